"""Every setting, changed alone, changes the tables that it is for, and none of an earlier stage; the mass of tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import cgemit as cg
from cgemit.base.validate import kinds_of
from cgemit.chain.settings import BY_STAGE
from cgemit.detector.readouts import READOUTS, Readout
from cgemit.particles import species
from cgemit.particles.gun import generate, only_kind
from cgemit.particles.table import particles_from
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.find import ckf
from cgemit.simulation.digitize import digitize
from cgemit.tables import Table

DESIGN = cg.load("besiii-cgem-design")
# Every twelfth X strip is dead: clusters bridge them. Slow pions turn back, kaons decay.
DEAD = {f"cgem.{one.label}.dead_x": [f"0:{strip}" for strip in range(5, one.strips_x, 12)] for one in DESIGN.cgem}
DETECTOR = DESIGN.with_overrides(DEAD)
PIONS = cg.Gun("pi-", p=(0.08, 0.5), cos_theta=(-0.4, 0.4))
GUN = PIONS + cg.Gun("K+", p=(0.2, 0.5), cos_theta=(-0.8, 0.8))
FOLDER, FACTORS = "a folder of another run", "a file of factors on errors"

#: Tables of each stage; candidates and matches follow from the others.
STAGE_TABLES = (
    *BY_STAGE[:3],
    ("candidate_hits",),
    ("refined_clusters", "refined_wire_hits", "tracks", "residuals", "states", "components", "start_times"),
)

SIMULATED = ("decays", "steps", "truths", "wire_truths")
DIGIS, HITS, CLUSTERS, FOUND, FITTED = ("digis",), ("wire_hits",), ("clusters",), ("candidate_hits",), ("tracks",)
BUSY, FITTED_START = {"background.cells": 0.15}, {"refine.start_time": "fitted"}
WITHOUT_FIELD, CHARGE = {"field.bz": "0 T"}, {"readout": "analog-projection"}


class Case(NamedTuple):
    """Another value of a setting, tables that change, all of one stage, and what else gives it a meaning.

    That is other settings, or a field of the detector.
    """

    value: Any
    changed: tuple[str, ...]
    given: Mapping[str, Any] = {}


CASES: dict[str, Case] = {
    "simulate.fluctuations": Case("gaussian", SIMULATED),
    "simulate.sublayers": Case(True, SIMULATED),
    "simulate.foil": Case("lattice", SIMULATED),
    "simulate.screening": Case("moliere", SIMULATED),
    "simulate.deltas": Case(False, ("steps", "truths")),
    "simulate.steps": Case(True, ("steps",)),
    "simulate.decays": Case(False, ("particles", *SIMULATED)),
    "simulate.half_turns": Case(3, ("particles", *SIMULATED)),
    "digitize.reveal_sides": Case(True, HITS),
    "digitize.wire_times": Case("raw", HITS),
    "background.level": Case("bes2009", DIGIS + HITS),
    "background.factor": Case(0.5, DIGIS + HITS, {"background.level": "bes2009"}),
    "background.cells": Case(0.05, HITS),
    "background.clumps": Case(False, HITS, BUSY),
    "background.events": Case(FOLDER, DIGIS + HITS),
    "background.offset": Case((50.0, 60.0), DIGIS + HITS, {"background.events": FOLDER}),
    "background.start_time": Case(3.0, HITS),
    "cluster.position": Case("charge", CLUSTERS),
    "cluster.bridge": Case(0, CLUSTERS),
    "cluster.error_factors": Case(FACTORS, CLUSTERS, CHARGE),
    "cluster.reference_p": Case(0.3, CLUSTERS),
    "cluster.reference_cos_theta": Case(0.2, CLUSTERS),
    "find.method": Case("chamber", FOUND),
    "find.hypothesis": Case("p", FOUND),
    "find.efficiency": Case(0.6, FOUND, BUSY),
    "find.gate": Case(2.5, FOUND),
    "find.branches": Case(1, FOUND, BUSY),
    "find.passes": Case(1, FOUND),
    "find.holes_in_row": Case(1, FOUND, BUSY),
    "find.max_d": Case(1.0, FOUND),
    "find.max_z": Case(2.0, FOUND),
    "find.min_pt": Case(0.3, FOUND),
    "find.least_axial": Case(20, FOUND, {"find.method": "chamber"}),
    "find.min_score": Case(30.0, FOUND),
    "find.max_seeds": Case(1, FOUND, BUSY),
    "find.annealing": Case(False, FOUND, BUSY),
    "find.momentum": Case(0.03, FOUND, WITHOUT_FIELD),
    "fit.cluster_errors": Case("cluster", FOUND),
    "fit.screening": Case("moliere", FITTED),
    "fit.loss": Case("mean", FITTED),
    "fit.momentum_error": Case(0.01, FITTED),
    "fit.radiation": Case(False, FITTED, {"fit.hypothesis": "e"}),
    "fit.matter": Case(False, FOUND),
    "fit.start_radius": Case(100.0, FITTED),
    "fit.residuals": Case(True, ("residuals",)),
    "fit.states": Case(("hits",), ("states",)),
    "fit.hypothesis": Case("pi", FITTED),
    "fit.max_iterations": Case(1, FITTED),
    "fit.tolerance": Case(5.0, FITTED),
    "fit.least_width": Case(0.5, FOUND),
    "fit.delta_strips": Case(0.2, FOUND),
    "fit.kinks": Case(False, FITTED),
    "fit.beam": Case((0.1, 5.0), FITTED),
    "fit.components": Case(True, ("components",), {"fit.hypothesis": "e"}),
    "fit.outlier_pull": Case(2.5, FITTED),
    "fit.chi2_limit": Case(1.01, FITTED, {"fit.matter": False}),
    "fit.momentum": Case(0.1, FITTED, WITHOUT_FIELD | {"find.momentum": 1.0}),
    "fit.prior_sigma": Case((1.0, 0.05, 0.5, 1.0, 0.2), FITTED),
    "refine.drift_times": Case("raw", FOUND),
    "refine.flight": Case("cosmic", FOUND, {"refine.drift_times": "raw"}),
    "refine.start_time": Case("fitted", FOUND),
    # Without another search, whose hits would depend on the error.
    "refine.start_time_error": Case(
        0.1, ("refined_wire_hits", "tracks", "start_times"), FITTED_START | {"refine.find_again": False}
    ),
    "refine.find_again": Case(False, FOUND, FITTED_START),
    "refine.points": Case("compete", FOUND),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the folder of a run whose events are mixed in, beside a file of factors."""
    path = tmp_path_factory.mktemp("others") / "run"
    (path.parent / "errors.csv").write_text("layer,view,size,hits,factor,err\n0,0,2,30,1.5,0.1\n")
    cg.run(DETECTOR, GUN, 5, 3, until="digitize", output=path)
    return str(path)


