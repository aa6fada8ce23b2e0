"""docs/validation.md: delta electrons of a drift gap, and the X residual of the paper, beside Geant4.

How far from the track electrons get, and how many are born in the gap. Geant4's X residuals come with the program
(src/cgemit/analysis/geant4_x_residual.toml), its other numbers are in pages/reference.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import cgemit as cg
from cgemit import _core
from cgemit.analysis.clusters import X_WINDOWS, ClusterResiduals, cluster_residuals, geant4_runs, x_beyond, x_widths
from cgemit.chain.settings import Settings
from cgemit.detector import Detector, compiled
from cgemit.detector.gas import LARGEST_SIZE, ionization
from cgemit.draw.style import COLORS, Picture, grid, new_picture, style
from cgemit.simulation.transport import SimulateSettings
from cgemit.study.evaluation import seed_of
from cgemit.study.paper import COS_THETA
from cgemit.study.paper.published import paper_values
from cgemit.tables.show import with_error
from pages.geant4 import read
from pages.page import Found, Numbers, Page, share_of, table

MUONS, TRACKS, SEED = 1_000_000, 200_000, 1
LAYOUT = "besiii-cgem-design"  # of the X residual
_BATCH = 20_000
MUON, P = 0.1056583755, 1.0  # GeV/c2, GeV/c
#: Everything that can come out of the solids is followed here, as in Geant4 with this range cut and no other.
GATED_CUT = "1 um"
TOLERANCE, SIGMAS = 0.20, 3.0
DISTANCES = (0.2, 0.5, 1.0, 2.0, 5.0)  # mm
THRESHOLDS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # keV
VIEWS = ("r-phi", "z")
ORIGINS = {"all": (0, 1, 2), "gas": (0,), "cathode": (1,), "behind": (2,)}

#: Geant4's runs with the coarsest and the finest range cut.
_RUNS = (geant4_runs()[0], geant4_runs()[2])
_REFERENCE_EVENTS = 100_000  # not recorded: assumed
_CHUNK = 100_000


def reference_stack() -> Detector:
    """Return the arrangement of the Geant4 run in layer 0; what lies behind its second foil is as good as nothing."""
    changes: dict[str, object] = {
        "cgem.L1.drift_gap": "5 mm",
        "cgem.L1.transfer_gap": "2 mm",
        "cgem.L1.foils": 2,
        "cgem.L1.induction_gap": "0.1 mm",
        "cgem.L1.anode": [{"material": "CgemGas", "thickness": "0.01 um"}],
    }
    return cg.load("besiii-cgem").with_overrides(changes)


def solid_foils(detector: Detector) -> Detector:
    """Return a detector whose first layer has foils of full density."""
    layers = [
        {"material": material, "thickness": f"{thickness} um"}
        for material, thickness in (("Cu", 5), ("Kapton", 50), ("Cu", 5))
    ]
    return detector.with_overrides({"cgem.L1.foil": layers})


#: What the fractions are measured in: name, and how to make it.
ARRANGEMENTS = {
    "reference": reference_stack,
    "reference, foils without holes": lambda: solid_foils(reference_stack()),
    "whole layer": lambda: cg.load("besiii-cgem"),
}


@dataclass(frozen=True)
class Fraction:
    """Per cent of muons with an electron farther from the track than a distance (mm), beside Geant4's if there is one.

    Attributes
    ----------
    arrangement, view, origin : str
        Key of `ARRANGEMENTS`; r-phi or z; key of `ORIGINS`.
    distance : float, mm
    percent, error : float
        With its standard error.
    reference : float or None
        Per cent in Geant4 with the range cut `GATED_CUT`.
    gated : bool
        Whether the two have to agree, or are shown only.
    """

    arrangement: str
    view: str
    origin: str
    distance: float
    percent: float
    error: float
    reference: float | None
    gated: bool

    @property
    def ratio(self) -> float | None:
        """Number of cgemit over that of Geant4."""
        return None if self.reference is None else self.percent / self.reference

    @property
    def allowed(self) -> float | None:
        """How far the ratio may be from 1: the tolerance and three combined standard errors."""
        if self.reference is None:
            return None
        error = math.sqrt(self.reference * (100 - self.reference) / _REFERENCE_EVENTS)
        return TOLERANCE + SIGMAS * math.hypot(self.error, error) / self.reference

    @property
    def agrees(self) -> bool:
        """Whether the ratio is near enough to 1."""
        return self.ratio is None or self.allowed is None or abs(self.ratio - 1) <= self.allowed


@dataclass(frozen=True)
class Born:
    """Electrons born in the gap per muon above an energy (keV).

    Attributes
    ----------
    energy : float, keV
    number, error : float
        Of cgemit: those that the muon strikes; the error is statistical.
    free : float
        What the muon would strike of free electrons.
    universal, pai : float
        Of Geant4 with two models of the loss: with those that electrons strike.
    """

    energy: float
    number: float
    error: float
    free: float
    universal: float
    pai: float


def displaced(detector: Detector, n: int, seed: int, arrangement: str = "reference") -> list[Fraction]:
    """Return the fractions in the first layer of a detector, of muons of 1 GeV/c at normal incidence."""
    core = compiled(detector)
    beyond: dict[tuple[str, str], Any] = {}
    for chunk, first in enumerate(range(0, n, _CHUNK)):
        count = min(_CHUNK, n - first)
        columns = _core._testing.ionize(
            core, 0, p=P, mass=MUON, n=count, seed=seed + chunk, deltas=True, keep_clusters=False
        )
        for key, found in _count(columns, count).items():
            beyond[key] = beyond.get(key, 0) + found
    known = reference_fractions()
    rows = []
    for (view, origin), numbers in beyond.items():
        for distance, number in zip(DISTANCES, numbers, strict=True):
            share = float(number) / n
            error = math.sqrt(max(share, 1 / n) * (1 - share) / n)
            reference = known.get((view, origin, distance))
            gated = arrangement == "reference" and origin == "all"
            rows.append(Fraction(arrangement, view, origin, distance, 100 * share, 100 * error, reference, gated))
    return rows


def reference_fractions(cut: str = GATED_CUT) -> dict[tuple[str, str, float], float]:
    """Return Geant4's per cent with a range cut by view, origin and distance in mm."""
    rows = [row for row in read("deltas.csv") if row["cut"] == cut]
    return {(row["view"], row["origin"], d): float(row[f"mm_{d:g}"]) for row in rows for d in DISTANCES}


