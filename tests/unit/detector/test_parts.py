"""Displaced layers against lines and rotations by scipy; dead and hot strips and gain maps change nothing else."""

import dataclasses
import math
import pickle
import tomllib

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import cgemit as cg
from cgemit import Gun, Settings, _core, helix, load, run
from cgemit.detector import DetectorError, compiled, slabs
from cgemit.detector.core import grid_of, strip_gains, strip_lists, wire_lists
from cgemit.detector.layers.layer import PLACEMENT, Placed, local_v, seen_by
from cgemit.fit_matter import tuned
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.clusterers.binary import cluster_errors
from cgemit.truth import assign
from tests.helpers.stats import assert_within

DESIGN = load("besiii-cgem-design")
DISPLACED = {"shift_x": 0.3, "shift_y": -0.2, "shift_z": 0.4, "tilt_x": 1e-3, "tilt_y": -0.7e-3, "rotation": 2e-3}
UNITS = {"shift_x": "mm", "shift_y": "mm", "shift_z": "mm", "tilt_x": "rad", "tilt_y": "rad", "rotation": "rad"}
EXACT = {"simulate": {"fluctuations": "off", "deltas": False}}


def displaced(part, **values):
    return DESIGN.with_overrides({f"{part}.{name}": f"{value} {UNITS[name]}" for name, value in values.items()})


def in_axes(point):
    """Return a point in the axes of a part displaced by `DISPLACED`."""
    turn = Rotation.from_euler("xyz", [DISPLACED["tilt_x"], DISPLACED["tilt_y"], DISPLACED["rotation"]])  # fixed axes
    return turn.inv().apply(np.asarray(point) - [DISPLACED["shift_x"], DISPLACED["shift_y"], DISPLACED["shift_z"]])


def test_parts_are_picked_by_number_and_by_label():
    assert DESIGN.cgem["L2"] is DESIGN.cgem[1] is DESIGN.cgem[-2]
    assert DESIGN.cgem[1:] == (DESIGN.cgem["L2"], DESIGN.cgem["L3"])
    assert [DESIGN.beam_pipe[part.label] for part in DESIGN.beam_pipe] == list(DESIGN.beam_pipe)
    assert [DESIGN.walls[part.label] for part in DESIGN.walls] == list(DESIGN.walls)
    with pytest.raises(KeyError, match="L1, L2, L3"):
        DESIGN.cgem["L4"]
    thin = dataclasses.replace(DESIGN, barrels=DESIGN.cgem[:2])
    again = pickle.loads(pickle.dumps(thin))
    assert again == thin
    assert again.cgem["L2"] == DESIGN.cgem["L2"]
    with pytest.raises(KeyError):
        again.cgem["L3"]


def crossing(track, radius, low=-20.0, high=20.0):
    """Return where a track, a function of its path, crosses the displaced cylinder, in the part's axes."""
    path = brentq(lambda t: np.hypot(*in_axes(track(t))[:2]) - radius, low, high, xtol=1e-13)
    return in_axes(track(path))


def test_straight_tracks():
    rng = np.random.default_rng(1)
    phi = rng.uniform(-np.pi, np.pi, 20)
    radius = rng.uniform(50, 200, 20)
    points = np.column_stack([radius * np.cos(phi), radius * np.sin(phi), rng.uniform(-300, 300, 20)])
    direction = points * [1, 1, 0.7] + rng.normal(0, 10, points.shape)
    found = seen_by(Placed(**DISPLACED), points, direction)
    unit = direction / np.linalg.norm(direction, axis=1)[:, None]
    expected = [crossing(lambda t, p=p, u=u: p + t * u, r) for p, u, r in zip(points, unit, radius, strict=True)]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert np.abs(found - points).max() > 0.1
    np.testing.assert_allclose(seen_by(Placed(), points, direction), points, atol=1e-12)


def test_what_the_fit_expects():
    """Predicted X and V of a helix against its crossing of the displaced cylinder, found step by step."""
    detector = displaced("cgem.L2", **DISPLACED)
    layer = detector.cgem[1]
    parameters = np.array([1.0, 0.4, 1 / 0.2, 5.0, 0.6])
    hits = {
        "kind": np.array([0, 1], "u1"), "layer": np.array([1, 1], "i4"), "channel": np.zeros(2, "i4"),
        "size": np.ones(2, "i4"), "value": np.zeros(2), "sigma": np.full(2, 0.1),
    }  # fmt: skip

    def predicted(core, sheet):
        return _core._testing.reference(core, parameters, 0.10566, hits | {"channel": np.full(2, sheet, "i4")})[
            "predicted"
        ]

    w = -0.299792458e-3 * DESIGN.field.bz * parameters[2]
    start = np.array([np.cos(parameters[1]), np.sin(parameters[1])]) * parameters[0]

    def track(arc):
        psi = parameters[1] + np.pi / 2 + w * np.array([0, arc])
        along = np.array([np.sin(psi[1]) - np.sin(psi[0]), np.cos(psi[0]) - np.cos(psi[1])]) / w
        return np.array([*(start + along), parameters[3] + parameters[4] * arc])

    at = crossing(track, layer.r_mid, 60.0, 250.0)
    turn = (np.arctan2(at[1], at[0]) - np.array(layer.sheet_phi)) % (2 * np.pi)
    sheet = int(np.argmin(turn))
    x = layer.r_readout * turn[sheet]
    expected = np.array([x, local_v(layer, x, at[2])])
    # Matter before the layer makes the helix of the fit curl a little more than this one: the same for both.
    plain = predicted(tuned(DESIGN), sheet)
    there = crossing_in_place(track, layer.r_mid)
    x_0 = layer.r_readout * ((np.arctan2(there[1], there[0]) - layer.sheet_phi[sheet]) % (2 * np.pi))
    without = np.array([x_0, local_v(layer, x_0, there[2])])
    around = 2 * np.pi * layer.r_readout
    moved = predicted(tuned(detector), sheet) - plain
    moved[0] = (moved[0] + around / 2) % around - around / 2
    np.testing.assert_allclose(moved, expected - without, atol=2e-3)
    assert np.abs(moved).max() > 0.2


