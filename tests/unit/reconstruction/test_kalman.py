"""Filter and smoother equal a global least-squares fit; predictions, derivatives and noise agree with integration."""

import math

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core, helix
from cgemit.detector import load, slab_table, slabs
from cgemit.detector.core import layer_table, wire_table
from cgemit.fit_matter import tuned
from cgemit.reconstruction.states import StateStatus
from cgemit.tables.schema import FitStatus
from dense import HELICES, PRIOR, least_squares, linear_model, smeared_track
from fields import HARMONIC, small_map
from oracles import LIGHT, helix_point, integrate
from slabs import composition
from tracks import MUON, hits_on, on_helix, particles, transport, without_matter

every_track = pytest.mark.parametrize(
    ("name", "which"), [(name, which) for name in ("besiii-cgem-design", "besiii-idc") for which in HELICES]
)


def settings(**changes):
    """Return settings that iterate until nothing moves."""
    values = {
        "max_iterations": 50,
        "tolerance": 1e-7,
        "errors_from_track": False,
        "least_width": 0.1,
        "delta_strips": 0.0,
        "kinks": False,
        "outlier_pull": 0.0,
        "momentum": 1.0,
    }
    return values | {"prior_sigma": tuple(PRIOR), "beam": (0.0, 0.0)} | changes


def settled(core, hits, helix):
    """Fit one track until nothing moves, one iteration at a time, so that the prior is the one in the settings."""
    for _ in range(12):
        out = fitted(core, hits, helix, settings(max_iterations=1, tolerance=1e-4))
        helix = out["helix"][0]
    return out


def fitted(core, hits, start, which_settings):
    """Fit one track."""
    return _core.reconstruction.fit(
        core, hit_offsets=np.array([0, len(hits["kind"])]), hits=hits, mass=np.array([MUON]),
        start=np.atleast_2d(start), settings=which_settings, residuals=True,
    )  # fmt: skip


@every_track
def test_filter_is_least_squares(name, which):
    """At the converged helix least squares moves nothing, and finds the filter's covariance and chi-square."""
    detector, core, helix, hits = smeared_track(name, which)
    out = settled(core, hits, helix)
    assert out["status"][0] == _core.common.FitStatus.ok
    sigma = np.sqrt(np.diag(out["cov"][0]))
    estimate, covariance, chi2 = least_squares(*linear_model(detector, core, out["helix"][0], hits))
    assert np.all(np.abs(estimate) < 1e-6 * sigma)
    np.testing.assert_allclose(out["cov"][0] / np.outer(sigma, sigma), covariance / np.outer(sigma, sigma), atol=1e-6)
    assert out["chi2"][0] == pytest.approx(chi2, rel=1e-6)
    assert out["ndf"][0] == len(hits["kind"]) - 5
    assert out["n_clusters"][0] == np.count_nonzero(hits["kind"] < 2)
    assert out["n_wires"][0] == np.count_nonzero(hits["kind"] == 2)


@every_track
def test_one_step_is_the_least_squares_step(name, which):
    """From a helix off by some standard deviations, one iteration moves to where least squares moves."""
    detector, core, helix, hits = smeared_track(name, which)
    sigma = np.sqrt(np.diag(fitted(core, hits, helix, settings())["cov"][0]))
    start = helix + sigma * [3, -2, 2, -3, 1]
    out = fitted(core, hits, start, settings(max_iterations=1))
    assert out["status"][0] == _core.common.FitStatus.not_converged
    estimate, _, _ = least_squares(*linear_model(detector, core, start, hits))
    np.testing.assert_allclose((out["helix"][0] - start) / sigma, estimate / sigma, atol=2e-6)


