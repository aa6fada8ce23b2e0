"""The fit: settings, first helices, correlated points, hits that constrain little, and whatever else it is given."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from typing import get_args

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
import fuzz
import tracks
from cgemit import _core, helix, isa
from cgemit.chain import run, settings
from cgemit.detector import compiled, load
from cgemit.fit_matter import tuned
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.find.loops import link_loops
from cgemit.reconstruction.fit import PARAMETERS, ClusterErrors, FitSettings, core_arguments, fit
from cgemit.reconstruction.fit import _with_large_chi2 as with_large_chi2
from cgemit.simulation.digitize import DigitizeSettings, digitize
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, HIT_XV, FitStatus
from cgemit.truth.finder import by_truth
from cgemit.truth.match import compare, joined, match
from clusterers import expect
from exact import assert_pulls_are_standard_normal, exact
from pages.performance.stages import smeared
from pages.scenarios import SCENARIOS, Hits, exchange_clusters
from tracks import order_of_matter, true_views

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
        ("prior_sigma", 1), ("prior_sigma", (1, 1, "x", 1, 1)),
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
        _core.reconstruction.fit(**given | {"settings": wrong})


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


@pytest.mark.parametrize(
    ("name", "field"), [("besiii-cgem-design", None), ("besiii-cgem-design", "finite-solenoid"), ("kloe2-like", None)]
)
def test_a_reference_that_is_kept_changes_little(name, field):
    """The fit keeps the reference of a helix nearby; with a small tolerance it follows each helix anew."""
    detector = load(name) if field is None else load(name).with_field(field)
    result = cg.run(detector, Gun("mu-", p=(0.3, 2.0), cos_theta=(-0.9, 0.9)), 2000, seed=4)
    kept, anew = (
        fit(detector, result.clusters, result.wire_hits, result.candidates, result.candidate_hits, how)["tracks"]
        for how in (FitSettings(), FitSettings(tolerance=1e-3))
    )
    same = (kept["status"] == 0) & (anew["status"] == 0) & (kept["n_outliers"] == anew["n_outliers"])
    assert np.mean(same) > 0.98
    for parameter in PARAMETERS:
        error = anew[f"err_{parameter}"]
        off = np.abs(helix_difference(kept, anew, parameter) / error)[same]
        assert np.median(off) < 0.002
        assert np.quantile(off, 0.99) < 0.5 * FitSettings().tolerance
        assert np.median(np.abs(kept[f"err_{parameter}"] / error - 1)[same]) < 0.003


def helix_difference(tracks_a: Table, tracks_b: Table, parameter: str) -> npt.NDArray[np.float64]:
    difference = tracks_a[parameter] - tracks_b[parameter]
    return np.remainder(difference + np.pi, 2 * np.pi) - np.pi if parameter == "phi0" else difference


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


ALL = _core._testing.SeedFrom.wires_and_clusters
AZIMUTHS = _core._testing.SeedFrom.azimuths

# What a first helix of a clean track may miss: a few times what it does (dr mm, phi0 rad, kappa relative, dz mm, tanl).
NEAR = np.array([2.0, 0.02, 0.05, 5.0, 0.04])


def seeds(hits, offsets, mass, source=ALL, detector=DETECTOR):
    """Return the first helices of some candidates."""
    core = tuned(detector)
    return _core._testing.seeds(
        core, hit_offsets=offsets, hits=hits, mass=np.broadcast_to(mass, len(offsets) - 1), source=source
    )


def distance(found, true):
    """Return how far first helices are off, kappa relative."""
    apart = np.abs(found - true)
    apart[:, 1] = np.abs(np.remainder(found[:, 1] - true[:, 1] + np.pi, 2 * np.pi) - np.pi)
    apart[:, 2] /= np.abs(true[:, 2])
    return apart


def of_scenario(name, events=400, spoil=None, mass=None):
    """Return how far the first helices of a scenario are off; infinite where there is none."""
    scenario = next(one for one in SCENARIOS if one.name == name)
    result = run.run(DETECTOR, scenario.particles(events, 1), seed=1)
    hits = Hits(result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    spoil = spoil or scenario.spoil
    hits = spoil(DETECTOR, hits, np.random.default_rng(1)) if spoil else hits
    flat = collect_hits(DETECTOR, hits.candidates, hits.candidate_hits, hits.clusters, hits.wire_hits)
    mass = result.particles["mass"] if mass is None else mass
    found = seeds(flat.columns(), flat.hit_offsets, mass)
    return np.nan_to_num(distance(found, helix.at_origin(result.particles, DETECTOR.field.bz)), nan=np.inf)


@pytest.mark.parametrize("bz", ["-1 T", "1 T"])
@pytest.mark.parametrize("kappa", [-2.5, 0.8, 4.0])
@pytest.mark.parametrize("hidden", [False, True])
def test_clean_track(bz, kappa, hidden):
    """Through exact hits goes the helix that made them, for both charges and fields, with sides known or not."""
    detector = DETECTOR.with_overrides({"field.bz": bz})
    for number in range(8):
        true = np.array([[0.3, 0.7 * number - 2.5, kappa, 4.0, 0.2 * number - 0.7]])
        hits = tracks.hits_on(detector, true)
        if hidden:
            hits["side"][:] = 0
        for source in (ALL, _core._testing.SeedFrom.wires, AZIMUTHS):
            found = seeds(hits, [0, len(hits["kind"])], tracks.MUON, source, detector)
            near = NEAR * (1, 1, 1, 4, 1) if source == _core._testing.SeedFrom.wires and hidden else NEAR
            assert np.all(distance(found, true) < near), (number, source, found)


def test_stereo_wires_and_clusters_make_a_helix():
    """In a chamber without axial wires most first helices lie within an error of the fit, which has all hits, too."""
    result = run.run("kloe2-like", Gun("mu-", p=(0.3, 2.0), cos_theta=(-0.86, 0.86)), n=400, seed=5)
    flat = collect_hits(
        result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits
    )  # fmt: skip
    mass, tracks_, names = result.candidates["mass"], result.tracks, helix.PARAMETERS
    found = seeds(flat.columns(), flat.hit_offsets, mass, AZIMUTHS, result.detector)
    apart = found - np.stack([tracks_[name] for name in names], axis=1)
    apart[:, 1] = np.remainder(apart[:, 1] + np.pi, 2 * np.pi) - np.pi
    pulls = np.abs(apart) / np.stack([tracks_[f"err_{name}"] for name in names], axis=1)
    assert np.all(np.median(pulls, axis=0) < 1), np.median(pulls, axis=0)
    assert np.all(np.quantile(pulls, 0.9, axis=0) < 4), np.quantile(pulls, 0.9, axis=0)
    assert np.mean(tracks_["iterations"]) < 3


def test_straight_track():
    """Nothing special happens at 10 TeV/c."""
    true = np.array([[0.3, 0.5, 1e-4, 4.0, 0.3]])
    hits = tracks.hits_on(DETECTOR, true)
    found = seeds(hits, [0, len(hits["kind"])], tracks.MUON)
    assert abs(found[0, 2]) < 2e-2
    assert np.all(np.abs(found - true)[0, [0, 1, 3, 4]] < NEAR[[0, 1, 3, 4]])


@pytest.mark.parametrize("name", ["noise", "wrong cluster"])
def test_wrong_hits_do_not_matter(name):
    """19 tracks of 20 start as near as clean ones, though every one has hits that are not its own."""
    assert np.all(np.quantile(of_scenario(name), 0.95, axis=0) < NEAR)


def test_all_clusters_wrong_is_seen():
    """Where no cluster is the track's own, a first helix that counts on them is off."""

    def all_wrong(_detector, hits, _random):
        for layer in range(3):
            hits = exchange_clusters(hits, layer, np.ones(len(hits.candidates), bool))
        return hits

    assert np.any(np.quantile(of_scenario("plain", spoil=all_wrong), 0.95, axis=0) > NEAR)


