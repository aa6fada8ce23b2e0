"""Parts of a detector as immutable dataclasses: layers, strips, shells, wires. Lengths in mm, angles in rad.

The metadata of each field (`keys.Key`) states what a detector file may hold there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import cached_property
from html import escape
from itertools import accumulate, chain
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, SupportsIndex, TypeVar, overload

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import did_you_mean
from cgemit.base.settings import SettingsData
from cgemit.base.validate import default_of
from cgemit.detector.field import Field
from cgemit.detector.keys import Part, key, once
from cgemit.detector.material import Material

_FAR, _TILT, _ROTATION = 2.0, 2e-3, 1e-2  # mm, rad: beyond, hits would be sought at other wires and strips


@dataclass(frozen=True, kw_only=True)
class Placed(Part):
    """A part with six degrees of freedom: it is turned about the x, then y, then z axis, and then shifted."""

    shift_x: float = field(metadata=key("length", "shift of the part along x", -_FAR, _FAR), default=0.0)  # mm
    shift_y: float = field(metadata=key("length", "shift of the part along y", -_FAR, _FAR), default=0.0)  # mm
    shift_z: float = field(metadata=key("length", "shift of the part along the beam", -_FAR, _FAR), default=0.0)  # mm
    tilt_x: float = field(metadata=key("angle", "turn of the part about the x axis", -_TILT, _TILT), default=0.0)
    tilt_y: float = field(metadata=key("angle", "turn of the part about the y axis", -_TILT, _TILT), default=0.0)
    rotation: float = field(
        metadata=key("angle", "turn of the part about the beam axis", -_ROTATION, _ROTATION), default=0.0
    )

    @property
    def is_moved(self) -> bool:
        """Whether the part is anywhere but where the description puts it."""
        return any(getattr(self, name) != 0 for name in PLACEMENT)

    def moved_text(self) -> str:
        """Return how the part is displaced, as the end of a line; nothing if it is in place."""
        if not self.is_moved:
            return ""
        shift = ", ".join(f"{1000 * value:g}" for value in self.shift)
        turn = ", ".join(f"{1000 * value:g}" for value in (self.tilt_x, self.tilt_y, self.rotation))
        return f", displaced by ({shift}) um and ({turn}) mrad"

    @property
    def shift(self) -> Floats:
        """Shift, (3,) float64 mm."""
        return np.array([self.shift_x, self.shift_y, self.shift_z])

    @property
    def turn(self) -> Floats:
        """Rotation from the beam's axes to those of the part, (3, 3) float64."""
        (cx, sx), (cy, sy), (cz, sz) = (
            (math.cos(angle), math.sin(angle)) for angle in (self.tilt_x, self.tilt_y, self.rotation)
        )
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.asarray((about_z @ about_y @ about_x).T)

    @property
    def placement(self) -> Floats:
        """Shift and the rows of the rotation, (12,) float64, as the core takes them."""
        return np.concatenate([self.shift, self.turn.ravel()])


#: Keys of `Placed`, which a file need not give.
PLACEMENT = ("shift_x", "shift_y", "shift_z", "tilt_x", "tilt_y", "rotation")

#: Placement of a part that is where the description puts it.
IN_PLACE = Placed().placement


def seen_by(part: Placed, points: Floats, direction: Floats) -> Floats:
    """Return where straight tracks that cross cylinders of the described part cross those of the real one.

    Parameters
    ----------
    part : Placed
    points : ndarray, (n, 3) float64, mm
        Points of the tracks, in the beam's axes.
    direction : ndarray, (n, 3) float64
        Their directions, of any length.

    Returns
    -------
    ndarray, (n, 3) float64, mm
        In the part's own axes, each at the radius that the point has in the beam's. A track along the surface is left
        where it is.
    """
    radius_2 = np.sum(points[:, :2] ** 2, axis=1)
    local, along = (points - part.shift) @ part.turn.T, direction @ part.turn.T
    # |p + t u| = radius, for the solution close to t = 0
    a, b = np.sum(along[:, :2] ** 2, axis=1), np.sum(local[:, :2] * along[:, :2], axis=1)
    c = np.sum(local[:, :2] ** 2, axis=1) - radius_2
    square = b * b - a * c
    t = np.where(square > 0, -c / (b + np.copysign(np.sqrt(np.maximum(square, 0)), b)), 0.0)
    return np.asarray(local + t[:, None] * along)


@dataclass(frozen=True, kw_only=True)
class RatePoint(Part):
    """Rate of hits at a radius."""

    r: float = field(metadata=key("length", "distance from the beam line", 1e-3, 1e6))
    rate: float = field(metadata=key("rate density", "hits of an area of the layer", 0, 1e6))


@dataclass(frozen=True, kw_only=True)
class BackgroundLevel(Part):
    """Cells and strips that fire without a particle of the event (docs/methods/background.md)."""

    label: str
    wire_rate: tuple[RatePoint, ...] = field(
        metadata=key("profile", "hits of the wires with a time in the readout window, against the radius"), default=()
    )
    wire_runs: tuple[float, ...] = field(
        metadata=key("counts", "how often 1, 2, 3 ... cells of a layer fire side by side"), default=(1,)
    )
    wire_window: float = field(metadata=key("time", "readout window of the wires", 1, 1e6), default=2000.0)
    hot_wires: float = field(metadata=key("dimensionless", "share of the wires that are hot", 0, 1), default=0.0)
    hot_wire_rate: float = field(metadata=key("rate", "hits of a hot wire", 0, 1e6), default=0.0)
    dead_wires: float = field(metadata=key("dimensionless", "share of the wires that never fire", 0, 1), default=0.0)
    efficiency_wires: float = field(
        metadata=key("dimensionless", "share of the cells fired by particles that are read out", 0, 1), default=1.0
    )
    cluster_rate: float = field(
        metadata=key("rate density", "clusters of the CGEM at cluster_radius", 0, 1e6), default=0.0
    )
    cluster_radius: float = field(
        metadata=key("length", "distance from the beam line of that rate", 1e-3, 1e6), default=76.0
    )
    cluster_power: float = field(
        metadata=key("dimensionless", "power of the radius with which it changes", -10, 10), default=0.0
    )
    cluster_strips: int = field(
        metadata=key("integer", "most strips of such a cluster; from 1, as probable as each other", 1, 1000), default=6
    )
    charge_low: float = field(metadata=key("charge", "smallest charge of a strip", 0, 1e6), default=10.0)
    charge_high: float = field(metadata=key("charge", "largest charge of a strip", 0, 1e6), default=50.0)
    strip_window: float = field(metadata=key("time", "readout window of the strips", 1, 1e6), default=1000.0)
    efficiency_x: float = field(
        metadata=key("dimensionless", "share of the X strips fired by particles that are read out", 0, 1), default=1.0
    )
    efficiency_v: float = field(
        metadata=key("dimensionless", "share of the V strips fired by particles that are read out", 0, 1), default=1.0
    )
    noise_x: float = field(metadata=key("rate", "noise of an X strip of the innermost layer", 0, 1e6), default=0.0)
    noise_v: float = field(metadata=key("rate", "noise of a V strip of the innermost layer", 0, 1e6), default=0.0)
    hot_strips: float = field(metadata=key("dimensionless", "share of the strips that are hot", 0, 1), default=0.0)
    hot_strip_rate: float = field(metadata=key("rate", "hits of a hot strip", 0, 1e6), default=0.0)
    dead_strips: float = field(metadata=key("dimensionless", "share of the strips that never fire", 0, 1), default=0.0)


