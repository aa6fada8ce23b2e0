"""Variants of a detector: wildcards, relative values, names, hashes, limits; what they take from their base."""

from __future__ import annotations

import math
import pickle
import re
import tomllib
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.base.errors import DetectorError
from cgemit.detector import compiled
from cgemit.detector.core import layer_table, slab_table, wire_table
from cgemit.detector.layers.cgem import _same_matter
from cgemit.detector.matter import _air, _chamber_gas, _cylinders, slabs

DESIGN = cg.load("besiii-cgem-design")


def problems(changes: dict[str, object]) -> list[str]:
    with pytest.raises(DetectorError) as caught:
        DESIGN.with_overrides(changes)
    return [str(problem) for problem in caught.value.problems]


def test_wildcards_reach_every_layer_and_an_exact_key_has_precedence() -> None:
    found = DESIGN.with_overrides({"cgem.L1.pitch_x": "400 um", "cgem.*.pitch_x": "500 um"})
    assert [layer.pitch_x for layer in found.cgem] == [0.4, 0.5, 0.5]
    both = DESIGN.with_overrides({"cgem.L[12].pitch_x, cgem.L3.pitch_v": "500 um"})
    assert [(layer.pitch_x, layer.pitch_v) for layer in both.cgem] == [(0.5, 0.65), (0.5, 0.65), (0.65, 0.5)]


@pytest.mark.parametrize(
    ("text", "factor"), [("x2", 2.0), ("×0.5", 0.5), ("+5 %", 1.05), ("-5%", 0.95), ("x 1e-1", 0.1)]
)
def test_relative_values_multiply_those_of_the_base(text: str, factor: float) -> None:
    found = DESIGN.with_overrides({"cgem.*.drift_gap": text})
    assert [layer.drift_gap for layer in found.cgem] == [layer.drift_gap * factor for layer in DESIGN.cgem]


def test_relative_values_are_of_what_a_measurement_layer_has() -> None:
    """A pitch that is not stated is no zero, which would leave a coordinate unmeasured."""
    base = cg.load("epic-like")
    same = base.with_overrides({"layer.*.pitch_x": "x1", "layer.*.sigma_x": "x1"})
    assert [layer.errors for layer in same.layers] == [layer.errors for layer in base.layers]
    half = base.with_overrides({"layer.*.pitch_x": "x0.5"})
    assert base.layers[0].errors[0] / half.layers[0].errors[0] == pytest.approx(2)
    assert half.layers[5].errors == base.layers[5].errors == (0.15, 0.15)  # CYMBAL states errors
    with pytest.raises(cg.DetectorError, match=r"pitch_x: got \"x2\", expected an absolute value"):
        base.with_overrides({"layer.CYMBAL.pitch_x": "x2"})
    with pytest.raises(cg.DetectorError, match=r"pitch_x: got \"x1e400\", expected a length"):
        base.with_overrides({"layer.L0.pitch_x": "x1e400"})


@pytest.mark.parametrize(
    "keys", [("cgem.*.pitch_x", "cgem.L?.pitch_x"), ("cgem.L1.pitch_x, cgem.L2.pitch_x", "cgem.L1.pitch_x")]
)
def test_two_keys_of_one_value_are_refused(keys: tuple[str, str]) -> None:
    """One of them would have no effect, while the table of a sweep states both."""
    message = re.escape(f'{keys[1]}: got cgem.L1.pitch_x, which "{keys[0]}" changes too')
    with pytest.raises(cg.DetectorError, match=message):
        DESIGN.with_overrides(dict.fromkeys(keys, "400 um"))
    with pytest.raises(cg.study.PlanError, match=message):
        cg.study.sweep(DESIGN, {key: ["400 um", "500 um"] for key in keys})


def test_a_shift_that_is_not_stated_is_no_number() -> None:
    """Relative changes, limits and sensitivities need a number; files hold the shift only where it is stated."""
    plain, key = cg.load("besiii-cgem-design"), "cgem.L1.lorentz_shift"
    for ask in (lambda: plain.with_overrides({key: "x1.1"}), lambda: plain.bounds(key)):
        with pytest.raises(cg.DetectorError, match=r"lorentz_shift: got (\"x1.1\"|no number), expected"):
            ask()
    with pytest.raises(ValueError, match="lorentz_shift: got no number"):
        cg.sensitivity(plain, keys=[key])
    stated = plain.with_overrides({key: "-2 mm"})
    assert stated.with_overrides({key: "x1.5"}).cgem[0].lorentz_shift == pytest.approx(-3.0)
    assert stated.bounds(key) == (-50.0, 50.0)
    assert [text.count("\nlorentz_shift = ") for text in (plain.to_toml(), stated.to_toml())] == [0, 1]