@cache
def tables(changes: tuple[tuple[str, Any], ...], folder: str, until: Any) -> Mapping[str, Table]:
    """Return the tables of a run with some settings changed."""
    files = {FOLDER: folder, FACTORS: str(Path(folder).parent / "errors.csv")}
    overrides = {key: files.get(value, value) if isinstance(value, str) else value for key, value in changes}
    field = {key: overrides.pop(key) for key in WITHOUT_FIELD | CHARGE if key in overrides}
    settings = cg.Settings().with_overrides(overrides)
    return dict(cg.run(detector_in(field), GUN, 10, 1, settings=settings, finder="ckf", until=until, workers=1).tables)


def field_of(case: Case) -> dict[str, Any]:
    """Return what of the field and the readout gives a setting its meaning."""
    return {key: value for key, value in case.given.items() if key in WITHOUT_FIELD | CHARGE}


def detector_in(field: Mapping[str, Any]) -> cg.Detector:
    """Return the detector with another field or readout."""
    detector = DETECTOR.with_readout(field["readout"]) if "readout" in field else DETECTOR
    field = {key: value for key, value in field.items() if key != "readout"}
    return detector.with_overrides(field) if field else detector


def hits_to_give(field: Mapping[str, Any], folder: str) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
    """Return columns of clusters by their strips, and of wires with raw drift times, of tracks in a field."""
    found = tables((("digitize.wire_times", "raw"), *field.items()), folder, "cluster")
    strips = {name: found["clusters"][name] for name in ("event", "layer", "sheet", "view", "first", "last", "size")}
    strips = {name: column[strips["view"] < 2] for name, column in strips.items()}
    names = ("event", "layer", "wire", "drift", "sigma", "drift_time")
    return strips, {name: found["wire_hits"][name] for name in names}