class Shell(NamedTuple):
    """A placed sub-layer; `group` is pipe, wall, air, cathode, drift, foils, anode or gas.

    Examples
    --------
    >>> shells = cg.load("besiii-cgem").cgem["L1"].shells()
    >>> print(*[(shell.group, shell.label) for shell in shells][-3:])
    ('anode', 'Epoxy5') ('anode', 'Cu3') ('anode', 'Kapton5')
    """

    group: str
    label: str
    r_in: float  # mm
    r_out: float  # mm
    half_length: float  # mm
    material: Material

    @property
    def thickness(self) -> float:
        """Thickness in mm."""
        return self.r_out - self.r_in

    @property
    def x0(self) -> float:
        """Thickness in radiation lengths at normal incidence."""
        return self.thickness / self.material.x0

    @property
    def xi(self) -> float:
        """(K/2) (Z/A) times the mass thickness at normal incidence, GeV."""
        return self.material.xi(self.thickness)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Part):
    """A cylindrical shell of one material: a layer of the beam pipe or of a wall.

    Examples
    --------
    >>> pipe = cg.load("besiii-cgem").beam_pipe[0]
    >>> pipe.label, pipe.material.name, pipe.r_in
    ('gold', 'Au', 31.48564)
    """

    label: str
    r_in: float = field(metadata=key("length", "inner radius", 0.1, 10_000.0))  # mm
    r_out: float = field(metadata=key("length", "outer radius", 0.1, 10_000.0))  # mm
    half_length: float = field(metadata=key("length", "half length along the beam", 1.0, 5000.0))  # mm
    material: Material = field(metadata=key("material", "name of the material"))

    @property
    def thickness(self) -> float:
        """Thickness in mm."""
        return self.r_out - self.r_in


@dataclass(frozen=True, kw_only=True)
class SubLayer(Part):
    """One material of an electrode of a CGEM layer.

    Examples
    --------
    >>> layer = cg.load("besiii-cgem").cgem["L1"]
    >>> [(part.label, part.material.name, part.thickness) for part in layer.foil]
    [('Cu1', 'CuFoil', 0.005), ('Kapton', 'KaptonFoil', 0.05), ('Cu2', 'CuFoil', 0.005)]
    """

    label: str
    material: Material = field(metadata=key("material", "name of the material"))
    thickness: float = field(metadata=key("length", "thickness", 1e-5, 50.0))  # mm

    def __hash__(self) -> int:
        return hash((self.label, self.thickness))  # as for materials: caches look up stacks often


@dataclass(frozen=True, kw_only=True)
class DriftPoint(Part):
    """A point of the relation of drift distance and drift time.

    Examples
    --------
    >>> points = [{"distance": "0 mm", "time": "0 ns"}, {"distance": "9 mm", "time": "350 ns"}]
    >>> det = cg.load("idea-like").with_overrides({"drift_chamber.drift_relation": points})
    >>> [(one.distance, one.time) for one in det.drift_chamber.drift_relation]
    [(0.0, 0.0), (9.0, 350.0)]
    """

    distance: float = field(metadata=key("length", "drift distance", 0.0, 1000.0))  # mm
    time: float = field(metadata=key("time", "drift time", -100.0, 100_000.0))  # ns


@dataclass(frozen=True, kw_only=True)
class ErrorPoint(Part):
    """The error of the drift distance at a distance from the wire.

    Examples
    --------
    >>> errors = [{"distance": "0 mm", "sigma": "0.2 mm"}, {"distance": "2 mm", "sigma": "0.1 mm"}]
    >>> det = cg.load("idea-like").with_overrides({"drift_chamber.sigma_points": errors})
    >>> layer = det.drift_chamber.layers[0]
    >>> print(layer.error_at(np.array([0.0, 1.0, 5.0])))
    [0.2  0.15 0.1 ]
    """

    distance: float = field(metadata=key("length", "drift distance", 0.0, 1000.0))  # mm
    sigma: float = field(metadata=key("length", "error of the drift distance", 1e-3, 10.0))  # mm


