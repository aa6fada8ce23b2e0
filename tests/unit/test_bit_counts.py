"""Counters side by side, one bit of a word each: against sums of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from cgemit._core import _testing

SIZE = 192


def summed(first: list[int], last: list[int]) -> np.ndarray:
    counts = np.zeros(SIZE, np.int64)
    for low, high in zip(first, last, strict=True):
        counts[low : high + 1] += 1
    return counts


@pytest.mark.parametrize(
    ("first", "last"),
    [
        ([], []),
        ([5], [5]),
        ([0], [SIZE - 1]),
        ([63, 64, 127, 0], [63, 64, 128, 191]),  # at the borders of words
        ([10, 20, 30] * 42, [100, 90, 80] * 42),  # 126 of at most 127
    ],
)
def test_ranges_by_hand(first: list[int], last: list[int]) -> None:
    counts, most, where = _testing.count_ranges(np.array(first, np.int32), np.array(last, np.int32))
    expected = summed(first, last)
    np.testing.assert_array_equal(counts, expected)
    assert most == expected.max()
    np.testing.assert_array_equal(where, expected == expected.max())


@pytest.mark.parametrize("seed", range(20))
def test_random_ranges(seed: int) -> None:
    random = np.random.default_rng(seed)
    ends = np.sort(random.integers(0, SIZE, (random.integers(1, 127), 2)), axis=1).astype(np.int32)
    counts, most, where = _testing.count_ranges(ends[:, 0], ends[:, 1])
    expected = summed(ends[:, 0].tolist(), ends[:, 1].tolist())
    np.testing.assert_array_equal(counts, expected)
    assert most == expected.max()
    np.testing.assert_array_equal(where, expected == expected.max())


@pytest.mark.parametrize(("first", "last"), [(-1, 3), (4, 3), (0, SIZE)])
def test_ranges_outside_are_refused(first: int, last: int) -> None:
    with pytest.raises(ValueError, match="expected ranges within 0 and 191"):
        _testing.count_ranges(np.array([first], np.int32), np.array([last], np.int32))
