"""Readouts of layers as hardware: what digitization and clustering both know of them (docs/methods/readout.md).

A readout is described here, digitized by the digitizer of its class (`cgemit.simulation.digitize.DIGITIZERS`) and
clustered by the clusterer of its class (`cgemit.reconstruction.cluster.CLUSTERERS`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import UnionType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.validate import Check, Quantity
from cgemit.detector.parts import CgemLayer, Layer, MeasurementLayer, Readout
from cgemit.units import parse_quantity

Share = Annotated[float, Quantity("dimensionless", 0.0, 0.99)]
# An avalanche of 1e8 electrons is a discharge (Raether's limit).
Gain = Annotated[float, Quantity("dimensionless", 0.0, 1e8, above=True)]
Width = Annotated[float, Quantity("length", 0.0, 1000.0, above=True)]
# Of a strip and of a time, to far beyond any chip.
Noise = Annotated[float, Quantity("charge", 0.0, 1000.0)]
Threshold = Annotated[float, Quantity("charge", 0.0, 1e12, above=True)]
Jitter = Annotated[float, Quantity("time", 0.0, 10_000.0)]
Margin = Annotated[float, Quantity("time", 0.0, 1e12, above=True)]
Probability = Annotated[float, Quantity("dimensionless", 0.0, 1.0, above=True)]
Factor = Annotated[float, Quantity("dimensionless", 0.0, 10.0)]
Missing = Annotated[int, Check(lambda value: 0 <= value <= 10, "a whole number from 0 to 10")]
Estimator = Literal["merged", "centroid", "micro-tpc"]

#: Electrons on the anode per electron of ionization: effective gain of a triple GEM.
GAIN = 12_000.0
SURVIVAL = 0.957 * 0.962
"""An electron enters a hole of the first foil, and its gain is not zero (PARSIFAL, at the nominal voltage)."""

ELECTRON = parse_quantity("1 e", "charge")
"""fC."""
_FINE = 0.01  # ns, step in which peaks are searched


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


class Precision(NamedTuple):
    """How a layer measures positions."""

    sigma_x: float  # mm; 0: the middle of a strip
    sigma_v: float  # mm; 0: the middle of a strip
    sigma_time: float  # ns


@dataclass(frozen=True, kw_only=True)
class PositionReadout(Readout):
    """No strips: positions X and V, with the errors and the time of each layer (`[layer.NAME]`)."""

    name: ClassVar[str] = "positions"
    makes: ClassVar[Literal["strips", "positions"]] = "positions"

    @property
    def least_electrons(self) -> int:
        """0: positions need no ionization."""
        return 0

    @property
    def gain(self) -> float:
        """Electrons per electron of ionization; 0: the charge is not measured."""
        return 0.0

    def precision(self, layer: Layer) -> Precision:
        """Return how a layer measures.

        Parameters
        ----------
        layer : MeasurementLayer
        """
        layer = self._measured(layer)
        return Precision(layer.sigma_x, layer.sigma_v, layer.sigma_time)

    def errors(self, layer: Layer) -> tuple[float, float]:
        """Return the errors of X and V of a layer, mm; 0 where it is not measured.

        Parameters
        ----------
        layer : MeasurementLayer
        """
        return self._measured(layer).errors

    def _measured(self, layer: Layer) -> MeasurementLayer:
        if isinstance(layer, MeasurementLayer):
            return layer
        raise ValueError(f"readout {self.name}: got CGEM layer {layer.label}, expected a layer with errors of its own")


#: Readout of a layer that states none, by the kind of the layer.
DEFAULT_READOUTS: dict[type[Layer], Readout] = {CgemLayer: BinaryReadout(), MeasurementLayer: PositionReadout()}


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

    def precision(self, layer: Layer) -> Precision:
        """Return the given errors; the time is the true one."""
        return Precision(self.sigma_x, self.sigma_v, 0.0)

    def errors(self, layer: Layer) -> tuple[float, float]:
        """Return the given errors."""
        return self.sigma_x, self.sigma_v


@dataclass(frozen=True)
class ChipErrors:
    """Factors of a chip in the errors of its clusters, fitted to simulated clusters (``cgemit readout --fit``).

    Errors of clusters: docs/methods/readout.md.

    Attributes
    ----------
    ionization : float
        On the variance of the mean height of the charge, from the numbers and sizes of ionization clusters.
    cut : float
        On the variance by charge of strips below the threshold.
    diffusion : float
        On the variance by diffusion, holes and gain over the number of electrons.
    span : float
        On the variance of heights, from the part of the gap that a strip sees and its number of electrons.
    time : float
        On the variance of heights by jitter, and by noise on the leading edge.
    wide : float
        On the variance that charge wider than expected shows, by the share that its largest ionization cluster has.
    line : float
        On the variance of a line fit by its own slope.
    height_by_threshold : float
        What to add to heights, over the part of the gap that a strip sees and the share of the thresholds of all strips
        in the charge of a cluster.
    """

    ionization: float
    cut: float
    diffusion: float
    span: float
    time: float
    wide: float
    line: float
    height_by_threshold: float


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

    def response(self, t: Floats) -> Floats:
        """Return the amplitude, (n,) float64, at times t, (n,) float64 ns, after a charge of 1."""
        u = np.asarray(t, np.float64) - self.delay
        return np.where(u > 0, _sum(self.normalised, np.maximum(u, 0.0)), 0.0)

    def pulse(self, t: Floats, duration: float, parts: Floats | None = None) -> Floats:
        """Return the amplitude for a charge of 1 that flows in for `duration` ns.

        Parameters
        ----------
        t : (n,) float64
            ns, after the begin.
        duration : float
            ns.
        parts : (..., parts) float64 or None
            Charge in equal parts of the duration; None: it flows in evenly.

        Returns
        -------
        ndarray, (..., n) float64
        """
        parts = np.ones(1) if parts is None else parts
        step = duration / parts.shape[-1]
        u = np.asarray(t, np.float64) - self.delay
        level = np.array([self._step(u - k * step) for k in range(parts.shape[-1] + 1)])
        return np.asarray(parts @ (level[:-1] - level[1:]) / step)

    def _step(self, u: Floats) -> Floats:
        """Return the integral of the response up to u, (n,), in ns."""
        a, b, rate = (column[:, None] for column in self.normalised.T)
        at = np.maximum(u, 0.0)[None, :]
        level = a / rate + b / rate**2
        return np.asarray(np.sum(level - np.exp(-rate * at) * (level + b * at / rate), axis=0))


def _sum(terms: Floats, u: Floats) -> Floats:
    a, b, rate = (column[:, None] for column in terms.T)
    return np.asarray(np.sum((a + b * u) * np.exp(-rate * u), axis=0))


@dataclass(frozen=True)
class Chip:
    """How a chip measures charge and time of a strip.

    Attributes
    ----------
    kind : str
        ``"tiger"``: the branch for the time crosses the threshold, which is the time. `sample_delay` later the branch
        for the charge is sampled, which must exceed the threshold, too. ``"apv25"``: one branch is sampled `samples`
        times. The largest sample is the charge, and the time is where the leading edge reaches half of it.
    timing, charge : Shaper
        Of the two branches; the same one if there is one.
    clock : float
        ns, of the time stamps or between samples.
    sample_delay : float
        ns.
    samples : int
    """

    kind: Literal["tiger", "apv25"]
    timing: Shaper
    charge: Shaper
    clock: float
    sample_delay: float = 0.0
    samples: int = 1

    @property
    def level(self) -> float:
        """Where the time is taken on the leading edge, over the charge; 0 is the threshold."""
        return 0.5 if self.kind == "apv25" else 0.0


def chip_arguments(readout: AnalogReadout) -> dict[str, Any]:
    """Return what the core takes of the chip of a readout, by name.

    Parameters
    ----------
    readout : AnalogReadout
    """
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


# Shapers and times are those of PARSIFAL (github.com/Hilldar/PARSIFAL).
_CR_RC = Shaper(((0.0, math.e / 50, 1 / 50),))  # (t/tau) exp(1 - t/tau), 50 ns
#: Of the BESIII CGEM. Branch T peaks 53.6 ns after a charge, with 13.3 mV/fC; branch E after 154.7 ns, with 12.3 mV/fC.
TIGER = Chip(
    kind="tiger",
    timing=Shaper(((0.00181928, 0.0, 1 / 3), (-0.0147059, 0.0, 1 / 20), (0.0128866, 0.0, 1 / 100)), delay=10.0),
    charge=Shaper(((100164.0, 1358.7, 0.0385647), (-100164.0, 1358.7, 0.0114353)), delay=5.0),
    clock=6.25,
    sample_delay=4 * 6.25 * (6 + 0.5),
)
#: Of the test beams.
APV25 = Chip(kind="apv25", timing=_CR_RC, charge=_CR_RC, clock=25.0, samples=27)


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


@dataclass(frozen=True, kw_only=True)
class TigerReadout(AnalogReadout):
    """Two branches: the fast one gives the time of the leading edge, the slow one is sampled for the charge.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem-design", gun, n=5, readout=cg.TigerReadout(threshold_x=3.0), until="digitize")
    >>> x = result.digis[result.digis["view"] == 0]
    >>> bool((x["charge"] > 1).all()), bool(np.isfinite(x["time"]).all())
    (True, True)
    """

    name: ClassVar[str] = "tiger"
    chip: ClassVar[Chip] = TIGER


@dataclass(frozen=True, kw_only=True)
class Apv25Readout(AnalogReadout):
    """Samples every 25 ns: the largest is the charge, half of it on the leading edge the time.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem-design", gun, n=5, readout=cg.Apv25Readout(noise=0.4), until="digitize")
    >>> bool((result.digis["charge"] > 1).all())  # fC; the threshold is 1.67
    True
    """

    name: ClassVar[str] = "apv25"
    chip: ClassVar[Chip] = APV25

    threshold_x: Threshold = 1.67
    threshold_v: Threshold = 1.67
    jitter: Jitter = 7.12
    time_margin: Margin = 100.0
    saturation: Threshold = 60.0


#: Those that measure the charge of strips (`cgemit.reconstruction.cluster_errors`).
ChargeReadout = AnalogReadout | ProjectionReadout

#: Readouts of CGEM layers by name.
READOUTS: dict[str, type[Readout]] = {
    one.name: one for one in (BinaryReadout, GaussianReadout, TigerReadout, Apv25Readout, ProjectionReadout)
}

#: Readouts of each kind of layers by name.
OF_LAYERS: dict[type[Layer], Mapping[str, type[Readout]]] = {
    CgemLayer: READOUTS, MeasurementLayer: {PositionReadout.name: PositionReadout},
}  # fmt: skip

Part = TypeVar("Part")


def part_of(readout: Readout, parts: Mapping[type[Readout], Part]) -> Part:
    """Return the digitizer or clusterer of a readout: that of its class, or of the nearest class that it extends."""
    for one in type(readout).__mro__:
        if one in parts:
            return parts[one]
    raise ValueError(f"readout: got {readout.name!r}, expected one of {names_of()}")


def names_of(kind: type[Readout] | UnionType = Readout) -> str:
    """Return the names of the readouts of a kind, for messages."""
    return ", ".join(name for name, one in READOUTS.items() if issubclass(one, kind))
