"""Numbers that follow from others, each recomputed by hand."""

import csv

import numpy as np
import pytest
from test_cluster import PITCH, crossing_strip, digi_table, v_strips, x_strips

from cgemit import FitSettings, GaussianReadout, Gun, Settings, _core, extrapolate, load, run
from cgemit.detector import write_field_map
from cgemit.reconstruction.cluster import cluster
from cgemit.simulation.digitize import DigitizeSettings

DESIGN = "besiii-cgem-design"
N = 1500


@pytest.fixture(scope="module")
def twins():
    """Return a run with two equal particles in each event."""
    gun = Gun("mu-", p=0.5, cos_theta=0.1, phi=0.3, multiplicity=2)
    return run(DESIGN, gun, N, seed=3, settings=Settings(digitize=DigitizeSettings(readout=GaussianReadout())))


def paired(table, value):
    """Return a column of the first and of the second particle, where both have one row."""
    rows = [np.flatnonzero(table["particle"] == number) for number in (0, 1)]
    _, first, second = np.intersect1d(table["event"][rows[0]], table["event"][rows[1]], return_indices=True)
    return value[rows[0][first]], value[rows[1][second]]


def assert_independent(first, second):
    """Check that two columns have no correlation beyond 4 of its standard errors."""
    assert len(first) > 0.8 * N
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(len(first))


def test_equal_particles_of_an_event_have_draws_of_their_own(twins):
    """Scattering, energy loss, drift distances and positions of twins are independent."""
    truths = twins.truths[twins.truths["layer"] == 2]
    for name in ("phi", "z", "energy"):
        first, second = paired(truths, truths[name])
        assert_independent(first, second)
        assert np.std(first) > 0
    particle = twins.truths["particle"][twins.digis["truth"]]
    digis = twins.digis.with_columns(particle=particle)
    for layer, view in ((0, 0), (0, 1), (1, 0), (2, 1)):
        picked = digis[(digis["layer"] == layer) & (digis["view"] == view)]
        residual = picked["position"] - np.median(picked["position"])
        assert_independent(*paired(picked, residual))


def test_equal_particles_have_drift_errors_of_their_own():
    """Beside each other, so that each has cells of its own; the second one by whole cells of the layer."""
    layer = load(DESIGN).drift_chamber.layers[0]
    turn = 5 * 2 * np.pi / layer.cells
    guns = [Gun("mu-", p=0.5, cos_theta=0.1, phi=0.3 + number * turn) for number in (0, 1)]
    result = run(DESIGN, guns[0] + guns[1], N, seed=3, until="digitize")
    wires = result.wire_hits[result.wire_hits["layer"] == layer.number]
    crossing = wires["wire_truth"]
    wires = wires.with_columns(particle=result.wire_truths["particle"][crossing])
    errors = paired(wires, wires["drift"] - np.abs(result.wire_truths["doca"][crossing]))
    assert_independent(*errors)
    assert np.std(errors[0]) > 0.05


def test_twins_fit_independently(twins):
    tracks = twins.tracks[twins.tracks["status"] == 0]
    for name in ("dr", "dz", "kappa"):
        assert_independent(*paired(tracks, tracks[f"res_{name}"]))


def test_a_map_in_csv_has_the_numbers_it_was_made_of(tmp_path):
    """Axes and components stand in mm and T, row by row."""
    r, z = np.linspace(0, 120, 5), np.linspace(-200, 400, 7)
    bz = -1 + 1e-3 * r[:, None] + 2e-4 * z
    write_field_map(tmp_path / "map.csv", {"r": r, "z": z, "br": 1e-5 * r[:, None] + 0 * z, "bz": bz})
    with (tmp_path / "map.csv").open() as stream:
        head, *rows = csv.reader(stream)
    assert head == ["r[mm]", "z[mm]", "br[T]", "bz[T]"]
    numbers = np.array(rows, float)
    np.testing.assert_array_equal(numbers[:, 0], np.repeat(r, 7))
    np.testing.assert_array_equal(numbers[:, 1], np.tile(z, 5))
    np.testing.assert_array_equal(numbers[:, 3], bz.ravel())


def test_extrapolation_loses_the_energy_of_the_particle():
    """Every row is extrapolated with the mass of its own hypothesis."""
    fit = FitSettings(hypothesis=("mu", "K"))
    tracks = run(DESIGN, Gun("K+", p=0.4, cos_theta=0.0), 60, settings=Settings(fit=fit)).tracks
    tracks = tracks[tracks["status"] == 0]
    own = extrapolate(DESIGN, tracks, 190.0)
    for number, name in ((-13, "mu"), (321, "K")):
        rows = np.abs(tracks["hypothesis"]) == abs(number)
        assert rows.sum() > 40
        one = extrapolate(DESIGN, tracks, 190.0, particle=name)
        np.testing.assert_array_equal(own["kappa"][rows], one["kappa"][rows])
    lost = helix_momentum(tracks) - np.sqrt(own["px"] ** 2 + own["py"] ** 2 + own["pz"] ** 2)
    kaon = np.abs(tracks["hypothesis"]) == 321
    # dE/dx at 0.4 GeV/c goes roughly with 1/beta^2, and dp = dE/beta.
    ratio = (np.hypot(0.4, 0.493677) / np.hypot(0.4, 0.105658)) ** 3
    assert np.median(lost[kaon]) / np.median(lost[~kaon]) == pytest.approx(ratio, rel=0.2)


def helix_momentum(tracks):
    return np.hypot(1, tracks["tanl"]) / np.abs(tracks["kappa"])


