"""Alignment from tables: names and patterns, starts, zero modes, input that is refused, what is written and read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import cgemit as cg
from cgemit.reconstruction.finders import HIT_FINDERS, HitFinder

NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")
MUONS = cg.Gun("mu-", p=(0.4, 1.5), cos_theta=(-0.8, 0.8))


def run_of(real: cg.Detector, n: int = 400, seed: int = 5, gun: object = MUONS, finder: str = "truth") -> cg.Result:
    settings = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
    return cg.run(real, gun, n=n, seed=seed, fit_detector=NOMINAL, settings=settings, finder=finder)


@pytest.fixture(scope="module")
def real() -> cg.Detector:
    return NOMINAL.misaligned(seed=2, sizes={"cgem.*": ("100 um", "0.5 mrad")})


@pytest.fixture(scope="module")
def run(real: cg.Detector) -> cg.Result:
    return run_of(real)


@pytest.fixture(scope="module")
def found(run: cg.Result) -> cg.Alignment:
    return cg.align(run)


def test_displacements_are_found(found: cg.Alignment, real: cg.Detector) -> None:
    pulls = found.compare(real)
    assert found.converged
    assert len(found.history) <= 4
    assert found.p_value < 1e-6
    assert np.abs(pulls).max() < 4
    assert 0.5 < np.sqrt(np.mean(pulls**2)) < 1.6
    assert np.abs(found.compare(NOMINAL)).max() > 10  # the description is not what was simulated
    again = cg.align(run_of(real), detector=found.detector)
    assert again.history[0].step < 0.1
    assert again.p_value > 1e-6


def test_alignment_of_the_right_description_finds_nothing() -> None:
    found = cg.align(run_of(NOMINAL, n=200))
    assert found.p_value > 1e-3
    assert np.abs(found.compare(NOMINAL)).max() < 4


def test_tracks_of_any_registered_finder_are_found_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A finder by another name than ``ckf`` sees the hits of every turn, with the hypothesis of the run."""
    seen: list[tuple[float, str | None]] = []

    def few(detector, clusters, wire_hits, settings=None, *, fit=None):
        seen.append((float(clusters["x"].mean()), settings and settings.hypothesis))
        return cg.find_tracks(detector, clusters, wire_hits, settings, fit=fit)

    few.unchecked = few  # type: ignore[attr-defined]
    run = run_of(NOMINAL.with_alignment({"cgem.L1.shift_x": 0.5}), n=60, finder=few)
    monkeypatch.setitem(HIT_FINDERS, "few", HitFinder("few", few, cg.FindSettings, "find"))
    seen.clear()
    aligned = cg.align(run, cg.AlignmentSettings(free=("cgem.L1.shift_x",)))
    assert len(seen) >= len(aligned.history)
    assert {hypothesis for _, hypothesis in seen} == {"mu"}


@pytest.mark.parametrize("finder", ["truth", "ckf"])
def test_starts_of_a_millimetre_converge(finder: str) -> None:
    """Shifts of 1 mm, rotations of 5 mrad, and tilts of nearly the 2 mrad that a description may have."""
    values = {
        "cgem.L1.shift_x": 1.0, "cgem.L2.shift_y": -1.0, "cgem.L3.shift_z": 1.0, "cgem.L1.rotation": 5e-3,
        "cgem.L2.rotation": -5e-3, "cgem.L3.tilt_x": 1.9e-3, "cgem.L1.tilt_y": -1.9e-3,
    }  # fmt: skip
    real = NOMINAL.with_alignment(values)
    found = cg.align(run_of(real, n=300, finder=finder))
    assert found.converged
    assert len(found.history) <= 5
    assert np.abs(found.compare(real)).max() < 4.5


def test_result_of_tables_is_that_of_the_run(run: cg.Result, found: cg.Alignment) -> None:
    tables = {name: run.tables[name] for name in ("clusters", "wire_hits", "candidates", "candidate_hits")}
    other = cg.align(tables, detector=NOMINAL, fit=cg.FitSettings(momentum=1.0))
    np.testing.assert_allclose(other.table.value, found.table.value, atol=1e-4)


def test_patterns_fix_and_free(run: cg.Result) -> None:
    settings = cg.AlignmentSettings(free=("cgem.*.shift_x", "cgem.L2"), fixed=("cgem.L2.tilt_*",))
    found = cg.align(run, settings)
    free = [name for name, status in zip(found.table.name, found.table.status, strict=True) if status == "free"]
    assert free == [
        "cgem.L1.shift_x", "cgem.L2.shift_x", "cgem.L2.shift_y", "cgem.L2.shift_z", "cgem.L2.rotation",
        "cgem.L3.shift_x",
    ]  # fmt: skip
    assert found.table.status.count("fixed") == 2


def test_survey_holds_a_constant(run: cg.Result, found: cg.Alignment) -> None:
    """The shift along z, which stereo wires tell to 0.2 mm, is held by a survey of 1 um, and its error is that."""
    held = cg.align(run, cg.AlignmentSettings(priors=("cgem.*.shift_z=1 um",)))
    row = held.table.name.index("cgem.L1.shift_z")
    assert abs(held.table.value[row]) < 3e-3
    assert held.table.err[row] == pytest.approx(1e-3, rel=0.02)
    assert found.table.err[row] > 0.05
    assert held.table.prior[row] == 1e-3


