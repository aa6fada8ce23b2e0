"""Vertices and masses of pairs of tracks: exact helices, Gaussian-smeared ones, and mistakes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares, minimize
from scipy.stats import chi2 as chi2_law
from scipy.stats import kstest

import cgemit as cg
from cgemit import helix
from cgemit.analysis.vertices import with_truth
from cgemit.particles.gun import generate
from cgemit.particles.species import species
from cgemit.particles.table import particles_from
from cgemit.reconstruction.fit import fit
from cgemit.reconstruction.vertex import begin_at_vertices
from cgemit.tables import SCHEMAS
from cgemit.tables.schema import FitStatus
from cgemit.truth.match import compare
from stats import assert_within, mean_error

DETECTOR = cg.load("besiii-cgem-design")
BZ = -1.0
#: Errors of dr mm, phi0 rad, kappa, dz mm, tanl, with correlations as of a tracker.
ERRORS = np.array([0.12, 1e-3, 5e-3, 0.25, 2e-3])


def covariance(n: int) -> np.ndarray:
    correlation = np.eye(5)
    for i, j, value in ((0, 1, -0.8), (0, 2, 0.4), (1, 2, -0.6), (3, 4, -0.7)):
        correlation[i, j] = correlation[j, i] = value
    return np.tile(ERRORS[:, None] * correlation * ERRORS, (n, 1, 1))


def tracks_of(particles: cg.Table, *, smear: int | None = None) -> tuple[cg.Table, cg.Table]:
    """Return tracks with the helices of the particles, smeared with a seed, and their matches."""
    parameters = helix.at_origin(particles, BZ)
    cov = covariance(len(particles))
    if smear is not None:
        normal = np.random.default_rng(smear).normal(size=parameters.shape)
        parameters = parameters + np.einsum("nij,nj->ni", np.linalg.cholesky(cov), normal)
    n = len(particles)
    columns = {column.name: np.zeros((n, *column.shape), column.dtype) for column in SCHEMAS["tracks"]}
    columns |= dict(zip(helix.PARAMETERS, parameters.T, strict=True)) | {"cov": cov, "event": particles["event"]}
    columns |= {f"err_{name}": np.sqrt(cov[:, i, i]) for i, name in enumerate(helix.PARAMETERS)}
    columns |= {"hypothesis": np.abs(particles["pdg"]), "candidate": np.arange(n), "p": helix.momentum(parameters)}
    columns["charge"] = np.ones(n, np.int8)
    columns["err_p"] = helix.momentum_error(parameters, cov)
    tracks = cg.Table("tracks", columns, **particles.cover)
    same = {"event": particles["event"], "track": np.arange(n), "particle": particles["particle"]}
    same |= {"purity": np.ones(n), "efficiency": np.ones(n), "decayed": np.zeros(n, np.int8)}
    same |= {"other_mass": np.zeros(n, np.int8), "match": np.zeros(n, np.int8), "half_turn": np.zeros(n, np.int8)}
    same["quantile_p"] = np.full(n, 0.5)
    from cgemit.detector import compiled

    same |= compare(tracks, particles, np.arange(n), compiled(DETECTOR).field)
    return tracks, cg.Table("matches", same, **particles.cover)


@pytest.mark.parametrize(
    ("name", "of"), [("ks-pipi", ("pi", "pi")), ("lambda-ppi", ("p", "pi")), ("jpsi", ("mu", "mu"))]
)
def test_exact_helices_meet_at_their_vertex(name: str, of: tuple[str, str]) -> None:
    """Without errors of the parameters, vertex, momentum and mass are those of the decay."""
    particles = decays(name, 300)
    tracks, matches = tracks_of(particles)
    found = with_truth(cg.fit_vertices(DETECTOR, tracks, particles=of), tracks, matches, particles)
    pt = np.hypot(particles["px"], particles["py"]).reshape(-1, 2).min(axis=1)
    plain = pt > 0.05  # slower ones may have turned by more than half a turn at the vertex
    assert np.mean(plain) > 0.8
    assert np.all(found["status"][plain] == 0)
    for axis in "xyz":
        assert np.allclose(found[f"res_{axis}"][plain], 0, atol=1e-6)
    assert np.allclose(found["res_mass"][plain], 0, atol=1e-9)
    assert np.allclose(found["chi2"][plain], 0, atol=1e-9)
    for one in ("px", "py", "pz"):
        assert np.allclose(found[one][plain], particles[one].reshape(-1, 2).sum(axis=1)[plain], atol=1e-9)


def decays(name: str, n: int, seed: int = 1) -> cg.Table:
    """Return pairs of particles from one vertex, the positive one first."""
    if name == "jpsi":
        given = generate(cg.sample("pipi-jpsi"), n, seed)
        given = given[np.abs(given["pdg"]) == 13]
    else:
        given = generate(cg.sample(name), n, seed)
    order = np.lexsort((-given["charge"], given["event"]))
    columns = {key: value[order] for key, value in given.columns.items()}
    return cg.Table("particles", columns, given.n_events)


def test_momenta_have_the_charge_of_their_tracks() -> None:
    """Tracks of charge 2 have twice the momentum of their curvature, at the same vertex."""
    particles = cg.run(DETECTOR, cg.sample("ks-pipi"), 20, 3, until="simulate").particles
    tracks, _ = tracks_of(particles)
    pairs = cg.pair_tracks(tracks)
    once = cg.fit_vertices(DETECTOR, tracks, pairs)
    twice = cg.fit_vertices(DETECTOR, tracks.with_columns(charge=np.full(len(tracks), 2, np.int8)), pairs)
    for axis in "xyz":
        np.testing.assert_allclose(twice[axis], once[axis])
        np.testing.assert_allclose(twice[f"p{axis}"], 2 * once[f"p{axis}"])
    assert np.all(twice["mass"] > once["mass"])


@pytest.mark.parametrize("spot", [None, cg.BeamSpot(sigma=(0.4, 0.01, 10.0))], ids=["free", "beam spot"])
def test_smeared_helices_have_pulls_of_unit_width(spot: cg.BeamSpot | None) -> None:
    """Vertex, mass and chi-square of helices with exactly the errors that the covariances state."""
    n = 3000
    sigma = (0.0, 0.0, 0.0) if spot is None else spot.sigma
    gun = cg.Gun("mu+", p=(0.8, 1.5), cos_theta=(-0.8, 0.8), vertex_sigma=sigma)
    first = generate(gun, n, seed=5)
    second = generate(cg.Gun("mu-", p=(0.8, 1.5), cos_theta=(-0.8, 0.8)), n, seed=6)
    both = {name: np.stack([first[name], second[name]], axis=1).ravel() for name in first}
    for axis in "xyz":
        both[axis] = np.repeat(first[axis], 2)
    both["particle"] = np.tile([0, 1], n)
    particles = cg.Table("particles", both, n)
    tracks, matches = tracks_of(particles, smear=7)
    pairs = np.arange(2 * n).reshape(-1, 2)
    apart = np.abs(
        np.sin(first["px"] * 0 + np.arctan2(first["py"], first["px"]) - np.arctan2(second["py"], second["px"]))
    )
    found = with_truth(
        cg.fit_vertices(DETECTOR, tracks, pairs, particles=("mu", "mu"), beam_spot=spot), tracks, matches, particles
    )
    assert np.all(found["status"] == 0)
    assert np.all(found["ndf"] == (1 if spot is None else 4))
    wide = apart > 0.3  # tracks that cross at an angle; others are along a line, and not linear
    for name in ("x", "y", "z", "mass"):
        pull = found[f"pull_{name}"][wide]
        assert_within(pull.std(), 1, 1 / np.sqrt(2 * wide.sum()), 5, name)
        assert_within(pull.mean(), 0, mean_error(pull), 5, name)
    probability = chi2_law.sf(found["chi2"], found["ndf"])[wide]
    assert kstest(probability, "uniform").pvalue > 1e-4
    if spot is not None:  # the constraint makes the vertex better than the free fit and better than the beam spot
        free = cg.fit_vertices(DETECTOR, tracks, pairs, particles=("mu", "mu"))
        assert np.all(found["err_x"] < np.minimum(free["err_x"], 0.4))


@pytest.mark.parametrize("spot", [None, cg.BeamSpot(sigma=(3.0, 3.0, 30.0))], ids=["free", "beam spot"])
def test_the_error_of_the_mass_is_that_of_the_helices(spot: cg.BeamSpot | None) -> None:
    """Propagated by differences of all ten parameters; with a beam spot also by its position."""
    tracks, _ = tracks_of(decays("ks-pipi", 8, seed=3), smear=1)

    def fitted(tracks: cg.Table, spot: cg.BeamSpot | None = spot) -> cg.Table:
        return cg.fit_vertices(DETECTOR, tracks, beam_spot=spot)

    found = fitted(tracks)
    variance = np.zeros(len(found))
    for which in ("first", "second"):
        rows = found[which]
        slopes = []
        for i, name in enumerate(helix.PARAMETERS):
            step = np.zeros(len(tracks))
            step[rows] = 0.02 * ERRORS[i]
            up, down = (fitted(tracks.with_columns(**{name: tracks[name] + side * step})) for side in (1, -1))
            slopes.append((up["mass"] - down["mass"]) / (0.04 * ERRORS[i]))
        slope = np.array(slopes).T
        variance += np.einsum("ni,nij,nj->n", slope, tracks["cov"][rows], slope)
    if spot is not None:
        for axis, sigma in enumerate(spot.sigma):
            move = 0.02 * sigma * np.eye(3)[axis]
            up, down = (fitted(tracks, dataclasses.replace(spot, position=tuple(side * move))) for side in (1, -1))
            variance += ((up["mass"] - down["mass"]) / 0.04) ** 2
    assert (found["status"] == 0).all()
    np.testing.assert_allclose(found["err_mass"] ** 2, variance, rtol=0.02)


@pytest.mark.slow
def test_the_fit_is_the_least_squares_of_all_parameters() -> None:
    """A general minimiser over the nine parameters finds the same vertex and chi-square."""
    particles = decays("ks-pipi", 6, seed=3)
    tracks, _ = tracks_of(particles, smear=1)
    found = cg.fit_vertices(DETECTOR, tracks)
    for row in range(len(found)):
        pair = [found["first"][row], found["second"][row]]
        measured = np.stack([[tracks[name][one] for name in helix.PARAMETERS] for one in pair])
        half = np.linalg.cholesky(np.linalg.inv(covariance(1)[0])).T

        def distance(values: np.ndarray, measured: np.ndarray = measured, half: np.ndarray = half) -> np.ndarray:
            vertex, directions = values[:3], values[3:].reshape(2, 3)
            pt = 1 / np.abs(directions[:, 1])
            flight = [pt * np.cos(directions[:, 0]), pt * np.sin(directions[:, 0]), pt * directions[:, 2]]
            columns = {"event": [0, 0], "pdg": [211, -211], **dict(zip(("px", "py", "pz"), flight, strict=True))}
            columns |= {axis: [value, value] for axis, value in zip("xyz", vertex, strict=True)}
            from cgemit.particles.table import particles_from

            difference = helix.at_origin(particles_from(columns), BZ) - measured
            difference[:, 1] = np.remainder(difference[:, 1] + np.pi, 2 * np.pi) - np.pi
            return (difference @ half.T).ravel()

        start = [found[axis][row] + 0.3 for axis in "xyz"]
        for k in range(2):
            start += [measured[k, 1] + np.pi / 2, measured[k, 2], measured[k, 4]]
        best = least_squares(distance, start, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        errors = np.array([found[f"err_{axis}"][row] for axis in "xyz"])
        assert np.allclose((best.x[:3] - [found[axis][row] for axis in "xyz"]) / errors, 0, atol=2e-2)
        assert 2 * best.cost == pytest.approx(found["chi2"][row], abs=2e-2)
        cov = np.linalg.inv(best.jac.T @ best.jac)[:3, :3]
        assert np.allclose(cov / np.outer(errors, errors), found["cov"][row] / np.outer(errors, errors), atol=2e-2)


def about(helices: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Return (dr, dz) of helices about a point: the circle's centre stays, the arc to the closest point is followed."""
    dr, phi0, kappa, dz, tanl = helices.T
    radius = helix.RADIUS_PER_KAPPA / (BZ * kappa)
    x, y = ((dr + radius) * of(phi0) - at for of, at in ((np.cos, point[0]), (np.sin, point[1])))
    turn = np.arctan2(np.sign(radius) * y, np.sign(radius) * x) - phi0
    turn = np.remainder(turn + np.pi, 2 * np.pi) - np.pi
    return np.stack([np.sign(radius) * np.hypot(x, y) - radius, dz - radius * tanl * turn - point[2]], axis=1)


