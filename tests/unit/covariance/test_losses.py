"""Losses that the fit of electrons does not see: spectra by integration, momenta by drawn losses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

import cgemit as cg
from cgemit.covariance.losses import Losses, collisions_above, photons_above
from stats import assert_within, fraction_error

SHARES = np.array([1e-4, 0.003, 0.05, 0.3, 0.49])


@pytest.mark.parametrize("y", SHARES)
def test_photons_are_the_integral_of_their_spectrum(y: float) -> None:
    """PDG 2024, eq. 34.29."""
    expected = quad(lambda y: (4 / 3 - 4 / 3 * y + y * y) / y, y, 1, epsrel=1e-10, limit=200)[0]
    assert photons_above(y) == pytest.approx(expected, rel=1e-8)
    assert photons_above([1.0, 2.0]).tolist() == [0.0, 0.0]


def moller(e: float) -> float:
    """Return collisions per xi/E and share of the energy: C. Moller, Ann. Phys. 406 (1932) 531, for gamma >> 1."""
    return 1 / e**2 + 1 / (1 - e) ** 2 + 1


def bhabha(e: float) -> float:
    """Return the same for positrons: H.J. Bhabha, Proc. R. Soc. A 154 (1936) 195."""
    return 1 / e**2 - 2 / e + 3 - 2 * e + e**2


@pytest.mark.parametrize("y", SHARES)
@pytest.mark.parametrize(("charge", "spectrum", "most"), [(-1.0, moller, 0.5), (1.0, bhabha, 1.0)])
def test_collisions_are_the_integral_of_their_spectrum(y: float, charge: float, spectrum, most: float) -> None:
    # The exchange term of Moller, -(2 gamma - 1)/gamma^2 ..., vanishes.
    expected = quad(spectrum, y, most, epsrel=1e-10, limit=200)[0]
    assert collisions_above(y, charge) == pytest.approx(expected, rel=1e-7)
    assert collisions_above(most, charge) == pytest.approx(0, abs=1e-12)


def losses(unseen: list[float], thickness: list[float], xi: list[float], error: float, charge: float = -1.0) -> Losses:
    """Return losses of electrons of 1 GeV/c in some slabs."""
    names = tuple(f"slab {i}" for i in range(len(unseen)))
    one = np.ones(1)
    return Losses(
        "made", "e-", charge, names, ("inner",) * (len(names) - 1) + ("outer",), one, 0 * one, np.array([thickness]),
        np.array([xi]), np.array([unseen]), error * one, 0.02 * one,
    )  # fmt: skip


def drawn(given: Losses, n: int, least: float) -> np.ndarray:
    """Return fitted over true momenta: each loss above a share drawn one by one."""
    random, ratio = np.random.default_rng(3), np.ones(n)
    grid = np.geomspace(least, 1, 4001)
    for t, xi, unseen in zip(given.thickness[0], given.xi[0], given.unseen[0], strict=True):
        above = t * photons_above(grid) + xi * collisions_above(grid, given.charge)
        left, number = np.ones(n), random.poisson(above[0], n)
        for k in range(number.max()):
            y = np.interp(random.random(n) * above[0], above[::-1], grid[::-1])
            left = np.where(number > k, left * (1 - y), left)
        ratio *= left / (1 - (1 - left) * (1 - unseen))
    return ratio


def test_one_loss_in_thin_matter() -> None:
    """The probability of a smaller momentum is that of drawn losses."""
    given = losses([1.0, 0.6, 0.1], [0.004, 0.006, 0.02], [2e-6, 1e-6, 5e-6], 1e-9)
    n = 400_000
    ratio = drawn(given, n, 1e-3)
    x = np.array([0.02, 0.1, 0.5])
    expected = given.loss_probability(x)[0]
    found = np.mean(ratio[:, None] < 1 - x, axis=0)
    for one, other in zip(found, expected, strict=True):
        assert_within(one, other, np.hypot(fraction_error(other, n), 0.005 * other))
    seen = losses([1.0, 0.6, 0.2], [0.004, 0.006, 0.02], [2e-6, 1e-6, 5e-6], 1e-9).loss_probability(x)[0]
    assert np.all(seen > 1.1 * expected)  # the share that is not seen matters


def test_shares_are_those_of_a_gaussian_without_losses() -> None:
    """Without matter 68.27 % of the tracks are within one error."""
    none = losses([1.0, 0.0], [0.0, 0.0], [0.0, 0.0], 0.005)
    assert none.share_within([0.005, 0.01])[0] == pytest.approx([0.6827, 0.9545], abs=5e-4)
    assert none.deviation(0.6827) == pytest.approx([0.005], rel=2e-3)
    assert none.loss_probability(0.01)[0] == 0


@pytest.mark.parametrize("charge", [-1.0, 1.0])
def test_shares_are_those_of_drawn_momenta(charge: float) -> None:
    """Drawn losses with Gaussian errors, less the mean loss below the cut."""
    error, n = 0.004, 400_000
    given = losses([1.0, 0.5], [0.01, 0.015], [2e-5, 4e-5], error, charge)
    least = 1e-4
    y = np.geomspace(least, 1, 20_001)
    mean = 0.0
    for t, xi, unseen in zip(given.thickness[0], given.xi[0], given.unseen[0], strict=True):
        above = t * photons_above(y) + xi * collisions_above(y, charge)
        seen = y * unseen / (1 - y * (1 - unseen))
        middle = -np.diff(above)
        mean += float(np.sum((middle * 0.5 * (seen[1:] + seen[:-1]))[seen[1:] < 0.02]))
    random = np.random.default_rng(4)
    ratio = drawn(given, n, least) * np.exp(mean + error * random.standard_normal(n))
    for x in (0.004, 0.01, 0.05, 0.2):
        expected = float(given.share_within(x)[0])
        found = float(np.mean(np.abs(ratio - 1) < x))
        assert_within(found, expected, np.hypot(fraction_error(expected, n), 1e-3), what=f"within {x}")


def test_parts_sum_to_all() -> None:
    given = losses([1.0, 0.5, 0.0], [0.01, 0.02, 0.5], [0.0] * 3, 0.004)
    assert given.effective.tolist() == [[0.01, 0.01, 0.0]]
    assert {name: value.tolist() for name, value in given.grouped().items()} == {"inner": [0.02], "outer": [0.0]}
    table = given.table()
    assert table["part"].tolist() == ["inner", "outer"]
    assert table["share"].tolist() == [1.0, 0.0]
    assert given.table("slab")["effective"].tolist() == [0.01, 0.01, 0.0]
    assert "2.000 %" in repr(given)
    with pytest.raises(ValueError, match="expected one of part, slab"):
        given.table("layer")  # type: ignore[arg-type]


@pytest.mark.parametrize("x", [0.0, 1.0, -0.1, np.nan])
def test_impossible_shares_are_refused(x: float) -> None:
    given = losses([1.0], [0.01], [0.0], 0.004)
    for method in (given.loss_probability, given.share_within, given.deviation):
        with pytest.raises(ValueError, match="expected shares between 0 and 1"):
            method(x)


def test_losses_are_those_of_electrons_at_fixed_momenta() -> None:
    """Everything that is wrong is listed."""
    fit = cg.FitSettings(loss="mean", radiation=False)
    muons = cg.analytic("besiii-cgem-design", "mu-", p=(0.5, 1.0), fit=fit)
    with pytest.raises(ValueError, match=r"e- or e\+") as raised:
        muons.losses()
    for text in ("particle", "p, cos_theta", "fit.loss", "fit.radiation"):
        assert text in str(raised.value)


def test_inner_matter_is_unseen_and_outer_matter_is_not() -> None:
    """Of a loss before the first hit the fit sees nothing, of one near the last hit nearly all."""
    found = cg.analytic("besiii-cgem", "e-", p=[0.3, 1.0], cos_theta=0.0).losses()
    assert found.unseen.shape == (2, len(found.slabs))
    assert found.unseen[:, 0] == pytest.approx([1, 1], abs=0.02)
    assert np.all(found.unseen[:, -2:] < 0.05)
    assert np.all(np.diff(found.unseen, axis=1) < 0.01)
    # X/X0 of all, and before the first hit, as of the description.
    assert found.effective[1].sum() < found.thickness[1].sum()
    at_angle = cg.analytic("besiii-cgem", "e-", p=1.0, cos_theta=0.7).losses()
    assert at_angle.effective.sum() / found.effective[1].sum() == pytest.approx(1 / np.sqrt(1 - 0.7**2), rel=0.05)
    shape = cg.analytic("besiii-cgem", "e-", p=[[0.3, 1.0]]).loss_probability([0.01, 0.1, 0.5]).shape
    assert shape == (1, 2, 3)
