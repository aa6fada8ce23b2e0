"""Rows that a study does not use, by the reason why."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit import _core


def removed_rows(status: npt.NDArray[np.int8], no_value: int) -> tuple[tuple[str, int], ...]:
    """Return how many rows each status removed, and how many good ones had no number."""
    codes, numbers = np.unique(status[status != 0], return_counts=True)
    names = {int(one): one.name for one in _core.FitStatus}
    removed = [(names.get(int(c), f"status {c}"), int(n)) for c, n in zip(codes, numbers, strict=True)]
    return tuple(removed + ([("without a value", int(no_value))] if no_value else []))
