"""How tests decide whether a number agrees with what is expected of it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def assert_within(
    value: npt.ArrayLike, expected: npt.ArrayLike, error: npt.ArrayLike, n_sigma: float = 4.0, what: str = ""
) -> None:
    """Fail if a value is more than `n_sigma` standard errors from what is expected.

    Four standard errors of a Gaussian estimate are exceeded by chance once in 16 000 comparisons; seeds are fixed,
    so that a test passes always or never.

    Parameters
    ----------
    value, expected, error : array_like
        Numbers or arrays of one shape; errors are standard errors and must be positive.
    n_sigma : float
    what : str
        What is compared, for the message.
    """
    value, expected, error = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (value, expected, error)))
    assert np.all(np.isfinite(error) & (error > 0)), f"{what}: a standard error is not positive: {error}"
    distance = np.atleast_1d(np.abs(value - expected) / error)
    worst = int(np.argmax(np.where(np.isnan(distance), np.inf, distance)))
    assert np.all(distance <= n_sigma), (
        f"{what or 'value'}: {np.atleast_1d(value)[worst]:.6g} is {distance[worst]:.2f} standard errors"
        f" ({np.atleast_1d(error)[worst]:.3g}) from {np.atleast_1d(expected)[worst]:.6g}; allowed {n_sigma}"
    )


def mean_error(sample: npt.ArrayLike) -> float:
    """Return the standard error of a sample's mean."""
    sample = np.asarray(sample, np.float64)
    return float(np.std(sample, ddof=1) / np.sqrt(sample.size))


def fraction_error(fraction: float, number: int) -> float:
    """Return the binomial standard error of a fraction of `number` trials, never 0."""
    inside = min(max(fraction, 0.5 / number), 1 - 0.5 / number)
    return float(np.sqrt(inside * (1 - inside) / number))
