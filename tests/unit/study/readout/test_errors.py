"""Factors of a chip in the errors of its clusters: designs, terms, fits and pulls."""

from __future__ import annotations

import dataclasses
import tomllib

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.widths import measure
from cgemit.detector.readouts import ChargeReadout
from cgemit.reconstruction.cluster import charge_clusterer, cluster
from cgemit.reconstruction.cluster_errors import ChipErrors, chip_errors, error_inputs
from cgemit.study.readout import errors
from cgemit.study.readout.errors import (
    Terms,
    as_toml,
    design,
    fit_errors,
    fitted_factors,
    fitted_height,
    inside_of_sheet,
    measurements,
    muons,
    pulls,
    terms,
    true_directions,
    with_estimator,
)

TIGER, APV25 = cg.TigerReadout(), cg.Apv25Readout()
DESIGN = cg.load("besiii-cgem-design")
FACTORS = ("ionization", "cut", "diffusion", "span", "time", "wide", "line")


def test_designs_are_different_and_stay() -> None:
    """Each number has its own strips, gaps, field, gain and threshold, and always the same."""
    drawn = [design(TIGER, number) for number in range(12)]
    again = design(TIGER, 7)
    assert again.detector.cgem == drawn[7].detector.cgem
    assert again.readout == drawn[7].readout
    layers = [layer for one in drawn for layer in one.detector.cgem]
    for values, low, high in (
        ([layer.pitch_x for layer in layers], 0.3, 1.2), ([layer.drift_gap for layer in layers], 3, 8),
        ([np.log2(one.readout.gain / TIGER.gain) for one in drawn], -1, 1),
        ([np.log2(one.readout.threshold_x / TIGER.threshold_x) for one in drawn], -1, 1),
        ([one.detector.field.bz for one in drawn], 0, 1.2),
    ):  # fmt: skip
        assert low <= min(values) < low + 0.3 * (high - low)
        assert high >= max(values) > high - 0.3 * (high - low)
        assert len(np.unique(values)) > 0.8 * len(values)


def test_muons_are_displaced_on_demand() -> None:
    """Their lines pass the beam line at distances up to the given one, in both senses."""
    for displaced in (0.0, 50.0):
        particles = muons(2000, 3, displaced)
        pt = np.hypot(particles["px"], particles["py"])
        distance = (particles["x"] * particles["py"] - particles["y"] * particles["px"]) / pt
        assert np.abs(distance).max() <= displaced + 1e-9
        assert np.ptp(distance) >= 1.95 * displaced
        p = np.hypot(pt, particles["pz"])
        assert np.ptp(np.abs(particles["pz"] / p)) > 0.85
        assert p.min() < 0.35
        assert p.max() > 9
        assert set(particles["pdg"]) == {-13, 13}


def drawn(height: float, factors: dict[str, float], n: int = 40_000) -> Terms:
    """Return clusters whose residuals have a mean and a variance of these factors, and a tail."""
    random = np.random.default_rng(6)
    slope = random.uniform(-1.5, 1.5, n)
    span = 5 / np.sqrt(1 + 4 * slope**2)
    moved = slope * span * random.uniform(0.1, 1.5, n)
    variances = {name: random.gamma(0.5, 0.02, n) for name in factors}
    fixed = random.uniform(0.001, 0.003, n)
    sigma = np.sqrt(fixed + sum(factor * variances[name] for name, factor in factors.items()))
    tail = np.where(random.random(n) < 0.05, 4.0, 1.0)
    return Terms(sigma * tail * random.standard_normal(n) - moved * height, moved, fixed, variances)


def test_heights_are_found() -> None:
    """In spite of tails, some of which lie to the side of the slope, and of residuals with unequal errors."""
    for true in (-0.14, 0.0):
        sample = drawn(true, {"wide": 0.4})
        far = np.where(np.arange(len(sample.residual)) % 30 == 0, np.sign(sample.heights), 0.0)  # mm
        assert fitted_height(sample._replace(residual=sample.residual + far)) == pytest.approx(true, abs=0.012)