def test_slow_particles_start_with_what_they_had_at_the_origin():
    """The momentum lost in beam pipe and CGEM is put back; without a mass to reckon with it is missing."""
    kappa = 2
    reckoned, blind = (of_scenario("slow muons", mass=mass)[:, kappa] for mass in (None, 5e-4))
    assert np.quantile(reckoned, 0.68) < 0.07
    assert np.quantile(blind, 0.5) > 0.15


@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_too_few_points(number):
    """No helix goes through two points; five hits may or may not be enough."""
    hits = tracks.hits_on(DETECTOR, np.array([[0.3, 0.5, 1.0, 4.0, 0.3]]))
    few = {name: column[:number] for name, column in hits.items()}
    for source in (ALL, _core._testing.SeedFrom.wires, _core._testing.SeedFrom.azimuths):
        found = seeds(few, [0, number], tracks.MUON, source)
        assert np.isnan(found).all() or (number == 5 and np.isfinite(found).all())


def test_all_on_one_layer():
    """Many hits of one layer are no track: no helix, or some helix, but numbers."""
    layer = DETECTOR.drift_chamber.layers[10]
    n = 12
    hits = {
        "kind": np.full(n, 2, np.uint8), "layer": np.full(n, layer.number, np.int32),
        "channel": np.arange(n, dtype=np.int32), "size": np.zeros(n, np.int32),
        "value": np.full(n, 3.0), "sigma": np.full(n, 0.13), "side": np.zeros(n, np.int8),
    }  # fmt: skip
    for source in (ALL, _core._testing.SeedFrom.wires, _core._testing.SeedFrom.azimuths):
        found = seeds(hits, [0, n], tracks.MUON, source)
        assert np.isnan(found).all() or np.isfinite(found).all()


DETECTOR_POINTS = cg.load("besiii-cgem-design")
FIT = FitSettings(residuals=True, states=("origin",), tolerance=1e-9, max_iterations=40, outlier_pull=0, kinks=False)
ERR_X, ERR_V, RHO = 0.2, 0.3, 0.8


