"""Background, dead areas and efficiencies: rates, links, what they remove, and what they leave as it is."""

import dataclasses

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.base.errors import DetectorError
from cgemit.base.files import parse_toml
from cgemit.cli import options
from cgemit.detector import compiled
from cgemit.detector.core import in_dead_area, layer_table, seam_strips, strip_lists
from cgemit.detector.drift import BESIII
from cgemit.simulation.background import CELLS, STRIPS, add_background, channel_kinds, mix_events, read_out, start_times
from cgemit.tables import Table
from stats import assert_within

MUON = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))


@pytest.fixture(scope="module")
def run():
    return cg.run("besiii-cgem", MUON, n=100, until="cluster")


def added(run, **settings):
    return add_background(run.detector, run.digis, run.wire_hits, cg.BackgroundSettings(**settings), seed=3)


def empty(run, n=400):
    return [Table.empty(kind, n_events=n) for kind in ("digis", "wire_hits")]


def test_off_changes_nothing(run):
    for settings in ({}, {"level": "bes2009", "factor": 0.0}):
        tables = added(run, **settings)
        assert tables["digis"] is run.digis
        assert tables["wire_hits"] is run.wire_hits


def test_the_shares_of_fired_cells_are_the_measured_ones(run):
    # Mean shares of random triggers of 2009: 34, 14, 7, 6.3 and 1.5 %; their rates have two digits.
    for clumps in (False, True):
        settings = cg.BackgroundSettings(level="bes2009", clumps=clumps)
        wires = add_background(cg.load("besiii-idc"), *empty(run), settings, seed=1)["wire_hits"]
        cells = {layer.number: layer.cells for layer in cg.load("besiii-idc").drift_chamber.layers}
        for layer, share in ((0, 0.32), (3, 0.14), (9, 0.07), (20, 0.06), (36, 0.015)):
            mean = np.count_nonzero(wires["layer"] == layer) / 400 / cells[layer]
            assert mean == pytest.approx(share, rel=0.15), layer
    assert np.all(np.diff(wires["event"]) >= 0)


def test_runs_fire_each_cell_with_the_share_of_the_closed_form(run):
    """A cell is silent if none of the runs that would reach it begins; without overlaps the same gate fails."""
    chamber, n = cg.load("besiii-idc"), 2000
    level = chamber.background[0]
    wires = add_background(chamber, *empty(run, n), cg.BackgroundSettings(level="bes2009"), seed=1)["wire_hits"]
    often = np.array(level.wire_runs) / sum(level.wire_runs)
    at_least = often[::-1].cumsum()[::-1]
    pulls = []
    for layer in chamber.drift_chamber.layers:
        area = 2 * np.pi * layer.r_mid / layer.cells * 2 * layer.half_length / 100
        rate = np.interp(layer.r_mid, [one.r for one in level.wire_rate], [one.rate for one in level.wire_rate])
        begins = 1 - np.exp(-rate * area * 2e-3 / (often @ np.arange(1, len(often) + 1)))
        found = np.bincount(wires["event"][wires["layer"] == layer.number], minlength=n) / layer.cells
        expected = np.array([1 - np.prod(1 - begins * at_least), begins * at_least.sum()])
        pulls.append((found.mean() - expected) / (found.std() / np.sqrt(n)))
    chi2 = np.sum(np.square(pulls), axis=0)
    assert chi2[0] < len(pulls) + 4 * np.sqrt(2 * len(pulls))
    assert chi2[1] > len(pulls) + 8 * np.sqrt(2 * len(pulls))


def test_a_given_share_of_cells_fires_within_the_drift_time(run):
    single = cg.BackgroundSettings(cells=0.2, clumps=False)
    wires = add_background(run.detector, *empty(run, 50), single, 1)["wire_hits"]
    total = 50 * sum(layer.cells for layer in run.detector.drift_chamber.layers)
    assert len(wires) / total == pytest.approx(0.2, abs=5 * np.sqrt(0.16 / total))
    assert wires["drift_time"].max() < 400
    clumped = add_background(run.detector, *empty(run, 50), cg.BackgroundSettings(cells=0.2), 1)["wire_hits"]
    assert len(clumped) / total == pytest.approx(0.2, rel=0.05)
    # Far more neighbours than of independent cells.
    pairs = [np.mean(np.diff(table["gid"]) == 1) for table in (wires, clumped)]
    assert pairs[0] == pytest.approx(0.2, abs=0.02)
    assert pairs[1] > 0.4
    runs = run.detector.background[0].wire_runs
    assert runs[0] / sum(runs) == pytest.approx(0.645, abs=0.001)


def test_cells_have_the_resolution_of_their_layer(run):
    """At the distance of the hit, as hits of particles have it."""
    sloping = run.detector.with_overrides({"drift_chamber.sigma_slope": "10 um/mm"})
    wires = add_background(sloping, *empty(run, 3), cg.BackgroundSettings(level="bes2009"), 1)["wire_hits"]
    layers = {layer.number: layer for layer in sloping.drift_chamber.layers}
    expected = [layers[n].sigma + 0.01 * drift for n, drift in zip(wires["layer"], wires["drift"], strict=True)]
    assert len(wires) > 300
    np.testing.assert_allclose(wires["sigma"], expected, rtol=1e-12)