def test_factors_are_found() -> None:
    """Of a sample of the model, whether or not some are given; with a wrong one given, others differ."""
    true = {"diffusion": 1.2, "span": 0.3, "wide": 0.6}
    sample = drawn(0.0, true)
    assert fitted_factors(sample, tuple(true), {}) == pytest.approx(true, rel=0.08)
    free = fitted_factors(sample, ("diffusion", "wide"), {"span": 0.3})
    assert free == pytest.approx({"diffusion": 1.2, "wide": 0.6}, rel=0.08)
    wrong = fitted_factors(sample, ("diffusion", "wide"), {"span": 3.0})
    assert wrong["diffusion"] < 0.7 * true["diffusion"]


@pytest.mark.parametrize(
    ("estimator", "of_track", "of"),
    [
        ("merged", True, ("diffusion", "span", "time", "wide", "cut")),
        ("centroid", False, ("ionization", "cut", "diffusion", "wide")),
    ],
)
def test_terms_add_up(estimator: str, of_track: bool, of: tuple[str, ...]) -> None:
    """With the factors of the chip they make up the errors and residuals of its clusters."""
    at = design(TIGER, 3)
    readout = with_estimator(at.readout, estimator)
    result = cg.run(at.detector, muons(150, 5, 50.0), seed=5, readout=readout, until="digitize")
    factors = chip_errors("tiger")
    sample = terms(at.detector, readout, result.digis, result.truths, of_track=of_track, heights=factors)
    clusters = cluster(at.detector, result.digis, readout=readout)
    if of_track:
        directions = true_directions(at.detector, clusters, result.truths)
        clusters = cluster(at.detector, result.digis, readout=readout, directions=directions)
    own = measurements(at.detector, clusters, result.truths)
    order = np.argsort(errors._keys(own))
    order = order[inside_of_sheet(at.detector, own)[order]]
    assert len(order) > 0.9 * len(own.error)
    variance = sample.fixed + sum(getattr(factors, name) * sample.variances[name] for name in FACTORS)
    # The factors decide at times which part of a divided cluster is that of the crossing, and without a track which
    # pair gives the direction.
    least = 0.998 if of_track else 0.98
    assert np.mean(np.isclose(variance, own.error[order] ** 2, rtol=1e-9)) >= least
    assert np.mean(np.isclose(sample.residual, own.residual[order], rtol=0, atol=1e-9)) >= least
    assert {name for name in FACTORS if np.mean(sample.variances[name] > 1e-9) > 0.02} == set(of)
    plain = terms(at.detector, readout, result.digis, result.truths, of_track=of_track, heights=None)
    moved = plain.residual + plain.heights * factors.height_by_threshold
    # Beyond the gap the Lorentz shift stays that of its border.
    assert np.quantile(np.abs(moved - sample.residual), 0.95) < 5e-3
    if of_track:
        assert np.quantile(np.abs(plain.residual - sample.residual), 0.5) > 0.002


def test_terms_are_of_the_same_clusters_whatever_part_is_that_of_the_crossing() -> None:
    """In this design the parts of divided clusters, and with them the edges of sheets, change with the factors."""
    at = design(TIGER, 4)
    digitized = cg.run(at.detector, muons(1500, 3, 0.0), seed=3, readout=at.readout, until="digitize")
    factors = chip_errors("tiger")
    sample = terms(at.detector, at.readout, digitized.digis, digitized.truths, of_track=True, heights=factors)
    assert {len(column) for column in (sample.heights, sample.fixed, *sample.variances.values())} == {
        len(sample.residual)
    }


@pytest.mark.slow
@pytest.mark.parametrize("readout", [TIGER, APV25], ids=["tiger", "apv25"])
def test_pulls_in_designs_that_no_fit_has_seen(readout: ChargeReadout, monkeypatch: pytest.MonkeyPatch) -> None:
    """Core of all within 8 % and no bias; errors that are a quarter larger would not pass."""
    found = pulls(readout, estimator="merged", of_track=True, designs=16, n=200)
    assert found[0].quantity == "all"
    assert found[0].clusters > 10_000
    assert found[0].core == pytest.approx(1, abs=0.08)
    assert abs(found[0].mean) < 0.15
    assert found[0].beyond < 0.04
    assert {one.quantity for one in found} == {"all", "design", "slope", "strips", "charge", "view"}
    for name in ("slope", "charge", "view"):
        assert sum(one.clusters for one in found if one.quantity == name) > 0.98 * found[0].clusters

    def too_large(*args: object, **how: object) -> errors.Measurements:
        sample = measurements(*args, **how)  # type: ignore[arg-type]
        return sample._replace(error=1.25 * sample.error)

    monkeypatch.setattr(errors, "measurements", too_large)
    wrong = pulls(readout, estimator="merged", of_track=True, designs=16, n=50)
    assert wrong[0].core < 0.92


