"""States of fitted tracks agree with the fit, with each other, and with exact motion, in fields and maps."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import cgemit as cg
from cgemit import _core, helix
from cgemit.chain.settings import Settings
from cgemit.cli.main import main
from cgemit.detector import load, slabs
from cgemit.fit_matter import tuned
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import PARAMETERS, FitSettings
from cgemit.reconstruction.states import StateStatus, Surface, extrapolate
from cgemit.tables import Table
from cgemit.tables.schema import FitStatus
from exact import exact
from fields import HARMONIC, harmonic_by_hand, small_map
from oracles import LIGHT
from tracks import MUON, hits_on, on_helix, transport, without_matter

DETECTOR = load("besiii-cgem-design")
PIPE = slabs(DETECTOR)[0]
WALL = next(slab for slab in slabs(DETECTOR) if slab.shells[0].group == "wall")
PLACES = ("origin", "beam_line", 10.0, "beam_pipe", 50.0, 250.0, 500.0, "hits", 1000.0)


#: Tolerance of fits whose derivatives are those about a reference close to the fitted track.
CLOSE = 1e-3


def states_of(surfaces, gun=None, n=40, **changes):
    """Return the result of a run in which everything is Gaussian, and its states."""
    how = exact(fit=FitSettings(states=surfaces, residuals=True, **changes))
    gun = gun or Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.6, 0.6), vertex_sigma=(1.0, 1.0, 5.0))
    result = cg.run(DETECTOR, gun, n, seed=5, **how)
    return result, result.states


@pytest.fixture(scope="module")
def run():
    """Return 40 muons with states everywhere."""
    return states_of(PLACES, tolerance=CLOSE)


def rows(table, **values):
    """Return the rows with these values."""
    return table[np.all([table[name] == value for name, value in values.items()], axis=0)]


def parameters(table):
    """Return the helices, (n, 5)."""
    return np.stack([table[name] for name in PARAMETERS], axis=1)


def pivots(table):
    """Return the pivots, (n, 3)."""
    return np.stack([table[f"pivot_{axis}"] for axis in "xyz"], axis=1)


def error(table):
    """Return the standard deviations of the parameters, (n, 5)."""
    return np.sqrt(np.diagonal(table["cov"], axis1=1, axis2=2))


def assert_same(found, cov, expected, expected_cov, tolerance=1e-8):
    """Compare helices and covariances in standard deviations."""
    sigma = np.sqrt(np.diagonal(expected_cov, axis1=1, axis2=2))
    difference = found - expected
    difference[:, 1] = np.remainder(difference[:, 1] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(difference / sigma).max() < tolerance
    scale = sigma[:, :, None] * sigma[:, None, :]
    assert np.abs((cov - expected_cov) / scale).max() < tolerance


def test_at_the_origin_it_is_the_track(run):
    """The state at the origin is the row of the tracks table; the pivot on the track moves nothing else."""
    result, states = run
    origin, line = (rows(states, surface=where) for where in (Surface.origin, Surface.beam_line))
    assert_same(parameters(origin), origin["cov"], parameters(result.tracks), result.tracks["cov"], 1e-9)
    assert not pivots(origin).any()
    for name in ("x", "y", "z", "px", "py", "pz", "phi0", "kappa"):
        np.testing.assert_allclose(line[name], origin[name], rtol=0, atol=1e-12)
    np.testing.assert_allclose(pivots(line), np.stack([line[axis] for axis in "xyz"], axis=1))
    moved = helix.change_pivot(parameters(origin), origin["cov"], [0, 0, 0], pivots(line), DETECTOR.field.bz)
    assert_same(parameters(line), line["cov"], *moved)


@pytest.mark.parametrize(("setting", "value"), [("loss", "mean"), ("screening", "moliere"), ("hypothesis", "K")])
def test_states_assume_what_the_fit_assumed(setting, value):
    """With another loss, screening or mass the state at the origin is the track all the same, and not another one."""
    gun = Gun("mu-", p=0.3, cos_theta=0.2)
    result, states = states_of(("origin", "hits"), gun, n=10, **{setting: value})
    usual, _ = states_of((), gun, n=10)
    origin, hits = (rows(states, surface=where) for where in (Surface.origin, Surface.hit))
    assert_same(parameters(origin), origin["cov"], parameters(result.tracks), result.tracks["cov"], 1e-9)
    np.testing.assert_allclose(hits["pull"], result.residuals["pull"], rtol=0, atol=1e-5)
    assert np.abs(usual.tracks["cov"] / result.tracks["cov"] - 1).max() > 1e-4


def test_every_row_holds_together(run):
    """Rows come in the order of the surfaces, with positive definite covariances and points on their helices."""
    result, states = run
    assert np.all(states["status"] == StateStatus.ok)
    n_hits = len(result.residuals)
    assert len(states) == (len(PLACES) - 1) * len(result.tracks) + n_hits
    first = states[states["track"] == 0]
    assert first["surface"].tolist() == [0, 1, 2, 2, 2, 2, 2] + [3] * (len(first) - 8) + [2]
    np.testing.assert_allclose(first["r"][[2, 3, -1]], [10.0, DETECTOR.beam_pipe[0].r_in, 1000.0])
    correlation = states["cov"] / (error(states)[:, :, None] * error(states)[:, None, :])
    assert np.linalg.eigvalsh(correlation).min() > 1e-4
    np.testing.assert_array_equal(states["cov"], states["cov"].transpose(0, 2, 1))
    cylinders = rows(states, surface=Surface.cylinder)
    np.testing.assert_allclose(np.hypot(cylinders["x"], cylinders["y"]), cylinders["r"])
    momentum = np.sqrt(states["px"] ** 2 + states["py"] ** 2 + states["pz"] ** 2)
    np.testing.assert_allclose(momentum, helix.momentum(parameters(states)))
    assert np.all(states["hypothesis"] == 13)


def test_hits_have_the_smoothed_residuals(run):
    """The pull to the track with the hit is that to the track without it, found in another way (residuals table)."""
    result, states = run
    hits, residuals = rows(states, surface=Surface.hit), result.residuals
    for name in ("track", "view", "layer", "hit"):
        np.testing.assert_array_equal(hits[name], residuals[name])
    np.testing.assert_allclose(hits["pull"], residuals["pull"], rtol=0, atol=1e-5)
    # With it, the residual is smaller: r = R/(R + V) r_without, R the variance of the hit, V of the prediction.
    np.testing.assert_allclose(hits["residual"] * residuals["residual"], hits["residual"] ** 2 * (
        residuals["err"] / hits["err"]), rtol=1e-4, atol=1e-9)  # fmt: skip
    assert np.all(np.abs(hits["residual"]) < np.abs(residuals["residual"]))
    wires = hits["view"] == 2
    truth = result.wire_truths[result.wire_hits["wire_truth"][hits["hit"][wires]]]
    distance = np.hypot(truth["x"] - hits["x"][wires], truth["y"] - hits["y"][wires])
    assert np.quantile(distance, 0.99) < 0.6


def test_nothing_happens_in_vacuum(run):
    """Between beam line and pipe the states are one helix; the wall beyond changes it."""
    _, states = run
    origin, inside, pipe, beyond = (
        states[states["surface"] == Surface.origin],
        *(rows(states, r=r) for r in (10.0, DETECTOR.beam_pipe[0].r_in, 50.0)),
    )
    for other in (inside, pipe):
        moved = helix.change_pivot(parameters(origin), origin["cov"], [0, 0, 0], pivots(other), DETECTOR.field.bz)
        assert_same(parameters(other), other["cov"], *moved, tolerance=1e-4)
    moved, cov = helix.change_pivot(parameters(origin), origin["cov"], [0, 0, 0], pivots(beyond), DETECTOR.field.bz)
    assert np.all(np.abs(beyond["kappa"]) > np.abs(moved[:, 2]) * (1 + 1e-4))
    assert np.median(np.sqrt(cov[:, 1, 1]) / error(beyond)[:, 1]) > 1.2


@pytest.mark.parametrize("slab", [PIPE, WALL], ids=["pipe", "wall"])
def test_matter_acts_as_far_as_the_radius(slab):
    """Across a wall, states change steadily from that before to that behind, and the loss in proportion to X/X0."""
    part = np.array([-0.01, 1e-4, 0.25, 0.5, 0.75, 1 - 1e-4, 1.01])
    radii = slab.r_in + part * (slab.r_out - slab.r_in)
    _, states = states_of(tuple(float(r) for r in radii), n=10)
    table = np.stack([parameters(rows(states, r=r)) for r in radii])
    sigma = np.stack([error(rows(states, r=r)) for r in radii])
    share = [sum(s.x0 * np.clip((r - s.r_in) / s.thickness, 0, 1) for s in slab.shells) / slab.x0 for r in radii]
    kappa = np.abs(table[:, :, 2])
    lost = (kappa - kappa[0]) / (kappa[-1] - kappa[0])
    # Straggling and scattering into dip change kappa by what the hits beyond say, which is not proportional.
    assert np.all(kappa[-1] > kappa[0])
    np.testing.assert_allclose(lost, np.broadcast_to(np.array(share)[:, None], lost.shape), atol=0.05)
    assert np.all(np.diff(sigma[:, :, 1], axis=0) < 1e-9)
    for edge in (0, 5):
        np.testing.assert_allclose(sigma[edge], sigma[edge + 1], rtol=2e-2)


def test_extrapolation_follows_the_simulation():
    """Without fluctuations, a helix taken from the origin to each gap is the simulated particle, and back the same."""
    start = np.array([[0.3, 0.4, 2.5, 5.0, 0.4], [-0.2, -2.0, -1.0, 2.0, -0.7]])
    cov = np.repeat(np.diag([1e-2, 1e-6, 1e-6, 1e-2, 1e-6])[None], 2, axis=0)
    out = transport(tuned(DETECTOR), on_helix(start))["truths"]
    result, _ = states_of((), n=2)
    columns = {name: start[:, i] for i, name in enumerate(PARAMETERS)}
    tracks = result.tracks.with_columns(cov=cov, **columns)
    for layer, cgem in enumerate(DETECTOR.cgem):
        gap = np.flatnonzero(out["layer"] == layer)
        found = extrapolate(DETECTOR, tracks, cgem.r_gap_in)
        to_middle = extrapolate(DETECTOR, found, cgem.r_mid)
        np.testing.assert_allclose(np.arctan2(to_middle["y"], to_middle["x"]), out["phi"][gap], atol=2e-6)
        np.testing.assert_allclose(to_middle["z"], out["z"][gap], atol=1e-3)
        for axis in ("px", "py", "pz"):
            np.testing.assert_allclose(to_middle[axis], out[axis][gap], atol=2e-6)
        assert np.all(np.linalg.eigvalsh(found["cov"]) > 0)
        back = extrapolate(DETECTOR, found, 20.0)
        there = extrapolate(DETECTOR, tracks, 20.0)
        np.testing.assert_allclose(parameters(back), parameters(there), rtol=1e-7, atol=1e-6)
        assert np.all(error(back)[:, [1, 4]] > error(there)[:, [1, 4]])


def test_extrapolation_loads_a_detector_by_its_name(run):
    assert extrapolate("besiii-cgem-design", run[1], 100.0) == extrapolate(DETECTOR, run[1], 100.0)


def test_outside_the_last_hit_states_are_extrapolated(run):
    """Beyond the last measurement the state is the last one moved on."""
    _, states = run
    outside = rows(states, r=1000.0)
    hits = rows(states, surface=Surface.hit)
    last = hits[np.flatnonzero(np.diff(hits["track"], append=-1) != 0)]
    moved = extrapolate(DETECTOR, last, 1000.0)
    # The last wire lies within a lump of gas that the fit has crossed as a whole.
    assert_same(parameters(outside), outside["cov"], parameters(moved), moved["cov"], tolerance=0.05)
    assert np.all(error(outside)[:, [0, 3]] > error(last)[:, [0, 3]])


def test_tracks_that_have_not_settled_have_no_states():
    """The last iteration of such a fit may have begun far from where it ended."""
    settings = Settings(fit=FitSettings(states=("origin", "hits"), max_iterations=1))
    result = cg.run("besiii-cgem-design", Gun("mu-", p=0.3, cos_theta=0.2), 5, seed=3, settings=settings)
    assert np.all(result.tracks["status"] == FitStatus.not_converged)
    assert np.all(result.states["status"] == StateStatus.not_fitted)
    assert np.isnan(result.states["dr"]).all()


def test_rows_without_a_state_say_why():
    """Tracks that were not fitted, turn before the radius, or start beyond it, keep their rows."""
    guns = Gun("mu-", p=1.0, cos_theta=0.0) + Gun("mu-", pt=0.09, cos_theta=0.0) + Gun("pi+", pt=0.02, cos_theta=0.0)
    result, states = states_of(("origin", 10.0, 800.0, "hits"), guns, n=3)
    status = states["status"]
    assert np.all(result.tracks["status"].reshape(3, 3)[:, :2] == FitStatus.ok)
    assert np.all(states["status"][states["track"] % 3 == 2] == StateStatus.not_fitted)
    curls = rows(states, r=800.0)
    assert curls["status"].tolist() == [StateStatus.ok, StateStatus.does_not_reach, StateStatus.not_fitted] * 3
    lost = status != StateStatus.ok
    for name in ("x", "px", "dr", "cov", "residual", "pull"):
        assert np.isnan(states[name][lost]).all()
        assert np.isfinite(states[name][~lost & (states["surface"] == Surface.hit)]).all()
    again = extrapolate(DETECTOR, states[states["surface"] == Surface.origin], 10.0)
    assert set(again["status"]) == {StateStatus.ok, StateStatus.not_fitted}
    displaced = Gun("mu-", p=1.0, cos_theta=0.0, phi=0.3, vertex=(0.0, 20.0, 0.0))
    _, states = states_of((10.0, 25.0), displaced, n=2)
    assert states["status"].tolist() == [StateStatus.does_not_reach, StateStatus.ok] * 2


def test_asking_for_states_changes_no_track(run):
    """Tracks are the same with and without."""
    result, _ = run
    settings = dataclasses.replace(result.settings, fit=FitSettings(tolerance=CLOSE))
    bare = cg.run(result.detector, result.gun, 40, seed=5, settings=settings)
    assert bare.tracks == result.tracks.with_columns()
    assert bare.states is None
    assert "states" not in bare.tables


def test_chunks_join():
    """Rows link to the same tracks, clusters and wires however the events were cut."""
    settings = Settings(fit=FitSettings(states=("hits", 700.0)))
    gun = Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    whole, parts = (
        cg.run(DETECTOR, gun, 12, seed=2, settings=settings, workers=cg.Workers(chunk=size)) for size in (12, 5)
    )
    assert whole.states == parts.states


def test_every_mistake_is_listed():
    """Surfaces and arguments that make no sense are named together."""
    with pytest.raises(ValueError, match="FitSettings") as caught:
        FitSettings(states=("vertex", -1.0, float("nan"), True), hypothesis=("pi", "tau", "pi"))
    for text in ("'vertex'", "-1.0", "nan", "True", r"hypothesis\[1\]: got 'tau'", r"'pi'\)"):
        assert re.search(f"{text}, expected", str(caught.value))
    with pytest.raises(ValueError, match="expected a list, each a length in mm above 0"):
        FitSettings(states=10.0)  # type: ignore[arg-type]
    result, _ = states_of((), n=1)
    with pytest.raises(ValueError, match="extrapolate:") as caught:
        extrapolate(DETECTOR, result.particles, 0.0, particle="tau", screening="none", loss="none")
    for name in ("table", "radius", "particle", "screening", "loss"):
        assert f"\n  {name}: " in str(caught.value)
    for table in (result, None):
        expected = (
            rf"(?s)table: got {type(table).__name__}, expected .*particle: got \['e'\], .*loss: got \[1\], expected"
        )
        with pytest.raises(ValueError, match=expected):
            extrapolate(DETECTOR, table, 10.0, particle=["e"], loss=[1])
    with pytest.raises(ValueError, match='did you mean "besiii-cgem"'):
        extrapolate("besii-cgem", result.tracks, 10.0)
    bare = dataclasses.replace(DETECTOR, beam_pipe=())
    with pytest.raises(ValueError, match="'beam_pipe', but the detector has none"):
        cg.run(bare, Gun("mu-", p=1.0, cos_theta=0.0), 1, settings=Settings(fit=FitSettings(states=("beam_pipe",))))


def test_states_and_hypotheses_from_the_shell(tmp_path, capsys):
    """Surfaces are radii with units and names; a mass that is not the particle's own gives tracks of its own."""
    shot = ["simulate", "-d", "besiii-cgem-design", "--p", "0.5", "--cos-theta", "0", "-n", "3", "--quiet"]
    assert main([*shot, "--states", "beam_pipe,9 cm", "--hypothesis", "mu,K", "-o", str(tmp_path / "out")]) == 0
    tracks, states = (Table.load(tmp_path / "out" / f"{name}.npz") for name in ("tracks", "states"))
    assert tracks["hypothesis"].tolist() == [13, 321] * 3
    assert states["r"].tolist() == [DETECTOR.beam_pipe[0].r_in, 90.0] * 6
    assert main([*shot, "--states", "pipe,-3", "--hypothesis", "tau", "-o", str(tmp_path / "no")]) == 2
    text = capsys.readouterr().err
    for value in ("'pipe'", "-3.0", "'tau'"):
        assert f"{value}, expected" in text
    assert main([*shot, "--states", "3 ns", "-o", str(tmp_path / "no")]) == 2
    scan = ["resolution", "-d", "besiii-cgem-design", "--p", "1", "--quiet", "-o", str(tmp_path / "no")]
    assert main([*scan, "--hypothesis", "all"]) == 2
    assert "fit.hypothesis: got e, mu, pi, K, p; this command expects one of them" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


