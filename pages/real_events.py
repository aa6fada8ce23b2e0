"""docs/how-to/real_events.md: public simulated events of the BESIII software, beside the experiment's own fits.

The source distribution of pybes3 holds the file; its folder is in the folder where the program runs:
``pip download --no-binary pybes3 --no-deps pybes3==0.5.6 && tar xf pybes3-0.5.6.tar.gz``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cgemit as cg
from cgemit.bes3 import wires as bes3_wires
from cgemit.bes3.events import Bes3Events, read_events
from cgemit.bes3.refit import refit
from pages.page import Found, MissingToolError, Numbers, Page

FILE = Path("pybes3-0.5.6/tests/data/test_full_mc_evt_1.rec")
ABOUT = {"events": f"10 events of {FILE.name} of pybes3 0.5.6"}
SETTINGS = cg.FitSettings(hypothesis="pi")
REFINE = cg.RefineSettings(drift_times="raw", start_time="fitted")


@dataclass(frozen=True)
class Fit:
    """Fits of the same hits: ours minus theirs over their error (median, 68 % within), our error over theirs."""

    fit: str
    parameter: str
    tracks: int
    pull: float
    pull_width: float
    error_ratio: float


@dataclass(frozen=True)
class Tracks:
    """Mean purity and efficiency (%) of the wire hits of tracks found among all hits, and of MdcTrack."""

    finder: str
    tracks: int
    purity: float
    efficiency: float


@dataclass(frozen=True)
class Start:
    """Start time that was found and fitted, minus that of the experiment, ns."""

    event: int
    difference: float


def fits(share: float) -> Numbers:
    """Fit the hits of the experiment's tracks."""
    events, rows = _events(), []
    for kind in ("kal", "mdc"):
        found = refit(events, kind, SETTINGS)
        for name, row in found.summary().items():
            numbers = row["pull"], row["pull_width"], row["error_ratio"]
            rows.append(Fit(kind, name, int(found.good.sum()), *map(float, numbers)))
    return Numbers(rows, ABOUT)


def tracks(share: float) -> Numbers:
    """Find tracks among the hits of all fired cells."""
    events = _events()
    wires = bes3_wires.all_wire_hits(events)
    own = bes3_wires.match_wires(events, wires, _found(events, wires))
    rows = []
    for finder, matches in (("ckf", own), ("MdcTrack", bes3_wires.match_wires(events, wires))):
        numbers = (100 * float(matches[name].mean()) for name in ("purity", "efficiency"))
        rows.append(Tracks(finder, int((matches["particle"] >= 0).sum()), *numbers))
    return Numbers(rows, ABOUT)


def starts(share: float) -> Numbers:
    """Find the start times without the experiment's."""
    events = _events()
    coarse = bes3_wires.find_start_times(events)
    found = _found(events, bes3_wires.all_wire_hits(events, coarse))["start_times"]["start_time"]
    off = coarse + found - events.start_time
    return Numbers([Start(event, float(one)) for event, one in enumerate(off)], ABOUT)


def _events() -> Bes3Events:
    if not FILE.exists():
        raise MissingToolError(f"{FILE}: see pages/real_events.py")
    return read_events(FILE, cg.load("besiii-idc").with_field("besiii"))


def _found(events: Bes3Events, wires: cg.Table) -> dict[str, cg.Table]:
    how = cg.refinements(REFINE)
    return cg.reconstruct(events.detector, events.clusters, wires, cg.find_tracks, SETTINGS, refinements=how)


def blocks(found: Found) -> dict[str, str]:
    """Return the numbers of the text."""
    kal, mdc = ({row.parameter: row for row in found["fits"].rows if row.fit == fit} for fit in ("kal", "mdc"))
    larger = [100 * (row.error_ratio - 1) for name, row in kal.items() if name != "p"]
    own, theirs = found["tracks"].rows
    return {
        "all-tracks": str(kal["dr"].tracks),
        "same-errors": f"{100 * max(abs(row.error_ratio - 1) for row in mdc.values()):.1f}",
        "same-values": f"{max(abs(row.pull) for row in mdc.values()):.1f}",
        "larger": f"{min(larger):.0f} to {max(larger):.0f}",
        "away": f"{max(kal[name].pull_width for name in ('dr', 'dz')):.1f}",
        "found-tracks": str(own.tracks),
        "purity": f"{own.purity:.1f} % and an efficiency of {own.efficiency:.1f} % (MdcTrack: {theirs.purity:.1f} and "
        f"{theirs.efficiency:.1f} %)",
        "starts": f"{max(abs(row.difference) for row in found['starts'].rows):.1f}",
    }


PAGE = Page(
    "real_events", "docs/how-to/real_events.md", "5 s",
    {"fits": (Fit, fits), "tracks": (Tracks, tracks), "starts": (Start, starts)}, blocks,
)  # fmt: skip
