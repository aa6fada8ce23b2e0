"""Electrons and positrons: collision loss of Berger and Seltzer, spectra of Moller and Bhabha, bremsstrahlung."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from cgemit import FitSettings, Gun, Settings, _core, extrapolate, load, run
from cgemit.detector import slabs as slabs_of
from cgemit.fit_matter import tuned
from cgemit.tables.schema import has_momentum
from slabs import BERYLLIUM, COPPER, ELECTRON, WATER, slab_detector
from stats import assert_within, mean_error

MEV = 1e-3
# Matter that radiates and does nothing else.
RADIATOR = COPPER._replace(z_over_a=1e-9, elements=((29, 63.546, 1e-9),))


def momentum(kinetic):
    """Return p of an electron."""
    return np.sqrt(kinetic * (kinetic + 2 * ELECTRON))


@pytest.mark.parametrize(
    ("kinetic", "estar"), [(1, 1.849), (2, 1.824), (5, 1.892), (10, 1.968), (20, 2.046), (100, 2.202), (1000, 2.400)]
)
def test_collision_loss_in_water(kinetic, estar):
    """The mean collision loss is ESTAR's (NIST; ICRU Report 37), MeV cm2/g, to half a per cent.

    Numbers compared with copies of the table in public repositories.
    """
    core = slab_detector([(WATER, 10.0, 50.0)])  # 1 g/cm2
    found = _core.matter.restricted_loss(
        core, 0, path=1.0, p=momentum(kinetic * MEV), mass=ELECTRON, charge=-1, cut=1e3
    )
    assert found / MEV == pytest.approx(estar, rel=5e-3)


def test_positrons_lose_less_when_fast():
    """ICRU Report 37: the collision loss of positrons is below that of electrons, by 2 to 4 % from 1 to 100 MeV."""
    core = slab_detector([(WATER, 10.0, 50.0)])

    def loss(kinetic, charge):
        return _core.matter.restricted_loss(
            core, 0, path=1.0, p=momentum(kinetic), mass=ELECTRON, charge=charge, cut=1e3
        )

    for kinetic in (1 * MEV, 10 * MEV, 100 * MEV):
        assert 0.015 < 1 - loss(kinetic, +1) / loss(kinetic, -1) < 0.045


def moller(w, kinetic):
    """Return the number of transfers w per xi/beta^2 and energy, 1/GeV: C. Moller (1932), as in ICRU Report 37."""
    gamma = 1 + kinetic / ELECTRON
    other = kinetic - w
    exchange = (2 * gamma - 1) / gamma**2 / (w * other)
    return 1 / w**2 + 1 / other**2 + ((gamma - 1) / gamma / kinetic) ** 2 - exchange


def bhabha(w, kinetic):
    """Return the same for positrons: H.J. Bhabha (1936), as in the Geant4 Physics Reference Manual, "Ionisation"."""
    gamma, e = 1 + kinetic / ELECTRON, w / kinetic
    beta2, y = 1 - 1 / gamma**2, 1 / (gamma + 1)
    b1, b2 = 2 - y**2, (1 - 2 * y) * (3 + y**2)
    b4 = (1 - 2 * y) ** 3
    b3 = b4 + (1 - 2 * y) ** 2
    return (1 / e**2 - beta2 * (b1 / e - b2 + b3 * e - b4 * e**2)) / kinetic**2


@pytest.mark.parametrize("kinetic", [0.5 * MEV, 5 * MEV, 100 * MEV])
@pytest.mark.parametrize(("charge", "spectrum", "largest"), [(-1, moller, 0.5), (1, bhabha, 1.0)])
def test_restricted_loss_is_the_integral_of_the_spectrum(kinetic, charge, spectrum, largest):
    """Between two cuts the restricted loss grows by what the collisions between them lose."""
    core, p = slab_detector([(WATER, 1.0, 50.0)]), momentum(kinetic)
    xi = WATER.xi(1.0) * (1 + (ELECTRON / p) ** 2)

    def loss(cut):
        return _core.matter.restricted_loss(core, 0, path=1.0, p=p, mass=ELECTRON, charge=charge, cut=cut)

    edges = largest * kinetic * np.array([1e-3, 0.03, 0.3, 0.6, 0.999])
    for low, high in itertools.pairwise(edges):
        w = np.geomspace(low, high, 20_001)
        expected = xi * np.trapezoid(w * spectrum(w, kinetic), w)
        assert loss(high) - loss(low) == pytest.approx(expected, rel=1e-5)
        other = moller if spectrum is bhabha else bhabha
        assert loss(high) - loss(low) != pytest.approx(xi * np.trapezoid(w * other(w, kinetic), w), rel=1e-5)


@pytest.mark.parametrize("kinetic", [5 * MEV, 100 * MEV])
@pytest.mark.parametrize(("charge", "spectrum", "largest"), [(-1, moller, 0.5), (1, bhabha, 1.0)])
def test_single_collisions(kinetic, charge, spectrum, largest):
    """In thin matter, losses above a few per cent are as many as the spectrum has, and the mean is the formula's."""
    core, p, n = slab_detector([(BERYLLIUM, 0.02, 50.0)]), momentum(kinetic), 1_000_000
    xi = BERYLLIUM.xi(0.02) * (1 + (ELECTRON / p) ** 2)
    sample = _core._testing.sample_loss(core, 0, path=1.0, p=p, mass=ELECTRON, charge=charge, seed=2, n=n)
    mean = _core.matter.restricted_loss(core, 0, path=1.0, p=p, mass=ELECTRON, charge=charge, cut=1e3)
    assert_within(sample.mean(), mean, mean_error(sample), what="mean")
    assert sample.max() < largest * kinetic + 40 * xi
    edges = largest * kinetic * np.array([0.02, 0.1, 0.4, 1.0])
    soft = mean * 0.8  # what the other collisions of the same passage lose
    for low, high in itertools.pairwise(edges):
        w = np.geomspace(low, high * (1 - 1e-9), 4001)
        expected = n * xi * np.trapezoid(spectrum(w, kinetic), w)
        found = np.count_nonzero((sample > low + soft) & (sample < high + soft + 40 * xi * (high == edges[-1])))
        assert_within(found, expected, np.hypot(np.sqrt(expected), 3 * xi / low * expected), what=f"above {low}")


