"""docs/how-to/real_events.md: simulated public events of BESIII beside the experiment's own fits, and a run of 2026.

The source distribution of pybes3 holds the files; its folder is in the folder where the program runs:
``pip download --no-binary pybes3 --no-deps pybes3==0.5.6 && tar xf pybes3-0.5.6.tar.gz``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

import cgemit as cg
from cgemit import helix
from cgemit.analysis.cosmics import BACKWARD
from cgemit.bes3 import wires as bes3_wires
from cgemit.bes3.events import Bes3Events, read_events
from cgemit.bes3.reconstruct import aligned_layers, point_offsets, reconstruct_events
from cgemit.bes3.refit import refit
from cgemit.draw.style import Picture
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, is_fitted
from pages.page import Found, MissingToolError, Numbers, Page, table

FOLDER = Path("pybes3-0.5.6/tests/data")
FILE, RUN = FOLDER / "test_full_mc_evt_1.rec", FOLDER / "test_raw_data.raw"
COSMIC, PAIRS, DRAWN = 7, (9, 1), 1  # events of `RUN`
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


@dataclass(frozen=True)
class Layers:
    """Tracks of run 91668 with layers as described, or aligned.

    Tracks with p > 0.4 GeV/c are `fast`; of these some have clusters in three layers, or in two or three. `pull_x`,
    `pull_v`: RMS of the pulls in all layers. Halves of a cosmic muon: differences over their errors, and chi-square.
    Pairs: difference of d_z, mm, and its error.
    """

    layers: str
    tracks: int
    fast: int
    in_three: int
    in_two: int
    clusters: int
    pull_x: float
    pull_v: float
    dr: float
    phi0: float
    kappa: float
    dz: float
    tanl: float
    chi2: float
    pair_9: float
    err_9: float
    pair_1: float
    err_1: float


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


def layers(share: float) -> Numbers:
    """Reconstruct the run with layers as described and aligned."""
    rows = [_layers(name, result) for name, result in zip(("as described", "aligned"), _run(), strict=True)]
    return Numbers(rows, {"events": f"10 events of {RUN.name} of pybes3 0.5.6"})


@cache
def _run() -> tuple[cg.Result, cg.Result]:
    """Return the run with layers as described, and after three turns of alignment."""
    settings = cg.Settings(fit=cg.FitSettings(hypothesis="mu", residuals=True))
    events = read_events(_there(RUN), cg.load("besiii-cgem").with_field("besiii").with_readout("tiger"))
    result = described = reconstruct_events(events, settings)
    for _ in range(3):
        aligned = aligned_layers(events.detector, point_offsets(events, result))
        events = read_events(RUN, replace(aligned, name="besiii-cgem aligned"))
        result = reconstruct_events(events, settings)
    return described, result


def _layers(name: str, result: cg.Result) -> Layers:
    tracks, hits, residuals = result.tables["tracks"], result.candidate_hits, result.tables["residuals"]
    good = is_fitted(tracks)
    of_clusters = hits["view"] != HIT_WIRE
    layer = result.clusters["layer"][hits["hit"][of_clusters]]
    pairs = np.unique(np.stack([hits["candidate"][of_clusters], layer], axis=1), axis=0)
    in_layers = np.array([np.count_nonzero(pairs[:, 0] == one) for one in tracks["candidate"]])
    fast = good & (tracks["p"] > 0.4)
    pulls = [float(np.sqrt(np.mean(residuals["pull"][residuals["view"] == view] ** 2))) for view in (HIT_X, HIT_V)]
    parameters, cov = np.stack([tracks[name] for name in helix.PARAMETERS], axis=1), tracks["cov"].reshape(-1, 5, 5)
    first, second = np.flatnonzero(good & (tracks["event"] == COSMIC))
    difference = parameters[first] - BACKWARD * parameters[second]
    difference[1] = helix.wrap_angle(difference[1] - np.pi)
    errors = cov[first] + cov[second] * np.outer(BACKWARD, BACKWARD)
    numbers = [*(difference / np.sqrt(np.diag(errors))), difference @ np.linalg.solve(errors, difference)]
    for event in PAIRS:
        first, second = np.flatnonzero(good & (tracks["event"] == event))
        numbers += [tracks["dz"][first] - tracks["dz"][second], np.hypot(*tracks["err_dz"][[first, second]])]
    counts = (np.count_nonzero(rows) for rows in (good, fast, fast & (in_layers == 3), fast & (in_layers >= 2)))
    return Layers(name, *map(int, counts), int(tracks["n_clusters"][good].sum()), *pulls, *map(float, numbers))


def draw(found: Found) -> Picture:
    """Draw an event of the run, its layers aligned."""
    return cg.draw.event(_run()[1], DRAWN)


def _there(file: Path) -> Path:
    if not file.exists():
        raise MissingToolError(f"{file}: see pages/real_events.py")
    return file


def _events() -> Bes3Events:
    return read_events(_there(FILE), cg.load("besiii-idc").with_field("besiii"))


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
        "run91668": _table(found["layers"].rows),
    }


def _table(rows: list[Layers]) -> str:
    """Return the table of the run, one column for each state of the layers."""
    lines = {
        "fitted tracks; with p > 0.4 GeV/c": "{0.tracks}; {0.fast}",
        "of these, with clusters in three layers; in two or three": "{0.in_three}; {0.in_two}",
        "X and V clusters on tracks": "{0.clusters}",
        "pulls of X; of V (RMS)": "{0.pull_x:.1f}; {0.pull_v:.1f}",
        "cosmic muon (event 7): halves differ in $d_\\rho$, $\\phi_0$, κ, in errors": (
            "{0.dr:.1f}, {0.phi0:.1f}, {0.kappa:.1f}"
        ),
        "in $d_z$, tan λ, in errors": "{0.dz:.1f}, {0.tanl:.1f}",
        "chi-square of the halves, 5 degrees of freedom": "{0.chi2:.0f}",
        "pair of event 9: $d_z$ differs by": "{0.pair_9:.1f} ± {0.err_9:.1f} mm",
        "pair of event 1": "{0.pair_1:.1f} ± {0.err_1:.1f} mm",
    }
    head = ["run 91668", *(row.layers for row in rows)]
    return table(head, [[text, *(form.format(row).replace("-", "−") for row in rows)] for text, form in lines.items()])


PAGE = Page(
    "real_events", "docs/how-to/real_events.md", "1 min",
    {"fits": (Fit, fits), "tracks": (Tracks, tracks), "starts": (Start, starts), "layers": (Layers, layers)}, blocks,
    {"event-91668.png": draw},
)  # fmt: skip