def test_relative_values_of_whole_numbers_and_of_all_wire_layers() -> None:
    two = DESIGN.with_overrides({"cgem.*.foils": 2})
    assert [layer.foils for layer in two.with_overrides({"cgem.L2.foils": "x1.5"}).cgem] == [2, 3, 2]
    wires = DESIGN.with_overrides({"drift_chamber.sigma": "x2"}).drift_chamber.layers
    assert [layer.sigma for layer in wires] == [2 * layer.sigma for layer in DESIGN.drift_chamber.layers]


def test_sub_layers_of_a_stack_are_reached_by_label() -> None:
    found = DESIGN.with_overrides({"cgem.*.foil.Kapton.thickness": "25 um", "cgem.L1.foil.Cu?.thickness": "x0.5"})
    assert [[part.thickness for part in layer.foil] for layer in found.cgem] == [
        [0.001, 0.025, 0.001], [0.002, 0.025, 0.002], [0.002, 0.025, 0.002],
    ]  # fmt: skip
    file = cg.load({"base": "besiii-cgem-design", "cgem": {"L2": {"foil": {"Kapton": {"thickness": "25 um"}}}}})
    assert file.cgem[1] == found.cgem[1]
    for key, value, text in (
        ("cgem.L1.foil.Kapton", "25 um", r'cgem.L1.foil\[1\]: got "25 um", expected a table'),
        ("cgem.L1.foil", {"Kapton": None}, r"cgem.L1.foil\[1\]: got None, expected a table"),
        ("cgem.L1.foil", {"Steel": 5}, r"cgem.L1.foil\[3\]: got 5, expected a table"),
        ("drift_chamber.layers.36.dead", {"3": 1}, r"dead\[0\]: got 1, expected a list"),
        ("drift_chamber.layers.36.wires_east_shift_r", {"3": "1 mm"}, "got 1 values, expected"),
    ):
        with pytest.raises(DetectorError, match=text):
            DESIGN.with_overrides({key: value})


def test_a_variant_equals_the_detector_read_from_its_file() -> None:
    changes: dict[str, object] = {
        "cgem.*.pitch_x": "x1.1", "cgem.L2.drift_gap": "3 mm", "drift_chamber.sigma": "100 um", "field.bz": "-0.9 T",
        "materials.Kapton.density": "1.5 g/cm3", "materials.Kapton.composition": "C22H10N2O5",
    }  # fmt: skip
    found = DESIGN.with_overrides(changes)
    assert cg.load(tomllib.loads(found.to_toml())) == found
    kapton = [part.material for layer in found.cgem for part in layer.anode if part.material.name == "Kapton"]
    assert {material.density for material in kapton} == {1.5}


def test_a_copied_layer_recomputes_its_strips() -> None:
    changes = {"cgem.L0": {"like": "L1", "anode_radius": "60 mm"}}
    found = DESIGN.with_overrides(changes)
    inner, model = found.cgem[:2]
    assert (inner.label, inner.length, inner.foil) == ("L0", model.length, model.foil)
    assert (inner.strips_x, model.strips_x) == (579, 845)  # floor(2 pi 60/0.65), and as before
    assert inner.stereo == pytest.approx(math.atan2(578 * 0.65, 532), rel=1e-15)
    assert cg.load({"base": "besiii-cgem-design", "cgem": {"L0": changes["cgem.L0"]}}).cgem == found.cgem
    assert problems({"cgem.L0": {"like": "L9"}}) == [
        'cgem.L0.like: got "L9", expected the label of another layer: L1, L2, L3'
    ]


def test_like_is_the_table_of_a_further_layer() -> None:
    """As `[cgem.L0] like = "L1"` in a file; its strips follow, and the layer that it copies stays."""
    copy = cg.like("L1", anode_radius="62 mm", foil={"Kapton": {"thickness": "25 um"}})
    assert copy == {"like": "L1", "anode_radius": "62 mm", "foil": {"Kapton": {"thickness": "25 um"}}}
    found = DESIGN.with_overrides({"cgem.L0": copy, "remove": ["cgem.L3"]})
    assert [layer.label for layer in found.cgem] == ["L0", "L1", "L2"]
    inner, model = found.cgem[:2]
    assert model == DESIGN.cgem[0]
    assert (inner.anode_radius, inner.strips_x) == (62.0, math.floor(2 * math.pi * 62 / 0.65))
    assert inner.stereo == pytest.approx(math.atan2((inner.strips_x - 1) * 0.65, inner.length), rel=1e-15)
    assert [part.thickness for part in inner.foil] == [
        0.025 if p.label == "Kapton" else p.thickness for p in model.foil
    ]
    text = 'base = "besiii-cgem-design"\nremove = ["cgem.L3"]\n[cgem.L0]\nlike = "L1"\nanode_radius = "62 mm"\n'
    text += '[cgem.L0.foil.Kapton]\nthickness = "25 um"\n'
    assert cg.load(tomllib.loads(text)).cgem == found.cgem
    assert cg.load({"base": "besiii-cgem-design", "cgem": {"L0": copy}, "remove": ["cgem.L3"]}).cgem == found.cgem
    plain = DESIGN.with_overrides({"cgem.L0": cg.like("L1", anode_radius="62 mm")})
    assert plain.name == "besiii-cgem-design+cgem.L0=like=L1,anode_radius=62mm"


