"""The compiled form: slabs, readout and wires as the core sees them, and arguments that the core refuses."""

import dataclasses
import math

import numpy as np
import numpy.typing as npt
import pytest

from cgemit import _core
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.detector import CgemLayer, Detector, compiled, detectors, load, slab_table, slabs
from cgemit.detector import core as compiling
from cgemit.detector.core import layer_table, wire_table
from cgemit.detector.shells import _compiled
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings
from cgemit.reconstruction.given_hits import fit_hits

DESIGN = load("besiii-cgem-design")


def group(index: int) -> str:
    return slabs(DESIGN)[index].shells[0].group


def test_order_of_the_design_detector() -> None:
    cgem = ["cathode", "drift", "foils", "anode", "air"]
    expected = ["pipe", "air", *cgem, *cgem, *cgem, "wall"]
    found = [slab.shells[0].group for slab in slabs(DESIGN)]
    assert found[: len(expected)] == expected
    assert set(found[len(expected) :]) == {"gas"}
    assert [slab.shells[0].group for slab in slabs(DESIGN, merge=False)].count("gas") == 35
    assert [slab.gap for slab in slabs(DESIGN) if slab.gap >= 0] == [0, 1, 2]


@pytest.mark.parametrize("name", list(detectors()))
@pytest.mark.parametrize("merge", [True, False])
def test_slabs_fill_space_without_gap_or_overlap(name: str, merge: bool) -> None:
    table, log_terms, composition = slab_table(slabs(load(name), merge))
    assert np.allclose(table["r_in"][1:], table["r_out"][:-1], atol=1e-9)
    assert np.all((table["r_in"] < table["radius"]) & (table["radius"] < table["r_out"]))
    assert np.all(table["spread"] > 0)
    assert np.all(table["x0"] > 0)
    assert np.all(table["xi"] > 0)
    assert log_terms.shape == (len(table["x0"]), _core.detector.LOSS_POINTS)
    assert np.all(np.isfinite(log_terms))
    assert composition["first"].shape == (len(table["x0"]) + 1,)
    assert np.all(np.diff(composition["first"]) > 0)
    assert np.all(composition["moles"] > 0)


@pytest.mark.parametrize("name", list(detectors()))
def test_merging_keeps_the_matter_and_its_moments(name: str) -> None:
    merged, merged_log, merged_elements = slab_table(slabs(load(name), True))
    single, single_log, single_elements = slab_table(slabs(load(name), False))
    for table in (merged, single):
        table["first"] = table["x0"] * table["radius"]
        table["second"] = table["x0"] * (table["radius"] ** 2 + table["spread"] ** 2)
    assert len(single["x0"]) > len(merged["x0"])
    for column in ("x0", "xi", "first", "second"):
        assert np.sum(merged[column]) == pytest.approx(np.sum(single[column]), rel=1e-12)
    assert merged["xi"] @ merged_log == pytest.approx(single["xi"] @ single_log, rel=1e-12)
    assert merged["gap"].max() == single["gap"].max()
    for element in np.unique(single_elements["z"]):
        amounts = [np.sum(e["moles"][e["z"] == element]) for e in (merged_elements, single_elements)]
        assert amounts[0] == pytest.approx(amounts[1], rel=1e-12)


def test_cathode_by_hand() -> None:
    # L1 of the design: the nine sub-layers end at the cathode side of the gap, r = 76.338 mm for 650 um strips.
    layers = [(0.003, 14.35), (0.05, 284.1), (0.015, 336.0), (1.9, 13000), (0.015, 336.0), (0.025, 284.1),
              (0.015, 336.0), (0.05, 284.1), (0.003, 14.35)]  # fmt: skip
    radius = 87.5 - 6.162 - 5 - sum(thickness for thickness, _ in layers)
    weights, middles, widths = [], [], []
    for thickness, x0 in layers:
        weights.append(thickness / x0)
        middles.append(radius + thickness / 2)
        widths.append(thickness**2 / 12)
        radius += thickness
    centre = np.average(middles, weights=weights)
    spread = math.sqrt(np.average((np.array(middles) - centre) ** 2 + widths, weights=weights))
    table = slab_table(slabs(DESIGN)).slabs
    assert group(2) == "cathode"
    assert table["x0"][2] == pytest.approx(sum(weights))
    assert table["radius"][2] == pytest.approx(centre)
    assert table["spread"][2] == pytest.approx(spread)
    assert table["z_max"][2] == 266


