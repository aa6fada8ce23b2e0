"""A variant takes from its base what it does not change; `benchmarks/variants.py` measures what that saves."""

import pytest

import cgemit as cg
from cgemit.detector import compile as compiling


@pytest.mark.parametrize(
    ("change", "new_parts", "new_slabs"),
    [
        ({"cgem.L2.pitch_x": "500 um"}, {"L2"}, 0),
        ({"cgem.L2.foil.Cu1.thickness": "3 um"}, {"L2"}, 8),
        ({"drift_chamber.sigma": "100 um"}, set(), 0),
        ({"beam_pipe.gold.r_in": "31.48 mm"}, set(), 1),
    ],
)
def test_only_what_changes_is_made_anew(change: dict[str, str], new_parts: set[str], new_slabs: int) -> None:
    base = cg.load("besiii-cgem-design")
    compiling.forget()
    compiling.compiled(base, gaps=False)
    before = compiling._row.cache_info().misses
    variant = base.with_overrides(change)
    assert {mine.label for mine, other in zip(variant.cgem, base.cgem, strict=True) if mine is not other} == new_parts
    compiling.compiled(variant, gaps=False)
    made = compiling._row.cache_info().misses - before
    assert made <= new_slabs
    assert (made > 0) == (new_slabs > 0)
