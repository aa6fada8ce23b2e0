"""Columns of hits from elsewhere, read and checked as they are given (docs/own_hits.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.candidates import HIT_V, HIT_X, XV_CLUSTER
from cgemit.detector import Detector
from cgemit.tables.convert import columns_of

Column = npt.NDArray[Any]
Columns = dict[str, Column]

_WHOLE = ("event", "layer", "sheet", "view", "first", "last", "size", "wire", "side", "candidate", "gid")


def read(kind: str, source: Any, needed: tuple[str, ...], problems: list[str]) -> Columns:
    """Return the columns of a source, whole numbers as integers, with `event`, `given_row` and what is needed.

    Parameters
    ----------
    kind : str
        Name of the argument, for messages.
    source : Table, mapping of arrays, pandas.DataFrame, structured ndarray or None
    needed : tuple of str
    problems : list of str
        What is wrong is appended.
    """
    if source is None:
        return {name: np.zeros(0, np.int64) for name in ("event", "given_row", *needed)}
    columns = columns_of(source)
    if columns is None:
        expected = "a table, a mapping of arrays, a data frame or a structured array"
        problems.append(f"{kind}: got {type(source).__name__}, expected {expected}")
        return read(kind, None, needed, problems)
    missing = [name for name in needed if name not in columns]
    rows = len(columns["layer"]) if "layer" in columns and columns["layer"].ndim else 0
    for name in missing:
        problems.append(f"{kind}: {name}: missing, expected columns {', '.join(needed)}")
    for name, column in columns.items():
        depth = 3 if name == "cov" else 1
        if column.ndim == 0 or len(column) != rows or column.ndim > depth or column.dtype.kind not in "iufb":
            if not missing:
                problems.append(f"{kind}: {name}: got {column.dtype}, shape {column.shape}; expected {rows} numbers")
        elif name in _WHOLE:
            columns[name] = _whole(kind, name, column, problems)
        elif name == "cov" and column.shape != (rows, 2, 2):
            problems.append(f"{kind}: cov: got shape {column.shape}, expected ({rows}, 2, 2)")
    if problems:
        return read(kind, None, needed, problems)
    columns.setdefault("event", np.zeros(rows, np.int64))
    return columns | {"given_row": np.arange(rows)}


def _whole(kind: str, name: str, column: Column, problems: list[str]) -> Column:
    """Return the column as integers; say which number is none, or too large for the tables."""
    if column.dtype.kind == "f":
        wrong = np.flatnonzero(~(column == np.rint(column)))
        if len(wrong):
            problems.append(f"{kind} row {wrong[0]}: {name}: got {column[wrong[0]]}, expected a whole number")
        column = np.where(np.isfinite(column), column, 0)
    bits = 62 if name == "event" else 31
    wrong = np.flatnonzero((column < -(2.0**bits)) | (column >= 2.0**bits))
    if len(wrong):
        problems.append(f"{kind} row {wrong[0]}: {name}: got {column[wrong[0]]}, expected a number below 2**{bits}")
        return np.zeros(len(column), np.int64)
    return column.astype(np.int64)


_RANGES = {
    "phi": "an azimuth in rad, within -2 pi and 2 pi",
    "z": "a position in mm, at most a tenth of its half length beyond the end of the layer",
}


def _reach(detector: Detector, layer: Column) -> Column:
    """Return the largest abs(z) of a point on each layer, mm; no limit for layers that are not there."""
    lengths = np.array([*(1.1 * one.half_length for one in detector.cgem), np.inf])
    return lengths[np.where((layer >= 0) & (layer < len(detector.cgem)), layer, -1)]


def value_problems(detector: Detector, clusters: Columns) -> list[str]:
    """Say which layers, coordinates, errors and strips of clusters cannot be, by the names that they were given under.

    Parameters
    ----------
    detector : Detector
    clusters : dict of str to ndarray
        As given, with `view`.
    """
    layers, layer, problems = len(detector.cgem), clusters["layer"], []

    def refuse(name: str, wrong: Column, expected: str) -> None:
        for row in np.flatnonzero(wrong):
            value = clusters[name][row]
            got = f"{value:g}" if value.ndim == 0 else value.tolist()
            problems.append(f"clusters row {row}: {name}: got {got}, {expected}")

    refuse("layer", (layer < 0) | (layer >= layers), f"expected a CGEM layer of the detector, 0 to {layers - 1}")
    point = clusters["view"] == XV_CLUSTER
    for name, other, unit in (("phi", "x", "rad"), ("z", "v", "mm")):
        if name in clusters:
            by_position = np.isnan(clusters[name]) & np.isfinite(clusters.get(other, np.full(len(layer), np.nan)))
            refuse(name, point & ~np.isfinite(clusters[name]) & ~by_position, f"expected a finite number, {unit}")
        if name in clusters:  # in another unit, a position may still lie somewhere on the layer
            most = 2 * np.pi * np.ones(len(layer)) if name == "phi" else _reach(detector, layer)
            by_other = np.isfinite(clusters.get(other, np.full(len(layer), np.nan)))
            far = point & ~by_other & np.isfinite(clusters[name]) & (np.abs(clusters[name]) > most)
            refuse(name, far, f"expected {_RANGES[name]}")
    for name, largest in (("err_phi", np.pi), ("err_z", 1e5)):  # only their squares reach the fit
        if name in clusters:
            refuse(name, clusters[name] <= 0, "expected a number above 0")
            refuse(name, clusters[name] > largest, f"expected at most {largest:.6g}")
    if {"cov_phi_z", "err_phi", "err_z"} <= clusters.keys():
        limit = np.abs(clusters["err_phi"] * clusters["err_z"])
        large = (limit > 0) & ~(np.abs(clusters["cov_phi_z"]) < limit)
        refuse("cov_phi_z", point & large, "expected less in size than err_phi err_z")
    if "cov" in clusters:
        cov = clusters["cov"]
        lowest = cov[:, 0, 0] * cov[:, 1, 1] - cov[:, 0, 1] ** 2
        good = (cov[:, 0, 1] == cov[:, 1, 0]) & (cov[:, 0, 0] > 0) & (lowest > 0)
        refuse(
            "cov", point & ~(good | np.isnan(cov).any(axis=(1, 2))), "expected a symmetric, positive definite matrix"
        )
    return problems + _strip_problems(detector, clusters)


def drift_problems(detector: Detector, wires: Columns) -> list[str]:
    """Say which drift distances are longer than any in their cells: three diagonals, since tracks may turn back there.

    Parameters
    ----------
    detector : Detector
    wires : dict of str to ndarray
        As given, with `layer` and `drift`.
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    problems = []
    for place, layer in enumerate(layers):
        width = 2 * np.pi * layer.r_end / layer.cells
        beside = [abs(other.r_end - layer.r_end) for other in layers[max(0, place - 1) : place + 2]]
        most = 3 * float(np.hypot(width, max(width, *beside)))
        for row in np.flatnonzero((wires["layer"] == layer.number) & (np.abs(wires["drift"]) > most)):
            given, expected = wires["drift"][row], f"expected at most three diagonals of a cell, {most:.4g} mm"
            if np.isfinite(given):
                problems.append(f"wire_hits row {row}: drift: got {given:g}, {expected}")
    return problems


