"""A setting has one home, the Python dataclass: the core has fields of the same names and no defaults."""

from __future__ import annotations

import dataclasses
import re
from typing import Any, get_args

import pytest
from sources import CORE

from cgemit import _core
from cgemit.detector import Screening
from cgemit.detector.readouts import BinaryReadout, GaussianReadout, ProjectionReadout
from cgemit.reconstruction.find.ckf import FindSettings
from cgemit.reconstruction.fit import FitSettings, Loss
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import Fluctuations, SimulateSettings

# Struct, its header, its dataclass, and the fields of the core that are made from a setting of another name, or from
# none: seeds and tables come with the call.
STRUCTS = [
    ("FitSettings", "reconstruction/fit/fit.hpp", FitSettings, {"errors_from_track": "cluster_errors"}),
    (
        "FindSettings",
        "reconstruction/find/find.hpp",
        FindSettings,
        {"segments": "method", "chamber": "method", "mass": "hypothesis"}
        | {"least_width": None, "delta_strips": None, "charge": None},
    ),
    ("SimulateSettings", "simulation/transport/simulate.hpp", SimulateSettings, {"interrupted": None}),
    ("BinaryReadout", "simulation/digitize/binary.hpp", BinaryReadout, {"w_values": None}),
    (
        "GaussianReadout",
        "simulation/digitize/gaussian.hpp",
        GaussianReadout,
        {"errors": "sigma_x", "w_values": None, "seed": None},
    ),
    ("ProjectionReadout", "simulation/digitize/projection.hpp", ProjectionReadout, {"w_values": None, "seed": None}),
    ("WireReadout", "simulation/digitize/wires.hpp", DigitizeSettings, {"seed": None}),
]


def fields(source: str, struct: str) -> dict[str, bool]:
    """Return the fields of a plain C++ struct, and whether each has a default."""
    body = re.search(rf"struct {struct} \{{(.*?)\n\}};", re.sub(r"//[^\n]*", "", source), re.DOTALL)
    assert body, f"no struct {struct}"
    found = {}
    for statement in body[1].split(";"):
        declared = re.fullmatch(r"\s*[\w:<>,* ]+?\s+(\w+)\s*(=.*|\{.*)?", statement, re.DOTALL)
        assert declared or not statement.strip(), f"{struct}: cannot read {statement!r}"
        if declared:
            found[declared[1]] = declared[2] is not None
    return found


@pytest.mark.parametrize(("struct", "header", "settings", "other"), STRUCTS, ids=[row[0] for row in STRUCTS])
def test_fields_of_the_core_are_settings(
    struct: str, header: str, settings: type, other: dict[str, str | None]
) -> None:
    names = {field.name for field in dataclasses.fields(settings)}
    core = fields((CORE / header).read_text(), struct)
    assert core, struct
    assert {other.get(name, name) for name in core} - {None} <= names
    assert not any(core.values()), f"{struct} has defaults of its own"


def test_every_struct_of_settings_is_listed() -> None:
    structs = {
        name
        for path in CORE.rglob("*.hpp")
        for name in re.findall(r"struct (\w*(?:Settings|Readout)) \{", path.read_text())
    }
    assert structs == {row[0] for row in STRUCTS}


@pytest.mark.parametrize(
    ("choices", "core"),
    [(Fluctuations, _core.simulation.Fluctuations), (Loss, _core.matter.CoreLoss), (Screening, _core.matter.Screening)],
    ids=["fluctuations", "loss", "screening"],
)
def test_choices_are_those_of_the_core(choices: Any, core: Any) -> None:
    assert set(get_args(choices)) == {member.name for member in core}


def test_a_default_in_the_core_is_seen() -> None:
    source = "struct S {\n  int a;  // = 3\n  double b = 0.5;\n  std::array<double, 5> c;\n  bool d{true};\n};\n"
    assert fields(source, "S") == {"a": False, "b": True, "c": False, "d": True}
