"""X and V clusters on tracks among the noise of a run of 2026: found without truth, compared with it."""

import numpy as np
import pytest

import bes3_layout
import cgemit as cg
from cgemit.bes3.reconstruct import numbered_tables, reconstruct_events
from stats import assert_within

EVENTS, MUONS = 120, 4


def shares(run, shift=0):
    """Return the share of V clusters on tracks without charge of their particle, and of crossings with V on a track.

    `shift`: by how many rows clusters are moved, which is wrong.
    """
    clusters, hits, digis, truths = run.clusters, run.candidate_hits, run.digis, run.truths
    matches, candidate = run.matches, run.tracks["candidate"]
    found = matches["particle"] >= 0
    owner = dict(zip(candidate[matches["track"][found]].tolist(), matches["particle"][found].tolist(), strict=True))
    particle = np.append(truths["particle"], -1)[digis["truth"]]
    v = hits[(hits["view"] == 1) & np.isin(hits["candidate"], list(owner))]
    wrong, seen = 0, set()
    rows = np.roll(v["hit"], shift)
    for own, row in zip(v["candidate"].tolist(), rows.tolist(), strict=True):
        mine = (digis["event"] == clusters["event"][row]) & (digis["view"] == 1)
        for name in ("layer", "sheet"):
            mine &= digis[name] == clusters[name][row]
        mine &= (digis["strip"] >= clusters["first"][row]) & (digis["strip"] <= clusters["last"][row])
        right = owner[own] in particle[mine]
        wrong += not right
        if right:
            seen.add((int(clusters["event"][row]), owner[own], int(clusters["layer"][row])))
    crossed = set(zip(*(truths[name].tolist() for name in ("event", "particle", "layer")), strict=True))
    return wrong / len(v), len(seen & crossed) / len(crossed)


def test_wrong_v_and_efficiency_of_points_in_noise() -> None:
    """Four muons an event: 0.3 % wrong of 3558 V clusters elsewhere, so that 1 % of 1430 is exceeded once in 10^4."""
    settings = cg.Settings(
        background=cg.BackgroundSettings(level="run91668"), simulate=cg.SimulateSettings(decays=False)
    )
    muons = cg.Gun("mu-", p=(0.3, 1.5), cos_theta=(-0.7, 0.7), multiplicity=MUONS)
    run = cg.run("besiii-cgem", muons, n=EVENTS, seed=31, readout="tiger", settings=settings, finder="ckf")
    wrong, efficiency = shares(run)
    assert wrong < 0.01
    assert efficiency > 0.97
    assert shares(run, shift=3 * MUONS)[0] > 0.5


OFFSET, SLACK = -8645.0, 15.0  # ns: clock of the strips against that of the wires; errors of first start times


@pytest.fixture(scope="module")
def measured():
    """A run with the noise of run 91668 in the file's layout: events begin anywhere, strips count from elsewhere."""
    settings = cg.Settings(
        background=cg.BackgroundSettings(level="run91668"), simulate=cg.SimulateSettings(decays=False)
    )
    detector, muon = cg.load("besiii-cgem").with_readout("tiger"), cg.Gun("mu-", p=(0.3, 1.5), cos_theta=(-0.7, 0.7))
    run = cg.run(detector, muon, n=EVENTS, seed=4, settings=settings)
    random = np.random.default_rng(2)
    late = bes3_layout.TICK * random.integers(-3000, 3000, EVENTS)
    events = bes3_layout.tables_of(bes3_layout.as_read_out(run, late, OFFSET), detector)
    near = bes3_layout.START + late + random.uniform(-SLACK, SLACK, EVENTS)
    mu = cg.Settings(fit=cg.FitSettings(hypothesis="mu"))
    return run, late, events, reconstruct_events(events, mu, start_time=near)


def test_start_times_in_noise(measured):
    """RMS of 0.8 ns; zero times of -231 ns, where -233.5 ns are assumed, make start times later by the difference."""
    _, late, _, found = measured
    assert (found.start_times["status"] == 0).mean() > 0.98
    away = (found.start_times["start_time"] - late - bes3_layout.START)[found.start_times["status"] == 0]
    assert_within(away.mean(), 233.5 + bes3_layout.ZERO, 1 / np.sqrt(EVENTS), 4.0)
    assert np.std(away) < 1
    strips = found.strip_times.meta
    assert_within(strips["offset"] + away.mean(), OFFSET, strips["err_offset"], 4.0)


def test_points_in_noise(measured):
    """Strips that the muon fired: 1 % of 356 V clusters is exceeded once in 10^4 if 0.05 % are wrong."""
    run, _, events, found = measured
    digis = run.digis[run.digis["truth"] >= 0]
    fired = set(zip(*(digis[name].tolist() for name in ("event", "layer", "sheet", "view", "strip")), strict=True))
    points = numbered_tables(events, found)["points"]
    place = np.stack([points[name] for name in ("event", "layer", "sheet")]).T.tolist()

    def shares(shift=0):
        has, right = np.zeros((2, 2, len(place)), np.bool_)
        for view, name in enumerate("xv"):
            first, last = points[f"{name}_first"], points[f"{name}_last"]
            has[view] = first >= 0
            for i in np.flatnonzero(has[view]).tolist():
                strips = range(int(first[i]) + shift, int(last[i]) + shift + 1)
                right[view, i] = any((*place[i], view, strip) in fired for strip in strips)
        both, good = has.all(axis=0), right.all(axis=0)
        crossed = set(zip(run.truths["event"].tolist(), run.truths["layer"].tolist(), strict=True))
        seen = {(event, layer) for (event, layer, _), one in zip(place, good, strict=True) if one}
        wrong_v = np.count_nonzero(has[1] & ~right[1]) / np.count_nonzero(has[1])
        return wrong_v, len(seen & crossed) / len(crossed), np.count_nonzero(good) / np.count_nonzero(both)

    wrong_v, efficiency, purity = shares()
    assert wrong_v < 0.01
    assert efficiency > 0.95
    assert purity > 0.98
    assert shares(shift=20)[0] > 0.5
