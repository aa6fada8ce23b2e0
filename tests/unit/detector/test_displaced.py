"""Displaced layers against lines and rotations by scipy."""

import tomllib

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from cgemit import Gun, Settings, _core, helix, load, run
from cgemit.detector import DetectorError, compiled
from cgemit.detector.layers.layer import PLACEMENT, Placed, local_v, seen_by
from cgemit.fit_matter import tuned
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


def test_single_wires():
    """Ends moved outward and along phi before their end plate turns; other wires of the layer stay."""
    number = DESIGN.drift_chamber.layers[15].number
    path = f"drift_chamber.layers.{number}"
    changes = {"east_shift_r": 0.4, "east_shift_phi": -0.3, "west_shift_r": 0.2, "west_shift_phi": 0.5}
    values = {f"{path}.wires.7.{key}": value for key, value in changes.items()}
    others = {f"{path}.east_rotation": 1e-3, f"{path}.west_shift_x": 0.3, f"{path}.shift_y": 0.2}
    chamber = {f"drift_chamber.{name}": value for name, value in DISPLACED.items()}
    moved = DESIGN.with_alignment(others | chamber)
    detector = moved.with_alignment(values)
    layer = detector.drift_chamber.layers[15]
    place = Placed(shift_y=0.2)
    turn = Rotation.from_euler("xyz", [DISPLACED["tilt_x"], DISPLACED["tilt_y"], DISPLACED["rotation"]])
    ends = []
    for end, rotation, shift, name in (
        (DESIGN.drift_chamber.layers[15].end_points(7)[0], 1e-3, 0.0, "east"),
        (DESIGN.drift_chamber.layers[15].end_points(7)[1], 0.0, 0.3, "west"),
    ):
        out = np.array([*end[:2], 0]) / np.hypot(*end[:2])
        own = end + changes[f"{name}_shift_r"] * out + changes[f"{name}_shift_phi"] * np.array([-out[1], out[0], 0])
        ends.append(Rotation.from_euler("z", rotation).apply(own) + np.array([shift, place.shift_y, 0.0]))
    np.testing.assert_allclose(layer.end_points(7), ends, atol=1e-9)
    chamber_shift = [DISPLACED["shift_x"], DISPLACED["shift_y"], DISPLACED["shift_z"]]
    assert expected_doca(detector, 15, 7, [turn.apply(end) + chamber_shift for end in ends])
    before = [turn.apply(end) + chamber_shift for end in moved.drift_chamber.layers[15].end_points(8)]
    assert expected_doca(detector, 15, 8, before)
    assert not expected_doca(detector, 15, 7, before)
    assert load(tomllib.loads(detector.to_toml())) == detector
    table = detector.displacements()
    assert DESIGN.with_alignment(table) == detector
    assert {name: value for name, value in table.values().items() if ".wires." in name} == pytest.approx(values)
    with pytest.raises(DetectorError, match=f"3 values, expected {layer.cells}, one for each wire"):
        DESIGN.with_overrides({f"{path}.wires_east_shift_r": ["1 mm", "0 mm", "0 mm"]})
    with pytest.raises(DetectorError, match=r"wires_west_shift_phi.*from -2 to 2"):
        DESIGN.with_alignment({f"{path}.wires.0.west_shift_phi": 2.5})
    with pytest.raises(DetectorError, match="got dict, expected a table of constants, its path, or numbers"):
        DESIGN.with_alignment({f"{path}.wires.0.east_shift_r": True})
    with pytest.raises(DetectorError, match=rf"wires\.{layer.cells}\."):
        DESIGN.with_alignment({f"{path}.wires.{layer.cells}.east_shift_r": 0.1})


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


@pytest.mark.parametrize("overrides", [
    {"cgem.L1.rotation": "30 mrad", "cgem.L3.rotation": "-30 mrad"}, {"cgem.*.shift_z": "9 mm"},
])  # fmt: skip
def test_layers_far_along_themselves(overrides):
    """At the limits of rotation and shift along the beam, hits are found and errors hold as in place."""
    gun = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
    moved = run(load("besiii-cgem").with_overrides(overrides), gun, 400, 5, finder="ckf").tracks
    plain = run("besiii-cgem", gun, 400, 5, finder="ckf").tracks
    assert len(moved) == len(plain) == 400
    assert abs(moved["n_clusters"].mean() - plain["n_clusters"].mean()) < 0.05
    for name in ("dr", "dz"):
        assert abs(np.median(moved[f"res_{name}"])) < 5 * 1.25 * np.median(moved[f"err_{name}"]) / np.sqrt(400)
        core = [np.subtract(*np.percentile(of[f"pull_{name}"], (84, 16))) / 2 for of in (moved, plain)]
        assert abs(core[0] - core[1]) < 0.15
    with pytest.raises(DetectorError, match=r"cgem.L1.rotation: got"):
        load("besiii-cgem").with_overrides({"cgem.L1.rotation": "60 mrad"})
