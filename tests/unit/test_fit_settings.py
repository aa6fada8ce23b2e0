"""The settings of the fit do what they say, mistakes are listed at once, and rows that failed say why."""

import dataclasses
import math
import re
from typing import get_args

import numpy as np
import pytest

from cgemit import _core, helix
from cgemit.chain import run, settings
from cgemit.chain.match import joined, match
from cgemit.detector import load
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.find import by_truth
from cgemit.reconstruction.fit import PARAMETERS, ClusterErrors, FitSettings, FitStatus, core_arguments, fit
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.simulation.transport import SimulateSettings, simulate
from pages.performance.stages import smeared

DETECTOR = load("besiii-cgem-design")


@pytest.fixture(scope="module")
def event():
    """Return the tables of 40 simulated muons up to the clusters, and their candidates; sides are known."""
    table = generate(Gun("mu-", p=(0.4, 1.2), cos_theta=(-0.8, 0.8)), 40, seed=3)
    tables = simulate(DETECTOR, table, seed=3)
    settings = DigitizeSettings(reveal_sides=True)
    tables |= digitize(DETECTOR, tables["truths"], tables["wire_truths"], settings, 3)
    tables["clusters"] = cluster(DETECTOR, tables["digis"])
    names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
    return tables, by_truth(DETECTOR, *(tables[name] for name in names))


def fitted(event, start=None, **changes):
    """Fit the events with some settings changed, and match the tracks."""
    tables, found = event
    hits = tables["clusters"], tables["wire_hits"]
    out = fit(DETECTOR, *hits, *found.values(), FitSettings(**changes), start=start)
    of_truth = tables["particles"], tables["truths"], tables["wire_truths"]
    matches = match(out["tracks"], *found.values(), *hits, *of_truth, detector=DETECTOR)["matches"]
    return out | {"tracks": joined(out["tracks"], matches)}


def test_every_mistake_is_listed():
    """One error names every wrong value, what it is and what was expected."""
    with pytest.raises(ValueError, match="FitSettings") as error:
        FitSettings(
            cluster_errors="both", loss="median", max_iterations=0, tolerance=-1, least_width=float("nan"),
            delta_strips=1.0, prior_sigma=(1, 1, 0, 1, 1),
        )  # fmt: skip
    text = str(error.value)
    for name in (
        "cluster_errors",
        "loss",
        "max_iterations",
        "tolerance",
        "least_width",
        "delta_strips",
        "prior_sigma",
    ):
        assert re.search(rf"^  {name}: ", text, re.MULTILINE)
    assert "'both', expected one of 'track', 'cluster'" in text


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("cluster_errors", np.array(["track", "cluster"])), ("screening", 1), ("loss", [1]),
        ("residuals", "no"), ("states", (["origin"],)), ("hypothesis", 13), ("hypothesis", [["mu"]]),
        ("hypothesis", ("pi", "all")), ("max_iterations", "3"), ("max_iterations", 2.5), ("max_iterations", math.nan),
        ("max_iterations", 10**12), ("max_iterations", True), ("tolerance", "x"), ("tolerance", None),
        ("tolerance", 10**400), ("least_width", True), ("delta_strips", "a"), ("outlier_pull", None),
        ("prior_sigma", 1), ("prior_sigma", (1, 1, "1", 1, 1)),
    ],
)  # fmt: skip
def test_values_of_any_type_are_named(name, value):
    """What is of a wrong type is listed with the other mistakes, not refused by whatever meets it first."""
    with pytest.raises(ValueError, match="FitSettings") as error:
        FitSettings(**{"least_width": -1.0, "loss": "median", name: value})
    lines = str(error.value).splitlines()[1:]
    assert sorted({re.split(r"[:[]", line.strip())[0] for line in lines}) == sorted({"least_width", "loss", name})
    assert all(re.search(r": got .*, expected ", line) for line in lines)


def test_numbers_of_numpy_are_numbers():
    """Settings made with numpy are the same."""
    given = {"max_iterations": np.int64(9), "tolerance": np.float32(0.5), "residuals": np.True_}
    assert FitSettings(**given, prior_sigma=np.ones(5)) == FitSettings(
        max_iterations=9, tolerance=0.5, residuals=True, prior_sigma=(1, 1, 1, 1, 1)
    )
    assert FitSettings(**given).residuals is True