def test_the_earliest_hit_of_a_cell_is_kept(run):
    wires = added(run, cells=0.5)["wire_hits"]
    key = np.stack([wires["event"], wires["gid"]])
    assert len(np.unique(key, axis=1).T) == len(wires)
    names = ("event", "gid", "drift_time")
    times = {(e, g): t for e, g, t in zip(*(wires[name].tolist() for name in names), strict=True)}
    for event, gid, drift in zip(*(run.wire_hits[name].tolist() for name in names), strict=True):
        assert times[event, gid] <= drift
    lost = len(run.wire_hits) - np.count_nonzero(wires["wire_truth"] >= 0)
    assert 0.05 < lost / len(run.wire_hits) < 0.4
    cells = [
        list(zip(*(hits[name].tolist() for name in ("layer", "wire", "gid")), strict=True))
        for hits in (run.wire_hits, wires)
    ]
    first = {(layer, wire): gid for layer, wire, gid in cells[0]}
    assert all(first.get((layer, wire), gid) == gid for layer, wire, gid in cells[1])


def test_strips_of_particles_stay_as_they_are(run):
    digis = added(run, level="bes2026", factor=3.0)["digis"]
    mine = digis[digis["n_truths"] > 0]
    assert all(np.array_equal(mine[name], run.digis[name], equal_nan=True) for name in digis if name != "event")
    noise = digis[digis["n_truths"] == 0]
    assert (noise["truth"] == -1).all()
    known = dict(
        zip(
            zip(*(run.digis[name] for name in ("layer", "sheet", "view", "strip")), strict=True),
            run.digis["gid"],
            strict=True,
        )
    )
    places = zip(*(noise[name] for name in ("layer", "sheet", "view", "strip")), strict=True)
    assert all(known.get(place, gid) == gid for place, gid in zip(places, noise["gid"], strict=True))


def test_clusters_and_noise_of_strips_have_their_rates(run):
    n = 1000
    quiet, noisy = (
        add_background(run.detector, *empty(run, n), cg.BackgroundSettings(level=level), seed=1)["digis"]
        for level in ("bes2009", "bes2026")
    )
    layer = run.detector.cgem[0]
    noise = run.detector.background[1].noise_v
    assert noise == 3.6
    expected = layer.sheets * layer.strips_v * noise * 1e-3 * n
    more = np.count_nonzero((noisy["layer"] == 0) & (noisy["view"] == 1)) - np.count_nonzero(
        (quiet["layer"] == 0) & (quiet["view"] == 1)
    )
    assert more == pytest.approx(expected, rel=0.05)
    # 1.9 kHz/cm^2 (r/76 mm)^-2.2 on the anodes of besiii-cgem (r 90.17, 132.53, 175.22, length 532, 690, 847 mm): 3.93,
    # 3.21 and 2.82 clusters of 3.5 strips in each view and microsecond, of which some lie on others.
    for number, clusters in enumerate((3.93, 3.21, 2.82)):
        strips = np.count_nonzero((quiet["layer"] == number) & (quiet["view"] == 0)) / n
        assert strips == pytest.approx(3.5 * clusters, rel=0.07), number  # 4 standard deviations


def test_noise_of_run_91668_has_the_rates_of_its_file(run):
    """Single strips of each view and layer, hot ones, charges of noise that are negative, clusters that fall with r."""
    n = 2000
    level = {one.label: one for one in run.detector.background}["run91668"]
    quiet = {"background.run91668.cluster_rate": "0 kHz/cm2", "background.run91668.hot_strips": 0.0}
    alone = add_background(
        run.detector.with_overrides(quiet), *empty(run, n), cg.BackgroundSettings(level="run91668"), seed=1
    )["digis"]
    for number, layer in enumerate(run.detector.cgem):
        rates = (level.noise_x, level.noise_v) if number == 0 else (level.outer_noise_x, level.outer_noise_v)
        for view, (rate, strips) in enumerate(zip(rates, (layer.strips_x, layer.strips_v), strict=True)):
            fired = np.count_nonzero((alone["layer"] == number) & (alone["view"] == view))
            expected = layer.sheets * strips * rate * 990e-6 * n
            assert abs(fired - expected) < 4 * np.sqrt(expected), (number, view)
    assert_within(alone["charge"].mean(), 3.75, 12.5 / np.sqrt(12 * len(alone)), 4.0)
    assert alone["charge"].min() < -2.4
    assert alone["charge"].max() < 10
    noisy = add_background(run.detector, *empty(run, n), cg.BackgroundSettings(level="run91668"), seed=1)["digis"]
    hot = np.bincount(noisy["gid"])
    hot = np.flatnonzero(hot > 0.2 * n)  # 0.0005 of 9897 strips
    assert 1 <= len(hot) <= 12
    assert_within(np.isin(noisy["gid"], hot).sum() / n / len(hot), 1 - np.exp(-0.495), 0.5 / np.sqrt(n * len(hot)), 4.0)
    x = (noisy["view"] == 0) & (noisy["charge"] > 10)  # no noise; 8/9 of the strips of clusters
    for number, layer in enumerate(run.detector.cgem):
        area = 2 * np.pi * layer.r_readout * 2 * layer.half_length / 100
        expected = 0.48 * (layer.r_readout / 90) ** -3.8 * area * 990e-6 * 5 * (40 / 45)
        assert np.count_nonzero(x & (noisy["layer"] == number)) / n == pytest.approx(expected, rel=0.12), number


def test_events_do_not_depend_on_each_other(run):
    settings = cg.BackgroundSettings(level="bes2026")
    whole = add_background(run.detector, *empty(run, 10), settings, seed=1)
    part = add_background(
        run.detector,
        *(Table.empty(kind, n_events=4, first_event=3) for kind in ("digis", "wire_hits")),
        settings,
        seed=1,
    )
    for name, table in part.items():
        assert table == whole[name].select_events(3, 7)


