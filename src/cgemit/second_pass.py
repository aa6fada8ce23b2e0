"""Second pass of the clusters: positions that use the angle of the track that has them (docs/methods/readout.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.cluster import ClusterSettings
from cgemit.detector import Detector
from cgemit.detector.strips import local_v
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

_STRIP_VIEWS = 2  # X and V in `candidate_hits`


def along_tracks(
    detector: Detector, readout: Any, digis: Table, clusters: Table, hits: Table, tracks: Table,
    settings: ClusterSettings,
) -> Table:  # fmt: skip
    """Return the same clusters, of which those on a good track have positions and errors for its angle.

    Parameters
    ----------
    detector : Detector
        That the fit assumes.
    readout : AnalogReadout
        With which the clusters were made.
    digis, clusters : Table
    hits : Table
        Of kind ``candidate_hits``, which were fitted.
    tracks : Table
    settings : ClusterSettings
    """
    directions = track_directions(detector, clusters, hits, tracks)
    return Table("clusters", readout.cluster_along(detector, digis, settings, directions).columns, **clusters.cover)


def track_directions(detector: Detector, clusters: Table, hits: Table, tracks: Table) -> Floats:
    """Return dX/dr or dV/dr at the anode, and the path per radius, of the track of each cluster, (clusters, 2) float64.

    They are NaN for clusters on no good track, or on a track that does not cross the whole gap.

    Parameters
    ----------
    detector : Detector
    clusters, hits, tracks : Table
        See `along_tracks`.
    """
    directions = np.full((len(clusters), 2), np.nan)
    good = np.full(int(hits["candidate"].max(initial=-1)) + 1, -1, np.int64)
    fitted = np.flatnonzero(tracks["status"] == 0)
    fitted = fitted[tracks["candidate"][fitted] < len(good)]  # others have no hits
    good[tracks["candidate"][fitted]] = fitted
    strips = np.flatnonzero(hits["view"] < _STRIP_VIEWS)
    track, row = good[hits["candidate"][strips]], hits["row"][strips]
    track, row = track[track >= 0], row[track >= 0]
    for number, layer in enumerate(detector.cgem):
        here = clusters["layer"][row] == number
        turn, path = gap_crossing(tracks, track[here], detector.field.bz, (layer.r_gap_in, layer.r_gap_out))
        dx, dz = layer.r_readout * turn, path * tracks["tanl"][track[here]]
        dv = local_v(layer, dx, layer.z_ref + dz)
        across = np.where(clusters["view"][row[here]] == 0, dx, dv)
        directions[row[here]] = np.column_stack([across, np.hypot(path, dz)]) / layer.drift_gap
    return directions


def gap_crossing(
    tracks: Table, rows: npt.NDArray[np.int64], bz: float, radii: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Return the azimuth (rad) and the transverse path (mm) between two radii, (n,) float64 each; NaN if not reached.

    On a circle of radius R about (dr + R)(cos phi0, sin phi0) a particle that flies outward is at radius r in the
    azimuth phi0 + acos[(r^2 + dr^2 + 2 R dr) / (2 r (dr + R))].

    Parameters
    ----------
    tracks : Table
    rows : (n,) int64
    bz : float
        T.
    radii : (float, float)
        mm.
    """
    dr, kappa = tracks["dr"][rows], tracks["kappa"][rows]
    circle = RADIUS_PER_KAPPA / (bz * kappa)
    with np.errstate(invalid="ignore"):
        inner, outer = (np.arccos((r**2 + dr**2 + 2 * circle * dr) / (2 * r * (dr + circle))) for r in radii)
    turn = outer - inner
    middle = 0.5 * (radii[0] + radii[1])
    return turn, np.hypot(radii[1] - radii[0], middle * turn)
