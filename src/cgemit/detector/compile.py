"""The detector as the core sees it: slabs of matter, read-out layers, wire layers, field."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from cgemit import _core, isa
from cgemit.detector.field.core import compiled_field
from cgemit.detector.gaps import gap_columns, gap_table
from cgemit.detector.holes import hole_table
from cgemit.detector.kept import once
from cgemit.detector.material import Material
from cgemit.detector.model import Detector, preset
from cgemit.detector.parts import CgemLayer, DriftChamber, WireLayer
from cgemit.detector.placement import IN_PLACE
from cgemit.detector.rows import NUMBERS
from cgemit.detector.shell import Shell
from cgemit.detector.slabs import ENDLESS, Slab, slabs

#: Screening of nuclei by their electrons in multiple scattering (docs/methods/matter.md); the first is the default.
Screening = Literal["wentzel", "moliere"]
SCREENINGS: tuple[Screening, ...] = get_args(Screening)

Columns = dict[str, NDArray[np.generic]]


class SlabTable(NamedTuple):
    """Slabs as the core takes them."""

    slabs: Columns
    log_terms: NDArray[np.float64]
    composition: Columns


def slab_table(found: Sequence[Slab]) -> SlabTable:
    """Return slabs as columns.

    Parameters
    ----------
    found : sequence of Slab

    Returns
    -------
    slabs : dict of ndarray
        r_in, r_out, radius, spread, half_length (n,) float64 mm; x0 (n,) float64; xi (n,) float64 GeV;
        gap (n,) int32; ends (n,) uint8.
    log_terms : (n, LOSS_POINTS) float64
        -2 ln(I/GeV) - delta - 2 C/Z against ln(beta gamma) on the core's grid.
    composition : dict of ndarray
        z, a (g/mol), moles (mol/cm2 at normal incidence) (m,) float64; slab i has the rows first[i] to first[i + 1],
        first (n + 1,) int32.

    """
    rows = [slab.row for slab in found]
    numbers = np.array([row.numbers for row in rows], dtype=np.float64).reshape(-1, len(NUMBERS)).T
    columns: Columns = dict(zip(NUMBERS, numbers.copy(), strict=True))
    columns["gap"] = np.array([slab.gap for slab in found], dtype=np.int32)
    columns["ends"] = np.array([slab.ends for slab in found], dtype=np.uint8)
    terms = np.concatenate([np.empty(0), *(row.log_terms for row in rows)]).reshape(-1, _core.LOSS_POINTS)
    elements = np.concatenate([np.empty((0, 3)), *(row.elements for row in rows)]).T
    first = np.cumsum([0, *(len(row.elements) for row in rows)]).astype(np.int32)
    composition: Columns = dict(zip(("z", "a", "moles"), elements.copy(), strict=True))
    return SlabTable(columns, terms, {"first": first, **composition})


def weighted(table: SlabTable, weights: NDArray[np.float64]) -> SlabTable:
    """Return slabs with other amounts of matter; 0 leaves vacuum.

    Parameters
    ----------
    table : SlabTable
    weights : ndarray, (n,) float64
    """
    scaled = {name: np.asarray(table.slabs[name], np.float64) * weights for name in ("x0", "xi")}
    moles = np.asarray(table.composition["moles"], np.float64) * np.repeat(weights, np.diff(table.composition["first"]))
    return SlabTable(table.slabs | scaled, table.log_terms, table.composition | {"moles": moles})


def slab_weights(found: Sequence[Slab], matter: bool, inside: int) -> NDArray[np.float64]:
    """Return how often the matter of each slab counts; arguments as for `compiled`.

    Parameters
    ----------
    found : sequence of Slab
    matter : bool
    inside : int
    """
    weights = np.full(len(found), float(matter))
    nearest = np.argsort([slab.radius for slab in found], kind="stable")[: abs(inside)]
    weights[nearest] *= 0.0 if inside > 0 else 2.0
    return weights


def compiled(
    detector: Detector,
    merge: bool = True,
    screening: str = "wentzel",
    foil: str = "effective",
    loss: str = "truncated",
    radiation: bool = True,
    *,
    gaps: bool = True,
    matter: bool = True,
    inside: int = 0,
) -> _core.Detector:
    """Return the detector of the compiled core; equal descriptions share one with gaps.

    Parameters
    ----------
    detector : Detector
        The description.
    merge, foil
        See `slabs`.
    screening : str
        Screening of nuclei in multiple scattering, ``"wentzel"`` or ``"moliere"`` (docs/methods/matter.md).
    loss : str
        Energy loss that the fit subtracts (``FitSettings.loss``).
    radiation : bool
        Whether it includes the bremsstrahlung of electrons and positrons.
    gaps : bool
        Whether to make the tables that only the simulation reads, which take most of the time: of scatters that are
        drawn, and of ionization and electrons in the drift gaps.
    matter : bool
        Whether there is matter.
    inside : int
        This number of innermost slabs are vacuum; if negative, they count twice (`FitSettings.start_radius`).

    Raises
    ------
    ValueError
        If ``CGEMIT_ISA`` names an instruction set that is not available.
    """
    choice = (merge, screening, foil, loss, radiation, gaps, matter, inside)
    # A sweep has thousands of variants, each of which is fitted once: what is made for it goes when it goes.
    return _shared(detector, *choice) if gaps else _kept(detector, *choice)


def forget() -> None:
    """Forget compiled detectors, their gaps, and presets, for tests that replace what they are made with."""
    _shared.cache_clear()
    preset.cache_clear()
    gap_columns.cache_clear()


def _made(
    detector: Detector, merge: bool, screening: str, foil: str, loss: str, radiation: bool, gaps: bool, matter: bool,
    inside: int,
) -> _core.Detector:  # fmt: skip
    isa.choose()
    found = slabs(detector, merge, foil)
    groups = [slab.shells[0].group for slab in found]
    table = slab_table(found)
    if inside or not matter:
        table = weighted(table, slab_weights(found, matter, inside))
    return _core.Detector(
        bz=detector.field.bz,
        **table._asdict(),
        cgem=cgem_table(detector.cgem),
        wires=_placed(detector.drift_chamber) if detector.drift_chamber else wire_table(None),
        screening=getattr(_core.Screening, screening),
        lattice=hole_table([slab.holes for slab in found], groups, merge) if foil == "lattice" else {},
        gaps=gap_table(detector) if gaps else [],
        loss=getattr(_core.CoreLoss, loss),
        radiation=radiation,
        field=compiled_field(detector),
        simulated=gaps,
    )


_kept, _shared = once(_made), lru_cache(maxsize=64)(_made)


def compiled_stack(parts: Sequence[tuple[Material, float]], screening: str = "wentzel") -> _core.Detector:
    """Return plane layers of matter, one behind the other, as a compiled detector without read-out.

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
    position, found = 1.0, []
    for material, thickness in parts:
        shell = Shell("stack", material.name, position, position + thickness, ENDLESS, material)
        found.append(Slab((shell,)))
        position += thickness
    return _core.Detector(
        bz=0.0,
        **slab_table(found)._asdict(),
        cgem=cgem_table(()),
        wires=wire_table(None),
        screening=getattr(_core.Screening, screening),
    )