def test_one_event_is_replayed_alone(run):
    """What an event holds depends on its number and the seed alone, also for start times."""
    settings = cg.BackgroundSettings(level="bes2026", start_time=4.0)
    whole = add_background(run.detector, run.digis, run.wire_hits, settings, seed=1)
    for event in (0, 57):
        one = [table.select_events(event, event + 1) for table in (run.digis, run.wire_hits)]
        alone = add_background(run.detector, *one, settings, seed=1)
        assert all(alone[name] == whole[name].select_events(event, event + 1) for name in alone)
    other = add_background(run.detector, *one, settings, seed=2)
    assert other["wire_hits"] != alone["wire_hits"]


def single_cells(share, n=4000):
    """Return how often each cell of a layer fires in n events without runs, and the fired cells."""
    detector = cg.load("besiii-cgem")
    layers = detector.drift_chamber.layers
    begins = np.where(np.arange(len(layers)) == 3, share, 0.0)
    none = np.empty(0, np.int32)
    how = {"lengths": [1.0], "window": 1.0, "hot": none, "hot_fires": np.empty(0), "seed": 5}
    found = _core.simulation.background_cells(compiled(detector), np.arange(n), begins=begins, **how)
    assert set(found["layer"]) == {layers[3].number}
    return np.bincount(found["wire"], minlength=layers[3].cells), found


@pytest.mark.parametrize("share", [0.003, 0.2, 0.9])
def test_cells_fire_independently_with_equal_probability(share):
    """Counts of the cells of a layer are binomial, as are those of neighbours; another share fails the same gate."""
    n = 4000
    counts, found = single_cells(share, n=n)

    def chi2(expected):
        return np.sum((counts - n * expected) ** 2) / (n * expected * (1 - expected))

    spread = np.sqrt(2 * len(counts))
    assert abs(chi2(share) - len(counts)) < 4 * spread
    assert abs(chi2(share * (1 + 6 / np.sqrt(n * share))) - len(counts)) > 4 * spread
    fired = np.zeros((n, len(counts)), np.bool_)
    fired[found["event"], found["wire"]] = True
    pairs = np.count_nonzero(fired[:, 1:] & fired[:, :-1])
    expected = n * (len(counts) - 1) * share**2
    assert abs(pairs - expected) < 4 * np.sqrt(expected) + 1
    time = found["drift_time"]
    assert abs(time.mean() - 0.5) < 4 / np.sqrt(12 * len(time))


def test_the_number_of_clusters_is_poisson_and_sizes_are_uniform(run):
    """Clusters that are alone in a layer's view: from 1 to 6 strips, each as often; a wrong size fails the gate."""
    layers = run.detector.cgem
    n, mean, none = 20_000, 0.05, np.empty(0, np.int32)
    how = {
        "single": np.zeros(6),
        "charge": [10.0, 50.0],
        "noise_charge": [10.0, 50.0],
        "window": 1000.0,
        "hot": none,
        "hot_fires": np.empty(0),
    }
    strips = _core.simulation.background_strips(
        compiled(run.detector), np.arange(n), clusters=[0.0, mean, 0.0], most_strips=6, seed=2, **how
    )
    assert set(strips["layer"]) == {1}
    fired = np.unique(strips["event"])
    empty = np.exp(-mean)
    assert abs(len(fired) / n - (1 - empty)) < 4 * np.sqrt(empty * (1 - empty) / n)
    # Away from the edges of the sheets, where clusters are cut; 2.5 % of the events have two clusters.
    inner = (strips["view"] == 0) & (strips["strip"] > 6) & (strips["strip"] < layers[1].strips_x - 7)
    sizes = np.bincount(np.bincount(strips["event"][inner], minlength=n), minlength=7)[1:7]
    expected = sizes.sum() / 6

    def gate(found):
        return np.sum((found - expected) ** 2 / expected)

    assert gate(sizes) < 5 + 4 * np.sqrt(10) + 6
    assert gate(np.append(sizes[:5] + sizes[5] / 5, 0)) > 5 + 4 * np.sqrt(10) + 6
    assert abs(strips["charge"].mean() - 30) < 4 * 40 / np.sqrt(12 * len(strips["charge"]))
    with pytest.raises(ValueError, match="single"):
        _core.simulation.background_strips(
            compiled(run.detector), [0], clusters=[0, 0, 0], most_strips=1, seed=2, **how | {"single": np.zeros(2)}
        )
    how |= {"hot": np.array([-1], np.int32), "hot_fires": np.ones(1)}
    with pytest.raises(ValueError, match="hot: channel -1"):
        _core.simulation.background_strips(
            compiled(run.detector), [0], clusters=[0, 0, 0], most_strips=1, seed=2, **how
        )


def test_rows_are_ordered_by_channel():
    """Order and first rows are those of numpy's sort of several keys."""
    rng = np.random.default_rng(1)
    event, gid = np.sort(rng.integers(0, 50, 3000)), rng.integers(0, 40, 3000).astype(np.int32)
    time = rng.integers(0, 3, 3000).astype(np.float64)
    order, first = _core.simulation.by_channel(event, gid, time)
    assert np.array_equal(order, np.lexsort((time, gid, event)))
    keys = np.stack([event, gid])[:, order]
    assert np.array_equal(first, np.unique(keys, axis=1, return_index=True)[1])


