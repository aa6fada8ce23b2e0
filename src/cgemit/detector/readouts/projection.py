"""Charge of the projected path on strips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cgemit.detector.readouts.readout import GAIN, ChipErrors, Gain, Noise, Readout, Share, Threshold, Width


@dataclass(frozen=True, kw_only=True)
class ProjectionReadout(Readout):
    """Each strip integrates its part of a charge profile along the projected path; position is the charge centroid.

    It needs ionization: a crossing that frees no electron in the gap has no clusters.

    Attributes
    ----------
    gain : float
        Electrons on the anode per electron of ionization.
    sigma : float
        mm, width of the profile across the path: avalanche and diffusion.
    threshold : float
        fC, of a strip.
    noise : float
        fC, of a strip.
    valley : float
        A strip with less than this share of the charge of both adjacent maxima divides a cluster. 0: none does.
    estimator : str
        Position of a cluster, always ``"centroid"``.

    Raises
    ------
    ValueError
        Listing every invalid value.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem-design", gun, n=5, readout=cg.ProjectionReadout(noise=0.8), until="digitize")
    >>> result.detector.cgem["L1"].readout.noise, bool((result.digis["charge"] > 0).all())
    (0.8, True)
    """

    name: ClassVar[str] = "analog-projection"
    #: Of a readout from outside the package; None: those of the readout that it extends.
    errors: ClassVar[ChipErrors | None] = None

    gain: Gain = GAIN
    sigma: Width = 0.29
    threshold: Threshold = 1.7
    noise: Noise = 0.5
    valley: Share = 0.4
    estimator: Literal["centroid"] = "centroid"
