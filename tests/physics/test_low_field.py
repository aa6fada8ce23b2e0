"""Tracks in no field and in fields that hardly bend them: pulls, expected widths, and a straight line by numpy."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import slabs, write_field_map
from cgemit.fit_matter import tuned
from cgemit.reconstruction.vertex import begin_at_vertices
from stats import assert_within

FitStatus = cg.FitStatus
MUON = 0.1056583755  # GeV/c2
QUANTITIES = ("dr", "phi0", "dz", "tanl")

# Points across the beam and along it in thin sensors of silicon, behind a pipe.
RADII = np.array([40.0, 60.0, 90.0, 130.0, 180.0, 240.0])
SIGMA = 0.02  # mm
TELESCOPE = {
    "name": "barrel of points",
    "field": {"bz": "0 T"},
    "base": "besiii-pixel",
    "remove": ["cgem", "walls", "drift_chamber", "layer.PIX"],
    "layer": {
        f"S{i}": {"radius": f"{r} mm", "length": "2 m", "sigma": f"{SIGMA} mm", "thickness": "0.3 mm", "material": "Si"}
        for i, r in enumerate(RADII)
    },
}


@cache
def in_field(name: str, bz: float) -> cg.Detector:
    return cg.load(name).with_overrides({"field.bz": f"{bz} T"})


def gaussian() -> cg.Settings:
    """Return settings of a simulation that the fit and the expectation describe: without tails."""
    return cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian", deltas=False))


@cache
def simulated(name: str, bz: float, n: int, finder: str = "truth", p: float = 1.0) -> cg.Result:
    gun = cg.Gun("mu-", p=p, cos_theta=(-0.5, 0.5))
    return cg.run(in_field(name, bz), gun, n=n, seed=7, settings=gaussian(), readout="gaussian", finder=finder)


def check(result: cg.Result, n: int) -> None:
    """Fail unless all tracks are fitted, with pulls of width 1 and the expected widths."""
    tracks = result.tracks
    fitted = np.isin(tracks["status"], (FitStatus.ok, FitStatus.unconstrained))
    assert len(tracks) == n
    assert fitted.all(), result.removed()
    bad = tracks["err_p"] > 0.5 * tracks["p"]
    assert (tracks["status"][bad] == FitStatus.unconstrained).all()
    expected = cg.analytic(result.detector, "mu-", p=1.0, cos_theta=(-0.5, 0.5), readout="gaussian")
    pulls = cg.study.pulls(result)
    for name in QUANTITIES:
        pull, width = pulls[name], cg.resolution(result, name if name != "tanl" else "theta")
        assert pull.n == n
        # 0.05 and 0.03 at most; four errors must fit into them with the large samples
        assert_within(pull.core, 1.0, max(pull.core_error, 0.05 / 4), what=f"pull of {name}")
        assert_within(
            width.core / expected.sigma(width.parameter).item(), 1.0,
            max(width.core_error / width.core, 0.03 / 4), what=f"width of {name}",
        )  # fmt: skip
    for name in ("kappa", "p"):
        left_out = int(np.count_nonzero(tracks["status"] == FitStatus.unconstrained))
        assert dict(pulls[name].removed).get("unconstrained", 0) == left_out
        assert pulls[name].n == n - left_out


FIELDS = (0.0, 0.001, 0.003, 0.01, 0.1)


@pytest.mark.parametrize("bz", [0.0, 0.001, 0.01])
def test_tracks_in_low_fields(bz):
    check(simulated("besiii-cgem", bz, 300), 300)


@pytest.mark.slow
@pytest.mark.parametrize("bz", FIELDS)
@pytest.mark.parametrize("name", ["besiii-cgem", "cepc-like"])
def test_many_tracks_in_low_fields(name, bz):
    check(simulated(name, bz, 6000), 6000)


def line_fit(detector: cg.Detector, p: float) -> tuple[np.ndarray, np.ndarray]:
    """Return design matrix and weight of a straight line through the sensors across the beam, in numpy alone.

    Intercept and slope at the origin; each scatter moves the points beyond by its angle times the distance. The angles
    are those of the matter's own model, everything else is independent of the fit.
    """
    core = tuned(detector)
    total = _core.matter.total_matter(core, 0.0)[2]
    cov = np.diag(np.full(len(RADII), SIGMA**2))
    for number, slab in enumerate(slabs(detector)):
        angle = _core.matter.scattering_angle(core, number, path=1.0, p=p, mass=MUON, charge=-1, track_chi_c2=total)
        beyond = np.maximum(RADII - slab.radius, 0.0)
        cov += angle**2 * np.outer(beyond, beyond)
    return np.stack([np.ones(len(RADII)), RADII], axis=1), np.linalg.inv(cov)


def test_the_expected_covariance_is_that_of_a_straight_line():
    """Of d_rho and phi0, without a field; a field that bends the track frees the curvature and widens them."""
    detector, p = cg.load(TELESCOPE), 0.5
    design, weight = line_fit(detector, p)
    expected = np.linalg.inv(design.T @ weight @ design)
    found = cg.analytic(detector, "mu-", p=p, cos_theta=0.0, phi=0.1).cov[:2, :2]
    scale = np.sqrt(np.diag(expected))
    signs = np.outer([1, -1], [1, -1])  # d_rho is positive to the right of the flight
    np.testing.assert_allclose(found * signs / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-3)
    free = cg.analytic(detector.with_overrides({"field.bz": "1 mT"}), "mu-", p=p, cos_theta=0.0, phi=0.1)
    assert free.sigma("dr").item() > 1.05 * 1e3 * scale[0]


def test_the_fit_is_that_of_a_straight_line():
    """Track by track: closest approach and azimuth from the same points by generalised least squares in numpy."""
    detector, p = cg.load(TELESCOPE), 0.5
    fit = cg.FitSettings(tolerance=1e-3, outlier_pull=0)
    simulate = cg.SimulateSettings(fluctuations="gaussian", deltas=False)
    settings = cg.Settings(fit=fit, simulate=simulate)
    result = cg.run(detector, cg.Gun("mu-", p=p, cos_theta=0.0), n=100, seed=3, settings=settings)
    design, weight = line_fit(detector, p)
    gain = np.linalg.solve(design.T @ weight @ design, design.T @ weight)
    points = result.clusters[result.clusters["view"] == 0]
    phi = np.stack([points["phi"][points["layer"] == i] for i in range(len(RADII))], axis=1)
    flight = phi[:, -1:]  # a direction close to that of the track
    aside, along = RADII * np.sin(phi - flight), RADII * np.cos(phi - flight)
    intercept, slope = gain @ (aside + (RADII - along) * (aside[:, -1:] / RADII[-1])).T
    tracks = result.tracks
    turned = np.remainder(tracks["phi0"] + 0.5 * np.pi - flight[:, 0] - np.arctan(slope) + np.pi, 2 * np.pi) - np.pi
    assert np.abs((tracks["dr"] + intercept * np.cos(slope)) / tracks["err_dr"]).max() < 0.02
    assert np.abs(turned / tracks["err_phi0"]).max() < 0.02
    assert (tracks["ndf"] == 2 * len(RADII) - 4).all()


def test_momentum_and_charge_are_not_measured_without_a_field():
    """They are those of the given momentum, the gun's or that of the settings, and the status says so."""
    detector = cg.load(TELESCOPE)
    gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.5, 0.5))
    guns = cg.run(detector, gun, n=20, seed=3)
    own = cg.run(detector, gun, n=20, seed=3, settings=cg.Settings(fit=cg.FitSettings(momentum=2.0)))
    for result, p in ((guns, 0.5), (own, 2.0)):
        tracks = result.tracks
        assert (tracks["status"] == FitStatus.unconstrained).all()
        np.testing.assert_allclose(tracks["p"], p, rtol=1e-6)
        assert (tracks["kappa"] > 0).all()
        assert np.all(tracks["err_kappa"] > 4)
        assert result.fitted.meta["momentum"] == p
    assert np.all(own.tracks["err_dr"] < 0.9 * guns.tracks["err_dr"])
    table = cg.fit(detector, guns.clusters, guns.wire_hits, guns.candidates, guns.candidate_hits)["tracks"]
    np.testing.assert_allclose(table["p"], 1.0, rtol=1e-6)  # without a gun


