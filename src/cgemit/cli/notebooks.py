"""`cgemit notebooks`: the notebooks of the documentation, to be opened in Jupyter."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

from cgemit.cli import options

DESCRIPTION = """\
Write the notebooks of the documentation as .ipynb files, without outputs, and print their titles. What they need is in
the extra [notebook]: pip install 'cgemit[notebook]'."""

EXAMPLES = """\
examples:
  cgemit notebooks                          in ./cgemit-notebooks
  cgemit notebooks -o lessons && jupyter lab lessons"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_output(parser, "folder for the notebooks", default="cgemit-notebooks")


def run(arguments: argparse.Namespace) -> int:
    """Write the notebooks, print their names and titles."""
    from cgemit.base.files import new_folder

    texts = {path.stem: path.read_text(encoding="utf-8") for path in sources()}
    with new_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        for name, text in texts.items():
            content = json.dumps(notebook(text), indent=1, ensure_ascii=False)
            (folder / f"{name}.ipynb").write_text(content + "\n", encoding="utf-8")
    for name, text in texts.items():
        title = re.search(r"^# # (.*)", text, re.MULTILINE)
        options.say(f"{name + '.ipynb':24}{title[1] if title else ''}")
    return options.OK


def sources() -> list[Path]:
    """Return the notebooks as scripts, as jupytext reads them: those of a wheel, or of a checkout."""
    package = Path(__file__).parents[1]
    for place in (package / "notebooks", package.parents[1] / "notebooks"):
        if found := sorted(place.glob("*.py")):
            return found
    raise options.RunFailedError("notebooks: this installation has none")


# A cell, and a link to a page of the documentation, which is not there where only the package is.
_CELL = re.compile(r"^# %%( \[markdown\])?\n(.*?)(?=^# %%|\Z)", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"\[([^]]*)\]\(\.\./[^)]*\)")


def notebook(text: str) -> dict[str, Any]:
    """Return a script in the percent format as a notebook in the format 4.5.

    Parameters
    ----------
    text : str
        With code and markdown cells.
    """
    cells = []
    for number, (markdown, body) in enumerate(_CELL.findall(text)):
        cell: dict[str, Any] = {"id": f"cell-{number}", "metadata": {}}
        if markdown:
            source = _LINK.sub(r"\1", re.sub(r"^# ?", "", body, flags=re.MULTILINE))
            cell |= {"cell_type": "markdown"}
        else:
            source = body
            cell |= {"cell_type": "code", "execution_count": None, "outputs": []}
        cells.append(cell | {"source": source.strip("\n").splitlines(keepends=True)})
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {"cells": cells, "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
