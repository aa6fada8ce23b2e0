"""The sections of docs/validation.md about delta electrons and the X residual."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from cgemit.analysis.clusters import X_WINDOWS, geant4_runs
from cgemit.study.paper.published import paper_values
from cgemit.tables.show import with_error
from delta_fractions import CUTS, DISTANCES, GATED_CUT, ORIGINS, VIEWS, Born, Fraction, reference_fractions
from results import table
from x_residual import Number

_DELTAS = """
## Delta electrons

Per cent of muons of 1 GeV/c, at normal incidence, with an electron in a 5 mm gap of Ar/iC4H10 displaced from the track
by more than a distance: cathode of the first layer as built, gap, foil, 2 mm of gas, foil; 1 T.
{events}.

Geant4 follows electrons that reach farther than its range cut; cgemit follows everything that can come out of the
solids, which is the row of 1 um, and no coarser one. **All electrons together have to agree with that row within 20 %
plus three combined standard errors**, in r-phi and in z (100 000 muons assumed for Geant4, whose number is not
recorded). The foils are those of `besiii-cgem` as built, their holes spread over the density; which the run had is not
recorded.

![Displaced electrons, electrons born in the gap, and X residual](images/validation-deltas.png)
"""

_SHOWN = """
What is not gated: range cuts, origins, foils without holes, and the whole first layer of `besiii-cgem` (5.149 mm gap,
three foils, anode). Per cent beyond 0.2, 0.5, 1, 2 and 5 mm:
"""

_BORN = """
Electrons born in the gap per muon ({events}; above 52 keV integrated, not sampled).
Those of cgemit and the free ones are struck by the muon, those of Geant4 by electrons as well:
"""

_RESIDUAL = """
## X residual of the paper

RMS in um of the cluster centre within a window, in `besiii-cgem-design`, mu- of 1 GeV/c, cos(theta) uniform in ±0.93,
three crossings each; {events}.
{geant4} on the same layout had 180 000 crossings. The paper publishes {paper} um without a window;
[paper](paper.md) says what follows from that.
"""


def delta_section(fractions: Sequence[Fraction], spectrum: Sequence[Born], about: Mapping[str, str]) -> str:
    """Return the section about delta electrons from the rows of results, and what was run (`about`)."""
    gated = [row for row in fractions if row.gated]
    lines = []
    for row in gated:
        text = f"{row.ratio:.3f} ± {row.allowed:.3f}" + ("" if row.agrees else " **(off)**")
        lines.append(
            [row.view, f"{row.distance:g}", f"{row.percent:.3f} ± {row.error:.3f}", f"{row.reference:g}", text]
        )
    head = ["view", "more than, mm", "cgemit, %", "Geant4, 1 um, %", "ratio ± allowed"]
    return "".join([
        _DELTAS.format(events=about["fractions"]), table(head, lines), _SHOWN, _shown(fractions),
        _BORN.format(events=about["spectrum"]), _spectrum(spectrum),
    ])  # fmt: skip


def _shown(rows: Sequence[Fraction]) -> str:
    lines = []
    for origin in ORIGINS:
        for cut in CUTS:
            known = reference_fractions(cut)
            if origin == "all" or (cut == GATED_CUT and ("r-phi", origin, DISTANCES[0]) in known):
                views = [[known.get((view, origin, distance)) for distance in DISTANCES] for view in VIEWS]
                lines.append([origin, f"Geant4, {cut}", *map(_series, views)])
        for name in dict.fromkeys(row.arrangement for row in rows):
            found = [row for row in rows if (row.arrangement, row.origin) == (name, origin)]
            views = [[row.percent for row in found if row.view == view] for view in VIEWS]
            lines.append([origin, f"cgemit, {name}", *map(_series, views)])
    return table(["origin", "", *(f"{view}, %" for view in VIEWS)], lines)


def _series(numbers: Sequence[float | None]) -> str:
    return " ".join("–" if number is None else f"{number:.2f}" for number in numbers)


def _spectrum(rows: Sequence[Born]) -> str:
    lines = [
        ["cgemit", *(f"{row.number:.4f}" for row in rows)],
        ["free electrons", *(f"{row.free:.4f}" for row in rows)],
        ["Geant4, universal", *(f"{row.universal:.4f}" for row in rows)],
        ["Geant4, PAI", *(f"{row.pai:.4f}" for row in rows)],
    ]
    return table(["above, keV", *(f"{row.energy:g}" for row in rows)], lines)


def residual_section(rows: Sequence[Number], about: Mapping[str, str]) -> str:
    """Return the section about the X residual from the rows of results, and what was run (`about`)."""
    found = {(row.deltas, row.quantity): row for row in rows}
    lines = []
    for number, window in enumerate(X_WINDOWS):
        cells = [with_error(found[deltas, window].value, found[deltas, window].error) for deltas in (True, False)]
        title = "all" if window == "all" else f"±{window.removesuffix('mm')} mm"
        lines.append([title, *cells, *(run.rms[number] for run in geant4_runs())])
    for name, title, text in (
        ("beyond_3mm", "residuals beyond 3 mm", [run.beyond_3mm for run in geant4_runs()]),
        ("single_strip", "clusters of one strip", [run.single_strip for run in geant4_runs()]),
    ):
        scale, unit = (100, " %") if name == "beyond_3mm" else (1, "")
        pairs = [found[deltas, name] for deltas in (True, False)]
        cells = [with_error(scale * row.value, scale * row.error) + unit if row.value else "0" for row in pairs]
        lines.append([title, *cells, *text])
    head = ["within", "cgemit", "cgemit, no deltas", *(f"Geant4, {run.title}" for run in geant4_runs())]
    paper = paper_values()["x_residual_rms"].value
    return _RESIDUAL.format(geant4=about["reference"], paper=paper, events=about["events"]) + table(head, lines)


def spans(fractions: Sequence[Fraction], spectrum: Sequence[Born], residuals: Sequence[Number]) -> dict[str, str]:
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
