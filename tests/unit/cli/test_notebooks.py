"""`cgemit notebooks` against jupytext."""

from __future__ import annotations

import re
from pathlib import Path

import nbformat
import pytest

from cgemit.cli.main import main
from cgemit.cli.notebooks import sources

SOURCES = sorted((Path(__file__).parents[3] / "notebooks").glob("*.py"))


def test_notebooks_hold_the_cells_of_their_sources(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Cell by cell as jupytext reads them, but for links into the documentation, of which the text stays."""
    import jupytext

    assert main(["notebooks", "-o", str(tmp_path / "new")]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in printed] == [f"{path.stem}.ipynb" for path in SOURCES]
    for path, line in zip(SOURCES, printed, strict=True):
        written = nbformat.read(tmp_path / "new" / f"{path.stem}.ipynb", as_version=nbformat.NO_CONVERT)
        nbformat.validate(written)
        expected = jupytext.read(path)
        assert [cell.cell_type for cell in written.cells] == [cell.cell_type for cell in expected.cells]
        for mine, cell in zip(written.cells, expected.cells, strict=True):
            assert mine.source == re.sub(r"\[([^]]*)\]\([^)h][^)]*\)", r"\1", cell.source)
        assert written.cells[0].source.splitlines()[0] == "# " + line.split(maxsplit=1)[1]
        assert written.metadata.kernelspec == expected.metadata.kernelspec
    assert not any("](.." in path.read_text(encoding="utf-8") for path in (tmp_path / "new").glob("*.ipynb"))


def test_other_files_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["notebooks", "-o", str(tmp_path)]
    assert main(command) == 0
    assert main(command) == 2
    assert main([*command, "--overwrite"]) == 0
    changed = tmp_path / "00_quickstart.ipynb"
    before = changed.read_text()
    changed.write_text("mine")
    assert main([*command, "--overwrite"]) == 2
    assert changed.read_text() == "mine"
    changed.write_text(before)
    (tmp_path / "notes.txt").write_text("mine")
    assert main([*command, "--overwrite"]) == 2
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert main(["notebooks", "-o", str(tmp_path / "notes.txt")]) == 2


def test_a_wheel_has_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """CMake installs them beside the package's modules."""
    assert [path.name for path in sources()] == [path.name for path in SOURCES]
    installed = tmp_path / "cgemit" / "notebooks"
    installed.mkdir(parents=True)
    (installed / "one.py").write_text("# %%\n1\n")
    monkeypatch.setattr("cgemit.cli.notebooks.__file__", str(tmp_path / "cgemit" / "cli" / "notebooks.py"))
    assert sources() == [installed / "one.py"]
