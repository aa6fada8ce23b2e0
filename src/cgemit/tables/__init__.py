"""Tables: plain numpy columns, one row per object, with per-event offsets. All stages meet in them."""

from cgemit.tables.schema import PARAMETERS, ROWS, SCHEMAS, Column
from cgemit.tables.store import concatenate, load_tables, save_tables, select_events
from cgemit.tables.table import Row, Table

__all__ = [
    "PARAMETERS",
    "ROWS",
    "SCHEMAS",
    "Column",
    "Row",
    "Table",
    "concatenate",
    "load_tables",
    "save_tables",
    "select_events",
]
