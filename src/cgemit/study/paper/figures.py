"""The figures of the paper and the CSV tables behind them."""

from __future__ import annotations

import gc
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import TMonitor

from cgemit.analysis.clusters import X_WINDOWS, ClusterResiduals, v_spectrum, x_spectrum, x_widths
from cgemit.analysis.curves import Line, Spectrum, track_spectrum
from cgemit.analysis.quantities import MAIN, QUANTITIES
from cgemit.analysis.resolutions import chi2_probability, resolution_against
from cgemit.analysis.widths import Resolution
from cgemit.base.files import HEARTBEAT
from cgemit.base.isa import cores
from cgemit.chain.result import Result
from cgemit.draw import chain_diagram, cluster, curves, display
from cgemit.draw.style import COLORS, Picture, new_picture, style
from cgemit.study.evaluation import ShowProgress, row_columns
from cgemit.study.paper.published import FIGURES, paper_values
from cgemit.study.paper.results import Reproduction
from cgemit.study.scan import line_of, pull_line
from cgemit.tables import PARAMETERS, Table
from cgemit.tables.show import with_error, write_csv

_ANGLE_BINS = 10
_TAIL_REACH = 8000.0  # um
_PARTS = {"single strip": (COLORS["single"], "one strip"), "several strips": (COLORS["multi"], "several strips")}


def write_figures(study: Reproduction, folder: Path, pdf: bool = False, progress: ShowProgress | None = None) -> None:
    """Write all figures as PNG, with `pdf` as PDF too, and the tables behind them and all momentum scans as CSV."""
    if progress:
        progress(0.0, "drawing figures")
    pool = _pool(study)
    try:
        # The event, with most to draw, first: no process then waits for it in the end.
        keys = sorted(FIGURES, key=lambda key: key != "event")
        figures = [pool.submit(_write_figure, key, folder / FIGURES[key].name, pdf) for key in keys]
        for number, done in enumerate(as_completed(figures), 1):
            done.result()
            if progress:
                progress(number / len(FIGURES), "drawing figures")
    finally:
        pool.shutdown(cancel_futures=True)
    write_csv(folder / "momentum_scan.csv", row_columns([s for scan in study.scans.values() for s in scan]))
    if progress:
        progress(1.0, "writing")


def _pool(study: Reproduction) -> Executor:
    """Return what draws the figures: copies of this process where it has no other threads, else one thread."""
    workers = min(study.inputs.threads or cores(), len(FIGURES))
    sleeping = [one for one in threading.enumerate() if isinstance(one, TMonitor) or one.name == HEARTBEAT]
    others = threading.active_count() - len(sleeping)
    if sys.platform != "linux" or workers == 1 or others > 1:
        return ThreadPoolExecutor(1, initializer=_receive, initargs=(study,))
    return ProcessPoolExecutor(workers, get_context("fork"), _receive_alone, (study,))


_received: dict[str, Callable[[Path], Picture]] = {}


def _receive(study: Reproduction) -> None:
    _received.update(_makers(study))


def _receive_alone(study: Reproduction) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the process that waits
    gc.disable()  # a fifth of the time of drawing: the collector goes through all artists, and this process ends soon
    _receive(study)


def _write_figure(key: str, path: Path, pdf: bool) -> None:
    _received[key](path).save(path if pdf else path.with_name(f"{path.name}.png"))


def _makers(study: Reproduction) -> dict[str, Callable[[Path], Picture]]:
    """Return by figure what draws it and writes its tables, given the figure's path without ending."""
    number = good_event(study.display)
    return {
        "layer": lambda path: cluster.draw_projection(study.display, number),
        "chain": lambda path: chain_diagram.draw_chain(),
        "cluster": lambda path: cluster.draw_cluster(study.display, number),
        "x_residual": lambda path: _x_residual(study, path),
        "x_tails": lambda path: _x_tails(study, path),
        "v_residual": lambda path: _v_residual(study, path),
        "dr_dz": lambda path: _track_residuals(study, path, ("dr", "dz")),
        "dr_dz_p": lambda path: _against_momentum(study, path, ("dr", "dz")),
        "p": lambda path: _track_residuals(study, path, ("p",)),
        "p_p": lambda path: _against_momentum(study, path, ("p",)),
        "pulls": lambda path: _pulls(study, path),
        "pulls_p": lambda path: _pulls_against_momentum(study, path),
        "cos_theta": lambda path: _against_angle(study, path),
        "chi2": lambda path: _probabilities(study, path),
        "event": lambda path: display.event(study.display, number),
    }


