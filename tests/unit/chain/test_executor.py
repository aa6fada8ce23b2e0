"""Chunks in two threads give what one thread gives, with every kind of kernel; run under the thread sanitizer, too."""

from __future__ import annotations

import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.base import isa
from cgemit.chain.executor import Workers, at_a_time, chunk_for
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.particles.gun import Gun
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings

GUN = Gun("mu-", p=(0.15, 1.5), cos_theta=(-0.9, 0.9)) + Gun("e+", p=0.3, cos_theta=(-0.5, 0.5))
KINDS = {
    "default": Settings(fit=FitSettings(residuals=True)),
    "smeared, sides known": Settings(
        simulate=SimulateSettings(fluctuations="gaussian"),
        digitize=DigitizeSettings(reveal_sides=True),
        fit=FitSettings(cluster_errors="cluster"),
    ),
    "holes, every step": Settings(simulate=SimulateSettings(foil="lattice", sublayers=True, steps=True)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_two_threads_on_one_detector(kind: str) -> None:
    """Eight chunks at a time on one compiled detector: the same bytes as all events in one call."""
    one, two = (
        run(
            "besiii-cgem-design",
            GUN,
            80,
            seed=7,
            settings=KINDS[kind],
            workers=Workers(threads=threads, chunk=chunk),
            readout="gaussian" if kind.startswith("smeared") else None,
        )
        for threads, chunk in ((1, 80), (2, 10))
    )
    assert len(one.tracks) == 160
    for name, table in one.tables.items():
        assert table == two.tables[name], name
    assert np.any(one.tracks["status"] == 0)


@pytest.mark.parametrize(
    ("n", "workers", "particles", "size"),
    [
        (0, Workers(threads=2), 1, 250),
        (300, Workers(threads=2), 1, 250),
        (1000, Workers(threads=2), 1, 500),
        (20_000, Workers(threads=2), 1, 3334),
        (20_000, Workers(threads=1), 1, 4000),
        (64_000, Workers(threads=2), 1, 4000),
        (64_000, Workers(threads=2), 4, 1000),
        (64_000, Workers(threads=2), 64, 250),
        (64_000, Workers(threads=2), 0, 4000),
        (5000, Workers(threads=64), 1, 250),
        (20_000, Workers(threads=2, chunk=1000), 64, 1000),
        (60, Workers(threads=2, chunk=20), 1, 20),
    ],
)
def test_threads_have_equally_many_chunks(n: int, workers: Workers, particles: float, size: int) -> None:
    """Unless chunks were as small as asked for already, or smaller than is worth it."""
    assert chunk_for(n, workers, particles) == size
    if size > 250:
        assert -(-n // size) % workers.threads == 0


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a process of this system uses all cores")
def test_a_process_has_the_cores_that_it_may_use() -> None:
    all_of_them = os.sched_getaffinity(0)
    assert isa.cores() == len(all_of_them)
    try:
        os.sched_setaffinity(0, {min(all_of_them)})
        assert (isa.cores(), at_a_time(Workers())) == (1, 1)
    finally:
        os.sched_setaffinity(0, all_of_them)


ENDLESS = cg.FitSettings(max_iterations=2**31 - 1, tolerance=1e-300)


def tracks_of(where):
    """Fit without end: in the threads of a run, in its own thread, or in the main thread."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    if where == "run":
        return cg.run("besiii-cgem-design", gun, 50, settings=cg.Settings(fit=ENDLESS), workers=2)
    found = cg.run("besiii-cgem-design", gun, 50)
    hits = {name: found.tables[name] for name in ("clusters", "wire_hits", "candidates", "candidate_hits")}
    return cg.fit(found.detector, **hits, settings=ENDLESS)


@pytest.mark.parametrize("where", ["run", "fit"])
def test_ctrl_c_ends_a_fit_without_end(where):
    """The stage hears it wherever it is in the core, and nothing goes on afterwards."""
    before = threading.active_count()
    timer = threading.Timer(2.0, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        tracks_of(where)
    assert time.monotonic() - begin < 30
    timer.join()
    assert threading.active_count() == before
    gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    assert len(cg.run("besiii-cgem-design", gun, 5).tracks) == 5  # which is not stopped, too


def test_stages_at_work_on_any_thread_are_stopped():
    """Every stage that loops over events gives up what it has; the same call works when nothing stops it."""
    found = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 20)
    calls = {
        "simulate": lambda: cg.simulate(found.detector, found.particles, seed=1),
        "find": lambda: cg.find_tracks(found.detector, found.clusters, found.wire_hits),
        "covariance": lambda: cg.analytic(found.detector, "mu-", p=[0.5, 1.0]),
    }
    for call in calls.values():
        _core.common.stop_stages(True)
        try:
            with ThreadPoolExecutor(1) as pool:
                assert isinstance(pool.submit(call).exception(), KeyboardInterrupt)
            with pytest.raises(KeyboardInterrupt):
                call()
        finally:
            _core.common.stop_stages(False)
        call()
