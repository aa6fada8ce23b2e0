"""Tables of presets in docs/methods/detector.md, compared with the detectors and with the stored numbers."""

from __future__ import annotations

import math
import re

import pytest

import cgemit as cg
from cgemit.detector.matter import slabs
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


def test_published_statements_hold_as_far_as_they_say():
    """Formulas by hand: one digit for BESIII, Belle II and CEPC, 6 % for IDEA, bounds for requirements."""
    shown = {(row[0].strip("`"), row[1].partition(")")[0] + ")"): row for row in cells("stated")}
    beta = {p: p / math.hypot(p, 0.10566) for p in (0.3, 1.0, 3.0)}
    published = {
        ("besiii-idc", "p"): {1.0: 0.5},
        ("besiii-cgem", "p"): {1.0: 0.5},
        ("besiii-cgem-design", "p"): {1.0: 0.5},
        ("belle2-like", "p"): {p: math.hypot(0.1 * p, 0.3 / beta[p]) for p in beta},
        ("idea-like", "p"): {
            p: 100 * math.sqrt(0.0001145**2 + 0.0002024**2 * p + (p * 2.093e-5) ** 2) for p in (1, 5, 10, 20, 50, 100)
        },
        ("epic-like", "p"): {p: 0.5 + 0.05 * p for p in (1, 10, 20)},
        ("idea-like", "dr"): {p: math.hypot(5, 15 / p) for p in (1, 10, 100)},
        ("cepc-like", "p"): {p: 100 * math.sqrt(0.001**2 + p**2 * 1.0e-5**2) for p in (1, 10, 50, 100)},
        ("epic-like", "dr"): {p: 1e3 * math.hypot(0.005, 0.03 / p) for p in (1, 10, 20)},
        ("epic-like", "dz"): {p: 1e3 * math.hypot(0.005, 0.03 / p) for p in (1, 10, 20)},
    }
    assert len(shown) == len(presets.STATEMENTS) == len(published)
    stored = {(row.preset, row.quantity, row.momentum): row for row in presets.PAGE.read()["stated"].rows}
    ratios = {}
    for (name, quantity), values in published.items():
        row = shown[name, {"p": "σ(p)", "dr": "σ(d_ρ)", "dz": "σ(d_z)"}[quantity]]
        assert [float(cell) for cell in row[2].split(",")] == list(values)
        for p, value, cell in zip(values, values.values(), row[3].split(","), strict=True):
            found = presets.resolutions(name, "mu-", p, 0.0)[quantity]
            ratios[name, quantity, p] = found / value
            assert stored[name, quantity, p].published == pytest.approx(value, rel=1e-5)
            assert stored[name, quantity, p].expected == pytest.approx(found, rel=0.01)
            assert float(cell) == pytest.approx(found / value, abs=0.015)
    assert 0.7 < ratios["besiii-idc", "p", 1] < 1
    assert all(0.9 < ratios[name, "p", 1] < 1.1 for name in ("besiii-cgem", "besiii-cgem-design"))  # 0.45 to 0.55 %
    assert all(0.5 < ratios["belle2-like", "p", p] < 1 for p in beta)
    assert [ratios["idea-like", "p", p] for p in (5, 10, 20, 50, 100)] == pytest.approx([1] * 5, abs=0.06)
    assert all(ratios["epic-like", "p", p] < 1 for p in (1, 10, 20))
    assert all(ratios["idea-like", "dr", p] < 1 for p in (1, 10, 100))
    assert all(ratios["epic-like", quantity, 1] < 1 for quantity in ("dr", "dz"))
    assert all(0.3 < ratios["cepc-like", "p", p] < 2 for p in (1, 10, 50, 100))
    assert 0.03 < sum(slab.x0 for slab in slabs(cg.load("epic-like"))) < 0.05


def test_chamber_of_belle2_like_without_silicon():
    """Neither its number in the text nor the published one is that of all layers."""
    detector = cg.load("belle2-like")
    alone = cg.load({
        "base": "belle2-like", "name": "alone", "remove": [f"layer.{layer.label}" for layer in detector.layers],
    })  # fmt: skip
    found = presets.resolutions(alone, "mu-", 1.0, 0.0)["p"]
    text = (ROOT / "docs/methods/detector.md").read_text(encoding="utf-8")
    assert f"is expected to have {found:.2f} % at 1 GeV/c" in text.replace("\n  ", " ")
    assert presets.resolutions(detector, "mu-", 1.0, 0.0)["p"] < found < math.hypot(0.1, 0.3)