@every_track
def test_residuals_leave_the_hit_out(name, which):
    """Each residual and its error are those of the hit against the prediction from all others."""
    detector, core, helix, hits = smeared_track(name, which)
    out = settled(core, hits, helix)
    residual, rows, covariance = linear_model(detector, core, out["helix"][0], hits)
    n = len(hits["kind"])
    for i in range(n):
        others = np.arange(n + 5) != i
        estimate, of_estimate, _ = least_squares(residual[others], rows[others], covariance[np.ix_(others, others)])
        # The hit shares the noise of the matter with the others: best linear prediction of what is left.
        weights = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, i])
        seen = rows[i] - weights @ rows[others]
        predicted = rows[i] @ estimate + weights @ (residual[others] - rows[others] @ estimate)
        variance = covariance[i, i] - weights @ covariance[others, i] + seen @ of_estimate @ seen
        assert out["err"][i] == pytest.approx(math.sqrt(variance), rel=1e-6)
        assert out["residual"][i] == pytest.approx(residual[i] - predicted, abs=1e-6 * out["err"][i])
        assert out["side"][i] == (hits["side"][i] if hits["kind"][i] == 2 else 0)


@every_track
def test_residual_of_the_innermost_hit_is_that_of_a_refit(name, which):
    """Refitting without the innermost hit predicts it: no matter lies between it and the others' common noise."""
    _, core, helix, hits = smeared_track(name, which)
    out = fitted(core, hits, helix, settings())
    without = fitted(core, {k: v[1:] for k, v in hits.items()}, helix, settings())
    predicted = _core._testing.reference(core, without["helix"][0], MUON, hits)["predicted"][0]
    measured = hits["value"][0] * (hits["side"][0] if hits["kind"][0] == 2 else 1)
    # The two fits are linearised about different helices.
    assert measured - predicted == pytest.approx(out["residual"][0], abs=0.02 * out["err"][0])


@every_track
def test_prior_is_weak_and_counted_once(name, which):
    """Priors ten times as wide move nothing by more than 1e-3 standard deviations, and widen nothing by 1e-3."""
    _, core, helix, hits = smeared_track(name, which)
    narrow = fitted(core, hits, helix, settings())
    wide = fitted(core, hits, helix, settings(prior_sigma=tuple(10 * PRIOR)))
    sigma = np.sqrt(np.diag(narrow["cov"][0]))
    assert np.all(np.abs(wide["helix"][0] - narrow["helix"][0]) < 1e-3 * sigma)
    np.testing.assert_allclose(np.sqrt(np.diag(wide["cov"][0])), sigma, rtol=1e-3)


def test_gate_sees_a_seed_that_counts():
    """A prior as narrow as the fit itself, which counts the seed as a measurement, is seen by the test above."""
    _, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    free = fitted(core, hits, helix, settings())
    sigma = np.sqrt(np.diag(free["cov"][0]))
    tied = fitted(core, hits, helix, settings(prior_sigma=tuple(sigma)))
    assert np.any(np.sqrt(np.diag(tied["cov"][0])) < 0.9 * sigma)


@every_track
def test_every_seed_leads_to_the_same_helix(name, which):
    """Starts scattered around the truth, and the start from the hits themselves, end at one helix."""
    _, core, helix, hits = smeared_track(name, which)
    best = fitted(core, hits, helix, settings())
    sigma = np.sqrt(np.diag(best["cov"][0]))
    rng = np.random.default_rng(8)
    smearing = np.array([2.0, 0.01, 0.04 * abs(helix[2]), 10.0, 0.02])
    starts = [helix + smearing * rng.normal(size=5) for _ in range(6)] + [np.empty((0, 5))]
    for start in starts:
        out = fitted(core, hits, start, settings())
        assert out["status"][0] == _core.common.FitStatus.ok
        assert np.all(np.abs(out["helix"][0] - best["helix"][0]) < 1e-5 * sigma)


@every_track
def test_hidden_sides_are_found(name, which):
    """With hidden sides and true distances the fit finds the sides and stays within a fraction of its error."""
    _, core, helix, hits = smeared_track(name, which)
    known = fitted(core, hits, helix, settings())
    hidden = fitted(core, hits | {"side": np.zeros_like(hits["side"])}, helix, settings(tolerance=1e-3))
    assert hidden["status"][0] == _core.common.FitStatus.ok
    far = (hits["kind"] == 2) & (hits["value"] > 1.0)
    np.testing.assert_array_equal(hidden["side"][far], hits["side"][far])
    sigma = np.sqrt(np.diag(known["cov"][0]))
    assert np.all(np.abs(hidden["helix"][0] - known["helix"][0]) < sigma)


