"""A page of docs/ with measured numbers: what it measures, where the numbers are stored, and how they are shown.

The Markdown file holds the text. What stands between `<!-- name -->` and `<!-- end -->` is written from the stored
numbers: on lines of its own, or within a line.
"""

from __future__ import annotations

import csv
import platform
import re
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

import cgemit as cg
from cgemit.base.files import new_file
from cgemit.draw.style import Picture

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "pages" / "data"
IMAGES = ROOT / "docs" / "images"

_START = time.perf_counter()


@dataclass(frozen=True)
class Numbers:
    """The rows of one file of numbers, and what was run for them (`about`: key and text)."""

    rows: Sequence[Any]
    about: Mapping[str, str] = field(default_factory=dict)


#: Measures the rows of a file from this share of the full number of events.
Measure = Callable[[float], Numbers]
#: The numbers of a page, by the names of their files.
Found = Mapping[str, Numbers]


@dataclass(frozen=True)
class Page:
    """A page, or the part of a page that one file of this folder makes.

    Attributes
    ----------
    name : str
        Its numbers are in pages/data/NAME.
    file : str
        Markdown file, seen from the root of the repository.
    takes : str
        How long it takes to measure everything on two cores.
    parts : dict of str to (type, callable)
        Name of each file of numbers -> dataclass of its rows, and the function that measures them.
    blocks : callable
        Returns the text of each block from the numbers.
    pictures : dict of str to callable
        Name of each file in docs/images -> function that draws it from the numbers.
    failures : callable
        Returns what has to agree and does not, as text.
    """

    name: str
    file: str
    takes: str
    parts: Mapping[str, tuple[type[Any], Measure]] = field(default_factory=dict)
    blocks: Callable[[Found], Mapping[str, str]] = lambda found: {}
    pictures: Mapping[str, Callable[[Found], Figure]] = field(default_factory=dict)
    failures: Callable[[Found], list[str]] = lambda found: []

    def read(self, folder: Path = DATA) -> dict[str, Numbers]:
        """Return the numbers on file; a part that a folder does not have is that of pages/data."""
        files = {part: folder / self.name / f"{part}.csv" for part in self.parts}
        files |= {part: DATA / self.name / f"{part}.csv" for part, file in files.items() if not file.exists()}
        return {part: read_numbers(files[part], kind) for part, (kind, _) in self.parts.items()}

    def measure(self, folder: Path, share: float = 1.0, only: Collection[str] = ()) -> list[str]:
        """Measure the parts (all, or those named) and write their files; returns what could not be measured, and why.

        A part that lacks a tool raises `MissingToolError`; its file stays as it is.
        """
        missing = []
        for part, (_, measure) in self.parts.items():
            if not only or part in only:
                say(f"{self.name}: {part}")
                try:
                    write_numbers(folder / self.name / f"{part}.csv", measure(share))
                except MissingToolError as error:
                    missing.append(f"{self.name}: {part} is not renewed: {error}")
        return missing

    def write(self, found: Found, file: Path, images: Path) -> None:
        """Write the page with its blocks, and the pictures."""
        text = put((ROOT / self.file).read_text(encoding="utf-8"), self.blocks(found), self.file)
        file.write_text(text, encoding="utf-8")
        for name, draw in self.pictures.items():
            say(f"{self.name}: {name}")
            try:
                figure = draw(found)
            except MissingToolError as error:
                say(f"{self.name}: {name} is not renewed: {error}")
                continue
            if isinstance(figure, Picture):
                figure.save(images / name, overwrite=True)
            else:
                figure.savefig(images / name)

    def problems(self) -> list[str]:
        """Return where the page differs from the numbers on file, and which pictures are not there."""
        text, found = (ROOT / self.file).read_text(encoding="utf-8"), self.read()
        wrong = [
            f"{self.file}: block {name} is not what the numbers say: python -m pages renew {self.name} --stored"
            for name, block in self.blocks(found).items()
            if put(text, {name: block}, self.file) != text
        ]
        for name in self.pictures:
            if not (IMAGES / name).exists():
                wrong.append(f"docs/images/{name}: missing: python -m pages renew {self.name} --stored")
        return wrong


