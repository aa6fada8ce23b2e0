"""Simulate, reconstruct and design trackers made of cylindrical GEM layers and drift chambers.

`run` calls the stages in order; `__init__.pyi` lists the public names. Each is imported when it is first used, since
numpy, scipy and matplotlib take half a second.
"""

from __future__ import annotations

import ast
import importlib
from functools import cache
from pathlib import Path
from typing import Any


@cache
def _public() -> dict[str, tuple[str, str]]:
    """Return the module and the name there of each public name, as `__init__.pyi` imports them."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def __getattr__(name: str) -> Any:
    if name == "__all__":  # `open` would shadow the builtin one
        return [public for public in _public() if public != "open"]
    if name not in _public():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _public()[name]
    parent = importlib.import_module(f"cgemit.{module}".rstrip("."))
    if not hasattr(parent, "__path__"):
        return getattr(parent, attribute)
    return importlib.import_module(f"{parent.__name__}.{attribute}")


def __dir__() -> list[str]:
    return sorted(_public())