def _strip_problems(detector: Detector, clusters: Columns) -> list[str]:
    """Say which clusters of strips, whose position follows from them, have strips that are not there."""
    if not {"first", "last"} <= clusters.keys():
        return []
    first, last, layer, view = (clusters[name] for name in ("first", "last", "layer", "view"))
    problems = []
    for is_view, name in ((HIT_X, "x"), (HIT_V, "v")):
        position = clusters.get(name, np.full(len(layer), np.nan))
        for number, one in enumerate(detector.cgem):
            strips = (one.strips_x, one.strips_v)[is_view]
            mine = (layer == number) & (view == is_view) & np.isnan(position)
            for row in np.flatnonzero(mine & ((first < 0) | (last < first) | (last >= strips))):
                problems.append(
                    f"clusters row {row}: first, last: got {first[row]}, {last[row]}; expected strips from 0 to "
                    f"{strips - 1}, the first not above the last"
                )
    return problems


def repeated(kind: str, columns: Columns, names: tuple[str, ...]) -> list[str]:
    """Say which hits of a candidate are given twice: they would count double. Hits of none (number below 0) may repeat.

    Parameters
    ----------
    kind : str
        Name of the argument, for messages.
    columns : dict of str to ndarray
        With `given_row`.
    names : tuple of str
        Columns that tell hits apart; NaN equals NaN.
    """
    rows = len(columns["given_row"])
    keys = [columns[name] for name in ("event", "candidate", *names) if name in columns]
    order = np.lexsort([columns["given_row"], *keys])
    same = np.ones(max(rows - 1, 0), np.bool_)
    for key in keys:
        before, after = key[order[:-1]], key[order[1:]]
        same &= (before == after) | ((before != before) & (after != after))
    same &= columns.get("candidate", np.zeros(rows))[order[1:]] >= 0
    return [
        f"{kind} row {order[i + 1]}: got the hit of row {order[i]} again, expected each hit once"
        for i in sorted(np.flatnonzero(same), key=lambda i: order[i + 1])
    ]
