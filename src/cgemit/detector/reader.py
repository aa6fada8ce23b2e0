"""Reader of a detector file: checks every value against its key, collects problems, merges a file with its base."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

from cgemit.base.errors import DetectorError, Problem, Problems, did_you_mean, joined, shown
from cgemit.base.validate import NO, entries
from cgemit.detector.field import MIRRORS
from cgemit.detector.keys import (
    CELLS,
    CENTRED,
    UNUSABLE,
    Key,
    Known,
    file_keys,
    keys_of,
    open_table,
    opened,
    plain,
    required_of,
    table_in,
)
from cgemit.detector.layers import LAYER_KINDS, CgemLayer, Layer
from cgemit.detector.layers.layer import STRIPS, SubLayer
from cgemit.detector.layers.wires import WIRES, CellWire, DriftChamber, DriftPoint, ErrorPoint
from cgemit.detector.material import DensityEffect, Material, elements, fractions_of_formula
from cgemit.detector.parts import RatePoint
from cgemit.detector.readouts import READOUTS, Readout
from cgemit.detector.shells import Bounded
from cgemit.units import NATIVE

#: Kinds of lists of values, and of the values.
OF_LISTS = {"angles": "angle", "lengths": "length", "shifts": "length"}
#: Most entries of a list of rates.
MOST_POINTS = 100


def writable(text: str) -> bool:
    """Return whether a file can hold a text: not with halves of surrogate pairs."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


TOP_LEVEL = {
    "base": "the preset or file that this one changes",
    "name": "name of the detector, used in results",
    "description": "one line about it",
    "remove": 'parts of the base to leave out, such as ["cgem.L2", "drift_chamber"]',
    "field": "magnetic field",
    "beam_pipe": "cylinders of the beam pipe by label",
    **{group: kind.about for group, kind in LAYER_KINDS.items()},
    "readout": "readout of the CGEM layers that state none: a name, or a table; in a variant, of all of the base's",
    "walls": "further cylinders by label",
    "drift_chamber": "drift chamber; sigma, sigma_slope, sigma_points, diffusion, efficiency, wire_x0, cell_wires, "
    "signal_speed, readout_end, drift_relation, drift_velocity, t0 hold for layers without their own, half_length, "
    "z_min, z_max for superlayers without their own",
    "background": "levels of background by label",
    "materials": "materials by name",
}

# Separators of paths, control characters, marks that change the direction of text, and halves of surrogate pairs, which
# no file can hold.
_NOT_IN_NAMES = r"/\\\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff"

#: What a name must match: one line of at most 100 characters, not only blanks and dots, without separators of paths.
NAME = rf"(?=.{{1,100}}$)[^{_NOT_IN_NAMES}]*[^{_NOT_IN_NAMES}\s.][^{_NOT_IN_NAMES}]*"

#: Values that were read before and may have changed: materials, and stacks of them.
_CHANGES = (Material, tuple)


