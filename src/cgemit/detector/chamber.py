"""Read a drift chamber: layers row by row, or generated from superlayers (docs/methods/detector.md)."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from cgemit.base.errors import shown
from cgemit.detector.keys import CELLS, UNUSABLE, Key, Known, keys_of
from cgemit.detector.layers.wires import (
    FOR_ALL_LAYERS,
    GENERATED,
    LAST_WIRE_LAYER,
    OF_ENDS,
    WIRE_NUMBER,
    DriftChamber,
    Superlayer,
    WireLayer,
)
from cgemit.detector.reader import OF_LISTS, Reader, unusable
from cgemit.units import NATIVE

# More than any detector has: a mistake, or meant to exhaust the memory.
_MOST_WIRE_LAYERS, _MOST_CELLS = 1000, 1_000_000
_TOUCH = 1e-6  # mm


def read_chamber(reader: Reader, raw: object) -> DriftChamber | None:
    """Return the drift chamber of a table; None if it is no table."""
    if isinstance(raw, DriftChamber):
        return raw
    if not isinstance(raw, Mapping):
        reader.mapping("drift_chamber", raw)
        return None
    tables = {"wire_material": "Al", **raw}
    rows = reader.mapping("drift_chamber.layers", tables.pop("layers", {}))
    groups = reader.mapping("drift_chamber.superlayers", tables.pop("superlayers", {}))
    generated = tables.pop(GENERATED, False)
    # Values for all layers are read once, so that a mistake in one is reported once.
    for_all = (*FOR_ALL_LAYERS, *OF_ENDS) if "superlayers" in raw else FOR_ALL_LAYERS
    keys = {name: keys_of(WireLayer)[name] for name in for_all}
    common = {
        name: reader.value(f"drift_chamber.{name}", tables.pop(name), key)
        for name, key in keys.items()
        if name in tables
    }
    _settle_errors(reader, "drift_chamber", raw, common)
    if "superlayers" in raw:
        reader.settle_ends("drift_chamber", raw, common, *WireLayer.short_form)
    _one_of(reader, "drift_chamber", raw, common, *_RELATION)
    values = reader.table("drift_chamber", tables, DriftChamber, elsewhere=(*keys, "layers", "superlayers"))
    superlayers = _superlayers(reader, groups, common)
    if groups and not generated:
        rows = _laid_over(_wire_rows(reader, superlayers), rows)
    layers = []
    if len(rows) > _MOST_WIRE_LAYERS:
        reader.note("drift_chamber.layers", f"{len(rows)} tables", f"at most {_MOST_WIRE_LAYERS}")
        rows = {}
    for layer_number, row in rows.items():
        if isinstance(row, WireLayer):
            layers.append(row)
        elif re.fullmatch(WIRE_NUMBER, str(layer_number)) and int(layer_number) <= LAST_WIRE_LAYER:
            path = f"drift_chamber.layers.{layer_number}"
            row_values = reader.table(path, row, WireLayer, defaults=_defaults(row, common), siblings=rows)
            _one_of(reader, path, row, row_values, *_MATTER)
            _one_of(reader, path, row, row_values, *_RELATION)
            _settle_errors(reader, path, row, row_values)
            layers.append(WireLayer(number=int(layer_number), **row_values))
        else:
            text = shown(str(layer_number))
            expected = f"the number of a layer, such as 8, up to {LAST_WIRE_LAYER}"
            reader.note(f"drift_chamber.layers.{text[1:-1]}", text, expected)
    cells = sum(layer.cells for layer in layers)
    if cells > _MOST_CELLS:
        reader.note("drift_chamber.layers", f"{cells} cells", f"at most {_MOST_CELLS}")
    ordered = tuple(sorted(layers, key=lambda layer: layer.number))
    if any(layer.cell_wires for layer in ordered):
        values.setdefault("wires", "smeared")
    return DriftChamber(**values, layers=ordered, superlayers=tuple(superlayers))


def _defaults(raw: object, common: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the values for all layers; a table with `sigma_points` needs no `sigma`."""
    has_points = isinstance(raw, Mapping) and "sigma_points" in raw
    return {"sigma": 1.0, **common} if has_points else common


