"""X and V clusters on tracks among the noise of a run of 2026: found without truth, compared with it."""

import numpy as np

import cgemit as cg

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
    rows = np.roll(v["row"], shift)
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