@dataclass
class Reader:
    """Reads tables and notes problems.

    `materials` holds None for a material with problems of its own. If the base could not be read (`baseless`), missing
    values are not problems of the file.
    """

    materials: Mapping[str, Material | None] = field(default_factory=dict)
    problems: Problems = field(default_factory=Problems)
    baseless: bool = False

    def note(self, path: str, given: str, expected: str, hint: str = "") -> Any:
        """Note a problem; return UNUSABLE."""
        self.problems.note(path, given, expected, hint)
        return UNUSABLE

    def mapping(self, path: str, raw: object) -> Mapping[str, Any]:
        """Return `raw` if it is a table, else note the problem and return an empty one."""
        return entries(raw, path, raw if isinstance(raw, Mapping) else (), self.problems)

    def table(
        self,
        path: str,
        raw: object,
        kind: type,
        *,
        elsewhere: Iterable[str] = (),
        defaults: Mapping[str, Any] | None = None,
        siblings: Iterable[str] = (),
        keys: Mapping[str, Key] | None = None,
    ) -> dict[str, Any]:
        """Return the values of a table in native units; UNUSABLE for wrong or missing values.

        Parameters
        ----------
        path, raw : str, object
            Path of the table in the file, and its content.
        kind : type
            The dataclass whose keys are read.
        elsewhere : iterable of str
            Further keys of this table, which the caller has read; for the message about unknown keys.
        defaults : mapping
            Values, already read, of keys that may be missing.
        siblings : iterable of str
            Labels of the tables beside this one, to recognise a misspelt label.
        keys : mapping, optional
            What is read instead of the keys of `kind`.

        """
        keys = keys or file_keys(kind)
        values = dict(defaults or {})
        for name, value in entries(
            raw, path, {**keys, **dict.fromkeys(elsewhere)} if elsewhere else keys, self.problems
        ).items():
            if type(value) is Known:
                known = value.value
                values[name] = self._known(known) if isinstance(known, _CHANGES) else known
            elif name in keys:
                values[name] = self.value(joined(path, name), value, keys[name])
        if hasattr(kind, "short_form"):
            self.settle_ends(path, raw, values, *kind.short_form)
        left = required_of(kind) - values.keys()
        missing = [name for name in keys if name in left] if left else []
        if missing and not self.baseless and isinstance(raw, Mapping):
            hint = _label_hint(path, siblings)
            self.problems.note(path, _only(raw), "also " + ", ".join(missing), hint, unknown=True)
        return {**values, **{name: unusable(keys[name]) for name in missing}}

    def settle_ends(self, path: str, raw: object, values: dict[str, Any], short: str, share: float) -> None:
        """Note ends of a table that are stated twice or in part; of both ends their short form follows."""
        names = ("z_min", "z_max")
        ends = [name for name in names if values.get(name) is not None]
        given = raw if isinstance(raw, Mapping) else {}
        stated = [name for name in (short, *ends) if name in given and not isinstance(given[name], Known)]
        if len(ends) == 2 and stated[:1] != [short]:
            low, high = (values[name] for name in names)
            if low >= high:
                self._note_order(path, stated, low, high)
                values |= {short: UNUSABLE, **dict.fromkeys(names)}
                return
            values[short] = share * (high - low)
            if low == -high:
                values |= dict.fromkeys(names)
            return
        if len(ends) == 1 and stated[:1] != [short]:
            other = names[names[0] == ends[0]]
            self.note(path, f"only {ends[0]}", f"also {other}, or {short} alone")
            values.setdefault(short, UNUSABLE)
        elif len(stated) > 1:
            self.note(f"{path}.{short}", f"also {stated[1]}", f"{short}, or z_min and z_max")
        values |= dict.fromkeys(ends)

    def _note_order(self, path: str, stated: Sequence[str], low: float, high: float) -> None:
        if "z_max" in stated:
            self.note(f"{path}.z_max", f"{high:g} mm", f"above z_min, {low:g} mm")
        else:
            self.note(f"{path}.z_min", f"{low:g} mm", f"below z_max, {high:g} mm")

    def value(self, path: str, raw: object, key: Key) -> Any:
        """Return one value in native units, or UNUSABLE after noting what is wrong."""
        if isinstance(raw, Known):
            return self._known(raw.value)
        if key.kind in NATIVE:
            number = key.read(path, raw, self.problems)
            return UNUSABLE if number is NO else number
        if key.kind in ("text", "boolean", "integer", "sign"):
            return self._plain(path, raw, key)
        return getattr(self, f"_{key.kind}")(path, raw, key)

    def _known(self, value: Any) -> Any:
        """Return a value of a part that was read before; materials of the same name may have changed since."""
        if isinstance(value, Material):
            return self.materials.get(value.name) or value
        if isinstance(value, tuple) and value and isinstance(value[0], SubLayer | CellWire):
            materials = [self._known(part.material) for part in value]
            if any(new is not part.material for new, part in zip(materials, value, strict=True)):
                return tuple(replace(part, material=new) for new, part in zip(materials, value, strict=True))
        return value

    def _plain(self, path: str, raw: object, key: Key) -> Any:
        kinds: dict[str, type] = {"text": str, "boolean": bool, "integer": int, "sign": int}
        good = isinstance(raw, kinds[key.kind]) and (key.kind == "boolean") == isinstance(raw, bool)
        good = good and (not isinstance(raw, str) or writable(raw))
        if good and isinstance(raw, int) and key.kind != "boolean":
            good = raw in (-1, 1) if key.kind == "sign" else key.admits(raw)
        if not good or (key.choices and raw not in key.choices):
            hint = did_you_mean(raw, key.choices) if isinstance(raw, str) and key.choices else ""
            return self.note(path, shown(raw), key.expected(), hint)
        return raw

    def _material(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, str):
            return self.note(path, shown(raw), key.expected())
        if raw not in self.materials:
            known = ", ".join(self.materials)
            return self.note(
                path,
                f'unknown material "{raw}"',
                f"one of {known}, or a table [materials.{raw}]",
                did_you_mean(raw, self.materials),
            )
        return self.materials[raw] or UNUSABLE

    def _gas(self, path: str, raw: object, key: Key) -> Any:
        material = self._material(path, raw, key)
        if isinstance(material, Material) and not material.gas:
            gases = ", ".join(name for name, one in self.materials.items() if one and one.gas)
            return self.note(path, f'"{raw}", which is no gas', f"{key.expected()}, such as {gases}")
        return material

    def _stack(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list) or not raw:
            self.note(path, shown(raw), key.expected())
            return unusable(key)
        parts = []
        for i, row in enumerate(raw):
            if isinstance(row, SubLayer):  # read before
                parts += self._known((row,))
                continue
            values = self.table(f"{path}[{i}]", row, SubLayer)
            values.setdefault("label", getattr(values["material"], "name", ""))
            parts.append(SubLayer(**values))
        return tuple(parts)

    def _wires(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list) or len(raw) > MOST_POINTS:
            self.note(path, shown(raw), key.expected())
            return ()
        wires = []
        for i, row in enumerate(raw):
            if isinstance(row, CellWire):  # read before
                wires += self._known((row,))
                continue
            wire = CellWire(**self.table(f"{path}[{i}]", row, CellWire))
            if 2 * wire.wall > wire.diameter:
                self.note(f"{path}[{i}].wall", f"{wire.wall:g} mm", f"at most half of diameter = {wire.diameter:g} mm")
            wires.append(wire)
        return tuple(wires)

    def _relation(self, path: str, raw: object, key: Key) -> Any:
        points = self._points(path, raw, key, DriftPoint)
        rising = all(b.distance > a.distance and b.time > a.time for a, b in pairwise(points))
        if len(points) == 1 or (points and points[0].distance != 0) or not rising:
            self.note(path, f"a list of {len(points)}", key.expected())
        return points

    def _errors(self, path: str, raw: object, key: Key) -> Any:
        points = self._points(path, raw, key, ErrorPoint)
        if points and (points[0].distance != 0 or any(b.distance <= a.distance for a, b in pairwise(points))):
            self.note(path, f"a list of {len(points)}", key.expected())
        return points

    def _mirrors(self, path: str, raw: object, key: Key) -> Any:
        names = raw if isinstance(raw, list) else [raw]
        if not all(isinstance(name, str) and name in MIRRORS for name in names) or len(set(names)) < len(names):
            return self.note(path, shown(raw), key.expected())
        return tuple(sorted(names))

    def _points(self, path: str, raw: object, key: Key, kind: type) -> Any:
        if not isinstance(raw, list) or not 0 < len(raw) <= MOST_POINTS:
            self.note(path, shown(raw), key.expected())
            return ()
        return tuple(kind(**self.table(f"{path}[{i}]", row, kind)) for i, row in enumerate(raw))

    def _profile(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list) or len(raw) > MOST_POINTS:
            self.note(path, shown(raw), key.expected())
            return ()
        points = [RatePoint(**self.table(f"{path}[{i}]", row, RatePoint)) for i, row in enumerate(raw)]
        if any(second.r <= first.r for first, second in pairwise(points)):
            self.note(path, f"a list of {len(raw)}", key.expected())
        return tuple(points)

    def _readout(self, path: str, raw: object, key: Key) -> Any:
        return self.readout(path, raw, LAYER_KINDS[path.partition(".")[0]])

    def readout(self, path: str, raw: object, kind: type[Layer]) -> Readout:
        """Return the readout of a kind of layers; the usual one after noting what is wrong."""
        known, usual, before = kind.readouts, kind.usual_readout, len(self.problems)
        table = {"name": usual.name} | readout_table(raw) if isinstance(raw, str | Mapping | Readout) else {"name": raw}
        name = plain(table.pop("name"))
        if not isinstance(name, str) or name not in known:
            self.note(path, shown(name), "one of " + ", ".join(known), did_you_mean(name, known))
            return usual
        cls: Any = known[name]
        keys = keys_of(cls)
        table = dict(entries(table, path, keys, self.problems, lambda one: _owner(one, cls, known)))
        values = self.table(path, table, cls, keys=keys)
        if len(self.problems) == before:
            try:
                return cls(**values)  # type: ignore[no-any-return]
            except ValueError as error:  # of a class from outside the package, too
                self.problems.take(error, path)
        return usual

    def _setting(self, _path: str, raw: object, _key: Key) -> Any:
        return raw  # its class checks it

    def _composition(self, path: str, raw: object, key: Key) -> Any:
        if isinstance(raw, str):
            try:
                return tuple(fractions_of_formula(raw).items())
            except KeyError as error:
                return self.note(path, f'unknown element "{error.args[0]}"', "one of " + ", ".join(elements()))
            except ValueError:
                return self.note(path, shown(raw), key.expected())
        if not isinstance(raw, Mapping):
            return self.note(path, shown(raw), key.expected())
        for name, fraction in raw.items():
            if name not in elements():
                return self.note(f"{path}.{name}", "an unknown element", "one of " + ", ".join(elements()))
            if not isinstance(fraction, int | float) or isinstance(fraction, bool) or not 0 < fraction <= 1:
                return self.note(f"{path}.{name}", shown(fraction), "a mass fraction between 0 and 1")
        total = sum(raw.values())
        if abs(total - 1) > 0.01:
            return self.note(path, f"mass fractions with sum {total:g}", "mass fractions with sum 1 (within 0.01)")
        # A sum that is 1 up to rounding stays untouched, so that files read back exactly.
        scale = 1.0 if abs(total - 1) < 1e-9 else total
        return tuple((name, part / scale) for name, part in raw.items())

    def _offset(self, path: str, raw: object, key: Key) -> Any:
        if raw == CENTRED:
            return raw
        if not isinstance(raw, int | float) or isinstance(raw, bool) or not key.admits(raw):
            return self.note(path, shown(raw), key.expected())
        return float(raw)

    def _numbers(self, path: str, raw: object, key: Key) -> Any:
        names = DensityEffect._fields
        if not isinstance(raw, Mapping) or set(raw) != set(names):
            return self.note(path, shown(raw), key.expected())
        number = Key("dimensionless", -100.0, 100.0)
        values = [self.value(f"{path}.{name}", raw[name], number) for name in names]
        return DensityEffect(*values)

    def _counts(self, path: str, raw: object, key: Key) -> Any:
        numbers = raw if isinstance(raw, list) and 0 < len(raw) <= MOST_POINTS else []
        good = all(isinstance(one, int | float) and not isinstance(one, bool) and 0 <= one < 1e15 for one in numbers)
        if not good or not any(numbers):
            self.note(path, shown(raw), key.expected())
            return (1,)
        return tuple(numbers)

    def _cells(self, path: str, raw: object, key: Key) -> Any:
        if isinstance(raw, str):
            return self.value(path, raw, CELLS[float])
        if isinstance(raw, int) and not isinstance(raw, bool):
            return self.value(path, raw, CELLS[int])
        return self.note(path, shown(raw), key.expected())

    def _angles(self, path: str, raw: object, key: Key) -> Any:
        angles = raw if isinstance(raw, list) else [raw]
        if not 0 < len(angles) <= MOST_POINTS:
            self.note(path, shown(raw), key.expected())
            return (UNUSABLE,)
        places = [f"{path}[{i}]" for i in range(len(angles))] if isinstance(raw, list) else [path]
        each = Key(OF_LISTS[key.kind], key.low, key.high)
        return tuple(self.value(place, one, each) for place, one in zip(places, angles, strict=True))

    _lengths = _angles

    def _shifts(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list):
            self.note(path, shown(raw), key.expected())
            return ()
        each = Key(OF_LISTS[key.kind], key.low, key.high)
        return tuple(self.value(f"{path}[{i}]", one, each) for i, one in enumerate(raw))

    def _strips(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list):
            self.note(path, shown(raw), key.expected())
            return ()
        strips = []
        for i, text in enumerate(raw):
            match = re.fullmatch(STRIPS, text) if isinstance(text, str) else None
            if match is None:
                self.note(f"{path}[{i}]", shown(text), key.expected())
                continue
            sheet, first, last = match.groups()
            strips.append((int(sheet), int(first), int(last or first)))
        return tuple(strips)

    def _channels(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list):
            self.note(path, shown(raw), key.expected())
            return ()
        channels = []
        for i, text in enumerate(raw):
            match = re.fullmatch(WIRES, text) if isinstance(text, str) else None
            if match is None:
                self.note(f"{path}[{i}]", shown(text), key.expected())
                continue
            first, last = match.groups()
            channels.append((int(first), int(last or first)))
        return tuple(channels)

    def _gains(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list):
            self.note(path, shown(raw), key.expected())
            return ()
        return tuple(self._gain_grid(f"{path}[{i}]", sheet, key) for i, sheet in enumerate(raw))

    def _gain_grid(self, path: str, raw: object, key: Key) -> Any:
        rows = raw if isinstance(raw, list) else [[raw]]
        if not rows or not all(isinstance(row, list) and row and len(row) == len(rows[0]) for row in rows):
            self.note(path, shown(raw), key.expected() + ", rows of equal length")
            return ((1.0,),)
        for row in rows:
            for gain in row:
                if not isinstance(gain, int | float) or isinstance(gain, bool) or not key.admits(gain):
                    self.note(path, shown(gain), key.expected())
                    return ((1.0,),)
        return tuple(tuple(map(float, row)) for row in rows)


