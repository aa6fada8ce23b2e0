"""Particles that decay in flight: their rows in all tables, and what finder, match and pictures make of them."""

from __future__ import annotations

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.detector import load
from cgemit.particles.gun import Gun, generate
from cgemit.particles.species import DECAYS, KNOWN, DecayMode, decay_table
from cgemit.reconstruction.find import truth
from cgemit.simulation.transport import SimulateSettings, TransportStatus, simulate
from cgemit.tables import Table

DETECTOR = load("besiii-cgem-design")
GUN = Gun("K+", p=(0.2, 0.6), cos_theta=(-0.8, 0.8)) + Gun("pi-", p=(0.1, 0.4), cos_theta=(-0.8, 0.8))
N = 300


def simulated(**settings) -> dict[str, Table]:
    return simulate(DETECTOR, generate(GUN, N, seed=1), SimulateSettings(**settings), 2)


def own(table: Table) -> Table:
    return table[table["daughter"] == 0]


@pytest.fixture(params=cg.isa.available())
def kernels(request):
    """Use each instruction set in turn."""
    before = cg.isa.name()
    cg.isa.use(request.param)
    yield request.param
    cg.isa.use(before)


@pytest.mark.parametrize("fluctuations", ["full", "gaussian"])
def test_up_to_the_decay_nothing_changes(fluctuations, kernels):
    """Particles that do not decay are the same to the last bit; the others are until they decay.

    With lanes, particles that decay are those of scalar code, which rounds otherwise.
    """
    on, off = (simulated(fluctuations=fluctuations, decays=decays) for decays in (True, False))
    assert len(off["decays"]) == 0
    assert not off["truths"]["daughter"].any()
    gone = on["particles"]["status"] == TransportStatus.decayed
    assert 50 < np.count_nonzero(gone) < 400
    np.testing.assert_array_equal(on["particles"]["status"][~gone], off["particles"]["status"][~gone])

    def whose(table):
        return truth.particle_rows(on["particles"], table)

    def places(table):
        return (whose(table) * 100 + table["layer"]) * 1000 + table.columns.get("wire", 0)

    end = np.full(len(gone), np.inf)
    first = on["decays"][on["decays"]["daughter"] == 1]
    end[whose(first)] = first["time"]
    for kind in ("truths", "wire_truths"):
        mine, theirs = own(on[kind]), off[kind]
        before = theirs[theirs["time"] < end[whose(theirs)]]
        assert len(before) < len(theirs)
        # A decay close to a gap or cell may take its crossing away.
        before = before[np.isin(places(before), places(mine))]
        assert len(before) == len(mine) > np.count_nonzero(theirs["time"] < end[whose(theirs)]) - 4
        decays = gone[whose(mine)]
        for name in mine:
            np.testing.assert_array_equal(mine[name][~decays], before[name][~decays], err_msg=name)
            # Deposits are made of decisions, which fall otherwise if a number is rounded otherwise.
            if kernels == "scalar" or name not in ("energy", "secondaries"):
                near = {"rtol": 0 if kernels == "scalar" else 1e-9, "atol": 0 if kernels == "scalar" else 1e-9}
                np.testing.assert_allclose(mine[name][decays], before[name][decays], err_msg=name, **near)


def test_each_decay_is_told():
    """Every particle that decayed has a row for its first charged daughter, and no other particle has one."""
    out = simulated()
    first = out["decays"][out["decays"]["daughter"] == 1]
    assert not first["parent"].any()
    rows = truth.particle_rows(out["particles"], first)
    np.testing.assert_array_equal(rows, np.flatnonzero(out["particles"]["status"] == TransportStatus.decayed))
    for row, pdg, mode in zip(rows, first["pdg"], first["mode"], strict=True):
        assert DECAYS[int(out["particles"]["pdg"][row])][mode].charged[0].pdg == pdg


@pytest.mark.parametrize("kind", ["truths", "wire_truths"])
def test_hits_of_daughters_come_after_the_decay(kind):
    """Own hits come before the decay, those of a daughter after it; a particle with daughters' hits has decayed."""
    out = simulated()
    table, decays = out[kind], out["decays"]
    key = (table["event"] * 10 + table["particle"]) * 100 + table["daughter"]
    known = (decays["event"] * 10 + decays["particle"]) * 100 + decays["daughter"]
    late = table["daughter"] > 0
    assert np.count_nonzero(late) > 50
    assert np.isin(key[late], known).all()
    time = dict(zip(known.tolist(), decays["time"].tolist(), strict=True))
    assert all(t > time[k] for k, t in zip(key[late].tolist(), table["time"][late].tolist(), strict=True))
    mine = (~late) & np.isin(key + 1, known)
    assert np.count_nonzero(mine) > 200
    assert all(t < time[k + 1] for k, t in zip(key[mine].tolist(), table["time"][mine].tolist(), strict=True))


def test_daughters_start_where_the_parent_ends():
    """The nearest cells before and after a decay lie within a layer or two of it."""
    out = simulated()
    decays = out["decays"][out["decays"]["daughter"] == 1]
    decays = decays[np.hypot(decays["x"], decays["y"]) > 250]
    at = np.column_stack([decays[axis] for axis in "xyz"])
    found = []
    for event, particle, time, point in zip(decays["event"], decays["particle"], decays["time"], at, strict=True):
        cells = out["wire_truths"].select_events(event, event + 1)
        cells = cells[cells["particle"] == particle]
        where = np.column_stack([cells[axis] for axis in "xyz"])
        for after in (False, True):
            near = (cells["daughter"] == int(after)) & (np.abs(cells["time"] - time) < 0.5)
            distance = np.linalg.norm(where[near] - point, axis=1)
            # No faster than light.
            assert np.all(distance <= 299.8 * np.abs(cells["time"][near] - time) + 1e-6)
            found.append(near.any())
    assert len(found) > 40
    assert np.mean(found) > 0.7