def test_drift_gap_and_air() -> None:
    table = slab_table(slabs(DESIGN)).slabs
    assert group(3) == "drift"
    assert table["radius"][3] == pytest.approx(78.838)
    assert table["spread"][3] == pytest.approx(5 / math.sqrt(12))
    assert table["x0"][3] == pytest.approx(5 / 121650)
    assert group(1) == "air"
    assert table["z_max"][1] == 1e9
    assert table["x0"][1] == pytest.approx((table["r_in"][2] - 33.7) / 303900)


def test_beam_pipe_xi_by_hand() -> None:
    # 0.1535 MeV cm2/mol (Z/A) rho t: gold, beryllium twice, oil C18H38 (146 electrons, 254.502 g/mol).
    gold = 79 / 196.97 * 19.32 * 0.001436
    beryllium = 4 / 9.0122 * 1.848 * 0.14
    oil = 146 / 254.502 * 0.81 * 0.08
    table, log_terms, composition = slab_table(slabs(DESIGN))
    assert table["xi"][0] == pytest.approx(0.1535375e-3 * (gold + beryllium + oil), rel=1e-3)
    # At beta gamma = 1, below the density effect, the logarithm is the mean of -2 ln I - 2 C/Z.
    one = round(-_core.detector.LOSS_GRID_FIRST / _core.detector.LOSS_GRID_STEP)
    oil_excitation = math.exp((108 * math.log(81) + 38 * math.log(19.2)) / 146)

    def shells(ev: float) -> float:
        return 0.45240e-6 * ev**2 + 3.69280e-9 * ev**3  # Barkas and Berger at beta gamma = 1

    oil_shells = (18 * shells(78.0) + 38 * shells(19.2)) / 146
    means = [(gold, 790, shells(790) / 79), (beryllium, 63.7, shells(63.7) / 4), (oil, oil_excitation, oil_shells)]
    expected = sum(w * (-2 * math.log(ev * 1e-9) - 2 * shell) for w, ev, shell in means) / (gold + beryllium + oil)
    assert log_terms[0, one] == pytest.approx(expected, rel=1e-5)
    # Elements: gold, beryllium, carbon, hydrogen.
    amounts = [19.32 * 0.001436 / 196.97, 1.848 * 0.14 / 9.0122, 18 * 0.81 * 0.08 / 254.502, 38 * 0.81 * 0.08 / 254.502]
    assert composition["z"][:4].tolist() == [79, 4, 6, 1]
    assert composition["moles"][:4] == pytest.approx(amounts, rel=1e-3)


def gas_of(detector: Detector, merge: bool = False) -> npt.NDArray[np.bool_]:
    """Return which slabs are gas of the drift chamber."""
    return np.array([slab.shells[0].group == "gas" for slab in slabs(detector, merge=merge)])


def test_chamber_gas_is_cut_at_the_wire_layers() -> None:
    table = slab_table(slabs(DESIGN, merge=False)).slabs
    gas = gas_of(DESIGN)
    wires = [layer.r_mid for layer in DESIGN.drift_chamber.layers]
    assert gas.sum() == 35
    assert table["r_out"][gas] == pytest.approx(wires)
    assert table["r_in"][gas] == pytest.approx([183.2, *wires[:-1]])
    halves = [layer.half_length for layer in DESIGN.drift_chamber.layers]
    # The end plate steps outward; each lump reaches to the plate of the layer after it.
    assert table["z_max"][gas] == pytest.approx(halves)


def test_chamber_gas_is_merged_in_lumps() -> None:
    merged, single = slab_table(slabs(DESIGN)).slabs, slab_table(slabs(DESIGN, merge=False)).slabs
    gas, parts = gas_of(DESIGN, merge=True), gas_of(DESIGN)
    assert gas.sum() < 15
    assert set(merged["r_out"][gas]) < set(single["r_out"][parts])
    assert np.all(merged["r_out"][gas] - merged["r_in"][gas] < 70)
    # What is joined ends at about the same z.
    for r_in, r_out, half_length in zip(merged["r_in"][gas], merged["r_out"][gas], merged["z_max"][gas], strict=True):
        inside = parts & (single["r_in"] >= r_in - 1e-9) & (single["r_out"] <= r_out + 1e-9)
        assert np.all(single["z_max"][inside] > half_length / 1.01)


