"""Optimization of several objectives: NSGA-II of Optuna by ask and tell, on any executor, resumable."""

from __future__ import annotations

import hashlib
import json
import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.analysis.widths import jackknife
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problem, ProblemsError
from cgemit.base.files import check_regular, package
from cgemit.study.optimize.goals import TOLERANCE, Goal, Variable, changes_of
from cgemit.study.optimize.search import Design, Evaluator, Search

#: Standard errors by which a design must be better to push another one off the front.
SIGMAS = 2.0
_POINTS = 40


def nondominated(values: Floats) -> npt.NDArray[np.bool_]:
    """Return which rows of (n, objectives) no other row dominates; lower is better, equal rows all count."""
    front = np.ones(len(values), bool)
    for i in np.lexsort(values.T[::-1]):  # a row is only dominated by one before it, or by an equal one
        if front[i]:
            worse = np.all(values >= values[i], axis=1) & np.any(values > values[i], axis=1)
            front &= ~worse
    return front


def within_errors(values: Floats, replicas: Floats, front: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which rows beside the front are not worse than it by more than the error of the difference.

    A design is off the front if some design of the front is at least as good in every objective and better by more
    than `SIGMAS` standard errors of the difference in one of them. Tracks are the same for all designs, so that the
    error of a difference follows from leaving out the same group of tracks in both (jackknife).

    Parameters
    ----------
    values : (n, objectives) float64
    replicas : (n, objectives, groups) float64
        Values without each group; equal to the value where an objective has no error.
    front : (n,) bool
    """
    off = np.zeros(len(values), bool)
    for i in np.flatnonzero(front):
        rows = np.flatnonzero(np.all(values >= values[i], axis=1) & ~front & ~off)
        limit = SIGMAS * jackknife(replicas[rows] - replicas[i]) + 1e-12 * np.abs(values[i])
        off[rows] = np.any(values[rows] - values[i] > limit, axis=1)
    return ~front & ~off


def by_noise(values: Floats, replicas: Floats, front: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Return which designs of the front owe their place to differences below the error.

    Some other design of the front is better by more than `SIGMAS` standard errors of the difference in one objective,
    and worse by less than that in the others.

    Parameters
    ----------
    values, replicas, front
        As for `within_errors`.
    """
    beaten = np.zeros(len(values), bool)
    rows = np.flatnonzero(front)
    for i in rows:
        worse = values[rows] - values[i]
        limit = SIGMAS * jackknife(replicas[rows] - replicas[i]) + 1e-12 * np.abs(values[i])
        beaten[i] = bool(np.any(np.all(worse <= limit, axis=1) & np.any(worse < -limit, axis=1)))
    return beaten


def hypervolume(values: Floats, reference: Floats) -> float:
    """Return the volume that rows of (n, objectives) dominate below a reference point, of any dimension.

    Slices along the last objective (E. Zitzler, 2001); two objectives are summed directly.
    """
    inside = values[np.all(values < reference, axis=1)]
    if not len(inside):
        return 0.0
    if values.shape[1] == 1:
        return float(reference[0] - inside.min())
    inside = inside[np.argsort(inside[:, -1], kind="stable")]
    if values.shape[1] == 2:
        best = np.minimum.accumulate(inside[:, 0])
        before = np.concatenate([[reference[0]], best[:-1]])
        return float(np.sum(np.maximum(before - inside[:, 0], 0) * (reference[1] - inside[:, 1])))
    ends = np.append(inside[1:, -1], reference[-1])
    total = 0.0
    for i, end in enumerate(ends):
        if end > inside[i, -1]:
            total += (end - inside[i, -1]) * hypervolume(inside[: i + 1, :-1], reference[:-1])
    return total


def growth(values: Floats, calls: Sequence[int], reference: Floats) -> list[tuple[int, int, float]]:
    """Return (call, designs so far, hypervolume) after each call, or after `_POINTS` of them at equal distances.

    Parameters
    ----------
    values : (n, objectives) float64
        NaN where a design is not allowed.
    calls : sequence of int
        Of each design, ascending.
    reference : (objectives,) float64
    """
    volumes: list[tuple[int, int, float]] = []
    kept: Any = np.empty((0, values.shape[1]))
    number, last = np.array(calls), -1
    every = list(dict.fromkeys(calls))
    for i in np.unique(np.linspace(0, len(every) - 1, min(len(every), _POINTS)).round().astype(int)):
        call = every[i]
        here, last = values[(number > last) & (number <= call)], call
        new = np.concatenate([kept, here[np.isfinite(here).all(axis=1)]])
        new = new[nondominated(new)] if len(new) else new
        same = np.array_equal(new, kept) and volumes
        volume = volumes[-1][2] if same else hypervolume(new, reference)
        volumes.append((int(call), int(np.sum(number <= call)), volume))
        kept = new
    return volumes


#: User attribute of the study that ends each group of designs.
GROUPS_DONE = "groups"


def optuna() -> Any:
    """Return the module `optuna`, silent; raises `MissingPackageError` if it is not installed."""
    module = package("optuna", "opt")
    module.logging.set_verbosity(module.logging.WARNING)
    return module


def open_journal(path: Path | None) -> tuple[Any, Any]:
    """Return a storage of Optuna and a function that writes what was stored since its last call.

    Parameters
    ----------
    path : Path or None
        A file of one JSON text for each operation, which `optuna.storages.journal.JournalFileBackend` reads, too; None:
        nothing is written.

    Raises
    ------
    ProblemsError
        If the file holds something else.
    """
    optuna()
    if path:
        path.parent.mkdir(exist_ok=True)
    from optuna.storages import JournalStorage
    from optuna.storages.journal import BaseJournalBackend

    lines = _whole_groups(path) if path else []

    class Backend(BaseJournalBackend):
        """Operations in memory."""

        written = len(lines)

        def read_logs(self, log_number_from: int) -> Iterable[dict[str, Any]]:
            return lines[log_number_from:]

        def append_logs(self, logs: list[dict[str, Any]]) -> None:
            lines.extend(logs)

    class Storage(JournalStorage):
        """A storage without queue: looking for waiting trials takes half of the time of a search."""

        def get_all_trials(self, study_id: int, deepcopy: bool = True, states: Any = None) -> Any:
            if states is not None and [state.name for state in states] == ["WAITING"]:
                return []
            return super().get_all_trials(study_id, deepcopy, states)

    backend = Backend()

    def write() -> None:
        if path is None:
            return
        text = "".join(json.dumps(line, separators=(",", ":")) + "\n" for line in lines[backend.written :])
        with path.open("a", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        backend.written = len(lines)

    return Storage(backend), write


_LONGEST_LINE = 10_000_000  # bytes of an operation


def _whole_groups(path: Path) -> list[dict[str, Any]]:
    """Return the operations of a journal up to the last complete group; the file is cut there.

    A warning says so if more than the last line of an interrupted run is lost; its designs are found again.
    """
    try:
        check_regular(path)
    except FileNotFoundError:
        return []
    except ValueError as error:
        raise ProblemsError(str(path), [Problem("", str(error), "a journal of Optuna")]) from error
    groups: list[dict[str, Any]] = []
    end = size = complete = 0
    with path.open("rb") as stream:
        while line := stream.readline(_LONGEST_LINE):
            try:
                groups.append(json.loads(line))
            except (ValueError, RecursionError) as error:
                if stream.read(1):
                    text = f"{path}: line {len(groups) + 1} cannot be read ({str(error) or 'too deep'})"
                    warnings.warn(f"{text}; the search goes on from the lines before", stacklevel=2)
                break
            size += len(line)
            if not isinstance(groups[-1], dict):
                raise ProblemsError(str(path), [Problem(f"line {len(groups)}", repr(line[:40]), "a journal of Optuna")])
            done = groups[-1].get("user_attr")
            if line.endswith(b"\n") and isinstance(done, dict) and GROUPS_DONE in done:
                end, complete = size, len(groups)
    os.truncate(path, end)
    return groups[:complete]


#: Violation of an impossible design, for each problem: worse than a violation of any limit.
_IMPOSSIBLE = 1e6


def evolve(
    evaluator: Evaluator,
    variables: Sequence[Variable],
    objectives: Sequence[Goal],
    how: Search,
    *,
    journal: Path | None,
    progress: Callable[[float, str], None] | None,
) -> tuple[Design, ...]:
    """Return all designs of a search: `how.population` random ones, then `how.calls` times `how.offspring`.

    K. Deb et al., IEEE Trans. Evol. Comput. 6 (2002) 182, with simulated binary crossover and polynomial mutation: the
    parents of a call are the best `population` designs of
    the parents and the offspring of the call before. Designs outside of limits are worse than all others, by how much
    they violate them.

    Parameters
    ----------
    evaluator : Evaluator
    variables : sequence of Variable
    objectives : sequence of Goal
    how : Search
    journal : Path or None
        Optuna's journal: a search that it holds is continued, with the same designs as if it had not been interrupted.
    progress : callable or None
    """
    population, offspring, calls, seed = how.population, how.offspring, how.calls, how.seed
    module = optuna()
    storage, write = open_journal(journal)
    study = module.create_study(
        storage=storage, study_name="cgemit", directions=["minimize"] * len(objectives), load_if_exists=True
    )
    distributions = {one.key: _distribution(one) for one in variables}
    parents: dict[int, list[Any]] = {0: []}
    designs = _told(study, evaluator, variables, (population, offspring))
    for call in range(int(study.user_attrs.get(GROUPS_DONE, 0)), calls + 1):
        # A new sampler for each call: its random numbers follow from the call, not from what ran before.
        study.sampler = _sampler(module, distributions, (population, offspring), (seed, call), parents)
        trials = [study.ask(distributions) for _ in range(offspring if call else population)]
        values = [_values(trial, variables) for trial in trials]
        rows = evaluator.rows([changes_of(variables, one) for one in values])
        for trial, value, row in zip(trials, values, rows, strict=True):
            _tell(study, trial, evaluator, objectives, row)
            designs.append(Design(call, "value", value, row))
        study.set_user_attr(GROUPS_DONE, call + 1)
        write()
        if progress:
            progress((call + 1) / (calls + 1), f"optimize, {len(designs)} designs")
    return tuple(designs)


def _told(study: Any, evaluator: Evaluator, variables: Sequence[Variable], sizes: tuple[int, int]) -> list[Design]:
    """Return the designs of a journal with their rows, in the groups in which they were evaluated."""
    trials = study.get_trials(deepcopy=False)
    groups: dict[int, list[tuple[Any, ...]]] = {}
    for trial in trials:
        groups.setdefault(_call(trial.number, sizes), []).append(_values(trial, variables))
    designs = []
    for call, group in groups.items():
        rows = evaluator.rows([changes_of(variables, one) for one in group])
        designs += [Design(call, "value", values, row) for values, row in zip(group, rows, strict=True)]
    return designs


def _values(trial: Any, variables: Sequence[Variable]) -> tuple[Any, ...]:
    found = trial.params  # a copy for each call
    return tuple(found[one.key] for one in variables)


def _call(number: int, sizes: tuple[int, int]) -> int:
    population, offspring = sizes
    return 0 if number < population else 1 + (number - population) // offspring


def _tell(study: Any, trial: Any, evaluator: Evaluator, objectives: Sequence[Goal], row: Mapping[str, Any]) -> None:
    if row["status"] != "ok":
        trial.set_constraint("possible", _IMPOSSIBLE * max(1, len(row["problems"])))
        study.tell(trial, [math.inf] * len(objectives))
        return
    trial.set_constraint("possible", 0.0)
    for name, by in evaluator.violations(dict(row)).items():
        trial.set_constraint(name, by if by > TOLERANCE else min(by, 0.0))
    study.tell(trial, [row["values"][one.header] for one in objectives])


def _distribution(variable: Variable) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if variable.choices:
        return CategoricalDistribution(variable.choices)
    if variable.whole:
        return IntDistribution(int(variable.low), int(variable.high))
    return FloatDistribution(variable.low, variable.high)


def _sampler(
    module: Any, distributions: Mapping[str, Any], sizes: tuple[int, int], seeds: tuple[int, int], parents: Any
) -> Any:
    """Return NSGA-II with `offspring` designs in each generation after the first; Optuna's own has `population`."""
    population, _ = sizes

    class Sampler(module.samplers.NSGAIISampler):  # type: ignore[misc]
        """NSGA-II in which the generation of a trial follows from its number."""

        def infer_relative_search_space(self, study: Any, trial: Any) -> Any:
            return dict(distributions)

        def get_trial_generation(self, study: Any, trial: Any) -> int:
            return _call(trial.number, sizes)

        def get_population(self, study: Any, generation: int) -> list[Any]:
            trials = study.get_trials(deepcopy=False)
            return [one for one in trials if one.state.is_finished() and _call(one.number, sizes) == generation]

        def get_parent_population(self, study: Any, generation: int) -> list[Any]:
            if generation not in parents:
                parents[generation] = self.select_parent(study, generation)
            return list(parents[generation])

    text = f"cgemit {seeds[0]} {seeds[1]}"
    number = int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")
    nsgaii = module.samplers.nsgaii
    with warnings.catch_warnings():  # "experimental" since years
        warnings.simplefilter("ignore", module.exceptions.ExperimentalWarning)
        return Sampler(
            population_size=population, seed=number, crossover=nsgaii.SBXCrossover(),
            mutation=nsgaii.PolynomialMutation(),
        )  # fmt: skip
