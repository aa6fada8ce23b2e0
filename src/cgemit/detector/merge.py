"""A variant on top of its base: tables are merged label by label, values that depend on changed ones are dropped."""

import copy
from collections.abc import Mapping
from typing import Any

from cgemit.detector.derive import CENTRED
from cgemit.detector.problems import Problem
from cgemit.words import did_you_mean

#: Values of a CGEM layer that are worked out from others, in order, and what each depends on.
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
}


def merged(base: Mapping[str, Any], variant: Mapping[str, Any], problems: list[Problem]) -> dict[str, Any]:
    """Return `base` with the tables of `variant` laid over it; what `variant["remove"]` names is taken out first."""
    result = copy.deepcopy(dict(base))
    _remove(result, variant.get("remove", []), problems)
    for label, layer in _tables(variant, "cgem").items():
        if isinstance(layer, Mapping):
            _drop_derived(_tables(result, "cgem").get(label, {}), layer)
    _drop_field(result, _tables(variant, "field"))
    chamber = variant.get("drift_chamber")
    if isinstance(chamber, Mapping):
        for name in FOR_ALL_LAYERS.keys() & chamber.keys():
            for layer in _tables(_tables(result, "drift_chamber"), "layers").values():
                for old in FOR_ALL_LAYERS[name]:
                    layer.pop(old, None)
    _lay_over(result, {k: v for k, v in variant.items() if k not in ("remove", "base")}, "")
    return result


def set_path(tree: dict[str, Any], dotted: str, value: object) -> bool:
    """Set a value in nested tables by its dotted path; return False if a part of the path is a value already."""
    *parents, last = dotted.split(".")
    for name in parents:
        tree = tree.setdefault(name, {})
        if not isinstance(tree, dict):
            return False
    tree[last] = value
    return True


def _tables(tree: Mapping[str, Any], name: str) -> dict[str, Any]:
    found = tree.get(name)
    return found if isinstance(found, dict) else {}


def _drop_derived(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Remove from a layer of the base what no longer follows from its changed values."""
    changed = set(variant)
    for name, depends in DERIVED_FROM.items():
        if name not in variant and changed & depends:
            old = base.pop(name, None)
            changed.add(name)
            if name == "stereo" and isinstance(old, str):
                base["stereo_sign"] = -1 if old.lstrip().startswith("-") else 1
            if name == "offset_v" and old:
                base["offset_v"] = CENTRED  # strips that were moved off the corner stay on the sheet


def _drop_field(base: dict[str, Any], variant: Mapping[str, Any]) -> None:
    """Leave nothing of the base's field but its strength where the variant has another kind; a map brings its own."""
    old, kind = _tables(base, "field"), variant.get("kind")
    if kind is not None and kind != old.get("kind"):
        base["field"] = {"bz": old["bz"]} if "bz" in old and kind != "map" else {}
    elif "file" in variant:
        base["field"] = {name: value for name, value in old.items() if name not in ("bz", "checksum")}


def _lay_over(base: dict[str, Any], variant: Mapping[str, Any], path: str) -> None:
    for name, value in variant.items():
        # A material is one statement: half of an old one and half of a new one would not belong together.
        if isinstance(value, Mapping) and isinstance(base.get(name), dict) and path != "materials":
            _lay_over(base[name], value, name)
        else:
            base[name] = copy.deepcopy(value)


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
