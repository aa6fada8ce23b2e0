"""The detector in the core's form: slabs of matter, readout layers, strip maps, wire layers, field."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike, NDArray

from cgemit import _core
from cgemit.base import isa
from cgemit.base.arrays import Columns, Floats, Ints
from cgemit.detector.detector import Detector
from cgemit.detector.drift import relation_of
from cgemit.detector.field import Axis, FieldGrid, HarmonicField, MapField, SolenoidField
from cgemit.detector.gas import gap_table
from cgemit.detector.keys import once
from cgemit.detector.layers import Layer
from cgemit.detector.layers.layer import IN_PLACE, MOST_SHEETS, Placed
from cgemit.detector.layers.wires import DriftChamber, WireLayer
from cgemit.detector.material import Material
from cgemit.detector.matter import hole_table, slabs
from cgemit.detector.parts import Contents, extent
from cgemit.detector.shells import ENDLESS, NUMBERS, Shell, Slab


class ChannelLists(NamedTuple):
    """Running numbers of strips or wires, each (n,) int32, growing."""

    dead: Ints
    hot: Ints

    @property
    def masked(self) -> Ints:
        """Strips of which clusters are not made, or wires whose hits no track takes, (n,) int32."""
        return np.union1d(self.dead, self.hot).astype(np.int32)


@once
def wire_lists(chamber: DriftChamber) -> ChannelLists:
    """Return the dead and the hot wires of a chamber; a wire in both lists is dead."""
    lists: dict[str, list[Ints]] = {"dead": [], "hot": []}
    for layer, gid in zip(chamber.layers, chamber.gid_first, strict=True):
        for kind, parts in lists.items():
            parts += [gid + np.arange(low, high + 1, dtype=np.int32) for low, high in getattr(layer, kind)]
    return _lists(lists)


def _lists(found: dict[str, list[Ints]]) -> ChannelLists:
    dead, hot = (np.unique(np.concatenate([*parts, np.empty(0, np.int32)])) for parts in found.values())
    return ChannelLists(dead.astype(np.int32), np.setdiff1d(hot, dead).astype(np.int32))


@lru_cache(maxsize=64)
def strip_lists(detector: Detector) -> ChannelLists:
    """Return dead and hot strips of a detector; a strip in both lists is dead, as are X strips in a dead seam."""
    lists: dict[str, list[Ints]] = {"dead": [], "hot": []}
    first = 0
    for layer in detector.layers:
        per_sheet = layer.strips_x + layer.strips_v
        for sheet in range(layer.sheets):
            lists["dead"].append(seam_strips(layer) + first + sheet * per_sheet)
        for kind, parts in lists.items():
            for view, offset in (("x", 0), ("v", layer.strips_x)):
                for sheet, low, high in getattr(layer, f"{kind}_{view}"):
                    parts.append(np.arange(low, high + 1, dtype=np.int32) + first + sheet * per_sheet + offset)
        first += layer.sheets * per_sheet
    return _lists(lists)


def seam_strips(layer: Layer) -> Ints:
    """Return the X strips of a sheet whose middle is in the dead part of a seam, (n,) int32."""
    middle = (np.arange(layer.strips_x) + 0.5) * layer.pitch_x
    beside = np.minimum(middle, layer.strips_x * layer.pitch_x - middle)
    return np.flatnonzero(beside < 0.5 * layer.dead_seam).astype(np.int32)


def in_dead_area(layer: Layer, x: Floats, z: Floats) -> npt.NDArray[np.bool_]:
    """Return whether points of a sheet are in the dead part of a seam or of an end, or between ladders, (n,) bool.

    Parameters
    ----------
    layer : Layer
    x : ndarray, (n,) float64, mm
        From the edge of the sheet.
    z : ndarray, (n,) float64, mm
    """
    beside = np.minimum(x, layer.strips_x * layer.pitch_x - x)
    # Nothing is dead by default, not even at the edge: strips end there by themselves.
    at_seam = (beside < 0.5 * layer.dead_seam) & (layer.dead_seam > 0)
    low, high = layer.ends
    at_end = (z < low + layer.dead_ends) | (z > high - layer.dead_ends)
    dead = at_seam | (at_end & (layer.dead_ends > 0))
    if layer.ladders:
        width = 2 * np.pi * layer.r_readout / layer.ladders
        dead |= np.abs(np.remainder(x - layer.ladder_first + 0.5 * width, width) - 0.5 * width) < 0.5 * layer.ladder_gap
    return np.asarray(dead)


@lru_cache(maxsize=64)
def gain_table(detector: Detector) -> dict[str, npt.NDArray[Any]]:
    """Return the gain maps of all layers as the core takes them; an empty dict if no layer has one.

    Returns
    -------
    dict of str to ndarray
        shape (2 layers,) int32, rows and columns of each layer's grids, 0 for a layer without; values (n,) float64,
        sheet by sheet, row by row.
    """
    if not any(layer.gain_map for layer in detector.layers):
        return {}
    grids = [grid_of(layer) for layer in detector.layers]
    return {
        "shape": np.array([n for grid in grids for n in grid.shape[1:]], dtype=np.int32),
        "values": np.concatenate([grid.ravel() for grid in grids]),
    }


def grid_of(layer: Layer) -> Floats:
    """Return the relative gain of a layer, (sheets, rows along z, columns along X) float64.

    Without a map there are no rows and columns. Grids of different shapes are repeated to the least common one.
    """
    if not layer.gain_map:
        return np.ones((layer.sheets, 0, 0))
    grids = [np.array(sheet, np.float64) for sheet in layer.gain_map]
    rows, columns = (int(np.lcm.reduce([grid.shape[axis] for grid in grids])) for axis in (0, 1))
    return np.array([np.kron(grid, np.ones((rows // grid.shape[0], columns // grid.shape[1]))) for grid in grids])


@lru_cache(maxsize=64)
def strip_gains(detector: Detector) -> Floats:
    """Return the mean relative gain along each strip by its running number, (strips,) float64; (0,) without maps.

    V strips have the mean of their sheet: they cross many cells.
    """
    if not any(layer.gain_map for layer in detector.layers):
        return np.empty(0)
    parts = []
    for layer in detector.layers:
        grid = grid_of(layer)
        for sheet in range(layer.sheets):
            if not grid.size:
                parts.append(np.ones(layer.strips_x + layer.strips_v))
                continue
            columns = grid[sheet].mean(axis=0)
            at = (np.arange(layer.strips_x) + 0.5) / layer.strips_x * len(columns)
            parts += [columns[at.astype(np.int64)], np.full(layer.strips_v, grid[sheet].mean())]
    return np.concatenate(parts)


# mm, of the solenoid's grid; the spline between its points is exact to 1e-7 of the field 0.5 m from the coil
STEP = 20.0
_MARGIN_R, _MARGIN_Z = 50.0, 600.0  # mm, beyond the outermost part; steep tracks go on beyond the ends


def compiled_field(detector: Contents) -> _core.detector.Field | None:
    """Return the field that tracks step through, or None where it is uniform."""
    field = detector.field
    if field.bz == 0 and not isinstance(field, MapField):
        return None
    if isinstance(field, HarmonicField):
        reach = (field.r_max, field.z_max)
        return _core.detector.Field(bz=field.bz, b=field.b, q=field.q, tolerance=field.tolerance, reach=reach)
    if isinstance(field, SolenoidField):
        r, z = extent(detector)
        reach = (r + _MARGIN_R, z + _MARGIN_Z)
        grid = solenoid_grid(field.coil_radius, field.half_length, field.z_offset, reach)
        return _on_grid(grid, field.bz, field.bz, field.tolerance)
    if isinstance(field, MapField):
        own = field.grid.bz_at_origin()
        scale = field.bz / own if own else 1.0
        return _on_grid(field.grid, scale, field.bz, field.tolerance) if scale and field.grid.largest() else None
    return None


def _on_grid(grid: FieldGrid, scale: float, bz: float, tolerance: float) -> _core.detector.Field:
    # Around, the first point is also the last one.
    axes = [(axis.first, axis.step, axis.points + (axis.name == "phi")) for axis in grid.axes]
    coefficients = scale * grid.coefficients().ravel()
    return _core.detector.Field(bz=bz, axes=axes, coefficients=coefficients, tolerance=tolerance, polar=grid.is_polar)


def field_at(detector: Contents, points: ArrayLike) -> NDArray[np.float64]:
    """Return the magnetic field of a detector at points.

    Parameters
    ----------
    detector : Detector
    points : array_like, (n, 3) float64
        x, y, z in mm.

    Returns
    -------
    ndarray, (n, 3) float64, T
        Bx, By, Bz; NaN beyond the range of a map.

    Examples
    --------
    >>> from cgemit.detector import field_at
    >>> det = cg.load("besiii-cgem").with_field("finite-solenoid")
    >>> print(field_at(det, [[0.0, 0.0, 0.0], [0.0, 0.0, 1000.0]])[:, 2].round(3))  # Bz, T
    [-1.    -0.876]
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    field = compiled_field(detector)
    if field is None:
        return np.tile([0.0, 0.0, detector.field.bz], (len(points), 1))
    values, _, inside = field.values(points)
    return np.where(inside[:, None] == 1, values, math.nan)


