"""A sweep by threads, processes and Dask is the serial one byte for byte, also if a worker or the program is killed."""

from __future__ import annotations

import os
import signal
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import pytest

import cgemit as cg
from cgemit.study import sweep
from kill_sweeps import FILES, SPACE, killed_until_complete, swept, written


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    with ThreadPoolExecutor(1) as one:
        return swept(tmp_path_factory.mktemp("serial") / "out", executor=one)


@pytest.mark.slow
def test_every_executor_makes_the_same_files(serial: list[bytes], tmp_path: Path) -> None:
    assert swept(tmp_path / "threads") == serial
    assert swept(tmp_path / "large chunks", chunk=4) == serial
    with ProcessPoolExecutor(2) as pool:
        assert swept(tmp_path / "processes", executor=pool) == serial


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of dask, about the cluster that is taken apart
def test_dask_makes_the_same_files_when_a_worker_is_killed(serial: list[bytes], tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, local_directory=str(tmp_path)
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        workers = [nanny.pid for nanny in cluster.workers.values()]
        killed = []

        def kill_one(done: float, label: str) -> None:
            if done > 0.2 and not killed:
                killed.append(workers[0])
                os.kill(workers[0], signal.SIGKILL)

        executor: Executor = client.get_executor()
        assert swept(tmp_path / "out", executor=executor, progress=kill_one) == serial
    assert killed


@pytest.mark.slow
def test_a_killed_sweep_ends_as_an_uninterrupted_one(serial: list[bytes], tmp_path: Path) -> None:
    folder = tmp_path / "out"
    assert killed_until_complete(folder, "threads", [0.0, 0.2, 0.1]) > 0
    assert written(folder) == serial
    assert sorted(path.name for path in folder.iterdir()) == ["chunks", *sorted(FILES)]
    assert not list((folder / "chunks").glob(".*"))


def test_variants_of_the_space_are_not_all_alike() -> None:
    found = sweep("besiii-cgem-design", SPACE, evaluate=lambda detector: {"name": detector.name})
    assert sorted(found.columns["status"]) == ["impossible"] * 4 + ["ok"] * 5
    assert cg.load("besiii-cgem-design").name == found.columns["name"][0]