def test_few_hits():
    """Fewer measurements than parameters end with a status; a dozen without the outer chamber are fitted."""
    _, core, helix, hits = smeared_track("besiii-cgem-design", "1 GeV/c")
    few = {k: v[:4] for k, v in hits.items()}
    assert fitted(core, few, helix, settings())["status"][0] == _core.common.FitStatus.too_few_hits
    enough = {k: v[:12] for k, v in hits.items()}
    out = fitted(core, enough, helix, settings())
    assert out["status"][0] == _core.common.FitStatus.ok
    assert out["ndf"][0] == 7
    assert np.all(np.linalg.eigvalsh(out["cov"][0]) > 0)


def test_gates_see_the_matter():
    """Leaving out the matter between measurements changes covariance and chi-square by much more than the gates."""
    detector, core, helix, hits = smeared_track("besiii-cgem-design", "0.18 GeV/c")
    out = fitted(core, hits, helix, settings())
    residual, rows, covariance = linear_model(detector, core, out["helix"][0], hits)
    bare = np.diag(np.concatenate([hits["sigma"] ** 2, PRIOR**2]))
    _, with_matter, chi2 = least_squares(residual, rows, covariance)
    _, without, chi2_without = least_squares(residual, rows, bare)
    assert with_matter[0, 0] > 2 * without[0, 0]
    assert chi2_without > 1.02 * chi2


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
    wires = np.flatnonzero(hits["kind"] == 2)
    for i in [*np.flatnonzero(hits["kind"] < 2), *wires[::4]]:
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
    detector, core, parameters = DETECTORS[name, bz], tuned(DETECTORS[name, bz]), helix_of(shape, charge)
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
    core, kinks, hits = tuned(detector), kinked(detector), hits_on(detector, helix_of(shape, charge))
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
    core, hits = tuned(detector), hits_on(detector, parameters)
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
    out = _core._testing.reference(tuned(detector), np.array([0, 0.4, 1 / 0.1, 0, 0]), 0.93827208816, hits)
    assert out["stopped"]
    assert out["reached"] == 0


def test_transport_without_fluctuations_is_the_reference():
    """With matter but without fluctuations the simulated crossings are where the reference predicts them."""
    for (name, bz), detector in DETECTORS.items():
        for charge in (-1, 1):
            for shape in SHAPES:
                parameters = helix_of(shape, charge)
                out = transport(tuned(detector), on_helix(parameters))
                if not len(out["wire_truths"]["layer"]):
                    continue
                hits = hits_on(detector, parameters)
                found = reference(tuned(detector), parameters, hits)["predicted"]
                value = np.where(hits["kind"] == 2, hits["value"] * hits["side"], hits["value"])
                np.testing.assert_allclose(
                    found, value[: len(found)], rtol=0, atol=1e-9, err_msg=f"{name} {bz} {shape}"
                )


DETECTORS_NOISE = {bz: load("besiii-cgem-design").with_overrides({"field.bz": f"{bz} T"}) for bz in (-1, 1)}
STEP_NOISE = np.array([0.01, 1e-5, 4e-5, 0.01, 2e-5])  # dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
# dr mm, phi0, pT GeV/c, dz mm, tanl
SHAPES_NOISE = {
    "central 1 GeV/c": (0.3, 0.4, 1.0, 5.0, 0.02),
    "inclined 5 GeV/c": (-0.5, -2.9, 5.0, -20.0, 1.1),
    "displaced 0.5 GeV/c": (20.0, 1.7, 0.5, 30.0, -0.7),
    "slow": (0.2, -1.2, 0.16, -8.0, 0.5),
}


def helix_of_noise(shape, charge):
    """Return (dr, phi0, kappa, dz, tanl) of a case."""
    dr, phi0, pt, dz, tanl = SHAPES_NOISE[shape]
    return np.array([dr, phi0, charge / pt, dz, tanl])


