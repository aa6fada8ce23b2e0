"""Binary strips."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

from cgemit.base.validate import Quantity
from cgemit.detector.readouts.readout import ELECTRON, GAIN, Gain, Readout


@dataclass(frozen=True, kw_only=True)
class BinaryReadout(Readout):
    """Strips that the projected path touches fire; clusters are contiguous fired strips (arXiv:1504.02570).

    With a threshold above 0 it needs ionization: `least_electrons` in the gap.

    Attributes
    ----------
    gain : float
        Electrons on the anode per electron of ionization.
    threshold : float
        fC, least charge of a crossing that fires strips.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem", gun, n=20, readout=cg.BinaryReadout(gain=8000))
    >>> x = result.clusters[result.clusters["view"] == 0]
    >>> print(x["size"].mean().round(1))  # strips
    1.5
    """

    name: ClassVar[str] = "binary"

    gain: Gain = GAIN
    threshold: Annotated[float, Quantity("charge", 0.0, 1e6)] = 1.7

    @property
    def least_electrons(self) -> int:
        """Electrons whose charge reaches the threshold."""
        return math.ceil(min(self.threshold / (self.gain * ELECTRON), 1e6))  # beyond any gap
