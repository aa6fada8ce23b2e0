"""Check of the values in tables that users give: ranges, covariances, links, and channels of a detector."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Flags, Ints
from cgemit.base.errors import report
from cgemit.tables.schema import FITTED, NEEDED_LINKS, SCHEMAS, Array, Column, range_of
from cgemit.tables.table import Table, kind_problems, targets

WIRE, XV = 2, 2  # views of residuals and states, and of clusters
#: Smallest eigenvalue of the correlations of a covariance: rounding, not a wrong sign.
_ROUNDING = 1e-9


class Channels(NamedTuple):
    """Numbers of the channels of a detector.

    Attributes
    ----------
    detector : str
        Its name.
    sheets : ndarray, (layers,) int64
    strips : ndarray, (layers, 2) int64
        X and V strips of a sheet.
    first : ndarray, (layers,) int64
        `gid` of the first strip of a layer.
    cells : ndarray, (n,) int64
        By the number of the wire layer; 0 where there is none.
    first_wire : ndarray, (n,) int64
        `gid` of its first wire.
    """

    detector: str
    sheets: Ints
    strips: Ints
    first: Ints
    cells: Ints
    first_wire: Ints


def table_problems(channels: Channels | None = None, /, ignore: Collection[str] = (), **tables: object) -> list[str]:
    """Return what is wrong with tables: one line for each column, with its first wrong row.

    Numbers are finite and within the ranges of the schema, except in rows whose `status` says that there is none.
    Covariances are positive. Links lead to rows of the same event where the table that they count is given, too.

    Parameters
    ----------
    channels : Channels or None
        Of the detector to which the layers belong.
    ignore : collection of str
        Columns that nobody reads: `cov`, and links, `particle`, `gid`, whose rows and channels need not be there.
    **tables : Table
        By their kind.
    """
    problems = kind_problems(**tables)
    given = {name: table for name, table in tables.items() if isinstance(table, Table)}
    return problems or [one for table in given.values() for one in _problems(table, given, channels, ignore)]


def refuse_wrong(function: str, /, ignore: Collection[str] = (), **tables: object) -> None:
    """Raise an error that lists what is wrong with the tables given to a function (`table_problems`).

    Parameters
    ----------
    function : str
        Its name.
    ignore : collection of str
    **tables : Table
        By their kind.

    Raises
    ------
    ValueError
        If something is.
    """
    problems = table_problems(None, ignore, **tables)
    report(f"{function}", problems)


def _problems(table: Table, tables: dict[str, Table], channels: Channels | None, ignore: Collection[str]) -> list[str]:
    if not len(table):
        return []
    counts = np.isin(table["status"], FITTED[table.kind]) if table.kind in FITTED else None
    problems = []
    columns = [(table.kind, column) for column in SCHEMAS[table.kind][1:]]
    if table.kind == "tracks":  # joined with their matches
        columns += [("matches", column) for column in SCHEMAS["matches"][2:] if column.name in table]
    for kind, column in columns:
        values = table[column.name]
        low, high, may_be_nan = range_of(kind, column)
        if not (values.min() >= low and values.max() <= high):  # NaN fails, too
            wrong = ~((values >= low) & (values <= high))
            if may_be_nan:
                wrong &= ~np.isnan(values)
            wrong = wrong.reshape(len(table), -1).any(axis=1)
            if counts is not None and column.dtype.kind == "f":
                wrong &= counts
            problems += _noted(table, column.name, wrong, _expected(column, low, high, may_be_nan=may_be_nan))
    if problems:  # the others rely on numbers in their ranges
        return problems
    if "cov" in table and "cov" not in ignore:
        problems += _noted(table, "cov", _no_covariance(table["cov"], counts), "a symmetric, positive matrix")
    if table.kind in ("clusters", "refined_clusters"):
        problems += _cluster_problems(table)
    for column in (one for one in SCHEMAS[table.kind] if one.name not in ignore):
        problems += _link_problems(table, column, tables)
    if {"truths", "wire_truths"} & {table.kind} and "particles" in tables and "particle" not in ignore:
        lost = _core.common.particle_rows(dict(tables["particles"].columns), dict(table.columns)) < 0
        problems += _noted(table, "particle", lost, "the number of a row of particles, in its event")
    return problems + (_channel_problems(table, channels, ignore) if channels is not None else [])


def _expected(column: Column, low: float, high: float, *, may_be_nan: bool) -> str:
    if column.dtype.kind == "f":
        text = f"a number from {low:g} to {high:g}"
        return f"{text}, or NaN" if may_be_nan else text
    return f"a whole number of at least {low:g}" if high > 1e9 else f"a whole number from {low:g} to {high:g}"


def _noted(table: Table, name: str, wrong: Flags, expected: str) -> list[str]:
    """Return the problem of the rows that are wrong, if there are any."""
    if not wrong.any():
        return []
    row, number = int(np.argmax(wrong)), int(np.count_nonzero(wrong))
    more = f" ({number} such rows)" if number > 1 else ""
    value = table[name][row]
    given = "a matrix that is none" if np.ndim(value) and np.isfinite(value).all() else str(value.ravel()[:3].tolist())
    return [f"{table.kind} row {row}: {name}: got {given if np.ndim(value) else value}, expected {expected}{more}"]


def _no_covariance(cov: Array, counts: Flags | None) -> Flags:
    """Mark the matrices, of rows that count, that are not symmetric and positive."""
    rows = np.arange(len(cov)) if counts is None else np.flatnonzero(counts)
    diagonal = np.diagonal(cov[rows], axis1=1, axis2=2)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    correlation = cov[rows] * scale[:, :, None] * scale[:, None, :]
    wrong = (diagonal <= 0).any(axis=1) | (np.abs(correlation - np.swapaxes(correlation, 1, 2)) > 1e-6).any(axis=(1, 2))
    try:
        np.linalg.cholesky(correlation + _ROUNDING * np.eye(correlation.shape[1]))  # ten times as fast as eigenvalues
    except np.linalg.LinAlgError:
        wrong |= np.linalg.eigvalsh(0.5 * (correlation + np.swapaxes(correlation, 1, 2)))[:, 0] < -_ROUNDING
    no_covariance = np.zeros(len(cov), np.bool_)
    no_covariance[rows[wrong]] = True
    return no_covariance


def _cluster_problems(table: Table) -> list[str]:
    """Return which clusters have no position, or no error, in a view that they measure."""
    problems = []
    for name, other in (("x", 1), ("v", 0)):
        measured = table["view"] != other
        value, err = table[name], table[f"err_{name}"]
        problems += _noted(table, name, measured & np.isnan(value), "a finite number in this view")
        problems += _noted(table, f"err_{name}", measured & ~(err > 0), "a number above 0 in this view")
    return problems


def _link_problems(table: Table, column: Column, tables: dict[str, Table]) -> list[str]:
    """Return whether links lead to no row, or to one of another event, of the tables that are given."""
    names, problems = targets(column), []
    links, event = table[column.name], table["event"]
    for place, name in enumerate(names):
        target = table if name == table.kind else tables.get(name)
        if target is None:
            continue
        mine = table["view"] == place if len(names) > 1 else None
        if name == table.kind:
            mine = table["view"] == XV
        rows = links if mine is None else np.where(mine, links, -1)
        strange = _core.common.strange_link(rows, event, target["event"]) >= 0
        needed = f"{table.kind}.{column.name}" in NEEDED_LINKS and bool((links < 0).any())
        if not strange and not needed:
            continue
        inside = np.clip(rows, 0, max(len(target) - 1, 0))
        found = target["event"][inside] if len(target) else np.full(len(rows), -1)
        lost = (rows >= 0) & ((rows >= len(target)) | (found != event))
        if needed:
            lost |= (rows < 0) & (True if mine is None else mine)
        problems += _noted(table, column.name, lost, f"a row of {name}, of the same event")
    return problems


def _channel_problems(table: Table, channels: Channels, ignore: Collection[str]) -> list[str]:
    """Return which rows are of a layer, sheet, strip or wire that the detector does not have."""
    if "layer" not in table:
        return []
    layer, of = table["layer"], f"of {channels.detector}"
    on_wire = np.zeros(len(table), np.bool_)
    if table.kind in ("wire_truths", "wire_hits", "refined_wire_hits"):
        on_wire[:] = True
    elif table.kind in ("residuals", "states"):
        on_wire = table["view"] == WIRE
    somewhere = table["view"] >= 0 if table.kind == "states" else np.True_
    within = (layer >= 0) & (layer < len(channels.sheets))
    cells = channels.cells.take(np.clip(layer, 0, len(channels.cells) - 1))
    there = np.where(on_wire, (layer >= 0) & (layer < len(channels.cells)) & (cells > 0), within)
    problems = _noted(table, "layer", somewhere & ~there, f"a layer {of}")
    if problems:
        return problems
    if "wire" in table:
        problems += _noted(table, "wire", table["wire"] >= cells, f"a cell of the layer, {of}")
        if "gid" in table and "gid" not in ignore:
            wrong = table["gid"] != channels.first_wire[layer] + table["wire"]
            problems += _noted(table, "gid", wrong, f"the number of its wire {of}")
    elif "sheet" in table:
        problems += _noted(table, "sheet", table["sheet"] >= channels.sheets[layer], f"a sheet of the layer, {of}")
        view = np.minimum(table["view"], 1)
        strips = channels.strips[layer, view]
        for name in ("strip", "first", "last"):
            if name in table and not problems:
                wrong = (table["view"] <= 1) & (table[name] >= strips)
                problems += _noted(table, name, wrong, f"a strip of the sheet, {of}")
        if "gid" in table and "gid" not in ignore and not problems:
            of_sheet = channels.strips[layer].sum(axis=1)
            gid = channels.first[layer] + table["sheet"] * of_sheet + view * channels.strips[layer, 0] + table["strip"]
            wrong = (table["strip"] >= 0) & (table["gid"] != gid)
            problems += _noted(table, "gid", wrong, f"the number of its strip {of}")
    return problems
