"""Short texts about a detector."""

import html
import math
from typing import TYPE_CHECKING

from cgemit.detector.field import field_text

if TYPE_CHECKING:
    from cgemit.detector.model import Detector


def lines(detector: "Detector") -> list[str]:
    """Return one line for the field and for each part that measures."""
    found = [f"field {field_text(detector.field)}"]
    for layer in detector.cgem:
        found.append(
            f"cgem {layer.label}: r = {layer.r_mid:.2f} mm (mid drift gap of {layer.drift_gap:g} mm), "
            f"length {layer.length:g} mm, {layer.sheets} x ({layer.strips_x} X + {layer.strips_v} V) strips, "
            f"stereo {math.degrees(layer.stereo):+.2f} deg"
        )
    chamber = detector.drift_chamber
    if chamber:
        first, last = chamber.layers[0], chamber.layers[-1]
        cells = sum(layer.cells for layer in chamber.layers)
        found.append(
            f"drift chamber: {len(chamber.layers)} layers, {cells} cells, "
            f"r = {first.r_mid:.1f} to {last.r_end:.1f} mm, wires {chamber.wires}"
        )
    return found


def summary(detector: "Detector") -> str:
    """Return a few lines for the terminal."""
    return "\n  ".join([f"Detector {detector.name!r}", *lines(detector)])


def summary_html(detector: "Detector") -> str:
    """Return the same for a notebook."""
    rows = "".join(f"<li>{html.escape(line)}</li>" for line in lines(detector))
    return f"<b>Detector {html.escape(detector.name)}</b> {html.escape(detector.description)}<ul>{rows}</ul>"
