"""Corrections of hits by their tracks: drift times along wires, directions of clusters."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.detector.drift import LIGHT, Rows, _of_layers, propagation_time, shifted, velocity_at
from cgemit.detector.parts import local_v
from cgemit.detector.readouts import Readout
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.particles.species import HYPOTHESES
from cgemit.reconstruction.candidates import HIT_WIRE
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

_STRIP_VIEWS = 2  # X and V in `candidate_hits`


def along_tracks(
    detector: Detector, readout: Readout, digis: Table, clusters: Table, hits: Table, tracks: Table,
    settings: ClusterSettings,
) -> Table:  # fmt: skip
    """Return the same clusters, of which those on a good track have positions and errors for its angle.

    Parameters
    ----------
    detector : Detector
        That the fit assumes.
    readout : Readout
        With which the clusters were made; its clusterer follows tracks.
    digis, clusters : Table
    hits : Table
        Of kind ``candidate_hits``, which were fitted.
    tracks : Table
    settings : ClusterSettings
    """
    directions = track_directions(detector, clusters, hits, tracks)
    return cluster(detector, digis, settings, readout=readout, directions=directions)


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


"""Speed of light, mm/ns."""
_STEPS = 3  # radius of a stereo wire and z of the track depend on each other; the third step moves less than 1 ps


def expected(detector: Detector, wire_hits: Table) -> Table:
    """Return wire hits corrected for the delay at the middle of their wires, before any track is known.

    The flight is that of light from the origin straight to the wire at z = 0. Errors include the uniform spread of the
    propagation over the wire of length L, L/(v sqrt(12)) times the drift velocity.

    Parameters
    ----------
    detector : Detector
    wire_hits : Table
        With raw drift times.

    Raises
    ------
    ValueError
        If a hit has no drift time, a layer is not in the detector, or the detector does not say how signals run.
    """
    layer = wire_hits["layer"]
    radius, half_length, speed = _of_layers(detector, layer, "r_mid", "half_length", "signal_speed")
    found = _earlier(wire_hits, radius / LIGHT + propagation_time(detector, layer, 0.0))
    spread = 2 * half_length / (speed * np.sqrt(12)) * velocity_at(found["drift"])
    return found.with_columns(sigma=np.hypot(found["sigma"], spread))


def times_along_tracks(
    detector: Detector, wire_hits: Table, candidates: Table, candidate_hits: Table, tracks: Table
) -> Table:
    """Return wire hits corrected for the delay on their tracks; those on no good track as `expected`.

    The flight is the path from the perigee to the wire over beta c, with the mass of the fit; z at the wire gives the
    propagation. Of several mass hypotheses the first good one counts.

    Parameters
    ----------
    detector : Detector
    wire_hits : Table
        With raw drift times.
    candidates, candidate_hits : Table
    tracks : Table
        Fitted to them; only its helices are used, so that it may come from the hits `expected`.

    Raises
    ------
    ValueError
        As `expected`.
    """
    found = expected(detector, wire_hits)
    good = np.flatnonzero(tracks["status"] == 0)[::-1]  # of several rows the first is written last
    track_of = np.full(len(candidates), -1, np.int64)
    track_of[tracks["candidate"][good]] = good
    hits = candidate_hits[(candidate_hits["view"] == HIT_WIRE) & (track_of[candidate_hits["candidate"]] >= 0)]
    row, track = hits["row"], track_of[hits["candidate"]]
    delay = _delay_on_track(detector, candidates, tracks, track, wire_hits["layer"][row])
    exact = _earlier(wire_hits[row], delay)
    columns = {name: found[name].copy() for name in ("drift", "drift_time", "sigma")}
    for name, column in columns.items():
        column[row] = exact[name]
    return found.with_columns(**columns)


def _delay_on_track(detector: Detector, candidates: Table, tracks: Table, track: Rows, layer: Rows) -> Floats:
    """Return flight and propagation where tracks (rows) first cross wires of layers, (n,) float64, ns.

    From the perigee of a circle of radius R, distance d_rho, a track is at radius r after the angle psi with
    sin^2(psi/2) = (r^2 - d_rho^2)/(4 R (R + d_rho)); a track that does not reach r is taken at its apex.
    """
    radius, r_end, half_length = _of_layers(detector, layer, "r_mid", "r_end", "half_length")
    dr, kappa, dz, tanl = (tracks[name][track] for name in ("dr", "kappa", "dz", "tanl"))
    circle = RADIUS_PER_KAPPA / (detector.field.bz * kappa)
    z: Floats = np.zeros(len(track))
    for _ in range(_STEPS):
        r2 = radius**2 + (r_end**2 - radius**2) * np.minimum((z / half_length) ** 2, 1)
        sine2 = np.clip((r2 - dr**2) / (4 * circle * (circle + dr)), 0, 1)
        arc = 2 * np.abs(circle) * np.arcsin(np.sqrt(sine2))
        z = np.clip(dz + arc * tanl, -half_length, half_length)
    mass = _masses(candidates, tracks)[track]
    flight = arc * np.hypot(1, tanl) * np.hypot(1, mass / tracks["p"][track]) / LIGHT
    return np.asarray(flight + propagation_time(detector, layer, z), np.float64)


def _masses(candidates: Table, tracks: Table) -> Floats:
    """Return the mass that each track was fitted with, GeV/c2."""
    rows = tracks["candidate"]
    mass = candidates["mass"][rows].copy()
    for kind in HYPOTHESES.values():
        mass[(tracks["hypothesis"] == kind.pdg) & (candidates["pdg"][rows] != kind.pdg)] = kind.mass
    return np.asarray(mass, np.float64)


def _earlier(wire_hits: Table, delay: Floats) -> Table:
    """Return wire hits with drift times that are shorter by a delay, ns, and distances to match."""
    time = wire_hits["drift_time"]
    unknown = np.count_nonzero(~np.isfinite(time))
    if unknown:
        raise ValueError(f"wire_hits: {unknown} of {len(time)} have no drift_time, expected one for each")
    return wire_hits.with_columns(drift_time=time - delay, drift=shifted(wire_hits["drift"], time, -delay))
