"""Reconstruction: find tracks, fit them, refine their hits, and repeat (docs/methods/reconstruct.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from cgemit.detector import Detector, load
from cgemit.detector.channels import checked
from cgemit.reconstruction.candidates import Finder, by_finder
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.reconstruction.points import settle_points
from cgemit.reconstruction.refine import Hits, Refinement, Turn
from cgemit.reconstruction.states import SurfaceName
from cgemit.tables import Table

#: States that refinements take: at the origin, and at every measurement.
_STATES: tuple[SurfaceName, ...] = ("origin", "hits")


@checked("clusters", "wire_hits", "digis", ignore=("gid",))
def reconstruct(
    detector: Detector | str | Mapping[str, Any],
    clusters: Table,
    wire_hits: Table,
    finder: Finder,
    settings: FitSettings | None = None,
    *,
    refinements: Sequence[Refinement] = (),
    find_again: bool = True,
    compete: bool = False,
    digis: Table | None = None,
) -> dict[str, Table]:
    """Reconstruct tracks from clusters and wire hits, simulated or real.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        Field and material that finder and fit assume.
    clusters, wire_hits : Table
        As measured, of the same events.
    finder : callable
        A function of (detector, clusters, wire_hits), such as `find_tracks`.
    settings : FitSettings or None
        Of the fit.
    refinements : sequence of Refinement
        What fitted tracks correct of their hits; `refinements` makes them from settings. They act in this order.
    find_again : bool
        Whether tracks are found a second time with the corrected hits.
    compete : bool
        Whether clusters of CGEM layers compete for the tracks before the last fit; ``candidate_hits`` then has the
        columns `margin` and `ambiguous`.
    digis : Table or None
        Strips of the clusters, which `ClusterDirection` needs.

    Returns
    -------
    dict of str to Table
        ``candidates``, ``candidate_hits`` and what else the finder makes, ``tracks`` and what else `fit` makes;
        ``refined_clusters`` and ``refined_wire_hits``, row by row those measured, where a refinement corrects them;
        ``start_times`` if they are fitted.

    Raises
    ------
    TypeError
        If the settings are something else.
    ValueError
        Listing every problem of the tables, as finder and fit do.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5, until="cluster")
    >>> tables = cg.reconstruct(r.detector, r.clusters, r.wire_hits, cg.find_tracks)
    >>> tables["tracks"]["n_clusters"].tolist()
    [6, 6, 6, 6, 6]
    """
    tables: dict[str, Table] = {}
    measured, settings = Hits(clusters, wire_hits, digis), FitSettings.of(settings)
    how = {"find_again": find_again, "compete": compete}
    for _, made in turns(load(detector), measured, finder, settings, refinements, **how):
        tables |= made
    return tables


def turns(
    detector: Detector,
    measured: Hits,
    finder: Finder,
    settings: FitSettings,
    refinements: Sequence[Refinement] = (),
    *,
    find_again: bool = True,
    compete: bool = False,
) -> Iterator[tuple[str, dict[str, Table]]]:
    """Yield the tables of each step of `reconstruct` after its name, ``"find"`` or ``"fit"``; later ones count.

    The number of turns is fixed: hits that stop moving cannot end them, since events of one chunk would then depend
    on each other.
    """
    last = max((one.turns for one in refinements), default=1) - 1 + (find_again and bool(refinements))
    single = settings.hypothesis if len(settings.hypotheses()) == 1 else None
    states = _STATES if any(one.needs_states for one in refinements) else ()
    early = settings
    if last > 0:
        early = replace(settings, residuals=True, states=states, hypothesis=single, components=False, beam=None)
    hits = measured
    for refinement in refinements:
        hits = refinement.guess(detector, hits)
    candidates = by_finder(finder, detector, hits.clusters, hits.wire_hits)
    yield "find", candidates
    for turn_number in range(last):
        if turn_number == 1 and find_again:
            candidates = by_finder(finder, detector, hits.clusters, hits.wire_hits)
            yield "find", candidates
        fitted = _fitted(detector, hits, candidates, early)
        turn = Turn(turn_number, last + 1, hits, candidates["candidates"], candidates["candidate_hits"], **fitted)
        hits = measured
        for refinement in refinements:
            hits = refinement.refine(detector, hits, turn)
        yield "fit", {}
    if compete:
        candidates = settle_points(detector, hits.clusters, hits.wire_hits, candidates, settings)
    tables = {**candidates, **_fitted(detector, hits, candidates, settings), **hits.refined(measured)}
    for refinement in refinements:
        tables |= refinement.finish(detector, tables)
    yield "fit", tables


def _fitted(detector: Detector, hits: Hits, candidates: Mapping[str, Table], settings: FitSettings) -> dict[str, Table]:
    """Fit the candidates that were found."""
    tables = (hits.clusters, hits.wire_hits, candidates["candidates"], candidates["candidate_hits"])
    return fit.unchecked(detector, *tables, settings)
