"""docs/settings.md: tables of all settings, made from their classes."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

from cgemit.base.validate import Choice, classes_in, expected, kinds_of
from cgemit.chain.settings import Settings
from pages.page import Found, Page, table


def blocks(found: Found) -> dict[str, str]:
    """Return the tables of all settings."""
    return {"settings": "".join(part for stage, cls in kinds_of(Settings).items() for part in sections(stage, cls))}


def sections(path: str, cls: type[Any], name: str = "") -> Iterator[str]:
    """Yield the table of a class of settings, then the tables of the classes that its settings may hold."""
    choice = f' with `name = "{name}"`' if name else ""
    settings, about, lines = cls(), meanings(cls), []
    for field, kind in kinds_of(cls).items():
        value = getattr(settings, field)
        default = f'"{value.name}"' if isinstance(kind, Choice) else shown(value)
        cells = [f"`{field}`", default, expected(kind), about.get(field, "")]
        lines.append([cell.replace("|", r"\|") for cell in cells])
    rows = table(["setting", "default", "allowed", "meaning"], lines)
    yield f"\n### `[{path}]`{choice}: {cls.__name__}\n\n{rows}\n"
    for field, kind in kinds_of(cls).items():
        for inner_name, inner in classes_in(kind).items():
            yield from sections(f"{path}.{field}", inner, inner_name)


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
            found |= dict.fromkeys(names.split(", "), " ".join(text.split()).replace("``", "`"))
    return found


PAGE = Page("settings", "docs/settings.md", "no time", blocks=blocks)