def test_start_times_are_gaussian():
    """Width and tails are those of a Gaussian, and events are independent of each other."""
    times = start_times(np.arange(20_000), 5.0, 1)
    assert abs(times.mean()) < 4 * 5 / np.sqrt(20_000)
    assert abs(times.std() / 5 - 1) < 4 / np.sqrt(40_000)
    assert abs(np.mean(np.abs(times) > 10) - 0.0455) < 4 * np.sqrt(0.0455 / 20_000)
    assert abs(np.corrcoef(times[1:], times[:-1])[0, 1]) < 4 / np.sqrt(20_000)
    assert start_times(np.array([777]), 5.0, 1)[0] == times[777]


def test_background_is_part_of_the_chain():
    settings = cg.Settings(background=cg.BackgroundSettings(level="bes2009"))
    result = cg.run("besiii-cgem", MUON, n=5, settings=settings)
    assert np.count_nonzero(result.wire_hits["wire_truth"] < 0) > 100
    assert (result.matches["purity"] == 1).all()


def test_rates_that_cannot_be_are_refused():
    for wrong in ({"factor": 200.0}, {"cells": 0.5, "factor": 2.0}):
        with pytest.raises(ValueError, match=r"expected a (number from 0 to 100|product up to 0\.6)"):
            cg.BackgroundSettings(**wrong)


def test_levels_are_part_of_the_detector_file(run):
    detector = run.detector
    assert [level.label for level in detector.background] == ["bes2009", "bes2026", "run91668"]
    assert cg.load(parse_toml(detector.to_toml())) == detector
    double = detector.with_overrides(
        {"background.bes2009.cluster_rate": "x2", "background.bes2009.strip_window": "1 us"}
    )
    assert double.background[0].cluster_rate == 2 * detector.background[0].cluster_rate
    assert double.background[1] == detector.background[1]
    assert double.content_hash != detector.content_hash
    settings = cg.BackgroundSettings(level="bes2009")
    few, many = (add_background(one, *empty(run, 60), settings, seed=1)["digis"] for one in (detector, double))
    assert len(many) / len(few) == pytest.approx(2, rel=0.15)
    tables = parse_toml(detector.to_toml())
    tables["background"] = {"mine": {"wire_rate": [{"r": "500 mm", "rate": "100 Hz/cm2"}]}}
    own = cg.load(tables)
    wires = add_background(own, *empty(run, 40), cg.BackgroundSettings(level="mine", clumps=False), 1)["wire_hits"]
    area = sum(2 * np.pi * layer.r_mid * 2 * layer.half_length for layer in own.drift_chamber.layers) / 100
    assert len(wires) / 40 == pytest.approx(0.1 * area * 2e-3, rel=0.05)


def test_a_detector_without_the_level_says_so():
    for detector, level, text in (
        ("stcf-like", "bes2009", r"expected one of off; stcf-like has no table \[background.bes2009\]"),
        ("besiii-cgem", "bes209", 'expected one of off, bes2009, bes2026, run91668; did you mean "bes2009"'),
    ):
        settings = cg.Settings(background=cg.BackgroundSettings(level=level))
        with pytest.raises(ValueError, match=text):
            cg.run(detector, MUON, n=2, settings=settings)
    stress = cg.Settings(background=cg.BackgroundSettings(cells=0.1))
    assert len(cg.run("stcf-like", MUON, n=2, settings=stress, until="digitize").wire_hits) > 1000


def test_wrong_levels_are_listed_together(run):
    tables = parse_toml(run.detector.to_toml())
    wrong = {
        "wire_rate": [{"r": "90 mm", "rate": "1 kHz"}, {"r": "80 mm", "rate": "1 kHz/cm2"}],
        "wire_runs": [0, 0], "cluster_rate": "-1 kHz/cm2", "hot_wires": "120 %", "nois_v": "1 kHz",
    }  # fmt: skip
    tables["background"] = {"mine": wrong}
    with pytest.raises(DetectorError) as error:
        cg.load(tables)
    paths = {problem.path.removeprefix("background.mine.") for problem in error.value.problems}
    assert paths == {"wire_rate[0].rate", "wire_rate", "wire_runs", "cluster_rate", "hot_wires", "nois_v"}


def test_dead_channels_never_fire_and_are_always_the_same(run):
    keys = {"background.bes2009.dead_wires": 0.1, "background.bes2009.dead_strips": "20 %"}
    spoiled = run.detector.with_overrides(keys)
    settings = cg.BackgroundSettings(level="bes2009")
    for seed in (1, 2):
        whole = add_background(run.detector, run.digis, run.wire_hits, settings, seed)
        left = add_background(spoiled, run.digis, run.wire_hits, settings, seed)
        for name, share in (("digis", 0.2), ("wire_hits", 0.1)):
            gone = set(whole[name]["gid"]) - set(left[name]["gid"])
            assert 0.5 * share < 1 - len(left[name]) / len(whole[name]) < 2 * share
            assert not gone & set(left[name]["gid"])
            assert set(left[name]["gid"]) <= set(whole[name]["gid"])
    kinds = [channel_kinds(np.arange(6000), what) for what in (CELLS, STRIPS)]
    assert [np.mean(kind < 0.1) for kind in kinds] == pytest.approx([0.1, 0.1], abs=4 * np.sqrt(0.09 / 6000))
    assert abs(np.corrcoef(kinds)[0, 1]) < 4 / np.sqrt(6000)