def cgem_table(layers: Sequence[CgemLayer]) -> Columns:
    """Return the read-out of layers as columns (n,): mm, rad, strips. phi_first is (n, most), placement (n, 12)."""
    names = (
        *("r_readout", "r_gap_in", "r_gap_out", "half_length", "pitch_x", "pitch_v", "stereo", "offset_v"),
        *("dead_seam", "dead_ends"),
    )
    numbers = np.array([[getattr(layer, name) for name in names] for layer in layers], dtype=np.float64)
    columns: Columns = dict(zip(names, numbers.reshape(-1, len(names)).T.copy(), strict=True))
    for name in ("sheets", "strips_x", "strips_v"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.int32)
    # A layer of fewer sheets than others repeats its azimuths: the core reads `sheets` of them.
    most = max((layer.sheets for layer in layers), default=1)
    edges = [(most * layer.sheet_phi)[:most] for layer in layers]
    columns["phi_first"] = np.array(edges, dtype=np.float64).reshape(-1, most)
    placements = [layer.placement if layer.is_moved else IN_PLACE for layer in layers]
    columns["placement"] = np.array(placements, dtype=np.float64).reshape(-1, 12)
    strips = [layer.sheets * (layer.strips_x + layer.strips_v) for layer in layers]
    columns["gid_first"] = np.cumsum([0, *strips])[:-1].astype(np.int32)
    return columns


def wire_table(chamber: DriftChamber | None) -> Columns:
    """Return the wire layers of a chamber as columns (n,): mm, rad; placement is (1, 12)."""
    if not chamber:
        return _wire_columns((), (), IN_PLACE)
    return _wire_columns(chamber.layers, chamber.gid_first, chamber.placement)


@once
def _placed(chamber: DriftChamber) -> _core.Chamber:
    return _core.Chamber(wire_table(chamber))


def _wire_columns(layers: Sequence[WireLayer], gid_first: Sequence[int], placement: NDArray[np.float64]) -> Columns:
    names = ("r_end", "half_length", "twist", "phi_east", "sigma", "sigma_slope", "efficiency")
    columns: Columns = {name: np.array([getattr(layer, name) for layer in layers], dtype=np.float64) for name in names}
    for name in ("number", "cells"):
        columns[name] = np.array([getattr(layer, name) for layer in layers], dtype=np.int32)
    columns["gid_first"] = np.array(gid_first, dtype=np.int32)
    columns["placement"] = placement.reshape(1, 12)
    return columns
