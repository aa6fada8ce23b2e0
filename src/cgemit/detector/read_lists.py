"""Values of a detector file that are lists of numbers or strips, and the short form in which messages show a value."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from cgemit.detector.keys import Key

#: Sheet and strips of a list of strips.
STRIPS = r"([0-9]{1,2}):([0-9]{1,6})(?:-([0-9]{1,6}))?"
#: Most entries of a list of rates.
MOST_POINTS = 100
#: Characters of a value that messages show.
LONGEST_SHOWN = 80


class ListReader:
    """Reads lists, and notes problems by the method of the `Reader` that it is part of."""

    def note(self, path: str, given: str, expected: str, hint: str = "") -> Any:
        """Note a problem."""
        raise NotImplementedError

    def _counts(self, path: str, raw: object, key: Key) -> Any:
        numbers = raw if isinstance(raw, list) and 0 < len(raw) <= MOST_POINTS else []
        good = all(isinstance(one, int | float) and not isinstance(one, bool) and 0 <= one < 1e15 for one in numbers)
        if not good or not any(numbers):
            self.note(path, shown(raw), key.expected())
            return (1,)
        return tuple(numbers)

    def _strips(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list):
            self.note(path, shown(raw), key.expected())
            return ()
        found = []
        for i, one in enumerate(raw):
            match = re.fullmatch(STRIPS, one) if isinstance(one, str) else None
            if match is None:
                self.note(f"{path}[{i}]", shown(one), key.expected())
                continue
            sheet, first, last = match.groups()
            found.append((int(sheet), int(first), int(last or first)))
        return tuple(found)

    def _gains(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list):
            self.note(path, shown(raw), key.expected())
            return ()
        return tuple(self._gain_grid(f"{path}[{i}]", sheet, key) for i, sheet in enumerate(raw))

    def _gain_grid(self, path: str, raw: object, key: Key) -> Any:
        rows = raw if isinstance(raw, list) else [[raw]]
        if not rows or not all(isinstance(row, list) and row and len(row) == len(rows[0]) for row in rows):
            self.note(path, shown(raw), key.expected() + ", rows of equal length")
            return ((1.0,),)
        for row in rows:
            for number in row:
                if not isinstance(number, int | float) or isinstance(number, bool) or not key.admits(number):
                    self.note(path, shown(number), key.expected())
                    return ((1.0,),)
        return tuple(tuple(map(float, row)) for row in rows)


def shown(raw: object) -> str:
    """Return a value of a file in short form, as TOML would write it."""
    if isinstance(raw, Mapping):
        return "a table"
    if isinstance(raw, list):
        return f"a list of {len(raw)}"
    if isinstance(raw, bool):
        return str(raw).lower()
    try:
        text = json.dumps(raw, ensure_ascii=False) if isinstance(raw, str) else repr(raw)
    except ValueError:  # a whole number of thousands of digits
        return "a number too large to write"
    return text if len(text) <= LONGEST_SHOWN else text[:LONGEST_SHOWN] + "..."


def writable(text: str) -> bool:
    """Return whether a file can hold a text: not with halves of surrogate pairs.

    Parameters
    ----------
    text : str
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def strip_text(sheet: int, first: int, last: int) -> str:
    """Return a range of strips as a file has it, such as ``0:17`` or ``1:100-120``."""
    return f"{sheet}:{first}" if first == last else f"{sheet}:{first}-{last}"