@pytest.fixture(scope="module")
def points():
    """Return a run of muons, and clusters whose XV rows have correlated errors, as which they are smeared."""
    gun = cg.Gun("mu-", p=(0.6, 1.5), cos_theta=(-0.7, 0.7))
    result = cg.run(DETECTOR_POINTS, gun, 60, seed=6, **exact())
    clusters, random = result.clusters, np.random.default_rng(1)
    n = len(clusters)
    a, b = random.standard_normal((2, n))
    xv = clusters["view"] == 2
    truth = clusters["truth"]
    x, v = true_views(
        DETECTOR_POINTS, clusters["layer"], clusters["sheet"], result.truths["phi"][truth], result.truths["z"][truth]
    )
    smeared = clusters.with_columns(
        x=np.where(xv, x + ERR_X * a, clusters["x"]),
        v=np.where(xv, v + ERR_V * (RHO * a + np.sqrt(1 - RHO**2) * b), clusters["v"]),
        err_x=np.where(xv, ERR_X, clusters["err_x"]),
        err_v=np.where(xv, ERR_V, clusters["err_v"]),
        cov_xv=np.where(xv, RHO * ERR_X * ERR_V, 0.0),
    )
    hits = result.candidate_hits
    on_wire = hits["view"] == HIT_WIRE
    rows = np.flatnonzero(xv)
    event = np.concatenate([hits["event"][on_wire], clusters["event"][rows]])
    order = np.argsort(event, kind="stable")
    columns = {
        "event": event,
        "candidate": np.concatenate([hits["candidate"][on_wire], clusters["event"][rows]]),
        "view": np.concatenate([hits["view"][on_wire], np.full(len(rows), HIT_XV)]),
        "hit": np.concatenate([hits["hit"][on_wire], rows]),
    }
    found = Table("candidate_hits", {name: column[order] for name, column in columns.items()}, 60)
    return result, smeared, found


def test_points_are_fitted_as_the_information_filter_does(points):
    """Information form with the full 2x2 covariance of each point, about the fitted helix: it is the optimum.

    The matter is that of the fit: noise vectors in the coordinates of the origin, which every measurement beyond sees.
    """
    result, clusters, found = points
    hits = collect_hits(DETECTOR_POINTS, result.candidates, found, clusters, result.wire_hits)
    arguments = core_arguments(DETECTOR_POINTS, hits, result.particles["mass"], np.empty((0, 5)), FIT)
    fitted = _core.reconstruction.fit(**arguments)
    assert np.all(fitted["status"] == 0)
    assert np.mean(fitted["n_clusters"] == 6) > 0.95
    wrong = []
    for track in range(20):
        rows = slice(*hits.hit_offsets[track : track + 2])
        mine = {name: column[rows] for name, column in hits.columns().items()}
        helix, prior = fitted["helix"][track], fitted["prior"][track].reshape(5, 5)
        given = (arguments["detector"], helix, result.particles["mass"][track], mine, prior)
        move, cov = information(*given, RHO)
        sigma = np.sqrt(np.diag(fitted["cov"][track]))
        assert np.all(np.abs(move) < 2e-5 * sigma)
        unit = np.outer(sigma, sigma)
        np.testing.assert_allclose(cov / unit, fitted["cov"][track] / unit, atol=2e-6)
        uncorrelated = information(*given, 0.0)[0]
        wrong.append(np.abs(uncorrelated / sigma).max())
    assert np.median(wrong) > 0.1, "without the correlation it is another one"


def information(core, helix, mass, mine, prior, rho):
    """Return how far the least-squares estimate is from a helix, and its covariance, from X and V as they are.

    The weak prior is a measurement of the helix behind all matter.
    """
    plain = dict(mine)
    strips = np.flatnonzero(mine["kind"] != 2)
    v = strips[mine["kind"][strips] == 1]
    plain["value"] = mine["value"] + mine["k"] * mine["x"]  # V as measured
    plain["sigma"] = np.where(np.isin(np.arange(len(mine["kind"])), v), ERR_V, mine["sigma"])
    plain["k"], plain["x"] = np.zeros_like(mine["k"]), np.zeros_like(mine["x"])
    reference = _core._testing.reference(core, helix, mass, plain)
    h, g = reference["rows"], reference["noise"]
    measured = np.where(plain["kind"] == 2, plain["value"] * plain["side"], plain["value"])
    n = len(h)
    covariance = np.zeros((n + 5, n + 5))
    covariance[:n, :n], covariance[n:, n:] = np.diag(plain["sigma"] ** 2), prior
    for i in v:
        covariance[i, i - 1] = covariance[i - 1, i] = rho * ERR_X * ERR_V
    seen = h @ g.T
    seen[np.arange(len(g)) >= order_of_matter(DETECTOR_POINTS, mine, len(g))[:, None]] = 0
    seen, h = np.concatenate([seen, g.T]), np.concatenate([h, np.eye(5)])
    weight = np.linalg.inv(covariance + seen @ seen.T)
    cov = np.linalg.inv(h.T @ weight @ h)
    residual = np.append(measured - reference["predicted"], np.zeros(5))
    return cov @ h.T @ weight @ residual, cov


def test_decorrelated_columns(points):
    """X as it is, and V - k X with k the covariance over the variance of X; independent of one another."""
    result, clusters, found = points
    hits = collect_hits(DETECTOR_POINTS, result.candidates, found, clusters, result.wire_hits)
    x, v = (np.flatnonzero(hits.kind == kind) for kind in (0, 1))
    np.testing.assert_array_equal(v, x + 1)
    k = RHO * ERR_V / ERR_X
    np.testing.assert_allclose(hits.k[v], k)
    np.testing.assert_array_equal(hits.x[v], hits.value[x])
    np.testing.assert_allclose(hits.value[v], clusters["v"][hits.hit[v]] - k * clusters["x"][hits.hit[x]])
    np.testing.assert_allclose(hits.sigma[v], ERR_V * np.sqrt(1 - RHO**2))


