"""A sweep that is killed at random moments and continued; run as a program, twenty times a way.

The program and its worker processes are killed together (SIGKILL), as by a batch system.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from cgemit.study import Evaluation, sweep

SPACE = {"cgem.*.pitch_x": ["400 um", "500 um", "600 um", "700 um"], "cgem.L2.anode_radius": ["132.5 mm", "160 mm"]}
HOW = Evaluation("mc", p=0.5, events=60)
FILES = ("sweep.csv", "summary.json", "detector.toml")
EVENTS = 40_000  # of the twenty kills: a chunk takes longer than most delays, so that all twenty hit a sweep at work
WAYS = ("serial", "threads", "processes", "dask")


def swept(folder: Path, *, events: int = HOW.events, chunk: int | None = None, **how: Any) -> list[bytes]:
    """Return the files that a sweep writes."""
    sweep("besiii-cgem-design", SPACE, output=folder, evaluate=replace(HOW, events=events, chunk=chunk), **how)
    return written(folder)


def written(folder: Path) -> list[bytes]:
    """Return the content of the files with results."""
    return [(folder / name).read_bytes() for name in FILES]


@contextmanager
def executor(way: str) -> Iterator[Executor]:
    """Give an executor: one thread, two threads, two processes, or two workers of Dask."""
    if way == "dask":
        import distributed

        with (
            distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client.get_executor()
        return
    pool: Executor = ProcessPoolExecutor(2) if way == "processes" else ThreadPoolExecutor(1 + (way == "threads"))
    with pool:
        yield pool


def killed_until_complete(folder: Path, way: str, delays: list[float], events: int = 60) -> int:
    """Run a sweep, kill it after each delay (s), from its first file on, then let it end; return how many it ended."""
    command = [sys.executable, __file__, way, str(folder), str(events)]
    killed = 0
    for delay in delays:
        process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
        while process.poll() is None and not (folder / "chunks").is_dir():
            time.sleep(0.02)
        time.sleep(delay)
        if process.poll() is None and not (folder / "sweep.csv").exists():
            os.killpg(process.pid, signal.SIGKILL)
            killed += 1
        process.wait()
    subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return killed


def main() -> None:
    """Kill twenty times a sweep of each kind, and compare."""
    chance = random.Random(1)
    with tempfile.TemporaryDirectory() as folder:
        expected = swept(Path(folder) / "expected", events=EVENTS)
        for way in WAYS:
            place = Path(folder) / way
            killed = killed_until_complete(place, way, [chance.uniform(0.0, 4.0) for _ in range(20)], EVENTS)
            same = written(place) == expected and not list((place / "chunks").glob(".*"))
            print(
                f"{way}: killed {killed} times before its end; {'the same' if same else 'DIFFERENT'} files", flush=True
            )


if __name__ == "__main__":
    if len(sys.argv) == 4:
        with executor(sys.argv[1]) as pool:
            swept(Path(sys.argv[2]), workers=pool, events=int(sys.argv[3]))
    else:
        main()