def _count(columns: Mapping[str, Any], n: int) -> dict[tuple[str, str], Any]:
    """Return how many of n muons have an electron beyond each distance, by view and origin.

    The tracks go along the x axis: displacements are those along the circle, and along z.
    """
    x, y, z, dx, dy, dz = (columns[f"deposit_{name}"] for name in ("x", "y", "z", "dx", "dy", "dz"))
    ends = [(x + part * dx, y + part * dy, z + part * dz) for part in (-0.5, 0.5)]
    displaced = {
        "r-phi": np.maximum(*(np.abs(np.hypot(a, b) * np.arctan2(b, a)) for a, b, _ in ends)),
        "z": np.maximum(*(np.abs(c) for _, _, c in ends)),
    }
    found = {}
    for view, distance in displaced.items():
        for origin, codes in ORIGINS.items():
            wanted = np.isin(columns["deposit_origin"], codes)
            farthest = np.zeros(n)
            np.maximum.at(farthest, columns["deposit_crossing"][wanted], distance[wanted])
            found[view, origin] = np.array([np.sum(farthest > limit) for limit in DISTANCES])
    return found


def born(n: int, seed: int) -> list[Born]:
    """Return the numbers of electrons born in the gap of the reference arrangement.

    Counted where clusters are drawn from the table of sizes; above it free electrons' spectrum, integrated:
    xi (1/E - 1/W - beta^2/W ln(W/E) + (W - E)/(2 E_total^2)), W the largest transfer (docs/methods/deltas.md).
    """
    detector = reference_stack()
    core, gap = compiled(detector), detector.cgem[0]
    counts = np.zeros(len(THRESHOLDS))
    for chunk, first in enumerate(range(0, n, _CHUNK)):
        count = min(_CHUNK, n - first)
        columns = _core._testing.ionize(
            core, 0, p=P, mass=MUON, n=count, seed=seed + chunk, deltas=False, keep_clusters=True
        )
        energy = columns["deposit_energy"]
        counts += [np.sum(energy > threshold) for threshold in THRESHOLDS]
    seam = (LARGEST_SIZE + 0.5) * ionization("ar-ic4h10-90-10").w_value
    xi = 1e6 * gap.gas.xi(gap.drift_gap)
    rows = []
    reference = {row["model"]: row for row in read("delta_spectrum.csv")}
    for threshold, number in zip(THRESHOLDS, counts, strict=True):
        above = _free(xi, max(threshold, seam))
        known = [float(reference[model][f"kev_{threshold:g}"]) for model in ("universal", "PAI")]
        own = float(number / n + above), float(np.sqrt(number) / n)
        rows.append(Born(threshold, *own, _free(xi, threshold), *known))
    return rows