def test_pulls_of_points_are_standard_normal(points):
    """Residuals of both scalars against the track fitted without them."""
    result, clusters, found = points
    residuals = fit(DETECTOR_POINTS, clusters, result.wire_hits, result.candidates, found, FIT)["residuals"]
    for view in (0, 1):
        pull = residuals["pull"][residuals["view"] == view]
        assert abs(pull.std() - 1) < 4 / np.sqrt(2 * len(pull))
        assert abs(pull.mean()) < 4 / np.sqrt(len(pull))


def test_points_without_correlation_are_x_and_v(points):
    """The joined rows of a readout are the same as their X and V clusters."""
    result, _, found = points
    fits = [
        fit(DETECTOR_POINTS, result.clusters, result.wire_hits, result.candidates, hits, FIT)["tracks"]
        for hits in (found, result.candidate_hits)
    ]
    for name in PARAMETERS:
        np.testing.assert_array_equal(fits[0][name], fits[1][name])


def test_impossible_correlations_are_refused(points):
    """The covariance is below the product of the errors."""
    result, clusters, found = points
    row = np.flatnonzero(clusters["view"] == 2)[5]
    cov = clusters["cov_xv"].copy()
    cov[row] = 0.07
    with pytest.raises(ValueError, match=rf"clusters row {row}: cov_xv: got 0\.07, expected less in size"):
        fit(DETECTOR_POINTS, clusters.with_columns(cov_xv=cov), result.wire_hits, result.candidates, found)


