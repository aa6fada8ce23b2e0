"""Tracks scatter by the angles of single scattering or, with Gaussian fluctuations, by the core that the fit takes."""

import math

import numpy as np
import pytest
from scipy import stats as distributions

from cgemit import _core
from coulomb import core_angle, exact_quantiles
from slabs import BERYLLIUM, COPPER, KAPTON, MUON, PROTON, slab_detector
from stats import assert_within
from tracks import particles, transport

N = 40_000
SLAB, GAP = 50.0, 150.0  # mm, radii of scatterer and of the layer that sees the track


def shoot(parts, p, tanl, fluctuations, seed=1, n=N, pdg=13):
    """Send n particles along phi = 0.3 through slabs without field; return plane angles and offsets at the layer.

    Both are components on axis 1, horizontal and across the flight, and axis 2, across both.
    """
    flight = np.array([math.cos(0.3), math.sin(0.3), tanl]) / math.hypot(1, tanl)
    core = slab_detector(parts, gap_radius=GAP)
    out = transport(core, particles(np.zeros((n, 3)), p * flight, pdg), fluctuations, seed)["truths"]
    assert len(out["r"]) == n
    axes = np.array([[-math.sin(0.3), math.cos(0.3), 0], [0, 0, 0]])
    axes[1] = np.cross(flight, axes[0])
    momentum = np.stack([out["px"], out["py"], out["pz"]], axis=1)
    along = momentum @ flight
    position = np.stack([out["r"] * np.cos(out["phi"]), out["r"] * np.sin(out["phi"]), out["z"]], axis=1)
    # Back along each track to the plane across the undisturbed flight.
    ahead = GAP * math.hypot(1, tanl)
    position = position + ((ahead - position @ flight) / along)[:, None] * momentum
    return momentum @ axes.T / along[:, None], position @ axes.T


def along(parts, tanl):
    """Return matter and thickness along the flight."""
    return [(matter, thickness * math.hypot(1, tanl)) for matter, thickness, _ in parts]


@pytest.mark.parametrize("tanl", [0.0, 1.3, -2.0])
@pytest.mark.parametrize("p", [0.5, 2.0])
def test_gaussian_width_in_both_planes(p, tanl):
    """Both plane angles are Gaussian with the core's width for the oblique path, independent of each other."""
    parts = [(BERYLLIUM, 1.0, SLAB)]
    angles, _ = shoot(parts, p, tanl, "gaussian")
    expected = core_angle(along(parts, tanl), p, MUON)
    # The momentum half-way through the loss: up to 0.3 MeV lower.
    allowed = 1e-3 * expected if p > 1 else 2e-3 * expected
    error = math.hypot(expected / math.sqrt(2 * N), allowed / 4)
    assert_within(angles.std(axis=0), expected, error, what="width")
    assert_within(angles.mean(axis=0), 0.0, expected / math.sqrt(N), what="mean")
    assert_within(np.mean(angles[:, 0] * angles[:, 1]) / expected**2, 0.0, 1 / math.sqrt(N), what="correlation")
    for plane in (angles / angles.std(axis=0)).T:
        assert distributions.kstest(plane, "norm").pvalue > 6e-5
    # The gate sees an angle times sqrt(2), and a path without the obliquity.
    for wrong in (math.sqrt(2), 1 / math.hypot(1, 1.3) ** 0.5):
        with pytest.raises(AssertionError, match="standard errors"):
            assert_within(angles.std(axis=0), wrong * expected, error)


@pytest.mark.parametrize("tanl", [0.0, 1.3, -2.0])
@pytest.mark.parametrize("p", [0.5, 2.0])
def test_full_widths_in_both_planes(p, tanl):
    """In either plane the angles are those of single scattering on the oblique path, independent in the core."""
    parts = [(BERYLLIUM, 1.0, SLAB)]
    angles, _ = shoot(parts, p, tanl, "full")
    elements = BERYLLIUM.moles(1.0 * math.hypot(1, tanl))
    expected = exact_quantiles(elements, p, MUON, "wentzel", [0.6827, 0.98])
    for plane in range(2):
        found = np.quantile(np.abs(angles[:, plane]), [0.6827, 0.98])
        # 1 % for the loss on the way, the model and the error of a quantile: 0.5 % and 0.9 %.
        assert found == pytest.approx(expected, rel=0.03)
        assert found[0] == pytest.approx(expected[0], rel=0.02)
    inside = angles[np.all(np.abs(angles) < 3 * expected[0], axis=1)]
    assert_within(np.corrcoef(inside.T)[0, 1], 0.0, 1 / math.sqrt(len(inside)), what="correlation")
    # The gate sees the widths of the other screening, and planes that share a twentieth of their variance.
    assert found[0] != pytest.approx(exact_quantiles(elements, p, MUON, "moliere", [0.6827])[0], rel=0.02)
    shared = inside @ np.linalg.cholesky([[1, 0.05], [0.05, 1]]).T
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(np.corrcoef(shared.T)[0, 1], 0.0, 1 / math.sqrt(len(shared)))