def crossing_in_place(track, radius):
    return track(brentq(lambda t: np.hypot(*track(t)[:2]) - radius, 60.0, 250.0, xtol=1e-13))


@pytest.mark.parametrize("layer", [0, 15, 30])
def test_wires(layer):
    """Ends of the wires, rotated and shifted by scipy, against the point of closest approach to a far line."""
    detector = displaced("drift_chamber", **DISPLACED)
    wires = DESIGN.drift_chamber.layers[layer]
    turn = Rotation.from_euler("xyz", [DISPLACED["tilt_x"], DISPLACED["tilt_y"], DISPLACED["rotation"]])
    shift = np.array([DISPLACED["shift_x"], DISPLACED["shift_y"], DISPLACED["shift_z"]])
    for wire in (0, 7, 31):
        east, west = (turn.apply(end) + shift for end in wires.end_points(wire))
        middle = 0.5 * (east + west)
        start = np.array([[*(0.3 * middle[:2]), 40.0, *(middle[:2] / np.hypot(*middle[:2])), 0.2, 1e-13]])
        _, doca, _, found = _core._testing.approach_wire(start, compiled(detector), layer, wire)
        along = np.array([start[0, 3], start[0, 4], 0.2])
        normal = np.cross(along, east - west)
        expected = abs((start[0, :3] - east) @ normal) / np.linalg.norm(normal)
        assert found[0]
        assert abs(doca[0]) == pytest.approx(expected, abs=1e-5)


ENDS = {
    "east_shift_x": 0.5, "east_shift_y": -0.3, "east_rotation": 1e-3, "west_shift_x": -0.4, "west_shift_y": 0.2,
    "west_rotation": -2e-3,
}  # fmt: skip
UNITS |= {name: "rad" if name.endswith("rotation") else "mm" for name in ENDS}


@pytest.mark.parametrize("layer", [0, 15])
@pytest.mark.parametrize("moved", [ENDS, ENDS | {"shift_x": 0.3, "tilt_y": 1e-3, "shift_z": 0.5}])
def test_wires_of_a_displaced_layer(layer, moved):
    """Ends turned and shifted by scipy in the layer, then with it, then with the chamber; other layers stay."""
    number = DESIGN.drift_chamber.layers[layer].number
    changes = {f"drift_chamber.layers.{number}.{name}": f"{value} {UNITS[name]}" for name, value in moved.items()}
    chamber = {f"drift_chamber.{name}": f"{value} {UNITS[name]}" for name, value in DISPLACED.items()}
    detector = DESIGN.with_overrides(changes | chamber)
    wires = DESIGN.drift_chamber.layers[layer]
    place = dict.fromkeys(DISPLACED, 0.0) | {name: moved[name] for name in DISPLACED.keys() & moved.keys()}

    def carried(point, by):
        turn = Rotation.from_euler("xyz", [by["tilt_x"], by["tilt_y"], by["rotation"]])
        return turn.apply(point) + np.array([by["shift_x"], by["shift_y"], by["shift_z"]])

    for wire in (0, 7, 31):
        ends = []
        for name, end in zip(("east", "west"), wires.end_points(wire), strict=True):
            own = Rotation.from_euler("z", moved[f"{name}_rotation"]).apply(end)
            own = own + np.array([moved[f"{name}_shift_x"], moved[f"{name}_shift_y"], 0.0])
            ends.append(carried(own, place))
        np.testing.assert_allclose(detector.drift_chamber.layers[layer].end_points(wire), ends, atol=1e-9)
        assert expected_doca(detector, layer, wire, [carried(end, DISPLACED) for end in ends])
    beside = 14 if layer else 1
    ends = [carried(end, DISPLACED) for end in DESIGN.drift_chamber.layers[beside].end_points(3)]
    assert expected_doca(detector, beside, 3, ends)
    assert load(tomllib.loads(detector.to_toml())) == detector


def expected_doca(detector, layer, wire, ends):
    """Return whether a line comes as close to a wire of the core as to the straight line between two points."""
    east, west = map(np.array, ends)
    middle = 0.5 * (east + west)
    start = np.array([[*(0.3 * middle[:2]), 40.0, *(middle[:2] / np.hypot(*middle[:2])), 0.2, 1e-13]])
    _, doca, _, found = _core._testing.approach_wire(start, compiled(detector), layer, wire)
    normal = np.cross([start[0, 3], start[0, 4], 0.2], east - west)
    expected = abs((start[0, :3] - east) @ normal) / np.linalg.norm(normal)
    return bool(found[0]) and abs(doca[0]) == pytest.approx(expected, abs=1e-5)


def residuals(detector, fit_detector, n=300):
    found = run(
        detector, Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n, seed=3, settings=Settings.from_dict(EXACT),
        fit_detector=fit_detector, readout="gaussian",
    )  # fmt: skip
    return found.tracks


@pytest.mark.parametrize("part", ["cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber"])
def test_a_fit_that_knows_the_displacement(part):
    """Nine of ten tracks as without displacement, but for the cells that a chamber's wires bring; else far off."""
    plain = residuals(DESIGN, None)
    check_known(plain, displaced(part, **DISPLACED), 1.0 if part == "drift_chamber" else 0.01)


