"""Charge that an electron induces on strips: Laplace's equation, sums of strips, and the currents of the core."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.integrate import quad

import cgemit as cg
from cgemit.detector.gas import drift_columns
from cgemit.detector.induction import WAY, induced_charge, induced_charges
from cgemit.detector.readouts import APV25, TIGER, Shaper
from pulses import pulse

PITCH, GAP = 0.65, 2.0


def wave_sum(distance: float, way: float, sigma: float) -> float:
    """Return the weighting potential of a strip as a sum of waves, each of which falls as sinh(k(D - z))/sinh(kD)."""

    def wave(k: float) -> float:
        spectrum = PITCH * np.sinc(k * PITCH / (2 * math.pi)) * math.exp(-((k * sigma) ** 2) / 2)
        falls = math.exp(-k * GAP * (1 - way)) * math.expm1(-2 * k * GAP * way) / math.expm1(-2 * k * GAP)
        return float(spectrum * math.cos(k * distance) * falls / math.pi)

    return float(quad(wave, 1e-9, 400.0, limit=2000)[0])


@pytest.mark.parametrize("way", [0.1, 0.5, 0.81, 0.97])
@pytest.mark.parametrize("sigma", [0.0, 0.3])
def test_potential_solves_laplace(way: float, sigma: float) -> None:
    """Against waves in the plane of the strips, each with its own solution of Laplace's equation."""
    distance = np.array([0.0, 0.3, 0.9, 2.0, 3.0])
    found = induced_charge(distance, way, PITCH, GAP, sigma)
    np.testing.assert_allclose(found, [wave_sum(one, way, sigma) for one in distance], atol=2e-5)


def test_potential_by_hand() -> None:
    """2/pi arctan(tanh(pi p/4D)) in mid-gap; the sum over strips is that of parallel plates."""
    middle = induced_charge(np.zeros(1), 0.5, PITCH, GAP)[0]
    assert middle == pytest.approx(2 / math.pi * math.atan(math.tanh(math.pi * 0.65 / 2 / 4)), abs=1e-12)
    assert middle == pytest.approx(0.156, abs=0.001)
    strips = PITCH * np.arange(-60, 61) + 0.2
    for way in (0.0, 0.3, 0.7, 1.0):
        assert induced_charge(strips, way, PITCH, GAP, 0.3).sum() == pytest.approx(way, abs=1e-6)
    np.testing.assert_array_equal(induced_charge(np.array([0.3, 0.4]), 1.0, PITCH, GAP), [1.0, 0.0])


@pytest.mark.parametrize("shaper", [TIGER.timing, TIGER.charge, APV25.timing])
def test_few_pieces_are_enough(shaper: Shaper) -> None:
    """Amplitudes with a constant current between the nodes are within 1 % of the charge; with one not within 6."""
    t, duration, fine = np.arange(0, 400, 1.0), 57.0, np.linspace(0, 1, 201)

    def error(ways: np.ndarray, distance: float) -> float:
        charge = np.array([induced_charge(np.array([distance]), way, PITCH, GAP, 0.31)[0] for way in fine])
        even = np.interp(fine, ways, np.interp(ways, fine, charge))
        exact, pieces = (pulse(shaper, t, duration, np.diff(one)) for one in (charge, even))
        return float(np.abs(exact - pieces).max())

    for distance in (0.0, 0.325, 0.65, 1.0, 1.3, 2.0):
        assert error(WAY, distance) < 0.01
    assert error(np.array([0.0, 1.0]), 0.0) > 0.06


def test_tables_of_a_detector() -> None:
    """Of X and V of each layer, with the Lorentz angle of the induction gap: early charge is seen where it is then."""
    det = cg.load("besiii-cgem-design")
    charges, reach = induced_charges(det, 1.0, True)
    straight, _ = induced_charges(det, 1.0, False)
    assert charges.shape == (6, 33, len(WAY), 2 * reach + 1)
    place, layer = 8, det.cgem[2]
    drift = {name: float(column[2]) for name, column in drift_columns(det).items()}
    lean = layer.r_readout * drift["lean"]
    assert lean == pytest.approx(math.copysign(0.114 * 2.0, det.field.bz), rel=0.1)  # tan of the angle times the gap
    for plane, (move, pitch) in {2: (lean, layer.pitch_x), 5: (lean * math.cos(layer.stereo), layer.pitch_v)}.items():
        along = layer.r_readout * drift["cloud_phi"], drift["cloud_z"]
        sigma = (
            along[0] if plane == 2 else math.hypot(math.cos(layer.stereo) * along[0], math.sin(layer.stereo) * along[1])
        )
        distance = pitch * (np.arange(-reach, reach + 1) + 0.5 - place / 32)
        for node, way in enumerate(WAY):
            expected = induced_charge(distance + move * (1 - way), float(way), pitch, 2.0, sigma)
            np.testing.assert_allclose(charges[plane, place, node], expected, atol=1e-9)
            assert node in (0, 4) or np.abs(straight[plane, place, node] - expected).max() > 0.005