def unusable(key: Key) -> Any:
    """Return what stands for a value that could not be read."""
    if key.kind == "stack":
        return (SubLayer(label="", material=UNUSABLE, thickness=UNUSABLE),)
    return () if key.kind in ("channels", "shifts") else UNUSABLE


def _only(raw: Mapping[str, Any]) -> str:
    return "only " + ", ".join(map(str, raw)) if raw else "an empty table"


def _label_hint(path: str, siblings: Iterable[str]) -> str:
    """Return a hint for an incomplete table: a misspelt label, or a new part."""
    labels = list(siblings)
    label = path.rpartition(".")[2]
    hint = did_you_mean(label, [other for other in labels if other != label])
    return hint or ("a part that the base does not have must be complete" if labels else "")


#: Key of the material that a material of a variant replaces.
BELOW = "<below>"


def _owner(key: str, cls: Any, known: Mapping[str, Any]) -> str:
    """Return which other readouts have a key; an empty text if none has."""
    owners = ", ".join(repr(name) for name, one in known.items() if key in keys_of(one))
    return f"it is a key of name = {owners}, and name is {cls.name!r} here" if owners else ""


def readout_of(choice: Readout | str | Mapping[str, Any]) -> Readout:
    """Return a readout of CGEM layers.

    Parameters
    ----------
    choice : Readout, str or mapping
        A name stands for the readout with its defaults; a mapping is a table as in a detector file.

    Raises
    ------
    DetectorError
        With every problem: no such readout, one whose class is not registered, or wrong values.
    """
    if isinstance(choice, Readout) and READOUTS.get(choice.name) is type(choice):
        return choice
    reader = Reader()
    if isinstance(choice, Readout):
        kind = type(choice).__name__
        hint = f"cgemit.register_readout({kind}, ...) registers it"
        reader.note("readout", f"{kind}(...)", "one of " + ", ".join(READOUTS), hint)
    readout = reader.readout("readout", choice, CgemLayer) if not reader.problems else CgemLayer.usual_readout
    reader.problems.report("readout", DetectorError)
    return readout