@dataclass(frozen=True, kw_only=True)
class CellWire(Part):
    """Wires, or tubes, of one kind in each drift cell.

    Examples
    --------
    >>> wires = [{"material": "W", "diameter": "20 um"}, {"material": "Al", "diameter": "120 um", "number": 3}]
    >>> det = cg.load("besiii-cgem").with_overrides({"drift_chamber.cell_wires": wires})
    >>> [(one.material.name, one.diameter, one.number) for one in det.drift_chamber.layers[0].cell_wires]
    [('W', 0.02, 1.0), ('Al', 0.12, 3.0)]
    """

    material: Material = field(metadata=key("material", "name of the material"))
    diameter: float = field(metadata=key("length", "outer diameter", 1e-3, 100.0))  # mm
    number: float = field(metadata=key("dimensionless", "wires for each cell", 0.01, 100.0), default=1.0)
    wall: float = field(  # mm
        metadata=key("length", "wall of a tube, such as a straw; 0: a solid wire", 0.0, 10.0), default=0.0
    )

    @property
    def area(self) -> float:
        """Cross-section of the matter of one wire, mm^2."""
        hole = max(self.diameter - 2 * self.wall, 0.0) if self.wall else 0.0
        return 0.25 * math.pi * (self.diameter**2 - hole**2)

    def __hash__(self) -> int:
        return hash((self.diameter, self.number, self.wall))  # as for materials: caches look up layers often


StripRanges = tuple[tuple[int, int, int], ...]


@dataclass(frozen=True, kw_only=True)
class Readout(SettingsData, Part):
    """Electronics of a layer, and what is made of their signals: a frozen dataclass of settings (`readouts`).

    Attributes
    ----------
    name : str
        Under which `cgemit.detector.readouts.READOUTS` holds the class.
    makes : str
        What its digis are: strips, or positions.
    """

    name: ClassVar[str]
    makes: ClassVar[Literal["strips", "positions"]] = "strips"

    @property
    def least_electrons(self) -> int:
        """Electrons of ionization in a gap below which a crossing has no clusters; 0: clusters need none."""
        return 1

    def stated(self) -> dict[str, Any]:
        """Return the name, and the values that differ from their defaults, by key."""
        found = {one.name: getattr(self, one.name) for one in fields(self)}
        usual = {one.name: default_of(one) for one in fields(self)}
        return {"name": self.name} | {name: value for name, value in found.items() if value != usual[name]}


class MeasuringCylinder(Placed):
    """What the layers that measure have in common: a readout surface with views X and V, and the matter around it.

    A layer of either kind also has `label`, `r_readout`, `r_gap_in` and `r_gap_out` (where a crossing begins and ends),
    `r_in`, `r_out`, `stacks`, `sheets`, `phi_first`, `stereo`, `strips_x`, `strips_v`, `offset_v`.
    """

    if TYPE_CHECKING:

        @property
        def length(self) -> float:
            """Active length along the beam, mm."""

        @property
        def phi_first(self) -> float:
            """Azimuth of X = 0 of the first sheet, rad."""

        @property
        def sheets(self) -> int:
            """Readout sheets around the layer."""

        @property
        def stereo(self) -> float:
            """Stereo angle of the V strips, rad."""

        @property
        def r_gap_in(self) -> float:
            """Radius where a crossing begins, mm."""

        @property
        def r_gap_out(self) -> float:
            """Radius where a crossing ends, mm."""

    @property
    def views(self) -> tuple[str, ...]:
        """Coordinates that are measured."""
        return ("X", "V")

    @property
    def half_length(self) -> float:
        """Half of the active length, mm."""
        return 0.5 * self.length

    @property
    def z_ref(self) -> float:
        """The end from which V is counted, mm."""
        return math.copysign(self.half_length, self.stereo)

    @property
    def sheet_phi(self) -> tuple[float, ...]:
        """Azimuth of X = 0 of each sheet, rad in (-pi, pi]."""
        turns = (self.phi_first + 2 * math.pi * i / self.sheets for i in range(self.sheets))
        return tuple(math.pi - (math.pi - phi) % (2 * math.pi) for phi in turns)

    @property
    def r_mid(self) -> float:
        """Radius of the middle of the crossing, where hits are, mm."""
        return 0.5 * (self.r_gap_in + self.r_gap_out)

    def stacks(self) -> tuple[tuple[Shell, ...], ...]:
        """Return the sub-layers from inside in groups that act as one scatterer each."""
        raise NotImplementedError

    def shells(self) -> Iterator[Shell]:
        """Yield every sub-layer, gaps included, from inside."""
        return chain.from_iterable(self.stacks())


