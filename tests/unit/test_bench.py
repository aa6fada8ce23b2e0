"""The cost of the stages is measured on what they are for, and reported as promised."""

from __future__ import annotations

import numpy as np
import pytest

from bench import DETECTOR, GUN, STAGES, instruction_set, machine, measure, stage_calls
from cgemit.base.isa import available
from cgemit.detector import load


def test_every_stage_has_its_time() -> None:
    cost = measure(events=50, threads=2, repeat=1)
    assert (cost.isa in available(), cost.threads) == (True, 2)
    assert all(cost.to_dict()[f"{stage}_us"] > 0 for stage in STAGES)
    assert machine()


def test_stages_do_the_work_that_is_timed() -> None:
    calls = stage_calls(load(DETECTOR), GUN, 200)
    assert len(calls["simulate"]()["truths"]) >= 590
    assert len(calls["cluster"]()) > 1700
    for name in ("fit", "fit_lr"):
        fitted = calls[name]()
        assert np.mean(fitted["tracks"]["status"] == 0) > 0.99
        assert len(fitted["residuals"]) > 200 * 30, "the smoother is part of the fit"
    assert list(calls) == list(STAGES)


def test_kernels_do_the_work_that_is_timed() -> None:
    calls = stage_calls(load(DETECTOR), GUN, 200)
    assert len(calls["simulate_kernel"]()["truths"]["event"]) >= 590
    two, found_out = calls["fit_kernel"](), calls["fit_lr_kernel"]()
    assert np.mean(two["iterations"] == 2) > 0.99
    assert np.mean(found_out["status"] == 0) > 0.99
    for fitted in (two, found_out):
        assert np.mean(fitted["err"] > 0) > 0.9, "residuals are part of the fit"


def test_instruction_set_is_the_one_asked_for_and_only_for_a_while() -> None:
    with instruction_set(None) as before:
        pass
    for name in available():
        with instruction_set(name) as used:
            assert used == name
    with instruction_set(None) as after:
        assert after == before
    with pytest.raises(ValueError, match="'mmx', expected one of scalar"):
        measure(isa="mmx")


def test_numbers_below_one_are_refused() -> None:
    with pytest.raises(ValueError, match=r"events: 0.*\n.*threads: -1"):
        measure(events=0, threads=-1)
