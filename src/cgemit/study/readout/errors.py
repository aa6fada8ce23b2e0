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
        errors[first - 1 : last] = core_width(
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
            widths = [core_width(sample.residual[here & (at == k)]) for k in numbers]
            values[view, layer] = np.interp(np.arange(ranges), numbers, widths)[:, None]
        for number, strips in np.ndindex(ranges, SLOPE_SIZES):
            mine = _in_cell(sample, at, size, (view, layer, number, strips))
            if np.count_nonzero(mine) >= FEWEST:
                values[view, layer, number, strips] = core_width(sample.residual[mine])
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
        width = core_width(pull[here])
        errors[cell] *= width
        pull[here] /= width


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


def core_width(residual: Floats) -> float:
    """Return the core width of residuals about 0, mm."""
    return float(measure(residual, parameter="position", unit="mm").core)
