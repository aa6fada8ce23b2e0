"""Mille records: their bytes, and the normal equations that they hold."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit.calibration.mille import MilleRecord, read_mille

NOMINAL = cg.load("besiii-cgem-design").with_readout("gaussian")
SETTINGS = cg.AlignmentSettings(free=("cgem.*",), priors=("cgem.*.shift_z=200 um",))


def normal(records: Iterable[MilleRecord], constants: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return N and b, with the local parameters of each record eliminated."""
    total, right = np.zeros((constants, constants)), np.zeros(constants)
    for one in records:
        locals_ = sorted({label for row in one.local for label in row})
        h, a = np.zeros((len(one.residual), len(locals_))), np.zeros((len(one.residual), constants))
        for i, (local, globals_) in enumerate(zip(one.local, one.global_, strict=True)):
            for label, value in local.items():
                h[i, locals_.index(label)] = value
            for label, value in globals_.items():
                a[i, label - 1] = value
        h, a, r = h / one.error[:, None], a / one.error[:, None], one.residual / one.error
        a -= h @ np.linalg.lstsq(h, a, rcond=None)[0]
        total += a.T @ a
        right += a.T @ r
    return total, right


@pytest.fixture(scope="module")
def run() -> cg.Result:
    real = NOMINAL.misaligned(seed=2, sizes={"cgem.*": ("100 um", "0.5 mrad")})
    return cg.run(real, cg.sample("cosmic"), n=60, seed=5, fit_detector=NOMINAL)


def test_records_hold_the_normal_equations(run: cg.Result, tmp_path: Path) -> None:
    """Those of `align`: halves of muons joined, surveys beside the records."""
    found = cg.write_mille(tmp_path / "mille.bin", run, SETTINGS)
    total, right = normal(read_mille(tmp_path / "mille.bin"), 18)
    survey = np.diag(np.where(np.isfinite(found.prior), 1 / found.prior**2, 0))
    scale = 1 / np.sqrt(found.measured)
    np.testing.assert_allclose(
        (total + survey) * np.outer(scale, scale), found.information * np.outer(scale, scale), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.solve(total + survey, right), found.value, rtol=1e-7, atol=1e-9)
    steering = (tmp_path / "mille.txt").read_text()
    assert "* 3 cgem.L1.shift_z [mm]" in steering
    assert "Measurement 0.0 0.2 ! survey\n3 1.0\n" in steering


def test_zero_modes_are_constraints_of_the_steering_file(run: cg.Result, tmp_path: Path) -> None:
    settings = cg.AlignmentSettings(free=("cgem.*.shift_z", "drift_chamber.shift_z"))
    found = cg.write_mille(tmp_path / "mille.bin", run, settings)
    assert found.zero_modes == ("common shift_z",)
    assert "Constraint 0.0 ! common shift_z" in (tmp_path / "mille.txt").read_text()


def test_the_bytes_of_a_record(tmp_path: Path) -> None:
    """A file written by hand as Mille.cc of Millepede-II writes it, in single and in double precision."""
    values, labels = (0.0, 0.5, 1.0, 2.0, 0.1, -1.5), (0, 0, 1, 2, 0, 7)  # r, two local ones, sigma, one global one
    single = struct.pack("<i6f6i", 12, *values, *labels)
    double = struct.pack("<i6d6i", -12, *values, *labels)
    path = tmp_path / "mille.bin"
    path.write_bytes(single + double)
    for one in read_mille(path):
        assert one.residual.tolist() == [0.5]
        assert one.error[0] == pytest.approx(0.1)
        assert one.local == ({1: 1.0, 2: 2.0},)
        assert one.global_ == ({7: -1.5},)
    for cut in (2, 30, len(single) + 9):
        path.write_bytes((single + double)[:cut])
        with pytest.raises(ValueError, match="record"):
            list(read_mille(path))
    path.write_bytes(struct.pack("<i3f3i", 6, 0.0, 0.5, 1.0, 0, 0, 1))  # no error
    with pytest.raises(ValueError, match="pairs"):
        list(read_mille(path))


def test_files_are_not_overwritten(run: cg.Result, tmp_path: Path) -> None:
    (tmp_path / "mille.bin").write_text("mine")
    with pytest.raises(FileExistsError):
        cg.write_mille(tmp_path / "mille.bin", run, SETTINGS)


def steered(path: Path) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the information of the surveys of a steering file, (n,), and its constraints, (constraints, n)."""
    lines = path.read_text().splitlines()
    constants = sum(line.startswith("* ") for line in lines) - 1
    survey, constraints = np.zeros(constants), list[npt.NDArray[np.float64]]()
    error = None
    for line in lines:
        words = line.split()
        if words[0] == "Measurement":
            assert float(words[1]) == 0
            error = float(words[2])
        elif words[0] == "Constraint":
            assert float(words[1]) == 0
            constraints.append(np.zeros(constants))
            error = None
        elif words[0].isdigit() and error is not None:
            assert float(words[1]) == 1
            survey[int(words[0]) - 1] = 1 / error**2
        elif words[0].isdigit():
            constraints[-1][int(words[0]) - 1] = float(words[1])
    return survey, np.array(constraints).reshape(-1, constants)


@pytest.mark.parametrize("case", ["surveys", "zero_modes"])
def test_pede_finds_the_same(case: str) -> None:
    """pages/reference/pede: what pede printed for records and steering files of `write_mille`."""
    folder = Path(__file__).parents[3] / "pages" / "reference" / "pede"
    survey, constraints = steered(folder / f"{case}.txt")
    total, right = normal(read_mille(folder / f"{case}.bin"), len(survey))
    scale = np.concatenate([1 / np.sqrt(np.diagonal(total)), np.ones(len(constraints))])
    none = np.zeros((len(constraints), len(constraints)))
    bordered = np.block([[total + np.diag(survey), constraints.T], [constraints, none]]) * np.outer(scale, scale)
    inverse = np.linalg.inv(bordered) * np.outer(scale, scale)
    value = inverse[: len(survey), : len(survey)] @ right
    error = np.sqrt(np.diagonal(inverse)[: len(survey)])
    printed = np.array([line.split() for line in (folder / f"{case}.res").read_text().splitlines()[1:]], float)
    np.testing.assert_array_equal(printed[:, 0], np.arange(1, len(survey) + 1))
    assert np.abs((value - printed[:, 1]) / error).max() < 1e-3
    np.testing.assert_allclose(error, printed[:, 4], rtol=1e-3)
