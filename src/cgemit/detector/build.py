"""Build the parts of a detector from the tables of its file; all problems are collected."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, TypeVar

from cgemit import _core
from cgemit.base.errors import DetectorError, Problems, WrongValueError, did_you_mean, shown
from cgemit.base.validate import entries
from cgemit.detector import check
from cgemit.detector.chamber import read_chamber
from cgemit.detector.field import KINDS, Field, MapField, kind_key
from cgemit.detector.files import library_materials, map_path, read_field_map
from cgemit.detector.keys import UNUSABLE, keys_of, plain
from cgemit.detector.layers import LAYER_KINDS, CgemLayer, Layer
from cgemit.detector.material import (
    Material,
    element_rows,
    elements,
    excitation_of_fractions,
    fractions_of_formula,
    general_density_effect,
    x0_of_fractions,
    z_over_a_of_fractions,
)
from cgemit.detector.parts import BackgroundLevel, Contents, Cylinder, Labelled
from cgemit.detector.reader import (
    BELOW,
    NAME,
    TOP_LEVEL,
    Reader,
    spread_readout,
    writable,
)

#: Volume of a mole of ideal gas at 20 C and 1 atm, cm3: R T/p with CODATA 2018 R = 8.314462618 J/(mol K).
MOLAR_VOLUME = 8.314462618 * 293.15 / 101325 * 1e6

#: Chemical formulas that mean a gas when no density is given, beside the elements that are gases.
GASES = ("H2", "N2", "O2", "F2", "Cl2", "CH4", "C2H6", "C3H8", "C4H10", "iC4H10", "CO2", "CF4", "C2H2F4", "SF6")

#: Mixtures that come with the program, by their names without fractions.
USUAL = {"He/C3H8": ("MdcGas", "60/40"), "Ar/iC4H10": ("CgemGas", "90/10")}

_BULK = ("x0", "z_over_a", "excitation_energy")


@cache
def library() -> dict[str, Material]:
    """Return the materials that come with the program."""
    reader = Reader()
    materials = read_materials(reader, {}, library_materials())
    if reader.problems:
        raise DetectorError("_materials.toml", reader.problems)
    return {name: material for name, material in materials.items() if material}


def read_materials(reader: Reader, known: Mapping[str, Material], raw: Mapping[str, Any]) -> dict[str, Material | None]:
    """Return `known` materials and those of the tables `raw` by name; None for one with problems, which are noted."""
    materials: dict[str, Material | None] = {name: material for name, material in known.items() if name not in raw}
    waiting = dict(raw)
    while waiting:
        ready = [name for name, table in waiting.items() if _base(table) in (None, *materials)]
        if not ready:
            # Report those whose base does not exist; if all bases exist, they form a circle.
            for name in [n for n, table in waiting.items() if _base(table) not in raw] or list(waiting):
                base = _base(waiting.pop(name)) or ""
                hint = did_you_mean(base, materials)
                reader.note(f"materials.{name}.base", f'"{base}"', "the name of another material", hint)
                materials[name] = None
        for name in ready:
            table = waiting.pop(name)
            read_before = isinstance(table, Material)
            materials[name] = table if read_before else _material(reader, name, table, materials, known.get(name))
    return materials


def _base(table: object) -> str | None:
    base = table.get("base") if isinstance(table, Mapping) else None
    return base if isinstance(base, str) else None


def _material(
    reader: Reader, name: str, raw: object, materials: Mapping[str, Material | None], old: Material | None
) -> Material | None:
    """Return the material of a table; values it leaves out come from the `old` material of the same name."""
    path = f"materials.{name}"
    if isinstance(raw, Mapping) and BELOW in raw:
        below = raw[BELOW]
        old = below if isinstance(below, Material) else _material(Reader(), name, below, materials, old) or old
        raw = {key: value for key, value in raw.items() if key != BELOW}
    base = materials.get(_base(raw) or "")
    before = len(reader.problems)
    if base or old is None or not isinstance(raw, Mapping):
        defaults = {"density": base.density} if base else {}
    else:
        defaults = _kept(old, raw)
    values = reader.table(path, raw, Material, defaults=defaults)
    if len(reader.problems) > before or (_base(raw) and base is None):
        return None
    values.pop("base", None)
    if base:
        return _with_base(reader, path, name, base, values)
    if old and isinstance(raw, Mapping) and raw.keys() <= {"density", "x0"}:
        same = values["density"] == old.density
        return _diluted(old, values["density"], values["x0"] if "x0" in raw else old.x0 if same else None)
    if old and "x0" in defaults and isinstance(raw, Mapping) and "x0" not in raw:
        values["x0"] *= old.density / values["density"]
    if "composition" not in values and not all(key in values for key in _BULK):
        given = "only " + ", ".join(values)
        reader.problems.note(path, given, "also composition, or all of " + ", ".join(_BULK), unknown=True)
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


def _kept(old: Material, raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a material that a table for it leaves as they are."""
    if "composition" in raw or all(key in raw for key in _BULK):
        return {"density": old.density, "gas": old.gas}
    names = ["density", "gas", *_BULK, *(["composition"] if old.composition else [])]
    return {name: getattr(old, name) for name in names}


