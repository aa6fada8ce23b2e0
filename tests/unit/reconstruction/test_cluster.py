"""Clusters of hand-made digis row by row, and their errors against hand-worked and thrown segments."""

import numpy as np
import pytest

import gem_toy
from cgemit import FitSettings, Gun, Settings, TigerReadout, _core, run
from cgemit.detector import load
from cgemit.detector.core import layer_table
from cgemit.detector.layers.cgem import strips_of_v
from cgemit.draw.cluster import crossing
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.clusterers.binary import MAX_SIZE, cluster_errors, error_table, reference_widths
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.simulation.digitize import digitize
from cgemit.tables import Table
from cgemit.truth.assign import own_clusters, residuals
from lorentz import mean_shift
from stats import assert_within

PITCH = 0.65
LAYERS = gem_toy.design_layers()


@pytest.fixture(scope="module")
def design():
    """The design CGEM."""
    return load("besiii-cgem-design")


def digi_table(rows, n_events=1):
    """Digis from rows (event, layer, sheet, view, strip, charge, truth); time is the row number."""
    event, layer, sheet, view, strip, charge, truth = (np.array(values) for values in zip(*rows, strict=True))
    columns = {"event": event, "layer": layer, "sheet": sheet, "view": view.astype("i1"), "strip": strip}
    columns |= {"gid": np.zeros(len(rows), "i4"), "position": np.full(len(rows), np.nan)}
    columns["charge"] = charge.astype(float)
    columns |= {"time": np.arange(len(rows), dtype=float), "truth": truth, "n_truths": np.ones(len(rows), "i4")}
    return Table("digis", columns, n_events)


def x_strips(*strips, charge=1.0, truth=0, layer=0, sheet=0, event=0):
    """Rows of X digis."""
    return [(event, layer, sheet, 0, strip, charge, truth) for strip in strips]


def v_strips(*strips, charge=1.0, truth=0, layer=0, sheet=0, event=0):
    """Rows of V digis."""
    return [(event, layer, sheet, 1, strip, charge, truth) for strip in strips]


def x_clusters(clusters):
    """First and last strip of the X clusters."""
    picked = clusters[clusters["view"] == 0]
    return list(zip(picked["first"].tolist(), picked["last"].tolist(), strict=True))


# ----- Lorentz shift


def residuals_of(detector, clusters, truths):
    """Medians of X and V of each layer minus those of the crossings, (layers, 2), mm."""
    rows = own_clusters(detector, clusters, truths)
    off, layer, view = residuals(detector, clusters, truths, rows), clusters["layer"][rows], clusters["view"][rows]
    return np.array([[np.median(off[(layer == i) & (view == k)]) for k in (0, 1)] for i in range(len(detector.cgem))])


@pytest.mark.parametrize("readout", ["binary", "analog-projection", "tiger", "gaussian"])
def test_clusters_are_moved_back_by_the_shift_of_the_layer(design, readout):
    """Simulation and clusters agree on it; strips clustered without it lie beside their crossings by as much."""
    shift = np.array([2.0, -1.0, 0.5])
    moved = design.with_overrides({f"cgem.L{i + 1}.lorentz_shift": f"{one} mm" for i, one in enumerate(shift)})
    gun, along = Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), np.cos([layer.stereo for layer in design.cgem])
    plain, made = (run(one, gun, 300, seed=4, readout=readout, until="cluster") for one in (design, moved))
    right = residuals_of(moved, made.clusters, made.truths)
    assert np.abs(right - residuals_of(design, plain.clusters, plain.truths)).max() < 0.05
    without = cluster(design, made.digis, readout=readout)
    own = np.array([mean_shift(layer, -1.0) for layer in design.cgem]) if readout == "tiger" else 0.0
    expected = (shift - own)[without["layer"]]
    for view, name, factor in ((0, "x", 1.0), (1, "v", along[without["layer"]])):
        mine = without["view"] == view
        np.testing.assert_allclose((without[name] - made.clusters[name])[mine], (expected * factor)[mine], atol=1e-9)


