"""Predictions and derivatives of the reference track agree with integration and with differences."""

import math

import numpy as np
import pytest

from cgemit import _core
from cgemit.detector import compiled, load, slabs
from oracles import LIGHT, helix_point, integrate
from tracks import MUON, hits_on, on_helix, transport, without_matter

DETECTORS = {(name, bz): load(name).with_overrides({"field.bz": f"{bz} T"})
             for name in ("besiii-cgem-design", "besiii-idc") for bz in (-1, 1)}  # fmt: skip
BARE = {key: without_matter(detector) for key, detector in DETECTORS.items()}

# dr mm, phi0, pT GeV/c, dz mm, tanl
SHAPES = {
    "central 1 GeV/c": (0.3, 0.4, 1.0, 5.0, 0.02),
    "inclined 5 GeV/c": (-0.5, -2.9, 5.0, -20.0, 1.1),
    "displaced 0.5 GeV/c": (20.0, 1.7, 0.5, 30.0, -0.7),
    "displaced the other way": (-20.0, 3.0, 0.3, 10.0, 0.4),
    "slow": (0.2, -1.2, 0.16, -8.0, 0.5),
    "curling": (0.5, 2.4, 0.1, 0.0, 0.3),
}
CASES = [(name, bz, charge, shape) for name, bz in DETECTORS for charge in (-1, 1) for shape in SHAPES]
every_case = pytest.mark.parametrize(("name", "bz", "charge", "shape"), CASES)
STEP = np.array([0.5, 5e-4, 2e-3, 0.5, 1e-3])  # dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl


def helix_of(shape, charge):
    """Return (dr, phi0, kappa, dz, tanl) of a case."""
    dr, phi0, pt, dz, tanl = SHAPES[shape]
    return np.array([dr, phi0, charge / pt, dz, tanl])


def wire_layer(detector, number):
    """Return the wire layer of a number."""
    return next(layer for layer in detector.drift_chamber.layers if layer.number == number)


def reference(core, parameters, hits):
    """Follow a helix through hits."""
    return _core._testing.reference(core, parameters, MUON, hits)


def linear_error(core, parameters, hits, step):
    """Return how far predictions after a step are from the linear extrapolation, (hits,) mm."""
    start, end = reference(core, parameters, hits), reference(core, parameters + step, hits)
    assert len(end["predicted"]) == len(start["predicted"]) == len(hits["kind"])
    return end["predicted"] - start["predicted"] - start["rows"] @ step


def central_difference(core, parameters, hits, i, size):
    """Return the derivative of the predictions by one parameter, (hits,)."""
    step = np.zeros(5)
    step[i] = size
    ahead, behind = reference(core, parameters + step, hits), reference(core, parameters - step, hits)
    return (ahead["predicted"] - behind["predicted"]) / (2 * size)


@every_case
def test_predictions_are_on_the_path(name, bz, charge, shape):
    """Without matter, predicted X, V and wire distances are those of the integrated path."""
    detector, core, parameters = DETECTORS[name, bz], BARE[name, bz], helix_of(shape, charge)
    hits = hits_on(detector, parameters)
    predicted = reference(core, parameters, hits)["predicted"]
    assert len(predicted) == len(hits["kind"]) > 5
    start = on_helix(parameters)
    position = [start[c][0] for c in "xyz"]
    momentum = [start[c][0] for c in ("px", "py", "pz")]
    pt, tanl = abs(1 / parameters[2]), parameters[4]
    circle = helix_point(position, momentum, charge, bz)
    for i in range(len(predicted)):
        kind, number, channel = hits["kind"][i], hits["layer"][i], hits["channel"][i]
        layer = detector.cgem[number] if kind < 2 else wire_layer(detector, number)
        _, arcs, reached = _core._testing.step_to_cylinder(circle[None], layer.r_mid)
        arc = arcs[0] if reached[0] else _core._testing.advance(circle[None], np.zeros(1))[1][0]
        path = integrate(position, momentum, charge, bz, arc * math.hypot(1, tanl))
        x, y, z, px, py, pz = path.y[:, -1]
        if kind < 2:
            along = layer.r_readout * ((math.atan2(y, x) - layer.sheet_phi[channel]) % (2 * math.pi))
            v = along * math.cos(layer.stereo) + (layer.z_ref - z) * math.sin(layer.stereo)
            assert predicted[i] == pytest.approx(along if kind == 0 else v, abs=1e-6)
            continue
        # Newton's method for the right angle between wire, track and connection, on the integrated path.
        east, west = map(np.array, layer.end_points(channel))
        wire = (east - west) / np.linalg.norm(east - west)
        for _ in range(8):
            flight = np.array([px, py, pz]) / math.hypot(pt, pz)
            offset = np.array([x, y, z]) - west
            across = offset - (offset @ wire) * wire
            normal = np.cross(flight, wire)
            ahead = -(across @ flight) / (normal @ normal)
            path = integrate([x, y, z], [px, py, pz], charge, bz, ahead) if abs(ahead) > 1e-9 else path
            x, y, z, px, py, pz = path.y[:, -1]
        assert predicted[i] == pytest.approx(offset @ normal / np.linalg.norm(normal), abs=2e-6)


