"""docs/methods/background.md: generated background beside that of ten random triggers of 2009.

The measured numbers are those of events that are published with pybes3: hits with a valid time within 2 us.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import cgemit as cg
from cgemit.reconstruction.cluster import cluster
from cgemit.simulation.background import add_background
from pages.page import Found, Numbers, Page, share_of, table

EVENTS, SEED = 4000, 1
#: Layer of wires -> mean share of its cells with a hit, %.
SHARES = {
    0: 34, 1: 25, 2: 18, 3: 14, 4: 11, 5: 8, 6: 6, 7: 8, 8: 3.6, 9: 7, 12: 3.9, 16: 5.1, 20: 6.3, 24: 4.0, 28: 2.4,
    32: 0.9, 36: 1.5, 40: 1.5, 42: 1.7,
}  # fmt: skip
#: Runs of 1, 2, ... 6 and of 7 or more neighbouring cells.
RUNS = (646, 167, 52, 39, 25, 21, 51)
#: Hits of an event: layers 0-7, layers 8-42; share of hits without a neighbour, %.
INNER, OUTER, ALONE = 65, 162, 28
#: Clusters of an event in the CGEM layers in 1 us, extrapolated from the wires.
CLUSTERS = (4.9, 3.0, 2.9)


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


def values(found: Found) -> dict[str, np.ndarray]:
    """Return the numbers on file as arrays, by quantity."""
    rows = found["generated"].rows
    names = dict.fromkeys(row.quantity for row in rows)
    return {name: np.array([row.value for row in rows if row.quantity == name]) for name in names}


def blocks(found: Found) -> dict[str, str]:
    """Return the table."""
    got = values(found)
    share = 100 * got["runs"] / got["runs"].sum()
    measured = 100 * np.array(RUNS) / sum(RUNS)
    rows = [
        ("hits an event, layers 0–7 / 8–42", f"{INNER} / {OUTER}", _joined(got["hits"], 0)),
        ("hits without a neighbour in their layer", f"{ALONE} %", f"{got['alone'][0]:.0f} %"),
        ("runs of 1 / 2 / 3 / 4 / 5 / 6 / 7 or more cells, %", _joined(measured, 0), _joined(share, 0)),
        *((f"cells of layer {layer} with a hit, %", f"{value:g}", f"{got['shares'][layer]:.1f}")
          for layer, value in SHARES.items() if layer in (0, 8, 20, 42)),
        ("clusters in X an event, L1 / L2 / L3 (extrapolated)", _joined(CLUSTERS, 1), _joined(got["clusters"], 1)),
    ]  # fmt: skip
    return {"generated": table(["", "measured", "generated"], rows)}


def _joined(numbers: object, digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in np.asarray(numbers))


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
    "background", "docs/methods/background.md", "1 min", {"generated": (Generated, measure)}, blocks,
    {"background.png": draw},
)  # fmt: skip
