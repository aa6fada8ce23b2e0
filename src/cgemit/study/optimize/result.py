"""The result of an optimization: every design that was evaluated, the best ones, their confirmation by simulation."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from cgemit.analysis.widths import GROUPS, jackknife
from cgemit.base.files import add_files
from cgemit.base.validate import is_whole
from cgemit.base.version import PHYSICS
from cgemit.chain.executor import Workers
from cgemit.chain.record import versions
from cgemit.chain.settings import Settings
from cgemit.detector import Detector
from cgemit.detector.variants import variant_name
from cgemit.study.optimize.goals import Goal, Goals, Variable, changes_of
from cgemit.study.optimize.pareto import SIGMAS, by_noise, growth, hypervolume, nondominated, within_errors
from cgemit.study.optimize.search import Design, Evaluator, Found
from cgemit.study.sweep.result import ChunkedResult, TidyResult
from cgemit.tables.show import with_error, write_csv

if TYPE_CHECKING:
    from cgemit.draw.style import Picture


#: What a design is: of the front, of the front by less than errors, dominated by less than errors.
FRONT, LOOSE, TIED = "front", "front within errors", "within errors"


def columns_of(evaluator: Evaluator, variables: Sequence[Variable], designs: Sequence[Design]) -> dict[str, list[Any]]:
    """Return the table of some designs, without the front."""
    rows = [one.row for one in designs]
    columns: dict[str, list[Any]] = {
        "design": list(range(len(designs))),
        "call": [one.call for one in designs],
        "kind": [one.kind for one in designs],
        "name": [_name(evaluator.base, variables, one) for one in designs],
        "hash": [row.get("hash", "") for row in rows],
        "status": [row["status"] for row in rows],
        "problems": ["; ".join(row["problems"]) for row in rows],
        "allowed": [evaluator.allowed(row) for row in rows],
    }
    for i, variable in enumerate(variables):
        columns[variable.header] = [one.values[i] for one in designs]
    for goal in evaluator.goals.goals:
        columns[goal.header] = [row.get("values", {}).get(goal.header, math.nan) for row in rows]
        if goal.resolution:
            columns[goal.error_header] = [row.get("errors", {}).get(goal.header, math.nan) for row in rows]
    return columns


def _name(base: Detector, variables: Sequence[Variable], design: Design) -> str:
    return base.name if design.kind == "base" else variant_name(base.name, changes_of(variables, design.values))


def replicas_of(designs: Sequence[Design], objectives: Sequence[Goal], values: Any) -> Any:
    """Return (designs, objectives, GROUPS) values without each group of tracks."""
    all_replicas = np.repeat(values[:, :, None], GROUPS, axis=2)
    for i, design in enumerate(designs):
        for k, goal in enumerate(objectives):
            replicas = design.row.get("replicas", {}).get(goal.header)
            if replicas is not None:
                all_replicas[i, k] = replicas
    return all_replicas


def front_of(values: Any, replicas: Any) -> list[str]:
    """Return what each design is: on the front, within errors of it, or neither (an empty text)."""
    texts = np.full(len(values), "", dtype=object)
    allowed = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(allowed):
        front = nondominated(values[allowed])
        texts[allowed[front]] = FRONT
        texts[allowed[by_noise(values[allowed], replicas[allowed], front)]] = LOOSE
        texts[allowed[within_errors(values[allowed], replicas[allowed], front)]] = TIED
    return [str(one) for one in texts]


@dataclass(frozen=True, eq=False, repr=False)
class Confirmation(TidyResult):
    """Resolutions of some designs as the optimization has them and from simulated tracks.

    Attributes
    ----------
    columns : dict of str to list
        One row for each design and resolution: `design`, `quantity`, `optimized`, `expected` of these tracks,
        `simulated`, `error` of the simulated value, `ratio` of simulated to expected with `ratio_error`, `to_base` and
        `to_base_error`: the simulated value over the base's, whose tracks have the same random numbers.
    events : int
        Of each design and point.

    Examples
    --------
    >>> space = {"cgem.L2.anode_radius": ("120 mm", "140 mm")}
    >>> best = cg.study.optimize("besiii-cgem-design", space, "dr", evaluate={"p": 0.5, "samples": 4})
    >>> checked = best.confirm(events=100)
    >>> print(checked.events, sorted(set(checked.columns["quantity"])))
    100 ['sigma_dr (um)']
    """

    columns: dict[str, list[Any]]
    events: int

    def __getitem__(self, name: str) -> Any:
        return np.array(self.columns[name])

    def write(self, folder: str | os.PathLike[str]) -> Path:
        """Write confirmation.csv to a folder; an earlier one is replaced.

        Raises OutputExistsError if cgemit did not write that one, or if it was changed.
        """
        name = "confirmation.csv"
        with add_files(folder) as place:
            write_csv(place / name, self.columns)
        return Path(folder) / name

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        columns = self.columns
        rows = [
            [
                "base" if columns["design"][i] == 0 else str(columns["design"][i]), columns["quantity"][i],
                f"{columns['optimized'][i]:.4g}", f"{columns['expected'][i]:.4g}",
                with_error(columns["simulated"][i], columns["error"][i]),
                with_error(columns["ratio"][i], columns["ratio_error"][i]),
                with_error(columns["to_base"][i], columns["to_base_error"][i]),
            ]
            for i in range(len(columns["design"]))
        ]  # fmt: skip
        head = [
            "design",
            "quantity",
            "optimized",
            "expected",
            "simulated",
            "simulated/expected",
            "simulated, to the base",
        ]
        return f"{self.events} simulated tracks for each design and point", head, rows


def confirm(
    evaluator: Evaluator,
    variables: Sequence[Variable],
    table: Mapping[str, Sequence[Any]],
    designs: Sequence[int],
    *,
    events: int = 20_000,
    seed: int = 1,
    fluctuations: Literal["full", "gaussian"] | None = None,
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
    fluctuations : "full", "gaussian" or None
        "gaussian" (None after an optimization by covariances): tracks as a covariance assumes them, with Gaussian
        scattering and energy loss, without decays and delta electrons; the fit expects no delta electrons either, and
        `expected` is the covariance of this fit. "full" (None after one by simulation): with tails, delta electrons
        and decays; `expected` is what was optimized.

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
    gaussian = fluctuations == "gaussian" or (fluctuations is None and old.method == "analytic")
    if gaussian:
        simulate = replace(settings.simulate, fluctuations="gaussian", deltas=False, decays=False)
        settings = replace(settings, simulate=simulate, fit=replace(settings.fit, delta_strips=0.0))
    elif fluctuations:
        settings = replace(settings, simulate=replace(settings.simulate, fluctuations=fluctuations))
    numbers = list(dict.fromkeys([0, *designs]))
    changes = [changes_of(variables, [table[one.header][i] for one in variables]) if i else {} for i in numbers]

    def rows_of(method: Literal["analytic", "mc"]) -> list[dict[str, Any]]:
        evaluation = replace(old, method=method, events=events, seed=seed, settings=settings)
        rows = Evaluator(evaluator.base, Goals(goals, evaluation, None), (), None, Workers()).rows(changes)
        for number, row in zip(numbers, rows, strict=True):
            if row["status"] != "ok":
                raise ValueError(f"confirm: design {number}: {'; '.join(row['problems'])}")
        return rows

    rows = rows_of("mc")
    expected = rows_of("analytic") if gaussian else [{"values": {}}] * len(rows)
    columns: dict[str, list[Any]] = {name: [] for name in _NAMES}
    for number, row, other in zip(numbers, rows, expected, strict=True):
        for goal in goals:
            name = goal.header
            optimized, simulated, error = table[name][number], row["values"][name], row["errors"][name]
            target = other["values"].get(name, optimized)
            ratio = [one / base for one, base in zip(row["replicas"][name], rows[0]["replicas"][name], strict=True)]
            values = (number, name, optimized, target, simulated, error, simulated / target, error / target)
            more = (simulated / rows[0]["values"][name], jackknife(ratio))
            for column, value in zip(_NAMES, (*values, *more), strict=True):
                columns[column].append(value)
    return Confirmation(columns, events)


_NAMES = ("design", "quantity", "optimized", "expected", "simulated", "error", "ratio", "ratio_error", "to_base",
          "to_base_error")  # fmt: skip


_SHOWN_ROWS = 20


@dataclass(frozen=True, eq=False, repr=False)
class Optimization(ChunkedResult):
    """The result of an optimization.

    Attributes
    ----------
    columns : dict of str to list
        One row for each evaluated design; row 0 is the base. `call` counts the steps or the groups of designs. `kind`
        is "base", "value" or "optimum".
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
    plan : tuple of str
        Name of the optimization.

    Examples
    --------
    >>> space = {"cgem.L2.anode_radius": ("120 mm", "140 mm")}
    >>> best = cg.study.optimize("besiii-cgem-design", space, "dr", evaluate={"p": 0.5, "samples": 4})
    >>> round(best.detector().cgem["L2"].anode_radius, 1)  # mm
    122.4
    """

    work: ClassVar[str] = "optimize"

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
    plan: tuple[str, ...]

    @staticmethod
    def of(
        evaluator: Evaluator, variables: Sequence[Variable], objectives: Sequence[Goal], method: str,
        designs: Sequence[Design], found: Found, plan: tuple[str, ...],
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
            tuple(map(float, reference)), error, replace(evaluator, folder=None, workers=Workers()), plan,
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
        if not rows or not is_whole(rows[0], 0, len(self) - 1):
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
        """Compare the resolutions of some designs with the resolutions of simulated tracks.

        Parameters
        ----------
        designs : sequence of int, optional
            Rows; default: `spread`. The base is added.
        **how
            `events` and `seed` of the simulation, and its `fluctuations`; see
            `cgemit.study.optimize.result.confirm`.
        """
        rows = self.spread() if designs is None else designs
        if not isinstance(rows, Sequence) or not all(is_whole(one, 0, len(self) - 1) for one in rows):
            raise ValueError(f"designs: got {rows!r:.60}, expected a list of rows from 0 to {len(self) - 1}")
        return confirm(self.evaluator, self.variables, self.columns, rows, **how)

    def _detectors(self) -> dict[str, Detector]:
        optimum = {"optimum.toml": self.detector()} if len(self.objectives) == 1 and self.front else {}
        return optimum | {"detector.toml": self.evaluator.base}

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds: what was varied and minimized, how it ended, and the best designs."""
        base = self.evaluator.base
        content: dict[str, Any] = {
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
            content["hypervolume"] = {"value": self.growth[-1][2], "error": self.hypervolume_error,
                                    "reference": list(self.reference)}  # fmt: skip
            counts = {name: self.columns["front"].count(name) for name in (FRONT, LOOSE, TIED)}
            content["front"] = counts | {"sigmas": SIGMAS}
        return json.loads(json.dumps(content, default=str).replace("NaN", "null").replace("Infinity", "null"))  # type: ignore[no-any-return]

    def draw(self, kind: str | None = None) -> Picture:
        """Draw the result.

        Parameters
        ----------
        kind : "convergence", "front" or "parallel", optional
            The best objective or the hypervolume against the number of designs; the front of each pair of objectives;
            parallel coordinates of variables and objectives. Default: "convergence" for one objective, else "front".
        """
        from cgemit.draw import design as pictures

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

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        goals = [one.header for one in self.evaluator.goals.goals]
        head = ["design", *(one.header for one in self.variables), *goals]
        rows = [0, *(self.spread(_SHOWN_ROWS) if len(self.objectives) > 1 else self.front)]
        cells = [["base" if i == 0 else str(i), *(_cell(self.columns[name][i]) for name in head[1:])] for i in rows]
        gradients = f", {self.gradients} gradients" if self.method == "gradient" else ""
        base, own = self.evaluator.base, any(one.resolution for one in self.evaluator.goals.goals)
        readout = f", readout {base.readout_text}" if own and base.readout_text else ""
        title = f"{base.name}{readout}, {self.method}: {self.evaluations} designs{gradients}; {self.message}"
        if len(self.objectives) > 1:
            loose, tied = (self.columns["front"].count(name) for name in (LOOSE, TIED))
            title += f"; front of {len(self.front)}, {loose} of them and {tied} others within errors; some are shown"
        return title, head, cells


def _cell(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
