"""Scattering angles and energy losses are the PDG's, and do not depend on how matter is cut."""

import math

import numpy as np
import pytest

from cgemit import _core
from cgemit.detector import compiled, load, slab_table
from cgemit.detector.readout import cgem_table, wire_table
from slabs import BERYLLIUM, COPPER, ELECTRON, KAPTON, MUON, PION, PROTON, bethe, highland, slab_detector
from tracks import hits_on

PASSAGES = [
    pytest.param(BERYLLIUM, 1.4, 1.0, MUON, id="1 GeV/c muon, 1.4 mm Be"),
    pytest.param(COPPER, 0.014, 1.0, MUON, id="1 GeV/c muon, 14 um Cu"),
    pytest.param(KAPTON, 0.3, 1.0, MUON, id="1 GeV/c muon, 0.3 mm Kapton"),
    pytest.param(BERYLLIUM, 1.4, 0.15, MUON, id="0.15 GeV/c muon, 1.4 mm Be"),
    pytest.param(KAPTON, 0.3, 0.2, PION, id="0.2 GeV/c pion, 0.3 mm Kapton"),
    pytest.param(COPPER, 0.014, 0.5, PROTON, id="0.5 GeV/c proton, 14 um Cu"),
    pytest.param(BERYLLIUM, 1.4, 30.0, PION, id="30 GeV/c pion, 1.4 mm Be"),
]
each_passage = pytest.mark.parametrize(("matter", "thickness", "p", "mass"), PASSAGES)


def test_highland_by_hand():
    """1.4 mm of beryllium are 0.003969 radiation lengths and turn a 1 GeV/c muon by 0.681 mrad in a plane."""
    x = 1.4 / 352.8
    # beta^2 = 1/(1 + 0.10566^2) = 0.98896; 13.6 MeV/(0.99446 GeV) sqrt(x) (1 + 0.038 ln(x/beta^2))
    by_hand = 13.6e-3 / 0.994465 * 0.0629941 * (1 + 0.038 * -5.51835)
    found = _core.scattering_angle(p=1.0, mass=MUON, x0=x, track_x0=x)
    assert found == pytest.approx(by_hand, rel=1e-5)
    assert found == pytest.approx(6.809e-4, rel=1e-3)


@each_passage
def test_scattering_angle(matter, thickness, p, mass):
    """For a single piece the angle is Highland's in the form of Lynch and Dahl."""
    x = 0.1 * thickness * matter.density / matter.x0
    assert _core.scattering_angle(p=p, mass=mass, x0=x, track_x0=x) == pytest.approx(highland(x, p, mass), rel=1e-12)


@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_scattering_is_additive(pieces):
    """The variance of a whole is the sum over its pieces; with a logarithm for each piece it would not be."""
    whole = _core.scattering_angle(p=0.5, mass=MUON, x0=0.02, track_x0=0.02)
    piece = _core.scattering_angle(p=0.5, mass=MUON, x0=0.02 / pieces, track_x0=0.02)
    assert pieces * piece**2 == pytest.approx(whole**2, rel=1e-12)
    alone = _core.scattering_angle(p=0.5, mass=MUON, x0=0.02 / pieces, track_x0=0.02 / pieces)
    assert pieces * alone**2 < 0.95 * whole**2


@each_passage
def test_bethe(matter, thickness, p, mass):
    """The mean loss of all collisions is Bethe's with density effect, and has a slope of 1 in the path."""
    core = slab_detector([(matter, thickness, 50.0)])
    expected, xi, w_max = bethe(matter, thickness, p, mass)
    for path in (1.0, 2.5):
        found = _core.restricted_loss(core, 0, path=path, p=p, mass=mass, cut=1e3)
        assert found == pytest.approx(path * expected, rel=1e-3)  # the density effect is read from a table
    cut = 0.05 * w_max
    restricted = _core.restricted_loss(core, 0, path=1.0, p=p, mass=mass, cut=cut)
    assert restricted == pytest.approx(bethe(matter, thickness, p, mass, cut)[0], rel=1e-3)
    beta2 = p * p / (p * p + mass * mass)
    harder = xi * (math.log(w_max / cut) - beta2 * (1 - cut / w_max))  # integral of E times the spectrum
    whole = _core.restricted_loss(core, 0, path=1.0, p=p, mass=mass, cut=w_max)
    assert whole - restricted == pytest.approx(harder, rel=1e-9)


