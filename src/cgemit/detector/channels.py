"""Check of the tables that functions of users are given, against the schema and the channels of a detector."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from functools import lru_cache
from typing import Any, Generic, ParamSpec, TypeVar, cast

import numpy as np

from cgemit.base.errors import report
from cgemit.detector.detector import Detector, load
from cgemit.tables.check import Channels, table_problems

P = ParamSpec("P")
R = TypeVar("R", covariant=True)


@lru_cache(maxsize=64)
def channels_of(detector: Detector) -> Channels:
    """Return the numbers of the channels of a detector."""
    layers = detector.layers
    sheets = np.array([one.sheets for one in layers], np.int64)
    strips = np.array([(one.strips_x, one.strips_v) for one in layers], np.int64).reshape(-1, 2)
    first = np.concatenate([[0], np.cumsum(sheets * strips.sum(axis=1))])[:-1]
    chamber = detector.drift_chamber
    wires = list(zip(chamber.layers, chamber.gid_first, strict=True)) if chamber else []
    cells, first_wire = np.zeros((2, max([one.number for one, _ in wires], default=0) + 1), np.int64)
    for one, gid in wires:
        cells[one.number], first_wire[one.number] = one.cells, gid
    return Channels(detector.name, sheets, strips, first.astype(np.int64), cells, first_wire)


class Checked(Generic[P, R]):
    """The type of a function of `checked`: `unchecked` is the function itself, for tables that the package has made."""

    unchecked: Callable[P, R]

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Check the tables, and call the function."""
        raise NotImplementedError


def checked(*names: str, ignore: Collection[str] = ()) -> Callable[[Callable[P, R]], Checked[P, R]]:
    """Return a decorator: the function then refuses tables with wrong values (`tables.check.table_problems`).

    Parameters
    ----------
    *names : str
        Arguments that are tables of the kind of their name, or None. An argument `detector` is that of their layers.
    ignore : collection of str
        Columns that the function does not read (`tables.check.table_problems`).
    """

    def decorate(function: Callable[P, R]) -> Checked[P, R]:
        signature = inspect.signature(function)
        optional = {name for name in names if signature.parameters[name].default is None}

        @functools.wraps(function)
        def refusing(*args: P.args, **kwargs: P.kwargs) -> R:
            bound = signature.bind(*args, **kwargs)
            arguments = bound.arguments
            tables = {
                name: arguments.get(name) for name in names if not (arguments.get(name) is None and name in optional)
            }
            channels = None
            if "detector" in arguments:
                arguments["detector"] = detector = load(arguments["detector"])
                channels = channels_of(detector)
            problems = table_problems(channels, ignore, **tables)
            report(f"{function.__name__}", problems)
            return function(*bound.args, **bound.kwargs)

        cast(Any, refusing).unchecked = function
        return cast(Checked[P, R], refusing)

    return decorate
