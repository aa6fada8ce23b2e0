"""Constants of a detector from tracks as a table, and the detector with them (docs/methods/alignment.md)."""

from __future__ import annotations

import csv
import math
import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.base.errors import DetectorError, Problem, did_you_mean, shown
from cgemit.base.files import new_file, read_text
from cgemit.base.validate import is_whole, number
from cgemit.detector.drift import relation_of
from cgemit.detector.keys import Known, once
from cgemit.detector.layers import Layer
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.detector.layers.wires import END_SHIFT, WIRE_SHIFT, DriftPoint, WireLayer
from cgemit.detector.parts import Contents
from cgemit.detector.variants import value_at
from cgemit.tables.show import Shown, Tabular, with_error
from cgemit.units import QuantityError, parse_quantity

#: How a constant was treated.
STATUSES = ("free", "fixed", "undetermined", "constrained")
#: ln of the field over that of the description.
FIELD_SCALE = "field.scale"
#: Displacement of a sheet of a CGEM layer; of an end of a single wire; of the ends of wires in one pair of end plates,
#: by its first and last layer; time of the relation of drift distance and time at a distance, of one layer or of all.
_SHEET = re.compile(r"([^.]+\.[^.]+)\.sheets\.(\d{1,3})\.(shift_z|rotation)")
_OF_SHEETS = ("shift_z", "rotation")
_WIRE = re.compile(r"(drift_chamber\.layers\.(\d{1,5}))\.wires\.(\d{1,5})\.((?:east|west)_shift_(?:r|phi))")
_PLATE = re.compile(r"drift_chamber\.plates\.(\d{1,5})-(\d{1,5})\.((?:east|west)_(?:shift_x|shift_y|rotation))")
_POINT = re.compile(r"drift_chamber\.(?:layers\.(\d{1,5})\.)?drift_relation\.(\d{1,3})mm")
_COLUMNS = ("name", "unit", "value", "err", "prior", "global_correlation", "status")


