"""Reading one table of a detector file: every value is checked against its key, every problem is noted."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Any

from cgemit.detector.background import RatePoint
from cgemit.detector.keys import CENTRED, Key, Known, keys_of, required_of
from cgemit.detector.material import DensityEffect, Material, elements, fractions_of_formula
from cgemit.detector.parts import CgemLayer, SubLayer
from cgemit.detector.read_lists import MOST_POINTS, ListReader, shown, writable
from cgemit.problems import Problem, did_you_mean
from cgemit.units import NATIVE, QuantityError, parse_quantity

TOP_LEVEL = {
    "base": "the preset or file that this one changes",
    "name": "name of the detector, used in results",
    "description": "one line about it",
    "remove": 'parts of the base to leave out, such as ["cgem.L2", "drift_chamber"]',
    "field": "magnetic field",
    "beam_pipe": "cylinders of the beam pipe by label",
    "cgem": "CGEM layers by label",
    "walls": "further cylinders by label",
    "drift_chamber": "drift chamber; sigma, sigma_slope, efficiency, wire_x0, signal_speed, readout_end hold for "
    "layers without their own",
    "background": "levels of background by label",
    "materials": "materials by name",
}

# Separators of paths, control characters, marks that change the direction of text, and halves of surrogate pairs, which
# no file can hold.
_NOT_IN_NAMES = r"/\\\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff"

#: What a name must match: one line of at most 100 characters, not only blanks and dots, without separators of paths.
NAME = rf"(?=.{{1,100}}$)[^{_NOT_IN_NAMES}]*[^{_NOT_IN_NAMES}\s.][^{_NOT_IN_NAMES}]*"

#: What the label of a wire layer must match, and its largest number.
WIRE_NUMBER, LAST_WIRE_LAYER = "0|[1-9][0-9]{0,4}", 65535


#: Keys that a file may hold beside those of the dataclass.
EXTRA: dict[type, dict[str, Key]] = {
    CgemLayer: {"stereo_sign": Key("sign", "sign of the stereo angle where the angle itself is left out")},
    Material: {"base": Key("text", "the material that this one is, at another density")},
    SubLayer: {
        "label": Key("text", "label of the sub-layer; the material's name if left out"),
    },
}


#: A value whose problem has been noted. Arithmetic with it stays unusable and no check of it fails, so the rest of the
#: part can still be checked.
UNUSABLE: Any = math.nan


#: Values that were read before and may have changed: materials, and stacks of them.
_CHANGES = (Material, tuple)


@dataclass
class Reader(ListReader):
    """Reads tables and notes problems.

    `materials` holds None for a material with problems of its own. If the base could not be read (`baseless`), missing
    values are not problems of the file.
    """

    materials: Mapping[str, Material | None] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    baseless: bool = False

    def note(self, path: str, given: str, expected: str, hint: str = "") -> Any:
        """Note a problem; return UNUSABLE."""
        self.problems.append(Problem(path, given, expected, hint))
        return UNUSABLE

    def mapping(self, path: str, raw: object) -> Mapping[str, Any]:
        """Return `raw` if it is a table, else note the problem and return an empty one."""
        if isinstance(raw, Mapping):
            return raw
        self.note(path, shown(raw), f"a table [{path}]")
        return {}

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
        keys = keys or _keys(kind)
        values = dict(defaults or {})
        tables = self.mapping(path, raw)
        for name, value in tables.items():
            if type(value) is Known and name in keys:
                known = value.value
                values[name] = self._known(known) if isinstance(known, _CHANGES) else known
            elif name in keys:
                values[name] = self.value(f"{path}.{name}", value, keys[name])
            else:
                names = [*keys, *elsewhere]
                self.note(f"{path}.{name}", "an unknown key", "one of " + ", ".join(names), did_you_mean(name, names))
        left = required_of(kind) - values.keys()
        missing = [name for name in keys if name in left] if left else []
        if missing and not self.baseless and isinstance(raw, Mapping):
            self.note(path, _only(raw), "also " + ", ".join(missing), _label_hint(path, siblings))
        return {**values, **{name: _unusable(keys[name]) for name in missing}}

    def value(self, path: str, raw: object, key: Key) -> Any:
        """Return one value in native units, or UNUSABLE after noting what is wrong."""
        if isinstance(raw, Known):
            return self._known(raw.value)
        if key.kind in NATIVE:
            return self._quantity(path, raw, key)
        if key.kind in ("text", "boolean", "integer", "sign"):
            return self._plain(path, raw, key)
        return getattr(self, f"_{key.kind}")(path, raw, key)

    def _known(self, value: Any) -> Any:
        """Return a value of a part that was read before; materials of the same name may have changed since."""
        if isinstance(value, Material):
            return self.materials.get(value.name) or value
        if isinstance(value, tuple) and value and isinstance(value[0], SubLayer):
            materials = [self._known(part.material) for part in value]
            if any(new is not part.material for new, part in zip(materials, value, strict=True)):
                return tuple(replace(part, material=new) for new, part in zip(materials, value, strict=True))
        return value

    def _quantity(self, path: str, raw: object, key: Key) -> Any:
        try:
            number = parse_quantity(raw, key.kind)
        except QuantityError as error:
            return self.note(path, error.given, error.expected, error.hint)
        if not key.admits(number):
            converted = isinstance(raw, str) and NATIVE[key.kind] not in raw
            native = f" = {number:.6g} {NATIVE[key.kind]}" if converted else ""
            return self.note(path, shown(raw) + native, key.expected())
        return number

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
            return _unusable(key)
        parts = []
        for i, row in enumerate(raw):
            if isinstance(row, SubLayer):  # read before
                parts += self._known((row,))
                continue
            values = self.table(f"{path}[{i}]", row, SubLayer)
            values.setdefault("label", getattr(values["material"], "name", ""))
            parts.append(SubLayer(**values))
        return tuple(parts)

    def _profile(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list) or len(raw) > MOST_POINTS:
            self.note(path, shown(raw), key.expected())
            return ()
        points = [RatePoint(**self.table(f"{path}[{i}]", row, RatePoint)) for i, row in enumerate(raw)]
        if any(second.r <= first.r for first, second in pairwise(points)):
            self.note(path, f"a list of {len(raw)}", key.expected())
        return tuple(points)

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
        for name, part in raw.items():
            if name not in elements():
                return self.note(f"{path}.{name}", "an unknown element", "one of " + ", ".join(elements()))
            if not isinstance(part, int | float) or isinstance(part, bool) or not 0 < part <= 1:
                return self.note(f"{path}.{name}", shown(part), "a mass fraction between 0 and 1")
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
        number = Key("dimensionless", "", -100.0, 100.0)
        values = [self._quantity(f"{path}.{name}", raw[name], number) for name in names]
        return DensityEffect(*values)


@cache
def _keys(kind: Any) -> dict[str, Key]:
    """Return the keys that the table of a part may have in a file."""
    return {**keys_of(kind), **EXTRA.get(kind, {})}


def _unusable(key: Key) -> Any:
    if key.kind == "stack":
        return (SubLayer(label="", material=UNUSABLE, thickness=UNUSABLE),)
    return UNUSABLE


def _only(raw: Mapping[str, Any]) -> str:
    return "only " + ", ".join(map(str, raw)) if raw else "an empty table"


def _label_hint(path: str, siblings: Iterable[str]) -> str:
    """Return a hint for an incomplete table: a misspelt label, or a new part."""
    others = list(siblings)
    label = path.rpartition(".")[2]
    hint = did_you_mean(label, [other for other in others if other != label])
    return hint or ("a part that the base does not have must be complete" if others else "")