def test_radiation_length_of_the_chamber_gas():
    """He/C3H8 60/40 by volume at 20 C and 1 atm, from the radiation lengths of the Particle Data Group."""
    gas = load(DESIGN).drift_chamber.gas
    molar, length = {"He": 4.0026, "C3H8": 44.0956}, {"He": 94.32, "C3H8": 45.37}  # g/mol, g/cm2
    mass = {"He": 0.6 * molar["He"], "C3H8": 0.4 * molar["C3H8"]}
    total = sum(mass.values())
    per = sum(part / total / length[name] for name, part in mass.items())
    assert gas.density == pytest.approx(total / 24055, rel=0.03)  # cm3/mol
    assert gas.x0 == pytest.approx(10 / (per * gas.density), rel=0.03)  # the file states that of the geometry
    cgem = load(DESIGN).cgem[0].gas  # Ar/iC4H10 90/10
    mass = {"Ar": 0.9 * 39.948, "iC4H10": 0.1 * 58.122}
    per = (mass["Ar"] / 19.55 + mass["iC4H10"] / 45.23) / sum(mass.values())
    assert cgem.x0 == pytest.approx(10 / (per * cgem.density), rel=0.01)


def test_pairs_cross_within_both_ends():
    """A pair of X and V makes a cluster if it crosses on the sheet, at either end."""
    detector = load(DESIGN)
    half, stereo = detector.cgem[0].half_length, detector.cgem[0].stereo
    x = 400
    strips = [crossing_strip(0, (x + 0.5) * PITCH, z) for z in (-half + 3, half - 3)]
    for strip, outward in zip(strips, (-1, 1), strict=True):
        step = -outward if stereo > 0 else outward  # V falls with z for a positive angle
        beyond = [strip + step * n for n in (8, 12, 20, 60)]
        xv = cluster(detector, digi_table(x_strips(x) + v_strips(strip, *beyond)))
        xv = xv[xv["view"] == 2]
        assert len(xv) == 1
        assert half - 6 < outward * xv["z"][0] <= half


def test_truths_of_a_cluster_are_counted():
    """As many as the largest number in one strip, or the different links, whichever is larger."""
    table = digi_table(x_strips(4, truth=1) + x_strips(5, truth=2) + x_strips(6, truth=2) + x_strips(9, truth=3))
    more = table.with_columns(n_truths=np.array([1, 3, 1, 2], "i4"))
    detector = load(DESIGN)
    assert cluster(detector, table)["n_truths"].tolist() == [2, 1]
    assert cluster(detector, more)["n_truths"].tolist() == [3, 2]
    assert cluster(detector, table)["truth"].tolist() == [2, 3]


@pytest.mark.parametrize("view", [0, 1])
def test_hits_beside_the_edge_of_a_sheet_are_as_good_as_others(view):
    """X and V begin anew at the edge; a track there may lie on the other side of it than its hit."""
    detector = load(DESIGN)
    pulls, near = [], []
    for layer in detector.cgem:
        for edge in layer.sheet_phi:
            gun = Gun("mu-", p=1.5, cos_theta=(-0.5, 0.5), phi=(edge - 0.03, edge + 0.03))
            fit = FitSettings(residuals=True)
            result = run(detector, gun, 80, seed=2, settings=Settings(fit=fit))
            assert np.mean(result.tracks["status"] == 0) > 0.97
            rows = result.residuals[result.residuals["view"] == view]
            number = detector.cgem.index(layer)
            at = rows[rows["layer"] == number]
            hits = at["hit"]
            x = result.clusters["x"][hits] if view == 0 else np.zeros(len(hits))
            near.append(np.minimum(x, layer.strips_x * layer.pitch_x - x) < 5)
            pulls.append(at["residual"])
    residual = np.concatenate(pulls)
    assert len(residual) > 300
    # A hit taken on the wrong side of the edge is off by the circumference.
    assert np.mean(np.abs(residual) < 3) > 0.97
    assert view == 1 or np.concatenate(near).sum() > 30


def test_weights_of_the_sides_of_a_wire(monkeypatch):
    """The two sides weigh as the likelihoods of the track fitted without the hit: tanh(drift predicted / variance)."""
    kept = {}
    real = _core.fit

    def keep(detector, **given):
        kept.update(given=given, out=real(detector, **given))
        return kept["out"]

    monkeypatch.setattr(_core, "fit", keep)
    fit = FitSettings(residuals=True, states=("origin",), outlier_pull=0)
    run(DESIGN, Gun("mu-", p=1.0, cos_theta=0.1), 300, settings=Settings(fit=fit), workers=1)
    out, hits = kept["out"], kept["given"]["hits"]
    track = np.repeat(np.arange(len(out["status"])), np.diff(kept["given"]["hit_offsets"]))
    wires = (np.asarray(hits["kind"]) == 2) & (out["status"][track] == 0)
    drift = np.asarray(hits["value"])[wires]
    weight = out["used_value"][wires] / drift
    noise, variance = np.asarray(hits["sigma"])[wires] ** 2, out["used_variance"][wires]
    predicted = out["used_value"][wires] - out["residual"][wires]
    spread = np.maximum(out["err"][wires] ** 2 - variance, 0)
    # The first iterations take the error of the prediction for half of what it is.
    off = [np.abs(weight - np.tanh(drift * predicted / (noise + caution * spread))) for caution in (1.0, 4.0)]
    between = np.abs(weight) < 0.95
    assert between.sum() > 50
    assert np.minimum(*off)[between].max() < 0.05
    np.testing.assert_allclose(variance, noise + (1 - weight**2) * drift**2, rtol=1e-6, atol=1e-9)