def test_the_expectation_says_that_momenta_are_not_measured():
    found = cg.analytic(in_field("besiii-cgem", 0.0), "mu-", p=[0.5, 1.0])
    assert (found.status == FitStatus.unconstrained).all()
    assert np.isnan(found.sigma("p")).all()
    assert np.isfinite(found.sigma("dr")).all()
    assert "unconstrained" in repr(found)
    assert (cg.analytic(in_field("besiii-cgem", 0.1), "mu-", p=[0.5, 1.0]).status == FitStatus.ok).all()


@pytest.mark.parametrize("bz", [0.0, 0.001, 0.01, 0.03])
def test_the_finder_in_low_fields(bz):
    """It finds every track, with all but a few of its hits, and nothing else."""
    result = simulated("besiii-cgem", bz, 100, "ckf")
    assert len(result.tracks) == 100
    assert result.matches["purity"].min() > 0.99
    assert np.median(result.matches["efficiency"]) > 0.98


def test_states_scatter_with_the_given_momentum():
    """Extrapolated outward, the errors grow as for a track of this momentum in 1 T."""
    settings = cg.Settings(fit=cg.FitSettings(states=("origin", "hits")))
    errors = {}
    for bz in (0.0, 0.002, 1.0):
        gun = cg.Gun("mu-", p=0.3, cos_theta=0.0)
        result = cg.run(in_field("besiii-cgem", bz), gun, n=20, seed=3, settings=settings)
        assert (result.states["status"] == 0).all()
        out = cg.extrapolate(result.detector, result.fitted, 60.0)
        assert (out["status"] == 0).all()
        start = result.fitted["cov"][:, 1, 1]
        errors[bz] = np.median(out["cov"][:, 1, 1] - start) if bz == 0 else 0.0
    pipe = tuned(in_field("besiii-cgem", 0.0))
    total = _core.matter.total_matter(pipe, 0.0)[2]
    angle = _core.matter.scattering_angle(pipe, 0, path=1.0, p=0.3, mass=MUON, charge=-1, track_chi_c2=total)
    assert errors[0.0] == pytest.approx(angle**2, rel=0.05)


