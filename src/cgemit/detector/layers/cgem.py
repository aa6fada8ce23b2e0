"""CGEM layers: cylindrical GEM detectors with strips X and V on the anode."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import Problem, Problems
from cgemit.detector.keys import CENTRED, Key, key, keys_of, once, plain
from cgemit.detector.layers.layer import (
    FAR,
    MOST_SHEETS,
    READOUT_KEY,
    ROTATION,
    Layer,
    StripRanges,
    SubLayer,
    slabs_of,
    strip_text,
    whole,
)
from cgemit.detector.material import Material
from cgemit.detector.readouts import READOUTS, BinaryReadout, GaussianReadout, Readout
from cgemit.detector.shells import TOUCH, Holes, Shell, Slab
from cgemit.units import NATIVE, format_quantity

#: Derived values of a CGEM layer in the order of their computation, each with the values that it depends on.
_DERIVED_FROM = {
    "strips_x": {"anode_radius", "readout_offset", "sheets", "pitch_x"},
    "stereo": {"strips_x", "pitch_x", "length", "stereo_sign"},
    "strips_v": {"stereo", "strips_x", "pitch_x", "pitch_v", "length"},
    "offset_v": {"strips_v", "stereo", "strips_x", "pitch_x", "pitch_v", "length"},
}

#: Values of a CGEM layer that follow from others unless they are given.
_DERIVED = {
    "strips_x": ("anode_radius", "sheets", "pitch_x"),
    "stereo": ("anode_radius", "sheets", "length"),
    "strips_v": ("anode_radius", "sheets", "length", "pitch_v"),
}


@dataclass(frozen=True, kw_only=True, repr=False)
class CgemLayer(Layer):
    """One cylindrical GEM layer with X and V strips; everything is placed from the V-strip plane inward and outward.

    From inside: cathode, drift gap, first foil, transfer gap, ..., last foil, induction gap, anode.

    Examples
    --------
    >>> layer = cg.load("besiii-cgem").cgem["L1"]
    >>> layer.strips_x, layer.strips_v, layer.sheets, round(layer.r_mid, 2)  # mm
    (856, 1173, 1, 81.57)
    """

    group = "cgem"
    about = "CGEM layers by label"
    name = "CGEM layer"
    readouts = READOUTS
    usual_readout = BinaryReadout()
    extra_keys = MappingProxyType(
        {"stereo_sign": Key("sign", doc="sign of the stereo angle where the angle itself is left out")}
    )
    sensitive = "drift"

    anode_radius: float = field(
        metadata=key("length", "radius of the V-strip plane, inner face of the anode", 10.0, 3000.0)
    )
    readout_offset: float = field(
        metadata=key("length", "radius at which X is measured, minus anode_radius", -5.0, 5.0), default=0.0
    )
    length: float = field(metadata=key("length", "active length along the beam", 10.0, 5000.0))  # mm
    sheets: int = field(metadata=key("integer", "number of readout sheets around the layer", 1, MOST_SHEETS))
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
    z_scale: float = field(
        metadata=key("dimensionless", "pattern of strips along the beam, longer by this", -0.02, 0.02, quiet=True),
        default=0.0,
    )
    # None: from gas and fields.
    lorentz_angle: float | None = field(
        metadata=key("angle", "angle of the electrons in the drift gap, without sign", 0.0, 1.4, quiet=True),
        default=None,
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
    sheet_shift_z: tuple[float, ...] = field(  # mm
        metadata=key("lengths", "shift of each sheet along the beam", -FAR, FAR, quiet=True), default=()
    )
    sheet_rotation: tuple[float, ...] = field(  # rad
        metadata=key("angles", "turn of each sheet about the beam axis", -ROTATION, ROTATION, quiet=True), default=()
    )
    # Of each sheet: rows along z from the end at -z, each with numbers along X.
    gain_map: tuple[tuple[tuple[float, ...], ...], ...] = field(
        metadata=key("gains", "gain of each sheet, relative to that of the readout", 0.01, 100.0), default=()
    )
    readout: Readout = field(metadata=READOUT_KEY, hash=False)  # one from outside the package may have no hash
    efficiency: float = field(
        metadata=key("dimensionless", "probability that a crossing is seen in both views", 0.0, 1.0, quiet=True),
        default=1.0,
    )

    def text(self) -> str:
        """Return the layer in one line."""
        return (
            f"r = {self.r_mid:.2f} mm (mid drift gap of {self.drift_gap:g} mm), {self.length_text()}, "
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
        radius, ends, make = self.r_in, self.ends, tuple.__new__  # half the time of Shell(...)
        stacks = []
        for group, layers in parts:
            shells = []
            for label, thickness, material in layers:
                r_in, radius = radius, radius + thickness
                shells.append(make(Shell, (group, label, r_in, radius, ends, material)))
            stacks.append(tuple(shells))
        return tuple(shells for shells in stacks if shells)

    # What a detector file has of it

    @classmethod
    def complete(cls, path: str, values: dict[str, Any], problems: Problems) -> None:
        """Add strips_x, stereo and strips_v to the values (native units) where they are missing.

        An `offset_v` of ``"centred"`` becomes a number.

        The stereo angle is that of the sheet's diagonal in whole strips, as in the readout of the BESIII CGEM
        (docs/methods/detector.md). `stereo_sign` is removed.
        """
        values.setdefault("readout", cls.usual_readout)
        sign = values.pop("stereo_sign", 1)
        if "strips_x" not in values:
            radius = values["anode_radius"] + values.get("readout_offset", 0.0)
            values["strips_x"] = strips_x(radius, values["sheets"], values["pitch_x"])
        width = (values["strips_x"] - 1) * values["pitch_x"]
        if "stereo" not in values:
            values["stereo"] = sign * math.atan2(width, values["length"])
        if "strips_v" not in values:
            values["strips_v"] = strips_v(width, values["length"], values["stereo"], values["pitch_v"])
        if values.get("offset_v") == CENTRED:
            values["offset_v"] = centred_v(values)

    @classmethod
    def drop_replaced(cls, base: dict[str, Any], variant: Mapping[str, Any]) -> None:
        """Remove the derived values of a layer of the base that depend on changed values."""
        changed = set(variant) | ({"length"} if {"z_min", "z_max"} & variant.keys() else set())
        for name, depends in _DERIVED_FROM.items():
            if name not in variant and changed & depends:
                old = plain(base.pop(name, None))
                changed.add(name)
                if name == "stereo" and isinstance(old, str | float):
                    base["stereo_sign"] = -1 if str(old).lstrip().startswith("-") else 1
                if name == "offset_v" and old:
                    base["offset_v"] = CENTRED  # strips that were moved off the corner stay on the sheet

    def hint_of(self, name: str) -> str:
        """Return what a value follows from, as a hint; nothing if it does not follow from others."""
        keys = keys_of(type(self))
        values = ((one, getattr(self, one), keys[one].kind) for one in _DERIVED.get(name, ()))
        texts = [f"{one} = {format_quantity(value, kind) if kind in NATIVE else value}" for one, value, kind in values]
        return f"unless given, it follows from {', '.join(texts)}" if texts else ""

    @once
    def problems(self) -> list[Problem]:
        """Return strips and holes that do not fit, and electrodes and gaps that leave no room inside."""
        problems = self._strip_problems() + self._hole_problems() + self._map_problems() + self._dead_problems()
        if self.r_in <= 0:
            given = f"an inner face at {self.r_in:g} mm"
            problems.append(Problem(self.path, given, "gaps and electrodes that fit inside anode_radius"))
        return problems

    def _strip_problems(self) -> list[Problem]:
        """Return X strips wider than the sheet and V strips beyond its far corner."""
        path = self.path
        width = 2 * math.pi * self.r_readout / self.sheets
        problems = []
        if self.strips_x * self.pitch_x > width + TOUCH:
            most = math.floor(width / self.pitch_x + 1e-9)
            got = f"{self.strips_x} strips of {self.pitch_x:g} mm"
            problems.append(Problem(f"{path}.strips_x", got, f"at most {most} on a sheet {width:.3f} mm wide"))
            return problems  # V strips cross the X strips: nothing to say about them yet
        extent = self.strips_x * self.pitch_x * math.cos(self.stereo) + self.length * math.sin(abs(self.stereo))
        if (self.strips_v + self.offset_v) * self.pitch_v > extent + TOUCH:
            most = math.floor(extent / self.pitch_v - self.offset_v + 1e-9)
            got = f"{self.strips_v} strips of {self.pitch_v:g} mm"
            got += f" after an offset of {self.offset_v:g} strips" if self.offset_v else ""
            problems.append(
                Problem(f"{path}.strips_v", got, f"at most {most}: the sheet measures {extent:.3f} mm along V")
            )
        if abs(self.stereo) < math.radians(1):
            got = f"{math.degrees(self.stereo):g} deg"
            expected = "at least 1 deg, either sign: otherwise z is not measured"
            problems.append(Problem(f"{path}.stereo", got, expected, self.hint_of("stereo")))
        return problems

    def _map_problems(self) -> list[Problem]:
        """Return strips that the layer does not have, and gains of sheets that it does not have."""
        problems = []
        for view, strips in (("x", self.strips_x), ("v", self.strips_v)):
            for name in (f"dead_{view}", f"hot_{view}"):
                for i, (sheet, first, last) in enumerate(getattr(self, name)):
                    if sheet >= self.sheets or not first <= last or last >= strips:
                        expected = f"sheet 0 to {self.sheets - 1} and strips 0 to {strips - 1}, first to last"
                        path = f"{self.path}.{name}[{i}]"
                        problems.append(Problem(path, strip_text(sheet, first, last), expected))
        for name in ("sheet_shift_z", "sheet_rotation"):
            if len(values := getattr(self, name)) > self.sheets:
                expected = f"at most {self.sheets}, one for each sheet"
                problems.append(Problem(f"{self.path}.{name}", f"{len(values)} values", expected))
        if self.gain_map and len(self.gain_map) != self.sheets:
            got = f"gains of {len(self.gain_map)} sheets"
            problems.append(Problem(f"{self.path}.gain_map", got, f"those of {self.sheets}"))
        return problems

    def _dead_problems(self) -> list[Problem]:
        """Return dead seams and ends that leave nothing of a sheet."""
        sizes = (
            ("dead_seam", self.dead_seam, self.strips_x * self.pitch_x),
            ("dead_ends", self.dead_ends, self.half_length),
        )
        return [
            Problem(f"{self.path}.{name}", f"{size:g} mm", f"less than {most:g} mm, which leaves a part of a sheet")
            for name, size, most in sizes
            if size > 0 and size >= most
        ]

    def _hole_problems(self) -> list[Problem]:
        """Return holes of a foil that are wider inside than outside, or that touch."""
        path = self.path
        problems = []
        if self.hole_inner > self.hole_outer:
            expected = f"at most hole_outer = {self.hole_outer:g} mm"
            problems.append(Problem(f"{path}.hole_inner", f"{self.hole_inner:g} mm", expected))
        if self.hole_outer >= self.hole_pitch:
            expected = f"less than hole_pitch = {self.hole_pitch:g} mm"
            problems.append(Problem(f"{path}.hole_outer", f"{self.hole_outer:g} mm", expected))
        return problems

    def design_keys(self) -> Iterator[str]:
        """Yield radius, pitches, stereo angle, gaps, and the thickness of each sub-layer."""
        for name in ("anode_radius", "pitch_x", "pitch_v", "stereo", "drift_gap", "transfer_gap", "induction_gap"):
            yield f"{self.path}.{name}"
        for stack in ("cathode", "foil", "anode"):
            for part in getattr(self, stack):
                yield f"{self.path}.{stack}.{part.label}.thickness"

    def smooth(self, base: Layer) -> CgemLayer:
        """Return the layer with a derived stereo angle that follows radius and length continuously."""
        if abs(abs(self.stereo) - math.atan2((self.strips_x - 1) * self.pitch_x, self.length)) >= 1e-12:
            return self
        angle = abs(base.stereo) + (_diagonal(self) - _diagonal(base))
        # The hits are given: one V strip fits at any angle.
        return replace(self, stereo=math.copysign(angle, base.stereo), strips_v=1)

    def described(self) -> dict[str, Any]:
        """Return the numbers of the layer that `cgemit show --json` prints."""
        return {
            "layer": self.label,
            "r_mid_gap_mm": self.r_mid,
            "r_readout_mm": self.r_readout,
            "length_mm": self.length,
            "z_min_mm": self.ends[0],
            "z_max_mm": self.ends[1],
            "drift_gap_mm": self.drift_gap,
            "hole_outer_um": 1000 * self.hole_outer,
            "hole_inner_um": 1000 * self.hole_inner,
            "hole_pitch_um": 1000 * self.hole_pitch,
            "sheets": self.sheets,
            "phi_first_deg": math.degrees(self.phi_first) % 360,
            "pitch_x_um": 1000 * self.pitch_x,
            "pitch_v_um": 1000 * self.pitch_v,
            "strips_x": self.strips_x,
            "strips_v": self.strips_v,
            "offset_v": self.offset_v,
            "stereo_deg": math.degrees(self.stereo),
        }

    def rings(self) -> Iterator[tuple[str, float, float]]:
        """Yield the layer and its drift gap."""
        yield "CGEM electrodes and gaps", self.r_in, self.r_out
        yield "CGEM drift gap", self.r_gap_in, self.r_gap_out

    @property
    def card_errors(self) -> tuple[float, float]:
        """Errors of X and V in a Delphes card, mm: those of the readout ``gaussian``."""
        usual = GaussianReadout()
        return usual.sigma_x, usual.sigma_v

    # What it is made of

    @once
    def slabs(self, number: int, merge: bool, lattice: bool, first_foil: int) -> tuple[Slab, ...]:
        """Return the matter as slabs, see `Layer.slabs`; layers of the same matter share them.

        Parameters
        ----------
        number : int
        merge, lattice : bool
        first_foil : int
        """
        matter = _Matter(tuple([getattr(self, name) for name in _MATTER]), self)
        return _same_matter(matter, number, first_foil, merge, lattice)

    def materials(self) -> Iterator[Material]:
        """Yield the gas and the materials of the electrodes."""
        yield self.gas
        yield from (part.material for part in (*self.cathode, *self.foil, *self.anode))


def strips_x(radius: float, sheets: int, pitch: float) -> int:
    """Return how many whole X strips fit on a sheet."""
    return whole(math.floor, 2 * math.pi * radius / (sheets * pitch))


def strips_v(width: float, length: float, stereo: float, pitch: float) -> int:
    """Return how many whole V strips fit between two corners of a sheet.

    `width` runs from the first X strip to the last. With the stereo angle of the diagonal this is the experiment's
    2 length sin(stereo)/pitch.
    """
    return whole(math.floor, (width * math.cos(stereo) + length * math.sin(abs(stereo))) / pitch)


def centred_v(values: dict[str, Any]) -> float:
    """Return the `offset_v` with which both corners of a sheet have the same room beside the V strips."""
    stereo = values["stereo"]
    extent = values["strips_x"] * values["pitch_x"] * math.cos(stereo) + values["length"] * math.sin(abs(stereo))
    return float(0.5 * (extent / values["pitch_v"] - values["strips_v"]))


def _diagonal(layer: Layer) -> float:
    """Return the angle of the diagonal of a whole sheet to the beam, rad."""
    return math.atan2(2 * math.pi * layer.r_readout / layer.sheets, layer.length)


def strips_of_v(layer: Layer, v: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, counted in V strips: i is the edge where strip i begins."""
    return np.asarray(np.divide(v, layer.pitch_v) - layer.offset_v)