def test_chunks_threads_and_neighbours(kernels):
    """The same bytes in one piece, in chunks and in threads, with every instruction set."""
    settings = cg.Settings(simulate=SimulateSettings(steps=True))
    whole, pieces = (
        cg.run(DETECTOR, GUN, 60, seed=5, settings=settings, workers=cg.Workers(threads=threads, chunk=chunk))
        for chunk, threads in ((60, 1), (7, 2))
    )
    assert len(whole.decays) > 10
    assert whole == pieces


def everything(detector, clusters, wire_hits):
    """Take all hits of an event as one track."""
    return cg.label_candidates(clusters, wire_hits, np.zeros(len(clusters), int), np.zeros(len(wire_hits), int))


def test_the_truth_finder_ends_at_the_decay():
    """Candidates hold the particle's own hits; they are pure and complete, and say that it decayed."""
    result = cg.run(DETECTOR, Gun("K+", p=0.4, cos_theta=(-0.5, 0.5)), 200, seed=3)
    hits = result.candidate_hits
    on_wire = hits["view"] == 2
    wires = result.wire_hits["wire_truth"][hits["row"][on_wire]]
    crossings = result.clusters["truth"][hits["row"][~on_wire]]
    assert not result.wire_truths["daughter"][wires].any()
    assert not result.truths["daughter"][crossings].any()
    gone = result.particles["status"] == TransportStatus.decayed
    assert 30 < np.count_nonzero(gone) < 80
    matched = result.tracks["particle"] >= 0
    assert np.all(gone[~matched])
    np.testing.assert_array_equal(result.tracks["decayed"], np.where(matched, gone, -1))
    assert np.all(result.tracks["purity"][matched] == 1)
    assert np.mean(result.tracks["efficiency"][matched]) > 0.99
    assert result.transport()["decayed"] == np.count_nonzero(gone)
    assert "decayed" in repr(result)


def test_a_candidate_across_the_kink_belongs_to_the_particle():
    """Hits of daughters count for whose track it is, not as hits of the particle itself."""
    result = cg.run(DETECTOR, Gun("K+", p=0.4, cos_theta=(-0.5, 0.5)), 200, seed=3, finder=everything)
    tracks, gone = result.tracks, result.tracks["decayed"] == 1
    left = np.bincount(result.wire_truths["event"], minlength=200) + np.bincount(result.truths["event"], minlength=200)
    assert np.all(tracks["particle"][left > 0] == 0)
    late = np.bincount(result.wire_truths["event"], result.wire_truths["daughter"] > 0, minlength=200)
    mixed = gone & (late > 5)
    assert np.count_nonzero(mixed) > 15
    assert np.all(tracks["purity"][mixed] < 1)
    assert np.all(tracks["purity"][~gone] == 1)
    assert np.all(tracks["efficiency"][tracks["purity"] > 0] == 1)
    assert np.all(tracks["efficiency"][tracks["purity"] == 0] == 0)


def test_studies_say_how_many_decayed():
    scan = cg.study.scan(DETECTOR, [0.3], particle="K-", cos_theta=(-0.5, 0.5), events=300, seed=4)
    gone = scan.samples[0].transport["decayed"]
    assert gone > np.count_nonzero(scan.samples[0].tracks["decayed"] == 1) > 50
    assert f" {gone} " in repr(scan).splitlines()[-1]
    assert "decayed" in repr(scan)


@pytest.mark.slow
def test_pictures_of_decays(tmp_path):
    """The event display draws events with kinks."""
    result = cg.run(DETECTOR, Gun("K+", p=0.3, cos_theta=0.0), 30, seed=6)
    event = int(result.decays["event"][0])
    cg.draw.event(result, event).save(tmp_path / "kink")
    assert list(tmp_path.iterdir())


def test_fractions_add_up():
    """Both charges of three particles; fractions are those of one whole, charges are conserved."""
    assert set(DECAYS) == {13, -13, 211, -211, 321, -321}
    for pdg, modes in DECAYS.items():
        assert sum(mode.fraction for mode in modes) == pytest.approx(1, abs=1e-12)
        for mode in modes:
            assert sum(one.charge for one in mode.products) == KNOWN[pdg].charge
            assert len(mode.charged) >= 1


@pytest.mark.parametrize(
    ("modes", "message"),
    [
        ((DecayMode(1.0, "phase_space", (KNOWN[321], KNOWN[14])),), "heavier than the particle"),
        ((DecayMode(0.5, "phase_space", (KNOWN[-13], KNOWN[14])),), "fractions with the sum 1"),
        ((DecayMode(1.0, "michel", (KNOWN[-11], KNOWN[12])),), "got 2 products"),
    ],
)
def test_impossible_decays_are_refused(modes, message):
    with pytest.raises(ValueError, match=message):
        decay_table({211: modes}, {211: 26.0})


def test_what_does_not_decay():
    """Protons, electrons, and what is too short-lived to be tracked, fly straight on."""
    guns = Gun("p", p=0.5, cos_theta=0.0) + Gun("e-", p=0.5, cos_theta=0.0) + Gun("Sigma-", p=0.5, cos_theta=0.0)
    out = simulate(DETECTOR, generate(guns, 20, seed=1), None, 1)
    assert len(out["decays"]) == 0
    assert _core.Purpose.decay == 11
