"""Quantiles of angles and losses, with their statistical errors."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Width(NamedTuple):
    """Half width that holds a fraction of the angles, in units of what it is for a Gaussian of width 1."""

    inside: float
    gaussian: float
    label: str


#: Widths of the plane angle by name.
ANGLES = {
    "q68": Width(math.erf(1 / math.sqrt(2)), 1.0, "q68, half of the central 68.27 %"),
    "q98": Width(0.98, 2.326, "q98, of 98 % / 2.326"),
    "q999": Width(0.999, 3.291, "q999, of 99.9 % / 3.291"),
}
#: Numbers of the loss by name, with their labels.
LOSSES = {
    "mean": "mean",
    "mode": "most probable",
    "fwhm": "full width at half maximum",
    "q01": "1 % quantile",
    "q16": "16 % quantile",
    "q50": "median",
    "q84": "84 % quantile",
    "q99": "99 % quantile",
}
_QUANTILES = {"q01": 0.01, "q16": 0.16, "q50": 0.5, "q84": 0.84, "q99": 0.99}
_FEWEST = 5  # entries beyond a quantile, for it to be quoted
_PARTS = 16  # subsamples whose spread is the error of mode and width at half maximum
_KERNEL = 0.03  # width of the smoothing over the central 68 %: widens a Landau distribution by 1 %

#: Value and standard error; None where the sample does not tell.
Estimate = tuple[float | None, float | None]


def angle_estimates(angle_1: Floats, angle_2: Floats) -> dict[str, Estimate]:
    """Return the widths of `ANGLES` of the angles of both planes, (n,) float64 each, in their unit.

    The two angles of a particle are not independent in the tails; the error counts how many of the two are inside.
    """
    pairs = np.abs(np.stack([angle_1, angle_2]))
    ordered = np.sort(pairs, axis=None)
    found: dict[str, Estimate] = {}
    for name, width in ANGLES.items():
        if (1 - width.inside) * ordered.size < _FEWEST:
            found[name] = None, None
            continue
        edge = float(np.quantile(ordered, width.inside))
        spread = float(np.std(np.mean(pairs <= edge, axis=0))) / math.sqrt(len(angle_1))
        found[name] = edge / width.gaussian, _quantile_error(ordered, width.inside, spread) / width.gaussian
    return found


def loss_estimates(loss: Floats) -> dict[str, Estimate]:
    """Return the numbers of `LOSSES` of a sample, (n,) float64, in its unit."""
    ordered = np.sort(loss)
    root = math.sqrt(len(loss))
    found: dict[str, Estimate] = {"mean": (float(np.mean(loss)), float(np.std(loss, ddof=1)) / root)}
    for name, fraction in _QUANTILES.items():
        spread = math.sqrt(fraction * (1 - fraction)) / root
        found[name] = float(np.quantile(ordered, fraction)), _quantile_error(ordered, fraction, spread)
    found |= _peak(loss, *(float(np.quantile(ordered, f)) for f in (0.16, 0.84)))
    return found


def _quantile_error(ordered: Floats, fraction: float, spread: float) -> float:
    """Return the standard error of a quantile from that of the fraction below it."""
    low, high = np.quantile(ordered, np.clip([fraction - spread, fraction + spread], 0, 1))
    return float(high - low) / 2


def _peak(loss: Floats, q16: float, q84: float) -> dict[str, Estimate]:
    """Return mode and full width at half maximum of the smoothed distribution, with errors from subsamples."""
    whole = _shape(loss, q16, q84)
    parts = [_shape(loss[i::_PARTS], q16, q84) for i in range(_PARTS)]
    if whole is None or None in parts:
        return {"mode": (None, None), "fwhm": (None, None)}
    errors = np.std([part for part in parts if part], axis=0, ddof=1) / math.sqrt(_PARTS)
    return {name: (whole[i], float(errors[i])) for i, name in enumerate(("mode", "fwhm"))}


def _shape(loss: Floats, q16: float, q84: float) -> tuple[float, float] | None:
    """Return mode and full width at half maximum; None if the distribution has not fallen to half at 0 or far out."""
    step = 0.2 * _KERNEL * (q84 - q16)
    if not step > 0:
        return None
    edges = np.arange(max(0.0, q16 - 2 * (q84 - q16)), q84 + 2 * (q84 - q16), step)
    counts = np.histogram(loss, edges)[0].astype(np.float64)
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / 5) ** 2)
    density = np.convolve(counts, kernel / kernel.sum(), mode="same")
    x = 0.5 * (edges[1:] + edges[:-1])
    above = np.flatnonzero(density >= 0.5 * density.max())
    if above[0] == 0 or above[-1] == len(x) - 1:
        return None
    # The top is flat: its position is the maximum of a curve of fourth order through the logarithm of the upper third.
    top = np.flatnonzero(density > 0.67 * density.max())
    if len(top) < 10:
        return None
    curve = np.polynomial.Polynomial.fit(x[top], np.log(density[top]), 4)
    fine = np.linspace(x[top[0]], x[top[-1]], 1001)
    return float(fine[np.argmax(curve(fine))]), float(x[above[-1]] - x[above[0]])
