"""Columns as the branches of one TTree in a ROOT file, with one JSON text (uproot)."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.io.files import check_unpacked
from cgemit.io.packages import package

_KEY = "cgemit"  # of the JSON text, a TObjString


def write_root(path: Path, tree: str, columns: Mapping[str, np.ndarray[Any, Any]], about: Mapping[str, Any]) -> None:
    """Write columns (n, ...) as a tree, and what is said about them."""
    branches = {name: (column.dtype, column.shape[1:]) for name, column in columns.items()}
    with package("uproot").recreate(path) as file:
        made = file.mktree(tree, branches)
        if len(next(iter(columns.values()))):
            made.extend(dict(columns))
        file[_KEY] = json.dumps(dict(about), allow_nan=False)


def read_root(
    path: Path, names: Collection[str] | None = None
) -> tuple[dict[str, np.ndarray[Any, Any]], dict[str, Any]]:
    """Read what `write_root` wrote: all columns, or those named.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is damaged or was not written by `write_root`.
    """
    uproot = package("uproot")
    try:
        with uproot.open(path) as file:
            about = json.loads(str(file[_KEY]))
            if not isinstance(about, dict):
                raise ValueError(f"its JSON text holds {about!r:.50}, not an object")
            tree = file[about["kind"]]
            width = sum(branch.interpretation.numpy_dtype.itemsize for branch in tree.branches)
            check_unpacked(path.stat().st_size, tree.num_entries * width)
            wanted = None if names is None else [name for name in names if name in tree]
            arrays = tree.arrays(wanted, library="np")
        return {str(name): np.asarray(column) for name, column in arrays.items()}, about
    except FileNotFoundError:
        raise
    except Exception as error:  # of uproot and json: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete ROOT file of cgemit ({error})") from error