def differ(one: Table | None, other: Table | None) -> bool:
    """Tell whether two tables differ in any bit."""
    if one is None or other is None:
        return one is not other
    return one.columns.keys() != other.columns.keys() or any(one[n].tobytes() != other[n].tobytes() for n in one)


def first_changed(before: Mapping[str, Table], after: Mapping[str, Table]) -> set[str]:
    """Return the tables that differ, of the first stage that has any."""
    for names in STAGE_TABLES:
        if changed := {name for name in names if differ(before.get(name), after.get(name))}:
            return changed
    return set()


@pytest.mark.parametrize("stage", kinds_of(cg.Settings))
def test_settings_of_a_stage_change_what_they_are_for(stage: str, folder: str) -> None:
    kinds = kinds_of(kinds_of(cg.Settings)[stage])
    cases = {key: case for key, case in CASES.items() if key.startswith(f"{stage}.")}
    assert cases.keys() == {f"{stage}.{name}" for name in kinds}
    until = {"background": "digitize", "refine": "fit"}.get(stage, stage)
    found = {}
    for key, case in cases.items():
        given = tuple(case.given.items())
        before, after = (tables(changes, folder, until) for changes in (given, (*given, (key, case.value))))
        found[key] = first_changed(before, after)
    assert found == {key: set(case.changed) for key, case in cases.items()}


#: Another value of each setting of the readouts, and whether digis, and clusters of the same digis, change.
BOTH = ("digis", "clusters")
ANALOG: dict[str, tuple[Any, tuple[str, ...]]] = {
    "gain": (9000.0, BOTH),
    "polya": (2.0, BOTH),
    "gain_fluctuation": (False, BOTH),
    "survival": (0.5, BOTH),
    "first_gain": (5.0, BOTH),
    "diffusion": (0.5, BOTH),
    "lorentz": (False, BOTH),
    "holes": (False, BOTH),
    "share_spread": (0.3, BOTH),
    "threshold_x": (4.0, BOTH),
    "threshold_v": (4.0, BOTH),
    "noise": (1.0, BOTH),
    "jitter": (15.0, BOTH),
    "missing": (0, CLUSTERS),
    "edge": (0.4, CLUSTERS),
    "valley": (0.9, CLUSTERS),
    "time_margin": (1.0, CLUSTERS),
    "estimator": ("centroid", CLUSTERS),
    "second_pass": (True, ()),
    "saturation": (10.0, DIGIS),
}
READOUT_CASES: dict[str, dict[str, tuple[Any, tuple[str, ...]]]] = {
    "binary": {"gain": (5000.0, DIGIS), "threshold": (30.0, DIGIS)},
    "gaussian": {"sigma_x": (0.2, BOTH), "sigma_v": (0.2, BOTH), "gain": (5000.0, DIGIS)},
    "analog-projection": {
        "gain": (5000.0, BOTH),
        "sigma": (0.4, BOTH),
        "threshold": (3.0, BOTH),
        "noise": (2.0, BOTH),
        "valley": (0.9, CLUSTERS),
        "estimator": ("centroid", ()),
    },
    "tiger": ANALOG,
    "apv25": ANALOG,
}
#: Other settings that give one a meaning.
GIVEN: dict[str, dict[str, Any]] = {"edge": {"estimator": "micro-tpc"}}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if READOUT_CASES[name] is ANALOG else ()) for name in READOUTS]
)
def test_settings_of_a_readout_change_what_they_are_for(name: str) -> None:
    """Digis, and clusters of the digis of the defaults: each half of a readout takes the settings that it needs."""
    given, cases = READOUTS[name](), READOUT_CASES[name]
    assert cases.keys() == kinds_of(READOUTS[name]).keys()
    settings = cg.Settings().with_overrides({"simulate.steps": True})
    simulated = cg.run(DESIGN, GUN, 16, 1, settings=settings, until="simulate", workers=1)

    def digis_of(readout: Readout) -> Table:
        detector = DESIGN.with_readout(readout)
        return digitize(detector, simulated.truths, simulated.wire_truths, None, 1, steps=simulated.steps)["digis"]

    def clusters_of(readout: Readout) -> Table:
        return cluster(DESIGN, digis, readout=readout)

    digis = digis_of(given)
    found = {}
    for key, (value, _) in cases.items():
        before = replace(given, **GIVEN.get(key, {}))
        after = replace(before, **{key: value})
        changed = {
            "digis": differ(digis, digis_of(after)),
            "clusters": differ(clusters_of(before), clusters_of(after)),
        }
        found[key] = tuple(which for which, on in changed.items() if on)
    assert found == {key: changed for key, (_, changed) in cases.items()}