def test_strips_of_another_simulation_take_their_shift(design):
    """Strips of drifting electrons, with binary clusters: 2.3 mm off, less than 0.1 mm with the shift."""
    made = run(design, Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 300, seed=4, readout="tiger", until="digitize")
    shifts = {f"cgem.{layer.label}.lorentz_shift": f"{mean_shift(layer, -1.0)!r} mm" for layer in design.cgem}
    plain, moved = (
        residuals_of(one, cluster(one, made.digis), made.truths) for one in (design, design.with_overrides(shifts))
    )
    assert (plain[:, 0] < -2.1).all()
    assert np.abs(moved).max() < 0.1


# ----- strips to clusters


def test_neighbours_join_and_gaps_part(design):
    """4 5 6 | 8 | 10 11, in whatever order the digis come."""
    rows = x_strips(4, 5, 6, 8, 10, 11)
    expected = [(4, 6), (8, 8), (10, 11)]
    assert x_clusters(cluster(design, digi_table(rows))) == expected
    assert x_clusters(cluster(design, digi_table([rows[i] for i in (3, 5, 0, 2, 4, 1)]))) == expected


def test_borders_of_view_sheet_layer_and_event_part(design):
    """Neighbouring numbers on different sheets, views, layers or events are no neighbours."""
    last = LAYERS["strips_x"][1] - 1
    rows = x_strips(last, layer=1) + x_strips(0, layer=1, sheet=1) + v_strips(1, layer=1, sheet=1)
    rows += x_strips(1, layer=2) + x_strips(2, layer=2, event=1)
    clusters = cluster(design, digi_table(rows, 2))
    assert x_clusters(clusters) == [(last, last), (0, 0), (1, 1), (2, 2)]
    # The corner where X strip 0 and V strip 1 cross makes an XV cluster, too.
    assert np.diff(clusters.offsets).tolist() == [5, 1]


@pytest.mark.parametrize(("position", "unequal"), [("centre", 11.0), ("charge", 11.25)])
def test_position_is_the_centre_of_the_strips_or_weighted_by_charge(design, position, unequal):
    """Equal charges, or none at all: the geometric centre. Unequal ones: the same, or sum(X_i Q_i)/sum(Q_i)."""
    rows = x_strips(4, 5, 6) + x_strips(10, charge=1.0) + x_strips(11, charge=3.0) + x_strips(20, 21, charge=0.0)
    clusters = cluster(design, digi_table(rows), ClusterSettings(position=position))
    np.testing.assert_allclose(clusters["x"], np.array([5.5, unequal, 21.0]) * PITCH)
    np.testing.assert_allclose(clusters["charge"], [3.0, 4.0, 0.0])
    assert clusters["time"].tolist() == [0.0, 3.0, 5.0]
    assert clusters["size"].tolist() == [3, 2, 2]


def test_azimuth_at_mid_gap(design):
    """Azimuth phi_first + X/R, wrapped; radius the middle of the gap; V unknown."""
    row = cluster(design, digi_table(x_strips(400, layer=1)))
    x = 400.5 * PITCH
    np.testing.assert_allclose(row["phi"], np.pi + x / 132.5 - 2 * np.pi)
    np.testing.assert_allclose(row["err_phi"], row["err_x"] / 132.5)
    np.testing.assert_allclose(row["r"], 132.5 - 6.162 - 2.5)
    for name in ("v", "z", "err_v", "err_z"):
        assert np.isnan(row[name]).all()


def crossing_strip(layer, x, z):
    """V strip under a local position."""
    stereo, half = LAYERS["stereo"][layer], LAYERS["z_max"][layer]
    return int((x * np.cos(stereo) + (np.copysign(half, stereo) - z) * np.sin(stereo)) / PITCH)


