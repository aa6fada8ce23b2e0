"""Columns as comma-separated values: a line of names and one of numbers a row; numbers keep every digit."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.io.files import check_regular

_ROWS = 10_000  # that are turned into text at a time


def write_csv(path: Path, columns: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Write columns of numbers (n,)."""
    rows = len(next(iter(columns.values())))
    with path.open("w", encoding="ascii") as stream:
        stream.write(",".join(columns) + "\n")
        for first in range(0, rows, _ROWS):
            texts = [map(repr, column[first : first + _ROWS].tolist()) for column in columns.values()]
            stream.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))


def read_csv(path: Path, dtypes: Mapping[str, np.dtype[Any]]) -> dict[str, np.ndarray[Any, Any]]:
    """Read what `write_csv` wrote.

    Parameters
    ----------
    path : Path
    dtypes : mapping of str to dtype
        Of each column, in their order.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged, or has other columns.
    """
    check_regular(path)
    try:
        with path.open(encoding="ascii") as stream:
            names = stream.readline().rstrip("\n").split(",")
            if names != list(dtypes):
                raise ValueError(f"got the columns {', '.join(names)[:200]}, expected {', '.join(dtypes)[:200]}")
            lines = iter(stream)
            first = next(lines, None)
            if first is None:
                return {name: np.empty(0, dtype) for name, dtype in dtypes.items()}
            _check_end(path)
            rows = np.loadtxt(_after(first, stream), dtype=list(dtypes.items()), delimiter=",", ndmin=1, comments=None)
        return {name: np.ascontiguousarray(rows[name]) for name in dtypes}
    except FileNotFoundError:
        raise
    except Exception as error:  # of numpy and of the decoder: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete CSV file of cgemit ({error})") from error


def _after(first: str, rest: Any) -> Any:
    """Yield a line, and those that follow it."""
    yield first
    yield from rest


def _check_end(path: Path) -> None:
    """Raise a ValueError for a file that ends within a line: its last number may be cut off."""
    with path.open("rb") as stream:
        stream.seek(-1, os.SEEK_END)
        if stream.read() != b"\n":
            raise ValueError("the last line is cut off")
