"""How well a finder finds: efficiency, fakes, clones and purity (docs/methods/match.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.result import Result
from cgemit.stages import finder_of
from cgemit.statistics.fractions import Fraction
from cgemit.study.finding_definitions import CLASSES, CLONE, DECAY, FAKE, LOOP, MATCHED, acts, belle2, findable_of
from cgemit.study.found_hits import CandidateCounts, ParticleCounts, count_candidates, count_particles
from cgemit.study.optimizer.geometry import channels as strips
from cgemit.tables import Table

Rows = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]
Definition = Literal["belle2", "acts"]
Quantity = Literal["pt", "cos_theta", "phi", "distance", "tracks", "occupancy"]


@dataclass(frozen=True)
class FindingRates:
    """Rates by one definition.

    Attributes
    ----------
    efficiency : Fraction
        Findable particles with a track.
    fakes : Fraction
        Candidates that belong to no particle.
    clones : Fraction
        Further candidates of a particle, among those of a particle.
    decays : Fraction
        Candidates of the daughters of a decay, the parent having its own, among all.
    loops : Fraction
        Loop clones, that is candidates whose own hits are mostly of other half turns than the first, among all.
    """

    efficiency: Fraction
    fakes: Fraction
    clones: Fraction
    decays: Fraction
    loops: Fraction


@dataclass(frozen=True, eq=False)
class Finding:
    """What a finder found of the particles of a run.

    Attributes
    ----------
    finder, detector : str
    candidates : CandidateCounts
        Hits of each candidate.
    particles : ParticleCounts
        Measurements of each particle.
    classes : mapping of str to ndarray, (candidates,) int8
        By definition, ``"belle2"`` or ``"acts"``: index into `CLASSES`; -1 for candidates without hits.
    charged, findable : ndarray, (particles,) bool
    removed : mapping of str to int
        Charged particles that are not findable, by reason.
    pt, cos_theta, phi, distance : ndarray, (particles,) float64
        GeV/c, 1, rad, and mm: true transverse momentum, polar angle, azimuth of the flight, and distance of the vertex
        from the beam line.
    tracks : ndarray, (particles,) int64
        Findable particles in the event.
    occupancy : ndarray, (particles,) float64
        Share of the cells, without a chamber of the strips, that are hit in the event, in %.
    """

    finder: str
    detector: str
    candidates: CandidateCounts
    particles: ParticleCounts
    classes: Mapping[str, npt.NDArray[np.int8]]
    charged: Flags
    findable: Flags
    removed: Mapping[str, int]
    pt: Floats
    cos_theta: Floats
    phi: Floats
    distance: Floats
    tracks: Rows
    occupancy: Floats

    def found(self, definition: Definition = "belle2") -> Flags:
        """Return which particles have a track.

        Parameters
        ----------
        definition : str

        Returns
        -------
        ndarray, (particles,) bool
        """
        found = np.zeros(len(self.charged), np.bool_)
        found[self.candidates.particle[self.classes[definition] == MATCHED]] = True
        return found

    def rates(self, definition: Definition = "belle2", among: npt.ArrayLike | None = None) -> FindingRates:
        """Return efficiency, fakes and clones.

        Parameters
        ----------
        definition : str
            ``"belle2"`` or ``"acts"``.
        among : array_like or None
            (particles,) bool, the particles that count in the efficiency; None: all findable ones. Fakes and clones
            are of all candidates.
        """
        which = self.findable if among is None else self.findable & np.asarray(among, np.bool_)
        n = [int(np.count_nonzero(self.classes[definition] == number)) for number in range(len(CLASSES))]
        return FindingRates(
            efficiency=Fraction(int(np.count_nonzero(self.found(definition) & which)), int(np.count_nonzero(which))),
            fakes=Fraction(n[FAKE], sum(n)),
            clones=Fraction(n[CLONE], n[MATCHED] + n[CLONE]),
            decays=Fraction(n[DECAY], sum(n)),
            loops=Fraction(n[LOOP], sum(n)),
        )

    @property
    def purity(self) -> float:
        """Mean share of a matched track's hits that its particle left; Belle II."""
        counts, matched = self.candidates, self.classes["belle2"] == MATCHED
        return float(np.mean(counts.of_particle[matched] / counts.hits[matched])) if matched.any() else float("nan")

    @property
    def hit_efficiency(self) -> float:
        """Mean share of a matched particle's measurements on its first half turn that its track has; Belle II."""
        counts, matched = self.candidates, self.classes["belle2"] == MATCHED
        left = np.maximum(self.particles.hits[counts.particle[matched]], 1)
        return float(np.mean(counts.found[matched] / left)) if matched.any() else float("nan")

    def against(self, quantity: Quantity, edges: npt.ArrayLike) -> list[Fraction]:
        """Return the efficiency in bins of a true quantity.

        Parameters
        ----------
        quantity : str
        edges : array_like, (bins + 1,)
            Increasing.
        """
        value, bounds, found = getattr(self, quantity), np.asarray(edges, np.float64), self.found()
        place = np.digitize(value, bounds) - 1
        return [
            Fraction(
                int(np.count_nonzero(found & self.findable & (place == i))),
                int(np.count_nonzero(self.findable & (place == i))),
            )
            for i in range(len(bounds) - 1)
        ]

    def rows(self) -> list[tuple[str, str]]:
        """Return the results as text, name and value."""
        rows = [("finder", self.finder), ("detector", self.detector)]
        share = Fraction(int(self.findable.sum()), int(self.charged.sum()))
        rows += [("findable", str(share)), *((f"  without: {name}", f"{n:,}") for name, n in self.removed.items())]
        for definition, name in (("belle2", "Belle II"), ("acts", "ACTS")):
            of = self.rates(definition)  # type: ignore[arg-type]
            rows += [(f"efficiency ({name})", str(of.efficiency)), (f"fakes ({name})", str(of.fakes))]
            rows += [(f"clones ({name})", str(of.clones))]
        rows.append(("tracks of decay products", str(self.rates().decays)))
        rows.append(("loop clones", str(self.rates().loops)))
        rows += [("hit purity", f"{100 * self.purity:.2f} %"), ("hit efficiency", f"{100 * self.hit_efficiency:.2f} %")]
        return rows

    def __repr__(self) -> str:
        return "\n".join(["Finding", *(f"  {name:<48}{text}" for name, text in self.rows())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self.rows())
        return f"<table>{rows}</table>"


def finding(result: Result) -> Finding:
    """Compare the candidates of a simulated run with its particles.

    Parameters
    ----------
    result : Result
        Of a run up to the stage ``"find"`` or later.

    Returns
    -------
    Finding

    Raises
    ------
    ValueError
        If the run ended before.
    """
    if "candidates" not in result.tables:
        expected = "a run with until='find' or 'fit' that keeps all tables"
        raise ValueError(f"finding: got a result without candidates; expected {expected}")
    of_candidate, of_particle = count_candidates(result), count_particles(result)
    particles = result.particles
    charged = np.asarray(particles["charge"] != 0)
    findable, removed = findable_of(of_particle, charged)
    px, py, pz = (particles[f"p{axis}"] for axis in "xyz")
    pt = np.hypot(px, py)
    return Finding(
        finder=finder_of(result.candidates),
        detector=result.detector.name,
        candidates=of_candidate,
        particles=of_particle,
        classes={"belle2": belle2(of_candidate, of_particle), "acts": acts(of_candidate)},
        charged=charged,
        findable=findable,
        removed=removed,
        pt=pt,
        cos_theta=pz / np.maximum(np.hypot(pt, pz), 1e-300),
        phi=np.arctan2(py, px),
        distance=np.hypot(particles["x"], particles["y"]),
        tracks=_of_event(particles, particles["event"][findable]),
        occupancy=_occupancy(result),
    )


def _of_event(particles: Table, rows: Rows) -> Rows:
    """Return how many of some rows, given by their events, are in the event of each particle, (particles,) int64."""
    events, counts = np.unique(rows, return_counts=True)
    place = np.minimum(np.searchsorted(events, particles["event"]), max(len(events) - 1, 0))
    return (
        np.where(events[place] == particles["event"], counts[place], 0)
        if len(events)
        else np.zeros(len(particles), np.int64)
    )


def _occupancy(result: Result) -> Floats:
    """Return the share of cells, or of strips, hit in the event of each particle, (particles,) float64 in %."""
    detector = result.detector
    chamber = detector.drift_chamber
    if chamber:
        channels, hits = sum(layer.cells for layer in chamber.layers), result.wire_hits["event"]
    else:
        channels = int(strips(detector))
        hits = result.digis["event"][result.digis["strip"] >= 0]
    return 100 * _of_event(result.particles, hits) / max(channels, 1)


def curve(of: Finding, quantity: str, edges: Floats) -> dict[str, Any]:
    """Return the efficiency in bins as columns: low and high edge, found, findable, efficiency and its interval.

    Parameters
    ----------
    of : Finding
    quantity : str
    edges : ndarray, (bins + 1,) float64
    """
    fractions = of.against(quantity, edges)  # type: ignore[arg-type]
    interval = np.array([fraction.interval() for fraction in fractions]).reshape(-1, 2)
    return {
        "low": edges[:-1], "high": edges[1:],
        "found": np.array([fraction.count for fraction in fractions]),
        "findable": np.array([fraction.n for fraction in fractions]),
        "efficiency": np.array([fraction.value for fraction in fractions]),
        "efficiency_low": interval[:, 0], "efficiency_high": interval[:, 1],
    }  # fmt: skip
