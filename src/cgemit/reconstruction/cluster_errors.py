"""Errors of clusters with charge: what the fluctuations of the charge and a chip do to a position.

The formulas are in ``src/cpp/reconstruction/cluster/charge_errors.cpp`` and in docs/methods/readout.md. Here are their
inputs, and what they give for the clusters that a track is expected to have.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import asdict
from functools import cache, lru_cache
from importlib import resources
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.detector import Detector
from cgemit.detector.gas import cluster_shares, clusters_per_mm, drift_columns
from cgemit.detector.parts import CgemLayer
from cgemit.detector.readouts import ELECTRON, AnalogReadout, ChargeReadout, Chip, ChipErrors

Floats = npt.NDArray[np.float64]

#: cos(theta) of tracks for which errors are expected, where these depend on it; linear between, constant beyond.
COS_THETA = np.array([-0.9, -0.85, -0.78, -0.69, -0.58, -0.45, -0.3, -0.15, 0.0,
                      0.15, 0.3, 0.45, 0.58, 0.69, 0.78, 0.85, 0.9])  # fmt: skip

SLOPE = 0.05
"""Spread of tracks' slopes about the direction from the beam line, of clusters that know no track."""
_PATHS = np.geomspace(1.0, 3.0, 12)  # per radius, of the table of shares
_NUMBERS = np.geomspace(2.0, 500.0, 40)  # of electrons, of the same
_SPREADS = np.linspace(0.0, 260.0, 14)  # ns, in which the charge of a strip arrives
_MUON = math.log(9.46)  # ln(beta gamma) of 1 GeV/c, whose ionization is expected
_HOLES = 5 / 36 / 2  # variance of the way to the nearest hole, in squares of the pitch of a hexagonal lattice


@cache
def _of_package() -> dict[str, ChipErrors]:
    """Return the factors of the read-outs of the package by name."""
    text = (resources.files("cgemit.reconstruction") / "cluster_errors.toml").read_text(encoding="utf-8")
    return {name: ChipErrors(**found) for name, found in tomllib.loads(text).items()}


def chip_errors(name: str) -> ChipErrors:
    """Return the factors of a read-out of the package.

    Parameters
    ----------
    name : str

    Raises
    ------
    ValueError
        If the package has none of this name.
    """
    if name not in _of_package():
        raise ValueError(f"errors of clusters: got read-out {name!r}, expected one of {', '.join(_of_package())}")
    return _of_package()[name]


def errors_of(readout: ChargeReadout) -> ChipErrors:
    """Return the factors of a read-out: its own, or those of the read-out of the package that it extends.

    Parameters
    ----------
    readout : ChargeReadout

    Raises
    ------
    ValueError
        If there are none.
    """
    if readout.errors is not None:
        return readout.errors
    names = [vars(one)["name"] for one in type(readout).__mro__ if "name" in vars(one)]
    return chip_errors(next((name for name in names if name in _of_package()), readout.name))


class ErrorInputs(NamedTuple):
    """What the core's formulas take of a detector and a read-out, by the names of its arguments."""

    delays: dict[str, Floats]
    chip: dict[str, float]
    planes: dict[str, Floats]
    shares: dict[str, Floats]


@lru_cache(maxsize=64)
def error_inputs(detector: Detector, readout: ChargeReadout) -> ErrorInputs:
    """Return the inputs of the error formulas.

    Parameters
    ----------
    detector : Detector
    readout : ChargeReadout

    Raises
    ------
    ValueError
        If a layer's gas or field has no table of electron transport.
    """
    return ErrorInputs(
        _delays(detector, readout), _chip(readout), _planes(detector, readout), _shares(detector, readout)
    )


def _gain_variance(readout: ChargeReadout) -> float:
    """Return the relative variance of the charge of an electron of ionization, which may be lost."""
    if not isinstance(readout, AnalogReadout):
        return 0.0
    gain = 1 / (1 + readout.polya) if readout.gain_fluctuation else 0.0
    return (1 + gain) / readout.survival - 1


