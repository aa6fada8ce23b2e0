"""docs/data_model.md: every table and column, from the schemas."""

from __future__ import annotations

from cgemit.tables.schema import ROWS, SCHEMAS, Column
from pages.page import Found, Page, table


def blocks(found: Found) -> dict[str, str]:
    """Return a section for each kind of table."""
    return {"schemas": "\n\n".join(_section(kind, columns) for kind, columns in SCHEMAS.items())}


def _section(kind: str, columns: tuple[Column, ...]) -> str:
    rows = table(["column", "dtype", "unit", "meaning", "links to"], [_row(column) for column in columns])
    return f"## {kind}\n\nOne row: {ROWS[kind]}.\n\n{rows}"


def _row(column: Column) -> list[str]:
    links = column.links if isinstance(column.links, str) else ", ".join(dict.fromkeys(column.links or ()))
    shape = f" ({', '.join(map(str, column.shape))})" if column.shape else ""
    return [f"`{column.name}`", f"{column.dtype}{shape}", column.unit, column.doc, links]


PAGE = Page("data_model", "docs/data_model.md", "no time", blocks=blocks)
