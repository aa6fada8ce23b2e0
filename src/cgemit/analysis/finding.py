"""Efficiency, fakes, clones and purity of a finder (docs/methods/match.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.analysis.widths import Fraction
from cgemit.base.arrays import Flags, Floats, Rows
from cgemit.chain.result import Result
from cgemit.chain.settings import finder_of, mass_by
from cgemit.detector.inventory import channels as strips
from cgemit.reconstruction.find.ckf import SeedLayers, have_seeds, wire_layers
from cgemit.reconstruction.find.loops import link_loops
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_X, has_momentum
from cgemit.tables.show import Shown
from cgemit.truth.assign import own_clusters
from cgemit.truth.match import CandidateCounts, MatchStatus, acts, belle2, count_candidates
from cgemit.truth.origins import have_flown, origins_of


class ParticleCounts(NamedTuple):
    """Numbers of measurements of each particle on its first half turn, before any decay; all of shape (particles,).

    Attributes
    ----------
    x_layers, v_layers : ndarray, int64
        Layers with an X cluster, with a V cluster.
    crossed : ndarray, int64
        Pairs of these V clusters with stereo angles of opposite sign, strips along z or around it left out. Each pair
        measures one coordinate across the beam and one along it.
    wires, stereo : ndarray, int64
        Cells of the drift chamber, and of its stereo layers alone.
    hits : ndarray, int64
        Crossings of a gap with a cluster, counted per view, and cells.
    layers : SeedLayers
        Layers with these measurements, as a seed of the finder needs them.
    """

    x_layers: Rows
    v_layers: Rows
    crossed: Rows
    wires: Rows
    stereo: Rows
    hits: Rows
    layers: SeedLayers


#: Cosine of the stereo angle of V strips that measure z alone.
_ALONG = 1e-6


def count_particles(result: Result) -> ParticleCounts:
    """Return the measurements of each particle."""
    particles, clusters, wire_hits = result.particles, result.clusters, result.wire_hits
    n = len(particles)
    rows = own_clusters(result.detector, clusters, result.truths)
    of_truth = origins_of(particles, result.truths)
    truth = clusters["truth"][rows]
    mine = of_truth.first[truth]
    rows, truth = rows[mine], truth[mine]
    views = len(result.detector.layers) * 2
    seen = np.zeros((n, views), np.bool_)
    seen[of_truth.owner[truth], clusters["layer"][rows] * 2 + clusters["view"][rows]] = True
    x, v = seen[:, HIT_X::2], seen[:, HIT_V::2]
    stereo_angle = np.array([layer.stereo for layer in result.detector.layers])
    sign = np.where(np.abs(np.cos(stereo_angle)) > _ALONG, np.sign(stereo_angle), 0)
    crossed = np.minimum(v[:, sign > 0].sum(axis=1), v[:, sign < 0].sum(axis=1))
    of_wire = origins_of(particles, result.wire_truths).linked(wire_hits["wire_truth"])
    twist = np.array([layer.twist for layer in wire_layers(result.detector)])
    tilted = twist != 0
    fired = np.zeros((n, len(tilted)), np.bool_)
    on = of_wire.first
    numbers = [layer.number for layer in wire_layers(result.detector)]
    owner, layer = of_wire.owner[on], np.searchsorted(numbers, wire_hits["layer"][on])
    fired[owner, layer] = True
    wires, stereo = (np.bincount(owner[which], minlength=n) for which in (slice(None), tilted[layer]))
    crossings = np.bincount(of_truth.owner[truth], minlength=n)
    axial_layers, plus, minus = (fired[:, which].sum(axis=1) for which in (~tilted, twist > 0, twist < 0))
    across, along = x.sum(axis=1), v.sum(axis=1)
    return ParticleCounts(
        across, along, crossed, wires, stereo, (crossings + wires).astype(np.int64),
        SeedLayers(x & v, axial_layers + across, plus + minus + along, np.stack([plus, minus], axis=1)),
    )  # fmt: skip


def findable_of(of: ParticleCounts, charged: Flags) -> tuple[Flags, dict[str, int]]:
    """Return which particles are findable, (particles,) bool, and how many charged ones each condition removes.

    A helix has five parameters, three across the beam and two along it; one measurement more tests it.

    Parameters
    ----------
    of : ParticleCounts
    charged : ndarray, (particles,) bool
    """

    def measure(across: int, along: int) -> Flags:
        pairs = np.maximum(across - of.x_layers, 0)  # of V in the place of X
        return (pairs <= of.crossed) & (of.v_layers - pairs >= along)

    two = measure(2, 2)
    layers = measure(3, 2) & (of.x_layers + of.v_layers >= 6)
    chamber = (of.wires >= 10) & (of.stereo >= 3)
    findable = charged & (layers | two & (of.wires >= 3) | chamber)
    not_findable = charged & ~findable
    reasons: dict[str, Flags] = {
        "no hit at all": of.hits == 0,
        "3 stereo wires among 10 or more": of.wires >= 10,
        "3 wires, or 6 coordinates, beside X and V in 2 layers": two,
        "10 wires, or X and V in 2 layers": np.ones(len(not_findable), np.bool_),
    }
    removed: dict[str, int] = {}
    for name, which in reasons.items():
        removed[name] = int(np.count_nonzero(not_findable & which))
        not_findable = not_findable & ~which
    return findable, removed


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
        Further candidates of a particle, among all that belong to particles.
    decays : Fraction
        Candidates of the daughters of a decay, among all.
    loops : Fraction
        Loop clones among all candidates: most of their own hits are on later half turns.
    short : Fraction
        Matched candidates cut short: with less than half of their particle's measurements.
    wrong_z : Fraction
        Matched tracks wrong in z, among those that were fitted (status `ok`): d_z or tan(lambda) is more than 8 errors
        from the particle's, with every mass hypothesis. Without fitted tracks, none of none.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20, finder="ckf")
    >>> rates = cg.study.finding(result).rates("acts")
    >>> rates.efficiency.value, rates.fakes.count
    (1.0, 0)
    """

    efficiency: Fraction
    fakes: Fraction
    clones: Fraction
    decays: Fraction
    loops: Fraction
    short: Fraction
    wrong_z: Fraction


