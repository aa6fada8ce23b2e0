"""docs/validation.md: scattering and energy loss in slabs, cgemit beside Geant4.

Geant4's numbers are in pages/reference. What is compared, and how far it may be off, is here.
"""

from __future__ import annotations

import csv
import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

import cgemit as cg
from cgemit.draw.style import COLORS, Picture, grid, legend_entries, new_picture, style
from cgemit.simulation.slab import SlabResult
from pages.page import ROOT, Found, Numbers, Page, say, share_of, table

REFERENCE = ROOT / "pages" / "reference"
EVENTS, SEED = 400_000, 1

#: The slabs as `cgemit slab` takes them; the formula has the mass fractions of the epoxy to 0.0005.
_CGEM = "Kapton {} um + Cu {} um + C 2.0 g/cm3 {} um + C52H59O9 1.20 g/cm3 {} um"
SLABS = {
    "C_0.1X0": "C 2.0 g/cm3 213.485 um",
    "Cu_14um": "Cu 14 um",
    "Be_1.4mm": "Be 1.4 mm",
    "Ar_10mm": "Ar 10 mm",
    "HeC3H8_16mm": "He/C3H8 16 mm",
    "CGEM_0.114": _CGEM.format(300, 33, 120, 150),
    "CGEM_0.13": _CGEM.format(*(round(1.1387 * length, 3) for length in (300, 33, 120, 150))),
}
#: What people call them.
TITLES = {
    "C_0.1X0": "C 0.1 % X0",
    "Cu_14um": "Cu 14 um",
    "Be_1.4mm": "Be 1.4 mm",
    "Ar_10mm": "Ar 10 mm",
    "HeC3H8_16mm": "He/C3H8 60/40, 16 mm",
    "CGEM_0.114": "CGEM layer, 0.114 g/cm2",
    "CGEM_0.13": "CGEM layer, 0.130 g/cm2",
}
ANGLES = ("q68_mrad", "q98_mrad", "q999_mrad")
LOSSES = tuple(f"loss_kev_{name}" for name in ("mean", "mode", "fwhm", "q01", "q16", "q50", "q84", "q99"))

_SS_ERRORS = dict(zip(ANGLES, (0.004, 0.008, 0.06), strict=True))  # relative, pages/reference/README.md
_GATED_LOSSES = ("C_0.1X0", "Be_1.4mm", "CGEM_0.114", "CGEM_0.13")
_TOLERANCES = {"q68_mrad": 0.05, "q98_mrad": 0.05, "q999_mrad": 0.10, "loss_kev_q50": 0.03, "loss_kev_q99": 0.08}
_SIGMAS = 3.0  # the tail of the angle may be off by so many standard errors, if that is more
_BUT_CHAMBER = tuple(slab for slab in SLABS if slab != "HeC3H8_16mm")
#: Rows of the table of gates: title, Geant4's model, what is allowed, quantity, slabs.
_GATES = (
    ("angle, 68 %", "single scattering", "5 %", "q68_mrad", _BUT_CHAMBER),
    ("angle, 98 %", "single scattering", "5 %", "q98_mrad", _BUT_CHAMBER),
    ("angle, 99.9 %", "single scattering", "10 % or 3 errors", "q999_mrad", _BUT_CHAMBER),
    ("angle, 68 %, chamber gas", "Wentzel-VI, 10 steps", "5 %", "q68_mrad", ("HeC3H8_16mm",)),
    ("loss, median", "universal", "3 %", "loss_kev_q50", _BUT_CHAMBER),
    ("loss, 99 %", "universal", "8 %", "loss_kev_q99", _BUT_CHAMBER),
)

