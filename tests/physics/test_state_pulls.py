"""States of fitted tracks against simulated truth, inside the inner tracker, between wires and outside the last hit."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from cgemit import helix
from cgemit.chain.run import run
from cgemit.detector import Detector, field_at, load
from cgemit.particles.gun import Gun, generate
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.fit import PARAMETERS, FitSettings, fit
from cgemit.reconstruction.states import StateStatus, Surface
from cgemit.simulation.digitize import digitize
from cgemit.simulation.transport import simulate
from cgemit.tables import Table
from cgemit.tables.schema import HIT_WIRE, FitStatus
from cgemit.truth import finder
from cgemit.truth.match import joined, match
from exact import assert_standard_normal, exact
from fields import HARMONIC

pytestmark = pytest.mark.slow

Floats = npt.NDArray[np.float64]
N = 2500
LAST_LAYER = 31  # outermost wire layer that the fit may use: the chamber goes on to 42
DETECTOR = load("besiii-cgem-design")
PIPE = DETECTOR.beam_pipe[0].r_in
MIDDLES = tuple(layer.r_mid for layer in DETECTOR.cgem)
LAYERS = {layer.number: layer.r_mid for layer in DETECTOR.drift_chamber.layers} if DETECTOR.drift_chamber else {}
OUTSIDE = (36, 42)  # layers of the chamber that the fit does not use
FIELDS = {
    "-1 T": DETECTOR,
    "1 T": DETECTOR.with_overrides({"field.bz": "1 T"}),
    "harmonic": DETECTOR.with_field(HARMONIC),
}
POINTS = [("mu-", 0.3, "-1 T"), ("mu+", 0.3, "1 T"), ("pi-", 1.0, "-1 T"), ("mu-", 0.3, "harmonic")]
every_point = pytest.mark.parametrize(("particle", "p", "field"), POINTS)


@cache
def sample(
    particle: str, p: float, field: str, believed: Detector | None = None
) -> tuple[dict[str, Table], dict[str, Table]]:
    """Simulate tracks in the mode in which everything is Gaussian; fit them without the outer wires."""
    how = exact()
    detector, settings = FIELDS[field].with_readout(how["readout"]), how["settings"]
    particles = generate(Gun(particle, p=p, cos_theta=(-0.5, 0.5)), N, seed=21)
    tables = simulate(detector, particles, settings.simulate, seed=21)
    tables |= digitize(detector, tables["truths"], tables["wire_truths"], settings.digitize, 21, steps=tables["steps"])
    tables["clusters"] = cluster(detector, tables["digis"])
    names = ("particles", "clusters", "wire_hits", "truths", "wire_truths")
    found = finder.by_truth(detector, *(tables[name] for name in names))
    hits = found["candidate_hits"]
    layer = tables["wire_hits"]["layer"][np.where(hits["view"] == HIT_WIRE, hits["hit"], 0)]
    hits = hits[(hits["view"] != HIT_WIRE) | (layer <= LAST_LAYER)]
    settings = FitSettings(states=("beam_pipe", *MIDDLES, "hits", *(LAYERS[number] for number in OUTSIDE)))
    given = (found["candidates"], hits, tables["clusters"], tables["wire_hits"])
    out = fit(believed or detector, *given[2:], *given[:2], settings)
    of_truth = (tables["particles"], tables["truths"], tables["wire_truths"])
    matches = match(out["tracks"], *given, *of_truth, detector=detector)["matches"]
    return tables, out | {"tracks": joined(out["tracks"], matches)}


def helices(table: Table) -> Floats:
    """Return the parameters, (n, 5)."""
    return np.stack([table[name] for name in PARAMETERS], axis=1)


def seen_from(states: Table, points: Floats, field: str) -> tuple[Floats, Floats]:
    """Return helices and covariances with the pivot at other points, in the field where the states are."""
    pivots = np.stack([states[f"pivot_{axis}"] for axis in "xyz"], axis=1)
    bz = field_at(FIELDS[field], pivots)[:, 2]
    return helix.change_pivot(helices(states), states["cov"], pivots, points, bz)


def pulls_at(states: Table, points: Floats, field: str) -> Floats:
    """Return pulls of d_rho and d_z with the pivot at the true points, (n, 2)."""
    moved, cov = seen_from(states, points, field)
    return np.asarray(moved[:, [0, 3]] / np.sqrt(cov[:, [0, 3], [0, 3]]))


def all_pulls(states: Table, points: Floats, momenta: Floats, charge: Floats, field: str) -> Floats:
    """Return the pulls of the five parameters with the pivot at the true points, (n, 5)."""
    moved, cov = seen_from(states, points, field)
    pt = np.hypot(momenta[:, 0], momenta[:, 1])
    true = np.stack(
        [0 * pt, np.arctan2(-momenta[:, 0], momenta[:, 1]), charge / pt, 0 * pt, momenta[:, 2] / pt], axis=1
    )
    difference = moved - true
    difference[:, 1] = np.remainder(difference[:, 1] + np.pi, 2 * np.pi) - np.pi
    return np.asarray(difference / np.sqrt(np.diagonal(cov, axis1=1, axis2=2)))


def columns(table: Table, names: tuple[str, ...], rows: npt.NDArray[np.intp]) -> Floats:
    """Return columns of some rows side by side."""
    return np.stack([table[name][rows] for name in names], axis=1)


def middles(truths: Table, rows: npt.NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Return points in the middle of gaps, and momenta there, (n, 3)."""
    r, phi = truths["r"][rows], truths["phi"][rows]
    points = np.stack([r * np.cos(phi), r * np.sin(phi), truths["z"][rows]], axis=1)
    return points, columns(truths, ("px", "py", "pz"), rows)