DESIGN = cg.load("besiii-cgem-design")
RHO_CORRELATED = np.array([0.6, -0.5, 0.7])


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the correlation of the Gaussian readout known."""
    expect(monkeypatch, cg.GaussianReadout, correlations=RHO_CORRELATED)


def correlated(result: cg.Result, rho: npt.NDArray[np.float64] | None = None) -> Table:
    """Return clusters whose V is smeared with X: the correlation is that of the column."""
    clusters = result.clusters
    layer, view = clusters["layer"], clusters["view"]
    v = clusters["v"].copy()
    xv = np.flatnonzero(view == 2)
    of_x, of_v = clusters["x_cluster"][xv], clusters["v_cluster"][xv]
    truth = clusters["truth"][xv]
    phi, z = (result.truths[name][truth] for name in ("phi", "z"))
    x_true, v_true = true_views(result.detector, layer[xv], clusters["sheet"][xv], phi, z)
    pulls = (clusters["x"][of_x] - x_true) / clusters["err_x"][of_x], (v[of_v] - v_true) / clusters["err_v"][of_v]
    mine = RHO_CORRELATED[layer[xv]]
    v[of_v] = v_true + clusters["err_v"][of_v] * (mine * pulls[0] + np.sqrt(1 - mine**2) * pulls[1])
    return clusters.with_columns(v=v, corr_xv=(RHO_CORRELATED if rho is None else rho)[layer])


@pytest.fixture(scope="module")
def muons() -> cg.Result:
    return cg.run(DESIGN, cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), 1500, seed=6, **exact())


def tracks_of(result: cg.Result, clusters: Table) -> Table:
    """Return the tracks of other clusters, with their pulls."""
    given = (result.candidates, result.candidate_hits)
    tracks = fit(DESIGN, clusters, result.wire_hits, *given)["tracks"]
    row = np.searchsorted(result.particles["event"], tracks["event"])
    return tracks.with_columns(**compare(tracks, result.particles, row, compiled(DESIGN).field))


def test_two_clusters_are_a_point_with_their_correlation(muons: cg.Result) -> None:
    """Taken as X and V with a correlation, or as an XV cluster with a covariance, they are the same measurements."""
    clusters = correlated(muons)
    hits = muons.candidate_hits
    collected = collect_hits(DESIGN, muons.candidates, hits, clusters, muons.wire_hits)
    xv = np.flatnonzero(clusters["view"] == 2)
    of_x, of_v = clusters["x_cluster"][xv], clusters["v_cluster"][xv]
    points = {name: clusters[name].copy() for name in ("x", "v", "err_x", "err_v")}
    for name, rows in (("x", of_x), ("v", of_v), ("err_x", of_x), ("err_v", of_v)):
        points[name][xv] = clusters[name][rows]
    cov = np.zeros(len(clusters))
    cov[xv] = (clusters["corr_xv"] * points["err_x"] * points["err_v"])[xv]
    wires = hits["view"] == HIT_WIRE
    event = np.concatenate([hits["event"][wires], clusters["event"][xv]])
    order = np.argsort(event, kind="stable")
    columns = {
        "event": event, "candidate": np.concatenate([hits["candidate"][wires], clusters["event"][xv]]),
        "view": np.concatenate([hits["view"][wires], np.full(len(xv), HIT_XV)]),
        "hit": np.concatenate([hits["hit"][wires], xv]),
    }  # fmt: skip
    found = Table("candidate_hits", {name: column[order] for name, column in columns.items()}, muons.n_events)
    table = clusters.with_columns(**points, cov_xv=cov, corr_xv=np.zeros(len(clusters)))
    other = collect_hits(DESIGN, muons.candidates, found, table, muons.wire_hits)
    assert np.count_nonzero(collected.k) == np.count_nonzero(collected.kind == 1) == len(xv)
    for name in ("hit_offsets", "kind", "layer"):
        np.testing.assert_array_equal(getattr(collected, name), getattr(other, name))
    for name in ("value", "sigma", "k", "x"):
        np.testing.assert_allclose(getattr(collected, name), getattr(other, name), rtol=1e-12, atol=1e-12)


def test_pulls_of_tracks_are_standard_normal(muons: cg.Result) -> None:
    assert_pulls_are_standard_normal(tracks_of(muons, correlated(muons)))


def test_pulls_need_the_correlation(muons: cg.Result) -> None:
    """The same clusters with the other sign have wrong errors."""
    pulls = [tracks_of(muons, correlated(muons, rho))["pull_dr"].std() for rho in (RHO_CORRELATED, -RHO_CORRELATED)]
    assert abs(pulls[1] - 1) > 5 * abs(pulls[0] - 1)
    assert abs(pulls[1] - 1) > 0.1


def test_clusters_that_are_not_alone_have_no_correlation(muons: cg.Result) -> None:
    """Of two X clusters of a sheet it is not known which one belongs to V; an X or V cluster alone has no other."""
    clusters, hits = correlated(muons), muons.candidate_hits
    first = hits["event"] == 0
    rows = np.flatnonzero(first & (hits["view"] == HIT_X))
    twice = clusters.with_columns(event=np.where(clusters["event"] == 1, 0, clusters["event"]))
    of_next = np.flatnonzero((clusters["event"] == 1) & (clusters["view"] == 0))
    more = of_next[clusters["layer"][of_next] == clusters["layer"][hits["hit"][rows[0]]]][:1]
    moved = twice.with_columns(
        sheet=np.where(np.arange(len(clusters)) == more[0], clusters["sheet"][hits["hit"][rows[0]]], clusters["sheet"])
    )

    def ks(chosen: npt.NDArray[np.bool_], extra: npt.NDArray[np.int64]) -> int:
        columns = {name: hits[name][first & chosen] for name in ("event", "candidate", "view", "hit")}
        added = {"event": 0, "candidate": 0, "view": HIT_X}
        columns = {
            name: np.concatenate([column, extra if name == "hit" else np.full(len(extra), added[name], column.dtype)])
            for name, column in columns.items()
        }
        candidates = Table(
            "candidates", {name: muons.candidates[name][:1] for name in muons.candidates.columns}, muons.n_events
        )
        table = Table("candidate_hits", columns, muons.n_events)
        return int(np.count_nonzero(collect_hits(DESIGN, candidates, table, moved, muons.wire_hits).k))

    every = np.ones(len(hits), np.bool_)
    none = np.empty(0, np.int64)
    assert ks(every, none) == 3
    assert ks(every, more) == 2
    assert ks(hits["view"] != HIT_X, none) == 0
    assert ks(hits["view"] != HIT_V, none) == 0


@pytest.mark.parametrize("rho", [1.0, -1.5, np.nan])
def test_impossible_correlations_are_refused_correlated(muons: cg.Result, rho: float) -> None:
    clusters = correlated(muons, np.array([0.0, rho, 0.0]))
    row = np.flatnonzero((clusters["layer"] == 1) & (clusters["view"] == 1))[0]
    with pytest.raises(ValueError, match=rf"clusters row {row}: corr_xv: got {rho:g}, expected a number between -1"):
        tracks_of(muons, clusters)


@pytest.mark.parametrize("radius", [None, 121.0])
def test_covariance_without_events(radius: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is that of fits, at the origin and at a radius, and without the correlation it is another one."""
    settings = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="off"), digitize=cg.DigitizeSettings(reveal_sides=True)
    )
    gun = cg.Gun("mu-", p=0.7, cos_theta=0.4, phi=0.3)
    result = cg.run(DESIGN, gun, 200, seed=3, settings=settings, readout="gaussian")
    fit_settings = cg.FitSettings(outlier_pull=0, kinks=False, states=() if radius is None else (radius,))
    hits = (result.wire_hits, result.candidates, result.candidate_hits)
    tables = fit(DESIGN, correlated(result), *hits, fit_settings)
    mean = tables["tracks" if radius is None else "states"]["cov"].mean(axis=0)
    scale = np.sqrt(np.diagonal(mean))
    unit = np.outer(scale, scale)
    how = {"phi": 0.3, "reveal_sides": True} | ({} if radius is None else {"radius": radius})
    other = cg.analytic(DESIGN, "mu-", 0.7, 0.4, readout="gaussian", **how).cov
    expect(monkeypatch, cg.GaussianReadout, correlations=RHO_CORRELATED)
    found = cg.analytic(DESIGN, "mu-", 0.7, 0.4, readout="gaussian", **how).cov
    assert np.abs((np.squeeze(found) - mean) / unit).max() < 0.01
    assert np.abs((np.squeeze(other) - mean) / unit).max() > 0.05


