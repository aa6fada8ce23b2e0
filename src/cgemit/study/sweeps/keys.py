"""Keys of a space that name nothing in the detectors that they would change, found before anything is evaluated."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatchcase

from cgemit.detector import Detector, DetectorError
from cgemit.problems import Problem, did_you_mean
from cgemit.study.sweeps.space import Changes

#: Groups of parts with labels.
_GROUPS = ("beam_pipe", "cgem", "walls")


def key_problems(pairs: Iterable[tuple[Detector, Changes]]) -> list[str]:
    """Return a problem for each key that names nothing in any detector that it would change.

    Parameters
    ----------
    pairs : iterable of (Detector, mapping)
        Each variant's base and changes. The first variant of each base and key is built.

    Returns
    -------
    list of str
        A value that is wrong is no problem here: another value of the same key may be possible.
    """
    tried: set[tuple[str, int]] = set()
    found: dict[str, str] = {}
    fine: set[str] = set()
    for base, changes in pairs:
        new = [key for key in changes if (key, id(base)) not in tried]
        if not new:
            continue
        tried |= {(key, id(base)) for key in new}
        problems = _unknown(base, changes)
        for key in new:
            own = next((one for one in problems if _is_of(one, key)), None)
            if own is None:
                fine.add(key)
            else:
                found[key] = _text(base, key, own)
    return [text for key, text in found.items() if key not in fine]


def _unknown(base: Detector, changes: Changes) -> list[Problem]:
    """Return those problems of a variant that tell of names that the base does not have."""
    try:
        base.with_overrides(dict(changes))
    except DetectorError as error:
        return [one for one in error.problems if _names_nothing(one)]
    return []


def _names_nothing(problem: Problem) -> bool:
    incomplete = problem.given.startswith("only ") and problem.expected.startswith("also ")  # read as a new part
    relative = problem.expected == "a number of the detector"
    return problem.given == "an unknown key" or problem.given.endswith("matches nothing") or incomplete or relative


def _is_of(problem: Problem, key: str) -> bool:
    """Return whether the path of a problem leads to a key, or from it to a value of its table."""
    names = [re.sub(r"\[\d+\]$", "", name) for name in problem.path.split(".")]
    for part in (part.strip() for part in key.split(",")):
        if problem.path == part or all(fnmatchcase(*pair) for pair in zip(names, part.split("."), strict=False)):
            return True
    return False


def _text(base: Detector, key: str, problem: Problem) -> str:
    group, _, rest = problem.path.partition(".")
    label = rest.partition(".")[0]
    labels = [part.label for part in getattr(base, group)] if group in _GROUPS else []
    if labels and label not in labels and not any(mark in label for mark in "*?["):
        hint = did_you_mean(label, labels, "; ")
        return f"{key}: got {label!r}, which the base does not have; expected one of {', '.join(labels)}{hint}"
    return f"{key}: {str(problem).partition(': ')[2]}"
