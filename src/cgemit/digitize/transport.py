"""Electron transport in the gaps of a CGEM layer: velocity, Lorentz angle and diffusion (docs/methods/readout.md).

Tables of ``data/gases``, computed with Magboltz. Between the tabulated electric fields everything is linear, and so it
is in the magnetic field between 0 and 1 T; this line is continued up to `MAX_B`.
"""

from __future__ import annotations

import csv
import math
from functools import cache, lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.detector.parts import CgemLayer

Floats = npt.NDArray[np.float64]

#: Largest magnetic field of the tables, T: the line through 0 and 1 T is continued that far.
MAX_B = 1.2

_COLUMNS = ("velocity", "tan_lorentz", "sigma_x", "sigma_par", "sigma_l")
#: Units of the tables in those of the program: um/ns to mm/ns, um/sqrt(cm) to mm/sqrt(mm).
_NATIVE = np.array([1e-3, 1.0, 1e-3 / math.sqrt(10), 1e-3 / math.sqrt(10), 1e-3 / math.sqrt(10)])


class Transport(NamedTuple):
    """Transport of electrons at one electric and magnetic field at right angles."""

    velocity: float  # mm/ns, along the electric field
    tan_lorentz: float  # not negative
    sigma_x: float  # mm/sqrt(mm), across both fields
    sigma_par: float  # mm/sqrt(mm), along the magnetic field
    sigma_l: float  # mm/sqrt(mm), along the drift