def test_like_lists_what_is_no_key_of_a_layer() -> None:
    with pytest.raises(cg.DetectorError) as info:
        cg.like("", anode_radus="62 mm", like="L2")
    assert [str(problem) for problem in info.value.problems] == [
        'label: got "", expected the label of another layer',
        'anode_radus: got "62 mm", expected a key of a CGEM layer; did you mean "anode_radius"?',
        'like: got "L2", expected a key of a CGEM layer',
    ]
    assert problems({"cgem.L0": cg.like("L9")}) == [
        'cgem.L0.like: got "L9", expected the label of another layer: L1, L2, L3'
    ]


def test_tables_single_values_and_removal_go_together() -> None:
    table = {"pitch_x": "500 um"}
    for changes in ({"cgem.L1": table, "cgem.L1.foils": 2}, {"cgem.L1.foils": 2, "cgem.L1": table}):
        layer = DESIGN.with_overrides(changes).cgem[0]
        assert (layer.pitch_x, layer.foils) == (0.5, 2)
    assert table == {"pitch_x": "500 um"}
    found = DESIGN.with_overrides({"remove": ["cgem.L1"], "cgem.*.pitch_x": "500 um"})
    assert [(layer.label, layer.pitch_x) for layer in found.cgem] == [("L2", 0.5), ("L3", 0.5)]
    assert problems({"remove": ["cgem.L1"], "cgem.L1.pitch_x": "500 um"})[0].startswith("cgem.L1: got only pitch_x")


def test_patterns_remove_every_part_that_they_match() -> None:
    found = DESIGN.with_overrides({"remove": ["cgem.L[12]", "cgem.*2"], "cgem.*.pitch_x": "500 um"})
    assert [(layer.label, layer.pitch_x) for layer in found.cgem] == [("L3", 0.5)]
    chamber = DESIGN.with_overrides({"remove": ["cgem.*", "walls.*"]})
    assert (len(chamber.cgem), len(chamber.walls)) == (0, 0)
    assert chamber.content_hash == DESIGN.with_overrides({"remove": ["cgem", "walls"]}).content_hash
    wires = DESIGN.with_overrides({"remove": ["drift_chamber.layers.[9-9]"]}).drift_chamber.layers
    assert [one.number for one in DESIGN.drift_chamber.layers if one not in wires] == [9]
    assert problems({"remove": ["cgem.Q*", "cgm.*", "cgem.L9"]}) == [
        'remove: got "cgem.Q*", which matches nothing, expected a pattern for L1, L2, L3',
        (
            'remove: got "cgm.*", which matches nothing, '
            "expected a pattern for field, drift_chamber, beam_pipe, cgem, layer, walls, background"
        ),
        'remove: got "cgem.L9", expected a part of the base; did you mean "cgem.L3"?',
    ]


def test_problems_are_all_listed() -> None:
    assert problems({"cgem.X*.pitch_x": "1 mm", "cgem.L1.foils": "x1.5", "cgem.L1.pitch": "x2"}) == [
        'cgem.X*.pitch_x: got "X*", which matches nothing, expected a pattern for L1, L2, L3',
        'cgem.L1.foils: got "x1.5" times 3, expected a whole number from 1 to 5',
        'cgem.L1.pitch: got "x2", expected a number of the detector; did you mean "pitch_x"?',
    ]
    first, *overlaps = problems({"cgem.L2.drift_gap": "x20"})
    assert first.startswith("cgem.L2.drift_gap: got 100.0 mm, expected a length with its unit")
    assert len(overlaps) == 1


