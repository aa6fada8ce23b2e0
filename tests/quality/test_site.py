"""The documentation's site: what the how-to pages say can be done."""

from __future__ import annotations

import re
import shlex
from doctest import ELLIPSIS, NORMALIZE_WHITESPACE, OutputChecker
from pathlib import Path
from typing import Any

import pytest

from cgemit.chain.settings import BY_STAGE
from cgemit.cli.main import COMMANDS, main

DOCS = Path(__file__).parents[2] / "docs"
HOW_TO = sorted((DOCS / "how-to").glob("*.md"))
#: Pages whose Python runs as it stands; their other blocks are excerpts.
METHODS = [
    page
    for page in sorted([*DOCS.glob("*.md"), *(DOCS / "methods").glob("*.md"), *HOW_TO])
    if (page.parent != DOCS / "how-to" or page.stem in ("sweeps", "optimize"))
    and "```python" in page.read_text(encoding="utf-8")
]
#: Pages of which every block runs, in order. `own_hits` runs in test_given_hits.py.
PAGES = [*(page for page in HOW_TO if page not in METHODS and page.stem != "own_hits"), DOCS / "command_line.md"]


def blocks(page: Path) -> list[tuple[str, str]]:
    """Return language and text of the code blocks of a page."""
    return re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_there_are_how_to_pages() -> None:
    names = {"own_detector", "design_study", "own_generator", "real_events", "many_cores"}
    assert names <= {path.stem for path in PAGES}
    assert {"own_hits", "sweeps", "optimize"} <= {path.stem for path in HOW_TO}


def test_every_command_has_its_output() -> None:
    """On the page of the command line, in a section of its own."""
    page = (DOCS / "command_line.md").read_text(encoding="utf-8")
    sections = {text.partition("\n")[0]: text for text in page.split("\n## ")[1:]}
    assert sections.keys() == COMMANDS.keys()
    for name, text in sections.items():
        assert re.search(rf"^```sh\ncgemit {name}\b.*\n```\n\n```output\n", text, re.MULTILINE), name


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_a_how_to_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its files are written under the names it gives, its commands and its Python run in their order.

    A block of output holds what the block before it prints; "..." stands for anything.
    """
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": page.stem}
    files = iter(re.findall(r"Save it as `([\w.]+)`", page.read_text(encoding="utf-8")))
    for language, text in blocks(page):
        if language == "toml":
            Path(next(files)).write_text(text, encoding="utf-8")
        elif language == "sh":
            capsys.readouterr()
            for line in text.splitlines():
                words = shlex.split(line, comments=True)
                assert words[0] == "cgemit"
                assert main(words[1:]) == 0, line
        elif language == "python":
            capsys.readouterr()
            exec(compile(text, f"{page.name}", "exec"), names)
        elif language == "output":
            printed = capsys.readouterr().out
            assert OutputChecker().check_output(text, printed, ELLIPSIS | NORMALIZE_WHITESPACE), printed


@pytest.mark.slow
@pytest.mark.parametrize("page", METHODS, ids=lambda path: path.stem)
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": page.stem}
    for language, text in blocks(page):
        if language == "python":
            exec(compile(text, page.name, "exec"), names)


def test_pages_of_methods_are_found() -> None:
    assert {"sweeps", "optimize", "readout", "states", "vertex"} <= {page.stem for page in METHODS}


def test_the_concepts_name_the_tables_of_a_run() -> None:
    rows = re.findall(r"^\| (\w+) \| (`.*?`) \|", (DOCS / "concepts.md").read_text(encoding="utf-8"), re.MULTILINE)
    named = {stage: set(re.findall(r"`(\w+)`", tables)) for stage, tables in rows}
    assert set().union(*named.values()) == set().union(*BY_STAGE) - {"particles"}
    assert named["digitize"] == set(BY_STAGE[1])
    assert named["find"] == set(BY_STAGE[3])
