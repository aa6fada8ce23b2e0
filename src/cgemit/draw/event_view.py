"""What an event display shows, as numbers: the rows of one event, ghosts, tracks as curves, strips on the anode."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cgemit.detector.strips import crossing_z, v_of_strips
from cgemit.draw.geometry import Array, helix_points, smooth_curve, wire_layers, wire_positions
from cgemit.fit import FitStatus, fit
from cgemit.helix import PARAMETERS, RADIUS_PER_KAPPA
from cgemit.species import species
from cgemit.stages import fit_settings
from cgemit.states import StateStatus, Surface
from cgemit.tables import Table

if TYPE_CHECKING:
    from cgemit.detector import CgemLayer, Detector
    from cgemit.result import Result

_FALLBACK_SIZE = 200.0  # mm, of a detector without cylinders
_POINT, _MOMENTUM = ("x", "y", "z"), ("px", "py", "pz")
_TABLES = ("particles", "truths", "digis", "clusters", "wire_hits", "wire_truths", "tracks")


States = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Path:
    """A fitted track as a curve.

    Attributes
    ----------
    points : (n, 3) float64, mm
        From the beam line to its last hit, through its smoothed states.
    p : float
        Momentum at the origin, GeV/c.
    row : int
        Row of the track among those of the event.
    """

    points: Array
    p: float
    row: int


@dataclass(frozen=True)
class EventView:
    """One event.

    Attributes
    ----------
    detector : Detector
    event : int
    particles, truths, digis, clusters, wire_hits, wire_truths, tracks : Table
        Rows of the event, empty where the run made none; links count them from 0.
    ghosts : (clusters,) bool
        XV clusters whose X and V come from different crossings.
    paths : list of Path
        Of the tracks that were fitted.
    centres : (wire_hits, 2) float64, mm
        Where the wire of each hit is, at the z of its track, or else of its true crossing, or else at z = 0.
    r, z : float
        Radius and half length of the detector, mm.
    """

    detector: Detector
    event: int
    particles: Table
    truths: Table
    digis: Table
    clusters: Table
    wire_hits: Table
    wire_truths: Table
    tracks: Table
    ghosts: npt.NDArray[np.bool_]
    paths: list[Path]
    centres: Array
    r: float
    z: float

    def shot(self) -> str:
        """Return the particles of the event as text."""
        texts = []
        for row in range(min(3, len(self.particles))):
            momentum = np.array([self.particles[f"p{axis}"][row] for axis in "xyz"])
            p = float(np.linalg.norm(momentum))
            name = species(int(self.particles["pdg"][row])).name
            texts.append(f"{name} {p:.3g} GeV/c, cos θ = {momentum[2] / p:.2f}")
        return "; ".join([*texts, *(["..."] if len(self.particles) > 3 else [])])

    def shown_clusters(self) -> npt.NDArray[np.bool_]:
        """Return which clusters are drawn as points: XV ones, and those of one view that no XV cluster holds."""
        used = np.concatenate([self.clusters["x_cluster"], self.clusters["v_cluster"]])
        held = np.isin(np.arange(len(self.clusters)), used[used >= 0])
        return np.asarray(((self.clusters["view"] == 2) | ~held) & ~self.ghosts)


def view_of(result: Result, event: int) -> EventView:
    """Return what is drawn of one event.

    Parameters
    ----------
    result : Result
    event : int

    Raises
    ------
    ValueError
        If the result has no such event.
    """
    whole = next(iter(result.tables.values()))  # any of them covers all events
    events = whole.events
    if event not in events:
        few = ", ".join(map(str, events[:5])) + (", ..." if len(events) > 5 else "")
        gaps = whole.cover["events"] is not None
        expected = f"one of {few}" if gaps else f"a number from {events[0]} to {events[-1]}" if len(events) else "none"
        raise ValueError(f"event: got {event}; expected {expected}")
    event = int(event)
    part = result.select_events(event, event + 1)
    rows = {name: part.tables.get(name, Table.empty(name, 1, event)) for name in _TABLES}  # a run may end early
    r, z = _reach(result.detector)
    states = _states(part)
    paths = _paths(part, rows["tracks"], states, r, z)
    centres = _wire_centres(result.detector, rows["wire_hits"], rows["wire_truths"], states)
    return EventView(result.detector, event, **rows, ghosts=_ghosts(rows["clusters"]), paths=paths, centres=centres,
                     r=r, z=z)  # fmt: skip


def _ghosts(clusters: Table) -> npt.NDArray[np.bool_]:
    pairs = clusters["view"] == 2
    ghosts = np.zeros(len(clusters), bool)
    x, v = (clusters["truth"][clusters[f"{name}_cluster"][pairs]] for name in "xv")
    ghosts[pairs] = x != v
    return ghosts


def _reach(detector: Detector) -> tuple[float, float]:
    wires = wire_layers(detector)
    r = [part.r_out for part in (*detector.beam_pipe, *detector.walls)] + [layer.r_out for layer in detector.cgem]
    z = [layer.half_length for layer in detector.cgem] + [layer.half_length for layer in wires]
    r += [layer.r_end for layer in wires]
    return max(r, default=_FALLBACK_SIZE), max(z, default=_FALLBACK_SIZE)


def _states(part: Result) -> States:
    """Return the smoothed states of the event at the beam line and at the hits, fitted again; none without hits."""
    names = ("track", "surface", "view", "hit", *_POINT, *_MOMENTUM)
    needed = ("tracks", "candidates", "candidate_hits", "clusters", "wire_hits")
    if any(part.tables.get(name) is None for name in needed) or not len(part.fitted):
        return {name: np.empty(0) for name in names}
    settings = replace(fit_settings(part.settings), states=("beam_line", "hits"), residuals=False)
    found = fit(
        part.fit_detector or part.detector, part.clusters, part.wire_hits, part.candidates, part.candidate_hits,
        settings,
    )["states"]  # fmt: skip
    good = found["status"] == StateStatus.ok
    return {name: found[name][good] for name in names}


def _paths(part: Result, tracks: Table, states: States, r: float, z: float) -> list[Path]:
    """Return the fitted tracks through their states; as the helix at the origin where there are none."""
    found = []
    for row in np.flatnonzero((tracks["status"] == FitStatus.ok) & np.isfinite(tracks["kappa"])):
        helix = np.array([tracks[name][row] for name in PARAMETERS])
        mine = states["track"] == row
        if np.count_nonzero(mine) > 1:
            points, momenta = (np.stack([states[name][mine] for name in names], 1) for names in (_POINT, _MOMENTUM))
            order = np.argsort(_turned(points, helix, part.detector.field.bz), kind="stable")
            curve = smooth_curve(points[order], momenta[order])
        else:
            curve = np.stack(helix_points(helix, part.detector.field.bz, r, z), axis=1)
        found.append(Path(curve, float(tracks["p"][row]), int(row)))
    return found


def _turned(points: Array, helix: Array, bz: float) -> Array:
    """Return the angle, (n,) rad, by which a track has turned about the centre of its circle at each point."""
    dr, phi0, kappa = helix[:3]
    radius = RADIUS_PER_KAPPA / (bz * kappa)
    centre = (dr + radius) * np.array([np.cos(phi0), np.sin(phi0)])
    x, y = (points[:, :2] - centre).T * -np.sign(radius)
    angle = (np.arctan2(y, x) - phi0) * -np.sign(radius)
    return np.asarray((angle + 0.5) % (2 * np.pi) - 0.5)  # energy loss may put the first point a little before 0


def _wire_centres(detector: Detector, hits: Table, truths: Table, states: States) -> Array:
    z = np.zeros(len(hits))
    known = hits["wire_truth"] >= 0
    z[known] = truths["z"][hits["wire_truth"][known]]
    at_wire = (states["surface"] == Surface.hit) & (states["view"] == 2)
    z[states["hit"][at_wire].astype(np.int64)] = states["z"][at_wire]
    layers = {layer.number: layer for layer in wire_layers(detector)}
    centres = np.empty((len(hits), 2))
    for number in np.unique(hits["layer"]):
        rows = hits["layer"] == number
        centres[rows] = np.column_stack(wire_positions(layers[number], hits["wire"][rows], z[rows]))
    return centres


def strip_line(layer: CgemLayer, sheet: int, view: int, strip: int, n: int = 121) -> tuple[Array, Array]:
    """Return the middle of a strip on the anode.

    Parameters
    ----------
    layer : CgemLayer
    sheet, view, strip : int
        View 0 X, 1 V.
    n : int
        Number of points.

    Returns
    -------
    phi, z : (m,) float64, rad and mm
        Inside the active length; `phi` does not jump.
    """
    start = layer.sheet_phi[sheet]
    if view == 0:
        phi = start + (strip + 0.5) * layer.pitch_x / layer.r_readout
        return np.full(2, phi), np.array([-layer.half_length, layer.half_length])
    x = np.linspace(0.0, 2 * np.pi * layer.r_readout / layer.sheets, n)
    v = v_of_strips(layer, strip + 0.5)
    # The ends of the strip, where it leaves the sheet along the beam.
    ends = (v - (layer.z_ref - np.array([-1, 1]) * layer.half_length) * np.sin(layer.stereo)) / np.cos(layer.stereo)
    x = np.clip(np.unique(np.concatenate([x, ends])), max(0.0, ends.min()), min(x[-1], ends.max()))
    return start + x / layer.r_readout, crossing_z(layer, x, v)
