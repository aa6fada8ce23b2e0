"""Resolutions and pulls of fitted tracks, with the rows that each status removed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.problems import did_you_mean
from cgemit.result import Result
from cgemit.statistics.estimate import HEAD, Floats, Resolution, measure
from cgemit.statistics.formatting import Comparable, Tabular, html_table, text_table
from cgemit.statistics.widths import Pulls, Resolutions, stacked
from cgemit.stored_run import TrackColumns, track_columns
from cgemit.tables import PARAMETERS, Table

#: Unit in which the resolution of each parameter is quoted, and how many of them make the native unit.
QUOTED = {
    "dr": ("um", 1000.0),
    "phi0": ("mrad", 1000.0),
    "kappa": ("1/(GeV/c)", 1.0),
    "dz": ("mm", 1.0),
    "tanl": ("1e-3", 1000.0),
    "p": ("MeV/c", 1000.0),
}
#: What tracks can be binned in: a function of the table, and the unit.
BY: dict[str, tuple[Callable[[Table | TrackColumns], Floats], str]] = {
    "p": (lambda tracks: tracks["truth_p"], "GeV/c"),
    "pt": (lambda tracks: 1 / np.abs(tracks["truth_kappa"]), "GeV/c"),
    "cos_theta": (lambda tracks: tracks["truth_tanl"] / np.sqrt(1 + tracks["truth_tanl"] ** 2), ""),
    "charge": (lambda tracks: np.sign(tracks["truth_kappa"]), "e"),
}


def resolution(tracks: Table | Result, parameter: str, *, window: tuple[float, float] | None = None) -> Resolution:
    """Return the widths of the residual (fitted minus true) of one parameter.

    Of a run in files (`cgemit.open`), only the columns that are needed are read, part by part.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table. Rows whose fit ended well are used; the others are counted by status.
    parameter : str
        One of dr, phi0, kappa, dz, tanl, p.
    window : (low, high) or None
        Range of the RMS, in the quoted unit; None: all rows.

    Returns
    -------
    Resolution
        In um (dr), mrad (phi0), 1/(GeV/c) (kappa), mm (dz), 1e-3 (tanl), MeV/c (p).

    Raises
    ------
    TypeError, ValueError
        If `tracks` is of another kind, the parameter is unknown or the window is empty.
    """
    unit, scale = QUOTED[_known(parameter, "parameter", list(QUOTED))]
    return _measure(track_columns(tracks), f"res_{parameter}", parameter, unit, scale, window)


def resolutions(tracks: Table | Result) -> Resolutions:
    """Return `resolution` of all parameters, shown as one table.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    """
    return Resolutions(tuple(resolution(tracks, name) for name in QUOTED))


def pulls(tracks: Table | Result) -> Pulls:
    """Return mean and width of the pulls of dr, phi0, kappa, dz, tanl and p, core and plain, with errors.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    """
    columns = track_columns(tracks)
    return Pulls(tuple(_measure(columns, f"pull_{name}", name, "", 1.0, None) for name in PARAMETERS))


@dataclass(frozen=True, eq=False, repr=False)
class Curve(Comparable, Tabular):
    """The widths of one parameter in bins of something.

    Attributes
    ----------
    parameter, unit, by, by_unit : str
    edges : tuple of float
        Limits of the bins, one more than bins.
    x : tuple of float
        Mean of `by` in each bin; NaN where it is empty.
    values : tuple of Resolution
        One per bin.
    outside : int
        Rows in no bin.
    """

    parameter: str
    unit: str
    by: str
    by_unit: str
    edges: tuple[float, ...]
    x: tuple[float, ...]
    values: tuple[Resolution, ...]
    outside: int

    def columns(self) -> dict[str, list[Any]]:
        """Return limits, mean and numbers of the bins as columns, one row for each bin."""
        bins = {f"{self.by}_low": list(self.edges[:-1]), f"{self.by}_high": list(self.edges[1:]), self.by: list(self.x)}
        return bins | stacked([value.columns() for value in self.values])

    def column(self, name: str) -> Floats:
        """Return one number of each bin, such as ``"core"`` or ``"core_error"``, (bins,) float64."""
        return np.array([getattr(value, name) for value in self.values], np.float64)

    def _head(self) -> tuple[str, ...]:
        return (f"{self.by} [{self.by_unit}]" if self.by_unit else self.by, *HEAD)

    def _rows(self) -> list[list[str]]:
        spans = [f"{low:g} to {high:g}" for low, high in zip(self.edges[:-1], self.edges[1:], strict=True)]
        return [[span, *value.cells()] for span, value in zip(spans, self.values, strict=True)]

    def _title(self) -> str:
        label = f"{self.parameter} [{self.unit}]" if self.unit else self.parameter
        return f"{label} against {self.by}, {self.outside} rows in no bin"

    def __repr__(self) -> str:
        return text_table(self._title(), self._head(), self._rows())

    def _repr_html_(self) -> str:
        return html_table(self._title(), self._head(), self._rows())


def resolution_against(
    tracks: Table | Result,
    parameter: str,
    by: str = "cos_theta",
    bins: int | npt.ArrayLike = 10,
    *,
    kind: Literal["residual", "pull"] = "residual",
    window: tuple[float, float] | None = None,
) -> Curve:
    """Return the widths of a parameter's residual or pull in bins of a true quantity.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    parameter : str
        One of dr, phi0, kappa, dz, tanl, p.
    by : str
        p, pt (GeV/c), cos_theta or charge (e), all true values.
    bins : int or (m + 1,) array_like
        Number of equal bins, or their increasing limits. A bin holds its lower limit, the last one both. Where all
        tracks have the same value, a number of bins gives a single one.
    kind : str
        "residual" (quoted units) or "pull".
    window : (low, high) or None
        Range of the RMS.

    Raises
    ------
    TypeError, ValueError
        If `tracks` is of another kind, a name is unknown or the limits do not increase.
    """
    unit, scale = QUOTED[_known(parameter, "parameter", list(QUOTED))]
    quantity, by_unit = BY[_known(by, "by", list(BY))]
    _known(kind, "kind", ["residual", "pull"])
    column = f"res_{parameter}" if kind == "residual" else f"pull_{parameter}"
    unit, scale = (unit, scale) if kind == "residual" else ("", 1.0)
    columns = track_columns(tracks)
    x = np.asarray(quantity(columns), np.float64)
    edges = _edges(x, bins)
    bin_of = np.searchsorted(edges, x, side="right") - 1
    bin_of[x == edges[-1]] = len(edges) - 2
    bin_of[~np.isfinite(x) | (x > edges[-1])] = -1
    chosen = [bin_of == i for i in range(len(edges) - 1)]
    values = tuple(_measure(columns, column, parameter, unit, scale, window, rows) for rows in chosen)
    means = tuple(float(x[rows].mean()) if rows.any() else math.nan for rows in chosen)
    outside = len(x) - sum(int(np.count_nonzero(rows)) for rows in chosen)
    return Curve(parameter, unit, by, by_unit, tuple(map(float, edges)), means, values, outside)


def _known(name: str, what: str, known: list[str]) -> str:
    if name not in known:
        hint = did_you_mean(name, known, "; ")
        raise ValueError(f"{what}: got {name!r}; expected one of {', '.join(known)}{hint}")
    return name


def _measure(
    tracks: Table | TrackColumns,
    column: str,
    parameter: str,
    unit: str,
    scale: float,
    window: tuple[float, float] | None,
    rows: npt.NDArray[np.bool_] | slice = slice(None),
) -> Resolution:
    """Measure a column of the tracks that are good, of the given rows."""
    status, values = tracks["status"][rows], tracks[column][rows]
    good = status == 0
    usable = good & np.isfinite(values)
    removed = removed_rows(status, int(np.count_nonzero(good & ~usable)))
    return measure(scale * values[usable], parameter=parameter, unit=unit, window=window, removed=removed)


def _edges(x: Floats, bins: int | npt.ArrayLike) -> Floats:
    if isinstance(bins, int | np.integer):
        finite = x[np.isfinite(x)]
        if bins < 1 or not len(finite):
            raise ValueError(f"bins: got {bins} for {len(finite)} rows; expected at least one bin and one row")
        return _equal_bins(finite, int(bins))
    edges = np.asarray(bins, np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
        raise ValueError(f"bins: got {bins!r}; expected a number of bins or at least two increasing limits")
    return edges


def _equal_bins(x: Floats, bins: int) -> Floats:
    """Return the limits of equal bins; of a single one where all values agree, as for a gun of one angle."""
    low, high = float(x.min()), float(x.max())
    margin = 1e-6 * max(1.0, abs(low), abs(high))
    if high - low < margin:
        return np.array([low - margin, high + margin])
    return np.linspace(low, high, bins + 1)


def removed_rows(status: npt.NDArray[np.int8], no_value: int) -> tuple[tuple[str, int], ...]:
    """Return how many rows each status removed, and how many good ones had no number."""
    codes, numbers = np.unique(status[status != 0], return_counts=True)
    names = {int(one): one.name for one in _core.FitStatus}
    removed = [(names.get(int(c), f"status {c}"), int(n)) for c, n in zip(codes, numbers, strict=True)]
    return tuple(removed + ([("without a value", int(no_value))] if no_value else []))