def one_slab(x0, xi, spread, bz):
    """Return the design detector's readout with a single slab of carbon at 60 mm, and its columns."""
    detector = DETECTORS_NOISE[bz]
    table = slab_table(slabs(detector))
    columns = {k: v.copy() for k, v in table.slabs.items()}
    for column in ("x0", "xi", "spread"):
        columns[column][:] = 0
    i = 1  # the air between beam pipe and first layer
    columns["radius"][i], columns["x0"][i], columns["xi"][i], columns["spread"][i] = 60.0, x0, xi, spread
    elements = [[(6, 12.011, 42.70 * x0 / 12.011)] if k == i else [] for k in range(len(columns["x0"]))]
    core = _core.detector.Detector(
        bz=detector.field.bz, slabs=columns, log_terms=table.log_terms, composition=composition(elements),
        layers=layer_table(detector.cgem), wires=wire_table(detector.drift_chamber),
        screening=_core.matter.Screening.wentzel,
    )  # fmt: skip
    return detector, core, i, columns


def rotated(momentum, angle_1, angle_2):
    """Turn a momentum by plane angles about the flight: 1 horizontal, 2 completing a right-handed set."""
    flight = momentum / np.linalg.norm(momentum)
    axis_1 = np.cross([0, 0, 1.0], flight)
    axis_1 /= np.linalg.norm(axis_1)
    axis_2 = np.cross(flight, axis_1)
    turned = flight + angle_1 * axis_1 + angle_2 * axis_2
    return np.linalg.norm(momentum) * turned / np.linalg.norm(turned), axis_1, axis_2


@pytest.mark.parametrize("bz", [-1, 1])
@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "displaced 0.5 GeV/c", "inclined 5 GeV/c", "slow"])
def test_noise_vectors_are_kicks_seen_from_the_origin(shape, charge, bz):
    """Each noise vector is the change of the helix when the track beyond the slab is kicked and followed back."""
    detector, core, slab, columns = one_slab(0.02, 1e-4, 4.0, bz)
    parameters = helix_of_noise(shape, charge)
    hits = hits_on(detector, parameters)
    noise = _core._testing.reference(core, parameters, MUON, hits)["noise"]
    noise = noise[np.any(np.abs(noise) > 1e-9, axis=1)]  # the other slabs are empty
    assert len(noise) == 5  # two angles, the loss, two shifts
    start = on_helix(parameters)
    point = helix_point([start[c][0] for c in "xyz"], [start[c][0] for c in ("px", "py", "pz")], charge, bz)
    at = _core._testing.step_to_cylinder(point[None], columns["radius"][slab])[0][0]
    position, momentum = at[:3], abs(1 / parameters[2]) * np.array([*at[3:5], at[5]])
    p = np.linalg.norm(momentum)
    # The kicks' sizes: path, angle from momentum half-way through the loss, straggling, shift.
    across = at[:2] @ at[3:5] / columns["radius"][slab]
    path = math.hypot(1, at[5]) / across
    _, track_xi, track_chi_c2 = _core.matter.total_matter(core, parameters[4])
    loss, variance, _ = _core._testing.core_loss(core, slab, path=path, p=p, mass=MUON, track_xi=track_xi)
    energy = math.hypot(p, MUON)
    after = math.sqrt((energy - loss) ** 2 - MUON**2)
    theta = _core.matter.scattering_angle(
        core, slab, path=path, p=0.5 * (p + after), mass=MUON, track_chi_c2=track_chi_c2
    )  # fmt: skip
    shift = theta * 4.0 * path

    def seen(kick, epsilon):
        """Return the helix of the kicked track, followed back to the beam line in vacuum."""
        turned, axis_1, axis_2 = rotated(momentum, epsilon * kick[0], epsilon * kick[1])
        moved = position + epsilon * (kick[3] * axis_1 + kick[4] * axis_2)
        return helix.at_origin(particles(moved, turned * (1 + epsilon * kick[2]), -13 * charge), bz)[0]

    kicks = np.diag([theta, theta, math.sqrt(variance) * energy / p**2, shift, shift])
    # The way back over a shift along the flight turns the direction by w times it: second order in thin matter.
    turn = abs(at[6]) * shift * abs(at[5]) / math.hypot(1, at[5])
    neglected = 1.1 * turn * np.array([70.0, 1.0, 0.0, 70.0 * abs(at[5]), 0.0])
    for number, (found, kick) in enumerate(zip(noise, kicks, strict=True)):
        expected = (seen(kick, 1e-3) - seen(kick, -1e-3)) / 2e-3
        weights = np.array([1e-3, 1, 1, 1e-3, 1])
        size = found @ (weights * expected) / (expected @ (weights * expected))
        if number == 4:
            limit = 5e-4 * np.abs(expected) + neglected
            assert np.all(np.abs(math.copysign(1, size) * found - expected) <= limit)
            continue
        # At which momentum on the way through the slab the size is taken is a matter of taste.
        assert abs(size) == pytest.approx(1, rel=5e-4), number
        limit = 2e-5 * np.abs(expected) + 1e-6 * np.abs(expected).max() * np.array([1, 1e-2, 1e-2, 1, 1e-2])
        assert np.all(np.abs(found / size - expected) <= limit), number


