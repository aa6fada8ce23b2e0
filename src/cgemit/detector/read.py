"""Reading one table of a detector file: every value is checked against its key, every problem is noted."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ..units import NATIVE, QuantityError, format_quantity, parse_quantity
from .check import in_range
from .keys import Key, keys_of, required_of
from .material import DensityEffect, Material, elements, fractions_of_formula
from .model import SubLayer
from .problems import Problem, did_you_mean


class _Unusable:
    """Marks a value whose problem has been noted."""


UNUSABLE = _Unusable()


@dataclass
class Reader:
    """Reads tables; notes problems; knows the materials (None for a material with problems of its own)."""

    materials: Mapping[str, Material | None] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def note(self, path: str, given: str, expected: str, hint: str = "") -> _Unusable:
        """Note a problem."""
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
        extra: Mapping[str, Key] | None = None,
        defaults: Mapping[str, Any] | None = None,
        siblings: Iterable[str] = (),
    ) -> dict[str, Any] | None:
        """Return the values of a table in native units, or None if anything in it is wrong.

        Parameters
        ----------
        path : str
            Where the table stands in the file.
        raw : object
            What the file says.
        kind : type
            The dataclass whose keys are read.
        extra : mapping of str to Key
            Further keys that are allowed.
        defaults : mapping
            Values, already read, of keys that may be missing; UNUSABLE makes the table unusable without a new problem.
        siblings : iterable of str
            Labels of the tables beside this one, to recognise a misspelt label.

        """
        before = len(self.problems)
        if not isinstance(raw, Mapping):
            self.mapping(path, raw)
            return None
        keys = {**keys_of(kind), **(extra or {})}
        values = dict(defaults or {})
        for name, value in raw.items():
            if name in keys:
                values[name] = self.value(f"{path}.{name}", value, keys[name])
            else:
                self.note(f"{path}.{name}", "an unknown key", "one of " + ", ".join(keys), did_you_mean(name, keys))
        missing = [name for name in keys if name in required_of(kind) - raw.keys() - values.keys()]
        if missing:
            given = "only " + ", ".join(raw) if raw else "an empty table"
            label = path.rpartition(".")[2]
            hint = did_you_mean(label, set(siblings) - {label}) or "a part that the base does not have must be complete"
            self.note(path, given, "also " + ", ".join(missing), hint)
        usable = not any(value is UNUSABLE for value in values.values())
        return values if usable and len(self.problems) == before else None

    def value(self, path: str, raw: object, key: Key) -> Any:
        """Return one value in native units, or UNUSABLE after noting what is wrong."""
        if key.kind in NATIVE:
            return self._quantity(path, raw, key)
        if key.kind in ("text", "boolean", "integer", "sign"):
            return self._plain(path, raw, key)
        return getattr(self, f"_{key.kind}")(path, raw, key)

    def _quantity(self, path: str, raw: object, key: Key) -> Any:
        try:
            number = parse_quantity(raw, key.kind)
        except QuantityError as error:
            return self.note(path, error.given, error.expected, error.hint)
        if not in_range(number, key):
            native = format_quantity(number, key.kind)
            return self.note(path, shown(raw) if native == raw else f"{shown(raw)} = {native}", key.expected())
        return number

    def _plain(self, path: str, raw: object, key: Key) -> Any:
        kinds: dict[str, type] = {"text": str, "boolean": bool, "integer": int, "sign": int}
        good = isinstance(raw, kinds[key.kind]) and (key.kind == "boolean") == isinstance(raw, bool)
        if good and isinstance(raw, int) and key.kind != "boolean":
            good = raw in (-1, 1) if key.kind == "sign" else in_range(raw, key)
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

    def _stack(self, path: str, raw: object, key: Key) -> Any:
        if not isinstance(raw, list) or not raw:
            return self.note(path, shown(raw), key.expected())
        parts = []
        label = Key("text", "label of the sub-layer; the material's name if left out")
        material = Key("material", "name of the material")
        for i, row in enumerate(raw):
            values = self.table(f"{path}[{i}]", row, SubLayer, {"label": label, "material": material})
            if values is not None and "material" not in values:
                self.note(f"{path}[{i}]", "no material", key.expected())
            elif values is not None:
                parts.append(SubLayer(**{"label": values["material"].name, **values}))
        return tuple(parts) if len(parts) == len(raw) else UNUSABLE

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

    def _numbers(self, path: str, raw: object, key: Key) -> Any:
        names = DensityEffect._fields
        if not isinstance(raw, Mapping) or set(raw) != set(names):
            return self.note(path, shown(raw), key.expected())
        number = Key("dimensionless", "", -100.0, 100.0)
        values = [self._quantity(f"{path}.{name}", raw[name], number) for name in names]
        return UNUSABLE if any(value is UNUSABLE for value in values) else DensityEffect(*values)


def shown(raw: object) -> str:
    """Return a short rendering of what a file says, as TOML would write it."""
    if isinstance(raw, Mapping):
        return "a table"
    if isinstance(raw, list):
        return f"a list of {len(raw)}"
    if isinstance(raw, bool):
        return str(raw).lower()
    return f'"{raw}"' if isinstance(raw, str) else repr(raw)
