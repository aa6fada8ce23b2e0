"""docs/methods/alignment.md against the program that writes its table."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_table() -> None:
    page = (ROOT / "docs" / "methods" / "alignment.md").read_text(encoding="utf-8")
    written = {
        (part, name): [tuple(float(x) for x in re.findall(r"[+-]?\d+\.\d+", cell)) for cell in cells.split("|")[::2]]
        for part, name, cells in re.findall(r"^\| `(.+)\.(\w+)` \| [\d.]+ \w+ \| (.+) \|$", page, re.MULTILINE)
    }
    rows = runpy.run_path(str(ROOT / "docs" / "alignment_numbers.py"))["rows"](1000)
    assert len(rows) == len(written) == 16
    for part, name, row in rows:
        for (mean, rms, _), (written_mean, written_rms) in zip(row.values(), written[part, name], strict=True):
            # Small ones come from the few tracks that gain or lose a hit.
            assert rms == pytest.approx(written_rms, rel=0.1) if written_rms > 1.5 else rms < 2
            assert mean == pytest.approx(written_mean, abs=0.05 + 5 * written_rms / 1000**0.5)


def test_rows_of_the_whole_detector_add_up() -> None:
    page = (ROOT / "docs" / "methods" / "alignment.md").read_text(encoding="utf-8")
    means = {"shift_z": [], "rotation": []}
    for name, cells in re.findall(r"\.(shift_z|rotation)` \| [\d.]+ \w+ \| (.+) \|$", page, re.MULTILINE):
        means[name].append([float(cell.split(",")[0]) for cell in cells.split("|")[::2]])
    assert [sum(column) for column in zip(*means["shift_z"], strict=True)] == pytest.approx([0, -10, 0], abs=0.05)
    assert [sum(column) for column in zip(*means["rotation"], strict=True)] == pytest.approx([0, 0, 0], abs=0.05)