@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "slow", "displaced 0.5 GeV/c"])
def test_noise_behind_all_matter(shape, charge):
    """Seen from the origin through all the matter before it, a kick in the outermost gap is its noise vector.

    The simulation without fluctuations tells how place, direction and momentum in the gap depend on the helix; the
    noise vector is the change of the helix that makes the kick.
    """
    detector, core = DETECTORS_NOISE[-1], tuned(DETECTORS_NOISE[-1])
    parameters = helix_of_noise(shape, charge)

    def arrival(helix_row):
        truths = {k: v[-1] for k, v in transport(core, on_helix(helix_row))["truths"].items()}
        assert truths["layer"] == 2
        pt = math.hypot(truths["px"], truths["py"])
        azimuth = math.atan2(truths["py"], truths["px"])
        return np.array([truths["phi"], azimuth, charge / pt, truths["z"], truths["pz"] / pt])

    matrix = np.empty((5, 5))
    for i in range(5):
        step = np.where(np.arange(5) == i, STEP_NOISE, 0)
        matrix[:, i] = (arrival(parameters + step) - arrival(parameters - step)) / (2 * STEP_NOISE[i])
    columns = slab_table(slabs(detector)).slabs
    shifts = columns["spread"] * 13.6e-3 * np.sqrt(columns["x0"]) > 5e-3
    gap = int(np.flatnonzero(columns["gap"] == 2)[0])
    first = np.where(shifts, 5, 3)[:gap].sum()
    noise = _core._testing.reference(core, parameters, MUON, hits_on(detector, parameters))["noise"][first : first + 3]
    _, _, kappa, _, tanl = arrival(parameters)
    # Sideways; up and down at fixed momentum; momentum alone. Sizes are tested with a single slab above; what is left
    # is that the loss depends on how obliquely matter is met.
    kicks = np.array([[0, 1, 0, 0, 0], [0, 0, kappa * tanl, 0, 1 + tanl**2], [0, 0, 1, 0, 0]])
    units = np.array([1.0, 5e-3, 1e-2, 1.0, 5e-3])
    for found, kick in zip(noise, kicks, strict=True):
        expected = np.linalg.solve(matrix, kick) / units
        unit, expected = found / units / np.linalg.norm(found / units), expected / np.linalg.norm(expected)
        np.testing.assert_allclose(unit * np.sign(unit @ expected), expected, atol=1e-2)


UNIFORM = load("besiii-cgem-design")
# A field that falls by a third: terms that a weak gradient would hide count.
UNEVEN = UNIFORM.with_field(
    {"kind": "harmonic", "bz": "-0.98 T", "b": "0.6 /m2", "q": "-0.251 /m4", "tolerance": "1e-8 mm"}
)
EVEN = UNIFORM.with_field({"kind": "harmonic", "bz": "-1 T", "b": "0 /m2", "tolerance": "1e-8 mm"})

# dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
SHAPES_FIELD = {
    "central 1 GeV/c": (0.3, 0.4, 1.0, 5.0, 0.02),
    "inclined 5 GeV/c": (-0.5, -2.9, -0.2, -20.0, 1.1),
    "displaced 0.5 GeV/c": (20.0, 1.7, 2.0, 30.0, -0.7),
    "slow": (0.2, -1.2, -1 / 0.16, -8.0, 0.5),
}
every_shape = pytest.mark.parametrize("shape", SHAPES_FIELD)