def _with_base(reader: Reader, path: str, name: str, base: Material, values: dict[str, Any]) -> Material | None:
    """Return the material of a table with a base: the base at another density."""
    for key in values.keys() - {"density", "x0"}:
        reader.note(f"{path}.{key}", "a value beside base", "only density and x0 beside base")
        return None
    return dataclasses.replace(_diluted(base, values["density"], values.get("x0")), name=name)


def _diluted(base: Material, density: float, x0: float | None = None) -> Material:
    """Return a material at another density (g/cm3).

    A solid is diluted by holes. The matter between them is unchanged and keeps its density effect; `filling` is its
    share of the volume. A gas gets a new density effect for its new pressure.
    """
    effect, filling = base.density_effect, base.filling
    if not base.gas:
        filling = min(1.0, base.filling * density / base.density)
    elif density != base.density:
        effect = general_density_effect(base.excitation_energy, base.z_over_a, density, gas=True)
    x0 = base.x0 * base.density / density if x0 is None else x0
    return dataclasses.replace(base, density=density, x0=x0, density_effect=effect, filling=filling)


class MaterialNameError(WrongValueError):
    """A material that cannot be made from its name."""


def material_named(
    name: str, volumes: tuple[float, ...] | None = None, density: float | None = None
) -> tuple[Material, str]:
    """Return a material by its name, and what had to be chosen for it (text, may be empty).

    Parameters
    ----------
    name : str
        A material that comes with the program, an element's symbol, a chemical formula, or gases with "/" between
        them. A mixture without `volumes` is the one that comes with the program (`USUAL`), else of equal parts.
    volumes : tuple of float or None
        Fractions of the gases by volume, %.
    density : float or None
        g/cm3; of gases by default that of ideal gases at 20 C and 1 atm.

    Raises
    ------
    MaterialNameError
        If there is no such material, or something is missing.

    """
    usual, text = USUAL.get(name, ("", ""))
    if usual and volumes is None:
        material = library()[usual]
        return _diluted(
            material, density
        ) if density else material, f"{name} {text} by volume, as detector files have it"
    if "/" in name:
        return _mixture(name, volumes, density)
    if volumes is not None:
        raise MaterialNameError(f'fractions for "{name}"', "fractions only after gases such as Ar/CO2")
    if name in library():
        material = library()[name]
        return _diluted(material, density) if density else material, ""
    return _pure(name, density)


def _pure(name: str, density: float | None) -> tuple[Material, str]:
    row = _rows().get(name)
    if row and row["gas"]:
        return _gas(name, [(row["gas"], 1.0)], density), f"{row['gas']} gas"
    if row:
        return _made(name, {name: 1.0}, density or float(row["density"]), gas=False), ""
    fractions = _fractions(name)
    if density is None and name in GASES:
        return _gas(name, [(name, 1.0)], None), ""
    if density is None:
        expected = 'the density of a compound that is no gas before its thickness, as "CH2 0.94 g/cm3 1 mm"'
        raise MaterialNameError(f'"{name}" without density', expected)
    return _made(name, fractions, density, gas=name in GASES), ""


def _mixture(name: str, volumes: tuple[float, ...] | None, density: float | None) -> tuple[Material, str]:
    names = name.split("/")
    note = "" if volumes else "equal parts by volume"
    volumes = volumes or (100 / len(names),) * len(names)
    if len(volumes) != len(names) or abs(sum(volumes) - 100) > 0.1 or min(volumes) <= 0:
        given = "/".join(f"{part:g}" for part in volumes)
        raise MaterialNameError(f'{given} for "{name}"', f"{len(names)} fractions above 0 that add up to 100 %")
    gases = []
    for gas_name, volume in zip(names, volumes, strict=True):
        row = _rows().get(gas_name)
        if not (row["gas"] if row else library()[gas_name].gas if gas_name in library() else True):
            raise MaterialNameError(f'"{gas_name}" in "{name}"', "a gas", did_you_mean(gas_name, _gas_names()))
        gases.append((row["gas"] if row else gas_name, volume))
    full = f"{name} {'/'.join(f'{volume:g}' for volume in volumes)}"
    return _gas(full if not note else name, gases, density), note


