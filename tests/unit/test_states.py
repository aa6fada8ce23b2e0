"""States of fitted tracks agree with the fit itself, with each other, and with exact motion where nothing scatters."""

import dataclasses
import re

import numpy as np
import pytest

import cgemit as cg
from cgemit import helix
from cgemit.chain.settings import Settings
from cgemit.cli.main import main
from cgemit.detector import compiled, load, slabs
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import PARAMETERS, FitSettings, FitStatus
from cgemit.reconstruction.states import StateStatus, Surface, extrapolate
from cgemit.tables import Table
from exact import EXACT
from tracks import on_helix, transport

DETECTOR = load("besiii-cgem-design")
PIPE = slabs(DETECTOR)[0]
WALL = next(slab for slab in slabs(DETECTOR) if slab.shells[0].group == "wall")
PLACES = ("origin", "beam_line", 10.0, "beam_pipe", 50.0, 250.0, 500.0, "hits", 1000.0)


def states_of(surfaces, gun=None, n=40, **changes):
    """Return the result of a run in which everything is Gaussian, and its states."""
    settings = dataclasses.replace(EXACT, fit=FitSettings(states=surfaces, residuals=True, **changes))
    gun = gun or Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.6, 0.6), vertex_sigma=(1.0, 1.0, 5.0))
    result = cg.run(DETECTOR, gun, n, seed=5, settings=settings)
    return result, result.states


@pytest.fixture(scope="module")
def run():
    """Return 40 muons with states everywhere."""
    return states_of(PLACES)


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
        # The fit's derivatives are those about its last reference, a fraction of a standard deviation away.
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
    out = transport(compiled(DETECTOR), on_helix(start))["truths"]
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
    settings = dataclasses.replace(result.settings, fit=FitSettings())
    bare = cg.run(DETECTOR, result.gun, 40, seed=5, settings=settings)
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
    for text in ("'vertex'", "-1.0", "nan", "True", "hypothesis: got 'tau'", r"'pi'\)"):
        assert re.search(f"{text}, expected", str(caught.value))
    with pytest.raises(ValueError, match="expected a list, each a positive radius"):
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