def test_common_displacements_are_named_and_get_no_number(run: cg.Result) -> None:
    """With the chamber free, too, tracks see neither common shifts nor a common rotation."""
    # 400 tracks tell common tilts to no better than their range.
    everything, tilts = ("cgem.*", "drift_chamber"), ("drift_chamber.tilt_*",)
    found = cg.align(run, cg.AlignmentSettings(free=everything, fixed=tilts))
    assert set(found.zero_modes) == {"common shift_x", "common shift_y", "common shift_z", "common rotation"}
    for name, value, status in zip(found.table.name, found.table.value, found.table.status, strict=True):
        tilt = ".tilt" in name
        if name.startswith("drift_chamber") and tilt:
            continue
        assert status == ("free" if tilt else "undetermined"), name
        assert np.isfinite(value) == tilt
    held = cg.align(run, cg.AlignmentSettings(free=everything, fixed=tilts, zero_modes="constrained"))
    assert np.isfinite(held.table.value).all()
    assert {"constrained", "free", "fixed"} == set(held.table.status)
    surveyed = cg.align(run, cg.AlignmentSettings(free=everything, fixed=tilts, priors=_SURVEY))
    assert surveyed.zero_modes == ()
    assert set(surveyed.table.status) == {"free", "fixed"}


_SURVEY = tuple(
    f"drift_chamber.{key}={error}"
    for key, error in (("shift_x", "10 um"), ("shift_y", "10 um"), ("shift_z", "10 um"), ("rotation", "0.1 mrad"))
)


def test_lorentz_shift_is_a_rotation_of_its_layer(run: cg.Result) -> None:
    found = cg.align(run, cg.AlignmentSettings(calibrate=("lorentz", "field")))
    assert set(found.zero_modes) == {*(f"Lorentz shift and rotation of L{i}" for i in (1, 2, 3)), "field.scale"}
    fixed = cg.align(run, cg.AlignmentSettings(calibrate=("lorentz",), fixed=("cgem.*.rotation",)))
    assert fixed.zero_modes == ()


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_a_lorentz_shift_is_found(readout: str) -> None:
    real = NOMINAL.with_readout(readout).with_overrides({"cgem.L2.lorentz_shift": "200 um"})
    nominal = NOMINAL.with_readout(readout)
    run = cg.run(real, MUONS, n=300, fit_detector=nominal, seed=8)
    settings = cg.AlignmentSettings(free=("cgem.*.shift_x",), calibrate=("lorentz",))
    found = cg.align(run, settings)
    row = found.table.name.index("cgem.L2.lorentz_shift")
    assert abs(found.table.value[row] - 0.2) < 4 * found.table.err[row]
    assert found.table.err[row] < 0.02


def test_table_is_written_and_read_exactly(found: cg.Alignment, tmp_path: Path) -> None:
    path = tmp_path / "alignment.csv"
    found.table.save(path)
    read = cg.AlignmentTable.load(path)
    for name, column in found.table.columns().items():
        if name in ("name", "unit", "status"):
            assert getattr(read, name) == column
        else:
            np.testing.assert_array_equal(getattr(read, name), column)
    assert NOMINAL.with_alignment(path) == NOMINAL.with_alignment(found.table)
    assert found.detector.cgem["L1"].shift_x == pytest.approx(found.table.value[0], rel=1e-12)
    path.write_text(path.read_text().replace("free", "gone", 1))
    with pytest.raises(cg.DetectorError, match="line 2: status"):
        NOMINAL.with_alignment(path)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"free": ("cgem.L9",)}, "free: got 'cgem.L9'"),
        ({"fixed": ("nothing",)}, "fixed: got 'nothing'"),
        ({"priors": ("cgem.*.shift_z: 1 um",)}, "priors"),
        ({"priors": ("cgem.*.shift_z=0 um",)}, "an error above 0"),
        ({"fixed": ("cgem.*",)}, "a constant that is left free"),
    ],
)
def test_wrong_settings_are_listed(changes: dict[str, tuple[str, ...]], expected: str, run: cg.Result) -> None:
    with pytest.raises(ValueError, match=expected):
        cg.align(run, cg.AlignmentSettings(**changes))


def test_runs_that_share_random_numbers_are_refused(run: cg.Result, real: cg.Detector) -> None:
    with pytest.raises(ValueError, match=r"runs\[1\].*another seed"):
        cg.align([run, run])
    other = run_of(real, n=50, seed=6)
    assert cg.align([run, other]).history[0].tracks == 450


def test_runs_without_tracks_are_refused(run: cg.Result) -> None:
    with pytest.raises(ValueError, match=r"candidates") as error:
        cg.align([{"clusters": run.clusters}, 3])
    assert "runs[1]" in str(error.value)
    few = run.select_events(0, 10)
    with pytest.raises(ValueError, match="expected more than the 18 constants"):
        cg.align(few)
