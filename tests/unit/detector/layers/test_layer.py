"""One list of layers by radius, and views of it by kind and label; keys of kinds."""

import pytest

from cgemit import load
from cgemit.detector import DetectorError
from cgemit.detector.keys import keys_of
from cgemit.detector.layers import CgemLayer, MeasurementLayer
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.detector.parts import cgem_layers, cgem_numbers

DESIGN = load("besiii-cgem-design")
SENSORS = {
    "VTX": {"radius": "100 mm", "sigma": "10 um", "material": "Si"},
    "SHELL": {"radius": "60 mm", "material": "Al", "thickness": "1 mm"},
}


def with_sensors(**more):
    return load({"base": "besiii-cgem-design", "name": "mixed", "layer": {**SENSORS, **more}})


def test_layers_of_all_kinds_are_one_list():
    """By radius; a layer of matter alone makes no clusters, and has no number."""
    detector = with_sensors()
    assert [layer.label for layer in detector.barrels] == ["SHELL", "L1", "VTX", "L2", "L3"]
    assert [layer.label for layer in detector.layers] == ["L1", "VTX", "L2", "L3"]
    assert detector.layers["VTX"] is detector.layers[1] is detector.layer["VTX"]
    assert detector.layers["L2"] is detector.layers[2] is detector.cgem["L2"] is detector.cgem[1]
    assert [layer.label for layer in detector.layer] == ["SHELL", "VTX"]
    assert [(group, len(layers)) for group, layers in detector.by_kind()] == [("cgem", 3), ("layer", 2)]
    assert cgem_numbers(detector) == (0, 2, 3)
    assert cgem_layers(detector, (2,)) == (detector.cgem["L2"],)
    with pytest.raises(KeyError, match="L1, VTX, L2, L3"):
        detector.layers["SHELL"]


def test_wires_are_the_layers_of_the_chamber():
    assert DESIGN.wires == DESIGN.drift_chamber.layers
    assert DESIGN.with_overrides({"remove": ["drift_chamber"]}).wires == ()


def test_a_label_is_that_of_one_layer():
    """Otherwise `layers["L2"]` and results by label would be either of two."""
    with pytest.raises(DetectorError, match=r'cgem\.L2: got the label "L2", which layer\.L2 has'):
        with_sensors(L2=SENSORS["VTX"])


def test_a_sensor_about_the_beam_line_is_one_problem():
    """It overlaps with nothing: where it is follows from the same mistake."""
    with pytest.raises(DetectorError) as error:
        with_sensors(VTX=SENSORS["VTX"] | {"radius": "6 mm", "thickness": "30 mm"})
    assert [problem.path for problem in error.value.problems] == ["layer.VTX.thickness"]


def test_keys_stand_where_a_kind_states_them():
    """Files and hashes have this order, although `Layer` has some of the fields before."""
    names = list(keys_of(CgemLayer))
    assert names[: len(PLACEMENT)] == list(PLACEMENT)
    assert names[6:9] == ["anode_radius", "readout_offset", "length"]
    assert names[-2:] == ["readout", "efficiency"]
    assert not {"label", "gas", "sheets"} & keys_of(MeasurementLayer).keys()
