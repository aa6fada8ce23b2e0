"""Points in the matter of a detector (docs/methods/background.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.detector.slabs import slabs

Floats = npt.NDArray[np.float64]

#: Of the flux of background with the radius, as that of clusters in the levels of the presets.
POWER = -2.2
FARTHEST_Z = 400.0  # mm, where particles start


@dataclass(frozen=True, eq=False)
class Matter:
    """Shells of matter, and how often particles start in each.

    Attributes
    ----------
    r_in, r_out : ndarray, (n,) float64
        mm.
    half_length : ndarray, (n,) float64
        mm, up to `FARTHEST_Z`.
    shares : ndarray, (n,) float64
        Of the particles: X/X0 times the area times the flux at the shell's middle, with a sum of 1.
    """

    r_in: Floats
    r_out: Floats
    half_length: Floats
    shares: Floats

    def points(self, u: Floats) -> Floats:
        """Return points (x, y, z), (n, 3) mm, for numbers uniform from 0 to 1, (n, 4)."""
        shell = np.searchsorted(np.cumsum(self.shares)[:-1], u[:, 0], side="right")
        inner, outer = self.r_in[shell] ** 2, self.r_out[shell] ** 2
        r, turn = np.sqrt(inner + (outer - inner) * u[:, 1]), 2 * np.pi * u[:, 2]
        return np.stack([r * np.cos(turn), r * np.sin(turn), self.half_length[shell] * (2 * u[:, 3] - 1)], axis=1)


def matter_of(detector: Detector) -> Matter:
    """Return the matter of a detector, from the beam pipe outward."""
    shells = [shell for slab in slabs(detector, merge=False) for shell in slab.shells]
    r_in, r_out, length, x0 = np.array([(s.r_in, s.r_out, min(s.half_length, FARTHEST_Z), s.x0) for s in shells]).T
    r = 0.5 * (r_in + r_out)
    weight = x0 * r * length * r**POWER
    return Matter(r_in, r_out, length, weight / weight.sum())
