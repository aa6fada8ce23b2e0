"""The compiled core refuses what it would divide by, index with or allocate."""

import numpy as np
import pytest

from cgemit import _core
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.detector import core as compiling
from cgemit.detector import load, slab_table, slabs
from cgemit.detector.matter import _compiled
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings
from cgemit.reconstruction.given_hits import fit_hits

DETECTOR = load("besiii-cgem-design")


def arguments():
    """Return the arguments of the core's detector."""
    return {
        "bz": -1.0, **slab_table(slabs(DETECTOR))._asdict(), "cgem": compiling.cgem_table(DETECTOR.cgem),
        "wires": compiling.wire_table(DETECTOR.drift_chamber), "screening": _core.Screening.wentzel,
    }  # fmt: skip


def changed(table, column, value, row=0):
    """Return the arguments with one number changed."""
    given = arguments()
    columns = dict(given[table])
    columns[column] = columns[column].copy()
    columns[column][row] = value
    return given | {table: columns}


def test_the_arguments_are_right_unchanged():
    assert _core.Detector(**arguments()).n_wire_layers == 35


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("wires", "cells", 0, r"wires\[0\] cells: got 0, expected 1 to"),
        ("wires", "cells", -1, "cells: got -1"),
        ("wires", "cells", 2**31 - 1, "cells: got 2147483647"),
        ("wires", "number", -1, "number: got -1, expected 0 to 65535"),
        ("wires", "number", 2**31 - 1, "number: got 2147483647"),
        ("wires", "half_length", 0.0, "half_length: got 0"),
        ("wires", "r_end", np.nan, "r_end: got nan"),
        ("wires", "sigma", np.inf, "sigma: got inf"),
        ("wires", "efficiency", 2.0, "efficiency: got 2"),
        ("cgem", "pitch_x", 0.0, r"cgem\[0\] pitch_x: got 0"),
        ("cgem", "strips_v", 0, "strips_v: got 0"),
        ("cgem", "sheets", 3, "sheets: expected 1 to 2, the columns of phi_first, 8 at most"),
        ("cgem", "stereo", 0.0, "stereo: got 0"),
        ("cgem", "r_gap_out", 1.0, "r_gap_out: got 1"),
        ("slabs", "gap", 3, r"slab\[0\] gap: got 3, expected -1 to 2"),
        ("slabs", "gap", -2, "gap: got -2"),
        ("slabs", "x0", np.nan, "x0: got nan"),
        ("slabs", "xi", -1.0, "xi: got -1"),
        ("composition", "first", -5, "first: expected to begin with 0"),
        ("composition", "z", 0.0, "z: got 0"),
    ],
)
def test_numbers_of_detectors(table, column, value, message):
    with pytest.raises(ValueError, match=message):
        _core.Detector(**changed(table, column, value))


def test_rows_of_components_stay_within():
    given = arguments()
    first = given["composition"]["first"].copy()
    first[-1] += 1000
    with pytest.raises(IndexError):
        _core.Detector(**given | {"composition": given["composition"] | {"first": first}})
    first[1] = 10**6
    with pytest.raises(ValueError, match="not to decrease"):
        _core.Detector(**given | {"composition": given["composition"] | {"first": first}})


def test_all_problems_are_listed():
    given = changed("wires", "cells", 0)
    given["wires"]["sigma"] = np.full(35, np.nan)
    given["bz"] = np.nan
    with pytest.raises(ValueError, match="detector:") as caught:
        _core.Detector(**given)
    assert len(str(caught.value).splitlines()) == 1 + 1 + 1 + 35


FIELD = {"bz": -1.0, "tolerance": 1e-3}
AXES = [(0.0, 10.0, 4), (-10.0, 10.0, 4)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axes": [(0.0, 1.0, 2**30)] * 3}, "2 to 100000 points"),
        ({"axes": [(0.0, 1.0, 90_000)] * 3}, "of length 2187145"),
        ({"axes": [(0.0, 1.0, 1)] * 2}, "2 to 100000 points"),
        ({"axes": [(0.0, 0.0, 4)] * 2}, "at a finite distance"),
        ({"axes": [(np.nan, 1.0, 4)] * 2}, "at a finite distance"),
        ({"axes": [(0.0, np.inf, 4)] * 2}, "at a finite distance"),
        ({"axes": [AXES[0]]}, "expected two or three"),
        ({"axes": AXES, "coefficients": np.full(72, np.nan)}, "coefficients: expected finite"),
        ({"axes": AXES, "coefficients": np.zeros(71)}, "of length 72"),
        ({"bz": np.nan}, "expected finite numbers"),
        ({"tolerance": 0.0}, "tolerance above 0"),
        ({"reach": (-1.0, 1.0)}, "reach: expected"),
    ],
)
def test_fields(change, message):
    assert _core.Field(**FIELD, axes=AXES, coefficients=np.zeros(72)).bz == -1
    with pytest.raises(ValueError, match=message):
        _core.Field(**FIELD | {"coefficients": np.zeros(3)} | change)


