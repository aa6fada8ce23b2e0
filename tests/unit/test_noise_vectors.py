"""Noise vectors of the reference track are kicks in matter, seen from the origin."""

import math

import numpy as np
import pytest

from cgemit import _core, helix
from cgemit.detector import compiled, load, slab_table, slabs
from cgemit.detector.core import cgem_table, wire_table
from oracles import helix_point
from slabs import composition
from tracks import MUON, hits_on, on_helix, particles, transport

DETECTORS = {bz: load("besiii-cgem-design").with_overrides({"field.bz": f"{bz} T"}) for bz in (-1, 1)}
STEP = np.array([0.01, 1e-5, 4e-5, 0.01, 2e-5])  # dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
# dr mm, phi0, pT GeV/c, dz mm, tanl
SHAPES = {
    "central 1 GeV/c": (0.3, 0.4, 1.0, 5.0, 0.02),
    "inclined 5 GeV/c": (-0.5, -2.9, 5.0, -20.0, 1.1),
    "displaced 0.5 GeV/c": (20.0, 1.7, 0.5, 30.0, -0.7),
    "slow": (0.2, -1.2, 0.16, -8.0, 0.5),
}


def helix_of(shape, charge):
    """Return (dr, phi0, kappa, dz, tanl) of a case."""
    dr, phi0, pt, dz, tanl = SHAPES[shape]
    return np.array([dr, phi0, charge / pt, dz, tanl])


def one_slab(x0, xi, spread, bz):
    """Return the design detector's read-out with a single slab of carbon at 60 mm, and its columns."""
    detector = DETECTORS[bz]
    table = slab_table(slabs(detector))
    columns = {k: v.copy() for k, v in table.slabs.items()}
    for column in ("x0", "xi", "spread"):
        columns[column][:] = 0
    i = 1  # the air between beam pipe and first layer
    columns["radius"][i], columns["x0"][i], columns["xi"][i], columns["spread"][i] = 60.0, x0, xi, spread
    elements = [[(6, 12.011, 42.70 * x0 / 12.011)] if k == i else [] for k in range(len(columns["x0"]))]
    core = _core.Detector(
        bz=detector.field.bz, slabs=columns, log_terms=table.log_terms, composition=composition(elements),
        cgem=cgem_table(detector.cgem), wires=wire_table(detector.drift_chamber), screening=_core.Screening.wentzel,
    )  # fmt: skip
    return detector, core, i, columns


def rotated(momentum, angle_1, angle_2):
    """Turn a momentum by plane angles about the flight: 1 horizontal, 2 completing a right-handed set."""
    flight = momentum / np.linalg.norm(momentum)
    axis_1 = np.cross([0, 0, 1.0], flight)
    axis_1 /= np.linalg.norm(axis_1)
    axis_2 = np.cross(flight, axis_1)
    turned = flight + angle_1 * axis_1 + angle_2 * axis_2
    return np.linalg.norm(momentum) * turned / np.linalg.norm(turned), axis_1, axis_2


