"""Detectors with unequal ends against their mirror image, against counts by hand, and against simulated tracks."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

import cgemit as cg
from cgemit.detector.layers.wires import WireLayer
from tests.helpers.stats import assert_within

#: The CGEM and the chamber of BESIII, cut differently at the two ends; a sensor, the beam pipe and a wall, too.
CHANGES: dict[str, object] = {
    "cgem.L1.z_max": "180 mm", "cgem.L2.z_min": "-200 mm", "cgem.L3.z_min": "-300 mm", "cgem.L3.z_max": "420 mm",
    "drift_chamber.layers.*.z_min": "x0.6", "beam_pipe.*.z_min": "-120 mm", "walls.*.z_max": "x0.7",
    "layer.VTX": {"radius": "40 mm", "sigma": "20 um", "z_min": "-90 mm", "z_max": "60 mm", "material": "Si"},
}  # fmt: skip
CUT = cg.load("besiii-cgem-design").with_overrides(CHANGES)
EXACT = cg.Settings.from_dict({"simulate": {"fluctuations": "off", "deltas": False}})


def swapped(part: cg.detector.parts.Cylinder | WireLayer) -> Iterator[tuple[str, str]]:
    low, high = part.ends
    yield from (("z_min", f"{-high!r} mm"), ("z_max", f"{-low!r} mm"))


def mirrored(detector: cg.Detector) -> cg.Detector:
    """Return the image of a detector under z -> -z, which leaves the field along z as it is."""
    changes: dict[str, object] = {}
    for group in ("beam_pipe", "walls"):
        for part in getattr(detector, group):
            changes |= {f"{group}.{part.label}.{name}": value for name, value in swapped(part)}
    for layer in detector.layers:
        changes |= {f"{layer.path}.{name}": value for name, value in swapped(layer)}
        changes[f"{layer.path}.stereo"] = f"{-layer.stereo!r} rad"
    for wires in detector.wires:
        changes |= {f"{wires.path}.{name}": value for name, value in swapped(wires)}
        changes[f"{wires.path}.twist_cells"] = -wires.twist_cells
        changes[f"{wires.path}.phi_east"] = f"{math.remainder(wires.phi_east - wires.twist, 2 * math.pi)!r} rad"
    return detector.with_overrides(changes)


def test_ends_of_the_detector() -> None:
    """By hand: L1 keeps -266 mm of its length of 532 mm."""
    assert CUT.cgem["L1"].ends == (-266.0, 180.0)
    assert CUT.cgem["L1"].length == 446.0
    assert CUT.cgem["L2"].ends[0] == -200.0
    first = cg.load("besiii-cgem-design").wires[0]
    assert CUT.wires[0].ends == pytest.approx((-0.6 * first.half_length, first.half_length))
    image = mirrored(CUT)
    assert image.cgem["L1"].ends == (-180.0, 266.0)
    assert image.wires[0].ends == (-CUT.wires[0].ends[1], -CUT.wires[0].ends[0])


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_mirror_image(finder: str) -> None:
    """Simulated, found and fitted tracks are those of the image, but for the sign of z."""
    image = mirrored(CUT)
    cosine = np.linspace(-0.9, 0.9, 120)
    gun = {"p": [0.3, 1.0, 2.5], "phi": (-3.1, 3.1)}
    made, back = (
        cg.run(one, cg.Gun("mu-", cos_theta=list(sign * cosine), **gun), 120, seed=4, settings=EXACT, finder=finder,
               readout="gaussian")
        for one, sign in ((CUT, 1), (image, -1))
    )  # fmt: skip
    for name in ("truths", "wire_truths", "clusters", "wire_hits", "tracks", "candidate_hits"):
        assert len(made.tables[name]) == len(back.tables[name]), name
    assert np.array_equal(made.wire_hits["gid"], back.wire_hits["gid"])
    assert made.wire_hits["drift"] == pytest.approx(back.wire_hits["drift"], abs=1e-6)
    good = (made.tracks["status"] == 0) & (back.tracks["status"] == 0)
    assert np.array_equal(made.tracks["status"], back.tracks["status"])
    assert good.sum() > 60
    for name, sign in (("dr", 1), ("phi0", 1), ("kappa", 1), ("dz", -1), ("tanl", -1)):
        difference = made.tracks[name][good] - sign * back.tracks[name][good]
        assert np.abs(difference / made.tracks[f"err_{name}"][good]).max() < 0.02, name
        ratio = made.tracks[f"err_{name}"][good] / back.tracks[f"err_{name}"][good]
        assert ratio == pytest.approx(1.0, abs=1e-3), name


def test_covariance_of_the_mirror_image() -> None:
    cosine = np.array([-0.9, -0.6, -0.3, 0.0, 0.3, 0.6, 0.9])
    made = cg.analytic(CUT, "mu-", p=1.0, cos_theta=cosine, readout="gaussian")
    back = cg.analytic(mirrored(CUT), "mu-", p=1.0, cos_theta=-cosine, readout="gaussian")
    for name in ("dr", "dz", "p"):  # near an end, samples scatter by draws that have no mirror image
        assert made.sigma(name) == pytest.approx(back.sigma(name), rel=5e-3, nan_ok=True)
        assert made.sigma(name)[1:6] == pytest.approx(back.sigma(name)[1:6], rel=1e-3)
    assert made.sigma("p")[6] > 1.1 * made.sigma("p")[1]


def crossed(layers: list[tuple[float, float, float]], tanl: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return how many cylinders (radius, ends) straight lines from the origin cross."""
    return np.sum([(tanl * r > low) & (tanl * r < high) for r, low, high in layers], axis=0)


