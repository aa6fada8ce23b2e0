"""Clusters of strips with charge and time, and what they assume of gas and chip (docs/methods/readout.md)."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.detector.strip_maps import strip_gains, strip_lists
from cgemit.digitize.calibration import (
    CHARGES,
    DISTANCES,
    PATH_KNOTS,
    SIZES,
    SLOPE_EDGES,
    SLOPE_KNOTS,
    Calibration,
    Estimator,
)
from cgemit.digitize.transport import drift_columns
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

_SPEED_OF_LIGHT = 299.792458  # mm/ns


def find_clusters(
    detector: Detector,
    digis: Table,
    delays: Callable[[Floats], tuple[Floats, Floats]],
    *,
    calibration: Calibration,
    estimator: Estimator,
    lorentz: bool,
    missing: int,
    edge: float,
    valley: float,
    margin: float,
    bridge: int = 0,
    directions: Floats | None = None,
) -> Table:
    """Return the clusters of strips with charge and time.

    Parameters
    ----------
    detector : Detector
    digis : Table
    delays : callable
        Returns measured charge (fC, growing) and delay of the chip (ns), each (2 layers, n) float64, by layer and view,
        from the induction times of the layers, (layers,) float64 ns.
    calibration : Calibration
    estimator : str
    lorentz : bool
        Whether the Lorentz shift is corrected.
    missing : int
        Strips that may be missing within a cluster.
    edge : float
        Outermost strips with a smaller share of their neighbour's charge do not enter line fits.
    valley : float
        A strip with less than this share of the charge of both maxima beside it divides a cluster; 0: none does.
    margin : float
        ns; strips whose drift time is below 0 or above that of the drift gap by more than this are left out.
    bridge : int
        Dead and hot strips in a row that a cluster may bridge.
    directions : (clusters, 2) float64 or None
        Of the track, by row of the result: dX/dr of X clusters and dV/dr of V clusters at the anode, and its path per
        radius; NaN where no track tells.
    """
    drift = drift_columns(detector)
    flight = np.array([layer.r_mid for layer in detector.cgem]) / _SPEED_OF_LIGHT
    bend = 1.0 if lorentz else 0.0
    timing = {
        "velocity": drift["velocity"],
        "tan_lorentz": bend * drift["tan_lorentz"],
        "shift": bend * drift["shift"],
        "delay": drift["delay"] + flight,
    }
    return clusters_at(
        detector, digis, timing, delays(drift["induction"]),
        calibration=calibration, estimator=estimator, missing=missing, edge=edge, valley=valley,
        margin=margin, bridge=bridge, directions=directions,
    )  # fmt: skip


def clusters_at(
    detector: Detector,
    digis: Table,
    timing: dict[str, Floats],
    delays: tuple[Floats, Floats],
    *,
    calibration: Calibration,
    estimator: Estimator,
    missing: int,
    edge: float,
    valley: float,
    margin: float = math.inf,
    bridge: int = 0,
    directions: Floats | None = None,
) -> Table:
    """Return the clusters of strips for given drift and delays.

    Parameters
    ----------
    detector : Detector
    digis : Table
    timing : dict of str to ndarray, (layers,) float64
        velocity (mm/ns), tan_lorentz, shift (rad), delay (ns).
    delays : (ndarray, ndarray), (2 layers, n) float64
        Charge (fC) and delay (ns) of the chip by layer and view.
    calibration, estimator, missing, edge, valley, margin, bridge, directions
        See `find_clusters`.
    """
    tracks = np.empty((0, 2)) if directions is None else directions
    found = _core.find_charge_time_clusters(
        compiled(detector), dict(digis.columns), timing=timing, delay_charge=delays[0], delay=delays[1],
        errors=calibration.errors.reshape(-1, SIZES), shares=calibration.shares.reshape(-1, SIZES),
        depth=calibration.depth.reshape(-1, CHARGES),
        height=calibration.height.reshape(-1, CHARGES), edges=calibration.edges.reshape(-1, CHARGES - 1),
        estimator=estimator, missing=missing, edge=edge, masked=strip_lists(detector).masked, bridge=bridge,
        gain=strip_gains(detector), valley=valley, margin=margin, pairs=calibration.pairs.ravel(),
        slope_errors=calibration.slope_errors.ravel(), slope_shares=calibration.slope_shares.ravel(),
        slope_edges=SLOPE_EDGES, charge_factors=calibration.charge_factors.ravel(),
        distance_edges=calibration.distance_edges.reshape(-1, DISTANCES - 2),
        distance_factors=calibration.distance_factors.reshape(-1, DISTANCES),
        direction_slopes=SLOPE_KNOTS, direction_paths=PATH_KNOTS,
        direction_depths=calibration.direction_depths.ravel(), direction_factors=calibration.direction_factors.ravel(),
        slopes=tracks[:, 0], paths=tracks[:, 1],
    )  # fmt: skip
    # X and V of a crossing come from the same electrons.
    alone, tracked = (calibration.mean_correlation(estimator, of_track)[found["layer"]] for of_track in (False, True))
    along = np.zeros(len(alone), np.bool_)
    along[: len(tracks)] = np.isfinite(tracks[: len(along), 0])
    found["corr_xv"] = np.where(along, tracked, alone)
    return Table("clusters", found, **digis.cover)