@pytest.mark.parametrize("layer", [0, 1])
def test_xv_cluster_has_the_z_of_the_crossing(design, layer):
    """Z = z_ref - (V - X cos)/sin for both stereo signs, with its error; links to both views."""
    x_strip, z = 200, 33.0
    v_strip = crossing_strip(layer, (x_strip + 0.5) * PITCH, z)
    rows = x_strips(x_strip, layer=layer, charge=2.0) + v_strips(v_strip, layer=layer, charge=3.0)
    clusters = cluster(design, digi_table(rows))
    x, v, xv = (clusters[i : i + 1] for i in range(3))
    stereo, half = LAYERS["stereo"][layer], LAYERS["z_max"][layer]
    z_found = xv["z"][0]
    from_ref = np.copysign(half, stereo) - z_found
    np.testing.assert_allclose(x["x"] * np.cos(stereo) + from_ref * np.sin(stereo), v["v"])
    assert abs(z_found - z) <= 0.5 * PITCH / abs(np.sin(stereo))
    np.testing.assert_allclose(
        xv["err_z"], np.sqrt(v["err_v"] ** 2 + np.cos(stereo) ** 2 * x["err_x"] ** 2) / abs(np.sin(stereo))
    )
    for name, view in (("x", x), ("phi", x), ("err_x", x), ("err_phi", x), ("v", v), ("err_v", v)):
        np.testing.assert_array_equal(xv[name], view[name])
    assert (xv["x_cluster"][0], xv["v_cluster"][0], xv["view"][0]) == (0, 1, 2)
    assert (xv["charge"][0], xv["size"][0], xv["first"][0], xv["last"][0], xv["time"][0]) == (5.0, 2, -1, -1, 0.0)


def test_v_strips_off_the_corner_keep_their_place():
    """Points on the layers as built: the one strip that fires has its middle within half a pitch of the point."""
    built = load("besiii-cgem")
    for number, layer in enumerate(built.cgem):
        phi, z = np.linspace(-3.0, 3.0, 501), np.linspace(-0.9, 0.9, 501) * layer.half_length
        points = np.column_stack([layer.r_gap_in * np.cos(phi), layer.r_gap_in * np.sin(phi), z])
        truths = Table("truths", gem_toy.truth_columns(np.arange(501), number, points, points), 501)
        clusters = cluster(built, digitize(built, truths, Table.empty("wire_truths", 501))["digis"])
        v = clusters[clusters["view"] == 1]
        start = np.array(layer.sheet_phi)[v["sheet"]]
        x = layer.r_readout * ((phi[v["truth"]] - start) % (2 * np.pi))
        z_ref = np.copysign(layer.half_length, layer.stereo)
        residual = v["v"] - x * np.cos(layer.stereo) - (z_ref - z[v["truth"]]) * np.sin(layer.stereo)
        assert len(v) > 480
        assert 0.32 < np.abs(residual).max() <= 0.33 + 1e-9


def test_pictures_count_v_strips_as_the_digitizer_does():
    """As built: the strip under the middle of each crossing is among the fired ones."""
    result = run("besiii-cgem", Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 20, seed=2)
    for event, layer in np.ndindex(20, 3):
        hit = crossing(result, event, layer)
        v = hit.v(hit.x(hit.phi[1]), hit.z[1])
        assert int(np.floor(strips_of_v(hit.layer, v))) in hit.strips_v


def test_every_pair_that_crosses_on_the_sheet(design):
    """Two tracks make four XV clusters, two of them ghosts; a pair that crosses beyond the end makes none."""
    a, b = 200, 230
    v_a, v_b = (crossing_strip(0, (strip + 0.5) * PITCH, 20.0) for strip in (a, b))
    v_off = crossing_strip(0, (b + 0.5) * PITCH, -265.0)  # with strip a beyond the end
    rows = x_strips(a, truth=0) + x_strips(b, truth=1)
    rows += v_strips(v_a, truth=0) + v_strips(v_b, truth=1) + v_strips(v_off, truth=1)
    clusters = cluster(design, digi_table(rows))
    xv = clusters[clusters["view"] == 2]
    pairs = list(zip(xv["x_cluster"].tolist(), xv["v_cluster"].tolist(), xv["truth"].tolist(), strict=True))
    assert pairs == [(0, 2, 0), (0, 3, -1), (1, 2, -1), (1, 3, 1), (1, 4, 1)]
    assert np.all(np.abs(xv["z"]) <= 266.0)