def solenoid_field(radius: float, half_length: float, r: ArrayLike, z: ArrayLike) -> tuple[Floats, Floats]:
    """Return the field of a thin coil around z = 0, for a field of 1 T in its middle.

    N. Derby and S. Olbert, Am. J. Phys. 78 (2010) 229, eqs. 4 and 5, with their generalized complete elliptic integral
    C written in Carlson's forms: C(k, p, c, s) = c R_F(0, k^2, 1) + (s - p c) R_J(0, k^2, 1, p)/3 (B. C. Carlson,
    Numer. Algorithms 10 (1995) 13).

    Parameters
    ----------
    radius, half_length : float
        Of the coil, mm.
    r, z : array_like, (...)
        Points, mm; not on the coil.

    Returns
    -------
    br, bz : ndarray, (...) float64, T

    """
    from scipy.special import elliprf, elliprj

    def integral(k2: Floats, p: Floats | float, c: float, s: Floats | float) -> Floats:
        return np.asarray(c * elliprf(0, k2, 1) + (s - p * c) / 3 * elliprj(0, k2, 1, p), dtype=np.float64)

    r, z = np.broadcast_arrays(np.asarray(r, np.float64), np.asarray(z, np.float64))
    sign, distance = np.where(r < 0, -1.0, 1.0), np.abs(r)
    gamma = (radius - distance) / (radius + distance)
    br, bz = np.zeros_like(z), np.zeros_like(z)
    for end, weight in ((half_length, 1.0), (-half_length, -1.0)):
        along = z + end
        far = along**2 + (radius + distance) ** 2
        k2 = (along**2 + (radius - distance) ** 2) / far
        br += weight * radius / np.sqrt(far) * integral(k2, 1.0, 1.0, -1.0)
        bz += weight * along / np.sqrt(far) * integral(k2, gamma**2, 1.0, gamma)
    middle = np.pi * half_length / np.hypot(half_length, radius)
    return sign * br / middle, radius / (radius + distance) * bz / middle