def v_of_strips(layer: Layer, strips: Floats | float) -> Floats:
    """Return V, (n,) float64 mm, of positions counted in V strips: i is the edge where strip i begins."""
    return np.asarray(np.add(strips, layer.offset_v) * layer.pitch_v)


#: The keys of a CGEM layer that its matter depends on.
_MATTER = (
    "anode_radius", "length", "z_min", "z_max", "drift_gap", "transfer_gap", "induction_gap", "foils", "hole_outer",
    "hole_inner", "hole_pitch", "gas", "cathode", "foil", "anode",
)  # fmt: skip


@dataclass(frozen=True)
class _Matter:
    """A CGEM layer that is equal to others of the same matter, whatever their strips are."""

    values: tuple[object, ...]
    layer: CgemLayer = field(compare=False)


@lru_cache(maxsize=256)
def _same_matter(matter: _Matter, layer_number: int, first_foil: int, merge: bool, lattice: bool) -> tuple[Slab, ...]:
    layer, stacks = matter.layer, matter.layer.stacks()
    foils: tuple[Slab, ...] = ()
    if lattice:
        foils = tuple(Slab((shell,), holes=holes) for shell, holes in perforated(layer, first_foil))
        stacks = tuple(shells for shells in stacks if shells[0].group != "foils")
    return foils + slabs_of(stacks, layer.sensitive, layer_number, merge)