_MOMENTA = {0.1: COLORS["single"], 0.2: COLORS["x"], 1.0: COLORS["fit"]}
_NAMES = {"q68_mrad": "q68", "q98_mrad": "q98 / 2.326", "q999_mrad": "q99.9 / 3.291"}
_INSIDE = {"q68_mrad": (0.6827, 1.0), "q98_mrad": (0.98, 2.326), "q999_mrad": (0.999, 3.291)}
#: Slabs whose distributions are drawn, and at which fractions beyond an angle and below a loss.
_DRAWN = ("C_0.1X0", "Cu_14um", "Ar_10mm", "CGEM_0.13")
_BEYOND = np.geomspace(0.95, 3e-4, 100)
_BELOW = 1 / (1 + np.exp(-np.linspace(-6.2, 6.2, 100)))
_QUANTILES = {"q01": 0.01, "q16": 0.16, "q50": 0.5, "q84": 0.84, "q99": 0.99}
#: Geant4's other models, drawn as ratios to its single scattering: marker and colour.
_OTHERS = {
    "WVI 10 steps": ("v", COLORS["multi"]),
    "WVI 1 step": ("^", COLORS["x"]),
    "Urban 1 step": ("s", COLORS["wire"]),
}


@dataclass(frozen=True)
class Comparison:
    """One number of cgemit beside one of a reference.

    Attributes
    ----------
    slab, quantity, model, screening : str
        The slab by its short name; the reference's model; the screening of cgemit.
    p : float, GeV/c
    value, error, reference : float
    reference_error : float or None
        Standard errors; None where the reference's number of events is not known.
    gated : bool
        Whether the two have to agree, or are shown only.
    """

    slab: str
    quantity: str
    model: str
    screening: str
    p: float
    value: float
    error: float
    reference: float
    reference_error: float | None
    gated: bool

    @property
    def ratio(self) -> float:
        """Number of cgemit over that of the reference."""
        return self.value / self.reference

    @property
    def ratio_error(self) -> float:
        """Combined standard error of the ratio."""
        return self.ratio * math.hypot(self.error / self.value, (self.reference_error or 0.0) / self.reference)

    @property
    def allowed(self) -> float:
        """How far the ratio may be from 1: the tolerance, for q999 at least three combined standard errors."""
        if not self.gated:
            return math.inf
        tolerance = _TOLERANCES[self.quantity]
        return max(tolerance, _SIGMAS * self.ratio_error) if self.quantity == "q999_mrad" else tolerance

    @property
    def agrees(self) -> bool:
        """Whether the ratio is near enough to 1."""
        return abs(self.ratio - 1) <= self.allowed


def read(name: str) -> list[dict[str, str]]:
    """Return the rows of a file of pages/reference."""
    lines = (REFERENCE / name).read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def references() -> list[tuple[str, Mapping[str, str]]]:
    """Return the rows about slabs with the models they come from."""
    rows = [(row["model"], row) for row in read("scattering.csv")]
    rows += [("WVI", row) for row in read("geant4_wvi.csv")]
    return rows + [("PAI", row) for row in read("geant4_pai.csv")]


def cases() -> list[tuple[str, float]]:
    """Return slabs and momenta with a reference, in the order of `SLABS`."""
    found = {(row["slab"], float(row["p_gev"])) for _, row in references()}
    return sorted(found, key=lambda case: (list(SLABS).index(case[0]), case[1]))


def compare(result: SlabResult, slab: str) -> list[Comparison]:
    """Return the numbers of a simulated slab beside all references for it."""
    found = []
    for model, row in references():
        if row["slab"] == slab and float(row["p_gev"]) == result.p:
            found += _compare_row(result, slab, model, row)
    return found


def _compare_row(result: SlabResult, slab: str, model: str, row: Mapping[str, str]) -> Iterator[Comparison]:
    for name in (*ANGLES, *LOSSES):
        value, error = getattr(result, name), result.errors[name]
        if not row.get(name) or value is None or error is None:
            continue
        reference, events = float(row[name]), row["n"]
        # Of the other models only numbers of events are known: their relative errors are those of cgemit, scaled.
        share = error / value * math.sqrt(result.n / float(events)) if events else None
        if model == "SS":
            share = _SS_ERRORS[name]
        yield Comparison(
            slab=slab, quantity=name, model=model, screening=result.screening, p=result.p, value=value, error=error,
            reference=reference, reference_error=None if share is None else share * reference,
            gated=name in _TOLERANCES and result.screening == "wentzel" and _is_gate(slab, name, model),
        )  # fmt: skip


