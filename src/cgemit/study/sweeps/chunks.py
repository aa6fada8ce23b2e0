"""Results of a sweep in files named by what they are results of: complete, checked, or absent."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cgemit.io.files import new_file
from cgemit.version import PHYSICS

FORMAT = "cgemit-sweep-2"
#: Folder of the chunks in the output of a sweep.
CHUNKS = "chunks"


def address(evaluation: Mapping[str, Any], variants: Sequence[tuple[str, Mapping[str, Any]]]) -> str:
    """Return the name of a chunk: a hash of all that its results depend on.

    Parameters
    ----------
    evaluation : mapping
        Method, seed and the rest of what is evaluated, as JSON.
    variants : sequence of (str, mapping)
        Fingerprint of the detector that each variant changes, and its changes.
    """
    text = json.dumps([FORMAT, PHYSICS, evaluation, [list(one) for one in variants]], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def write_chunk(folder: Path, name: str, payload: str) -> None:
    """Write rows (`text_of_rows`) of a chunk under a temporary name, which becomes the chunk's when all is written."""
    record = {"format": FORMAT, "chunk": name, "sha256": _checksum(payload), "rows": payload}
    with new_file(folder / f"{name}.json", overwrite=True) as temporary:
        temporary.write_text(json.dumps(record) + "\n", encoding="utf-8")


def read_chunk(folder: Path, name: str, count: int) -> list[dict[str, Any]] | None:
    """Return the rows of a chunk with `count` variants; None if there is none, or a damaged one."""
    try:
        record = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
        payload = record["rows"]
        good = record["format"] == FORMAT and record["chunk"] == name and record["sha256"] == _checksum(payload)
        rows = rows_of_text(payload)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return rows if good and len(rows) == count else None


def clean(folder: Path, names: Sequence[str]) -> None:
    """Remove what interrupted writers of these chunks left behind; all chunks must be complete."""
    for name in names:
        for left in folder.glob(f".{name}-*.tmp.json"):
            left.unlink(missing_ok=True)


def _checksum(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def text_of_rows(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows as JSON: how workers send them and files hold them, so that results do not depend on files."""
    try:
        return json.dumps(rows, allow_nan=False)
    except (TypeError, ValueError):  # some number that JSON cannot hold
        return json.dumps([_without_nan(row) for row in rows], allow_nan=False)


def rows_of_text(text: str) -> list[dict[str, Any]]:
    """Return the rows of `text_of_rows`."""
    rows = json.loads(text)
    return [_with_nan(row) for row in rows] if '{"float":' in text else rows


def _without_nan(value: Any) -> Any:
    """Return a value with numbers that JSON cannot hold as ``{"float": "nan"}``."""
    if isinstance(value, Mapping):
        return {key: _without_nan(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(one) for one in value]
    return {"float": repr(value)} if isinstance(value, float) and not math.isfinite(value) else value


def _with_nan(value: Any) -> Any:
    if isinstance(value, dict):
        if value.keys() == {"float"}:
            return float(value["float"])
        return {key: _with_nan(one) for key, one in value.items()}
    return [_with_nan(one) for one in value] if isinstance(value, list) else value
