"""X and V clusters of one crossing whose errors are correlated: in the fit and without events."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit.chain.match import compare
from cgemit.detector import compiled
from cgemit.reconstruction.candidates import HIT_V, HIT_WIRE, HIT_X, HIT_XV, collect_hits
from cgemit.reconstruction.clusterers.gaussian import GaussianClusterer
from cgemit.reconstruction.fit import fit
from cgemit.tables import Table
from exact import EXACT, assert_pulls_are_standard_normal
from tracks import true_views

DESIGN = cg.load("besiii-cgem-design")
RHO = np.array([0.6, -0.5, 0.7])


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the correlation of the Gaussian read-out known."""
    monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_: RHO)


def correlated(result: cg.Result, rho: npt.NDArray[np.float64] | None = None) -> Table:
    """Return clusters whose V is smeared with X: the correlation is that of the column."""
    clusters = result.clusters
    layer, view = clusters["layer"], clusters["view"]
    v = clusters["v"].copy()
    xv = np.flatnonzero(view == 2)
    of_x, of_v = clusters["x_cluster"][xv], clusters["v_cluster"][xv]
    truth = clusters["truth"][xv]
    phi, z = (result.truths[name][truth] for name in ("phi", "z"))
    x_true, v_true = true_views(result.detector, layer[xv], clusters["sheet"][xv], phi, z)
    pulls = (clusters["x"][of_x] - x_true) / clusters["err_x"][of_x], (v[of_v] - v_true) / clusters["err_v"][of_v]
    mine = RHO[layer[xv]]
    v[of_v] = v_true + clusters["err_v"][of_v] * (mine * pulls[0] + np.sqrt(1 - mine**2) * pulls[1])
    return clusters.with_columns(v=v, corr_xv=(RHO if rho is None else rho)[layer])


@pytest.fixture(scope="module")
def muons() -> cg.Result:
    return cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), 1500, seed=6, settings=EXACT)


def tracks_of(result: cg.Result, clusters: Table) -> Table:
    """Return the tracks of other clusters, with their pulls."""
    given = (result.candidates, result.candidate_hits)
    tracks = fit(DESIGN, clusters, result.wire_hits, *given)["tracks"]
    row = np.searchsorted(result.particles["event"], tracks["event"])
    return tracks.with_columns(**compare(tracks, result.particles, row, compiled(DESIGN).field))


def test_two_clusters_are_a_point_with_their_correlation(muons: cg.Result) -> None:
    """Taken as X and V with a correlation, or as an XV point with a covariance, they are the same measurements."""
    clusters = correlated(muons)
    hits = muons.candidate_hits
    collected = collect_hits(DESIGN, muons.candidates, hits, clusters, muons.wire_hits)
    xv = np.flatnonzero(clusters["view"] == 2)
    of_x, of_v = clusters["x_cluster"][xv], clusters["v_cluster"][xv]
    points = {name: clusters[name].copy() for name in ("x", "v", "err_x", "err_v")}
    for name, rows in (("x", of_x), ("v", of_v), ("err_x", of_x), ("err_v", of_v)):
        points[name][xv] = clusters[name][rows]
    cov = np.zeros(len(clusters))
    cov[xv] = (clusters["corr_xv"] * points["err_x"] * points["err_v"])[xv]
    wires = hits["view"] == HIT_WIRE
    event = np.concatenate([hits["event"][wires], clusters["event"][xv]])
    order = np.argsort(event, kind="stable")
    columns = {
        "event": event, "candidate": np.concatenate([hits["candidate"][wires], clusters["event"][xv]]),
        "view": np.concatenate([hits["view"][wires], np.full(len(xv), HIT_XV)]),
        "row": np.concatenate([hits["row"][wires], xv]),
    }  # fmt: skip
    found = Table("candidate_hits", {name: column[order] for name, column in columns.items()}, muons.n_events)
    table = clusters.with_columns(**points, cov_xv=cov, corr_xv=np.zeros(len(clusters)))
    other = collect_hits(DESIGN, muons.candidates, found, table, muons.wire_hits)
    assert np.count_nonzero(collected.k) == np.count_nonzero(collected.kind == 1) == len(xv)
    for name in ("hit_offsets", "kind", "layer"):
        np.testing.assert_array_equal(getattr(collected, name), getattr(other, name))
    for name in ("value", "sigma", "k", "x"):
        np.testing.assert_allclose(getattr(collected, name), getattr(other, name), rtol=1e-12, atol=1e-12)


def test_pulls_of_tracks_are_standard_normal(muons: cg.Result) -> None:
    assert_pulls_are_standard_normal(tracks_of(muons, correlated(muons)))