@pytest.mark.parametrize("matter", [BERYLLIUM, COPPER, KAPTON])
def test_minimum_ionisation(matter):
    """The smallest loss over all momenta is the PDG's tabulated minimum ionisation, to half a per cent."""
    core = slab_detector([(matter, 1.0, 50.0)])
    losses = [_core.restricted_loss(core, 0, path=1.0, p=p, mass=MUON, cut=1e3) for p in np.linspace(0.2, 0.8, 121)]
    assert min(losses) / (0.1 * matter.density) * 1e3 == pytest.approx(matter.minimum, rel=5e-3)


def test_bethe_by_hand():
    """A 1 GeV/c muon loses 0.43 MeV in 1.4 mm of beryllium."""
    # xi = 0.1535 MeV x 0.44384 x 1.848 x 0.14 / 0.98896 = 17.83 keV; beta gamma = 9.4645; W_max = 83.4 MeV
    # ln(2 x 0.511 MeV x 89.58 x 83.4 MeV / (63.7 eV)^2) - 2 x 0.98896 - delta, delta = 2 ln 9.4645 - 2.7847 + 0.317
    by_hand = 0.01783 * (math.log(2 * 0.510999 * 89.577 * 83.4 / 63.7e-6**2) - 2 * 0.98896 - 2.0269)
    core = slab_detector([(BERYLLIUM, 1.4, 50.0)])
    assert _core.restricted_loss(core, 0, path=1.0, p=1.0, mass=MUON, cut=1e3) == pytest.approx(
        1e-3 * by_hand, rel=5e-3
    )
    assert by_hand == pytest.approx(0.43, abs=0.01)


@each_passage
@pytest.mark.parametrize("times", [1, 30])
def test_core_moments(matter, thickness, p, mass, times):
    """Core loss and its variance are the first two moments of the collisions below CORE_CUT xi of the whole track."""
    core = slab_detector([(matter, thickness, 50.0)])
    track_xi = times * 0.5 * 0.307075e-3 * matter.z_over_a * matter.density * 0.1 * thickness
    beta2 = p * p / (p * p + mass * mass)
    expected, xi, w_max = bethe(matter, thickness, p, mass, _core.CORE_CUT * track_xi / beta2)
    loss, variance, _ = _core.core_loss(core, 0, path=1.0, p=p, mass=mass, track_xi=track_xi)
    assert loss == pytest.approx(expected, rel=1e-3)
    cut = min(_core.CORE_CUT * track_xi / beta2, w_max)
    # Integral of E^2 xi/E^2 (1 - beta^2 E/W_max).
    energy = np.linspace(0, cut, 2001)
    assert variance == pytest.approx(np.trapezoid(xi * (1 - beta2 * energy / w_max), energy), rel=1e-9)


@each_passage
@pytest.mark.parametrize("times", [1, 30])
def test_core_slope(matter, thickness, p, mass, times):
    """The slope of the core loss is its derivative by momentum, to 1e-3 of loss over momentum."""
    core = slab_detector([(matter, thickness, 50.0)])
    track_xi = times * 0.5 * 0.307075e-3 * matter.z_over_a * matter.density * 0.1 * thickness

    def loss(momentum):
        return _core.core_loss(core, 0, path=1.0, p=momentum, mass=mass, track_xi=track_xi)

    # Half a bin of the table of the density effect away from its nodes, where the slope jumps.
    nodes = np.exp(_core.LOSS_GRID_FIRST + _core.LOSS_GRID_STEP * (np.arange(_core.LOSS_POINTS) + 0.5)) * mass
    at = nodes[np.argmin(np.abs(nodes - p))]
    step = 1e-4 * at
    difference = (loss(at + step)[0] - loss(at - step)[0]) / (2 * step)
    assert loss(at)[2] == pytest.approx(difference, rel=1e-3, abs=1e-3 * loss(at)[0] / at)


