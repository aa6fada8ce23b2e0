"""docs/data_model.md: every table and column, from the schemas."""

from __future__ import annotations

import re

from cgemit.tables.schema import ROWS, SCHEMAS, Column
from pages.page import Found, Page, table

#: What ends the meanings of the columns of a vector.
AXIS = r", [xyz]$"


def blocks(found: Found) -> dict[str, str]:
    """Return a section for each kind of table."""
    return {"schemas": "\n\n".join(_section(kind, columns) for kind, columns in SCHEMAS.items())}


def _section(kind: str, columns: tuple[Column, ...]) -> str:
    head = f"## {kind}\n\nOne row: {ROWS[kind]}."
    if alike := [other for other in SCHEMAS if SCHEMAS[other] == columns and other != kind and kind.endswith(other)]:
        return f"{head} Columns are those of `{alike[0]}`."
    groups = _groups(tuple(column for column in columns if column.name != "event"))
    return f"{head}\n\n{table(['column', 'type', 'meaning'], [_row(group) for group in groups])}"


def _groups(columns: tuple[Column, ...]) -> list[list[Column]]:
    """Return runs of columns that differ in their name and in a last word x, y or z of their meaning."""
    groups: list[list[Column]] = []
    for column in columns:
        last = groups[-1][-1] if groups else None
        if last and re.search(AXIS, column.doc) and _alike(last) == _alike(column):
            groups[-1].append(column)
        else:
            groups.append([column])
    return groups


def _alike(column: Column) -> tuple[object, ...]:
    return re.sub(AXIS, "", column.doc), column.dtype, column.shape, column.unit, column.links


def _row(group: list[Column]) -> list[str]:
    column = group[0]
    names = ", ".join(f"`{one.name}`" for one in group)
    links = [column.links] if isinstance(column.links, str) else list(dict.fromkeys(column.links or ()))
    meaning = re.sub(AXIS, "", column.doc) if len(group) > 1 else column.doc
    meaning += f" (row of {' or '.join(f'`{link}`' for link in links)})" if links else ""
    shape = f" ({', '.join(map(str, column.shape))})" if column.shape else ""
    return [names, f"{column.dtype}{shape}{f', {column.unit}' * bool(column.unit)}", meaning]


PAGE = Page("data_model", "docs/data_model.md", "no time", blocks=blocks)