def check_known(plain, moved, limit):
    known, unknown = residuals(moved, None), residuals(moved, DESIGN)
    off = []
    for name in ("dr", "phi0", "dz", "tanl", "p"):
        error = np.median(plain[f"err_{name}"])
        shifts = [(table[f"res_{name}"] - plain[f"res_{name}"]) / error for table in (known, unknown)]
        assert abs(np.mean(shifts[0])) < 0.05, name
        assert np.percentile(np.abs(shifts[0]), 90) < limit, name
        off.append(np.percentile(np.abs(shifts[1]), 90))
    assert max(off) > 1
    assert np.mean(unknown["chi2"]) > 1.1 * np.mean(known["chi2"])


def test_a_fit_that_knows_displaced_wire_layers():
    """Twelve layers, each end by its own way: their cells change hits of some tracks, as for the whole chamber."""
    numbers = [layer.number for layer in DESIGN.drift_chamber.layers[:12]]
    changes = {f"drift_chamber.layers.{n}.{key}": f"{x} {UNITS[key]}" for n in numbers for key, x in ENDS.items()}
    check_known(residuals(DESIGN, None), DESIGN.with_overrides(changes), 1.0)


@pytest.mark.parametrize("readout", ["gaussian", "binary", "tiger"])
def test_displaced_sheets(readout):
    """Clusters of displaced sheets are where the tracks are; a description in place is off by the displacement."""
    moved = DESIGN.with_overrides(
        {"cgem.L2.sheet_shift_z": ["0.5 mm", "-0.8 mm"], "cgem.L2.sheet_rotation": ["1 mrad", "-2 mrad"]}
    )
    assert load(tomllib.loads(moved.to_toml())) == moved
    made = [
        run(moved, Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 300, seed=3, fit_detector=other, readout=readout,
            settings=None if readout == "tiger" else Settings.from_dict(EXACT))
        for other in (moved, DESIGN)
    ]  # fmt: skip
    for part, shifts, turns in zip(made, ([0, 0], [0.5, -0.8]), ([0, 0], [1e-3, -2e-3]), strict=True):
        clusters = part.clusters
        rows = (clusters["layer"] == 1) & (clusters["view"] == 2) & (clusters["truth"] >= 0)
        truth = part.truths[clusters["truth"][rows]]
        dz, dphi = clusters["z"][rows] - truth["z"], helix.wrap_angle(clusters["phi"][rows] - truth["phi"])
        for sheet in (0, 1):
            mine = clusters["sheet"][rows] == sheet
            assert mine.sum() > 80
            for off, expected in ((dz[mine], -shifts[sheet]), (dphi[mine], -turns[sheet])):
                assert_within(np.median(off), expected, 1.2533 * off.std() / np.sqrt(mine.sum()))
    chi2 = [np.median(part.tracks["chi2"] / part.tracks["ndf"]) for part in made]
    assert chi2[1] > 1.1 * chi2[0]


def test_mistakes_of_displacements():
    changes = {
        "drift_chamber.layers.9.east_shift_x": "3 mm", "drift_chamber.layers.9.west_rotation": "0.1 rad",
        "cgem.L2.sheet_shift_z": ["1 mm", "5 mm"], "cgem.L1.sheet_rotation": "1 mm",
        "cgem.L3.sheet_rotation": ["1 mrad", "0 rad", "0 rad"],
    }  # fmt: skip
    with pytest.raises(DetectorError) as caught:
        DESIGN.with_overrides(changes)
    assert sorted(problem.path for problem in caught.value.problems) == [
        "cgem.L1.sheet_rotation", "cgem.L2.sheet_shift_z[1]", "cgem.L3.sheet_rotation",
        "drift_chamber.layers.9.east_shift_x", "drift_chamber.layers.9.west_rotation",
    ]  # fmt: skip


def test_dead_and_hot_wires():
    """Hits of some wires vanish, others fire in every event; no track takes either, and none is missed there."""
    plain = cg.load("besiii-cgem")
    changed = plain.with_overrides(
        {"drift_chamber.layers.12.dead": ["0-39"], "drift_chamber.layers.20.hot": ["5", "60-119"]}
    )
    assert load(tomllib.loads(changed.to_toml())) == changed
    gun, n = Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 200
    for finder in ("truth", "ckf"):
        usual, found = (run(one, gun, n, seed=5, finder=finder) for one in (plain, changed))
        layer, wire = found.wire_hits["layer"], found.wire_hits["wire"]
        assert not ((layer == 12) & (wire < 40)).any()
        for one in (5, 60, 119):
            assert len(np.unique(found.wire_hits["event"][(layer == 20) & (wire == one)])) == n
        hits = found.candidate_hits["hit"][found.candidate_hits["view"] == 2]
        hot = (layer == 20) & ((wire == 5) | (wire >= 60) & (wire < 120))
        assert hot.sum() == 61 * n
        assert not hot[hits].any()
        taken = usual.wire_hits[usual.candidate_hits["hit"][usual.candidate_hits["view"] == 2]]
        dead = (taken["layer"] == 12) & (taken["wire"] < 40)
        masked = dead | (taken["layer"] == 20) & ((taken["wire"] == 5) | (taken["wire"] >= 60) & (taken["wire"] < 120))
        assert masked.sum() > 30
        assert len(hits) == pytest.approx(len(taken) - masked.sum(), abs=5)
        assert np.count_nonzero(found.tracks["status"] == 0) == np.count_nonzero(usual.tracks["status"] == 0)
    strips = lists_of(changed)
    assert (len(strips.dead), len(strips.hot)) == (40, 61)


def lists_of(detector):
    return wire_lists(detector.drift_chamber)