@pytest.mark.usefixtures("known")
def test_budget_adds_up() -> None:
    found = cg.analytic(DESIGN, "mu-", 0.7, 0.4, phi=0.3, readout="gaussian")
    budget = found.budget("dr")
    np.testing.assert_allclose(budget.total, found.sigma_dr**2, rtol=1e-10)


STOPPING = cg.Gun("p", p=(0.20, 0.26), cos_theta=(-0.3, 0.3))


@pytest.fixture(scope="module")
def alphas() -> cg.Result:
    """Return alphas of both charges with exact noise, and their states."""
    gun = cg.Gun("alpha", p=(1.5, 3.0), cos_theta=(-0.6, 0.6)) + cg.Gun("anti-alpha", p=2.0, cos_theta=0.2)
    stages = cg.Settings(
        simulate=SimulateSettings(fluctuations="gaussian"), fit=FitSettings(states=("origin", 400.0), residuals=True)
    )
    return cg.run("besiii-cgem", gun, 150, 4, settings=stages, readout="gaussian")


def test_alphas_have_twice_the_momentum_of_their_curvature(alphas: cg.Result) -> None:
    """Momenta in all tables are charge/kappa, and those of the particles; chi-square is right."""
    tracks, states = alphas.tracks, alphas.states
    assert np.all(tracks["status"] == 0)
    assert np.all((tracks["charge"] == 2) & (tracks["hypothesis"] == 1000020040))
    slant = np.hypot(1, tracks["tanl"])
    np.testing.assert_allclose(tracks["p"], 2 * slant / np.abs(tracks["kappa"]), rtol=1e-14)
    assert np.all(np.sign(tracks["kappa"]) == np.where(np.arange(len(tracks)) % 2, -1, 1))
    true = np.sqrt(sum(alphas.particles[f"p{axis}"] ** 2 for axis in "xyz"))
    np.testing.assert_allclose(tracks["truth_p"], true, rtol=1e-12)
    assert np.std(tracks["pull_p"]) == pytest.approx(1, abs=4 / math.sqrt(2 * len(tracks)))
    assert np.mean(tracks["chi2"] / tracks["ndf"]) == pytest.approx(1, abs=0.05)
    at_origin = states["surface"] == 0
    assert np.all(states["charge"] == 2)
    p = np.sqrt(sum(states[f"p{axis}"] ** 2 for axis in "xyz"))
    np.testing.assert_allclose(p[at_origin], tracks["p"], rtol=1e-9)
    # pt and its resolution, too.
    pt = cg.resolution(tracks, "pt_rel")
    assert pt.q68 == pytest.approx(cg.resolution(tracks, "p_rel").q68, rel=0.1)


def test_extrapolated_alphas_lose_their_energy(alphas: cg.Result) -> None:
    """A track moved to a cylinder has the momentum of the fit's state there; as a proton it loses far less."""
    inside = alphas.states["surface"] == 0
    smoothed = alphas.states[~inside]
    p = np.sqrt(sum(smoothed[f"p{axis}"] ** 2 for axis in "xyz"))
    for particle, relation in ((None, np.less_equal), ("p", np.greater)):
        moved = cg.extrapolate(alphas.detector, alphas.fitted, 400.0, particle=particle)
        lost = alphas.fitted["p"] * (0.5 if particle else 1) - np.sqrt(sum(moved[f"p{axis}"] ** 2 for axis in "xyz"))
        expected = alphas.fitted["p"] - p
        assert relation(np.abs(np.median(lost / expected) - 1), 0.1)
    assert np.median(expected) > 0.03


@pytest.fixture(params=isa.available())
def each_isa(request: pytest.FixtureRequest) -> Iterator[None]:
    """Use one instruction set after the other."""
    before = isa.name()
    isa.use(request.param)
    yield
    isa.use(before)


@pytest.mark.slow
@pytest.mark.usefixtures("each_isa")
def test_protons_that_stop_behind_the_cgem_are_unconstrained() -> None:
    tracks = cg.run("besiii-cgem-design", STOPPING, n=2000, seed=3, workers=1).tracks
    wide = tracks["err_p"] > 0.5 * tracks["p"]
    weak = tracks["status"] == FitStatus.unconstrained
    assert np.count_nonzero(weak) > 3
    assert np.array_equal(weak, wide & ((tracks["status"] == FitStatus.ok) | weak))
    assert np.isfinite(tracks["chi2"][weak]).all()
    assert np.isfinite(tracks["cov"][weak]).all()


def test_a_muon_too_fast_for_the_field_is_unconstrained() -> None:
    """At 300 GeV/c the chamber measures the sign at best, whatever the number of its hits."""
    tracks = cg.run("besiii-cgem-design", cg.Gun("mu-", p=300.0, cos_theta=0.2), n=50, seed=3).tracks
    wide = tracks["err_p"] > 0.5 * tracks["p"]
    assert wide.any()
    assert (tracks["status"][wide] == FitStatus.unconstrained).all()
    assert (tracks["n_wires"] > 30).all()