def _is_gate(slab: str, name: str, model: str) -> bool:
    trusted = "WVI 10 steps" if slab == "HeC3H8_16mm" else "SS"
    return model == trusted if name in ANGLES else model == "WVI" and slab in _GATED_LOSSES


@dataclass(frozen=True)
class Quantile:
    """A quantile of the absolute plane angle (mrad; `level` is beyond it) or of the loss (keV; `level` is below it)."""

    slab: str
    p: float  # GeV/c
    quantity: str  # "angle" or "loss"
    level: float
    value: float


@functools.cache
def simulated(slab: str, p: float, screening: str, events: int) -> SlabResult:
    """Simulate the muons of a slab."""
    say(f"{SLABS[slab]}, {p:g} GeV/c, {screening}")
    return cg.slab(SLABS[slab], "mu-", p, events, SEED, screening)


def measure_slabs(share: float) -> Numbers:
    """Compare all slabs with both screenings; the loss does not depend on it."""
    events, rows = share_of(EVENTS, share, 2500), []
    for slab, p in cases():
        for screening in ("wentzel", "moliere"):
            found = compare(simulated(slab, p, screening, events), slab)
            rows += [row for row in found if screening == "wentzel" or row.quantity.endswith("mrad")]
    text = f"{events:,} mu- for each slab, momentum and screening; seed {SEED}"
    return Numbers(rows, {"events": text, "reference": "Geant4 11.4.1"})


def measure_quantiles(share: float) -> Numbers:
    """Return the distributions that are drawn, as quantiles."""
    events, rows = share_of(EVENTS, share, 2500), []
    for slab in _DRAWN:
        for p in _MOMENTA:
            result = simulated(slab, p, "wentzel", events)
            both = np.abs(1e3 * np.concatenate([result.angle_1, result.angle_2])[np.tile(result.through, 2)])
            for quantity, levels, values in (
                ("angle", _BEYOND, np.quantile(both, 1 - _BEYOND)), ("loss", _BELOW, np.quantile(result.loss, _BELOW))
            ):  # fmt: skip
                pairs = zip(levels, values, strict=True)
                rows += [Quantile(slab, p, quantity, float(level), float(value)) for level, value in pairs]
    return Numbers(rows, {"events": f"{events:,} mu- for each slab and momentum; seed {SEED}"})


def blocks(found: Found) -> dict[str, str]:
    """Return the tables, what was run, and the numbers of the text."""
    rows, about = found["slabs"].rows, found["slabs"].about
    return {
        "versions": about["versions"],
        "slab-events": about["events"],
        "slab-gates": _gate_table(rows),
        **_spans(rows),
    }


def failures(found: Found) -> list[str]:
    """Return what has to agree and does not."""
    wrong = [row for row in found["slabs"].rows if row.gated and not row.agrees]
    return [f"{row.slab}, {row.p:g} GeV/c, {row.quantity}: {row.ratio:.3f} of Geant4's" for row in wrong]


def _gate_table(rows: Sequence[Comparison]) -> str:
    lines = []
    for title, model, allowed, quantity, slabs in _GATES:
        found = [row for row in rows if row.gated and row.quantity == quantity and row.slab in slabs]
        ratios = [row.ratio for row in found]
        worst = max(found, key=lambda row: abs(row.ratio - 1) / row.allowed)
        span = f"{min(ratios):.3f} to {max(ratios):.3f}"
        lines.append([title, model, allowed, span, f"{_ratio(worst)}, {TITLES[worst.slab]}, {worst.p:g} GeV/c"])
    return table(["quantity", "Geant4 model", "allowed", "cgemit over Geant4", "nearest to the limit"], lines)


def _ratio(row: Comparison) -> str:
    return f"{row.ratio:.3f} ± {row.ratio_error:.3f}" + (" **(off)**" if row.gated and not row.agrees else "")


