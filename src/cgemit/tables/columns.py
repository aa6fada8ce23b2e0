"""The columns of which the schemas of the tables are made."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Parameters
    ----------
    name : str
    dtype : numpy.dtype
    unit : str
        Empty for counts, numbers of things and other pure numbers.
    doc : str
    links : str, tuple of str or None
        The table whose rows the column counts (-1: none). A tuple picks the table by the row's `view`.
    shape : tuple of int
        Shape of one entry; ``()`` is a plain number.
    """

    name: str
    dtype: np.dtype[np.generic]
    unit: str
    doc: str
    links: str | tuple[str, ...] | None = None
    shape: tuple[int, ...] = ()


def column_of(code: str, name: str, unit: str, doc: str, links: str | tuple[str, ...] | None = None) -> Column:
    """Return a column of a dtype code."""
    return Column(name, np.dtype(code), unit, doc, links)


def real(name: str, unit: str, doc: str) -> Column:
    """Return a column of numbers, float64."""
    return column_of("f8", name, unit, doc)


def whole(name: str, doc: str) -> Column:
    """Return a column of counts or numbers of things, int32."""
    return column_of("i4", name, "", doc)


def link(name: str, doc: str, links: str | tuple[str, ...]) -> Column:
    """Return a column that counts rows of another table, int64."""
    return column_of("i8", name, "", doc, links)


def point(prefix: str, doc: str) -> tuple[Column, ...]:
    """Return the columns of the three coordinates of a point."""
    return tuple(real(prefix + axis, "mm", f"{doc}, {axis}") for axis in "xyz")


def momentum(doc: str) -> tuple[Column, ...]:
    """Return the columns of the three components of a momentum."""
    return tuple(real("p" + axis, "GeV/c", f"{doc}, {axis}") for axis in "xyz")


#: The first column of every table.
EVENT = column_of("i8", "event", "", "event number")