def test_defaults_are_valid_and_frozen():
    """The defaults make sense, can not be changed, and differ by `dataclasses.replace`."""
    settings = FitSettings()
    with pytest.raises(dataclasses.FrozenInstanceError):
        settings.loss = "mean"  # type: ignore[misc]
    assert dataclasses.replace(settings, loss="mean") != settings


def test_core_takes_its_settings_by_name(event):
    """Every field has to be there, no other, and of its type."""
    tables, found = event
    hits = collect_hits(DETECTOR, *found.values(), tables["clusters"], tables["wire_hits"])
    given = core_arguments(DETECTOR, hits, np.full(40, 0.1), np.empty((0, 5)), FitSettings())
    wrong = given["settings"] | {"kinks": "perhaps", "magic": 1}
    del wrong["tolerance"]
    kinks = "kinks: got 'perhaps', which has another type than the field"
    lines = ("settings:", "tolerance: missing", kinks, "magic: no such field")
    with pytest.raises(ValueError, match="^" + "\n  ".join(lines) + "$"):
        _core.fit(**given | {"settings": wrong})


def near_truth(event, seed):
    """Return true helices smeared, for the fit to begin with."""
    particles = event[0]["particles"]
    return smeared(helix.at_origin(particles, DETECTOR.field.bz), particles, seed)


def test_start_does_not_matter(event):
    """Started from the hits or from the smeared truth, and whatever the smearing, tracks end at the same helix."""
    from_hits = fitted(event, tolerance=1e-4)["tracks"]
    assert np.all(from_hits["status"] == FitStatus.ok)
    for seed in (1, 2):
        from_truth = fitted(event, near_truth(event, seed), tolerance=1e-4)["tracks"]
        assert np.all(from_truth["status"] == FitStatus.ok)
        for name in PARAMETERS:
            moved = from_truth[f"res_{name}"] - from_hits[f"res_{name}"]
            assert np.abs(moved / from_hits[f"err_{name}"]).max() < 0.05, name