def reference_field(core, parameters, hits):
    return _core._testing.reference(core, parameters, MUON, hits)


def test_matter_acts_together_in_a_constant_map_as_in_a_uniform_field():
    acting = [tuned(detector).acting for detector in (UNIFORM, EVEN)]
    assert len(set(acting[0])) > 20
    np.testing.assert_allclose(acting[1], acting[0], rtol=1e-5)


@pytest.mark.usefixtures("equal_weights")
@every_shape
def test_constant_map_is_the_uniform_field(shape):
    """Rows and noise of two formulations agree: turns of helices, and transported derivatives."""
    parameters = np.array(SHAPES_FIELD[shape])
    hits = hits_on(UNIFORM, parameters)
    bare, other_bare = (reference_field(without_matter(detector), parameters, hits) for detector in (UNIFORM, EVEN))
    scale = np.abs(bare["rows"]).max(axis=0)
    np.testing.assert_allclose(other_bare["rows"] / scale, bare["rows"] / scale, rtol=0, atol=1e-9)
    one, other = (reference_field(tuned(detector), parameters, hits) for detector in (UNIFORM, EVEN))
    assert other["predicted"] == pytest.approx(one["predicted"], abs=1e-6)
    # A displaced track loses its momentum after the same path in one, on the same cylinder in the other.
    for name, tolerance in (("rows", [2e-3, 1e-9, 1e-4, 1e-9, 1e-6]), ("noise", [5e-4, 5e-4, 1e-9, 1e-4, 1e-9])):
        scale = np.abs(one[name]).max(axis=0)
        assert (np.abs(other[name] - one[name]).max(axis=0) / scale < tolerance).all()


@every_shape
def test_taylor(shape):
    """Without matter, the error of the linear prediction falls by four with every halving of the step."""
    core, parameters = without_matter(UNEVEN), np.array(SHAPES_FIELD[shape])
    hits, rng = hits_on(UNEVEN, parameters), np.random.default_rng(1)
    start = reference_field(core, parameters, hits)
    assert start["reached"] == len(hits["kind"]) > 20
    for _ in range(3):
        step, errors = STEP * rng.choice([-1, 1], 5) * 0.5, []
        for size in (1, 0.5, 0.25, 0.125):
            moved = reference_field(core, parameters + size * step, hits)["predicted"]
            errors.append(np.linalg.norm(moved - start["predicted"] - start["rows"] @ (size * step)))
        np.testing.assert_allclose(np.array(errors[:-1])[1:] / errors[2:], 4, rtol=0.12)


def test_taylor_sees_the_rows_of_a_uniform_field():
    parameters = np.array(SHAPES_FIELD["central 1 GeV/c"])
    hits = hits_on(UNEVEN, parameters)
    rows = {det.field.kind: reference_field(without_matter(det), parameters, hits)["rows"] for det in (UNIFORM, UNEVEN)}
    error = np.abs(rows["harmonic"] - rows["uniform"]).max(axis=0) / np.abs(rows["uniform"]).max(axis=0)
    assert error[2] > 1e-3


@every_shape
def test_differences_with_matter_field(shape):
    """As in a uniform field: exact up to how obliquely the matter is crossed, which depends on z now, too."""
    core, parameters = tuned(UNEVEN), np.array(SHAPES_FIELD[shape])
    hits = hits_on(UNEVEN, parameters)
    rows = reference_field(core, parameters, hits)["rows"]
    gentle = abs(parameters[0]) <= 1 and abs(parameters[2]) < 1 / 0.15
    for i, part in enumerate([6e-3, 1e-7, 3e-4, 1e-4, 6e-3] if gentle else [4e-2, 1e-7, 5e-3, 1e-4, 4e-2]):
        step = np.where(np.arange(5) == i, 0.05 * STEP, 0.0)
        ahead, behind = (reference_field(core, parameters + sign * step, hits)["predicted"] for sign in (1, -1))
        limit = part * np.abs(rows[:, i]).max()
        np.testing.assert_allclose(rows[:, i], (ahead - behind) / (2 * step[i]), rtol=0, atol=limit, err_msg=f"{i}")