@every_case
def test_taylor_without_matter(name, bz, charge, shape):
    """Without matter, the error of the linear prediction falls by four with every halving of the step."""
    core, parameters = BARE[name, bz], helix_of(shape, charge)
    hits = hits_on(DETECTORS[name, bz], parameters)
    rng = np.random.default_rng(1)
    for _ in range(3):
        step = STEP * rng.choice([-1, 1], 5) * 0.5
        errors = [np.linalg.norm(linear_error(core, parameters, hits, step / 2**k)) for k in range(5)]
        np.testing.assert_allclose(np.array(errors[1:4]) / errors[2:], 4, rtol=0.12)


@every_case
def test_differences_without_matter(name, bz, charge, shape):
    """Without matter, every column is the central difference of the predictions."""
    core, parameters = BARE[name, bz], helix_of(shape, charge)
    hits = hits_on(DETECTORS[name, bz], parameters)
    rows = reference(core, parameters, hits)["rows"]
    for i in range(5):
        # Richardson: the error of second order in the step is removed.
        once, half = (central_difference(core, parameters, hits, i, STEP[i] * f) for f in (0.02, 0.01))
        scale = np.max(np.abs(rows[:, i]))
        np.testing.assert_allclose(rows[:, i], (4 * half - once) / 3, rtol=0, atol=2e-8 * scale)


@every_case
def test_differences_with_matter(name, bz, charge, shape):
    """With energy loss the phi0 and dz columns stay exact, and the others hold to what the fit can not notice.

    What is left is that the loss depends on how obliquely the matter is crossed. From 0.15 GeV/c up, near the beam
    line: 6e-3 of the largest entry for dr and tanl, 3e-4 for kappa. Far from it or slower: 4e-2 and 5e-3. A step of
    a standard deviation of the fit then moves a prediction by less than a tenth of its error.
    """
    detector, core, parameters = DETECTORS[name, bz], compiled(DETECTORS[name, bz]), helix_of(shape, charge)
    hits = hits_on(detector, parameters)
    rows = reference(core, parameters, hits)["rows"]
    gentle = abs(parameters[0]) <= 1 and abs(parameters[2]) < 1 / 0.15
    tolerance = [6e-3, 1e-7, 3e-4, 1e-7, 6e-3] if gentle else [4e-2, 1e-7, 5e-3, 1e-7, 4e-2]
    for i in range(5):
        once, half = (central_difference(core, parameters, hits, i, STEP[i] * f) for f in (0.05, 0.025))
        limit = tolerance[i] * np.max(np.abs(rows[:, i]))
        np.testing.assert_allclose(rows[:, i], (4 * half - once) / 3, rtol=0, atol=limit, err_msg=f"column {i}")


def kinked(detector, seed=1, size=0.01):
    """Return two angles for every slab, rad."""
    return np.random.default_rng(seed).normal(scale=size, size=(len(slabs(detector)), 2))


@pytest.mark.parametrize("bz", [-1, 1])
@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "inclined 5 GeV/c", "slow"])
def test_differences_with_kinks(shape, charge, bz):
    """Rows about a scattered reference are as good as those about a smooth one.

    With 10 mrad a slab, what is left is that displaced tracks are scattered on the same cylinder, not after the same
    path: of the size of the angles times the tangent of the incidence, for dr and kappa of slow tracks.
    """
    detector, parameters = DETECTORS["besiii-cgem-design", bz], helix_of(shape, charge)
    core, kinks, hits = compiled(detector), kinked(detector), hits_on(detector, helix_of(shape, charge))
    rows = _core._testing.reference(core, parameters, MUON, hits, kinks)["rows"]
    limits = [3e-2, 1e-7, 7e-3, 1e-7, 1.5e-3] if shape == "slow" else [3e-3, 1e-7, 1e-3, 1e-7, 1e-4]
    for i, part in enumerate(limits):
        step = np.where(np.arange(5) == i, 0.05 * STEP, 0.0)
        ends = [
            _core._testing.reference(core, parameters + sign * step, MUON, hits, kinks)["predicted"] for sign in (1, -1)
        ]
        assert len(ends[0]) == len(ends[1]) == len(rows) > 30
        limit = part * np.max(np.abs(rows[:, i]))
        np.testing.assert_allclose(rows[:, i], (ends[0] - ends[1]) / (2 * step[i]), rtol=0, atol=limit, err_msg=f"{i}")