def solenoid_grid(radius: float, half_length: float, z_offset: float, reach: tuple[float, float]) -> FieldGrid:
    """Return the field on a grid, with 1 T at the origin.

    Parameters
    ----------
    radius, half_length, z_offset : float
        Of the coil, mm.
    reach : tuple of float
        Largest r and |z| that the grid must hold, mm.

    """
    n_r, n_z = (int(np.ceil(length / STEP)) for length in reach)
    r, z = STEP * np.arange(n_r + 1), STEP * np.arange(-n_z, n_z + 1)
    values = np.stack(solenoid_field(radius, half_length, r[:, None], z - z_offset), axis=-1)
    scale = solenoid_field(radius, half_length, 0.0, -z_offset)[1]
    axes = (Axis("r", 0.0, STEP, n_r + 1), Axis("z", -n_z * STEP, STEP, 2 * n_z + 1))
    return FieldGrid(axes, values / scale)


#: Screening of nuclei by their electrons in multiple scattering (docs/methods/matter.md); the first is the default.
Screening = Literal["wentzel", "moliere"]
SCREENINGS: tuple[Screening, ...] = get_args(Screening)


class SlabTable(NamedTuple):
    """Slabs as the core takes them."""

    slabs: Columns
    log_terms: NDArray[np.float64]
    composition: Columns


