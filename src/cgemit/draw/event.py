"""Numbers that an event display draws: rows of one event, ghosts, tracks as curves, strips on the anode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from cgemit.chain.settings import fit_settings
from cgemit.detector.layers import Layer
from cgemit.detector.layers.cgem import v_of_strips
from cgemit.detector.layers.layer import crossing_z
from cgemit.detector.parts import Cylinder, cgem_numbers
from cgemit.draw.style import COLORS, plain, statistics_box
from cgemit.helix import PARAMETERS, RADIUS_PER_KAPPA, wrap_angle
from cgemit.particles.species import species
from cgemit.reconstruction.fit import fit
from cgemit.reconstruction.states import StateStatus, Surface
from cgemit.tables import Table
from cgemit.tables.schema import HIT_WIRE, XV_CLUSTER, FitStatus, is_fitted
from cgemit.truth.assign import residuals

if TYPE_CHECKING:
    from cgemit.chain.result import Result
    from cgemit.detector import Detector, WireLayer


Array = npt.NDArray[np.float64]


def helix_points(helix: Array, bz: float, r_max: float, z_max: float, n: int = 400) -> tuple[Array, Array, Array]:
    """Return points of a track from its closest approach to the beam line until it leaves a cylinder or turns back.

    Parameters
    ----------
    helix : (5,) float64
        dr mm, phi0 rad, kappa 1/(GeV/c), dz mm, tanl; pivot at the origin.
    bz : float
        Field, T.
    r_max, z_max : float
        Radius and half length of the cylinder, mm.
    n : int
        Number of points.

    Returns
    -------
    x, y, z : (m,) float64, mm
        m <= n.
    """
    dr, phi0, kappa, dz, tanl = helix
    w = -bz * kappa / RADIUS_PER_KAPPA  # 1/mm, turn per length
    # Half a turn, or the whole way out of the cylinder for an almost straight track.
    out = 1.5 * (r_max + abs(dr))
    length = np.linspace(0.0, min(np.pi / abs(w), out) if w else out, n)
    # Along its chord, which points half of the turn ahead; written without the radius.
    half = 0.5 * w * length
    chord = length * np.sinc(half / np.pi)
    x = dr * np.cos(phi0) - chord * np.sin(phi0 + half)
    y = dr * np.sin(phi0) + chord * np.cos(phi0 + half)
    z = dz + length * tanl
    inside = (np.hypot(x, y) <= r_max) & (np.abs(z) <= z_max)
    last = n if inside.all() else int(np.argmin(inside))
    return x[:last], y[:last], z[:last]


def near(phi: npt.ArrayLike, reference: float) -> Array:
    """Return angles shifted by whole turns to lie within pi of a reference, rad."""
    return reference + wrap_angle(np.asarray(phi, np.float64) - reference)


def wire_layers(detector: Detector) -> tuple[WireLayer, ...]:
    """Return the wire layers of a detector; none without a drift chamber."""
    return detector.wires


def chamber_begin(detector: Detector) -> float:
    """Return the radius of the innermost wires, mm; infinite without a drift chamber."""
    return min((layer.r_mid for layer in wire_layers(detector)), default=np.inf)


def matter_parts(detector: Detector) -> list[Cylinder | Layer]:
    """Return the cylinders that measure nothing: beam pipe, walls, and layers of matter alone."""
    return [*detector.beam_pipe, *detector.walls, *(layer for layer in detector.barrels if not layer.views)]


def wire_positions(layer: WireLayer, wires: npt.NDArray[np.integer[Any]], z: Array | float) -> tuple[Array, Array]:
    """Return x and y, (n,) float64 mm, of wires, (n,) int, at z, (n,) float64 mm."""
    low, high = layer.ends
    share = np.clip((z - low) / (high - low), 0, 1)
    east, west = np.moveaxis(layer.wire_ends(wires), -2, 0)
    return share * east[..., 0] + (1 - share) * west[..., 0], share * east[..., 1] + (1 - share) * west[..., 1]


def wire_profile(layer: WireLayer) -> tuple[Array, Array]:
    """Return z and r, (41,) float64 mm, along the wires of a layer: a hyperbola for straight stereo wires."""
    z = np.linspace(*layer.ends, 41)
    return z, np.array([layer.radius_at(one) for one in z])


def smooth_curve(points: Array, directions: Array, steps: int = 12) -> Array:
    """Return a curve through points with given directions: a cubic between neighbours, as long as the arc would be.

    Parameters
    ----------
    points, directions : (n, 3) float64
        In their order along the curve; directions of any length.
    steps : int
        Points for each interval.

    Returns
    -------
    (m, 3) float64
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = points[:-1], points[1:]
    chord = np.linalg.norm(there - here, axis=1)
    half = 0.5 * np.arccos(np.clip(np.sum(unit[:-1] * unit[1:], axis=1), -1, 1))
    length = (chord / np.sinc(half / np.pi))[:, None, None]  # of the arc of a circle with this chord and turn
    t = np.linspace(0, 1, steps, endpoint=False)[None, :, None]
    start, end = unit[:-1, None], unit[1:, None]
    cubic = (
        (1 + 2 * t) * (1 - t) ** 2 * here[:, None] + t**2 * (3 - 2 * t) * there[:, None]
        + length * (t * (1 - t) ** 2 * start - t**2 * (1 - t) * end)
    )  # fmt: skip
    return np.concatenate([cubic.reshape(-1, 3), points[-1:]])


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
        Row of the track in the event.
    large_chi2 : bool
        Whether neither chance nor the errors of its hits explain its chi-square.
    """

    points: Array
    p: float
    row: int
    large_chi2: bool


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
    on_track : (clusters,) bool, (wire_hits,) bool
        Which X, V and XV clusters, and which wire hits, a track has.
    measured : bool
        Whether the event is of an experiment: nothing is known of the truth.
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
    on_track: tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]
    measured: bool
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
    on_track = _on_track(rows["clusters"], rows["wire_hits"], part.tables.get("candidate_hits"))
    return EventView(
        result.detector, event, **rows, ghosts=_ghosts(rows["clusters"]), on_track=on_track,
        measured=result.is_measured, paths=paths, centres=centres, r=r, z=z,
    )  # fmt: skip


def _on_track(
    clusters: Table, wire_hits: Table, hits: Table | None
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return which clusters, with the XV clusters of their X and V, and which wire hits are in a candidate."""
    of_clusters, of_wires = np.zeros(len(clusters), np.bool_), np.zeros(len(wire_hits), np.bool_)
    if hits is not None:
        wire = hits["view"] == HIT_WIRE
        of_wires[hits["hit"][wire]] = True
        of_clusters[hits["hit"][~wire]] = True
    is_xv = clusters["view"] == XV_CLUSTER
    parts = [clusters[name][is_xv] for name in ("x_cluster", "v_cluster")]
    of_clusters[is_xv] |= of_clusters[parts[0]] & of_clusters[parts[1]]
    return of_clusters, of_wires