UNIFORM = load("besiii-cgem-design")
EVEN = UNIFORM.with_field({"kind": "harmonic", "bz": "-1 T", "b": "0 /m2", "tolerance": "1e-9 mm"})
# A field that falls by a third: terms that a weak gradient would hide count.
FALLING = {"bz": -0.98, "b": 0.6e-6, "q": -0.251e-12}
UNEVEN = UNIFORM.with_field(
    {"kind": "harmonic", "bz": "-0.98 T", "b": "0.6 /m2", "q": "-0.251 /m4", "tolerance": "1e-9 mm"}
)
COIL = UNIFORM.with_field(
    {"kind": "solenoid", "bz": "-1 T", "coil_radius": "1490 mm", "half_length": "1770 mm", "tolerance": "1e-9 mm"}
)
ORIGIN = np.zeros(3)
# dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
HELICES = np.array([(0.3, 0.4, 1.0, 5.0, 0.02), (-0.5, -2.9, -0.2, -20.0, 1.1), (-20.0, 1.7, -1 / 0.2, 30.0, -0.7)])
SIGMA = np.array([0.2, 1e-3, 3e-3, 0.3, 1e-3])
EVERY_RADIUS = (31.5, 100.0, 424.0, 790.0)
CYLINDER = int(Surface.cylinder)


