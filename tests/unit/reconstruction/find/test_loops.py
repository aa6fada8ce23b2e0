"""Links between half turns of one particle: on exact helices, and on found and fitted tracks."""

import json
import math

import numpy as np
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.reconstruction.find import loops
from cgemit.reconstruction.find.loops import pair_chi2
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table
from fitted import make_tracks

BZ = -1.0
RADIUS = 3335.64095 / 10.0  # mm, of kappa = 10
TANL = 0.1
ONE = np.array([0.5, 0.3, 10.0, 2.0, TANL])


def half_turns(helix, n):
    """Return the helices that a fit of each of n half turns without loss gives."""
    found = []
    for turn in range(n):
        dr, phi0, kappa, dz, tanl = helix
        dz = dz + (turn + 1) // 2 * 2 * math.pi * RADIUS * tanl
        found.append([-dr, phi0 + math.pi, -kappa, dz, -tanl] if turn % 2 else [dr, phi0, kappa, dz, tanl])
    return np.array(found)


def table(helices, **columns):
    n = len(helices)
    values = dict(zip(("dr", "phi0", "kappa", "dz", "tanl"), np.asarray(helices).T, strict=True))
    cov = np.tile(np.diag([0.1, 1e-3, 0.1, 1.0, 1e-3]) ** 2, (n, 1, 1))
    return make_tracks(n, **({"event": np.zeros(n, "i8"), "cov": cov} | values | columns))


def test_half_turns_of_a_helix_have_no_chi_square():
    """All pairs of four half turns: the same circle, and whole turns apart along the beam."""
    tracks = table(half_turns(ONE, 4))
    one, other = np.triu_indices(4, 1)
    np.testing.assert_allclose(pair_chi2(tracks, one, other, BZ), 0, atol=1e-9)
    np.testing.assert_allclose(pair_chi2(tracks, other, one, BZ), 0, atol=1e-9)