def chi2_at(point: np.ndarray, helices: np.ndarray, cov: np.ndarray) -> float:
    """Return the sum of m' V^-1 m, m = (dr, dz) about the point, V by differences of the parameters."""
    steps, total = np.diag([1e-4, 1e-7, 1e-6, 1e-4, 1e-6]), 0.0
    for one, errors in zip(helices, cov, strict=True):
        values = about(np.concatenate([one[None], one + steps, one - steps]), point)
        slopes = (values[1:6] - values[6:]) / (2 * np.diag(steps)[:, None])
        total += float(values[0] @ np.linalg.solve(slopes.T @ errors @ slopes, values[0]))
    return total


def minima(helices: np.ndarray, cov: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return chi-square and point of the minima that Nelder and Mead's method finds, the best first.

    It starts where the circles cross, or in the middle between them where they are closest.
    """
    radius = helix.RADIUS_PER_KAPPA / (BZ * helices[:, 2])
    centre = (helices[:, 0] + radius)[:, None] * np.stack([np.cos(helices[:, 1]), np.sin(helices[:, 1])], axis=1)
    apart = np.hypot(*(centre[1] - centre[0]))
    along = (centre[1] - centre[0]) / apart
    foot = (apart**2 + radius[0] ** 2 - radius[1] ** 2) / (2 * apart)
    half2 = radius[0] ** 2 - foot**2
    foot = foot if half2 > 0 else 0.5 * (abs(radius[0]) + apart - abs(radius[1]))
    found: list[tuple[float, np.ndarray]] = []
    for shift in np.sqrt(half2) * np.array([-1, 1]) if half2 > 0 else [0.0]:
        x, y = centre[0] + foot * along + shift * np.array([-along[1], along[0]])
        start = np.array([x, y, about(helices, np.array([x, y, 0.0]))[:, 1].mean()])
        how = {"xatol": 1e-5, "fatol": 1e-9, "maxiter": 4000}
        best = minimize(chi2_at, start, (helices, cov), "Nelder-Mead", options=how)
        if all(np.linalg.norm(best.x - point) > 0.1 for _, point in found):
            found.append((best.fun, best.x))
    return sorted(found, key=lambda one: one[0])


@pytest.mark.parametrize("opening", [0.0, 0.02])
def test_pairs_that_leave_their_vertex_almost_parallel(opening: float) -> None:
    """As of photon conversions: the vertex is the best minimum, also where circles do not meet; a second one shows."""
    random, n = np.random.default_rng(3), 300
    phi = np.repeat(random.uniform(-np.pi, np.pi, n), 2)
    p, tanl = np.tile([0.5, 0.4], n), np.full(2 * n, 0.1)
    azimuth, tanl = phi + opening * random.normal(size=2 * n), tanl + opening * random.normal(size=2 * n)
    particles = particles_from(
        {
            "event": np.repeat(np.arange(n), 2), "pdg": np.tile([-13, 13], n), "px": p * np.cos(azimuth),
            "py": p * np.sin(azimuth), "pz": p * tanl, "x": 20 * np.cos(phi), "y": 20 * np.sin(phi), "z": 0 * phi,
        }
    )  # fmt: skip
    tracks, _ = tracks_of(particles, smear=7)
    found = cg.fit_vertices(DETECTOR, tracks, particles=("mu", "mu"))
    assert np.all(found["status"] == 0)
    # No point around the vertex is better.
    helices = np.stack([tracks[name] for name in helix.PARAMETERS], axis=1)
    rows = np.stack([found["first"], found["second"]], axis=1)
    points, two = np.stack([found[axis] for axis in "xyz"], axis=1), np.isfinite(found["other_chi2"])
    assert 0.2 < np.mean(two) < 0.6
    for i in [*np.flatnonzero(two)[:5], *np.flatnonzero(~two)[:5]]:
        pair = helices[rows[i]], tracks["cov"][rows[i]]
        assert found["chi2"][i] == pytest.approx(chi2_at(points[i], *pair), rel=1e-5, abs=1e-5)
        best, *others = minima(*pair)
        assert found["chi2"][i] == pytest.approx(best[0], abs=1e-5)
        if others and others[0][0] - best[0] > 1e-3:  # else either is the best
            assert np.linalg.norm(points[i] - best[1]) < 0.05 * max(found[f"err_{axis}"][i] for axis in "xyz")
        assert bool(others) == two[i]
        if others:
            assert found["other_chi2"][i] == pytest.approx(others[0][0], abs=1e-4)
            distance = np.linalg.norm(others[0][1] - best[1])
            assert found["other_distance"][i] == pytest.approx(distance, abs=0.1)
    # A vertex without a competitor is where its errors say.
    along = np.stack([np.cos(phi[::2]), np.sin(phi[::2])], axis=1)[found["event"]]
    off = np.einsum("ni,ni->n", points[:, :2], along) - 20
    err = np.sqrt(np.einsum("ni,nij,nj->n", along, found["cov"][:, :2, :2], along))
    alone = ~two
    assert np.mean(np.abs(off / err)[alone] > 3) < 0.05
    assert np.mean(np.abs(off / err)[two] > 3) > 0.1  # as the second vertex warns


def test_rotations_and_order_change_nothing() -> None:
    particles = decays("ks-pipi", 40, seed=4)
    tracks, _ = tracks_of(particles, smear=2)
    found = cg.fit_vertices(DETECTOR, tracks)
    turned = tracks.with_columns(phi0=np.remainder(tracks["phi0"] + 1.0 + np.pi, 2 * np.pi) - np.pi)
    other = cg.fit_vertices(DETECTOR, turned)
    assert np.allclose(other["mass"], found["mass"], rtol=1e-9)
    assert np.allclose(other["x"], found["x"] * np.cos(1) - found["y"] * np.sin(1), atol=1e-5)
    back = cg.fit_vertices(DETECTOR, tracks, np.stack([found["second"], found["first"]], axis=1)[::-1])
    assert np.array_equal(back["event"], found["event"])
    for name in ("x", "z", "mass", "err_mass", "chi2"):
        assert np.allclose(back[name], found[name], rtol=1e-7, atol=1e-9)


def test_pairs_are_of_opposite_charge_and_one_event() -> None:
    particles = generate(cg.sample("d0-d0bar"), 50, seed=5)
    particles = cg.Table("particles", {k: v[particles["charge"] != 0] for k, v in particles.columns.items()}, 50)
    tracks, _ = tracks_of(particles)
    pairs = cg.pair_tracks(tracks)
    expected = [
        (i, j)
        for i in range(len(tracks))
        for j in range(len(tracks))
        if tracks["event"][i] == tracks["event"][j] and tracks["kappa"][i] > 0 > tracks["kappa"][j]
    ]
    assert sorted(map(tuple, pairs)) == expected
    bad = tracks["status"].copy()
    bad[pairs[0, 0]] = FitStatus.too_few_hits
    rest = cg.pair_tracks(tracks.with_columns(status=bad))
    assert len(rest) == len(pairs) - np.count_nonzero(pairs[:, 0] == pairs[0, 0])
    for wrong in ([1, "a"], [[], []], 5, ("pi",)):
        with pytest.raises(ValueError, match=r"particles: got .*expected two of"):
            cg.pair_tracks(tracks, wrong)  # type: ignore[arg-type]


def test_tracks_without_a_fit_and_parallel_ones_say_so() -> None:
    particles = decays("ks-pipi", 3)
    tracks, _ = tracks_of(particles)
    status = np.array([FitStatus.too_few_hits, 0, 0, FitStatus.not_positive_definite, 0, 0])
    cov = tracks["cov"].copy()
    cov[3] = np.nan
    found = cg.fit_vertices(DETECTOR, tracks.with_columns(status=status, cov=cov), [[0, 1], [2, 3], [4, 5]])
    expected = [cg.VertexStatus.no_track, cg.VertexStatus.no_track, cg.VertexStatus.ok]
    assert list(found["status"]) == expected
    assert np.isnan(found["mass"][:2]).all()
    assert np.isfinite(found["mass"][2])
    same = {name: column[[0, 0]] for name, column in tracks.columns.items()}
    twice = cg.fit_vertices(DETECTOR, cg.Table("tracks", same, 1), [[0, 1]])
    assert twice["status"][0] == cg.VertexStatus.singular
    empty = cg.fit_vertices(DETECTOR, cg.Table.empty("tracks", 4))
    assert len(empty) == 0
    assert empty.n_events == 4


def test_mistakes_are_listed_together() -> None:
    tracks, _ = tracks_of(decays("ks-pipi", 2))
    with pytest.raises(ValueError, match="particles: got") as error:
        cg.fit_vertices(DETECTOR, tracks, [[0, 9]], particles=("pi", "tau"), beam_spot=0.1)  # type: ignore[arg-type]
    assert str(error.value).count("\n") == 3
    with pytest.raises(ValueError, match="two tracks of one event"):
        cg.fit_vertices(DETECTOR, tracks, [[0, 2]])
    with pytest.raises(ValueError, match="one track twice"):
        cg.fit_vertices(DETECTOR, tracks, [[0, 0]])
    with pytest.raises(ValueError, match="sigma"):
        cg.BeamSpot(sigma=(0.1, 0, 1))


def test_hypotheses_are_told_apart() -> None:
    """Where tracks were fitted with several masses, each side of the pair takes its own."""
    settings = cg.Settings(fit=cg.FitSettings(hypothesis=("pi", "p")))
    result = cg.run(DETECTOR, cg.sample("lambda-ppi", p=1.0, cos_theta=0), 30, settings=settings)
    found = cg.fit_vertices(DETECTOR, result.tracks, particles=("p", "pi"))
    good = found["status"] == 0
    assert good.sum() > 15
    assert np.all(result.tracks["hypothesis"][found["first"]] == 2212)
    assert np.all(result.tracks["hypothesis"][found["second"]] == 211)
    assert abs(np.median(found["mass"][good]) - species("Lambda").mass) < 1e-3


def test_fitted_tracks_give_the_mass_and_its_error() -> None:
    """The real fit: K_S that decay inside the beam pipe; pulls are those of the tracks, within 10 %."""
    result = cg.run(DETECTOR, cg.sample("ks-pipi", p=(0.3, 1.0), cos_theta=(-0.7, 0.7)), 700, seed=3)
    found = cg.fit_vertices(DETECTOR, result.tracks)
    found = with_truth(found, result.fitted, result.matches, result.particles)
    inside = (found["status"] == 0) & (np.hypot(found["truth_x"], found["truth_y"]) < 28)
    n = np.count_nonzero(inside)
    assert n > 350
    for name in ("x", "y", "z", "mass"):
        core = cg.study.measure(found[f"pull_{name}"][inside]).core
        assert_within(core, 1, 0.035, what=name)  # 1.5 / sqrt(2 n)
    assert_within(np.median(found["mass"][inside]), species("K0_S").mass, 1.25 * 0.003 / np.sqrt(n))
    assert cg.study.measure(found["res_mass"][inside]).core < 0.003


@pytest.mark.slow
def test_tracks_that_begin_at_their_vertex_have_unit_pulls() -> None:
    """K_S that decay beyond the beam pipe: the second fit leaves out the pipe, and mass and vertex get their errors."""
    detector = cg.load("besiii-cgem")
    result = cg.run(detector, cg.sample("ks-pipi"), n=6000, seed=3)
    before = cg.fit_vertices(detector, result.tracks)
    begun = begin_at_vertices(detector, result.candidates, result.tracks, before)
    again = fit(detector, result.clusters, result.wire_hits, begun, result.candidate_hits, result.settings.fit)[
        "tracks"
    ]
    after = cg.fit_vertices(detector, again)
    widths = []
    for vertices, tracks in ((before, result.tracks), (after, again)):
        pulls = with_truth(vertices, tracks, result.matches, result.particles)
        radius = np.hypot(pulls["truth_x"], pulls["truth_y"])
        beyond = (pulls["status"] == 0) & (radius > 34) & (radius < 110)
        widths.append([cg.study.measure(pulls[f"pull_{name}"][beyond]) for name in ("mass", "x")])
        assert beyond.sum() > 1000
    for old, new in zip(*widths, strict=True):
        assert abs(new.core - 1) < 0.05 + 3 * new.core_error
        assert abs(old.core - 1) > 0.05 + 1.5 * old.core_error  # the fit through the pipe fails
    assert abs(widths[1][0].mean) < 0.15 < widths[0][0].mean


def test_a_track_of_two_vertices_begins_at_the_better_one() -> None:
    detector = cg.load("besiii-cgem")
    result = cg.run(detector, cg.sample("ks-pipi"), n=20, seed=4)
    found = cg.fit_vertices(detector, result.tracks)
    rows = np.flatnonzero(found["status"] == 0)[[0, 0]]
    worse = {name: column[rows].copy() for name, column in found.columns.items()}
    worse["chi2"] = np.array([1.0, 9.0])
    worse["x"][1] += 30.0
    worse["first"], worse["second"] = (
        np.array([worse[a][0], worse[b][1]]) for a, b in (("first", "second"), ("second", "first"))
    )
    both = cg.Table("vertices", worse, **found.cover)
    begun = begin_at_vertices(detector, result.candidates, result.tracks, both)
    radius = np.hypot(worse["x"][0], worse["y"][0])
    assert np.count_nonzero(begun["start_radius"]) == 2
    assert np.abs(begun["start_radius"][begun["start_radius"] != 0]) == pytest.approx([radius, radius])
    with pytest.raises(ValueError, match="begin_at_vertices"):
        begin_at_vertices(detector, result.tracks, result.tracks, both)


@pytest.mark.parametrize("cov", [0.0, -1.0, np.nan])
def test_a_track_without_covariance_fails_alone(cov):
    """Its pair says so; the other pairs have the vertices that they have without it."""
    result = cg.run("besiii-cgem-design", cg.Gun("pi-", p=0.5, cos_theta=(-0.5, 0.5), multiplicity=2), n=3)
    tracks, pairs = result.fitted, 3
    wrong = tracks["cov"].copy()
    wrong[2] = cov
    with pytest.raises(ValueError, match=r"fit_vertices: 1 problem\n  tracks row 2: cov: got .*, expected"):
        cg.fit_vertices(result.detector, tracks.with_columns(cov=wrong))
    status = [0, 0, cg.FitStatus.not_positive_definite, 0, 0, 0]
    rows = np.arange(2 * pairs).reshape(-1, 2)
    found, right = (
        cg.fit_vertices(result.detector, one, rows) for one in (tracks.with_columns(cov=wrong, status=status), tracks)
    )
    assert found["status"].tolist() == [0, int(cg.VertexStatus.no_track), 0]
    assert all(np.array_equal(found[name][[0, 2]], right[name][[0, 2]]) for name in ("x", "y", "z", "mass"))
