"""docs/data_model.md: every table and column, from the schemas."""

from __future__ import annotations

import itertools
import re

import numpy as np

from cgemit.tables.schema import ROWS, SCHEMAS, Column
from pages.page import Found, Page, table

#: What ends the meanings of the columns of a vector.
AXIS = r", [xyz]$"
LEAST_FAMILY = 3  # columns of a prefix that share a row
LEAST_SHARED = 2  # rows that an earlier table has, too, for one row instead


def blocks(found: Found) -> dict[str, str]:
    """Return a section for each kind of table."""
    return {"schemas": "\n\n".join(_section(kind, columns) for kind, columns in SCHEMAS.items())}


def _section(kind: str, columns: tuple[Column, ...]) -> str:
    head = f"## {kind}\n\nOne row: {ROWS[kind]}."
    if alike := [other for other in SCHEMAS if SCHEMAS[other] == columns and other != kind and kind.endswith(other)]:
        return f"{head} Columns are those of `{alike[0]}`."
    own = tuple(column for column in columns if column.name != "event")
    rows = []
    for other, shared in _shared(kind, own).items():
        own = tuple(column for column in own if column not in shared)
        rows.append([", ".join(f"`{one.name}`" for one in shared), "", f"as in [{other}](#{other})"])
    return f"{head}\n\n{table(['column', 'type, unit', 'meaning'], [*map(_row, _groups(own)), *rows])}"


def _shared(kind: str, columns: tuple[Column, ...]) -> dict[str, list[Column]]:
    """Return the columns that stand in earlier tables, by the table that has most of them."""
    found: dict[str, list[Column]] = {}
    earlier = list(itertools.takewhile(lambda other: other != kind, SCHEMAS))
    while True:
        left = [column for column in columns if column not in itertools.chain(*found.values())]
        most = max(earlier, key=lambda other: len([one for one in left if one in SCHEMAS[other]]), default=kind)
        shared = [column for column in left if most != kind and column in SCHEMAS[most]]
        if len(_groups(tuple(shared))) < LEAST_SHARED:
            return found
        found[most] = shared


def _groups(columns: tuple[Column, ...]) -> list[list[Column]]:
    """Return columns that share a row: vectors, and families of a prefix such as `err_dr`, `err_phi0`, ..."""
    families: dict[str | tuple[str, ...], list[Column]] = {}
    for column in columns:
        families.setdefault(_family(column), []).append(column)
    groups: list[list[Column]] = []
    for column in columns:
        last = groups[-1][-1] if groups else None
        family = families[_family(column)]
        if len(family) >= LEAST_FAMILY:
            groups += [family] if column is family[0] else []
        elif last and re.search(AXIS, column.doc) and _alike(last) == _alike(column):
            groups[-1].append(column)
        else:
            groups.append([column])
    return groups


def _family(column: Column) -> str | tuple[str, ...]:
    """Return what columns of a family have in common: prefix, meaning without the suffix, type."""
    prefix, _, suffix = column.name.partition("_")
    meaning = _without(suffix, column.doc)
    if not suffix or meaning == column.doc or re.search(AXIS, column.doc):
        return column.name
    return prefix, meaning, str(column.dtype), str(column.shape), str(column.links)


def _without(suffix: str, doc: str) -> str:
    return re.sub(rf"(?<![A-Za-z0-9]){re.escape(suffix)}(?![A-Za-z0-9])", "…", doc)


def _alike(column: Column) -> tuple[object, ...]:
    return re.sub(AXIS, "", column.doc), column.dtype, column.shape, column.unit, column.links


def _row(group: list[Column]) -> list[str]:
    column = group[0]
    names = ", ".join(f"`{one.name}`" for one in group)
    links = [column.links] if isinstance(column.links, str) else list(dict.fromkeys(column.links or ()))
    family = _family(column)
    meaning = re.sub(AXIS, "", column.doc) if len(group) > 1 else column.doc
    if len(group) > 1 and isinstance(family, tuple):
        meaning = family[1]
    meaning += f" (row of {' or '.join(f'`{link}`' for link in links)})" if links else ""
    shape = f" ({', '.join(map(str, column.shape))})" if column.shape else ""
    kind = f"{column.dtype}{shape}" if column.dtype != np.float64 or shape else ""
    unit = column.unit if len({one.unit for one in group}) == 1 else ""
    return [names, ", ".join(text for text in (kind, unit) if text), meaning]


PAGE = Page("data_model", "docs/data_model.md", "no time", blocks=blocks)
