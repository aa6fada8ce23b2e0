"""Positions and errors of clusters with charge against a few lines of numpy, and the errors that are expected."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import pytest

import cgemit as cg
from cgemit.detector.gas import cluster_shares, clusters_per_mm, drift_columns
from cgemit.detector.readouts import AnalogReadout
from cgemit.reconstruction.cluster import cluster
from cgemit.reconstruction.cluster_errors import ChipErrors, chip_errors, error_inputs, errors_of, expected_errors
from charge_clusters import expected_cluster

Floats = npt.NDArray[np.float64]

DESIGN = cg.load("besiii-cgem-design")
L1 = DESIGN.cgem[0]
TIGER, APV25 = cg.TigerReadout(), cg.Apv25Readout()
EARLIEST = L1.r_mid / 299.792458 + float(drift_columns(DESIGN)["delay"][0])  # ns


def digis_of(strips: Floats, charge: Floats, time: Floats, view: int = 0) -> cg.Table:
    """Return digis of strips of the first layer."""
    n = len(strips)
    gid = strips + view * L1.strips_x
    return cg.Table(
        "digis",
        {
            **{name: np.zeros(n, np.int32) for name in ("layer", "sheet")}, "event": np.zeros(n, np.int64),
            "view": np.full(n, view, np.int8), "strip": strips.astype(np.int32), "gid": gid.astype(np.int32),
            "position": np.full(n, np.nan), "charge": charge, "time": time, "truth": np.zeros(n, np.int64),
            "n_truths": np.ones(n, np.int32),
        },
        n_events=1,
    )  # fmt: skip


#: First strip, charges (fC) and times after the earliest electrons (ns).
CLUSTERS = {
    "slanted": (100, [4.0, 12.0, 9.0, 5.0], [110.0, 85.0, 70.0, 62.0]),
    "flat": (100, [3.0, 14.0, 2.5], [80.0, 78.0, 83.0]),
    "single": (140, [9.0], [85.0]),
    "weak": (140, [2.6], [95.0]),
    "wide": (60, [3.0, 8.0, 15.0, 22.0, 18.0, 7.0, 4.0], [150.0, 130.0, 120.0, 95.0, 90.0, 60.0, 66.0]),
}


@pytest.mark.parametrize("readout", [TIGER, APV25], ids=["tiger", "apv25"])
@pytest.mark.parametrize("how", ["centroid", "merged", "track"])
@pytest.mark.parametrize("name", CLUSTERS)
def test_a_cluster_by_hand(readout: AnalogReadout, how: str, name: str) -> None:
    """Position, error and time of X clusters that cross no V cluster, and with the slope of a track."""
    first, charge, time = CLUSTERS[name]
    strips, charges = first + np.arange(len(charge)), np.array(charge)
    times = EARLIEST + np.array(time)
    readout = dataclasses.replace(readout, estimator="centroid" if how == "centroid" else "merged")
    of_track = how == "track"
    slope, path = (0.35, 1.4) if of_track else (0.0, 1.0)
    place = (strips + 0.5) * L1.pitch_x
    directions = np.array([[slope, path]]) if of_track else None
    found = cluster(DESIGN, digis_of(strips, charges, times), readout=readout, directions=directions)
    expected = expected_cluster(DESIGN, readout, 0, 0, (place, charges, times), slope, path, of_track=of_track)
    assert len(found) == 1
    assert found["x"][0] == pytest.approx(expected.position, abs=1e-9)
    assert found["err_x"][0] == pytest.approx(expected.error, abs=1e-9)
    assert found["time"][0] == pytest.approx(expected.time, abs=1e-9)


def test_each_term_of_the_errors_counts_in_some_cluster() -> None:
    """The clusters above would show a mistake of 1 % in each term."""
    largest: dict[str, float] = {}
    for readout in (TIGER, APV25):
        for estimator in ("centroid", "merged"):
            for of_track in (False, True):
                changed = dataclasses.replace(readout, estimator=estimator)
                for first, charge, time in CLUSTERS.values():
                    place = (first + np.arange(len(charge)) + 0.5) * L1.pitch_x
                    strips = place, np.array(charge), EARLIEST + np.array(time)
                    found = expected_cluster(DESIGN, changed, 0, 0, strips, 0.35, 1.4, of_track=of_track)
                    for name, variance in found.variances.items():
                        largest[name] = max(largest.get(name, 0.0), variance)
    assert len(largest) == 10
    assert min(largest.values()) > 1e-6  # mm2: 0.01 of it moves errors of 0.1 mm by 5e-8 mm


def test_position_along_a_track_is_on_the_line_of_the_charge() -> None:
    """A track moves the position by its slope times the mean height of the charge, whatever its Lorentz angle."""
    first, charge, time = CLUSTERS["slanted"]
    strips, times = first + np.arange(4), EARLIEST + np.array(time)
    readout = dataclasses.replace(TIGER, lorentz=False)
    found, heights = [], []
    slopes = (-0.2, 0.3)
    for slope in slopes:
        directions = np.array([[slope, 1.0]])
        found.append(cluster(DESIGN, digis_of(strips, np.array(charge), times), readout=readout, directions=directions))
        drift = found[-1]["time"][0] - EARLIEST
        heights.append(L1.drift_gap / 2 - drift * float(drift_columns(DESIGN)["velocity"][0]))
    centroid = np.average((strips + 0.5) * L1.pitch_x, weights=charge)
    for one, slope, height in zip(found, slopes, heights, strict=True):
        assert one["x"][0] == pytest.approx(centroid - slope * height, abs=1e-9)
    assert abs(heights[0]) > 0.05


def test_shares_in_the_table_of_the_core() -> None:
    """Between its numbers and paths it is within 3 % of those of the gas."""
    table = error_inputs(DESIGN, TIGER).shares
    values = table["values"].reshape(3, len(table["paths"]), len(table["numbers"]))
    gas = cluster_shares(L1.gas.ionization)
    mean = float(clusters_per_mm(L1.gas, np.log([9.46]))[0]) * L1.drift_gap
    variance = (1 + 1 / (1 + TIGER.polya)) / TIGER.survival - 1
    random = np.random.default_rng(2)
    for path, number in zip(random.uniform(1, 3, 40), random.uniform(8, 300, 40), strict=True):
        found = np.interp(path, table["paths"], [np.interp(number, table["numbers"], row) for row in values[0]])
        assert found == pytest.approx(float(gas.shares(mean * path, np.array([number]), variance)[0]), rel=0.03)


@dataclass(frozen=True, kw_only=True)
class QuietTiger(cg.TigerReadout):
    """A TIGER with less noise and no factors of its own."""

    name: ClassVar[str] = "quiet-tiger"


@dataclass(frozen=True, kw_only=True)
class OwnFactors(AnalogReadout):
    """A chip with factors of its own."""

    name: ClassVar[str] = "own-factors"
    chip = TIGER.chip
    errors: ClassVar[ChipErrors] = dataclasses.replace(chip_errors("apv25"), diffusion=2.5)


@dataclass(frozen=True, kw_only=True)
class NoFactors(AnalogReadout):
    """A chip without."""

    name: ClassVar[str] = "no-factors"
    chip = TIGER.chip


def test_factors_of_a_readout() -> None:
    """Its own, or those of the one of the package that it extends; another one is refused."""
    assert errors_of(TIGER) == chip_errors("tiger") != chip_errors("apv25")
    assert errors_of(QuietTiger()) == chip_errors("tiger")
    assert errors_of(OwnFactors()).diffusion == 2.5
    assert error_inputs(DESIGN, OwnFactors()).chip["diffusion"] == 2.5
    with pytest.raises(ValueError, match="got readout 'no-factors', expected one of tiger, apv25"):
        error_inputs(DESIGN, NoFactors())


WAYS = [("merged", True), ("merged", False), ("micro-tpc", False), ("centroid", False)]


def with_pitch(pitch: float) -> cg.Detector:
    """Return the detector with other strips of one stereo angle, which else would have whole numbers of strips."""
    pitches = {f"cgem.L2.pitch_{view}": f"{pitch!r} mm" for view in "xv"}
    return DESIGN.with_overrides(pitches | {"cgem.L2.stereo": "-31.1 deg"})


def errors_at(detector: cg.Detector, readout: AnalogReadout, way: tuple[str, bool]) -> Floats:
    """Return the errors of the second layer in both views and at all angles."""
    found = expected_errors(detector, readout, *way)
    return np.concatenate([found.sigma_x[1], found.sigma_v[1]])


@pytest.mark.parametrize("readout", [TIGER, APV25], ids=["tiger", "apv25"])
@pytest.mark.parametrize("way", WAYS, ids=lambda way: "-".join(map(str, way)))
def test_expected_errors_follow_gain_and_pitch(readout: AnalogReadout, way: tuple[str, bool]) -> None:
    """They fall with the gain and grow with the pitch, without jumps; derivatives are those of any small step.

    Centroids of wider strips lose less charge below the threshold, which outweighs the width at some angles.
    """
    gains = readout.gain * 1.02 ** np.arange(-12, 13)
    by_gain = np.array([errors_at(DESIGN, dataclasses.replace(readout, gain=float(gain)), way) for gain in gains])
    steps = np.diff(np.log(by_gain), axis=0)
    assert (steps < 0).all()
    assert steps.min() > -0.1
    pitches = 0.5 * 1.02 ** np.arange(26)
    by_pitch = np.array([errors_at(with_pitch(float(pitch)), readout, way) for pitch in pitches])
    steps = np.diff(np.log(by_pitch), axis=0)
    assert steps.min() > (-0.004 if way[0] == "centroid" else 0.0)
    assert steps.max() < 0.1
    for of in (
        lambda factor: errors_at(DESIGN, dataclasses.replace(readout, gain=readout.gain * factor), way),
        lambda factor: errors_at(with_pitch(0.65 * factor), readout, way),
    ):
        slopes = [np.log(of(1 + step) / of(1 - step)) / (2 * step) for step in (0.01, 0.001)]
        np.testing.assert_allclose(slopes[0], slopes[1], rtol=0.05, atol=0.005)