def slab_table(matter: Sequence[Slab]) -> SlabTable:
    """Return slabs as columns.

    Parameters
    ----------
    matter : sequence of Slab

    Returns
    -------
    slabs : dict of ndarray
        r_in, r_out, radius, spread, z_min, z_max (n,) float64 mm; x0 (n,) float64; xi (n,) float64 GeV;
        gap (n,) int32; ends (n,) uint8.
    log_terms : (n, LOSS_POINTS) float64
        -2 ln(I/GeV) - delta - 2 C/Z against ln(beta gamma) on the core's grid.
    composition : dict of ndarray
        z, a (g/mol), moles (mol/cm2 at normal incidence) (m,) float64; slab i has the rows first[i] to first[i + 1],
        first (n + 1,) int32.

    Examples
    --------
    >>> from cgemit.detector import slab_table, slabs
    >>> slabs = slabs(cg.load("besiii-cgem"))
    >>> print(slab_table(slabs)._fields)
    ('slabs', 'log_terms', 'composition')
    """
    rows = [slab.row for slab in matter]
    numbers = np.array([row.numbers for row in rows], dtype=np.float64).reshape(-1, len(NUMBERS)).T
    columns: Columns = dict(zip(NUMBERS, numbers.copy(), strict=True))
    columns["gap"] = np.array([slab.gap for slab in matter], dtype=np.int32)
    columns["filler"] = np.array([slab.filler for slab in matter], dtype=np.uint8)
    terms = np.concatenate([np.empty(0), *(row.log_terms for row in rows)]).reshape(-1, _core.detector.LOSS_POINTS)
    elements = np.concatenate([np.empty((0, 3)), *(row.elements for row in rows)]).T
    first = np.cumsum([0, *(len(row.elements) for row in rows)]).astype(np.int32)
    composition: Columns = dict(zip(("z", "a", "moles"), elements.copy(), strict=True))
    return SlabTable(columns, terms, {"first": first, **composition})


def without_matter(table: SlabTable) -> SlabTable:
    """Return the slabs as vacuum."""
    none = {name: np.zeros_like(table.slabs[name], np.float64) for name in ("x0", "xi")}
    moles = np.zeros_like(table.composition["moles"], np.float64)
    return SlabTable(table.slabs | none, table.log_terms, table.composition | {"moles": moles})


def compiled(
    detector: Detector,
    merge: bool = True,
    screening: str = "wentzel",
    foil: str = "effective",
    *,
    gaps: bool = True,
    matter: bool = True,
) -> _core.detector.Detector:
    """Return the detector of the compiled core; equal descriptions share one with gaps.

    It assumes nothing of tracks: all matter of a track acts with every slab. The fit takes that of
    `cgemit.fit_matter.tuned`.

    Parameters
    ----------
    detector : Detector
        The description.
    merge, foil
        See `slabs`.
    screening : str
        Screening of nuclei in multiple scattering, ``"wentzel"`` or ``"moliere"`` (docs/methods/matter.md).
    gaps : bool
        Whether to make the tables that only the simulation reads, which take most of the time: of scatters that are
        drawn, and of ionization and electrons in the drift gaps.
    matter : bool
        Whether there is matter.

    Raises
    ------
    ValueError
        If ``CGEMIT_ISA`` names an instruction set that is not available.

    Examples
    --------
    >>> from cgemit.detector import compiled
    >>> compiled(cg.load("besiii-cgem")).field.bz
    -1.0
    """
    choice = (merge, screening, foil, gaps, matter)
    # A sweep has thousands of variants, each of which is fitted once: what is made for it goes when it goes.
    return _shared(detector, *choice) if gaps else _kept(detector, *choice)


def _made(
    detector: Detector, merge: bool, screening: str, foil: str, gaps: bool, matter: bool
) -> _core.detector.Detector:
    isa.choose()
    all_slabs = slabs(detector, merge, foil)
    groups = [slab.shells[0].group for slab in all_slabs]
    table = slab_table(all_slabs)
    if not matter:
        table = without_matter(table)
    return _core.detector.Detector(
        bz=detector.field.bz,
        **table._asdict(),
        layers=layer_table(detector.layers),
        wires=_placed(detector.drift_chamber) if detector.drift_chamber else wire_table(None),
        screening=getattr(_core.matter.Screening, screening),
        lattice=hole_table([slab.holes for slab in all_slabs], groups, merge) if foil == "lattice" else {},
        gaps=gap_table(detector) if gaps else [],
        field=compiled_field(detector),
        simulated=gaps,
    )


