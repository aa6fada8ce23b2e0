"""Who may use whom, in C++ and in Python: design as a test."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Mapping

import pytest
from sources import CORE, imports, included, module_of, nodes_of, package_of, python_files, top

# A folder may include itself and those before it; stages stand side by side and never include each other.
CPP_LAYERS = [
    {"common"},
    {"detector"},
    {"motion"},
    {"matter"},
    {"kalman"},
    {"readout"},
    {"covariance"},
    {"simulation/transport", "simulation/digitize", "simulation/background", "truth"}
    | {"reconstruction/cluster", "reconstruction/find", "reconstruction/fit", "calibration"},
    {"kernels"},
    {"bindings"},
]
# A folder may import those before it; modules of one folder may import each other, but not in a circle. Simulation,
# reconstruction and truth stand side by side: real data have neither simulation nor truth. Units and base count as one
# folder. Pictures take data: curves, tables, results. Studies measure, and draw what they found.
# `__init__` lists names for users, so it sees all of them.
PYTHON_LAYERS = [
    {"base", "units"},
    {"tables"},
    {"detector", "helix"},
    {"particles"},
    {"fit_matter"},
    {"reconstruction", "simulation", "truth"},
    {"chain"},
    {"analysis"},
    {"bes3"},
    {"covariance"},
    {"calibration"},
    {"draw"},
    {"study"},
    {"cli"},
    {"__main__", "__init__"},
]
ONE_FOLDER = ({"base", "units"}, {"cli"})
# A submodule of `_core` counts as the folder of its name. These folders of the core have no folder in Python, or serve
# lower ones too: each may be used from this layer on.
CORE_FROM = {"common": "base", "kernels": "base", "motion": "detector", "matter": "detector", "kalman": "detector"} | {
    "detector": "detector", "readout": "detector", "covariance": "fit_matter",
}  # fmt: skip
CPP_RANK = {folder: rank for rank, layer in enumerate(CPP_LAYERS) for folder in layer}
PYTHON_RANK = {module: rank for rank, layer in enumerate(PYTHON_LAYERS) for module in layer}


def cpp_folder(path: str) -> str:
    """Return the folder of the core that a file belongs to: the stage, where the first folder holds several."""
    first, *rest = path.split("/")
    return f"{first}/{rest[0]}" if first in ("simulation", "reconstruction") else first


def cpp_problems(folder: str, source: str) -> list[str]:
    problems = []
    for name, own in included(source):
        target = cpp_folder(name)
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
        if first != "cgemit" or not path or path[0] in (module, "_core") or {path[0], module} in ONE_FOLDER:
            continue
        if python_rank(path[0]) >= PYTHON_RANK[module]:
            problems.append(f"{module} imports {name}")
    return problems + [f"{module} uses _core.{part}" for part in parts_of_core(source) if not may_use(module, part)]


def parts_of_core(source: str) -> set[str]:
    """Return the submodules of `_core` that a module names."""
    names = {
        node.attr
        for node in nodes_of(source)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "_core"
        if not node.attr.startswith("__")
    }
    within = (name.split(".") for name in imports(source, "cgemit") if name.startswith("cgemit._core."))
    return names | {name[2] for name in within}


def may_use(module: str, part: str) -> bool:
    """Tell whether a folder of the package may use a submodule of `_core`."""
    if part in CORE_FROM:
        return PYTHON_RANK[module] >= PYTHON_RANK[CORE_FROM[part]]
    return part == module or (part in PYTHON_RANK and PYTHON_RANK[module] > PYTHON_RANK[part])


def python_rank(module: str) -> int:
    """Return the layer of a module; names that `cgemit` itself offers count as a module of the top layer."""
    return PYTHON_RANK.get(module, len(PYTHON_LAYERS))


def import_graph(sources: Mapping[str, tuple[str, str]]) -> dict[str, set[str]]:
    """Return which modules each module imports, from each one's package and source.

    What a package's `__init__` offers counts as an import of the package; that a module's own packages are imported
    before it does not count.
    """
    graph = {}
    for module, (package, source) in sources.items():
        names = {name if name in sources else name.rpartition(".")[0] for name in imports(source, package)}
        graph[module] = (names & sources.keys()) - {module, "cgemit"}
    return graph


def circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Return the groups of modules that import each other, directly or through others."""
    reached = {module: reachable(graph, module) for module in graph}
    groups = {frozenset(other for other in reached[module] if module in reached[other]) for module in graph}
    return [set(group) for group in groups if group]


def reachable(graph: Mapping[str, set[str]], start: str) -> set[str]:
    found: set[str] = set()
    waiting = [start]
    while waiting:
        new = graph[waiting.pop()] - found
        found |= new
        waiting += new
    return found


