"""The chain on one screen: particles -> truths -> digis -> clusters -> candidates -> tracks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from cgemit import find
from cgemit.background import add_background
from cgemit.detector import Detector
from cgemit.digitize import cluster_digis, digitize
from cgemit.find.tracks import find_tracks
from cgemit.finders import by_finder
from cgemit.fit import fit
from cgemit.match import match
from cgemit.second_pass import along_tracks
from cgemit.simulate import simulate
from cgemit.stages import FinderLike, Settings, fit_settings
from cgemit.start_times import corrected
from cgemit.tables import Table
from cgemit.wire_times import along_tracks as times_along_tracks
from cgemit.wire_times import expected


def run_chunk(
    detector: Detector,
    fit_detector: Detector,
    particles: Table,
    settings: Settings,
    seed: int,
    finder: FinderLike = "truth",
    until: str = "fit",
) -> tuple[dict[str, Table], dict[str, float]]:
    """Run the stages on the events of one table of particles.

    Parameters
    ----------
    detector, fit_detector : Detector
        The detector that is simulated and digitized, and the one that finder and fit assume.
    particles : Table of kind "particles"
    settings : Settings
    seed : int
    finder : "truth", "ckf" or callable
    until : str
        The last stage, one of `cgemit.run_checks.STAGES`. After the fit, tracks are matched with particles.

    Returns
    -------
    tables : dict of str to Table
    timings : dict of str to float, s
        Wall time of each stage.
    """
    tables: dict[str, Table] = {}
    raw_times = settings.digitize.wire_times == "raw"
    raw_hits: list[Table] = []  # before they are corrected

    def pick(*names: str) -> tuple[Any, ...]:
        return tuple(tables[name] for name in names)

    hits, truth, found = ("clusters", "wire_hits"), ("truths", "wire_truths"), ("candidates", "candidate_hits")

    def find_in(wire_hits: Table) -> Mapping[str, Table]:
        if callable(finder):
            return by_finder(finder, fit_detector, tables["clusters"], wire_hits)
        if finder == "ckf":
            return find_tracks(fit_detector, tables["clusters"], wire_hits, settings.find)
        return find.by_truth(detector, *pick("particles", *hits, *truth))

    def find_first() -> Mapping[str, Table]:
        if not raw_times:
            return find_in(tables["wire_hits"])
        raw_hits.append(tables["wire_hits"])
        wire_hits = expected(fit_detector, tables["wire_hits"])
        return {"wire_hits": wire_hits, **find_in(wire_hits)}

    def find_again() -> Mapping[str, Table]:
        fitted = fit_and_correct()
        if "start_times" in fitted:
            return find_in(corrected(tables["wire_hits"], fitted["start_times"]))
        return find_in(tables["wire_hits"])

    def fit_clusters(clusters: Table) -> Mapping[str, Table]:
        candidates, candidate_hits = pick(*found)
        return fit(fit_detector, clusters, tables["wire_hits"], candidates, candidate_hits, fit_settings(settings))

    def fit_and_correct() -> Mapping[str, Table]:
        fitted = fit_clusters(tables["clusters"])
        if raw_times:
            candidates, candidate_hits = pick(*found)
            tables["wire_hits"] = times_along_tracks(
                fit_detector, raw_hits[0], candidates, candidate_hits, fitted["tracks"]
            )
        return fitted

    def fit_last() -> Mapping[str, Table]:
        if raw_times:
            fit_and_correct()
        return fit_clusters(tables["clusters"])

    def second_pass() -> Mapping[str, Table]:
        readout, hits = settings.digitize.readout, tables["candidate_hits"]
        digis, clusters, tracks = pick("digis", "clusters", "tracks")
        again = along_tracks(detector, readout, digis, clusters, hits, tracks, settings.cluster)
        return {"clusters": again, **fit_clusters(again)}

    stages: dict[str, Callable[[], Mapping[str, Table]]] = {
        "simulate": lambda: simulate(detector, particles, settings.simulate, seed),
        "digitize": lambda: add_background(
            detector,
            **digitize(
                detector, tables["truths"], tables["wire_truths"], settings.digitize, seed, steps=tables["steps"]
            ),
            settings=settings.background,
            seed=seed,
        ),
        "cluster": lambda: {
            "clusters": cluster_digis(detector, tables["digis"], settings.digitize, settings.cluster)
        },
        "find": find_first,
        "fit": fit_last,
        "match": lambda: match(*pick("tracks", *found, *hits, "particles", *truth), detector=detector),
    }  # fmt: skip
    if (raw_times or settings.fit.start_time == "fitted") and finder != "truth" and until == "fit":
        rest = {name: stages.pop(name) for name in ("fit", "match")}
        stages |= {"find again": find_again, **rest}
    if getattr(settings.digitize.readout, "second_pass", False):
        last = stages.pop("match")
        stages |= {"second pass": second_pass, "match": last}
    seconds = {}
    for stage, work in stages.items():
        start = time.perf_counter()
        tables |= work()
        seconds[stage] = time.perf_counter() - start
        if stage == until != "fit":
            break
    return tables, seconds