#: Settings of the fit that its finder takes, too; the others say what the fit does with the hits.
OF_FINDER = {
    *("cluster_errors", "screening", "loss", "momentum_error", "radiation", "matter", "least_width", "delta_strips"),
}


def test_the_finder_assumes_matter_and_cluster_errors_of_the_fit(monkeypatch: pytest.MonkeyPatch, folder: str) -> None:
    """By the scores of candidates, in which each number of matter and errors shows: radiation only for electrons."""
    hits, scores, search = tables((), folder, "cluster"), [], ckf._core.reconstruction.find_tracks

    def with_scores(*given: Any, **named: Any) -> Any:
        found = search(*given, **named)
        scores.append(found["score"].tobytes())
        return found

    monkeypatch.setattr(ckf._core.reconstruction, "find_tracks", with_scores)
    cases = {key.removeprefix("fit."): case.value for key, case in CASES.items() if key.startswith("fit.")}
    seen = set()
    for name, value in cases.items():
        for fit in (cg.FitSettings(), cg.FitSettings(**{name: value})):
            cg.find_tracks(DETECTOR, hits["clusters"], hits["wire_hits"], cg.FindSettings(hypothesis="e"), fit=fit)
        if scores[-1] != scores[-2]:
            seen.add(name)
    assert seen == OF_FINDER


@pytest.mark.slow
def test_settings_reach_the_fit_of_given_hits(folder: str) -> None:
    """`fit_hits` takes settings of the fit, refinements, cluster errors and finder; each changes what it makes."""
    own: dict[str, Mapping[str, Any]] = {
        "cluster": {"settings": cg.FitSettings(cluster_errors="cluster")},
        "refine.flight": {"refine": cg.RefineSettings(drift_times="raw")},
        "refine.start_time_error": {"refine": cg.RefineSettings(drift_times="raw", start_time="fitted")},
        "refine.find_again": {"refine": cg.RefineSettings(drift_times="raw", start_time="fitted")},
        "fit.radiation": {"settings": cg.FitSettings(hypothesis="e")},
    }
    kinds = {"cluster": cg.ClusterSettings, "find": cg.FindSettings, "fit": cg.FitSettings, "refine": cg.RefineSettings}
    #: Clusters that are given by their strips have no charge, and are joined already.
    no_effect = {"cluster.position", "cluster.bridge", "cluster.error_factors"}
    unseen = set()
    for key, case in CASES.items():
        stage, name = key.split(".")
        if stage not in kinds:
            continue
        field = field_of(case)
        strips, wires = hits_to_give(field, folder)
        how = dict(own.get(key, own.get(stage, {})))
        argument = "settings" if stage == "fit" else stage
        before = how.get(argument, kinds[stage]())
        if stage != "refine":
            how.setdefault("refine", cg.RefineSettings(drift_times="raw"))
        made = [
            cg.fit_hits(detector_in(field), strips, wires, candidates="ckf", **how | {argument: one})
            for one in (before, replace(before, **{name: case.value}))
        ]
        if not any(differ(made[0].get(table), made[1].get(table)) for table in {*made[0], *made[1]}):
            unseen.add(key)
    assert unseen == no_effect