def _free(xi: float, energy: float) -> float:
    """Return the number of free electrons struck with more than an energy; keV, xi without 1/beta^2."""
    electron, total = 510.99895, 1e6 * math.hypot(P, MUON)
    betagamma, gamma = P / MUON, math.hypot(P, MUON) / MUON
    ratio = electron * 1e-6 / MUON
    largest = 2 * electron * betagamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    beta2 = (betagamma / gamma) ** 2
    spectrum = 1 / energy - 1 / largest - beta2 / largest * math.log(largest / energy)
    return xi / beta2 * (spectrum + 0.5 * (largest - energy) / total**2)


def failures(rows: Sequence[Fraction]) -> list[str]:
    """Return what has to agree and does not, as text."""
    wrong = [row for row in rows if row.gated and not row.agrees]
    return [f"{row.view}, {row.distance:g} mm: {row.ratio:.3f} of Geant4's" for row in wrong]


@dataclass(frozen=True)
class Number:
    """A number of the X residual with its standard error.

    Attributes
    ----------
    deltas : bool
        Whether delta electrons were simulated.
    quantity : str
        Key of `X_WINDOWS` (RMS within this window, um), "beyond_3mm" or "single_strip" (fractions).
    value, error : float
    """

    deltas: bool
    quantity: str
    value: float
    error: float


def x_residual(events: int, seed: int, *, deltas: bool) -> list[Number]:
    """Return the numbers of mu- of 1 GeV/c at the angles of the paper."""
    settings = Settings(simulate=SimulateSettings(deltas=deltas))
    gun = cg.Gun("mu-", p=1.0, cos_theta=COS_THETA)
    parts = []
    for batch, first in enumerate(range(0, events, _BATCH)):
        count = min(_BATCH, events - first)
        parts.append(cluster_residuals(cg.run(LAYOUT, gun, count, seed_of(seed, batch), settings=settings)))
    residuals = _joined(parts)
    widths = {name: x_widths(residuals, window) for name, window in X_WINDOWS.items()}
    pairs = {name: (found.rms, found.rms_error) for name, found in widths.items()}
    pairs |= {"beyond_3mm": x_beyond(residuals, 3.0), "single_strip": residuals.single_strip_fraction}
    return [Number(deltas, name, float(value), float(error)) for name, (value, error) in pairs.items()]


def _joined(parts: Sequence[ClusterResiduals]) -> ClusterResiduals:
    columns = [np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "x_size", "v", "v_size")]
    return ClusterResiduals(*columns, sum(part.without_truth for part in parts), sum(part.beside for part in parts))


def measure_fractions(share: float) -> Numbers:
    """Simulate delta electrons in each arrangement."""
    n = share_of(MUONS, share, 2000)
    rows = [row for name, make in ARRANGEMENTS.items() for row in displaced(make(), n, SEED, name)]
    return Numbers(rows, {"events": f"{n:,} mu- in each arrangement; seed {SEED}"})


def measure_spectrum(share: float) -> Numbers:
    """Count electrons born in the gap."""
    n = share_of(MUONS, share, 2000)
    return Numbers(born(n, SEED), {"events": f"{n:,} mu-; seed {SEED}"})


def measure_residuals(share: float) -> Numbers:
    """Simulate the sample of the paper with and without delta electrons."""
    n = share_of(TRACKS, share, 200)
    rows = [row for deltas in (True, False) for row in x_residual(n, SEED, deltas=deltas)]
    return Numbers(rows, {"events": f"{n:,} tracks with and without delta electrons; seed {SEED}"})


def blocks(found: Found) -> dict[str, str]:
    """Return the tables, what was run, and the numbers of the text."""
    fractions, spectrum, residuals = (found[name].rows for name in ("fractions", "spectrum", "residuals"))
    return {
        **{f"{name}-events": numbers.about["events"] for name, numbers in found.items()},
        "gated": _gated(fractions),
        "residuals": _residual_table(residuals),
        **_spans(fractions, spectrum, residuals),
    }