@pytest.mark.parametrize("angle", [0, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "inclined 5 GeV/c"])
def test_a_kink_is_its_noise_vector(shape, angle):
    """A small kink moves the hits beyond by row times noise vector, times how many standard deviations it is."""
    detector, parameters = DETECTORS["besiii-cgem-design", -1], helix_of(shape, 1)
    core, hits = compiled(detector), hits_on(detector, parameters)
    start, place = _core._testing.reference(core, parameters, MUON, hits), 7
    kinks = np.zeros((len(slabs(detector)), 2))
    kinks[place, angle] = 1e-5
    found = _core._testing.reference(core, parameters, MUON, hits, kinks)
    pulled = int(np.argmax(np.abs(found["noise_units"])))
    assert np.sum(np.abs(found["noise_units"])) < (1 + 1e-4) * abs(found["noise_units"][pulled])
    moved = found["predicted"] - start["predicted"]
    expected = start["rows"] @ start["noise"][pulled] * found["noise_units"][pulled]
    beyond = np.abs(moved) > 1e-9
    assert 5 < np.count_nonzero(beyond) < len(moved)
    np.testing.assert_allclose(moved[beyond], expected[beyond], rtol=0, atol=3e-3 * np.abs(expected).max())


def test_gate_sees_a_wrong_row():
    """The Taylor test fails if a column is wrong by one in a thousand."""
    key = ("besiii-cgem-design", -1)
    core, parameters = BARE[key], helix_of("central 1 GeV/c", -1)
    hits = hits_on(DETECTORS[key], parameters)
    step = STEP * np.array([1, 1, 1, 1, 1]) * 0.5
    wrong = reference(core, parameters, hits)["rows"][:, 2] * 1e-3
    errors = [
        np.linalg.norm(linear_error(core, parameters, hits, step / 2**k) - wrong * step[2] / 2**k) for k in (3, 4)
    ]
    assert errors[0] / errors[1] < 3.5


@pytest.mark.parametrize("bz", [-1, 1])
@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "displaced 0.5 GeV/c", "inclined 5 GeV/c"])
def test_extent_is_the_path_across_the_gap(shape, charge, bz):
    """The extent on X and V is the distance between entry and exit of the drift gap in that coordinate."""
    detector, core = DETECTORS["besiii-cgem-design", bz], BARE["besiii-cgem-design", bz]
    parameters = helix_of(shape, charge)
    hits = hits_on(detector, parameters)
    extent = reference(core, parameters, hits)["extent"]
    start = on_helix(parameters)
    point = helix_point([start[c][0] for c in "xyz"], [start[c][0] for c in ("px", "py", "pz")], charge, bz)[None]
    for i in np.flatnonzero(hits["kind"] < 2):
        layer = detector.cgem[hits["layer"][i]]
        ends = [_core._testing.step_to_cylinder(point, r)[0][0] for r in (layer.r_gap_in, layer.r_gap_out)]
        turned = math.atan2(ends[1][1], ends[1][0]) - math.atan2(ends[0][1], ends[0][0])
        along = layer.r_readout * math.remainder(turned, 2 * math.pi)
        v = along * math.cos(layer.stereo) - (ends[1][2] - ends[0][2]) * math.sin(layer.stereo)
        assert extent[i] == pytest.approx(abs(along if hits["kind"][i] == 0 else v), rel=0.01, abs=2e-3)


@pytest.mark.parametrize(("pt", "reached"), [(0.0100, 0), (0.0155, 2), (0.0220, 4)])
def test_out_of_reach(pt, reached):
    """A helix that turns back between two CGEM layers meets the hits inside its turning point and no others."""
    detector, core = DETECTORS["besiii-cgem-design", -1], BARE["besiii-cgem-design", -1]
    parameters = helix_of("central 1 GeV/c", -1)
    hits = hits_on(detector, parameters)
    parameters[2] = -1 / pt
    inside = np.count_nonzero([layer.r_mid < 2 * pt / LIGHT + abs(parameters[0]) for layer in detector.cgem])
    out = reference(core, parameters, hits)
    assert out["reached"] == 2 * inside == reached
    assert len(out["predicted"]) == len(out["extent"]) == len(out["rows"]) == reached
    assert not out["stopped"]


def test_stopped_in_matter():
    """A proton of 0.1 GeV/c runs out of momentum in the beam pipe, and the reference says so."""
    detector = DETECTORS["besiii-cgem-design", -1]
    hits = hits_on(detector, helix_of("central 1 GeV/c", 1))
    out = _core._testing.reference(compiled(detector), np.array([0, 0.4, 1 / 0.1, 0, 0]), 0.93827208816, hits)
    assert out["stopped"]
    assert out["reached"] == 0


def test_transport_without_fluctuations_is_the_reference():
    """With matter but without fluctuations the simulated crossings are where the reference predicts them."""
    for (name, bz), detector in DETECTORS.items():
        for charge in (-1, 1):
            for shape in SHAPES:
                parameters = helix_of(shape, charge)
                out = transport(compiled(detector), on_helix(parameters))
                if not len(out["wire_truths"]["layer"]):
                    continue
                hits = hits_on(detector, parameters)
                found = reference(compiled(detector), parameters, hits)["predicted"]
                value = np.where(hits["kind"] == 2, hits["value"] * hits["side"], hits["value"])
                np.testing.assert_allclose(
                    found, value[: len(found)], rtol=0, atol=1e-9, err_msg=f"{name} {bz} {shape}"
                )
