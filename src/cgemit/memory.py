"""The memory that a run needs, compared with what there is."""

from __future__ import annotations

import os
from collections.abc import Mapping

from cgemit.tables import Table

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


def check_memory(tables: Mapping[str, Table], done: int, n_events: int) -> None:
    """Raise an error if a run does not fit into memory, judged by its first events.

    Parameters
    ----------
    tables : mapping of str to Table
        Of the first events.
    done, n_events : int
        Number of these events, and of all.

    Raises
    ------
    ValueError
        With what the run needs and what there is.
    """
    size = sum(column.nbytes for table in tables.values() for column in table.columns.values())
    needed, free = COPIES * size * n_events / done, available()
    if needed > free:
        raise ValueError(
            f"n: {n_events} events need about {needed / 1e9:,.0f} GB of memory ({size / done / 1000:.1f} kB an event, "
            f"{COPIES} times), and {free / 1e9:,.0f} GB are free; expected at most {int(free / needed * n_events):,} "
            "events at a time: several runs with seeds of their own"
        )
