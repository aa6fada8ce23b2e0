"""The cost of the stages is measured on what they are for, and reported as promised."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cgemit.bench import DETECTOR, GUN, machine, measure, stage_calls
from cgemit.cli.main import main
from cgemit.detector import load

KEYS = ["isa", "threads", "simulate_us", "digitize_us", "cluster_us", "fit_us", "fit_lr_us"]


def test_json_has_exactly_these_keys(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--json", "--events", "50", "--repeat", "1", "--threads", "2"]) == 0
    out, err = capsys.readouterr()
    cost = json.loads(out)
    assert list(cost) == KEYS
    assert (cost["isa"], cost["threads"]) == ("scalar", 2)
    assert all(cost[name] > 0 for name in KEYS[2:])
    assert "best of 1 runs" in err
    assert machine() in err


def test_table_names_every_stage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--events", "20", "--repeat", "1", "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == len(KEYS) - 2
    assert not err


def test_stages_do_the_work_that_is_timed() -> None:
    calls = stage_calls(load(DETECTOR), GUN, 200)
    assert len(calls["simulate"]()["truths"]) >= 590
    assert len(calls["cluster"]()) > 1700
    for name in ("fit", "fit_lr"):
        fitted = calls[name]()
        assert np.mean(fitted["tracks"]["status"] == 0) > 0.99
        assert len(fitted["residuals"]) > 200 * 30, "the smoother is part of the fit"


def test_numbers_below_one_are_refused() -> None:
    with pytest.raises(ValueError, match=r"events: 0.*\n.*threads: -1"):
        measure(events=0, threads=-1)
