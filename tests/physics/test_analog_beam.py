"""Analog readouts in a test beam, one layer of 2 m radius, against published numbers; and two traps of such models.

Measured numbers stand beside the published ones in docs/methods/readout.md.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from cgemit import Apv25Readout, Gun, ProjectionReadout, TigerReadout, analytic, load, resolution, run
from cgemit.analysis.widths import measure
from cgemit.chain.result import Result
from cgemit.covariance.result import Covariance
from cgemit.detector.gas import ionization
from cgemit.detector.readouts import AnalogReadout
from cgemit.reconstruction.cluster import cluster, clusterer_of
from cgemit.study.readout.errors import measurements
from cgemit.study.readout.scan import beam_detector, beam_run, beam_views
from cgemit.tables import Table
from cgemit.truth import assign
from clusterers import expect
from lorentz import mean_shift

PLANE = beam_detector(0.0)
FIELD = beam_detector(1.0)
#: Nothing but the gain is adjusted.
BEAM = Apv25Readout(gain=39_000.0)
TAILS = pytest.mark.xfail(strict=True, reason="delta electrons move V by many errors: d_z is 7 to 17 % wider")
WITH_CHARGE = [
    pytest.param(TigerReadout(), id="tiger"), pytest.param(TigerReadout(second_pass=True), id="tiger-second"),
    pytest.param(Apv25Readout(), id="apv25"), pytest.param(Apv25Readout(second_pass=True), id="apv25-second"),
    pytest.param(ProjectionReadout(), id="projection", marks=TAILS),
]  # fmt: skip


def centroid_width(digis: Table, run_of: Any, readout: Any) -> float:
    """Core width of the centroid's residual in X, um."""
    clusters = cluster(run_of.detector, digis, readout=replace(readout, estimator="centroid"))
    sample = measurements(run_of.detector, clusters, run_of.truths)
    return measure(1e3 * sample.residual[sample.view == 0], parameter="X", unit="um").core


def test_normal_incidence_without_field() -> None:
    """Measured 50 um: one electron's diffusion moves its whole avalanche; else it would average out to 17 um."""
    result = beam_run(PLANE, BEAM, 0.0, n=1500, seed=2, threads=1)
    assert 45 < centroid_width(result.digis, result, BEAM) < 60


def test_density_and_sizes_of_clusters_are_of_one_source() -> None:
    """Electrons of a muon in 5 mm: HEED's quantiles 13/17/30/55/97 % at 5/16/50/84/95 % of the events.

    Sizes of another source (65.6 % single electrons, made for a lower density) with HEED's density miss the median.
    """
    heed, random = ionization("ar-ic4h10-90-10"), np.random.default_rng(5)
    density = 36.0 / 1.053  # the quantiles hold for HEED's own density, without hydrogen
    listed = len(heed.sizes) - len(heed.tail) + 1
    sizes = np.append(np.arange(1, listed + 1), np.sqrt(heed.tail[:-1] * heed.tail[1:]))
    own = np.diff(heed.sizes, prepend=0.0)
    other = np.array([65.6, 15.0, 6.4, 3.5, 2.25, 1.55, 1.05, 0.81, 0.61, 0.49, 0.39, 0.30, 0.25, 0.20, 0.16, 0.12,
                      0.095, 0.075, 0.063, 0.054] + [21.6 / n**2 for n in range(21, 301)])  # fmt: skip

    def median(values: np.ndarray, shares: np.ndarray) -> float:
        number = random.poisson(density * 0.5, 4000)
        drawn = random.choice(values, number.sum(), p=shares / shares.sum())
        return float(np.median(np.bincount(np.repeat(np.arange(4000), number), drawn, minlength=4000)))

    assert median(sizes, own) == pytest.approx(30, abs=1.5)
    assert median(np.arange(1, 301), other) > 33


def test_lorentz_shift_before_and_after_the_correction() -> None:
    """1 T, 1.5 kV/cm: 2.20 mm in a plane stack before, and -50 um after, by what strips induce on their neighbours."""
    result = beam_run(FIELD, BEAM, 0.0, n=1500, seed=3, particle="mu-", p=1.0, threads=1)
    raw = cluster(FIELD, result.digis, readout=replace(BEAM, estimator="centroid", lorentz=False))
    corrected = cluster(FIELD, result.digis, readout=replace(BEAM, estimator="centroid"))
    across = raw["view"] == 0
    shift = raw["x"][across] - corrected["x"][across]
    np.testing.assert_allclose(shift, mean_shift(FIELD.cgem[0], FIELD.field.bz))
    sample = measurements(FIELD, corrected, result.truths)
    residual = sample.residual[sample.view == 0]
    left = measure(1e3 * residual, parameter="X", unit="um")
    assert shift.mean() == pytest.approx(2.20, abs=0.05)
    assert -70 < left.core_mean < -30
    assert 300 < left.core < 380