def _chip(readout: ChargeReadout) -> dict[str, float]:
    found = asdict(errors_of(readout)) | {
        "noise": readout.noise, "jitter": 0.0, "rise": 0.0, "gain_variance": _gain_variance(readout), "slope": SLOPE,
        "share_spread": 0.0,
    }  # fmt: skip
    survival = 1.0
    if isinstance(readout, AnalogReadout):
        survival = readout.survival
        found |= {
            "jitter": readout.jitter, "rise": readout.chip.timing.peak, "share_spread": readout.share_spread,
        }  # fmt: skip
    return found | {"electrons_per_fC": 2 / (readout.gain * survival * ELECTRON)}  # a view has half of the charge


def _thresholds(readout: ChargeReadout) -> tuple[float, float]:
    return (
        (readout.threshold_x, readout.threshold_v) if isinstance(readout, AnalogReadout) else (readout.threshold,) * 2
    )


def _planes(detector: Detector, readout: ChargeReadout) -> dict[str, Floats]:
    """Return pitch, gap, velocity, variances of diffusion and cloud, and threshold of X, then of V of all layers."""
    rows = []
    for view, threshold in enumerate(_thresholds(readout)):
        for number, layer in enumerate(detector.cgem):
            pitch = layer.pitch_x if view == 0 else layer.pitch_v
            if isinstance(readout, AnalogReadout):
                drift = {name: float(one[number]) for name, one in drift_columns(detector).items()}
                widths = drift["velocity"], *_widths(layer, readout, drift, view)
            else:
                widths = 1.0, 0.0, readout.sigma**2
            rows.append((pitch, layer.drift_gap, *widths, threshold))
    names = ("pitch", "gap", "velocity", "diffusion", "cloud", "threshold")
    return dict(zip(names, np.array(rows, np.float64).reshape(-1, len(names)).T.copy(), strict=True))


def _widths(layer: CgemLayer, readout: AnalogReadout, drift: dict[str, float], view: int) -> tuple[float, float]:
    """Return the variances of an electron's place and of its avalanche across the strips of a view, mm2."""
    scale, half = layer.r_readout / layer.r_mid, layer.drift_gap / 2
    holes = _HOLES * layer.hole_pitch**2 if readout.holes else 0.0
    few = readout.diffusion**2 / readout.first_gain
    factor = readout.diffusion**2
    place_x = (
        factor * (scale * drift["sigma_x"]) ** 2 * half + holes + few * (layer.r_readout * drift["first_phi"]) ** 2
    )
    place_z = factor * drift["sigma_par"] ** 2 * half + holes + few * drift["first_z"] ** 2
    cloud_x, cloud_z = factor * (layer.r_readout * drift["cloud_phi"]) ** 2, factor * drift["cloud_z"] ** 2
    if view == 0:
        return place_x, cloud_x
    across, along = math.cos(layer.stereo) ** 2, math.sin(layer.stereo) ** 2
    return across * place_x + along * place_z, across * cloud_x + along * cloud_z


def _shares(detector: Detector, readout: ChargeReadout) -> dict[str, Floats]:
    variance = _gain_variance(readout)
    values, apart, times = [], [], []
    drift = drift_columns(detector) if isinstance(readout, AnalogReadout) else None
    for number, layer in enumerate(detector.cgem):
        mean = float(clusters_per_mm(layer.gas, np.array([_MUON]))[0]) * layer.drift_gap
        table = cluster_shares(layer.gas.ionization)
        values.append([table.shares(mean * path, _NUMBERS, variance) for path in _PATHS])
        numbers = table.quantiles(mean)
        apart.append(math.sqrt(2) * float(np.std(np.log(numbers))))
        velocity = 1.0 if drift is None else float(drift["velocity"][number])
        height = layer.drift_gap**2 / 12 * float(np.mean(table.shares(mean, numbers, variance)))
        times.append(math.sqrt(2 * height) / velocity)
    return {
        "paths": _PATHS,
        "numbers": _NUMBERS,
        "values": np.array(values, np.float64).ravel(),
        "charges_apart": np.array(apart, np.float64),
        "times_apart": np.array(times, np.float64),
    }