def test_heights_are_less_certain_with_every_turn():
    """Errors of both helices, by differences of the predicted height, and 12 % of the momentum, after n turns."""
    helices, off = half_turns(ONE, 7), 60.0
    variances = np.array([0.1, 1e-3, 0.1, 1.0, 1e-3]) ** 2
    later = np.array([2, 4, 6])
    helices[later, 3] += off
    found = pair_chi2(table(helices), np.zeros(3, np.int64), later, BZ)
    turns, circle = later / 2, 2 * math.pi * RADIUS
    slope = 2 * variances[4] + TANL**2 * (2 * variances[2] / ONE[2] ** 2 + loops.LOSS**2)
    np.testing.assert_allclose(found, off**2 / (2 * variances[3] + turns**2 * circle**2 * slope / 4), rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_they_are_linked_to_the_first_in_any_order(seed):
    """Three particles, one from each side of the detector, in one event."""
    others = [np.array([-0.2, 0.9, -10.0, -1.0, 0.15]), np.array([0.1, -1.5, 10.0, 0.0, -0.12])]
    helices = np.concatenate([half_turns(helix, n) for helix, n in zip([ONE, *others], (5, 3, 4), strict=True)])
    owner = np.repeat(range(3), (5, 3, 4))
    order = np.random.default_rng(seed).permutation(12)
    first = loops.link_loops(table(helices[order]), BZ)
    start = np.array([0, 5, 8])
    np.testing.assert_array_equal(order[first], start[owner[order]])


@pytest.mark.parametrize(
    ("place", "change", "linked"),
    [
        ("phi0", 0.3, True),
        ("phi0", 0.8, False),  # 6.7 times the allowance of 0.12
        ("dr", 60.0, True),
        ("dr", 120.0, False),  # 6 times 20 mm, half the allowance times the radius
        ("tanl", 0.1, True),
        ("tanl", 0.2, False),
    ],
)
def test_what_differs_too_much_is_not_linked(place, change, linked):
    helices = half_turns(ONE, 2)
    helices[1, ("dr", "phi0", "kappa", "dz", "tanl").index(place)] += change
    helices[1, 3] = 2 + 2 * math.pi * RADIUS * 0.5 * (TANL - helices[1, 4])  # a whole turn at the mean slope
    assert loops.link_loops(table(helices), BZ).tolist() == ([0, 0] if linked else [0, 1])


def test_momentum_and_height_count():
    """A fifth less momentum is a loss, half is another particle; half of a whole turn along the beam is none."""
    helices = half_turns(ONE, 2)
    lost = [helices.copy() for _ in range(3)]
    lost[0][1, 2] *= 1.2
    lost[1][1, 2] *= 2.0
    lost[2][1, 3] -= math.pi * RADIUS * TANL
    assert [loops.link_loops(table(one), BZ).tolist() for one in lost] == [[0, 0], [0, 1], [0, 1]]


@pytest.mark.parametrize("columns", [{"event": np.arange(2)}, {"hypothesis": [11, 13]}, {"status": [0, 3]}])
def test_only_fitted_tracks_of_one_event_and_mass_are_linked(columns):
    columns = {name: np.array(values) for name, values in columns.items()}
    assert loops.link_loops(table(half_turns(ONE, 2), **columns), BZ).tolist() == [0, 1]


def test_a_group_never_joins_tracks_that_disagree():
    """B agrees with A and with C, but A not with C: C stays alone, since B is closer to A."""
    helices = half_turns(ONE, 2)[[0, 1, 1]]
    helices[1, 1] += 0.4
    helices[2, 1] += 0.85
    chi2 = pair_chi2(table(helices), np.array([0, 0]), np.array([1, 2]), BZ)
    assert chi2[0] < 20 < chi2[1]
    assert loops.link_loops(table(helices), BZ).tolist()[:2] == [0, 0]
    assert loops.link_loops(table(helices), BZ)[2] == 2


def test_found_electrons():
    """Most later half turns of single electrons are linked, to the first one of the same particle."""
    settings = cg.Settings(simulate=SimulateSettings(half_turns=4, decays=False), find=cg.FindSettings(hypothesis="e"))
    gun = cg.Gun("e-", p=(0.05, 0.1), cos_theta=(-0.6, 0.6))
    result = cg.run("besiii-cgem", gun, n=60, seed=1, settings=settings, finder="ckf")
    links = cg.study.loop_links(result)
    assert links.before == links.found.rates().loops
    assert links.before.count > 40
    assert links.after.count < 0.3 * links.before.count
    assert links.wrong.count == 0
    assert links.lost.count <= 1
    kept = links.first == np.arange(len(links.first))
    assert links.after.n == np.count_nonzero(kept)
    np.testing.assert_array_equal(links.first[links.first], links.first)
    np.testing.assert_array_equal(result.fitted["event"][links.first], result.fitted["event"])


def test_the_command_links(capsys):
    line = ["find", "-d", "besiii-cgem", "--particle", "e-", "--p", "0.05:0.1", "--cos-theta", "-0.5:0.5", "-n", "20"]
    assert main([*line, "--quiet", "--json", "--set", "simulate.half_turns=3"]) == 0
    loops = json.loads(capsys.readouterr().out)["loops"]
    assert loops["before"]["count"] > loops["after"]["count"]
    assert main([*line, "--quiet", "--set", "simulate.half_turns=3"]) == 0
    assert "loop clones after linking" in capsys.readouterr().out
    assert main([*line, "--quiet"]) == 0
    assert "after linking" not in capsys.readouterr().out


def test_wrong_input_is_refused():
    with pytest.raises(ValueError, match=r"bz: got nan.*expected a field"):
        loops.link_loops(table(half_turns(ONE, 2)), float("nan"))
    with pytest.raises(ValueError, match="expected a table of kind 'tracks'"):
        loops.link_loops(Table.empty("candidates", 1), BZ)
    with pytest.raises(ValueError, match="expected a run with until='fit'"):
        cg.study.loop_links(cg.run("besiii-cgem", cg.Gun("mu-", p=0.5, cos_theta=0.1), n=1, until="find"))
    assert loops.link_loops(make_tracks(0), BZ).tolist() == []


def test_without_a_field_no_track_turns_back():
    assert loops.link_loops(table(half_turns(ONE, 2)), BZ).tolist() == [0, 0]
    assert loops.link_loops(table(half_turns(ONE, 2)), 0.0).tolist() == [0, 1]
