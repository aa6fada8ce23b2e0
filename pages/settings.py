"""docs/settings.md: tables of all settings, made from their classes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from typing import Any

from cgemit.base.validate import Choice, classes_in, expected, kinds_of
from cgemit.chain.settings import Settings
from pages.page import Found, Page, table

Rows = Sequence[Sequence[str]]

#: Words of allowed values, and what replaces them in the tables.
SHORT = {
    r"one of ": "", r"zero or a positive number": "≥ 0", r"a positive number": "> 0", r"a finite number": "number",
    r"an? [\w ]+? above 0 and up to ": "> 0, ≤ ", r"an? [\w ]+? from (\S+) to ": r"\1 to ",
}  # fmt: skip


def blocks(found: Found) -> dict[str, str]:
    """Return the tables of all settings."""
    return {"settings": "".join(part for stage, cls in kinds_of(Settings).items() for part in sections(stage, cls))}


def sections(path: str, cls: type[Any], name: str = "", like: str = "", others: Rows = ()) -> Iterator[str]:
    """Yield the table of a class of settings, then the tables of the classes that its settings may hold.

    `others` are the rows of the class `like` that this class resembles: only rows that differ are in the table.
    """
    choice = f' with `name = "{name}"`' if name else ""
    note = f"As `{like}`, but for:\n\n" if like else ""
    rows = table(["setting", "default", "allowed", "meaning"], [row for row in rows_of(cls) if row not in others])
    yield f"\n### `[{path}]`{choice}: {cls.__name__}\n\n{note}{rows}\n"
    for field, kind in kinds_of(cls).items():
        known: dict[str, Rows] = {}
        for inner_name, inner in classes_in(kind).items():
            own = rows_of(inner)
            alike = [one for one, rows in known.items() if 2 * sum(row in rows for row in own) > len(own)]
            first = alike[0] if alike else ""
            yield from sections(f"{path}.{field}", inner, inner_name, first, known.get(first, ()))
            known[inner_name] = own


def rows_of(cls: type[Any]) -> Rows:
    """Return name, default, allowed values and meaning of each setting of a class."""
    settings, about, rows = cls(), meanings(cls), []
    for field, kind in kinds_of(cls).items():
        value = getattr(settings, field)
        default = f'"{value.name}"' if isinstance(kind, Choice) else shown(value)
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
    """Return the description of each attribute from the docstrings of a class and those it is made from."""
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
    return found


PAGE = Page("settings", "docs/settings.md", "no time", blocks=blocks)