def _gas(name: str, gases: list[tuple[str, float]], density: float | None) -> Material:
    """Return a mixture of gases given by formula and share of the volume, %."""
    mass: dict[str, float] = {}
    total = 0.0
    for formula, volume in gases:
        fractions = _fractions(formula)
        moles = volume * _molar_mass(formula)
        total += moles
        for symbol, part in fractions.items():
            mass[symbol] = mass.get(symbol, 0.0) + moles * part
    fractions = {symbol: value / total for symbol, value in mass.items()}
    ideal = total / sum(volume for _, volume in gases) / MOLAR_VOLUME
    return _made(name, fractions, density or ideal, gas=True)


def _made(name: str, fractions: dict[str, float], density: float, *, gas: bool) -> Material:
    excitation, z_over_a = excitation_of_fractions(fractions), z_over_a_of_fractions(fractions)
    return Material(
        name=name,
        density=density,
        x0=x0_of_fractions(fractions, density),
        z_over_a=z_over_a,
        excitation_energy=excitation,
        gas=gas,
        composition=tuple(fractions.items()),
        density_effect=general_density_effect(excitation, z_over_a, density, gas),
    )


def _plain(formula: str) -> str:
    """Return a formula without the letter of the isomer: iC4H10 is C4H10."""
    return re.sub(r"^[in](?=C\d)", "", formula)


def _molar_mass(formula: str) -> float:
    counted = re.findall(r"([A-Z][a-z]?)(\d*)", _plain(formula))
    return sum(elements()[symbol].a * int(count or 1) for symbol, count in counted)


def _fractions(formula: str) -> dict[str, float]:
    try:
        return fractions_of_formula(_plain(formula))
    except (KeyError, ValueError, ZeroDivisionError):
        expected = "a material of detector files, an element's symbol, a chemical formula, or gases as Ar/CO2"
        hint = did_you_mean(formula, [*library(), *_gas_names(), *elements()])
        hint = hint or f"materials of detector files: {', '.join(library())}"
        raise MaterialNameError(f'"{formula}"', expected, hint) from None


@cache
def _rows() -> dict[str, dict[str, str]]:
    return {row["symbol"]: row for row in element_rows()}


def _gas_names() -> list[str]:
    return [*GASES, *(symbol for symbol, row in _rows().items() if row["gas"])]


def read_contents(source: str, tables: Mapping[str, Any], problems: Problems) -> Contents:
    """Return the parts of the detector that complete tables describe; `Detector` checks how they fit together.

    Raises
    ------
    DetectorError
        With `problems` and those found here.

    """
    reader = Reader(problems=problems, baseless=any(problem.path == "base" for problem in problems))
    entries(tables, "", TOP_LEVEL, problems)
    texts = {name: _text(reader, name, tables.get(name, "")) for name in ("name", "description")}
    tables = _check_names(reader, tables, texts["name"])
    own = reader.mapping("materials", tables.get("materials", {}))
    reader.materials = read_materials(reader, library(), own)
    field = _field(reader, tables.get("field"))
    tables = {**tables, "cgem": dict(reader.mapping("cgem", tables.get("cgem", {})))}
    if "readout" in tables:
        reader.readout("readout", tables["readout"], CgemLayer)
        spread_readout(tables)
    pipe = Labelled(_parts(reader, tables, "beam_pipe", Cylinder, "r_in"))
    barrels: list[Layer] = []
    for group, kind in LAYER_KINDS.items():
        barrels += _parts(reader, tables, group, kind, "r_mid", kind.complete)
    walls = Labelled(_parts(reader, tables, "walls", Cylinder, "r_in"))
    chamber = read_chamber(reader, tables["drift_chamber"]) if "drift_chamber" in tables else None
    levels = tuple(_parts(reader, tables, "background", BackgroundLevel, "label"))
    # A layer that could not be read may measure.
    measures = any(one.views for one in barrels) or any(one.path.partition(".")[0] in LAYER_KINDS for one in problems)
    if not measures and not chamber and not reader.baseless:
        expected = "a [cgem.<label>], a [layer.<label>] with an error or a pitch, or a [drift_chamber]"
        reader.note("", "nothing that measures", expected)
    if problems:
        more = check.field_problems(field) + check.geometry_problems(pipe, barrels, walls, chamber)
        raise DetectorError(source, problems + more)
    air = reader.materials["Air"]
    assert air is not None  # otherwise there was a problem
    return Contents(
        **texts, field=field, beam_pipe=pipe, barrels=Labelled(barrels), walls=walls, drift_chamber=chamber,
        background=levels, air=air,
    )  # fmt: skip


