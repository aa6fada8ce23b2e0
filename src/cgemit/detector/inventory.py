"""Numbers of a design that need no tracks: channels, area, matter, space between parts, occupancy."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

from cgemit.base.settings import SettingsData
from cgemit.base.validate import NotNegative
from cgemit.detector.detector import Detector
from cgemit.detector.layers import CgemLayer
from cgemit.units import GEV_PER_T_MM


@dataclass(frozen=True)
class Background(SettingsData):
    """Hits that do not belong to tracks, for the occupancy of strips.

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
    """Return the largest probability of a strip to be hit within the window, %.

    Parameters
    ----------
    detector : Detector
    background : Background
    """
    worst = 0.0
    for layer in detector.cgem:
        rate = background.rate * (background.radius / layer.r_mid) ** background.power  # kHz/cm2
        sheet = 2 * math.pi * layer.r_readout * layer.length / layer.sheets / 100  # cm2
        for strips in (layer.strips_x, layer.strips_v):
            mean = rate * 1e3 * sheet / strips * background.strips * background.window * 1e-9
            worst = max(worst, -100 * math.expm1(-mean))
    return worst


#: What can be a goal or a limit: unit, the number, and the number without rounding to whole strips.
GEOMETRY: Mapping[str, tuple[str, Callable[[Detector], float], Callable[[Detector], float]]] = {
    "channels": ("", channels, smooth_channels),
    "area": ("m2", area, area),
    "x0": ("%", radiation_lengths, radiation_lengths),
    "outer_radius": ("mm", outer_radius, outer_radius),
    "inner_radius": ("mm", inner_radius, inner_radius),
    "gap": ("mm", smallest_gap, smallest_gap),
    "pt_threshold": ("MeV/c", pt_threshold, pt_threshold),
}