def test_the_fit_begins_where_it_is_told(event):
    """Without iterations left the results depend on the start; each hypothesis begins at that of its candidate."""
    once = [fitted(event, near_truth(event, seed), max_iterations=1)["tracks"] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(once[0]["kappa"], once[1]["kappa"])
    assert not np.any(once[0]["kappa"] == once[2]["kappa"])


def test_too_few_iterations_is_a_status(event):
    """A fit that was not given time to settle says not_converged, and keeps helix and covariance."""
    tracks = fitted(event, max_iterations=1, tolerance=1e-6)["tracks"]
    assert np.all(tracks["status"] == FitStatus.not_converged)
    assert np.all(np.isfinite(tracks["cov"]))
    assert np.all(tracks["iterations"] == 1)


def test_slow_particles_are_fitted_with_the_momentum_they_started_with():
    """Protons of 0.25 GeV/c lose so much on the way that the momentum they end with would not take them there."""
    gun = Gun("proton", pt=0.25, cos_theta=0.0)
    tracks = run.run("besiii-cgem-design", gun, 200).tracks
    assert np.count_nonzero(tracks["status"] == FitStatus.ok) > 195
    assert abs(np.median(tracks["p"]) - 0.25) < 0.002


def test_a_particle_that_cannot_get_there_has_a_status():
    """A proton of 0.08 GeV/c does not leave the beam pipe, so a pion's hits beyond are not those of a proton."""
    wrong = settings.Settings(simulate=SimulateSettings(decays=False), fit=FitSettings(hypothesis="p"))
    tracks = run.run("besiii-cgem-design", Gun("pi+", p=0.08, cos_theta=0.0), 200, settings=wrong).tracks
    short = np.isin(tracks["status"], (FitStatus.stopped, FitStatus.does_not_reach))
    assert np.mean(short) > 0.9
    assert np.mean(tracks["status"] == FitStatus.ok) < 0.02  # few hits that fit a much faster proton
    assert np.any(tracks["status"] == FitStatus.stopped)
    assert np.all(np.isnan(tracks["cov"][short]))


def test_residuals_on_request(event):
    """The residuals table has one row for every measurement used, links to its hit, and exists only if asked for."""
    tables, candidates = event
    assert set(fitted(event)) == {"tracks"}
    out = fitted(event, residuals=True)
    tracks, residuals = out["tracks"], out["residuals"]
    used = tracks["n_clusters"] + tracks["n_wires"]
    np.testing.assert_array_equal(np.bincount(residuals["track"], minlength=len(tracks)), used)
    np.testing.assert_array_equal(tracks["ndf"], used - 5)
    assert len(residuals) == len(candidates["candidate_hits"])
    np.testing.assert_allclose(residuals["pull"], residuals["residual"] / residuals["err"])
    on_wire = residuals["view"] == 2
    np.testing.assert_array_equal(residuals["layer"][on_wire], tables["wire_hits"]["layer"][residuals["hit"][on_wire]])
    np.testing.assert_array_equal(residuals["layer"][~on_wire], tables["clusters"]["layer"][residuals["hit"][~on_wire]])
    np.testing.assert_array_equal(residuals["side"][on_wire], tables["wire_hits"]["side"][residuals["hit"][on_wire]])
    assert not np.any(residuals["side"][~on_wire])


@pytest.mark.parametrize("errors", get_args(ClusterErrors))
def test_columns_agree_with_each_other(event, errors):
    """Pulls, errors and residuals of every parameter and of p are those of helix, truth and covariance."""
    tables, _ = event
    tracks = fitted(event, cluster_errors=errors)["tracks"]
    truth = helix.at_origin(tables["particles"], DETECTOR.field.bz)
    for i, name in enumerate(PARAMETERS):
        np.testing.assert_allclose(tracks[f"err_{name}"], np.sqrt(tracks["cov"][:, i, i]))
        np.testing.assert_array_equal(tracks[f"truth_{name}"], truth[:, i])
        difference = tracks[name] - truth[:, i]
        if name == "phi0":
            difference = np.remainder(difference + np.pi, 2 * np.pi) - np.pi
        np.testing.assert_allclose(tracks[f"res_{name}"], difference, atol=1e-15)
        np.testing.assert_allclose(tracks[f"pull_{name}"], difference / tracks[f"err_{name}"], rtol=1e-9)
    np.testing.assert_allclose(tracks["p"], np.sqrt(1 + tracks["tanl"] ** 2) / np.abs(tracks["kappa"]))
    np.testing.assert_array_equal(tracks["cov"], tracks["cov"].transpose(0, 2, 1))
    assert np.all(np.linalg.eigvalsh(tracks["cov"]) > 0)


def test_cluster_errors_matter(event):
    """Errors that follow the track's incidence give another helix than those of the clusters table, within errors."""
    track, table = (fitted(event, cluster_errors=errors)["tracks"] for errors in ("track", "cluster"))
    difference = (track["dr"] - table["dr"]) / table["err_dr"]
    assert 1e-3 < np.std(difference) < 1


def test_least_width_is_a_floor(event):
    """A wider floor under the allowed interval of a cluster never makes an error smaller."""
    narrow, wide = (fitted(event, least_width=width)["tracks"]["err_dr"] for width in (0.05, 1.0))
    assert np.all(wide > 0.999 * narrow)
    assert np.median(wide / narrow) > 1.02


def test_wide_priors_change_nothing(event):
    """Ten times wider priors leave every parameter where it is: the first helix is not counted as a measurement."""
    settings = FitSettings()
    usual = fitted(event, tolerance=1e-5)["tracks"]
    wide = fitted(event, tolerance=1e-5, prior_sigma=tuple(10 * s for s in settings.prior_sigma))["tracks"]
    for name in PARAMETERS:
        moved = wide[f"res_{name}"] - usual[f"res_{name}"]
        assert np.abs(moved / usual[f"err_{name}"]).max() < 1e-3, name


def test_rows_without_hits_keep_their_place():
    """Charged particles that leave nothing to fit have a row that says so, with NaN where there is no covariance."""
    guns = Gun("mu-", p=1.0, cos_theta=0.2) + Gun("gamma", p=1.0, cos_theta=0.2) + Gun("pi+", pt=0.02, cos_theta=0.0)
    tracks = run.run(DETECTOR, guns, 3, seed=1).tracks
    assert len(tracks) == 6
    assert tracks["particle"].tolist() == [0, -1] * 3  # no hit says of which particle the second one is
    status = tracks["status"].reshape(3, 2)
    assert np.all(status[:, 0] == FitStatus.ok)
    assert np.all(status[:, 1:] != FitStatus.ok)
    lost = tracks["status"] != FitStatus.ok
    assert np.all(np.isnan(tracks["cov"][lost]))
    assert np.all(np.isnan(tracks["pull_dr"][lost]))
    assert np.all(np.isfinite(tracks["cov"][~lost]))


def true_extents(truths, layer):
    """How far each crossing of a layer extends in X and V, mm."""
    mine = truths["layer"] == layer
    ends = [[truths[f"{end}_{axis}"][mine] for axis in "xyz"] for end in ("entry", "exit")]
    dphi = np.subtract(*(np.arctan2(y, x) for x, y, _ in ends))
    dx = DETECTOR.cgem[layer].r_readout * (np.remainder(dphi + np.pi, 2 * np.pi) - np.pi)
    stereo = DETECTOR.cgem[layer].stereo
    return np.abs(dx), np.abs(dx * np.cos(stereo) - (ends[0][2] - ends[1][2]) * np.sin(stereo))


def residual_errors(event, view, layer, strips, **changes):
    """Errors of the residuals to the track without them, of clusters of a view and layer that have so many strips."""
    tables, found = event
    clusters = tables["clusters"]
    mine = (clusters["view"] == view) & (clusters["layer"] == layer)
    other = clusters.with_columns(size=np.where(mine, strips, clusters["size"]).astype("i4"))
    out = fit(DETECTOR, other, tables["wire_hits"], *found.values(), FitSettings(residuals=True, **changes))
    assert np.all(out["tracks"]["status"] == FitStatus.ok)
    rows = out["residuals"]
    return rows["err"][(rows["view"] == view) & (rows["layer"] == layer)]


@pytest.mark.parametrize("view", [0, 1])
def test_without_delta_electrons_a_long_cluster_may_hold_the_track_anywhere(event, view):
    """Thirty strips: the error is that of an interval of their length without the path's own."""
    error = residual_errors(event, view, 1, 30, delta_strips=0)
    width = 30 * 0.65 - true_extents(event[0]["truths"], 1)[view]
    # The track without this cluster is known to 0.3 mm, in quadrature to 5 mm.
    np.testing.assert_allclose(error, width / np.sqrt(12), rtol=0.004)


def laid_error(extent, strips):
    """RMS distance of a path from the middle of the strips, if a delta electron added k with weight 1/k on one side."""
    begin = (np.arange(10_000) + 0.5) / 10_000
    end = begin + extent / 0.65
    added = strips - np.floor(end).astype(int) - 1
    assert added.min() > 0
    squares = [(0.5 * (begin + end) - (0.5 * strips - lower)) ** 2 for lower in (0 * added, added)]
    return 0.65 * np.sqrt(np.average(np.mean(squares, axis=0), weights=1 / added))


@pytest.mark.parametrize(("view", "strips", "fewer"), [(0, 8, 5), (0, 30, 8), (1, 30, 20)])
def test_delta_electrons_leave_the_track_at_an_end_of_a_long_cluster(event, view, strips, fewer):
    """Against paths laid onto strips, to one side of which others are added.

    What the other hits say of the place is the same for both numbers of strips, and drops out of the difference.
    """
    extents = true_extents(event[0]["truths"], 1)[view]
    fitted = [residual_errors(event, view, 1, number) ** 2 for number in (strips, fewer)]
    # The fit's d_rho is good to 0.2 mm, hence the slope to 2 mrad at this radius and the extent in 5 mm to 10 um.
    expected, beside = (
        np.array([laid_error(extent, strips) ** 2 - laid_error(extent, fewer) ** 2 for extent in each])
        for each in (extents, extents + 0.01)
    )
    pull = (fitted[0] - fitted[1] - expected) / (np.abs(beside - expected) + 1e-3 * expected)
    assert np.abs(pull).max() < 4
    assert abs(np.mean(fitted[0] - fitted[1]) / expected.mean() - 1) < 0.003