@dataclass(frozen=True, eq=False, repr=False)
class Finding(Shown):
    """Efficiency, fakes and clones of a finder in a run.

    Attributes
    ----------
    finder, detector : str
    mass : str
        Particle whose mass the finder assumed, as text.
    candidates : CandidateCounts
        Hits of each candidate.
    particles : ParticleCounts
        Measurements of each particle.
    classes : mapping of str to ndarray, (candidates,) int8
        By definition, ``"belle2"`` or ``"acts"``: `MatchStatus` of each candidate.
    charged, findable : ndarray, (particles,) bool
    seedless : ndarray, (particles,) bool
        Findable particles that left measurements only in layers in which no seed of `find_tracks` can be made, with the
        settings of the run.
    fitted, wrong_z : ndarray, (candidates,) bool
        Candidates with a fitted track (status `ok`), and those of them that are wrong in z (`FindingRates`).
    removed : mapping of str to int
        Charged particles that are not findable, by reason.
    pt, cos_theta, phi, distance : ndarray, (particles,) float64
        GeV/c, 1, rad, and mm: true transverse momentum, polar angle, azimuth of the flight, and distance of the vertex
        from the beam line.
    tracks : ndarray, (particles,) int64
        Findable particles in the event.
    occupancy : ndarray, (particles,) float64
        Fraction of the cells that are hit in the event, in %; of the strips for a detector without a chamber.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20, finder="ckf")
    >>> found = cg.study.finding(result)
    >>> print(found.finder, found.findable.sum(), found.rates().efficiency.value)
    ckf 20 1.0
    """

    finder: str
    detector: str
    mass: str
    candidates: CandidateCounts
    particles: ParticleCounts
    classes: Mapping[str, npt.NDArray[np.int8]]
    charged: Flags
    findable: Flags
    seedless: Flags
    fitted: Flags
    wrong_z: Flags
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
        is_found = np.zeros(len(self.charged), np.bool_)
        is_found[self.candidates.particle[self.classes[definition] == MatchStatus.matched]] = True
        return is_found

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
        classes = self.classes[definition]
        known, clone = classes != MatchStatus.no_hits, classes == MatchStatus.clone
        matched, counts = classes == MatchStatus.matched, self.candidates
        return FindingRates(
            efficiency=_fraction(self.found(definition), which),
            fakes=_fraction(classes == MatchStatus.fake, known),
            clones=_fraction(clone, matched | clone),
            decays=_fraction(classes == MatchStatus.decay_daughter, known),
            loops=_fraction(classes == MatchStatus.other_half_turn, known),
            short=_fraction(2 * counts.found < counts.left, matched),
            wrong_z=_fraction(self.wrong_z, matched & self.fitted),
        )

    @property
    def purity(self) -> float:
        """Mean share of a matched track's hits that its particle left; Belle II."""
        counts, matched = self.candidates, self.classes["belle2"] == MatchStatus.matched
        return float(np.mean(counts.of_particle[matched] / counts.hits[matched])) if matched.any() else float("nan")

    @property
    def hit_efficiency(self) -> float:
        """Mean share of a matched particle's measurements on its first half turn that its track has; Belle II."""
        counts, matched = self.candidates, self.classes["belle2"] == MatchStatus.matched
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
        bounds, is_found = np.asarray(edges, np.float64), self.found()
        bin_of = np.digitize(getattr(self, quantity), bounds) - 1
        return [_fraction(is_found, self.findable & (bin_of == i)) for i in range(len(bounds) - 1)]

    def rows(self) -> list[tuple[str, str]]:
        """Return the results as text, name and value."""
        rows = [("finder", self.finder), ("mass assumed", self.mass), ("detector", self.detector)]
        share = _fraction(self.findable, self.charged)
        rows += [("findable", str(share)), *((f"  without: {name}", f"{n:,}") for name, n in self.removed.items())]
        rows.append(("findable, in layers that make no seed", f"{np.count_nonzero(self.seedless):,}"))
        for definition, name in (("belle2", "Belle II"), ("acts", "ACTS")):
            of = self.rates(definition)  # type: ignore[arg-type]
            rows += [(f"efficiency ({name})", str(of.efficiency)), (f"fakes ({name})", str(of.fakes))]
            rows += [(f"clones ({name})", str(of.clones))]
        rows.append(("tracks of decay products", str(self.rates().decays)))
        rows.append(("loop clones", str(self.rates().loops)))
        rows.append(("matched tracks cut short", str(self.rates().short)))
        rows.append(("matched tracks wrong in z", str(self.rates().wrong_z)))
        rows += [("hit purity", f"{100 * self.purity:.2f} %"), ("hit efficiency", f"{100 * self.hit_efficiency:.2f} %")]
        return rows

    def _table(self) -> tuple[str, tuple[str, str], list[tuple[str, str]]]:
        return "Finding", ("quantity", "value"), self.rows()


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

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20, finder="ckf")
    >>> found = cg.study.finding(result)
    >>> print(found.rates().efficiency)
    100.00 % (+0.00 -4.76; 20 of 20)
    """
    if "candidates" not in result.tables:
        expected = "a run with until='find' or 'fit' that keeps all tables"
        raise ValueError(f"finding: got a result without candidates; expected {expected}")
    of_candidate, of_particle = count_candidates(result.detector, result.tables), count_particles(result)
    particles = result.particles
    charged = have_flown(particles)
    findable, removed = findable_of(of_particle, charged)
    seeds = have_seeds(result.fit_detector or result.detector, of_particle.layers, result.settings.find)
    fitted, wrong_z = _wrong_in_z(result)
    px, py, pz = (particles[f"p{axis}"] for axis in "xyz")
    pt = np.hypot(px, py)
    return Finding(
        finder=finder_of(result.candidates),
        detector=result.detector.name,
        mass=mass_by(result.candidates.meta),
        candidates=of_candidate,
        particles=of_particle,
        classes={"belle2": belle2(of_candidate), "acts": acts(of_candidate)},
        charged=charged,
        findable=findable,
        seedless=findable & ~np.any(seeds, axis=0),
        fitted=fitted,
        wrong_z=wrong_z,
        removed=removed,
        pt=pt,
        cos_theta=pz / np.maximum(np.hypot(pt, pz), 1e-300),
        phi=np.arctan2(py, px),
        distance=np.hypot(particles["x"], particles["y"]),
        tracks=_of_event(particles, particles["event"][findable]),
        occupancy=_occupancy(result),
    )


#: Errors of the fit; pulls beyond are no fluctuations.
_WRONG = 8.0


def _wrong_in_z(result: Result) -> tuple[Flags, Flags]:
    """Return which candidates have fitted tracks, and which of these are wrong in z; both (candidates,) bool."""
    n = len(result.candidates)
    if "matches" not in result.tables:
        return np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    tracks, matches = result.fitted, result.matches
    ok = has_momentum(tracks)
    near = np.abs([matches[f"pull_{name}"] for name in ("dz", "tanl")]).max(axis=0) <= _WRONG
    fitted, right = (np.bincount(tracks["candidate"][which], minlength=n) > 0 for which in (ok, ok & near))
    return fitted, fitted & ~right


def _of_event(particles: Table, rows: Rows) -> Rows:
    """Return the number of rows in the event of each particle, (particles,) int64; `rows` are the events of rows."""
    events, counts = np.unique(rows, return_counts=True)
    row = np.minimum(np.searchsorted(events, particles["event"]), max(len(events) - 1, 0))
    return (
        np.where(events[row] == particles["event"], counts[row], 0)
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


@dataclass(frozen=True, eq=False, repr=False)
class LoopLinks(Shown):
    """Links of a run's fitted tracks to the first half turns of their particles.

    Attributes
    ----------
    first : ndarray, (tracks,) int64
        Row of the track that each track is linked to; its own if none.
    found : Finding
        Comparison of the candidates with the particles.
    before, after : Fraction
        Loop clones among all candidates, and among those that are not linked to another one.
    wrong : Fraction
        Links of tracks of two particles, among all links.
    lost : Fraction
        Particles whose matched track is linked to another track and so no longer kept, among those with one.

    Examples
    --------
    >>> settings = cg.Settings(simulate=cg.SimulateSettings(half_turns=3))
    >>> result = cg.run("besiii-cgem", cg.Gun("pi-", pt=0.1, cos_theta=0.2), n=5, settings=settings)
    >>> links = cg.study.loop_links(result)
    >>> len(links.first) == len(result.tracks)
    True
    """

    first: Rows
    found: Finding
    before: Fraction
    after: Fraction
    wrong: Fraction
    lost: Fraction

    def rows(self) -> list[tuple[str, str]]:
        """Return the results as text, name and value."""
        return [
            ("loop clones after linking", str(self.after)),
            ("links of two particles", str(self.wrong)),
            ("first half turns linked to another track", str(self.lost)),
        ]

    def _table(self) -> tuple[str, tuple[str, str], list[tuple[str, str]]]:
        return "LoopLinks", ("quantity", "value"), self.rows()


def loop_links(result: Result) -> LoopLinks:
    """Link the fitted tracks of a simulated run, and compare the links with the truth.

    Parameters
    ----------
    result : Result
        Of a run up to the stage ``"fit"``, with one mass hypothesis.

    Raises
    ------
    ValueError
        If the run ended before, or has several hypotheses.

    Examples
    --------
    >>> settings = cg.Settings(simulate=cg.SimulateSettings(half_turns=3))
    >>> result = cg.run("besiii-cgem", cg.Gun("pi-", pt=0.1, cos_theta=0.2), n=5, settings=settings)
    >>> links = cg.study.loop_links(result)
    >>> links.before, links.after
    (Fraction(count=0, n=5), Fraction(count=0, n=5))
    """
    if result.fitted is None or len(result.fitted) != len(result.candidates):
        raise ValueError("loop_links: expected a run with until='fit' and one mass hypothesis that keeps all tables")
    detector = result.fit_detector or result.detector
    by_finder = finding(result)
    first = link_loops(result.fitted, detector.field.bz)
    classes, particle = by_finder.classes["belle2"], by_finder.candidates.particle
    of_track = result.fitted["candidate"]
    classes, particle = classes[of_track], particle[of_track]
    known, loops = classes != MatchStatus.no_hits, classes == MatchStatus.other_half_turn
    linked = first != np.arange(len(first))
    matched, fake = classes == MatchStatus.matched, classes == MatchStatus.fake
    foreign = linked & ((particle != particle[first]) | fake | fake[first])
    return LoopLinks(
        first=first,
        found=by_finder,
        before=_fraction(loops, known),
        after=_fraction(loops, known & ~linked),
        wrong=_fraction(foreign, linked),
        lost=_fraction(linked, matched),
    )


def _fraction(which: Flags, among: Flags) -> Fraction:
    """Return the fraction of some rows, (n,) bool, that are also in `which`."""
    return Fraction(int(np.count_nonzero(which & among)), int(np.count_nonzero(among)))