_kept, _shared = once(_made), lru_cache(maxsize=64)(_made)


def compiled_stack(parts: Sequence[tuple[Material, float]], screening: str = "wentzel") -> _core.detector.Detector:
    """Return plane layers of matter, one behind the other, as a compiled detector without readout.

    Parameters
    ----------
    parts : sequence of (Material, float)
        Material and thickness in mm.
    screening : str

    Raises
    ------
    ValueError
        If ``CGEMIT_ISA`` names an instruction set that is not available.

    """
    isa.choose()
    position, matter = 1.0, []
    for material, thickness in parts:
        shell = Shell("stack", material.name, position, position + thickness, ENDLESS, material)
        matter.append(Slab((shell,)))
        position += thickness
    return _core.detector.Detector(
        bz=0.0,
        **slab_table(matter)._asdict(),
        layers=layer_table(()),
        wires=wire_table(None),
        screening=getattr(_core.matter.Screening, screening),
    )


def layer_table(layers: Sequence[Layer]) -> Columns:
    """Return the readout of layers as columns (n,): mm, rad, strips; see `MeasuringLayer` in ``detector/detector.hpp``.

    phi_first is (n, MOST_SHEETS); placement_shift and placement_turn, rows of a rotation, are (n, 3) and (n, 9).
    """
    names = ("r_readout", "r_gap_in", "r_gap_out", "stereo", "offset_v", "dead_seam", "dead_ends")
    numbers = np.array([[getattr(layer, name) for name in names] for layer in layers], dtype=np.float64)
    columns: Columns = dict(zip(names, numbers.reshape(-1, len(names)).T.copy(), strict=True))
    columns |= _end_columns([layer.ends for layer in layers])
    pitch = np.array([layer.pitches for layer in layers], dtype=np.float64).reshape(-1, 2).T
    columns |= {"pitch_x": pitch[0].copy(), "pitch_v": pitch[1].copy()}
    for view in "XV":
        columns[f"has_{view.lower()}"] = np.array([view in layer.views for layer in layers], dtype=np.bool_)
    columns["lorentz_shift"] = np.array([layer.lorentz_shift or 0.0 for layer in layers], dtype=np.float64)
    columns["z_scale"] = np.array([layer.z_scale for layer in layers], dtype=np.float64)
    columns["slope"] = np.array([layer.error_slope for layer in layers], dtype=np.float64)
    for name in ("sheets", "strips_x", "strips_v"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.int32)
    # The azimuths are repeated: the core reads `sheets` of them.
    edges = [(MOST_SHEETS * layer.sheet_phi)[:MOST_SHEETS] for layer in layers]
    columns["phi_first"] = np.array(edges, dtype=np.float64).reshape(-1, MOST_SHEETS)
    columns |= _placement_columns("placement", layers)
    strips = [layer.sheets * (layer.strips_x + layer.strips_v) for layer in layers]
    columns["gid_first"] = np.cumsum([0, *strips])[:-1].astype(np.int32)
    columns["ladders"] = np.array([layer.ladders for layer in layers], dtype=np.int32)
    for name in ("ladder_gap", "ladder_first"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.float64)
    return columns


def _end_columns(ends: Sequence[tuple[float, float]]) -> Columns:
    low, high = np.array(ends, dtype=np.float64).reshape(-1, 2).T
    return {"z_min": low.copy(), "z_max": high.copy()}


def _placement_columns(name: str, parts: Sequence[Placed]) -> Columns:
    found = np.array([part.placement if part.is_moved else IN_PLACE for part in parts], np.float64).reshape(-1, 12)
    return {f"{name}_shift": found[:, :3].copy(), f"{name}_turn": found[:, 3:].copy()}


