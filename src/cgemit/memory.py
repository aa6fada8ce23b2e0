"""The memory, or the space on disk, that a run needs, compared with what there is."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path

#: Chunks are held until they are joined: the tables of a run stand in memory twice.
COPIES = 2


def available() -> int:
    """Return the bytes of memory that are free for new data, or all where the system does not tell."""
    try:
        with open("/proc/meminfo", encoding="ascii") as stream:  # noqa: PTH123
            lines = dict(line.split(":", 1) for line in stream)
        return 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def check_memory(sizes: Mapping[str, int], kept: Collection[str], done: int, n_events: int) -> None:
    """Raise an error if a run does not fit into memory, judged by its first events.

    Parameters
    ----------
    sizes : mapping of str to int, bytes
        Of all tables of the first events.
    kept : collection of str
        The tables that the run keeps.
    done, n_events : int
        Number of these events, and of all.

    Raises
    ------
    ValueError
        With what the run needs, what there is, and how it would fit.
    """
    size = sum(sizes[name] for name in kept) / done
    tracks = sum(sizes.get(name, 0) for name in _TRACKS) / done
    needed, free = COPIES * size * n_events, available()
    if needed <= free:
        return
    ways = []
    if set(kept) > set(_TRACKS) <= sizes.keys() and COPIES * tracks * n_events <= free:
        ways.append(f"keep=('tracks',) needs {_gigabytes(COPIES * tracks * n_events)}")
    disk = f"{_gigabytes(size * n_events)} on disk"
    if set(kept) > set(_TRACKS) <= sizes.keys():
        disk += f", or {_gigabytes(tracks * n_events)} with keep=('tracks',)"
    ways.append(f"output=FOLDER (on the command line --keep) needs no more memory than a few chunks, and {disk}")
    raise ValueError(
        f"n: {n_events} events need about {_gigabytes(needed)} of memory ({size / 1000:.1f} kB an event, "
        f"{COPIES} times), and {_gigabytes(free)} are free; expected at most {int(free / needed * n_events):,} "
        f"events at a time, or less of each: {'; '.join(ways)}"
    )


#: Chunks of more events than this are judged by as many events as `PROBE`, before they are begun.
PROBED = 10_000
PROBE = 100


def check_chunk(sizes: Mapping[str, int], done: int, chunk: int, workers: int) -> None:
    """Raise an error if the chunks that run at a time do not fit into memory, judged by some events.

    Parameters
    ----------
    sizes : mapping of str to int, bytes
        Of all tables of these events: a chunk holds each of them until it is complete.
    done : int
        Number of these events.
    chunk, workers : int
        Events of a chunk, and chunks at a time.

    Raises
    ------
    ValueError
        With what the chunks need, what there is, and a chunk that fits.
    """
    size = sum(sizes.values()) / done
    needed, free = size * chunk * workers, available()
    if needed > free:
        most = max(1, int(free / size / workers))
        raise ValueError(
            f"chunk: {workers} of {chunk} events at a time need about {_gigabytes(needed)} of memory "
            f"({size / 1000:.1f} kB an event), and {_gigabytes(free)} are free; expected at most {most:,} events"
        )


#: What ``keep=("tracks",)`` keeps.
_TRACKS = ("tracks", "matches")


def check_disk(folder: Path, size: int, done: int, n_events: int) -> None:
    """Raise an error if the rest of a run does not fit on the disk, judged by what is written.

    Parameters
    ----------
    folder : Path
        Where the run is written.
    size : int, bytes
        Of the files of the first events.
    done, n_events : int
        Number of these events, and of all.

    Raises
    ------
    ValueError
        With what the run needs and what there is.
    """
    needed, free = size * n_events / done, size + shutil.disk_usage(folder).free
    if needed > free:
        raise ValueError(
            f"n: {n_events} events need about {_gigabytes(needed)} on disk ({size / done / 1000:.2f} kB an event), and "
            f"{_gigabytes(free)} are free there; expected at most {int(free / needed * n_events):,} "
            "events, or fewer tables, or a smaller format such as parquet"
        )


def _gigabytes(size: float) -> str:
    return f"{size / 1e9:,.0f} GB" if size >= 1e10 else f"{size / 1e9:.2g} GB"
