"""Strip crossing against brute force: fine sampling of the projected segment, and hand-worked edge cases."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gem_toy
from cgemit import _core

SAMPLES = 4001
ROUNDING = 1e-9  # mm
READOUT = {"gain": 12_000.0, "w_values": np.array([0.0259]), "threshold": 0.0}


def layer_columns(index, **changes):
    """One of the design layers alone, with columns replaced."""
    columns = {name: values[index : index + 1].copy() for name, values in gem_toy.design_layers().items()}
    columns["gid_first"][:] = 0
    for name, value in changes.items():
        columns[name] = np.asarray([value], columns[name].dtype)
    return columns


def fired(columns, entry, exit_):
    """Set of (sheet, view, strip) that a truth from `entry` to `exit_` = (phi, z) fires."""
    radius = columns["r_gap_in"][0], columns["r_gap_out"][0]
    points = [[r * np.cos(phi), r * np.sin(phi), z] for r, (phi, z) in zip(radius, (entry, exit_), strict=True)]
    truths = gem_toy.truth_columns(0, 0, points[0], points[1])
    detector = gem_toy.core_detector(cgem=columns)
    digis = _core.read_out_strips(detector, truths, gem_toy.no_steps(), **READOUT)
    return set(zip(digis["sheet"].tolist(), digis["view"].tolist(), digis["strip"].tolist(), strict=True))


def unrolled(columns, entry, exit_, margin):
    """Sheet, X and V of points on the projected segment, off the edges by `margin`; -1 elsewhere."""
    (phi_1, z_1), (phi_2, z_2) = entry, exit_
    share = np.linspace(0, 1, SAMPLES)
    short_way = np.angle(np.exp(1j * (phi_2 - phi_1)))
    phi, z = phi_1 + share * short_way, z_1 + share * (z_2 - z_1)
    r, half = columns["r_readout"][0], columns["half_length"][0]
    width = columns["strips_x"][0] * columns["pitch_x"][0]
    sheet, x = np.full(SAMPLES, -1), np.zeros(SAMPLES)
    for s in range(columns["sheets"][0]):
        before = max(0.0, -margin)  # X counts from here
        from_edge = np.mod(r * (phi - columns["phi_first"][0, s]) + before, 2 * np.pi * r) - before
        on = (from_edge > margin) & (from_edge < width - margin) & (np.abs(z) < half - margin)
        sheet[on], x[on] = s, from_edge[on]
    stereo = columns["stereo"][0]
    v = x * np.cos(stereo) + (np.copysign(half, stereo) - z) * np.sin(stereo)
    return sheet, x, v


def sampled(columns, entry, exit_, margin):
    """Strips that hold a sample, off their borders by `margin`; a negative one adds strips that are only near."""
    sheet, x, v = unrolled(columns, entry, exit_, margin)
    strips = set()
    for view, value, pitch, begin, count in (
        (0, x, columns["pitch_x"][0], 0.0, columns["strips_x"][0]),
        (1, v, columns["pitch_v"][0], columns["offset_v"][0] * columns["pitch_v"][0], columns["strips_v"][0]),
    ):
        low, high = (np.floor((value - begin + shift) / pitch).astype(int) for shift in (-margin, margin))
        for strip in (low, high):
            keep = (sheet >= 0) & (strip >= 0) & (strip < count) & ((low == high) | (margin < 0))
            strips |= {(s, view, n) for s, n in np.unique([sheet[keep], strip[keep]], axis=1).T.tolist()}
    return strips


def assert_brute_force(columns, entry, exit_):
    """Every strip under the segment fires; none fires that is more than two samples away from it."""
    (phi_1, z_1), (phi_2, z_2) = entry, exit_
    length = np.hypot(columns["r_readout"][0] * np.angle(np.exp(1j * (phi_2 - phi_1))), z_2 - z_1)
    result = fired(columns, entry, exit_)
    assert sampled(columns, entry, exit_, ROUNDING) <= result
    assert result <= sampled(columns, entry, exit_, -2 * length / SAMPLES - ROUNDING)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    index=st.integers(0, 2),
    phi=st.floats(-np.pi, np.pi),
    z=st.floats(-1.05, 1.05),
    turn=st.floats(-1.5, 1.5),
    rise=st.floats(-30.0, 30.0),
    mirrored=st.booleans(),
    offset=st.sampled_from([0.0, 0.352]),
)
def test_any_segment_fires_the_strips_under_it(index, phi, z, turn, rise, mirrored, offset):
    """Both stereo signs, V strips at the corner and off it, across sheet edges, seams and ends."""
    sign = -1 if mirrored else 1
    columns = layer_columns(index, stereo=sign * gem_toy.design_layers()["stereo"][index], offset_v=offset)
    z *= columns["half_length"][0]
    assert_brute_force(columns, (phi, z), (phi + turn, z + rise))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(
    sheet=st.integers(0, 1),
    before=st.floats(-0.02, 0.02),
    turn=st.floats(-0.03, 0.03),
    z=st.floats(-345.0, 345.0),
    rise=st.floats(-5.0, 5.0),
)
def test_segments_at_the_seams(sheet, before, turn, z, rise):
    """Starts within 3 mm of a sheet's edge, on either side of phi = pi."""
    columns = layer_columns(1)
    phi = columns["phi_first"][0, sheet] + before
    assert_brute_force(columns, (phi, z), (phi + turn, z + rise))


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(side=st.sampled_from([-1, 1]), z=st.floats(-3.0, 3.0), rise=st.floats(-6.0, 6.0), phi=st.floats(-3.0, 3.0))
def test_segments_at_the_ends(side, z, rise, phi):
    """Starts within 3 mm of an end of the active length."""
    columns = layer_columns(2)
    z += side * columns["half_length"][0]
    assert_brute_force(columns, (phi, z), (phi + 0.001, z + rise))


