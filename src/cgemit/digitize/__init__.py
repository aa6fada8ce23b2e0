"""Digitization: truths become digis, crossings of drift cells become drift distances (docs/methods/digitize.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from cgemit import _core
from cgemit.cluster import ClusterSettings
from cgemit.detector import Detector, compiled, load
from cgemit.detector.strip_maps import in_dead_area, strip_lists
from cgemit.digitize.apv25 import Apv25Readout as Apv25Readout
from cgemit.digitize.binary import BinaryReadout as BinaryReadout
from cgemit.digitize.gaussian import GaussianReadout as GaussianReadout
from cgemit.digitize.placed import in_layer_axes
from cgemit.digitize.projection import ProjectionReadout as ProjectionReadout
from cgemit.digitize.readout import Readout as Readout
from cgemit.digitize.tiger import TigerReadout as TigerReadout
from cgemit.drift_times import XT_DISTANCE as XT_DISTANCE
from cgemit.drift_times import XT_TIME as XT_TIME
from cgemit.drift_times import shifted
from cgemit.kinds import one_of
from cgemit.settings import SettingsData
from cgemit.tables import Table
from cgemit.tables.table import kind_problems
from cgemit.wire_times import true_delay

#: Read-outs of CGEM layers by name.
READOUTS: dict[str, type[Readout]] = {
    BinaryReadout.name: BinaryReadout,
    GaussianReadout.name: GaussianReadout,
    TigerReadout.name: TigerReadout,
    Apv25Readout.name: Apv25Readout,
    ProjectionReadout.name: ProjectionReadout,
}


@dataclass(frozen=True, kw_only=True)
class DigitizeSettings(SettingsData):
    """How CGEM layers and wires are read out.

    Attributes
    ----------
    readout : Readout
        Of the CGEM layers, such as ``BinaryReadout(gain=8000)``. Its name alone, such as ``"gaussian"``, stands for
        the read-out with its defaults.
    reveal_sides : bool
        Whether wire hits tell on which side of the wire the particle passed.
    wire_times : str
        ``"corrected"``: drift times hold the drift alone. ``"raw"``: also time of flight and propagation along the
        wire, for which the reconstruction corrects (docs/methods/digitize.md).

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    readout: Readout = field(default_factory=BinaryReadout, metadata=one_of(READOUTS, "cgemit.digitize.READOUTS"))
    reveal_sides: bool = False
    wire_times: Literal["corrected", "raw"] = "corrected"

    if TYPE_CHECKING:  # a name is accepted, too, and never kept

        def __init__(
            self, *, readout: Readout | str = ..., reveal_sides: bool = ..., wire_times: str = ...
        ) -> None: ...


def digitize(
    detector: Detector | str | Mapping[str, Any],
    truths: Table,
    wire_truths: Table,
    settings: DigitizeSettings | None = None,
    seed: int = 0,
    *,
    steps: Table | None = None,
) -> dict[str, Table]:
    """Read out the CGEM layers and the wires; dead strips give no digis.

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
    ValueError
        If a layer or wire is not in the detector, a value is not finite, a step does not belong to its truth or has
        invalid values, or raw drift times are asked for and the detector does not say how signals run along its wires.
    """
    detector, settings = load(detector), settings or DigitizeSettings()
    if steps is None:
        steps = Table.empty("steps", **truths.cover)
    truths, steps = in_layer_axes(detector, truths, steps)
    digis = made("digis", settings.readout.digitize(detector, truths, steps, seed), settings.readout, truths)
    return {
        "wire_hits": read_out_wires(
            detector, wire_truths, reveal_sides=settings.reveal_sides, seed=seed, raw=settings.wire_times == "raw"
        ),
        "digis": without_dead(detector, outside_dead_areas(detector, digis, truths)),
    }


def outside_dead_areas(detector: Detector, digis: Table, truths: Table) -> Table:
    """Return digis without those of crossings in the dead part of a seam or of an end.

    Parameters
    ----------
    detector : Detector
    digis : Table
    truths : Table
        In the axes of the layers; where a crossing is at mid-gap counts for all of it.
    """
    dead = np.zeros(len(truths), np.bool_)
    for number, layer in enumerate(detector.cgem):
        if layer.dead_seam > 0 or layer.dead_ends > 0:
            rows = np.flatnonzero(truths["layer"] == number)
            turn = np.remainder(truths["phi"][rows] - layer.phi_first, 2 * np.pi / layer.sheets)
            dead[rows] = in_dead_area(layer, layer.r_readout * turn, truths["z"][rows])
    return digis[~dead[digis["truth"]] | (digis["truth"] < 0)] if dead.any() else digis


def without_dead(detector: Detector, digis: Table) -> Table:
    """Return digis without those of dead strips.

    Parameters
    ----------
    detector : Detector
    digis : Table
    """
    dead = strip_lists(detector).dead
    if not len(dead):
        return digis
    alive = ~np.isin(digis["gid"], dead)
    return Table(
        "digis", {name: column[alive] for name, column in digis.columns.items()}, meta=digis.meta, **digis.cover
    )


def read_out_wires(
    detector: Detector, wire_truths: Table, *, reveal_sides: bool, seed: int, raw: bool = False
) -> Table:
    """Return the table ``wire_hits`` of a table ``wire_truths``.

    Parameters
    ----------
    detector : Detector
    wire_truths : Table
    reveal_sides : bool
        Whether wire hits tell on which side of the wire the particle passed.
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
    hits = _core.read_out_wires(
        compiled(detector), {**wire_truths.columns, "delay": delay}, xt_distance=XT_DISTANCE, xt_time=XT_TIME,
        reveal_sides=reveal_sides, seed=seed,
    )  # fmt: skip
    table = Table("wire_hits", hits, **wire_truths.cover)
    if not raw:
        return table
    late, drift_time = delay[table["wire_truth"]], table["drift_time"]
    return table.with_columns(drift_time=drift_time + late, drift=shifted(table["drift"], drift_time, late))


def cluster_digis(
    detector: Detector | str | Mapping[str, Any],
    digis: Table,
    settings: DigitizeSettings,
    cluster_settings: ClusterSettings,
) -> Table:
    """Return the table ``clusters`` that the read-out of the settings makes of digis.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    digis : Table
    settings : DigitizeSettings
    cluster_settings : ClusterSettings

    Raises
    ------
    TypeError, ValueError
        If a digi is not in the detector, or the read-out makes anything but clusters of the same events.
    """
    return made("clusters", settings.readout.cluster(load(detector), digis, cluster_settings), settings.readout, digis)


def made(kind: str, table: object, readout: Readout, source: Table) -> Table:
    """Return the table that a read-out has made of another one.

    Parameters
    ----------
    kind : str
    table : object
        What the read-out returned.
    readout : Readout
    source : Table

    Raises
    ------
    TypeError, ValueError
        If it is not a table of this kind, of the same events.
    """
    problems = kind_problems(**{kind: table})
    if problems or not isinstance(table, Table):
        raise TypeError(f"read-out {readout.name}: {problems[0]}")
    if not np.array_equal(table.events, source.events):
        raise ValueError(f"read-out {readout.name}: {kind}: cover other events than {source.kind}; expected the same")
    return table