@pytest.fixture(scope="module")
def calls():
    """Return the arguments with which the fit calls `states` and `seeds`."""
    kept = {}
    states = _core.states

    def keep(detector, **given):
        kept["states"] = {"detector": detector, **given}
        return states(detector, **given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_core, "states", keep)
        run(DETECTOR, Gun("mu-", p=0.5, theta=1), 6, settings=Settings(fit=FitSettings(states=("origin", "hits"))))
    names = ("detector", "hit_offsets", "hits", "mass")
    kept["seeds"] = {name: kept["states"][name] for name in names} | {"source": _core._testing.SeedFrom.wires}
    return kept


def with_nan(array, row=0):
    found = np.array(array, np.float64, copy=True)
    found.reshape(len(found), -1)[row] = np.nan
    return found


@pytest.mark.parametrize(
    ("name", "argument", "change", "message"),
    [
        ("states", "reference", with_nan, "track 0: expected finite reference"),
        ("states", "reference", np.zeros_like, "kappa other than 0"),
        ("states", "kinks", with_nan, "expected finite reference, kinks"),
        ("states", "prior", with_nan, "kinks and prior"),
        ("states", "mass", with_nan, "a mass above 0"),
        ("states", "mass", lambda mass: 0 * mass, "a mass above 0"),
        ("seeds", "mass", with_nan, "mass: expected finite"),
    ]
    + [
        (name, "hit_offsets", change, message)
        for name in ("states", "seeds")
        for change, message in (
            (lambda offsets: offsets + 1, "begin with 0"),
            (lambda offsets: offsets[::-1], "begin with 0"),
            (lambda offsets: np.array([0, 10**15, *offsets[2:]]), "increase"),
            (lambda offsets: np.array([*offsets[:-1], 10**15]), "length"),
            (lambda offsets: np.array([0, -5, *offsets[2:]]), "increase"),
            (lambda offsets: offsets[:0], "begin with 0"),
        )
    ],
)
def test_states_and_seeds(calls, name, argument, change, message):
    given = calls[name]
    call = _core.states if name == "states" else _core._testing.seeds
    call(**given)
    with pytest.raises(ValueError, match=message):
        call(**given | {argument: change(given[argument])})


def test_targets_of_states(calls):
    given = calls["states"]
    for change, message in (
        ({"radius": np.array([np.nan, 0.0])}, "radius"), ({"share": np.array([2.0, 0.0])}, "share"),
        ({"surface": np.array([9, 0], np.int8)}, "no such surface"),
        ({"surface": np.array([_core.Surface.cylinder, 0], np.int8)}, "above 0 for a cylinder"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            _core.states(**given | {"targets": given["targets"] | change})


def test_a_drift_is_not_longer_than_a_cell():
    """A drift distance of 100 mm is a mistake, such as micrometres or a time; the longest possible one is none."""
    layer = DETECTOR.drift_chamber.layers[10]
    wires = {"layer": [layer.number], "wire": [1], "drift": [100.0]}
    with pytest.raises(
        ValueError, match="wire_hits row 0: drift: got 100, expected at most three diagonals of a cell, "
    ):
        fit_hits(DETECTOR, wire_hits=wires)
    width = 2 * np.pi * layer.r_end / layer.cells
    fit_hits(DETECTOR, wire_hits=wires | {"drift": [1.6 * width]})  # as of tracks that turn back in the cell
    with pytest.raises(ValueError, match="three diagonals"):
        fit_hits(DETECTOR, wire_hits=wires | {"drift": [-100.0]})


def test_shells_need_a_material_and_radii_each() -> None:
    with pytest.raises(ValueError, match="sum_shells: expected at least one material, with r_in and r_out for each"):
        _core.sum_shells(materials=[], r_in=[], r_out=[])
    air = _compiled(DETECTOR.air)
    with pytest.raises(ValueError, match="with r_in and r_out for each"):
        _core.sum_shells(materials=[air], r_in=[1.0, 2.0], r_out=[2.0])
    with pytest.raises(ValueError, match="got None, expected a Material"):
        _core.sum_shells(materials=[None], r_in=[1.0], r_out=[2.0])  # type: ignore[list-item]


def test_wires_of_a_chamber_are_checked_before_they_are_placed() -> None:
    wires = compiling.wire_table(DETECTOR.drift_chamber)
    with pytest.raises(ValueError, match=r"wires\[0\] cells: got 0, expected 1 to"):
        _core.Chamber(wires | {"cells": np.zeros_like(wires["cells"])})
