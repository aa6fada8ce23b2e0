"""Read-out of CGEM layers and wires, checked row by row and in distribution."""

import numpy as np
import pytest

import gem_toy
from cgemit import _core
from cgemit.detector import compiled, gas, load
from cgemit.detector.drift import XT_DISTANCE, XT_TIME
from cgemit.detector.readouts import BinaryReadout, GaussianReadout
from cgemit.reconstruction.cluster import cluster
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.tables import Table
from stats import assert_within, fraction_error

ELECTRON = 1.602176634e-4  # fC


@pytest.fixture(scope="module")
def design():
    """The design CGEM with the outer drift chamber."""
    return load("besiii-cgem-design")


def read_out(detector, truths=None, wire_truths=None, n_events=1, seed=1, **settings):
    """`digitize` from bare columns; a table that is not given is empty."""
    tables = [
        Table.empty(kind, n_events) if columns is None else Table(kind, columns, n_events)
        for kind, columns in (("truths", truths), ("wire_truths", wire_truths))
    ]
    return digitize(detector, *tables, DigitizeSettings(**settings), seed)


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
            z = np.linspace(-0.99, 0.99, 4000) * layers["half_length"][layer]
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
    with pytest.raises(ValueError, match=r"truths row 1: layer 7, expected 0 to 2"):
        read_out(design, stacked(good, straight_up(1.0, 10.0, 14.0, layer=7)))
    with pytest.raises(ValueError, match=r"truths row 1: a value is not finite"):
        read_out(design, stacked(good, straight_up(1.0, 10.0, np.nan)))
    with pytest.raises(ValueError, match=r"no wire layer 3"):
        read_out(design, wire_truths=gem_toy.wire_truth_columns(0, 3, 5, 1.0))
    with pytest.raises(ValueError, match=r"wire_truths row 0: wire 76, expected 0 to 75"):
        read_out(design, wire_truths=gem_toy.wire_truth_columns(0, 8, 76, 1.0))


def test_settings_list_every_problem():
    """Each wrong value is named with what was given and what was expected."""
    with pytest.raises(ValueError, match=r"readout: got 'analogue', expected one of 'binary', 'gaussian'(?s:.*)sides"):
        DigitizeSettings(readout="analogue", reveal_sides=2)
    with pytest.raises(ValueError, match=r"gain: got -1(?s:.*)threshold: got -0.1"):
        BinaryReadout(gain=-1, threshold=-0.1)
    with pytest.raises(ValueError, match=r"sigma_x: got 0(?s:.*)sigma_v: got inf(?s:.*)gain: got nan"):
        GaussianReadout(sigma_x=0, sigma_v=np.inf, gain=np.nan)


def test_settings_of_wrong_type_are_named():
    """What is no number, and no truth value, is a problem like any other."""
    given = (
        (DigitizeSettings, {"readout": 1, "reveal_sides": "x"}),
        (DigitizeSettings, {"readout": GaussianReadout}),
        (BinaryReadout, {"gain": "x", "threshold": [1.7]}),
        (GaussianReadout, {"sigma_x": None, "sigma_v": True}),
    )
    for kind, values in given:
        with pytest.raises(ValueError, match=kind.__name__) as caught:
            kind(**values)
        lines = str(caught.value).splitlines()[1:]
        assert {line.split(":")[0].strip() for line in lines} == values.keys()
        assert all("got " in line and ", expected " in line for line in lines)


# ----- gaussian read-out


def toy_muons(n, seed=5):
    """Truths of muons through the design layers, away from the ends."""
    return gem_toy.muons_through(gem_toy.design_layers(), n, seed, limit=0.8)


def smeared(detector, truths, n_events=1, seed=1, **settings):
    """Clusters of the gaussian read-out."""
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
    settings = DigitizeSettings(readout=readout)
    assert settings.readout.name == readout
    whole = digitize(design, truths, wire_truths, settings, seed=9)
    part = digitize(design, truths.select_events(40, 60), wire_truths.select_events(40, 60), settings, seed=9)
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
    return _core.read_out_wires(
        detector,
        truths | {"delay": np.zeros(len(truths["event"]))},
        xt_distance=XT_DISTANCE,
        xt_time=XT_TIME,
        reveal_sides=reveal_sides,
        seed=seed,
    )


def test_error_of_a_hit_is_that_at_its_drift_distance():
    """The hit does not know doca: sigma follows from the measured distance."""
    detector = gem_toy.core_detector(wires=gem_toy.wire_layers(sigma=0.2, sigma_slope=0.03))
    hits = wire_hits(detector, gem_toy.wire_truth_columns(np.arange(100), 11, 4, np.linspace(-5, 5, 100)))
    np.testing.assert_allclose(hits["sigma"], 0.2 + 0.03 * np.maximum(hits["drift"], 0))


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
    digis = _core.read_out_strips(compiled(design), dict(table.columns), steps, **kwargs)
    assert len(digis["gid"]) == 5
    with pytest.raises(ValueError, match="one-dimensional array of length 1"):
        _core.read_out_strips(compiled(design), dict(table.columns) | {"energy": np.zeros(2)}, steps, **kwargs)
    with pytest.raises(ValueError, match="w_values: expected a one-dimensional array of length 3"):
        _core.read_out_strips(compiled(design), dict(table.columns), steps, **kwargs | {"w_values": np.ones(2)})