def test_find_settings_without_the_finder_are_refused() -> None:
    with pytest.raises(ValueError, match="find: got settings of the finder, expected None unless candidates is 'ckf'"):
        cg.fit_hits(DESIGN, find=cg.FindSettings())


#: Settings of the fit that say nothing of the covariance: how a fit gets there, and what it makes beside it. Clusters
#: have the errors of their size, and tracks a mass and a momentum of their own.
NOT_ANALYTIC = {
    *("cluster_errors", "residuals", "states", "hypothesis", "max_iterations", "tolerance", "kinks", "outlier_pull"),
    *("momentum", "components"),
}


@pytest.mark.slow
def test_settings_of_the_fit_reach_the_analytic_resolution() -> None:
    cases = {key.removeprefix("fit."): case for key, case in CASES.items() if key.startswith("fit.")}
    unseen = set()
    with pytest.raises(ValueError, match="beam"):
        cg.analytic(DESIGN, "e-", p=0.3, fit=cg.FitSettings(beam=cases.pop("beam").value))
    for name, case in cases.items():
        design = DESIGN.with_overrides(field) if (field := field_of(case)) else DESIGN
        covariances = [
            cg.analytic(design, "e-", p=0.3, cos_theta=0.3, fit=fit, threads=1).cov.tobytes()
            for fit in (cg.FitSettings(), cg.FitSettings(**{name: case.value}))
        ]
        if covariances[0] == covariances[1]:
            unseen.add(name)
    assert unseen == NOT_ANALYTIC


KAON = {"p": 0.5, "cos_theta": (-0.6, 0.6)}


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        (cg.Gun("K+", **KAON), 321),
        (cg.Gun("K+", **KAON) + cg.Gun("K-", **KAON), 321),
        (cg.Gun("K+", **KAON) + cg.Gun("n", **KAON), 321),
        (cg.Gun("K+", **KAON) + cg.Gun("pi-", **KAON), None),
        (cg.Gun("n", **KAON), None),
        (cg.sample("slow-pions"), 211),
        (cg.sample("ks-pipi"), 211),
        (cg.sample("jpsi-rhopi"), 211),
        (cg.sample("cosmic") + cg.Gun("mu+", **KAON), 13),
        (cg.sample("electrons"), 11),
        (cg.sample("beam-gas"), None),
        (cg.sample("pipi-jpsi"), None),
        (cg.sample("d0-d0bar"), None),
        (None, None),
    ],
    ids=repr,
)
def test_sources_of_one_kind_of_particle(source, kind):
    """Guns and samples tell it, and the particles that they shoot are of it."""
    assert only_kind(source) == kind
    if kind is not None:
        shot = generate(source, 20, 1, detector=cg.load("besiii-cgem"))
        assert set(np.abs(shot["pdg"][shot["charge"] != 0])) == {kind}
        assert only_kind(None, shot) == kind


