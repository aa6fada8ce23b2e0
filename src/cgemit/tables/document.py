"""The page `docs/data_model.md`, written from the schemas."""

from __future__ import annotations

import sys

from cgemit.tables.columns import Column
from cgemit.tables.schemas import ROWS, SCHEMAS

_INTRODUCTION = """# Data model

Stages meet in tables: plain numpy columns, one row per object, sorted by `event`. This page is written from
`cgemit.tables.SCHEMAS` (`python -m cgemit.tables.document > docs/data_model.md`); a test keeps it up to date.

- Units are those of every number in the program: mm, ns, GeV, GeV/c, rad, e; strip charge in fC, energy deposits
  in keV.
- `event` is the global event number. Rows `offsets[i]` to `offsets[i + 1]` of a table belong to event
  `first_event + i`; an event without rows has none there.
- A column that links counts rows of another table, from 0; -1 means none. Links hold for tables as a stage returned
  them or `concatenate` joined them, not after rows were picked. `Result.select_events` keeps them for some events,
  and `Result.to_awkward` gives lists per event in which links count within the event.
- `status` tells how a row ended (`TransportStatus` for particles, `FitStatus` for tracks, `StateStatus` for
  states). Rows of every status are kept; a value that does not exist is NaN.
- Columns cannot be written; `with_columns` returns a new table, in which further columns may follow those below.

In a file (`Table.save`, `.npz`) each column is an array of the same name, beside `offsets` and the JSON text
`__meta__` with version, units, event range, and the configuration hash and seed of the run.
"""


def data_model() -> str:
    """Return the page as Markdown."""
    return "\n".join([_INTRODUCTION, *(_section(kind, columns) for kind, columns in SCHEMAS.items())])


def _section(kind: str, columns: tuple[Column, ...]) -> str:
    head = "| column | dtype | unit | meaning | links to |\n|---|---|---|---|---|\n"
    return f"## {kind}\n\nOne row: {ROWS[kind]}.\n\n" + head + "".join(_row(column) for column in columns)


def _row(column: Column) -> str:
    links = column.links if isinstance(column.links, str) else ", ".join(dict.fromkeys(column.links or ()))
    shape = f" ({', '.join(map(str, column.shape))})" if column.shape else ""
    return f"| `{column.name}` | {column.dtype}{shape} | {column.unit} | {column.doc} | {links} |\n"


if __name__ == "__main__":
    sys.stdout.write(data_model())
