"""Unequal ends, also on one side of z = 0, against mirror images, counts by hand, simulated tracks, whole barrels."""

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

import cgemit as cg
from cgemit import _core
from cgemit.detector import compiled, slabs
from cgemit.detector.layers.wires import WireLayer
from tests.helpers.stats import assert_within

#: The CGEM and the chamber of BESIII, cut differently at the two ends; a sensor, the beam pipe and a wall, too.
CHANGES: dict[str, object] = {
    "cgem.L1.z_max": "180 mm", "cgem.L2.z_min": "-200 mm", "cgem.L3.z_min": "-300 mm", "cgem.L3.z_max": "420 mm",
    "drift_chamber.layers.*.z_min": "x0.6", "beam_pipe.*.z_min": "-120 mm", "walls.*.z_max": "x0.7",
    "layer.VTX": {"radius": "40 mm", "sigma": "20 um", "z_min": "-90 mm", "z_max": "60 mm", "material": "Si"},
}  # fmt: skip
CUT = cg.load("besiii-cgem-design").with_overrides(CHANGES)
SENSOR = {"sigma": "20 um", "material": "Si"}
#: Layers on one side of z = 0, two of them beside each other at one radius, and a wall.
SIDES = CUT.with_overrides({
    "cgem.L2.z_min": "20 mm", "cgem.L3.z_max": "-15 mm", "walls.*.z_min": "25 mm",
    "layer.FWD": {"radius": "50 mm", "z_min": "30 mm", "z_max": "200 mm", **SENSOR},
    "layer.BWD": {"radius": "50 mm", "z_min": "-150 mm", "z_max": "30 mm", **SENSOR},
    "layer.OUT": {"radius": "60 mm", "z_min": "50 mm", "z_max": "260 mm", **SENSOR},
})  # fmt: skip
#: A chamber on one side.
HALF = CUT.with_overrides({"drift_chamber.layers.*.z_min": "30 mm"})
DETECTORS = {"cut": CUT, "sides": SIDES, "half": HALF}
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


@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_mirror_image(finder: str, name: str) -> None:
    """Simulated, found and fitted tracks are those of the image, but for the sign of z."""
    detector = DETECTORS[name]
    image = mirrored(detector)
    cosine = np.linspace(-0.9, 0.9, 120)
    gun = {"p": [0.3, 1.0, 2.5], "phi": (-3.1, 3.1)}
    made, back = (
        cg.run(one, cg.Gun("mu-", cos_theta=list(sign * cosine), **gun), 120, seed=4, settings=EXACT, finder=finder,
               readout="gaussian")
        for one, sign in ((detector, 1), (image, -1))
    )  # fmt: skip
    for table in ("truths", "wire_truths", "clusters", "wire_hits", "tracks", "candidate_hits"):
        assert len(made.tables[table]) == len(back.tables[table]), table
    assert np.array_equal(made.wire_hits["gid"], back.wire_hits["gid"])
    assert made.wire_hits["drift"] == pytest.approx(back.wire_hits["drift"], abs=1e-6)
    good = (made.tracks["status"] == 0) & (back.tracks["status"] == 0)
    assert np.array_equal(made.tracks["status"], back.tracks["status"])
    assert good.sum() > 60
    for column, sign in (("dr", 1), ("phi0", 1), ("kappa", 1), ("dz", -1), ("tanl", -1)):
        difference = made.tracks[column][good] - sign * back.tracks[column][good]
        assert np.abs(difference / made.tracks[f"err_{column}"][good]).max() < 0.02, column
        ratio = made.tracks[f"err_{column}"][good] / back.tracks[f"err_{column}"][good]
        assert ratio == pytest.approx(1.0, abs=1e-3), column


@pytest.mark.parametrize("name", DETECTORS)
def test_covariance_of_the_mirror_image(name: str) -> None:
    detector, cosine = DETECTORS[name], np.array([-0.9, -0.6, -0.3, 0.02, 0.3, 0.6, 0.9])
    made = cg.analytic(detector, "mu-", p=1.0, cos_theta=cosine, readout="gaussian")
    back = cg.analytic(mirrored(detector), "mu-", p=1.0, cos_theta=-cosine, readout="gaussian")
    for what in ("dr", "dz", "p"):  # near an end, samples scatter by draws that have no mirror image
        if detector is CUT:
            assert made.sigma(what) == pytest.approx(back.sigma(what), rel=5e-3, nan_ok=True)
        assert made.sigma(what)[1:6] == pytest.approx(back.sigma(what)[1:6], rel=1e-3)
    if detector is CUT:
        assert made.sigma("p")[6] > 1.1 * made.sigma("p")[1]


