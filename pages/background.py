"""Write the table and the picture of docs/methods/background.md that compare generated and measured background.

``python docs/background_numbers.py`` generates the level `bes2009` without particles. The measured numbers are those of
ten random triggers of 2009 that are published with pybes3: hits with a valid time within 2 us.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import cgemit as cg
from cgemit.reconstruction.cluster import cluster
from cgemit.simulation.background import add_background

HERE = Path(__file__).resolve().parent
PAGE = HERE / "methods" / "background.md"
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


def generated(events: int = EVENTS) -> dict[str, np.ndarray]:
    """Return shares of fired cells (43,) in %, runs (7,), hits of an event (2,), share of lone hits, clusters (3,)."""
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
        "alone": np.array(100 * np.count_nonzero(lengths == 1) / len(hits)),
        "clusters": np.bincount(x["layer"], minlength=3) / events,
    }


def runs(hits: cg.Table | dict[str, np.ndarray], cells: np.ndarray) -> np.ndarray:
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


def table(found: dict[str, np.ndarray]) -> str:
    """Return the table of the page."""
    share = 100 * found["runs"] / found["runs"].sum()
    measured = 100 * np.array(RUNS) / sum(RUNS)
    rows = [
        ("hits an event, layers 0–7 / 8–42", f"{INNER} / {OUTER}", f"{found['hits'][0]:.0f} / {found['hits'][1]:.0f}"),
        ("hits without a neighbour in their layer", f"{ALONE} %", f"{found['alone']:.0f} %"),
        (
            "runs of 1 / 2 / 3 / 4 / 5 / 6 / 7 or more cells, %",
            " / ".join(f"{value:.0f}" for value in measured),
            " / ".join(f"{value:.0f}" for value in share),
        ),
        *((f"cells of layer {layer} with a hit, %", f"{value:g}", f"{found['shares'][layer]:.1f}")
          for layer, value in SHARES.items() if layer in (0, 3, 7, 8, 9, 16, 20, 28, 36, 42)),
        (
            "clusters in X an event, L1 / L2 / L3 (extrapolated)",
            " / ".join(f"{value:.1f}" for value in CLUSTERS),
            " / ".join(f"{value:.1f}" for value in found["clusters"]),
        ),
    ]  # fmt: skip
    return "\n".join(f"| {' | '.join(row)} |" for row in [("", "measured", "generated"), ("---",) * 3, *rows])


def picture(found: dict[str, np.ndarray]) -> None:
    """Draw shares of cells by layer and lengths of runs."""
    figure, (shares, lengths) = plt.subplots(1, 2, figsize=(9.6, 3.6), width_ratios=(1.5, 1))
    shares.plot(found["shares"], color="#0072B2", drawstyle="steps-mid", label=f"generated, {EVENTS:,} events")
    shares.plot(list(SHARES), list(SHARES.values()), "o", color="#D55E00", ms=5, label="random triggers of 2009, mean")
    shares.set(xlabel="layer of wires", ylabel="cells with a hit (%)", yscale="log", title="within 2 µs")
    n = np.arange(1, 8)
    lengths.bar(n - 0.2, found["runs"] / found["runs"].sum(), 0.4, color="#0072B2", label="generated")
    lengths.bar(n + 0.2, np.array(RUNS) / sum(RUNS), 0.4, color="#D55E00", label="measured")
    lengths.set(xlabel="cells side by side (7: or more)", ylabel="share of runs", title="clumps")
    for plot in (shares, lengths):
        plot.legend(fontsize=9, frameon=False)
    figure.tight_layout()
    figure.savefig(HERE / "images" / "background.png", dpi=90)


def main() -> None:
    """Generate, and renew table and picture."""
    found = generated()
    begin, end = "<!-- begin generated -->\n", "<!-- end generated -->"
    text = PAGE.read_text(encoding="utf-8")
    (before, _), (_, after) = text.split(begin), text.split(end)
    PAGE.write_text(f"{before}{begin}{table(found)}\n{end}{after}", encoding="utf-8")
    picture(found)


if __name__ == "__main__":
    main()
