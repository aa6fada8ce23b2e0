"""Mille records of alignment, which the program pede of Millepede-II solves (docs/methods/alignment.md)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.base.files import new_file
from cgemit.calibration.align import Given, sources_of, tables_of
from cgemit.calibration.modes import Solution, solve
from cgemit.calibration.settings import AlignmentSettings, plan_of
from cgemit.calibration.sums import Rows, Sums, fitted_sums
from cgemit.chain.executor import Workers, pool_of
from cgemit.detector import Detector
from cgemit.reconstruction.fit import FitSettings

#: A record needs a local parameter: one that a measurement 0 of error 1 holds, and on which nothing depends.
_LOCAL = (1.0, 1)


@dataclass(frozen=True, eq=False)
class MilleRecord:
    """A record of a Mille file: measurements that share local parameters.

    Attributes
    ----------
    residual, error : ndarray, (n,) float64
    local, global_ : tuple of dict
        Derivatives of each measurement by the number of the local parameter, and by the label of the global one.
    """

    residual: Floats
    error: Floats
    local: tuple[dict[int, float], ...]
    global_: tuple[dict[int, float], ...]


def write_mille(
    path: str | os.PathLike[str],
    runs: Given | Sequence[Given],
    settings: AlignmentSettings | None = None,
    *,
    detector: Detector | str | Mapping[str, Any] | None = None,
    fit: FitSettings | None = None,
    threads: int | None = None,
    overwrite: bool = False,
) -> Solution:
    """Write the tracks of runs as Mille records, and a steering file for pede beside them.

    Every event is a record of independent measurements, of which the helices have been eliminated and in which matter
    scatters. The label of a constant is its row in the table of `align`, counted from 1. Runs are fitted with the
    description, with the last cut on pulls; pede then finds what one step of `align` finds.

    Parameters
    ----------
    path : path
        Of the records; the steering file has the suffix ``.txt``.
    runs, settings, detector, fit, threads
        As of `align`.
    overwrite : bool

    Returns
    -------
    Solution
        Of the same normal equations, as a check.

    Raises
    ------
    ValueError
        As `align`.
    FileExistsError
        If a file exists and `overwrite` is false.

    Examples
    --------
    >>> run = cg.run("besiii-cgem", cg.sample("cosmic"), n=50, readout="gaussian")
    >>> settings = cg.AlignmentSettings(free=("cgem.*.shift_x",))
    >>> solution = cg.write_mille("mille.bin", run, settings)
    >>> from cgemit.calibration.mille import read_mille
    >>> records = list(read_mille("mille.bin"))
    >>> sorted({label for one in records for row in one.global_ for label in row})  # L1, L2, L3
    [1, 2, 3]
    """
    settings = AlignmentSettings.of(settings)
    given = list(runs) if isinstance(runs, Sequence) else [runs]
    described, sources = sources_of(given, detector, fit)
    free, _, priors = plan_of(described, settings)
    binary, steering = Path(path), Path(path).with_suffix(".txt")
    with new_file(binary, overwrite=overwrite) as records, new_file(steering, overwrite=overwrite) as text:
        sums, events = Sums.none(described, free), list[tuple[int, Rows]]()
        with pool_of(Workers(threads=threads)) as pool:
            for run_number, source in enumerate(sources):
                tuned = replace(source.fit, outlier_pull=settings.outlier_pull[-1])
                tables = tables_of(source, described)
                of_run = fitted_sums(described, tables, free, tuned, settings=settings, pool=pool, rows=True)
                events += [(run_number, rows) for rows in of_run.rows]
                sums = sums + replace(of_run, rows=())
        solution = solve(described, free, sums, priors, constrain=settings.zero_modes == "constrained")
        with records.open("wb") as file:
            for record in _records(events):
                file.write(record)
        text.write_text(_steering(binary.name, solution), encoding="utf-8")
    return solution


def _records(events: Sequence[tuple[int, Rows]]) -> Iterator[bytes]:
    """Yield a record for every event."""
    merged: dict[tuple[int, int], list[tuple[Rows, npt.NDArray[np.intp]]]] = {}
    for run_number, rows in events:
        order = np.argsort(rows.event, kind="stable")
        borders = np.flatnonzero(np.diff(rows.event[order])) + 1
        for rows_of_event in np.split(order, borders) if len(order) else []:
            merged.setdefault((run_number, int(rows.event[rows_of_event[0]])), []).append((rows, rows_of_event))
    for parts in merged.values():
        values, labels = [0.0], [0]  # the first pair is empty

        def add(number: float, label: int, values: list[float] = values, labels: list[int] = labels) -> None:
            values.append(number)
            labels.append(label)

        add(0.0, 0)
        add(*_LOCAL)
        add(1.0, 0)
        for rows, rows_of_event in parts:
            for row in rows_of_event:
                begin = rows.ends[row - 1] if row else 0
                add(float(rows.residual[row]), 0)
                add(float(rows.error[row]), 0)
                values += rows.derivative[begin : rows.ends[row]].tolist()
                labels += (rows.column[begin : rows.ends[row]] + 1).tolist()
        yield _packed(values, labels)


def _packed(values: Sequence[float], labels: Sequence[int]) -> bytes:
    """Return a record: its length in words, negative for double precision, then numbers and labels."""
    length = np.array(-2 * len(values), "<i4")
    return length.tobytes() + np.array(values, "<f8").tobytes() + np.array(labels, "<i4").tobytes()


def _steering(binary: str, solution: Solution) -> str:
    """Return a steering file: surveys as measurements, zero modes as constraints."""
    lines = ["* Records of cgemit; labels:"]
    lines += [f"* {i + 1} {one.name} [{one.unit or '1'}]" for i, one in enumerate(solution.constants)]
    lines += ["Cfiles", binary]
    unknown = [i for i in range(len(solution.constants)) if not (solution.measured[i] > 0 or solution.prior[i] > 0)]
    if unknown:
        lines += ["Parameter", *(f"{i + 1} 0.0 -1.0" for i in unknown)]
    # A pre-sigma would hold the steps of an iteration alone, not the values.
    for i in np.flatnonzero(np.isfinite(solution.prior)):
        lines += [f"Measurement 0.0 {solution.prior[i]:.10g} ! survey", f"{i + 1} 1.0"]
    for name, zero in zip(solution.zero_modes, solution.zeros, strict=True):
        lines += [f"Constraint 0.0 ! {name}"]
        shares = zero * solution.measured / np.abs(zero * solution.measured).max()
        lines += [f"{i + 1} {share:.12g}" for i, share in enumerate(shares) if share]
    return "\n".join([*lines, "method inversion 3 0.01", "end", ""])


def read_mille(path: str | os.PathLike[str]) -> Iterator[MilleRecord]:
    """Yield the records of a Mille file, of single or double precision.

    Parameters
    ----------
    path : path

    Raises
    ------
    ValueError
        If the file ends within a record, or a record is none.
    """
    data, at, record = Path(path).read_bytes(), 0, 0
    while at < len(data):
        words = int(np.frombuffer(data[at : at + 4].ljust(4, b"\0"), "<i4")[0])
        double, n = words < 0, abs(words) // 2
        size = n * (12 if double else 8)
        if words % 2 or n < 2 or at + 4 + size > len(data):
            raise ValueError(f"{path}: record {record}: got {words} words, expected those of a record of Mille")
        values = np.frombuffer(data, "<f8" if double else "<f4", n, at + 4)
        labels = np.frombuffer(data, "<i4", n, at + 4 + n * (8 if double else 4))
        yield _record(values, labels, f"{path}: record {record}")
        at, record = at + 4 + size, record + 1


def _record(values: npt.NDArray[Any], labels: npt.NDArray[np.int32], where: str) -> MilleRecord:
    # A measurement is a residual (label 0), local derivatives, an error (label 0), global derivatives.
    zeros = np.flatnonzero(labels[1:] == 0) + 1
    if len(zeros) % 2:
        raise ValueError(f"{where}: got {len(zeros)} residuals and errors, expected pairs")
    ends = [*zeros[2::2], len(labels)]
    local, global_ = [], []
    for begin, middle, end in zip(zeros[::2], zeros[1::2], ends, strict=True):
        local.append({int(labels[i]): float(values[i]) for i in range(begin + 1, middle)})
        global_.append({int(labels[i]): float(values[i]) for i in range(middle + 1, end)})
    return MilleRecord(
        values[zeros[::2]].astype(np.float64), values[zeros[1::2]].astype(np.float64), tuple(local), tuple(global_)
    )