def test_hot_channels_fire_at_their_rate(run):
    keys = {
        "background.bes2009.hot_wires": 0.01, "background.bes2009.hot_wire_rate": "1 MHz",
        "background.bes2009.hot_strips": 0.005, "background.bes2009.hot_strip_rate": "200 kHz",
    }  # fmt: skip
    spoiled = run.detector.with_overrides(keys)
    settings = cg.BackgroundSettings(level="bes2009")
    n = 100
    before, after = (add_background(one, *empty(run, n), settings, seed=1) for one in (run.detector, spoiled))
    channels = {
        "wire_hits": (sum(layer.cells for layer in spoiled.drift_chamber.layers), 0.01, 1 - np.exp(-2.0)),
        "digis": (
            sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in spoiled.cgem),
            0.005,
            1 - np.exp(-0.2),
        ),
    }
    for name, (total, share, fires) in channels.items():
        counts = [
            np.bincount(table[name]["gid"] - 484 * (name == "wire_hits"), minlength=total) for table in (before, after)
        ]
        hot = counts[1] > counts[0]
        assert np.count_nonzero(hot) == pytest.approx(share * total, rel=0.5)
        assert counts[1][hot].sum() / n / hot.sum() == pytest.approx(fires, rel=0.1)


def test_the_factor_multiplies_every_rate(run):
    """Twice the factor is twice each rate, to the bit; a rate that it leaves out differs."""
    tables = parse_toml(run.detector.to_toml())
    level = tables["background"]["bes2026"] | {"hot_wires": 0.01, "hot_strips": 0.01}
    level |= {"hot_wire_rate": "100 kHz", "hot_strip_rate": "20 kHz", "noise_x": "2 kHz"}
    level |= {"outer_noise_x": "1 kHz", "outer_noise_v": "1 kHz"}

    def doubled(quantity):
        number, unit = quantity.split(" ", 1)
        return f"{2 * float(number)!r} {unit}"

    rates = {name: doubled(value) for name, value in level.items() if str(value).endswith(("kHz", "kHz/cm2"))}
    noise = {"noise_x", "noise_v", "outer_noise_x", "outer_noise_v"}
    assert rates.keys() == {"hot_wire_rate", "hot_strip_rate", "cluster_rate", *noise}
    rates["wire_rate"] = [point | {"rate": doubled(point["rate"])} for point in level["wire_rate"]]

    def found(changes, factor):
        detector = cg.load(tables | {"background": {"bes2026": level | changes}})
        settings = cg.BackgroundSettings(level="bes2026", factor=factor)
        return add_background(detector, *empty(run, 40), settings, seed=1)

    expected = found({}, 2.0)
    assert found(rates, 1.0) == expected
    for name in rates:
        assert found({other: value for other, value in rates.items() if other != name}, 1.0) != expected, name


def test_levels_on_the_command_line():
    found = options.split(["background.level=bes2009", "background.bes2009.noise_v=2 kHz"], [])
    assert found.settings == [("background.level", "bes2009")]
    assert found.detector == {"background.bes2009.noise_v": "2 kHz"}


@pytest.fixture(scope="module")
def other():
    return cg.run(
        "besiii-cgem", cg.Gun("pi+", pt=(0.1, 0.5), cos_theta=(-0.8, 0.8), multiplicity=3), n=7, seed=9, until="cluster"
    )


def test_mixed_events_are_those_of_the_other_run(run, other):
    """Without a shift, each event holds its own first hits and all hits of one other event."""
    mixed = mix_events(run.detector, run.digis, run.wire_hits, other.tables, seed=4)
    whole = mix_events(
        run.detector, *(Table.empty(k, n_events=100) for k in ("digis", "wire_hits")), other.tables, seed=4
    )
    events = set()
    for event in range(100):
        alone = {name: table[table["event"] == event] for name, table in whole.items()}
        gids = [np.unique(other.wire_hits["gid"][other.wire_hits["event"] == i]) for i in range(7)]
        same = [i for i in range(7) if np.array_equal(alone["wire_hits"]["gid"], gids[i])]
        assert len(same) == 1
        events |= set(same)
        mine = run.wire_hits["gid"][run.wire_hits["event"] == event]
        both = mixed["wire_hits"]["gid"][mixed["wire_hits"]["event"] == event]
        assert set(both) == set(mine) | set(alone["wire_hits"]["gid"])
    assert events == set(range(7))
    assert (whole["wire_hits"]["wire_truth"] == -1).all()
    total = run.digis["charge"].sum() + whole["digis"]["charge"].sum()
    assert mixed["digis"]["charge"].sum() == pytest.approx(total)
    assert len(mixed["digis"]) < len(run.digis) + len(whole["digis"])
    key = np.stack([mixed["digis"]["event"], mixed["digis"]["gid"]])
    assert len(np.unique(key, axis=1).T) == len(mixed["digis"])


def test_the_earlier_of_two_mixed_hits_wins(run):
    """Mixed with themselves, hits stay if the other event is later, and are replaced if it is earlier."""
    one = run.select_events(0, 1)
    tables = {"digis": one.digis, "wire_hits": one.wire_hits}
    later = mix_events(run.detector, **tables, other=tables, offset=(30.0, 30.0))["wire_hits"]
    unique = np.unique(one.wire_hits["gid"])
    assert np.array_equal(later["gid"], unique)
    assert (later["wire_truth"] >= 0).all()
    earlier = mix_events(run.detector, **tables, other=tables, offset=(-30.0, -30.0))["wire_hits"]
    assert np.array_equal(earlier["gid"], unique)
    before = {g: min(one.wire_hits["drift_time"][one.wire_hits["gid"] == g]) for g in unique}
    for gid, time, link, drift in zip(*(earlier[n] for n in ("gid", "drift_time", "wire_truth", "drift")), strict=True):
        lost = before[gid] < 10  # outside of the window after the shift
        assert time == pytest.approx(before[gid] if lost else before[gid] - 30)
        assert (link >= 0) == lost
        assert lost or not 0 < time < 350 or drift == pytest.approx(np.interp(time, BESIII.time, BESIII.distance))