@pytest.mark.parametrize("fluctuations", ["full", "gaussian"])
@pytest.mark.parametrize("tanl", [0.0, 1.0])
def test_displacement_of_a_thick_scatterer(tanl, fluctuations):
    """Behind 10 mm: displacement path theta/sqrt(3), correlation with the angle sqrt(3)/2 (PDG 2024, sec. 34.3)."""
    parts, p = [(KAPTON, 10.0, SLAB)], 1.0
    angles, offsets = shoot(parts, p, tanl, fluctuations)
    stretch = math.hypot(1, tanl)
    # Offset where the track leaves the matter: the layer's minus the lever arm from there.
    lever = (GAP - SLAB - 5.0) * stretch
    at_exit = offsets - lever * angles
    path = 10.0 * stretch
    # A few hard scatters would rule second moments: the core of the angles alone.
    inside = np.all(np.abs(angles) < 3.5 * np.quantile(np.abs(angles), 0.6827), axis=1)
    for plane in range(2):
        angle, offset = angles[inside, plane], at_exit[inside, plane]
        n, width = len(angle), angle.std()
        # Scatters happen half-way on average, whatever the angle; about that the offset spreads by path/sqrt(12).
        slope = angle @ offset / (angle @ angle)
        assert_within(slope, path / 2, path / math.sqrt(12) / math.sqrt(n), what="slope")
        rest = offset - slope * angle
        rest = rest[np.abs(rest) < 3.5 * path * width / math.sqrt(12)]
        # A cut on angles keeps tracks whose hard scatters happen to cancel, and not those that add up: 3 %.
        error = math.hypot(1 / math.sqrt(2 * n), 0.03 / 4 if fluctuations == "full" else 0)
        assert_within(rest.std() / (path * width / math.sqrt(12)), 1.0, error, what="spread about it")
        assert_within(np.corrcoef(angle, offset)[0, 1], math.sqrt(3) / 2, 0.5 * error, what="correlation")
        with pytest.raises(AssertionError, match="standard errors"):  # all at the entrance
            assert_within(slope, path, path / math.sqrt(12) / math.sqrt(n))


@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_cutting_changes_nothing(pieces):
    """Cut into neighbouring slabs the same matter gives the same widths of angle and offset."""
    whole = [(KAPTON, 2.0, SLAB)]
    cut = [(KAPTON, 2.0 / pieces, SLAB - 1.0 + 2.0 * (i + 0.5) / pieces) for i in range(pieces)]
    n = N // 4
    once, many = shoot(whole, 2.0, 0.4, "gaussian", 1, n), shoot(cut, 2.0, 0.4, "gaussian", 2, n)
    for a, b, what in zip(once, many, ("angle", "offset"), strict=True):
        assert_within(b.std(axis=0) / a.std(axis=0), 1.0, 1 / math.sqrt(n), what=what)
    # The formula for each piece alone would be seen.
    alone = math.sqrt(pieces) * core_angle(along(cut[:1], 0.4), 2.0, MUON)
    if pieces > 2:
        with pytest.raises(AssertionError, match="standard errors"):
            assert_within(many[0].std(axis=0) / alone, 1.0, 1 / math.sqrt(2 * n))


def test_no_fluctuations_no_scattering():
    """With fluctuations off every particle goes the same straight way."""
    angles, offsets = shoot([(KAPTON, 2.0, SLAB)], 0.5, 0.4, "off", n=50)
    np.testing.assert_allclose(angles, 0, atol=1e-12)
    np.testing.assert_allclose(offsets, 0, atol=1e-10)


def test_heavy_and_slow_scatter_more():
    """Widths go as 1/(p beta): a 0.6 GeV/c proton scatters as its beta says, not as 1/p."""
    parts = [(BERYLLIUM, 0.3, SLAB)]
    angles, _ = shoot(parts, 0.6, 0.0, "gaussian", pdg=2212)
    # The loss in 0.3 mm, 0.2 MeV, lowers p by 0.2/beta MeV; half of that counts.
    expected = core_angle(along(parts, 0), 0.6 - 0.0002, PROTON)
    assert_within(angles.std(axis=0), expected, expected / math.sqrt(2 * N))
    assert expected > 1.5 * core_angle(along(parts, 0), 0.6, MUON)


def test_angle_of_a_particle_depends_on_its_own_stream_only():
    """The same particles in another order, or fewer of them, scatter as before."""
    core = slab_detector([(BERYLLIUM, 1.0, SLAB)], gap_radius=GAP)
    table = particles(np.zeros((20, 3)), np.array([1.0, 0, 0.2]))
    everyone = transport(core, table, "full")["truths"]
    some = transport(core, table[np.array([3, 7, 11])], "full")["truths"]
    for name in ("phi", "z", "px", "energy"):
        np.testing.assert_array_equal(some[name], everyone[name][[3, 7, 11]])
    other = transport(core, table, "full", seed=2)["truths"]
    assert not np.any(other["phi"] == everyone["phi"])
    assert _core.common.Purpose.scattering != _core.common.Purpose.energy_loss


def test_a_slab_crossed_twice_scatters_anew():
    """In and out again through the same matter: the angles add in quadrature, they are not the same one twice."""
    core = slab_detector([(COPPER, 0.5, SLAB)], gap_radius=GAP)
    width = {}
    for start in (0.0, -100.0):
        table = particles(np.tile([start, 0.0, 0.0], (N, 1)), np.array([1.0, 0, 0]))
        out = transport(core, table, "full")["truths"]
        angle = np.arctan2(out["py"], out["px"])
        width[start] = np.quantile(np.abs(angle), 0.6827)
    # Highland's logarithm (PDG 2024 eq. 34.16) of twice the matter, 0.5 mm being 3.48 % of a radiation length.
    expected = math.sqrt(2) * (1 + 0.038 * math.log(2 * 0.0348)) / (1 + 0.038 * math.log(0.0348))
    error = math.sqrt(2) * expected / math.sqrt(2 * N)
    assert_within(width[-100.0] / width[0.0], expected, error, what="ratio")
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(2.0, expected, error)