def good_event(result: Result, layer: int = 0) -> int:
    """Return the first event with two X and three V strips in a layer, or the event closest to it."""
    clusters = result.clusters
    first = clusters.first_event
    inside = clusters["layer"] == layer
    sizes = np.zeros((clusters.n_events, 2), np.int64)
    for view in (0, 1):
        rows = inside & (clusters["view"] == view)
        sizes[clusters["event"][rows] - first, view] = clusters["size"][rows]
    pairs = np.bincount(clusters["event"][inside & (clusters["view"] == 2)] - first, minlength=clusters.n_events)
    distance = np.abs(sizes[:, 0] - 2) + np.abs(sizes[:, 1] - 3) + 100 * (pairs != 1)
    return int(first + np.argmin(distance))


def _x_residual(study: Reproduction, path: Path) -> Picture:
    spectrum = x_spectrum(study.samples["cgem"].clusters)
    return _residual(path, spectrum, lambda axes: curves.draw_parts(axes, spectrum, _PARTS, "X clusters"))


def _x_tails(study: Reproduction, path: Path) -> Picture:
    residuals = study.samples["cgem"].clusters
    spectrum, windows = x_spectrum(residuals, _TAIL_REACH, 160), _windows(residuals)
    title = "X clusters, tails"
    return _residual(path, spectrum, lambda axes: curves.draw_tails(axes, spectrum, _PARTS, windows, title))


def _v_residual(study: Reproduction, path: Path) -> Picture:
    spectrum = v_spectrum(study.samples["cgem"].clusters)
    return _residual(path, spectrum, lambda axes: curves.draw_spectrum(axes, spectrum, "V clusters"))


def _residual(path: Path, spectrum: Spectrum, draw: Callable[[Any], None]) -> Picture:
    """Write the table of a spectrum of cluster residuals and return its picture."""
    write_csv(_table(path), spectrum.columns())
    with style():
        picture, (axes,) = new_picture(1, 1, (7.4, 4.8))
        draw(axes)
        picture.subplots_adjust(left=0.11, right=0.96, top=0.93, bottom=0.12)  # room for half of the last tick's label
    return picture


def _windows(residuals: ClusterResiduals) -> list[tuple[float, str]]:
    """Half-widths in um, and the RMS within each."""
    found = [(1e3 * window, x_widths(residuals, window)) for window in X_WINDOWS.values() if np.isfinite(window)]
    return [(reach, f"RMS {with_error(widths.rms, widths.rms_error)} µm") for reach, widths in found]


def _track_residuals(study: Reproduction, path: Path, names: Sequence[str]) -> Picture:
    """Draw residuals at 1 GeV/c: one row for each detector, one column for each parameter."""
    samples = [study.samples["cgem"], study.samples["idc"]]
    with style():
        across = len(names) if len(names) > 1 else len(samples)
        rows = len(samples) if len(names) > 1 else 1
        picture, axes = new_picture(rows, across, (12.4, 4.3 * rows + 0.3))
        cells = [(sample, name) for sample in samples for name in names]
        for plot, (sample, name) in zip(axes, cells, strict=True):
            spectrum = track_spectrum(sample.tracks, name)
            write_csv(path.with_name(f"{path.name}_{name}_{sample.detector.name}.csv"), spectrum.columns())
            curves.draw_spectrum(plot, spectrum, sample.detector.name)
        top, bottom = (0.96, 0.07) if rows > 1 else (0.93, 0.12)
        picture.subplots_adjust(left=0.065, right=0.985, top=top, bottom=bottom, wspace=0.2, hspace=0.26)
    return picture


def _against_momentum(study: Reproduction, path: Path, names: Sequence[str]) -> Picture:
    lines = {name: [line_of(scan, name) for scan in study.scans.values()] for name in names}
    _write_lines(_table(path), [line for group in lines.values() for line in group])
    published = [paper_values()[f"sigma_{name}"].value for name in names]
    points = [(1.0, value) if value is not None else None for value in published]
    return curves.draw_resolutions([(QUANTITIES[name].sigma, group) for name, group in lines.items()], "p", points)