BETTER = pytest.mark.xfail(strict=True, reason="the mean of centroid and line is a third better than published")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angle", "strips", "centroid", "line", "merged"),
    [
        (0, 4.67, 50, None, 50), (5, 4.75, None, None, 110),
        pytest.param(10, 5.20, 173, None, 125, marks=BETTER), (15, 5.85, 228, 130, None),
        (20, 6.54, 280, 110, 105), (30, 7.90, 380, 110, 105), (40, 9.00, 460, 120, 115),
    ],
)  # fmt: skip
def test_angles_without_field(
    angle: float, strips: float, centroid: float | None, line: float | None, merged: float | None
) -> None:
    """Published rows of a test beam: strips within 20 %, centroid and merged within 25 %, line fits within 30 %.

    The merged position is better at 10 degrees (docs/methods/readout.md).
    """
    point = beam_views(PLANE, BEAM, angle, n=4000, threads=1)[0]
    assert point.size == pytest.approx(strips, rel=0.2)
    if centroid is not None:
        assert point.widths["centroid"].core == pytest.approx(centroid, rel=0.25)
    if line is not None:
        assert point.widths["micro-tpc"].core == pytest.approx(line, rel=0.3)
    if merged is not None:
        assert point.widths["merged"].core == pytest.approx(merged, rel=0.25)
    assert point.efficiency > 0.999


@pytest.mark.slow
@pytest.mark.parametrize(("angle", "published"), [(0.0, 128.0), (20.0, 170.0)])
def test_charge_at_two_angles(angle: float, published: float) -> None:
    """The charge is 15 to 30 % below the published one, whose gain is known as little."""
    charge = beam_views(PLANE, BEAM, angle, n=400, threads=1)[0].charge
    assert 0.7 * published < charge < 0.85 * published


@pytest.mark.slow
def test_field_of_one_tesla_at_both_angles() -> None:
    """At +25 degrees the track lies along the drift: a sharp centroid. At -25 degrees the line fit is better."""
    normal = beam_views(FIELD, Apv25Readout(), 0.0, n=1000, particle="mu-", p=1.0, threads=1)[0]
    assert normal.efficiency > 0.99  # at a gain of 12 000
    assert normal.widths["merged"].core < 150
    assert normal.widths["micro-tpc"].core < 0.5 * normal.widths["centroid"].core
    assert normal.widths["track"].core < 0.95 * normal.widths["merged"].core
    along, against = (beam_views(FIELD, BEAM, angle, n=1000, threads=1)[0] for angle in (25.0, -25.0))
    assert along.widths["centroid"].core < 70
    assert along.widths["micro-tpc"].core > 500
    assert 500 < against.widths["centroid"].core < 680
    assert against.widths["micro-tpc"].core < 150


def test_clusters_and_tracks_with_tiger() -> None:
    """Whole detector: errors of clusters and of tracks hold in the core."""
    result = run(
        load("besiii-cgem-design"), Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93)), 10_000, seed=7, readout="tiger"
    )
    clusters = result.clusters
    sample = measurements(result.detector, clusters, result.truths)
    typical = np.median(clusters["err_x"][clusters["view"] == 0])
    assert 0.09 < typical < 0.14
    assert np.mean(sample.view == 0) == pytest.approx(0.5, abs=0.01)
    assert len(sample.view) > 2 * 0.995 * len(result.truths)
    good = result.tracks["status"] == 0
    assert good.mean() > 0.999
    for name in ("dr", "dz", "phi0", "kappa", "tanl"):
        pull = measure(result.tracks[f"pull_{name}"][good], parameter=name, unit="")
        assert abs(pull.core - 1) < 0.05 + 1.5 * pull.core_error, (name, pull.core)
        assert abs(pull.core_mean) < 0.1 + 1.5 * pull.core_mean_error, (name, pull.core_mean)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "second_pass", "particle"),
    list(itertools.product((TigerReadout, Apv25Readout), (False, True), ("mu-", "mu+"))),
)
def test_pulls_of_tracks_of_both_charges(kind: type, second_pass: bool, particle: str) -> None:
    """They have unit width within 5 %, and hardly a bias: at 1 GeV/c the first pass does not know the charge."""
    gun = Gun(particle, p=1.0, cos_theta=(-0.93, 0.93))
    tracks = run(load("besiii-cgem-design"), gun, 12_000, seed=3, readout=kind(second_pass=second_pass)).tracks
    for name in ("dr", "dz", "phi0", "kappa", "tanl"):
        pull = measure(tracks[f"pull_{name}"][tracks["status"] == 0])
        assert abs(pull.core - 1) < 0.05 + 1.5 * pull.core_error, (name, pull.core)
        assert abs(pull.core_mean) < 0.1 + 1.5 * pull.core_mean_error, (name, pull.core_mean)