def test_names_are_made_of_what_changed() -> None:
    name = DESIGN.with_overrides({"cgem.*.pitch_x": "400 um"}).name
    assert name == "besiii-cgem-design+cgem.pitch_x=400um"
    again = DESIGN.with_overrides({"cgem.*.pitch_x": "400 um"}).with_overrides({"cgem.*.pitch_x": "+5 %"})
    assert again.name == "besiii-cgem-design+cgem.pitch_x=5%"
    assert again.cgem[0].pitch_x == pytest.approx(0.42)
    both = DESIGN.with_overrides({"cgem.L2.foils": 2, "field.bz": "0.9 T"})
    assert both.name == "besiii-cgem-design+cgem.L2.foils=2+field.bz=0.9T"
    long = DESIGN.with_overrides({f"cgem.L{i}.{key}": "500 um" for i in (1, 2, 3) for key in ("pitch_x", "pitch_v")})
    assert len(long.name) == 100
    assert (
        long.name
        != DESIGN.with_overrides(
            {f"cgem.L{i}.{key}": "501 um" for i in (1, 2, 3) for key in ("pitch_x", "pitch_v")}
        ).name
    )
    assert DESIGN.with_overrides({}).name == DESIGN.name
    odd = DESIGN.with_overrides({"name": "a++b=1+c"})
    assert odd.with_overrides({}).name == odd.name
    assert (
        odd.with_overrides({"cgem.L1.foils": 2}).with_overrides({"cgem.L1.foils": 1}).name == "a++b=1+c+cgem.L1.foils=1"
    )


def test_hashes_tell_contents_apart_and_nothing_else() -> None:
    changes = {"cgem.*.pitch_x": "x1.01", "cgem.*.foil.Kapton.thickness": "x1.01", "drift_chamber.sigma": "x1.01",
               "field.bz": "x1.01", "cgem.L1.gas": "MdcGas", "walls.*.half_length": "x1.01"}  # fmt: skip
    found = {DESIGN.with_overrides({key: value}).content_hash for key, value in changes.items()}
    assert len(found | {DESIGN.content_hash}) == len(changes) + 1
    assert DESIGN.with_overrides({"name": "other", "description": "?"}).content_hash == DESIGN.content_hash
    there = DESIGN.with_overrides({"cgem.L2.drift_gap": "3 mm"})
    assert there.with_overrides({"cgem.L2.drift_gap": "5 mm"}).content_hash == DESIGN.content_hash


def test_bounds_end_where_the_neighbours_begin() -> None:
    low, high = DESIGN.bounds("cgem.L2.anode_radius")
    inner, layer, outer = DESIGN.cgem
    below, above = layer.anode_radius - layer.r_in, layer.r_out - layer.anode_radius
    assert low == pytest.approx(inner.r_out + below, abs=2e-6)
    assert high == pytest.approx(outer.r_in - above, abs=2e-6)
    for value in (low, high):
        assert DESIGN.with_overrides({"cgem.L2.anode_radius": f"{value!r} mm"}).cgem[1].anode_radius == value
    assert DESIGN.bounds("cgem.L2.foils") == (1, 5)
    assert DESIGN.bounds("cgem.*.pitch_x") == (0.01, 20.0)
    thickest = DESIGN.bounds("cgem.L2.foil.Kapton.thickness")[1]  # three foils fill the room to the first layer
    assert thickest == pytest.approx(0.05 + (layer.r_in - inner.r_out) / 3, abs=1e-6)
    with pytest.raises(DetectorError, match=r"different values: 87\.5, 132\.5, 175"):
        DESIGN.bounds("cgem.*.anode_radius")
    with pytest.raises(DetectorError, match="no number"):
        DESIGN.bounds("cgem.L2.gas")


def test_other_things_than_keys_are_refused() -> None:
    for wrong in (5, None, [], {5: 1}):
        with pytest.raises(DetectorError, match="expected values by dotted key"):
            DESIGN.with_overrides(wrong)
    with pytest.raises(DetectorError, match="expected the dotted key of one number"):
        DESIGN.bounds(5)


def test_bounds_of_a_value_of_all_wire_layers() -> None:
    assert DESIGN.bounds("drift_chamber.sigma") == DESIGN.bounds("drift_chamber.layers.*.sigma") == (0.001, 10.0)
    with pytest.raises(DetectorError, match=r"different values: 0\.299, 0\.23, 0\.183"):
        cg.load("besiii-idc-boss").bounds("drift_chamber.sigma")


def test_a_variant_shares_what_did_not_change() -> None:
    found = DESIGN.with_overrides({"cgem.L2.pitch_x": "500 um"})
    assert found.cgem[0] is DESIGN.cgem[0]
    assert all(one is other for one, other in zip(found.drift_chamber.layers, DESIGN.drift_chamber.layers, strict=True))


