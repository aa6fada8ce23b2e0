"""Dead and hot strips and gain maps change nothing else."""

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled
from cgemit.detector.core import grid_of, strip_gains, strip_lists
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.clusterers.binary import cluster_errors
from cgemit.truth import assign

DESIGN = cg.load("besiii-cgem-design")
READOUTS = ("binary", "analog-projection", "tiger", "apv25")
GUN = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
L1 = DESIGN.cgem[0]
L2 = DESIGN.cgem[1]


def run_on(detector, readout, n=60, until="cluster"):
    return cg.run(detector, GUN, n, 5, readout=readout, until=until)


def rows(digis, where=slice(None)):
    """Return the digis as tuples of what was measured."""
    names = ("event", "gid", "charge", "time")
    return set(zip(*(digis[name][where].tolist() for name in names), strict=True))


@pytest.mark.parametrize("readout", READOUTS)
def test_dead_strips(readout):
    """Dead strips give no digis; all other strips are as before, bit by bit."""
    plain = run_on(DESIGN, readout).digis
    dead = DESIGN.with_overrides({"cgem.L1.dead_x": ["0:100-499"], "cgem.L3.dead_v": ["1:0-700"]})
    gids = strip_lists(dead).dead
    assert len(gids) == 400 + 701
    assert (gids[0], gids[399]) == (100, 499)
    kept = ~np.isin(plain["gid"], gids)
    assert 0 < np.count_nonzero(~kept) < len(plain)
    assert rows(run_on(dead, readout).digis) == rows(plain, kept)


@pytest.mark.parametrize("readout", READOUTS)
def test_gain_map(readout):
    """A sheet with half of the gain has less charge; other sheets and layers are as before, bit by bit."""
    result = run_on(DESIGN, readout)
    plain = result.digis
    half = run_on(DESIGN.with_overrides({"cgem.L3.gain_map": [1.0, 0.5]}), readout).digis
    mine = [(digis["layer"] == 2) & (digis["sheet"] == 1) for digis in (plain, half)]
    # An avalanche at the seam has charge on both sheets.
    truths = result.truths
    from_seam = np.abs(np.angle(np.exp(2j * (truths["phi"] - DESIGN.cgem[2].phi_first)))) / 2
    at_seam = np.unique(truths["event"][(truths["layer"] == 2) & (from_seam < 0.03)])
    far = [~np.isin(digis["event"], at_seam) for digis in (plain, half)]
    assert rows(half, ~mine[1] & far[1]) == rows(plain, ~mine[0] & far[0])
    small = plain["charge"] < 20  # below saturation
    before = dict(
        zip(
            zip(plain["event"][mine[0] & small], plain["gid"][mine[0] & small], strict=True),
            plain["charge"][mine[0] & small],
            strict=True,
        )
    )
    after = dict(
        zip(zip(half["event"][mine[1]], half["gid"][mine[1]], strict=True), half["charge"][mine[1]], strict=True)
    )
    both = before.keys() & after.keys()
    assert len(both) > 50
    ratio = sum(after[key] for key in both) / sum(before[key] for key in both)
    assert 0.4 < ratio < 0.55


def test_gain_of_a_cell():
    """A grid acts where its cell is: rows along z, columns along X."""
    mapped = DESIGN.with_overrides({"cgem.L1.gain_map": [[[1.0, 1.0, 3.0], [1.0, 1.0, 1.0]]]})
    plain, changed = (run_on(one, "binary", 300, "digitize") for one in (DESIGN, mapped))
    assert len(plain.digis) == len(changed.digis)
    ratio = changed.digis["charge"] / plain.digis["charge"]
    truth = plain.digis["truth"]
    x = L1.r_readout * np.mod(plain.truths["phi"][truth] - L1.phi_first, 2 * np.pi)
    cell = (x > L1.strips_x * L1.pitch_x * 2 / 3) & (plain.truths["z"][truth] < 0) & (plain.digis["layer"] == 0)
    assert 300 < np.count_nonzero(cell) < 600
    np.testing.assert_allclose(ratio, np.where(cell, 3.0, 1.0), rtol=1e-12)


def test_gain_in_clusters():
    """Clusters weight charges without the gain: two halves of a sheet do not bend positions at their border."""
    mapped = DESIGN.with_overrides({"cgem.L1.gain_map": [[[1.0, 0.25]]], "cgem.L2.gain_map": [2.0, 1.0]})
    gains = strip_gains(mapped)
    per_sheet = L1.strips_x + L1.strips_v
    middle = L1.strips_x // 2
    assert (gains[middle - 1], gains[middle + 1], gains[L1.strips_x]) == (1.0, 0.25, 0.625)
    assert (gains[per_sheet], gains[-1]) == (2.0, 1.0)
    second = DESIGN.cgem[1]
    v_strips = per_sheet + second.strips_x + np.arange(2) * (second.strips_x + second.strips_v)
    assert gains[v_strips].tolist() == [2.0, 1.0]
    assert grid_of(mapped.cgem[2]).shape == (2, 0, 0)
    strips = np.array([middle - 2, middle - 1, middle, middle + 1, middle + 2])
    readout = cg.TigerReadout(estimator="centroid")
    charges = 4 * gains[strips]
    found = cluster(mapped, digis_of(strips, charges), readout=readout)
    plain = cluster(DESIGN, digis_of(strips, charges), readout=readout)
    even = cluster(DESIGN, digis_of(strips, np.full(5, 4.0)), readout=readout)
    assert found["x"][0] == pytest.approx(even["x"][0], abs=1e-9)
    assert abs(plain["x"][0] - even["x"][0]) > 0.3