def _pulls(study: Reproduction, path: Path) -> Picture:
    samples = {s.detector.name: s for s in (study.samples["cgem"], study.samples["idc"])}
    widths = {name: sample.pulls for name, sample in samples.items()}
    texts = {name: {QUANTITIES[w.parameter].symbol: _width_and_mean(w) for w in each} for name, each in widths.items()}
    columns: dict[str, list[str | float]] = {"detector": [], "parameter": []}
    for name, each in widths.items():
        for w in each:
            columns["detector"].append(name)
            columns["parameter"].append(w.parameter)
            for what in ("core", "core_mean", "rms", "mean"):
                columns.setdefault(what, []).append(getattr(w, what))
                columns.setdefault(f"{what}_error", []).append(getattr(w, f"{what}_error"))
    write_csv(_table(path), columns)
    values = {
        name: {
            QUANTITIES[p].symbol: sample.tracks[f"pull_{p}"][QUANTITIES[p].counts(sample.tracks)] for p in PARAMETERS
        }
        for name, sample in samples.items()
    }
    return curves.draw_pulls(values, texts)


def _width_and_mean(pull: Resolution) -> str:
    width, mean = with_error(pull.core, pull.core_error), with_error(pull.core_mean, pull.core_mean_error)
    return f"width {width}, mean {mean}"


def _pulls_against_momentum(study: Reproduction, path: Path) -> Picture:
    lines = {p: [pull_line(scan, p) for scan in study.scans.values()] for p in PARAMETERS}
    _write_lines(_table(path), [line for group in lines.values() for line in group])
    panels = [(f"core width, pull of {QUANTITIES[p].symbol}", group) for p, group in lines.items()]
    return curves.draw_grid([panels[:3], panels[3:]], "p", unity_rows=(0, 1))


def _against_angle(study: Reproduction, path: Path) -> Picture:
    edges = np.linspace(-0.93, 0.93, _ANGLE_BINS + 1)
    samples = [study.samples["cgem"], study.samples["idc"]]
    pairs = {p: [_angle_lines(s.tracks, s.detector.name, p, edges) for s in samples] for p in MAIN}
    widths = [(QUANTITIES[p].sigma, [pair[0] for pair in group]) for p, group in pairs.items()]
    ratios = [
        (f"core width, pull of {QUANTITIES[p].symbol}", [pair[1] for pair in group]) for p, group in pairs.items()
    ]
    _write_lines(_table(path), [line for _, group in (*widths, *ratios) for line in group])
    return curves.draw_grid([widths, ratios], "cos θ", unity_rows=(1,))


def _probabilities(study: Reproduction, path: Path) -> Picture:
    values = {s.detector.name: chi2_probability(s.tracks) for s in (study.samples["cgem"], study.samples["idc"])}
    edges = np.linspace(0, 1, 41)
    columns = {"low": edges[:-1].tolist(), "high": edges[1:].tolist()}
    counts = {name: np.histogram(each, edges)[0].tolist() for name, each in values.items()}
    write_csv(_table(path), columns | counts)
    return curves.draw_probabilities(values)


def _table(path: Path) -> Path:
    """Return where the table of a figure stands, given the figure's path without ending."""
    return path.with_name(f"{path.name}.csv")


def _write_lines(path: Path, lines: Sequence[Line]) -> None:
    rows = [
        (line.id, line.detector, x, line.x_unit, y, error, line.y_unit)
        for line in lines
        for x, y, error in zip(line.x.tolist(), line.y.tolist(), line.y_error.tolist(), strict=True)
    ]
    headers = ("curve", "detector", "x", "x unit", "y", "y error", "y unit")
    write_csv(path, dict(zip(headers, zip(*rows, strict=True), strict=True)))


def _angle_lines(tracks: Table, detector: str, parameter: str, edges: npt.ArrayLike) -> tuple[Line, Line]:
    """Return the core resolution and the core width of the pull of a parameter against cos(theta)."""
    lines = []
    for kind, name in (("residual", "sigma"), ("pull", "pull")):
        curve = resolution_against(tracks, parameter, "cos_theta", edges, kind=kind)  # type: ignore[arg-type]
        unit = curve.unit
        core, error = curve.column("core"), curve.column("core_error")
        lines.append(Line(f"{name}_{parameter}_cos_theta", detector, np.array(curve.x), "", core, error, unit))
    return lines[0], lines[1]