@every_point
def test_at_the_beam_pipe(particle: str, p: float, field: str) -> None:
    """Before any matter, all five parameters are those of the generated helix."""
    tables, fitted = sample(particle, p, field)
    states = fitted["states"]
    assert np.all(fitted["tracks"]["status"] == FitStatus.ok)
    states = states[(states["surface"] == Surface.cylinder) & np.isclose(states["r"], PIPE)]
    assert np.all(states["status"] == StateStatus.ok)
    particles = tables["particles"]
    rows = np.arange(N)
    start, momenta = columns(particles, ("x", "y", "z"), rows), columns(particles, ("px", "py", "pz"), rows)
    pull = all_pulls(states, start, momenta, particles["charge"], field)
    for i, name in enumerate(PARAMETERS):
        assert_standard_normal(pull[:, i], f"{name} at the beam pipe")


@every_point
@pytest.mark.parametrize("layer", [0, 1, 2])
def test_inside_the_inner_tracker(particle: str, p: float, field: str, layer: int) -> None:
    """In the middle of each gap all five parameters are those of the particle there, by radius and by hit alike."""
    tables, fitted = sample(particle, p, field)
    states, truths = fitted["states"], tables["truths"]
    in_layer = np.flatnonzero(truths["layer"] == layer)
    at_hit = states[(states["surface"] == Surface.hit) & (states["view"] == 0) & (states["layer"] == layer)]
    at_radius = states[(states["surface"] == Surface.cylinder) & np.isclose(states["r"], MIDDLES[layer])]
    for where, table in (("hit", at_hit), ("radius", at_radius)):
        events, mine, row = np.intersect1d(table["track"], truths["event"][in_layer], return_indices=True)
        assert len(events) > 0.99 * N  # particles at a seam leave no cluster
        points, momenta = middles(truths, in_layer[row])
        pull = all_pulls(table[mine], points, momenta, tables["particles"]["charge"][events], field)
        for i, name in enumerate(PARAMETERS):
            assert_standard_normal(pull[:, i], f"{name} in layer {layer} by {where}")


