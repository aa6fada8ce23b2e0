"""Changes of a detector by dotted keys: wildcards, relative values, names of variants, hashes, allowed ranges."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from typing import Any

from cgemit.base.errors import DetectorError, Problem, did_you_mean, shown
from cgemit.detector.keys import CELLS, Key, Known, Part, default, file_keys, keys_of, once
from cgemit.detector.layers import CgemLayer
from cgemit.detector.layers.layer import SubLayer
from cgemit.detector.layers.wires import FOR_ALL_LAYERS, CellWire, DriftChamber
from cgemit.detector.material import Material
from cgemit.detector.parts import Contents
from cgemit.detector.reader import OF_LISTS, TOP_LEVEL
from cgemit.detector.readouts import Readout
from cgemit.detector.shells import Bounded
from cgemit.units import NATIVE

_NUMBER = r"(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+)"
_FACTOR = re.compile(rf"\s*[x×]\s*{_NUMBER}\s*")
_PERCENT = re.compile(rf"\s*([+-]{_NUMBER})\s*%\s*")
_LONGEST_NAME = 100


def like(label: str, **changes: object) -> dict[str, object]:
    """Return a CGEM layer, for `load` and `Detector.with_overrides`, that is a copy with some values changed.

    ``detector.with_overrides({"cgem.L0": cg.like("L1", anode_radius="62 mm")})`` adds the layer L0. Strip counts and
    stereo angles that depend on changed values are computed anew.

    Parameters
    ----------
    label : str
        Label of the layer that is copied.
    **changes : object
        Keys of a CGEM layer with values as in a detector file, ``"62 mm"``.

    Returns
    -------
    dict of str to object
        The table ``{"like": label, **changes}`` of a detector file. Values, and the layer of that label, are checked
        where the table is used.

    Raises
    ------
    DetectorError
        With every name that is no key of a CGEM layer, and if `label` is no text.

    Examples
    --------
    >>> det = cg.load("besiii-cgem-design").with_overrides({"cgem.L0": cg.like("L1", anode_radius="62 mm")})
    >>> [(layer.label, layer.anode_radius) for layer in det.cgem]
    [('L0', 62.0), ('L1', 87.5), ('L2', 132.5), ('L3', 175.0)]
    """
    known = list(file_keys(CgemLayer))
    problems = [
        Problem(name, shown(value), "a key of a CGEM layer", did_you_mean(name, known))
        for name, value in changes.items()
        if name not in known
    ]
    if not isinstance(label, str) or not label:
        problems.insert(0, Problem("label", shown(label), "the label of another layer"))
    if problems:
        raise DetectorError(f"like({shown(label)})", problems)
    return {"like": label, **changes}


def factor_of(value: object) -> float | None:
    """Return the factor that a relative value such as ``"x2"`` or ``"+5 %"`` stands for, or None."""
    if not isinstance(value, str):
        return None
    if times := _FACTOR.fullmatch(value):
        factor = float(times[1])
    elif percent := _PERCENT.fullmatch(value):
        factor = 1 + float(percent[1]) / 100
    else:
        return None
    return factor if math.isfinite(factor) else None


def expanded(detector: Contents, changes: Mapping[str, object], problems: list[Problem]) -> dict[str, object]:
    """Return changes by plain dotted keys: wildcards filled in, relative values computed from those of the detector.

    Parameters
    ----------
    detector : Contents
    changes : mapping of str to object
        By dotted keys, several of which may stand together, separated by commas. ``*``, ``?`` and ``[...]`` match
        labels of parts that are not removed; a key without them has precedence. They match in paths of `remove`, too.
    problems : list of Problem
        Receives every pattern that matches nothing, every relative value of something that is no number, and keys
        that change what another pattern, or another plain key, changes.
    """
    overrides: dict[str, object] = {}
    exact: dict[str, object] = {}
    named_by: dict[tuple[str, bool], str] = {}  # of paths, and whether a pattern matched: the keys that match it
    removed = changes.get("remove")
    gone: tuple[str, ...] = ()
    if isinstance(removed, list) and all(isinstance(path, str) for path in removed):
        paths = _removed(detector, removed, problems)
        changes, gone = {**changes, "remove": paths}, tuple(f"{path}." for path in paths)
    for keys, value in changes.items():
        changed, noted = False, len(problems)
        for key in keys.split(","):
            for path in matching(detector, key.strip(), problems):
                if path != key.strip() and f"{path}.".startswith(gone):
                    continue
                plain = path == key.strip()
                before = named_by.setdefault((path, plain), keys)
                if before != keys and not any(one.path == key.strip() and one.unknown for one in problems):
                    given = f'{path}, which "{before}" changes too'
                    problems.append(Problem(key.strip(), given, "one key for each value", unknown=True))
                values = _absolute(detector, path, value, problems)
                (exact if plain else overrides).update(values)
                changed = changed or bool(values)
        if not changed and factor_of(value) is not None and len(problems) == noted:
            problems.append(Problem(keys, shown(value), "an absolute value: the detector has no such pitch or error"))
    return overrides | exact


def _removed(detector: Contents, patterns: list[str], problems: list[Problem]) -> list[str]:
    """Return the paths of the parts that `remove` names, each once."""
    wrong: list[Problem] = []
    paths = list(dict.fromkeys(path for one in patterns for path in matching(detector, one, wrong)))
    problems += [
        one._replace(path="remove", given=f'"{one.path}", which matches nothing', unknown=False) for one in wrong
    ]
    return paths


def matching(detector: Contents, pattern: str, problems: list[Problem]) -> Iterator[str]:
    """Yield the dotted keys of a detector that a pattern matches; a key without wildcards is yielded as it is."""
    if not _is_pattern(pattern):
        yield pattern
        return
    matches, problem = _matched(detector, pattern)
    problems += [problem] if problem else []
    yield from matches


@once
def _matched(detector: Contents, pattern: str) -> tuple[tuple[str, ...], Problem | None]:
    """Return the dotted keys that a pattern matches, or why there is none."""
    paths: list[tuple[str, Any]] = [("", _root(detector))]
    parts = pattern.split(".")
    for i, name in enumerate(parts):
        children_of = []
        exact = not _is_pattern(".".join(parts[i:]))  # the name of a new part, perhaps
        for path, node in paths:
            children = _children(node)
            names = [name] if exact else [child for child in children if fnmatchcase(child, name)]
            children_of += [(f"{path}.{child}".lstrip("."), children.get(child)) for child in names]
        if not children_of:
            known = ", ".join(dict.fromkeys(child for _, node in paths for child in _children(node)))
            given, expected = f'"{name}", which matches nothing', f"a pattern for {known or 'a part'}"
            return (), Problem(pattern, given, expected, unknown=True)
        paths = children_of
    return tuple(path for path, _ in paths), None


def _is_pattern(text: str) -> bool:
    return any(mark in text for mark in "*?[")


@once
def _root(detector: Contents) -> dict[str, Any]:
    return {"field": detector.field, "drift_chamber": detector.drift_chamber, **detector.labelled()}


def _children(node: Any) -> Mapping[str, Any]:
    """Return what may stand behind a dot: labels of parts, keys of a part, labels of the rows of a stack."""
    if isinstance(node, Mapping):
        return node
    if isinstance(node, tuple) and node and isinstance(node[0], SubLayer):
        return {part.label: part for part in node}
    return _values(node) if isinstance(node, Part) and not isinstance(node, Material) else {}


@once
def _values(part: Part) -> dict[str, Any]:
    return part.children()


def _node(detector: Contents, path: str) -> Any:
    """Return what is at a dotted key; None if nothing is."""
    node: Any = _root(detector)
    for name in path.split(".") if path else ():
        node = _children(node).get(name)
    return node


def value_at(detector: Contents, path: str) -> tuple[Any, Key] | None:
    """Return the value at a dotted key and what it may be; None if the detector has no such value."""
    parent, _, last = path.rpartition(".")
    node = _node(detector, parent)
    if isinstance(node, Part) and (extra := node.extra_value(last)) is not None:
        return extra, node.extra_keys[last]
    kind: Any = type(node)
    keys = keys_of(kind) if dataclasses.is_dataclass(node) else {}
    if last not in keys:
        return None
    value, key = getattr(node, last), keys[last]
    if isinstance(node, Bounded) and last in ("z_min", "z_max"):
        value = node.ends[last == "z_max"]
    return value, CELLS[type(value)] if key.kind == "cells" else key


def values_at(detector: Contents, keys: str, problems: list[Problem]) -> list[tuple[Any, Key] | None]:
    """Return what `value_at` returns for each value that some keys stand for.

    Parameters
    ----------
    detector : Contents
    keys : str
        Dotted keys or patterns, separated by commas; one of the drift chamber may stand for all of its layers, and
        `sigma` or `pitch` of a measurement layer for both coordinates.
    problems : list of Problem
        Receives every pattern that matches nothing.
    """
    paths = [path for key in keys.split(",") for path in matching(detector, key.strip(), problems)]
    return [value_at(detector, one) for path in paths for one in _several(detector, path) or [path]]


def _several(detector: Contents, path: str) -> list[str]:
    """Return the keys for which a key of the drift chamber or of a part stands; none for another key."""
    group, _, name = path.rpartition(".")
    part = _node(detector, group)
    if isinstance(part, Part) and (names := part.stands_for(name)):
        return [f"{group}.{one}" for one in names]
    if group != "drift_chamber" or name not in FOR_ALL_LAYERS or detector.drift_chamber is None:
        return []
    return [f"drift_chamber.layers.{layer.number}.{name}" for layer in detector.drift_chamber.layers]


def _absolute(detector: Contents, path: str, value: object, problems: list[Problem]) -> dict[str, object]:
    """Return the changes that a value, which may be relative, makes at a plain key."""
    factor = factor_of(value)
    if factor is None:
        return {path: value}
    if layers := _several(detector, path):
        return {one: new for layer in layers for one, new in _absolute(detector, layer, value, problems).items()}
    now = value_at(detector, path)
    if now is None:
        hint = did_you_mean(path.rpartition(".")[2], _siblings(detector, path))
        problems.append(Problem(path, shown(value), "a number of the detector", hint, unknown=True))
        return {}
    old, key = now
    parent, _, last = path.rpartition(".")
    if old == 0 and _node(detector, parent).may_lack(last):
        return {}
    if key.kind == "integer" and (old * factor) % 1 == 0:
        return {path: Known(round(old * factor))}
    if (key.kind in NATIVE and old is not None) or (key.kind == "offset" and isinstance(old, float)):
        return {path: Known(old * factor)}
    if key.kind in OF_LISTS and old:
        return {path: Known(tuple(one * factor for one in old))}
    if key.kind not in ("text", "material", "gas"):
        given = f"{shown(value)} times {old}" if key.kind == "integer" else shown(value)
        problems.append(Problem(path, given, key.expected()))
        return {}
    return {path: value}


def _siblings(detector: Contents, path: str) -> list[str]:
    return list(_children(_node(detector, path.rpartition(".")[0])))


def variant_name(name: str, changes: Mapping[str, object]) -> str:
    """Return the name of a variant: the base's, and behind plus signs what changed, such as ``+cgem.L2.pitch_x=500um``.

    Wildcards that match every label are left out. A long name ends with a hash of all changes.
    """
    base, texts = _split_name(name)
    for key, value in changes.items():
        if key not in ("name", "description"):
            key = ",".join(part.strip() for part in key.split(","))
            texts[key.replace(".*", "")] = _short(value)
    full = "+".join([base, *(f"{key}={text}" if text else key for key, text in texts.items())])
    if len(full) <= _LONGEST_NAME:
        return full
    return f"{full[: _LONGEST_NAME - 9]}~{hashlib.sha256(full.encode()).hexdigest()[:8]}"


def _split_name(name: str) -> tuple[str, dict[str, str]]:
    """Return the name of the first base, and the changes that the rest of the name tells."""
    *parts, last = name.split("+")
    changes: dict[str, str] = {}
    while parts and last.partition("=")[0].partition(".")[0] in TOP_LEVEL:
        key, _, text = last.partition("=")
        changes = {key: text} | changes
        last = parts.pop()
    return "+".join([*parts, last]), changes


def _short(value: object) -> str:
    """Return a value as a part of a name: without blanks, plus signs and separators of paths."""
    if isinstance(value, Known):
        value = value.value
    if isinstance(value, list) and all(isinstance(one, str) for one in value):
        value = ",".join(value)
    if isinstance(value, Mapping) and "like" in value:
        value = ",".join(f"{key}={_short(one)}" for key, one in value.items())
    if not isinstance(value, str | int | float):
        return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()[:8]
    text = str(value).lower() if isinstance(value, bool) else str(value)
    return re.sub(r"[/\\]", "_", re.sub(r"[\s+]", "", text))


def content_hash(detector: Contents) -> str:
    """Return 16 hexadecimal digits that name the content of a detector, whatever its name and description are."""
    chamber = detector.drift_chamber
    layers = [layer for _, layers in detector.by_kind() for layer in layers]
    parts = [detector.field, *detector.beam_pipe, *layers, *detector.walls, detector.air]
    digests = [*map(_digest, parts), *([_digest_of_all(chamber)] if chamber else [])]
    digests += map(_digest, detector.background)
    return hashlib.sha256(" ".join(digests).encode()).hexdigest()[:16]


@once
def _digest_of_all(chamber: DriftChamber) -> str:
    return " ".join(map(_digest, (chamber, *chamber.layers)))


@once
def _digest(part: Part) -> str:
    kind: Any = type(part)
    values = [f"{kind.__name__} {getattr(part, 'label', '')} {getattr(part, 'number', '')}"]
    for name, key in keys_of(kind).items():
        value = getattr(part, name)
        if key.quiet and value == default(kind, name):
            continue
        if type(value) is float:
            values.append(f"{name}={value!r}")
        elif isinstance(value, Readout):
            if value != getattr(part, "usual_readout", None):
                values.append(f"{name}={value.stated()!r}")
        elif name != "file" and value not in ((), None):  # a map's checksum tells more; as before lists and shifts
            values.append(f"{name}={_text(value)}")
    return hashlib.sha256("\n".join(values).encode()).hexdigest()


def _text(value: Any) -> str:
    if isinstance(value, Material | SubLayer | CellWire):
        return f"{getattr(value, 'name', '')} {_digest(value)}"
    if isinstance(value, tuple) and value and isinstance(value[0], SubLayer | CellWire):
        return " ".join(map(_digest, value))
    return repr(value)