def readout_table(choice: str | Mapping[str, Any] | Readout | Known) -> dict[str, Any]:
    """Return a readout as a table of its name and values: a name alone, or a readout read before, states all of them.

    Parameters
    ----------
    choice : str, mapping, Readout or Known
        As a file may state it; of a name that is not known only the name comes back.
    """
    choice = plain(choice)
    if isinstance(choice, str) and choice in READOUTS:
        choice = READOUTS[choice]()
    if isinstance(choice, Readout):
        return {"name": choice.name, **opened(choice)}
    return dict(choice) if isinstance(choice, Mapping) else {"name": choice}


def laid_readout(below: Any, above: Any) -> Any:
    """Return a readout of which another one changes some values, or takes the place if its name differs."""
    above = above if _is_other(above) else readout_table(above)
    if below is None or not isinstance(above, dict) or _is_other(below):
        return above
    below = readout_table(below)
    return above if plain(above.get("name", below.get("name"))) != plain(below.get("name")) else below | above


def _is_known(raw: Any) -> bool:
    return not _is_other(raw) and plain(readout_table(raw).get("name", "")) in ("", *READOUTS)


def _is_other(raw: Any) -> bool:
    """Return whether a value of a file is neither the name of a readout nor a table."""
    return not isinstance(plain(raw), str | Mapping | Readout)


