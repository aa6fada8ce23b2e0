"""Positions of CGEM layers with given Gaussian errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cgemit.detector.readouts.positions import PositionReadout, Precision
from cgemit.detector.readouts.readout import GAIN, Gain, Width


@dataclass(frozen=True, kw_only=True)
class GaussianReadout(PositionReadout):
    """No strips: X and V at mid-gap are measured with independent Gaussian errors, whatever the crossing deposits.

    Attributes
    ----------
    sigma_x : float
        mm, error of X. Default: RMS of the binary readout for muons of 1 GeV/c.
    sigma_v : float
        mm, error of V. Default: pitch/sqrt(24) at 0.65 mm.
    gain : float
        Electrons on the anode per electron of ionization.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem", gun, n=20, readout=cg.GaussianReadout(sigma_x=0.1))
    >>> print(result.clusters["err_x"][0])  # mm
    0.1
    """

    name: ClassVar[str] = "gaussian"

    sigma_x: Width = 0.1387
    sigma_v: Width = 0.1327
    gain: Gain = GAIN

    def precision(self, own: Precision) -> Precision:
        """Return the given errors; the time is the true one."""
        return Precision(self.sigma_x, self.sigma_v, 0.0)