def _settle_errors(reader: Reader, path: str, raw: object, values: dict[str, Any]) -> None:
    """Note a table that states its error twice; one with points has the error of the first one as `sigma`."""
    points = values.get("sigma_points")
    if not isinstance(points, tuple) or not points or not isinstance(raw, Mapping):
        return
    names = ("sigma_points", "sigma", "sigma_slope")
    stated = [name for name in names if name in raw and not isinstance(raw[name], Known)]
    if stated and stated[0] != names[0]:  # the points hold for all layers
        values["sigma_points"] = ()
        return
    if len(stated) > 1:
        reader.note(f"{path}.{stated[1]}", "also sigma_points", "one of both")
    values |= {"sigma": points[0].sigma, "sigma_slope": 0.0}


#: Pairs of keys of wires that state the same: their matter, and the relation of drift distance and time.
_MATTER, _RELATION = ("cell_wires", "wire_x0"), ("drift_relation", "drift_velocity")


def _one_of(reader: Reader, path: str, raw: object, values: dict[str, Any], *names: str) -> None:
    """Note a table that states both of two keys; keep what it states of what holds for all layers."""
    if not all(values.get(name) for name in names) or not isinstance(raw, Mapping):
        return
    stated = [name for name in names if name in raw and not isinstance(raw[name], Known)]
    if len(stated) > 1:
        reader.note(f"{path}.{names[1]}", f"also {names[0]}", "one of both")
    else:
        kept = stated or [name for name in names if name in raw] or names
        values.pop(names[kept[0] == names[0]])


def _laid_over(generated: dict[str, Any], rows: Mapping[str, Any]) -> dict[str, Any]:
    """Return generated rows with the values of others in their place."""
    for layer_number, row in rows.items():
        both = layer_number in generated and isinstance(row, Mapping)
        generated[layer_number] = {**generated[layer_number], **row} if both else row
    return generated


def _superlayers(reader: Reader, tables: Mapping[str, Any], common: Mapping[str, Any]) -> list[Superlayer]:
    """Return superlayers in the order of the file, their values checked."""
    complete = []
    for label, table in tables.items():
        if isinstance(table, Superlayer):
            complete.append(table)
            continue
        path = f"drift_chamber.superlayers.{label}"
        values = reader.table(path, table, Superlayer, defaults=_defaults(table, common), siblings=tables)
        _one_of(reader, path, table, values, *_MATTER)
        _one_of(reader, path, table, values, *_RELATION)
        _settle_errors(reader, path, table, values)
        for name, key in keys_of(Superlayer).items():  # relative values have not been checked
            value = values.get(name)
            limits = CELLS[int if isinstance(value, int) else float] if key.kind == "cells" else key
            if not all(_fits(reader, f"{path}.{name}", one, limits) for one in _numbers(value)):
                values[name] = (UNUSABLE,) if key.kind in OF_LISTS else UNUSABLE
        if values.get("stereo") and values.get("twist"):
            reader.note(f"{path}.twist", "both stereo and twist", "one of them: each follows from the other")
        complete.append(Superlayer(label=str(label), **values))
    return complete


def _numbers(value: Any) -> list[int | float]:
    values = value if isinstance(value, tuple) else (value,)
    return [one for one in values if isinstance(one, int | float) and not isinstance(one, bool)]


def _fits(reader: Reader, path: str, value: float, key: Key, of: str = "") -> bool:
    """Return whether a number is in the range of its key, and note the problem; unusable ones have theirs already."""
    if math.isnan(value) or key.admits(value):
        return True
    unit = NATIVE.get(OF_LISTS.get(key.kind, key.kind), "")
    reader.note(path, f"{value:.6g} {unit}".rstrip() + of, key.expected())
    return False