@pytest.mark.parametrize("sheets", [3, 8])
@pytest.mark.parametrize("turn", [-3.0, 0.004, 2.9])
def test_layers_of_more_sheets(sheets, turn):
    """Segments that begin in the last sheet and go over up to five of them, either way round."""
    strips = int(2 * np.pi * gem_toy.design_layers()["r_readout"][0] / (sheets * 0.65))
    edges = 2 + 2 * np.pi / sheets * np.arange(sheets)
    columns = layer_columns(0, sheets=sheets, strips_x=strips, phi_first=edges)
    entry, exit_ = (edges[-1] + 0.3, -40.0), (edges[-1] + 0.3 + turn, 8.0)
    assert_brute_force(columns, entry, exit_)
    passed = len({sheet for sheet, _, _ in fired(columns, entry, exit_)})
    assert passed == {(3, -3.0): 3, (3, 0.004): 1, (3, 2.9): 2, (8, -3.0): 5, (8, 0.004): 1, (8, 2.9): 5}[sheets, turn]
    with pytest.raises(ValueError, match=f"sheets: expected 1 to {sheets - 1}, the columns of phi_first"):
        gem_toy.core_detector(cgem=columns | {"phi_first": columns["phi_first"][:, :-1].copy()})


def test_brute_force_sees_a_wrong_stereo_sign():
    """The comparison fails when the kernel works with another angle than the brute force."""
    columns = layer_columns(0)
    entry, exit_ = (0.3, 40.0), (0.304, 46.0)
    wrong = fired(layer_columns(0, stereo=-columns["stereo"][0]), entry, exit_)
    assert not sampled(columns, entry, exit_, ROUNDING) <= wrong


def at(columns, sheet, x, z):
    """(phi, z) of a local position."""
    return columns["phi_first"][0, sheet] + x / columns["r_readout"][0], z


def test_hand_worked_strips():
    """From X = 0.60 to 1.40 mm at pitch 0.65: strips 0, 1, 2; V from its formula."""
    columns = layer_columns(0)
    stereo, half = columns["stereo"][0], columns["half_length"][0]
    result = fired(columns, at(columns, 0, 0.60, 10.0), at(columns, 0, 1.40, 10.0))
    v = [x * np.cos(stereo) + (half - 10.0) * np.sin(stereo) for x in (0.60, 1.40)]
    first, last = (int(value / 0.65) for value in v)
    assert result == {(0, 0, 0), (0, 0, 1), (0, 0, 2)} | {(0, 1, strip) for strip in range(first, last + 1)}


