"""docs/methods/background.md: generated background beside random triggers of 2009, and its effect on tracks.

The measured numbers are those of ten events that are published with pybes3: hits with a valid time within 2 us.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import cgemit as cg
from cgemit.analysis.finding import finding
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import fit
from cgemit.simulation.background import add_background
from cgemit.tables.schema import has_momentum
from cgemit.tables.show import with_error
from pages.page import Found, Numbers, Page, share_of, table

EVENTS, SEED = 4000, 1
#: Layer of wires -> mean share of its cells with a hit, %.
SHARES = {
    0: 34, 1: 25, 2: 18, 3: 14, 4: 11, 5: 8, 6: 6, 7: 8, 8: 3.6, 9: 7, 12: 3.9, 16: 5.1, 20: 6.3, 24: 4.0, 28: 2.4,
    32: 0.9, 36: 1.5, 40: 1.5, 42: 1.7,
}  # fmt: skip
#: Runs of 1, 2, ... 6 and of 7 or more neighbouring cells.
RUNS = (646, 167, 52, 39, 25, 21, 51)
#: Row of the table of effects -> level, keys of the background with their values.
EFFECTS = {
    "nothing, `bes2009`": ("bes2009", {}),
    "nothing, `bes2026`": ("bes2026", {}),
    "`dead_wires` 10 %": ("bes2009", {"dead_wires": "10 %"}),
    "`dead_strips` 5 %": ("bes2009", {"dead_strips": "5 %"}),
    "`efficiency_x` and `efficiency_v` 95 %": ("bes2026", {"efficiency_x": "95 %", "efficiency_v": "95 %"}),
    "`efficiency_wires` 95 %": ("bes2026", {"efficiency_wires": "95 %"}),
}
TRACKS, START_TRACKS = 4000, 6000
WIDTHS = (("dr", "σ(d_ρ) µm"), ("dz", "σ(d_z) mm"), ("p", "σ(p) MeV/c"))
CHAMBERS = ("besiii-cgem", "besiii-idc")
SPREAD = 5.0  # ns
FITTED_START_TIME: dict[str, dict[str, object]] = {
    "background": {"start_time": SPREAD}, "refine": {"start_time": "fitted"},
}  # fmt: skip
TRACKS_OF_AN_EVENT, HALF_TURNS = (1, 4), (1, 15)
#: Row of the table of drift times -> settings; `uncorrected` fits the hits as measured.
TIMES: dict[str, dict[str, dict[str, object]]] = {
    "exact": {},
    "start time with a spread of 5 ns": {"background": {"start_time": SPREAD}},
    "the same, `refine.start_time=fitted`": FITTED_START_TIME,
    "`digitize.wire_times=raw`": {"digitize": {"wire_times": "raw"}},
    "the same, uncorrected": {"digitize": {"wire_times": "raw"}},
}  # fmt: skip


@dataclass(frozen=True)
class Effect:
    """A core width, in um, mm or MeV/c, and the tracking efficiency."""

    changed: str
    quantity: str
    core: float
    error: float
    found: float


@dataclass(frozen=True)
class Times:
    """Core width of the momentum, MeV/c."""

    times: str
    detector: str
    core: float
    error: float


@dataclass(frozen=True)
class StartTime:
    """Median error (ns) of the start time of events with this number of muons."""

    tracks: int
    error: float


@dataclass(frozen=True)
class Electrons:
    """Mean number of cells that the sample `electrons` fires in an event."""

    half_turns: int
    cells: float
    error: float


@dataclass(frozen=True)
class Generated:
    """A number of the level `bes2009` without particles.

    Attributes
    ----------
    quantity : str
        "shares": cells of a layer with a hit, %; "runs": runs of 1, 2, ... 6 and of 7 or more neighbouring cells;
        "hits" of an event in layers 0-7 and 8-42; "alone": hits without a neighbour, %; "clusters" in X of an event.
    index : int
        Layer or place in the list.
    value : float
    """

    quantity: str
    index: int
    value: float


def generated(events: int) -> dict[str, np.ndarray]:
    """Return the numbers of all quantities."""
    settings = cg.BackgroundSettings(level="bes2009")
    empty = [cg.Table.empty(kind, n_events=events) for kind in ("digis", "wire_hits")]
    chamber = cg.load("besiii-idc")
    hits = add_background(chamber, *empty, settings, SEED)["wire_hits"]
    cells = np.array([layer.cells for layer in chamber.drift_chamber.layers])
    counts = np.bincount(hits["layer"], minlength=len(cells))
    lengths = runs(hits, cells)
    inner = np.count_nonzero(hits["layer"] < 8)
    tracker = cg.load("besiii-cgem")
    digis = add_background(tracker, *empty, settings, SEED)["digis"]
    clusters = cluster(tracker, digis)
    x = clusters[clusters["view"] == 0]
    return {
        "shares": 100 * counts / events / cells,
        "runs": np.bincount(np.minimum(lengths, 7), minlength=8)[1:],
        "hits": np.array([inner, len(hits) - inner]) / events,
        "alone": np.array([100 * np.count_nonzero(lengths == 1) / len(hits)]),
        "clusters": np.bincount(x["layer"], minlength=3) / events,
    }


def runs(hits: cg.Table | Mapping[str, np.ndarray], cells: np.ndarray) -> np.ndarray:
    """Return the length (n,) of each run of neighbouring cells of a layer; the last cell is beside the first."""
    key = np.unique(np.stack([hits["event"], hits["layer"], hits["wire"]]), axis=1)
    event, layer, wire = key
    same = (event[1:] == event[:-1]) & (layer[1:] == layer[:-1])
    starts = np.r_[True, ~(same & (wire[1:] == wire[:-1] + 1))]
    length = np.diff(np.r_[np.flatnonzero(starts), len(wire)])
    first = np.flatnonzero(starts)
    last = first + length - 1
    # A run that ends at the last cell continues in the run of the same layer that begins at cell 0.
    rings = np.flatnonzero(np.r_[True, ~same])
    ends = np.r_[rings[1:], len(wire)] - 1
    for head, tail in zip(np.searchsorted(first, rings), np.searchsorted(last, ends), strict=True):
        if head != tail and wire[first[head]] == 0 and wire[last[tail]] == cells[layer[last[tail]]] - 1:
            length[tail] += length[head]
            length[head] = 0
    return length[length > 0]


def measure(share: float) -> Numbers:
    """Generate background and count."""
    events = share_of(EVENTS, share)
    rows = [Generated(name, i, float(v)) for name, values in generated(events).items() for i, v in enumerate(values)]
    return Numbers(rows, {"events": f"{events:,} events"})


def effects(share: float) -> Numbers:
    """Find and fit the same muons with background, dead channels and inefficiencies."""
    events, rows = share_of(TRACKS, share, 200), []
    for changed, (level, keys) in EFFECTS.items():
        detector = cg.load("besiii-cgem").with_overrides({f"background.{level}.{k}": v for k, v in keys.items()})
        settings = cg.Settings(background=cg.BackgroundSettings(level=level))
        muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9))
        result = cg.run(detector, muons, events, SEED, settings=settings, finder="ckf")
        found = finding(result).rates().efficiency.value
        for name, _ in WIDTHS:
            width = cg.resolution(result, name)
            rows.append(Effect(changed, name, width.core, width.core_error, found))
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def times(share: float) -> Numbers:
    """Fit the same muons with start times and drift times that are not exact."""
    events, rows = share_of(START_TRACKS, share, 200), []
    for label, stages in TIMES.items():
        for name in CHAMBERS:
            muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
            result = cg.run(name, muons, events, SEED, settings=cg.Settings.from_dict(stages))
            width = cg.resolution(result, "p")
            if "uncorrected" in label:
                hits = (result.clusters, result.wire_hits, result.candidates, result.candidate_hits)
                tracks = fit(result.detector, *hits)["tracks"]
                good = has_momentum(tracks) & np.isfinite(result.tracks["truth_p"])
                width = cg.study.measure(1e3 * (tracks["p"] - result.tracks["truth_p"])[good], parameter="p")
            rows.append(Times(label, name, width.core, width.core_error))
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def start_times(share: float) -> Numbers:
    """Fit the start time of events with one track and with several."""
    events, settings = share_of(START_TRACKS, share, 200), cg.Settings.from_dict(FITTED_START_TIME)
    rows = []
    for tracks in TRACKS_OF_AN_EVENT:
        muons = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93), multiplicity=tracks)
        errors = cg.run(CHAMBERS[0], muons, events, SEED, settings=settings).tables["start_times"]["err_start_time"]
        rows.append(StartTime(tracks, float(np.nanmedian(errors))))
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def electrons(share: float) -> Numbers:
    """Count the cells that electrons fire on one half turn and on many."""
    events, rows = share_of(EVENTS, share, 200), []
    for half_turns in HALF_TURNS:
        settings = cg.Settings(simulate=cg.SimulateSettings(half_turns=half_turns))
        result = cg.run(CHAMBERS[0], cg.sample("electrons"), events, SEED, settings=settings, until="digitize")
        cells = np.bincount(result.wire_hits["event"], minlength=events)
        rows.append(Electrons(half_turns, float(cells.mean()), float(cells.std(ddof=1) / events**0.5)))
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def values(found: Found) -> dict[str, np.ndarray]:
    """Return the numbers on file as arrays, by quantity."""
    rows = found["generated"].rows
    names = dict.fromkeys(row.quantity for row in rows)
    return {name: np.array([row.value for row in rows if row.quantity == name]) for name in names}


def blocks(found: Found) -> dict[str, str]:
    """Return the tables and numbers of the text."""
    errors = {f"start-{row.tracks}": f"{row.error:.1f}" for row in found["start_times"].rows}
    cells = {f"cells-{row.half_turns}": f"{row.cells:.0f}" for row in found["electrons"].rows}
    return {
        **errors,
        **cells,
        "effects": _effects(found["effects"].rows),
        "times": _times(found["times"].rows),
    }


def _effects(rows: Sequence[Effect]) -> str:
    """Return the table of effects; the first rows show their errors."""
    cells = {(row.changed, row.quantity): row for row in rows}
    lines = []
    for changed in EFFECTS:
        line = [changed]
        for name, _ in WIDTHS:
            row = cells[changed, name]
            shown = with_error(row.core, row.error)
            line.append(shown if changed.startswith("nothing") else shown.partition(" ")[0])
        lines.append(line)
    return table(["changed", *(head for _, head in WIDTHS)], lines)


def _times(rows: Sequence[Times]) -> str:
    cells = {(row.times, row.detector): with_error(row.core, row.error) for row in rows}
    lines = [[label, *(cells[label, name] for name in CHAMBERS)] for label in TIMES]
    return table(["drift times", *(f"`{name}`, σ(p) MeV/c" for name in CHAMBERS)], lines)


def draw(found: Found) -> Figure:
    """Draw shares of cells by layer and lengths of runs."""
    got = values(found)
    figure, (shares, lengths) = plt.subplots(1, 2, figsize=(9.6, 3.6), width_ratios=(1.5, 1), dpi=90)
    label = f"generated, {found['generated'].about['events']}"
    shares.plot(got["shares"], color="#0072B2", drawstyle="steps-mid", label=label)
    shares.plot(list(SHARES), list(SHARES.values()), "o", color="#D55E00", ms=5, label="random triggers of 2009, mean")
    shares.set(xlabel="layer of wires", ylabel="cells with a hit (%)", yscale="log", title="within 2 µs")
    n = np.arange(1, 8)
    lengths.bar(n - 0.2, got["runs"] / got["runs"].sum(), 0.4, color="#0072B2", label="generated")
    lengths.bar(n + 0.2, np.array(RUNS) / sum(RUNS), 0.4, color="#D55E00", label="measured")
    lengths.set(xlabel="cells side by side (7: or more)", ylabel="share of runs", title="clumps")
    for plot in (shares, lengths):
        plot.legend(fontsize=9, frameon=False)
    figure.tight_layout()
    return figure


PAGE = Page(
    "background", "docs/methods/background.md", "1 min",
    {
        "generated": (Generated, measure), "effects": (Effect, effects), "times": (Times, times),
        "start_times": (StartTime, start_times), "electrons": (Electrons, electrons),
    },
    blocks,
    {"background.png": draw},
)  # fmt: skip
