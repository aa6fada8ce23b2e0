"""Every notebook runs from top to bottom, is stored without outputs, and keeps its cells short.

Jupyter's packages are imported by the tests that use them, since their import takes seconds in each process of tests.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

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
    assert notebook - {"jupyterlab"} == docs - {"sphinx", "myst-nb", "furo"}
    assert {"ipywidgets", "optuna", "pandas"} <= docs


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_are_short(path: Path) -> None:
    import jupytext

    cells = [cell.source.splitlines() for cell in jupytext.read(path).cells if cell.cell_type == "code"]
    assert 4 <= len(cells) <= 18
    assert max(len(lines) for lines in cells) <= 32


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "agg")
    import jupytext
    import nbclient

    notebook = jupytext.read(path)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in shown)
    assert not [output for output in shown if output.get("name") == "stderr"]


def test_a_broken_notebook_is_seen(tmp_path: Path) -> None:
    import nbclient
    import nbformat

    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")])
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    client = nbclient.NotebookClient(notebook, timeout=60, resources={"metadata": {"path": str(tmp_path)}})
    with pytest.raises(nbclient.exceptions.CellExecutionError, match="ZeroDivisionError"):
        client.execute()
