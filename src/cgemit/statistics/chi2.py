"""Tests of the chi-square of the fits against its expected distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from cgemit.result import Result
from cgemit.statistics.estimate import Floats
from cgemit.statistics.formatting import Comparable, Tabular, html_table, with_error
from cgemit.statistics.resolutions import removed_rows
from cgemit.stored_run import tracks_of
from cgemit.tables import Table


def chi2_probability(tracks: Table | Result) -> Floats:
    """Return the probability of a larger chi-square, (n,) float64, for the tracks whose fit ended well.

    It is uniform between 0 and 1 if the errors are right: Q(ndf/2, chi2/2), the regularised incomplete gamma
    function. Tracks without degrees of freedom have no probability and are left out.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    """
    tracks = tracks_of(tracks)
    rows = (tracks["status"] == 0) & (tracks["ndf"] > 0) & np.isfinite(tracks["chi2"])
    return np.asarray(special.gammaincc(tracks["ndf"][rows] / 2, tracks["chi2"][rows] / 2), np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class Flatness(Comparable, Tabular):
    """How well the chi-square probability agrees with a uniform distribution.

    Attributes
    ----------
    n : int
        Tracks used.
    removed : tuple of (str, int)
        Why tracks were not used, and how many each.
    mean, mean_error : float
        Mean probability, expected 0.5, and its error if uniform.
    kolmogorov : float
        Probability of a larger Kolmogorov-Smirnov distance.
    chi2, ndf, binned : float, int, float
        Chi-square of equal bins against uniform, its degrees of freedom, probability of a larger one.
    """

    n: int
    removed: tuple[tuple[str, int], ...]
    mean: float
    mean_error: float
    kolmogorov: float
    chi2: float
    ndf: int
    binned: float

    def columns(self) -> dict[str, list[Any]]:
        """Return all numbers as columns of one row; `removed` as text."""
        removed = ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"
        return {name: list(values) for name, values in super().columns().items()} | {"removed": [removed]}

    def _repr_html_(self) -> str:
        removed = ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"
        cells = [with_error(self.mean, self.mean_error), f"{self.kolmogorov:.3g}", f"{self.binned:.3g}",
                 f"{self.chi2:.1f}/{self.ndf}", str(self.n), removed]  # fmt: skip
        head = ("mean (0.5 expected)", "flat (Kolmogorov)", "flat (bins)", "chi2/ndf", "rows", "removed")
        return html_table("chi-square probability", head, [cells])

    def __repr__(self) -> str:
        removed = ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"
        return (
            f"<chi-square probability: mean {with_error(self.mean, self.mean_error)} (0.5 expected), flat with"
            f" probability {self.kolmogorov:.3g} (Kolmogorov) and {self.binned:.3g} (chi2 {self.chi2:.1f}/{self.ndf}),"
            f" rows {self.n}, removed {removed}>"
        )


def chi2_flatness(tracks: Table | Result, bins: int = 20) -> Flatness:
    """Test whether the chi-square probability of the tracks is uniform.

    Kolmogorov's limiting distribution is taken at D (sqrt(n) + 0.12 + 0.11/sqrt(n)) (Stephens, J. R. Stat. Soc. B 32
    (1970) 115), good from n = 5 on.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    bins : int
        Number of equal bins of the chi-square test.

    Raises
    ------
    ValueError
        If fewer than 5 tracks a bin are left.
    """
    tracks = tracks_of(tracks)
    probability = np.sort(chi2_probability(tracks))
    n = len(probability)
    if bins < 2 or n < 5 * bins:
        raise ValueError(f"bins: got {bins} for {n} tracks; expected at least 2, with 5 tracks each")
    steps = np.arange(n + 1) / n
    distance = max(np.max(steps[1:] - probability), np.max(probability - steps[:-1]))
    kolmogorov = special.kolmogorov(distance * (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n)))
    counts = np.histogram(probability, bins, (0.0, 1.0))[0]
    chi2 = float(np.sum((counts - n / bins) ** 2) / (n / bins))
    removed = removed_rows(tracks["status"], int(np.count_nonzero(tracks["status"] == 0)) - n)
    mean, error = float(probability.mean()), math.sqrt(1 / 12 / n)
    binned = float(special.gammaincc((bins - 1) / 2, chi2 / 2))
    return Flatness(n, removed, mean, error, float(kolmogorov), chi2, bins - 1, binned)
