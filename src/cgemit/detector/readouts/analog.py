"""Chips that measure charge and time of each strip."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.validate import Quantity
from cgemit.detector.readouts.readout import (
    GAIN,
    SURVIVAL,
    ChipErrors,
    Estimator,
    Factor,
    Gain,
    Jitter,
    Margin,
    Missing,
    Noise,
    Probability,
    Readout,
    Share,
    Threshold,
)

_FINE = 0.01  # ns, step in which peaks are searched


@dataclass(frozen=True)
class Shaper:
    """Response of an amplifier to a charge.

    Attributes
    ----------
    terms : tuple of (float, float, float)
        a, b (1/ns) and rate (1/ns) of each term, of any scale.
    delay : float
        ns.
    """

    terms: tuple[tuple[float, float, float], ...]
    delay: float = 0.0

    @cached_property
    def normalised(self) -> Floats:
        """The terms, (n, 3) float64, scaled so that the peak is 1."""
        terms = np.array(self.terms)
        terms[:, :2] /= _sum(terms, np.arange(0.0, 500.0, _FINE)).max()
        return terms

    @cached_property
    def peak(self) -> float:
        """Time of the largest amplitude, ns after a charge."""
        times = np.arange(0.0, 500.0, _FINE)
        return self.delay + float(times[_sum(self.normalised, times).argmax()])


def _sum(terms: Floats, u: Floats) -> Floats:
    a, b, rate = (column[:, None] for column in terms.T)
    return np.asarray(np.sum((a + b * u) * np.exp(-rate * u), axis=0))


@dataclass(frozen=True)
class Chip:
    """How a chip measures charge and time of a strip.

    Attributes
    ----------
    kind : str
        Name of a chip in the core (``readout/chips.hpp``). ``"tiger"``: the branch for the time crosses the threshold,
        which is the time. `sample_delay` later the branch for the charge is sampled, which must exceed the threshold,
        too. ``"apv25"``: one branch is sampled `samples` times. The largest sample is the charge, and the time is where
        the leading edge reaches half of it.
    timing, charge : Shaper
        Of the two branches; the same one if there is one.
    clock : float
        ns, of the time stamps or between samples.
    level : float
        Where the time is taken on the leading edge, over the charge; 0 is the threshold.
    sample_delay : float
        ns.
    samples : int
    """

    kind: str
    timing: Shaper
    charge: Shaper
    clock: float
    level: float
    sample_delay: float = 0.0
    samples: int = 1


def chip_arguments(readout: AnalogReadout) -> dict[str, Any]:
    """Return what the core takes of the chip of a readout, by name."""
    chip = readout.chip
    return {
        "kind": chip.kind,
        "timing": (chip.timing.normalised, chip.timing.delay),
        "charge": (chip.charge.normalised, chip.charge.delay),
        "threshold_x": readout.threshold_x,
        "threshold_v": readout.threshold_v,
        "noise": readout.noise,
        "jitter": readout.jitter,
        "saturation": readout.saturation,
        "sample_delay": chip.sample_delay,
        "clock": chip.clock,
        "samples": chip.samples,
    }


@dataclass(frozen=True, kw_only=True)
class AnalogReadout(Readout):
    """A chip that measures charge and time of each strip. Gas and fields belong to the detector.

    It needs ionization: a crossing that frees no electron in the gap has no clusters.

    Attributes
    ----------
    gain : float
        Mean electrons on the anode per electron of ionization whose avalanche reaches it.
    polya : float
        Parameter theta of the Polya distribution of the gain (relative variance 1/(1 + theta)).
    gain_fluctuation : bool
        Whether the gain fluctuates.
    survival : float
        Probability that an electron enters a hole and its avalanche reaches the anode.
    first_gain : float
        Electrons behind the first foil per electron that entered it.
    diffusion : float
        Factor on all diffusion widths.
    lorentz : bool
        Whether the Lorentz angle acts.
    holes : bool
        Whether electrons move to the centre of the nearest hole of the first foil.
    share_spread : float
        Standard deviation of ln(charge on X / charge on V) of a crossing.
    threshold_x, threshold_v : float
        fC, least amplitude of a strip that is read out.
    noise : float
        fC, of an amplitude.
    jitter : float
        ns, of the time, in addition to the effect of noise.
    missing : int
        Strips that may be missing in a cluster.
    edge : float
        Outermost strips with a smaller share of their neighbour's charge are left out of ``"micro-tpc"`` fits.
    valley : float
        A strip with less than this share of the charge of both adjacent maxima divides a cluster. 0: none does.
    time_margin : float
        ns; strips are left out if their drift time is this far outside of the range of the drift gap.
    estimator : str
        Position of a cluster without track: ``"centroid"`` of the charge, ``"micro-tpc"`` (line fit through the drift
        gap), or ``"merged"`` (line through the centroid with the slope of a track from the beam line).
    second_pass : bool
        Whether clusters on fitted tracks are made again with the angle of the track.
    saturation : float
        fC, largest charge that the chip measures.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    chip: ClassVar[Chip]
    #: Of a readout from outside the package; None: those of the readout that it extends.
    errors: ClassVar[ChipErrors | None] = None

    gain: Gain = GAIN
    polya: Annotated[float, Quantity("dimensionless", 0.0, 1e6)] = 0.36
    gain_fluctuation: bool = True
    survival: Probability = SURVIVAL
    first_gain: Gain = 15.0
    diffusion: Factor = 1.0
    lorentz: bool = True
    holes: bool = True
    share_spread: Factor = 0.1
    threshold_x: Threshold = 2.0
    threshold_v: Threshold = 2.0
    noise: Noise = 0.5
    jitter: Jitter = 2.0
    missing: Missing = 1
    edge: Share = 0.1
    valley: Share = 0.2
    time_margin: Margin = 50.0
    estimator: Estimator = "merged"
    second_pass: bool = False
    saturation: Threshold = 48.0
