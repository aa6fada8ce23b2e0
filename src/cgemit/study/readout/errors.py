"""Errors of clusters by what is known of them: widths of residuals and pulls in ranges of charge, size and slope."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.digitize.calibration import (
    CHARGES,
    DISTANCES,
    PATH_KNOTS,
    SIZES,
    SLOPE_EDGES,
    SLOPE_KNOTS,
    SLOPE_SIZES,
    Calibration,
)
from cgemit.statistics.estimate import measure
from cgemit.study.readout.measure import FEWEST, Measurements

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_CORE = 3.0  # errors, within which clusters count in correlations
_TAILS = 5.0  # errors, beyond which the fit drops hits
_FEWEST_SIZES = 100  # clusters of one charge that give a group of sizes an error of its own
_REFINED = 5  # times that the widths of pulls go into each of the factors


def set_errors(found: Calibration, which: int, sample: Measurements) -> None:
    """Set the errors of one estimator."""
    for view, layer, charge in np.ndindex(found.errors.shape[1:4]):
        own = select(sample, found, (view, layer, charge))
        if len(own.residual) >= FEWEST // 2:
            found.errors[which, view, layer, charge] = _errors(own)


def _errors(sample: Measurements) -> Floats:
    """Return the errors by number of strips, (SIZES,) mm."""
    errors = np.ones(SIZES)
    for first, last in groups(np.minimum(sample.size, SIZES)):
        errors[first - 1 : last] = _width(
            sample.residual[(sample.size >= first) & (np.minimum(sample.size, SIZES) <= last)]
        )
    return errors


def by_slope(sample: Measurements, found: Calibration) -> Floats:
    """Return the width of residuals by view, layer, range of the slope and size; of all sizes where these are few."""
    values = np.ones(found.slope_shares.shape)
    at, size = slope_cells(sample)
    layers, ranges = found.slope_shares.shape[1:3]
    for view, layer in np.ndindex(2, layers):
        here = (sample.view == view) & (sample.layer == layer)
        numbers = [k for k in range(ranges) if np.count_nonzero(here & (at == k)) >= FEWEST]
        if numbers:
            widths = [_width(sample.residual[here & (at == k)]) for k in numbers]
            values[view, layer] = np.interp(np.arange(ranges), numbers, widths)[:, None]
        for number, strips in np.ndindex(ranges, SLOPE_SIZES):
            mine = _in_cell(sample, at, size, (view, layer, number, strips))
            if np.count_nonzero(mine) >= FEWEST:
                values[view, layer, number, strips] = _width(sample.residual[mine])
    return values


def refine(
    found: Calibration, along: int, which: int, sample: Measurements, apart: Floats, direction: tuple[Floats, Floats]
) -> None:
    """Make pulls of unit width in every range of distance, charge, size, slope and path.

    The error is a product of factors; each takes the widths that the others leave, in turns. With the track's angle,
    slope and size have one together.
    """
    slopes = np.searchsorted(SLOPE_KNOTS, np.abs(direction[0]), side="right") - 1
    paths = np.searchsorted(PATH_KNOTS, direction[1], side="right") - 1
    slope, strips = slope_cells(sample)
    for view, layer in np.ndindex(found.errors.shape[1:3]):
        mine = np.flatnonzero((sample.view == view) & (sample.layer == layer))
        size = np.minimum(sample.size[mine], SIZES) - 1
        charge = np.searchsorted(found.edges[view, layer], sample.charge[mine], side="right")
        edges = found.distance_edges[along, view, layer]
        near = np.where(apart[mine] > 0, 1 + np.searchsorted(edges, apart[mine], side="right"), 0)
        by_slope, by_path = np.split(found.direction_factors[along, which, view, layer], [len(SLOPE_KNOTS)])
        factors = found.distance_factors[along, which, view, layer]
        by_charge = (found.charge_factors if along else found.errors)[which, view, layer]
        pull = sample.residual[mine] / by_charge[charge, size]
        if along:
            by_cell = found.slope_errors[which, view, layer]
            pull /= by_cell[slope[mine], strips[mine]]
        for _ in range(_REFINED):
            for number in range(DISTANCES if apart.any() else 0):
                _unit_width(pull, near == number, factors, (number,))
            for number in range(CHARGES):
                for first, last in groups(size[charge == number] + 1):
                    here = (charge == number) & (size >= first - 1) & (size < last)
                    _unit_width(pull, here, by_charge, (number, slice(first - 1, last)))
            for first, last in groups(size + 1):  # sizes that are few at each charge
                _unit_width(pull, (size >= first - 1) & (size < last), by_charge, (slice(None), slice(first - 1, last)))
            if along:
                for cell in np.ndindex(*by_cell.shape):
                    _unit_width(pull, (slope[mine] == cell[0]) & (strips[mine] == cell[1]), by_cell, cell)
            else:
                for number in range(len(SLOPE_KNOTS)):
                    _unit_width(pull, slopes[mine] == number, by_slope, (number,))
            for number in range(len(PATH_KNOTS)):
                _unit_width(pull, paths[mine] == number, by_path, (number,))


def _unit_width(pull: Floats, here: npt.NDArray[np.bool_], errors: Floats, cell: tuple[int | slice, ...]) -> None:
    """Multiply the errors of a cell with the width of its pulls, which then is 1; of few clusters nothing changes."""
    if np.count_nonzero(here) >= _FEWEST_SIZES:
        width = _width(pull[here])
        errors[cell] *= width
        pull[here] /= width


def set_typical(found: Calibration, along: int, which: int, sample: Measurements, event: Ints, radii: Floats) -> None:
    """Set the errors, equal for all clusters of a view and layer, with which tracks are as precise as with these.

    They are the core widths of the residuals, times a factor: a straight line is fitted to the clusters of each track
    with their own errors. The core of its intercepts at the beam line over that for equal Gaussian errors is the
    factor. It holds what a fit gains from errors that differ, and loses by the tails of several clusters together.

    Parameters
    ----------
    found : Calibration
        Changed.
    along, which : int
    sample : Measurements
    event : (n,) int64
        Of each cluster.
    radii : (layers,) float64, mm
    """
    for view in range(2):
        widths = found.typical_errors[along, which, view]
        residual = np.zeros((int(event.max(initial=0)) + 1, len(radii)))
        weight = np.zeros(residual.shape)
        for layer in range(len(radii)):
            mine = (sample.view == view) & (sample.layer == layer)
            if np.count_nonzero(mine) >= FEWEST:
                widths[layer] = _width(sample.residual[mine])
            mine &= np.abs(sample.residual) < _TAILS * sample.error
            residual[event[mine], layer] = sample.residual[mine]
            weight[event[mine], layer] = sample.error[mine] ** -2
        whole = (weight > 0).all(axis=1)
        if len(radii) > 1 and np.count_nonzero(whole) >= FEWEST:
            intercepts = (_at_beam_line(weight[whole], radii) * residual[whole]).sum(axis=1)
            equal = _at_beam_line(widths[None] ** -2, radii)[0]
            widths *= _width(intercepts) / float(np.sqrt(np.sum((equal * widths) ** 2)))


def _at_beam_line(weight: Floats, radii: Floats) -> Floats:
    """Return what each layer adds to the intercept at radius 0 of a straight line, (tracks, layers) float64."""
    s, x, xx = ((weight * radii**power).sum(axis=1, keepdims=True) for power in range(3))
    return np.asarray(weight * (xx - x * radii) / (s * xx - x * x))


def set_correlations(found: Calibration, along: int, which: int, sample: Measurements) -> None:
    """Set the correlations of the errors of X and V of one crossing, those beyond three errors left out."""
    pull = sample.residual / sample.error
    for layer in range(found.correlations.shape[2]):
        here = (sample.layer == layer) & (np.abs(pull) < _CORE)
        x, v = (np.flatnonzero(here & (sample.view == view)) for view in (0, 1))
        _, of_x, of_v = np.intersect1d(sample.truth[x], sample.truth[v], return_indices=True)
        if len(of_x) >= FEWEST:
            found.correlations[along, which, layer] = np.corrcoef(pull[x[of_x]], pull[v[of_v]])[0, 1]


def select(sample: Measurements, calibration: Calibration, at: tuple[int, ...]) -> Measurements:
    """Return the clusters of one view, layer and range of the charge."""
    view, layer, charge = at
    edges = calibration.edges[view, layer]
    here = (sample.view == view) & (sample.layer == layer)
    here &= np.searchsorted(edges, sample.charge, side="right") == charge
    return Measurements(*(values[here] for values in sample))


def slope_cells(sample: Measurements) -> tuple[Ints, Ints]:
    """Return range of the slope and size, less 1, of each cluster as indices."""
    at = np.searchsorted(SLOPE_EDGES, np.abs(sample.slope), side="right")
    return at, np.minimum(sample.size, SLOPE_SIZES) - 1


def _in_cell(sample: Measurements, at: Ints, size: Ints, cell: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    view, layer, number, strips = cell
    return np.asarray((sample.view == view) & (sample.layer == layer) & (at == number) & (size == strips))


def groups(size: Ints) -> list[tuple[int, int]]:
    """Return ranges of sizes that cover all, each with enough clusters."""
    groups, first = [], 1
    for last in range(1, SIZES + 1):
        if np.count_nonzero((size >= first) & (size <= last)) >= _FEWEST_SIZES:
            groups.append((first, last))
            first = last + 1
    if groups and first <= SIZES:  # what is left joins the last group
        groups[-1] = (groups[-1][0], SIZES)
    return groups or [(1, SIZES)]


def _width(residual: Floats) -> float:
    """Return the core width of residuals about 0, mm."""
    return float(measure(residual, parameter="position", unit="mm").core)