@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_core_loss_is_additive(pieces):
    """Loss and variance of a whole are the sums over its pieces."""
    whole = slab_detector([(BERYLLIUM, 2.0, 50.0)])
    piece = slab_detector([(BERYLLIUM, 2.0 / pieces, 50.0)])
    track_xi = _core.total_matter(whole, 0.0)[1]
    full = _core.core_loss(whole, 0, path=1.0, p=0.4, mass=MUON, track_xi=track_xi)
    part = _core.core_loss(piece, 0, path=1.0, p=0.4, mass=MUON, track_xi=track_xi)
    np.testing.assert_allclose(pieces * np.array(part), full, rtol=1e-12)


@pytest.mark.parametrize("pieces", [2, 10, 100])
@pytest.mark.parametrize("pt", [0.2, 1.0])
def test_noise_of_a_track_does_not_depend_on_cuts(pieces, pt):
    """The fit's noise seen from the origin is the same if the beam pipe is cut into neighbouring slabs."""
    design = load("besiii-cgem-design")
    hits = hits_on(design, [0.1, 0.5, -1 / pt, 2.0, 0.3])
    columns, log_terms = slab_table(design)

    def noise(n):
        repeat = np.where(np.arange(len(columns["x0"])) == 0, n, 1)
        cut = {k: np.repeat(v, repeat) for k, v in columns.items()}
        for name in ("x0", "xi"):
            cut[name][:n] /= n
        cut["spread"][:] = 0  # a thin piece may stay below the limit where shifts are followed
        core = _core.Detector(bz=-1.0, slabs=cut, log_terms=np.repeat(log_terms, repeat, axis=0),
                              cgem=cgem_table(design), wires=wire_table(design))  # fmt: skip
        vectors = _core.reference(core, np.array([0.1, 0.5, -1 / pt, 2.0, 0.3]), MUON, hits)["noise"]
        return vectors.T @ vectors

    whole, cut = noise(1), noise(pieces)
    scale = np.sqrt(np.outer(np.diag(whole), np.diag(whole)))
    # What is left: the pieces see the momentum on its way down, the whole sees its middle.
    np.testing.assert_allclose(cut / scale, whole / scale, rtol=0, atol=2e-3 if pt < 1 else 3e-4)


def test_total_matter():
    """The matter along a line is that of the slabs it meets within their lengths, over the cosine of its slope."""
    parts = [(BERYLLIUM, 1.0, 30.0), (KAPTON, 0.5, 80.0), (COPPER, 0.1, 120.0)]
    core = slab_detector(parts, half_length=100.0)
    x0 = [0.1 * t * m.density / m.x0 for m, t, _ in parts]
    xi = [0.5 * 0.307075e-3 * m.z_over_a * m.density * 0.1 * t for m, t, _ in parts]
    for tanl, met in ((0.0, 3), (-0.8, 3), (1.0, 2), (-2.0, 1)):
        expected = [sum(x0[:met]) * math.hypot(1, tanl), sum(xi[:met]) * math.hypot(1, tanl)]
        np.testing.assert_allclose(_core.total_matter(core, tanl), expected, rtol=1e-12)


def test_total_matter_ends_with_the_chamber():
    """A line that leaves the drift chamber through its end meets nothing behind, as for the simulation."""
    design = compiled(load("besiii-cgem-design"))
    columns, _ = slab_table(load("besiii-cgem-design"))
    for tanl in (0.3, 1.4, 2.5):
        inside = np.abs(tanl) * columns["radius"] <= columns["half_length"]
        leaves = np.flatnonzero(~inside & (columns["ends"] == 1))
        inside[leaves[0] if len(leaves) else len(inside) :] = False
        expected = columns["x0"][inside].sum() * math.hypot(1, tanl)
        assert _core.total_matter(design, tanl)[0] == pytest.approx(expected, rel=1e-12)


def test_largest_transfer():
    """Cuts above the largest transfer 2 m beta^2 gamma^2/(1 + 2 gamma m/M + (m/M)^2) change nothing, below they do."""
    core = slab_detector([(BERYLLIUM, 1.4, 50.0)])
    gamma = math.hypot(1.0, MUON) / MUON
    ratio = ELECTRON / MUON
    w_max = 2 * ELECTRON * (1 / MUON) ** 2 / (1 + 2 * gamma * ratio + ratio**2)
    losses = [_core.restricted_loss(core, 0, path=1, p=1, mass=MUON, cut=f * w_max) for f in (0.99, 1, 1.01)]
    assert losses[0] < losses[1] == losses[2]