def digis_of(strips, charge, event=None):
    """Return digis of X strips of the first layer."""
    n = len(strips)
    return cg.Table(
        "digis",
        {
            "event": np.zeros(n, np.int64) if event is None else event,
            **{name: np.zeros(n, np.int32) for name in ("layer", "sheet")}, "view": np.zeros(n, np.int8),
            "strip": np.asarray(strips, np.int32), "gid": np.asarray(strips, np.int32),
            "position": np.full(n, np.nan), "charge": np.asarray(charge, np.float64), "time": np.full(n, 150.0),
            "truth": np.zeros(n, np.int64), "n_truths": np.ones(n, np.int32),
        },
        n_events=1,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("bridge", "runs"),
    [(0, [(9, 9), (11, 11), (15, 15), (18, 18)]), (1, [(9, 11), (15, 15), (18, 18)]), (2, [(9, 11), (15, 18)])],
)
def test_bridges(bridge, runs):
    """A cluster bridges as many dead strips in a row as allowed, and no live strip; hot strips count as dead."""
    holes = DESIGN.with_overrides({"cgem.L1.dead_x": ["0:10", "0:16"], "cgem.L1.hot_x": ["0:17"]})
    digis = digis_of([9, 11, 15, 17, 18], np.full(5, 10.0))
    found = cluster(holes, digis, cg.ClusterSettings(bridge=bridge))
    assert list(zip(found["first"], found["last"], strict=True)) == runs
    charge_time = cluster(holes, digis, cg.ClusterSettings(bridge=bridge), readout=cg.TigerReadout(missing=0))
    assert list(zip(charge_time["first"], charge_time["last"], strict=True)) == runs
    apart = cluster(DESIGN, digis_of([9, 11], [10.0, 10.0]), cg.ClusterSettings(bridge=bridge))
    assert len(apart) == 2


def test_error_beside_dead_strips():
    """Each masked strip within or beside a cluster adds pitch^2/12 to the variance; other clusters are as before."""
    holes = DESIGN.with_overrides({"cgem.L1.dead_x": ["0:10", "0:20"]})
    digis = digis_of([9, 11, 21, 22, 40, 41], np.full(6, 10.0))
    found, plain = (cluster(one, digis) for one in (holes, DESIGN))
    errors = cluster_errors(DESIGN, cg.ClusterSettings())[0][0]
    more = L1.pitch_x**2 / 12
    expected = [np.hypot(errors[2], more**0.5), np.hypot(errors[1], more**0.5), errors[1]]
    np.testing.assert_allclose(found["err_x"], expected, rtol=1e-12)
    assert found["method"].tolist() == [1, 1, 0]
    assert {name: found[name][-1] for name in ("x", "err_x", "phi", "err_phi")} == {
        name: plain[name][-1] for name in ("x", "err_x", "phi", "err_phi")
    }


@pytest.mark.parametrize("readout", ["binary", "tiger"])
def test_pulls_beside_dead_strips(readout):
    """With each ninth strip dead, residuals of clusters that lack a strip are within their errors."""
    dead = {
        f"cgem.{layer.label}.dead_{view}": [f"{sheet}:{i}" for sheet in range(layer.sheets) for i in range(5, n, 9)]
        for layer in DESIGN.cgem
        for view, n in (("x", layer.strips_x), ("v", layer.strips_v))
    }
    holes = DESIGN.with_overrides(dead)
    result = run_on(holes, readout, 800)
    clusters = result.clusters
    own = assign.own_clusters(holes, clusters, result.truths)
    residual = assign.residuals(holes, clusters, result.truths, own)
    error = np.where(clusters["view"] == 0, clusters["err_x"], clusters["err_v"])[own]
    first, last = clusters["first"][own], clusters["last"][own]
    touched = (first + 3) % 9 >= 9 - (last - first + 2)
    assert np.count_nonzero(touched) > 1000
    pull = (residual / error)[touched & (np.abs(residual) < 2)]
    # 3 % for the delta electrons within 2 mm; errors are those of a dead strip with any charge, so no lower limit of 1:
    # a line through the other strips hardly moves
    assert 0.8 < np.sqrt(np.mean(pull**2)) < 1.15


