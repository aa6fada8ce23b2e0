"""Parts of a detector: beam pipe, walls, levels of background, and the layers by their kinds. Lengths in mm.

The metadata of each field (`keys.Key`) states what a detector file may hold there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, SupportsIndex, TypeVar, overload

from cgemit.base.errors import did_you_mean
from cgemit.detector.field import Field
from cgemit.detector.keys import Part, key, once
from cgemit.detector.layers import LAYER_KINDS, CgemLayer, Layer, MeasurementLayer
from cgemit.detector.layers.wires import DriftChamber, WireLayer
from cgemit.detector.material import Material
from cgemit.detector.shells import Bounded


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
    outer_noise_x: float = field(
        metadata=key("rate", "noise of an X strip of the other layers", 0, 1e6, quiet=True), default=0.0
    )
    outer_noise_v: float = field(
        metadata=key("rate", "noise of a V strip of the other layers", 0, 1e6, quiet=True), default=0.0
    )
    noise_low: float | None = field(
        metadata=key("charge", "smallest charge of noise; without it charge_low", -1e3, 1e6, quiet=True), default=None
    )
    noise_high: float | None = field(
        metadata=key("charge", "largest charge of noise; without it charge_high", -1e3, 1e6, quiet=True), default=None
    )
    hot_strips: float = field(metadata=key("dimensionless", "share of the strips that are hot", 0, 1), default=0.0)
    hot_strip_rate: float = field(metadata=key("rate", "hits of a hot strip", 0, 1e6), default=0.0)
    dead_strips: float = field(metadata=key("dimensionless", "share of the strips that never fire", 0, 1), default=0.0)


@dataclass(frozen=True, kw_only=True)
class Cylinder(Bounded):
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


L = TypeVar("L", bound=Cylinder | Layer, covariant=True)


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
    barrels: Labelled[Layer]  # of every kind, also those of matter alone
    walls: Labelled[Cylinder]
    drift_chamber: DriftChamber | None
    background: tuple[BackgroundLevel, ...] = ()  # by label
    air: Material  # fills the space between parts inside the drift chamber

    def __post_init__(self) -> None:
        for name in ("beam_pipe", "walls"):
            object.__setattr__(self, name, Labelled(getattr(self, name)))
        object.__setattr__(self, "barrels", Labelled(sorted(self.barrels, key=lambda layer: layer.r_mid)))

    @property
    def layers(self) -> Labelled[Layer]:
        """The layers that make clusters, by radius; tables number them from 0."""
        return _measuring(self)

    @property
    def wires(self) -> tuple[WireLayer, ...]:
        """The wire layers of the drift chamber, by radius; none without a chamber."""
        return self.drift_chamber.layers if self.drift_chamber else ()

    @property
    def cgem(self) -> Labelled[CgemLayer]:
        """The CGEM layers, by radius."""
        return _of_kind(self, CgemLayer)

    @property
    def layer(self) -> Labelled[MeasurementLayer]:
        """The layers of ``[layer.NAME]``, by radius, also those of matter alone."""
        return _of_kind(self, MeasurementLayer)

    def by_kind(self) -> Iterator[tuple[str, Labelled[Layer]]]:
        """Yield the layers of each kind with the table of a detector file that holds them."""
        for group, kind in LAYER_KINDS.items():
            yield group, _of_kind(self, kind)

    def labelled(self) -> dict[str, dict[str, Part]]:
        """Return the parts with a label, by their table in a detector file."""
        groups: dict[str, Iterable[Any]] = {"beam_pipe": self.beam_pipe, **dict(self.by_kind())}
        groups |= {"walls": self.walls, "background": self.background}
        return {name: {part.label: part for part in parts} for name, parts in groups.items()}


@once
def _measuring(detector: Contents) -> Labelled[Layer]:
    return Labelled(layer for layer in detector.barrels if layer.views)


_K = TypeVar("_K", bound=Layer)


@once
def _of_kind(detector: Contents, kind: type[_K]) -> Labelled[_K]:
    return Labelled(layer for layer in detector.barrels if isinstance(layer, kind) and layer.group == kind.group)


@once
def cgem_numbers(detector: Contents) -> tuple[int, ...]:
    """Return the numbers of the CGEM layers among all layers."""
    own = set(map(id, detector.cgem))
    return tuple(number for number, layer in enumerate(detector.layers) if id(layer) in own)


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
    return tuple(layer for number, layer in zip(cgem_numbers(detector), detector.cgem, strict=True) if number in cgem)


def extent(detector: Contents) -> tuple[float, float]:
    """Return the outermost radius and |z| of a detector's parts, mm."""
    parts: list[Cylinder | Layer] = [*detector.beam_pipe, *detector.walls, *detector.barrels]
    radii = [part.r_out for part in parts] + [wires.r_end for wires in detector.wires]
    lengths = [max(-low, high) for low, high in (part.ends for part in (*parts, *detector.wires))]
    return max(radii, default=0.0), max(lengths, default=0.0)
