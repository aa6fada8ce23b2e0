"""Fractions with Wilson's binomial interval."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Fraction:
    """A number of successes among trials.

    Attributes
    ----------
    count, n : int
        Successes and trials.
    """

    count: int
    n: int

    @property
    def value(self) -> float:
        """The fraction; NaN without trials."""
        return self.count / self.n if self.n else math.nan

    def interval(self, z: float = 1.0) -> tuple[float, float]:
        """Return Wilson's interval.

        Parameters
        ----------
        z : float
            Standard deviations of a Gaussian that the interval corresponds to; 1: 68.3 %.

        Returns
        -------
        low, high : float
            NaN without trials.
        """
        if not self.n:
            return math.nan, math.nan
        share, per = self.count / self.n, z * z / self.n
        middle = (share + 0.5 * per) / (1 + per)
        half = math.sqrt(per * (share * (1 - share) + 0.25 * per)) / (1 + per)
        low, high = max(0.0, middle - half), min(1.0, middle + half)
        return (0.0 if self.count == 0 else low), (1.0 if self.count == self.n else high)

    def __str__(self) -> str:
        if not self.n:
            return "none"
        low, high = self.interval()
        up, down = 100 * (high - self.value), 100 * (self.value - low)
        return f"{100 * self.value:.2f} % (+{up:.2f} -{down:.2f}; {self.count:,} of {self.n:,})"