@pytest.mark.parametrize("index", [0, 1])
def test_first_and_last_v_strip(index):
    """V strip 0 starts at X = 0 and z_ref; the corner opposite lies beyond the last V strip and has X strips only."""
    columns = layer_columns(index)
    z_ref = np.copysign(columns["half_length"][0], columns["stereo"][0])
    width = columns["strips_x"][0] * 0.65
    near = fired(columns, at(columns, 0, 1e-6, 0.9999999 * z_ref), at(columns, 0, 0.01, 0.9999999 * z_ref))
    far = fired(columns, at(columns, 0, width - 0.05, -0.99999 * z_ref), at(columns, 0, width - 0.01, -0.99999 * z_ref))
    assert near == {(0, 0, 0), (0, 1, 0)}
    assert far == {(0, 0, columns["strips_x"][0] - 1)}


@pytest.mark.parametrize("index", [0, 1])
def test_v_strips_off_the_corner(index):
    """With an offset of 0.9 strips the corner has X strips only up to V = 0.9 pitch, where V strip 0 begins."""
    columns = layer_columns(index, offset_v=0.9)
    z_ref, stereo = np.copysign(columns["half_length"][0], columns["stereo"][0]), columns["stereo"][0]

    def along_z(v_1, v_2):
        points = [at(columns, 0, 0.01, z_ref - (v - 0.01 * np.cos(stereo)) / np.sin(stereo)) for v in (v_1, v_2)]
        return {strip for _, view, strip in fired(columns, *points) if view == 1}

    assert along_z(0.01 * 0.65, 0.89 * 0.65) == set()
    assert along_z(0.01 * 0.65, 0.91 * 0.65) == {0}
    assert along_z(0.91 * 0.65, 2.91 * 0.65) == {0, 1, 2}


def test_seam_gives_strips_on_both_sheets_and_none_in_the_dead_area():
    """Over the edge of sheet 1: the last X strips of sheet 0, the first of sheet 1; in between nothing."""
    columns = layer_columns(1)
    edge = columns["phi_first"][0, 1]
    last = columns["strips_x"][0] - 1
    views = fired(columns, (edge - 0.006, 5.0), (edge + 0.006, 5.0))
    assert {(s, n) for s, view, n in views if view == 0} == {(0, last), (1, 0), (1, 1)}
    dead = columns["r_readout"][0] * np.pi - columns["strips_x"][0] * 0.65
    middle = edge - 0.5 * dead / columns["r_readout"][0]
    assert fired(columns, (middle, 5.0), (middle, 8.0)) == set()


def test_a_seamless_sheet_fires_each_strip_once():
    """Strips that close the circle exactly: the segment across X = 0 fires the last and the first strip."""
    columns = layer_columns(0, r_readout=845 * 0.65 / (2 * np.pi))
    views = fired(columns, at(columns, 0, -0.1, 5.0), at(columns, 0, 0.1, 5.0))
    assert {n for _, view, n in views if view == 0} == {0, 844}


def test_a_point_fires_one_strip_of_each_view():
    """Entry straight below exit in phi and z: no extent, one X and one V strip, also on a sheet's edge."""
    columns = layer_columns(1)
    inside = fired(columns, (1.0, 20.0), (1.0, 20.0))
    on_edge = fired(columns, (columns["phi_first"][0, 1], 20.0), (columns["phi_first"][0, 1], 20.0))
    assert sorted(view for _, view, _ in inside) == [0, 1]
    assert {(s, n) for s, view, n in on_edge if view == 0} == {(1, 0)}


def test_beyond_the_active_length_nothing_fires():
    """A segment off the end leaves no strips; one that leaves through the end keeps its inner part."""
    columns = layer_columns(0)
    assert fired(columns, (1.0, 270.0), (1.0, 280.0)) == set()
    partly = fired(columns, (1.0, 265.0), (1.0, 280.0))
    assert partly == fired(columns, (1.0, 265.0), (1.0, 266.0))
