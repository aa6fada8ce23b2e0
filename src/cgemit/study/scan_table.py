"""The tidy table of resolution scans, with the columns of the table of a sweep, and paired differences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit.fit import FitStatus
from cgemit.statistics.estimate import core_sigma
from cgemit.statistics.formatting import Tabular, html_table, text_table, with_error
from cgemit.study.quantities import QUANTITIES, column, median_error, sample_of, width
from cgemit.study.samples import Order, Sample, angle_of, decayed, fitted, momentum_name, momentum_of
from cgemit.study.sweeps.evaluate import GROUPS, error_of_difference

Columns = dict[str, list[Any]]


def leading_columns(orders: Sequence[Order], method: str) -> Columns:
    """Return the columns that say what a row is about: detector, particle, method, momentum and angle."""
    columns: Columns = {
        "name": [order.detector.name for order in orders],
        "hash": [order.detector.content_hash for order in orders],
        "particle": [str(order.gun.particle) for order in orders],
        "method": [method] * len(orders),
        f"{momentum_name(orders[0])} (GeV/c)": [momentum_of(order) for order in orders],
    }
    name = angle_of(orders[0])[0]
    return columns | {"theta (rad)" if name == "theta" else name: [angle_of(order)[1] for order in orders]}


def scan_columns(samples: Sequence[Sample]) -> Columns:
    """Return the widths of all quantities for each momentum.

    `sigma` is the core width, as in sweeps; `median_error` the median of the fit's own errors.
    """
    columns = leading_columns(samples, "mc") | {"events": [s.n_events for s in samples]}
    for name in QUANTITIES:
        widths = [width(s.tracks, name) for s in samples]
        for kind, what in (("sigma", "core"), ("q68", "q68"), ("rms", "rms")):
            columns[column(kind, name)] = [getattr(w, what) for w in widths]
            columns[column(kind, name, "_error")] = [getattr(w, f"{what}_error") for w in widths]
        columns[f"tail_{name}"] = [w.tail for w in widths]
        columns[column("median_error", name)] = [median_error(s.tracks, name) for s in samples]
    columns["decayed"] = [decayed(s) for s in samples]
    columns["fitted"] = [fitted(s) for s in samples]
    columns["not fitted"] = [counts_text(s.removed) for s in samples]
    return columns


def counts_text(counts: Mapping[str, int]) -> str:
    """Return counts by name as text."""
    return "; ".join(f"{number} {name}" for name, number in counts.items()) or "none"


def difference(sample: Sample, base: Sample, quantity: str) -> tuple[float, float]:
    """Return how much wider the core of a quantity is than in another sample of the same events, with its paired error.

    The error follows from leaving out one of 20 groups of events in turn (jackknife), so that the correlation of both
    samples counts.

    Parameters
    ----------
    sample, base : Sample
        Of the same gun and seed.
    quantity : str
        Of `QUANTITIES`.
    """
    widths, replicas = [], []
    for one in (sample, base):
        residuals = sample_of(one.tracks, quantity)
        known = np.isfinite(residuals)  # tracks of no particle have no residual
        group = one.tracks["event"][one.tracks["status"] == FitStatus.ok][known] % GROUPS
        residuals = residuals[known]
        widths.append(width(one.tracks, quantity).core)
        replicas.append([core_sigma(residuals[group != left_out]) for left_out in range(GROUPS)])
    return widths[0] - widths[1], error_of_difference(*replicas)


def median_difference(sample: Sample, base: Sample, quantity: str) -> tuple[float, float]:
    """Return how much larger the median of the fit's own errors is, with its paired error, as in `difference`."""
    medians = [median_error(one.tracks, quantity) for one in (sample, base)]
    replicas = [[_median_without(one, quantity, left_out) for left_out in range(GROUPS)] for one in (sample, base)]
    return medians[0] - medians[1], error_of_difference(*replicas)


def _median_without(sample: Sample, quantity: str, left_out: int) -> float:
    kept = sample.tracks["event"] % GROUPS != left_out
    good = {name: sample.tracks[name][kept] for name in ("status", "kappa", "tanl", "p", *_ERRORS)}
    return median_error(good, quantity)  # type: ignore[arg-type]


_ERRORS = ("err_dr", "err_phi0", "err_kappa", "err_dz", "err_tanl", "err_p")


def difference_columns(samples: Sequence[Sample], bases: Sequence[Sample]) -> Columns:
    """Return the columns of the differences to other samples of the same events."""
    columns: Columns = {}
    for name in QUANTITIES:
        for kind, compare in (("delta_sigma", difference), ("delta_median_error", median_difference)):
            pairs = [compare(*pair, name) for pair in zip(samples, bases, strict=True)]
            columns[column(kind, name)] = [value for value, _ in pairs]
            columns[column(kind, name, "_error")] = [error for _, error in pairs]
    return columns


@dataclass(frozen=True, eq=False, repr=False)
class Differences(Tabular):
    """Differences of resolutions of two detectors that saw the same particles.

    Attributes
    ----------
    samples, bases : tuple of Sample
        Of the detector, and of the one that is subtracted.
    """

    samples: tuple[Sample, ...]
    bases: tuple[Sample, ...]

    def columns(self) -> Columns:
        """Return momenta, angles, and the differences of all quantities with their paired errors."""
        return leading_columns(self.samples, "mc") | difference_columns(self.samples, self.bases)

    def __repr__(self) -> str:
        return text_table(*differences_table(self.samples, self.bases))

    def _repr_html_(self) -> str:
        return html_table(*differences_table(self.samples, self.bases))


def differences(samples: Sequence[Sample], bases: Sequence[Sample]) -> Differences:
    """Return the differences to other samples of the same events.

    Raises
    ------
    ValueError
        If guns, events or seeds differ.
    """
    shots = [[(one.gun, one.n_events, one.seed) for one in group] for group in (samples, bases)]
    if shots[0] != shots[1]:
        raise ValueError("difference of scans: got different particles, expected equal guns, events and seeds")
    return Differences(tuple(samples), tuple(bases))


def differences_table(
    samples: Sequence[Sample], bases: Sequence[Sample], names: Sequence[str] = ("dr", "dz", "p")
) -> tuple[str, list[str], list[list[str]]]:
    """Return title, head and rows of the differences of some quantities to other samples of the same events."""
    first, base = samples[0], bases[0]
    title = (
        f"{first.detector.name} minus {base.detector.name}, {first.gun.particle}: differences of core widths (sigma) "
        "and of medians of the fit's errors, with paired errors"
    )
    head = [f"{momentum_name(first)} [GeV/c]"]
    head += [f"{what} {name} [{QUANTITIES[name][0]}]" for name in names for what in ("sigma", "median error")]
    rows = [
        [f"{momentum_of(pair[0]):g}"]
        + [signed(*compare(*pair, name)) for name in names for compare in (difference, median_difference)]
        for pair in zip(samples, bases, strict=True)
    ]
    return title, head, rows


def signed(value: float, error: float) -> str:
    """Return a difference with its sign and error."""
    text = with_error(value, error)
    return f"+{text}" if math.isfinite(value) and value > 0 else text


def shot_text(order: Order) -> str:
    """Return particle and angle of the tracks as text."""
    return f"{order.gun.particle}, {angle_text(order)}"


def angle_text(order: Order) -> str:
    """Return the angle of the tracks as text."""
    name, value = angle_of(order)
    text = f"{value:g}" if isinstance(value, float) else str(value).replace(":", " to ")
    unit = " rad" if name == "theta" else ""
    return f"{'θ' if name == 'theta' else 'cos θ'} = {text}{unit}"