def test_gap_tables_are_made_where_they_are_needed() -> None:
    small = DESIGN.with_overrides({"cgem.L1.drift_gap": "3.3 mm"})
    without, complete = compiled(small, gaps=False), compiled(small)
    assert without is not complete
    given = {"w": 1.0, "energy": 20.0, "outward": 1.0, "n": 3, "seed": 1}
    assert _core._testing.follow_electrons(complete, 0, **given)
    with pytest.raises(IndexError):
        _core._testing.follow_electrons(without, 0, **given)


@pytest.mark.parametrize(
    ("change", "new_parts", "new_slabs"),
    [
        ({"cgem.L2.pitch_x": "500 um"}, {"L2"}, 0),
        ({"cgem.L2.foil.Cu1.thickness": "3 um"}, {"L2"}, 6),
        ({"drift_chamber.sigma": "100 um"}, set(), 0),
        ({"beam_pipe.gold.r_in": "31.48 mm"}, set(), 1),
    ],
)
def test_only_what_changes_is_made_anew(change: dict[str, str], new_parts: set[str], new_slabs: int) -> None:
    base = pickle.loads(pickle.dumps(cg.load("besiii-cgem-design")))  # nothing is kept with its parts yet
    before = {id(slab) for slab in slabs(base)}
    variant = base.with_overrides(change)
    assert {mine.label for mine, other in zip(variant.cgem, base.cgem, strict=True) if mine is not other} == new_parts
    made = [slab for slab in slabs(variant) if id(slab) not in before]
    assert len(made) == new_slabs
    assert all(slab.row is slab.row for slab in made)  # kept with the slab


#: What a variant may change in one layer, each of which changes what the core is given.
CHANGES: dict[str, object] = {
    "anode_radius": "x1.001", "length": "x0.99", "pitch_x": "x1.01", "pitch_v": "x1.01", "drift_gap": "x1.01",
    "transfer_gap": "x1.01", "induction_gap": "x1.01", "foils": 2, "gas": "MdcGas", "cathode.Epoxy1.thickness": "x1.01",
    "foil.Kapton.thickness": "x1.01", "anode.Cu3.thickness": "x1.01", "foil.Cu1.material": "Cu", "stereo": "x0.9",
    "readout_offset": "0.1 mm", "sheets": 1, "phi_first": "x0.9", "offset_v": 1.5, "shift_x": "0.1 mm",
    "lorentz_shift": "2 mm", "z_scale": 0.001,
}  # fmt: skip
OTHERS: dict[str, object] = {
    "materials.Kapton.density": "1.4 g/cm3", "drift_chamber.sigma": "x1.1", "drift_chamber.layers.20.r_end": "x1.001",
    "walls.separator-cfrp.r_in": "x1.0001", "beam_pipe.gold.r_in": "x0.9999", "cgem.*.length": "x0.99",
}  # fmt: skip


def tables_of(detector: cg.Detector) -> list[Any]:
    """Return all that the core is given of a detector but its field."""
    found = [*slab_table(slabs(detector)), layer_table(detector.cgem), wire_table(detector.drift_chamber)]
    return [column for table in found for column in (table.values() if isinstance(table, dict) else [table])]


@pytest.mark.parametrize(
    ("key", "value"), [*((f"cgem.L2.{key}", value) for key, value in CHANGES.items()), *OTHERS.items()]
)
def test_a_variant_is_the_detector_of_its_own_file(key: str, value: object) -> None:
    """With what it takes from its base it equals the detector read from its own file, to the last bit."""
    base = pickle.loads(pickle.dumps(cg.load("besiii-cgem-design")))  # nothing is kept with its parts yet
    before = tables_of(base)
    variant = base.with_overrides({key: value})
    found = tables_of(variant)
    for cache in (_same_matter, _cylinders, _air, _chamber_gas):
        cache.cache_clear()
    read = cg.load(tomllib.loads(variant.to_toml()))
    assert read == variant
    assert read.content_hash == variant.content_hash != base.content_hash
    assert all(np.array_equal(*pair) for pair in zip(found, tables_of(read), strict=True))
    assert not all(np.array_equal(*pair) for pair in zip(found, before, strict=True))


def test_what_is_kept_does_not_travel() -> None:
    """A pickled detector is as large as one of which nothing was computed, and equal."""
    base = cg.load("besiii-cgem-design").with_overrides({"cgem.L2.pitch_x": "500 um"})
    size = len(pickle.dumps(base))
    tables_of(base)
    assert len(pickle.dumps(base)) < 1.1 * size
    assert pickle.loads(pickle.dumps(base)) == base
