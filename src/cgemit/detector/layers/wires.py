"""Wire layers and the drift chamber that they are in."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from itertools import accumulate
from typing import Any, ClassVar

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import Problem
from cgemit.detector.keys import Part, key, once, open_table, table_in
from cgemit.detector.layers.layer import FAR, ROTATION, Placed
from cgemit.detector.material import Material
from cgemit.detector.shells import TOUCH, Bounded


@dataclass(frozen=True, kw_only=True)
class DriftPoint(Part):
    """A point of the relation of drift distance and drift time.

    Examples
    --------
    >>> points = [{"distance": "0 mm", "time": "0 ns"}, {"distance": "9 mm", "time": "350 ns"}]
    >>> det = cg.load("idea-like").with_overrides({"drift_chamber.drift_relation": points})
    >>> [(one.distance, one.time) for one in det.drift_chamber.layers[0].drift_relation]
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


#: mm, between which the width of drifting electrons is a straight line: within 2 % of the root from 0.05 mm on.
_NODES = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 51.2, 102.4)


WireRanges = tuple[tuple[int, int], ...]

#: Wires of a list of wires.
WIRES = r"([0-9]{1,6})(?:-([0-9]{1,6}))?"


def wire_text(first: int, last: int) -> str:
    """Return a range of wires as a file has it, such as ``17`` or ``100-120``."""
    return f"{first}" if first == last else f"{first}-{last}"


def _of_end(kind: str, doc: str, most: float) -> Any:
    """Return the field of a displacement of the wires' ends."""
    return field(metadata=key(kind, doc, -most, most, quiet=True), default=0.0)


#: Keys of the displacement of the wires' ends.
END_SHIFT = ("east_shift_x", "east_shift_y", "east_rotation", "west_shift_x", "west_shift_y", "west_rotation")
#: Of the displacement of the ends of single wires: outward, and along phi.
WIRE_SHIFT = ("east_shift_r", "east_shift_phi", "west_shift_r", "west_shift_phi")


def _of_each(doc: str) -> Any:
    """Return the field of displacements of the ends of single wires."""
    return field(metadata=key("shifts", doc, -FAR, FAR, quiet=True), default=())


