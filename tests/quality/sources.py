"""The source tree as the quality tests see it: what imports what."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "src" / "cgemit"
CORE = ROOT / "src" / "cpp"


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """Return all nodes of a module's syntax tree.

    Parameters
    ----------
    source : str
    """
    return tuple(ast.walk(ast.parse(source)))


def imports(source: str, package: str) -> Iterator[str]:
    """Yield the full names of what a module imports, inside functions and under TYPE_CHECKING too.

    Parameters
    ----------
    source : str
    package : str
        Dotted name of the package that the module lies in, for relative imports.
    """
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) + 1 - node.level]) if node.level else ""
            start = ".".join(filter(None, (base, node.module)))
            yield from (f"{start}.{name.name}" for name in node.names)


def python_files() -> list[Path]:
    """Return the modules of the package."""
    return sorted(PACKAGE.rglob("*.py"))


def top(path: Path) -> str:
    """Return the module or sub-package of `cgemit` that a file belongs to."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def module_of(path: Path) -> str:
    """Return the dotted name of a module, or of the package whose `__init__` it is."""
    name = package_of(path)
    return name if path.stem == "__init__" else f"{name}.{path.stem}"


def package_of(path: Path) -> str:
    """Return the dotted name of the package that a file lies in."""
    return ".".join(("cgemit", *path.relative_to(PACKAGE).parts[:-1]))


def included(source: str) -> list[tuple[str, bool]]:
    """Return what a C++ file includes: name, and whether in quotes (our own)."""
    found = re.findall(r'^\s*#\s*include\s*(["<])([^">]+)', source, re.MULTILINE)
    return [(name, quote == '"') for quote, name in found]