def test_rows_come_by_layer_sheet_and_view(design):
    """Within an event: layer, sheet, X, V, XV; links count rows of the table."""
    rows = [
        row
        for event in (0, 1)
        for layer, sheet in ((2, 1), (0, 0), (2, 0))
        for row in x_strips(100, layer=layer, sheet=sheet, event=event)
        + v_strips(crossing_strip(layer, 100.5 * PITCH, 0.0), layer=layer, sheet=sheet, event=event)
    ]
    clusters = cluster(design, digi_table(rows, 2))
    places = np.column_stack([clusters[name] for name in ("event", "layer", "sheet", "view")]).tolist()
    assert places == sorted(places)
    assert len(places) == 18
    xv = np.flatnonzero(clusters["view"] == 2)
    np.testing.assert_array_equal(clusters["x_cluster"][xv], xv - 2)
    np.testing.assert_array_equal(clusters["v_cluster"][xv], xv - 1)


def test_truth_with_most_charge(design):
    """The link is to the truth that left most charge in all strips together."""
    rows = x_strips(4, charge=3.0, truth=7) + x_strips(5, 6, charge=2.0, truth=8)
    clusters = cluster(design, digi_table(rows))
    assert clusters["truth"].tolist() == [8]
    assert clusters["n_truths"].tolist() == [2]


def test_strips_that_do_not_exist_are_refused(design):
    """Row, value and what was expected."""
    with pytest.raises(
        ValueError, match=r"digis row 1: strip: got 845, expected a strip of the sheet, of besiii-cgem-design"
    ):
        cluster(design, digi_table(x_strips(844, 845)))
    with pytest.raises(ValueError, match=r"digis row 0: sheet: got 1, expected a sheet of the layer"):
        cluster(design, digi_table(x_strips(3, sheet=1)))
    with pytest.raises(ValueError, match=r"digis row 0: layer: got 3, expected a layer of besiii-cgem-design"):
        cluster(design, digi_table(x_strips(3, layer=3)))
    with pytest.raises(ValueError, match=r"digis row 0: view: got 2, expected a whole number from 0 to 1"):
        cluster(design, digi_table([(0, 0, 0, 2, 1, 1.0, 0)]))


def test_no_digis_no_clusters():
    """An empty table, also for a detector without CGEM layers."""
    for name in ("besiii-cgem-design", "besiii-idc"):
        assert len(cluster(load(name), Table.empty("digis", 3))) == 0


# ----- errors


def size_errors(extents, pitch):
    """Errors by number of strips."""
    return _core.reconstruction.size_errors(extents, pitch, MAX_SIZE)


def test_errors_of_one_width_worked_by_hand():
    """W = 0.2 mm at p = 0.65: one strip if the centre is in 0.45 mm, two in 0.2 mm; error length/sqrt(12)."""
    errors = size_errors(np.array([0.2]), 0.65)
    # Never three: then the line lies anywhere in them, its centre in 3 * 0.65 - 0.2 = 1.75 mm.
    np.testing.assert_allclose(errors[:3] * np.sqrt(12), [0.45, 0.20, 1.75])
    # w = 0.8 mm: two strips in 2 * 0.65 - 0.8 = 0.5 mm, three in 0.8 - 0.65 = 0.15 mm, one never.
    errors = size_errors(np.array([0.8]), 0.65)
    np.testing.assert_allclose(errors[:4] * np.sqrt(12), [0.65, 0.5, 0.15, 1.8])


@pytest.mark.parametrize(
    ("extents", "pitch", "sizes"), [([-0.1], 0.65, 4), ([np.nan], 0.65, 4), ([0.1], 0.0, 4), ([0.1], 0.65, 0)]
)
def test_extents_that_are_none_are_refused(extents, pitch, sizes):
    """Negative, not a number, no pitch, no size."""
    with pytest.raises(ValueError, match="size_errors: expected extents of 0 or more"):
        _core.reconstruction.size_errors(np.array(extents), pitch, sizes)


def test_hardly_made_sizes_count_as_never_made():
    """One segment in 2000 that is just wide enough for three strips does not set their error."""
    errors = size_errors(np.append(np.full(1999, 0.2), 0.66), 0.65)
    np.testing.assert_allclose(errors[2], 1.75 / np.sqrt(12), rtol=1e-3)