@dataclass(frozen=True, kw_only=True)
class WireLayer(Placed, Bounded):
    """One layer of drift cells.

    Wire i starts at z_max at azimuth phi_east + 2 pi i/cells and ends at z_min at that azimuth minus the twist, both at
    radius r_end; it is straight. The ends at +z (east) or -z (west) are displaced wire by wire, outward and along phi
    where the description has them, then turned together about the beam line, then shifted; the layer as a whole is then
    displaced in the chamber, and the chamber with it.

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
    drift_relation: tuple[DriftPoint, ...] = field(
        metadata=key("relation", "drift distance against drift time (default: as in BESIII)", quiet=True), default=()
    )
    drift_velocity: float | None = field(  # mm/ns
        metadata=key("speed", "constant drift velocity, instead of drift_relation", 1e-4, 1.0, quiet=True),
        default=None,
    )
    t0: float = field(  # ns
        metadata=key("time", "drift time of a signal at the wire, added to that relation", -1e5, 1e5, quiet=True),
        default=0.0,
    )
    east_shift_x: float = _of_end("length", "shift of the wires' ends at +z along x", FAR)  # mm
    east_shift_y: float = _of_end("length", "shift of the wires' ends at +z along y", FAR)  # mm
    east_rotation: float = _of_end("angle", "turn of the wires' ends at +z about the beam axis", ROTATION)  # rad
    west_shift_x: float = _of_end("length", "shift of the wires' ends at -z along x", FAR)  # mm
    west_shift_y: float = _of_end("length", "shift of the wires' ends at -z along y", FAR)  # mm
    west_rotation: float = _of_end("angle", "turn of the wires' ends at -z about the beam axis", ROTATION)  # rad
    # mm, of every wire; empty: 0
    wires_east_shift_r: tuple[float, ...] = _of_each("shift of the end at +z of each wire, away from the beam line")
    wires_east_shift_phi: tuple[float, ...] = _of_each("shift of the end at +z of each wire, along phi")
    wires_west_shift_r: tuple[float, ...] = _of_each("shift of the end at -z of each wire, away from the beam line")
    wires_west_shift_phi: tuple[float, ...] = _of_each("shift of the end at -z of each wire, along phi")
    # (first wire, last wire) each.
    dead: WireRanges = field(metadata=key("channels", "wires that never fire", quiet=True), default=())
    hot: WireRanges = field(metadata=key("channels", "wires that fire in every event", quiet=True), default=())

    @cached_property
    def twist(self) -> float:
        """Azimuth at the +z end minus azimuth at the -z end, rad."""
        return self.twist_cells * 2 * math.pi / self.cells

    @cached_property
    def r_mid(self) -> float:
        """Radius of the wires in their middle, mm."""
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
            sigma = np.interp(nodes, points, [one.sigma for one in self.sigma_points])
        else:
            sigma = self.sigma + self.sigma_slope * nodes
        return nodes, np.hypot(sigma, (self.diffusion or 0.0) * np.sqrt(nodes))

    def wire_matter(self, wire_material: Material) -> tuple[tuple[Material, float], ...]:
        """Return materials and mean X/X0 of the layer's wires at normal incidence, in their middle.

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

    def drift_text(self) -> str:
        """Return where drift times come from."""
        if self.drift_velocity:
            text = f"of {1000 * self.drift_velocity:g} um/ns"
        elif self.drift_relation:
            text = f"of a table of {len(self.drift_relation)} points"
        else:
            text = "as in BESIII"
        return f"{text} from {self.t0:g} ns" if self.t0 else text

    def radius_at(self, z: float) -> float:
        """Return the radius of the wires, or of their continuation, at z; both in mm."""
        along = (z - self.z_mid) / self.half_length
        return math.hypot(self.r_mid, self.r_end * math.sin(0.5 * self.twist) * along)

    @property
    def z_readout(self) -> float:
        """Z of the end of the wires that is read out, mm; NaN if unknown."""
        low, high = self.ends
        return {"-z": low, "+z": high, "alternating": high if self.number % 2 else low}.get(self.readout_end, math.nan)

    @property
    def end_shift(self) -> tuple[float, ...]:
        """Displacement of the ends, (6,): x, y (mm) and rotation (rad) of those at +z, then of those at -z."""
        return tuple(getattr(self, name) for name in END_SHIFT)

    @once
    def wire_shifts(self) -> Floats | None:
        """Return the displacements of the ends of single wires, (cells, 4) mm as in `WIRE_SHIFT`; None: none."""
        given = [getattr(self, f"wires_{name}") for name in WIRE_SHIFT]
        if not any(map(any, given)):
            return None
        return np.stack([np.array(one or np.zeros(self.cells)) for one in given], axis=1)

    def wire_ends(self, wires: Any) -> Floats:
        """Return the ends of wires in the axes of the chamber, (n, 2, 3) mm: those at +z, then those at -z.

        Parameters
        ----------
        wires : array_like, (n,) int
        """
        nominal = self.phi_east + 2 * math.pi * np.asarray(wires) / self.cells
        (low, high), shifts = self.ends, (self.end_shift[:3], self.end_shift[3:])
        single, ends = self.wire_shifts(), []
        for i, (azimuth, z, (x, y, turn)) in enumerate(
            zip((nominal, nominal - self.twist), (high, low), shifts, strict=True)
        ):
            r, aside = self.r_end, 0.0
            if single is not None:
                out, aside = np.moveaxis(single[wires, 2 * i : 2 * i + 2], -1, 0)
                r = r + out
            c, s = np.cos(azimuth + turn), np.sin(azimuth + turn)
            across = r * c - aside * s + x, r * s + aside * c + y
            ends.append(np.stack([*across, np.full_like(across[0], z)], axis=-1))
        points = np.stack(ends, axis=-2)
        return points @ self.turn + self.shift if self.is_moved else points

    def end_points(self, wire: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Return the ends of a wire in the axes of the chamber, (x, y, z) in mm: first at +z, then at -z."""
        east, west = (tuple(map(float, end)) for end in self.wire_ends(wire))
        return east, west  # type: ignore[return-value]

    @property
    def path(self) -> str:
        """Dotted key of the layer in a detector file."""
        return f"drift_chamber.layers.{self.number}"

    @once
    def problems(self) -> list[Problem]:
        """Return what is impossible about the layer alone, beside values out of the range of their key."""
        problems = []  # none from the NaN of a value that could not be read
        if abs(self.twist) > math.pi / 2:
            given = f"{self.twist_cells:g} cells of {self.cells}"
            problems.append(Problem(f"{self.path}.twist_cells", given, "at most a quarter turn"))
        for name in WIRE_SHIFT:
            if self.cells > 0 and (n := len(getattr(self, f"wires_{name}"))) not in (0, self.cells):
                problems.append(Problem(f"{self.path}.wires_{name}", f"{n} values", f"{self.cells}, one for each wire"))
        for name in ("dead", "hot"):
            for i, (first, last) in enumerate(getattr(self, name)):
                if first > last or last >= self.cells:
                    expected = f"wires 0 to {self.cells - 1}, first to last"
                    problems.append(Problem(f"{self.path}.{name}[{i}]", wire_text(first, last), expected))
        return problems

    def ends_within(self, radius: float) -> tuple[float, float]:
        """Return the z between which wires are within a radius, mm; the first above the last if they are nowhere."""
        if self.r_end <= radius:
            return self.ends
        if self.r_mid > radius:
            return math.inf, -math.inf
        reach = self.half_length * math.sqrt((radius**2 - self.r_mid**2) / (self.r_end**2 - self.r_mid**2))
        return self.z_mid - reach, self.z_mid + reach

    def radii_between(self, low: float, high: float) -> tuple[float, float]:
        """Return the smallest and the largest radius of the wires between two z, mm; NaN where there are none.

        Parameters
        ----------
        low, high : float
            mm.
        """
        first, last = self.ends
        low, high = max(low, first), min(high, last)
        if not low <= high:
            return math.nan, math.nan
        nearest = min(max(self.z_mid, low), high)
        return self.radius_at(nearest), max(self.radius_at(low), self.radius_at(high))

    @property
    def tilt(self) -> float:
        """Angle of the wires to the beam, signed, rad."""
        return math.atan(self.r_end * math.sin(0.5 * self.twist) / self.half_length)

    def described(self, gid_first: int) -> dict[str, Any]:
        """Return the numbers of the layer that `cgemit show --json` prints.

        Parameters
        ----------
        gid_first : int
            Running number of wire 0.
        """
        return {
            "layer": self.number,
            "cells": self.cells,
            "gid_first": gid_first,
            "r_end_mm": self.r_end,
            "r_mid_mm": self.r_mid,
            "half_length_mm": self.half_length,
            "z_min_mm": self.ends[0],
            "z_max_mm": self.ends[1],
            "twist_deg": math.degrees(self.twist),
            "tilt_mrad": 1000 * self.tilt,
            "phi_east_deg": math.degrees(self.phi_east),
            "sigma_um": 1000 * self.sigma,
            "sigma_slope_um_per_mm": 1000 * self.sigma_slope,
            "efficiency": self.efficiency,
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

    short_form: ClassVar[tuple[str, float]] = Bounded.short_form

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
    z_min: float | None = _of_wires("z_min")  # mm
    z_max: float | None = _of_wires("z_max")  # mm
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
    drift_relation: tuple[DriftPoint, ...] = _of_wires("drift_relation")
    drift_velocity: float | None = _of_wires("drift_velocity")  # mm/ns
    t0: float = _of_wires("t0")  # ns


#: What the label of a wire layer must match, and its largest number.
WIRE_NUMBER, LAST_WIRE_LAYER = "0|[1-9][0-9]{0,4}", 65535

#: Keys of the ends of wires.
OF_ENDS = ("half_length", "z_min", "z_max")

#: Values of [drift_chamber] that hold for every layer which does not state its own; a new value in a variant
#: replaces the listed values of the base's layers.
FOR_ALL_LAYERS = {
    "sigma": ("sigma", "sigma_slope", "sigma_points"),
    "sigma_slope": ("sigma_slope", "sigma_points"),
    "sigma_points": ("sigma_points", "sigma", "sigma_slope"),
    "diffusion": ("diffusion",),
    "efficiency": ("efficiency",),
    "wire_x0": ("wire_x0", "cell_wires"),
    "cell_wires": ("cell_wires", "wire_x0"),
    "signal_speed": ("signal_speed",),
    "readout_end": ("readout_end",),
    "drift_relation": ("drift_relation", "drift_velocity"),
    "drift_velocity": ("drift_velocity", "drift_relation"),
    "t0": ("t0",),
}

#: Key of a drift chamber whose layers have been made of its superlayers.
GENERATED = "<generated>"


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
    wire_material: Material = field(metadata=key("material", "material of smeared wires (default Al)", derived=True))
    first_gid: int = field(
        metadata=key("integer", "running number of the innermost layer's wire 0", 0, 1_000_000), default=0
    )
    layers: tuple[WireLayer, ...] = ()
    # What the layers were made of, for changes by `with_overrides`; no part of the content.
    superlayers: tuple[Superlayer, ...] = field(default=(), compare=False)

    @staticmethod
    def drop_replaced(chamber: dict[str, Any], variant: Mapping[str, Any]) -> None:
        """Remove the values of the base's layers that the variant replaces; all layers if it changes superlayers."""
        changes, superlayers = table_in(variant, "drift_chamber"), table_in(chamber, "superlayers")
        for name in FOR_ALL_LAYERS.keys() & changes.keys():
            for group in (table_in(chamber, "layers"), superlayers):
                for layer in (open_table(group, label) for label in group):
                    for old in FOR_ALL_LAYERS[name]:
                        layer.pop(old, None)
        removed = str(variant.get("remove", ""))
        if (
            "superlayers" in changes
            or "drift_chamber.superlayers" in removed
            or (superlayers and changes.keys() & set(OF_ENDS))
        ):
            chamber.pop("layers", None)
            chamber.pop(GENERATED, None)
        tables = [changes, *table_in(changes, "layers").values(), *table_in(changes, "superlayers").values()]
        if "wires" not in changes and any(isinstance(one, Mapping) and "cell_wires" in one for one in tables):
            chamber.pop("wires", None)
        for name, other in (("drift_relation", "drift_velocity"), ("drift_velocity", "drift_relation")):
            if name in changes:
                chamber.pop(other, None)
        WireLayer.drop_ends(chamber, changes)
        for name in ("layers", "superlayers"):
            for label, table in table_in(changes, name).items():
                if isinstance(table, Mapping):
                    WireLayer.drop_ends(open_table(table_in(chamber, name), label), table)
        for label in superlayers:
            if changes.keys() & set(OF_ENDS):
                for name in OF_ENDS:
                    open_table(superlayers, label).pop(name, None)
            superlayer = table_in(table_in(changes, "superlayers"), label)
            for name, other in (("stereo", "twist"), ("twist", "stereo")):
                if name in superlayer:
                    open_table(superlayers, label).pop(other, None)

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
            wire_matter = [one for layer in self.layers for one in layer.wire_matter(self.wire_material)]
            names = " and ".join(dict.fromkeys(material.name for material, _ in wire_matter))
            matter = f"{names}, {100 * sum(x0 for _, x0 in wire_matter):.3g} % X0, spread over the gas"
        gases = " and ".join(dict.fromkeys((layer.gas or self.gas).name for layer in self.layers)) or self.gas.name
        wires = f"{len(self.layers)} layers, {cells} cells{reach}, gas {gases}"
        return f"{wires}, matter of the wires {matter}, drift times {self.drift_text()}{self.moved_text()}"

    def drift_text(self) -> str:
        """Return where drift times come from; only their number if layers differ."""
        texts = list(dict.fromkeys(layer.drift_text() for layer in self.layers))
        return texts[0] if len(texts) == 1 else f"of {len(texts)} relations"

    @property
    def gid_first(self) -> tuple[int, ...]:
        """Running number of wire 0 of each layer."""
        return tuple(accumulate((layer.cells for layer in self.layers[:-1]), initial=self.first_gid))

    def children(self) -> dict[str, Any]:
        """Return the values of the chamber, wire layers by number and superlayers by label."""
        layers = {str(layer.number): layer for layer in self.layers}
        return super().children() | {"layers": layers, "superlayers": {one.label: one for one in self.superlayers}}

    def inner(self) -> Iterator[tuple[str, Part]]:
        """Yield the wire layers with their paths from here."""
        return ((f"layers.{layer.number}", layer) for layer in self.layers)

    def materials(self) -> Iterator[Material]:
        """Yield the gases, and the materials of the wires."""
        yield from (self.gas, self.wire_material)
        for layer in self.layers:
            yield from ([layer.gas] if layer.gas else [])
            yield from (one.material for one in layer.cell_wires)

    @once
    def problems(self) -> list[Problem]:
        """Return what is impossible about the wires, beside values out of the range of their key."""
        if not self.layers:
            expected = "at least one [drift_chamber.layers.<number>] or [drift_chamber.superlayers.<label>]"
            return [Problem("drift_chamber.layers", "no wire layer", expected)]
        problems = [problem for layer in self.layers for problem in layer.problems()]
        if self.wires == "smeared" and not any(layer.wire_x0 or layer.cell_wires for layer in self.layers):
            expected = 'cell_wires or wire_x0 of [drift_chamber] or of a layer, or wires = "none"'
            problems.append(Problem("drift_chamber.wires", '"smeared" and no matter of any wires', expected))
        sound = self.sound
        problems += [found for i in range(len(sound)) if (found := _crossed_wires(sound, i))]
        return problems + _error_problems(sound)

    @cached_property
    def sound(self) -> list[WireLayer]:
        """The layers without problems of their own, which they would only repeat as overlaps."""
        return [layer for layer in self.layers if not layer.problems()]


def _crossed_wires(layers: Sequence[WireLayer], i: int) -> Problem | None:
    """Return whether a layer crosses one inside of it at a z where both have wires, or has no such z with the next.

    The difference of the squares of the radii is quadratic in z: they are compared where it is smallest or largest, and
    at the ends of the part of z that both have. Layers inside of one that is as long as this one have been compared
    with that one.
    """
    outer = layers[i]
    for inner in reversed(layers[:i]):
        ends = list(zip(inner.ends, outer.ends, strict=True))
        low, high = max(ends[0]), min(ends[1])
        if low >= high:
            if inner is layers[i - 1]:
                low, high = outer.ends
                expected = f"wires beside those of layer {inner.number}, which fill the chamber with it"
                return Problem(outer.path, f"wires from z = {low:g} to {high:g} mm", expected)
            continue
        for z in _turning_points(inner, outer, low, high):
            if outer.radius_at(z) <= inner.radius_at(z) + TOUCH:
                got = f"wires at r = {outer.radius_at(z):g} mm at z = {z:g} mm"
                expected = f"more than the {inner.radius_at(z):g} mm of layer {inner.number} there"
                return Problem(outer.path, got, expected)
        if (low, high) == outer.ends:
            break
    return None


def _turning_points(inner: WireLayer, other: WireLayer, low: float, high: float) -> Iterator[float]:
    """Yield z between two ends where the distance of two layers may be smallest, mm."""
    first, second = ((layer.r_end * math.sin(0.5 * layer.twist) / layer.half_length) ** 2 for layer in (inner, other))
    z = (first * inner.z_mid - second * other.z_mid) / (first - second) if first != second else 0.0
    yield min(max(z, low), high)
    yield high
    yield low


def _error_problems(wires: Sequence[WireLayer]) -> list[Problem]:
    """Return the layers whose error of the drift distance is not positive in all of their cells."""
    problems = []
    for i, wire in enumerate(wires):
        if wire.sigma_slope >= 0 or wire.sigma_points:
            continue
        # Tracks pass at most as far from the wire as an outer corner of its cell, midway to the next layer.
        others = (*wires[max(i - 1, 0) : i], *wires[i + 1 : i + 2])
        apart = [abs(one.radius_at(z) - wire.radius_at(z)) for one in others for z in (wire.z_mid, *wire.ends)]
        height = 0.5 * max(apart, default=2 * math.pi * wire.r_end / wire.cells)
        farthest = math.hypot(math.pi * (wire.r_end + height) / wire.cells, height)
        error = wire.sigma + wire.sigma_slope * farthest
        if error <= 0:
            given = f"an error of {error:g} mm at {farthest:.3g} mm"
            problems.append(Problem(f"{wire.path}.sigma_slope", given, "a positive error over the whole cell"))
    return problems