class MissingToolError(Exception):
    """A program or package that a measurement needs is not installed."""


def put(text: str, blocks: Mapping[str, str], where: str) -> str:
    """Return the text of a page with new blocks.

    Raises
    ------
    ValueError
        If a block has no place.
    """
    for name, block in blocks.items():

        def filled(old: re.Match[str], block: str = block) -> str:
            new = f"\n{block.strip()}\n" if old[2].startswith("\n") else block
            return f"{old[1]}{new}{old[3]}"

        text, times = re.subn(rf"(<!-- {re.escape(name)} -->)(.*?)(<!-- end -->)", filled, text, flags=re.DOTALL)
        if not times:
            raise ValueError(f"{where}: there is no place for the block {name}: <!-- {name} --> ... <!-- end -->")
    return text


def markers(text: str) -> list[str]:
    """Return the names of the blocks of a page."""
    return re.findall(r"<!-- (?!end )([\w+-]+) -->", text)


def torn_lines(text: str) -> list[int]:
    """Return the numbers of lines that begin with a marker and go on with text.

    In CommonMark, `<!--` at the beginning of a line ends the paragraph, and the line's text is not part of one.
    """
    return [i for i, line in enumerate(text.splitlines(), 1) if re.match(r"\s*<!--.*?-->\s*\S", line)]


def sample(numbers: Numbers) -> str:
    """Return what was run, and with which version."""
    return f"{numbers.about['events']}, {numbers.about['versions'].partition(',')[0]}"


def table(head: Sequence[str], lines: Sequence[Sequence[object]]) -> str:
    """Return a table as Markdown; a cell with "|" is several."""
    columns = sum(cell.count("|") + 1 for cell in head)
    rows = [f"| {' | '.join(map(str, row))} |" for row in (head, *lines)]
    return "\n".join([rows[0], "|---" * columns + "|", *rows[1:]])


def write_numbers(path: Path, numbers: Numbers) -> None:
    """Write rows of one dataclass as CSV, after lines that say what was run and with which versions."""
    names = [one.name for one in fields(numbers.rows[0])]
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path, overwrite=True) as temporary, Path(temporary).open("w", encoding="utf-8", newline="") as file:
        file.writelines(
            f"# {name}: {text}\n" for name, text in ({"versions": versions()} | dict(numbers.about)).items()
        )
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows([_cell(getattr(row, name)) for name in names] for row in numbers.rows)


def read_numbers(path: Path, kind: type[DataclassInstance]) -> Numbers:
    """Return the rows of a file as objects of `kind`, and what was run."""
    lines = path.read_text(encoding="utf-8").splitlines()
    about = dict(line.removeprefix("# ").split(": ", 1) for line in lines if line.startswith("#"))
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    types = {one.name: str(one.type) for one in fields(kind)}
    return Numbers([kind(**{name: _value(row[name], text) for name, text in types.items()}) for row in rows], about)


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.8g}"
    return str(value)


def _value(text: str, kind: str) -> Any:
    if kind == "bool":
        return text == "yes"
    if kind in ("str", "int"):
        return text if kind == "str" else int(text)
    return float(text) if text else None


def versions() -> str:
    """Return what numbers are made with."""
    return f"cgemit {cg.__version__}, Python {platform.python_version()}, numpy {np.__version__}"


def share_of(events: int, share: float, least: int = 20) -> int:
    """Return a share of a number of events."""
    return max(least, round(events * share))


def span(values: Sequence[float]) -> str:
    """Return the smallest and the largest of some ratios."""
    low, high = f"{min(values):.2f}", f"{max(values):.2f}"
    return low if low == high else f"{low} to {high}"


def say(text: str) -> None:
    """Report progress with the time since the start."""
    print(f"{time.perf_counter() - _START:5.0f} s  {text}", file=sys.stderr, flush=True)
