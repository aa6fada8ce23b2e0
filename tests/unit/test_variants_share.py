"""A variant takes from its base what it does not change; `pages/performance/designs.py` measures what that saves."""

import pickle
import tomllib
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.detector.core import cgem_table, slab_table, wire_table
from cgemit.detector.matter import _air, _chamber_gas, _cylinders, _same_matter, slabs


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
}  # fmt: skip
OTHERS: dict[str, object] = {
    "materials.Kapton.density": "1.4 g/cm3", "drift_chamber.sigma": "x1.1", "drift_chamber.layers.20.r_end": "x1.001",
    "walls.separator-cfrp.r_in": "x1.0001", "beam_pipe.gold.r_in": "x0.9999", "cgem.*.length": "x0.99",
}  # fmt: skip


def tables_of(detector: cg.Detector) -> list[Any]:
    """Return all that the core is given of a detector but its field."""
    found = [*slab_table(slabs(detector)), cgem_table(detector.cgem), wire_table(detector.drift_chamber)]
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
