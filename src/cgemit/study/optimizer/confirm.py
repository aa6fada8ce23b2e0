"""Resolutions of the best designs beside those of simulated tracks."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cgemit.io.files import new_file
from cgemit.stages import Settings
from cgemit.statistics.formatting import html_table, text_table, with_error, write_csv
from cgemit.study.optimizer.evaluator import Evaluator
from cgemit.study.optimizer.goals import Goals, jackknife
from cgemit.study.optimizer.variables import Variable, changes_of


@dataclass(frozen=True, eq=False, repr=False)
class Confirmation:
    """Resolutions of some designs as the optimization has them and from simulated tracks.

    Attributes
    ----------
    columns : dict of str to list
        One row for each design and resolution: `design`, `quantity`, `optimized`, `simulated`, `error` of the simulated
        value, `ratio` of simulated to optimized with `ratio_error`, `to_base` and `to_base_error`: the simulated value
        over that of the base, whose tracks have the same random numbers.
    events : int
        Of each design and point.
    """

    columns: dict[str, list[Any]]
    events: int

    def __getitem__(self, name: str) -> Any:
        return np.array(self.columns[name])

    def to_pandas(self) -> Any:
        """Return the table as a `pandas.DataFrame`."""
        import pandas

        return pandas.DataFrame(self.columns)

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write confirmation.csv to a folder; an earlier one is replaced."""
        path = Path(folder) / "confirmation.csv"
        with new_file(path, overwrite=True) as temporary:
            write_csv(temporary, self.columns)
        return path

    def _cells(self) -> tuple[str, list[str], list[list[str]]]:
        columns = self.columns
        rows = [
            [
                "base" if columns["design"][i] == 0 else str(columns["design"][i]), columns["quantity"][i],
                f"{columns['optimized'][i]:.4g}", with_error(columns["simulated"][i], columns["error"][i]),
                with_error(columns["ratio"][i], columns["ratio_error"][i]),
                with_error(columns["to_base"][i], columns["to_base_error"][i]),
            ]
            for i in range(len(columns["design"]))
        ]  # fmt: skip
        head = ["design", "quantity", "optimized", "simulated", "simulated/optimized", "simulated, to the base"]
        return f"{self.events} simulated tracks for each design and point", head, rows

    def __repr__(self) -> str:
        return text_table(*self._cells())

    def _repr_html_(self) -> str:
        return html_table(*self._cells())


def confirm(
    evaluator: Evaluator,
    variables: Sequence[Variable],
    table: Mapping[str, Sequence[Any]],
    designs: Sequence[int],
    *,
    events: int = 20_000,
    seed: int = 1,
    fluctuations: Literal["full", "gaussian"] = "gaussian",
) -> Confirmation:
    """Return the resolutions of some designs from simulated tracks.

    Parameters
    ----------
    evaluator : Evaluator
        Of the optimization.
    variables : sequence of Variable
    table : mapping of str to list
        Its table.
    designs : sequence of int
        Rows of the table. The base is added.
    events, seed : int
        Of the simulation, for each design and point.
    fluctuations : "full" or "gaussian"
        "gaussian": scattering and energy loss as the fit and the covariance assume them; "full": with their tails.

    Raises
    ------
    ValueError
        If no goal is a resolution.
    """
    goals = tuple(one for one in evaluator.goals.goals if one.resolution)
    if not goals:
        raise ValueError("confirm: got no resolution among objectives and limits, expected at least one")
    old = evaluator.goals.evaluation
    settings = old.settings or Settings()
    settings = replace(settings, simulate=replace(settings.simulate, fluctuations=fluctuations))
    evaluation = replace(old, method="mc", events=events, seed=seed, settings=settings)
    simulating = Evaluator(evaluator.base, Goals(goals, evaluation, None), (), None, None)
    numbers = list(dict.fromkeys([0, *designs]))
    changes = [changes_of(variables, [table[one.header][i] for one in variables]) if i else {} for i in numbers]
    rows = simulating.rows(changes)
    columns: dict[str, list[Any]] = {name: [] for name in _NAMES}
    for number, row in zip(numbers, rows, strict=True):
        if row["status"] != "ok":
            raise ValueError(f"confirm: design {number}: {'; '.join(row['problems'])}")
        for goal in goals:
            name = goal.header
            values = (number, name, table[name][number], row["values"][name], row["errors"][name])
            simulated, error = values[3:]
            ratio = [one / other for one, other in zip(row["replicas"][name], rows[0]["replicas"][name], strict=True)]
            more = (simulated / values[2], error / values[2], simulated / rows[0]["values"][name], jackknife(ratio))
            for column, value in zip(_NAMES, (*values, *more), strict=True):
                columns[column].append(value)
    return Confirmation(columns, events)


_NAMES = ("design", "quantity", "optimized", "simulated", "error", "ratio", "ratio_error", "to_base", "to_base_error")