def _delays(detector: Detector, readout: ChargeReadout) -> dict[str, Floats]:
    """Return the delays of the chip, see ``DelayTable`` of the core."""
    layers = len(detector.cgem)
    if not isinstance(readout, AnalogReadout):
        return {"spreads": np.zeros(1), "charges": np.tile([0.0, 1.0], 2 * layers), "delays": np.zeros(4 * layers)}
    induction = drift_columns(detector)["induction"]
    thresholds = (readout.threshold_x, readout.threshold_v)
    rows = [delays_of(readout.chip, float(duration), one) for duration in induction for one in thresholds]
    charges, delays = ([row[i].ravel() for row in rows] for i in (0, 1))
    empty = np.zeros(0)
    return {
        "spreads": _SPREADS,
        "charges": np.concatenate(charges or [empty]),
        "delays": np.concatenate(delays or [empty]),
    }


_POINTS = 64  # of charge, in the table of a leading edge
_LARGEST = 200.0  # fC, of the table
_STEP = 0.5  # ns, in which pulses are followed


@lru_cache(maxsize=256)
def delays_of(chip: Chip, duration: float, threshold: float) -> tuple[Floats, Floats]:
    """Return when a chip measures charge that arrives evenly within a time, after its mean arrival.

    Parameters
    ----------
    chip : Chip
    duration : float
        ns, of the current of an electron.
    threshold : float
        fC.

    Returns
    -------
    charges : ndarray, (64,) float64, fC, growing
        As the chip measures them.
    delays : ndarray, (14, 64) float64, ns
        For charge that arrives within 0 to 260 ns in equal steps.
    """
    times = np.arange(0.0, 700.0, _STEP)
    charges = np.geomspace(1.02 * threshold, max(_LARGEST, 100 * threshold), _POINTS)
    delays = np.empty((len(_SPREADS), _POINTS))
    for row, spread in zip(delays, _SPREADS, strict=True):
        evenly = np.full(max(1, round(spread / _STEP)), 1.0)
        edge, sampled = (
            np.convolve(shaper.pulse(times, duration), evenly / len(evenly))[: len(times)]
            for shaper in (chip.timing, chip.charge)
        )
        if chip.kind == "tiger":
            rise = slice(0, int(edge.argmax()) + 1)
            true = np.geomspace(1.01 * threshold / edge.max(), 2 * charges[-1], 4 * _POINTS)
            crossed = np.interp(threshold / true, edge[rise], times[rise])
            measured = true * np.interp(crossed + chip.sample_delay, times, sampled)
            order = np.argsort(measured)
            row[:] = np.interp(charges, measured[order], crossed[order]) - spread / 2
        else:
            row[:] = _half_height(chip, times, edge) - spread / 2
    return charges, delays


def _half_height(chip: Chip, times: Floats, edge: Floats) -> float:
    """Return the mean time at which samples of a pulse reach half of the largest one, ns after its begin."""
    sampled = chip.clock * np.arange(chip.samples, dtype=np.float64)
    found = []
    for phase in np.arange(0.5, chip.clock, 2.0):  # ns, of the begin after a sample
        begin = 4 * chip.clock + float(phase)
        samples = np.interp(sampled - begin, times, edge, left=0.0)
        top = int(samples.argmax())
        first = int(np.flatnonzero(samples[: top + 1] <= 0.5 * samples[top])[-1])
        rise = samples[first + 1] - samples[first]
        found.append(sampled[first] + chip.clock * (0.5 * samples[top] - samples[first]) / rise - begin)
    return float(np.mean(found))


class Expected(NamedTuple):
    """Errors of clusters of tracks from the origin, each (layers, 17) float64, at `COS_THETA`."""

    sigma_x: Floats  # mm
    sigma_v: Floats  # mm
    correlation: Floats


