"""The report of the reproduction: `report.html`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cgemit.analysis.clusters import X_WINDOWS, geant4_runs, x_beyond
from cgemit.analysis.curves import WINDOW, windowed_resolution
from cgemit.analysis.quantities import QUANTITIES
from cgemit.analysis.widths import HEAD
from cgemit.base.files import RECORD
from cgemit.base.version import __version__
from cgemit.chain.settings import Settings, finder_of, hits_text, mass_by
from cgemit.reconstruction.candidates import finder_name
from cgemit.simulation.transport import SimulateSettings
from cgemit.study.evaluation import Sample
from cgemit.study.paper.published import FIGURES, Group, PaperFigure, paper_values
from cgemit.study.paper.results import Reproduction
from cgemit.study.report import Code, Image, Note, Part, Section, TableOf, html_report
from cgemit.tables import PARAMETERS
from cgemit.tables.show import shown, with_error
from cgemit.truth.match import measuring

_TITLE = "Cluster reconstruction and track fit of the BESIII CGEM inner tracker"
_PURE = ", which no finder without truth can do: the resolutions contain no wrong or missed hits"


def _hits_note(study: Reproduction) -> str:
    tracks = next(iter(study.samples.values())).tracks
    if finder_of(tracks) == "truth":
        return f"Hits are {hits_text(tracks)}{_PURE}. Mass in the fit: {mass_by(tracks.meta)}."
    shares = ", ".join(f"{100 * _found(s) / s.n_events:.2f} % in {s.detector.name}" for s in _main(study))
    mass = f"Mass in the fit: {mass_by(tracks.meta)}"
    return f"Hits are {hits_text(tracks)}. {mass}. Muons of 1 GeV/c with a track: {shares}."


def _found(sample: Sample) -> int:
    """Return how many muons have a track."""
    return len(np.unique(sample.tracks["event"][measuring(sample.tracks)]))


def paper_report(study: Reproduction, folder: Path) -> str:
    """Return the page with the comparison, the figures in `folder`, and all resolutions and pulls."""
    lead = (
        f"arXiv:1504.02570 (Chin. Phys. C 40 (2016) 016201) reproduced with cgemit {__version__}: "
        f"{study.inputs.events:,} mu- of 1 GeV/c for each detector and {study.inputs.events_per_momentum:,} at each of "
        f"{len(study.scans['cgem'])} momenta, seed {study.inputs.seed}"
        + (f", in the field {study.inputs.field}." if study.inputs.field else ".")
    )
    return html_report(
        f"{_TITLE}: the paper and cgemit",
        lead,
        [
            Section("The paper's numbers", [_comparison(study), Note(_hits_note(study))]),
            Section("Delta electrons and the X residual", [*_windows(study), *_deltas(study)]),
            Section("Figures of the paper", [*_images(folder, "paper"), "Figure 6 is at the top of the page."]),
            Section("Are the errors right?", _images(folder, "beyond")),
            Section("Resolutions at 1 GeV/c", [*_resolutions(study)]),
            Section("Pulls at 1 GeV/c", [_pulls(study)]),
            Section("Rows removed by status", [_removed(study)]),
            Section("The event that is drawn", _images(folder, "display")),
            Section("How to repeat this", _repeat(study)),
        ],
        [Note(_verdict(study)), _image(folder, FIGURES[_FIRST])],
    )


_FIRST = "dr_dz_p"  # the figure on the first screen
_NEAR = 0.05  # of the paper's number


def _verdict(study: Reproduction) -> str:
    """Return which of the paper's numbers are met, and by how much others differ."""
    near: list[str] = []
    far: list[str] = []
    for row in study.results:
        if row.paper is None:
            continue
        apart = row.value / row.paper - 1
        error = row.error / row.paper
        text = f"{row.title}: {with_error(row.value, row.error)} {row.unit} ({row.paper:g}, {100 * apart:+.0f} %)"
        (near if abs(apart) <= _NEAR + error else far).append(text.replace("-", "−"))
    within = f"Within {100 * _NEAR:.0f} % and a statistical error of the paper's numbers (in brackets): "
    farther = f" Farther away: {'; '.join(far)}. The table says why." if far else ""
    return f"{within}{'; '.join(near) or 'none'}.{farther}"


def _images(folder: Path, group: Group) -> list[Part]:
    figures = [figure for name, figure in FIGURES.items() if figure.group == group and name != _FIRST]
    return [_image(folder, figure) for figure in figures]


def _image(folder: Path, figure: PaperFigure) -> Image:
    return Image(folder / f"{figure.name}.png", figure.title, figure.caption, _files(folder, figure))


def _files(folder: Path, figure: PaperFigure) -> list[str]:
    """Return the names of the PDF of a figure, if there is one, and of the tables behind it."""
    tables = [path.name for pattern in figure.tables for path in sorted(folder.glob(pattern))]
    return [path.name for path in folder.glob(f"{figure.name}.pdf")] + tables


def _comparison(study: Reproduction) -> TableOf:
    rows = []
    for row in study.results:
        if row.id.startswith(("x_residual_rms_", "delta_fraction_")) and "gap" not in row.id:
            continue  # in tables of their own
        published = f"{row.paper:g} {shown(row.unit)}" if row.paper is not None else "-"
        ours = f"{with_error(row.value, row.error)} {shown(row.unit)}".strip()
        quoted = f" Paper: {paper_values()[row.id].statistic}." if row.paper is not None else ""
        rows.append([row.title, published, ours, row.note + quoted])
    return TableOf(
        ("quantity", "paper", "cgemit ± statistical error", "why they differ"), rows, frozenset({1, 2}), frozenset({3})
    )