def test_the_covariance_knows_dead_wires():
    """Without the wires of six layers as without these layers, but for their gas; without all hits of others: more."""
    few = {
        f"drift_chamber.layers.{n}.dead": [f"0-{DESIGN.drift_chamber.layers[n - 8].cells - 1}"] for n in range(36, 42)
    }
    dead = DESIGN.with_overrides(few)
    silent = DESIGN.with_overrides({f"drift_chamber.layers.{n}.efficiency": 0.0 for n in range(36, 42)})
    expected, found, full = (cg.analytic(one, "mu-", p=[0.3, 1.0], cos_theta=0.2) for one in (silent, dead, DESIGN))
    np.testing.assert_allclose(found.sigma("p"), expected.sigma("p"), rtol=1e-12)
    assert (found.sigma("p") > 1.04 * full.sigma("p")).all()


def test_mistakes_of_dead_and_hot_wires():
    changes = {
        "drift_chamber.layers.9.dead": ["0:3", "5"], "drift_chamber.layers.10.dead": ["7-3"],
        "drift_chamber.layers.11.hot": ["5000"], "drift_chamber.layers.12.hot": "5",
    }  # fmt: skip
    with pytest.raises(DetectorError) as caught:
        DESIGN.with_overrides(changes)
    assert sorted(problem.path for problem in caught.value.problems) == [
        "drift_chamber.layers.10.dead[0]", "drift_chamber.layers.11.hot[0]", "drift_chamber.layers.12.hot",
        "drift_chamber.layers.9.dead[0]",
    ]  # fmt: skip


def test_clusters_of_a_shifted_layer():
    """A straight track along x meets a layer shifted along y at an X that is smaller by the shift, scaled to R."""
    detector = displaced("cgem.L1", shift_y=0.1)
    gun = Gun("mu-", p=50.0, theta=np.pi / 2, phi=0.0)
    x = []
    for one in (DESIGN, detector):
        clusters = run(one, gun, 200, seed=1, settings=Settings.from_dict(EXACT), readout="gaussian").clusters
        x.append(clusters["x"][(clusters["layer"] == 0) & (clusters["view"] == 0)])
    layer = DESIGN.cgem[0]
    np.testing.assert_allclose(x[1] - x[0], -0.1 * layer.r_readout / layer.r_mid, atol=1e-4)


def test_delta_electrons_stay_in_the_gap():
    detector = displaced("cgem.*", shift_x=1.0, tilt_y=1e-3)
    found = run(detector, Gun("pi-", p=0.3, cos_theta=(-0.8, 0.8)), 400, seed=2)
    assert (found.steps["parent"] != 0).any()
    moved = run(DESIGN, Gun("pi-", p=0.3, cos_theta=(-0.8, 0.8)), 400, seed=2)
    np.testing.assert_array_equal(found.truths["energy"], moved.truths["energy"])
    sizes = [np.bincount(table.clusters["size"]) for table in (found, moved)]
    assert abs(sizes[0].argmax() - sizes[1].argmax()) <= 1
    assert len(found.digis) == pytest.approx(len(moved.digis), rel=0.02)


def test_keys():
    detector = displaced("cgem.L1", **DISPLACED)
    again = load({"name": "again"} | tomllib.loads(detector.to_toml()))
    assert all(getattr(again.cgem[0], name) == pytest.approx(value) for name, value in DISPLACED.items())
    assert "displaced by (300, -200, 400) um and (1, -0.7, 2) mrad" in again.cgem[0].text()
    assert not any(name in DESIGN.to_toml() for name in PLACEMENT)
    with pytest.raises(DetectorError) as error:
        displaced("cgem.L1", shift_x=3.0, tilt_y=0.1)
    assert {problem.path for problem in error.value.problems} == {"cgem.L1.shift_x", "cgem.L1.tilt_y"}


def test_helix_of_this_file():
    """The hand-made helix of these tests has the convention of the package."""
    parameters = np.array([1.0, 0.4, 1 / 0.2, 5.0, 0.6])
    assert np.sign(helix.momentum_vector(parameters)[0]) == np.sign(-np.sin(0.4))


def test_the_whole_detector_displaced():
    """All parts together displace the helix of the fit rigidly, which the sums of the parts' effects must give."""
    parts = ("cgem.L1", "cgem.L2", "cgem.L3", "drift_chamber")
    plain = residuals(DESIGN, DESIGN)
    for name, size in (("shift_x", 0.05), ("shift_z", 0.05), ("rotation", 2e-4)):
        whole = {f"{part}.{name}": f"{size} {UNITS[name]}" for part in parts}
        moved = residuals(DESIGN.with_overrides(whole), DESIGN)
        change = {key: np.median(moved[f"res_{key}"] - plain[f"res_{key}"]) for key in ("phi0", "dz", "p", "tanl")}
        expected = {"phi0": -size if name == "rotation" else 0.0, "dz": -size if name == "shift_z" else 0.0}
        for key in ("phi0", "dz", "p", "tanl"):
            assert change[key] == pytest.approx(expected.get(key, 0.0), abs=0.02 * np.median(plain[f"err_{key}"]))
        if name == "shift_x":
            found, phi0 = moved["res_dr"] - plain["res_dr"], plain["phi0"]
            assert np.median(np.abs(found + size * np.cos(phi0))) < 0.002


DESIGN_MAPS = cg.load("besiii-cgem-design")
READOUTS = ("binary", "analog-projection", "tiger", "apv25")
GUN = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
L1 = DESIGN_MAPS.cgem[0]
L2 = DESIGN_MAPS.cgem[1]


def run_maps(detector, readout, n=60, until="cluster"):
    return cg.run(detector, GUN, n, 5, readout=readout, until=until)


def rows(digis, where=slice(None)):
    """Return the digis as tuples of what was measured."""
    names = ("event", "gid", "charge", "time")
    return set(zip(*(digis[name][where].tolist() for name in names), strict=True))