def test_error_of_strips_that_something_else_fired():
    """A line of 0.2 mm thrown anywhere into five strips: RMS of its distance from their middle."""
    n, width, strips = 400_000, 0.2, 5
    begin = np.random.default_rng(7).uniform(0, strips * PITCH - width, n)
    residual = 0.5 * strips * PITCH - (begin + 0.5 * width)
    error = size_errors(np.array([width]), PITCH)[strips - 1]
    assert_within(residual.std(), error, rms_error(residual))
    with pytest.raises(AssertionError):
        assert_within(residual.std(), PITCH / np.sqrt(12), rms_error(residual))


def test_errors_of_a_mixture_are_weighted_by_how_often_a_size_occurs():
    """Against throwing segments on strips."""
    rng = np.random.default_rng(4)
    n, widths = 400_000, np.linspace(0.05, 1.6, 40)
    errors = size_errors(widths, 0.65)
    w, centre = rng.choice(widths, n), rng.uniform(0, 0.65, n)
    first, last = np.floor((centre - 0.5 * w) / 0.65), np.floor((centre + 0.5 * w) / 0.65)
    residual, size = 0.325 * (first + last + 1) - centre, last - first + 1
    for strips in (1, 2, 3, 4):
        sample = residual[size == strips]
        assert_within(sample.std(), errors[strips - 1], rms_error(sample))


def rms_error(sample):
    """Standard error of the RMS of a sample, from its fourth moment."""
    return np.std(sample**2) / (2 * np.sqrt(np.mean(sample**2)) * np.sqrt(len(sample)))


def test_error_table_of_a_detector(design):
    """One row per CGEM layer; clusters too long for a line err by their length; the field's sign does not matter."""
    err_x, err_v = cluster_errors(design, ClusterSettings())
    assert err_x.shape == err_v.shape == (3, MAX_SIZE)
    # The reference never makes three X strips: it extends over a tenth to a quarter of the pitch.
    extent = np.arange(3, MAX_SIZE + 1) - np.sqrt(12) * err_x[:, 2:] / PITCH
    assert np.all((extent > 0.1) & (extent < 0.27))
    mirrored = error_table(LAYERS, +1.0, ClusterSettings())
    np.testing.assert_allclose(mirrored, (err_x, err_v))
    assert cluster_errors(design, ClusterSettings())[0] is err_x


def test_straight_and_curling_references():
    """Without field the X extent vanishes; where no track reaches a layer, clusters err by their whole length."""
    whole = np.broadcast_to(np.arange(1, MAX_SIZE + 1) * PITCH / np.sqrt(12), (3, MAX_SIZE))
    err_x, _ = error_table(LAYERS, 0.0, ClusterSettings())
    np.testing.assert_allclose(err_x, whole)
    err_x, err_v = error_table(LAYERS, 1.0, ClusterSettings(reference_p=0.01))
    np.testing.assert_allclose(err_x, whole)
    np.testing.assert_allclose(err_v, whole)


def test_settings_list_every_problem():
    """All wrong values in one message."""
    wrong = r"position: got 'middle'(?s:.*)reference_p: got -1(?s:.*)reference_cos_theta: got 1.2"
    with pytest.raises(ValueError, match=wrong):
        ClusterSettings(position="middle", reference_p=-1, reference_cos_theta=1.2)
    with pytest.raises(ValueError, match=r'reference_p: got "x"(?s:.*)reference_cos_theta: got None'):
        ClusterSettings(reference_p="x", reference_cos_theta=None)


DESIGN = "besiii-cgem-design"


def test_pairs_cross_within_both_ends():
    """A pair of X and V makes a cluster if it crosses on the sheet, at either end."""
    detector = load(DESIGN)
    half, stereo = detector.cgem[0].half_length, detector.cgem[0].stereo
    x = 400
    strips = [crossing_strip(0, (x + 0.5) * PITCH, z) for z in (-half + 3, half - 3)]
    for strip, outward in zip(strips, (-1, 1), strict=True):
        step = -outward if stereo > 0 else outward  # V falls with z for a positive angle
        beyond = [strip + step * n for n in (8, 12, 20, 60)]
        xv = cluster(detector, digi_table(x_strips(x) + v_strips(strip, *beyond)))
        xv = xv[xv["view"] == 2]
        assert len(xv) == 1
        assert half - 6 < outward * xv["z"][0] <= half