@pytest.mark.usefixtures("each_isa")
def test_few_wires_do_not_constrain_the_direction() -> None:
    """Of six wires one or two are stereo: where the errors along z are those of the prior, the status says so."""
    tracks = cg.run("besiii-idc", cg.Gun("pi+", p=(0.05, 0.3), cos_theta=(-0.95, 0.95)), 2500, 11, workers=1).tracks
    prior = FitSettings().prior_sigma
    weak = (tracks["err_dz"] > prior[3] / 2) | (tracks["err_tanl"] > prior[4] / 2)
    weak |= tracks["err_p"] > tracks["p"] / 2
    fitted = np.isin(tracks["status"], (FitStatus.ok, FitStatus.unconstrained))
    assert np.count_nonzero(weak & fitted) > 3
    assert np.array_equal(tracks["status"][fitted] == FitStatus.unconstrained, weak[fitted])


@pytest.mark.usefixtures("each_isa")
def test_clean_tracks_of_stereo_wires_keep_them() -> None:
    """All wires are stereo: after a circle through clusters alone, five of these tracks left out up to 14 hits."""
    exact = cg.Settings(simulate=SimulateSettings(fluctuations="gaussian", deltas=False, decays=False))
    muons = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    tracks = cg.run("kloe2-like", muons, 700, 555, settings=exact, workers=1).tracks
    assert (tracks["status"] == FitStatus.ok).all()
    assert tracks["n_outliers"].max() <= 1


@pytest.mark.parametrize("p", [0.0528, 0.06, 0.1])
@pytest.mark.parametrize(("cells", "layers"), [("7 mm", 18), ("14 mm", 10)])
def test_tracks_that_turn_back_among_stereo_wires_have_a_start(p: float, cells: str, layers: int) -> None:
    """Positrons of muons at rest cross several cells of their last layers, at azimuths that tell nothing."""
    chamber = {
        "gas": "Light", "sigma": "110 um", "half_length": "950 mm", "wires": "none",
        "superlayers": {
            f"S{i}": {"layers": 1, "cells": cells, "stereo": f"{-100 if i % 2 else 100} mrad"} for i in range(layers)
        },
    }  # fmt: skip
    chamber["superlayers"]["S0"]["r_in"] = "170 mm"
    gas = {"density": "0.36e-3 g/cm3", "composition": {"He": 0.55, "C": 0.36, "H": 0.09}, "gas": True}
    detector = {"name": "curl", "field": {"bz": "-1.25 T"}, "materials": {"Light": gas}, "drift_chamber": chamber}
    exact = cg.Settings(simulate=SimulateSettings(fluctuations="gaussian", decays=False))
    result = cg.run(detector, cg.Gun("e+", p=p, cos_theta=(-0.3, 0.3)), 40, 1, settings=exact, workers=1)
    assert (result.tracks["status"] == FitStatus.ok).all()
    pulls = np.stack([result.matches[f"pull_{name}"] for name in ("dr", "phi0", "kappa", "dz", "tanl")])
    assert np.abs(pulls).max() < 8


@pytest.mark.usefixtures("each_isa")
def test_a_fit_that_gives_up_hits_starts_again() -> None:
    """The first start of event 426 ends with 21 of 66 hits: a good fit, were the other 45 not counted."""
    tracks = cg.run("besiii-idc", cg.Gun("p", p=(0.2, 0.35), cos_theta=(-0.5, 0.5)), 430, 1, workers=1).tracks
    again = tracks[tracks["event"] == 426]
    assert again["status"].tolist() == [FitStatus.ok]
    assert again["n_wires"].tolist() == [66]
    assert again["n_outliers"].tolist() == [0]


def used_hits(tracks: Table) -> npt.NDArray[np.int64]:
    """Return the number of hits that each fit uses."""
    return np.asarray(tracks["n_clusters"] + tracks["n_wires"], np.int64)


@pytest.mark.usefixtures("each_isa")
def test_a_track_that_gives_up_most_hits_says_so() -> None:
    """Slow protons may stop before hits of their candidate: these count as left out, as outliers do."""
    result = cg.run("stcf-like", cg.Gun("p", p=(0.2, 0.35), cos_theta=(-0.5, 0.5)), 1500, 1, workers=1)
    tracks, hits = result.tracks, result.candidate_hits["candidate"]
    held = np.bincount(hits, minlength=len(result.candidates))[tracks["candidate"]]
    known = np.isfinite(tracks["chi2"])
    assert np.array_equal((used_hits(tracks) + tracks["n_outliers"])[known], held[known])
    lost = tracks["status"] == FitStatus.hits_left_out
    assert np.count_nonzero(lost) > 3
    settled = lost | (tracks["status"] == FitStatus.ok)
    assert np.array_equal(lost[settled], (tracks["n_outliers"] > used_hits(tracks))[settled])


def test_tracks_and_garbage():
    """Half of them tracks with all kinds of damage, half nonsense."""
    counts, found = fuzz.fuzz(6000, seed=3)
    assert not found
    assert sum(counts.values()) == 6000
    assert {status for _, status in counts} >= {status.name for status in FitStatus} - {"left_field"}


@pytest.mark.parametrize("name", [name for name in isa.available() if name != isa.available()[-1]])
def test_with_every_instruction_set(name):
    """The same for the kernels that are not in use by default."""
    before = isa.name()
    isa.use(name)
    try:
        assert not fuzz.fuzz(2_000, seed=4)[1]
    finally:
        isa.use(before)


