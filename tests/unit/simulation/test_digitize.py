"""Readout of layers and wires row by row and in distribution; strip crossings against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gem_toy
from cgemit import _core, analytic
from cgemit.chain.run import run
from cgemit.detector import compiled, gas, load
from cgemit.detector.core import layer_table
from cgemit.detector.readouts import BinaryReadout, GaussianReadout
from cgemit.particles.gun import Gun
from cgemit.reconstruction.cluster import cluster
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.tables import Table
from stats import assert_within, fraction_error

ELECTRON = 1.602176634e-4  # fC


@pytest.fixture(scope="module")
def design():
    """The design CGEM with the outer drift chamber."""
    return load("besiii-cgem-design")


def read_out(detector, truths=None, wire_truths=None, n_events=1, seed=1, readout="binary", **settings):
    """`digitize` from bare columns; a table that is not given is empty."""
    tables = [
        Table.empty(kind, n_events) if columns is None else Table(kind, columns, n_events)
        for kind, columns in (("truths", truths), ("wire_truths", wire_truths))
    ]
    return digitize(detector.with_readout(readout), *tables, DigitizeSettings(**settings), seed)


def straight_up(phi, z_in, z_out, layer=1, **kwargs):
    """A truth of the design's layer 1 that moves in z only."""
    points = [[r * np.cos(phi), r * np.sin(phi), z] for r, z in ((121.338, z_in), (126.338, z_out))]
    return gem_toy.truth_columns(kwargs.pop("event", 0), layer, points[0], points[1], **kwargs)


def stacked(*columns):
    """Rows of several sets of columns."""
    return {name: np.concatenate([c[name] for c in columns]) for name in columns[0]}


def test_charge_of_a_truth_is_shared_equally(design):
    """3 keV at 25.9 eV an electron and gain 12 000: half of it in each view, the same on each strip of a view."""
    digis = read_out(design, straight_up(1.0, 10.0, 14.0, energy=3.0))["digis"]
    total = 3000 / 25.9 * 12_000 * ELECTRON
    for view in (0, 1):
        charge = digis["charge"][digis["view"] == view]
        np.testing.assert_allclose(charge, 0.5 * total / len(charge))
    assert np.count_nonzero(digis["view"] == 0) == 1
    assert np.count_nonzero(digis["view"] == 1) == 4  # 4 mm sin(31.05 deg) = 2.06 mm: 4 or 5 strips of 0.65 mm


def test_threshold_is_on_the_total_charge(design):
    """1.7 fC are 22.9 eV: a truth just above fires all its strips, one just below none."""
    at_threshold = 1.7 / (12_000 * ELECTRON) * 0.0259
    above = read_out(design, straight_up(1.0, 10.0, 14.0, energy=at_threshold * 1.001))["digis"]
    below = read_out(design, straight_up(1.0, 10.0, 14.0, energy=at_threshold * 0.999))["digis"]
    assert len(above) == 5
    assert len(below) == 0


def test_the_gas_of_a_layer_decides_on_the_charge():
    """28.7 eV an electron in Ar/CO2 70/30, 25.9 eV in Ar/iC4H10 90/10 (HEED)."""
    gas = {"density": "1.711e-3 g/cm3", "composition": {"Ar": 0.7, "C": 0.0819, "O": 0.2181}, "gas": True}
    gas["ionization"] = "ar-co2-70-30"
    mixed = load({"base": "besiii-cgem-design", "materials": {"ArCO2": gas}, "cgem": {"L2": {"gas": "ArCO2"}}})
    for layer, w_value in ((0, 25.9), (1, 28.7)):
        charge = read_out(mixed, straight_up(1.0, 10.0, 14.0, layer=layer, energy=3.0))["digis"]["charge"]
        assert charge.sum() == pytest.approx(3000 / w_value * 12_000 * ELECTRON)


def test_a_gas_table_without_its_energy_per_electron_is_refused(monkeypatch, tmp_path):
    """The message names the file and what it lacks."""
    (tmp_path / "gases").mkdir()
    (tmp_path / "gases" / "ar-co2-70-30.csv").write_text("quantity,at,value\ndensity,,1e-3\n")
    monkeypatch.setattr(gas.resources, "files", lambda package: tmp_path)
    gas.ionization.cache_clear()
    with pytest.raises(ValueError, match=r"ar-co2-70-30.csv: got no w_value, expected"):
        gas.ionization("ar-co2-70-30")


def test_truths_on_one_strip_add_up(design):
    """Two truths on the same strips: charges add, the larger one is linked, the earlier one gives the time."""
    small = straight_up(1.0, 10.0, 14.0, energy=1.0, time=0.4)
    large = straight_up(1.0, 10.0, 14.0, energy=3.0, time=0.9, particle=1)
    alone = read_out(design, small)["digis"]
    both = read_out(design, stacked(small, large))["digis"]
    np.testing.assert_array_equal(both["gid"], alone["gid"])
    np.testing.assert_allclose(both["charge"], 4 * alone["charge"])
    assert set(both["truth"]) == {1}
    assert set(both["n_truths"]) == {2}
    assert set(both["time"]) == {0.4}


