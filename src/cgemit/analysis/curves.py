"""Curves and histograms as data, for figures, CSV tables and `summary.json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.analysis.quantities import quantity_of
from cgemit.analysis.resolutions import resolution
from cgemit.analysis.widths import FEWEST, GaussianFit, Resolution
from cgemit.base.arrays import Floats, Ints
from cgemit.tables import Table
from cgemit.tables.show import shown, with_error

#: Core widths to each side within which figures and reports take the RMS; values outside are counted.
WINDOW = 5.0

_INSIDE_3 = 0.9973002  # of a Gaussian within 3 sigma


@dataclass(frozen=True, eq=False)
class Line:
    """A quantity against another for one detector.

    Attributes
    ----------
    id, detector : str
    x, y, y_error : (n,) float64
        In `x_unit`, `y_unit`; the error is statistical.
    x_unit, y_unit : str
    method : str
        ``"mc"`` (simulated events), ``"analytic"`` (a line without points), or empty.
    particle : str
        Whose, or empty.
    """

    id: str
    detector: str
    x: npt.NDArray[np.float64]
    x_unit: str
    y: npt.NDArray[np.float64]
    y_error: npt.NDArray[np.float64]
    y_unit: str
    method: str = ""
    particle: str = ""

    def __eq__(self, other: object) -> bool:
        """Compare all values; NaN equals NaN."""
        return isinstance(other, Line) and self.as_json() == other.as_json()

    def __hash__(self) -> int:
        return hash((self.id, self.detector))

    def as_json(self) -> dict[str, Any]:
        """Return the line as `summary.json` has it."""
        return {
            "id": self.id, "detector": self.detector, "x": _numbers(self.x), "x_unit": self.x_unit,
            "y": _numbers(self.y), "y_error": _numbers(self.y_error), "y_unit": self.y_unit,
        } | {name: text for name in ("method", "particle") if (text := getattr(self, name))}  # fmt: skip


@dataclass(frozen=True)
class Spectrum:
    """A histogram and the statistics of the values in it.

    Attributes
    ----------
    label, unit : str
    edges : (bins + 1,) float64
        In `unit`.
    counts : mapping of str to (bins,) int64
        ``"all"`` and parts of it; values outside `edges` are not in it.
    resolution : Resolution
        Of all values, in `unit`.
    fit : GaussianFit or None
        Gaussian of all values, shown instead of the core.
    gaussian : bool
        Whether the core is a Gaussian, so that its width describes the shape.
    reach : str
        What the window of `resolution` is called.
    extra : tuple of str
        Further lines of statistics.
    """

    label: str
    unit: str
    edges: Floats
    counts: Mapping[str, Ints]
    resolution: Resolution
    fit: GaussianFit | None = None
    reach: str = f"{WINDOW:g} core widths"
    extra: tuple[str, ...] = ()
    gaussian: bool = True

    def fit_curve(self, points: int = 200) -> tuple[Floats, Floats]:
        """Return the fitted Gaussian as (x in `unit`, entries a bin), over three widths to each side."""
        r, width = self.resolution, self.edges[1] - self.edges[0]
        u = np.linspace(-3, 3, points)
        density = np.exp(-0.5 * u**2) / np.sqrt(2 * np.pi)
        if self.fit:
            return self.fit.mean + self.fit.sigma * u, self.fit.n * width / self.fit.sigma * density
        inside = r.n * (1 - r.tail) / _INSIDE_3
        return r.core_mean + r.core * u, inside * width / r.core * density

    def statistics(self) -> list[str]:
        """Return the lines of statistics that figures show: widths first, then mean and numbers of values."""
        r = self.resolution
        lines = [self._line("Gaussian fit", self.fit.sigma, self.fit.sigma_error)] if self.fit else []
        lines += [self._line("core", r.core, r.core_error)] if self.gaussian and not self.fit else []
        lines += [
            self._line("q68", r.q68, r.q68_error),
            self._line(f"RMS ({self.reach})" if r.outside else "RMS", r.rms, r.rms_error),
            f"n = {r.n:,}",
        ]
        if self.gaussian and not self.fit:
            lines += [self._line("mean", r.core_mean, r.core_mean_error), f"beyond 3 core widths: {100 * r.tail:.2f} %"]
        left_out = sum(number for _, number in r.removed)
        counts = ((left_out, "left out"), (r.outside, f"beyond {self.reach}"))
        return [*lines, *(f"{name}: {number:,}" for number, name in counts if number), *self.extra]

    def _line(self, name: str, value: float, error: float) -> str:
        return f"{name}: {with_error(value, error)} {shown(self.unit)}"

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of the CSV table."""
        limits = {f"low ({self.unit})": self.edges[:-1].tolist(), f"high ({self.unit})": self.edges[1:].tolist()}
        return limits | {name: counts.tolist() for name, counts in self.counts.items()}


def windowed_resolution(tracks: Table, parameter: str) -> Resolution:
    """Return the widths of a track parameter with the RMS within `WINDOW` core widths of the core's mean.

    A few tracks far out would otherwise dominate the RMS; they are counted in `outside`.
    """
    widths = resolution(tracks, parameter)
    if not widths.core > 0:
        return widths
    reach = WINDOW * widths.core
    return resolution(tracks, parameter, window=(widths.core_mean - reach, widths.core_mean + reach))


def track_spectrum(tracks: Table, parameter: str, bins: int = 80) -> Spectrum:
    """Return the histogram of fitted minus true values of a track parameter, five core widths to each side.

    Raises
    ------
    ValueError
        If the parameter is unknown, or fewer than ten tracks were fitted.
    """
    widths = windowed_resolution(tracks, parameter)
    if not widths.core > 0:
        raise ValueError(f"tracks: {widths.n} fitted of {len(tracks)}; expected at least {FEWEST} for a resolution")
    known = quantity_of(parameter)
    values = known.residual(tracks)[known.counts(tracks)]
    edges = round_edges(*widths.window, bins)
    counts = histograms({"all": values}, edges)
    return Spectrum(f"{known.symbol}: fitted − true", known.unit, edges, counts, widths)


def round_edges(low: float, high: float, bins: int) -> Floats:
    """Return edges of about so many bins that cover a range; their width is 1, 2, 2.5 or 5 times a power of ten."""
    raw = (high - low) / bins
    power = 10.0 ** np.floor(np.log10(raw))
    width = power * min((1.0, 2.0, 2.5, 5.0, 10.0), key=lambda step: abs(np.log(step * power / raw)))
    first, last = np.floor(low / width + 1e-9), np.ceil(high / width - 1e-9)
    return np.asarray(width * np.arange(first, last + 1))


def histograms(parts: Mapping[str, Floats], edges: Floats) -> dict[str, Ints]:
    """Return the entries of each part in the bins."""
    return {name: np.histogram(values, edges)[0].astype(np.int64) for name, values in parts.items()}


def _numbers(values: npt.NDArray[np.float64]) -> list[float | None]:
    """Return numbers that JSON can hold: what is not finite becomes null."""
    return [float(value) if np.isfinite(value) else None for value in values]
