"""Widths of several quantities as one table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from cgemit.problems import did_you_mean
from cgemit.statistics.estimate import HEAD, Resolution
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
