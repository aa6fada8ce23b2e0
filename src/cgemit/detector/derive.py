"""Strip counts, stereo angle and place of the V strips of a CGEM layer where a file does not state them."""

import math
from typing import Any

#: Word for an `offset_v` that follows from the other values.
CENTRED = "centred"


def complete_layer(values: dict[str, Any]) -> None:
    """Add strips_x, stereo and strips_v to the values (native units) of a CGEM layer where they are missing.

    An `offset_v` of ``"centred"`` becomes a number.

    The stereo angle is the one of the sheet's diagonal, counted in whole strips: as the read-out of the BESIII CGEM
    is laid out (docs/methods/detector.md). `stereo_sign` is taken out.
    """
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


def strips_x(radius: float, sheets: int, pitch: float) -> int:
    """Return how many whole X strips fit on a sheet."""
    return _floor(2 * math.pi * radius / (sheets * pitch))


def strips_v(width: float, length: float, stereo: float, pitch: float) -> int:
    """Return how many whole V strips fit between two corners of a sheet.

    `width` runs from the first X strip to the last. With the stereo angle of the diagonal this is the experiment's
    2 length sin(stereo)/pitch.
    """
    return _floor((width * math.cos(stereo) + length * math.sin(abs(stereo))) / pitch)


def centred_v(values: dict[str, Any]) -> float:
    """Return the `offset_v` with which both corners of a sheet have the same room beside the V strips."""
    stereo = values["stereo"]
    extent = values["strips_x"] * values["pitch_x"] * math.cos(stereo) + values["length"] * math.sin(abs(stereo))
    return float(0.5 * (extent / values["pitch_v"] - values["strips_v"]))


def _floor(value: float) -> int:
    # A value that could not be read stays unusable; its problem has been noted.
    return value if math.isnan(value) else math.floor(value)  # type: ignore[return-value]