@lru_cache(maxsize=256)
def expected_errors(detector: Detector, readout: ChargeReadout, estimator: str, of_track: bool) -> Expected:
    """Return the errors that a read-out is expected to have, without events.

    The formulas are those of a cluster that is seen, for the mean width, and the geometric mean over numbers of
    electrons in equal steps of their distribution.

    Parameters
    ----------
    detector : Detector
    readout : ChargeReadout
    estimator : str
    of_track : bool
        Whether clusters know the slopes of their tracks.
    """
    if not detector.cgem:
        none = np.zeros((0, len(COS_THETA)))
        return Expected(none, none, none)
    inputs = error_inputs(detector, readout)
    layers = detector.cgem
    tilt = COS_THETA / np.sqrt(1 - COS_THETA**2)  # z over radius
    path = np.hypot(1.0, tilt)
    lorentz = drift_columns(detector)["tan_lorentz"] if isinstance(readout, AnalogReadout) else np.zeros(len(layers))
    if isinstance(readout, AnalogReadout) and not readout.lorentz:
        lorentz = np.zeros(len(layers))
    slopes = np.array(
        [
            [
                -tan * one.r_readout / one.r_mid + 0 * tilt,
                -math.sin(one.stereo) * tilt - tan * math.cos(one.stereo) * one.r_readout / one.r_mid,
            ]
            for tan, one in zip(lorentz, layers, strict=True)
        ]
    )  # (layers, 2, angles)
    numbers = np.array(
        [
            [
                cluster_shares(one.gas.ionization).quantiles(
                    float(clusters_per_mm(one.gas, np.array([_MUON]))[0]) * one.drift_gap * length
                )
                for length in path
            ]
            for one in layers
        ]
    )  # (layers, angles, numbers)
    variances = np.empty((2, *numbers.shape))
    plane = {name: values.reshape(2, len(layers)) for name, values in inputs.planes.items()}
    for view, number in np.ndindex(2, len(layers)):
        slope = np.broadcast_to(slopes[number, view][:, None], numbers[number].shape)
        variances[view, number] = _core.charge_variances(
            chip=inputs.chip, planes=inputs.planes, shares=inputs.shares,
            estimator=estimator, of_track=of_track, view=view, layer=number, slope=slope.ravel(),
            path=np.repeat(path, numbers.shape[2]), number=numbers[number].ravel(),
        ).reshape(numbers[number].shape)  # fmt: skip
    sigma = np.exp(0.5 * np.log(variances).mean(axis=-1))
    # X and V of a crossing come from the same electrons.
    chip = inputs.chip
    single = chip["diffusion"] * (1 + chip["gain_variance"]) / numbers
    cos_stereo = np.array([math.cos(one.stereo) for one in layers])[:, None, None]
    shared = single * plane["diffusion"][0][:, None, None] * cos_stereo
    if estimator == "centroid" and not of_track:
        heights = (plane["gap"][0] ** 2 / 12)[:, None, None] * chip["ionization"]
        shares = np.array([_of_table(inputs.shares, number, path, numbers[number]) for number in range(len(layers))])
        shared = shared + (slopes[:, 0] * slopes[:, 1])[:, :, None] * heights * shares
    correlation = (shared / np.sqrt(variances[0] * variances[1])).mean(axis=-1)
    return Expected(sigma[0], sigma[1], np.clip(correlation, -0.95, 0.95))


def _of_table(shares: dict[str, Floats], layer: int, path: Floats, numbers: Floats) -> Floats:
    """Return the mean of the sum of squares of shares, (angles, numbers)."""
    table = shares["values"].reshape(-1, len(_PATHS), len(_NUMBERS))[layer]
    by_number = np.array([np.interp(numbers, _NUMBERS, row) for row in table])
    return np.array(
        [
            [np.interp(length, _PATHS, by_number[:, i, k]) for k in range(numbers.shape[1])]
            for i, length in enumerate(path)
        ]
    )