def test_events_do_not_mix(design):
    """The same strips in two events are two sets of digis."""
    truths = stacked(straight_up(1.0, 10.0, 14.0, event=0), straight_up(1.0, 10.0, 14.0, event=2))
    digis = read_out(design, truths, n_events=3)["digis"]
    assert np.diff(digis.offsets).tolist() == [5, 0, 5]
    assert set(digis["n_truths"]) == {1}


def test_gid_counts_layer_sheet_view_strip():
    """First gid of every sheet and view of the detector as built, as pybes3 numbers them."""
    detector = load("besiii-cgem")
    layers = gem_toy.design_layers()
    firsts = []
    for layer, part in enumerate(detector.cgem):
        for sheet in range(part.sheets):
            phi = np.linspace(-np.pi, np.pi, 4001)[:-1]
            z = np.linspace(-0.99, 0.99, 4000) * layers["z_max"][layer]
            r = layers["r_gap_in"][layer]
            points = np.column_stack([r * np.cos(phi), r * np.sin(phi), z])
            digis = read_out(detector, gem_toy.truth_columns(np.arange(4000), layer, points, points), n_events=4000)
            for view in (0, 1):
                picked = digis["digis"][(digis["digis"]["sheet"] == sheet) & (digis["digis"]["view"] == view)]
                firsts += np.unique(picked["gid"] - picked["strip"]).tolist()
    assert firsts == [0, 856, 2029, 2659, 3736, 4366, 5443, 6275, 7670, 8502]


def test_rows_that_make_no_sense_are_refused(design):
    """A layer the detector does not have, and a position that is no number; the row is named."""
    good = straight_up(1.0, 10.0, 14.0)
    with pytest.raises(ValueError, match=r"truths row 1: layer: got 7, expected a layer of besiii-cgem-design"):
        read_out(design, stacked(good, straight_up(1.0, 10.0, 14.0, layer=7)))
    with pytest.raises(ValueError, match=r"truths row 1: \w+: got nan, expected a number from"):
        read_out(design, stacked(good, straight_up(1.0, 10.0, np.nan)))
    with pytest.raises(ValueError, match=r"wire_truths row 0: layer: got 3, expected a layer of besiii-cgem-design"):
        read_out(design, wire_truths=gem_toy.wire_truth_columns(0, 3, 5, 1.0))
    with pytest.raises(
        ValueError, match=r"wire_truths row 0: wire: got 76, expected a cell of the layer, of besiii-cgem-design"
    ):
        read_out(design, wire_truths=gem_toy.wire_truth_columns(0, 8, 76, 1.0))


def test_settings_list_every_problem():
    """Each wrong value is named with what was given and what was expected."""
    with pytest.raises(ValueError, match=r"reveal_sides: got 2(?s:.*)wire_times: got 'late', expected one of"):
        DigitizeSettings(reveal_sides=2, wire_times="late")
    with pytest.raises(ValueError, match=r"gain: got -1(?s:.*)threshold: got -0.1"):
        BinaryReadout(gain=-1, threshold=-0.1)
    with pytest.raises(ValueError, match=r"sigma_x: got 0(?s:.*)sigma_v: got inf(?s:.*)gain: got nan"):
        GaussianReadout(sigma_x=0, sigma_v=np.inf, gain=np.nan)


def test_settings_of_wrong_type_are_named():
    """What is no number, and no truth value, is a problem like any other."""
    given = (
        (DigitizeSettings, {"wire_times": 1, "reveal_sides": "x"}),
        (BinaryReadout, {"gain": "x", "threshold": [1.7]}),
        (GaussianReadout, {"sigma_x": None, "sigma_v": True}),
    )
    for kind, values in given:
        with pytest.raises(ValueError, match=kind.__name__) as caught:
            kind(**values)
        lines = str(caught.value).splitlines()[1:]
        assert {line.split(":")[0].strip() for line in lines} == values.keys()
        assert all("got " in line and ", expected " in line for line in lines)


# ----- gaussian readout


def toy_muons(n, seed=5):
    """Truths of muons through the design layers, away from the ends."""
    return gem_toy.muons_through(gem_toy.design_layers(), n, seed, limit=0.8)


def smeared(detector, truths, n_events=1, seed=1, **settings):
    """Clusters of the gaussian readout."""
    readout = GaussianReadout(**settings)
    digis = read_out(detector, truths, n_events=n_events, seed=seed, readout=readout)["digis"]
    return cluster(detector, digis, readout=readout)