@every_point
@pytest.mark.parametrize("number", [10, 25, *OUTSIDE])
def test_at_wires(particle: str, p: float, field: str, number: int) -> None:
    """Between wires that were used, and at layers beyond the last one, tracks pass where the particles did."""
    tables, fitted = sample(particle, p, field)
    states, truths = fitted["states"], tables["wire_truths"]
    # One passage of the layer for each track.
    in_layer = np.flatnonzero(truths["layer"] == number)
    events, first = np.unique(truths["event"][in_layer], return_index=True)
    if number in OUTSIDE:
        at = (states["surface"] == Surface.cylinder) & np.isclose(states["r"], LAYERS[number])
    else:
        at = (states["surface"] == Surface.hit) & (states["view"] == 2) & (states["layer"] == number)
        first_of_track = np.append(True, np.diff(np.where(at, states["track"], -1)[at]) != 0)
        at[np.flatnonzero(at)[~first_of_track]] = False
    table = states[at]
    events, mine, row = np.intersect1d(table["track"], events, return_indices=True)
    assert len(events) > 0.9 * N
    table = table[mine]
    assert np.all(table["status"] == StateStatus.ok)
    pull = pulls_at(table, columns(truths, ("x", "y", "z"), in_layer[first][row]), field)
    for i, name in enumerate(("dr", "dz")):
        assert_standard_normal(pull[:, i], f"{name} at layer {number}")


def test_gate_sees_a_state_that_knows_no_matter() -> None:
    """The helix at the origin, taken through the tracker as in vacuum, fails the gates of the middle of a gap."""
    tables, fitted = sample("mu-", 0.3, "-1 T")
    truths, tracks = tables["truths"], fitted["tracks"]
    rows = np.flatnonzero(truths["layer"] == 0)
    points, momenta = middles(truths, rows)
    event = truths["event"][rows]
    moved, cov = helix.change_pivot(helices(tracks)[event], tracks["cov"][event], [0, 0, 0], points, -1.0)
    pull = moved[:, 0] / np.sqrt(cov[:, 0, 0])
    with pytest.raises(AssertionError, match="standard errors"):
        assert_standard_normal(pull, "dr")
    lost = 1 - np.abs(moved[:, 2]) * np.hypot(momenta[:, 0], momenta[:, 1])
    assert np.mean(lost) > 1e-3


@pytest.mark.parametrize("believed", ["uniform", "of another strength"])
def test_gate_sees_a_wrong_field(believed: str) -> None:
    """States of tracks through the harmonic field fail the gates if the fit believes in a uniform one."""
    detector = FIELDS["harmonic"].with_overrides({"field.kind": "uniform"})
    if believed != "uniform":
        detector = detector.with_overrides({"field.bz": "-0.97 T"})
    tables, fitted = sample("mu-", 0.3, "harmonic", detector)
    states, truths = fitted["states"], tables["truths"]
    rows = np.flatnonzero(truths["layer"] == 1)
    at = states[(states["surface"] == Surface.cylinder) & np.isclose(states["r"], MIDDLES[1])]
    at = at[at["status"] == StateStatus.ok]
    events, mine, row = np.intersect1d(at["track"], truths["event"][rows], return_indices=True)
    points, momenta = middles(truths, rows[row])
    pull = all_pulls(at[mine], points, momenta, tables["particles"]["charge"][events], "harmonic")
    with pytest.raises(AssertionError, match="standard errors"):
        assert_standard_normal(pull[:, 2], "kappa")


@cache
def hypotheses() -> Table:
    """Fit kaons of 0.3 GeV/c with three masses."""
    how = exact(fit=FitSettings(hypothesis=("pi", "K", "p")))
    return run(DETECTOR, Gun("K+", p=0.3, cos_theta=(-0.5, 0.5)), N, seed=22, **how).tracks


def test_the_right_mass_is_unbiased_and_wrong_ones_are_not() -> None:
    """Kaons of 0.3 GeV/c: the loss of a pion is too small and that of a proton too large; chi-square knows little."""
    tracks = hypotheses()
    assert tracks["hypothesis"].tolist() == [211, 321, 2212] * N
    of = {pdg: tracks[(tracks["hypothesis"] == pdg) & (tracks["status"] == FitStatus.ok)] for pdg in (211, 321, 2212)}
    right = of[321]
    assert len(right) > 0.99 * N
    for name in (*PARAMETERS, "p"):
        if name != "p":  # a ratio of errors of a few per cent, not quite Gaussian
            assert_standard_normal(right[f"pull_{name}"], name)
    assert np.mean(of[211]["pull_p"]) < -0.5
    assert np.mean(of[2212]["pull_p"]) > 0.5
    assert np.mean(of[211]["res_p"]) < -1e-3
    with pytest.raises(AssertionError, match="standard errors"):
        assert_standard_normal(of[211]["pull_kappa"], "kappa")