def test_hot_strips():
    """A hot strip fires in every event, enters no cluster, and leaves the others as before."""
    hot = DESIGN.with_overrides({"cgem.L1.hot_x": ["0:3"], "cgem.L2.hot_v": ["0:7-8"]})
    plain, noisy = run_on(DESIGN, "tiger"), run_on(hot, "tiger")
    mine = np.isin(noisy.digis["gid"], strip_lists(hot).hot)
    assert np.count_nonzero(mine) == 3 * 60
    at = noisy.digis["gid"][mine]
    first = L1.strips_x + L1.strips_v
    assert sorted(set(at.tolist())) == [3, first + L2.strips_x + 7, first + L2.strips_x + 8]
    addresses = {name: noisy.digis[name][mine][:3].tolist() for name in ("layer", "sheet", "view", "strip")}
    assert addresses == {"layer": [0, 1, 1], "sheet": [0, 0, 0], "view": [0, 1, 1], "strip": [3, 7, 8]}
    assert rows(noisy.digis, ~mine) == rows(plain.digis, ~np.isin(plain.digis["gid"], strip_lists(hot).hot))
    assert len(noisy.clusters) <= len(plain.clusters)
    order = np.lexsort((noisy.digis["gid"], noisy.digis["event"]))
    assert (np.diff(order) == 1).all()


def test_dead_wins():
    """A strip that is listed as dead and as hot is dead."""
    both = DESIGN.with_overrides({"cgem.L1.hot_x": ["0:3-4"], "cgem.L1.dead_x": ["0:4"]})
    assert [part.tolist() for part in strip_lists(both)] == [[4], [3]]
    assert 4 not in run_on(both, "binary").digis["gid"]


def test_background_spares_dead_strips():
    """Noise does not fire dead strips."""
    dead = DESIGN.with_overrides({"cgem.L1.dead_v": [f"0:0-{L1.strips_v - 1}"]})
    settings = cg.Settings(background=cg.BackgroundSettings(level="bes2026", factor=5))
    found = cg.run(dead, GUN, 20, 1, settings=settings, until="digitize").digis
    noise = found["truth"] < 0
    assert np.count_nonzero(noise) > 10
    assert not ((found["layer"] == 0) & (found["view"] == 1)).any()


def test_file_and_hash(tmp_path):
    """Maps are written and read back; without maps file and hash are as they were before maps existed."""
    changes = {"cgem.L1.dead_x": ["0:17", "0:20-22"], "cgem.L3.gain_map": [0.5, [[1.0, 2.0], [1.5, 1.0]]]}
    mapped = DESIGN.with_overrides(changes)
    file = tmp_path / "mapped.toml"
    file.write_text(mapped.to_toml(), encoding="utf-8")
    assert cg.load(file) == mapped
    assert 'dead_x = ["0:17", "0:20-22"]' in file.read_text(encoding="utf-8")
    assert mapped.content_hash != DESIGN.content_hash
    assert not any(name in DESIGN.to_toml() for name in ("dead_x", "dead_v", "hot_x", "hot_v", "gain_map"))
    grid = grid_of(mapped.cgem[2])
    assert grid.tolist() == [[[0.5, 0.5], [0.5, 0.5]], [[1.0, 2.0], [1.5, 1.0]]]


def test_all_problems_of_a_file():
    """A wrong file lists all its problems."""
    wrong = {
        "cgem.L1.dead_x": ["0:17", "5:20", "x", 3], "cgem.L1.gain_map": [0.5, [[1], [2, 3]], "z", 1000],
        "cgem.L2.hot_v": "0:1", "cgem.L3.dead_v": ["0:99999", "1:7-5"],
    }  # fmt: skip
    with pytest.raises(cg.DetectorError) as caught:
        DESIGN.with_overrides(wrong)
    paths = [problem.path for problem in caught.value.problems]
    assert sorted(paths) == sorted(
        [
            "cgem.L1.dead_x[1]", "cgem.L1.dead_x[2]", "cgem.L1.dead_x[3]", "cgem.L1.gain_map", "cgem.L1.gain_map[1]",
            "cgem.L1.gain_map[2]", "cgem.L1.gain_map[3]", "cgem.L2.hot_v", "cgem.L3.dead_v[0]", "cgem.L3.dead_v[1]",
        ]
    )  # fmt: skip


def test_core_arguments():
    """The core refuses maps that do not fit the detector."""
    digis = digis_of([9], [10.0])
    errors = np.ones((3, 4))
    with pytest.raises(ValueError, match="masked: strip 100000"):
        _core.reconstruction.find_clusters(
            compiled(DESIGN), dict(digis.columns), err_x=errors, err_v=errors, by_charge=False, masked=[100_000]
        )
    truths = run_on(DESIGN, "binary", 2, "simulate").truths
    steps = cg.Table.empty("steps", n_events=2)
    with pytest.raises(ValueError, match="rows times columns"):
        _core.simulation.read_out_strips(
            compiled(DESIGN),
            dict(truths.columns),
            dict(steps.columns),
            gain=1.0,
            w_values=np.ones(3),
            threshold=0.0,
            gains={"shape": np.full(6, 2, np.int32), "values": np.ones(3)},
        )