def test_a_wrong_number_is_seen():
    """The check itself: a covariance or residual that is no number, or not positive, is listed."""
    random = np.random.default_rng(1)
    tables = fuzz.run(fuzz.tracks(200, random), fuzz.FitSettings(residuals=True))
    assert not fuzz.problems(tables)
    good = np.flatnonzero(tables["tracks"]["status"] == FitStatus.ok)[0]
    for value in (np.nan, -1.0):
        cov = tables["tracks"]["cov"].copy()
        cov[good, 2, 2] = value
        assert fuzz.problems(tables | {"tracks": tables["tracks"].with_columns(cov=cov)})
    kappa = tables["tracks"]["kappa"].copy()
    kappa[good] = np.inf
    assert fuzz.problems(tables | {"tracks": tables["tracks"].with_columns(kappa=kappa)})
    pull = tables["residuals"]["pull"].copy()
    pull[0] = np.nan
    assert fuzz.problems(tables | {"residuals": tables["residuals"].with_columns(pull=pull)})


@pytest.fixture(scope="module")
def too_small():
    """Muons whose fit takes the errors of wires for a third of what they are; every hit is used."""
    fit_detector = load("besiii-cgem").with_overrides({"drift_chamber.sigma": "40 um"})

    def run(**changes):
        settings = cg.Settings(fit=FitSettings(outlier_pull=0.0, **changes))
        gun = Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7))
        return cg.run("besiii-cgem", gun, 60, seed=2, settings=settings, fit_detector=fit_detector)

    return run(), run(chi2_limit=0.0)


def test_a_chi_square_that_nothing_explains_is_not_ok(too_small):
    large, unlimited = too_small
    tracks, others = large.tracks, unlimited.tracks
    assert (others["status"] == FitStatus.ok).all()
    beyond = tracks["chi2"] > 6 * tracks["ndf"]
    assert 0.5 < beyond.mean() < 1
    assert np.array_equal(tracks["status"] == FitStatus.large_chi2, beyond)
    assert (tracks["status"][~beyond] == FitStatus.ok).all()
    for name in set(tracks) - {"status"}:
        np.testing.assert_array_equal(tracks[name], others[name])
    assert f"; large chi-square: {beyond.sum()})" in repr(large)
    assert large.large_chi2() == beyond.sum()
    assert unlimited.large_chi2() == 0


def test_tracks_with_a_large_chi_square_count_as_before(too_small):
    """In resolutions, pulls, efficiencies, pairs, loops, vertices and alignment: without them tails would be lost."""
    large, unlimited = too_small
    assert large.removed() == unlimited.removed() == {}
    for name in ("dr", "p"):
        one, other = (cg.resolution(run.tracks, name) for run in too_small)
        assert one.n == 60
        assert one == other
    both = [cg.study.pulls(run.tracks) for run in too_small]
    assert both[0] == both[1]
    found = [cg.study.finding(run) for run in too_small]
    assert np.array_equal(found[0].fitted, found[1].fitted)
    assert found[0].fitted.all()
    assert np.array_equal(*(link_loops(run.fitted, -1.0) for run in too_small))
    events = [run.fitted.with_columns(event=np.repeat(np.arange(30), 2)) for run in too_small]
    signs = np.tile([1.0, -1.0], 30)
    mixed = [tracks.with_columns(kappa=np.abs(tracks["kappa"]) * signs, charge=tracks["charge"]) for tracks in events]
    pairs = [cg.pair_tracks(tracks) for tracks in mixed]
    assert len(pairs[0]) == 30
    assert np.array_equal(*pairs)
    states = [cg.fit(run.detector, *run.fitted_hits, run.candidates, run.candidate_hits,
                     FitSettings(states=("beam_line",), chi2_limit=limit))["states"]
              for run, limit in zip(too_small, (1.1, 0.0), strict=True)]  # fmt: skip
    np.testing.assert_array_equal(states[0]["status"], states[1]["status"])


def test_few_degrees_of_freedom_fluctuate():
    """A ratio of 8 is one in 10^3 of two degrees of freedom, and one in 10^25 of 30."""
    columns = {"status": np.zeros(4, np.int8), "ndf": np.array([2, 30, 0, 30]), "chi2": np.array([16.0, 240, 0, 170])}
    assert with_large_chi2(columns, 6.0).tolist() == [0, FitStatus.large_chi2, 0, 0]
    assert with_large_chi2(columns, 5.0).tolist() == [0, FitStatus.large_chi2, 0, FitStatus.large_chi2]
    other = columns | {"status": np.full(4, FitStatus.unconstrained)}
    assert with_large_chi2(other, 6.0).tolist() == [FitStatus.unconstrained] * 4
    with pytest.raises(ValueError, match=r"chi2_limit: got 1\.0.*expected 0 or a finite number above 1"):
        FitSettings(chi2_limit=1.0)


def test_good_tracks_have_no_large_chi_square():
    """At most one in a thousand muons, also where they scatter much."""
    tracks = cg.run("besiii-cgem", Gun("mu-", p=(0.1, 1.0), cos_theta=(-0.8, 0.8)), 4000, seed=5).tracks
    n = np.count_nonzero(tracks["status"] == FitStatus.large_chi2)
    assert n <= 4 + 3 * 2
