"""Every public function and class has a place in the reference and examples, which print what they show."""

from __future__ import annotations

import doctest
import importlib
import inspect
import operator
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sources import PACKAGE, ROOT

import cgemit as cg
from cgemit.detector.readouts import READOUTS

#: Modules whose names are public; the first lists other modules, too.
PUBLIC = (
    "cgemit",
    *(f"cgemit.{name}" for name in ("study", "draw", "detector", "tables", "helix", "units", "base.isa")),
)
MODULES = sorted(
    ".".join(("cgemit", *path.relative_to(PACKAGE).with_suffix("").parts))
    for path in PACKAGE.rglob("*.py")
    if ">>> " in path.read_text(encoding="utf-8")
)
#: Needs a file of the experiment.
NOT_RUN = {"cgemit.draw.curves.draw_refit"}


def examples(text: str) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(text)


def public() -> dict[str, Any]:
    """Return the public functions and classes by name."""
    found = {}
    for module in map(importlib.import_module, PUBLIC):
        things = [getattr(module, name) for name in getattr(module, "__all__", [])] or [
            thing for name, thing in vars(module).items() if name[0] != "_" and is_from(thing, module.__name__)
        ]
        for thing in things:
            is_code = inspect.isclass(thing) or inspect.isfunction(inspect.unwrap(thing))
            if is_code and is_from(thing, "cgemit."):
                found[full_name(thing)] = thing
    return found


def full_name(thing: Any) -> str:
    return f"{thing.__module__}.{thing.__qualname__}"


def is_from(thing: object, place: str) -> bool:
    return str(getattr(thing, "__module__", "")).startswith(place)


def without_examples(things: dict[str, Any]) -> list[str]:
    """List what has no section of examples of its own, or only such as print nothing; enums of the core need none."""
    missing = []
    for name, thing in things.items():
        if is_from(thing, "cgemit._core"):
            continue
        doc = inspect.cleandoc((vars(thing).get("__doc__") if inspect.isclass(thing) else thing.__doc__) or "")
        printing = [one for one in examples(doc) if one.want]
        if "\nExamples\n--------\n" not in doc or not (printing or name in NOT_RUN):
            missing.append(name)
    return missing


def test_every_public_name_has_an_example() -> None:
    things = public()
    assert len(things) > 150
    assert {"cgemit.chain.run.run", "cgemit.units.describe", "cgemit.detector.export.describe"} <= things.keys()
    assert not without_examples(things)


def test_every_public_name_is_on_one_page_of_the_reference() -> None:
    pages = [path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "reference").glob("*.md")]
    named = re.findall(r"^\.\. auto(\w+):: (?:cgemit\.)([\w.]+)$", "\n".join(pages), re.MULTILINE)
    things = [operator.attrgetter(name)(cg) for _, name in named]
    assert len({id(thing) for thing in things}) == len(things)
    assert not public().items() - {full_name(thing): thing for thing in things}.items()
    for (kind, name), thing in zip(named, things, strict=True):
        is_error = inspect.isclass(thing) and issubclass(thing, Exception)
        assert kind == ("exception" if is_error else "class" if inspect.isclass(thing) else "function"), name


def test_a_missing_example_is_seen() -> None:
    def nothing_printed() -> None:
        """Do something.

        Examples
        --------
        >>> x = 1
        """

    class Documented(cg.Gun):
        """Inherits examples, but has none."""

    things = {"nothing": nothing_printed, "inherited": Documented, "run": cg.run}
    assert without_examples(things) == ["nothing", "inherited"]


@pytest.fixture
def readouts() -> Iterator[None]:
    """Take back what an example registers."""
    before = dict(READOUTS)
    yield
    READOUTS.clear()
    READOUTS.update(before)


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_they_show(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, readouts: None
) -> None:
    monkeypatch.chdir(tmp_path)
    runner, report = doctest.DocTestRunner(verbose=False), []
    found = doctest.DocTestFinder(exclude_empty=True).find(
        importlib.import_module(name), name, globs={"cg": cg, "np": np}
    )
    for one in found:
        runner.run(one, out=report.append)
    assert runner.summarize(verbose=False).attempted
    assert not runner.summarize(verbose=False).failed, "".join(report)