def as_expected(
    readout: AnalogReadout | ProjectionReadout, cos_theta: float | tuple[float, float], n: int
) -> Covariance:
    """Return what `analytic` expects of muons, after asserting that d_rho, d_z and p of n of them are within 5 %."""
    design = load("besiii-cgem-design")
    tracks = run(design, Gun("mu-", p=1.0, cos_theta=cos_theta), n, seed=9, readout=readout).tracks
    expected = analytic(design, "mu-", p=1.0, cos_theta=cos_theta, readout=readout)
    for name in ("dr", "dz", "p"):
        found = resolution(tracks, name)
        ratio = float(np.squeeze(getattr(expected, f"sigma_{name}"))) / found.core
        assert abs(ratio - 1) < 0.05 + 1.5 * found.core_error / found.core, (name, ratio)
    return expected


@pytest.mark.slow
@pytest.mark.parametrize("readout", WITH_CHARGE)
def test_analytic_errors_are_those_of_tracks(readout: AnalogReadout | ProjectionReadout) -> None:
    """The covariance takes the errors that the readout expects, without events."""
    as_expected(readout, (-0.93, 0.93), 8000)


AT_THE_GATE = pytest.mark.xfail(strict=False, reason="d_z is 7 % wider, at the gate of 5 % and 1.5 errors")
AT_ANGLES = [
    pytest.param(
        *one.values, angle, id=f"{one.id}-{angle}", marks=AT_THE_GATE if one.marks and angle == 0 else one.marks
    )
    for one in WITH_CHARGE
    for angle in (-0.8, 0.0, 0.4)
]


@pytest.mark.slow
@pytest.mark.parametrize(("readout", "cos_theta"), AT_ANGLES)
def test_analytic_errors_at_one_angle(
    readout: AnalogReadout | ProjectionReadout, cos_theta: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They hold at every angle, too; with errors of all angles d_z is 5 % off or more."""
    expected = as_expected(readout, cos_theta, 8000)
    if cos_theta == -0.8 and isinstance(readout, AnalogReadout):
        (group,) = load("besiii-cgem-design").with_readout(readout).groups
        of_all = [one.mean(axis=1) for one in clusterer_of(readout).expected_errors(group)]
        expect(monkeypatch, AnalogReadout, of_all)
        wrong = analytic("besiii-cgem-design", "mu-", p=1.0, cos_theta=cos_theta, readout=readout)
        assert float(np.squeeze(wrong.sigma_dz)) < 0.96 * float(np.squeeze(expected.sigma_dz))


@cache
def tiger_run(second_pass: bool) -> Result:
    """Return muons of all angles with clusters of TIGER."""
    gun, readout = Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93)), TigerReadout(second_pass=second_pass)
    return run(load("besiii-cgem-design"), gun, 6000, seed=8, readout=readout)


#: Gates that clusters of the second pass miss: their view, quantity and range. Factors are those of many designs, whose
#: widths of pulls scatter by 10 % (docs/methods/readout.md); with 12 000 muons the width in X is 0.938 ± 0.004.
KNOWN_OFF = {True: {("x", "all"), ("v", "charge 0 to 0.1")}, False: set[tuple[str, str]]()}


@pytest.mark.parametrize("second_pass", [False, True])
def test_pulls_of_clusters_by_charge_and_size(second_pass: bool) -> None:
    """Errors hold for little and much charge and up to six strips; X clusters of more are those of delta electrons.

    These, 3 % of all, have a bias and no Gaussian core: their errors must be of the right order. Errors of the first
    pass are 9 % too large in X: slopes of muons of 1 GeV/c spread less than it assumes.
    """
    result = tiger_run(second_pass)
    clusters = result.fitted_hits[0]
    own = assign.own_clusters(result.detector, clusters, result.truths)
    pull = assign.residuals(result.detector, clusters, result.truths, own)
    pull /= np.where(clusters["view"] == 0, clusters["err_x"], clusters["err_v"])[own]
    within, off = 0.06 if second_pass else 0.1, set()
    for number, view in enumerate("xv"):
        mine = clusters["view"][own] == number
        charge, size = clusters["charge"][own], clusters["size"][own]
        ranges = {"all": (mine, within)}
        for low, high in itertools.pairwise((0, 0.1, 0.5, 0.9, 1)):
            least, most = np.quantile(charge[mine], (low, high))
            ranges[f"charge {low} to {high}"] = mine & (charge > least) & (charge <= most), within + 0.04
        for low, high in itertools.pairwise((0, 3, 4, 6)):
            ranges[f"{low + 1} to {high} strips"] = mine & (size > low) & (size <= high), within + 0.04
        off |= {(view, name) for name, (here, gate) in ranges.items() if abs(measure(pull[here]).core - 1) > gate}
        assert 0.6 < np.quantile(np.abs(pull[mine & (size > 6)]), 0.683) < 1.5
    assert off == KNOWN_OFF[second_pass]