def test_cpp_folders_include_only_what_comes_before() -> None:
    files = sorted(path.relative_to(CORE).as_posix() for path in CORE.rglob("*.?pp"))
    assert len(files) > 100
    problems = {name: cpp_problems(cpp_folder(name), (CORE / name).read_text()) for name in files}
    assert not {name: found for name, found in problems.items() if found}


def test_python_modules_import_only_what_comes_before() -> None:
    files = [path for path in python_files() if top(path) != "__init__"]
    assert len(files) > 100
    assert {top(path) for path in files} <= PYTHON_RANK.keys(), "give each a place in PYTHON_LAYERS"
    problems = {str(path): python_problems(top(path), package_of(path), path.read_text()) for path in files}
    assert not {name: found for name, found in problems.items() if found}


def test_no_python_modules_import_each_other_in_a_circle() -> None:
    sources = {module_of(path): (package_of(path), path.read_text()) for path in python_files()}
    assert not circles(import_graph(sources))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("import cgemit.two", "import cgemit.one"),
        ("from cgemit.two import f", "def f():\n    from cgemit.one import g"),
        ("from cgemit import two", "if TYPE_CHECKING:\n    from .one import g"),
        ("import cgemit.three", "from cgemit.one import g"),
    ],
)
def test_a_circle_is_seen(first: str, second: str) -> None:
    texts = {"cgemit.one": first, "cgemit.two": second, "cgemit.three": "import cgemit.two", "cgemit.four": first}
    graph = import_graph({name: ("cgemit", text) for name, text in texts.items()})
    assert len(circles(graph)) == 1
    assert circles(graph)[0] >= {"cgemit.one", "cgemit.two"}
    assert not circles(import_graph({name: ("cgemit", text) for name, text in [*texts.items()][1:]}))


def prints(text: str) -> bool:
    """Tell whether code prints; examples in docstrings may."""
    calls = (node.func for node in nodes_of(text) if isinstance(node, ast.Call))
    return any(isinstance(called, ast.Name) and called.id == "print" for called in calls)


def test_only_the_command_line_prints() -> None:
    assert {top(path) for path in python_files() if prints(path.read_text())} == {"cli"}


@pytest.mark.parametrize(
    ("folder", "line"),
    [
        ("common", '#include "detector/detector.hpp"'),
        ("reconstruction/fit", '#include "simulation/transport/simulate.hpp"'),
        ("reconstruction/fit", '#include "reconstruction/find/find.hpp"'),
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
        ("detector", "from cgemit.chain.run import run"),
        ("detector", "from ..tables import Table\nfrom ..chain import run"),
        ("reconstruction", "from cgemit import simulation"),
        ("simulation", "from cgemit.reconstruction.cluster import cluster"),
        ("reconstruction", "def f():\n    import cgemit.chain.run"),
        ("study", "def f():\n    import matplotlib.pyplot as plt"),
        ("draw", "from cgemit.study.paper import reproduce"),
        ("draw", "def f():\n    from cgemit.study.scan import Scan"),
        ("analysis", "if TYPE_CHECKING:\n    from cgemit.draw.style import Picture"),
        ("study", "from cgemit import run"),
        ("reconstruction", "_core.simulation.simulate()"),
        ("reconstruction", "def f():\n    from cgemit._core import truth"),
        ("reconstruction", "from cgemit._core.truth import assign_hits"),
        ("detector", "def f() -> _core.covariance.Result: ..."),
        ("tables", "_core.detector.Detector"),
        ("chain", "_core.simulate()"),
    ],
)
def test_a_wrong_import_is_seen(module: str, line: str) -> None:
    assert len(python_problems(module, f"cgemit.{module}", line)) == 1


@pytest.mark.parametrize("module", ["cli.main", "detector", "draw", "study", "tables"])
def test_each_part_can_be_imported_first(module: str) -> None:
    run = subprocess.run([sys.executable, "-c", f"import cgemit.{module}"], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def loaded(program: str) -> set[str]:
    """Return the packages that take long to import and that a program has imported at its end."""
    program += "\nprint(*{'numpy', 'matplotlib', 'scipy', 'pandas', 'awkward'} & set(sys.modules), file=sys.stderr)"
    run = subprocess.run([sys.executable, "-c", f"import sys\n{program}"], capture_output=True, text=True, check=True)
    return set(run.stderr.split())


def test_pictures_and_statistics_are_loaded_when_needed() -> None:
    assert loaded("import cgemit") == set()
    assert loaded("import cgemit; cgemit.run, cgemit.analytic") == {"numpy"}
    assert loaded("import cgemit; cgemit.study") == {"numpy"}


def test_help_waits_for_no_pictures_and_statistics() -> None:
    begin = "import cgemit.__main__; from cgemit.cli.main import COMMANDS, main\n"
    assert loaded(f"{begin}assert main(['--help']) == 0") == set()
    assert loaded(f"{begin}for name in COMMANDS: assert main([name, '--help']) == 0") <= {"numpy"}
