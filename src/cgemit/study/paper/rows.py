"""The numbers that the paper quotes, measured."""

from __future__ import annotations

from collections.abc import Mapping

from cgemit.statistics.curves import windowed_resolution
from cgemit.study.cluster_residuals import X_WINDOWS, v_fit, x_beyond, x_widths
from cgemit.study.deltas import DISTANCES
from cgemit.study.paper import differences
from cgemit.study.paper.published import paper_values
from cgemit.study.paper.reproduction import Row
from cgemit.study.samples import Sample


def make_rows(samples: Mapping[str, Sample]) -> list[Row]:
    """Return one row for each quantity and detector.

    Parameters
    ----------
    samples : mapping of str to Sample
        ``"cgem"``, ``"idc"``, and ``"gap"``: the CGEM with a thinner drift gap; all of 1 GeV/c.
    """
    cgem, gap = samples["cgem"], samples["gap"]
    rows = [*_x_rows(cgem), _v_row(cgem)]
    tracks = {name: _track_row(cgem, name) for name in ("dr", "dz", "p")}
    rows += tracks.values()
    rows += [_idc_row(samples["idc"], name, row.value) for name, row in tracks.items()]
    nominal = {row.id: row.value for row in rows}
    return [*rows, *_gap_rows(gap, nominal), *_window_rows(cgem), *_delta_rows(cgem)]


def _row(name: str, sample: Sample, value: float, error: float, note: str) -> Row:
    known = paper_values()[name]
    return Row(name, sample.detector.name, value, error, known.unit, known.value, note)


def _x_numbers(sample: Sample) -> dict[str, tuple[float, float]]:
    widths = x_widths(sample.clusters)
    return {
        "x_residual_rms": (widths.rms, widths.rms_error),
        "x_residual_core": (widths.core, widths.core_error),
        "x_single_strip_fraction": sample.clusters.single_strip_fraction,
    }


def _x_rows(sample: Sample) -> list[Row]:
    numbers = _x_numbers(sample)
    (rms, error), (core, _) = numbers["x_residual_rms"], numbers["x_residual_core"]
    notes = {
        "x_residual_rms": differences.x_rms(rms, error, _published("x_residual_rms"), x_beyond(sample.clusters)[0]),
        "x_residual_core": differences.x_core(core, rms),
        "x_single_strip_fraction": differences.single_strips(sample.detector.cgem[0].drift_gap),
    }
    return [_row(name, sample, *numbers[name], note) for name, note in notes.items()]


def _gap_rows(sample: Sample, nominal: Mapping[str, float]) -> list[Row]:
    gap = sample.detector.cgem[0].drift_gap
    return [
        _row(f"{name}_gap3mm", sample, *pair, differences.gap_variant(gap, pair[0], nominal[name]))
        for name, pair in _x_numbers(sample).items()
    ]


def _window_rows(sample: Sample) -> list[Row]:
    rows = []
    for number, (name, window) in enumerate(X_WINDOWS.items()):
        widths = x_widths(sample.clusters, window)
        note = differences.x_window(window, widths.outside, widths.n, number)
        rows.append(_row(f"x_residual_rms_{name}", sample, widths.rms, widths.rms_error, note))
    return rows


def _delta_rows(sample: Sample) -> list[Row]:
    found, rows = sample.deltas, []
    for way, values, errors in (("rphi", found.rphi, found.rphi_error), ("z", found.z, found.z_error)):
        for distance, value, error in zip(DISTANCES, values, errors, strict=True):
            name = f"{distance:g}mm" if distance >= 1 else f"{1e3 * distance:.0f}um"
            note = differences.deltas(found.crossings, simulated=sample.settings.simulate.deltas)
            rows.append(_row(f"delta_fraction_{way}_{name}", sample, value, error, note))
    return rows


def _v_row(sample: Sample) -> Row:
    fit = v_fit(sample.clusters)
    note = differences.v_width(fit.sigma, fit.sigma_error, _published("v_residual_sigma"))
    return _row("v_residual_sigma", sample, fit.sigma, fit.sigma_error, note)


def _track_row(sample: Sample, parameter: str) -> Row:
    name, widths = f"sigma_{parameter}", windowed_resolution(sample.tracks, parameter)
    note = differences.track(parameter, widths, _published(name))
    return _row(name, sample, widths.core, widths.core_error, note)


def _idc_row(sample: Sample, parameter: str, cgem: float) -> Row:
    widths = windowed_resolution(sample.tracks, parameter)
    note = differences.idc(parameter, widths.core, cgem)
    return _row(f"sigma_{parameter}_idc", sample, widths.core, widths.core_error, note)


def _published(name: str) -> float:
    value = paper_values()[name].value
    assert value is not None, name
    return value