def test_events_are_mixed_from_files_in_the_chain(run, other, tmp_path):
    other.save(tmp_path / "other")
    given = cg.BackgroundSettings(events=str(tmp_path / "other"), offset=(-100.0, 100.0))
    settings = cg.Settings(background=given)
    found = cg.run("besiii-cgem", MUON, n=100, settings=settings, until="digitize")
    direct = mix_events(run.detector, run.digis, run.wire_hits, other.tables, offset=(-100.0, 100.0), seed=1)
    assert all(np.array_equal(found.wire_hits[name], direct["wire_hits"][name]) for name in found.wire_hits)
    assert all(np.array_equal(found.digis[n], direct["digis"][n], equal_nan=True) for n in found.digis)
    parts = cg.run(
        "besiii-cgem", MUON, n=100, settings=settings, until="digitize", workers=cg.Workers(threads=2, chunk=17)
    )
    assert parts.wire_hits == found.wire_hits


def test_what_cannot_be_mixed_is_refused(run, other, tmp_path):
    with pytest.raises(ValueError, match="other: wire_hits row 0: layer: got 0, expected a layer of besiii-cgem"):
        mix_events(run.detector, run.digis, run.wire_hits, cg.run("besiii-idc", MUON, n=2).tables)
    with pytest.raises(ValueError, match="digis: missing"):
        mix_events(run.detector, run.digis, run.wire_hits, {"wire_hits": other.wire_hits})
    with pytest.raises(FileNotFoundError, match=r"nothing holds no tables"):
        mix_events(run.detector, run.digis, run.wire_hits, tmp_path / "nothing")
    with pytest.raises(ValueError, match="expected a range from low to high"):
        cg.BackgroundSettings(offset=(2.0, 1.0))


def test_the_start_time_shifts_all_cells_of_an_event(run):
    """Times of an event move by one number of the stated width, and distances by the drift velocity."""
    found = added(run, start_time=3.0)["wire_hits"]
    shift = found["drift_time"] - run.wire_hits["drift_time"]
    event = run.wire_hits["event"]
    first = np.array([shift[event == i][0] for i in range(100)])
    assert np.allclose(shift, first[event])
    assert first.std() == pytest.approx(3.0, abs=4 * 3.0 / np.sqrt(200))
    assert abs(first.mean()) < 4 * 3.0 / 10
    middle = (found["drift_time"] > 30) & (run.wire_hits["drift_time"] > 30) & (found["drift_time"] < 45)
    middle &= run.wire_hits["drift_time"] < 45
    moved = found["drift"] - run.wire_hits["drift"]
    assert np.allclose(moved[middle], shift[middle] * 0.8 / 25)
    assert np.array_equal(found["sigma"], run.wire_hits["sigma"])
    assert added(run, start_time=3.0)["digis"] is run.digis


def test_a_wrong_start_time_costs_momentum_resolution():
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    widths = []
    for sigma in (0.0, 10.0):
        settings = cg.Settings(background=cg.BackgroundSettings(start_time=sigma))
        widths.append(cg.resolution(cg.run("besiii-cgem", gun, n=400, settings=settings).tracks, "p"))
    assert widths[1].core > widths[0].core + 4 * widths[1].core_error


def test_mix_events_lists_every_wrong_argument_and_takes_a_name(run, other):
    tables = {"digis": run.digis, "wire_hits": run.wire_hits}
    with pytest.raises(ValueError, match="mix_events:") as error:
        mix_events(run.detector, **tables, other=3, offset=(float("nan"), 1.0), seed=-1)
    assert [line.split(":")[0].strip() for line in str(error.value).splitlines()[1:]] == ["other", "offset", "seed"]
    for offset in (3, "ab", (1.0,), (2.0, 1.0), (None, 1.0), (0.0, float("inf"))):
        with pytest.raises(ValueError, match=r"offset: got .*, expected a range \(low, high\) of two numbers, ns"):
            mix_events(run.detector, **tables, other=other.tables, offset=offset)
    with pytest.raises(ValueError, match="digis: got dict, expected a table of kind 'digis'"):
        mix_events(run.detector, {}, run.wire_hits, other.tables)
    with pytest.raises(ValueError, match="digis: got other events than those of wire_hits"):
        mix_events(run.detector, other.digis, run.wire_hits, other.tables)
    named = mix_events("besiii-cgem", **tables, other=other.tables, seed=4)
    assert named["digis"] == mix_events(run.detector, **tables, other=other.tables, seed=4)["digis"]


CGEM = cg.load("besiii-cgem")
L1 = CGEM.cgem[0]
MUON_DEAD = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
DEAD = {"cgem.*.dead_seam": "20 mm", "cgem.*.dead_ends": "15 mm"}


@pytest.fixture(scope="module")
def run_dead():
    return cg.run(CGEM, MUON_DEAD, n=120, seed=5, until="cluster")


def rows(digis, where=slice(None)):
    names = ("event", "gid", "position", "charge")
    return sorted(zip(*(np.nan_to_num(digis[name][where]).tolist() for name in names), strict=True))