def _gated(rows: Sequence[Fraction]) -> str:
    lines = []
    for view in VIEWS:
        found = [row for row in rows if row.gated and row.view == view]
        cells = [f"{row.ratio:.2f} ± {row.allowed:.2f}" + ("" if row.agrees else " **(off)**") for row in found]
        lines.append([view, *cells])
    return table(["view", *(f"beyond {distance:g} mm" for distance in DISTANCES)], lines)


def _residual_table(rows: Sequence[Number]) -> str:
    found = {row.quantity: row for row in rows if row.deltas}
    lines = []
    for number, window in enumerate(X_WINDOWS):
        title = "RMS of all, µm" if window == "all" else f"RMS within ±{window.removesuffix('mm')} mm, µm"
        own = with_error(found[window].value, found[window].error)
        lines.append([title, own, *(run.rms[number] for run in _RUNS)])
    far, single = found["beyond_3mm"], found["single_strip"]
    own = with_error(100 * far.value, 100 * far.error)
    lines.append(["beyond 3 mm", f"{own} %", *(run.beyond_3mm for run in _RUNS)])
    own = with_error(single.value, single.error)
    lines.append(["clusters of one strip", own, *(run.single_strip for run in _RUNS)])
    return table(["", "cgemit", *(f"Geant4, {run.title}".replace(" um", " µm") for run in _RUNS)], lines)


def _spans(fractions: Sequence[Fraction], spectrum: Sequence[Born], residuals: Sequence[Number]) -> dict[str, str]:
    """Return the numbers of the text about differences."""

    def ratio(distance: float, arrangement: str = "reference", origin: str = "all") -> str:
        wanted = (arrangement, "r-phi", origin, distance)
        rows = {(row.arrangement, row.view, row.origin, row.distance): row for row in fractions}
        return f"{rows[wanted].ratio:.2f}"

    softest = spectrum[0]
    rms = {row.quantity: row.value for row in residuals if row.deltas}
    finest = dict(zip(X_WINDOWS, geant4_runs()[2].rms, strict=True))
    quotients = sorted(rms[name] / float(text) for name, text in finest.items())
    return {
        "near": ratio(0.2),
        "far": ratio(5.0),
        "far_solid": ratio(5.0, "reference, foils without holes"),
        "far_whole": ratio(5.0, "whole layer"),
        "behind": ratio(5.0, origin="behind"),
        "behind_solid": ratio(5.0, "reference, foils without holes", "behind"),
        "struck": f"{softest.number / softest.free:.2f}",
        "more": f"{softest.pai - softest.universal:.3f}",
        "surplus": f"{softest.number - softest.free:.3f}",
        "x_rms": f"{quotients[0]:.2f} to {quotients[-1]:.2f}",
    }


_CUTS = {"0.7 mm": (":", COLORS["single"]), "30 um": ("--", COLORS["x"]), "1 um": ("-", COLORS["data"])}
_PANELS = {
    ("r-phi", "all"): "in r-phi",
    ("z", "all"): "in z",
    ("r-phi", "cathode"): "in r-phi, from the cathode",
    ("r-phi", "behind"): "in r-phi, from behind",
}
_PER_CENT = (0.2, 0.5, 1, 2, 5)
_MARKERS = {"reference": ("o", COLORS["fit"]), "whole layer": ("s", COLORS["truth"])}


def draw(found: Found) -> Picture:
    """Draw fractions against the distance, electrons born in the gap, and the RMS of the X residual by window."""
    with style():
        picture, axes = new_picture(3, 2, (8.6, 11.0))
        for plot, (key, title) in zip(axes, _PANELS.items(), strict=False):
            _draw_fractions(plot, found["fractions"].rows, *key)
            plot.set(title=title, xlabel="displaced by more than  (mm)", ylabel="muons  (%)", ylim=(0.2, 5))
        _draw_spectrum(axes[4], found["spectrum"].rows)
        _draw_residuals(axes[5], found["residuals"].rows)
        for plot in axes:
            grid(plot)
        picture.legend(handles=_handles(), loc="lower center", ncols=3)
        picture.subplots_adjust(left=0.09, right=0.99, top=0.97, bottom=0.15, wspace=0.26, hspace=0.35)
    return picture


