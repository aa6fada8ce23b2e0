"""Tables of a variant laid over those of its base; values of the base that follow from changed ones are left out."""

from collections.abc import Mapping
from typing import Any

from cgemit.detector.keys import CENTRED, Known, opened, plain
from cgemit.detector.parts import SubLayer
from cgemit.problems import Problem, did_you_mean

#: Key of the material that a material of a variant replaces.
BELOW = "<below>"

#: Derived values of a CGEM layer in the order of their computation, each with the values that it depends on.
DERIVED_FROM = {
    "strips_x": {"anode_radius", "readout_offset", "sheets", "pitch_x"},
    "stereo": {"strips_x", "pitch_x", "length", "stereo_sign"},
    "strips_v": {"stereo", "strips_x", "pitch_x", "pitch_v", "length"},
    "offset_v": {"strips_v", "stereo", "strips_x", "pitch_x", "pitch_v", "length"},
}

#: Values of [drift_chamber] that hold for every layer which does not state its own; a new value in a variant
#: replaces the listed values of the base's layers.
FOR_ALL_LAYERS = {
    "sigma": ("sigma", "sigma_slope"),
    "sigma_slope": ("sigma_slope",),
    "efficiency": ("efficiency",),
    "wire_x0": ("wire_x0",),
    "signal_speed": ("signal_speed",),
    "readout_end": ("readout_end",),
}


def merged(base: Mapping[str, Any], variant: Mapping[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Return `base` with the tables of `variant` laid over it; what `variant["remove"]` names is taken out first.

    The base may hold parts that were read before (`describe.tables_of`); those that the variant does not change are
    the same objects in the result. CGEM layers with the key `like` are copies of other layers with some values changed.
    """
    copies = {label: layer for label, layer in _tables(variant, "cgem").items() if _has_like(layer)}
    if copies:
        variant = {**variant, "cgem": {k: v for k, v in variant["cgem"].items() if k not in copies}}
    result: dict[str, Any] = _copied(base, open_parts="materials" in variant)
    _remove(result, variant.get("remove", []), problems)
    for label, layer in _tables(variant, "cgem").items():
        if isinstance(layer, Mapping):
            _drop_derived(_open(_tables(result, "cgem"), label), layer)
    _drop_field(result, _tables(variant, "field"))
    chamber = variant.get("drift_chamber")
    if isinstance(chamber, Mapping):
        for name in FOR_ALL_LAYERS.keys() & chamber.keys():
            layers = _tables(_tables(result, "drift_chamber"), "layers")
            for layer in (_open(layers, number) for number in layers):
                for old in FOR_ALL_LAYERS[name]:
                    layer.pop(old, None)
    _lay_over(result, {k: v for k, v in variant.items() if k not in ("remove", "base")}, "")
    for label, layer in copies.items():
        _copy_layer(result.setdefault("cgem", {}), label, layer, problems)
    return result


def _copied(tree: Any, *, open_parts: bool = False) -> Any:
    """Return nested tables whose dicts may be changed; parts that were read before are shared, or opened."""
    if isinstance(tree, Mapping):
        return {name: _copied(one, open_parts=open_parts and name != "materials") for name, one in tree.items()}
    return opened(tree) if open_parts else tree


def _open(tables: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a table of others, opened if it is a part that was read before; an empty one if it is none."""
    if name in tables:
        tables[name] = opened(tables[name])
    return _tables(tables, name)


def _has_like(layer: object) -> bool:
    return isinstance(layer, Mapping) and "like" in layer


def _copy_layer(layers: dict[str, Any], label: str, changes: Mapping[str, Any], problems: list[Problem]) -> None:
    """Add a CGEM layer that is a copy of another one with some values changed; those derived from them are left out."""
    like = changes["like"]
    if not isinstance(like, str) or like not in layers:
        given = f'"{like}"' if isinstance(like, str) else repr(like)
        expected = "the label of another layer: " + ", ".join(layers)
        problems.append(Problem(f"cgem.{label}.like", given, expected, did_you_mean(like, layers)))
        return
    layer = _copied(opened(layers[like]))
    own = {name: value for name, value in changes.items() if name != "like"}
    _drop_derived(layer, own)
    _lay_over(layer, own, label)
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


def _tables(tree: Mapping[str, Any], name: str) -> dict[str, Any]:
    found = tree.get(name)
    return found if isinstance(found, dict) else {}


def _drop_derived(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Remove the derived values of a layer of the base that depend on changed values."""
    changed = set(variant)
    for name, depends in DERIVED_FROM.items():
        if name not in variant and changed & depends:
            old = base.pop(name, None)
            changed.add(name)
            old = plain(old)
            if name == "stereo" and isinstance(old, str | float):
                base["stereo_sign"] = -1 if str(old).lstrip().startswith("-") else 1
            if name == "offset_v" and old:
                base["offset_v"] = CENTRED  # strips that were moved off the corner stay on the sheet


def _drop_field(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Keep only the strength of the base's field if the variant has another kind; a map has its own strength."""
    if not variant:
        return
    old, kind = _open(base, "field"), variant.get("kind")
    if kind is not None and kind != plain(old.get("kind")):
        base["field"] = {"bz": old["bz"]} if "bz" in old and kind != "map" else {}
    elif "file" in variant:
        base["field"] = {name: value for name, value in old.items() if name not in ("bz", "checksum")}


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
            if isinstance(_open(base, name), dict) and isinstance(base[name], dict):
                _lay_over(base[name], value, name)
                continue
        base[name] = _copied(value)


def _stack_of(value: Any) -> Any:
    """Return the sub-layers of a part that was read before as a list; anything else as it is."""
    return list(value.value) if isinstance(value, Known) and isinstance(value.value, tuple) else value


def _changed_stack(rows: list[Any], changes: Mapping[str, Any]) -> list[Any]:
    """Return the rows of a stack with those changed that `changes` names by label; a new label is a row that is wrong.

    A row without a label has its material's name for one.
    """
    found, left = [], dict(changes)
    for row in rows:
        label = _label(row)
        change = changes.get(str(label))
        left.pop(str(label), None)
        found.append({"label": label, **opened(row), **change} if isinstance(change, Mapping) else row)
    return found + [{"label": label, **change} for label, change in left.items() if isinstance(change, Mapping)]


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
