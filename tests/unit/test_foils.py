"""GEM foils with holes: what a straight line crosses, against brute force and against volumes by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cgemit import _core
from cgemit.detector import Detector, DetectorError, compiled, load, slabs
from cgemit.detector.matter import hole_table
from cgemit.particles.gun import Gun, generate
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.tables import Table
from stats import assert_within, fraction_error, mean_error

BUILT = load("besiii-cgem")  # 5 um copper, 50 um Kapton, 5 um copper
PITCH, CELL = 0.14, 0.5 * math.sqrt(3) * 0.14**2
COPPER, KAPTON, SECOND_COPPER = (i for i, slab in enumerate(slabs(BUILT, foil="lattice")) if slab.holes and
                                 slab.holes.foil == 0)  # fmt: skip
#: Solid part of a sub-layer: a cylinder of 70 um, a double cone of 70/50 um, one per cell of the lattice.
COVERAGE = {
    COPPER: 1 - math.pi * 0.035**2 / CELL,
    KAPTON: 1 - math.pi * (0.035**2 + 0.035 * 0.025 + 0.025**2) / 3 / CELL,
}


def lines(n: int, slope: float, seed: int) -> dict[str, np.ndarray]:
    """Return lines that cross the foil evenly at one slope in random azimuth."""
    i, j, turn = np.random.default_rng(seed).random((3, n))
    steep = {"slope_u": slope * np.cos(2 * np.pi * turn), "slope_v": slope * np.sin(2 * np.pi * turn)}
    return {"u": (i + j / 2) * PITCH, "v": j * PITCH * math.sqrt(3) / 2, **steep}


def fraction(slab: int, given: dict[str, np.ndarray], detector: Detector = BUILT) -> np.ndarray:
    return _core._testing.solid_fraction(compiled(detector, foil="lattice"), slab, **given)


def marched(slab: int, given: dict[str, np.ndarray], steps: int = 4000) -> np.ndarray:
    """Return the solid part of each line by looking at points along it, with every hole of a large piece of foil."""
    holes = slabs(BUILT, foil="lattice")[slab].holes
    reach = range(-40, 41)
    tree = cKDTree([((i + j / 2) * PITCH, j * PITCH * math.sqrt(3) / 2) for i in reach for j in reach])
    w = holes.begin + (np.arange(steps) + 0.5) / steps * (holes.end - holes.begin)
    at = [np.add.outer(given[x], 0 * w) + np.outer(given[f"slope_{x}"], w) for x in "uv"]
    distance, _ = tree.query(np.stack(at, axis=-1))
    radius = 0.035 if slab != KAPTON else 0.025 + 0.01 * np.abs(w) / 0.025
    return np.mean(distance > radius, axis=1)


def test_coverage_of_the_standard_foil() -> None:
    assert COVERAGE[COPPER] == pytest.approx(0.773, abs=5e-4)
    assert COVERAGE[KAPTON] == pytest.approx(0.832, abs=5e-4)


@pytest.mark.parametrize("slab", [COPPER, KAPTON])
@pytest.mark.parametrize("slope", [0.0, 0.4, 2.5, 30.0, 3000.0])
def test_mean_over_a_foil_is_its_volume_at_any_slope(slab: int, slope: float) -> None:
    found = fraction(slab, lines(40_000, slope, seed=3))
    error = max(mean_error(found), 1e-12)  # the flattest lines all get the mean
    assert_within(found.mean(), COVERAGE[slab], error, what=f"solid part at slope {slope}")


def test_another_hole_is_seen() -> None:
    wide = BUILT.with_overrides({"cgem.L1.hole_outer": "73 um"})
    found = fraction(COPPER, lines(40_000, 0.0, seed=3), wide)
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(found.mean(), COVERAGE[COPPER], mean_error(found))


@pytest.mark.parametrize("slab", [COPPER, KAPTON, SECOND_COPPER])
@pytest.mark.parametrize("slope", [0.0, 0.3, 1.5, 6.0, 40.0])
def test_lines_agree_with_marching(slab: int, slope: float) -> None:
    given = lines(60, slope, seed=4)
    borders = 2 + 2 * slope * 0.05 / 0.07  # of holes, that a line crosses at most; each may be off by one step
    assert np.allclose(fraction(slab, given), marched(slab, given), atol=borders / 4000)


def test_marching_sees_a_wrong_cone() -> None:
    straight = BUILT.with_overrides({"cgem.L1.hole_inner": "70 um"})
    given = lines(60, 0.3, seed=4)
    assert not np.allclose(fraction(KAPTON, given, straight), marched(KAPTON, given), atol=0.01)


def test_a_track_at_normal_incidence_meets_all_copper_or_none() -> None:
    n = 40_000
    given = lines(n, 0.0, seed=5)
    first, kapton, second = (fraction(slab, given) for slab in (COPPER, KAPTON, SECOND_COPPER))
    assert set(np.unique(first)) == {0.0, 1.0}
    assert np.array_equal(first, second)
    # Kapton: none in the waist, all beside the hole, and between them a share that grows evenly with the distance.
    for found, area in ((kapton == 0, 0.025**2), (kapton < 0.5, 0.030**2), (kapton < 1, 0.035**2)):
        expected = math.pi * area / CELL
        assert_within(found.mean(), expected, fraction_error(expected, n), what=f"part below radius^2 {area}")
    assert np.all(kapton[first == 1] == 1)


def small(changes: dict[str, object] | None = None) -> Detector:
    """Return L1 and L2 alone."""
    bare = load({"base": "besiii-cgem", "remove": ["drift_chamber", "walls", "beam_pipe", "cgem.L3"]})
    return bare.with_overrides(changes or {})


def shoot(detector: Detector, settings: SimulateSettings, n: int = 10_000) -> Table:
    return simulate(detector, generate(Gun("proton", p=0.6, cos_theta=(-0.5, 0.5)), n, seed=2), settings, 7)["truths"]


def even(detector: Detector, copper: float, kapton: float) -> Detector:
    """Return a detector whose foils have these parts of their solid density."""

    def thin(part, share):
        full = part.material.solid()
        return dataclasses.replace(
            part, material=dataclasses.replace(full, density=full.density * share, x0=full.x0 / share)
        )

    layers = [
        dataclasses.replace(layer, foil=tuple(map(thin, layer.foil, (copper, kapton, copper))))
        for layer in detector.cgem
    ]
    return dataclasses.replace(detector, cgem=tuple(layers))


def lost(detector: Detector, settings: SimulateSettings) -> np.ndarray:
    """Return the energy (MeV) that protons lose between the gaps of the two layers."""
    truths = shoot(detector, settings)
    energy = np.sqrt(truths["px"] ** 2 + truths["py"] ** 2 + truths["pz"] ** 2 + 0.938272**2)
    both = np.intersect1d(truths["event"][truths["layer"] == 0], truths["event"][truths["layer"] == 1])
    before, after = (energy[(truths["layer"] == i) & np.isin(truths["event"], both)] for i in (0, 1))
    return 1e3 * (before - after)


def test_mean_loss_is_that_of_the_matter_spread_evenly() -> None:
    lattice = lost(small(), SimulateSettings(foil="lattice"))
    spread = lost(even(small(), COVERAGE[COPPER], COVERAGE[KAPTON]), SimulateSettings())
    error = math.hypot(mean_error(lattice), mean_error(spread))
    assert_within(lattice.mean(), spread.mean(), error, what="mean loss")
    solid = lost(even(small(), 1.0, 1.0), SimulateSettings())
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(lattice.mean(), solid.mean(), error)


def test_holes_spread_the_loss() -> None:
    lattice = lost(small(), SimulateSettings(foil="lattice"))
    spread = lost(even(small(), COVERAGE[COPPER], COVERAGE[KAPTON]), SimulateSettings())
    widths = [np.diff(np.quantile(x, [0.16, 0.84]))[0] for x in (lattice, spread)]
    assert widths[0] > 1.02 * widths[1]


def test_foils_without_holes_give_the_same_as_even_ones() -> None:
    # Holes of 1 um are met by one track in ten thousand.
    changes = {f"cgem.{label}.hole_{side}": "1 um" for label in ("L1", "L2") for side in ("outer", "inner")}
    solid = even(small(changes), 1.0, 1.0)
    lattice, effective = (
        shoot(solid, SimulateSettings(sublayers=True, foil=foil), 500) for foil in ("lattice", "effective")
    )
    assert len(lattice) == len(effective)
    # Foils with holes are simulated one by one, even ones in lanes: equal but for rounding.
    assert np.mean(np.isclose(lattice["phi"], effective["phi"], rtol=0, atol=1e-12)) > 0.98


def test_other_slabs_keep_their_random_numbers() -> None:
    found = slabs(BUILT, foil="lattice")
    groups = [slab.shells[0].group for slab in found]
    place = hole_table([slab.holes for slab in found], groups, merge=True)["place"]
    merged = [slab.shells[0].group for slab in slabs(BUILT)]
    others = [(int(number), group) for number, group in zip(place, groups, strict=True) if group != "foils"]
    assert others == [(i, group) for i, group in enumerate(merged) if group != "foils"]
    assert len(set(place.tolist())) == len(found)


def test_foils_of_a_lattice_are_solid() -> None:
    found = [slab for slab in slabs(BUILT, foil="lattice") if slab.holes]
    assert len(found) == 3 * 3 * 3
    assert [slab.shells[0].material.density for slab in found[:3]] == pytest.approx([8.96, 1.42, 8.96])
    assert [slab.shells[0].material.x0 for slab in found[:3]] == pytest.approx([14.35, 284.1, 14.35])
    assert [slab.holes.foil for slab in found[::3]] == list(range(9))
    assert {round(slab.holes.end - slab.holes.begin, 9) for slab in found} == {0.005, 0.05}


def test_wrong_holes_are_reported_together() -> None:
    with pytest.raises(DetectorError) as caught:
        load({"base": "besiii-cgem", "cgem": {"L1": {"hole_outer": "140 um", "hole_inner": "150 um"}}})
    assert {problem.path for problem in caught.value.problems} == {"cgem.L1.hole_outer", "cgem.L1.hole_inner"}


def test_diluted_material_knows_its_solid_also_from_a_file(tmp_path) -> None:
    own = {"base": "besiii-cgem", "materials": {"Mesh": {"base": "CuFoil", "density": "2 g/cm3"}}}
    foil = [{"material": "Mesh", "thickness": "5 um"}, {"material": "KaptonFoil", "thickness": "50 um"}]
    detector = load(own | {"cgem": {"L1": {"foil": foil}}})
    path = tmp_path / "own.toml"
    path.write_text(detector.to_toml())
    assert load(path) == detector
    solid = load(path).cgem[0].foil[0].material.solid()
    assert (solid.density, solid.x0, solid.filling) == pytest.approx((8.96, 14.35, 1.0))


@pytest.mark.parametrize("wrong", [{"foil": "holes"}, {"foil": "lattice", "fluctuations": "gaussian"}])
def test_settings_that_do_not_exist(wrong: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="SimulateSettings: 1 problem\n  foil: "):
        SimulateSettings(**wrong)