def _ghosts(clusters: Table) -> npt.NDArray[np.bool_]:
    pairs = clusters["view"] == 2
    ghosts = np.zeros(len(clusters), bool)
    x, v = (clusters["truth"][clusters[f"{name}_cluster"][pairs]] for name in "xv")
    ghosts[pairs] = x != v
    return ghosts


def _reach(detector: Detector) -> tuple[float, float]:
    wires = wire_layers(detector)
    r = [part.r_out for part in matter_parts(detector)] + [layer.r_out for layer in detector.layers]
    ends = [layer.ends for layer in detector.layers] + [layer.ends for layer in wires]
    z = [max(-low, high) for low, high in ends]
    r += [layer.r_end for layer in wires]
    return max(r, default=_FALLBACK_SIZE), max(z, default=_FALLBACK_SIZE)


def _states(part: Result) -> States:
    """Return the smoothed states of the event at the beam line and at the hits, fitted again; none without hits."""
    names = ("track", "surface", "view", "hit", *_POINT, *_MOMENTUM)
    needed = ("tracks", "candidates", "candidate_hits", "clusters", "wire_hits")
    if any(part.tables.get(name) is None for name in needed) or not len(part.fitted):
        return {name: np.empty(0) for name in names}
    settings = fit_settings(part.settings, part.gun, states=("beam_line", "hits"), residuals=False, beam=None)
    states = fit(
        part.fit_detector or part.detector, *part.fitted_hits, part.candidates, part.candidate_hits,
        settings,
    )["states"]  # fmt: skip
    good = states["status"] == StateStatus.ok
    return {name: states[name][good] for name in names}


