"""Magnetic fields of a detector file, one class a kind. Field in T, lengths in mm; `bz` is the one at the origin."""

from dataclasses import dataclass, field

from cgemit.detector.field.grid import FieldGrid
from cgemit.detector.kept import Part
from cgemit.detector.keys import Key, key

_TOLERANCE = key("length", "error allowed to one step of a track through the field", 1e-9, 1.0)


EVERYWHERE = 1e6  # mm, farther than any detector


@dataclass(frozen=True, kw_only=True)
class Field(Part):
    """Uniform magnetic field along the beam."""

    kind: str = field(
        metadata=key("text", "shape of the field", choices=("uniform", "solenoid", "harmonic", "map")),
        default="uniform",
    )
    bz: float = field(metadata=key("field", "component along the beam at the origin, signed", -10.0, 10.0))  # T


@dataclass(frozen=True, kw_only=True)
class SolenoidField(Field):
    """Field of a thin, finite coil without iron around it (docs/methods/field.md)."""

    kind: str = field(metadata=key("text", "shape of the field", choices=("solenoid",)), default="solenoid")
    coil_radius: float = field(metadata=key("length", "radius of the coil", 10.0, 10_000.0))  # mm
    half_length: float = field(metadata=key("length", "half length of the coil along the beam", 10.0, 20_000.0))  # mm
    z_offset: float = field(metadata=key("length", "z of the middle of the coil", -2000.0, 2000.0), default=0.0)  # mm
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm


@dataclass(frozen=True, kw_only=True)
class HarmonicField(Field):
    """Bz = bz [1 - b (z^2 - r^2/2) + q (z^4 - 3 z^2 r^2 + 3 r^4/8)]; Br follows from Maxwell's equations."""

    kind: str = field(metadata=key("text", "shape of the field", choices=("harmonic",)), default="harmonic")
    b: float = field(metadata=key("inverse area", "quadratic decrease along the beam", -1e-5, 1e-5))  # mm^-2
    q: float = field(metadata=key("inverse area squared", "fourth-order term", -1e-11, 1e-11), default=0.0)  # mm^-4
    r_max: float = field(
        metadata=key("length", "largest radius at which the field holds", 1.0, EVERYWHERE), default=EVERYWHERE
    )  # mm
    z_max: float = field(
        metadata=key("length", "largest |z| at which the field holds", 1.0, EVERYWHERE), default=EVERYWHERE
    )  # mm
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm


@dataclass(frozen=True, kw_only=True)
class MapField(Field):
    """Field on a grid read from a file; `bz`, if it is stated, scales the map to that value at the origin."""

    kind: str = field(metadata=key("text", "shape of the field", choices=("map",)), default="map")
    bz: float = field(
        metadata=key("field", "component along the beam at the origin (default: the map's)", -10.0, 10.0, derived=True)
    )  # T
    file: str = field(metadata=key("text", "the map, .npz or .csv, or cgemit:besiii.npz"))
    checksum: str = field(metadata=key("text", "what the map's numbers must have (default: anything)", derived=True))
    tolerance: float = field(metadata=_TOLERANCE, default=1e-3)  # mm
    grid: FieldGrid  # as in the file, not scaled


KINDS: dict[str, type[Field]] = {
    "uniform": Field,
    "solenoid": SolenoidField,
    "harmonic": HarmonicField,
    "map": MapField,
}


def kind_key() -> Key:
    """Return what `kind` may be."""
    found: Key = Field.__dataclass_fields__["kind"].metadata["key"]
    return found


def field_text(detector_field: Field) -> str:
    """Return one line about a field."""
    text = f"{detector_field.bz:g} T"
    if isinstance(detector_field, SolenoidField):
        coil = f"coil of radius {detector_field.coil_radius:g} mm, half length {detector_field.half_length:g} mm"
        return f"{text} at the origin, {coil}"
    if isinstance(detector_field, HarmonicField):
        shape = f"b = {1e6 * detector_field.b:g} /m2, q = {1e12 * detector_field.q:g} /m4"
        reach = f" for r < {detector_field.r_max:g} mm, |z| < {detector_field.z_max:g} mm"
        limited = min(detector_field.r_max, detector_field.z_max) < EVERYWHERE
        return f"{text} at the origin, harmonic with {shape}" + (reach if limited else "")
    if isinstance(detector_field, MapField):
        return f"{text} at the origin, map {detector_field.file}, {detector_field.grid.range_text()}"
    return text