def crossed(layers: list[tuple[float, float, float]], tanl: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return how many cylinders (radius, ends) straight lines from the origin cross."""
    return np.sum([(tanl * r > low) & (tanl * r < high) for r, low, high in layers], axis=0)


@pytest.mark.parametrize("name", DETECTORS)
def test_numbers_of_hits_by_the_polar_angle(name: str) -> None:
    """Tracks of 20 GeV/c are straight lines: crossings of the measuring cylinders by hand, away from their ends."""
    detector, cosine = DETECTORS[name], np.linspace(-0.97, 0.97, 195)
    tanl = cosine / np.sqrt(1 - cosine**2)
    made = cg.run(detector, cg.Gun("mu-", p=20.0, cos_theta=list(cosine), phi=0.3), 195, seed=1, settings=EXACT)
    layers = [(layer.r_mid, *layer.ends) for layer in detector.layers]
    count = np.bincount(made.truths["event"], minlength=195)
    near = np.any([np.abs(tanl * r - end) < 3 for r, *ends in layers for end in ends], axis=0)
    assert np.array_equal(count[~near], crossed(layers, tanl)[~near])
    assert len(set(count.tolist())) >= 5
    wires = [(layer.r_mid, *layer.ends) for layer in detector.wires]
    found = [len(np.unique(made.wire_truths["layer"][made.wire_truths["event"] == event])) for event in range(195)]
    # Tracks beyond an end of the gas meet no more wires; stereo wires are up to 2 cm farther out at their ends.
    expected = crossed(wires, tanl)
    assert np.abs(np.array(found) - expected).max() <= 3
    assert np.mean(np.array(found) == expected) > 0.8


@pytest.mark.parametrize(
    ("name", "cosine"), [("cut", -0.8), ("cut", -0.55), ("cut", 0.55), ("cut", 0.8), ("sides", -0.5), ("sides", 0.6)]
)
def test_simulated_tracks_have_the_expected_errors(name: str, cosine: float) -> None:
    """Pulls of width 1, and widths as the covariance expects them, on either side."""
    detector = DETECTORS[name]
    settings = cg.Settings.from_dict({"simulate": {"fluctuations": "gaussian", "deltas": False}})
    n = 700
    made = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=cosine), n, seed=8, settings=settings, readout="gaussian")
    good = made.tracks["status"] == 0
    assert good.sum() > 0.97 * n
    tracks = made.tracks[good]
    expected = cg.analytic(detector, "mu-", p=1.0, cos_theta=cosine, readout="gaussian")
    for what in ("dr", "dz", "phi0", "tanl", "kappa"):
        pull = tracks[f"pull_{what}"]
        assert_within(pull.mean(), 0.0, 1 / np.sqrt(good.sum()))
        assert_within(pull.std(), 1.0, 1 / np.sqrt(2 * good.sum()))
    for what, unit in (("dr", 1e-3), ("dz", 1.0)):
        sigma = unit * float(expected.sigma(what))  # mm
        assert_within(tracks[f"res_{what}"].std(), sigma, sigma / np.sqrt(2 * good.sum()))


SOLENOID = {"kind": "solenoid", "bz": "-1 T", "coil_radius": "1 m", "half_length": "1.5 m"}
UNIFORM = {"kind": "uniform", "bz": "-1 T"}


def barrel(field: dict[str, str], edges: list[float]) -> cg.Detector:
    """Return five layers of silicon, each of rings beside each other with these edges, mm."""
    rings = list(pairwise(edges))
    layers = {
        f"S{i}{'abcdefgh'[k]}": {
            "radius": f"{30 * i} mm", "z_min": f"{low} mm", "z_max": f"{high} mm", "thickness": "0.3 mm", **SENSOR
        }
        for i in range(1, 6) for k, (low, high) in enumerate(rings)
    }  # fmt: skip
    pipes = {
        f"P{k}": {"r_in": "20 mm", "r_out": "20.8 mm", "z_min": f"{low} mm", "z_max": f"{high} mm", "material": "Be"}
        for k, (low, high) in enumerate(rings)
    }
    return cg.load({"name": f"rings{len(rings)}", "field": field, "beam_pipe": pipes, "layer": layers})


@pytest.mark.parametrize("field", [UNIFORM, SOLENOID], ids=["uniform", "solenoid"])
def test_a_barrel_of_rings_beside_each_other_is_one_barrel(field: dict[str, str]) -> None:
    """Crossings, matter, found tracks and resolutions are those of the barrel in one piece."""
    whole, rings = barrel(field, [-400, 400]), barrel(field, [-400, -120, -20, 0, 60, 180, 400])
    cosine = np.linspace(-0.9, 0.9, 90)
    gun = cg.Gun("mu-", p=[0.25, 1.0, 4.0], cos_theta=list(cosine), phi=(-3.1, 3.1))
    one, many = (cg.run(part, gun, 180, seed=3, settings=EXACT, finder="ckf") for part in (whole, rings))
    for column in ("event", "x", "y", "z", "entry_x", "entry_z", "exit_y", "path"):
        if column in one.truths.columns:
            assert many.truths[column] == pytest.approx(one.truths[column], abs=1e-3), column
    assert len(one.truths) == len(many.truths) == 5 * 180
    assert len(one.tracks) == len(many.tracks) == 180
    assert (many.tracks["status"] == 0).all()
    assert (many.tracks["n_clusters"] == 10).all()
    # In a map, rounding tells which of two rings a track crosses that flies along their common end.
    across = np.array([-0.85, -0.4, -0.1, 0.0 if field is UNIFORM else 0.01, 0.07, 0.3, 0.7])
    for what in ("dr", "dz", "p"):
        a, b = (cg.analytic(part, "mu-", p=1.0, cos_theta=across).sigma(what) for part in (whole, rings))
        assert b == pytest.approx(a, rel=5e-4), what
    for tanl in (-1.5, -0.2, 0.0, 0.4, 2.0):
        a, b = (_core.matter.total_matter(compiled(part), tanl)[0] for part in (whole, rings))
        assert b == pytest.approx(a, rel=1e-9)


def test_matter_of_a_chamber_on_one_side() -> None:
    """By hand: every slab whose ends hold the line, up to where it leaves the gas."""
    core, parts = compiled(HALF), slabs(HALF)
    for tanl in (-0.8, 0.3, 0.6, 1.2):
        right, inside = 0.0, True
        for slab in parts:
            (low, high), z = slab.ends, tanl * slab.radius
            if slab.filler == 2 and z > high:
                inside = False
            right += slab.x0 * (low <= z < high and (inside or slab.filler != 2))
        assert _core.matter.total_matter(core, tanl)[0] == pytest.approx(right * math.hypot(1, tanl), rel=1e-9)
