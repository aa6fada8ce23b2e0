"""Charge that electrons induce on strips while they cross the induction gap (docs/methods/readout.md).

The weighting potential of a strip in an anode plane, at a distance D from a parallel electrode (W. Shockley, J. Appl.
Phys. 9 (1938) 635; S. Ramo, Proc. IRE 27 (1939) 584). Strips of a view tile the plane, and each view has its share of
the charge.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.detector.detector import Detector
from cgemit.detector.gas import drift_columns
from cgemit.detector.layers import CgemLayer
from cgemit.detector.parts import cgem_layers

#: Shares of the way through the induction gap between which the current of a strip counts as constant. Amplitudes
#: behind the shapers of `tiger` and `apv25` are then within 1 % of the charge of those of the exact current.
WAY = np.array([0.0, 0.54, 0.77, 0.905, 1.0])
_PHASES = 32  # places within a strip, between which charges are linear
_REACH = 1.3  # gaps between cloud and strip, beyond which a strip has less than 0.6 % of the charge at any time
_FARTHEST = 4.0  # widths of a cloud
_NODES = np.linspace(-5, 5, 61)  # widths, of integrals over a Gaussian
_WEIGHTS = np.exp(-0.5 * _NODES**2) / np.exp(-0.5 * _NODES**2).sum()


def induced_charge(distance: Floats, way: float, pitch: float, gap: float, sigma: float = 0.0) -> Floats:
    """Return the charge that a Gaussian cloud of charge 1 has induced on a strip of a plane, shape of `distance`.

    Without width it is the weighting potential ``arctan(cot(pi z/2D) tanh(pi u/2D))/pi`` between the edges of the
    strip, with z the height above the strips.

    Parameters
    ----------
    distance : ndarray, float64
        mm, from the cloud to the middle of the strip, u.
    way : float
        Share of the gap that the cloud has crossed, 0 to 1; 1: it is on the strips.
    pitch, gap : float
        mm.
    sigma : float
        mm, width of the cloud.
    """
    from scipy.special import ndtr

    low, high = distance - pitch / 2, distance + pitch / 2
    if way >= 1:
        narrow = max(sigma, 1e-9)
        return np.asarray(ndtr(high / narrow) - ndtr(low / narrow))
    cotangent = math.tan(math.pi * way / 2)  # of pi z/2D

    def edge(u: Floats) -> Floats:
        return np.asarray(np.arctan(cotangent * np.tanh(math.pi * u / (2 * gap))) / math.pi)

    if sigma == 0:
        return edge(high) - edge(low)
    moved = sigma * _NODES
    return np.asarray(((edge(high[..., None] + moved) - edge(low[..., None] + moved)) * _WEIGHTS).sum(axis=-1))


@lru_cache(maxsize=256)
def _of_plane(pitch: float, gap: float, sigma: float, lean: float, reach: int) -> Floats:
    """Return the charges of a plane, (places, nodes, strips); `lean`: mm that a cloud moves across strips."""
    strips = np.arange(-reach, reach + 1) + 0.5
    distance = pitch * (strips[None, :] - np.linspace(0, 1, _PHASES + 1)[:, None])
    charges = [induced_charge(distance + lean * (1 - way), float(way), pitch, gap, sigma) for way in WAY]
    return np.stack(charges, axis=1)


def cloud_widths(detector: Detector, diffusion: float, cgem: tuple[int, ...] | None = None) -> Floats:
    """Return the widths of avalanches across the strips, (2, layers) float64, mm, of X and V.

    Parameters
    ----------
    detector : Detector
    diffusion : float
        Factor on the widths.
    cgem : tuple of int or None
        See `cgem_layers`.
    """
    layers, drift = cgem_layers(detector, cgem), drift_columns(detector, cgem)
    around = diffusion * drift["cloud_phi"] * np.array([layer.r_readout for layer in layers])
    along = diffusion * drift["cloud_z"]
    stereo = np.array([layer.stereo for layer in layers])
    return np.array([around, np.hypot(np.cos(stereo) * around, np.sin(stereo) * along)])


def _pitches(layers: tuple[CgemLayer, ...]) -> Floats:
    return np.array([[layer.pitch_x for layer in layers], [layer.pitch_v for layer in layers]], np.float64)


def _reach(pitches: Floats | float, gaps: Floats | float, widths: Floats | float) -> int:
    return int(np.ceil(np.maximum(_FARTHEST * np.asarray(widths), _REACH * np.asarray(gaps)) / pitches).max(initial=1))


def charges_of_plane(pitch: float, gap: float, width: float) -> tuple[Floats, int]:
    """Return the same as `induced_charges`, of one plane and without Lorentz angle.

    Parameters
    ----------
    pitch, gap, width : float
        mm, of the strips, of the induction gap, of the charge.
    """
    reach = _reach(pitch, gap, width)
    return _of_plane(pitch, gap, width, 0.0, reach)[None], reach


def induced_charges(
    detector: Detector, diffusion: float, lorentz: bool, cgem: tuple[int, ...] | None = None
) -> tuple[Floats, int]:
    """Return the charges that avalanches induce on strips, as the core takes them.

    Parameters
    ----------
    detector : Detector
    diffusion : float
        Factor on the widths of the cloud.
    lorentz : bool
        Whether the Lorentz angle acts.
    cgem : tuple of int or None
        See `cgem_layers`.

    Returns
    -------
    charges : ndarray, (planes, places, nodes, strips) float64
        Of X and then of V of all layers, at `WAY`, from the strips before the cloud to those behind it.
    reach : int
        Strips on either side.
    """
    layers = cgem_layers(detector, cgem)
    widths, pitches = cloud_widths(detector, diffusion, cgem), _pitches(layers)
    lean = drift_columns(detector, cgem)["lean"] * np.array([layer.r_readout for layer in layers]) * lorentz
    leans = np.array([lean, lean * np.cos([layer.stereo for layer in layers])])
    reach = _reach(pitches, np.array([layer.induction_gap for layer in layers]), widths)
    planes = [
        _of_plane(float(pitches[at]), layers[at[1]].induction_gap, float(widths[at]), float(leans[at]), reach)
        for at in np.ndindex(2, len(layers))
    ]
    return np.array(planes, np.float64).reshape(-1, _PHASES + 1, len(WAY), 2 * reach + 1), reach