def wire_table(chamber: DriftChamber | None) -> Columns:
    """Return the wire layers of a chamber as columns (n,): mm, rad; see `WireLayer` in ``detector/detector.hpp``.

    Columns with the names ramp, point, masked and single have rows of their own, each with the number of its layer.
    chamber_shift and chamber_turn are (1, 3) and (1, 9).
    """
    if not chamber:
        none = np.empty(0, np.int32)
        return (
            _wire_columns((), ())
            | _placement_columns("chamber", [Placed()])
            | {"masked_layer": none, "masked_wire": none}
            | _single_columns(())
        )
    columns = _wire_columns(chamber.layers, chamber.gid_first) | _placement_columns("chamber", [chamber])
    masked, gid_first = wire_lists(chamber).masked, np.array(chamber.gid_first, np.int32)
    rows = np.searchsorted(gid_first, masked, side="right") - 1
    columns |= {"masked_layer": rows.astype(np.int32), "masked_wire": masked - gid_first[rows]}
    return columns | _single_columns(chamber.layers)


@once
def _placed(chamber: DriftChamber) -> _core.detector.Chamber:
    return _core.detector.Chamber(wire_table(chamber))


def _wire_columns(layers: Sequence[WireLayer], gid_first: Sequence[int]) -> Columns:
    names = ("r_end", "twist", "phi_east", "sigma", "sigma_slope", "efficiency")
    columns: Columns = {name: np.array([getattr(layer, name) for layer in layers], dtype=np.float64) for name in names}
    columns |= _end_columns([layer.ends for layer in layers])
    for name in ("number", "cells"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.int32)
    columns["gid_first"] = np.array(gid_first, dtype=np.int32)
    columns |= _placement_columns("placement", layers)
    shifts = np.array([layer.end_shift for layer in layers], dtype=np.float64).reshape(-1, 6).T.copy()
    columns |= dict(
        zip((f"{end}_{name}" for end in ("east", "west") for name in ("x", "y", "rotation")), shifts, strict=True)
    )
    return columns | _error_columns(layers, columns) | _relation_columns(layers)


def _single_columns(layers: Sequence[WireLayer]) -> Columns:
    """Return the displacements of the ends of single wires, of all wires of a layer with any."""
    moved = [(i, shifts) for i, layer in enumerate(layers) if (shifts := layer.wire_shifts()) is not None]
    values = np.concatenate([np.empty((0, 4)), *(shifts for _, shifts in moved)])
    rows = [np.stack([np.full(len(shifts), i), np.arange(len(shifts))]) for i, shifts in moved]
    layer_rows, wires = np.concatenate([np.empty((2, 0)), *rows], axis=1).astype(np.int32)
    names = ("single_east_r", "single_east_phi", "single_west_r", "single_west_phi")
    return {"single_layer": layer_rows.copy(), "single_wire": wires.copy()} | dict(
        zip(names, np.ascontiguousarray(values.T), strict=True)
    )


def _relation_columns(layers: Sequence[WireLayer]) -> Columns:
    """Return the points of the relations of drift distance and time, layer by layer."""
    relations = [relation_of(layer) for layer in layers]
    rows = [np.full(len(one.distance), i, np.int32) for i, one in enumerate(relations)]
    return {
        "point_layer": np.concatenate([*rows, np.empty(0, np.int32)]),
        "point_distance": np.concatenate([*(one.distance for one in relations), np.empty(0)]),
        "point_time": np.concatenate([*(one.time for one in relations), np.empty(0)]),
    }


def _error_columns(layers: Sequence[WireLayer], columns: Columns) -> Columns:
    """Return the first value and slope of errors that are no straight lines, and the changes of the slope."""
    sigma, slope = columns["sigma"].copy(), columns["sigma_slope"].copy()
    ramps: list[tuple[int, float, float]] = []
    for i, layer in enumerate(layers):
        nodes, errors = layer.error_table
        if len(nodes):
            slopes = [*(np.diff(errors) / np.diff(nodes)), 0.0]  # constant beyond the last point
            sigma[i], slope[i] = errors[0], slopes[0]
            ramps += [(i, node, new - old) for node, old, new in zip(nodes[1:], slopes[:-1], slopes[1:], strict=True)]
    rows, starts, changes = np.array(ramps, np.float64).reshape(-1, 3).T
    found: Columns = {"ramp_layer": rows.astype(np.int32), "ramp_from": starts.copy(), "ramp_change": changes.copy()}
    return {"sigma": sigma, "sigma_slope": slope, **found}
