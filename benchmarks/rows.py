"""Files of the numbers that the programs of this folder measure."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent


def write_rows(name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same keys to a file of this folder."""
    with (HERE / name).open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