def test_numbers_of_hits_by_the_polar_angle() -> None:
    """Tracks of 20 GeV/c are straight lines: crossings of the measuring cylinders by hand, away from their ends."""
    cosine = np.linspace(-0.97, 0.97, 195)
    tanl = cosine / np.sqrt(1 - cosine**2)
    made = cg.run(CUT, cg.Gun("mu-", p=20.0, cos_theta=list(cosine), phi=0.3), 195, seed=1, settings=EXACT)
    layers = [(layer.r_mid, *layer.ends) for layer in CUT.layers]
    count = np.bincount(made.truths["event"], minlength=195)
    near = np.any([np.abs(tanl * r - end) < 3 for r, *ends in layers for end in ends], axis=0)
    assert np.array_equal(count[~near], crossed(layers, tanl)[~near])
    assert len(set(count.tolist())) == 5
    wires = [(layer.r_mid, *layer.ends) for layer in CUT.wires]
    found = [len(np.unique(made.wire_truths["layer"][made.wire_truths["event"] == event])) for event in range(195)]
    # Tracks beyond an end of the gas meet no more wires; stereo wires are up to 2 cm farther out at their ends.
    expected = crossed(wires, tanl)
    assert np.abs(np.array(found) - expected).max() <= 3
    assert np.mean(np.array(found) == expected) > 0.8


@pytest.mark.parametrize("cosine", [-0.8, -0.55, 0.55, 0.8])
def test_simulated_tracks_have_the_expected_errors(cosine: float) -> None:
    """Pulls of width 1, and widths as the covariance expects them, on either side."""
    settings = cg.Settings.from_dict({"simulate": {"fluctuations": "gaussian", "deltas": False}})
    n = 700
    made = cg.run(CUT, cg.Gun("mu-", p=1.0, cos_theta=cosine), n, seed=8, settings=settings, readout="gaussian")
    good = made.tracks["status"] == 0
    assert good.sum() > 0.97 * n
    tracks = made.tracks[good]
    expected = cg.analytic(CUT, "mu-", p=1.0, cos_theta=cosine, readout="gaussian")
    for name in ("dr", "dz", "phi0", "tanl", "kappa"):
        pull = tracks[f"pull_{name}"]
        assert_within(pull.mean(), 0.0, 1 / np.sqrt(good.sum()))
        assert_within(pull.std(), 1.0, 1 / np.sqrt(2 * good.sum()))
    for name, unit in (("dr", 1e-3), ("dz", 1.0)):
        sigma = unit * float(expected.sigma(name))  # mm
        assert_within(tracks[f"res_{name}"].std(), sigma, sigma / np.sqrt(2 * good.sum()))