def spread_readout(tables: dict[str, Any]) -> None:
    """Lay the readout of each CGEM layer of a file over that of the top level, which holds for those without."""
    if "readout" in tables and _is_known(tables["readout"]):
        for label in (layers := table_in(tables, "cgem")):
            layer = opened(layers[label])
            if isinstance(layer, Mapping) and "like" not in layer:
                own, top = layer.get("readout"), tables["readout"]
                layers[label] = {**layer, "readout": top if own is None else laid_readout(top, own)}


def merged(base: Mapping[str, Any], variant: Mapping[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Return `base` with the tables of `variant` laid over it; what `variant["remove"]` names is taken out first.

    The base may hold parts that were read before (`describe.tables_of`); those that the variant does not change are
    the same objects in the result. Layers with the key `like` are copies of other layers with some values changed.
    """
    copies: dict[str, dict[str, Any]] = {}
    for group in LAYER_KINDS:
        copies[group] = {label: layer for label, layer in table_in(variant, group).items() if _has_like(layer)}
        if copies[group]:
            variant = {**variant, group: {k: v for k, v in variant[group].items() if k not in copies[group]}}
    result: dict[str, Any] = _copied(base, open_parts="materials" in variant)
    _remove(result, variant.get("remove", []), problems)
    variant = _lay_readout(result, variant)
    for group, kind in LAYER_KINDS.items():
        for label, layer in table_in(variant, group).items():
            if isinstance(layer, Mapping):
                _lay_own_readout(open_table(table_in(result, group), label), layer)
                kind.drop_replaced(open_table(table_in(result, group), label), layer)
                kind.drop_ends(open_table(table_in(result, group), label), layer)
    for group in ("beam_pipe", "walls"):
        for label, part_changes in table_in(variant, group).items():
            if isinstance(part_changes, Mapping):
                Bounded.drop_ends(open_table(table_in(result, group), label), part_changes)
    _drop_field(result, table_in(variant, "field"))
    DriftChamber.drop_replaced(table_in(result, "drift_chamber"), variant)
    _lay_over(result, {k: v for k, v in variant.items() if k not in ("remove", "base")}, "")
    for group, layers in copies.items():
        for label, layer in layers.items():
            _copy_layer(result.setdefault(group, {}), group, label, layer, problems)
    return result


def _lay_readout(base: dict[str, Any], variant: Mapping[str, Any]) -> Mapping[str, Any]:
    """Give the base's CGEM layers the readout of the top level: the base's where they have none, then the variant's.

    What is left of the variant is returned. The top level of the result is for layers that the base does not have.
    """
    spread_readout(base)
    layers = table_in(base, "cgem")
    if "readout" not in variant or not _is_known(variant["readout"]) or not layers:
        return variant  # it is noted once, where it is read
    for label in layers:
        layer = layers[label] = opened(layers[label])
        if isinstance(layer, dict):
            layer["readout"] = laid_readout(layer.get("readout"), variant["readout"])
    top = laid_readout(base.get("readout"), variant["readout"])
    if "name" in top:  # otherwise it changes values of readouts of the base
        base["readout"] = top
    return {name: value for name, value in variant.items() if name != "readout"}


def _lay_own_readout(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Lay the readout of a layer of the variant over that of the base, which it then replaces."""
    if "readout" in variant:
        base["readout"] = laid_readout(base.get("readout"), variant["readout"])


def _copied(tree: Any, *, open_parts: bool = False) -> Any:
    """Return nested tables whose dicts may be changed; parts that were read before are shared, or opened."""
    if isinstance(tree, Mapping):
        return {name: _copied(one, open_parts=open_parts and name != "materials") for name, one in tree.items()}
    return opened(tree) if open_parts else tree


def _has_like(layer: object) -> bool:
    return isinstance(layer, Mapping) and "like" in layer


def _copy_layer(
    layers: dict[str, Any], group: str, label: str, changes: Mapping[str, Any], problems: list[Problem]
) -> None:
    """Add a layer that is a copy of another one with some values changed; those derived from them are left out."""
    like = changes["like"]
    if not isinstance(like, str) or like not in layers:
        got = f'"{like}"' if isinstance(like, str) else repr(like)
        expected = "the label of another layer: " + ", ".join(layers)
        problems.append(Problem(f"{group}.{label}.like", got, expected, did_you_mean(like, layers)))
        return
    layer = _copied(opened(layers[like]))
    own_changes = {name: value for name, value in changes.items() if name != "like"}
    _lay_own_readout(layer, own_changes)
    LAYER_KINDS[group].drop_replaced(layer, own_changes)
    LAYER_KINDS[group].drop_ends(layer, own_changes)
    _lay_over(layer, own_changes, label)
    layers[label] = layer


def set_path(tree: dict[str, Any], dotted: str, value: object) -> bool:
    """Set a value in nested tables by its dotted path; return False if a part of the path is a value already.

    A table is copied, and what is set inside it by longer paths stays.
    """
    *parents, last = dotted.split(".")
    for name in parents:
        tree = tree.setdefault(name, {})
        if not isinstance(tree, dict):
            return False
    before = tree.get(last)
    tree[last] = _copied(value) | before if isinstance(value, Mapping) and isinstance(before, dict) else _copied(value)
    return True


def _drop_field(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Keep only the strength of the base's field if the variant has another kind; a map has its own strength."""
    if not variant:
        return
    old, kind = open_table(base, "field"), variant.get("kind")
    if kind is not None and kind != plain(old.get("kind")):
        base["field"] = {"bz": old["bz"]} if "bz" in old and kind != "map" else {}
    elif "file" in variant:
        base["field"] = {name: value for name, value in old.items() if name not in ("bz", "checksum", "mirror")}
    elif "mirror" in variant:
        base["field"] = {name: value for name, value in old.items() if name != "checksum"}


def _lay_over(base: dict[str, Any], variant: Mapping[str, Any], path: str) -> None:
    for name, value in variant.items():
        if isinstance(value, Mapping) and name in base and path == "materials":
            # Values of a material depend on each other: the reader decides what of the old one stays.
            base[name] = {**_copied(value), BELOW: base[name]}
            continue
        if isinstance(value, Mapping) and name in base:
            base[name] = _stack_of(base[name])
            if isinstance(base[name], list):
                base[name] = _changed_stack(base[name], value)
                continue
            if isinstance(open_table(base, name), dict) and isinstance(base[name], dict):
                _lay_over(base[name], value, name)
                continue
        base[name] = _copied(value)


def _stack_of(value: Any) -> Any:
    """Return the sub-layers of a part that was read before as a list; anything else as it is."""
    return list(value.value) if isinstance(value, Known) and isinstance(value.value, tuple) else value


def _changed_stack(rows: list[Any], changes: Mapping[str, Any]) -> list[Any]:
    """Return the rows of a stack with those changed that `changes` names by label; a new label is a row that is wrong.

    A row without a label has its material's name for one. A change that is no table is a row that is wrong, too.
    """

    def laid(label: Any, row: Mapping[str, Any], change: Any) -> Any:
        return {"label": label, **row, **change} if isinstance(change, Mapping) else change

    labels = [str(_label(row)) for row in rows]
    changed = [
        laid(_label(row), opened(row), changes[label]) if label in changes else row
        for label, row in zip(labels, rows, strict=True)
    ]
    return changed + [laid(label, {}, change) for label, change in changes.items() if label not in labels]


def _label(row: Any) -> Any:
    if isinstance(row, SubLayer):
        return row.label
    return row.get("label", row.get("material")) if isinstance(row, Mapping) else None


def _remove(tree: dict[str, Any], paths: object, problems: list[Problem]) -> None:
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        problems.append(Problem("remove", repr(paths), 'a list of paths such as ["cgem.L2", "drift_chamber"]'))
        return
    for path in paths:
        *parents, last = path.split(".")
        table: Any = tree
        for name in parents:
            table = table.get(name, {}) if isinstance(table, dict) else {}
        if isinstance(table, dict) and last in table:
            del table[last]
        else:
            prefix = "".join(name + "." for name in parents)
            known = [prefix + name for name in table] if isinstance(table, dict) else []
            problems.append(Problem("remove", f'"{path}"', "a part of the base", did_you_mean(path, known)))
