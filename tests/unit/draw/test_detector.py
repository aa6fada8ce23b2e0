"""Pictures of detectors: what is drawn stands where the description says."""

import math

import numpy as np
import pytest
from matplotlib.patches import Annulus, Rectangle

from cgemit.detector import detectors, load
from cgemit.detector.inventory import material_scan
from cgemit.draw.detector import draw_detector, draw_layer, draw_layers, draw_material, draw_rz, draw_sides, draw_xy

#: Each has other parts; the other presets are variants of them.
DIFFERENT = {"besiii-cgem", "stcf-like", "kloe2-like"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in DIFFERENT else pytest.mark.slow) for name in detectors()]
)
def test_all_presets_can_be_drawn(name: str) -> None:
    detector = load(name)
    assert draw_detector(detector)._repr_png_().startswith(b"\x89PNG")
    assert draw_sides(detector)._repr_png_().startswith(b"\x89PNG")


def test_xy() -> None:
    detector = load("besiii-cgem-design")
    axes = draw_xy(detector)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (mm)", "y (mm)")
    radii = {round(float(patch.get_radii()[0]), 6) for patch in axes.patches if isinstance(patch, Annulus)}
    for layer in detector.cgem:
        assert {round(layer.r_out, 6), round(layer.r_gap_out, 6)} <= radii
    dots = np.concatenate([line.get_xydata() for line in axes.lines])
    assert len(dots) == 6312
    # The first wire of layer 20 crosses z = 0 midway between its ends.
    wire = detector.drift_chamber.layers[12]
    (x1, y1, _), (x2, y2, _) = wire.end_points(0)
    distance = np.hypot(dots[:, 0] - (x1 + x2) / 2, dots[:, 1] - (y1 + y2) / 2)
    assert distance.min() < 1e-9
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels[:2] == ["beam pipe", "wall"]


def test_magnified_view_labels_layers_and_sheets() -> None:
    detector = load("besiii-cgem")
    axes = draw_xy(detector, r_max=200)
    assert [text.get_text() for text in axes.texts] == ["L1", "L2", "L3"]
    edges = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 2]
    angles = sorted(math.degrees(math.atan2(*edge[0][::-1])) % 360 for edge in edges)
    assert angles == pytest.approx([0.118, 0.222, 180.118, 180.222, 180.502])


def test_rz() -> None:
    detector = load("besiii-cgem-design")
    axes = draw_rz(detector)
    boxes = {
        (round(patch.get_x(), 3), round(patch.get_y(), 3), round(patch.get_height(), 3))
        for patch in axes.patches
        if isinstance(patch, Rectangle)
    }
    assert (-266.0, 76.338, 5.0) in boxes  # drift gap of L1
    wires = [line.get_xydata() for line in axes.lines if len(line.get_xydata()) > 2]
    assert len(wires) == 35
    stereo = wires[12]
    assert stereo[0] == pytest.approx([-1087, 399.75])
    assert stereo[20] == pytest.approx([0, 396.98], abs=0.01)


def test_layer_is_to_scale() -> None:
    layer = load("besiii-cgem").cgem[0]
    axes = draw_layer(layer)
    boxes = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
    assert [box.get_width() for box in boxes] == [shell.thickness for shell in layer.shells()]
    words = " ".join(text.get_text() for text in axes.texts)
    assert "cathode, 2.076 mm" in words
    assert "drift gap, 5.149 mm" in words
    assert "0.205 % X" in words
    assert len(draw_layers(load("besiii-cgem")).axes) == 3


def test_parts_may_be_missing() -> None:
    draw_detector(load({"base": "besiii-cgem", "remove": ["drift_chamber", "walls"]}))
    bare = load({"base": "besiii-idc", "remove": ["beam_pipe", "walls"]})
    draw_detector(bare)
    draw_sides(bare)


@pytest.mark.parametrize(("name", "last"), [("idea-like", 315.0), ("cepc-like", 570.0), ("epic-like", 740.0)])
def test_inner_part_is_what_lies_inside_of_the_chamber(name: str, last: float) -> None:
    """A layer behind the chamber does not make the whole detector its inner part."""
    detector = load(name)
    for axes in (draw_detector(detector).axes[1], draw_sides(detector).axes[1]):
        assert last < axes.get_ylim()[1] < 1.4 * last


def test_layers_that_measure_nothing_are_drawn_as_walls() -> None:
    """In `cepc-like` the shell behind the vertex layers is matter alone."""
    detector = load({"base": "cepc-like", "name": "shell", "remove": ["walls"]})
    assert not detector.walls
    axes = draw_xy(detector, r_max=100)
    colors = {round(float(p.get_radii()[0]), 3): p.get_facecolor() for p in axes.patches if isinstance(p, Annulus)}
    shell, measuring = detector.layer["SHELL"], detector.layer["VTX1"]
    assert colors[round(shell.r_out, 3)] != colors[round(measuring.r_out, 3)]
    assert "wall" in [text.get_text() for text in axes.get_legend().get_texts()]


@pytest.mark.parametrize(("against", "label"), [("cos_theta", "cos θ"), ("theta", "θ  (deg)"), ("eta", "η")])
def test_matter_is_drawn_as_it_is(against: str, label: str) -> None:
    scan = material_scan("belle2-like", np.linspace(-0.9, 0.9, 31))
    picture = draw_material(scan, against, most=5)  # type: ignore[arg-type]
    matter, hits = picture.axes
    x = {"cos_theta": scan.cos_theta, "theta": np.degrees(scan.theta), "eta": scan.eta}[against]
    order = np.argsort(x)
    names = sorted(scan.x0, key=lambda name: -scan.x0[name].mean())
    expected = {name: scan.x0[name] for name in names[:5]} | {"other": sum(scan.x0[name] for name in names[5:])}
    low = np.zeros(len(x))
    assert [str(area.get_label()) for area in matter.collections] == list(expected)
    for area, values in zip(matter.collections, expected.values(), strict=True):
        vertices = np.concatenate([path.vertices for path in area.get_paths()])
        top = [vertices[np.isclose(vertices[:, 0], one), 1].max() for one in x[order]]
        np.testing.assert_allclose(top, low + values[order], rtol=1e-9)
        low = low + values[order]
    np.testing.assert_allclose(low, scan.total[order])
    for line, counts in zip(hits.lines, scan.hits.values(), strict=True):
        np.testing.assert_allclose(line.get_xdata(), x[order])
        assert np.asarray(line.get_ydata()).tolist() == counts[order].tolist()
    assert hits.get_xlabel() == label
    with pytest.raises(ValueError, match="expected cos_theta, theta, eta"):
        draw_material(scan, "phi")  # type: ignore[arg-type]
