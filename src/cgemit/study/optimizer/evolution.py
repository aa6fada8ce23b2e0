"""Several objectives: NSGA-II of Optuna by ask and tell, evaluated by any executor, resumable."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cgemit.study.optimizer.evaluator import Design, Evaluator
from cgemit.study.optimizer.goals import TOLERANCE, Goal
from cgemit.study.optimizer.journal import GROUPS_DONE, open_journal, optuna
from cgemit.study.optimizer.variables import Variable, changes_of

#: Violation of an impossible design, for each problem: worse than that of any limit.
_IMPOSSIBLE = 1e6


def evolve(
    evaluator: Evaluator,
    variables: Sequence[Variable],
    objectives: Sequence[Goal],
    *,
    population: int,
    offspring: int,
    calls: int,
    seed: int,
    journal: Path | None,
    progress: Callable[[float, str], None] | None,
) -> tuple[Design, ...]:
    """Return all designs of a search: `population` random ones, then `calls` times `offspring`.

    K. Deb et al., IEEE Trans. Evol. Comput. 6 (2002) 182, with simulated binary crossover and polynomial mutation: the
    parents of a call are the best `population` designs of
    the parents and the offspring of the call before. Designs outside of limits are worse than all others, by how much
    they violate them.

    Parameters
    ----------
    evaluator : Evaluator
    variables : sequence of Variable
    objectives : sequence of Goal
    population, offspring, calls, seed : int
    journal : Path or None
        Optuna's journal: a search that it holds is continued, with the same designs as if it had not been interrupted.
    progress : callable or None
    """
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
