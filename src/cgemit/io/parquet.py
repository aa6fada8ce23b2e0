"""Columns in Parquet files, with one JSON text (pyarrow)."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.io.files import check_unpacked, new_file
from cgemit.io.packages import package

_KEY = b"cgemit"  # of the JSON text


def write_parquet(path: Path, columns: Mapping[str, np.ndarray[Any, Any]], about: Mapping[str, Any]) -> None:
    """Write columns (n,) and what is said about them."""
    pyarrow, parquet = package("pyarrow"), package("pyarrow.parquet")
    table = pyarrow.table(dict(columns))
    parquet.write_table(table.replace_schema_metadata({_KEY: json.dumps(dict(about), allow_nan=False)}), path)


def write_columns(path: str | os.PathLike[str], columns: Mapping[str, Any], *, overwrite: bool = False) -> Path:
    """Write columns of any origin as a Parquet file for other programs."""
    pyarrow, parquet = package("pyarrow"), package("pyarrow.parquet")
    with new_file(path, overwrite=overwrite) as temporary:
        parquet.write_table(pyarrow.table(dict(columns)), temporary)
    return Path(path)


def read_parquet(
    path: Path, names: Collection[str] | None = None
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Read what `write_parquet` wrote: all columns, or those named.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or was not written by `write_parquet`.
    """
    parquet = package("pyarrow.parquet")
    try:
        with parquet.ParquetFile(path) as file:
            schema = file.schema_arrow
            about = json.loads(schema.metadata[_KEY])
            width = sum(field.type.bit_width for field in schema) // 8
            check_unpacked(path.stat().st_size, file.metadata.num_rows * width)
            table = file.read(columns=None if names is None else list(names), use_threads=False)
        if not isinstance(about, dict):
            raise ValueError(f"its JSON text holds {about!r:.50}, not an object")
        return {name: table[name].to_numpy() for name in table.column_names}, about
    except FileNotFoundError:
        raise
    except Exception as error:  # of pyarrow and json: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete Parquet file of cgemit ({error})") from error