@pytest.mark.usefixtures("equal_weights")
@every_shape
def test_kinks_in_a_constant_map_are_those_of_a_uniform_field(shape):
    """Two formulations of a scattered reference agree in what it meets and, to the size of the angles, in its rows."""
    parameters = np.array(SHAPES_FIELD[shape])
    hits = hits_on(UNIFORM, parameters)
    kinks = np.random.default_rng(3).normal(scale=0.01, size=(len(slabs(UNIFORM)), 2))
    cores = [tuned(detector) for detector in (UNIFORM, EVEN)]
    one, other = (_core._testing.reference(core, parameters, MUON, hits, kinks) for core in cores)
    assert other["predicted"] == pytest.approx(one["predicted"], abs=1e-6)
    assert other["noise_units"] == pytest.approx(one["noise_units"], rel=1e-6)
    assert np.abs(one["predicted"] - _core._testing.reference(cores[0], parameters, MUON, hits)["predicted"]).max() > 4
    for name, limits in (("rows", [4e-2, 1e-8, 5e-3, 1e-8, 3e-4]), ("noise", [2e-2, 2e-3, 1e-9, 2.5e-2, 1e-9])):
        scale = np.abs(one[name]).max(axis=0)
        assert (np.abs(other[name] - one[name]).max(axis=0) / scale < limits).all()


@every_shape
def test_differences_with_kinks_field(shape):
    """Displaced tracks are scattered on the same cylinder: rows through a map are exact up to how the loss depends."""
    core, parameters = tuned(UNEVEN), np.array(SHAPES_FIELD[shape])
    hits = hits_on(UNEVEN, parameters)
    kinks = np.random.default_rng(3).normal(scale=0.01, size=(len(slabs(UNEVEN)), 2))
    rows = _core._testing.reference(core, parameters, MUON, hits, kinks)["rows"]
    for i, part in enumerate([8e-3, 1e-7, 3e-4, 3e-5, 2e-3]):
        step = np.where(np.arange(5) == i, 0.05 * STEP, 0.0)
        ends = [
            _core._testing.reference(core, parameters + sign * step, MUON, hits, kinks)["predicted"] for sign in (1, -1)
        ]
        limit = part * np.abs(rows[:, i]).max()
        np.testing.assert_allclose(rows[:, i], (ends[0] - ends[1]) / (2 * step[i]), rtol=0, atol=limit, err_msg=f"{i}")


SOLENOID = UNIFORM.with_field("finite-solenoid")


@every_shape
@pytest.mark.parametrize("scattered", [False, True])
@pytest.mark.parametrize(
    ("detector", "distance", "part"), [(UNEVEN, 1e-6, 2e-5), (SOLENOID, 5e-5, 2e-4)], ids=["fine steps", "solenoid"]
)
def test_wires_on_a_span_are_those_of_a_trajectory_that_stops_there(shape, scattered, detector, distance, part):
    """One move past all wires of a superlayer: distances to 50 nm, rows to two parts in 10 000."""
    parameters = np.array(SHAPES_FIELD[shape])
    hits = hits_on(detector, parameters)
    kinks = np.random.default_rng(3).normal(scale=0.01, size=(len(slabs(detector)), 2)) if scattered else None
    core = tuned(detector)
    stops, passes = (_core._testing.reference(core, parameters, MUON, hits, kinks, spans=spans) for spans in (0, 1))
    assert len(passes["predicted"]) == len(stops["predicted"]) > 35
    np.testing.assert_allclose(passes["predicted"], stops["predicted"], rtol=0, atol=distance)
    for name in ("rows", "noise"):
        difference = np.abs(passes[name] - stops[name]).max(axis=0)
        assert 0 < (difference / np.abs(stops[name]).max(axis=0)).max() < part


@every_shape
def test_simulation_without_fluctuations_is_the_reference(shape):
    parameters = np.array(SHAPES_FIELD[shape])
    hits = hits_on(UNEVEN, parameters)
    found = reference_field(tuned(UNEVEN), parameters, hits)["predicted"]
    value = np.where(hits["kind"] == 2, hits["value"] * hits["side"], hits["value"])
    assert found == pytest.approx(value, abs=1e-5)