@dataclass(frozen=True, kw_only=True, repr=False)
class CgemLayer(MeasuringCylinder):
    """One cylindrical GEM layer with X and V strips; everything is placed from the V-strip plane inward and outward.

    From inside: cathode, drift gap, first foil, transfer gap, ..., last foil, induction gap, anode.

    Examples
    --------
    >>> layer = cg.load("besiii-cgem").cgem["L1"]
    >>> layer.strips_x, layer.strips_v, layer.sheets, round(layer.r_mid, 2)  # mm
    (856, 1173, 1, 81.57)
    """

    label: str
    anode_radius: float = field(
        metadata=key("length", "radius of the V-strip plane, inner face of the anode", 10.0, 3000.0)
    )
    readout_offset: float = field(
        metadata=key("length", "radius at which X is measured, minus anode_radius", -5.0, 5.0), default=0.0
    )
    length: float = field(metadata=key("length", "active length along the beam", 10.0, 5000.0))  # mm
    sheets: int = field(metadata=key("integer", "number of readout sheets around the layer", 1, 8))
    phi_first: float = field(metadata=key("angle", "azimuth of X = 0 of the first sheet", -2 * math.pi, 2 * math.pi))
    pitch_x: float = field(metadata=key("length", "pitch of the X strips", 0.01, 20.0))  # mm
    pitch_v: float = field(metadata=key("length", "pitch of the V strips", 0.01, 20.0))  # mm
    drift_gap: float = field(metadata=key("length", "gap between cathode and first foil", 0.1, 50.0))  # mm
    transfer_gap: float = field(metadata=key("length", "gap between two foils", 0.1, 50.0))  # mm
    induction_gap: float = field(metadata=key("length", "gap between last foil and anode", 0.1, 50.0))  # mm
    # Operating point of the test beams and of the digitization model, doi 10.1007/s41605-020-00166-0; at mid-gap.
    drift_field: float = field(metadata=key("electric field", "field of the drift gap", 0.01, 20.0), default=1.5)
    transfer_field: float = field(metadata=key("electric field", "field of the transfer gaps", 0.01, 20.0), default=3.0)
    induction_field: float = field(
        metadata=key("electric field", "field of the induction gap", 0.01, 20.0), default=5.0
    )
    # None: tiger and apv25 take it from gas and fields, other readouts have none.
    lorentz_shift: float | None = field(
        metadata=key("length", "shift in X of electrons from mid-gap to the anode", -50.0, 50.0), default=None
    )
    foils: int = field(metadata=key("integer", "number of GEM foils", 1, 5), default=3)
    # Standard GEM foils: F. Sauli, Nucl. Instrum. Methods A 805 (2016) 2.
    hole_outer: float = field(metadata=key("length", "diameter of holes, in electrodes", 1e-3, 5.0), default=0.07)  # mm
    hole_inner: float = field(metadata=key("length", "their diameter inside the foil", 1e-3, 5.0), default=0.05)  # mm
    hole_pitch: float = field(metadata=key("length", "pitch of holes, hexagonal", 1e-3, 10.0), default=0.14)  # mm
    gas: Material = field(metadata=key("gas", "gas of all gaps"))
    cathode: tuple[SubLayer, ...] = field(metadata=key("stack", "materials of the cathode, from inside"))
    foil: tuple[SubLayer, ...] = field(metadata=key("stack", "materials of one GEM foil, from inside"))
    anode: tuple[SubLayer, ...] = field(metadata=key("stack", "materials of the anode, from inside"))
    strips_x: int = field(metadata=key("integer", "X strips of a sheet", 1, 100_000, derived=True))
    stereo: float = field(metadata=key("angle", "stereo angle of the V strips, signed", -1.55, 1.55, derived=True))
    strips_v: int = field(metadata=key("integer", "V strips of a sheet", 1, 100_000, derived=True))
    offset_v: float = field(
        metadata=key("offset", "V of the edge where V strip 0 begins, in units of pitch_v", 0.0, 100_000.0), default=0.0
    )
    # (sheet, first strip, last strip) each.
    dead_x: StripRanges = field(metadata=key("strips", "X strips that never fire"), default=())
    dead_v: StripRanges = field(metadata=key("strips", "V strips that never fire"), default=())
    dead_seam: float = field(metadata=key("length", "dead width about edges of sheets", 0.0, 1000.0), default=0.0)
    dead_ends: float = field(metadata=key("length", "dead length at each end", 0.0, 2500.0), default=0.0)
    hot_x: StripRanges = field(metadata=key("strips", "X strips that fire in every event"), default=())
    hot_v: StripRanges = field(metadata=key("strips", "V strips that fire in every event"), default=())
    # Of each sheet: rows along z from -length/2, each with numbers along X.
    gain_map: tuple[tuple[tuple[float, ...], ...], ...] = field(
        metadata=key("gains", "gain of each sheet, relative to that of the readout", 0.01, 100.0), default=()
    )
    readout: Readout = field(
        metadata=key(
            "readout", "name of the readout, or a table with its name and what differs from its defaults", derived=True
        ),
        hash=False,
    )  # one from outside the package may have no hash
    efficiency: float = field(
        metadata=key("dimensionless", "probability that a crossing is seen in both views", 0.0, 1.0, quiet=True),
        default=1.0,
    )

    error_slope: ClassVar[float] = 0.0  # of `MeasurementLayer`; a readout has errors of its own

    def __repr__(self) -> str:
        return f"<CGEM layer {self.label}: {self.text()}>"

    def _repr_html_(self) -> str:
        return f"<b>CGEM layer {escape(self.label)}</b> {escape(self.text())}"

    def text(self) -> str:
        """Return the layer in one line."""
        return (
            f"r = {self.r_mid:.2f} mm (mid drift gap of {self.drift_gap:g} mm), length {self.length:g} mm, "
            f"{self.sheets} x ({self.strips_x} X + {self.strips_v} V) strips, "
            f"stereo {math.degrees(self.stereo):+.2f} deg, readout {self.readout.name}{self.moved_text()}"
        )

    @property
    def r_readout(self) -> float:
        """Radius R of X = R (phi - phi_first), mm."""
        return self.anode_radius + self.readout_offset

    @cached_property
    def r_gap_out(self) -> float:
        """Outer radius of the drift gap, the inner face of the first foil, mm."""
        foils = self.foils * sum(part.thickness for part in self.foil)
        return self.anode_radius - self.induction_gap - (self.foils - 1) * self.transfer_gap - foils

    @property
    def r_gap_in(self) -> float:
        """Inner radius of the drift gap, the outer face of the cathode, mm."""
        return self.r_gap_out - self.drift_gap

    @cached_property
    def r_in(self) -> float:
        """Inner face of the cathode, mm."""
        return self.r_gap_in - sum(part.thickness for part in self.cathode)

    @cached_property
    def r_out(self) -> float:
        """Outer face of the anode, mm."""
        return self.anode_radius + sum(part.thickness for part in self.anode)

    def stacks(self) -> tuple[tuple[Shell, ...], ...]:
        """Return the sub-layers, gaps included, from inside: cathode, drift gap, foils and gaps behind them, anode."""
        gaps = [("transfer gap", self.transfer_gap)] * (self.foils - 1) + [("induction gap", self.induction_gap)]
        foil = [(part.label, part.thickness, part.material) for part in self.foil]
        foils: list[tuple[str, float, Material]] = []
        for number, (gap, width) in enumerate(gaps, start=1):
            foils += [(f"foil {number} {label}", thickness, material) for label, thickness, material in foil]
            foils.append((gap, width, self.gas))
        parts = (
            ("cathode", [(part.label, part.thickness, part.material) for part in self.cathode]),
            ("drift", [("drift gap", self.drift_gap, self.gas)]),
            ("foils", foils),
            ("anode", [(part.label, part.thickness, part.material) for part in self.anode]),
        )
        radius, half_length, make = self.r_in, self.half_length, tuple.__new__  # half the time of Shell(...)
        found = []
        for group, part in parts:
            shells = []
            for label, thickness, material in part:
                r_in, radius = radius, radius + thickness
                shells.append(make(Shell, (group, label, r_in, radius, half_length, material)))
            found.append(tuple(shells))
        return tuple(shells for shells in found if shells)


