"""The programs of benchmarks/ read what they measure with, and write what they promise."""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"

# As callgrind writes it: names are spelled out once, also where a function of another library is called; places count
# on from the line before; the line after `calls=` is what the called function cost.
PROFILE = """\
positions: instr line
events: Ir

ob=(1) /lib/python
fn=(1) main
0x100 0 5
cob=(2) /site-packages/cgemit/_core.so
cfn=(2) fit
calls=3 0x2000 0
0x104 0 999

ob=(2)
fn=(2)
0x2000 0 3
+4 0 6
* 0 1
-4 0 10
cob=(3) /lib/libm.so.6
calls=1 0x30 0
+8 0 77
+1 0 2
ob=(3)
0x30 0 4
"""
ASSEMBLY = """\
    2000:	addsd  %xmm1,%xmm0
    2004:	vfmadd231pd %ymm1,%ymm2,%ymm3
    2009:	call   30 <log>
    200d:	vdivsd %xmm1,%xmm0,%xmm0
    2011:	vsqrtpd (%rax),%zmm0
    2015:	addss  %xmm1,%xmm0
    2019:	paddd  %xmm1,%xmm0
    201d:	subpd  %xmm1,%xmm0
"""


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import a program of the folder."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    yield importlib.import_module
    for name in ("operations", "page", "readout", "rows", "stages"):
        sys.modules.pop(name, None)


def test_profile_counts_instructions_of_the_core(program: Any) -> None:
    core, libm = "/site-packages/cgemit/_core.so", "/lib/libm.so.6"
    counts = program("operations").parsed(PROFILE.splitlines())
    assert counts == Counter({(core, 0x2000): 13, (core, 0x2004): 7, (core, 0x2009): 2, (libm, 0x30): 4})


def test_operations_count_lanes_and_fused_ones_twice(program: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    operations = program("operations")
    monkeypatch.setattr(operations, "disassembly", lambda library: ASSEMBLY)
    expected = {
        0x2000: ("add", 1),
        0x2004: ("fused", 4),
        0x200D: ("divide", 1),
        0x2011: ("root", 8),
        0x201D: ("add", 2),
    }
    assert operations.kinds("core") == expected
    calls = 2 * operations.TRACKS
    counts = Counter({("core", at): calls for at in (0x2000, 0x2004, 0x2009, 0x2011, 0x201D)})
    assert operations.per_track(counts) == {
        "instructions": 5, "add": 3, "multiply": 0, "fused": 4, "divide": 0, "root": 8, "operations": 3 + 2 * 4 + 8
    }  # fmt: skip


def test_page_has_a_place_for_every_block(program: Any) -> None:
    page = program("page")
    text = page.PAGE.read_text()
    for name in page.BLOCKS:
        assert text.count(f"<!-- {name} -->\n") == 1
    assert text.count("<!-- end -->") == len(page.BLOCKS)


def test_page_is_renewed_block_by_block(
    program: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = program("page")
    (tmp_path / "memory.csv").write_text("case,tables_bytes,peak_bytes\nall,8169,17490\n")
    blocks = "\n".join(f"words\n<!-- {name} -->\nold {name}\n<!-- end -->" for name in page.BLOCKS)
    (tmp_path / "page.md").write_text(blocks)
    monkeypatch.setattr(page, "HERE", tmp_path)
    monkeypatch.setattr(page, "PAGE", tmp_path / "page.md")
    assert page.main() == 0
    text = (tmp_path / "page.md").read_text()
    assert "| all | 8,169 | 17,490 |" in text
    assert "old memory" not in text
    assert "old peers" in text
    assert "peers: left as it is, there is no peers.csv" in capsys.readouterr().err


def test_the_chain_is_timed_stage_by_stage(program: Any) -> None:
    """Every stage of the chain has its time, and together they take no longer than the whole."""
    stages = program("stages")
    cost = stages.cost(20)
    assert list(cost) == [*stages.STAGES, "all"]
    assert all(value > 0 for value in cost.values())
    assert sum(cost[name] for name in stages.STAGES) < cost["all"]


def test_electrons_of_the_readout_are_multiplied(program: Any) -> None:
    """A step has so many times the electrons, and the strips so many times the charge."""
    readout = program("readout")
    muons = readout.muons(30)
    more = readout.with_electrons(muons.steps, 4)
    assert more["n_electrons"].sum() == 4 * muons.steps["n_electrons"].sum() > 0
    for one in (readout.TigerReadout(), readout.Apv25Readout()):
        digitizer, samples = readout.digitizer_of(one), (muons.steps, more)
        charge = [digitizer.digitize(muons.detector, muons.truths, steps, 1)["charge"].sum() for steps in samples]
        assert 2.5 < charge[1] / charge[0] < 6  # thresholds and saturation change the factor
        assert readout.seconds(muons, one, muons.steps) > 0