def _spans(rows: Sequence[Comparison]) -> dict[str, str]:
    """Return the numbers of the text, as ranges over what they speak of."""

    def span(wanted: Callable[[Comparison], bool], screening: str = "wentzel") -> str:
        found = sorted(row.ratio for row in rows if row.screening == screening and wanted(row))
        return f"{found[0]:.2f} to {found[-1]:.2f}"

    def loss(quantity: str, *slabs: str) -> str:
        return span(lambda r: r.model == "WVI" and r.quantity == f"loss_kev_{quantity}" and r.slab in slabs)

    solids = [slab for slab in TITLES if slab != "Ar_10mm"]
    widths = [row for row in rows if row.quantity == "loss_kev_fwhm" and row.slab in solids]
    return {
        "narrow-kev": f"{max(abs(row.value - row.reference) for row in widths):.0f}",
        "moliere": span(lambda r: r.model == "SS" and r.quantity == ANGLES[0], "moliere"),
        "narrow": loss("fwhm", *solids),
        "q16": loss("q16", *solids),
        "copper": loss("q50", "Cu_14um"),
    }


def draw_scattering_ratios(found: Found) -> Picture:
    """Draw widths of the plane angle over those of Geant4's single scattering; the band is what is allowed."""
    rows = found["slabs"].rows
    single = [row for row in rows if row.model == "SS"]
    places = list(dict.fromkeys((row.slab, row.p) for row in single))
    with style():
        picture, axes = new_picture(3, 1, (8.6, 11.5))
        for plot, name in zip(axes, ANGLES, strict=True):
            by_place = {(row.slab, row.p, row.screening): row for row in single if row.quantity == name}
            for i, (slab, p) in enumerate(places):
                row = by_place[slab, p, "wentzel"]
                _band(plot, i, row)
                _point(plot, i - 0.2, row, "o", COLORS["fit"], "cgemit, wentzel")
                _point(plot, i, by_place[slab, p, "moliere"], "D", COLORS["truth"], "cgemit, moliere")
            _others(plot, rows, name, places)
            plot.axhline(1, color=COLORS["data"], lw=0.9)
            plot.set(title=_NAMES[name], ylabel="ratio to Geant4 single scattering", xlim=(-0.6, len(places) - 0.4))
            labels = [f"{TITLES[slab]}, {p:g} GeV/c" for slab, p in places]
            plot.set_xticks(range(len(places)), labels, rotation=35, ha="right", fontsize=8)
            grid(plot)
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=3)
        picture.subplots_adjust(left=0.09, right=0.99, top=0.97, bottom=0.17, hspace=0.72)
    return picture


def _point(plot: Axes, x: float, row: Comparison, marker: str, colour: str, label: str) -> None:
    plot.errorbar(x, row.ratio, row.ratio_error, fmt=marker, color=colour, ms=5, lw=1.1, label=label, zorder=4)


def _band(plot: Axes, x: float, row: Comparison) -> None:
    """Draw what is allowed."""
    plot.fill_between((x - 0.42, x + 0.42), 1 - row.allowed, 1 + row.allowed, color=COLORS["matter"], lw=0)


def _others(plot: Axes, rows: Sequence[Comparison], name: str, places: Sequence[tuple[str, float]]) -> None:
    """Draw Geant4's other models; they have no errors on record."""
    single = {(r.slab, r.p): r.reference for r in rows if r.model == "SS" and r.quantity == name}
    for model, (marker, colour) in _OTHERS.items():
        found = {(r.slab, r.p): r.reference for r in rows if r.model == model and r.quantity == name}
        x = [i + 0.22 for i, place in enumerate(places) if place in found]
        y = [found[place] / single[place] for place in places if place in found]
        plot.plot(x, y, marker, color=colour, mfc="white", ms=5, label=f"Geant4, {model}", zorder=3)


