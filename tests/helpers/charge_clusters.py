"""Position, error and time of a cluster with charge in a few lines of numpy, from docs/methods/readout.md."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.stats import norm

from cgemit.detector import Detector
from cgemit.detector.gas import drift_columns, practical_range
from cgemit.detector.readouts import AnalogReadout
from cgemit.reconstruction.cluster_errors import SLOPE, chip_delays, error_inputs, errors_of

Floats = npt.NDArray[np.float64]

E_FC = 1.602176634e-4  # fC, of an electron
KEV_PER_ELECTRON, DENSITY, FARTHEST = 0.026, 1.7e-4, 3.0  # keV, g/cm2 per mm, mm


class Expected(NamedTuple):
    """What a cluster should have."""

    position: float  # mm
    error: float  # mm
    time: float  # ns
    variances: dict[str, float]  # mm2, by the term


class Plane(NamedTuple):
    """Numbers of one view of a layer."""

    pitch: float
    gap: float
    velocity: float
    diffusion: float
    cloud: float
    threshold: float


def plane_of(detector: Detector, readout: AnalogReadout, layer: int, view: int) -> Plane:
    """Return the numbers of one view: electrons drift half of the gap, end in holes, and are multiplied."""
    one, drift = detector.cgem[layer], {name: values[layer] for name, values in drift_columns(detector).items()}
    half, holes = one.drift_gap / 2, 5 / 72 * one.hole_pitch**2
    place = np.array([
        (one.r_readout / one.r_mid * drift["sigma_x"]) ** 2 * half + (one.r_readout * drift["first_phi"]) ** 2
        / readout.first_gain, drift["sigma_par"] ** 2 * half + drift["first_z"] ** 2 / readout.first_gain,
    ]) + holes  # fmt: skip
    cloud = np.array([one.r_readout * drift["cloud_phi"], drift["cloud_z"]]) ** 2
    along = np.array([1.0, 0.0] if view == 0 else [math.cos(one.stereo) ** 2, math.sin(one.stereo) ** 2])
    return Plane(
        (one.pitch_x, one.pitch_v)[view], one.drift_gap, drift["velocity"], float(along @ place), float(along @ cloud),
        (readout.threshold_x, readout.threshold_v)[view],
    )  # fmt: skip


def share_at(detector: Detector, readout: AnalogReadout, layer: int, path: float, number: float) -> float:
    """Return the sum of squares of the clusters' shares, linear between the table's paths and numbers."""
    table = error_inputs(detector, readout).shares
    paths, numbers = table["paths"], table["numbers"]
    values = table["values"].reshape(-1, len(paths), len(numbers))[layer]
    return float(np.interp(path, paths, [np.interp(number, numbers, row) for row in values]))


def delay_at(
    detector: Detector, readout: AnalogReadout, layer: int, view: int, spread: float, charge: Floats
) -> Floats:
    """Return the delays (ns) of charges (fC) that arrive within `spread` (ns), linear in the tables of the chip."""
    tables = chip_delays(detector, readout)
    spreads = tables["spreads"]
    number = view * len(detector.cgem) + layer
    charges = tables["charges"].reshape(2 * len(detector.cgem), -1)[number]
    rows = tables["delays"].reshape(2 * len(detector.cgem), len(spreads), -1)[number]
    by_spread = np.array([np.interp(charge, charges, row) for row in rows])
    return np.array([np.interp(spread, spreads, column) for column in by_spread.T])


def expected_cluster(
    detector: Detector, readout: AnalogReadout, layer: int, view: int, strips: tuple[Floats, Floats, Floats],
    slope: float, path: float, *, of_track: bool,
) -> Expected:  # fmt: skip
    """Return a cluster of strips, whose estimator is ``merged`` or, without a track, ``centroid``.

    Parameters
    ----------
    detector : Detector
    readout : AnalogReadout
    layer, view : int
    strips : (n,) float64 each
        Positions (mm), charges (fC) and times (ns).
    slope, path : float
        dX/dr or dV/dr of the track at the anode, and its path per radius.
    of_track : bool
        Whether they are those of a fitted track.
    """
    one, drift = detector.cgem[layer], {name: values[layer] for name, values in drift_columns(detector).items()}
    plane, chip = plane_of(detector, readout, layer, view), errors_of(readout)
    across = one.r_readout * (1.0 if view == 0 else math.cos(one.stereo))
    tangent = drift["tan_lorentz"]
    place, charge, times = strips
    n, total = len(place), charge.sum()

    s = slope - across * tangent / one.r_mid
    width = plane.pitch**2 / 12 + plane.cloud + plane.diffusion

    def span(s: float) -> float:
        return math.sqrt(12 / (12 / plane.gap**2 + s**2 / width))

    seen = span(s)
    delay = delay_at(detector, readout, layer, view, seen / plane.velocity, charge)
    # The first electrons arrive after the drift from the middle of the gap to the last foil, less their height.
    arrival = times - delay - drift["delay"] - one.r_mid / 299.792458
    lost = plane.threshold * n / total
    height = plane.gap / 2 - plane.velocity * arrival + seen * chip.height_by_threshold * lost

    share = charge / total
    x, h = share @ place, share @ height
    xx, hh, xh = share @ (place - x) ** 2, share @ (height - h) ** 2, share @ ((place - x) * (height - h))
    squares = share @ share

    gain = (1 + (1 / (1 + readout.polya) if readout.gain_fluctuation else 0.0)) / readout.survival - 1
    number = total * 2 / (readout.gain * readout.survival * E_FC)
    single = (1 + gain) / number
    # Noise moves the leading edge Q (t/rise)^2 of a strip where its time is taken.
    of_strip = total / n
    level = readout.chip.level * of_strip if readout.chip.level > 0 else plane.threshold
    edge = (readout.chip.timing.peak * readout.noise) ** 2 / (4 * level * of_strip)
    all_shares = share_at(detector, readout, layer, path, number)
    largest = max(all_shares - single, 0.0)
    energy = np.array([KEV_PER_ELECTRON * math.sqrt(largest) * number])
    reach = min(float(practical_range(energy)[0]) / DENSITY, FARTHEST)
    part = min(math.sqrt(largest), 0.75)
    alone = 0.0
    if n == 1:
        least = min(plane.threshold / total, 0.5)
        alone = max(0.0, plane.pitch + 2 * math.sqrt(plane.cloud + plane.diffusion) * norm.ppf(least))
    variances = {
        "diffusion": chip.diffusion * plane.diffusion * single,
        "strips": plane.pitch**2 / (2 * math.pi**2) * math.exp(-4 * math.pi**2 * plane.cloud / plane.pitch**2),
        "noise": (readout.noise * plane.pitch / total) ** 2 * n * (n**2 - 1) / 12,
        "alone": alone**2 / 24,
        "delta": largest * reach**2,
    }

    def lorentz(height: float) -> float:
        start = float(np.clip(one.r_mid + height, one.r_gap_in, one.r_gap_out))
        return float(across * (tangent * math.log(one.r_gap_out / start) + drift["shift"]))

    time = one.r_mid / 299.792458 + drift["delay"] + (plane.gap / 2 - h) / plane.velocity
    if readout.estimator == "centroid" and not of_track:
        along = s**2 * plane.gap**2 / 12
        variances |= {
            "ionization": chip.ionization * along * all_shares,
            "cut": chip.cut * (plane.threshold / total) ** 2 * n**2 * along,
            "wide": chip.wide * max(xx - along - width, 0.0) * part / (1 - part),
        }
        return Expected(x - lorentz(0.0), math.sqrt(sum(variances.values())), time, variances)
    slope_variance = 0.0
    if not of_track:
        # The slope that the charge has, weighted with that of a track from the beam line.
        # Noise is no part of the spread of heights. Where the slopes disagree, the track may come from elsewhere.
        noise = readout.jitter**2 + edge
        spread_of_heights = max(hh - chip.time * plane.velocity**2 * noise * (1 - squares), 0.0)
        own = spread_of_heights / squares / width
        apart = xh / (spread_of_heights + seen**2 / 12) - s
        prior = SLOPE**2 + (max(apart**2 - 1 / own, 0.0) if own > 0 else 0.0)
        slope_variance = 1 / (own + 1 / prior)
        more = slope_variance * own * apart
        slope, s = slope + more, s + more
    time_variance = readout.jitter**2 * squares + edge / n
    beside = place - x - s * (height - h)
    variances |= {
        "height": s**2 * (chip.span * span(s) ** 2 * all_shares + chip.time * plane.velocity**2 * time_variance),
        "slope": h**2 * slope_variance,
        "cut": chip.cut * (plane.threshold / total * plane.pitch) ** 2 / 12,
        "wide": chip.wide * max(share @ beside**2 - width, 0.0) * part / (1 - part),
    }
    return Expected(x - lorentz(h) - slope * h, math.sqrt(sum(variances.values())), time, variances)
