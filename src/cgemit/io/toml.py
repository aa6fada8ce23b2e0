"""Nested tables: as TOML text, which `tomllib` reads back to equal tables, and by dotted paths."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

_LARGEST, _LONGEST_LINE = 1_000_000, 4_000  # characters; the time to read dotted keys grows with their square


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises
    ------
    ValueError
        If it is no TOML, or too large or too deeply nested to be read.
    """
    if len(text) > _LARGEST or max(map(len, text.splitlines()), default=0) > _LONGEST_LINE:
        raise ValueError(f"more than {_LARGEST} characters, or more than {_LONGEST_LINE} in a line")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("too many levels of nesting") from None


def toml_text(
    tables: Mapping[str, Any],
    *,
    in_place: Collection[str] = (),
    comment: Callable[[str], str] | None = None,
) -> str:
    """Return nested tables as the text of a TOML file.

    Parameters
    ----------
    tables : mapping
        Of str to bool, int, float, str, lists and mappings of these. TOML has no null.
    in_place : collection of str
        Names of tables that are written as ``name = { ... }`` instead of ``[name]``.
    comment : callable or None
        Returns what is written behind a value as a comment, given its dotted path; an empty text for nothing.

    Returns
    -------
    str
        Floats with all digits.
    """
    lines: list[str] = []
    _write_table(lines, "", tables, in_place, comment or (lambda _: ""))
    return "\n".join(lines).strip() + "\n"


def _write_table(
    lines: list[str], path: str, table: Mapping[str, Any], in_place: Collection[str], comment: Callable[[str], str]
) -> None:
    """Append a table: first its values, then its tables."""
    inner = {name: v for name, v in table.items() if isinstance(v, Mapping) and name not in in_place}
    values = {name: v for name, v in table.items() if name not in inner}
    if path and (values or not inner):
        lines += ["", f"[{path}]"]
    before = f"{path}." if path else ""
    for name, value in values.items():
        about = comment(before + name)
        lines.append(f"{_name(name)} = {_text(value)}" + (f"  # {about}" if about else ""))
    for name, sub in inner.items():
        _write_table(lines, before + _name(name), sub, in_place, comment)


def _name(name: str) -> str:
    bare = name.replace("_", "").replace("-", "")
    return name if bare.isascii() and bare.isalnum() else _quoted(name)


def _text(value: Any) -> str:
    if isinstance(value, list) and any(isinstance(row, Mapping) for row in value):
        rows = "".join(f"\n    {_text(row)}," for row in value)
        return f"[{rows}\n]"
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_name(name)} = {_text(v)}" for name, v in value.items()) + " }"
    if isinstance(value, bool):
        return str(value).lower()
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    # JSON strings are TOML strings except for DEL, which TOML wants escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def nested(path: str, value: object) -> dict[str, Any]:
    """Return tables that hold one value at a dotted path."""
    *parents, last = path.split(".")
    tables: dict[str, Any] = {last: value}
    for name in reversed(parents):
        tables = {name: tables}
    return tables


def flat(path: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield the dotted path and the value of everything in nested tables."""
    if not isinstance(value, Mapping):
        yield path, value
        return
    for name, inner in value.items():
        yield from flat(f"{path}.{name}" if path else str(name), inner)
