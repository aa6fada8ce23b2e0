"""Building a variant costs a small part of reading and compiling its complete file."""

import importlib
from pathlib import Path

import pytest

import cgemit as cg

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


def test_variants_are_built_several_times_as_fast_as_files(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    variants = importlib.import_module("variants")
    monkeypatch.setattr(variants, "REPEATS", 6)
    ratios = {name: whole / fast for name, fast, whole in variants.rows(cg.load("besiii-cgem-design"))}
    assert len(ratios) == 5
    assert min(ratios.values()) > 3, ratios  # 8 to 16 on a quiet machine