def test_truths_of_a_cluster_are_counted():
    """As many as the largest number in one strip, or the different links, whichever is larger."""
    table = digi_table(x_strips(4, truth=1) + x_strips(5, truth=2) + x_strips(6, truth=2) + x_strips(9, truth=3))
    more = table.with_columns(n_truths=np.array([1, 3, 1, 2], "i4"))
    detector = load(DESIGN)
    assert cluster(detector, table)["n_truths"].tolist() == [2, 1]
    assert cluster(detector, more)["n_truths"].tolist() == [3, 2]
    assert cluster(detector, table)["truth"].tolist() == [2, 3]


@pytest.mark.parametrize("view", [0, 1])
def test_hits_beside_the_edge_of_a_sheet_are_as_good_as_others(view):
    """X and V begin anew at the edge; a track there may lie on the other side of it than its hit."""
    detector = load(DESIGN)
    pulls, near = [], []
    for layer in detector.cgem:
        for edge in layer.sheet_phi:
            gun = Gun("mu-", p=1.5, cos_theta=(-0.5, 0.5), phi=(edge - 0.03, edge + 0.03))
            fit = FitSettings(residuals=True)
            result = run(detector, gun, 80, seed=2, settings=Settings(fit=fit))
            assert np.mean(result.tracks["status"] == 0) > 0.97
            rows = result.residuals[result.residuals["view"] == view]
            number = detector.cgem.index(layer)
            at = rows[rows["layer"] == number]
            hits = at["hit"]
            x = result.clusters["x"][hits] if view == 0 else np.zeros(len(hits))
            near.append(np.minimum(x, layer.strips_x * layer.pitch_x - x) < 5)
            pulls.append(at["residual"])
    residual = np.concatenate(pulls)
    assert len(residual) > 300
    # A hit taken on the wrong side of the edge is off by the circumference.
    assert np.mean(np.abs(residual) < 3) > 0.97
    assert view == 1 or np.concatenate(near).sum() > 30


def test_the_reference_sample_ends_with_the_layer():
    """Straight tracks up to |cos(theta)| = 0.99: those that cross the middle of the gap within the length."""
    detector = load("besiii-cgem-design")
    straight = ClusterSettings(reference_p=1e6, reference_cos_theta=0.99)
    rows = layer_table(detector.cgem)
    counts = []
    for number, layer in enumerate(detector.cgem):
        width, _ = reference_widths({name: column[number] for name, column in rows.items()}, 1.0, straight)
        counts.append(len(width) / (layer.half_length / np.hypot(layer.half_length, layer.r_mid)))
    assert counts == pytest.approx([counts[0]] * len(counts), rel=2e-3)


def test_directions_belong_to_the_clusters_of_all_layers():
    """Each layer of a mixed detector takes those of its own clusters; without `clusters` they are made first."""
    detector, readout = load("besiii-pixel"), TigerReadout()
    digis = run(detector, Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 10, seed=3, readout=readout).digis
    clusters = cluster(detector, digis, readout=readout)
    directions = np.full((len(clusters), 2), np.nan)
    # One cluster of a CGEM layer behind the sensor has a track that it did not expect.
    (row,) = np.flatnonzero((clusters["layer"] == 2) & (clusters["view"] == 0))[3:4]
    directions[row] = 0.4, 1.1
    again = cluster(detector, digis, readout=readout, directions=directions, clusters=clusters)
    assert again["x"][row] != clusters["x"][row]
    moved = np.flatnonzero(~np.isclose(again["x"], clusters["x"], equal_nan=True))
    assert set(moved) <= {row, *np.flatnonzero(clusters["x_cluster"] == row)}
    assert cluster(detector, digis, readout=readout, directions=directions) == again
    for view, link in ((0, "x_cluster"), (1, "v_cluster")):
        points = clusters[clusters["view"] == 2]
        linked = clusters[points[link]]
        assert (linked["view"] == view).all()
        for name in ("event", "layer", "sheet"):
            assert np.array_equal(linked[name], points[name])
