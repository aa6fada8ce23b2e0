"""Digitization: truths become digis, crossings of drift cells become drift distances (docs/methods/digitize.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.base.settings import SettingsData
from cgemit.base.validate import check_numbers
from cgemit.detector import Detector, ReadoutGroup, compiled, load
from cgemit.detector.channels import checked
from cgemit.detector.core import in_dead_area, strip_lists, wire_lists
from cgemit.detector.drift import propagation_time, relations_of
from cgemit.detector.layers import Layer
from cgemit.detector.layers.layer import seen_by
from cgemit.detector.readouts import (
    AnalogReadout,
    BinaryReadout,
    PositionReadout,
    ProjectionReadout,
    Readout,
    part_of,
)
from cgemit.simulation.digitizers import (
    AnalogDigitizer,
    BinaryDigitizer,
    Digitizer,
    PositionDigitizer,
    ProjectionDigitizer,
)
from cgemit.tables import Table
from cgemit.tables.table import made_by, merged


def in_layer_axes(detector: Detector, truths: Table, steps: Table) -> tuple[Table, Table]:
    """Return truths and steps in the axes of their layers and sheets; the same tables where nothing is displaced.

    A straight track through the crossing is continued to the displaced layer. Points of delta electrons keep their
    places relative to it.

    Parameters
    ----------
    detector : Detector
    truths, steps : Table
        Of these kinds, steps linked to truths; layers as in the detector.

    Returns
    -------
    truths, steps : Table
        With other `entry`, `exit`, `phi`, `z` of truths, and `x`, `y`, `z`, `dx`, `dy`, `dz` of steps.
    """
    if not any(layer.is_moved or any(layer.sheet_z) for layer in detector.layers):
        return truths, steps
    entry, out = _points(truths, "entry_x", "entry_y", "entry_z"), _points(truths, "exit_x", "exit_y", "exit_z")
    direction = out - entry
    radius = np.array([layer.r_mid for layer in detector.layers])[truths["layer"]]
    middle = np.column_stack([radius * np.cos(truths["phi"]), radius * np.sin(truths["phi"]), truths["z"]])
    at, length = _points(steps, "x", "y", "z"), _points(steps, "dx", "dy", "dz")
    along = direction[steps["truth"]]
    for number, layer in enumerate(detector.layers):
        of_layer, of_mine = truths["layer"] == number, steps["layer"] == number
        if layer.is_moved:
            for points in (entry, out, middle):
                points[of_layer] = seen_by(layer, points[of_layer], direction[of_layer])
            at[of_mine], length[of_mine] = _steps_seen_by(layer, at[of_mine], length[of_mine], along[of_mine])
        if any(layer.sheet_z):
            shift = np.zeros(len(truths))
            shift[of_layer] = np.array(layer.sheet_z)[
                layer.sheet_at(np.arctan2(middle[of_layer, 1], middle[of_layer, 0]))
            ]
            for points in (entry, out, middle):
                points[:, 2] -= shift
            at[:, 2] -= shift[steps["truth"]]
    moved = _columns(("entry_x", "entry_y", "entry_z"), entry) | _columns(("exit_x", "exit_y", "exit_z"), out)
    moved |= {"phi": np.arctan2(middle[:, 1], middle[:, 0]), "z": middle[:, 2]}
    of_steps = _columns(("x", "y", "z"), at) | _columns(("dx", "dy", "dz"), length)
    return truths.with_columns(**moved), steps.with_columns(**of_steps)


def _steps_seen_by(layer: Layer, middle: Floats, length: Floats, along: Floats) -> tuple[Floats, Floats]:
    """Return middles and lengths of steps, (n, 3), of which both ends keep their radius."""
    begin, end = (seen_by(layer, middle + side * length, along) for side in (-0.5, 0.5))
    return 0.5 * (begin + end), end - begin


def _points(table: Table, *names: str) -> Floats:
    return np.column_stack([table[name] for name in names]).astype(np.float64)


def _columns(names: tuple[str, str, str], points: Floats) -> dict[str, Floats]:
    return dict(zip(names, points.T.copy(), strict=True))


def true_delay(detector: Detector, wire_truths: Table) -> Floats:
    """Return flight and propagation of crossings of cells, (n,) float64, ns."""
    delay = wire_truths["time"] + propagation_time(detector, wire_truths["layer"], wire_truths["z"])
    return np.asarray(delay, np.float64)


#: Digitizers by the class of their readout; they serve the classes that extend it, too.
DIGITIZERS: dict[type[Readout], type[Digitizer]] = {
    BinaryReadout: BinaryDigitizer,
    PositionReadout: PositionDigitizer,
    AnalogReadout: AnalogDigitizer,
    ProjectionReadout: ProjectionDigitizer,
}


@dataclass(frozen=True, kw_only=True)
class DigitizeSettings(SettingsData):
    """How hits of wires are made; layers that make clusters have a readout (`cgemit.Detector`).

    Attributes
    ----------
    reveal_sides : bool
        Whether wire hits hold the true side of the wire.
    wire_times : str
        ``"corrected"``: drift times hold the drift alone. ``"raw"``: also flight and propagation along the wire
        (docs/methods/digitize.md).

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> cg.Settings(digitize=cg.DigitizeSettings(wire_times="raw")).digitize
    DigitizeSettings(reveal_sides=False, wire_times='raw')
    """

    reveal_sides: bool = False
    wire_times: Literal["corrected", "raw"] = "corrected"


def digitizer_of(readout: Readout) -> Digitizer:
    """Return the digitizer of a readout."""
    return part_of(readout, DIGITIZERS)(readout)


@checked("truths", "wire_truths", "steps")
def digitize(
    detector: Detector | str | Mapping[str, Any],
    truths: Table,
    wire_truths: Table,
    settings: DigitizeSettings | None = None,
    seed: int = 0,
    *,
    steps: Table | None = None,
) -> dict[str, Table]:
    """Read out all layers, each by its readout, and the wires; dead strips give no digis.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    truths : Table
        Of kind ``truths``.
    wire_truths : Table
        Of kind ``wire_truths``, of the same events.
    settings : DigitizeSettings or None
    seed : int
        Key of the random numbers. They depend only on seed, event, particle, layer and wire.
    steps : Table or None
        Of kind ``steps``, linked to `truths` and in their order: delta electrons deposit along their paths (binary).
        Without it, all energy of a truth lies between entry and exit.

    Returns
    -------
    dict of str to Table
        ``digis`` and ``wire_hits``.

    Raises
    ------
    TypeError, ValueError
        If the settings are something else, a layer or wire is not in the detector, a value is not finite, a step does
        not belong to its truth or has invalid values, raw drift times are asked for and the detector does not say how
        signals run along its wires, or a digitizer from outside the package makes anything but digis of the same
        events.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> tables = cg.digitize(r.detector, r.truths, r.wire_truths, seed=2)
    >>> len(tables["wire_hits"]) == len(r.wire_truths), bool((tables["digis"]["charge"] > 0).all())
    (True, True)
    """
    check_numbers("digitize", seed)
    detector, settings = load(detector), DigitizeSettings.of(settings)
    if steps is None:
        steps = Table.empty("steps", **truths.cover)
    truths, steps = in_layer_axes(detector, truths, steps)
    digis = _seen(detector, truths, steps, seed)
    return {
        "wire_hits": read_out_wires(
            detector, wire_truths, reveal_sides=settings.reveal_sides, seed=seed, raw=settings.wire_times == "raw"
        ),
        "digis": without_dead(detector, outside_dead_areas(detector, digis, truths)),
    }


def _seen(detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
    """Return the digis of the crossings that the layers see, by their efficiency."""
    efficiency = np.array([layer.efficiency for layer in detector.layers], np.float64)
    if (efficiency == 1).all():
        return _digis(detector, truths, steps, seed)
    seen = _core.simulation.seen_crossings(compiled(detector), dict(truths.columns), efficiency=efficiency, seed=seed)
    return _of_some(truths, steps, seen, lambda truths, steps: _digis(detector, truths, steps, seed))


def _of_some(truths: Table, steps: Table, some: npt.NDArray[np.bool_], read: Callable[[Table, Table], Table]) -> Table:
    """Return the digis that a function makes of some truths and their steps, with links to all truths."""
    row = np.cumsum(some) - 1  # of a truth among those that are read
    own = steps[some[steps["truth"]]]
    digis = read(truths[some], own.with_columns(truth=row[own["truth"]]))
    link = np.append(np.flatnonzero(some), -1)[np.maximum(digis["truth"], -1)]
    return digis.with_columns(truth=link)


def _digis(detector: Detector, truths: Table, steps: Table, seed: int) -> Table:
    """Return the digis of all layers, group by group."""

    def read(group: ReadoutGroup, truths: Table, steps: Table) -> Table:
        digis = digitizer_of(group.readout).digitize(group, truths, steps, seed)
        return made_by(f"readout {group.readout.name}", "digis", digis, truths)

    groups = detector.groups
    if len(groups) == 1:
        return read(groups[0], truths, steps)
    digis = []
    for group in groups:
        digis.append(_of_some(truths, steps, group.owns(truths), partial(read, group)))
    return merged(digis)


def outside_dead_areas(detector: Detector, digis: Table, truths: Table) -> Table:
    """Drop the digis of crossings in the dead part of a seam or of an end, or between ladders.

    Parameters
    ----------
    detector : Detector
    digis : Table
    truths : Table
        In the axes of the layers; where a crossing is at mid-gap counts for all of it.
    """
    dead = np.zeros(len(truths), np.bool_)
    for layer_number, layer in enumerate(detector.layers):
        if layer.dead_seam > 0 or layer.dead_ends > 0 or layer.ladder_gap > 0:
            rows = np.flatnonzero(truths["layer"] == layer_number)
            phi = truths["phi"][rows]
            turn = np.min([np.remainder(phi - start, 2 * np.pi) for start in layer.sheet_phi], axis=0)
            dead[rows] = in_dead_area(layer, layer.r_readout * turn, truths["z"][rows])
    return digis[~dead[digis["truth"]] | (digis["truth"] < 0)] if dead.any() else digis


def without_dead(detector: Detector, digis: Table) -> Table:
    """Drop the digis of dead strips."""
    dead = strip_lists(detector).dead
    if not len(dead):
        return digis
    alive = ~np.isin(digis["gid"], dead)
    return Table(
        "digis", {name: column[alive] for name, column in digis.columns.items()}, meta=digis.meta, **digis.cover
    )


def without_dead_wires(detector: Detector, wire_hits: Table) -> Table:
    """Drop the hits of dead wires."""
    dead = wire_lists(detector.drift_chamber).dead if detector.drift_chamber else ()
    return wire_hits[~np.isin(wire_hits["gid"], dead)] if len(dead) else wire_hits


def read_out_wires(
    detector: Detector, wire_truths: Table, *, reveal_sides: bool, seed: int, raw: bool = False
) -> Table:
    """Return the table ``wire_hits`` of a table ``wire_truths``.

    Parameters
    ----------
    detector : Detector
    wire_truths : Table
    reveal_sides : bool
        Whether wire hits hold the true side of the wire.
    seed : int
    raw : bool
        Whether drift times hold flight and propagation. Without them, only later half turns are later by their flight
        when a cell is hit twice: the flight of first ones is taken as corrected.

    Raises
    ------
    ValueError
        If a wire is not in the detector, a value is not finite, or the detector does not say how signals run.
    """
    if raw:
        delay = true_delay(detector, wire_truths)
    else:  # times that are not finite stay, for the check
        time = wire_truths["time"]
        delay = np.where((wire_truths["half_turn"] > 0) | ~np.isfinite(time), time, 0.0)
    hits = _core.simulation.read_out_wires(
        compiled(detector), {**wire_truths.columns, "delay": delay}, reveal_sides=reveal_sides, seed=seed
    )
    table = without_dead_wires(detector, Table("wire_hits", hits, **wire_truths.cover))
    if not raw:
        return table
    late = delay[table["wire_truth"]]
    drift = relations_of(detector).shifted(table, late)
    return table.with_columns(drift_time=table["drift_time"] + late, drift=drift)
