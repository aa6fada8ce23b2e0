"""The typed stubs say what the compiled module has: names, enum values, arguments, defaults and types."""

from __future__ import annotations

import ast
import enum
import re
from typing import Any

import numpy as np
import pytest
from sources import CORE, PACKAGE

from cgemit import _core
from cgemit.detector import compiled, load
from cgemit.particles.gun import Gun, generate

FOLDER = PACKAGE / "_core"
MODULE = r"cgemit\._core\.\w+\."
STUBS = {
    path.stem: ast.parse(path.read_text())
    for path in sorted(FOLDER.glob("*.pyi"))
    if path.stem not in ("__init__", "_arrays")
}
PARTS = {name: getattr(_core, name) for name in STUBS}
#: Names of all submodules, which are all different.
WHERE = {
    node.target.id if isinstance(node, ast.AnnAssign) else node.name: part
    for part, stub in STUBS.items()
    for node in stub.body
    if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AnnAssign)
}
NODES = [node for stub in STUBS.values() for node in stub.body]
FUNCTIONS = {node.name: node for node in NODES if isinstance(node, ast.FunctionDef)}
CLASSES = {node.name: node for node in NODES if isinstance(node, ast.ClassDef)}
CONSTANTS = {node.target.id: node for node in NODES if isinstance(node, ast.AnnAssign)}
HIT_COLUMNS = {"kind": "u1", "layer": "i4", "channel": "i4", "size": "i4", "value": "f8", "sigma": "f8"}
ENUMS = {name for name in CLASSES if isinstance(getattr(PARTS[WHERE[name]], name, None), enum.EnumType)}


def compiled_one(name: str) -> Any:
    return getattr(PARTS[WHERE[name]], name)


def signature_of(function: object) -> ast.FunctionDef:
    """Read the signature that pybind11 writes into the first line of a docstring."""
    line = (function.__doc__ or "").strip().splitlines()[0]
    (node,) = ast.parse(f"def {line}: ...").body
    assert isinstance(node, ast.FunctionDef)
    return node


def arguments(node: ast.FunctionDef) -> list[tuple[str, str, str, str | None]]:
    """List name, kind, type and default of each argument but self."""
    a = node.args
    assert not a.posonlyargs
    assert not a.vararg
    positional = [None] * (len(a.args) - len(a.defaults)) + a.defaults
    rows = [(arg, "positional", value) for arg, value in zip(a.args, positional, strict=True)]
    rows += [(arg, "keyword", value) for arg, value in zip(a.kwonlyargs, a.kw_defaults, strict=True)]
    return [
        (arg.arg, kind, spelled(arg.annotation), ast.unparse(value) if value else None)
        for arg, kind, value in rows
        if arg.arg != "self"
    ]


def spelled(annotation: ast.expr | None) -> str:
    """Spell a type of the stubs or of pybind11 alike; array types are told apart from numbers and dicts only."""
    text = ast.unparse(annotation) if annotation else "nothing"
    words = {
        "Sequence": "sequence", "ArrayLike": "array in", "NDArray": "array", "SupportsFloat": "float",
        "SupportsInt": "int", "_Floats": "array", "_Bytes": "array", "_Array": "array", "_Columns": "dict",
        "_Simulated": "dict", "_Reference": "dict", "list": "sequence",
    }  # fmt: skip
    other, either, last = text.rpartition(" | ")
    if either and last in ("dict", "_Columns"):
        return f"{re.sub(MODULE, '', other)} | dict"
    outer = text.removeprefix("typing.Annotated[")
    for container in ("tuple", "dict"):
        if outer.startswith(container):
            return container
    for word, meaning in words.items():
        if word in outer:
            return meaning
    return re.sub(MODULE, "", outer)


def test_names_agree() -> None:
    assert sum(map(len, (FUNCTIONS, CLASSES, CONSTANTS))) == len(WHERE)
    for part, module in PARTS.items():
        stub = {name for name, where in WHERE.items() if where == part and not name.startswith("_")}
        assert stub == {name for name in dir(module) if not name.startswith("_")}, part


def test_submodules_are_the_folders_of_the_core() -> None:
    folders = {path.name for path in CORE.iterdir() if path.is_dir()}
    public = {name for name in PARTS if not name.startswith("_")}
    assert public == {name for name in dir(_core) if not name.startswith("_")}
    assert public < folders


@pytest.mark.parametrize("name", sorted(FUNCTIONS))
def test_functions_agree(name: str) -> None:
    signature = signature_of(compiled_one(name))
    assert arguments(FUNCTIONS[name]) == arguments(signature)
    assert spelled(FUNCTIONS[name].returns) == spelled(signature.returns)


@pytest.mark.parametrize("name", sorted(ENUMS))
def test_enums_agree(name: str) -> None:
    stub = {ast.unparse(node.targets[0]): node.value for node in CLASSES[name].body if isinstance(node, ast.Assign)}
    values = {member: ast.literal_eval(value) for member, value in stub.items()}
    assert values == {member.name: member.value for member in compiled_one(name)}


@pytest.mark.parametrize("name", sorted(set(CLASSES) - ENUMS - {n for n in CLASSES if n.startswith("_")}))
def test_classes_agree(name: str) -> None:
    methods = {node.name: node for node in CLASSES[name].body if isinstance(node, ast.FunctionDef)}
    assert set(methods) - {"__init__"} == {n for n in vars(compiled_one(name)) if not n.startswith("_")}
    assert arguments(methods["__init__"]) == arguments(signature_of(compiled_one(name).__init__))


@pytest.mark.parametrize("name", sorted(CONSTANTS.keys() - {n for n in CONSTANTS if n.startswith("_")}))
def test_constants_agree(name: str) -> None:
    assert ast.unparse(CONSTANTS[name].annotation) == f"Final[{type(compiled_one(name)).__name__}]"


def test_keys_of_returned_dicts_agree() -> None:
    core = compiled(load("besiii-cgem-design"))
    particles = dict(generate(Gun("mu-", p=1.0, cos_theta=0.0), 1, seed=1).columns)
    simulated = _core.simulation.simulate(core, particles, fluctuations=_core.simulation.Fluctuations.off, seed=1)
    hits = {
        name: np.empty(0, code) for name, code in zip(HIT_COLUMNS, ("u1", "i4", "i4", "i4", "f8", "f8"), strict=True)
    }
    reference = _core._testing.reference(core, np.array([0.0, 0.0, 1.0, 0.0, 0.0]), 0.1, hits)
    for name, found in (("_Simulated", simulated), ("_Reference", reference)):
        keys = {node.target.id for node in CLASSES[name].body if isinstance(node, ast.AnnAssign)}
        assert keys == set(found)