def test_smeared_wires_add_their_matter() -> None:
    smeared = DESIGN.with_overrides({"drift_chamber.wires": "smeared"})
    without, with_wires = (slab_table(slabs(detector, merge=False)).slabs for detector in (DESIGN, smeared))
    added = with_wires["x0"] - without["x0"]
    gas = gas_of(DESIGN)
    assert added[~gas] == pytest.approx(0)
    assert np.sum(added) == pytest.approx(0.0009, rel=0.001)
    assert with_wires["radius"] == pytest.approx(without["radius"])
    # Aluminium: 0.09 % of 88.97 mm.
    xi = 0.1535375e-3 * 13 / 26.982 * 2.70 * 0.1 * 88.97 * np.sum(added)
    assert np.sum(with_wires["xi"] - without["xi"]) == pytest.approx(xi, rel=1e-6)


def test_readout_and_wire_tables() -> None:
    cgem, wires = layer_table(DESIGN.cgem), wire_table(load("besiii-idc").drift_chamber)
    assert cgem["r_readout"].tolist() == [87.5, 132.5, 175.0]
    assert cgem["z_max"].tolist() == [266, 345, 423.5]
    assert cgem["phi_first"][:, :2] == pytest.approx(np.array([[math.pi, math.pi], [math.pi, 0], [math.pi, 0]]))
    assert cgem["gid_first"].tolist() == [0, 2020, 5488]
    assert wires["gid_first"][:3].tolist() == [0, 40, 84]
    assert wires["twist"][0] == pytest.approx(math.radians(31.5))
    assert wires["twist"][4] == pytest.approx(-4.5 * 2 * math.pi / 64)


@pytest.mark.parametrize("name", list(detectors()))
def test_core_takes_it(name: str) -> None:
    detector = load(name)
    core = compiled(detector)
    assert core.bz == detector.field.bz
    assert core.n_slabs == len(slabs(detector))
    assert core.n_layers == len(detector.layers)
    assert core.n_wire_layers == (len(detector.drift_chamber.layers) if detector.drift_chamber else 0)
    assert compiled(load(name)) is core
    assert compiled(detector, merge=False).n_slabs > core.n_slabs


def test_parts_may_be_missing() -> None:
    only_cgem = load({"base": "besiii-cgem", "remove": ["drift_chamber", "beam_pipe", "walls"]})
    assert [slab.shells[0].group for slab in slabs(only_cgem)][:2] == ["cathode", "drift"]
    assert compiled(only_cgem).n_wire_layers == 0
    only_chamber = load({"base": "besiii-idc", "remove": ["beam_pipe", "walls"]})
    assert len(slabs(only_chamber, merge=False)) == 42  # between 43 wire layers
    assert compiled(only_chamber).n_layers == 0


def test_wall_between_wire_layers_cuts_the_gas() -> None:
    wall = {"r_in": "180 mm", "r_out": "181 mm", "half_length": "500 mm", "material": "CarbonFiber"}
    detector = load({"base": "besiii-idc", "walls": {"middle": wall}})
    found = slabs(detector)
    place = next(i for i, slab in enumerate(found) if slab.shells[0].label == "middle")
    assert [slab.shells[0].label for slab in found[place - 1 : place + 2]] == [
        "gas before layer 8", "middle", "gas before layer 8"
    ]  # fmt: skip
    assert found[place - 1].r_out == 180
    assert found[place + 1].r_in == 181


def test_gap_moves_the_cathode_only() -> None:
    layer: CgemLayer = DESIGN.cgem[0]
    thin: Detector = DESIGN.with_overrides({"cgem.L1.drift_gap": "3 mm"})
    assert thin.cgem[0].r_gap_out == layer.r_gap_out
    assert thin.cgem[0].r_out == layer.r_out
    assert thin.cgem[0].r_in == pytest.approx(layer.r_in + 2)
    assert dataclasses.replace(thin.cgem[0], drift_gap=5.0) == layer


DETECTOR = load("besiii-cgem-design")


def arguments():
    """Return the arguments of the core's detector."""
    return {
        "bz": -1.0, **slab_table(slabs(DETECTOR))._asdict(), "layers": compiling.layer_table(DETECTOR.cgem),
        "wires": compiling.wire_table(DETECTOR.drift_chamber), "screening": _core.matter.Screening.wentzel,
    }  # fmt: skip


