"""Numbers of a design that need no fits: channels, area, matter by angle, space between parts, occupancy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.base.settings import SettingsData
from cgemit.base.validate import NotNegative
from cgemit.detector.detector import Detector, load
from cgemit.detector.layers import CgemLayer
from cgemit.detector.matter import slabs
from cgemit.detector.shells import Slab
from cgemit.tables.show import Shown, Tabular
from cgemit.units import GEV_PER_T_MM


@dataclass(frozen=True)
class Background(SettingsData):
    """Hits that do not belong to tracks, for the occupancy of strips and of wires.

    Attributes
    ----------
    rate : float
        Hits per area and time at `radius`, kHz/cm2.
    radius : float
        mm.
    power : float
        The rate falls with this power of the radius.
    window : float
        Time in which a strip counts hits, ns.
    strips : float
        Fired strips of a hit in each view.
    wire_window : float
        Time in which a wire counts hits, ns. A particle fires one cell of a layer.

    Examples
    --------
    >>> background = cg.study.Background(rate=10.0)  # kHz/cm2 at 100 mm
    >>> background.power, background.window
    (2.0, 1000.0)
    """

    rate: NotNegative
    radius: NotNegative = 100.0
    power: NotNegative = 2.0
    window: NotNegative = 1000.0
    strips: NotNegative = 3.0
    wire_window: NotNegative = 500.0


def channels(detector: Detector) -> float:
    """Return the number of strips."""
    return float(sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem))


def smooth_channels(detector: Detector) -> float:
    """Return the number of strips without rounding, which has derivatives and is never smaller."""
    return sum(_smooth_channels(layer) for layer in detector.cgem)


def _smooth_channels(layer: CgemLayer) -> float:
    width = 2 * math.pi * layer.r_readout / layer.sheets
    stereo = abs(layer.stereo)
    # A stereo angle that follows from the diagonal of the X strips does so here from the whole sheet.
    if abs(stereo - math.atan2((layer.strips_x - 1) * layer.pitch_x, layer.length)) < 1e-12:
        stereo = math.atan2(width, layer.length)
    along_v = width * math.cos(stereo) + layer.length * math.sin(stereo)
    return layer.sheets * (width / layer.pitch_x + along_v / layer.pitch_v)


def area(detector: Detector) -> float:
    """Return the area of all layers that measure, m2."""
    return sum(2 * math.pi * layer.r_readout * layer.length for layer in detector.layers) / 1e6


def radiation_lengths(detector: Detector) -> float:
    """Return X/X0 of all layers that measure at normal incidence, %."""
    return 100 * sum(shell.x0 for layer in detector.layers for shell in layer.shells())


def part_of(detector: Detector, slab: Slab) -> str:
    """Return the part to which a slab belongs: the label of a layer, or ``pipe``, ``wall``, ``air`` or ``gas``."""
    first = slab.shells[0]
    if first.group in ("pipe", "wall", "air", "gas"):
        return first.group
    return next((layer.label for layer in detector.barrels if _contains(layer, first.r_in)), first.group)


def _contains(layer: Any, radius: float) -> bool:
    shells = list(layer.shells())
    return bool(min(s.r_in for s in shells) <= radius + 1e-9 and radius < max(s.r_out for s in shells))


@dataclass(frozen=True, eq=False, repr=False)
class MaterialScan(Shown, Tabular):
    """Matter and layers that straight tracks from the origin cross, against their polar angle.

    Attributes
    ----------
    detector : str
    by : str
        ``"part"`` or ``"material"``.
    cos_theta : ndarray, (n,) float64
    x0 : dict of str to ndarray, (n,) float64
        X/X0 in % of each part or material, from the beam line outward.
    hits : dict of str to ndarray, (n,) float64
        Crossed layers that measure: ``cgem``, ``layers`` (others of positions) and ``wires``, those that the detector
        has.

    Examples
    --------
    >>> found = cg.material_scan("besiii-cgem", [0.0])
    >>> list(found.x0), found.columns()["hits_wires"]
    (['pipe', 'air', 'L1', 'L2', 'L3', 'wall', 'gas'], [35.0])
    """

    detector: str
    by: str
    cos_theta: Floats
    x0: Mapping[str, Floats]
    hits: Mapping[str, Floats]

    @property
    def theta(self) -> Floats:
        """Polar angle, rad."""
        return np.arccos(self.cos_theta)

    @property
    def eta(self) -> Floats:
        """Pseudorapidity."""
        return np.arctanh(self.cos_theta)

    @property
    def total(self) -> Floats:
        """X/X0 of all matter, %."""
        return np.asarray(np.sum(list(self.x0.values()), axis=0))

    def columns(self) -> dict[str, list[Any]]:
        """Return one row for each angle: angles, X/X0 in % of each part and of all, and hits."""
        columns = {"cos_theta": self.cos_theta, "theta (rad)": self.theta, "eta": self.eta, "x0 (%)": self.total}
        columns |= {f"x0_{name} (%)": values for name, values in self.x0.items()}
        columns |= {f"hits_{name}": values for name, values in self.hits.items()}
        return {name: values.tolist() for name, values in columns.items()}

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        most = 12  # angles that are shown
        shown = np.unique(np.linspace(0, len(self.cos_theta) - 1, most).astype(int))
        head = ["cos(theta)", "theta [deg]", "X/X0 [%]", *(f"hits {name}" for name in self.hits)]
        rows = [
            [f"{self.cos_theta[i]:.3g}", f"{math.degrees(self.theta[i]):.1f}", f"{self.total[i]:.3f}",
             *(f"{hits[i]:.0f}" for hits in self.hits.values())]
            for i in shown
        ]  # fmt: skip
        return f"{self.detector}: matter and hits of straight tracks from the origin", head, rows

    def note(self) -> str:
        """Return how many angles are not shown."""
        more = len(self.cos_theta) - 12
        return f"{more} more angles: columns()" if more > 0 else ""


def material_scan(
    detector: Detector | str | Mapping[str, Any],
    cos_theta: npt.ArrayLike | None = None,
    *,
    by: Literal["part", "material"] = "part",
) -> MaterialScan:
    """Return the matter and the layers that straight tracks from the origin cross, against their polar angle.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    cos_theta : (n,) array_like or None
        Cosines of the polar angle, between -1 and 1. None: 197 from -0.98 to 0.98.
    by : str
        ``"part"``, or ``"material"``.

    Returns
    -------
    MaterialScan

    Raises
    ------
    DetectorError
        If the detector is not valid.
    ValueError
        If the cosines are no list of numbers between -1 and 1, or `by` is not known.

    Notes
    -----
    A path of a shell of thickness d is d/sin(theta) between its ends. Foils have their mean density. Dead areas and
    efficiencies do not count.

    Examples
    --------
    >>> found = cg.material_scan("besiii-cgem", [0.0, 0.6])
    >>> print(found.total.round(2), found.hits["cgem"])  # %
    [3.   3.75] [3. 3.]
    """
    detector = load(detector)
    cosine = np.linspace(-0.98, 0.98, 197) if cos_theta is None else np.asarray(cos_theta, np.float64)
    if cosine.ndim != 1 or not len(cosine) or not (np.abs(cosine) < 1).all():
        raise ValueError(f"cos_theta: got {cos_theta!r:.80}; expected a list of numbers between -1 and 1")
    if by not in ("part", "material"):
        raise ValueError(f"by: got {by!r}; expected part or material")
    sine = np.sqrt(1 - cosine**2)
    x0: dict[str, Floats] = {}
    for slab in slabs(detector):
        part = part_of(detector, slab)
        for shell in slab.shells:
            name = part if by == "part" else shell.material.name
            path = _inside(cosine / sine, shell.ends, shell.r_in, shell.r_out) / sine
            x0[name] = x0.get(name, np.zeros(len(cosine))) + 100 * path / shell.material.x0
    return MaterialScan(detector.name, by, cosine, x0, _crossed(detector, cosine / sine))


def _inside(slope: Floats, ends: tuple[float, float], low: float, high: float) -> Floats:
    """Return how much of the radii from low to high straight lines z = slope r are between two ends, mm."""
    with np.errstate(divide="ignore", invalid="ignore"):
        borders = np.sort(np.array(ends)[:, None] / slope, axis=0)
    flat = slope == 0
    borders[0, flat], borders[1, flat] = (-np.inf, np.inf) if ends[0] <= 0 <= ends[1] else (np.inf, np.inf)
    return np.asarray(np.maximum(np.minimum(borders[1], high) - np.maximum(borders[0], low), 0.0))


def _crossed(detector: Detector, slope: Floats) -> dict[str, Floats]:
    """Return how many layers of each kind straight lines z = slope r cross."""
    crossings: dict[str, Floats] = {}
    for layer in detector.layers:
        name = "cgem" if isinstance(layer, CgemLayer) else "layers"
        z = slope * layer.r_mid
        crossings[name] = crossings.get(name, np.zeros(len(slope))) + ((z > layer.ends[0]) & (z < layer.ends[1]))
    if detector.drift_chamber:
        wires = np.zeros(len(slope))
        for wire in detector.drift_chamber.layers:
            # Wires of a stereo layer lie on a hyperboloid about their middle: r^2 = r_mid^2 + c (z - z_mid)^2.
            c = (wire.r_end**2 - wire.r_mid**2) / (0.5 * (wire.ends[1] - wire.ends[0])) ** 2
            a, b = 1 - c * slope**2, c * slope * wire.z_mid
            rest = wire.r_mid**2 + c * wire.z_mid**2
            with np.errstate(invalid="ignore", divide="ignore"):
                z = slope * (np.sqrt(b**2 + a * rest) - b) / a
            wires += (z > wire.ends[0]) & (z < wire.ends[1])
        crossings["wires"] = wires
    return crossings


def outer_radius(detector: Detector) -> float:
    """Return the radius within which all layers that measure lie, mm."""
    return max(layer.r_out for layer in detector.layers)


def inner_radius(detector: Detector) -> float:
    """Return the radius outside of which all layers that measure lie, mm."""
    return min(layer.r_in for layer in detector.layers)


def gaps(detector: Detector) -> list[float]:
    """Return the free space inside and outside each measuring layer up to the next part, mm, from inside outward."""
    spans = [(part.r_in, part.r_out, False) for part in (*detector.beam_pipe, *detector.walls)]
    spans += [(layer.r_in, layer.r_out, bool(layer.views)) for layer in detector.barrels]
    if detector.drift_chamber:
        first = detector.drift_chamber.layers[0]
        spans.append((first.r_mid, first.r_end, False))
    spans.sort()
    return [outer[0] - inner[1] for inner, outer in pairwise(spans) if inner[2] or outer[2]]


def smallest_gap(detector: Detector) -> float:
    """Return the smallest free space inside or outside a layer that measures, mm."""
    return min(gaps(detector), default=math.inf)


def pt_threshold(detector: Detector) -> float:
    """Return the pT in MeV/c whose circle through the beam line just reaches the outermost layer that measures."""
    radius = max(layer.r_mid for layer in detector.layers)
    return 1000 * GEV_PER_T_MM * abs(detector.field.bz) * 0.5 * radius


def occupancy(detector: Detector, background: Background) -> float:
    """Return the largest probability of a strip to be hit within the window, %."""
    worst = 0.0
    for layer in detector.cgem:
        rate = background.rate * (background.radius / layer.r_mid) ** background.power  # kHz/cm2
        sheet = 2 * math.pi * layer.r_readout * layer.length / layer.sheets / 100  # cm2
        for strips in (layer.strips_x, layer.strips_v):
            mean = rate * 1e3 * sheet / strips * background.strips * background.window * 1e-9
            worst = max(worst, -100 * math.expm1(-mean))
    return worst


def wires(detector: Detector) -> float:
    """Return the number of sense wires."""
    return float(sum(layer.cells for layer in detector.wires))


def wire_occupancy(detector: Detector, background: Background) -> float:
    """Return the largest probability of a wire to be hit within the window, %; 0 without wires.

    Parameters
    ----------
    detector : Detector
    background : Background
    """
    worst = 0.0
    for layer in detector.wires:
        rate = background.rate * (background.radius / layer.r_mid) ** background.power  # kHz/cm2
        cell = 2 * math.pi * layer.r_mid / layer.cells * (layer.ends[1] - layer.ends[0]) / 100  # cm2
        worst = max(worst, -100 * math.expm1(-rate * 1e3 * cell * background.wire_window * 1e-9))
    return worst


#: What can be a goal or a limit: unit, the number, and the number without rounding to whole strips.
GEOMETRY: Mapping[str, tuple[str, Callable[[Detector], float], Callable[[Detector], float]]] = {
    "channels": ("", channels, smooth_channels),
    "wires": ("", wires, wires),
    "area": ("m2", area, area),
    "x0": ("%", radiation_lengths, radiation_lengths),
    "outer_radius": ("mm", outer_radius, outer_radius),
    "inner_radius": ("mm", inner_radius, inner_radius),
    "gap": ("mm", smallest_gap, smallest_gap),
    "pt_threshold": ("MeV/c", pt_threshold, pt_threshold),
}
