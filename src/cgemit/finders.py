"""Finders as functions of (detector, clusters, wire_hits), and what they must return."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.tables import Table
from cgemit.tables.table import kind_problems, what

#: A finder takes detector, clusters and wire hits, and returns tables of candidates and their hits.
Finder = Callable[[Detector, Table, Table], Mapping[str, Table]]
FOUND = ("candidates", "candidate_hits")


def by_finder(finder: Finder, detector: Detector, clusters: Table, wire_hits: Table) -> dict[str, Table]:
    """Return the tables that a finder makes.

    Parameters
    ----------
    finder : callable
    detector : Detector
    clusters, wire_hits : Table

    Returns
    -------
    dict of str to Table
        ``candidates`` and ``candidate_hits``, with the finder's name in `meta`.

    Raises
    ------
    TypeError, ValueError
        If it returns anything but a mapping with these two tables, of the same events.
    """
    return check_found(finder(detector, clusters, wire_hits), finder_name(finder), clusters.events)


def finder_name(finder: object) -> str:
    """Return the name of a finder in tables: the name of the function, also of a partial one, or of the class.

    Parameters
    ----------
    finder : callable, or str
        A name is returned as it is.
    """
    if isinstance(finder, str):
        return finder
    function = getattr(finder, "func", finder)
    return str(getattr(function, "__name__", type(function).__name__))


def check_found(found: object, finder: str, events: npt.NDArray[Any]) -> dict[str, Table]:
    """Return the two tables that a finder has made.

    Parameters
    ----------
    found : object
        Its return value.
    finder : str
        Its name.
    events : ndarray, (n,) int64
        Events that it was given.

    Raises
    ------
    TypeError, ValueError
        If `found` is not a mapping with tables of candidates and their hits, of the same events.
    """
    if not isinstance(found, Mapping) or not set(FOUND) <= set(found):
        given = (
            f"a mapping with {', '.join(map(repr, found)) or 'nothing'}" if isinstance(found, Mapping) else what(found)
        )
        raise TypeError(f"finder {finder}: returned {given}; expected a mapping with 'candidates' and 'candidate_hits'")
    tables = {name: found[name] for name in FOUND}
    problems = kind_problems(**tables) or [
        f"{name}: cover other events than the clusters; expected the same"
        for name, table in tables.items()
        if not np.array_equal(table.events, events)
    ]
    if problems:
        raise ValueError(f"finder {finder}:\n  " + "\n  ".join(problems))
    return {name: table.with_meta(finder=finder) for name, table in tables.items()}
