"""Notebooks are stored without outputs, have titles and needs; the site runs them (`docs/make_site.py`)."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

NOTEBOOKS = sorted((Path(__file__).resolve().parents[1] / "notebooks").glob("*.py"))


def test_there_are_notebooks_and_no_stored_outputs() -> None:
    assert NOTEBOOKS
    assert not list(NOTEBOOKS[0].parent.rglob("*.ipynb")), "store notebooks as scripts: jupytext --to py:percent"


def test_each_notebook_has_one_title_of_its_own() -> None:
    titles = [re.findall(r"^# # (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE) for path in NOTEBOOKS]
    assert [len(one) for one in titles] == [1] * len(NOTEBOOKS)
    assert len({one[0] for one in titles}) == len(NOTEBOOKS)
    gallery = (NOTEBOOKS[0].parents[1] / "docs" / "gallery.md").read_text(encoding="utf-8")
    links = [(title, f"../notebooks/{path.name}") for (title,), path in zip(titles, NOTEBOOKS, strict=True)]
    assert re.findall(r"^## \[(.*)\]\((.*)\)$", gallery, re.MULTILINE) == links


def test_both_extras_hold_what_notebooks_need() -> None:
    """The site is built where nothing but the extra [docs] is installed (.ci/run)."""
    project = tomllib.loads((NOTEBOOKS[0].parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    notebook, docs = (
        {re.match(r"[\w-]+", one)[0] for one in project["optional-dependencies"][extra]}  # type: ignore[index]
        for extra in ("notebook", "docs")
    )
    assert notebook - {"jupyterlab"} == docs - {"sphinx", "myst-nb", "furo", "sphinx-mathjax-offline"}
    assert {"ipywidgets", "pandas"} <= docs