def test_pulls_with_other_factors() -> None:
    """Factors that are given count instead of the chip's own."""
    large = dataclasses.replace(chip_errors("tiger"), diffusion=10.0)
    own, other = (pulls(TIGER, designs=2, n=300, errors=one)[0] for one in (None, large))
    assert other.clusters == own.clusters
    assert other.core < 0.7 * own.core
    assert pulls(TIGER, designs=2, n=300, errors=chip_errors("tiger"))[0] == own


@pytest.mark.slow
def test_a_fit_finds_the_factors_of_the_package() -> None:
    """With fewer designs, roughly; in the designs of the other half, the errors hold."""
    progress: list[float] = []
    found = fit_errors(TIGER, designs=8, n=800, progress=progress.append)
    own = chip_errors("tiger")
    for name in ("ionization", "cut", "diffusion", "time", "wide"):
        assert getattr(found, name) == pytest.approx(getattr(own, name), rel=0.5), name
    assert found.height_by_threshold == pytest.approx(own.height_by_threshold, abs=0.05)
    assert progress[-1] == 1.0
    assert progress == sorted(progress)
    assert pulls(TIGER, errors=found, designs=8, n=1000)[0].core == pytest.approx(1, abs=0.1)


def test_a_file_of_factors() -> None:
    """It has what has been found, to three digits, by the name of the readout."""
    found = dataclasses.replace(chip_errors("apv25"), diffusion=0.123456)
    table = tomllib.loads(as_toml("mine", found))["mine"]
    assert ChipErrors(**table) == dataclasses.replace(found, diffusion=0.123)


@pytest.mark.slow
@pytest.mark.parametrize("particle", ["mu-", "mu+"])
@pytest.mark.parametrize("p", [0.25, 0.6])
def test_known_tracks_of_low_momentum(particle: str, p: float) -> None:
    """Clusters that know their track are right for both charges and at large curvature."""
    layers = dataclasses.replace(DESIGN, drift_chamber=None)
    gun = cg.Gun(particle, p=p, cos_theta=(-0.9, 0.9))
    result = cg.run(layers, gun, 3000, 5, readout=TIGER, until="cluster")
    directions = true_directions(layers, result.clusters, result.truths)
    clusters = cluster(layers, result.digis, readout=TIGER, directions=directions)
    sample = measurements(layers, clusters, result.truths)
    for view, layer in np.ndindex(2, 3):
        here = (sample.view == view) & (sample.layer == layer)
        pull = measure(sample.residual[here] / sample.error[here])
        assert abs(pull.core - 1) < 0.08 + 2 * pull.core_error, (view, layer)
        assert abs(pull.core_mean) < 0.2 + 2 * pull.core_mean_error, (view, layer)


def test_the_core_takes_other_factors() -> None:
    """A term without its factor is gone from the errors of clusters: none of the seven is left out."""
    at = design(TIGER, 1)
    digis = cg.run(at.detector, muons(60, 5, 0.0), seed=5, readout=at.readout, until="digitize").digis
    inputs, (group,) = error_inputs(at.detector, at.readout), at.detector.with_readout(at.readout).groups
    for estimator, names in (("merged", FACTORS[1:6]), ("micro-tpc", FACTORS[6:]), ("centroid", FACTORS[:1])):
        clusterer = charge_clusterer(with_estimator(at.readout, estimator))
        whole = clusterer.columns(group, digis, inputs)["err_x"]
        for name in names:
            without = inputs._replace(chip=inputs.chip | {name: 0.0})
            part = clusterer.columns(group, digis, without)["err_x"]
            assert np.nanmax(whole - part) > 1e-4, name