def from_seam(truths, layer):
    """Return the distance of crossings from the next edge of a sheet, mm."""
    turn = 2 * np.pi / layer.sheets
    off = np.mod(truths["phi"] - layer.phi_first, turn)
    last = layer.strips_x * layer.pitch_x / layer.r_readout
    return layer.r_readout * np.minimum(off, last - off)


def test_strips_of_the_seam_and_points_of_the_dead_area():
    layer = CGEM.with_overrides({"cgem.L2.dead_seam": "2 mm", "cgem.L2.dead_ends": "10 mm"}).cgem[1]
    # Pitch 0.65 mm: the middle of the second strip is at 0.975 mm, that of the third at 1.625 mm.
    assert seam_strips(layer).tolist() == [0, 1, layer.strips_x - 2, layer.strips_x - 1]
    width, end = layer.strips_x * layer.pitch_x, layer.half_length
    x = np.array([0.9, 1.1, width - 0.9, width - 1.1, 100.0, 100.0, 100.0])
    z = np.array([0.0, 0.0, 0.0, 0.0, end - 9.0, -end + 9.0, end - 11.0])
    assert in_dead_area(layer, x, z).tolist() == [True, False, True, False, True, True, False]
    assert not in_dead_area(L1, np.array([0.0, -1.0]), np.array([0.0, 400.0])).any()
    assert not len(seam_strips(L1))


@pytest.mark.parametrize("readout", ["binary", "gaussian", "tiger"])
def test_digis_of_crossings_in_dead_areas_are_gone_and_no_others(readout):
    plain = cg.run(CGEM, MUON_DEAD, n=160, seed=5, readout=readout, until="digitize")
    spoiled = CGEM.with_overrides(DEAD)
    left = cg.run(spoiled, MUON_DEAD, n=160, seed=5, readout=readout, until="digitize")
    dead = np.zeros(len(plain.truths), np.bool_)
    for number, layer in enumerate(CGEM.cgem):
        mine = plain.truths["layer"] == number
        gone = (from_seam(plain.truths, layer) < 10.0) | (np.abs(plain.truths["z"]) > layer.half_length - 15.0)
        dead |= mine & gone
    kept = ~dead[plain.digis["truth"]] & ~np.isin(plain.digis["gid"], strip_lists(spoiled).dead)
    assert 0.02 < dead.mean() < 0.2
    assert rows(left.digis) == rows(plain.digis, kept)
    assert 0.8 < kept.mean() < 0.98
    assert left.wire_hits == plain.wire_hits


def test_clusters_of_the_background_spare_dead_areas():
    spoiled = CGEM.with_overrides({"cgem.L1.dead_ends": "200 mm"})
    settings = cg.BackgroundSettings(level="bes2009")
    nothing = [Table.empty(kind, n_events=200) for kind in ("digis", "wire_hits")]
    plain, left = (add_background(one, *nothing, settings, 1)["digis"] for one in (CGEM, spoiled))
    counts = [np.count_nonzero(digis["layer"] == 0) for digis in (plain, left)]
    # Clusters are uniform in z.
    assert counts[1] / counts[0] == pytest.approx(1 - 200.0 / L1.half_length, abs=0.04)
    names = ("event", "gid")
    others = [{*zip(*(digis[n][digis["layer"] > 0].tolist() for n in names), strict=True)} for digis in (plain, left)]
    assert others[0] == others[1]


def test_wrong_seams_ends_and_efficiencies_are_listed_at_once():
    wrong = {
        "cgem.L1.dead_ends": "300 mm", "cgem.L2.dead_seam": "500 mm", "cgem.L3.dead_seam": "-1 mm",
        "background.bes2026.efficiency_x": 1.5, "background.bes2026.efficiency_wires": -0.1,
    }  # fmt: skip
    with pytest.raises(DetectorError) as error:
        CGEM.with_overrides(wrong)
    for path in wrong:
        assert f"{path}: got" in str(error.value), path
    assert "got 300 mm, expected less than 266 mm, which leaves a part of a sheet" in str(error.value)


def test_efficiencies_remove_their_share_of_what_particles_fire(run_dead):
    keys = {"efficiency_x": 0.9, "efficiency_v": "70 %", "efficiency_wires": 0.8}
    spoiled = CGEM.with_overrides({f"background.bes2026.{name}": value for name, value in keys.items()})
    settings = cg.BackgroundSettings(level="bes2026")
    whole, left = (add_background(one, run_dead.digis, run_dead.wire_hits, settings, 3) for one in (CGEM, spoiled))

    def of_particles(tables, view):
        digis, wires = tables["digis"], tables["wire_hits"]
        if view == 2:
            return np.count_nonzero(wires["wire_truth"] >= 0), np.count_nonzero(wires["wire_truth"] < 0)
        mine = digis["view"] == view
        return np.count_nonzero(mine & (digis["truth"] >= 0)), np.count_nonzero(mine & (digis["truth"] < 0))

    for view, share in ((0, 0.9), (1, 0.7), (2, 0.8)):
        (before, noise), (after, still) = of_particles(whole, view), of_particles(left, view)
        assert after / before == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / before) + 0.003), view
        # Background comes to light where the hit of a particle is not read out.
        assert noise <= still < 1.05 * noise
    again = add_background(spoiled, run_dead.digis, run_dead.wire_hits, settings, 3)
    assert again["digis"] == left["digis"]
    assert again["wire_hits"] == left["wire_hits"]


