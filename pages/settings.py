"""docs/settings.md: tables of all settings and of the keys of readouts, made from their classes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from typing import Any

from cgemit.base.validate import expected, kinds_of
from cgemit.chain.settings import Settings
from cgemit.detector.keys import keys_of
from cgemit.detector.readouts import READOUTS, Readout
from cgemit.units import NATIVE, format_quantity
from pages.page import Found, Page, table

Rows = Sequence[Sequence[str]]

#: Words of allowed values, and what replaces them in the tables.
SHORT = {
    r"one of ": "", r"zero or a positive number": "≥ 0", r"a positive number": "> 0", r"a finite number": "number",
    r"an? [\w ]+? above 0 and up to ": "> 0, ≤ ", r"an? \w+ in (\S+) above 0, up to (\S+)": r"> 0, ≤ \2 \1",
    r"an? \w+ in (\S+) above ([^\s,]+)": r"> \2 \1", r"a number of at least ": "≥ ",
    r"an? [\w ]+? above 0, up to ": "> 0, ≤ ", r"an? \w+ in (\S+) from (\S+) to ([^\s,]+)": r"\2 to \3 \1",
    r"an? [\w ]+? from (\S+) to ": r"\1 to ",
}  # fmt: skip


def blocks(found: Found) -> dict[str, str]:
    """Return the tables of all settings, and of the keys of all readouts."""
    stages = (
        section(f"`[{stage}]`: {cls.__name__}", "setting", rows_of(cls)) for stage, cls in kinds_of(Settings).items()
    )
    return {"settings": "".join(stages), "readouts": "".join(readouts())}


def section(title: str, key: str, rows: Rows, note: str = "") -> str:
    """Return a title and a table; `key` heads the first column, `note` stands above."""
    return f"\n### {title}\n\n{note}{table([key, 'default', 'allowed', 'meaning'], rows)}\n"


def readouts() -> Iterator[str]:
    """Yield the table of each readout: of one that resembles an earlier one, only the rows that differ."""
    known: dict[str, Rows] = {}
    for name, cls in READOUTS.items():
        rows = rows_of(cls)
        like = next((one for one, of in known.items() if 2 * sum(row in of for row in rows) > len(rows)), "")
        own = [row for row in rows if row not in known.get(like, ())]
        note = f"As `{like}`, but for:\n\n" if like else ""
        yield section(f'`[cgem.NAME.readout]` with `name = "{name}"`: {cls.__name__}', "key", own, note)
        known[name] = rows


def rows_of(cls: type[Any]) -> Rows:
    """Return name, default, allowed values and meaning of each setting of a class; of a readout as in a file."""
    settings, about, rows = cls(), meanings(cls), []
    keys = keys_of(cls) if issubclass(cls, Readout) else {}
    for field, kind in kinds_of(cls).items():
        value = getattr(settings, field)
        has_unit = field in keys and NATIVE.get(keys[field].kind)
        default = f'"{format_quantity(value, keys[field].kind)}"' if has_unit else shown(value)
        allowed = "" if kind is bool else _short(expected(kind))
        cells = [f"`{field}`", default, allowed, about.get(field, "")]
        rows.append([cell.replace("|", r"\|") for cell in cells])
    return rows


def _short(text: str) -> str:
    """Return allowed values in a few words."""
    for words, short in SHORT.items():
        text = re.sub(words, short, text)
    return text


def shown(value: object) -> str:
    """Return a default in the notation of a file."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(shown, value))}]"
    if isinstance(value, bool) or value is None:
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)


def meanings(cls: type[Any]) -> dict[str, str]:
    """Return the description of each setting from the docstrings of a class and those it is made from."""
    found: dict[str, str] = {}
    for one in reversed(cls.__mro__):
        section = re.search(
            r"Attributes\n-+\n(.*?)(?:\n\n|\Z)", inspect.cleandoc(vars(one).get("__doc__") or ""), re.DOTALL
        )
        entries = re.split(r"^(\w+(?:, \w+)*) : .*\n?", section[1] if section else "", flags=re.MULTILINE)[1:]
        for names, text in zip(entries[::2], entries[1::2], strict=True):
            meaning = " ".join(text.split()).replace("``", "`")
            linked = re.sub(r"docs/(methods/(\w+)\.md)", r"[\2](\1)", meaning)
            found |= dict.fromkeys(names.split(", "), linked)
    return {name: meaning for name, meaning in found.items() if name in kinds_of(cls)}  # without class variables


PAGE = Page("settings", "docs/settings.md", "no time", blocks=blocks)