def test_gaussian_digis_are_positions(design):
    """One row of X and one of V for each crossing, half of the charge in each, no strips; their order is free."""
    truths = stacked(straight_up(1.0, 10.0, 14.0, energy=3.0), straight_up(1.3, -60.0, -50.0, energy=1.0))
    digis = read_out(design, truths, readout=GaussianReadout(gain=8000, sigma_x=1e-9, sigma_v=1e-9))["digis"]
    assert digis["view"].tolist() == [0, 0, 1, 1]
    assert digis["truth"].tolist() == [0, 1, 0, 1]
    assert set(digis["strip"]) == set(digis["gid"]) == {-1}
    np.testing.assert_allclose(digis["charge"], 0.5 * np.array([3, 1, 3, 1]) / 0.0259 * 8000 * ELECTRON)
    layer = design.cgem[1]
    x = layer.r_readout * np.array([1.0, 1.3])  # of sheet 1, which begins at phi = 0
    v = x * np.cos(layer.stereo) + (-345.0 - np.array([12.0, -55.0])) * np.sin(layer.stereo)
    np.testing.assert_allclose(digis["position"], np.concatenate([x, v]))
    clusters = cluster(design, digis, readout="gaussian")
    assert clusters["truth"].tolist() == [0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(clusters["z"][4:], [12.0, -55.0])
    mixed = cluster(design, digis[np.array([2, 0, 3, 1])], readout="gaussian")
    assert mixed == clusters


def test_positions_without_a_partner_are_refused(design):
    """The n-th X and the n-th V position belong together: one V too few, a position that is none, and strips."""
    digis = read_out(design, straight_up(1.0, 10.0, 14.0), readout="gaussian")["digis"]
    with pytest.raises(ValueError, match=r"event 0, layer 1, sheet 1: 1 positions in X and 0 in V"):
        cluster(design, digis[:1], readout="gaussian")
    strips = read_out(design, straight_up(1.0, 10.0, 14.0))["digis"]
    with pytest.raises(ValueError, match=r"digis row 0: the position is not finite"):
        cluster(design, strips, readout="gaussian")
    with pytest.raises(ValueError, match=r"digis row 0: strip -1, expected 0 to 639"):
        cluster(design, digis)


def test_gaussian_clusters_have_the_given_errors():
    """X and V residuals: mean 0, the given widths, no correlation; each hit once in every view."""
    n, sigma_x, sigma_v = 20_000, 0.2, 0.1
    columns = toy_muons(n)
    clusters = smeared(load("besiii-cgem-design"), columns, n_events=n, sigma_x=sigma_x, sigma_v=sigma_v)
    xv = clusters[clusters["view"] == 2]
    truth, layers, layer = xv["truth"], gem_toy.design_layers(), xv["layer"]
    res_x = layers["r_readout"][layer] * np.angle(np.exp(1j * (xv["phi"] - columns["phi"][truth])))
    stereo = layers["stereo"][layer]
    res_v = res_x * np.cos(stereo) - (xv["z"] - columns["z"][truth]) * np.sin(stereo)
    for residual, sigma in ((res_x, sigma_x), (res_v, sigma_v)):
        assert_within(residual.mean(), 0.0, sigma / np.sqrt(len(residual)))
        assert_within(residual.std(), sigma, sigma / np.sqrt(2 * len(residual)))
    assert_within(np.corrcoef(res_x, res_v)[0, 1], 0.0, 1 / np.sqrt(len(truth)))
    # Three layers with the noise of three different draws.
    first = [res_x[(layer == k)][:5000] for k in range(3)]
    assert_within(np.corrcoef(first)[np.triu_indices(3, 1)], 0.0, 1 / np.sqrt(5000))
    np.testing.assert_allclose(xv["err_x"], sigma_x)
    np.testing.assert_allclose(xv["err_z"], np.hypot(sigma_v, np.cos(stereo) * sigma_x) / np.abs(np.sin(stereo)))
    assert len(clusters) == 3 * len(xv)
    assert set(clusters["method"]) == {1}
    for view, link in ((0, "x_cluster"), (1, "v_cluster")):
        np.testing.assert_array_equal(clusters["view"][xv[link]], view)
        np.testing.assert_array_equal(clusters["truth"][xv[link]], truth)


def test_gaussian_clusters_only_on_the_active_area(design):
    """Nothing beyond the ends and nothing in the dead area at a seam."""
    edge = gem_toy.design_layers()["phi_first"][1, 1]
    inside, beyond = straight_up(1.0, 343.0, 345.0), straight_up(1.0, 345.1, 346.0)
    seam = straight_up(edge - 0.001, 10.0, 14.0)
    assert len(smeared(design, inside)) == 3
    assert len(smeared(design, beyond)) == 0
    assert len(smeared(design, seam)) == 0


def test_returning_track_has_its_own_noise(design):
    """A particle that crosses a layer twice gets two different draws."""
    twice = stacked(straight_up(1.0, 10.0, 14.0), straight_up(1.0, 10.0, 14.0))
    x = smeared(design, twice)["x"]
    assert x[0] != x[1]


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_results_do_not_depend_on_chunks(design, readout):
    """Events 40 to 59 alone give the same rows as in the whole sample."""
    n = 100
    truths = Table("truths", toy_muons(n), n)
    doca = np.random.default_rng(2).uniform(-7, 7, 20 * n)
    wires = gem_toy.wire_truth_columns(np.repeat(np.arange(n), 20), np.tile(np.arange(8, 28), n), 11, doca)
    wire_truths = Table("wire_truths", wires, n)
    design = design.with_readout(readout)
    whole = digitize(design, truths, wire_truths, seed=9)
    part = digitize(design, truths.select_events(40, 60), wire_truths.select_events(40, 60), seed=9)
    for name, table in part.items():
        same = whole[name].select_events(40, 60)
        links = {"truth", "wire_truth", "x_cluster", "v_cluster"}
        for column in set(table.keys()) - links:
            np.testing.assert_array_equal(table[column], same[column])


def test_seeds_differ(design):
    """Another seed, other numbers."""
    one, two = (smeared(design, straight_up(1.0, 10.0, 14.0), seed=s) for s in (1, 2))
    assert one["x"][0] != two["x"][0]


# ----- wires


def test_drift_distance_has_the_layers_error():
    """Residuals of width sigma + slope |doca|, negative drift distances near the wire included."""
    detector = gem_toy.core_detector(wires=gem_toy.wire_layers(sigma=0.2, sigma_slope=0.03))
    n = 20_000
    for doca in (0.01, 3.0):
        truths = gem_toy.wire_truth_columns(np.arange(n), 8, 4, np.full(n, doca))
        drift = wire_hits(detector, truths)["drift"]
        sigma = 0.2 + 0.03 * doca
        assert_within(drift.mean(), doca, sigma / np.sqrt(n))
        assert_within(drift.std(), sigma, sigma / np.sqrt(2 * n))
        assert (drift.min() < 0) == (doca < 1)


def wire_hits(detector, truths, reveal_sides=False, seed=1):
    """Columns of wire hits from the kernel."""
    return _core.simulation.read_out_wires(
        detector,
        truths | {"delay": np.zeros(len(truths["event"]))},
        reveal_sides=reveal_sides,
        seed=seed,
    )


def test_error_of_a_hit_is_that_at_its_drift_distance():
    """The hit does not know doca: sigma follows from the measured distance."""
    detector = gem_toy.core_detector(wires=gem_toy.wire_layers(sigma=0.2, sigma_slope=0.03))
    hits = wire_hits(detector, gem_toy.wire_truth_columns(np.arange(100), 11, 4, np.linspace(-5, 5, 100)))
    np.testing.assert_allclose(hits["sigma"], 0.2 + 0.03 * np.maximum(hits["drift"], 0))


def test_the_steepest_slope_that_a_file_may_have_gives_errors_above_zero():
    """Tracks reach the corners of the cells, where the error of this file is 0.1 um."""

    def slanting(error_in_corner):
        height = 0.5 * (229.55 - 213.0)
        slope = (error_in_corner - 0.13) / np.hypot(np.pi * (213.0 + height) / 76, height)
        layers = {"9": {"sigma_slope": f"{slope:.12f} mm/mm"}}
        return load({"base": "besiii-cgem", "drift_chamber": {"layers": layers}})

    made = run(slanting(1e-4), Gun("mu-", pt=(0.03, 0.06), cos_theta=(-0.9, 0.9)), 3000, seed=1, until="digitize")
    ninth = made.wire_truths["layer"] == 9
    assert np.abs(made.wire_truths["doca"][ninth]).max() > 12.1
    sigma = made.wire_hits["sigma"][made.wire_hits["layer"] == 9]
    assert 0 < sigma.min() < 0.01
    with pytest.raises(ValueError, match=r"an error of -0\.0001 mm at 12\.3 mm"):
        slanting(-1e-4)


def test_efficiency():
    """A cell fires with the layer's efficiency."""
    n = 20_000
    detector = gem_toy.core_detector(wires=gem_toy.wire_layers(efficiency=0.9))
    hits = wire_hits(detector, gem_toy.wire_truth_columns(np.arange(n), 8, 4, np.full(n, 2.0)))
    assert_within(len(hits["drift"]) / n, 0.9, fraction_error(0.9, n))


def test_sides_are_hidden_unless_asked_for(design):
    """Side is 0, or the truth's side with reveal_sides."""
    truths = gem_toy.wire_truth_columns([0, 0], [8, 9], 5, np.array([-2.0, 3.0]))
    assert read_out(design, wire_truths=truths)["wire_hits"]["side"].tolist() == [0, 0]
    assert read_out(design, wire_truths=truths, reveal_sides=True)["wire_hits"]["side"].tolist() == [-1, 1]


def test_first_arrival_wins_a_shared_cell(design):
    """Two particles in a cell give one hit, that of the closer one; hits are ordered by layer and wire."""
    truths = gem_toy.wire_truth_columns(0, [9, 8, 8, 8], [3, 7, 7, 2], np.array([1.0, 5.0, -2.0, 4.0]), [0, 0, 1, 0])
    hits = read_out(design, wire_truths=truths)["wire_hits"]
    assert hits["wire_truth"].tolist() == [3, 2, 0]
    assert hits["layer"].tolist() == [8, 8, 9]
    assert hits["gid"].tolist() == [484 + 2, 484 + 7, 484 + 76 + 3]


def test_later_half_turns_arrive_later(design):
    """A second half turn that comes 300 ns later loses the cell, though closer; the flight of a first counts not."""
    truths = gem_toy.wire_truth_columns(0, 8, [7, 7, 2, 2], np.array([5.0, 1.0, 5.0, 1.0]))
    truths |= {"time": np.array([3.0, 303.0, 3.0, 303.0]), "half_turn": np.array([0, 1, 0, 0], "i1")}
    hits = read_out(design, wire_truths=truths)["wire_hits"]
    assert dict(zip(hits["wire"].tolist(), hits["wire_truth"].tolist(), strict=True)) == {7: 0, 2: 3}


def test_drift_time_follows_the_table():
    """At its points the table's times, half-way between them the mean, beyond them the last straight line."""
    detector = gem_toy.core_detector(wires=gem_toy.wire_layers(sigma=1e-12))
    doca = np.array([0.0, 0.5, 1.6, 8.3, 8.7])
    hits = wire_hits(detector, gem_toy.wire_truth_columns(np.arange(5), 8, 4, doca))
    np.testing.assert_allclose(hits["drift_time"], [0.0, 10.0, 37.5, 350.0, 400.0], atol=1e-6)


def test_time_below_the_wire_continues_the_first_line():
    """A drift distance that noise made negative has a negative time: the first line goes on."""
    detector = gem_toy.core_detector(wires=gem_toy.wire_layers(sigma=0.2))
    hits = wire_hits(detector, gem_toy.wire_truth_columns(np.arange(200), 8, 4, np.zeros(200)))
    below = hits["drift"] < 0
    assert below.any()
    np.testing.assert_allclose(hits["drift_time"][below], 20.0 * hits["drift"][below])


def test_kernels_check_their_columns(design):
    """Read-only columns are taken as they are; one of another length is refused."""
    table = Table("truths", straight_up(1.0, 10.0, 14.0), 1)
    kwargs = {"gain": 12_000.0, "w_values": np.full(3, 0.0259), "threshold": 1.7}
    steps = gem_toy.no_steps()
    digis = _core.simulation.read_out_strips(compiled(design), dict(table.columns), steps, **kwargs)
    assert len(digis["gid"]) == 5
    with pytest.raises(ValueError, match="one-dimensional array of length 1"):
        _core.simulation.read_out_strips(
            compiled(design), dict(table.columns) | {"energy": np.zeros(2)}, steps, **kwargs
        )
    with pytest.raises(ValueError, match="w_values: expected a one-dimensional array of length 3"):
        _core.simulation.read_out_strips(
            compiled(design), dict(table.columns), steps, **kwargs | {"w_values": np.ones(2)}
        )


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
    digis = _core.simulation.read_out_strips(detector, truths, gem_toy.no_steps(), **READOUT)
    return set(zip(digis["sheet"].tolist(), digis["view"].tolist(), digis["strip"].tolist(), strict=True))


def unrolled(columns, entry, exit_, margin):
    """Sheet, X and V of points on the projected segment, off the edges by `margin`; -1 elsewhere."""
    (phi_1, z_1), (phi_2, z_2) = entry, exit_
    share = np.linspace(0, 1, SAMPLES)
    short_way = np.angle(np.exp(1j * (phi_2 - phi_1)))
    phi, z = phi_1 + share * short_way, z_1 + share * (z_2 - z_1)
    r, half = columns["r_readout"][0], columns["z_max"][0]
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
    z *= columns["z_max"][0]
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
    z += side * columns["z_max"][0]
    assert_brute_force(columns, (phi, z), (phi + 0.001, z + rise))


@pytest.mark.parametrize("sheets", [3, 8])
@pytest.mark.parametrize("turn", [-3.0, 0.004, 2.9])
def test_layers_of_more_sheets(sheets, turn):
    """Segments that begin in the last sheet and go over up to five of them, either way round."""
    strips = int(2 * np.pi * gem_toy.design_layers()["r_readout"][0] / (sheets * 0.65))
    edges = 2 + 2 * np.pi / sheets * np.arange(sheets)
    columns = layer_columns(0, sheets=sheets, strips_x=strips, phi_first=np.resize(edges, 8))
    entry, exit_ = (edges[-1] + 0.3, -40.0), (edges[-1] + 0.3 + turn, 8.0)
    assert_brute_force(columns, entry, exit_)
    passed = len({sheet for sheet, _, _ in fired(columns, entry, exit_)})
    assert passed == {(3, -3.0): 3, (3, 0.004): 1, (3, 2.9): 2, (8, -3.0): 5, (8, 0.004): 1, (8, 2.9): 5}[sheets, turn]
    with pytest.raises(ValueError, match=r"layers phi_first: expected shape \(1, 8\)"):
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
    stereo, half = columns["stereo"][0], columns["z_max"][0]
    result = fired(columns, at(columns, 0, 0.60, 10.0), at(columns, 0, 1.40, 10.0))
    v = [x * np.cos(stereo) + (half - 10.0) * np.sin(stereo) for x in (0.60, 1.40)]
    first, last = (int(value / 0.65) for value in v)
    assert result == {(0, 0, 0), (0, 0, 1), (0, 0, 2)} | {(0, 1, strip) for strip in range(first, last + 1)}


@pytest.mark.parametrize("index", [0, 1])
def test_first_and_last_v_strip(index):
    """V strip 0 starts at X = 0 and z_ref; the corner opposite lies beyond the last V strip and has X strips only."""
    columns = layer_columns(index)
    z_ref = np.copysign(columns["z_max"][0], columns["stereo"][0])
    width = columns["strips_x"][0] * 0.65
    near = fired(columns, at(columns, 0, 1e-6, 0.9999999 * z_ref), at(columns, 0, 0.01, 0.9999999 * z_ref))
    far = fired(columns, at(columns, 0, width - 0.05, -0.99999 * z_ref), at(columns, 0, width - 0.01, -0.99999 * z_ref))
    assert near == {(0, 0, 0), (0, 1, 0)}
    assert far == {(0, 0, columns["strips_x"][0] - 1)}


@pytest.mark.parametrize("index", [0, 1])
def test_v_strips_off_the_corner(index):
    """With an offset of 0.9 strips the corner has X strips only up to V = 0.9 pitch, where V strip 0 begins."""
    columns = layer_columns(index, offset_v=0.9)
    z_ref, stereo = np.copysign(columns["z_max"][0], columns["stereo"][0]), columns["stereo"][0]

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


DETECTOR = load("besiii-cgem-design")
LAYERS = gem_toy.design_layers()
PER_KEV = 12_000 / 0.0259 * 1.602176634e-4  # fC
PITCH = 0.65


def read_out_deltas(truths, steps=None, n_events=1, **settings):
    """Digis of bare columns."""
    tables = Table("truths", truths, n_events), Table.empty("wire_truths", n_events)
    steps = None if steps is None else Table("steps", steps, n_events)
    return digitize(DETECTOR.with_readout(BinaryReadout(**settings)), *tables, steps=steps)["digis"]


def on_cylinder(layer, phi, z):
    """Points at mid-gap."""
    r = 0.5 * (LAYERS["r_gap_in"][layer] + LAYERS["r_gap_out"][layer])
    return np.column_stack(np.broadcast_arrays(r * np.cos(phi), r * np.sin(phi), z))


def radial(phi, z=12.0, layer=1, energy=3.0, event=0):
    """A truth straight outward: one X strip and one V strip."""
    ends = [np.array([r * np.cos(phi), r * np.sin(phi), z]) for r in (121.338, 126.338)]
    return gem_toy.truth_columns(event, layer, *ends, energy=energy)


def by_strip(digis, view=None):
    """Charge by (event, gid)."""
    rows = range(len(digis)) if view is None else np.flatnonzero(digis["view"] == view)
    return {(int(digis["event"][i]), int(digis["gid"][i])): float(digis["charge"][i]) for i in rows}


def test_charge_goes_where_the_delta_went():
    """2 keV stay on the track's strip; 1 keV lies on the X strips from 3.0 to 4.6 mm beside it."""
    phi = np.pi + (200.5 * PITCH) / 132.5  # in the middle of X strip 200 of sheet 0
    truth = radial(phi)
    ends = on_cylinder(1, phi + np.array([3.0, 4.6]) / 132.5, 12.0)
    steps = gem_toy.step_columns(truth, 0, 0.5 * (ends[0] + ends[1]), ends[1] - ends[0], energy=1.0)
    x = read_out_deltas(truth, steps)
    x = x[x["view"] == 0]
    assert x["strip"].tolist() == [200, 205, 206, 207]
    np.testing.assert_allclose(x["charge"], 0.5 * PER_KEV * np.array([2.0, 1 / 3, 1 / 3, 1 / 3]))
    assert set(x["truth"]) == {0}
    assert set(x["n_truths"]) == {1}
    without = read_out_deltas(truth)
    assert without["strip"][without["view"] == 0].tolist() == [200]


def test_every_step_is_read_out_like_a_segment_of_its_own():
    """Random deltas of random tracks: charge by strip is that of truths put in their places."""
    n, rng = 60, np.random.default_rng(8)
    truths = gem_toy.muons_through(LAYERS, n, seed=2, limit=0.8)
    link = np.sort(rng.integers(0, 3 * n, 500))
    layer = truths["layer"][link]
    phi = truths["phi"][link] + rng.normal(0, 3, 500) / LAYERS["r_readout"][layer]
    middle = np.concatenate([on_cylinder(k, p, z) for k, p, z in zip(layer, phi, rng.normal(0, 30, 500), strict=True)])
    vector = rng.normal(0, 0.5, (500, 3))
    truths["energy"][:] = 10.0
    steps = gem_toy.step_columns(truths, link, middle, vector, energy=0.1)
    alone = gem_toy.truth_columns(
        truths["event"][link], layer, middle - 0.5 * vector, middle + 0.5 * vector, energy=0.1
    )
    rest = truths | {"energy": 10.0 - 0.1 * np.bincount(link, minlength=3 * n)}
    both = {name: np.concatenate([rest[name], alone[name]]) for name in rest}
    order = np.argsort(both["event"], kind="stable")
    expected = by_strip(
        read_out_deltas({name: values[order] for name, values in both.items()}, n_events=n, threshold=0.0)
    )
    found = by_strip(read_out_deltas(truths, steps, n_events=n))
    assert found.keys() == expected.keys()
    np.testing.assert_allclose([found[k] for k in expected], list(expected.values()))
    assert len(found) > len(read_out_deltas(truths, n_events=n)) + 500


def test_steps_of_the_particle_itself_change_nothing():
    """Ionization clusters of the track are part of what lies between entry and exit."""
    truth = radial(1.0)
    clusters = gem_toy.step_columns(truth, [0, 0], on_cylinder(1, [1.01, 1.02], 12.0), np.zeros((2, 3)), parent=0)
    assert read_out_deltas(truth, clusters) == read_out_deltas(truth)


def test_deposits_off_the_active_area_are_lost():
    """Beyond the end of the layer nothing fires, and the rest keeps its charge."""
    truth = radial(1.0, z=344.0)
    steps = gem_toy.step_columns(truth, [0, 0], on_cylinder(1, 1.0, [346.0, 350.0]), np.zeros((2, 3)), energy=1.0)
    digis = read_out_deltas(truth, steps)
    assert np.count_nonzero(digis["view"] == 0) == 1
    np.testing.assert_allclose(digis["charge"][digis["view"] == 0], 0.5 * PER_KEV)


def test_deltas_cross_to_the_other_sheet():
    """A track at the end of sheet 0 whose delta went over the seam: strips on both sheets, one crossing."""
    width = LAYERS["strips_x"][1] * PITCH
    phi = np.pi + (width - 0.1) / 132.5
    truth = radial(phi)
    steps = gem_toy.step_columns(truth, 0, on_cylinder(1, phi + 4.0 / 132.5, 12.0), np.zeros(3), energy=1.0)
    x = read_out_deltas(truth, steps)
    x = x[x["view"] == 0]
    assert x["sheet"].tolist() == [0, 1]
    assert x["strip"].tolist()[0] == LAYERS["strips_x"][1] - 1
    np.testing.assert_allclose(x["charge"], 0.5 * PER_KEV * np.array([2.0, 1.0]))


def test_threshold_is_on_the_whole_deposit():
    """A truth that passes the threshold only with its delta fires all strips; below it none, the delta's included."""
    at_threshold = 1.7 / PER_KEV
    for factor, fired in ((1.001, 4), (0.999, 0)):
        truth = radial(1.0, energy=factor * at_threshold)
        steps = gem_toy.step_columns(truth, 0, on_cylinder(1, 1.1, 12.0), np.zeros(3), energy=0.9 * at_threshold)
        assert len(read_out_deltas(truth, steps)) == fired


def test_steps_that_do_not_belong_are_refused():
    """Row, and what is wrong with it: order, link, event, layer, values, more energy than there was."""
    two = {k: np.concatenate([a, b]) for (k, a), b in zip(radial(1.0).items(), radial(2.0).values(), strict=True)}
    two["event"] = np.array([0, 1])
    good = gem_toy.step_columns(two, [0, 1], on_cylinder(1, [1.0, 2.0], 12.0), np.zeros((2, 3)))
    assert len(read_out_deltas(two, good, 2))
    wrong = [
        ({"truth": np.array([1, 0])}, r"steps row 0: truth: got 1, expected a row of truths, of the same event"),
        ({"truth": np.array([0, 2])}, r"steps row 1: truth: got 2, expected a row of truths, of the same event"),
        ({"event": np.array([0, 0])}, r"steps row 1: truth: got 1, expected a row of truths"),
        ({"layer": np.array([0, 1], "i4")}, r"steps row 0: event, particle and layer"),
        ({"particle": np.array([0, 1], "i4")}, r"steps row 1: event, particle and layer"),
        ({"parent": np.array([1, 2], "i1")}, r"steps row 1: parent: got 2, expected a whole number from 0 to 1"),
        ({"parent": np.array([-1, 1], "i1")}, r"steps row 0: parent: got -1, expected a whole number from 0 to 1"),
        (
            {"n_electrons": np.array([0, -3], "i4")},
            r"steps row 1: n_electrons: got -3, expected a whole number of at least 0",
        ),
        ({"x": np.array([500.0, 500.0])}, r"steps row 0: radius 5\d\d\.\d+ mm, expected 121\.\d+ to 126\.\d+ mm"),
        ({name: (1 - 5.01 / 123.838) * good[name] for name in "xy"}, r"steps row 0: radius 118\."),
        ({"dz": np.array([0.0, np.nan])}, r"steps row 1: dz: got nan"),
        ({"energy": np.array([-1.0, 1.0])}, r"steps row 0: energy: got -1.0, expected a number from 0"),
        ({"energy": np.array([1.0, 3.5])}, r"truths row 1: its delta electrons deposit 0\.5\d* keV more"),
    ]
    for columns, message in wrong:
        with pytest.raises(ValueError, match=message):
            read_out_deltas(two, good | columns, 2)
    # The chord of 2 mm between points of the inner face dips 4 um below it.
    dip = LAYERS["r_gap_in"][1] * np.cos(1 / LAYERS["r_gap_in"][1])
    chord = gem_toy.step_columns(radial(0.0), 0, [dip, 0.0, 12.0], [0.0, 2.0, 0.0])
    assert len(read_out_deltas(radial(0.0), chord))
    with pytest.raises(ValueError, match="radius"):
        read_out_deltas(radial(0.0), chord | {"dy": np.zeros(1)})
    one = gem_toy.step_columns(radial(1.0), [0, 0], on_cylinder(1, [1.0, 1.1], 12.0), np.zeros((2, 3)))
    both = {name: np.concatenate([radial(1.0)[name]] * 2) for name in radial(1.0)}
    with pytest.raises(ValueError, match=r"steps row 1: truth 0, expected 1 to 1"):
        read_out_deltas(both, one | {"truth": np.array([1, 0])})


@pytest.mark.parametrize("readout", ["binary", "tiger", "gaussian"])
def test_layers_beside_a_sensor_are_read_out_as_alone(readout):
    """Layers draw by their numbers: those of a CGEM within a sensor, and those of pixels within a CGEM, stay the same.

    Rows keep numbers, strips and links of the whole detector; positions have no strip.
    """
    sensor = {"radius": "182 mm", "length": "700 mm", "sigma": "50 um", "thickness": "0.3 mm", "material": "Si"}
    wrapped = load({"base": "besiii-cgem-design", "name": "wrapped", "layer": {"W": sensor}})
    names = [layer.label for layer in load("besiii-pixel").cgem]
    pixels = load({"base": "besiii-pixel", "name": "pixels", "remove": [f"cgem.{name}" for name in names]})
    gun = Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    for detector, alone, last in ((wrapped, load("besiii-cgem-design"), 2), (load("besiii-pixel"), pixels, 0)):
        detector, alone = (one.with_readout(readout) for one in (detector, alone))
        made = run(detector, gun, 15, seed=3, until="digitize")
        truths, steps = made.truths, made.steps
        digis = digitize(detector, truths, made.wire_truths, None, 5, steps=steps)["digis"]
        place = np.cumsum(truths["layer"] <= last) - 1
        own = steps[steps["layer"] <= last]
        expected = digitize(
            alone, truths[truths["layer"] <= last], made.wire_truths, None, 5,
            steps=own.with_columns(truth=place[own["truth"]]),
        )["digis"]  # fmt: skip
        found = digis[digis["layer"] <= last]
        for name, column in expected.columns.items():
            now = place[found["truth"]] if name == "truth" else found[name]
            np.testing.assert_array_equal(now, column, err_msg=name)
        assert len(found) > 20
        assert np.array_equal(truths["layer"][digis["truth"]], digis["layer"])
        assert np.array_equal(digis["gid"] < 0, digis["strip"] < 0)
        first = layer_table(detector.layers)["gid_first"][digis["layer"]]
        assert (digis["gid"] >= first)[digis["strip"] >= 0].all()
        order = np.lexsort((digis["layer"], digis["event"]))
        assert np.array_equal(order, np.arange(len(order)))


@pytest.mark.parametrize("readout", ["binary", "tiger", "gaussian"])
def test_a_layer_sees_crossings_with_its_efficiency(readout):
    """The same ones whatever its readout; both views lose them, and the other layers nothing."""
    n, layer = 1000, DETECTOR.with_overrides({"cgem.L2.efficiency": 0.8}).with_readout(readout)
    gun = Gun("mu-", p=1.0, cos_theta=0.0)
    whole, found = (run(one, gun, n, seed=4, readout=readout, until="digitize") for one in (DETECTOR, layer))
    np.testing.assert_array_equal(found.truths["energy"], whole.truths["energy"])
    hit = found.digis["truth"]
    seen = np.isin(np.arange(len(found.truths)), hit)
    draws = _core.simulation.seen_crossings(
        compiled(layer), dict(found.truths.columns), efficiency=[1.0, 0.8, 1.0], seed=4
    )
    could = np.isin(np.arange(len(found.truths)), whole.digis["truth"])
    np.testing.assert_array_equal(seen, draws & could)
    assert_within(draws[found.truths["layer"] == 1].mean(), 0.8, np.sqrt(0.8 * 0.2 / n))
    assert draws[found.truths["layer"] != 1].all()
    for row in (0, 1):
        assert set(found.digis["truth"][found.digis["view"] == row]) <= set(np.flatnonzero(draws))
    same = np.isin(whole.digis["truth"], np.flatnonzero(draws))
    for name in ("event", "layer", "view", "strip", "charge", "time", "truth"):
        np.testing.assert_array_equal(found.digis[name], whole.digis[name][same], err_msg=name)


def test_the_covariance_expects_the_hits_that_layers_see():
    detector = DETECTOR.with_overrides({"cgem.L1.efficiency": 0.7})
    found, whole = (analytic(one, p=1.0, cos_theta=0.1, samples=4000) for one in (detector, DETECTOR))
    assert_within(float(whole.n_clusters - found.n_clusters), 2 * 0.3, 2 * np.sqrt(0.3 * 0.7 / 4000))
    assert "efficiency" not in DETECTOR.to_toml().partition("[drift_chamber")[0]
    assert (
        detector.content_hash
        != DETECTOR.content_hash
        == detector.with_overrides({"cgem.L1.efficiency": 1.0}).content_hash
    )