def test_efficiencies_are_those_of_particles(run_dead):
    """Hits without truth, such as those of other events, stay."""
    level = dataclasses.replace(CGEM.background[0], efficiency_x=0.0, efficiency_v=0.0, efficiency_wires=0.0)
    digis = run_dead.digis.with_columns(truth=np.where(run_dead.digis["event"] % 2, -1, run_dead.digis["truth"]))
    wires = run_dead.wire_hits.with_columns(wire_truth=np.where(run_dead.wire_hits["event"] % 3, -1, 0))
    left = read_out(level, digis, wires, 1)
    assert left[0]["gid"].tolist() == digis["gid"][digis["event"] % 2 == 1].tolist()
    assert left[1]["gid"].tolist() == wires["gid"][wires["event"] % 3 > 0].tolist()


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_efficiencies_do_not_depend_on_chunks(readout):
    spoiled = CGEM.with_overrides({"background.bes2026.efficiency_x": 0.5, "background.bes2026.efficiency_wires": 0.5})
    settings = cg.Settings(background=cg.BackgroundSettings(level="bes2026"))
    whole, parts = (
        cg.run(
            spoiled,
            MUON_DEAD,
            n=30,
            settings=settings,
            readout=readout,
            until="digitize",
            workers=cg.Workers(chunk=chunk),
        )
        for chunk in (30, 7)
    )
    assert whole.digis == parts.digis
    assert whole.wire_hits == parts.wire_hits
    plain = cg.run(CGEM, MUON_DEAD, n=30, settings=settings, readout=readout, until="digitize")
    x = [np.count_nonzero((one.digis["view"] == 0) & (one.digis["truth"] >= 0)) for one in (plain, whole)]
    assert x[1] / x[0] == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / x[0]))


def test_the_finder_counts_no_hole_in_a_dead_area(monkeypatch):
    """A layer is not missed where it is known to be dead, 13 mm beside the seam; where it is taken for alive, it is."""
    dead = CGEM.with_overrides({"cgem.L2.dead_seam": "60 mm"})
    gun = cg.Gun("mu-", p=3.0, cos_theta=(-0.3, 0.3), phi=dead.cgem[1].sheet_phi[1] + 0.1)
    made = cg.run(dead, gun, n=40, seed=2, finder="ckf", readout="gaussian")
    assert not np.any(made.digis["layer"] == 1)
    holes, find = [], _core.reconstruction.find_tracks

    def recorded(*given, **named):
        out = find(*given, **named)
        holes.append(np.mean(out["holes"]))
        return out

    monkeypatch.setattr(_core.reconstruction, "find_tracks", recorded)
    for known in (dead, CGEM):
        assert len(cg.find_tracks(known, made.clusters, made.wire_hits)["candidates"]) == 40
    assert holes[0] < holes[1] - 0.9


def test_the_analytic_covariance_has_no_clusters_in_dead_areas():
    spoiled = CGEM.with_overrides({"cgem.L1.dead_ends": "100 mm"})
    edge = np.sin(np.arctan((L1.half_length - 50.0) / L1.r_mid))
    counts = [cg.analytic(one, "mu-", p=1.0, cos_theta=edge).n_clusters for one in (CGEM, spoiled)]
    assert counts[0] - counts[1] == pytest.approx(2.0, abs=0.03)


def test_strips_behind_a_sensor_fire_and_positions_stay():
    """Noise is that of the innermost layer with strips; dead and hot channels are strips of CGEM layers alone."""
    noisy = {"cluster_rate": "0 kHz/cm2", "noise_v": "500 kHz", "strip_window": "1 us", "dead_strips": 0.2}
    noisy |= {"hot_strips": 0.02, "hot_strip_rate": "1000 kHz"}
    background = {"noisy": noisy}
    pixel = cg.load({"base": "besiii-pixel", "name": "noisy", "background": background})
    made = cg.run(pixel, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 200, seed=3, until="digitize")
    digis = add_background(pixel, made.digis, made.wire_hits, cg.BackgroundSettings(level="noisy"), seed=1)["digis"]
    of_sensor = digis["layer"] == 0
    for name, column in made.digis[made.digis["layer"] == 0].columns.items():
        np.testing.assert_array_equal(digis[of_sensor][name], column, err_msg=name)
    assert of_sensor.sum() > 300
    assert np.array_equal(np.lexsort((digis["layer"], digis["event"])), np.arange(len(digis)))
    strips = digis[~of_sensor]
    fired = digis["gid"][digis["truth"] < 0]
    first = layer_table(pixel.layers)["gid_first"]
    assert fired.min() >= first[1]  # behind the two channels of the sensor
    # Noise of V strips of L1: alive ones, each with the probability of the closed form.
    l1 = pixel.cgem["L1"]
    gids = first[1] + l1.strips_x + np.arange(l1.strips_v)
    kinds = channel_kinds(gids, STRIPS)
    quiet = gids[(kinds >= 0.2) & (kinds < 0.98)]
    counts = np.count_nonzero(np.isin(fired, quiet))
    expected = 200 * len(quiet) * (1 - np.exp(-0.5))
    assert abs(counts - expected) < 4 * np.sqrt(expected)
    # Elsewhere only hot strips fire on their own, and no dead one.
    others = strips["gid"][(strips["truth"] < 0) & ((strips["layer"] > 1) | (strips["view"] == 0))]
    assert len(others) > 100
    assert (channel_kinds(others, STRIPS) >= 0.98).all()
    assert (channel_kinds(strips["gid"], STRIPS) >= 0.2).all()