def draw_loss_ratios(found: Found) -> Picture:
    """Draw quantiles and mean of the energy loss over those of Geant4, one panel per slab."""
    rows = found["slabs"].rows
    names = [*_QUANTILES, "mean"]
    slabs = list(dict.fromkeys(row.slab for row in rows if row.model == "WVI"))
    with style():
        picture, axes = new_picture(3, 2, (8.6, 10.0))
        for plot, slab in zip(axes, slabs, strict=True):
            for number, (p, colour) in enumerate(_MOMENTA.items()):
                for row in rows:
                    name = row.quantity.removeprefix("loss_kev_")
                    if (row.slab, row.p, row.model) != (slab, p, "WVI") or name not in names:
                        continue
                    x = names.index(name) + 0.18 * (number - 1)
                    if row.gated:
                        _band(plot, names.index(name), row)
                    _point(plot, x, row, "o", colour, f"{p:g} GeV/c")
            plot.axhline(1, color=COLORS["data"], lw=0.9)
            plot.set_xticks(range(len(names)), ["1 %", "16 %", "median", "84 %", "99 %", "mean"])
            plot.set(title=TITLES[slab], ylabel="energy loss, ratio to Geant4")
            low, high = plot.get_ylim()
            plot.set_ylim(max(low, 0.7), min(high, 1.6))
            grid(plot)
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=3)
        picture.subplots_adjust(left=0.09, right=0.99, top=0.96, bottom=0.08, wspace=0.28, hspace=0.3)
    return picture


def draw_distributions(found: Found) -> Picture:
    """Draw how many angles are beyond, and how many losses below a value; points are Geant4's quantiles."""
    with style():
        picture, axes = new_picture(4, 2, (8.6, 12.5))
        for left, right, slab in zip(axes[::2], axes[1::2], _DRAWN, strict=True):
            for p, colour in _MOMENTA.items():
                mine = [row for row in found["quantiles"].rows if (row.slab, row.p) == (slab, p)]
                for plot, name in ((left, "angle"), (right, "loss")):
                    curve = [row for row in mine if row.quantity == name]
                    plot.plot([row.value for row in curve], [row.level for row in curve], color=colour, lw=1.3)
                _geant4_angles(left, slab, p, colour)
                _geant4_losses(right, slab, p, colour)
            left.set(title=TITLES[slab], xscale="log", yscale="log", ylim=(3e-4, 1.2), xlabel="|plane angle|  (mrad)")
            right.set(xscale="log", yscale="logit", ylim=(0.002, 0.998), xlabel="energy loss  (keV)")
            right.yaxis.set_minor_formatter(NullFormatter())
            right.xaxis.set_minor_formatter(NullFormatter())
            left.set_ylabel("fraction beyond")
            right.set_ylabel("fraction below", labelpad=0)
        for plot in axes:
            grid(plot)
        handles = [Line2D([], [], color=colour, label=f"cgemit, {p:g} GeV/c") for p, colour in _MOMENTA.items()]
        points = (("o", "SS + ionisation"), ("^", "WVI, one step"))
        handles += [
            Line2D([], [], ls="", marker=marker, mfc="white", color=COLORS["data"], label=f"Geant4, {label}")
            for marker, label in points
        ]
        picture.legend(handles=handles, loc="lower center", ncols=3)
        picture.subplots_adjust(left=0.09, right=0.99, top=0.97, bottom=0.1, wspace=0.28, hspace=0.42)
    return picture


def _geant4_angles(plot: Axes, slab: str, p: float, colour: str) -> None:
    for model, row in references():
        if row["slab"] == slab and float(row["p_gev"]) == p and model in ("SS", "WVI"):
            marker = "o" if model == "SS" else "^"
            for name, (inside, gaussian) in _INSIDE.items():
                plot.plot(float(row[name]) * gaussian, 1 - inside, marker, color=colour, mfc="white", ms=5.5)


def _geant4_losses(plot: Axes, slab: str, p: float, colour: str) -> None:
    for model, row in references():
        if row["slab"] == slab and float(row["p_gev"]) == p and model == "WVI":
            for name, level in _QUANTILES.items():
                plot.plot(float(row[f"loss_kev_{name}"]), level, "^", color=colour, mfc="white", ms=5.5)


PAGE = Page(
    "geant4",
    "docs/validation.md",
    "1 min",
    {"slabs": (Comparison, measure_slabs), "quantiles": (Quantile, measure_quantiles)},
    blocks,
    {
        "validation-scattering.png": draw_scattering_ratios,
        "validation-loss.png": draw_loss_ratios,
        "validation-distributions.png": draw_distributions,
    },
    failures,
)
