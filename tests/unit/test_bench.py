"""The cost of the stages is measured on what they are for, and reported as promised."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cgemit.base.isa import available
from cgemit.bench import DETECTOR, GUN, STAGES, instruction_set, machine, measure, stage_calls
from cgemit.cli.main import main
from cgemit.detector import load

KEYS = [
    "isa", "threads", "simulate_us", "digitize_us", "cluster_us", "fit_us", "fit_lr_us",
    "find_us", "simulate_kernel_us", "fit_kernel_us", "fit_lr_kernel_us",
]  # fmt: skip


def test_json_has_exactly_these_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--json", "--events", "50", "--repeat", "1", "--threads", "2"]) == 0
    out, err = capsys.readouterr()
    cost = json.loads(out)
    assert list(cost) == KEYS
    assert (cost["isa"] in available(), cost["threads"]) == (True, 2)
    assert all(cost[name] > 0 for name in KEYS[2:])
    assert "best of 1 runs" in err
    assert machine() in err


def test_table_names_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--events", "20", "--repeat", "1", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 1 + len(KEYS) - 2
    assert not err


def test_json_of_several_runs_is_a_list(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--events", "10", "--repeat", "1", "--isa", "all", "--threads", "1", "2"]
    assert main(["bench", "--json", *arguments]) == 0
    costs = json.loads(capsys.readouterr().out)
    assert [(c["isa"], c["threads"]) for c in costs] == [(isa, n) for isa in available() for n in (1, 2)]
    assert all(list(cost) == KEYS for cost in costs)


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