@pytest.mark.parametrize("readout", READOUTS)
def test_dead_strips(readout):
    """Dead strips give no digis; all other strips are as before, bit by bit."""
    plain = run_maps(DESIGN_MAPS, readout).digis
    dead = DESIGN_MAPS.with_overrides({"cgem.L1.dead_x": ["0:100-499"], "cgem.L3.dead_v": ["1:0-700"]})
    gids = strip_lists(dead).dead
    assert len(gids) == 400 + 701
    assert (gids[0], gids[399]) == (100, 499)
    kept = ~np.isin(plain["gid"], gids)
    assert 0 < np.count_nonzero(~kept) < len(plain)
    assert rows(run_maps(dead, readout).digis) == rows(plain, kept)


@pytest.mark.parametrize("readout", READOUTS)
def test_gain_map(readout):
    """A sheet with half of the gain has less charge; other sheets and layers are as before, bit by bit."""
    result = run_maps(DESIGN_MAPS, readout)
    plain = result.digis
    half = run_maps(DESIGN_MAPS.with_overrides({"cgem.L3.gain_map": [1.0, 0.5]}), readout).digis
    mine = [(digis["layer"] == 2) & (digis["sheet"] == 1) for digis in (plain, half)]
    # An avalanche at the seam has charge on both sheets.
    truths = result.truths
    from_seam = np.abs(np.angle(np.exp(2j * (truths["phi"] - DESIGN_MAPS.cgem[2].phi_first)))) / 2
    at_seam = np.unique(truths["event"][(truths["layer"] == 2) & (from_seam < 0.03)])
    far = [~np.isin(digis["event"], at_seam) for digis in (plain, half)]
    assert rows(half, ~mine[1] & far[1]) == rows(plain, ~mine[0] & far[0])
    small = plain["charge"] < 20  # below saturation
    before = dict(
        zip(
            zip(plain["event"][mine[0] & small], plain["gid"][mine[0] & small], strict=True),
            plain["charge"][mine[0] & small],
            strict=True,
        )
    )
    after = dict(
        zip(zip(half["event"][mine[1]], half["gid"][mine[1]], strict=True), half["charge"][mine[1]], strict=True)
    )
    both = before.keys() & after.keys()
    assert len(both) > 50
    ratio = sum(after[key] for key in both) / sum(before[key] for key in both)
    assert 0.4 < ratio < 0.55


def test_gain_of_a_cell():
    """A grid acts where its cell is: rows along z, columns along X."""
    mapped = DESIGN_MAPS.with_overrides({"cgem.L1.gain_map": [[[1.0, 1.0, 3.0], [1.0, 1.0, 1.0]]]})
    plain, changed = (run_maps(one, "binary", 300, "digitize") for one in (DESIGN_MAPS, mapped))
    assert len(plain.digis) == len(changed.digis)
    ratio = changed.digis["charge"] / plain.digis["charge"]
    truth = plain.digis["truth"]
    x = L1.r_readout * np.mod(plain.truths["phi"][truth] - L1.phi_first, 2 * np.pi)
    cell = (x > L1.strips_x * L1.pitch_x * 2 / 3) & (plain.truths["z"][truth] < 0) & (plain.digis["layer"] == 0)
    assert 300 < np.count_nonzero(cell) < 600
    np.testing.assert_allclose(ratio, np.where(cell, 3.0, 1.0), rtol=1e-12)


def test_gain_in_clusters():
    """Clusters weight charges without the gain: two halves of a sheet do not bend positions at their border."""
    mapped = DESIGN_MAPS.with_overrides({"cgem.L1.gain_map": [[[1.0, 0.25]]], "cgem.L2.gain_map": [2.0, 1.0]})
    gains = strip_gains(mapped)
    per_sheet = L1.strips_x + L1.strips_v
    middle = L1.strips_x // 2
    assert (gains[middle - 1], gains[middle + 1], gains[L1.strips_x]) == (1.0, 0.25, 0.625)
    assert (gains[per_sheet], gains[-1]) == (2.0, 1.0)
    second = DESIGN_MAPS.cgem[1]
    v_strips = per_sheet + second.strips_x + np.arange(2) * (second.strips_x + second.strips_v)
    assert gains[v_strips].tolist() == [2.0, 1.0]
    assert grid_of(mapped.cgem[2]).shape == (2, 0, 0)
    strips = np.array([middle - 2, middle - 1, middle, middle + 1, middle + 2])
    readout = cg.TigerReadout(estimator="centroid")
    charges = 4 * gains[strips]
    found = cluster(mapped, digis_of(strips, charges), readout=readout)
    plain = cluster(DESIGN_MAPS, digis_of(strips, charges), readout=readout)
    even = cluster(DESIGN_MAPS, digis_of(strips, np.full(5, 4.0)), readout=readout)
    assert found["x"][0] == pytest.approx(even["x"][0], abs=1e-9)
    assert abs(plain["x"][0] - even["x"][0]) > 0.3


def digis_of(strips, charge, event=None):
    """Return digis of X strips of the first layer."""
    n = len(strips)
    return cg.Table(
        "digis",
        {
            "event": np.zeros(n, np.int64) if event is None else event,
            **{name: np.zeros(n, np.int32) for name in ("layer", "sheet")}, "view": np.zeros(n, np.int8),
            "strip": np.asarray(strips, np.int32), "gid": np.asarray(strips, np.int32),
            "position": np.full(n, np.nan), "charge": np.asarray(charge, np.float64), "time": np.full(n, 150.0),
            "truth": np.zeros(n, np.int64), "n_truths": np.ones(n, np.int32),
        },
        n_events=1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("bridge", "runs"),
    [(0, [(9, 9), (11, 11), (15, 15), (18, 18)]), (1, [(9, 11), (15, 15), (18, 18)]), (2, [(9, 11), (15, 18)])],
)
def test_bridges(bridge, runs):
    """A cluster bridges as many dead strips in a row as allowed, and no live strip; hot strips count as dead."""
    holes = DESIGN_MAPS.with_overrides({"cgem.L1.dead_x": ["0:10", "0:16"], "cgem.L1.hot_x": ["0:17"]})
    digis = digis_of([9, 11, 15, 17, 18], np.full(5, 10.0))
    found = cluster(holes, digis, cg.ClusterSettings(bridge=bridge))
    assert list(zip(found["first"], found["last"], strict=True)) == runs
    charge_time = cluster(holes, digis, cg.ClusterSettings(bridge=bridge), readout=cg.TigerReadout(missing=0))
    assert list(zip(charge_time["first"], charge_time["last"], strict=True)) == runs
    apart = cluster(DESIGN_MAPS, digis_of([9, 11], [10.0, 10.0]), cg.ClusterSettings(bridge=bridge))
    assert len(apart) == 2