def test_noise_is_a_kick_seen_from_the_origin():
    """A turn at the first slab, undone at the origin, leaves the hits where they were: the sum over parameters."""
    parameters = np.array(SHAPES_FIELD["inclined 5 GeV/c"])
    core, hits = without_matter(UNEVEN, density=1e-4), hits_on(UNEVEN, parameters)
    out = reference_field(core, parameters, hits)
    # The innermost scatterer is the beam pipe, r = 32.6 mm: its turns move hits as a turn about the origin would,
    # but for the lever arm.
    turn = out["noise"][0] / out["noise"][0][1]
    shift = out["rows"] @ (turn - np.array([0, 1, 0, 0, 0]))
    lever = math.hypot(turn[0], 0)
    assert lever == pytest.approx(32.6, rel=0.02)
    moved = reference_field(core, parameters + 1e-4 * turn, hits)["predicted"] - out["predicted"]
    assert moved == pytest.approx(1e-4 * (out["rows"][:, 1] + shift), abs=1e-5)


def test_a_fit_that_leaves_its_map_says_so(tmp_path):
    whole = UNIFORM.with_field(HARMONIC)
    small = UNIFORM.with_field(small_map(tmp_path))
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3))
    result = cg.run(whole, gun, 30, seed=2, fit_detector=small)
    assert (result.tracks["status"] == FitStatus.left_field).all()
    assert result.removed() == {"left_field": 30}
    # What was simulated in the map is fitted in the map.
    inside = cg.run(small, gun, 30, seed=2)
    assert inside.transport() == {"left_field": 30}
    assert inside.removed() == {}
    assert inside.tracks["n_wires"].max() < 25 < result.wire_truths["event"].size / 30


def test_unknown_sides_and_low_momenta_are_fitted():
    result = cg.run(
        UNIFORM.with_field("finite-solenoid"), cg.Gun("mu-", p=(0.12, 2.0), cos_theta=(-0.9, 0.9)), 300, seed=4
    )
    fitted = result.tracks["status"] == FitStatus.ok
    assert fitted.mean() > 0.97
    assert np.median(np.abs(result.tracks["res_p"][fitted] / result.tracks["truth_p"][fitted])) < 0.01


@pytest.mark.parametrize("name", [HARMONIC, "finite-solenoid", "small map"])
def test_any_particle_ends_with_numbers_or_a_status(tmp_path, name):
    """From 25 MeV/c to 5 GeV/c, from far beside the beam line: nothing is NaN where all is said to be well."""
    rng, n = np.random.default_rng(5), 300
    flight = rng.normal(size=(n, 3))
    flight *= (10 ** rng.uniform(-1.6, 0.7, n) / np.linalg.norm(flight, axis=1))[:, None]
    place = rng.normal(size=(n, 3)) * np.where(rng.random(n) < 0.5, 5, 150)[:, None]
    table = particles(place, flight, rng.choice([13, -13, 211, -211, 2212, 11, -11, 321], n))
    settings = cg.Settings(fit=cg.FitSettings(states=("beam_line", 50.0, 400.0, 900.0, "hits")))
    detector = UNIFORM.with_field(small_map(tmp_path) if name == "small map" else name)
    result = cg.run(detector, table, seed=3, settings=settings)
    fitted = result.tracks["status"] == FitStatus.ok
    assert fitted.sum() > 100
    states = result.states[result.states["status"] == StateStatus.ok]
    assert len(states) > 0.8 * len(result.wire_hits)
    for column in ("x", "px", "kappa", "cov"):
        assert np.isfinite(states[column]).all()
    assert np.diagonal(states["cov"][:, 1:3, 1:3], axis1=1, axis2=2).min() > 0
    for name, rows in (
        ("truths", slice(None)),
        ("steps", slice(None)),
        ("wire_truths", slice(None)),
        ("tracks", fitted),
    ):
        for column, values in result.tables[name].columns.items():
            if values.dtype.kind == "f":
                assert np.isfinite(values[rows]).all(), f"{name}.{column}"
    cov = result.tracks["cov"][fitted]
    sigma = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    assert np.linalg.eigvalsh(cov / (sigma[:, :, None] * sigma[:, None, :])).min() > 0
