"""What users can reach is documented: a sentence, and every parameter by name (numpydoc)."""

from __future__ import annotations

import dataclasses
import enum
import importlib
import inspect
import re
from collections.abc import Callable
from typing import Any

PACKAGES = ("cgemit", "cgemit.detector", "cgemit.tables", "cgemit.study", "cgemit.draw")
MODULES = (
    "helix",
    "particles.table",
    "reconstruction.candidates",
    "reconstruction.cluster",
    "reconstruction.find.ckf",
    "reconstruction.find.loops",
    "simulation.digitize",
    "simulation.transport",
    "truth.assign",
    "truth.finder",
    "truth.match",
    "truth.origins",
)


def public() -> dict[str, Any]:
    """Collect classes, their methods and functions that users can reach, by full name."""
    found: dict[str, Any] = {}
    for name in (*PACKAGES, *(f"cgemit.{module}" for module in MODULES)):
        module = importlib.import_module(name)
        for item in getattr(module, "__all__", None) or own_names(module):
            thing = getattr(module, item)
            if inspect.isfunction(inspect.unwrap(thing)) or inspect.isclass(thing):
                found[f"{thing.__module__}.{thing.__qualname__}"] = thing
            if inspect.isclass(thing) and thing.__module__.startswith("cgemit"):
                methods = {n: m for n, m in vars(thing).items() if not n.startswith("_") and inspect.isfunction(m)}
                found |= {f"{m.__module__}.{m.__qualname__}": m for m in methods.values()}
    return {name: thing for name, thing in found.items() if name.startswith("cgemit") and "_core" not in name}


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