@dataclass(frozen=True, kw_only=True, repr=False)
class MeasurementLayer(MeasuringCylinder):
    """A cylinder that measures positions: a silicon barrel, a strip layer of any technology, a wrapper.

    X is r phi. V is z with the default `stereo` of 90 degrees, else the coordinate across strips at that angle to the
    beam. A coordinate is measured if its `sigma` or its `pitch` is given. With a sigma, positions have Gaussian errors
    of this width; with a pitch alone they are middles of strips, and their error is pitch/sqrt(12). A layer that
    measures nothing is matter only.

    On an inclined track a sigma becomes sqrt(sigma^2 + (sigma_tan t)^2), where t is dX/dr or dV/dr of the track.

    Examples
    --------
    >>> silicon = {"radius": "30 mm", "sigma": "5 um", "material": "Si", "thickness": "0.1 mm"}
    >>> det = cg.load({"base": "besiii-idc", "name": "pixel", "layer": {"VTX": silicon}})
    >>> layer = det.layer["VTX"]
    >>> layer.views, layer.sigma_v, layer.length
    (('X', 'V'), 0.005, 150.0)
    """

    label: str
    radius: float = field(metadata=key("length", "radius of the middle of the sensor", 5.0, 3000.0))
    length: float = field(
        metadata=key("length", "active length along the beam (default: 5 radii)", 10.0, 10_000.0, derived=True)
    )
    material: Material = field(metadata=key("material", "material of the sensor"))
    thickness: float = field(metadata=key("length", "thickness of the sensor", 1e-3, 50.0, derived=True))
    support: tuple[SubLayer, ...] = field(metadata=key("stack", "matter behind the sensor, from inside"), default=())
    sigma_x: float = field(metadata=key("length", "error of X = r phi; 0: see pitch_x", 0.0, 100.0), default=0.0)
    sigma_v: float = field(metadata=key("length", "error of V; 0: see pitch_v", 0.0, 1000.0), default=0.0)
    sigma_tan: float = field(
        metadata=key("length", "what a track at 45 degrees adds to a sigma, in quadrature", 0.0, 100.0), default=0.0
    )
    pitch_x: float = field(metadata=key("length", "pitch of the X strips; 0: none", 0.0, 100.0), default=0.0)
    pitch_v: float = field(metadata=key("length", "pitch of the V strips; 0: none", 0.0, 1000.0), default=0.0)
    stereo: float = field(
        metadata=key("angle", "angle of the V strips to the beam, signed; 90 deg: V is z", -math.pi / 2, math.pi / 2),
        default=math.pi / 2,
    )
    efficiency: float = field(metadata=key("dimensionless", "probability of a hit", 0.0, 1.0), default=1.0)
    sigma_time: float = field(metadata=key("time", "error of the time of a hit", 0.0, 1e6), default=0.0)
    readout: Readout = field(
        metadata=key(
            "readout", "name of the readout, or a table with its name and what differs from its defaults", derived=True
        ),
        hash=False,
    )  # one from outside the package may have no hash

    # One sheet around the beam, as a CGEM layer without seams, dead and hot strips.
    sheets: ClassVar[int] = 1
    phi_first: ClassVar[float] = math.pi
    offset_v: ClassVar[float] = 0.0
    dead_seam: ClassVar[float] = 0.0
    dead_ends: ClassVar[float] = 0.0
    lorentz_shift: ClassVar[None] = None
    dead_x: ClassVar[StripRanges] = ()
    dead_v: ClassVar[StripRanges] = ()
    hot_x: ClassVar[StripRanges] = ()
    hot_v: ClassVar[StripRanges] = ()
    gain_map: ClassVar[tuple[()]] = ()

    def __repr__(self) -> str:
        return f"<layer {self.label}: {self.text()}>"

    def _repr_html_(self) -> str:
        return f"<b>layer {escape(self.label)}</b> {escape(self.text())}"

    def text(self) -> str:
        """Return the layer in one line."""
        errors = dict(zip("XV", self.errors, strict=True))
        names = {"X": "r phi", "V": "z" if self.measures_z else f"V at {math.degrees(self.stereo):+.2f} deg"}
        inclined = f" + {1000 * self.sigma_tan:.4g} um tan" if self.sigma_tan else ""
        measured = ", ".join(f"{names[view]} to {1000 * errors[view]:.4g} um{inclined}" for view in self.views)
        x0 = 100 * sum(shell.x0 for shell in self.shells())
        return (
            f"r = {self.radius:g} mm, length {self.length:g} mm, {x0:.3g} % X0 of {self.material.name}, "
            f"{measured or 'measures nothing'}{self.moved_text()}"
        )

    @property
    def measures_z(self) -> bool:
        """Whether V is z."""
        return abs(abs(self.stereo) - math.pi / 2) < 1e-9

    @property
    def views(self) -> tuple[str, ...]:
        """Coordinates that are measured: X (r phi), V, both or none."""
        return tuple(view for view, error in zip("XV", self.errors, strict=True) if error > 0)

    @property
    def errors(self) -> tuple[float, float]:
        """Errors of X and V, mm; 0 where it is not measured."""
        pitches = (self.pitch_x, self.pitch_v)
        return tuple(
            sigma or pitch / math.sqrt(12) for sigma, pitch in zip((self.sigma_x, self.sigma_v), pitches, strict=True)
        )  # type: ignore[return-value]

    @property
    def error_slope(self) -> float:
        """Growth of errors with the path in the sensor, projected on X or V; added in quadrature."""
        return self.sigma_tan / self.thickness

    @property
    def r_readout(self) -> float:
        """Radius R of X = R (phi - phi_first), mm."""
        return self.radius

    @property
    def r_gap_in(self) -> float:
        """Inner face of the sensor, mm."""
        return self.radius - 0.5 * self.thickness

    @property
    def r_gap_out(self) -> float:
        """Outer face of the sensor, mm."""
        return self.radius + 0.5 * self.thickness

    @property
    def r_in(self) -> float:
        """Inner face, mm."""
        return self.r_gap_in

    @property
    def r_out(self) -> float:
        """Outer face, support included, mm."""
        return self.r_gap_out + sum(part.thickness for part in self.support)

    @property
    def strips_x(self) -> int:
        """X strips, of which a whole number is around the beam."""
        return max(1, round(2 * math.pi * self.radius / self.pitch_x)) if self.pitch_x else 1

    @property
    def strips_v(self) -> int:
        """V strips."""
        return max(1, math.ceil(self.extent_v / self.pitch_v - 1e-9)) if self.pitch_v else 1

    @property
    def extent_v(self) -> float:
        """Largest V, mm."""
        return 2 * math.pi * self.radius * math.cos(self.stereo) + self.length * math.sin(abs(self.stereo))

    def stacks(self) -> tuple[tuple[Shell, ...], ...]:
        """Return the sensor, and the support behind it."""
        sensor = Shell("sensor", self.material.name, self.r_gap_in, self.r_gap_out, self.half_length, self.material)
        radius, support = sensor.r_out, []
        for part in self.support:
            r_in, radius = radius, radius + part.thickness
            support.append(Shell("support", part.label, r_in, radius, self.half_length, part.material))
        return ((sensor,), tuple(support)) if support else ((sensor,),)