def perforated(layer: CgemLayer, first_foil: int) -> Iterator[tuple[Shell, Holes | None]]:
    """Yield the foils of a layer and the gas behind each, sub-layer by sub-layer: foils solid, and with holes.

    Parameters
    ----------
    layer : CgemLayer
    first_foil : int
        Running number of the layer's first foil.

    """
    shells = [shell for shell in layer.shells() if shell.group == "foils"]
    n = len(layer.foil)
    for i_foil in range(layer.foils):
        *parts, gas = shells[i_foil * (n + 1) : (i_foil + 1) * (n + 1)]
        for shell, holes in zip(parts, _holes(layer, first_foil + i_foil), strict=True):
            yield shell._replace(material=shell.material.solid()), holes
        yield gas, None


def _holes(layer: CgemLayer, foil: int) -> Iterator[Holes]:
    """Yield the holes of each sub-layer of a foil.

    The first and the last of three or more sub-layers are electrodes, with cylindrical holes; between them holes are
    double cones with their waist in the middle.
    """
    edges = np.cumsum([0.0, *(part.thickness for part in layer.foil)])
    edges -= 0.5 * edges[-1]
    last = len(layer.foil) - 1
    inner = slice(1, last) if last > 1 else slice(0, last + 1)
    low, high = edges[inner.start], edges[inner.stop]
    middle = 0.5 * (low + high)
    cone = (layer.hole_outer - layer.hole_inner) / (high - low)
    for i, (begin, end) in enumerate(zip(edges[:-1] - middle, edges[1:] - middle, strict=True)):
        electrode = not inner.start <= i < inner.stop
        shape = (0.5 * layer.hole_outer, 0.0) if electrode else (0.5 * layer.hole_inner, cone)
        yield Holes(foil, layer.hole_pitch, *map(float, (*shape, begin, end)))