def covariances(n, seed=1):
    """Return covariances whose parameters have errors of the usual sizes, all correlated."""
    root = np.random.default_rng(seed).normal(size=(n, 5, 5)) * SIGMA[:, None] / 2
    return root @ root.transpose(0, 2, 1)


def go(core, radius, helices=HELICES, cov=None, pivot=ORIGIN):
    """Take helices to a cylinder by the compiled module."""
    n = len(helices)
    cov = np.reshape(covariances(n) if cov is None else cov, (n, 25))
    return _core.reconstruction.extrapolate(
        core, pivot=np.broadcast_to(pivot, (n, 3)), helix=helices, cov=cov,
        mass=np.full(n, MUON), radius=radius, share=np.zeros(n), target_share=0.0,
    )  # fmt: skip


def on(core, start, radius):
    """Take what `go` returned to another cylinder."""
    return go(core, radius, start["helix"], start["cov"], start["pivot"])


def assert_close(found, expected, place=1e-9, parameters=1e-9, cov=1e-8):
    """Compare points in mm, helices with SIGMA = 1 and covariances by their diagonal."""
    assert np.all(found["status"] == StateStatus.ok)
    np.testing.assert_allclose(found["pivot"], expected["pivot"], rtol=0, atol=place)
    difference = found["helix"] - expected["helix"]
    difference[:, 1] = np.remainder(difference[:, 1] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(difference / SIGMA).max() < parameters
    sigma = np.sqrt(np.diagonal(expected["cov"], axis1=1, axis2=2))
    assert np.abs((found["cov"] - expected["cov"]) / (sigma[:, :, None] * sigma[:, None, :])).max() < cov


@pytest.mark.usefixtures("equal_weights")
@pytest.mark.parametrize("matter", [False, True])
@pytest.mark.parametrize("radius", EVERY_RADIUS)
def test_extrapolation_in_a_constant_map_is_that_of_the_uniform_field(radius, matter):
    """Outward and back in, through all matter or none."""
    uniform, constant = (tuned(d) if matter else without_matter(d) for d in (UNIFORM, EVEN))
    expected, found = go(uniform, radius), go(constant, radius)
    assert_close(found, expected, parameters=1e-8)
    assert_close(on(constant, found, 25.0), on(uniform, expected, 25.0), parameters=1e-8)


def fitted_states(core, detector, surfaces, offset=0.0):
    """Return smoothed states of tracks about HELICES whose hits lie `offset` sigma beside them, in turn."""
    hits = [hits_on(detector, helix) for helix in HELICES]
    columns = {name: np.concatenate([one[name] for one in hits]) for name in hits[0]}
    predicted = [
        _core._testing.reference(core, helix, MUON, one)["predicted"] for helix, one in zip(HELICES, hits, strict=True)
    ]
    beside = np.concatenate([np.cos(np.arange(len(one))) for one in predicted])
    reference = HELICES + np.array([0, np.pi / 2, 0, 0, 0])
    return _core.reconstruction.states(
        core, hit_offsets=np.cumsum([0, *map(len, predicted)]),
        hits=columns | {
            "used": np.ones(len(beside), np.uint8), "used_variance": columns["sigma"] ** 2,
            "used_value": np.concatenate(predicted) + offset * columns["sigma"] * beside,
        },
        reference=reference, prior=np.tile(np.diag([200.0, 0.5, 5.0, 1000.0, 2.0]).ravel() ** 2, (len(HELICES), 1)),
        kinks=np.zeros((len(HELICES), 2 * len(slabs(detector)))),
        mass=np.full(len(HELICES), MUON), fitted=np.ones(len(HELICES), np.uint8),
        targets={
            "surface": np.array([surface for surface, _ in surfaces], np.int8),
            "radius": np.array([radius for _, radius in surfaces]), "share": np.zeros(len(surfaces)),
        },
    )  # fmt: skip


SURFACES = [(0, 0.0), (1, 0.0), *((CYLINDER, radius) for radius in (*EVERY_RADIUS, 800.0)), (int(Surface.hit), 0.0)]


@pytest.mark.parametrize("density", [0.0, 1.0])
def test_states_in_a_constant_map_are_those_of_the_uniform_field(density):
    """Of the same fit, at the origin, on every cylinder and at every hit, with residuals.

    With matter, a displaced track loses its momentum after the same path in one, on the same cylinder in the other.
    """
    expected, found = (
        fitted_states(without_matter(detector, density), UNIFORM, SURFACES, offset=0.5) for detector in (UNIFORM, EVEN)
    )
    assert np.abs(expected["residual"][expected["hit"] >= 0]).max() > 0.05
    exact = density == 0
    assert_close(found, expected, *((1e-9, 1e-8, 1e-8) if exact else (1e-4, 1e-3, 1e-3)))
    for name in ("residual", "err"):
        np.testing.assert_allclose(found[name], expected[name], rtol=0, atol=1e-8 if exact else 1e-4)


@pytest.mark.parametrize("detector", [UNEVEN, COIL], ids=["harmonic", "solenoid"])
def test_there_and_back(detector):
    """Without matter, a state that went out and came back is what it was."""
    core = without_matter(detector)
    for outer in (424.0, 790.0):
        start = go(core, 31.5)
        assert_close(on(core, on(core, start, outer), 31.5), start, 1e-7, 1e-7, 1e-7)


@pytest.mark.parametrize("detector", [UNEVEN, COIL], ids=["harmonic", "solenoid"])
def test_in_vacuum_all_surfaces_have_one_track(detector):
    """Smoothed states, by derivatives from the origin, are the state at the origin moved there."""
    core = without_matter(detector)
    states = fitted_states(core, detector, SURFACES)
    at = {surface: {name: states[name][states["target"] == i] for name in states} for i, surface in enumerate(SURFACES)}
    origin = at[0, 0.0]
    assert_close(on(core, at[1, 0.0], 100.0), on(core, origin, 100.0), 1e-7, 1e-7, 1e-7)
    for radius in (*EVERY_RADIUS, 800.0):
        assert_close(at[CYLINDER, radius], on(core, origin, radius), 1e-7, 1e-7, 1e-7)
    hits = at[int(Surface.hit), 0.0]
    outward = on(core, hits, 800.0)
    expected = on(core, {name: origin[name][hits["track"]] for name in origin}, 800.0)
    assert_close(outward, expected, 1e-6, 1e-6, 1e-6)


def integrated(parameters, end, radius):
    """Helix of a track by scipy: where it leaves a cylinder, or closest to the axis through `end` if there is one."""
    dr, phi0, kappa, dz, tanl = parameters
    start = [dr * np.cos(phi0), dr * np.sin(phi0), dz, *(np.array([-np.sin(phi0), np.cos(phi0), tanl]) / abs(kappa))]
    total = np.linalg.norm(start[3:])

    def motion(_, s):
        force = LIGHT * np.sign(kappa) * np.cross(s[3:] / total, harmonic_by_hand(*s[:3], **FALLING))
        return np.concatenate([s[3:] / total, force])

    def arrived(path, s):
        if end is None:
            return s[0] ** 2 + s[1] ** 2 - radius**2
        return (s[0] - end[0]) * s[3] + (s[1] - end[1]) * s[4] if path > 0.9 * radius else -1.0

    arrived.terminal, arrived.direction = True, 1
    events = solve_ivp(motion, (0, 3 * radius), start, "DOP853", rtol=1e-12, atol=1e-12, events=arrived, max_step=50)
    x, y, z, px, py, pz = events.y_events[0][0]
    pivot, pt = np.array([x, y, z]) if end is None else end, np.hypot(px, py)
    azimuth = np.arctan2(-px, py)
    across = (x - pivot[0]) * np.cos(azimuth) + (y - pivot[1]) * np.sin(azimuth)
    return pivot, np.array([across, azimuth, np.sign(kappa) / pt, z - pivot[2], pz / pt])


@pytest.mark.parametrize("number", range(len(HELICES)))
@pytest.mark.parametrize("radius", [100.0, 424.0])
def test_jacobian_by_numerical_differentiation(number, radius):
    """Point, helix and covariance are those of tracks that scipy integrates, the covariance by their differences."""
    helix, cov = HELICES[number : number + 1], covariances(1, seed=number)
    found = go(without_matter(UNEVEN), radius, helix, cov)
    end, expected = integrated(helix[0], None, radius)
    columns = []
    for i, step in enumerate(0.02 * SIGMA):
        ahead, behind = (integrated(helix[0] + sign * step * np.eye(5)[i], end, radius)[1] for sign in (1, -1))
        columns.append((ahead - behind) / (2 * step))
    jacobian = np.stack(columns, axis=1)
    truth = {"pivot": end[None], "helix": expected[None], "cov": (jacobian @ cov[0] @ jacobian.T)[None]}
    assert_close(found, truth, 1e-7, 1e-6, 1e-6)
    # The uniform field's Jacobian would not do.
    even = go(without_matter(UNEVEN.with_overrides({"field.kind": "uniform"})), radius, helix, cov)["cov"][0]
    assert np.abs(even / truth["cov"][0] - 1).max() > 1e-3


def test_a_way_out_of_the_map_has_its_status(tmp_path):
    """Beyond the edge there is no state; below the closest approach there is none either, for another reason."""
    detector = UNIFORM.with_field(small_map(tmp_path))
    settings = cg.Settings(fit=cg.FitSettings(states=("origin", 10.0, "beam_pipe", 300.0, 600.0, "hits")))
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.3, 0.3), vertex=(0.0, 15.0, 0.0))
    result = cg.run(detector, gun, 20, seed=2, settings=settings)
    assert np.all(result.tracks["status"] == FitStatus.ok)
    states = result.states
    at = states["surface"] == Surface.cylinder
    inside = at & (states["r"] == 10.0)
    outside = at & (states["r"] == 600.0)
    assert {*states["status"][inside]} == {StateStatus.ok, StateStatus.does_not_reach}
    assert np.all(states["status"][outside] == StateStatus.left_field)
    assert np.all(states["status"][~inside & ~outside] == StateStatus.ok)
    assert np.isnan(states["x"][outside]).all()
    start = states[at & (states["r"] == 300.0)]
    assert np.all(cg.extrapolate(detector, start, 501.0)["status"] == StateStatus.left_field)
    assert np.all(cg.extrapolate(detector, start, 499.0)["status"] == StateStatus.ok)
    assert {*cg.extrapolate(detector, start, 10.0)["status"]} == {StateStatus.ok, StateStatus.does_not_reach}
    # One that begins outside.
    beyond = cg.extrapolate(detector.with_field(HARMONIC), start, 600.0)
    assert np.all(cg.extrapolate(detector, beyond, 300.0)["status"] == StateStatus.left_field)
    # The map ends in z, too.
    steep = start.with_columns(tanl=np.full(len(start), 20.0))
    assert np.all(cg.extrapolate(detector, steep, 499.0)["status"] == StateStatus.left_field)