def _windows(study: Reproduction) -> list[Part]:
    residuals, runs = study.samples["cgem"].clusters, geant4_runs()
    rows = []
    for number, window in enumerate(X_WINDOWS):
        row = study[f"x_residual_rms_{window}"]
        name = row.title.removeprefix("X residual, ")
        rows.append([name, with_error(row.value, row.error), *(run.rms[number] for run in runs)])
    beyond, beyond_error = x_beyond(residuals, 3.0)
    share, error = residuals.single_strip_fraction
    percent = f"{with_error(100 * beyond, 100 * beyond_error)} %"
    rows.append(["residuals beyond 3 mm", percent, *(run.beyond_3mm for run in runs)])
    rows.append(["clusters of one strip", with_error(share, error), *(run.single_strip for run in runs)])
    text = (
        f"RMS in µm. The paper's {paper_values()['x_residual_rms'].value} µm comes without its window. Geant4 11.4.1: "
        "same layout and sample, range cuts as named. A residual is that of the cluster that holds the strip under the "
        "track, or else of the nearest."
    )
    heads = ("X residual", "cgemit ± statistical error", *(f"Geant4, {run.title}" for run in runs))
    return [text, TableOf(heads, rows, frozenset(range(1, len(heads))))]


def _deltas(study: Reproduction) -> list[Part]:
    if not study.inputs.settings.simulate.deltas:
        return ["Delta electrons were left out of this run."]
    deltas = study.samples["cgem"].deltas
    pairs = zip(deltas.rphi, deltas.rphi_error, deltas.z, deltas.z_error, strict=True)
    cells = [[with_error(100 * v, 100 * e), with_error(100 * w, 100 * f)] for v, e, w, f in pairs]
    rows = [[f"{distance:g} mm", *pair] for distance, pair in zip(deltas.beyond, cells, strict=True)]
    text = (
        f"Per cent of the {deltas.crossings:,} crossings of a drift gap, all layers and angles of the sample, in which "
        "a delta electron left a deposit farther from the track than stated, ± statistical error."
    )
    return [text, TableOf(("farther than", "in r-φ", "in z"), rows, frozenset({1, 2}))]


def _main(study: Reproduction) -> list[Sample]:
    return [study.samples["cgem"], study.samples["idc"]]


def _resolutions(study: Reproduction) -> list[Part]:
    rows = []
    for sample in _main(study):
        for name in PARAMETERS:
            widths = windowed_resolution(sample.tracks, name)
            quantity = f"{QUANTITIES[name].symbol} ({shown(widths.unit)})"
            rows.append([sample.detector.name, quantity, *widths.cells(), str(widths.outside)])
    text = (
        "core: Gaussian fitted by likelihood within three of its own widths; q68: half the central interval that holds "
        f"68.3 % of the tracks; rms: of the tracks within {WINDOW:g} core widths, the number outside is in the last "
        "column; bias: mean of the core; tail: tracks beyond three core widths (0.27 % for a Gaussian)."
    )
    return [text, TableOf(("detector", "quantity", *HEAD, "outside"), rows, frozenset({2, 3, 4, 5, 6, 7, 9}))]


def _pulls(study: Reproduction) -> TableOf:
    rows = [[s.detector.name, QUANTITIES[w.parameter].symbol, *w.cells()] for s in _main(study) for w in s.pulls]
    return TableOf(("detector", "pull of", *HEAD), rows, frozenset(range(2, 8)))


def _removed(study: Reproduction) -> TableOf:
    rows = []
    for sample in [*study.samples.values(), *(s for scan in study.scans.values() for s in scan)]:
        fit = ", ".join(f"{number:,} {name}" for name, number in sample.removed.items()) or "none"
        transport = ", ".join(f"{number:,} {name}" for name, number in sample.transport.items())
        unmatched = f"{sample.clusters.without_truth:,}"
        rows.append([sample.label, f"{sample.n_events:,}", fit, transport, unmatched])
    heads = ("sample", "tracks", "left out", "end of transport", "clusters without truth")
    return TableOf(heads, rows, frozenset({1, 4}))


def _repeat(study: Reproduction) -> list[Part]:
    in_words = {Settings(): "", Settings(simulate=SimulateSettings(deltas=False)): " --no-deltas"}
    settings = in_words.get(study.inputs.settings, f" --settings {RECORD}")
    field = f" --field {study.inputs.field}" if study.inputs.field else ""
    finder = study.inputs.finder
    how = "" if finder == "truth" else f" --finder {finder_name(finder)}"
    command = f"cgemit study --events {study.inputs.events} --seed {study.inputs.seed}{how}{settings}{field} -o DIR"
    times = {name.removesuffix("_s").removesuffix("_thread"): value for name, value in study.timings.items()}
    seconds = ", ".join(f"{name} {value:.1f} s" for name, value in times.items())
    return [
        "The numbers depend on version, events and seed, not on threads.",
        Code(command),
        f"cgemit {__version__}. Times, stages summed over threads: {seconds}.",
        f"The CSV files beside this page hold the figures' data, summary.json all numbers, {RECORD} all settings.",
    ]