@dataclass(frozen=True, eq=False, repr=False)
class AlignmentTable(Shown, Tabular):
    """Constants of a detector with their errors, one row each.

    Attributes
    ----------
    name : tuple of str
        Dotted keys of the detector file, such as ``"cgem.L1.shift_x"``, or a name of docs/methods/alignment.md:
        ``"field.scale"`` is ln of the field over that of the description.
    unit : tuple of str
        ``"mm"``, ``"rad"``, ``"ns"`` or empty.
    value, err : tuple of float
        To be added to the description; NaN for constants that the data do not determine.
    prior : tuple of float
        Error of the survey; NaN: none.
    global_correlation : tuple of float
        With all other constants together, 0 to 1.
    status : tuple of str
        ``"free"``, ``"fixed"``, ``"undetermined"``, or ``"constrained"``: determined only together with the condition
        that the zero modes are 0.

    Examples
    --------
    >>> det = cg.load("besiii-cgem")
    >>> moved = det.misaligned(seed=1, sizes={"cgem.*": ("100 um", "0.1 mrad")})
    >>> table = moved.displacements()
    >>> len(table.name), det.with_alignment(table).cgem["L1"].shift_x == moved.cgem["L1"].shift_x
    (24, True)
    """

    name: tuple[str, ...]
    unit: tuple[str, ...]
    value: tuple[float, ...]
    err: tuple[float, ...]
    prior: tuple[float, ...]
    global_correlation: tuple[float, ...]
    status: tuple[str, ...]

    def columns(self) -> dict[str, tuple[object, ...]]:
        """Return the columns by name."""
        return {name: getattr(self, name) for name in _COLUMNS}

    def values(self) -> dict[str, float]:
        """Return the values that were determined, or fixed, by name."""
        return {name: value for name, value in zip(self.name, self.value, strict=True) if math.isfinite(value)}

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the table as CSV, from which `load` and `Detector.with_alignment` read it back exactly.

        Parameters
        ----------
        path : path
        overwrite : bool

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        """
        with (
            new_file(path, overwrite=overwrite) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(_COLUMNS)
            rows = zip(*self.columns().values(), strict=True)
            writer.writerows([repr(one) if isinstance(one, float) else one for one in row] for row in rows)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> AlignmentTable:
        """Read what `save` wrote.

        Parameters
        ----------
        path : path

        Raises
        ------
        DetectorError
            Listing every problem of the file.
        """
        try:
            rows = list(csv.reader(read_text(path).splitlines()))
        except (OSError, ValueError) as error:
            raise DetectorError(str(path), [Problem("", str(error), "a table of constants (CSV)")]) from error
        if not rows or tuple(rows[0]) != _COLUMNS:
            given = ", ".join(rows[0]) if rows else "nothing"
            raise DetectorError(str(path), [Problem("columns", given[:200], ", ".join(_COLUMNS))])
        problems, constants = [], []
        for line, row in enumerate(rows[1:], start=2):
            if len(row) != len(_COLUMNS):
                problems.append(Problem(f"line {line}", f"{len(row)} values", f"{len(_COLUMNS)}"))
                continue
            numbers = [_number(text) for text in row[2:6]]
            for text, value, name in zip(row[2:6], numbers, _COLUMNS[2:6], strict=True):
                if value is None:
                    problems.append(Problem(f"line {line}: {name}", repr(text), "a number or nan"))
            if row[6] not in STATUSES:
                problems.append(Problem(f"line {line}: status", repr(row[6]), f"one of {', '.join(STATUSES)}"))
            constants.append((row[0], row[1], *numbers, row[6]))
        if problems:
            raise DetectorError(str(path), problems)
        return cls(*map(tuple, zip(*constants, strict=True))) if constants else cls(*((),) * 7)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        if any(".wires." in name for name in self.name):
            return self._wires()
        rows = []
        for name, unit, value, err, prior, correlation, status in zip(*self.columns().values(), strict=True):
            factor, shown = {"mm": (1e3, "um"), "rad": (1e3, "mrad")}.get(str(unit), (1.0, str(unit)))
            shown_value = with_error(factor * value, factor * err) if np.isfinite(value) else "-"
            if status == "fixed":
                shown_value = f"{factor * value:g}"
            survey = f"{factor * prior:g}" if np.isfinite(prior) else "-"
            shared = f"{correlation:.3f}" if np.isfinite(correlation) else "-"
            rows.append([str(name), shown, shown_value, survey, shared, str(status)])
        return f"{len(rows)} constants", ("constant", "unit", "value", "survey", "correlation", "status"), rows

    def _wires(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        """Return the constants of single wires in one row for each layer and key."""
        groups = dict[str, list[int]]()
        for i, name in enumerate(self.name):
            match = _WIRE.fullmatch(name)
            groups.setdefault(f"{match[1]}.wires.*.{match[4]}" if match else name, []).append(i)
        value, err, rows = 1e3 * np.array(self.value), 1e3 * np.array(self.err), []
        for name, members in groups.items():
            known = [i for i in members if np.isfinite(err[i])]
            numbers = (f"{np.sqrt(np.mean(value[known] ** 2)):.4g}", f"{np.median(err[known]):.4g}") if known else "--"
            rows.append([name, "um", f"{len(known)} of {len(members)}", *numbers])
        return f"{len(self.name)} constants", ("constants", "unit", "determined", "RMS", "median error"), rows


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def constants_in(constants: object, source: str) -> dict[str, float]:
    """Return values by name of what `Detector.with_alignment` takes.

    Parameters
    ----------
    constants : AlignmentTable, mapping, or path of a table
    source : str
        For messages.

    Raises
    ------
    DetectorError
        If it is none of these, or the file has problems.
    """
    if isinstance(constants, str | os.PathLike):
        constants = AlignmentTable.load(Path(constants))
    if isinstance(constants, AlignmentTable):
        return constants.values()
    numbers = constants.items() if isinstance(constants, Mapping) else ()
    if not isinstance(constants, Mapping) or not all(
        isinstance(name, str) and isinstance(value, int | float | np.number) and not isinstance(value, bool)
        for name, value in numbers
    ):
        expected = "a table of constants, its path, or numbers by name"
        raise DetectorError(source, [Problem("with_alignment", type(constants).__name__, expected)])
    return {name: float(value) for name, value in numbers}


def overrides_of(detector: Contents, values: Mapping[str, float]) -> dict[str, object]:
    """Return the keys of a detector whose constants are larger by some values, with their new values.

    Parameters
    ----------
    detector : Contents
    values : mapping of str to float
        By name, mm, rad, ns or 1.

    Raises
    ------
    DetectorError
        Listing every name that is no number of the detector, and every value that is not finite.
    """
    problems, overrides = list[Problem](), dict[str, object]()
    numbers: dict[str, float] = {}  # several constants may move one
    lists: dict[str, list[float]] = {}
    points: dict[int, dict[int, float]] = {}
    nodes = points_of_relation(detector)
    for name, change in values.items():
        if not math.isfinite(change):
            problems.append(Problem(name, f"{change:g}", "a finite number"))
            continue
        point = _POINT.fullmatch(name)
        known = point is not None and int(point[2]) in nodes and bool(_wire_layers(detector, point[1]))
        if point and known:
            for wires in _wire_layers(detector, point[1]):
                of_layer = points.setdefault(wires.number, {})
                of_layer[int(point[2])] = of_layer.get(int(point[2]), 0.0) + change
        keys = keys_of_constant(detector, name)
        for path, entry in keys:
            if entry is not None:
                if path not in lists:
                    lists[path] = _whole_list(detector, path)
                lists[path][entry] += change
                continue
            now = value_at(detector, path)
            before = numbers.setdefault(path, float((now[0] if now else 0.0) or 0.0))
            numbers[path] = before * math.exp(change) if name == FIELD_SCALE else before + change
        if not point and not keys:
            hint = did_you_mean(name, [FIELD_SCALE])
            problems.append(Problem(name, f"{change:g}", "the dotted key of a displacement, or another constant", hint))
        elif point and not known:
            problems.append(
                Problem(name, f"{change:g}", f"a wire layer of the detector, and {nodes[0]} to {nodes[-1]} mm")
            )
    overrides |= {path: Known(value) for path, value in numbers.items()}
    for path, entries in lists.items():
        now = value_at(detector, path)
        if now is not None and (wrong := [one for one in entries if not now[1].low <= one <= now[1].high]):
            given = ", ".join(f"{one:g}" for one in wrong[:5])
            problems.append(Problem(path, given, f"numbers from {now[1].low:g} to {now[1].high:g}"))
        overrides[path] = Known(tuple(entries))
    for wires in _wire_layers(detector, None):
        if wires.number not in points:
            continue
        path, nodes_after = wires.path, _relation_with(wires, points[wires.number], nodes)
        if any(b.time <= a.time for a, b in pairwise(nodes_after)):
            at = next(a.distance for a, b in pairwise(nodes_after) if b.time <= a.time)
            problems.append(Problem(f"{path}.drift_relation", f"times that fall from {at:g} mm", "times that rise"))
        overrides |= {f"{path}.drift_relation": Known(nodes_after), f"{path}.drift_velocity": Known(None)}
    if problems:
        raise DetectorError(detector.name, problems)
    return overrides


def _whole_list(detector: Contents, path: str) -> list[float]:
    """Return the entries of a list of all sheets, or of all wires, of a layer."""
    path_of_layer, _, key = path.rpartition(".")
    for wires in _wire_layers(detector, None):
        if wires.path == path_of_layer:
            return list(getattr(wires, key) or (0.0,) * wires.cells)
    layer = next(one for one in detector.layers if one.path == path_of_layer)
    return list(layer.sheet_z if key == "sheet_shift_z" else _turns(layer))


def _turns(layer: Layer) -> tuple[float, ...]:
    own = layer.sheet_rotation or (0.0,)
    return tuple(own[i % len(own)] for i in range(layer.sheets))


def _wire_layers(detector: Contents, layer_number: str | None) -> list[WireLayer]:
    """Return the wire layer of a number, or all."""
    layers = detector.drift_chamber.layers if detector.drift_chamber else ()
    return [layer for layer in layers if layer_number is None or layer.number == int(layer_number)]


def keys_of_constant(detector: Contents, name: str) -> list[tuple[str, int | None]]:
    """Return the keys of a detector file that a constant changes, and the entry of their list; may be empty."""
    if name == FIELD_SCALE:
        return [("field.bz", None)]
    if match := _WIRE.fullmatch(name):
        layers = [one for one in _wire_layers(detector, match[2]) if int(match[3]) < one.cells]
        return [(f"{match[1]}.wires_{match[4]}", int(match[3])) for _ in layers]
    if match := _SHEET.fullmatch(name):
        for layer in detector.layers:
            if layer.path == match[1] and value_at(detector, f"{layer.path}.sheet_{match[3]}"):
                return [(f"{layer.path}.sheet_{match[3]}", int(match[2]))] if int(match[2]) < layer.sheets else []
        return []
    if match := _PLATE.fullmatch(name):
        within = [one for one in _wire_layers(detector, None) if int(match[1]) <= one.number <= int(match[2])]
        return [(f"{one.path}.{match[3]}", None) for one in within]
    now = value_at(detector, name)
    known = now is not None and now[1].kind in ("length", "angle", "time", "dimensionless") and name.count(".") > 0
    return [(name, None)] if known else []


def value_of(detector: Contents, name: str) -> tuple[float, float, float] | None:
    """Return the present value of a constant and how far it may go down and up; None if there is none.

    Values are in mm, rad, ns or 1. The value of several parts is their mean; that of a field its logarithm.
    """
    if point := _POINT.fullmatch(name):
        layers = _wire_layers(detector, point[1]) if int(point[2]) in points_of_relation(detector) else []
        times = [_time_at(layer, float(point[2])) for layer in layers]
        return (float(np.mean(times)), -_MOST_TIME, _MOST_TIME) if times else None
    entries = []
    for path, entry in keys_of_constant(detector, name):
        now = value_at(detector, path)
        assert now is not None
        value, key = now
        if entry is not None:
            value = (value[entry % len(value)] if value else 0.0) or 0.0
        entries.append((float(value or 0.0), key.low, key.high))
    if not entries:
        return None
    if name == FIELD_SCALE:
        return float(np.log(abs(entries[0][0]))), -0.5, 0.5
    values, low, high = (np.array(one) for one in zip(*entries, strict=True))
    return float(np.mean(values)), float(np.max(low - values)), float(np.min(high - values))


_MOST_TIME = 1000.0  # ns, of a change of a drift relation


def _time_at(layer: WireLayer, distance: float) -> float:
    relation = relation_of(layer)
    slope = (relation.time[-1] - relation.time[-2]) / (relation.distance[-1] - relation.distance[-2])
    beyond = max(distance - relation.distance[-1], 0.0)
    return float(np.interp(distance, relation.distance, relation.time) - layer.t0 + slope * beyond)


@once
def points_of_relation(detector: Contents) -> tuple[int, ...]:
    """Return the distances of the points of a relation of drift distance and time: each mm of the widest half cell."""
    half = [math.pi * one.r_end / one.cells for one in detector.wires]
    return tuple(range(1, max(int(max(half, default=0.0)), 1) + 1))


def hat(point: int, distance: npt.ArrayLike, points: Sequence[int]) -> Floats:
    """Return the share of a point of a relation at distances: 1 at its own, falling to 0 at the points beside it.

    Nearer to the wire than all points the share of the first one is 1, and farther that of the last one.

    Parameters
    ----------
    point : int
        mm.
    distance : array_like, mm
    points : sequence of int
        All of them.
    """
    inside = np.clip(distance, points[0], points[-1])
    return np.asarray(np.maximum(1 - np.abs(inside - point), 0.0))


def _relation_with(layer: WireLayer, changes: Mapping[int, float], points: Sequence[int]) -> tuple[DriftPoint, ...]:
    """Return the relation of a layer with changes of its times at distances, ns by mm."""
    own = np.zeros(1) if layer.drift_velocity else relation_of(layer).distance
    distances = np.unique(np.concatenate([own, np.array(points, np.float64)]))
    changed = [
        _time_at(layer, float(one)) + sum(change * float(hat(at, one, points)) for at, change in changes.items())
        for one in distances
    ]
    return tuple(DriftPoint(distance=float(a), time=float(b)) for a, b in zip(distances, changed, strict=True))


#: Patterns of displacement of a whole detector that tracks constrain weakly. (Formulas as in the lists of weak modes
#: of CMSSW and basf2.) Each is the displacement at points (r, phi, z), mm and rad, of a detector of radius R and half
#: length Z: (3, n) along x, y, z, at most about 1.
PATTERNS = (
    "radial", "telescope", "layer_rotation", "curl", "bowing", "z_expansion", "twist", "elliptical", "skew",
    "clamshell", "sagitta",
)  # fmt: skip


def pattern_at(name: str, points: Floats, size: tuple[float, float]) -> Floats:
    """Return the displacement of a pattern at points.

    Parameters
    ----------
    name : str
        One of `PATTERNS`.
    points : ndarray, (n, 3) float64, mm
    size : (float, float), mm
        Radius and half length of the detector.

    Returns
    -------
    ndarray, (n, 3) float64
    """
    x, y, z = points.T
    r, phi = np.hypot(x, y), np.arctan2(y, x)
    outer, long = size
    none = np.zeros_like(r)

    def around(angle: Floats) -> Floats:  # mm, by a turn in units of the outer radius
        return np.stack([-y * angle, x * angle, none], axis=1) / outer

    def across(scale: Floats) -> Floats:
        return np.stack([x * scale, y * scale, none], axis=1) / outer

    def along(shift: Floats) -> Floats:
        return np.stack([none, none, shift], axis=1)

    if name == "radial":
        return across(np.ones_like(r))
    if name == "telescope":
        return along(r / outer)
    if name == "layer_rotation":
        return around(r / outer - 0.5)
    if name == "curl":
        return around(r / outer)
    if name == "bowing":
        return across(1 - (z / long) ** 2)
    if name == "z_expansion":
        return along(z / long)
    if name == "twist":
        return around(z / long)
    if name == "elliptical":
        return across(np.cos(2 * phi))
    if name == "skew":
        return along(r / outer * np.cos(phi))
    if name == "clamshell":
        return around(np.cos(phi))
    return np.stack([none, r / outer, none], axis=1)  # sagitta


def rigid_parts(detector: Contents) -> dict[str, tuple[Floats, Floats]]:
    """Return points on the parts that move as a whole, and the points about which they turn, by dotted key.

    Returns
    -------
    dict of str to (ndarray, (n, 3) float64, and ndarray, (3,) float64), mm
    """
    parts = {}
    for layer in detector.layers:
        path = f"{layer.group}.{layer.label}"
        parts[path] = (_cylinder([(layer.r_mid, *layer.ends)]), layer.shift)
    chamber = detector.drift_chamber
    if chamber is not None and chamber.layers:
        parts["drift_chamber"] = _cylinder([(one.r_mid, *one.ends) for one in chamber.layers]), chamber.shift
    return parts


def _cylinder(layers: list[tuple[float, float, float]]) -> Floats:
    phi, share = (one.ravel() for one in np.meshgrid(np.arange(16) * np.pi / 8, np.linspace(0, 1, 9)))
    return np.concatenate(
        [np.stack([r * np.cos(phi), r * np.sin(phi), low + (high - low) * share], axis=1) for r, low, high in layers]
    )


#: Of a pattern's square; with less, the parts of the detector cannot move like it.
_LEAST_SHARE = 0.1


def pattern_values(detector: Contents, name: str) -> tuple[dict[str, float], float]:
    """Return the constants of the parts of a detector that come nearest to a pattern of size 1 mm.

    Parameters
    ----------
    detector : Contents
    name : str
        One of `PATTERNS`.

    Returns
    -------
    values : dict of str to float
        By name, mm and rad.
    share : float
        Of the pattern's square that these displacements make, 0 to 1; of that in the wires if only their ends can.
    """
    parts, values = rigid_parts(detector), dict[str, float]()
    every = np.concatenate([points for points, _ in parts.values()])
    size = float(np.hypot(every[:, 0], every[:, 1]).max()), float(np.abs(every[:, 2]).max())

    def follow(path: str, keys: tuple[str, ...], points: Floats, columns: list[Floats]) -> tuple[float, float]:
        wanted = pattern_at(name, points, size)
        matrix = np.stack([one.ravel() for one in columns], axis=1)
        solution = np.linalg.lstsq(matrix, wanted.ravel(), rcond=None)[0]
        names = (f"{path}.{key}" for key in keys)
        values.update({key: float(one) for key, one in zip(names, solution, strict=True) if abs(one) > 1e-12})
        # Parts count alike, whatever the number of their points.
        return float(np.mean(wanted**2)), float(np.mean((matrix @ solution) ** 2))

    shares = []
    for path, (points, pivot) in parts.items():
        columns = [np.broadcast_to(axis, points.shape) for axis in np.eye(3)]
        columns += [np.cross(axis, points - pivot) for axis in np.eye(3)]
        shares.append(follow(path, PLACEMENT, points, columns))
    total, followed = np.sum(shares, axis=0)
    if followed >= _LEAST_SHARE * total:
        return values, float(followed / total) if total else 0.0
    # Whole parts cannot; wires may by their ends.
    values.clear()
    shares = [follow(one.path, END_SHIFT, *_by_ends(one)) for one in detector.wires]
    total, followed = np.sum(shares, axis=0) if shares else (0.0, 0.0)
    return values, float(followed / total) if total else 0.0


def _by_ends(layer: WireLayer) -> tuple[Floats, list[Floats]]:
    """Return points on wires, and what each key of their ends does to them, (n, 3) each."""
    ends = layer.wire_ends(np.arange(0, layer.cells, max(layer.cells // 16, 1)))  # (wires, end, 3)
    points, columns = [], list[list[Floats]]([[] for _ in END_SHIFT])
    for share in np.linspace(0, 1, 9):
        points.append(share * ends[:, 0] + (1 - share) * ends[:, 1])
        moves = [
            part * np.broadcast_to(axis, points[-1].shape)
            for end, part in ((0, share), (1, 1 - share))
            for axis in (*np.eye(3)[:2], np.cross(np.eye(3)[2], ends[:, end]))
        ]
        for column, move in zip(columns, moves, strict=True):
            column.append(move)
    return np.concatenate(points), [np.concatenate(column) for column in columns]


def misaligned_values(detector: Contents, seed: int, sizes: Mapping[str, object]) -> dict[str, float]:
    """Return constants of a displaced detector; see `Detector.misaligned`.

    Raises
    ------
    DetectorError
        Listing every problem.
    """
    problems: list[Problem] = []
    if not is_whole(seed, 0, 2**64 - 1):
        problems.append(Problem("seed", shown(seed), "a whole number from 0 to 2**64 - 1"))
    paths = list(rigid_parts(detector))
    spread: dict[str, float] = {}
    drawn_values: dict[str, float] = {}
    for key, size in sizes.items():
        if key in PATTERNS:
            length = _size(key, size, "length", problems)
            values, share = pattern_values(detector, key)
            if share < _LEAST_SHARE:
                expected = "a pattern that displacements of whole parts or of the ends of wires make"
                problems.append(Problem(key, f"{100 * share:.0f} % of it", expected))
            for name, value in values.items():
                drawn_values[name] = drawn_values.get(name, 0.0) + length * value
            continue
        named = [path for path in paths if _fits(path, key)]
        if named and isinstance(size, tuple | list) and len(size) == 2:
            of_shift, of_turn = _size(key, size[0], "length", problems), _size(key, size[1], "angle", problems)
            for path in named:
                for name in PLACEMENT:
                    spread[f"{path}.{name}"] = of_shift if name.startswith("shift") else of_turn
            continue
        single = [f"{path}.{name}" for path in paths for name in PLACEMENT if _fits(f"{path}.{name}", key)]
        if ".wires." in key:
            of_wires = ((f"{one.path}.wires.{i}", way) for one in detector.wires for i, _, way in _places(one))
            single = [f"{path}.{way}" for path, way in of_wires if _fits(path, key) or _fits(f"{path}.{way}", key)]
        if single:
            kind = "length" if "shift" in single[0] else "angle"
            spread |= dict.fromkeys(single, _size(key, size, kind, problems))
            continue
        expected = "a part with a length and an angle, a key of a displacement, or a pattern"
        problems.append(Problem(key, shown(size), expected, did_you_mean(key, [*paths, *PATTERNS])))
    if problems:
        raise DetectorError(detector.name, problems)
    for name, width in spread.items():
        # A constant depends on the seed and its own name alone.
        event = np.array([_FIRST_EVENT + zlib.crc32(name.encode())], np.int64)
        drawn = _core.common.normals(seed, event, np.zeros(1, np.int32), _core.common.Purpose.gun, 0, 0)
        drawn_values[name] = drawn_values.get(name, 0.0) + width * float(np.ravel(drawn)[0])
    return drawn_values


_FIRST_EVENT = 2**62  # beyond events of any run, so that no draw of a gun is the same


def _fits(name: str, pattern: str) -> bool:
    words, patterns = name.split("."), pattern.split(".")
    return len(words) == len(patterns) and all(map(fnmatchcase, words, patterns))


def _size(path: str, raw: object, kind: str, problems: list[Problem]) -> float:
    try:
        value = parse_quantity(raw, kind) if isinstance(raw, str) else number(raw)
    except QuantityError as error:
        problems.append(Problem(path, shown(raw), str(error)))
        return 0.0
    if not (math.isfinite(value) and value >= 0):
        problems.append(Problem(path, shown(raw), f"a {kind}, 0 or more"))
        return 0.0
    return value


def _places(layer: WireLayer) -> Iterator[tuple[int, int, str]]:
    """Yield the numbers of all wires of a layer with those of the displacements of their ends, and their names."""
    return ((wire, i, key) for wire in range(layer.cells) for i, key in enumerate(WIRE_SHIFT))


def displacements_of(detector: Contents) -> AlignmentTable:
    """Return the displacements that a description has; see `Detector.displacements`."""
    names = [f"{path}.{key}" for path in rigid_parts(detector) for key in PLACEMENT]
    finer = [f"{one.path}.sheets.{i}.{key}" for one in detector.cgem for i in range(one.sheets) for key in _OF_SHEETS]
    finer += [f"{one.path}.{key}" for one in detector.wires for key in (*PLACEMENT, *END_SHIFT)]
    known = {name: (value_of(detector, name) or (0.0,))[0] for name in (*names, *finer)}
    names += [name for name in finer if known[name]]
    for layer in detector.wires:
        if (shifts := layer.wire_shifts()) is not None:
            single = {f"{layer.path}.wires.{i}.{key}": float(shifts[i, k]) for i, k, key in _places(layer)}
            known |= single
            names += [name for name, value in single.items() if value]
    values = [known[name] for name in names]
    none = (math.nan,) * len(names)
    units = tuple("mm" if "shift" in name else "rad" for name in names)
    return AlignmentTable(tuple(names), units, tuple(values), none, none, none, ("fixed",) * len(names))
