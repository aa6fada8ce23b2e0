"""Every function that takes a table, every column, and values that are none: refused with table, row and column."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.vertices import with_truth
from cgemit.detector.channels import channels_of
from cgemit.reconstruction.find.loops import link_loops
from cgemit.reconstruction.vertex import begin_at_vertices
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.check import table_problems
from cgemit.tables.schema import Column
from cgemit.tables.table import stacked, targets
from cgemit.truth.finder import by_truth
from cgemit.truth.match import joined

PIXEL = "besiii-pixel"
Tables = dict[str, Table]


@cache
def result() -> cg.Result:
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)) + cg.Gun("mu+", p=0.8, cos_theta=(-0.8, 0.8))
    settings = cg.Settings(
        simulate=cg.SimulateSettings(steps=True), fit=cg.FitSettings(residuals=True, states=("origin", "hits"))
    )
    return cg.run(PIXEL, gun, n=3, seed=5, workers=1, finder="ckf", settings=settings)


@cache
def tables() -> Tables:
    found = dict(result().tables)
    pairs = cg.pair_tracks(found["tracks"])
    return found | {"vertices": cg.fit_vertices(PIXEL, found["tracks"], pairs)}


#: Calls with tables in the place of those of the run, and the tables that they read.
FUNCTIONS: dict[str, tuple[Callable[[Tables], object], tuple[str, ...]]] = {
    "simulate": (lambda t: cg.simulate(PIXEL, t["particles"], seed=1), ("particles",)),
    "digitize": (
        lambda t: cg.digitize(PIXEL, t["truths"], t["wire_truths"], seed=1, steps=t["steps"]),
        ("truths", "wire_truths", "steps"),
    ),
    "add_background": (
        lambda t: cg.add_background(result().detector, t["digis"], t["wire_hits"], cg.BackgroundSettings(), 1),
        ("digis", "wire_hits"),
    ),
    "mix_events": (
        lambda t: cg.mix_events(PIXEL, t["digis"], t["wire_hits"], dict(tables())), ("digis", "wire_hits")
    ),
    "mix_events, others": (
        lambda t: cg.mix_events(PIXEL, tables()["digis"], tables()["wire_hits"], t), ("digis", "wire_hits")
    ),
    "cluster": (lambda t: cg.cluster(PIXEL, t["digis"]), ("digis",)),
    "find_tracks": (lambda t: cg.find_tracks(PIXEL, t["clusters"], t["wire_hits"]), ("clusters", "wire_hits")),
    "label_candidates": (
        lambda t: cg.label_candidates(t["clusters"], t["wire_hits"], t["clusters"]["event"], t["wire_hits"]["event"]),
        ("clusters", "wire_hits"),
    ),
    "by_truth": (
        lambda t: by_truth(PIXEL, t["particles"], t["clusters"], t["wire_hits"], t["truths"], t["wire_truths"]),
        ("particles", "clusters", "wire_hits", "truths", "wire_truths"),
    ),
    "fit": (
        lambda t: cg.fit(PIXEL, t["clusters"], t["wire_hits"], t["candidates"], t["candidate_hits"]),
        ("clusters", "wire_hits", "candidates", "candidate_hits"),
    ),
    "reconstruct": (
        lambda t: cg.reconstruct(PIXEL, t["clusters"], t["wire_hits"], cg.find_tracks, digis=t["digis"]),
        ("clusters", "wire_hits", "digis"),
    ),
    "match": (
        lambda t: cg.match(
            t["tracks"], t["candidates"], t["candidate_hits"], t["clusters"], t["wire_hits"], t["particles"],
            t["truths"], t["wire_truths"], detector=PIXEL,
        ),
        ("tracks", "candidates", "candidate_hits", "clusters", "wire_hits", "particles", "truths", "wire_truths"),
    ),
    "extrapolate tracks": (lambda t: cg.extrapolate(PIXEL, t["tracks"], 20.0), ("tracks",)),
    "extrapolate states": (lambda t: cg.extrapolate(PIXEL, t["states"], 20.0), ("states",)),
    "pair_tracks": (lambda t: cg.pair_tracks(t["tracks"]), ("tracks",)),
    "fit_vertices": (lambda t: cg.fit_vertices(PIXEL, t["tracks"]), ("tracks",)),
    "begin_at_vertices": (
        lambda t: begin_at_vertices(PIXEL, t["candidates"], t["tracks"], t["vertices"]),
        ("candidates", "tracks", "vertices"),
    ),
    "link_loops": (lambda t: link_loops(t["tracks"], -1.0), ("tracks",)),
    "resolution": (lambda t: cg.resolution(joined(t["tracks"], t["matches"]), "dr"), ("tracks",)),
    "pulls": (lambda t: cg.study.pulls(joined(t["tracks"], t["matches"])), ("tracks",)),
    "resolution_against": (
        lambda t: cg.study.resolution_against(joined(t["tracks"], t["matches"]), "p", "cos_theta", bins=2), ("tracks",)
    ),
    "chi2_probability": (lambda t: cg.study.chi2_probability(t["tracks"]), ("tracks",)),
    "cosmics": (lambda t: cg.study.cosmics(t["tracks"]), ("tracks",)),
    "with_truth": (
        lambda t: with_truth(t["vertices"], t["tracks"], t["matches"], t["particles"]),
        ("vertices", "tracks", "particles"),
    ),
    "delta_displacements": (
        lambda t: cg.study.delta_displacements(t["truths"], t["steps"]), ("truths", "steps")
    ),
    "at_origin": (lambda t: cg.helix.at_origin(t["particles"], -1.0), ("particles",)),
}  # fmt: skip

#: Whole numbers of either sign; -1 crossings are an unknown number of them.
SIGNED = ("pdg", "charge", "ndf", "n_truths")
#: Whole numbers of a short list.
CODES = ("view", "side", "method", "displaced", "decayed", "surface", "used", "parent")
#: Numbers that are not negative.
POSITIVE = ("mass", "err", "sigma", "chi2", "path", "err_x", "err_v", "err_p", "err_dr", "err_mass", "err_kappa")
#: Links that a function uses lead to rows.
USED = {("candidate_hits", "hit"), ("candidate_hits", "candidate"), ("tracks", "candidate"), ("steps", "truth")}


def wrong_values(kind: str, column: Column) -> list[Any]:
    """Return values that a column cannot have, as its documentation says."""
    if column.dtype.kind == "f":
        sometimes = "NaN" in column.doc or column.name in ("residual", "err", "pull", "drift_time", "position")
        sometimes |= kind == "clusters" and column.name in ("charge", "time")  # files of other programs lack them
        not_negative = [-1.0] if column.name in POSITIVE or f"{kind}.{column.name}" == "truths.energy" else []
        return [np.inf, -np.inf, 1e300, *([] if sometimes else [np.nan]), *not_negative]
    if targets(column):
        return [-7]
    if column.name in SIGNED:
        return []
    least = -1 if "-1" in column.doc else 0
    below = [least - 1] if column.dtype.kind == "i" else []
    return below + ([np.iinfo(column.dtype).max] if column.name in CODES and column.dtype.itemsize == 1 else [])


def changed(kind: str, name: str, value: Any, given: Mapping[str, Table] | None = None) -> tuple[Tables, int]:
    """Return the tables with another value in one row of a column, and the row."""
    found = dict(given or tables())
    array = found[kind][name].copy()
    row = int(np.flatnonzero(found[kind]["view"] == 0)[-1]) if "view" in found[kind] else len(array) // 2
    array[row] = value
    return found | {kind: found[kind].with_columns(**{name: array})}, row


CASES = [
    (function, kind, column.name)
    for function, (_, kinds) in FUNCTIONS.items()
    for kind in kinds
    for column in SCHEMAS[kind][1:]
    # Statuses of particles are those of an earlier simulation, masses and charges have a check by their PDG number.
    if (function, column.name) != ("simulate", "status")
]


@pytest.mark.parametrize(("function", "kind"), sorted({case[:2] for case in CASES}))
def test_values_that_are_none_are_refused_with_row_and_column(function: str, kind: str) -> None:
    call = FUNCTIONS[function][0]
    silent = []
    for column in SCHEMAS[kind][1:]:
        if (function, kind, column.name) not in CASES:
            continue
        for value in wrong_values(kind, column):
            found, row = changed(kind, column.name, value)
            try:
                call(found)
            except ValueError as error:
                named = f"{kind} row {row}: {column.name}: got" in str(error)
                if not named and not (function == "simulate" and f"in row {row}" in str(error)):
                    silent.append((column.name, value, str(error)))
            else:
                silent.append((column.name, value, "accepted"))
    assert silent == []


def test_residuals_that_are_no_measurements_are_refused() -> None:
    tracks = joined(tables()["tracks"], tables()["matches"])
    residual = tracks["res_dr"].copy()
    residual[1] = 1e300
    with pytest.raises(ValueError, match=r"tracks row 1: res_dr: got 1e\+300, expected a number from .* or NaN"):
        cg.resolution(tracks.with_columns(res_dr=residual), "dr")
    residual[1] = np.nan  # of a track without a particle
    assert dict(cg.resolution(tracks.with_columns(res_dr=residual), "dr").removed)["without a value"] == 1


LINKS = [
    ("digitize", "steps", "truth"), ("find_tracks", "clusters", "x_cluster"), ("find_tracks", "clusters", "v_cluster"),
    ("fit", "candidate_hits", "candidate"), ("fit", "candidate_hits", "hit"), ("match", "clusters", "truth"),
    ("match", "wire_hits", "wire_truth"), ("match", "tracks", "candidate"), ("by_truth", "clusters", "truth"),
    ("begin_at_vertices", "vertices", "first"), ("begin_at_vertices", "vertices", "second"),
]  # fmt: skip


@pytest.mark.parametrize(("function", "kind", "name"), LINKS)
def test_links_that_lead_to_no_row_of_the_event_are_refused(function: str, kind: str, name: str) -> None:
    found = tables()
    rows = found[kind]
    if "cluster" in name:  # of an XV cluster
        row = int(np.flatnonzero((rows["view"] == 2) & (rows["event"] == 0))[0])
    else:
        row = int(np.flatnonzero(rows["event"] == 0)[0])
    values = [10**6, int(rows[name][rows["event"] == 2].max())]
    for value in [*values, *([-1] if (kind, name) in USED or kind == "vertices" else [])]:
        links = rows[name].copy()
        links[row] = value
        with pytest.raises(
            ValueError, match=rf"{kind} row {row}: {name}: got {value}, expected a row of .* same event"
        ):
            FUNCTIONS[function][0](found | {kind: rows.with_columns(**{name: links})})


LAYERED = (
    ("digitize", "truths"), ("digitize", "wire_truths"), ("add_background", "digis"), ("mix_events", "digis"),
    ("cluster", "digis"), ("find_tracks", "clusters"), ("find_tracks", "wire_hits"), ("fit", "clusters"),
    ("fit", "wire_hits"), ("match", "clusters"), ("match", "wire_hits"), ("by_truth", "truths"),
)  # fmt: skip
CHANNELS = [
    *((function, kind, "layer", 100) for function, kind in LAYERED),
    ("cluster", "digis", "strip", 10**6), ("cluster", "digis", "sheet", 9), ("find_tracks", "clusters", "sheet", 9),
    ("fit", "wire_hits", "wire", 10**6), ("mix_events", "wire_hits", "gid", 1), ("add_background", "digis", "gid", 1),
]  # fmt: skip


@pytest.mark.parametrize(("function", "kind", "name", "value"), CHANNELS)
def test_channels_that_the_detector_does_not_have_are_refused(function: str, kind: str, name: str, value: int) -> None:
    rows = tables()[kind]
    row = int(np.flatnonzero(rows["strip"] >= 0)[3]) if "strip" in rows else len(rows) // 2
    numbers = rows[name].copy()
    numbers[row] = value
    with pytest.raises(ValueError, match=rf"{kind} row {row}: {name}: got {value}, expected .* {PIXEL}"):
        FUNCTIONS[function][0](tables() | {kind: rows.with_columns(**{name: numbers})})


def test_tables_of_another_detector_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"find_tracks: \d+ problems?\n  clusters row 0: layer: got 0, expected a layer of besiii-idc"
    ):
        cg.find_tracks("besiii-idc", tables()["clusters"], Table.empty("wire_hits", **tables()["clusters"].cover))


@pytest.mark.parametrize("change", ["negative", "not symmetric", "not positive"])
@pytest.mark.parametrize(
    ("function", "kind"),
    [
        ("extrapolate tracks", "tracks"),
        ("extrapolate states", "states"),
        ("fit_vertices", "tracks"),
        ("begin_at_vertices", "vertices"),
    ],
)
def test_matrices_that_are_no_covariances_are_refused(function: str, kind: str, change: str) -> None:
    cov = tables()[kind]["cov"].copy()
    if change == "negative":
        cov[1, 0, 0] *= -1
    elif change == "not symmetric":
        cov[1, 0, 1] = cov[1, 1, 0] + 0.1 * np.sqrt(cov[1, 0, 0] * cov[1, 1, 1])
    else:
        cov[1, 0, 1] = cov[1, 1, 0] = 1.01 * np.sqrt(cov[1, 0, 0] * cov[1, 1, 1])
    with pytest.raises(
        ValueError, match=f"{kind} row 1: cov: got a matrix that is none, expected a symmetric, positive"
    ):
        FUNCTIONS[function][0](tables() | {kind: tables()[kind].with_columns(cov=cov)})


def test_rows_without_a_fit_may_have_any_numbers() -> None:
    tracks = tables()["tracks"]
    status = tracks["status"].copy()
    status[0] = cg.FitStatus.not_positive_definite
    cov, dr = tracks["cov"].copy(), tracks["dr"].copy()
    cov[0], dr[0] = np.nan, np.inf
    failed = tracks.with_columns(status=status, cov=cov, dr=dr)
    assert table_problems(tracks=failed) == []
    states = cg.extrapolate(PIXEL, failed, 20.0)
    assert states["status"][0] == cg.StateStatus.not_fitted
    assert np.array_equal(states["x"][1:], cg.extrapolate(PIXEL, tracks, 20.0)["x"][1:])


def test_a_state_of_huge_numbers_is_none() -> None:
    """Numbers within the limits whose squares are beyond all digits: a status, or a state of finite numbers."""
    tracks = tables()["tracks"]
    for name in ("dr", "dz", "kappa", "tanl"):
        states = cg.extrapolate(PIXEL, tracks.with_columns(**{name: np.full(len(tracks), 1e11)}), 20.0)
        good = states["status"] == 0
        assert np.isfinite(states["cov"][good]).all()
        assert np.isfinite(states["px"][good]).all()


@pytest.mark.parametrize("name", cg.detectors())
def test_tables_of_a_run_pass_the_check(name: str) -> None:
    settings = cg.Settings(
        simulate=cg.SimulateSettings(steps=True, half_turns=3),
        fit=cg.FitSettings(residuals=True, states=("origin", "beam_line", "hits", 200.0)),
    )
    gun = cg.Gun("pi-", p=(0.05, 1.0), cos_theta=(-0.95, 0.95), multiplicity=2)
    made = cg.run(name, gun, n=6, seed=3, workers=1, finder="ckf", settings=settings)
    assert table_problems(channels_of(made.detector), **made.tables) == []


def test_further_columns_are_kept_by_stages_that_pass_tables_on() -> None:
    given = {
        name: table.with_columns(weight=np.arange(len(table)) + 0.5, tag=np.full(len(table), 7, np.int16))
        for name, table in tables().items()
    }
    detector, digis, wire_hits = result().detector, given["digis"], given["wire_hits"]
    noise = cg.BackgroundSettings(cells=0.05)
    made = {
        "simulate": cg.simulate(detector, given["particles"], seed=1)["particles"],
        "begin": begin_at_vertices(detector, given["candidates"], given["tracks"], given["vertices"]),
    }
    for name, found in {
        "cells": cg.add_background(detector, digis, wire_hits, noise, 1),
        "level": cg.add_background(detector, digis, wire_hits, cg.BackgroundSettings(level="bes2026"), 1),
        "mix": cg.mix_events(detector, digis, wire_hits, dict(tables())),
    }.items():
        made |= {f"{name} {kind}": table for kind, table in found.items()}
    settings = cg.RefineSettings(start_time="fitted")
    again = cg.reconstruct(
        detector, given["clusters"], wire_hits, cg.find_tracks, refinements=cg.refinements(settings), digis=digis
    )
    made |= {name: table for name, table in again.items() if name.startswith("refined")}
    assert "refined_wire_hits" in made
    for name, table in made.items():
        assert {"weight", "tag"} <= set(table), name
        own = np.isfinite(table["weight"])
        assert own.any(), name
        assert set(table["tag"][own].tolist()) == {7}, name
        assert set(table["tag"][~own].tolist()) <= {-1}, name


def test_columns_that_further_rows_lack_are_blank() -> None:
    table = tables()["searches"].with_columns(weight=np.ones(3), tag=np.ones(3, "i4"), text=np.full(3, "a"))
    found = stacked(table, {"event": [2], "seeds": [5], "limits": [0]})
    assert found["event"].tolist() == [0, 1, 2, 2]
    assert np.isnan(found["weight"][3])
    assert (found["tag"].tolist(), found["seeds"][3]) == ([1, 1, 1, -1], 5)
