"""What layers that make clusters have in common: a cylinder that measures X and V, and the matter around it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from html import escape
from itertools import chain
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problem, Problems
from cgemit.detector.keys import Key, Part, key
from cgemit.detector.material import Material
from cgemit.detector.readouts.positions import Precision
from cgemit.detector.readouts.readout import Readout
from cgemit.detector.shells import Bounded, Shell, Slab

FAR, _TILT, ROTATION = 2.0, 2e-3, 1e-2  # mm, rad: beyond, hits would be sought at other wires and strips
_LAYER_Z, _LAYER_ROTATION = 10.0, 3e-2  # mm, rad: a layer of strips or positions that moves along itself


@dataclass(frozen=True, kw_only=True)
class Placed(Part):
    """A part with six degrees of freedom: it is turned about the x, then y, then z axis, and then shifted."""

    shift_x: float = field(
        metadata=key("length", "shift of the part along x", -FAR, FAR, quiet=True), default=0.0
    )  # mm
    shift_y: float = field(
        metadata=key("length", "shift of the part along y", -FAR, FAR, quiet=True), default=0.0
    )  # mm
    shift_z: float = field(
        metadata=key("length", "shift of the part along the beam", -FAR, FAR, quiet=True), default=0.0
    )  # mm
    tilt_x: float = field(
        metadata=key("angle", "turn of the part about the x axis", -_TILT, _TILT, quiet=True), default=0.0
    )
    tilt_y: float = field(
        metadata=key("angle", "turn of the part about the y axis", -_TILT, _TILT, quiet=True), default=0.0
    )
    rotation: float = field(
        metadata=key("angle", "turn of the part about the beam axis", -ROTATION, ROTATION, quiet=True), default=0.0
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


#: Largest number of readout sheets of a layer.
MOST_SHEETS = _core.detector.MOST_SHEETS

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
class SubLayer(Part):
    """One material of an electrode of a CGEM layer.

    Examples
    --------
    >>> layer = cg.load("besiii-cgem").cgem["L1"]
    >>> [(part.label, part.material.name, part.thickness) for part in layer.foil]
    [('Cu1', 'CuFoil', 0.005), ('Kapton', 'KaptonFoil', 0.05), ('Cu2', 'CuFoil', 0.005)]
    """

    extra_keys = MappingProxyType({"label": Key("text", doc="label of the sub-layer; the material's name if left out")})

    label: str
    material: Material = field(metadata=key("material", "name of the material"))
    thickness: float = field(metadata=key("length", "thickness", 1e-5, 50.0))  # mm

    def __hash__(self) -> int:
        return hash((self.label, self.thickness))  # as for materials: caches look up stacks often


StripRanges = tuple[tuple[int, int, int], ...]


@dataclass(frozen=True, kw_only=True, repr=False)
class Layer(Placed, Bounded, ABC):
    """A layer that makes clusters: a readout surface with views X and V, and the matter around it.

    A kind of layer is a subclass in a file of its own, and a word in `cgemit.detector.layers.LAYER_KINDS`. It states
    with a `key` which of the fields below a detector file may hold, and adds its own. The other fields keep the values
    here: one sheet, without seams, dead or hot strips.

    Attributes
    ----------
    group : str
        Table of a detector file that holds layers of the kind.
    about : str
        What is in this table.
    name : str
        Of the kind, for texts.
    readouts : mapping
        Readouts that the kind may have, by name.
    usual_readout : Readout
        Of a layer that states none.
    sensitive : str
        Group of the shells in which a crossing is measured.
    """

    group: ClassVar[str]
    about: ClassVar[str]
    name: ClassVar[str]
    readouts: ClassVar[Mapping[str, type[Readout]]]
    usual_readout: ClassVar[Readout]
    sensitive: ClassVar[str]

    short_form: ClassVar[tuple[str, float]] = ("length", 1.0)

    shift_z: float = field(
        metadata=key("length", "shift of the part along the beam", -_LAYER_Z, _LAYER_Z, quiet=True), default=0.0
    )  # mm
    rotation: float = field(
        metadata=key("angle", "turn of the part about the beam axis", -_LAYER_ROTATION, _LAYER_ROTATION, quiet=True),
        default=0.0,
    )

    label: str
    length: float  # mm, active length along the beam
    readout: Readout = field(hash=False)  # one from outside the package may have no hash
    efficiency: float = 1.0
    gas: Material | None = None  # that crossing tracks ionize; None: a solid
    drift_gap: float = 0.0  # mm of gas that a track straight on crosses
    sheets: int = 1
    phi_first: float = math.pi  # rad, azimuth of X = 0 of the first sheet
    stereo: float  # rad, of V strips
    strips_x: int  # of a sheet
    strips_v: int
    pitch_x: float  # mm
    pitch_v: float
    offset_v: float = 0.0
    dead_x: StripRanges = ()
    dead_v: StripRanges = ()
    hot_x: StripRanges = ()
    hot_v: StripRanges = ()
    dead_seam: float = 0.0
    dead_ends: float = 0.0
    ladders: int = 0
    ladder_gap: float = 0.0  # mm
    ladder_phi: float = 0.0  # rad
    sheet_shift_z: tuple[float, ...] = ()  # mm
    sheet_rotation: tuple[float, ...] = ()  # rad
    gain_map: tuple[tuple[tuple[float, ...], ...], ...] = ()
    lorentz_shift: float | None = None
    z_scale: float = 0.0

    def __repr__(self) -> str:
        return f"<{self.name} {self.label}: {self.text()}>"

    def _repr_html_(self) -> str:
        return f"<b>{self.name} {escape(self.label)}</b> {escape(self.text())}"

    @property
    def path(self) -> str:
        """Dotted key of the layer in a detector file."""
        return f"{self.group}.{self.label}"

    # What a detector file has of it

    @classmethod
    @abstractmethod
    def complete(cls, path: str, values: dict[str, Any], problems: Problems) -> None:
        """Add what follows from other values (native units) of a table where it is missing; take out short forms."""

    @classmethod
    @abstractmethod
    def drop_replaced(cls, base: dict[str, Any], variant: Mapping[str, Any]) -> None:
        """Remove from the table of a base what the values of a variant replace, and what follows from those."""

    @abstractmethod
    def problems(self) -> list[Problem]:
        """Return what is impossible about the layer alone, beside values out of the range of their key."""

    @abstractmethod
    def design_keys(self) -> Iterator[str]:
        """Yield the keys of the layer that `cgemit.sensitivity` varies by default."""

    def smooth(self, base: Layer) -> Layer:
        """Return the layer of a variant with what follows from its size following continuously, not in whole strips."""
        return self

    def with_readout(self, readout: Readout) -> Layer:
        """Return the layer with another readout, as it is if its kind has no such readouts."""
        return replace(self, readout=readout) if readout.name in self.readouts else self

    # Texts

    @abstractmethod
    def text(self) -> str:
        """Return the layer in one line."""

    @abstractmethod
    def described(self) -> dict[str, Any]:
        """Return the numbers of the layer that `cgemit show --json` prints."""

    # Where it is

    @property
    @abstractmethod
    def r_readout(self) -> float:
        """Radius R of X = R (phi - phi_first), mm."""

    @property
    @abstractmethod
    def r_gap_in(self) -> float:
        """Radius where a crossing begins, mm."""

    @property
    @abstractmethod
    def r_gap_out(self) -> float:
        """Radius where a crossing ends, mm."""

    @property
    @abstractmethod
    def r_in(self) -> float:
        """Inner face, mm."""

    @property
    @abstractmethod
    def r_out(self) -> float:
        """Outer face, mm."""

    @property
    def r_mid(self) -> float:
        """Radius of the middle of the crossing, where hits are, mm."""
        return 0.5 * (self.r_gap_in + self.r_gap_out)

    @property
    def half_length(self) -> float:
        """Half of the active length, mm."""
        return 0.5 * self.length

    def ends_within(self, radius: float) -> tuple[float, float]:
        """Return the z between which the layer is within a radius, mm; the first above the last if it is nowhere."""
        return self.ends if self.r_gap_out <= radius else (math.inf, -math.inf)

    @property
    def z_ref(self) -> float:
        """The end from which V is counted, mm."""
        low, high = self.ends
        return (high if self.stereo > 0 else low) * (1 + self.z_scale)

    @property
    def sin_stereo(self) -> float:
        """What V falls by with z: the sine of the stereo angle, less where the pattern of strips is longer."""
        return math.sin(self.stereo) / (1 + self.z_scale)

    @property
    def sheet_phi(self) -> tuple[float, ...]:
        """Azimuth of X = 0 of each sheet, rad in (-pi, pi]."""
        turns = (self.phi_first + 2 * math.pi * i / self.sheets for i in range(self.sheets))
        if own := self.sheet_rotation:
            turns = (phi + own[i % len(own)] for i, phi in enumerate(turns))
        return tuple(math.pi - (math.pi - phi) % (2 * math.pi) for phi in turns)

    @property
    def sheet_z(self) -> tuple[float, ...]:
        """Shift of each sheet along the beam in the layer, mm."""
        own = self.sheet_shift_z or (0.0,)
        return tuple(own[i % len(own)] for i in range(self.sheets))

    @property
    def ladder_first(self) -> float:
        """X of the middle of a gap between ladders, mm."""
        return self.r_readout * (self.ladder_phi - self.phi_first)

    def sheet_at(self, phi: Floats) -> Any:
        """Return the sheet of azimuths, (n,) int, each the one that begins last before it."""
        return np.argmin([np.remainder(phi - start, 2 * np.pi) for start in self.sheet_phi], axis=0)

    # What it measures

    @property
    def views(self) -> tuple[str, ...]:
        """Coordinates that are measured: X, V, both or none."""
        return ("X", "V")

    @property
    def pitches(self) -> tuple[float, float]:
        """Pitches of X and V strips, mm; of positions that no strip measures the width of the layer."""
        return self.pitch_x, self.pitch_v

    @property
    def precision(self) -> Precision:
        """How positions are measured, unless the readout says it: in the middle of strips."""
        return Precision(0.0, 0.0, 0.0)

    @property
    def errors(self) -> tuple[float, float]:
        """Errors of X and V, mm, without those of the readout; 0 where it is not measured."""
        return self.precision.errors(self.pitch_x, self.pitch_v)

    @property
    def error_slope(self) -> float:
        """Growth of errors with the path in the sensor, projected on X or V; added in quadrature."""
        return 0.0

    @property
    def measures_points(self) -> bool:
        """Whether X and V of a crossing are known to belong together."""
        return False

    @property
    def card_errors(self) -> tuple[float, float]:
        """Errors of X and V in a Delphes card, mm; 0 where it is not measured."""
        return self.errors

    def rings(self) -> Iterator[tuple[str, float, float]]:
        """Yield the name and the radii, mm, of what pictures of a detector show of it."""
        yield "layer" if self.views else "wall", self.r_in, self.r_out

    def card_label(self, group: str) -> str:
        """Return the label of a group of sub-layers in a Delphes card.

        Parameters
        ----------
        group : str
            As of `Shell`.
        """
        return f"{self.label}-{group}"

    # What it is made of

    @abstractmethod
    def stacks(self) -> tuple[tuple[Shell, ...], ...]:
        """Return the sub-layers from inside in groups that act as one scatterer each."""

    def shells(self) -> Iterator[Shell]:
        """Yield every sub-layer, gaps included, from inside."""
        return chain.from_iterable(self.stacks())

    def slabs(self, number: int, merge: bool, lattice: bool, first_foil: int) -> tuple[Slab, ...]:
        """Return the matter as slabs; see `cgemit.detector.slabs`.

        Parameters
        ----------
        number : int
            Of the layer in the detector; -1: it measures nothing.
        merge : bool
        lattice : bool
            Whether foils have holes.
        first_foil : int
            Running number of the layer's first foil in the detector.
        """
        return slabs_of(self.stacks(), self.sensitive, number, merge)

    @abstractmethod
    def materials(self) -> Iterator[Material]:
        """Yield the materials."""


#: Key `readout` of a layer.
READOUT_KEY = key(
    "readout", "name of the readout, or a table with its name and what differs from its defaults", derived=True
)


def whole(rounded: Callable[[float], int], value: float) -> int:
    """Return a rounded number; one that could not be read stays unusable, its problem has been noted."""
    return value if math.isnan(value) else rounded(value)  # type: ignore[return-value]


def slabs_of(stacks: Iterable[tuple[Shell, ...]], sensitive: str, layer_number: int, merge: bool) -> tuple[Slab, ...]:
    """Return groups of sub-layers as slabs: each as one, or each sub-layer, but for the group that measures."""
    slabs = []
    for shells in stacks:
        gap = layer_number if shells[0].group == sensitive else -1
        slabs += [Slab(part, gap) for part in ([shells] if merge else [(shell,) for shell in shells])]
    return tuple(slabs)


#: Sheet and strips of a list of strips.
STRIPS = r"([0-9]{1,2}):([0-9]{1,6})(?:-([0-9]{1,6}))?"


def strip_text(sheet: int, first: int, last: int) -> str:
    """Return a range of strips as a file has it, such as ``0:17`` or ``1:100-120``."""
    return f"{sheet}:{first}" if first == last else f"{sheet}:{first}-{last}"


def local_v(layer: Layer, x: Floats | float, z: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, of points with X and z, (n,) float64 mm."""
    return np.asarray(x * np.cos(layer.stereo) + (layer.z_ref - z) * layer.sin_stereo)


def crossing_z(layer: Layer, x: Floats | float, v: Floats | float) -> Floats:
    """Return z, (n,) float64 mm, at which lines of constant V meet those of constant X, (n,) float64 mm."""
    return np.asarray(layer.z_ref - (v - x * np.cos(layer.stereo)) / layer.sin_stereo)
