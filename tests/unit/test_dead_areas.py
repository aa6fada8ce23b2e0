"""Dead seams and ends of CGEM layers, and efficiencies of strips and wires: what they remove, and nothing else."""

import dataclasses

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.base.errors import DetectorError
from cgemit.detector.core import in_dead_area, seam_strips, strip_lists
from cgemit.simulation.background import add_background, read_out
from cgemit.tables import Table

CGEM = cg.load("besiii-cgem")
L1 = CGEM.cgem[0]
MUON = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
DEAD = {"cgem.*.dead_seam": "20 mm", "cgem.*.dead_ends": "15 mm"}


@pytest.fixture(scope="module")
def run():
    return cg.run(CGEM, MUON, n=120, seed=5, until="cluster")


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
    plain = cg.run(CGEM, MUON, n=160, seed=5, readout=readout, until="digitize")
    spoiled = CGEM.with_overrides(DEAD)
    left = cg.run(spoiled, MUON, n=160, seed=5, readout=readout, until="digitize")
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


def test_efficiencies_remove_their_share_of_what_particles_fire(run):
    keys = {"efficiency_x": 0.9, "efficiency_v": "70 %", "efficiency_wires": 0.8}
    spoiled = CGEM.with_overrides({f"background.bes2026.{name}": value for name, value in keys.items()})
    settings = cg.BackgroundSettings(level="bes2026")
    whole, left = (add_background(one, run.digis, run.wire_hits, settings, 3) for one in (CGEM, spoiled))

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
    again = add_background(spoiled, run.digis, run.wire_hits, settings, 3)
    assert again["digis"] == left["digis"]
    assert again["wire_hits"] == left["wire_hits"]


def test_efficiencies_are_those_of_particles(run):
    """Hits without truth, such as those of other events, stay."""
    level = dataclasses.replace(CGEM.background[0], efficiency_x=0.0, efficiency_v=0.0, efficiency_wires=0.0)
    digis = run.digis.with_columns(truth=np.where(run.digis["event"] % 2, -1, run.digis["truth"]))
    wires = run.wire_hits.with_columns(wire_truth=np.where(run.wire_hits["event"] % 3, -1, 0))
    left = read_out(level, digis, wires, 1)
    assert left[0]["gid"].tolist() == digis["gid"][digis["event"] % 2 == 1].tolist()
    assert left[1]["gid"].tolist() == wires["gid"][wires["event"] % 3 > 0].tolist()


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_efficiencies_do_not_depend_on_chunks(readout):
    spoiled = CGEM.with_overrides({"background.bes2026.efficiency_x": 0.5, "background.bes2026.efficiency_wires": 0.5})
    settings = cg.Settings(background=cg.BackgroundSettings(level="bes2026"))
    whole, parts = (
        cg.run(
            spoiled, MUON, n=30, settings=settings, readout=readout, until="digitize", workers=cg.Workers(chunk=chunk)
        )
        for chunk in (30, 7)
    )
    assert whole.digis == parts.digis
    assert whole.wire_hits == parts.wire_hits
    plain = cg.run(CGEM, MUON, n=30, settings=settings, readout=readout, until="digitize")
    x = [np.count_nonzero((one.digis["view"] == 0) & (one.digis["truth"] >= 0)) for one in (plain, whole)]
    assert x[1] / x[0] == pytest.approx(0.5, abs=4 * np.sqrt(0.25 / x[0]))


def test_the_finder_counts_no_hole_in_a_dead_area(monkeypatch):
    """A layer is not missed where it is known to be dead, 13 mm beside the seam; where it is taken for alive, it is."""
    dead = CGEM.with_overrides({"cgem.L2.dead_seam": "60 mm"})
    gun = cg.Gun("mu-", p=3.0, cos_theta=(-0.3, 0.3), phi=dead.cgem[1].sheet_phi[1] + 0.1)
    made = cg.run(dead, gun, n=40, seed=2, finder="ckf", readout="gaussian")
    assert not np.any(made.digis["layer"] == 1)
    holes, find = [], _core.find_tracks

    def recorded(*given, **named):
        out = find(*given, **named)
        holes.append(np.mean(out["holes"]))
        return out

    monkeypatch.setattr(_core, "find_tracks", recorded)
    for known in (dead, CGEM):
        assert len(cg.find_tracks(known, made.clusters, made.wire_hits)["candidates"]) == 40
    assert holes[0] < holes[1] - 0.9


def test_the_analytic_covariance_has_no_clusters_in_dead_areas():
    spoiled = CGEM.with_overrides({"cgem.L1.dead_ends": "100 mm"})
    edge = np.sin(np.arctan((L1.half_length - 50.0) / L1.r_mid))
    counts = [cg.analytic(one, "mu-", p=1.0, cos_theta=edge).n_clusters for one in (CGEM, spoiled)]
    assert counts[0] - counts[1] == pytest.approx(2.0, abs=0.03)
