"""The layers of a detector in groups that are read out alike."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pytest

from cgemit import GaussianReadout, load, register_readout
from cgemit.detector import Detector, DetectorError
from cgemit.detector.gas import drift_columns
from cgemit.detector.induction import induced_charges
from cgemit.detector.readouts import READOUTS, PositionReadout, Readout
from cgemit.tables import Table

SENSOR = {"radius": "100 mm", "sigma": "10 um", "material": "Si"}


def with_sensor(**sensors: dict[str, Any]) -> Detector:
    """Return the CGEM layers L1 to L3 with sensors; one of 100 mm is between L1 and L2."""
    return load({"base": "besiii-cgem-design", "name": "mixed", "layer": sensors})


@pytest.mark.parametrize(
    ("detector", "expected"),
    [
        ("besiii-cgem-design", [("tiger", (0, 1, 2))]),
        ("besiii-pixel", [("positions", (0,)), ("tiger", (1, 2, 3))]),
        ("epic-like", [("positions", tuple(range(8)))]),
        ("besiii-idc", [("binary", ())]),
        (with_sensor(VTX=SENSOR), [("tiger", (0, 2, 3)), ("positions", (1,))]),
        (with_sensor(VTX=SENSOR, IN={**SENSOR, "radius": "50 mm"}), [("positions", (0, 2)), ("tiger", (1, 3, 4))]),
    ],
)
def test_groups_have_all_layers_by_their_readout(detector: str | Detector, expected: list[Any]) -> None:
    """CGEM layers have the given readout, sensors measure positions; groups come in the order of their first layer."""
    detector = load(detector).with_readout("tiger")
    groups = detector.groups
    assert [(group.readout.name, group.numbers) for group in groups] == expected
    for group in groups:
        assert [(number, layer.label) for number, layer in group.items()] == [
            (number, detector.layers[number].label) for number in group.numbers
        ]
        assert group.layers == tuple(layer for _, layer in group.items())
        assert group.cgem == (() if group.readout == PositionReadout() else tuple(detector.cgem))


def test_owns_tells_the_rows_of_the_group_and_refuses_other_layers() -> None:
    positions, strips = load("besiii-pixel").groups
    events = {"event": np.zeros(5, np.int64)}

    def table(*layers: int) -> Table:
        columns = {name: np.zeros(5, one.dtype) for name, one in Table.empty("truths", 1).columns.items()}
        return Table("truths", columns | events | {"layer": np.array(layers, np.int32)}, 1)

    assert positions.owns(table(0, 3, 1, 0, 2)).tolist() == [True, False, False, True, False]
    assert strips.owns(table(0, 3, 1, 0, 2)).tolist() == [False, True, True, False, True]
    for wrong in (4, -1):
        with pytest.raises(ValueError, match=f"truths row 2: layer: got {wrong}, expected .*, 0 to 3"):
            strips.owns(table(0, 3, wrong, 0, 2))


def test_values_of_a_group_become_those_of_all_layers() -> None:
    """By view and then layer, whatever each layer has; the others are NaN, or as asked for."""
    group, sensor = with_sensor(VTX=SENSOR).groups
    nan = np.nan
    np.testing.assert_equal(group.among_all(np.array([1.0, 2.0, 3.0])), [1, nan, 2, 3])
    np.testing.assert_equal(group.among_all(np.arange(6.0), 2), [0, nan, 1, 2, 3, nan, 4, 5])
    np.testing.assert_equal(group.among_all(np.arange(6.0)), [0, 1, nan, nan, 2, 3, 4, 5])
    np.testing.assert_equal(group.among_all(np.arange(6.0).reshape(3, 2), fill=7.0), [[0, 1], [7, 7], [2, 3], [4, 5]])
    np.testing.assert_equal(sensor.among_all(np.array([1.0])), [nan, 1, nan, nan])
    whole = np.arange(3.0)
    assert load("besiii-cgem-design").groups[0].among_all(whole) is whole


@dataclass(frozen=True, kw_only=True)
class Listed(Readout):
    """A readout that has no hash."""

    name: ClassVar[str] = "listed"

    thresholds: list[float] = field(default_factory=list)


def test_groups_are_equal_by_value_and_have_a_hash() -> None:
    """They are keys of caches, also of a readout without a hash."""
    register_readout(Listed)
    try:
        readouts = (Listed(thresholds=[value]) for value in (1.0, 2.0, 1.0))
        one, other, same = (load("besiii-pixel").with_readout(readout).groups[1] for readout in readouts)
    finally:
        del READOUTS[Listed.name]
    assert (one == same, one == other, hash(one) == hash(same)) == (True, False, True)


def test_tables_of_some_cgem_layers_are_their_rows_among_all() -> None:
    """Numbers are those among all layers of the detector."""
    detector = with_sensor(VTX=SENSOR)  # L1, VTX, L2, L3
    for name, column in drift_columns(detector).items():
        assert np.array_equal(drift_columns(detector, (0, 3))[name], column[[0, 2]])
    (all_planes, reach), (planes, same) = (induced_charges(detector, 1.0, True, some) for some in (None, (0, 2, 3)))
    assert (reach, all_planes.tolist()) == (same, planes.tolist())


def test_a_cgem_layer_takes_no_readout_of_sensors() -> None:
    """Nothing states the errors of its positions; the Gaussian readout does."""
    detector = load("besiii-cgem-design")
    layer = dataclasses.replace(detector.cgem["L2"], readout=PositionReadout())
    with pytest.raises(DetectorError, match=r"cgem\.L2\.readout: got positions, expected one of binary, gaussian"):
        dataclasses.replace(detector, barrels=(layer,))
    readout = GaussianReadout(sigma_x=0.2, sigma_v=0.3)
    assert readout.precision(layer.precision) == (0.2, 0.3, 0.0)
    assert layer.errors == pytest.approx((layer.pitch_x / np.sqrt(12), layer.pitch_v / np.sqrt(12)))


def test_a_sensor_measures_as_its_file_says() -> None:
    """Without an error it measures the middle of a strip, with the error pitch/sqrt(12)."""
    keys = {"radius": "100 mm", "material": "Si", "sigma_x": "10 um", "pitch_v": "1 mm", "efficiency": 0.9}
    sensor = with_sensor(VTX={**keys, "sigma_time": "2 ns"}).layer["VTX"]
    assert PositionReadout().precision(sensor.precision) == (0.01, 0.0, 2.0)
    assert sensor.errors == pytest.approx((0.01, 1 / np.sqrt(12)))
