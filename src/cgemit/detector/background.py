"""The background of a detector, as its file states it: rates of one level by name."""

from dataclasses import dataclass, field

from cgemit.detector.kept import Part
from cgemit.detector.keys import key


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
        metadata=key("profile", "hits of the wires with a time in the read-out window, against the radius"), default=()
    )
    wire_runs: tuple[float, ...] = field(
        metadata=key("counts", "how often 1, 2, 3 ... cells of a layer fire side by side"), default=(1,)
    )
    wire_window: float = field(metadata=key("time", "read-out window of the wires", 1, 1e6), default=2000.0)
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
    strip_window: float = field(metadata=key("time", "read-out window of the strips", 1, 1e6), default=1000.0)
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
