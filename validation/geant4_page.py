"""The first part of docs/validation.md, cgemit beside Geant4, written from validation/results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from delta_fractions import Born, Fraction
from delta_page import delta_section, residual_section, spans
from geant4_reference import ANGLES, TITLES, Comparison
from results import FOLDER, read_rows, table
from x_residual import Number

_HEAD = """# Validation

Two parts: [cgemit beside Geant4](#cgemit-beside-geant4), matter and hits; and [the fit beside what it
promises](#the-fit-beside-what-it-promises).

# cgemit beside Geant4

Muons through slabs, delta electrons in a drift gap, and the X residual of the paper, simulated by cgemit and by
{reference}. This page and its pictures are written by

```sh
python validation/geant4.py
```

(a minute or two; numbers in `validation/results`). Geant4 is not needed for that: its numbers are in
[validation/data](../validation/data/README.md), with the slabs, what was switched on, and the numbers of events. Any
other slab: `cgemit slab "Kapton 300 um + Cu 33 um" --particle pi- --p 0.5`.

This version: {versions}. Slabs: {events}.
"""

_SCATTERING = """
## Scattering

Half widths of the plane angle that hold 68.27 %, 98 % and 99.9 % of the muons, divided by what they are for a Gaussian
of width 1. The reference is Geant4 with every single scatter (SS, 60 000 muons). **q68 and q98 have to agree within
5 %, q99.9 within 10 % or three combined standard errors**, whichever is more, with the default screening `wentzel`.

![Widths of the plane angle over those of Geant4](images/validation-scattering.png)

Grey bands are what is allowed. Geant4's other models are drawn without errors.
"""

_GAS = """
Gas of the drift chamber, against Wentzel-VI with ten steps (only q68 is on record). Hydrogen does a tenth of the
scattering and is screened with factor 1; with factor 2 the width would be 2 % smaller:
"""

_LOSS = """
## Energy loss

The reference has 400 000 muons for each slab and momentum. **The median has to agree within 3 %, the 99 % quantile
within 8 %** for carbon, beryllium and the CGEM layer. The other quantiles, and copper and argon, are shown.

![Quantiles of the energy loss over those of Geant4](images/validation-loss.png)
"""

_DISTRIBUTIONS = """
## Distributions

How many angles are beyond, and how many losses below a value: curves are cgemit, points the quantiles of Geant4.

![Distributions of angle and loss with Geant4's quantiles](images/validation-distributions.png)
"""

_WHY = """
## Where they differ, and why

**Core of the angle.** cgemit's `wentzel` screening multiplies Moliere's squared screening angle by 1 + exp(-Z²/1000),
as the Wentzel-VI model of Geant4 does: 2 for light elements, 1 for heavy ones and for hydrogen; `moliere` leaves it
out, and is wider.
In both, electrons are scatterers of their own, which take no more than their recoil allows. With `wentzel`, q68 and
q98 are {core} of SS. Argon has the fewest scatters per slab: there the shape of the screening, and not its size
alone, decides on the core.

**Geant4 against itself.** Its Wentzel-VI model with one step is 4 to 6 % wider in the core of solids than its own
single scattering, and than itself with ten steps. Such rows are in the picture, and nothing is tested against them.
Urban's model has no hard tail and is too wide in gas.

**Tail of the angle.** In both programs the tail is single scatters off nuclei, fewer of them beyond the nucleus' size.
The 6 % error of the reference dominates.

**Loss, below the median and at half maximum.** cgemit has the core of Landau's distribution, which is that of free
electrons: 4.02 ξ wide. Bound electrons widen it in thin slabs (O. Blunck, S. Leisegang, Z. Phys. 128 (1950) 500), which
Geant4's universal fluctuation model describes by two excitation levels and cgemit does not. The widths at half maximum
of solids are {narrow} of Geant4's, the 16 % quantiles {q16}, and the difference vanishes for thick slabs and
slow muons. Geant4's own width depends on the step (carbon: 18.2, 17.6 and 16.4 keV with 1, 10 and 100 steps; copper:
8.0, 5.7 and 4.9 keV), so none of this is tested. Momentum resolution does not notice: a keV is 10⁻⁶ of 1 GeV/c.

**Loss in 14 um of copper.** cgemit is {copper} of Geant4 in the median. There the universal model is off by 8 to
16 %; cgemit is tested against an exact convolution of the collision spectrum (Vavilov's distribution) instead.

**Loss in 10 mm of argon.** ξ is below the binding energies: the core counts a few dozen ionizations, and neither
Landau's distribution nor the universal model describes it; the photo-absorption model of Geant4 shows how far that goes
(table). What a drift gap sees is therefore not this loss, but ionization clusters ([matter](methods/matter.md)).

**Mean.** Rare collisions with large transfers make the mean: it fluctuates by a per cent even with 400 000 muons.

**Delta electrons near the track.** cgemit has {near} times Geant4's at 0.2 mm. HEED's clusters above 1 keV are {struck}
times what the muon strikes of free electrons, since the argon K shell adds to them: {surplus} more per muon. Geant4's
universal model has free electrons; its photo-absorption model has {more} more per muon, and an electron beyond
0.2 mm for 0.2 per cent of the muons more. That its universal model and cgemit agree in the number above 1 keV is
chance: Geant4's includes electrons that electrons strike, while those of cgemit slow down continuously.

**Delta electrons far away.** Beyond 5 mm nearly as many come from behind as from the cathode, so that what stands
behind the gap decides: {far} of Geant4 in its own arrangement, {far_solid} with foils of full density ({behind} and
{behind_solid} of those from behind). The whole layer is another arrangement: its third foil and its anode send back
enough for {far_whole}. So the gate is on the arrangement of the run.

**X residual.** {x_rms} of Geant4's RMS with the cut of 1 um in every window; Geant4's standard errors, from a third of
the crossings, are nearly twice those of cgemit in the table. Coarser cuts have fewer electrons and less RMS. The far
tail makes it: a few crossings in a thousand are beyond 3 mm.
"""


@dataclass(frozen=True)
class Results:
    """The rows of all files of results, and what was run for each file."""

    slabs: list[Comparison]
    fractions: list[Fraction]
    spectrum: list[Born]
    residuals: list[Number]
    about: Mapping[str, Mapping[str, str]]


def read_results(folder: Path = FOLDER) -> Results:
    """Return what the files of a folder hold."""
    kinds = {"slabs": Comparison, "fractions": Fraction, "spectrum": Born, "residuals": Number}
    files = {name: read_rows(folder / f"{name}.csv", kind) for name, kind in kinds.items()}
    rows = {name: found for name, (found, _) in files.items()}
    return Results(**rows, about={name: about for name, (_, about) in files.items()})


def page(results: Results) -> str:
    """Return the page as Markdown."""
    rows, about = results.slabs, results.about
    events = {name: about[name]["events"] for name in ("fractions", "spectrum")}
    shown = results.fractions, results.spectrum
    why = _WHY.format(**_spans(rows), **spans(*shown, results.residuals))
    parts = [_HEAD.format(**about["slabs"]), _SCATTERING, _scattering_table(rows), _GAS, _gas_table(rows)]
    parts += [_LOSS, _loss_table(rows)]
    parts += [_shown_table(rows), _DISTRIBUTIONS, delta_section(*shown, events)]
    return "".join([*parts, residual_section(results.residuals, about["residuals"]), why])


def _scattering_table(rows: Sequence[Comparison]) -> str:
    head = [
        "slab",
        "p, GeV/c",
        *(f"{name}, mrad | over SS" for name in ("q68", "q98", "q99.9")),
        "moliere, q68 over SS",
    ]
    lines = []
    single = [row for row in rows if row.model == "SS"]
    for slab, p in dict.fromkeys((row.slab, row.p) for row in single):
        found = {(r.quantity, r.screening): r for r in single if (r.slab, r.p) == (slab, p)}
        cells = [f"{found[name, 'wentzel'].value:.4g} | {_ratio(found[name, 'wentzel'])}" for name in ANGLES]
        lines.append([TITLES[slab], f"{p:g}", *cells, _ratio(found["q68_mrad", "moliere"])])
    return table(head, lines)


def _gas_table(rows: Sequence[Comparison]) -> str:
    found = {(r.slab, r.p, r.screening): r for r in rows if r.slab == "HeC3H8_16mm"}
    lines = []
    for slab, p in dict.fromkeys((slab, p) for slab, p, _ in found):
        row = found[slab, p, "wentzel"]
        lines.append([TITLES[slab], f"{p:g}", f"{row.value:.4g}", _ratio(row), _ratio(found[slab, p, "moliere"])])
    return table(["slab", "p, GeV/c", "q68, mrad", "over Geant4", "moliere, over Geant4"], lines)


def _loss_table(rows: Sequence[Comparison]) -> str:
    head = ["slab", "p, GeV/c", "median, keV", "over Geant4", "99 %, keV", "over Geant4"]
    lines = []
    gated = [row for row in rows if row.gated and row.quantity.startswith("loss")]
    for slab, p in dict.fromkeys((row.slab, row.p) for row in gated):
        found = {r.quantity: r for r in gated if (r.slab, r.p) == (slab, p)}
        cells = []
        for name in ("loss_kev_q50", "loss_kev_q99"):
            cells += [f"{found[name].value:.4g}", _ratio(found[name])]
        lines.append([TITLES[slab], f"{p:g}", *cells])
    return table(head, lines)


def _shown_table(rows: Sequence[Comparison]) -> str:
    names = {"mean": "mean", "mode": "most probable", "fwhm": "FWHM", "q01": "1 %", "q16": "16 %", "q50": "median",
             "q84": "84 %", "q99": "99 %"}  # fmt: skip
    models = {"WVI": "universal", "PAI": "photo-absorption"}
    lines = []
    for slab, p, model in dict.fromkeys((r.slab, r.p, r.model) for r in rows if r.model in models):
        found = {r.quantity.removeprefix("loss_kev_"): r for r in rows if (r.slab, r.p, r.model) == (slab, p, model)}
        cells = [f"{found[name].ratio:.3f}" if name in found else "–" for name in names]
        lines.append([TITLES[slab], f"{p:g}", models[model], *cells])
    return "\nAll of them, as ratios of cgemit to Geant4:\n" + table(
        ["slab", "p, GeV/c", "Geant4's model", *names.values()], lines
    )


def _ratio(row: Comparison) -> str:
    return f"{row.ratio:.3f} ± {row.ratio_error:.3f}" + (" **(off)**" if row.gated and not row.agrees else "")


def _spans(rows: Sequence[Comparison]) -> dict[str, str]:
    """Return the numbers of the text, as ranges over what they speak of."""

    def span(wanted: Callable[[Comparison], bool]) -> str:
        found = sorted(row.ratio for row in rows if row.screening == "wentzel" and wanted(row))
        return f"{found[0]:.2f} to {found[-1]:.2f}"

    def loss(quantity: str, *slabs: str) -> str:
        return span(lambda r: r.model == "WVI" and r.quantity == f"loss_kev_{quantity}" and r.slab in slabs)

    solids = [slab for slab in TITLES if slab != "Ar_10mm"]
    return {
        "core": span(lambda r: r.model == "SS" and r.quantity in ANGLES[:2]),
        "narrow": loss("fwhm", *solids),
        "q16": loss("q16", *solids),
        "copper": loss("q50", "Cu_14um"),
    }
