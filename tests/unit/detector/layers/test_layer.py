"""One list of layers by radius, and views of it by kind and label; keys of kinds."""

import math
import tomllib
from dataclasses import dataclass, field

import pytest

from cgemit import analytic, load
from cgemit.covariance.sensitivity import design_keys
from cgemit.detector import DetectorError, describe, schema
from cgemit.detector.delphes import card_of
from cgemit.detector.keys import key, keys_of
from cgemit.detector.layers import LAYER_KINDS, CgemLayer, MeasurementLayer
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.detector.parts import cgem_layers, cgem_numbers
from cgemit.detector.reader import TOP_LEVEL
from cgemit.detector.readouts import Precision

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
    own = names.index("anode_radius")
    assert names[own - len(PLACEMENT) : own] == list(PLACEMENT)
    assert names[own : own + 3] == ["anode_radius", "readout_offset", "length"]
    assert names[-2:] == ["readout", "efficiency"]
    assert not {"label", "gas", "sheets"} & keys_of(MeasurementLayer).keys()


@dataclass(frozen=True, kw_only=True, repr=False)
class PadRow(MeasurementLayer):
    """A row of pads whose error of X is that of a drift over half of the way to the ends."""

    group = "pads"
    about = "rows of pads by label"
    name = "pad row"

    diffusion: float = field(metadata=key("diffusion", "of drifting electrons", 0.0, 1.0), default=0.0)

    @property
    def precision(self) -> Precision:
        """Errors with the diffusion in quadrature."""
        way = 0.5 * self.half_length
        return super().precision._replace(sigma_x=math.hypot(self.sigma_x, self.diffusion * math.sqrt(way)))


def test_a_kind_of_layers_is_one_class(monkeypatch):
    """Files, hashes, variants, schema, cards, checks and covariances need nothing but the class."""
    monkeypatch.setitem(LAYER_KINDS, "pads", PadRow)
    monkeypatch.setitem(TOP_LEVEL, "pads", PadRow.about)
    row = {"sigma": "0.1 mm", "material": "MdcGas", "thickness": "9 mm", "length": "400 mm"}
    rows = {f"R{i}": row | {"radius": f"{80 + 20 * i} mm", "diffusion": "0.02 mm/sqrt(mm)"} for i in range(4)}
    inner = {"VTX": SENSORS["VTX"] | {"radius": "50 mm"}}
    detector = load({"name": "pads", "field": {"bz": "1 T"}, "pads": rows, "layer": inner})
    assert [layer.label for layer in detector.layers] == ["VTX", "R0", "R1", "R2", "R3"]
    assert [layer.label for layer in detector.layer] == ["VTX"]
    assert load(tomllib.loads(detector.to_toml())) == detector
    assert detector.layers["R1"].errors == pytest.approx((0.1 * math.sqrt(5), 0.1))
    worse = detector.with_overrides({"pads.*.diffusion": "x2", "pads.R3.sigma": "x2"})
    assert worse.layers["R0"].errors == pytest.approx((0.1 * math.sqrt(17), 0.1))
    assert worse.layers["R3"].errors == pytest.approx((0.1 * math.sqrt(20), 0.2))
    assert worse.content_hash != detector.content_hash == load(tomllib.loads(detector.to_toml())).content_hash
    assert "diffusion" in str(schema()["$defs"]["complete"]["properties"]["pads"])
    assert "pads.R2.radius" in design_keys(detector)
    assert [row["layer"] for row in describe(detector)["layers"]] == ["VTX", "R0", "R1", "R2", "R3"]
    assert f" {0.1 * math.sqrt(5) / 1000:.9g} 0.0001 1" in card_of(detector)
    with pytest.raises(DetectorError, match=r"pads\.R1: got r = "):
        detector.with_overrides({"pads.R1.radius": "84 mm"})
    better = detector.with_overrides({"pads.*.diffusion": "0 mm/sqrt(mm)"})
    assert analytic(better, p=1.0).rms("dr") < analytic(detector, p=1.0).rms("dr") < analytic(worse, p=1.0).rms("dr")
