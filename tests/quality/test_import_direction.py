"""Who may use whom, in C++ and in Python: design as a test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from sources import CORE, PACKAGE, imports, included, package_of, python_files, top

# A folder may include itself and those before it; stages stand side by side and never include each other.
CPP_LAYERS = [
    {"common"},
    {"lanes"},
    {"field"},
    {"detector"},
    {"motion"},
    {"matter"},
    {"kalman"},
    {"simulate", "digitize", "cluster", "find", "fit"},
    {"kernels"},
    {"bindings"},
]
# A module or sub-package may import those before it; a dotted name gives one module of a package a place of its own:
# pictures show what studies measure, and studies draw. `__init__` lists names for users, so it sees all of them.
PYTHON_LAYERS = [
    {"problems", "words", "version"},
    {"_core", "data", "io", "units"},
    {"isa"},
    {"tables", "values"},
    {"detector", "helix", "particles", "candidates"},
    {"gun", "states", "tracks"},
    {"fit_settings"},
    {"cluster"},
    {"simulate", "digitize", "find", "fit"},
    {"result"},
    {"chain"},
    {"bench", "matter", "study.records", "study.spectra"},
    {"draw"},
    {"study"},
    {"cli"},
    {"__main__", "__init__"},
]
CPP_RANK = {folder: rank for rank, layer in enumerate(CPP_LAYERS) for folder in layer}
PYTHON_RANK = {module: rank for rank, layer in enumerate(PYTHON_LAYERS) for module in layer}


def cpp_problems(folder: str, source: str) -> list[str]:
    problems = []
    for name, own in included(source):
        target = name.partition("/")[0]
        if own and target not in CPP_RANK:
            problems.append(f"{folder} includes {name}: not a path from src/cpp")
        elif own and target != folder and CPP_RANK[target] >= CPP_RANK[folder]:
            problems.append(f"{folder} includes {name}")
        elif folder != "bindings" and (target == "pybind11" or name in ("Python.h", "iostream", "cstdio", "fstream")):
            problems.append(f"{folder} includes {name}: the core knows no Python and no input or output")
    return problems


def python_problems(module: str, package: str, source: str) -> list[str]:
    problems = []
    for name in imports(source, package):
        first, *path = name.split(".")
        if first == "matplotlib" and module != "draw":
            problems.append(f"{module} imports {name}: only draw/ may")
        if first == "cgemit" and path and path[0] != module and python_rank(path) >= PYTHON_RANK[module]:
            problems.append(f"{module} imports {name}")
    return problems


def python_rank(path: list[str]) -> int:
    """Return the layer of a module; names that `cgemit` itself offers count as a module of the top layer."""
    top_rank = PYTHON_RANK.get(path[0], len(PYTHON_LAYERS))
    return PYTHON_RANK.get(".".join(path[:2]), top_rank)


@pytest.mark.parametrize("path", sorted(CORE.rglob("*.?pp")), ids=lambda p: str(p.relative_to(CORE)))
def test_cpp_folders_include_only_what_comes_before(path: Path) -> None:
    assert not cpp_problems(path.relative_to(CORE).parts[0], path.read_text())


@pytest.mark.parametrize("path", python_files(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_python_modules_import_only_what_comes_before(path: Path) -> None:
    assert top(path) in PYTHON_RANK, f"give {top(path)} a place in PYTHON_LAYERS"
    if top(path) != "__init__":
        assert not python_problems(top(path), package_of(path), path.read_text())


@pytest.mark.parametrize("path", python_files(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_only_the_command_line_prints(path: Path) -> None:
    if top(path) != "cli":
        assert "print(" not in path.read_text()


@pytest.mark.parametrize(
    ("folder", "line"),
    [
        ("common", '#include "detector/detector.hpp"'),
        ("fit", '#include "simulate/simulate.hpp"'),
        ("kalman", "#include <pybind11/pybind11.h>"),
        ("motion", "#include <iostream>"),
        ("motion", '#include "helix.hpp"'),
    ],
)
def test_a_wrong_include_is_seen(folder: str, line: str) -> None:
    assert len(cpp_problems(folder, f"#include <vector>\n{line}\n")) == 1


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("detector", "from cgemit.chain import run"),
        ("detector", "from ..tables import Table\nfrom ..chain import run"),
        ("fit", "from cgemit import digitize"),
        ("fit", "def f():\n    import cgemit.chain"),
        ("study", "def f():\n    import matplotlib.pyplot as plt"),
        ("draw", "from cgemit.study.paper import reproduce"),
        ("study", "from cgemit import run"),
    ],
)
def test_a_wrong_import_is_seen(module: str, line: str) -> None:
    assert len(python_problems(module, f"cgemit.{module}", line)) == 1


@pytest.mark.parametrize("module", ["bench", "cli.main", "detector", "draw", "study", "tables"])
def test_each_part_can_be_imported_first(module: str) -> None:
    run = subprocess.run([sys.executable, "-c", f"import cgemit.{module}"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_pictures_and_statistics_are_loaded_when_needed() -> None:
    program = "import sys, cgemit; print(*{'matplotlib', 'scipy', 'pandas', 'awkward'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not run.stdout.split()