def test_error_beside_dead_strips():
    """Each masked strip within or beside a cluster adds pitch^2/12 to the variance; other clusters are as before."""
    holes = DESIGN_MAPS.with_overrides({"cgem.L1.dead_x": ["0:10", "0:20"]})
    digis = digis_of([9, 11, 21, 22, 40, 41], np.full(6, 10.0))
    found, plain = (cluster(one, digis) for one in (holes, DESIGN_MAPS))
    errors = cluster_errors(DESIGN_MAPS, cg.ClusterSettings())[0][0]
    more = L1.pitch_x**2 / 12
    expected = [np.hypot(errors[2], more**0.5), np.hypot(errors[1], more**0.5), errors[1]]
    np.testing.assert_allclose(found["err_x"], expected, rtol=1e-12)
    assert found["method"].tolist() == [1, 1, 0]
    assert {name: found[name][-1] for name in ("x", "err_x", "phi", "err_phi")} == {
        name: plain[name][-1] for name in ("x", "err_x", "phi", "err_phi")
    }


@pytest.mark.parametrize("readout", ["binary", "tiger"])
def test_pulls_beside_dead_strips(readout):
    """With each ninth strip dead, residuals of clusters that lack a strip are within their errors."""
    dead = {
        f"cgem.{layer.label}.dead_{view}": [f"{sheet}:{i}" for sheet in range(layer.sheets) for i in range(5, n, 9)]
        for layer in DESIGN_MAPS.cgem
        for view, n in (("x", layer.strips_x), ("v", layer.strips_v))
    }
    holes = DESIGN_MAPS.with_overrides(dead)
    result = run_maps(holes, readout, 800)
    clusters = result.clusters
    own = assign.own_clusters(holes, clusters, result.truths)
    residual = assign.residuals(holes, clusters, result.truths, own)
    error = np.where(clusters["view"] == 0, clusters["err_x"], clusters["err_v"])[own]
    first, last = clusters["first"][own], clusters["last"][own]
    touched = (first + 3) % 9 >= 9 - (last - first + 2)
    assert np.count_nonzero(touched) > 1000
    pull = (residual / error)[touched & (np.abs(residual) < 2)]
    # 3 % for the delta electrons within 2 mm; errors are those of a dead strip with any charge, so no lower limit of 1:
    # a line through the other strips hardly moves
    assert 0.8 < np.sqrt(np.mean(pull**2)) < 1.15


def test_hot_strips():
    """A hot strip fires in every event, enters no cluster, and leaves the others as before."""
    hot = DESIGN_MAPS.with_overrides({"cgem.L1.hot_x": ["0:3"], "cgem.L2.hot_v": ["0:7-8"]})
    plain, noisy = run_maps(DESIGN_MAPS, "tiger"), run_maps(hot, "tiger")
    mine = np.isin(noisy.digis["gid"], strip_lists(hot).hot)
    assert np.count_nonzero(mine) == 3 * 60
    at = noisy.digis["gid"][mine]
    first = L1.strips_x + L1.strips_v
    assert sorted(set(at.tolist())) == [3, first + L2.strips_x + 7, first + L2.strips_x + 8]
    addresses = {name: noisy.digis[name][mine][:3].tolist() for name in ("layer", "sheet", "view", "strip")}
    assert addresses == {"layer": [0, 1, 1], "sheet": [0, 0, 0], "view": [0, 1, 1], "strip": [3, 7, 8]}
    assert rows(noisy.digis, ~mine) == rows(plain.digis, ~np.isin(plain.digis["gid"], strip_lists(hot).hot))
    assert len(noisy.clusters) <= len(plain.clusters)
    order = np.lexsort((noisy.digis["gid"], noisy.digis["event"]))
    assert (np.diff(order) == 1).all()


def test_dead_wins():
    """A strip that is listed as dead and as hot is dead."""
    both = DESIGN_MAPS.with_overrides({"cgem.L1.hot_x": ["0:3-4"], "cgem.L1.dead_x": ["0:4"]})
    assert [part.tolist() for part in strip_lists(both)] == [[4], [3]]
    assert 4 not in run_maps(both, "binary").digis["gid"]


def test_background_spares_dead_strips():
    """Noise does not fire dead strips."""
    dead = DESIGN_MAPS.with_overrides({"cgem.L1.dead_v": [f"0:0-{L1.strips_v - 1}"]})
    settings = cg.Settings(background=cg.BackgroundSettings(level="bes2026", factor=5))
    found = cg.run(dead, GUN, 20, 1, settings=settings, until="digitize").digis
    noise = found["truth"] < 0
    assert np.count_nonzero(noise) > 10
    assert not ((found["layer"] == 0) & (found["view"] == 1)).any()


