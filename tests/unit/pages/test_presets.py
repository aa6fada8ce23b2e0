"""Tables of presets in docs/methods/detector.md, compared with the detectors and with the stored numbers."""

from __future__ import annotations

import math
import re

import pytest

import cgemit as cg
from pages import presets
from pages.page import ROOT


def cells(block: str) -> list[list[str]]:
    """Return the rows of a table of the page, without its head."""
    text = (ROOT / "docs/methods/detector.md").read_text(encoding="utf-8")
    (table,) = re.findall(f"<!-- {block} -->\n(.*?)<!-- end -->", text, re.DOTALL)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.strip().splitlines()[2:]]


def test_layers_are_those_of_the_detectors():
    shown = cells("layers")
    layers = [(name, layer) for name in presets.BESIII for layer in cg.load(name).cgem]
    assert [row[0] for row in shown] == [f"`{name}` {layer.label}" for name, layer in layers]
    for row, (_, layer) in zip(shown, layers, strict=True):
        _, place, gap, sheets, strips, pitch, stereo, x0, reach = row
        assert place == f"{layer.r_readout:.1f}, {2 * layer.half_length:g}"
        assert (gap, int(sheets)) == (f"{layer.drift_gap:.2f}", layer.sheets)
        assert strips == f"{layer.sheets * layer.strips_x}, {layer.sheets * layer.strips_v}"
        assert float(pitch) == pytest.approx(1e3 * layer.pitch_x) == pytest.approx(1e3 * layer.pitch_v)
        assert float(stereo.replace("−", "-")) == pytest.approx(math.degrees(layer.stereo), abs=0.05)
        assert float(x0) == pytest.approx(100 * sum(shell.x0 for shell in layer.shells()), abs=0.005)
        assert float(reach) == pytest.approx(math.cos(math.atan2(layer.r_readout, layer.half_length)), abs=5e-4)


def test_simulated_resolutions_are_those_on_file():
    rows = presets.PAGE.read()["simulated"].rows
    shown = {row[0].strip("`"): [float(cell) for cell in row[1:]] for row in cells("simulated")}
    assert list(shown) == list(presets.THIN)
    for name, values in shown.items():
        stored = {row.quantity: row.ratio for row in rows if row.preset == name}
        assert values == pytest.approx([stored[one] for one in ("dr", "phi0", "dz", "tanl", "p")], abs=0.005)