# More parts than any detector has: a mistake, or meant to exhaust the memory.
_MOST_PARTS = {"beam_pipe": 100, "cgem": 100, "layer": 1000, "walls": 300, "background": 100, "materials": 1000}


def _check_names(reader: Reader, tables: Mapping[str, Any], name: str) -> Mapping[str, Any]:
    """Note names that cannot be names of files, and groups of too many parts; return the tables without these."""
    if not _is_name(name):
        expected = "one line of text, up to 100 characters, without / and \\, since files are called by it"
        reader.note("name", shown(name), expected)
    for group, most in _MOST_PARTS.items():
        parts = tables.get(group)
        if not isinstance(parts, Mapping):
            continue
        if len(parts) > most:
            reader.note(group, f"{len(parts)} tables", f"at most {most}")
            tables, parts = {**tables, group: {}}, {}
        for label in parts:
            if not _is_name(str(label)):
                expected = "one line of text, up to 100 characters, without / and \\"
                reader.note(f"{group}.{shown(str(label))}", "as a label", expected)
    return tables


@lru_cache(maxsize=4096)
def _is_name(text: str) -> bool:
    return re.fullmatch(NAME, text) is not None


def _text(reader: Reader, name: str, raw: object) -> str:
    if not isinstance(raw, str):
        reader.note(name, shown(raw), "text")
    elif not writable(raw) and name != "name":  # whose own check says so
        reader.note(name, shown(raw), "text that a file can hold")
    return str(raw)


def _field(reader: Reader, raw: object) -> Field:
    if isinstance(raw, Field):
        return raw
    if raw is None:
        if not reader.baseless:
            reader.note("field", "nothing", 'a table [field] with kind = "uniform" and bz')
        return Field(kind="uniform", bz=UNUSABLE)
    kind_name = plain(reader.mapping("field", raw).get("kind", "uniform"))
    if not isinstance(kind_name, str) or kind_name not in KINDS:
        # The other keys are checked as for every kind of field.
        kinds: list[Any] = list(KINDS.values())
        keys = {name: key for kind in kinds for name, key in keys_of(kind).items()}
        reader.table("field", raw, Field, keys=keys | {"kind": kind_key()})
        return Field(kind="uniform", bz=UNUSABLE)
    kind = KINDS[kind_name]
    values = reader.table("field", raw, kind)
    if kind is MapField:
        _read_map(reader, values)
    return kind(**values)


def _read_map(reader: Reader, values: dict[str, Any]) -> None:
    """Read the map that the values of a table [field] name, and fill in what follows from it."""
    values["grid"] = UNUSABLE
    checksum, stated = values.get("checksum"), "bz" in values
    values.setdefault("checksum", UNUSABLE)
    values.setdefault("bz", UNUSABLE)
    mirror = values.get("mirror")
    if not isinstance(values["file"], str) or (mirror is not None and not isinstance(mirror, tuple)):
        return
    try:
        grid = read_field_map(map_path(values["file"]), mirror=mirror)
    except DetectorError as error:
        for problem in error.problems:
            place = f" {problem.path}" if problem.path else ""
            reader.note("field.file", f"{values['file']}{place}: {problem.given}", problem.expected, problem.hint)
        return
    if checksum is not None and checksum != grid.checksum:
        reader.note("field.checksum", str(checksum), f"{grid.checksum}, that of {values['file']}: the map has changed")
    at_origin = grid.bz_at_origin()
    if stated and values["bz"] and abs(at_origin) < _core.kalman.STRAIGHT_FIELD:
        given = f"{values['bz']:g} T to scale the map to" if isinstance(values["bz"], float) else "a value"
        reader.note("field.bz", given, f"none: the map is {at_origin:g} T at the origin")
    values |= {"grid": grid, "checksum": grid.checksum}
    if not stated:
        values["bz"] = at_origin


_P = TypeVar("_P", bound=Cylinder | Layer | BackgroundLevel)


def _parts(
    reader: Reader,
    tables: Mapping[str, Any],
    group: str,
    kind: type[_P],
    order: str,
    complete: Callable[[str, dict[str, Any], Problems], None] | None = None,
) -> list[_P]:
    """Return the parts of a group in the order of one of their values; parts that were read before stay as they are."""
    group_table = reader.mapping(group, tables.get(group, {}))
    parts: list[_P] = []
    for label, table in group_table.items():
        if isinstance(table, kind):
            parts.append(table)
            continue
        path = f"{group}.{label}"
        values = reader.table(path, table, kind, siblings=group_table)
        if complete:
            complete(path, values, reader.problems)
        parts.append(kind(label=label, **values))
    return sorted(parts, key=attrgetter(order))