@pytest.mark.parametrize("bz", [-1, 1])
@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "displaced 0.5 GeV/c", "inclined 5 GeV/c", "slow"])
def test_noise_vectors_are_kicks_seen_from_the_origin(shape, charge, bz):
    """Each noise vector is the change of the helix when the track beyond the slab is kicked and followed back."""
    detector, core, slab, columns = one_slab(0.02, 1e-4, 4.0, bz)
    parameters = helix_of(shape, charge)
    hits = hits_on(detector, parameters)
    noise = _core._testing.reference(core, parameters, MUON, hits)["noise"]
    noise = noise[np.any(np.abs(noise) > 1e-9, axis=1)]  # the other slabs are empty
    assert len(noise) == 5  # two angles, the loss, two shifts
    start = on_helix(parameters)
    point = helix_point([start[c][0] for c in "xyz"], [start[c][0] for c in ("px", "py", "pz")], charge, bz)
    at = _core._testing.step_to_cylinder(point[None], columns["radius"][slab])[0][0]
    position, momentum = at[:3], abs(1 / parameters[2]) * np.array([*at[3:5], at[5]])
    p = np.linalg.norm(momentum)
    # The kicks' sizes: path, angle from momentum half-way through the loss, straggling, shift.
    across = at[:2] @ at[3:5] / columns["radius"][slab]
    path = math.hypot(1, at[5]) / across
    _, track_xi, track_chi_c2, _ = _core.total_matter(core, parameters[4])
    loss, variance, _ = _core._testing.core_loss(core, slab, path=path, p=p, mass=MUON, track_xi=track_xi)
    energy = math.hypot(p, MUON)
    after = math.sqrt((energy - loss) ** 2 - MUON**2)
    theta = _core.scattering_angle(
        core, slab, path=path, p=0.5 * (p + after), mass=MUON, track_chi_c2=track_chi_c2
    )  # fmt: skip
    shift = theta * 4.0 * path

    def seen(kick, epsilon):
        """Return the helix of the kicked track, followed back to the beam line in vacuum."""
        turned, axis_1, axis_2 = rotated(momentum, epsilon * kick[0], epsilon * kick[1])
        moved = position + epsilon * (kick[3] * axis_1 + kick[4] * axis_2)
        return helix.at_origin(particles(moved, turned * (1 + epsilon * kick[2]), -13 * charge), bz)[0]

    kicks = np.diag([theta, theta, math.sqrt(variance) * energy / p**2, shift, shift])
    # The way back over a shift along the flight turns the direction by w times it: second order in thin matter.
    turn = abs(at[6]) * shift * abs(at[5]) / math.hypot(1, at[5])
    neglected = 1.1 * turn * np.array([70.0, 1.0, 0.0, 70.0 * abs(at[5]), 0.0])
    for number, (found, kick) in enumerate(zip(noise, kicks, strict=True)):
        expected = (seen(kick, 1e-3) - seen(kick, -1e-3)) / 2e-3
        weights = np.array([1e-3, 1, 1, 1e-3, 1])
        size = found @ (weights * expected) / (expected @ (weights * expected))
        if number == 4:
            limit = 5e-4 * np.abs(expected) + neglected
            assert np.all(np.abs(math.copysign(1, size) * found - expected) <= limit)
            continue
        # At which momentum on the way through the slab the size is taken is a matter of taste.
        assert abs(size) == pytest.approx(1, rel=5e-4), number
        limit = 2e-5 * np.abs(expected) + 1e-6 * np.abs(expected).max() * np.array([1, 1e-2, 1e-2, 1, 1e-2])
        assert np.all(np.abs(found / size - expected) <= limit), number


@pytest.mark.parametrize("charge", [-1, 1])
@pytest.mark.parametrize("shape", ["central 1 GeV/c", "slow", "displaced 0.5 GeV/c"])
def test_noise_behind_all_matter(shape, charge):
    """Seen from the origin through all the matter before it, a kick in the outermost gap is its noise vector.

    The simulation without fluctuations tells how place, direction and momentum in the gap depend on the helix; the
    noise vector is the change of the helix that makes the kick.
    """
    detector, core = DETECTORS[-1], compiled(DETECTORS[-1])
    parameters = helix_of(shape, charge)

    def arrival(helix_row):
        truths = {k: v[-1] for k, v in transport(core, on_helix(helix_row))["truths"].items()}
        assert truths["layer"] == 2
        pt = math.hypot(truths["px"], truths["py"])
        azimuth = math.atan2(truths["py"], truths["px"])
        return np.array([truths["phi"], azimuth, charge / pt, truths["z"], truths["pz"] / pt])

    matrix = np.empty((5, 5))
    for i in range(5):
        step = np.where(np.arange(5) == i, STEP, 0)
        matrix[:, i] = (arrival(parameters + step) - arrival(parameters - step)) / (2 * STEP[i])
    columns = slab_table(slabs(detector)).slabs
    shifts = columns["spread"] * 13.6e-3 * np.sqrt(columns["x0"]) > 5e-3
    gap = int(np.flatnonzero(columns["gap"] == 2)[0])
    first = np.where(shifts, 5, 3)[:gap].sum()
    noise = _core._testing.reference(core, parameters, MUON, hits_on(detector, parameters))["noise"][first : first + 3]
    _, _, kappa, _, tanl = arrival(parameters)
    # Sideways; up and down at fixed momentum; momentum alone. Sizes are tested with a single slab above; what is left
    # is that the loss depends on how obliquely matter is met.
    kicks = np.array([[0, 1, 0, 0, 0], [0, 0, kappa * tanl, 0, 1 + tanl**2], [0, 0, 1, 0, 0]])
    units = np.array([1.0, 5e-3, 1e-2, 1.0, 5e-3])
    for found, kick in zip(noise, kicks, strict=True):
        expected = np.linalg.solve(matrix, kick) / units
        unit, expected = found / units / np.linalg.norm(found / units), expected / np.linalg.norm(expected)
        np.testing.assert_allclose(unit * np.sign(unit @ expected), expected, atol=1e-2)