def _draw_fractions(plot: Axes, rows: Sequence[Fraction], view: str, origin: str) -> None:
    for cut, (dashes, colour) in _CUTS.items():
        known = {d: per_cent for (v, o, d), per_cent in reference_fractions(cut).items() if (v, o) == (view, origin)}
        plot.plot(list(known), list(known.values()), dashes, color=colour)
    for arrangement, (marker, colour) in _MARKERS.items():
        found = [row for row in rows if (row.arrangement, row.view, row.origin) == (arrangement, view, origin)]
        gated = [row for row in found if row.gated]
        edges = [[(1 + sign * row.allowed) * row.reference for row in gated] for sign in (-1, 1)]
        plot.fill_between([row.distance for row in gated], *edges, color=COLORS["matter"], alpha=0.6, lw=0)
        values = [row.percent for row in found], [row.error for row in found]
        plot.errorbar([row.distance for row in found], *values, fmt=marker, color=colour, ms=5)
    plot.set(xscale="log", yscale="log")
    plot.set_xticks(DISTANCES, [f"{distance:g}" for distance in DISTANCES])
    plot.set_yticks(_PER_CENT, [f"{value:g}" for value in _PER_CENT])
    plot.minorticks_off()


def _draw_spectrum(plot: Axes, rows: Sequence[Born]) -> None:
    energy = [row.energy for row in rows]
    dashes, colour = _CUTS[GATED_CUT]
    plot.plot(energy, [row.universal for row in rows], dashes, color=colour)
    plot.plot(energy, [row.pai for row in rows], "-.", color=COLORS["multi"])
    values = [row.number for row in rows], [row.error for row in rows]
    plot.errorbar(energy, *values, fmt="o", color=COLORS["fit"], ms=5)
    plot.set(title="born in the gap", xlabel="above  (keV)", ylabel="electrons per muon", xscale="log", yscale="log")


def _draw_residuals(plot: Axes, rows: Sequence[Number]) -> None:
    names = list(X_WINDOWS)
    for run, (dashes, colour) in zip(geant4_runs(), _CUTS.values(), strict=False):
        plot.plot(range(len(names)), [_middle(text) for text in run.rms], dashes, color=colour)
    for deltas in (True, False):
        found = {row.quantity: row for row in rows if row.deltas is deltas}
        values = [found[name].value for name in names], [found[name].error for name in names]
        face = COLORS["fit"] if deltas else "white"
        plot.errorbar(range(len(names)), *values, fmt="o", color=COLORS["fit"], mfc=face, ms=5)
    plot.axhline(paper_values()["x_residual_rms"].value, color=COLORS["wire"], lw=1.2)
    plot.set_xticks(range(len(names)), ["±1 mm", "±2 mm", "±3 mm", "±5 mm", "all"])
    plot.set(title="X residual", xlabel="within", ylabel="RMS  (µm)", ylim=(0, None))


def _middle(text: str) -> float:
    """Return the middle of a number or a range."""
    ends = [float(part) for part in text.split("–")]
    return sum(ends) / len(ends)


def _handles() -> list[Line2D | Patch]:
    handles = [
        Line2D([], [], ls=ls, color=colour, label=f"Geant4, {cut}".replace(" um", " µm"))
        for cut, (ls, colour) in _CUTS.items()
    ]
    handles.append(Line2D([], [], ls="-.", color=COLORS["multi"], label="Geant4, PAI"))
    labels = {"reference": "cgemit", "whole layer": "whole layer"}
    handles += [
        Line2D([], [], ls="", marker=marker, color=colour, label=labels[name])
        for name, (marker, colour) in _MARKERS.items()
    ]
    handles.append(Line2D([], [], ls="", marker="o", color=COLORS["fit"], mfc="white", label="no deltas"))
    return [*handles, Line2D([], [], color=COLORS["wire"], label="paper"), Patch(fc=COLORS["matter"], label="allowed")]


PAGE = Page(
    "deltas",
    "docs/validation.md",
    "2 min",
    {
        "fractions": (Fraction, measure_fractions),
        "spectrum": (Born, measure_spectrum),
        "residuals": (Number, measure_residuals),
    },
    blocks,
    {"validation-deltas.png": draw},
    lambda found: failures(found["fractions"].rows),
)