@pytest.mark.parametrize(
    ("gun", "hypothesis", "pdg", "name", "other"),
    [
        (cg.Gun("K+", **KAON), None, 321, "K", 0),
        (cg.Gun("K+", **KAON) + cg.Gun("pi-", **KAON), None, 13, "mu", 1),
        (cg.Gun("K+", **KAON), "pi", 211, "pi", 1),
        (cg.Gun("alpha", p=3.0, cos_theta=(-0.6, 0.6)), None, 1000020040, "alpha", 0),
        (cg.Gun("mu-", **KAON), None, 13, "mu", 0),
    ],
)
def test_found_tracks_have_the_mass_of_their_particle(gun, hypothesis, pdg, name, other):
    """Or that of the settings; tables, result and resolution name it and say where it is not the particle's."""
    settings = cg.Settings(find=cg.FindSettings(hypothesis=hypothesis), simulate=cg.SimulateSettings(decays=False))
    result = cg.run("besiii-cgem", gun, 20, 1, finder="ckf", settings=settings)
    assert len(result.tracks) > 15
    kind = species.hypothesis_of(name)
    for column, value in (("pdg", pdg), ("mass", kind.mass), ("charge", abs(kind.charge))):
        assert set(result.candidates[column]) == {value}
    assert set(result.tracks["hypothesis"]) == {pdg}
    assert result.tracks["other_mass"].tolist() == [other] * len(result.tracks)
    assert result.mass == name
    assert f"mass      {name}" in repr(result)
    width = cg.resolution(result, "dr")
    assert width.other_mass == other * width.n
    assert (f"({width.n} of another mass)" in repr(width)) == bool(other)
    assert cg.study.finding(result).mass == name


def test_particles_of_a_table_have_their_mass_too():
    """The kind is that of all events, not of those of a chunk; by truth each track has its own."""
    guns = [cg.Gun(name, **KAON) for name in ("proton", "K-")]
    protons, kaons = (generate(gun, 8, 1) for gun in guns)
    arguments = {"finder": "ckf", "settings": cg.Settings(simulate=cg.SimulateSettings(decays=False))}
    assert set(cg.run("besiii-cgem", protons, **arguments).tracks["hypothesis"]) == {2212}
    columns = {name: np.concatenate([protons[name], kaons[name] + 8 * (name == "event")]) for name in protons}
    both = particles_from(columns)
    workers = cg.Workers(threads=1, chunk=8)
    result = cg.run("besiii-cgem", both, **arguments, workers=workers)
    assert set(result.tracks["hypothesis"]) == {13}
    by_truth = cg.run("besiii-cgem", both, settings=arguments["settings"])
    assert by_truth.mass == "each particle's own"
    assert by_truth.tracks["hypothesis"].tolist() == [2212] * 8 + [321] * 8
    assert not np.any(by_truth.tracks["other_mass"])
    several = cg.run("besiii-cgem", protons, settings=cg.Settings(fit=cg.FitSettings(hypothesis=("mu", "p"))))
    assert several.mass == "mu, p"
    assert several.tracks["other_mass"].tolist() == [1, 0] * 8


@pytest.mark.parametrize(("particle", "bias"), [("K+", -0.8), ("proton", -5.0)])
def test_pulls_of_found_tracks(particle, bias):
    """Kaons and protons are fitted as such; fitted as muons, as all were, they are many errors too slow."""
    means = []
    for name in (None, "mu"):
        settings = cg.Settings(find=cg.FindSettings(hypothesis=name), simulate=cg.SimulateSettings(decays=False))
        result = cg.run("besiii-cgem", cg.Gun(particle, **KAON), 100, 1, finder="ckf", settings=settings)
        means.append(np.median(result.tracks["pull_p"]))
    assert abs(means[0]) < 0.5
    assert means[1] < bias


@pytest.mark.parametrize("wrong", ["tau", "gamma", "pion", 13, ["pi"]])
def test_hypotheses_that_are_none(wrong):
    with pytest.raises(ValueError, match="hypothesis: got"):
        cg.FindSettings(hypothesis=wrong)
