"""Widths of several quantities as one table, and the fit of a Gaussian."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.problems import did_you_mean
from cgemit.statistics.estimate import HEAD, Resolution, moments
from cgemit.statistics.formatting import Comparable, Tabular, html_table, text_table, with_error


def stacked(tables: Sequence[dict[str, list[Any]]]) -> dict[str, list[Any]]:
    """Return tables of the same columns, one below the other."""
    return {name: [cell for table in tables for cell in table[name]] for name in tables[0]} if tables else {}


@dataclass(frozen=True, eq=False, repr=False)
class Resolutions(Comparable, Tabular):
    """The widths of several quantities, by their name.

    Attributes
    ----------
    widths : tuple of Resolution
    """

    widths: tuple[Resolution, ...]

    def columns(self) -> dict[str, list[Any]]:
        """Return the numbers as columns, one row for each quantity."""
        return stacked([one.columns() for one in self.widths])

    def names(self) -> list[str]:
        """Return the names of the quantities."""
        return [one.parameter for one in self.widths]

    def __getitem__(self, parameter: str) -> Resolution:
        names = self.names()
        if parameter not in names:
            hint = did_you_mean(parameter, names, "; ")
            raise ValueError(f"parameter: got {parameter!r}; expected one of {', '.join(names)}{hint}")
        return self.widths[names.index(parameter)]

    def _ipython_key_completions_(self) -> list[str]:
        return self.names()

    def __iter__(self) -> Iterator[Resolution]:
        return iter(self.widths)

    def __len__(self) -> int:
        return len(self.widths)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        return "resolutions", ("quantity", *HEAD), [[one.label(), *one.cells()] for one in self.widths]

    def __repr__(self) -> str:
        return text_table(*self._table())

    def _repr_html_(self) -> str:
        return html_table(*self._table())


class Pulls(Resolutions):
    """The pulls (residual / error) of all parameters; `rms` and `mean` are the plain width and mean."""

    @property
    def pulls(self) -> tuple[Resolution, ...]:
        """The widths of the pulls."""
        return self.widths

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        rows = [[one.parameter, *one.cells(), with_error(one.mean, one.mean_error)] for one in self.widths]
        return "pulls", ("parameter", *HEAD, "mean"), rows


@dataclass(frozen=True, eq=False, repr=False)
class GaussianFit(Comparable, Tabular):
    """A Gaussian fitted to a sample: number of rows, mean and sigma with errors."""

    n: int
    mean: float
    mean_error: float
    sigma: float
    sigma_error: float

    def __repr__(self) -> str:
        mean, sigma = with_error(self.mean, self.mean_error), with_error(self.sigma, self.sigma_error)
        return f"<Gaussian: mean {mean}, sigma {sigma}, {self.n} rows>"

    def _repr_html_(self) -> str:
        cells = [with_error(self.mean, self.mean_error), with_error(self.sigma, self.sigma_error), str(self.n)]
        return html_table("Gaussian", ("mean", "sigma", "rows"), [cells])


def gaussian_fit(sample: npt.ArrayLike) -> GaussianFit:
    """Fit a Gaussian to all rows of a sample by maximum likelihood, without a histogram.

    The maximum is at the sample's mean and standard deviation (divisor n); the error of sigma allows for a shape that
    is not Gaussian (fourth moment).

    Parameters
    ----------
    sample : (n,) array_like

    Raises
    ------
    ValueError
        If the sample is not a list of finite numbers.
    """
    x = np.asarray(sample, np.float64)
    if x.ndim != 1 or not np.isfinite(x).all():
        raise ValueError(f"sample: expected a list of finite numbers, got shape {x.shape}")
    rms, rms_error, mean, mean_error = moments(x)
    shrink = math.sqrt(1 - 1 / len(x)) if len(x) else 1.0
    return GaussianFit(len(x), mean, mean_error, rms * shrink, rms_error)