@pytest.mark.parametrize("charge", [-1, 1])
def test_radiation(charge):
    """The photons' mean and variance are those of the PDG's spectrum, and so are their numbers above a fraction y."""
    # Each photon y leaves 1 - y: the mean of the product is exp(-t), that of its square exp(-t (2 - 17/36)).
    t, n, energy = 0.05, 400_000, 1.0
    core = slab_detector([(RADIATOR, t * 14.35, 50.0)])
    out = _core.simulation.through_slabs(core, p=energy, mass=ELECTRON, charge=charge, n=n, seed=4)["loss"] / energy
    thickness = _core.matter.total_matter(core, 0.0)[0]
    assert_within(out.mean(), 1 - np.exp(-thickness), np.hypot(mean_error(out), 1e-6), what="mean")
    variance = np.exp(-thickness * (2 - 17 / 36)) - np.exp(-2 * thickness)
    assert_within(out.var(), variance, np.std((out - out.mean()) ** 2) / np.sqrt(n), what="variance")
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(out.mean(), 1.03 * (1 - np.exp(-thickness)), mean_error(out))
    thin = slab_detector([(RADIATOR, 0.002 * 14.35, 50.0)])
    out = _core.simulation.through_slabs(thin, p=energy, mass=ELECTRON, charge=charge, n=n, seed=5)["loss"] / energy
    thickness = _core.matter.total_matter(thin, 0.0)[0]
    for y in (0.01, 0.1, 0.5, 0.9):
        expected = n * thickness * (-4 / 3 * np.log(y) - 4 / 3 * (1 - y) + 0.5 * (1 - y**2))
        error = np.hypot(np.sqrt(expected), 4 * thickness * expected)  # a second photon may help
        assert_within(np.count_nonzero(out > y), expected, error, what=f"above {y}")


def test_muons_do_not_radiate():
    """The same matter takes nothing from a muon."""
    core = slab_detector([(RADIATOR, 1.0, 50.0)])
    assert (
        _core.simulation.through_slabs(core, p=1.0, mass=0.1056583755, charge=-1, n=100, seed=4)["loss"].max() < 1e-10
    )


def photons(y):
    """Return dN/dy per radiation length: PDG 2024, eq. 34.29."""
    return (4 / 3 - 4 / 3 * y + y**2) / y


def radiated(cut, power):
    """Return the integral of y^power dN/dy up to a share of the energy."""
    return quad(lambda y: y**power * photons(y), 0, cut, epsabs=0, epsrel=1e-11)[0]


def cut_of(xi, error):
    """Return the loss W = 2.6 sigma with sigma^2 = error^2 + xi W, of little matter."""
    return brentq(lambda w: w - 2.6 * math.sqrt(error**2 + xi * w), 0, 100 * (xi + error), xtol=1e-15, rtol=1e-14)