def _wire_rows(reader: Reader, superlayers: Sequence[Superlayer]) -> dict[str, Any]:
    """Return the tables of all wire layers by number, from 0; the first problem of each superlayer is noted."""
    total = sum(1 if math.isnan(one.layers) else one.layers for one in superlayers)
    if total > _MOST_WIRE_LAYERS:
        reader.note("drift_chamber.superlayers", f"{total} layers", f"at most {_MOST_WIRE_LAYERS}")
        superlayers = ()
    rows: list[dict[str, Any]] = []
    border = UNUSABLE  # where the superlayer before ends
    reach, before = UNUSABLE, ""  # the outermost border so far, and its superlayer
    for superlayer in superlayers:
        path = f"drift_chamber.superlayers.{superlayer.label}"
        start = border if superlayer.r_in is None else superlayer.r_in
        if superlayer.r_in is None and superlayer is superlayers[0] and not reader.baseless:
            reader.note(f"{path}.r_in", "nothing", "the inner border of the innermost superlayer")
        good, border = True, start
        if superlayer.r_in is not None and start < reach - _TOUCH:
            expected = f"at least {reach:.6g} mm, the outer border of {before}: superlayers from inside outward"
            reader.note(f"{path}.r_in", f"{start:g} mm", expected)
            good = False
        for i in range(1 if math.isnan(superlayer.layers) else superlayer.layers):
            row, border = _wire_row(superlayer, i, border, shifted=superlayer.stagger and len(rows) % 2 == 1)
            good = good and _possible(reader, path, superlayer, row, len(rows))
            more = {name: getattr(superlayer, name) for name in FOR_ALL_LAYERS} | (
                {"gas": superlayer.gas} if superlayer.gas else {}
            )
            rows.append(more | row if good else _UNUSABLE_ROW)
        if not border <= reach:
            reach, before = border, superlayer.label
    rows = rows or [_UNUSABLE_ROW]
    return {str(number): {name: Known(value) for name, value in row.items()} for number, row in enumerate(rows)}


_UNUSABLE_ROW = {name: unusable(key) for name, key in keys_of(WireLayer).items()}


def _wire_row(superlayer: Superlayer, i: int, border: float, *, shifted: bool) -> tuple[dict[str, Any], float]:
    """Return the wires of layer `i` of a superlayer and the outer border of its cells, which begin at a border.

    Radii are those in the middle of the wires. There, the cells of a count are as high as wide, h = 2 pi r/n with
    r = border + h/2.
    """
    width = superlayer.cells if isinstance(superlayer.cells, float) else None
    share = math.pi / superlayer.cells  # half a cell in rad, of a count
    height = superlayer.height or width or 2 * border * share / (1 - share)
    r_mid = border + 0.5 * height
    cells = superlayer.cells if width is None else _whole(2 * math.pi * r_mid / width)
    if superlayer.twist:
        twist = superlayer.twist[i % len(superlayer.twist)]
    else:
        angle = superlayer.stereo[i % len(superlayer.stereo)] if superlayer.stereo else 0.0
        twist = 2 * math.atan(superlayer.half_length * math.tan(angle) / r_mid)
    row = {
        "cells": cells,
        "r_end": r_mid / math.cos(0.5 * twist),
        "half_length": superlayer.half_length,
        "z_min": superlayer.z_min,
        "z_max": superlayer.z_max,
        "twist_cells": twist * cells / (2 * math.pi),
        "phi_east": 0.5 * twist + (math.pi / cells if shifted and cells else 0.0),
    }
    return row, border + height


def _whole(value: float) -> int | float:
    return value if math.isnan(value) else round(value)


def _possible(reader: Reader, path: str, superlayer: Superlayer, row: Mapping[str, Any], layer_number: int) -> bool:
    """Return whether a layer is possible, and note its problem, that of the first key that causes it."""
    turn = 2 * math.pi * abs(row["twist_cells"]) / row["cells"] if row["cells"] else 0.0
    if turn > math.pi / 2 + 1e-9:
        r_mid = row["r_end"] * math.cos(0.5 * turn)
        most = 1000 * math.atan(r_mid / superlayer.half_length)
        given = f"a twist of {math.degrees(turn):.4g} deg of layer {layer_number}"
        reader.note(f"{path}.stereo", given, f"at most a quarter turn, here {most:.4g} mrad")
        return False
    causes = {"cells": "cells", "r_end": "layers", "twist_cells": "stereo"}
    return all(
        _fits(
            reader, f"{path}.{causes[name]}", row[name], keys_of(WireLayer)[name], f" ({name} of layer {layer_number})"
        )
        for name in causes
    )
