"""Charge that strips induce on their neighbours at random (`apv25`): functions, rates, charges and times."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.reconstruction.cluster_errors import CalibrationError, calibration_of, key_of
from cgemit.tables import Table

DESIGN = cg.load("besiii-cgem-design")
STRAIGHT = DESIGN.with_overrides({"field.bz": "1 mT"})
OFF = cg.Apv25Readout(gain=30_000.0, diffusion=0.0)  # hardly any field, no diffusion: few strips with much charge
ON = dataclasses.replace(OFF, random_neighbours=True)
MUONS = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6))


def digis_of(readout: cg.Apv25Readout, n: int = 400, **options: int) -> Table:
    return cg.run(STRAIGHT, MUONS, n, seed=4, readout=readout, until="digitize", **options).digis


@pytest.fixture(scope="module")
def digis() -> tuple[Table, Table]:
    """Return the digis of the same electrons, without and with induced charge."""
    return digis_of(OFF), digis_of(ON)


def keys(table: Table) -> np.ndarray:
    """Return one number per digi, one apart for neighbours of one view of a sheet, and far for others."""
    gap = 10_000
    view = ((table["event"] * 8 + table["layer"]) * 2 + table["sheet"]) * 2 + table["view"]
    return np.asarray(view * gap + table["strip"])


def strips(table: Table) -> np.ndarray:
    """Return the number of strips of the view of each digi."""
    x, v = (np.array([getattr(layer, f"strips_{view}") for layer in DESIGN.cgem]) for view in "xv")
    return np.where(table["view"] == 0, x[table["layer"]], v[table["layer"]])


@pytest.mark.parametrize(
    ("charge", "probability", "share", "delay"),
    [
        # By hand, q = 900: -9.428 + 95.67 - 169.371 + 146.8935 - 35.947719 = 27.816781
        (30.0, 0.27816781, (math.exp(1.82236) + math.exp(1.1153) + math.exp(-15.068)) / 100, -20.640953),
        # q = 300: -9.428 + 31.89 - 18.819 + 5.4405 - 0.443799 = 8.639701
        (10.0, 0.08639701, (math.exp(1.51612) + math.exp(2.6291) + math.exp(0.766)) / 100, -15.079739),
        (1.0, 0.0, 0.5, -6.88981974),  # -6.4 %, and more than half
        (60.0, 1.0, (math.exp(2.28172) + math.exp(-1.1554) + math.exp(-38.819)) / 100, None),
    ],
)
def test_functions(charge: float, probability: float, share: float, delay: float | None) -> None:
    found = _core._testing.induced_by(charge)
    assert found[0] == pytest.approx(probability, abs=1e-9)
    assert found[1] == pytest.approx(share, rel=1e-9)
    if delay is not None:
        assert found[2] == pytest.approx(delay, abs=1e-6)


def test_rows(digis: tuple[Table, Table]) -> None:
    """Strips stay, in order, with their times; they gain charge up to saturation, and neighbours get digis."""
    off, on = digis
    before, after = keys(off), keys(on)
    assert (np.diff(on["event"]) >= 0).all()
    order = np.lexsort((on["strip"], on["view"], on["sheet"], on["layer"], on["event"]))
    np.testing.assert_array_equal(order, np.arange(len(on)))
    old = np.isin(after, before)
    np.testing.assert_array_equal(after[old], before)
    for name in ("time", "truth", "gid", "n_truths"):
        np.testing.assert_array_equal(on[name][old], off[name])
    gain = on["charge"][old] - off["charge"]
    assert gain.min() == 0
    assert 0.1 < np.mean(gain > 0) < 0.9
    assert on["charge"].max() == ON.saturation
    assert 0.02 < np.mean(~old) < 0.5
    assert (np.isin(after[~old] - 1, before) | np.isin(after[~old] + 1, before)).all()
    threshold = np.array([ON.threshold_x, ON.threshold_v])[on["view"][~old]]
    assert (on["charge"][~old] > threshold).all()
    assert ((on["strip"] >= 0) & (on["strip"] < strips(on))).all()


def test_rate_charge_and_time_of_new_strips(digis: tuple[Table, Table]) -> None:
    """Beside the last strips of clusters, with charge enough: the share of the charge, at a random time before."""
    off, on = digis
    before, after = keys(off), keys(on)
    for side in (-1, 1):
        alone = ~np.isin(before + side, before) & ~np.isin(before + 2 * side, before)
        inside = (off["strip"] > 0) & (off["strip"] < strips(off) - 1)
        sources = np.flatnonzero(alone & inside & (off["charge"] > 12))
        charge = off["charge"][sources]
        probability, share, delay = np.array([_core._testing.induced_by(one) for one in charge]).T
        place = np.searchsorted(after, before[sources] + side)
        there = after[np.minimum(place, len(after) - 1)] == before[sources] + side
        spread = math.sqrt(np.sum(probability * (1 - probability)))
        assert len(sources) > 500
        assert abs(np.count_nonzero(there) - probability.sum()) < 4 * spread
        rows = place[there]
        np.testing.assert_allclose(on["charge"][rows], (share * charge)[there], rtol=1e-12)
        pull = (on["time"][rows] - off["time"][sources[there]] - delay[there]) / 30
        assert abs(pull.mean()) < 4 / math.sqrt(len(pull))
        assert abs(pull.std() - 1) < 4 / math.sqrt(2 * len(pull))
        np.testing.assert_array_equal(on["truth"][rows], off["truth"][sources[there]])


def test_both_sides_and_strips_are_independent(digis: tuple[Table, Table]) -> None:
    off, on = digis
    before, after = keys(off), keys(on)
    single = ~np.isin(before - 1, before) & ~np.isin(before + 1, before) & (off["charge"] > 12)
    single &= ~np.isin(before - 2, before) & ~np.isin(before + 2, before)
    left, right = (np.isin(before[single] + side, after) for side in (-1, 1))
    probability = np.array([_core._testing.induced_by(one)[0] for one in off["charge"][single]])
    expected = probability**2
    assert abs(np.count_nonzero(left & right) - expected.sum()) < 4 * math.sqrt(expected.sum()) + 1


def test_any_chunks_give_the_same_bytes() -> None:
    one, other = digis_of(ON, 60), digis_of(ON, 60, chunk=7, threads=2)
    for name in one.columns:
        assert one[name].tobytes() == other[name].tobytes(), name


def test_calibration_belongs_to_the_setting() -> None:
    """Without it calibrations stay valid, with it they need to be made."""
    default = cg.Apv25Readout()
    on = dataclasses.replace(default, random_neighbours=True)
    assert key_of(DESIGN, default) != key_of(DESIGN, on)
    assert calibration_of(DESIGN, default).about.startswith("apv25, besiii-cgem-design")
    with pytest.raises(CalibrationError, match="cgemit readout --readout NAME"):
        calibration_of(DESIGN, on)


def test_setting_by_name() -> None:
    def chosen(name: str) -> object:
        changes = {"digitize.readout.name": name, "digitize.readout.random_neighbours": True}
        return cg.Settings().with_overrides(changes).digitize.readout

    assert chosen("apv25") == dataclasses.replace(cg.Apv25Readout(), random_neighbours=True)
    with pytest.raises(ValueError, match="random_neighbours"):
        chosen("tiger")
