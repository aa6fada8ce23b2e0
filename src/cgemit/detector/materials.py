"""Materials of a detector file: complete ones, and copies of others at another density."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from cgemit.detector.material import (
    Material,
    excitation_of_fractions,
    general_density_effect,
    x0_of_fractions,
    z_over_a_of_fractions,
)
from cgemit.detector.read import Reader
from cgemit.problems import did_you_mean

_BULK = ("x0", "z_over_a", "excitation_energy")


def read_materials(reader: Reader, known: Mapping[str, Material], raw: Mapping[str, Any]) -> dict[str, Material | None]:
    """Return `known` materials and those of the tables `raw` by name; None for one with problems, which are noted."""
    found: dict[str, Material | None] = {name: material for name, material in known.items() if name not in raw}
    waiting = dict(raw)
    while waiting:
        ready = [name for name, table in waiting.items() if _base(table) in (None, *found)]
        if not ready:
            # Blame those whose base does not exist; if all exist they lead in a circle.
            for name in [n for n, table in waiting.items() if _base(table) not in raw] or list(waiting):
                base = _base(waiting.pop(name)) or ""
                hint = did_you_mean(base, found)
                reader.note(f"materials.{name}.base", f'"{base}"', "the name of another material", hint)
                found[name] = None
        for name in ready:
            found[name] = _material(reader, name, waiting.pop(name), found)
    return found


def _base(table: object) -> str | None:
    base = table.get("base") if isinstance(table, Mapping) else None
    return base if isinstance(base, str) else None


def _material(reader: Reader, name: str, raw: object, found: Mapping[str, Material | None]) -> Material | None:
    path = f"materials.{name}"
    base = found.get(_base(raw) or "")
    before = len(reader.problems)
    values = reader.table(path, raw, Material, defaults={"density": base.density} if base else None)
    if len(reader.problems) > before or (_base(raw) and base is None):
        return None
    values.pop("base", None)
    if base:
        return _diluted(reader, path, name, base, values)
    if "composition" not in values and not all(key in values for key in _BULK):
        given = "only " + ", ".join(values)
        reader.note(path, given, "also composition, or all of " + ", ".join(_BULK))
        return None
    fractions = dict(values.setdefault("composition", ()))
    values.setdefault("gas", False)
    if fractions:
        values.setdefault("x0", x0_of_fractions(fractions, values["density"]))
        values.setdefault("z_over_a", z_over_a_of_fractions(fractions))
        values.setdefault("excitation_energy", excitation_of_fractions(fractions))
    effect = (values["excitation_energy"], values["z_over_a"], values["density"], values["gas"])
    values.setdefault("density_effect", general_density_effect(*effect))
    return Material(name=name, **values)


def _diluted(reader: Reader, path: str, name: str, base: Material, values: dict[str, Any]) -> Material | None:
    """Return `base` at another density.

    A solid is diluted by holes, the matter beside them is unchanged: it keeps its density effect, and `filling` says
    how dense it is. A gas gets a new density effect for its new pressure.
    """
    for key in values.keys() - {"density", "x0"}:
        reader.note(f"{path}.{key}", "a value beside base", "only density and x0 beside base")
        return None
    density: float = values["density"]
    effect = base.density_effect
    if base.gas and density != base.density:
        effect = general_density_effect(base.excitation_energy, base.z_over_a, density, gas=True)
    x0 = values.get("x0", base.x0 * base.density / density)
    filling = base.filling if base.gas else min(1.0, base.filling * density / base.density)
    return dataclasses.replace(base, name=name, density=density, x0=x0, density_effect=effect, filling=filling)
