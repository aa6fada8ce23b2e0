"""Pareto fronts of objectives with errors, and the volume that they dominate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.statistics.estimate import Floats
from cgemit.study.sweeps.evaluate import GROUPS

#: Standard errors by which a design must be better to push another one off the front.
SIGMAS = 2.0
_POINTS = 40


def nondominated(values: Floats) -> npt.NDArray[np.bool_]:
    """Return which rows of (n, objectives) no other row dominates; lower is better, equal rows all count."""
    found = np.ones(len(values), bool)
    for i in np.lexsort(values.T[::-1]):  # a row is only dominated by one before it, or by an equal one
        if found[i]:
            worse = np.all(values >= values[i], axis=1) & np.any(values > values[i], axis=1)
            found &= ~worse
    return found


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
        limit = SIGMAS * _error(replicas[rows] - replicas[i]) + 1e-12 * np.abs(values[i])
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
    found = np.zeros(len(values), bool)
    rows = np.flatnonzero(front)
    for i in rows:
        worse = values[rows] - values[i]
        limit = SIGMAS * _error(replicas[rows] - replicas[i]) + 1e-12 * np.abs(values[i])
        found[i] = bool(np.any(np.all(worse <= limit, axis=1) & np.any(worse < -limit, axis=1)))
    return found


def _error(differences: Floats) -> Floats:
    """Return the errors of differences of (n, objectives, groups) values without each group."""
    spread = np.sum((differences - differences.mean(axis=2, keepdims=True)) ** 2, axis=2)
    return np.asarray(np.sqrt((GROUPS - 1) / GROUPS * spread))


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
    found: list[tuple[int, int, float]] = []
    kept: Any = np.empty((0, values.shape[1]))
    number, last = np.array(calls), -1
    every = list(dict.fromkeys(calls))
    for i in np.unique(np.linspace(0, len(every) - 1, min(len(every), _POINTS)).round().astype(int)):
        call = every[i]
        here, last = values[(number > last) & (number <= call)], call
        new = np.concatenate([kept, here[np.isfinite(here).all(axis=1)]])
        new = new[nondominated(new)] if len(new) else new
        same = np.array_equal(new, kept) and found
        volume = found[-1][2] if same else hypervolume(new, reference)
        found.append((int(call), int(np.sum(number <= call)), volume))
        kept = new
    return found