def changed(table, column, value, row=0):
    """Return the arguments with one number changed."""
    given = arguments()
    columns = dict(given[table])
    columns[column] = columns[column].copy()
    columns[column][row] = value
    return given | {table: columns}


def test_the_arguments_are_right_unchanged():
    assert _core.detector.Detector(**arguments()).n_wire_layers == 35


@pytest.mark.parametrize(
    ("table", "column", "value", "message"),
    [
        ("wires", "cells", 0, r"wires\[0\] cells: got 0, expected 1 to"),
        ("wires", "cells", -1, "cells: got -1"),
        ("wires", "cells", 2**31 - 1, "cells: got 2147483647"),
        ("wires", "number", -1, "number: got -1, expected 0 to 65535"),
        ("wires", "number", 2**31 - 1, "number: got 2147483647"),
        ("wires", "z_max", -1e4, "z_max: got -10000"),
        ("wires", "r_end", np.nan, "r_end: got nan"),
        ("wires", "sigma", np.inf, "sigma: got inf"),
        ("wires", "efficiency", 2.0, "efficiency: got 2"),
        ("layers", "pitch_x", 0.0, r"layer\[0\] pitch_x: got 0"),
        ("layers", "strips_v", 0, "strips_v: got 0"),
        ("layers", "sheets", 9, "sheets: got 9, expected 1 to 8"),
        ("layers", "stereo", 0.0, "stereo: got 0"),
        ("layers", "r_gap_out", 1.0, "r_gap_out: got 1"),
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
        _core.detector.Detector(**changed(table, column, value))


def test_rows_of_components_stay_within():
    given = arguments()
    first = given["composition"]["first"].copy()
    first[-1] += 1000
    with pytest.raises(IndexError):
        _core.detector.Detector(**given | {"composition": given["composition"] | {"first": first}})
    first[1] = 10**6
    with pytest.raises(ValueError, match="not to decrease"):
        _core.detector.Detector(**given | {"composition": given["composition"] | {"first": first}})


def test_all_problems_are_listed():
    given = changed("wires", "cells", 0)
    given["wires"]["sigma"] = np.full(35, np.nan)
    given["bz"] = np.nan
    with pytest.raises(ValueError, match="detector:") as caught:
        _core.detector.Detector(**given)
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
    assert _core.detector.Field(**FIELD, axes=AXES, coefficients=np.zeros(72)).bz == -1
    with pytest.raises(ValueError, match=message):
        _core.detector.Field(**FIELD | {"coefficients": np.zeros(3)} | change)


@pytest.fixture(scope="module")
def calls():
    """Return the arguments with which the fit calls `states` and `seeds`."""
    kept = {}
    states = _core.reconstruction.states

    def keep(detector, **given):
        kept["states"] = {"detector": detector, **given}
        return states(detector, **given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_core.reconstruction, "states", keep)
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
    call = _core.reconstruction.states if name == "states" else _core._testing.seeds
    call(**given)
    with pytest.raises(ValueError, match=message):
        call(**given | {argument: change(given[argument])})


def test_targets_of_states(calls):
    given = calls["states"]
    for change, message in (
        ({"radius": np.array([np.nan, 0.0])}, "radius"), ({"share": np.array([2.0, 0.0])}, "share"),
        ({"surface": np.array([9, 0], np.int8)}, "no such surface"),
        ({"surface": np.array([_core.reconstruction.Surface.cylinder, 0], np.int8)}, "above 0 for a cylinder"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            _core.reconstruction.states(**given | {"targets": given["targets"] | change})


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
        _core.detector.sum_shells(materials=[], r_in=[], r_out=[])
    air = _compiled(DETECTOR.air)
    with pytest.raises(ValueError, match="with r_in and r_out for each"):
        _core.detector.sum_shells(materials=[air], r_in=[1.0, 2.0], r_out=[2.0])
    with pytest.raises(ValueError, match="got None, expected a Material"):
        _core.detector.sum_shells(materials=[None], r_in=[1.0], r_out=[2.0])  # type: ignore[list-item]


def test_wires_of_a_chamber_are_checked_before_they_are_placed() -> None:
    wires = compiling.wire_table(DETECTOR.drift_chamber)
    with pytest.raises(ValueError, match=r"wires\[0\] cells: got 0, expected 1 to"):
        _core.detector.Chamber(wires | {"cells": np.zeros_like(wires["cells"])})
