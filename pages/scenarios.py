"""Scenarios of difficult tracks: efficiency, resolution and failures of the fit (docs/methods/robustness.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.analysis.widths import Resolution, measure
from cgemit.chain import run
from cgemit.chain.result import Result
from cgemit.chain.settings import Settings, fit_settings
from cgemit.detector import Detector, compiled, load
from cgemit.particles.gun import Gun, Guns, Source, generate
from cgemit.particles.species import species
from cgemit.particles.table import particles_from
from cgemit.reconstruction.fit import fit
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, FitStatus, has_momentum, is_fitted
from cgemit.truth.match import compare

Rows = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]
Columns = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Hits:
    """Candidates, their hits, and the tables that these point into.

    Attributes
    ----------
    candidates, candidate_hits : Table
    clusters, wire_hits : Table
    """

    candidates: Table
    candidate_hits: Table
    clusters: Table
    wire_hits: Table

    @property
    def track(self) -> Rows:
        """Candidate of each hit."""
        return np.asarray(self.candidate_hits["candidate"])

    @property
    def view(self) -> Rows:
        """View of each hit."""
        return np.asarray(self.candidate_hits["view"])

    @property
    def row(self) -> Rows:
        """Row of each hit in its table."""
        return np.asarray(self.candidate_hits["hit"])

    @property
    def on_wire(self) -> Mask:
        """Whether each hit is one of a wire."""
        return np.asarray(self.view == HIT_WIRE)

    @property
    def layer(self) -> Rows:
        """CGEM layer or number of the wire layer of each hit."""
        return self._column("layer", "layer", self.row)

    def _column(self, of_cluster: str, of_wire: str, row: Rows) -> Rows:
        column = np.empty(len(row), np.int64)
        column[~self.on_wire] = self.clusters[of_cluster][row[~self.on_wire]]
        column[self.on_wire] = self.wire_hits[of_wire][row[self.on_wire]]
        return column


def keep(hits: Hits, kept: Mask) -> Hits:
    """Return the candidates without some of their hits."""
    return _times(hits, kept.astype(np.int64))


def lose_layers(hits: Hits, share: float, random: np.random.Generator) -> Hits:
    """Return the candidates of a detector in which each layer misses a track with probability `share`."""
    place = (hits.track * 2 + hits.on_wire) * 1000 + hits.layer
    _, index = np.unique(place, return_inverse=True)
    return keep(hits, (random.random(index.max(initial=-1) + 1) >= share)[index])


def _times(hits: Hits, times: Rows) -> Hits:
    """Return the candidates with each hit so many times, one behind the other."""
    return replace(hits, candidate_hits=hits.candidate_hits[np.repeat(np.arange(len(times)), times)])


def exchange_clusters(hits: Hits, layer: int, tracks: Mask) -> Hits:
    """Return the candidates with the X and V cluster of one layer taken from the track four rows on."""
    row, taken = hits.row.copy(), [np.empty(0, np.int64)]
    for view in (HIT_X, HIT_V):
        mine = np.flatnonzero((hits.view == view) & (hits.layer == layer))
        hurt = tracks[hits.track[mine]]
        row[mine[hurt]] = np.roll(hits.row[mine], -4)[hurt]
        taken.append(mine[hurt])
    # The other track's event is another one, so that the cluster is copied.
    places = np.concatenate(taken)
    copies = {name: hits.clusters[name][row[places]] for name in hits.clusters}
    clusters, old, new = _with_clusters(hits.clusters, copies | {"event": hits.candidate_hits["event"][places]})
    kept = np.setdiff1d(np.flatnonzero(~hits.on_wire), places)
    row[kept], row[places] = old[row[kept]], new
    return replace(hits, candidate_hits=hits.candidate_hits.with_columns(hit=row), clusters=clusters)


def add_noise(detector: Detector, hits: Hits, share: float, random: np.random.Generator) -> Hits:
    """Return the candidates with noise: a false hit beside each of their hits with probability `share`.

    Noise on a wire lies in a cell at most 3 away, anywhere in it; in the hit's own cell the shorter drift is seen.
    Noise on strips is a cluster like the hit's own, shifted by a whole number of strips, at most 10 mm.
    """
    noisy = random.random(len(hits.track)) < share
    spoilt = _times(hits, 1 + noisy.astype(np.int64))
    second = np.flatnonzero(noisy) + 1 + np.arange(np.count_nonzero(noisy))
    wire, strip = (second[spoilt.on_wire[second] == is_wire] for is_wire in (True, False))
    row = spoilt.row.copy()
    new_wires = _wire_noise(detector, spoilt.wire_hits, row[wire], random)
    new_strips = _strip_noise(detector, spoilt.clusters, row[strip], random)
    same_cell = new_wires["gid"] == spoilt.wire_hits["gid"][row[wire]]
    wire_hits, old, new = _merged(spoilt.wire_hits, new_wires)
    row[spoilt.on_wire] = old[row[spoilt.on_wire]]
    row[wire] = new
    clusters, old, new = _with_clusters(spoilt.clusters, new_strips)
    row[~spoilt.on_wire] = old[row[~spoilt.on_wire]]
    row[strip] = new
    kept = np.ones(len(row), np.bool_)
    kept[wire[same_cell] - 1] = False
    return keep(Hits(spoilt.candidates, spoilt.candidate_hits.with_columns(hit=row), clusters, wire_hits), kept)


def _wire_noise(detector: Detector, wire_hits: Table, rows: Rows, random: np.random.Generator) -> Columns:
    """Return rows like those given, in a cell nearby and with any drift distance."""
    columns = {name: wire_hits[name][rows].copy() for name in wire_hits}
    layers = {layer.number: layer for layer in detector.drift_chamber.layers} if detector.drift_chamber else {}
    cells = np.array([layers[number].cells for number in columns["layer"]], np.int64)
    radius = np.array([layers[number].r_mid for number in columns["layer"]])
    shift = random.integers(-3, 4, len(rows))
    drift = random.random(len(rows)) * np.pi * radius / np.maximum(cells, 1)
    drift = np.where(shift == 0, np.minimum(drift, columns["drift"]), drift)
    wire = (columns["wire"] + shift) % np.maximum(cells, 1)
    columns["gid"] += (wire - columns["wire"]).astype(columns["gid"].dtype)
    columns["wire"] = wire.astype(columns["wire"].dtype)
    columns["wire_truth"][:] = -1
    return columns | {"drift": drift}


def _strip_noise(detector: Detector, clusters: Table, rows: Rows, random: np.random.Generator) -> Columns:
    """Return rows like those given, some strips to the left or right on the same sheet."""
    columns = {name: clusters[name][rows].copy() for name in clusters}
    is_x = columns["view"] == HIT_X
    layers = [(cgem.pitch_x, cgem.strips_x, cgem.pitch_v, cgem.strips_v) for cgem in detector.cgem]
    of_layer = np.array(layers).reshape(-1, 4)[columns["layer"]]
    pitch, strips = (np.where(is_x, of_layer[:, i], of_layer[:, i + 2]) for i in (0, 1))
    shift = np.ceil(random.random(len(rows)) * 10.0 / pitch)
    shift *= np.where(random.random(len(rows)) < 0.5, 1, -1)
    middle = np.where(is_x, columns["x"], columns["v"]) / pitch
    first, last = (np.where(columns["size"] > 0, columns[name], middle) + shift for name in ("first", "last"))
    shift *= np.where((first < 0) | (last >= strips), -1, 1)
    for name in ("first", "last"):
        columns[name] += np.where(columns["size"] > 0, shift, 0).astype(columns[name].dtype)
    columns["x"] += np.where(is_x, shift * pitch, 0.0)
    columns["v"] += np.where(is_x, 0.0, shift * pitch)
    columns["truth"][:] = -1
    return columns


def _merged(table: Table, extra: Columns) -> tuple[Table, Rows, Rows]:
    """Return the table with more rows, and where its own rows and the new ones are in it."""
    columns = {name: np.concatenate([table[name], extra[name]]) for name in table}
    order = np.argsort(columns["event"], kind="stable")
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    joined = {name: column[order] for name, column in columns.items()}
    return Table(table.kind, joined, **table.cover), place[: len(table)], place[len(table) :]


def _with_clusters(clusters: Table, extra: Columns) -> tuple[Table, Rows, Rows]:
    """Return the clusters with more of them, which belong to no crossing, and places as `_merged`."""
    links = ("x_cluster", "v_cluster")
    joined, old, new = _merged(clusters, extra | {name: np.full_like(extra[name], -1) for name in links})
    moved = {name: np.where(joined[name] < 0, -1, old[joined[name]]) for name in links}
    return joined.with_columns(**moved), old, new


Spoil = Callable[[Detector, Hits, np.random.Generator], Hits]


@dataclass(frozen=True)
class Scenario:
    """One kind of difficult track.

    Attributes
    ----------
    name : str
    text : str
        What is difficult, for the reader of a table.
    source : Gun, Guns or callable
        Particles, or a function of (number of events, seed) that returns their table.
    spoil : callable or None
        Function of (detector, hits, numpy random generator) that returns the hits as the fit gets them; None: as they
        are.
    """

    name: str
    text: str
    source: Source | Guns | Callable[[int, int], Table]
    spoil: Spoil | None = None

    def particles(self, n_events: int, seed: int) -> Table:
        """Return the particles of some events."""
        return (
            generate(self.source, n_events, seed)
            if isinstance(self.source, Source | Guns)
            else self.source(n_events, seed)
        )


def both_charges(name: str, **what: Any) -> Guns:
    """Return guns that shoot a particle and its antiparticle together."""
    return Gun(name, **what) + Gun(-species(name).pdg, **what)


# PDG, Phys. Rev. D 110, 030001 (2024): mass in GeV/c2, c tau in mm.
_KAON_MASS, _KAON_CTAU = 0.497611, 26.844


def kaon_decays(n_events: int, seed: int) -> Table:
    """Return the pions of K_S mesons from the origin that decay at radii up to 100 mm.

    Momenta are uniform from 0.2 to 1.2 GeV/c, cos(theta) within 0.8, decay lengths exponential; the pions fly apart
    isotropically in the rest frame.
    """
    random = np.random.default_rng(seed)
    p = random.uniform(0.2, 1.2, n_events)
    direction = _directions(random, n_events, 0.8)
    sin = np.hypot(direction[:, 0], direction[:, 1])
    mean = p / _KAON_MASS * _KAON_CTAU
    farthest = -np.expm1(-100.0 / sin / mean)  # share of the mesons that decay within 100 mm
    length = -mean * np.log1p(-farthest * random.random(n_events))
    vertex = length[:, None] * direction
    mass = species("pi+").mass
    rest = np.sqrt(0.25 * _KAON_MASS**2 - mass**2)
    star = rest * _directions(random, n_events, 1.0)
    gamma, boost = np.hypot(p, _KAON_MASS) / _KAON_MASS, p / _KAON_MASS
    along = np.sum(star * direction, axis=1)
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("x", "y", "z", "px", "py", "pz")}
    for sign in (1, -1):
        shift = (gamma - 1) * sign * along + boost * 0.5 * _KAON_MASS
        momentum = sign * star + shift[:, None] * direction
        for i, axis in enumerate("xyz"):
            columns[axis].append(vertex[:, i])
            columns["p" + axis].append(momentum[:, i])
    event = np.tile(np.arange(n_events), 2)
    pdg = np.repeat([211, -211], n_events)
    flat = {name: np.concatenate(parts) for name, parts in columns.items()}
    return particles_from({"event": event, "pdg": pdg, **flat}, n_events=n_events, first_event=0)


def _directions(random: np.random.Generator, n: int, most: float) -> np.ndarray:
    cos, phi = random.uniform(-most, most, n), random.uniform(-np.pi, np.pi, n)
    sin = np.sqrt(1 - cos**2)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=1)


def only_layers(*layers: int) -> Spoil:
    """Return a function that keeps only the wires and the given CGEM layers."""
    return lambda detector, hits, random: keep(hits, hits.on_wire | np.isin(hits.layer, layers))


def _wires_only(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    return keep(hits, hits.on_wire)


def _clusters_only(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    return keep(hits, ~hits.on_wire)


def _lose(share: float) -> Spoil:
    return lambda detector, hits, random: lose_layers(hits, share, random)


def _noise(share: float) -> Spoil:
    return lambda detector, hits, random: add_noise(detector, hits, share, random)


def _wrong_cluster(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    layer = random.integers(0, max(len(detector.cgem), 1), len(hits.candidates))
    for number in range(len(detector.cgem)):
        hits = exchange_clusters(hits, number, layer == number)
    return hits


def _x_only(detector: Detector, hits: Hits, random: np.random.Generator) -> Hits:
    return keep(hits, hits.view != HIT_V)


_PLAIN = both_charges("mu-", p=(0.3, 1.5), cos_theta=(-0.8, 0.8))
_SLOW = {"cos_theta": (-0.8, 0.8)}

#: What `docs/methods/robustness.md` shows.
SCENARIOS = (
    Scenario("plain", "muons of 0.3 to 1.5 GeV/c, cos(theta) within 0.8, all hits", _PLAIN),
    Scenario(
        "wide",
        "muons of 0.3 to 1.5 GeV/c, cos(theta) within 0.93",
        both_charges("mu-", p=(0.3, 1.5), cos_theta=(-0.93, 0.93)),
    ),
    Scenario(
        "end plates",
        "the same, cos(theta) 0.83 to 0.93: out through an end plate",
        both_charges("mu-", p=(0.3, 1.5), cos_theta=(0.83, 0.93)),
    ),
    Scenario("layers missing", "each layer lost with probability 0.3", _PLAIN, _lose(0.3)),
    Scenario("one CGEM layer, inner", "wires and CGEM layer 0", _PLAIN, only_layers(0)),
    Scenario("one CGEM layer, outer", "wires and CGEM layer 2", _PLAIN, only_layers(2)),
    Scenario("two CGEM layers", "wires and CGEM layers 0 and 1", _PLAIN, only_layers(0, 1)),
    Scenario("drift chamber only", "no clusters", _PLAIN, _wires_only),
    Scenario("CGEM only", "no wires", _PLAIN, _clusters_only),
    Scenario("X only", "no V clusters", _PLAIN, _x_only),
    Scenario("noise", "noise beside 10 % of the hits", _PLAIN, _noise(0.1)),
    Scenario("much noise", "noise beside 30 % of the hits", _PLAIN, _noise(0.3)),
    Scenario("wrong cluster", "one CGEM layer has another track's X and V", _PLAIN, _wrong_cluster),
    Scenario("noise and missing layers", "both", _PLAIN, lambda d, h, r: lose_layers(add_noise(d, h, 0.1, r), 0.2, r)),
    Scenario(
        "loopers",
        "muons that turn back in the drift chamber, pT 0.06 to 0.12 GeV/c, outward arc",
        both_charges("mu-", pt=(0.06, 0.12), **_SLOW),
    ),
    Scenario("loopers with noise", "the same with noise", both_charges("mu-", pt=(0.06, 0.12), **_SLOW), _noise(0.1)),
    Scenario("slow muons", "pT 0.05 to 0.06 GeV/c", both_charges("mu-", pt=(0.05, 0.06), **_SLOW)),
    Scenario("slow pions 50", "pT 0.050 to 0.065 GeV/c", both_charges("pi+", pt=(0.05, 0.065), **_SLOW)),
    Scenario("slow pions 65", "pT 0.065 to 0.1 GeV/c", both_charges("pi+", pt=(0.065, 0.1), **_SLOW)),
    Scenario("muons 0.1 GeV/c", "p = 0.1 GeV/c", both_charges("mu-", p=0.1, **_SLOW)),
    Scenario("K_S pions", "decays at radii up to 100 mm", kaon_decays),
    Scenario("electrons", "pT 0.05 to 1 GeV/c", both_charges("e-", pt=(0.05, 1.0), **_SLOW)),
    Scenario("pions", "pT 0.1 to 1 GeV/c", both_charges("pi+", pt=(0.1, 1.0), **_SLOW)),
    Scenario("kaons", "p 0.25 to 1 GeV/c", both_charges("K+", p=(0.25, 1.0), **_SLOW)),
    Scenario("protons", "p 0.35 to 1 GeV/c", both_charges("p", p=(0.35, 1.0), **_SLOW)),
    Scenario("10 GeV/c", "muons of 10 GeV/c", both_charges("mu-", p=10.0, **_SLOW)),
)


#: Of the page on difficult tracks: kaons that decay early have few hits, which is not a matter of the fit.
WITHOUT_DECAYS = Settings(simulate=SimulateSettings(decays=False))

#: What a track needs to be fitted: this many own hits, of which so many along z and across, over this length in mm.
HITS, ALONG, ACROSS, LEVER = 6, 2, 3, 80.0


@dataclass(frozen=True, eq=False)
class Outcome:
    """The tracks of one scenario.

    Attributes
    ----------
    scenario : Scenario
    tracks : Table
        As fitted, with the hits as the scenario leaves them.
    enough : ndarray, (tracks,) bool
        Which have `HITS` hits of their own that measure the whole helix over a length of `LEVER`.
    """

    scenario: Scenario
    tracks: Table
    enough: Mask

    @property
    def good(self) -> Table:
        """The fitted ones of the tracks with enough hits."""
        picked: Table = self.tracks[self.enough & has_momentum(self.tracks)]
        return picked

    @property
    def efficiency(self) -> float:
        """Share of the tracks with enough hits that are fitted, with those whose momentum the hits do not constrain."""
        settled = is_fitted(self.tracks)[self.enough]
        return int(np.count_nonzero(settled)) / max(len(settled), 1)

    @property
    def removed(self) -> Mapping[str, int]:
        """Tracks with enough hits that are not fitted, by status."""
        status = self.tracks["status"][self.enough]
        good = (FitStatus.ok, FitStatus.large_chi2)
        return {s.name: n for s in FitStatus if s not in good and (n := int((status == s).sum()))}

    def resolution(self, parameter: str) -> Resolution:
        """Return the widths of fitted minus true values; of p relative to the true one."""
        tracks = self.good
        scale = tracks["truth_p"] if parameter == "p" else 1.0
        return measure(tracks[f"res_{parameter}"] / scale, parameter=parameter)

    def pull(self, parameter: str) -> Resolution:
        """Return the widths of the pull."""
        return measure(self.good[f"pull_{parameter}"], parameter=f"pull of {parameter}")


def run_scenario(
    scenario: Scenario,
    n_events: int,
    seed: int = 1,
    *,
    detector: Detector | str = "besiii-cgem-design",
    settings: Settings | None = None,
) -> Outcome:
    """Simulate, spoil and fit the tracks of one scenario."""
    detector, settings = load(detector), settings or WITHOUT_DECAYS
    result = run.run(detector, scenario.particles(n_events, seed), seed=seed, settings=settings)
    hits = Hits(result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    if scenario.spoil is None:
        return Outcome(scenario, result.tracks, has_enough(detector, hits, result))
    hits = scenario.spoil(detector, hits, np.random.default_rng(seed))
    tables = (hits.clusters, hits.wire_hits, hits.candidates, hits.candidate_hits)
    tracks = fit(detector, *tables, fit_settings(settings))["tracks"]
    # Whatever hits a candidate has been given, it is compared with the particle that it was made of.
    comparison = compare(tracks, result.particles, tracks["candidate"], compiled(detector).field)
    return Outcome(scenario, tracks.with_columns(**comparison), has_enough(detector, hits, result))


def has_enough(detector: Detector, hits: Hits, result: Result) -> Mask:
    """Return which candidates have enough hits of their own particle to measure a helix."""
    n, own, track = len(result.particles), own_hits(hits, result), hits.track
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    radii, tilted = (
        {layer.number: layer.r_mid for layer in layers},
        {layer.number: layer.twist != 0 for layer in layers},
    )
    places = list(zip(hits.on_wire, hits.layer, strict=True))
    radius = np.array([radii[number] if wire else detector.cgem[number].r_mid for wire, number in places])
    along = np.array([wire and tilted[number] for wire, number in places], np.bool_) | (hits.view == HIT_V)
    lowest, highest = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(lowest, track[own], radius[own])
    np.maximum.at(highest, track[own], radius[own])
    n_own, n_along = (np.bincount(track[mask], minlength=n) for mask in (own, own & along))
    enough = (n_own >= HITS) & (n_along >= ALONG) & (n_own - n_along >= ACROSS) & (highest - lowest >= LEVER)
    return np.asarray(enough, np.bool_)


def own_hits(hits: Hits, result: Result) -> Mask:
    """Return which hits the particle of their candidate left itself."""
    own = np.zeros(len(hits.track), np.bool_)
    tables = (
        (hits.on_wire, hits.wire_hits["wire_truth"], result.wire_truths),
        (~hits.on_wire, hits.clusters["truth"], result.truths),
    )
    for mask, links, truths in tables:
        link, track = links[hits.row[mask]], hits.track[mask]
        same = link >= 0
        for name in ("event", "particle"):
            same[same] = truths[name][link[same]] == result.particles[name][track[same]]
        same[same] = truths["daughter"][link[same]] == 0
        own[mask] = same
    return own