def moments(core, p, charge, track_xi):
    """Return loss, variance and slope that the fit takes for the first slab."""
    return np.array(_core._testing.core_loss(core, 0, path=1.0, p=p, mass=ELECTRON, charge=charge, track_xi=track_xi))


@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("p", [0.05, 0.5, 2.0])
def test_what_the_fit_takes(p, charge):
    """Collisions and photons below the cut, by numerical integration; the slope is the loss's derivative."""
    core = slab_detector([(COPPER, 0.3, 50.0)])
    xi = _core.matter.total_matter(core, 0.0)[1]
    t = 0.03 / COPPER.x0 * COPPER.density
    energy, beta2 = np.hypot(p, ELECTRON), 1 / (1 + (ELECTRON / p) ** 2)
    cut = cut_of(xi / beta2, _core.matter.USUAL_MOMENTUM_ERROR * p * np.sqrt(beta2))
    collisions = _core.matter.restricted_loss(core, 0, path=1.0, p=p, mass=ELECTRON, charge=charge, cut=cut)
    loss, variance, slope = moments(core, p, charge, xi)
    assert loss == pytest.approx(collisions + t * energy * radiated(cut / energy, 1), rel=1e-9)
    assert variance == pytest.approx(cut * xi / beta2 + t * energy**2 * radiated(cut / energy, 2), rel=1e-9)
    assert loss - collisions != pytest.approx(t * energy * radiated(1.1 * cut / energy, 1), rel=0.05)
    step = 1e-3 * p
    difference = (moments(core, p + step, charge, xi)[0] - moments(core, p - step, charge, xi)[0]) / (2 * step)
    assert slope == pytest.approx(difference, rel=0.01)


@pytest.mark.parametrize("error", [1e-4, 0.003, 0.1, 0.4])
def test_photons_are_cut_like_collisions(error):
    """The loss with radiation, less the loss without, is that of photons below the cut, whatever the cut."""
    detector, p, xi = load("besiii-cgem-design"), 0.8, 1e-6
    thick, energy = slabs_of(detector)[0].x0, np.hypot(p, ELECTRON)
    cut = min(cut_of(xi, error * p) / energy, 1.0)

    def found(p):
        both = [tuned(detector, radiation=on, momentum_error=error) for on in (True, False)]
        return np.subtract(*(moments(core, p, -1, xi) for core in both))

    loss, variance, slope = found(p)
    assert loss == pytest.approx(thick * energy * radiated(cut, 1), rel=1e-4)
    assert variance == pytest.approx(thick * energy**2 * radiated(cut, 2), rel=1e-4)
    assert slope == pytest.approx((found(1.001 * p)[0] - found(0.999 * p)[0]) / (0.002 * p), rel=2e-3)


def test_the_mean_loss_includes_all_photons():
    """With `loss="mean"` the mean is E x/X0 and the variance 17/36 E^2 x/X0."""
    detector, p = load("besiii-cgem-design"), 0.8
    thick, energy = slabs_of(detector)[0].x0, np.hypot(p, ELECTRON)
    both = [moments(tuned(detector, loss="mean", radiation=on), p, -1, 1e-6) for on in (True, False)]
    expected = [thick * energy, 17 / 36 * thick * energy**2, thick * p / energy]
    np.testing.assert_allclose(both[0] - both[1], expected, rtol=1e-9)


@pytest.mark.parametrize("particle", ["e-", "mu-"])
def test_the_switch_is_one_of_electrons(particle):
    runs = [
        run(
            "besiii-cgem-design", Gun(particle, p=0.8, theta=1.3), 300, settings=Settings(fit=FitSettings(radiation=on))
        )
        for on in (True, False)
    ]
    with_it, without = (one.tracks[has_momentum(one.tracks)] for one in runs)
    if particle == "mu-":
        assert runs[0].tracks == runs[1].tracks
        return
    # Photons below the cut take 0.05 % of the momentum from most tracks. Their variance, 2/3 t y^2 with t = 0.026 and
    # y = 1.4 %, is a seventh of that of the others.
    shift = np.median(with_it["p"] - without["p"]) / 0.8
    assert 1e-4 < shift < 6e-4
    assert 1.04 < np.median(with_it["err_kappa"]) / np.median(without["err_kappa"]) < 1.1
    start = runs[0].tracks
    out = [extrapolate("besiii-cgem-design", start, 180.0, radiation=on) for on in (True, False)]
    ratio = out[0]["kappa"] / out[1]["kappa"]
    assert 1 + 5e-5 < np.nanmin(ratio) < np.nanmax(ratio) < 1.01  # slower where it radiates