@pytest.mark.parametrize("field", [HARMONIC, "finite-solenoid"])
def test_states_of_a_run_hold_together(field):
    """Points on their cylinders, positive definite covariances, and pulls of hits as in the residuals table."""
    radii = (10.0, 50.0, 250.0, 500.0, 900.0)
    settings = cg.Settings(
        fit=cg.FitSettings(states=("origin", "beam_line", *radii, "hits"), residuals=True, tolerance=CLOSE)
    )
    gun = cg.Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.8, 0.8), vertex_sigma=(1.0, 1.0, 5.0))
    result = cg.run(UNIFORM.with_field(field), gun, 30, seed=5, settings=settings)
    states = result.states
    good = states[states["status"] == StateStatus.ok]
    assert len(good) > 0.95 * len(states)
    cylinders = good[good["surface"] == Surface.cylinder]
    np.testing.assert_allclose(np.hypot(cylinders["x"], cylinders["y"]), cylinders["r"])
    sigma = np.sqrt(np.diagonal(good["cov"], axis1=1, axis2=2))
    assert np.linalg.eigvalsh(good["cov"] / (sigma[:, :, None] * sigma[:, None, :])).min() > 1e-4
    origin = states[states["surface"] == Surface.origin]
    # The fit passes wires on spans, where the states stop at each of them.
    errors = np.sqrt(np.diagonal(origin["cov"], axis1=1, axis2=2))
    for k, name in enumerate(("dr", "phi0", "kappa", "dz", "tanl")):
        if name != "phi0":
            assert np.abs((origin[name] - result.tracks[name]) / errors[:, k]).max() < 5e-4
    hits = states[(states["surface"] == Surface.hit) & (states["status"] == StateStatus.ok)]
    rows = result.residuals
    keys = (np.stack([table[name] for name in ("track", "view", "hit")], axis=1) for table in (hits, rows))
    np.testing.assert_array_equal(*keys)
    np.testing.assert_allclose(hits["pull"], rows["pull"], rtol=0, atol=2e-4)