Layer = CgemLayer | MeasurementLayer


#: mm, between which the width of drifting electrons is a straight line: within 2 % of the root from 0.05 mm on.
_NODES = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 102.4)


@dataclass(frozen=True, kw_only=True)
class WireLayer(Part):
    """One layer of drift cells.

    Wire i starts at z = +half_length at azimuth phi_east + 2 pi i/cells and ends at z = -half_length at that azimuth
    minus the twist, both at radius r_end; it is straight.

    Examples
    --------
    >>> layer = cg.load("besiii-cgem").drift_chamber.layers[0]
    >>> layer.number, layer.cells, layer.sigma
    (8, 76, 0.13)
    """

    number: int
    cells: int = field(metadata=key("integer", "number of drift cells", 3, 10_000))
    r_end: float = field(metadata=key("length", "radius of the wires at the end plates", 1.0, 3000.0))  # mm
    half_length: float = field(metadata=key("length", "half length of the wires along the beam", 1.0, 5000.0))  # mm
    twist_cells: float = field(metadata=key("dimensionless", "azimuth at +z minus at -z, in cells", -500.0, 500.0))
    phi_east: float = field(metadata=key("angle", "azimuth of wire 0 at +z", -2 * math.pi, 2 * math.pi))  # rad
    sigma: float = field(metadata=key("length", "error of the drift distance at the wire", 1e-3, 10.0))  # mm
    sigma_slope: float = field(
        metadata=key("slope", "change of that error with drift distance", -0.1, 0.1), default=0.0
    )
    sigma_points: tuple[ErrorPoint, ...] = field(
        metadata=key("errors", "that error at some distances, instead of sigma and sigma_slope"), default=()
    )
    diffusion: float | None = field(  # mm/sqrt(mm)
        metadata=key("diffusion", "of drifting electrons, whose width adds to that error in quadrature", 0.0, 1.0),
        default=None,
    )
    efficiency: float = field(metadata=key("dimensionless", "probability that a cell fires", 0.0, 1.0), default=1.0)
    wire_x0: float = field(
        metadata=key("dimensionless", "mean X/X0 of the layer's wires, used if smeared", 0.0, 0.01), default=0.0
    )
    cell_wires: tuple[CellWire, ...] = field(
        metadata=key("wires", "wires or tubes of each cell, instead of wire_x0"), default=()
    )
    gas: Material | None = field(metadata=key("gas", "gas around the layer (default: the chamber's)"), default=None)
    signal_speed: float = field(  # mm/ns
        metadata=key("speed", "speed of signals along the wire; 0: unknown", 0.0, 300.0), default=0.0
    )
    readout_end: str = field(
        metadata=key(
            "text", "end of the wires that is read out; alternating: -z in even layers, +z in odd ones",
            choices=("unknown", "-z", "+z", "alternating"),
        ),
        default="unknown",
    )  # fmt: skip

    @cached_property
    def twist(self) -> float:
        """Azimuth at the +z end minus azimuth at the -z end, rad."""
        return self.twist_cells * 2 * math.pi / self.cells

    @cached_property
    def r_mid(self) -> float:
        """Radius of the wires at z = 0, mm."""
        return self.r_end * math.cos(0.5 * self.twist)

    def error_at(self, distance: Floats | float) -> Any:
        """Return the error of drift distances from 0 on; both in mm."""
        nodes, errors = self.error_table
        if not len(nodes):
            return self.sigma + self.sigma_slope * distance
        return np.interp(distance, nodes, errors)

    @cached_property
    def error_table(self) -> tuple[Floats, Floats]:
        """Distances and errors, mm, between which the error is a straight line; empty if it is one everywhere."""
        points = [one.distance for one in self.sigma_points]
        if not points and not self.diffusion:
            return np.empty(0), np.empty(0)
        nodes = np.array(sorted({0.0, *points, *(_NODES if self.diffusion else ())}))
        if points:
            own = np.interp(nodes, points, [one.sigma for one in self.sigma_points])
        else:
            own = self.sigma + self.sigma_slope * nodes
        return nodes, np.hypot(own, (self.diffusion or 0.0) * np.sqrt(nodes))

    def wire_matter(self, wire_material: Material) -> tuple[tuple[Material, float], ...]:
        """Return materials and mean X/X0 of the layer's wires at normal incidence and z = 0.

        Of n wires with the cross-section A for each of N cells, a circle at the radius r of the wires crosses
        N n A/cos(stereo angle): spread over the circle they are N n A/(2 pi r cos(stereo angle)) thick.

        Parameters
        ----------
        wire_material : Material
            Of wires given by `wire_x0`.
        """
        if not self.cell_wires:
            return ((wire_material, self.wire_x0),) if self.wire_x0 else ()
        longer = math.hypot(1.0, self.r_end * math.sin(0.5 * self.twist) / self.half_length)
        per_area = self.cells * longer / (2 * math.pi * self.r_mid)
        return tuple((one.material, one.number * one.area * per_area / one.material.x0) for one in self.cell_wires)

    def radius_at(self, z: float) -> float:
        """Return the radius of the wires, or of their continuation, at z; both in mm."""
        return math.hypot(self.r_mid, self.r_end * math.sin(0.5 * self.twist) * z / self.half_length)

    @property
    def z_readout(self) -> float:
        """Z of the end of the wires that is read out, mm; NaN if unknown."""
        ends = {"-z": -1.0, "+z": 1.0, "alternating": 1.0 if self.number % 2 else -1.0}
        return ends.get(self.readout_end, math.nan) * self.half_length

    def end_points(self, wire: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Return the ends of a wire, (x, y, z) in mm: first the one at +z, then the one at -z."""
        east = self.phi_east + 2 * math.pi * wire / self.cells
        west = east - self.twist
        return (
            (self.r_end * math.cos(east), self.r_end * math.sin(east), self.half_length),
            (self.r_end * math.cos(west), self.r_end * math.sin(west), -self.half_length),
        )


#: Keys of parts that are lists of parts with a material.
STACKS: dict[type, tuple[str, ...]] = {
    CgemLayer: ("cathode", "foil", "anode"),
    MeasurementLayer: ("support",),
    WireLayer: ("cell_wires",),
}


def _of_wires(name: str) -> Any:
    """Return a dataclass field like that of a wire layer."""
    one = WireLayer.__dataclass_fields__[name]
    return field(metadata=one.metadata, default=one.default)


@dataclass(frozen=True, kw_only=True)
class Superlayer(Part):
    """Wire layers of a detector file that follow from a few numbers (docs/methods/detector.md).

    Examples
    --------
    >>> rows = {"A": {"layers": 8, "r_in": "350 mm", "cells": 192, "stereo": ["50 mrad", "-50 mrad"]}}
    >>> chamber = {"gas": "MdcGas", "sigma": "100 um", "half_length": "2000 mm", "superlayers": rows}
    >>> wires = cg.load({"field": {"bz": "2 T"}, "drift_chamber": chamber}).drift_chamber.layers
    >>> [(layer.cells, round(layer.r_mid, 1), round(layer.r_end, 1)) for layer in wires[:2]]
    [(192, 355.8, 369.6), (192, 367.7, 381.0)]
    """

    label: str
    layers: int = field(metadata=key("integer", "number of wire layers", 1, 1000))
    r_in: float | None = field(  # None: where the superlayer before ends
        metadata=key("length", "inner border of the cells of the first layer at z = 0", 1.0, 3000.0), default=None
    )
    cells: int | float = field(metadata=key("cells", "cells of each layer, or their width at z = 0"))
    height: float | None = field(  # None: the width of the cells
        metadata=key("length", "radial size of the cells at z = 0", 0.5, 1000.0), default=None
    )
    stereo: tuple[float, ...] = field(
        metadata=key("angles", "angle of the wires to the beam axis, of the layers in turn", -1.0, 1.0), default=()
    )
    twist: tuple[float, ...] = field(
        metadata=key(
            "angles", "azimuth at +z minus at -z, instead of stereo, of the layers in turn", -math.pi / 2, math.pi / 2
        ),
        default=(),
    )
    stagger: bool = field(metadata=key("boolean", "whether odd layers are turned by half a cell"), default=True)
    half_length: float = _of_wires("half_length")  # mm
    sigma: float = _of_wires("sigma")  # mm
    sigma_slope: float = _of_wires("sigma_slope")
    sigma_points: tuple[ErrorPoint, ...] = _of_wires("sigma_points")
    diffusion: float | None = _of_wires("diffusion")  # mm/sqrt(mm)
    efficiency: float = _of_wires("efficiency")
    wire_x0: float = _of_wires("wire_x0")
    cell_wires: tuple[CellWire, ...] = _of_wires("cell_wires")
    gas: Material | None = _of_wires("gas")  # noqa: RUF009 (a Material is no function)
    signal_speed: float = _of_wires("signal_speed")  # mm/ns
    readout_end: str = _of_wires("readout_end")


@dataclass(frozen=True, kw_only=True, repr=False)
class DriftChamber(Placed):
    """A drift chamber: wire layers in one gas.

    Examples
    --------
    >>> chamber = cg.load("besiii-cgem").drift_chamber
    >>> chamber.text().split(", ")[:4]
    ['35 layers', '6312 cells', 'r = 197.0 to 763.5 mm', 'gas MdcGas']
    >>> chamber.layers[0].number
    8
    """

    gas: Material = field(metadata=key("gas", "gas of the chamber"))
    wires: str = field(
        metadata=key(
            "text",
            "matter of the wires: ignored, or spread over the gas (default with cell_wires)",
            choices=("none", "smeared"),
        ),
        default="none",
    )
    drift_relation: tuple[DriftPoint, ...] = field(
        metadata=key("relation", "drift distance against drift time"), default=()
    )
    drift_velocity: float | None = field(  # mm/ns
        metadata=key("speed", "constant drift velocity, instead of drift_relation", 1e-4, 1.0), default=None
    )
    wire_material: Material = field(metadata=key("material", "material of smeared wires (default Al)", derived=True))
    first_gid: int = field(
        metadata=key("integer", "running number of the innermost layer's wire 0", 0, 1_000_000), default=0
    )
    layers: tuple[WireLayer, ...] = ()
    # What the layers were made of, for changes by `with_overrides`; no part of the content.
    superlayers: tuple[Superlayer, ...] = field(default=(), compare=False)

    def __repr__(self) -> str:
        return f"<drift chamber: {self.text()}>"

    def _repr_html_(self) -> str:
        return f"<b>drift chamber</b> {escape(self.text())}"

    def text(self) -> str:
        """Return the chamber in one line."""
        cells = sum(layer.cells for layer in self.layers)
        reach = f", r = {self.layers[0].r_mid:.1f} to {self.layers[-1].r_end:.1f} mm" if self.layers else ""
        matter = "not counted"
        if self.wires == "smeared":
            found = [one for layer in self.layers for one in layer.wire_matter(self.wire_material)]
            names = " and ".join(dict.fromkeys(material.name for material, _ in found))
            matter = f"{names}, {100 * sum(x0 for _, x0 in found):.3g} % X0, spread over the gas"
        gases = " and ".join(dict.fromkeys((layer.gas or self.gas).name for layer in self.layers)) or self.gas.name
        wires = f"{len(self.layers)} layers, {cells} cells{reach}, gas {gases}"
        return f"{wires}, matter of the wires {matter}, drift times {self.drift_text()}{self.moved_text()}"

    def drift_text(self) -> str:
        """Return where drift times come from."""
        if self.drift_velocity:
            return f"of {1000 * self.drift_velocity:g} um/ns"
        return f"of a table of {len(self.drift_relation)} points" if self.drift_relation else "as in BESIII"

    @property
    def gid_first(self) -> tuple[int, ...]:
        """Running number of wire 0 of each layer."""
        return tuple(accumulate((layer.cells for layer in self.layers[:-1]), initial=self.first_gid))


L = TypeVar("L", bound=Cylinder | CgemLayer | MeasurementLayer, covariant=True)


class Labelled(tuple[L, ...]):
    """Parts from inside outward, picked by number or by label.

    Raises
    ------
    KeyError
        If no part has the label.

    Examples
    --------
    >>> det = cg.load("besiii-cgem")
    >>> det.cgem["L2"] is det.cgem[1], [layer.label for layer in det.cgem]
    (True, ['L1', 'L2', 'L3'])
    """

    __slots__ = ()

    @overload
    def __getitem__(self, key: SupportsIndex | str, /) -> L: ...
    @overload
    def __getitem__(self, key: slice, /) -> tuple[L, ...]: ...
    def __getitem__(self, key: SupportsIndex | slice | str, /) -> L | tuple[L, ...]:
        if not isinstance(key, str):
            return super().__getitem__(key)
        labels = self._ipython_key_completions_()
        if key not in labels:
            known = ", ".join(labels) or "there are none"
            raise KeyError(f"got label {key!r}; expected one of {known}{did_you_mean(key, labels, '; ')}")
        return self[labels.index(key)]

    def _ipython_key_completions_(self) -> list[str]:
        return [part.label for part in self]


@dataclass(frozen=True, kw_only=True)
class Contents(Part):
    """What a detector consists of, parts ordered from the beam line outward; a `Detector` is this, checked."""

    name: str
    description: str
    field: Field
    beam_pipe: Labelled[Cylinder]
    cgem: Labelled[CgemLayer]
    layer: Labelled[MeasurementLayer]
    walls: Labelled[Cylinder]
    drift_chamber: DriftChamber | None
    background: tuple[BackgroundLevel, ...] = ()  # by label
    air: Material  # fills the space between parts inside the drift chamber

    def __post_init__(self) -> None:
        for name in ("beam_pipe", "cgem", "layer", "walls"):
            object.__setattr__(self, name, Labelled(getattr(self, name)))

    @property
    def layers(self) -> Labelled[Layer]:
        """The cylinders that measure, CGEM layers and others, by radius; tables number them from 0."""
        return layers_of(self)


@once
def layers_of(detector: Contents) -> Labelled[Layer]:
    """Return the cylinders that measure, by radius.

    Parameters
    ----------
    detector : Contents
    """
    others = [layer for layer in detector.layer if layer.views]
    return Labelled(sorted([*detector.cgem, *others], key=lambda layer: layer.r_mid)) if others else detector.cgem


@once
def cgem_numbers(detector: Contents) -> tuple[int, ...]:
    """Return the numbers of the CGEM layers among all layers.

    Parameters
    ----------
    detector : Contents
    """
    return tuple(number for number, layer in enumerate(detector.layers) if isinstance(layer, CgemLayer))


def cgem_layers(detector: Contents, cgem: tuple[int, ...] | None = None) -> tuple[CgemLayer, ...]:
    """Return some CGEM layers, or all of them.

    Parameters
    ----------
    detector : Contents
    cgem : tuple of int or None
        Their numbers among all layers; None: all CGEM layers.
    """
    if cgem is None:
        return detector.cgem
    return tuple(layer for layer in map(detector.layers.__getitem__, cgem) if isinstance(layer, CgemLayer))


def local_v(layer: Layer, x: Floats | float, z: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, of points with X and z, (n,) float64 mm."""
    return np.asarray(x * np.cos(layer.stereo) + (layer.z_ref - z) * np.sin(layer.stereo))


def pitches(layer: Layer) -> tuple[float, float]:
    """Return the pitches of X and V strips, mm; of positions that no strip measures the width of the layer."""
    if isinstance(layer, CgemLayer):
        return layer.pitch_x, layer.pitch_v
    return 2 * math.pi * layer.radius / layer.strips_x, layer.pitch_v or layer.extent_v


def strips_of_v(layer: CgemLayer, v: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, counted in V strips: i is the edge where strip i begins."""
    return np.asarray(np.divide(v, layer.pitch_v) - layer.offset_v)


def v_of_strips(layer: CgemLayer, strips: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, of positions counted in V strips: i is the edge where strip i begins."""
    return np.asarray(np.add(strips, layer.offset_v) * layer.pitch_v)


def crossing_z(layer: Layer, x: Floats | float, v: Floats | float) -> Floats:
    """Return z, (n,) float64 mm, at which lines of constant V meet those of constant X, (n,) float64 mm."""
    return np.asarray(layer.z_ref - (v - x * np.cos(layer.stereo)) / np.sin(layer.stereo))


def extent(detector: Contents) -> tuple[float, float]:
    """Return the outermost radius and |z| of a detector's parts, mm."""
    cylinders = [*detector.beam_pipe, *detector.walls]
    measuring: list[Layer] = [*detector.cgem, *detector.layer]
    radii = [part.r_out for part in cylinders] + [layer.r_out for layer in measuring]
    lengths = [part.half_length for part in cylinders] + [layer.half_length for layer in measuring]
    for wire in detector.drift_chamber.layers if detector.drift_chamber else ():
        radii.append(wire.r_end)
        lengths.append(wire.half_length)
    return max(radii, default=0.0), max(lengths, default=0.0)