def test_pulls_need_the_correlation(muons: cg.Result) -> None:
    """The same clusters with the other sign have wrong errors."""
    pulls = [tracks_of(muons, correlated(muons, rho))["pull_dr"].std() for rho in (RHO, -RHO)]
    assert abs(pulls[1] - 1) > 5 * abs(pulls[0] - 1)
    assert abs(pulls[1] - 1) > 0.1


def test_clusters_that_are_not_alone_have_no_correlation(muons: cg.Result) -> None:
    """Of two X clusters of a sheet it is not known which one belongs to V; an X or V cluster alone has no other."""
    clusters, hits = correlated(muons), muons.candidate_hits
    first = hits["event"] == 0
    rows = np.flatnonzero(first & (hits["view"] == HIT_X))
    twice = clusters.with_columns(event=np.where(clusters["event"] == 1, 0, clusters["event"]))
    of_next = np.flatnonzero((clusters["event"] == 1) & (clusters["view"] == 0))
    more = of_next[clusters["layer"][of_next] == clusters["layer"][hits["row"][rows[0]]]][:1]
    moved = twice.with_columns(
        sheet=np.where(np.arange(len(clusters)) == more[0], clusters["sheet"][hits["row"][rows[0]]], clusters["sheet"])
    )

    def ks(chosen: npt.NDArray[np.bool_], extra: npt.NDArray[np.int64]) -> int:
        columns = {name: hits[name][first & chosen] for name in ("event", "candidate", "view", "row")}
        added = {"event": 0, "candidate": 0, "view": HIT_X}
        columns = {
            name: np.concatenate([column, extra if name == "row" else np.full(len(extra), added[name], column.dtype)])
            for name, column in columns.items()
        }
        candidates = Table(
            "candidates", {name: muons.candidates[name][:1] for name in muons.candidates.columns}, muons.n_events
        )
        table = Table("candidate_hits", columns, muons.n_events)
        return int(np.count_nonzero(collect_hits(DESIGN, candidates, table, moved, muons.wire_hits).k))

    every = np.ones(len(hits), np.bool_)
    none = np.empty(0, np.int64)
    assert ks(every, none) == 3
    assert ks(every, more) == 2
    assert ks(hits["view"] != HIT_X, none) == 0
    assert ks(hits["view"] != HIT_V, none) == 0


@pytest.mark.parametrize("rho", [1.0, -1.5, np.nan])
def test_impossible_correlations_are_refused(muons: cg.Result, rho: float) -> None:
    clusters = correlated(muons, np.array([0.0, rho, 0.0]))
    row = np.flatnonzero((clusters["layer"] == 1) & (clusters["view"] == 1))[0]
    with pytest.raises(ValueError, match=rf"clusters row {row}: corr_xv: got {rho:g}, expected a number between -1"):
        tracks_of(muons, clusters)


@pytest.mark.parametrize("radius", [None, 121.0])
def test_covariance_without_events(radius: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is that of fits, at the origin and at a radius, and without the correlation it is another one."""
    settings = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="off"),
        digitize=cg.DigitizeSettings(readout="gaussian", reveal_sides=True),
    )
    result = cg.run(DESIGN, cg.Gun("mu-", p=0.7, cos_theta=0.4, phi=0.3), 200, seed=3, settings=settings)
    fit_settings = cg.FitSettings(outlier_pull=0, kinks=False, states=() if radius is None else (radius,))
    hits = (result.wire_hits, result.candidates, result.candidate_hits)
    tables = fit(DESIGN, correlated(result), *hits, fit_settings)
    mean = tables["tracks" if radius is None else "states"]["cov"].mean(axis=0)
    scale = np.sqrt(np.diagonal(mean))
    unit = np.outer(scale, scale)
    how = {"phi": 0.3, "reveal_sides": True} | ({} if radius is None else {"radius": radius})
    other = cg.analytic(DESIGN, "mu-", 0.7, 0.4, readout="gaussian", **how).cov
    monkeypatch.setattr(GaussianClusterer, "expected_correlations", lambda *_: RHO)
    found = cg.analytic(DESIGN, "mu-", 0.7, 0.4, readout="gaussian", **how).cov
    assert np.abs((np.squeeze(found) - mean) / unit).max() < 0.01
    assert np.abs((np.squeeze(other) - mean) / unit).max() > 0.05


@pytest.mark.usefixtures("known")
def test_budget_adds_up() -> None:
    found = cg.analytic(DESIGN, "mu-", 0.7, 0.4, phi=0.3, readout="gaussian")
    budget = found.budget("dr")
    np.testing.assert_allclose(budget.total, found.sigma_dr**2, rtol=1e-10)