def _paths(part: Result, tracks: Table, states: States, r: float, z: float) -> list[Path]:
    """Return the fitted tracks through their states; as the helix at the origin where there are none."""
    paths = []
    fitted = is_fitted(tracks)
    for row in np.flatnonzero(fitted & np.isfinite(tracks["kappa"])):
        helix = np.array([tracks[name][row] for name in PARAMETERS])
        mine = states["track"] == row
        if np.count_nonzero(mine) > 1:
            points, momenta = (np.stack([states[name][mine] for name in names], 1) for names in (_POINT, _MOMENTUM))
            order = np.argsort(_turned(points, helix, part.detector.field.bz), kind="stable")
            curve = smooth_curve(points[order], momenta[order])
        else:
            curve = np.stack(helix_points(helix, part.detector.field.bz, r, z), axis=1)
        large = bool(tracks["status"][row] == FitStatus.large_chi2)
        paths.append(Path(curve, float(tracks["p"][row]), int(row), large))
    return paths


_ALMOST_STRAIGHT = 1e-3  # T/(GeV/c): a radius above 3 km


def _turned(points: Array, helix: Array, bz: float) -> Array:
    """Return what orders points along a track, (n,): the angle turned about the centre of its circle, rad.

    Of a track that is all but straight it is the length along it, mm.
    """
    dr, phi0, kappa = helix[:3]
    if abs(bz * kappa) < _ALMOST_STRAIGHT:
        return np.asarray(points[:, 1] * np.cos(phi0) - points[:, 0] * np.sin(phi0))
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


