"""Flight and propagation in the drift times of wires: simulated, expected, and corrected (docs/methods/digitize.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.candidates import HIT_WIRE
from cgemit.detector import Detector
from cgemit.drift_times import shifted, velocity_at
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.species import HYPOTHESES
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]
Rows = npt.NDArray[np.integer[Any]]

LIGHT = 299.792458
"""Speed of light, mm/ns."""
_STEPS = 3  # radius of a stereo wire and z of the track depend on each other; the third step moves less than 1 ps


def check_wire_times(detector: Detector) -> None:
    """Raise an error if a detector does not say how signals run along its wires.

    Parameters
    ----------
    detector : Detector

    Raises
    ------
    ValueError
        Naming the missing keys of the detector file and their layers.
    """
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    missing = {
        "signal_speed": [str(layer.number) for layer in layers if layer.signal_speed == 0],
        "readout_end": [str(layer.number) for layer in layers if np.isnan(layer.z_readout)],
    }
    texts = [
        f"drift_chamber.{key} (layers {', '.join(numbers[:3])}{f' and {more} more' if more > 0 else ''})"
        for key, numbers in missing.items()
        if (more := len(numbers) - 3) > -3
    ]
    if texts:
        raise ValueError(
            f"wire_times: got 'raw' and {detector.name} without {' and '.join(texts)}, expected both for every layer"
        )


def propagation_time(detector: Detector, layer: Rows, z: Floats | float) -> Floats:
    """Return the time of signals from a place on the wire to the end that is read out, |z - z_end|/v, (n,) float64, ns.

    Parameters
    ----------
    detector : Detector
    layer : ndarray, (n,) int
        Layers as the experiment numbers them.
    z : float or ndarray, (n,) float64, mm

    Raises
    ------
    ValueError
        If the detector has no such layer, or does not say how signals run along its wires.
    """
    end, speed = _of_layers(detector, layer, "z_readout", "signal_speed")
    return np.asarray(np.abs(z - end) / speed, np.float64)


def true_delay(detector: Detector, wire_truths: Table) -> Floats:
    """Return flight and propagation of crossings of cells, (n,) float64, ns.

    Parameters
    ----------
    detector : Detector
    wire_truths : Table
    """
    delay = wire_truths["time"] + propagation_time(detector, wire_truths["layer"], wire_truths["z"])
    return np.asarray(delay, np.float64)


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


def along_tracks(
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


def _of_layers(detector: Detector, layer: Rows, *names: str) -> tuple[Floats, ...]:
    """Return values of the wire layers with these numbers, (n,) float64 each."""
    check_wire_times(detector)
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    numbers = np.array([one.number for one in layers], np.int64)
    wrong = np.setdiff1d(layer, numbers)
    if len(wrong):
        raise ValueError(f"wire_hits: the detector has no wire layer {wrong[0]}")
    place = np.searchsorted(numbers, layer)
    return tuple(np.array([getattr(one, name) for one in layers], np.float64)[place] for name in names)
