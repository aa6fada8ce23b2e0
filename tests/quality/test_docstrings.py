"""What users can reach is documented: a sentence, and every parameter by name (numpydoc)."""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

PACKAGES = ("cgemit", "cgemit.detector", "cgemit.tables", "cgemit.study", "cgemit.draw")
ROOT = Path(__file__).parents[2]


def listed() -> list[str]:
    """List the full names that the reference of the site documents."""
    return [
        name
        for page in sorted((ROOT / "docs" / "reference").glob("*.md"))
        for name in re.findall(r"^\.\. auto\w+:: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    ]


def exported() -> list[str]:
    """List the full names that the packages of users hold."""
    modules = {name: importlib.import_module(name) for name in PACKAGES}
    return [f"{name}.{item}" for name, m in modules.items() for item in getattr(m, "__all__", None) or own_names(m)]


def public() -> dict[str, Any]:
    """Collect classes, their methods and functions that users can reach, by full name."""
    things: dict[str, Any] = {}
    for name in (*exported(), *listed()):
        module, _, item = name.rpartition(".")
        thing = getattr(importlib.import_module(module), item)
        if inspect.isfunction(inspect.unwrap(thing)) or inspect.isclass(thing):
            things[f"{thing.__module__}.{thing.__qualname__}"] = thing
        if inspect.isclass(thing) and thing.__module__.startswith("cgemit"):
            methods = {n: m for n, m in vars(thing).items() if not n.startswith("_") and inspect.isfunction(m)}
            things |= {f"{m.__module__}.{m.__qualname__}": m for m in methods.values()}
    return {name: thing for name, thing in things.items() if name.startswith("cgemit") and "_core" not in name}


def own_names(module: Any) -> list[str]:
    """List the public functions and classes that a module defines itself."""
    return [
        n for n, t in vars(module).items() if not n.startswith("_") and getattr(t, "__module__", "") == module.__name__
    ]


def problems(thing: Callable[..., Any] | type) -> list[str]:
    """List what the docstring lacks, and what it explains that is not there."""
    doc = inspect.getdoc(thing) or ""
    if not doc.split("\n\n")[0].rstrip().endswith((".", ":")):
        return ["no docstring that begins with a sentence"]
    if inspect.isclass(thing) and issubclass(thing, enum.Enum | BaseException):
        return []
    explained = names_in(doc, "Parameters") | names_in(doc, "Attributes")
    have = parameters(thing)
    found = []
    # The fields of a dataclass may explain themselves, by comments and units beside them.
    missing = [] if dataclasses.is_dataclass(thing) else [n for n in have if n not in explained and f"`{n}`" not in doc]
    # The sentence of a method says what its only parameter is.
    if missing and not ("." in thing.__qualname__ and len(have) == 1):
        found.append(f"not documented: {', '.join(missing)}")
    stale = sorted(name for name in explained if name not in have and not hasattr(thing, name))
    if stale:
        found.append(f"documented but not there: {', '.join(stale)}")
    return found


def parameters(thing: Callable[..., Any] | type) -> list[str]:
    """List the parameters that a user gives."""
    if dataclasses.is_dataclass(thing):
        return [field.name for field in dataclasses.fields(thing)]
    if inspect.isclass(thing) and "__init__" not in vars(thing):
        return []
    return [name for name in inspect.signature(inspect.unwrap(thing)).parameters if name not in ("self", "cls")]


def names_in(doc: str, heading: str) -> set[str]:
    """Return the names that a numpydoc section explains."""
    section = re.search(rf"^{heading}\n-+\n(.*?)(?=^\w[^\n]*\n---|\Z)", doc, re.MULTILINE | re.DOTALL)
    entries = re.findall(r"^(\S[^\n:]*?)\s*(?::|$)", section[1], re.MULTILINE) if section else []
    return {name.strip().lstrip("*") for entry in entries for name in entry.split(",")}


def test_docstrings_name_every_parameter() -> None:
    things = public()
    assert len(things) > 100
    assert not {name: found for name, thing in things.items() if (found := problems(thing))}


def stale_names(source: str) -> dict[str, set[str]]:
    """Return the parameters that docstrings of a module explain, and that the functions do not have."""
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    explained = {node: names_in(ast.get_docstring(node) or "", "Parameters") for node in functions}
    have = {node: {one.arg for one in ast.walk(node.args) if isinstance(one, ast.arg)} for node in functions}
    return {node.name: stale for node in functions if (stale := explained[node] - have[node])}


def test_no_docstring_explains_what_is_not_there() -> None:
    """Functions that users do not reach, too: they need no list of parameters, but none may be wrong."""
    modules = {path: path.read_text(encoding="utf-8") for path in (ROOT / "src" / "cgemit").rglob("*.py")}
    assert not {path.name: stale for path, source in modules.items() if (stale := stale_names(source))}
    assert len(modules) > 100
    source = (
        'def f(a: int, *b: int) -> None:\n    """Do.\n\n    Parameters\n    ----------\n    a, *b, c : int\n    """'
    )
    assert stale_names(source) == {"f": {"c"}}


def test_a_wrong_docstring_is_seen() -> None:
    def documented(a: int, *, b: int) -> None:
        """Do something.

        Parameters
        ----------
        a, b : int
        """

    def not_documented(a: int, c: int) -> None:
        """Do something.

        Parameters
        ----------
        a : int
            Not c.
        """

    def stale(a: int) -> None:
        """Do something.

        Parameters
        ----------
        a : int
        b : int
        """

    assert not problems(documented)
    assert problems(stale) == ["documented but not there: b"]
    assert problems(not_documented) == ["not documented: c"]
    assert problems(lambda: None)
