"""Scattering through slabs is that of the cross-section scatter by scatter, however the matter is cut."""

import numpy as np
import pytest

from cgemit import _core
from coulomb import core_angle, exact_quantiles, scattered, species
from slabs import ARGON, CARBON, COPPER, HELIUM_PROPANE, KAPTON, MUON, slab_detector
from stats import assert_within

pytestmark = pytest.mark.slow

SLABS = {
    "C 0.1 % X0": [(CARBON, 0.2135)],
    "Cu 14 um": [(COPPER, 0.014)],
    "Ar 10 mm": [(ARGON, 10.0)],
    "He/C3H8 16 mm": [(HELIUM_PROPANE, 16.0)],
    "like a CGEM layer": [(KAPTON, 0.34), (COPPER, 0.0376), (CARBON, 0.137)],
}
FRACTIONS = np.array([0.6827, 0.98, 0.999])
N = 100_000


def elements(parts):
    """Return Z, A, mol/cm2 of all elements."""
    return [row for matter, thickness in parts for row in matter.moles(thickness)]


def through(parts, p, screening, n=N, seed=1, pieces=1):
    """Return what n muons do behind sheets, each cut in pieces."""
    placed, edge = [], 10.0
    for matter, thickness in parts:
        for _ in range(pieces):
            placed.append((matter, thickness / pieces, edge + 0.5 * thickness / pieces))
            edge += thickness / pieces
    core = slab_detector(placed, screening=screening)
    return _core.simulation.through_slabs(core, p=p, mass=MUON, charge=-1, n=n, seed=seed)


def widths(angles):
    """Return half widths of the central fractions of four planes together, and their standard errors.

    Errors from the density, taken between neighbouring quantiles; two planes count as independent.
    """
    a, b = angles
    both = np.abs(np.concatenate([a, b, (a + b) / np.sqrt(2), (a - b) / np.sqrt(2)]))
    above, below = FRACTIONS + 0.2 * (1 - FRACTIONS), FRACTIONS - 0.2 * (1 - FRACTIONS)
    density = (above - below) / (np.quantile(both, above) - np.quantile(both, below))
    return np.quantile(both, FRACTIONS), np.sqrt(2 * FRACTIONS * (1 - FRACTIONS) / len(both)) / density


