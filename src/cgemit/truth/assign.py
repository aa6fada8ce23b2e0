"""Which cluster a crossing made itself, and how far clusters are from their crossings (docs/methods/find.md)."""

from __future__ import annotations

import numpy as np

from cgemit.base.arrays import Floats, Rows
from cgemit.detector import Detector
from cgemit.detector.layers.layer import local_v
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_X

_OF_STRIPS = 0  # `method` of clusters whose position is that of their strips
_NEARER = 1e-6  # orders crossings inside several clusters


def own_clusters(detector: Detector, clusters: Table, truths: Table) -> Rows:
    """Return the one cluster of each crossing and view that the particle itself made.

    Delta electrons may fire strips away from the particle's own, and at a seam of the readout a crossing fires strips
    of two sheets. The cluster with the strip at the crossing's mid-gap point is selected, otherwise the nearest one.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
        Links of `clusters` count rows of `truths`.

    Returns
    -------
    ndarray, (n,) intp
        Increasing row numbers of X and V clusters; clusters without a truth are left out.
    """
    rows = np.flatnonzero((clusters["view"] <= HIT_V) & (clusters["truth"] >= 0))
    crossing = clusters["truth"].take(rows) * 2 + clusters["view"].take(rows)
    several = np.flatnonzero(np.bincount(crossing).take(crossing) > 1)
    order = several[np.lexsort((_distances(detector, clusters, truths, rows[several]), crossing[several]))]
    chosen = np.ones(len(rows), np.bool_)
    chosen[order[np.diff(crossing[order], prepend=-1) == 0]] = False  # all but the nearest of each crossing
    return rows[chosen]


def residuals(detector: Detector, clusters: Table, truths: Table, rows: Rows) -> Floats:
    """Return how far clusters are from the crossings they link to, at mid-gap.

    Parameters
    ----------
    detector : Detector
    clusters, truths : Table
    rows : ndarray, (n,) int
        X and V clusters that link to a truth.

    Returns
    -------
    ndarray, (n,) float64, mm
        X or V of the cluster minus that of the crossing's phi and z, at the nearest of all turns about the beam line.
    """
    layer, sheet, view = (clusters[name][rows] for name in ("layer", "sheet", "view"))
    truth = clusters["truth"][rows]
    residual = np.empty(len(rows))
    for layer_number, cgem in enumerate(detector.layers):
        for half_shell, start in enumerate(cgem.sheet_phi):
            for axis in (HIT_X, HIT_V):
                on_sheet = (layer == layer_number) & (sheet == half_shell) & (view == axis)
                phi, z = truths["phi"][truth[on_sheet]], truths["z"][truth[on_sheet]]
                x, turn = cgem.r_readout * (phi - start), 2 * np.pi * cgem.r_readout
                if axis == HIT_X:
                    difference = clusters["x"][rows[on_sheet]] - x
                else:  # a whole turn changes V by hundreds of mm: the nearest turn is the right one
                    difference = clusters["v"][rows[on_sheet]] - local_v(cgem, x, z)
                    turn *= np.cos(cgem.stereo)
                residual[on_sheet] = difference - turn * np.round(difference / turn)
    return residual


def _distances(detector: Detector, clusters: Table, truths: Table, rows: Rows) -> Floats:
    """How far crossings lie from the edge of their cluster (mm), 0 if inside."""
    first, size, layer, view = (clusters[name][rows] for name in ("first", "size", "layer", "view"))
    of_layer = np.array([layer.pitches for layer in detector.layers]).reshape(-1, 2)
    begins = np.array([(0.0, cgem.offset_v) for cgem in detector.layers]).reshape(-1, 2)
    pitch = of_layer[layer, view]
    position = np.where(view == HIT_X, clusters["x"][rows], clusters["v"][rows])
    # A position weighted by charge is not the middle of the strips; one of charge and time is corrected for the Lorentz
    # shift, which strips are not. Of two parts of such a cluster at the crossing, the nearer one counts.
    strips = clusters["method"][rows] == _OF_STRIPS
    shifts = [(cgem.lorentz_shift or 0.0) * np.array([1.0, np.cos(cgem.stereo)]) for cgem in detector.layers]
    shift = np.reshape(shifts, (-1, 2))[layer, view]
    middle = np.where(strips, (first + begins[layer, view] + 0.5 * size) * pitch - shift, position)
    beside = np.abs(residuals(detector, clusters, truths, rows) - (position - middle))
    return np.asarray(np.maximum(beside - 0.5 * size * pitch, np.where(strips, 0.0, _NEARER * beside)))