@cache
def table(gas: str) -> dict[float, Floats]:
    """Return the table of a gas by magnetic field (T): rows of electric field (kV/cm) and the columns as in the file.

    Parameters
    ----------
    gas : str
        Such as ``"ar-ic4h10-90-10"``.

    Returns
    -------
    dict of float to ndarray, (n, 6) float64
    """
    text = (resources.files("cgemit.data") / "gases" / f"transport-{gas}.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    found: dict[float, list[list[float]]] = {}
    for row in rows:
        found.setdefault(float(row["b_field"]), []).append([float(row[name]) for name in ("e_field", *_COLUMNS)])
    return {b: np.array(sorted(values)) for b, values in found.items()}


@lru_cache(maxsize=256)
def transport(gas: str, e_field: float, b_field: float) -> Transport:
    """Return the transport in a gas.

    Parameters
    ----------
    gas : str
    e_field : float
        kV/cm.
    b_field : float
        T, of either sign.

    Raises
    ------
    ValueError
        If a field is outside the tables; of the electric field the rows of every magnetic field that is needed count.
    """
    b = abs(b_field)
    if not b <= MAX_B:
        raise ValueError(f"magnetic field: got {b:g} T, expected 0 to {MAX_B:g} T, where {gas} is tabulated")
    rows = table(gas)
    needed = (0.0,) if b == 0 else (1.0,) if b == 1 else (0.0, 1.0)
    low, high = (f(side[0] for side in (rows[i][:, 0][[0, -1]][::s] for i in needed)) for f, s in ((max, 1), (min, -1)))
    if not low <= e_field <= high:
        raise ValueError(
            f"electric field: got {e_field:g} kV/cm, expected {low:g} to {high:g} kV/cm, where {gas} is tabulated "
            f"at {b:g} T"
        )
    at = [[np.interp(e_field, rows[i][:, 0], column) for column in rows[i][:, 1:].T] for i in needed]
    values = np.array(at[0]) if len(at) == 1 else np.array(at[0]) + b * (np.array(at[1]) - np.array(at[0]))
    return Transport(*(float(value) for value in values * _NATIVE))


class LayerDrift(NamedTuple):
    """Drift through one CGEM layer as the core takes it: electrons start in the drift gap and end on the anode."""

    velocity: float  # mm/ns, in the drift gap
    tan_lorentz: float  # in the drift gap, positive towards larger phi
    sigma_x: float  # mm/sqrt(mm), diffusion in the drift gap along phi
    sigma_par: float  # mm/sqrt(mm), along z
    sigma_l: float  # mm/sqrt(mm), along the drift
    shift: float  # rad, azimuth that the transfer and induction gaps add
    delay: float  # ns, from the first foil to the last one
    induction: float  # ns, of the induction gap
    first_phi: float  # rad, diffusion of one electron in the first transfer gap along phi
    first_z: float  # mm, along z
    cloud_phi: float  # rad, width of the avalanche of one electron at the anode along phi
    cloud_z: float  # mm, along z


class _Gap(NamedTuple):
    r_in: float  # mm
    r_out: float  # mm
    transport: Transport

    def width_phi(self) -> float:
        """Return the diffusion along phi, rad: the radii at which it arises are averaged."""
        return self.transport.sigma_x * math.sqrt((self.r_out - self.r_in) / (self.r_in * self.r_out))

    def width_z(self) -> float:
        """Return the diffusion along z, mm."""
        return self.transport.sigma_par * math.sqrt(self.r_out - self.r_in)


def layer_drift(layer: CgemLayer, bz: float) -> LayerDrift:
    """Return the drift in a layer.

    In a cylinder the azimuth grows by tan(alpha) ln(r2/r1) over a gap, with the angle at the nominal field. Electrons
    drift outward; in a field along +z they are bent towards larger phi.

    Parameters
    ----------
    layer : CgemLayer
    bz : float
        T, signed.

    Raises
    ------
    ValueError
        Listing every field that is outside the tables, or that the gas has no table.
    """
    gas = layer.gas.ionization
    if not gas:
        raise ValueError(
            f"cgem.{layer.label}.gas: got {layer.gas.name} without a table of electron transport, "
            'expected a gas with ionization = "ar-ic4h10-90-10" or "ar-co2-70-30"'
        )
    problems: list[str] = []
    found = []
    for name in ("drift_field", "transfer_field", "induction_field"):
        try:
            found.append(transport(gas, getattr(layer, name), bz))
        except ValueError as error:
            problems.append(f"cgem.{layer.label}.{name}: {error}")
    if problems:
        raise ValueError("\n".join(problems))
    drift, transfer, induction = found
    gaps = _gaps_behind(layer, transfer, induction)
    sign = math.copysign(1.0, bz)
    return LayerDrift(
        velocity=drift.velocity,
        tan_lorentz=sign * drift.tan_lorentz,
        sigma_x=drift.sigma_x,
        sigma_par=drift.sigma_par,
        sigma_l=drift.sigma_l,
        shift=sign * sum(gap.transport.tan_lorentz * math.log(gap.r_out / gap.r_in) for gap in gaps),
        delay=sum((gap.r_out - gap.r_in) / gap.transport.velocity for gap in gaps[:-1]),
        induction=layer.induction_gap / induction.velocity,
        first_phi=gaps[0].width_phi(),
        first_z=gaps[0].width_z(),
        cloud_phi=math.sqrt(sum(gap.width_phi() ** 2 for gap in gaps)),
        cloud_z=math.sqrt(sum(gap.width_z() ** 2 for gap in gaps)),
    )


def _gaps_behind(layer: CgemLayer, transfer: Transport, induction: Transport) -> list[_Gap]:
    """Return the gaps behind the first foil, from inside."""
    foil = sum(part.thickness for part in layer.foil)
    radius, gaps = layer.r_gap_out, []
    for _ in range(layer.foils - 1):
        radius += foil
        gaps.append(_Gap(radius, radius + layer.transfer_gap, transfer))
        radius += layer.transfer_gap
    return [*gaps, _Gap(layer.anode_radius - layer.induction_gap, layer.anode_radius, induction)]


@lru_cache(maxsize=64)
def drift_columns(detector: Detector) -> dict[str, Floats]:
    """Return the drift of all CGEM layers as columns, each (layers,) float64, see `LayerDrift`.

    Parameters
    ----------
    detector : Detector

    Raises
    ------
    ValueError
        Listing the problems of all layers.
    """
    problems, found = [], []
    for layer in detector.cgem:
        try:
            found.append(layer_drift(layer, detector.field.bz))
        except ValueError as error:
            problems += str(error).splitlines()
    if problems:
        raise ValueError("\n  ".join([f"{detector.name}: no electron transport for the read-out", *problems]))
    columns = np.array(found, np.float64).reshape(-1, len(LayerDrift._fields)).T
    return dict(zip(LayerDrift._fields, columns.copy(), strict=True))


def mean_shift(layer: CgemLayer, bz: float) -> float:
    """Return the Lorentz shift of electrons from mid-gap to the anode, mm of X.

    Parameters
    ----------
    layer : CgemLayer
    bz : float
        T, signed.
    """
    drift = layer_drift(layer, bz)
    return layer.r_readout * (drift.tan_lorentz * math.log(layer.r_gap_out / layer.r_mid) + drift.shift)