def test_file_and_hash(tmp_path):
    """Maps are written and read back; without maps file and hash are as they were before maps existed."""
    changes = {"cgem.L1.dead_x": ["0:17", "0:20-22"], "cgem.L3.gain_map": [0.5, [[1.0, 2.0], [1.5, 1.0]]]}
    mapped = DESIGN_MAPS.with_overrides(changes)
    file = tmp_path / "mapped.toml"
    file.write_text(mapped.to_toml(), encoding="utf-8")
    assert cg.load(file) == mapped
    assert 'dead_x = ["0:17", "0:20-22"]' in file.read_text(encoding="utf-8")
    assert mapped.content_hash != DESIGN_MAPS.content_hash
    assert not any(name in DESIGN_MAPS.to_toml() for name in ("dead_x", "dead_v", "hot_x", "hot_v", "gain_map"))
    grid = grid_of(mapped.cgem[2])
    assert grid.tolist() == [[[0.5, 0.5], [0.5, 0.5]], [[1.0, 2.0], [1.5, 1.0]]]


def test_all_problems_of_a_file():
    """A wrong file lists all its problems."""
    wrong = {
        "cgem.L1.dead_x": ["0:17", "5:20", "x", 3], "cgem.L1.gain_map": [0.5, [[1], [2, 3]], "z", 1000],
        "cgem.L2.hot_v": "0:1", "cgem.L3.dead_v": ["0:99999", "1:7-5"],
    }  # fmt: skip
    with pytest.raises(cg.DetectorError) as caught:
        DESIGN_MAPS.with_overrides(wrong)
    paths = [problem.path for problem in caught.value.problems]
    assert sorted(paths) == sorted(
        [
            "cgem.L1.dead_x[1]", "cgem.L1.dead_x[2]", "cgem.L1.dead_x[3]", "cgem.L1.gain_map", "cgem.L1.gain_map[1]",
            "cgem.L1.gain_map[2]", "cgem.L1.gain_map[3]", "cgem.L2.hot_v", "cgem.L3.dead_v[0]", "cgem.L3.dead_v[1]",
        ]
    )  # fmt: skip


def test_core_arguments():
    """The core refuses maps that do not fit the detector."""
    digis = digis_of([9], [10.0])
    errors = np.ones((3, 4))
    with pytest.raises(ValueError, match="masked: strip 100000"):
        _core.reconstruction.find_clusters(
            compiled(DESIGN_MAPS), dict(digis.columns), err_x=errors, err_v=errors, by_charge=False, masked=[100_000]
        )
    truths = run_maps(DESIGN_MAPS, "binary", 2, "simulate").truths
    steps = cg.Table.empty("steps", n_events=2)
    with pytest.raises(ValueError, match="rows times columns"):
        _core.simulation.read_out_strips(
            compiled(DESIGN_MAPS),
            dict(truths.columns),
            dict(steps.columns),
            gain=1.0,
            w_values=np.ones(3),
            threshold=0.0,
            gains={"shape": np.full(6, 2, np.int32), "values": np.ones(3)},
        )


LAYER = {"radius": "50 mm", "sigma": "10 um", "material": "Si"}


def with_layer(**keys):
    return load({"base": "besiii-cgem-design", "name": "layered", "layer": {"VTX": {**LAYER, **keys}}})


def test_a_measurement_layer_needs_three_keys():
    layer = with_layer().layer["VTX"]
    assert (layer.views, layer.errors) == (("X", "V"), (0.01, 0.01))
    assert (layer.r_in, layer.r_out, layer.half_length) == (49.85, 50.15, 125.0)
    assert layer.measures_z
    assert "0.32 % X0 of Si, r phi to 10 um, z to 10 um" in repr(layer)


def test_measurement_layers_are_ordered_among_the_others():
    detector = with_layer(radius="100 mm")
    assert [layer.label for layer in detector.layers] == ["L1", "VTX", "L2", "L3"]
    assert [layer.label for layer in detector.cgem] == ["L1", "L2", "L3"]
    shells = [slab.shells for slab in slabs(detector) if slab.gap == 1]
    assert [[shell.label for shell in one] for one in shells] == [["Si"]]


def test_thickness_in_radiation_lengths_and_support():
    support = [{"material": "CarbonFiber", "thickness": "0.4 mm"}]
    layer = with_layer(x0=0.005, support=support).layer["VTX"]
    assert sum(shell.x0 for shell in layer.shells() if shell.group == "sensor") == pytest.approx(0.005)
    assert layer.r_out == pytest.approx(layer.r_gap_out + 0.4)
    assert [slab.gap for slab in slabs(with_layer(support=support)) if slab.shells[0].group == "support"] == [-1]


@pytest.mark.parametrize(
    ("keys", "views", "errors"),
    [
        ({"pitch": "0.1 mm"}, ("X", "V"), (0.1 / math.sqrt(12), 0.1 / math.sqrt(12))),
        ({"sigma_x": "5 um"}, ("X",), (0.005, 0.0)),
        ({"sigma_v": "5 um"}, ("V",), (0.0, 0.005)),
        ({"sigma_x": "5 um", "pitch_v": "1 mm"}, ("X", "V"), (0.005, 1 / math.sqrt(12))),
        ({}, (), (0.0, 0.0)),
    ],
)
def test_what_is_given_is_measured(keys, views, errors):
    only = {key: value for key, value in LAYER.items() if key != "sigma"}
    detector = load({"base": "besiii-cgem-design", "name": "layered", "layer": {"VTX": {**only, **keys}}})
    layer = detector.layer["VTX"]
    assert layer.views == views
    assert layer.errors == pytest.approx(errors)
    assert (layer in detector.layers) == bool(views)
    assert any(shell.label == "Si" for slab in slabs(detector) for shell in slab.shells)
    assert load(tomllib.loads(detector.to_toml())) == detector