def strip_line(layer: Layer, sheet: int, view: int, strip: int, n: int = 121) -> tuple[Array, Array]:
    """Return the middle of a strip on the anode.

    Parameters
    ----------
    layer : Layer
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
        return np.full(2, phi), np.array(layer.ends)
    x = np.linspace(0.0, 2 * np.pi * layer.r_readout / layer.sheets, n)
    v = v_of_strips(layer, strip + 0.5)
    # The ends of the strip, where it leaves the sheet along the beam.
    ends = (v - (layer.z_ref - np.array(layer.ends)) * layer.sin_stereo) / np.cos(layer.stereo)
    x = np.clip(np.unique(np.concatenate([x, ends])), max(0.0, ends.min()), min(x[-1], ends.max()))
    return start + x / layer.r_readout, crossing_z(layer, x, v)


_BESIDE = 6  # strips shown on either side of a cluster
_TIMES = "viridis"
_WIDEST = 2.8  # points, of the line of the strip with the largest charge


@dataclass(frozen=True, eq=False)
class ClusterStrips:
    """The cluster of a particle with the largest charge in a layer and view, and the fired strips about it."""

    name: str
    """"X" or "V"."""
    across: Array
    """(n,) float64, mm: middles of the strips, from the position of the cluster."""
    charge: Array
    """(n,) float64, fC."""
    time: Array
    """(n,) float64, ns."""
    pitch: float
    """mm."""
    truth: float
    """The true crossing, mm from the position of the cluster; NaN if the cluster has none."""
    whole: float
    """Charge of the cluster, fC."""
    size: int
    """Strips of the cluster."""


def cluster_strips(view: EventView, number: int) -> list[ClusterStrips]:
    """Return the strips of the largest X and V cluster of a layer; noise counts where there is nothing else.

    Parameters
    ----------
    view : EventView
    number : int
        Layer, from 0.
    """
    return [one for code in (0, 1) if (one := _of_view(view, number, code)) is not None]


def _of_view(view: EventView, number: int, code: int) -> ClusterStrips | None:
    clusters, digis, layer = view.clusters, view.digis, view.detector.layers[number]
    rows = np.flatnonzero((clusters["layer"] == number) & (clusters["view"] == code) & (clusters["first"] >= 0))
    if not len(rows):
        return None
    true = rows[clusters["truth"][rows] >= 0]
    rows = true if len(true) else rows
    row = rows[[int(np.argmax(clusters["charge"][rows]))]]
    first, last, sheet = (int(clusters[name][row[0]]) for name in ("first", "last", "sheet"))
    near = (digis["layer"] == number) & (digis["view"] == code) & (digis["sheet"] == sheet)
    near &= (digis["strip"] >= first - _BESIDE) & (digis["strip"] <= last + _BESIDE)
    strips = digis["strip"][near] + 0.5
    pitch = (layer.pitch_x, layer.pitch_v)[code]
    position = float(clusters["xv"[code]][row[0]])
    truth = (
        -float(residuals(view.detector, clusters, view.truths, row)[0]) if clusters["truth"][row[0]] >= 0 else np.nan
    )
    return ClusterStrips(
        "XV"[code], (strips * pitch if code == 0 else v_of_strips(layer, strips)) - position,
        digis["charge"][near], digis["time"][near], pitch, truth,
        float(clusters["charge"][row[0]]), int(clusters["size"][row[0]]),
    )  # fmt: skip


def line_widths(view: EventView, fired: npt.NDArray[np.bool_]) -> Array:
    """Return the widths of lines for fired strips, (n,) float64 in points: more with more charge.

    Parameters
    ----------
    view : EventView
    fired : (digis,) bool
    """
    largest = float(view.digis["charge"].max(initial=0.0))
    share = view.digis["charge"][fired] / largest if largest > 0 else np.zeros(int(fired.sum()))
    return np.asarray(0.4 + (_WIDEST - 0.4) * share)


def draw_cluster_strips(axes: list[Axes], view: EventView) -> None:
    """Draw charge and time of the strips of the largest clusters, X upwards and V downwards, one plot a layer.

    Parameters
    ----------
    axes : list of Axes
        For each CGEM layer; the last one gets the scale of the times.
    view : EventView
    """
    layers = [cluster_strips(view, number) for number in cgem_numbers(view.detector)]
    times = np.concatenate([np.empty(0), *(one.time for layer in layers for one in layer)])
    low, high = (float(times.min()), float(times.max())) if len(times) else (0.0, 1.0)
    colours = ScalarMappable(Normalize(low, high if high > low else low + 1.0), _TIMES)
    most = max((float(one.charge.max(initial=0.0)) for layer in layers for one in layer), default=0.0) or 1.0
    reach = max((float(np.abs(one.across).max(initial=0.0)) for layer in layers for one in layer), default=0.0) + 1.0
    for plot, strips, layer in zip(axes, layers, view.detector.cgem, strict=True):
        for strip_view in strips:
            _draw_view(plot, strip_view, colours, 1.0 if strip_view.name == "X" else -1.0)
        plot.axhline(0, color=COLORS["text"], lw=0.8)
        plot.axvline(0, color=COLORS["cgem"], lw=1.2, ls="--", label="position of the cluster")
        plot.set(xlim=(-reach, reach), ylim=(-1.6 * most, 1.6 * most), xlabel="across the strips  (mm)")
        plot.set_title(f"{plain(layer.label)}: largest clusters", loc="left")
        plot.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
        plot.tick_params(length=3)
    axes[0].set_ylabel("V  ←  charge (fC)  →  X")
    scale = axes[-1].inset_axes((1.04, 0.0, 0.05, 1.0))
    axes[-1].figure.colorbar(colours, cax=scale, label="time of the strip  (ns)")


def _draw_view(axes: Axes, strips: ClusterStrips, colours: ScalarMappable, sign: float) -> None:
    bars = axes.bar(
        strips.across, sign * strips.charge, width=0.86 * strips.pitch, color=colours.to_rgba(strips.time), lw=0
    )
    bars.set_label(f"_{strips.name}")
    if np.isfinite(strips.truth):
        tip = sign * 0.5 * float(strips.charge.max())
        # A white line below shows the pin on bars of any colour.
        axes.plot([strips.truth] * 2, [0, tip], "-o", color="white", ms=8, markevery=[1], lw=4.0, zorder=3)
        axes.plot([strips.truth] * 2, [0, tip], "-o", color=COLORS["truth"], mfc="white", ms=5, markevery=[1], lw=1.6,
                  zorder=3.1, label="true crossing of the strips")  # fmt: skip
    many = f"{strips.size} strip{'s' * (strips.size != 1)}"
    off = [f"residual {-1000 * strips.truth:+.0f} µm"] if np.isfinite(strips.truth) else []
    statistics_box(axes, [f"{strips.name}: {strips.whole:.1f} fC, {many}", *off], right=False,
                   top=0.97 if sign > 0 else 0.19)  # fmt: skip
