"""Tables: plain numpy columns, one row per object, with per-event offsets. All stages meet in them."""

from cgemit.tables.columns import Column
from cgemit.tables.files import save_tables
from cgemit.tables.join import concatenate, select_events
from cgemit.tables.schemas import ROWS, SCHEMAS
from cgemit.tables.stored import load_tables
from cgemit.tables.table import Table
from cgemit.tables.track_schemas import PARAMETERS

__all__ = [
    "PARAMETERS",
    "ROWS",
    "SCHEMAS",
    "Column",
    "Table",
    "concatenate",
    "load_tables",
    "save_tables",
    "select_events",
]