@pytest.mark.parametrize(
    ("overrides", "errors"),
    [
        ({"sigma": "20 um"}, (0.02, 0.02)),
        ({"sigma_v": "20 um"}, (0.01, 0.02)),
        ({"pitch_x": "0.1 mm"}, (0.1 / math.sqrt(12), 0.01)),
        ({"pitch": "0.1 mm"}, (0.1 / math.sqrt(12), 0.1 / math.sqrt(12))),
    ],
)
def test_errors_of_a_variant_replace_those_of_its_base(overrides, errors):
    for label in ("VTX", "*"):
        variant = with_layer().with_overrides({f"layer.{label}.{key}": value for key, value in overrides.items()})
        assert variant.layer["VTX"].errors == pytest.approx(errors)
        assert load(tomllib.loads(variant.to_toml())) == variant


def test_a_file_changes_the_layer_of_its_base(tmp_path):
    base = tmp_path / "base.toml"
    base.write_text(
        'base = "besiii-cgem-design"\n[layer.VTX]\nradius = "50 mm"\nsigma = "10 um"\nmaterial = "Si"\nx0 = 0.01\n'
    )
    for text, thickness, errors in (
        ('sigma_x = "5 um"', 0.01 * load(base).layer["VTX"].material.x0, (0.005, 0.01)),
        ('thickness = "50 um"', 0.05, (0.01, 0.01)),
        ('pitch = "0.2 mm"', 0.01 * load(base).layer["VTX"].material.x0, (0.2 / math.sqrt(12),) * 2),
    ):
        own = tmp_path / "own.toml"
        own.write_text(f'base = "base.toml"\n[layer.VTX]\n{text}\n[layer.SECOND]\nlike = "VTX"\nradius = "60 mm"\n')
        detector = load(own)
        assert detector.layer["VTX"].thickness == pytest.approx(thickness)
        assert detector.layer["VTX"].errors == pytest.approx(errors)
        assert detector.layer["SECOND"].radius == 60
        assert detector.layer["SECOND"].material.name == "Si"


def test_mistakes_of_a_measurement_layer_are_listed():
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem-design", "layer": {
            "A": {**LAYER, "sigma_x": "3 um"},
            "B": {"radius": "60 mm", "sigma": "5 um", "material": "Silicon", "x0": 0.1, "thickness": "1 mm"},
            "C": {"radius": "2 mm", "sigma": "5 um", "material": "Si", "efficiency": 1.2},
            "D": {"sigma": "5 um", "material": "Si"},
            "E": {**LAYER, "radius": "150 mm", "stereo": "0.5 mrad"},
            "F": {**LAYER, "radius": "145 mm", "pitch_x": "99 cm"},
        }})  # fmt: skip
    found = {problem.path: problem for problem in caught.value.problems}
    for path in ("A.sigma", "B.material", "B.x0", "C.radius", "C.efficiency", "D", "F.pitch_x"):
        assert f"layer.{path}" in found, path
    assert "one of both" in str(found["layer.A.sigma"])
    assert "also radius" in str(found["layer.D"])
    with pytest.raises(DetectorError, match=r"layer\.VTX\.stereo: got 0\.5 mrad, expected at least 1 mrad"):
        with_layer(stereo="0.5 mrad")
    with pytest.raises(DetectorError, match=r"layer\.VTX\.sigma_tan: got 0\.05 mm and no sigma_v, expected a sigma"):
        load(
            {
                "base": "besiii-cgem-design",
                "layer": {
                    "VTX": {
                        "radius": "50 mm",
                        "sigma_x": "10 um",
                        "pitch_v": "1 mm",
                        "material": "Si",
                        "sigma_tan": "50 um",
                    }
                },
            }
        )
    with pytest.raises(DetectorError, match="no overlap with"):
        with_layer(radius="79 mm")


def test_keys_that_stand_for_several_values_are_varied():
    base = with_layer().with_overrides({"layer.VTX.sigma": "x2", "layer.VTX.x0": "x0.5"})
    assert base.layer["VTX"].errors == (0.02, 0.02)
    assert base.layer["VTX"].thickness == pytest.approx(0.15)
    assert with_layer().bounds("layer.VTX.sigma")[0] == 0
    key = "layer.VTX.sigma"
    slope = float(cg.sensitivity(with_layer(), "mu-", p=5.0, keys=[key]).of(key, "dr"))
    each = [f"{key}_{view}" for view in "xv"]
    apart = cg.sensitivity(with_layer(), "mu-", p=5.0, keys=each)
    assert slope == pytest.approx(sum(float(apart.of(one, "dr")) for one in each), rel=1e-3)
    assert slope > 0.1


@pytest.mark.parametrize("overrides", [
    {"cgem.L1.rotation": "30 mrad", "cgem.L3.rotation": "-30 mrad"}, {"cgem.*.shift_z": "9 mm"},
])  # fmt: skip
def test_layers_far_along_themselves(overrides):
    """At the limits of rotation and shift along the beam, hits are found and errors hold as in place."""
    moved = cg.run(cg.load("besiii-cgem").with_overrides(overrides), GUN, 400, 5, finder="ckf").tracks
    plain = cg.run("besiii-cgem", GUN, 400, 5, finder="ckf").tracks
    assert len(moved) == len(plain) == 400
    assert abs(moved["n_clusters"].mean() - plain["n_clusters"].mean()) < 0.05
    for name in ("dr", "dz"):
        assert abs(np.median(moved[f"res_{name}"])) < 5 * 1.25 * np.median(moved[f"err_{name}"]) / np.sqrt(400)
        core = [np.subtract(*np.percentile(of[f"pull_{name}"], (84, 16))) / 2 for of in (moved, plain)]
        assert abs(core[0] - core[1]) < 0.15
    with pytest.raises(cg.DetectorError, match=r"cgem.L1.rotation: got"):
        cg.load("besiii-cgem").with_overrides({"cgem.L1.rotation": "60 mrad"})