def test_halves_of_cosmic_muons_without_a_field():
    """They agree within their errors; momenta are left out."""
    result = cg.run(in_field("besiii-cgem", 0.0), cg.sample("cosmic", p=1.0), n=400, seed=3)
    found = cg.study.cosmics(result)
    assert found.events > 200
    for name in QUANTITIES:
        assert_within(found.pulls[name].core, 1.0, found.pulls[name].core_error, what=name)
    assert found.pulls["kappa"].n == 0
    assert found.halves["p"].removed == (("unconstrained", found.events),)


def test_vertices_without_a_field_have_no_mass():
    """Pairs that are given have a vertex; pairs by charge are refused with words."""
    gun = cg.Gun("pi+", p=1.0, cos_theta=0.0, phi=0.3) + cg.Gun("pi-", p=1.0, cos_theta=0.2, phi=1.5)
    result = cg.run(in_field("besiii-cgem", 0.0), gun, n=50, seed=3)
    with pytest.raises(ValueError, match=r"no track measures its charge \(100 tracks of status unconstrained\)"):
        cg.fit_vertices(result.detector, result.fitted)
    found = cg.fit_vertices(result.detector, result.fitted, np.arange(100).reshape(50, 2))
    assert (found["status"] == 0).all()
    assert np.isnan(found["mass"]).all()
    pulls = found["x"] / found["err_x"]
    assert 0.7 < np.std(pulls) < 1.4
    again = begin_at_vertices(result.detector, result.candidates, result.fitted, found)
    assert (again["start_radius"] != 0).all()


def test_particles_without_a_field_fly_outward_behind_the_closest_point():
    """Along (-sin phi0, cos phi0): from (0, 20) the particle has left the beam line, from (0, -20) it comes to it."""
    track = np.tile([0.0, 0.0, -1.0, 0.0, 0.5], (2, 1))
    points = np.array([[0.0, 20.0, 10.0], [0.0, -20.0, -10.0]])
    np.testing.assert_allclose(cg.helix.start_radius(track, points, bz=0.0), [20.0, -20.0])
    np.testing.assert_allclose(cg.helix.start_radius(track, points, bz=-1e-4), [20.0, -20.0], rtol=1e-6)


def test_maps_that_vanish(tmp_path):
    """A map of zeros, or scaled to 0, is no field; one that is 0 at the origin alone is refused."""
    r, z = np.linspace(0, 900, 10), np.linspace(-2000, 2000, 21)
    shape = np.ones((10, 21))

    def written(name, bz):
        return write_field_map(tmp_path / f"{name}.npz", {"r": r, "z": z, "br": np.zeros((10, 21)), "bz": bz})

    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    straight = cg.run(in_field("besiii-cgem", 0.0), gun, n=30, seed=3).tracks
    zero = cg.load("besiii-cgem").with_field(written("zero", 0 * shape))
    scaled = cg.load("besiii-cgem").with_field({"kind": "map", "file": str(written("one", -shape)), "bz": "0 T"})
    weak = cg.load("besiii-cgem").with_field(written("weak", 3e-5 * shape))
    for detector in (zero, scaled, weak):
        tracks = cg.run(detector, gun, n=30, seed=3).tracks
        assert (tracks["status"] == FitStatus.unconstrained).all()
        assert np.abs((tracks["dr"] - straight["dr"]) / straight["err_dr"]).max() < 0.1
    ramp = np.broadcast_to(1e-3 * np.abs(z), (10, 21))
    with pytest.raises(cg.DetectorError, match="at the origin of a map of up to"):
        cg.load("besiii-cgem").with_field(written("hole", np.maximum(ramp - 0.3, 0)))
    with pytest.raises(cg.DetectorError, match="none: the map is 0 T at the origin"):
        cg.load("besiii-cgem").with_field({"kind": "map", "file": str(written("none", 0 * shape)), "bz": "1 T"})
