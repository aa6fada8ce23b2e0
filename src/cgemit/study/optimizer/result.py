"""The result of an optimization: every design that was evaluated, the best ones, their confirmation by simulation."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgemit.detector import Detector
from cgemit.record import versions
from cgemit.statistics.formatting import html_table, text_table
from cgemit.study.optimizer.confirm import Confirmation, confirm
from cgemit.study.optimizer.evaluator import Design, Evaluator
from cgemit.study.optimizer.front import SIGMAS, growth, hypervolume
from cgemit.study.optimizer.goals import Goal, jackknife
from cgemit.study.optimizer.single import Found
from cgemit.study.optimizer.table import FRONT, LOOSE, TIED, columns_of, front_of, replicas_of
from cgemit.study.optimizer.variables import Variable, changes_of
from cgemit.study.sweeps.evaluate import GROUPS
from cgemit.study.sweeps.tidy import TidyResult
from cgemit.version import PHYSICS

if TYPE_CHECKING:
    from cgemit.draw.style import Picture

_SHOWN_ROWS = 20


@dataclass(frozen=True, eq=False, repr=False)
class Optimization(TidyResult):
    """The result of an optimization.

    Attributes
    ----------
    columns : dict of str to list
        One row for each evaluated design; row 0 is the base. `call` counts the steps or the groups of designs. `kind`
        is "base", "value", "step" (resolutions with the hits of another design, without errors) or "optimum".
        `allowed` says whether all limits are kept. `front` is "front" for designs that no other one dominates, "front
        within errors" for those among them that another one would dominate but for differences below the error, and
        "within errors" for designs that are dominated by less than the error.
    variables : tuple of Variable
    objectives : tuple of Goal
    method : str
    gradients : int
        Gradients that were computed.
    message : str
        How the search ended.
    growth : list of (int, int, float)
        Several objectives: call, number of designs so far, and the hypervolume of their front.
    reference : tuple of float
        Where the hypervolume ends: the largest objectives of the allowed designs of the first population.
    hypervolume_error : float
        From leaving out groups of tracks (jackknife).
    """

    columns: dict[str, list[Any]]
    variables: tuple[Variable, ...]
    objectives: tuple[Goal, ...]
    method: str
    gradients: int
    message: str
    growth: list[tuple[int, int, float]]
    reference: tuple[float, ...]
    hypervolume_error: float
    evaluator: Evaluator

    @staticmethod
    def of(
        evaluator: Evaluator, variables: Sequence[Variable], objectives: Sequence[Goal], method: str,
        designs: Sequence[Design], found: Found,
    ) -> Optimization:  # fmt: skip
        """Return the table of some designs, the front among them, and its hypervolume."""
        columns = columns_of(evaluator, variables, designs)
        values = np.array([columns[one.header] for one in objectives], np.float64).T
        values[~np.array(columns["allowed"])] = np.nan
        replicas = replicas_of(designs, objectives, values)
        if len(objectives) > 1:
            columns["front"] = front_of(values, replicas)
        volumes: list[tuple[int, int, float]] = []
        reference, error = values[:0].sum(axis=0), math.nan
        if len(objectives) > 1:
            first = values[[i for i, one in enumerate(designs) if one.kind == "value" and one.call == 0]]
            first = first[np.isfinite(first).all(axis=1)]
            reference = first.max(axis=0) if len(first) else np.full(len(objectives), np.nan)
            own = slice(1, None)  # the base is no design of the search
            volumes = growth(values[own], [one.call for one in designs[own]], reference)
            rows = np.array([one in (FRONT, LOOSE) for one in columns["front"]])
            error = jackknife([hypervolume(replicas[rows][..., i], reference) for i in range(GROUPS)])
        return Optimization(
            columns, tuple(variables), tuple(objectives), method, found.gradients, found.message, volumes,
            tuple(map(float, reference)), error, replace(evaluator, folder=None, executor=None),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.columns["design"])

    def __getitem__(self, name: str) -> Any:
        return np.array(self.columns[name])

    @property
    def evaluations(self) -> int:
        """Number of designs that were evaluated, beside the base."""
        return len(self) - 1

    @property
    def front(self) -> list[int]:
        """Rows of the Pareto front, ordered by the first objective; of one objective: the row of the optimum."""
        if len(self.objectives) == 1:
            best = [i for i, kind in enumerate(self.columns["kind"]) if kind == "optimum"]
            first = self.columns[self.objectives[0].header]
            return best or sorted(self._allowed(), key=lambda i: float(first[i]))[:1]
        rows = [i for i, one in enumerate(self.columns["front"]) if one in (FRONT, LOOSE)]
        values = self[self.objectives[0].header]
        return sorted(rows, key=lambda i: float(values[i]))

    def detector(self, design: int | None = None) -> Detector:
        """Return a design by its row; default: the first one of the front.

        Raises
        ------
        ValueError
            If there is no such design.
        """
        rows = self.front if design is None else [design]
        if not rows or not 0 <= rows[0] < len(self):
            raise ValueError(
                f"design: got {design}, expected the row of a design, 0 to {len(self) - 1}, and by default an optimum"
            )
        changes = self._changes(rows[0])
        return self.evaluator.base.with_overrides(dict(changes)) if changes else self.evaluator.base

    def _changes(self, design: int) -> Mapping[str, Any]:
        if design == 0:
            return {}
        return changes_of(self.variables, [self.columns[one.header][design] for one in self.variables])

    def spread(self, count: int = 5) -> list[int]:
        """Return rows of the front at equal distances along the first objective, both ends included."""
        rows = self.front
        if not rows:
            return []
        return [rows[i] for i in np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int)]

    def confirm(self, designs: Sequence[int] | None = None, **how: Any) -> Confirmation:
        """Return the resolutions of some designs beside those of simulated tracks.

        Parameters
        ----------
        designs : sequence of int, optional
            Rows; default: `spread`. The base is added.
        **how
            `events` and `seed` of the simulation, and its `fluctuations`: "gaussian" (default), as the fit and the
            covariance assume them, or "full".
        """
        rows = self.spread() if designs is None else designs
        return confirm(self.evaluator, self.variables, self.columns, rows, **how)

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Write optimize.csv, detector.toml (the base), optimum.toml (of one objective) and summary.json to a folder.

        Files of an earlier optimization are replaced.
        """
        detectors = {"optimum.toml": self.detector()} if len(self.objectives) == 1 and self.front else {}
        return self._write(folder, "optimize.csv", detectors | {"detector.toml": self.evaluator.base}, self.summary())

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds: what was varied and minimized, how it ended, and the best designs."""
        base = self.evaluator.base
        found: dict[str, Any] = {
            "program": "cgemit", "versions": versions(), "physics": PHYSICS,
            "inputs": {
                "base": base.name, "hash": base.content_hash, "method": self.method,
                "minimize": [one.header for one in self.objectives],
                "vary": {one.key: list(one.choices) or [one.low, one.high, one.unit or one.before]
                         for one in self.variables},
                "constraints": {one.goal.header: [one.low, one.high] for one in self.evaluator.limits},
                "evaluation": json.loads(json.dumps(self.evaluator.goals.described())),
            },
            "evaluations": self.evaluations, "gradients": self.gradients, "message": self.message,
            "best": [self._row(i) for i in self.front],
        }  # fmt: skip
        if len(self.objectives) > 1 and self.growth:
            found["hypervolume"] = {"value": self.growth[-1][2], "error": self.hypervolume_error,
                                    "reference": list(self.reference)}  # fmt: skip
            counts = {name: self.columns["front"].count(name) for name in (FRONT, LOOSE, TIED)}
            found["front"] = counts | {"sigmas": SIGMAS}
        return json.loads(json.dumps(found, default=str).replace("NaN", "null").replace("Infinity", "null"))  # type: ignore[no-any-return]

    def draw(self, kind: str | None = None) -> Picture:
        """Draw the result.

        Parameters
        ----------
        kind : "convergence", "front" or "parallel", optional
            The best objective or the hypervolume against the number of designs; the front of each pair of objectives;
            parallel coordinates of variables and objectives. Default: "convergence" for one objective, else "front".
        """
        from cgemit.draw import optimizer as pictures

        chosen = kind or ("convergence" if len(self.objectives) == 1 else "front")
        headers = [one.header for one in self.objectives]
        errors = [one.error_header if one.resolution else None for one in self.objectives]
        title = f"{self.evaluator.base.name}, {self.method}, {self.evaluations} designs"
        if chosen == "convergence" and len(headers) == 1:
            return pictures.draw_convergence(self.columns, headers[0], errors[0], title)
        if chosen == "convergence":
            return pictures.draw_hypervolume(self.growth, self.hypervolume_error, title)
        if chosen == "front":
            return pictures.draw_front(self.columns, headers, errors, title)
        if chosen == "parallel":
            rows = self.front if len(headers) > 1 else self._allowed()
            names = [*(one.header for one in self.variables), *(one.header for one in self.evaluator.goals.goals)]
            return pictures.draw_parallel(self.columns, names, title, colour_by=headers[0], best=rows)
        raise ValueError(f"kind: got {kind!r}, expected one of convergence, front, parallel")

    def _allowed(self) -> list[int]:
        """Return the rows of all designs that keep the limits."""
        return [i for i, one in enumerate(self.columns["allowed"]) if one and i]

    def _row(self, design: int) -> dict[str, Any]:
        left_out = ("problems", "status", "front", "kind", "allowed")
        return {name: values[design] for name, values in self.columns.items() if name not in left_out}

    def _cells(self) -> tuple[list[str], list[list[str]], str]:
        goals = [one.header for one in self.evaluator.goals.goals]
        head = ["design", *(one.header for one in self.variables), *goals]
        rows = [0, *(self.spread(_SHOWN_ROWS) if len(self.objectives) > 1 else self.front)]
        cells = [["base" if i == 0 else str(i), *(_cell(self.columns[name][i]) for name in head[1:])] for i in rows]
        gradients = f", {self.gradients} gradients" if self.method == "gradient" else ""
        title = f"{self.evaluator.base.name}, {self.method}: {self.evaluations} designs{gradients}; {self.message}"
        if len(self.objectives) > 1:
            loose, tied = (self.columns["front"].count(name) for name in (LOOSE, TIED))
            title += f"; front of {len(self.front)}, {loose} of them and {tied} others within errors; some are shown"
        return head, cells, title

    def __repr__(self) -> str:
        head, rows, title = self._cells()
        return text_table(title, head, rows)

    def _repr_html_(self) -> str:
        head, rows, title = self._cells()
        return html_table(title, head, rows)


def _cell(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
