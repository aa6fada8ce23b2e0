"""The compiled module refuses wrong numbers or computes with them: none ends the process, and each call ends."""

from __future__ import annotations

import functools
import itertools
import os
import re
import signal
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from borders import Call, changed, compiled_names, deaths, entries, of_another_type, recorded
from cgemit import _core
from cgemit.detector import compiled
from cgemit.fit_matter import momentum_error
from cgemit.particles.species import compiled_decays
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.cluster_errors import chip_delays, expected_errors
from cgemit.reconstruction.find.ckf import seedless
from cgemit.truth.origins import particle_rows

DESIGN = "besiii-cgem-design"


#: Of the fixture, which a process may make several times: each compiles a detector of its own.
NUMBER = itertools.count(1)


@pytest.fixture(scope="module")
def calls() -> dict[str, list[Call]]:
    """Calls of the functions and classes of the compiled module by name, as the package makes them."""
    found: dict[str, list[Call]] = {}
    # Materials, chambers and decays are compiled here, whatever other tests have made.
    compiled_decays.cache_clear()
    expected_errors.cache_clear()
    chip_delays.cache_clear()
    detector = cg.load(DESIGN).with_overrides(
        {
            "materials.Kapton.density": f"{1.43 + 1e-4 * next(NUMBER):.4f} g/cm3",
            "drift_chamber.sigma": "131.7 um",
            "cgem.L2.efficiency": 0.9,
        }
    )
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9), vertex_sigma=(1.0, 1.0, 1.0))
    with recorded(found):
        background = cg.Settings(background=cg.BackgroundSettings(level="bes2026"))
        result = cg.run(detector, gun, 4, workers=1, finder="ckf", settings=background)
        for readout in ("tiger", "apv25", "gaussian", "analog-projection"):
            cg.run(DESIGN, gun, 2, workers=1, readout=readout)
        cg.run(detector.with_field("besiii"), gun, 2, workers=1)
        cg.analytic(DESIGN, "mu-", p=[0.2, 1.0])
        cg.analytic(DESIGN, "mu-", p=1.0, radius=100.0)
        cg.analytic(DESIGN, "e-", p=1.0).losses()
        momentum_error(detector, "mu-", 1.0)
        cg.slab("Kapton 300 um", "pi-", p=0.5, n=1000)
        cg.extrapolate(DESIGN, result.tracks, 100.0)
        particle_rows(result.particles, result.truths)
        truth = result.particles, result.truths, result.wire_truths
        fitted = result.fitted, result.candidates, result.candidate_hits, result.clusters, result.wire_hits
        cg.match(*fitted, *truth, detector=detector)
        seedless(cg.load("kloe2-like"))
        core = compiled(result.detector)
        hits = collect_hits(core, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
        _core.reconstruction.hit_problems(core, hits.columns())
        cg.alignment_forecast(DESIGN, [(gun, 10)], cg.AlignmentSettings(free=("cgem.*",)), threads=1)
        cg.helix.change_pivot(
            np.array([[0.0, 1.0, 1.0, 0.0, 0.1]]), np.eye(5)[None], np.zeros((1, 3)), np.ones((1, 3)), 1.0
        )
    return found


def test_calls_of_all_functions_that_take_numbers_are_recorded(calls: dict[str, list[Call]]) -> None:
    names = compiled_names()
    assert len({name for _, name, _ in names}) == len(names) > 60
    functions = {name for _, name, one in names if callable(one) and not hasattr(one, "__members__")}
    no_numbers = {
        "isa",
        "keep_memory",
        "lanes",
        "processor_runs",
        "same_surfaces",
        "stop_stages",
        "use_kernels",
        "use_scalar_kernels",
    }
    assert functions - calls.keys() <= no_numbers


@pytest.mark.parametrize("name", ["read_out_analog", "covariances"])
def test_wrong_numbers_do_not_end_the_process(name: str, calls: dict[str, list[Call]]) -> None:
    assert [text for call in calls[name] for text in deaths(call)] == []


@pytest.mark.slow
def test_wrong_numbers_of_any_function_do_not_end_the_process(calls: dict[str, list[Call]]) -> None:
    assert [text for several in calls.values() for call in several for text in deaths(call)] == []


def test_deaths_and_endless_calls_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    def function(value: float, other: dict[str, float]) -> None:
        if value == np.inf:
            os.kill(os.getpid(), signal.SIGSEGV)
        while other["x"] == 0:
            pass

    monkeypatch.setattr("borders.SECONDS", 1)
    found = deaths(Call("function", function, (1.0,), {"other": {"x": 1.0}}))
    assert found == ["function(0, 0): inf: SIGSEGV", "function(1, 'other', 'x'): 0.0: SIGALRM"]


#: Columns that a function does not read of the tables that it is given whole, by function and argument.
UNREAD = {
    "match_hits particles, assign_hits particles, particle_rows 0": "charge mass pdg px py pz status x y z",
    "match_hits truths, assign_hits truths": """
        energy entry_x entry_y entry_z exit_x exit_y exit_z layer path phi px py pz r secondaries time z""",
    "match_hits wire_truths, assign_hits wire_truths": "doca layer side time wire x y z",
    "match_hits clusters": """
        charge err_phi err_v err_x err_z event first last layer method n_truths phi r score sheet size time v v_cluster
        x z""",
    "match_hits wire_hits": "drift drift_time event gid layer side sigma wire",
    "match_hits candidate_hits": "event",
    "assign_hits clusters": """
        charge corr_xv err_phi err_v err_x err_z event first last method n_truths phi r score sheet size time v
        v_cluster x x_cluster z""",
    "assign_hits wire_hits": "drift drift_time event gid side sigma wire",
    "particle_rows 1": """
        daughter energy entry_x entry_y entry_z exit_x exit_y exit_z half_turn layer path phi px py pz r secondaries
        time z""",
    "read_out_analog 1, read_out_profiles 1, read_out_strips 1, seen_crossings 1, smear_positions 1": """
        daughter half_turn path px py pz r secondaries""",
    "read_out_analog 2, read_out_profiles 2, read_out_strips 2": "delta",
    "read_out_analog drift": "lean",
    "read_out_wires 1": "daughter half_turn time x y z",
    "find_clusters 1, find_charge_time_clusters 1, clusters_of_positions 1": "gid",
    "charge_variances shares": "charges_apart log_numbers times_apart",
}
#: Columns that may be missing.
OPTIONAL = {
    "find_clusters 1, find_charge_time_clusters 1": "position",
    "find_tracks hits": "hit",
    "fit hits, hit_problems 1": "hit k side x",
    "states hits, sums hits": "k x",
}


def listed(columns: dict[str, str]) -> set[str]:
    return {
        f"{one} {name}" for several, names in columns.items() for one in several.split(", ") for name in names.split()
    }


def accepted(call: Call, change: Callable[[Any], Any] | None, unnamed: list[str]) -> set[str]:
    """Return the entries of the dicts of a call that it takes when they are changed, or missing without a change.

    To `unnamed` is added what is said of others that are refused without their name.
    """
    found = set[str]()
    names = [*map(str, range(len(call.arguments))), *call.keywords]
    given = [*call.arguments, *call.keywords.values()]
    for number, *inside in entries(given):
        if not inside:
            continue
        text, values = f"{call.name} {names[number]} {inside[-1]}", list(given)
        values[number] = changed(given[number], tuple(inside), change)
        n = len(call.arguments)
        try:
            call.function(*values[:n], **dict(zip(call.keywords, values[n:], strict=True)))
        except Exception as error:
            if not (isinstance(error, ValueError) and re.search(rf"(^|\s){inside[-1]}: ", str(error))):
                unnamed.append(f"{text}: {error}")
        else:
            found.add(text)
    return found


def test_entries_that_are_missing_or_of_another_type_are_named(calls: dict[str, list[Call]]) -> None:
    unnamed = list[str]()
    missing, other = (
        set[str]().union(*(accepted(several[0], change, unnamed) for several in calls.values()))
        for change in (None, of_another_type)
    )
    assert unnamed == []
    assert other == listed(UNREAD)
    assert missing == listed(UNREAD) | listed(OPTIONAL)


def test_problems_of_all_tables_of_a_detector_are_listed(calls: dict[str, list[Call]]) -> None:
    call = calls["Detector"][0]
    given = dict(call.keywords)
    given["slabs"] = without(given["slabs"], "z_max") | {"x0": np.full(len(given["slabs"]["x0"]), "a")}
    given["layers"] = without(given["layers"], "placement_turn") | {"phi_first": given["layers"]["phi_first"][:, 1:]}
    given["composition"] = without(given["composition"], "moles")
    given["gaps"] = [{**given["gaps"][0], "xi": "a", "slices": without(given["gaps"][0]["slices"], "rate")}]
    with pytest.raises(ValueError, match=r"^detector:") as caught:
        call.function(*call.arguments, **given)
    assert sorted(str(caught.value).splitlines()[1:]) == [
        "  composition moles: missing",
        "  gaps[0] slices rate: missing",
        "  gaps[0] xi: got 'a', which has another type than the field",
        f"  layers phi_first: expected shape ({len(given['layers']['sheets'])}, 8)",
        "  layers placement_turn: missing",
        "  slabs x0: got <U1, expected float64",
        "  slabs z_max: missing",
    ]


def without(columns: dict[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    return {other: column for other, column in columns.items() if other != name}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda hits: without(hits, "sigma"), "hits:\n  sigma: missing"),
        (lambda hits: hits | {"layer": hits["layer"] + 0.5}, "hits:\n  layer: got float64, expected int32"),
        (
            lambda hits: hits | {"value": hits["value"][1:]},
            "hits:\n  value: expected a one-dimensional array",
        ),
        (
            lambda hits: hits | {"side": hits["side"] * 1.0},
            "hits:\n  side: got float64, expected int8",
        ),  # may be missing
        (
            lambda hits: without(hits, "sigma") | {"kind": hits["kind"] + 0.5, "layer": "two"},
            "hits:\n  kind: got float64, expected uint8\n  layer: got <U3, expected int32\n  sigma: missing",
        ),
    ],
)
def test_columns_of_a_struct_of_spans_are_named(change: Callable[[Any], Any], message: str) -> None:
    run = cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=0.0), 2, workers=1)
    core = compiled(run.detector)
    hits = collect_hits(core, run.candidates, run.candidate_hits, run.clusters, run.wire_hits).columns()
    assert _core.reconstruction.hit_problems(core, hits) == ([], 0)
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        _core.reconstruction.hit_problems(core, change(hits))


def test_columns_of_a_struct_of_a_row_are_named() -> None:
    run = cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=0.0), 2, workers=1, until="simulate")
    truths = dict(run.truths.columns)
    given: dict[str, Any] = {"gain": 1e4, "w_values": np.full(3, 0.026), "seed": 1}
    errors = {name: np.full(3, 0.1) for name in ("sigma_x", "sigma_v", "sigma_time")}
    smear = functools.partial(_core.simulation.smear_positions, compiled(run.detector), **given)
    assert len(smear(truths, errors=errors)["gid"]) > 0
    for wrong, message in (
        (without(errors, "sigma_v"), "sigma_v: missing"),
        (errors | {"sigma_v": np.full(3, "a")}, "sigma_v: got <U1, expected float64"),
        (errors | {"sigma_v": np.full(2, 0.1)}, "sigma_v: expected a one-dimensional array of length 3"),
    ):
        with pytest.raises(ValueError, match=f"^errors:\n  {message}$"):
            smear(truths, errors=wrong)
    with pytest.raises(ValueError, match=r"^truths:\n  entry_y: missing$"):  # one of a point
        smear(without(truths, "entry_y"), errors=errors)
