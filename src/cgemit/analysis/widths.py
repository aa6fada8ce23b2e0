"""Widths of a sample: core, central interval, RMS and tails of plain arrays, each with its error."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.base.validate import number
from cgemit.tables.show import Comparable, Tabular, html_table, with_error

FEWEST = 10  # a width of fewer rows is not quoted

_N_SIGMA = 3.0  # half-width of the core's window, in core sigmas

_INSIDE = math.erf(_N_SIGMA / math.sqrt(2))
#: <u^2> of a standard normal variable cut at +-3, by partial integration: 0.9733.
SECOND_INSIDE = 1 - 2 * _N_SIGMA * math.exp(-(_N_SIGMA**2) / 2) / math.sqrt(2 * math.pi) / _INSIDE

_CENTRAL = math.erf(1 / math.sqrt(2))  # 0.6827, what a Gaussian holds within one sigma

_ODD = 0.1  # of the core, by which q68 differs where no Gaussian describes most rows


@dataclass(frozen=True, eq=False, repr=False)
class Resolution(Comparable, Tabular):
    """The widths of one sample, all in `unit`; NaN where fewer than 10 rows are left.

    Attributes
    ----------
    parameter, unit : str
    n : int
        Rows used.
    removed : tuple of (str, int)
        Why rows were not used, and how many each.
    core, core_error, core_mean, core_mean_error : float
        Gaussian within 3 of its sigmas. For Gaussian rows the errors are good to 10 % from 100 rows on. If a tenth of
        the rows is three times as wide, this needs 200 rows; the core of 60 rows scatters 1.3 times its error, of 30
        rows 1.5 times.
    q68, q68_error : float
        Half the central interval that holds 68.27 % of the rows.
    rms, rms_error, mean, mean_error : float
        Standard deviation (about the mean) and mean of the rows within `window`.
    window : (float, float)
        Range of the rows in `rms` and `mean`; infinite for all rows.
    outside : int
        Rows outside `window`.
    tail, tail_error : float
        Fraction of rows more than 3 core sigmas from the core's mean; 0.0027 for a Gaussian.
    other_mass : int
        Rows used whose fit assumed the mass of another particle.
    electrons : int
        Rows used that are electrons or positrons with a density of their own (docs/methods/fit.md): the core is that of
        tracks without a visible loss, and tails are due to radiation.

    Examples
    --------
    >>> sample = np.random.default_rng(1).normal(0.0, 2.0, 10_000)
    >>> found = cg.study.measure(sample, unit="um")
    >>> round(found.core, 1), round(found.core_error, 2), round(found.tail, 3)
    (2.0, 0.02, 0.003)
    """

    parameter: str
    unit: str
    n: int
    removed: tuple[tuple[str, int], ...]
    core: float
    core_error: float
    core_mean: float
    core_mean_error: float
    q68: float
    q68_error: float
    rms: float
    rms_error: float
    mean: float
    mean_error: float
    window: tuple[float, float]
    outside: int
    tail: float
    tail_error: float
    other_mass: int = 0
    electrons: int = 0

    def cells(self) -> list[str]:
        """Return the printed values, in the order of `HEAD`."""
        pairs = [(self.core, self.core_error), (self.q68, self.q68_error), (self.rms, self.rms_error),
                 (self.core_mean, self.core_mean_error), (100 * self.tail, 100 * self.tail_error)]  # fmt: skip
        notes = [f"{self.other_mass} of another mass"] if self.other_mass else []
        notes += [f"{self.electrons} electrons, tails by radiation"] if self.electrons else []
        notes += [] if self.electrons or self.is_gaussian() else ["core not Gaussian"]
        rows = f"{self.n} ({'; '.join(notes)})" if notes else str(self.n)
        return [*(with_error(*pair) for pair in pairs), rows, self.removed_text()]

    def is_gaussian(self) -> bool:
        """Return whether core and q68 agree: within 10 % of the core, or 5 of their errors.

        They differ where the hits of tracks at one angle move together, as in strips without charge (docs/methods/
        resolutions.md): the core is then that of some rows, and q68 and RMS tell more.
        """
        off, error = abs(self.q68 - self.core), math.hypot(self.q68_error, self.core_error)
        return not (off > _ODD * self.core and off > 5 * error)

    def columns(self) -> dict[str, list[Any]]:
        """Return all numbers as columns of one row; `removed` as text, the window as two columns."""
        columns = {name: list(values) for name, values in super().columns().items() if name != "window"}
        window = dict(zip(("window_low", "window_high"), ([end] for end in self.window), strict=True))
        return columns | {"removed": [self.removed_text()]} | window

    def removed_text(self) -> str:
        """Return how many rows were removed and why."""
        return ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"

    def label(self) -> str:
        """Return the parameter with its unit."""
        return f"{self.parameter} [{self.unit}]" if self.unit else self.parameter

    def __repr__(self) -> str:
        values = ", ".join(f"{name} {cell}" for name, cell in zip(HEAD, self.cells(), strict=True))
        return f"<{self.label()}: {values}; rms {self._where()}>"

    def _repr_html_(self) -> str:
        return html_table(f"{self.label()}, rms {self._where()}", HEAD, [self.cells()])

    def _where(self) -> str:
        low, high = self.window
        return f"within {low:g} to {high:g}, {self.outside} rows outside" if self.outside else "of all rows"


#: What `Resolution.cells` holds.
HEAD = ("core", "q68", "rms", "bias", "tail %", "rows", "removed")


def measure(
    sample: npt.ArrayLike,
    *,
    parameter: str = "sample",
    unit: str = "",
    window: tuple[float, float] | None = None,
    removed: tuple[tuple[str, int], ...] = (),
    other_mass: int = 0,
    electrons: int = 0,
) -> Resolution:
    """Return the widths of a sample.

    Parameters
    ----------
    sample : (n,) array_like
        In `unit`.
    parameter, unit : str
        For print-outs.
    window : (low, high) or None
        Range of the RMS and the mean, in `unit`; None: all rows.
    removed : tuple of (str, int)
        Rows that were left out before, and why.
    other_mass : int
        Rows whose fit assumed the mass of another particle.
    electrons : int
        Rows of electrons with a density of their own.

    Raises
    ------
    ValueError
        If the sample is not a list of finite numbers, or the window is empty.

    Examples
    --------
    >>> sample = np.random.default_rng(1).normal(0.0, 2.0, 10_000)
    >>> found = cg.study.measure(sample, unit="um")
    >>> round(found.core, 1), round(found.q68, 1), round(found.rms, 1)
    (2.0, 2.0, 2.0)
    """
    x = np.sort(np.asarray(sample, np.float64), axis=None)
    if np.ndim(sample) != 1 or not np.isfinite(x).all():
        raise ValueError(f"{parameter}: expected a list of finite numbers, got shape {np.shape(sample)}")
    low, high = _window(window)
    first, last = np.searchsorted(x, [low, high], side="left")
    inside = x[first:last]
    rms, rms_error, mean, mean_error = moments(inside)
    core, core_error, core_mean, core_mean_error = _core(x)
    tail, tail_error = _tail(x, core, core_mean)
    q68, q68_error = _q68(x)
    return Resolution(
        parameter, unit, len(x), tuple(removed), core, core_error, core_mean, core_mean_error,
        q68, q68_error, rms, rms_error, mean, mean_error, (float(low), float(high)), len(x) - len(inside),
        tail, tail_error, other_mass, electrons,
    )  # fmt: skip


def core_sigma(sample: npt.ArrayLike) -> float:
    """Return the sigma of the Gaussian within 3 of its sigmas of a sample, (n,), alone; NaN for fewer than 10 rows."""
    return _core(np.sort(np.asarray(sample, np.float64)))[0]


def _window(raw: object) -> tuple[float, float]:
    """Return the ends of a window; infinite for None."""
    if raw is None:
        return -math.inf, math.inf
    ends = [number(end) for end in raw] if isinstance(raw, tuple | list | np.ndarray) and np.ndim(raw) else []
    if len(ends) != 2 or not ends[0] < ends[1]:
        raise ValueError(f"window: got {raw!r}; expected (low, high)")
    return ends[0], ends[1]


def moments(x: Floats) -> tuple[float, float, float, float]:
    """Return standard deviation, its error, mean, its error.

    The variance of a sample variance is (m4 - s^4 (n - 3)/(n - 1))/n with the fourth central moment m4
    (Kendall and Stuart, The Advanced Theory of Statistics, vol. 1, 10.15), for any shape.
    """
    n = len(x)
    if n < FEWEST:
        return math.nan, math.nan, math.nan, math.nan
    mean, variance = float(x.mean()), float(x.var(ddof=1))
    fourth = float(np.mean((x - mean) ** 4))
    spread = max(0.0, fourth - variance**2 * (n - 3) / (n - 1)) / n
    rms = math.sqrt(variance)
    return rms, math.sqrt(spread) / (2 * rms) if rms else 0.0, mean, rms / math.sqrt(n)


def _core(x: Floats) -> tuple[float, float, float, float]:
    """Return sigma, its error, mean, its error of the Gaussian within 3 of its sigmas, of a sorted sample.

    The likelihood equations of a Gaussian cut at both sides of a window equate mean and variance of the rows inside
    with those of the cut Gaussian. When the window is mean +- 3 sigma of the result itself, these are: mean = mean
    inside, sigma^2 = variance inside / <u^2>, with <u^2> of a normal variable cut at +-3. Repeating this changes the
    rows inside less and less until they stay the same.
    """
    if len(x) < FEWEST:
        return math.nan, math.nan, math.nan, math.nan
    centre = float(np.median(x))  # sums about it keep their digits
    shifted = x - centre
    first = np.concatenate(([0.0], np.cumsum(shifted)))
    second = np.concatenate(([0.0], np.cumsum(shifted**2)))
    mean, sigma, before = 0.0, _half_width(shifted), (-1, -1)
    for _ in range(1000):
        i = int(np.searchsorted(shifted, mean - _N_SIGMA * sigma, side="left"))
        j = int(np.searchsorted(shifted, mean + _N_SIGMA * sigma, side="right"))
        if (i, j) == before or j - i < 2:
            break
        before = (i, j)
        mean = float(first[j] - first[i]) / (j - i)
        variance = float(second[j] - second[i]) / (j - i) - mean**2
        sigma = math.sqrt(max(0.0, variance) / SECOND_INSIDE)
    if sigma == 0:
        return 0.0, 0.0, centre + mean, 0.0
    sigma_error, mean_error = _core_errors((shifted - mean) / sigma)
    return sigma, sigma * sigma_error, centre + mean, sigma * mean_error


def _core_errors(u: Floats) -> tuple[float, float]:
    """Return the errors of core sigma and mean, in core sigmas, of a sample in units of its core.

    Sigma and mean solve sum (u^2 - <u^2>) = 0 and sum u = 0 over the rows inside +-3. An estimate that solves
    sum psi = 0 has the variance n <psi^2> / (sum psi')^2 for any shape (Huber, Robust Statistics, 3.2); psi' holds the
    curvature of the likelihood and, since the window follows the result, the density at its edges. Terms that vanish
    for a symmetric shape are left out. For a Gaussian, n sigma_error^2 = 1/1.728 (1/2 without a window).
    """
    square = u[np.abs(u) <= _N_SIGMA] ** 2
    n, total = len(square), float(square.sum())
    half = 0.25  # of the range about an edge that gives the density there
    edge = float(np.count_nonzero(np.abs(np.abs(u) - _N_SIGMA) < half)) / (2 * half)
    # At least a tenth of the curvature is kept: noise in `edge` must not make a small sample's error infinite.
    slope_sigma = max(2 * total - _N_SIGMA * (_N_SIGMA**2 - SECOND_INSIDE) * edge, 0.2 * total)
    slope_mean = max(n - _N_SIGMA * edge, 0.1 * n)
    return math.sqrt(float(np.sum((square - SECOND_INSIDE) ** 2))) / slope_sigma, math.sqrt(total) / slope_mean


def _tail(x: Floats, core: float, mean: float) -> tuple[float, float]:
    """Return the fraction beyond 3 core sigmas and its binomial error."""
    n = len(x)
    if not math.isfinite(core):
        return math.nan, math.nan
    i = np.searchsorted(x, mean - _N_SIGMA * core, side="left")
    j = np.searchsorted(x, mean + _N_SIGMA * core, side="right")
    tail = 1 - int(j - i) / n
    return tail, share_error(tail, n)


def share_error(share: float, n: int) -> float:
    """Return the binomial error of a fraction of `n` rows: half of Wilson's 68 % interval, which is never 0."""
    return math.sqrt(share * (1 - share) / n + 0.25 / n**2) / (1 + 1 / n) if n else math.nan


def _half_width(x: Floats) -> float:
    low, high = np.quantile(x, [(1 - _CENTRAL) / 2, (1 + _CENTRAL) / 2])
    return float(high - low) / 2


def _q68(x: Floats) -> tuple[float, float]:
    """Return half the central 68.27 % interval and its error, of a sorted sample.

    Two quantiles a < b have covariance a (1 - b)/(n f(a) f(b)) with the density f there (David and Nagaraja, Order
    Statistics, 10.2). The density comes from the quantiles a little to each side.
    """
    n = len(x)
    if n < FEWEST:
        return math.nan, math.nan
    a, b = (1 - _CENTRAL) / 2, (1 + _CENTRAL) / 2
    step = min(0.05, n ** (-1 / 3))
    at_a, above_a, at_b, above_b = np.quantile(x, [a - step, a + step, b - step, b + step])
    one, other = (above_a - at_a) / (2 * step), (above_b - at_b) / (2 * step)  # 1/f
    variance = (a * (1 - a) * one**2 + b * (1 - b) * other**2 - 2 * a * (1 - b) * one * other) / (4 * n)
    return _half_width(x), math.sqrt(max(0.0, float(variance)))


#: Parts of a sample that a jackknife leaves out in turn.
GROUPS = 20


def without_groups(values: Floats, number: npt.NDArray[Any], statistic: Callable[[Floats], float]) -> Floats:
    """Return a statistic of a sample without each of `GROUPS` groups of its rows, (groups,) float64, for `jackknife`.

    Parameters
    ----------
    values : (n,) float64
    number : (n,) int
        Of each row, such as its event; rows with the same number modulo `GROUPS` are a group.
    statistic : callable
        Takes the rows that stay.
    """
    return np.array([statistic(values[number % GROUPS != left_out]) for left_out in range(GROUPS)])


def jackknife(replicas: npt.ArrayLike) -> Any:
    """Return the standard error of a statistic from its values without each group of rows.

    Of a difference or ratio of two samples of the same events, take the difference or ratio without each group: the
    correlation of the samples then counts. B. Efron, The Jackknife, the Bootstrap and Other Resampling Plans (1982),
    ch. 3.

    Parameters
    ----------
    replicas : (..., groups) array_like

    Returns
    -------
    float, or ndarray (...) float64
    """
    values = np.asarray(replicas, np.float64)
    groups = values.shape[-1]
    spread = np.sum((values - values.mean(axis=-1, keepdims=True)) ** 2, axis=-1)
    error = np.sqrt((groups - 1) / groups * spread)
    return float(error) if values.ndim == 1 else error


def stacked(tables: Sequence[dict[str, list[Any]]]) -> dict[str, list[Any]]:
    """Return tables of the same columns, one below the other."""
    return {name: [cell for table in tables for cell in table[name]] for name in tables[0]} if tables else {}


@dataclass(frozen=True, eq=False, repr=False)
class GaussianFit(Comparable, Tabular):
    """A Gaussian fitted to a sample: number of rows, mean and sigma with errors.

    Examples
    --------
    >>> found = cg.study.gaussian_fit(np.arange(100.0))
    >>> found.mean, round(found.sigma, 2), found.n
    (49.5, 28.87, 100)
    """

    n: int
    mean: float
    mean_error: float
    sigma: float
    sigma_error: float

    def __repr__(self) -> str:
        mean, sigma = with_error(self.mean, self.mean_error), with_error(self.sigma, self.sigma_error)
        return f"<Gaussian: mean {mean}, sigma {sigma}, {self.n} rows>"

    def _repr_html_(self) -> str:
        cells = [with_error(self.mean, self.mean_error), with_error(self.sigma, self.sigma_error), str(self.n)]
        return html_table("Gaussian", ("mean", "sigma", "rows"), [cells])


def gaussian_fit(sample: npt.ArrayLike) -> GaussianFit:
    """Fit a Gaussian to all rows of a sample by maximum likelihood, without a histogram.

    The maximum is at the sample's mean and standard deviation (divisor n); the error of sigma allows for a shape that
    is not Gaussian (fourth moment).

    Parameters
    ----------
    sample : (n,) array_like

    Raises
    ------
    ValueError
        If the sample is not a list of finite numbers.

    Examples
    --------
    >>> cg.study.gaussian_fit(np.random.default_rng(1).normal(0.0, 2.0, 10_000))
    <Gaussian: mean -0.022 ± 0.020, sigma 1.997 ± 0.014, 10000 rows>
    """
    x = np.asarray(sample, np.float64)
    if x.ndim != 1 or not np.isfinite(x).all():
        raise ValueError(f"sample: expected a list of finite numbers, got shape {x.shape}")
    rms, rms_error, mean, mean_error = moments(x)
    shrink = math.sqrt(1 - 1 / len(x)) if len(x) else 1.0
    return GaussianFit(len(x), mean, mean_error, rms * shrink, rms_error)


@dataclass(frozen=True)
class Fraction:
    """A number of successes among trials.

    Attributes
    ----------
    count, n : int
        Successes and trials.

    Examples
    --------
    >>> found = cg.study.Fraction(95, 100)
    >>> found.value, [round(end, 3) for end in found.interval()]
    (0.95, [0.923, 0.968])
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