@pytest.mark.parametrize("screening", ["wentzel", pytest.param("moliere", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SLABS)
def test_angles_of_single_scatters(name, screening):
    """The 68 and 98 % half widths are within 1.5 % of single scatters drawn one by one, the 99.9 % within errors."""
    parts, p = SLABS[name], 1.0
    per_track = sum(c / a2 for c, a2, _, _ in species(elements(parts), p, MUON, screening))
    n = int(min(2 * N, 4e7 / per_track))
    expected, expected_error = widths(scattered(elements(parts), p, MUON, screening, n, seed=2))
    out = through(parts, p, screening, 2 * N)
    found, error = widths((out["angle_1"], out["angle_2"]))
    assert found[:2] == pytest.approx(expected[:2], rel=0.015)
    # 2 %: what four hard scatters a slab leave to the Gaussian.
    assert_within(found, expected, np.hypot(np.hypot(error, expected_error), 0.02 / 4 * expected), what="half widths")


@pytest.mark.parametrize(
    ("p", "screening"),
    [(0.05, "wentzel"), (0.2, "wentzel"), pytest.param(0.2, "moliere", marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("name", SLABS)
def test_angles_of_the_characteristic_function(name, screening, p):
    """The same cross-section summed without samples gives 68 and 98 % within 1.5 %, 99.9 % within 3 %."""
    # At 50 MeV/c a tenth of the slab, which hardly slows a muon of 12 MeV.
    parts = [(matter, thickness * (0.1 if p < 0.1 else 1)) for matter, thickness in SLABS[name]]
    expected = exact_quantiles(elements(parts), p, MUON, screening, FRACTIONS)
    out = through(parts, p, screening)
    found, error = widths((out["angle_1"], out["angle_2"]))
    assert found[:2] == pytest.approx(expected[:2], rel=0.015)
    assert_within(found[2], expected[2], np.hypot(error[2], 0.03 / 4 * expected[2]), what="99.9 %")


def test_the_gate_sees_wrong_physics():
    """Moliere's screening for Geant4's, Z^2 for Z(Z + 1), or no tail fail: the widths change by more than 1.5 %."""
    parts, p = SLABS["C 0.1 % X0"], 1.0
    right = exact_quantiles(elements(parts), p, MUON, "wentzel", FRACTIONS)
    other = exact_quantiles(elements(parts), p, MUON, "moliere", FRACTIONS)
    assert right[0] != pytest.approx(other[0], rel=0.015)
    nuclei = [(z, a, moles * z / (z + 1)) for z, a, moles in elements(parts)]
    assert np.all(exact_quantiles(nuclei, p, MUON, "wentzel", FRACTIONS)[:2] < 0.985 * right[:2])
    gaussian = right[0] * np.array([1, 2.326])
    assert right[1] > 1.015 * gaussian[1]


@pytest.mark.parametrize("name", ["C 0.1 % X0", "Ar 10 mm"])
@pytest.mark.parametrize("pieces", [2, 10, 100])
def test_cutting_changes_nothing(name, pieces):
    """Angles behind 2, 10 or 100 pieces are those behind one: 68, 98 and 99.9 % within errors and 1 %."""
    parts, n = SLABS[name], 60_000 if pieces < 100 else 15_000
    expected = exact_quantiles(elements(parts), 1.0, MUON, "wentzel", FRACTIONS)
    out = through(parts, 1.0, "wentzel", n, seed=pieces, pieces=pieces)
    found, error = widths((out["angle_1"], out["angle_2"]))
    assert_within(found, expected, np.hypot(error, 0.01 / 4 * expected), what="half widths")
    # Core angles of the pieces, each taken alone, do not add up to the core.
    if pieces == 10:
        alone = np.sqrt(pieces) * core_angle([(m, t / pieces) for m, t in parts], 1.0, MUON)
        assert found[0] > 1.03 * alone


def test_planes_share_single_scatters():
    """Plane angles do not correlate, their absolute values do by what a hard scatter has in both."""
    parts = SLABS["Cu 14 um"]
    angles = scattered(elements(parts), 1.0, MUON, "wentzel", 150_000)
    out = through(parts, 1.0, "wentzel", 150_000)
    found = np.array([out["angle_1"], out["angle_2"]])
    limit = 3 * np.quantile(np.abs(angles), 0.6827)
    values = []
    for sample in (angles, found):
        inside = sample[:, np.all(np.abs(sample) < limit, axis=0)]
        assert_within(np.corrcoef(inside)[0, 1], 0.0, 1 / np.sqrt(inside.shape[1]), what="correlation")
        values.append(np.corrcoef(np.abs(inside))[0, 1])
    assert values[0] > 0.02
    # The soft part, Gaussian here, is in truth a sum of scatters that share, too.
    assert_within(values[1], values[0], np.hypot(np.sqrt(2 / 150_000), 0.01 / 4), what="correlation of sizes")


def test_nuclei_of_finite_size_scatter_less():
    """Beyond 60 mrad behind 1 mm of copper there is what the form factor leaves, half of a point's."""
    parts, p, n, least = [(COPPER, 1.0)], 1.0, 500_000, 0.06
    q2 = np.geomspace((2 * p * np.sin(least / 2)) ** 2, 4 * p * p, 5000)
    expected = point = 0.0
    for c, a2, size, limit in species(elements(parts), p, MUON, "wentzel"):
        density = n * c / (q2 + a2) ** 2 * (q2 < limit)
        expected += np.trapezoid(density / (1 + size * q2) ** 4, q2)
        point += np.trapezoid(density, q2)
    out = through(parts, p, "wentzel", n)
    found = np.count_nonzero(np.hypot(out["angle_1"], out["angle_2"]) > least)
    # 5 %: soft scatters (4.5 mrad) before and behind the hard one.
    assert_within(found, expected, np.hypot(np.sqrt(expected), 0.05 * expected), what="large angles")
    assert point - found > 4 * np.hypot(np.sqrt(point), 0.05 * point)
