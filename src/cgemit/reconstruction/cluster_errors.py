"""Errors of clusters with charge: what the fluctuations of the charge and a chip do to a position.

The formulas are in ``src/cpp/reconstruction/cluster/charge_errors.cpp`` and in docs/methods/readout.md. Here are their
inputs, and what they give for the clusters that a track is expected to have.
"""

from __future__ import annotations

import csv
import math
import os
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.base.errors import report
from cgemit.base.files import new_file, read_text
from cgemit.detector import Detector
from cgemit.detector.gas import cluster_shares, cluster_sizes, clusters_per_mm, drift_columns, ionization
from cgemit.detector.induction import WAY, charges_of_plane, cloud_widths
from cgemit.detector.layers import CgemLayer
from cgemit.detector.parts import cgem_layers
from cgemit.detector.readouts import ELECTRON, AnalogReadout, ChargeReadout, ChipErrors, chip_arguments
from cgemit.tables import Table
from cgemit.tables.schema import XV_CLUSTER
from cgemit.tables.show import Shown, Tabular, with_error, write_csv

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
    """Return the factors of the readouts of the package by name."""
    text = (resources.files("cgemit.reconstruction") / "cluster_errors.toml").read_text(encoding="utf-8")
    return {name: ChipErrors(**found) for name, found in tomllib.loads(text).items()}


def chip_errors(name: str) -> ChipErrors:
    """Return the factors of a readout of the package.

    Raises
    ------
    ValueError
        If the package has none of this name.
    """
    if name not in _of_package():
        raise ValueError(f"errors of clusters: got readout {name!r}, expected one of {', '.join(_of_package())}")
    return _of_package()[name]


def errors_of(readout: ChargeReadout) -> ChipErrors:
    """Return the factors of a readout: its own, or those of the readout of the package that it extends.

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
    """What the core's formulas take of a detector and a readout, by the names of its arguments."""

    chip: dict[str, float]
    planes: dict[str, Floats]
    shares: dict[str, Floats]


@lru_cache(maxsize=64)
def error_inputs(detector: Detector, readout: ChargeReadout, cgem: tuple[int, ...] | None = None) -> ErrorInputs:
    """Return the inputs of the error formulas.

    Parameters
    ----------
    detector : Detector
    readout : ChargeReadout
    cgem : tuple of int or None
        See `cgem_layers`.

    Raises
    ------
    ValueError
        If a layer's gas or field has no table of electron transport.
    """
    return ErrorInputs(_chip(readout), _planes(detector, readout, cgem), _shares(detector, readout, cgem))


def _gain_variance(readout: ChargeReadout) -> float:
    """Return the relative variance of the charge of an electron of ionization, which may be lost."""
    if not isinstance(readout, AnalogReadout):
        return 0.0
    gain = 1 / (1 + readout.polya) if readout.gain_fluctuation else 0.0
    return (1 + gain) / readout.survival - 1


def _chip(readout: ChargeReadout) -> dict[str, float]:
    columns = asdict(errors_of(readout)) | {
        "noise": readout.noise, "jitter": 0.0, "rise": 0.0, "level": 0.5, "gain_variance": _gain_variance(readout),
        "slope": SLOPE, "share_spread": 0.0,
    }  # fmt: skip
    survival = 1.0
    if isinstance(readout, AnalogReadout):
        survival = readout.survival
        columns |= {
            "jitter": readout.jitter, "rise": readout.chip.timing.peak, "level": readout.chip.level,
            "share_spread": readout.share_spread,
        }  # fmt: skip
    return columns | {"electrons_per_fC": 2 / (readout.gain * survival * ELECTRON)}  # a view has half of the charge


def _thresholds(readout: ChargeReadout) -> tuple[float, float]:
    return (
        (readout.threshold_x, readout.threshold_v) if isinstance(readout, AnalogReadout) else (readout.threshold,) * 2
    )


def _planes(detector: Detector, readout: ChargeReadout, cgem: tuple[int, ...] | None) -> dict[str, Floats]:
    """Return pitch, gap, velocity, variances of diffusion and cloud, and threshold of X, then of V of all layers."""
    rows = []
    for view, threshold in enumerate(_thresholds(readout)):
        for i, layer in enumerate(cgem_layers(detector, cgem)):
            pitch = layer.pitch_x if view == 0 else layer.pitch_v
            if isinstance(readout, AnalogReadout):
                drift = {name: float(one[i]) for name, one in drift_columns(detector, cgem).items()}
                cloud = float(cloud_widths(detector, readout.diffusion, cgem)[view, i]) ** 2
                place = _place_variance(layer, readout, drift, view)
                widths = drift["velocity"], place, cloud
            else:
                widths = 1.0, 0.0, readout.sigma**2
            rows.append((pitch, layer.drift_gap, *widths, threshold))
    names = ("pitch", "gap", "velocity", "diffusion", "cloud", "threshold")
    return dict(zip(names, np.array(rows, np.float64).reshape(-1, len(names)).T.copy(), strict=True))


def _place_variance(layer: CgemLayer, readout: AnalogReadout, drift: dict[str, float], view: int) -> float:
    """Return the variance of an electron's place across the strips of a view, mm2."""
    scale, half = layer.r_readout / layer.r_mid, layer.drift_gap / 2
    holes = _HOLES * layer.hole_pitch**2 if readout.holes else 0.0
    factor, few = readout.diffusion**2, readout.diffusion**2 / readout.first_gain
    along_x = (
        factor * (scale * drift["sigma_x"]) ** 2 * half + holes + few * (layer.r_readout * drift["first_phi"]) ** 2
    )
    along_z = factor * drift["sigma_par"] ** 2 * half + holes + few * drift["first_z"] ** 2
    return along_x if view == 0 else math.cos(layer.stereo) ** 2 * along_x + math.sin(layer.stereo) ** 2 * along_z


def _shares(detector: Detector, readout: ChargeReadout, cgem: tuple[int, ...] | None) -> dict[str, Floats]:
    variance = _gain_variance(readout)
    values, apart, times, logs = [], [], [], []
    drift = drift_columns(detector, cgem) if isinstance(readout, AnalogReadout) else None
    for i, layer in enumerate(cgem_layers(detector, cgem)):
        mean = float(clusters_per_mm(layer.gas, np.array([_MUON]))[0]) * layer.drift_gap
        table = cluster_shares(layer.gas.ionization)
        values.append([table.shares(mean * path, _NUMBERS, variance) for path in _PATHS])
        numbers = table.quantiles(mean)
        apart.append(math.sqrt(2) * float(np.std(np.log(numbers))))
        logs.append(float(np.mean(np.log(numbers))))
        velocity = 1.0 if drift is None else float(drift["velocity"][i])
        height = layer.drift_gap**2 / 12 * float(np.mean(table.shares(mean, numbers, variance)))
        times.append(math.sqrt(2 * height) / velocity)
    return {
        "paths": _PATHS,
        "numbers": _NUMBERS,
        "values": np.array(values, np.float64).ravel(),
        "charges_apart": np.array(apart, np.float64),
        "times_apart": np.array(times, np.float64),
        "log_numbers": np.array(logs, np.float64),
    }


_TRACKS = 1000  # beside strips, whose delays are averaged
_CHARGES = 64  # in a table of delays
_LARGEST = 200.0  # fC, of the table


@lru_cache(maxsize=16)
def _drifting(gas: str, clusters: float, gain_variance: float) -> dict[str, npt.NDArray[Any]]:
    """Return random tracks through a gap with a mean number of ionization clusters, as the core takes them."""
    table, random = ionization(gas), np.random.default_rng(1)
    number = np.maximum(random.poisson(clusters, _TRACKS), 1)
    first = np.concatenate([[0], np.cumsum(number)])
    electrons = cluster_sizes(table, random.random((2, first[-1])))
    # The charge of i electrons is a gamma variate of the variance i times that of one.
    shape = electrons / gain_variance if gain_variance > 0 else np.inf
    charge = electrons if gain_variance == 0 else gain_variance * random.gamma(shape)
    return {
        "first": first,
        "height": random.uniform(-0.5, 0.5, first[-1]),
        "charge": charge,
        "place": (random.permutation(_TRACKS) + 0.5) / _TRACKS - 0.5,
    }


@lru_cache(maxsize=64)
def chip_delays(detector: Detector, readout: ChargeReadout, cgem: tuple[int, ...] | None = None) -> dict[str, Floats]:
    """Return the delays of the chip for X, then V of all layers, see ``DelayTable`` of the core.

    The mean over tracks with fluctuating ionization, for strips that see parts of the gap.

    Parameters
    ----------
    detector : Detector
    readout : ChargeReadout
    cgem : tuple of int or None
        See `cgem_layers`.
    """
    planes = _planes(detector, readout, cgem)
    n = len(planes["pitch"])
    if not isinstance(readout, AnalogReadout):
        return {"spreads": np.zeros(1), "charges": np.tile([0.0, 1.0], n), "delays": np.zeros(2 * n)}
    induction = np.tile(drift_columns(detector, cgem)["induction"], 2)
    charges, delays = np.empty((n, _CHARGES)), np.empty((n, len(_SPREADS), _CHARGES))
    for i, layer in enumerate(cgem_layers(detector, cgem) * 2):
        pitch, gap, velocity, place, cloud, threshold = (float(column[i]) for column in planes.values())
        width = math.sqrt(place + cloud)
        # The slopes with which a strip sees parts of the gap.
        seen = np.clip(_SPREADS * velocity, 0.05 * gap, gap)
        slopes = np.sqrt(12 * (width**2 + pitch**2 / 12) * np.maximum(1 / seen**2 - 1 / gap**2, 0))
        clusters = float(clusters_per_mm(layer.gas, np.array([_MUON]))[0]) * gap
        charges[i] = np.geomspace(1.02 * threshold, max(_LARGEST, 100 * threshold), _CHARGES)
        delays[i] = _core.readout.strip_delays(
            chip=chip_arguments(readout),
            view={
                "pitch": pitch, "gap": gap, "velocity": velocity, "duration": float(induction[i]),
                "margin": 2 * width, "threshold": threshold,
            },
            way=WAY, induced=charges_of_plane(pitch, layer.induction_gap, width),
            tracks=_drifting(layer.gas.ionization, clusters, _gain_variance(readout)),
            slopes=slopes, charges=charges[i],
        )  # fmt: skip
    return {"spreads": _SPREADS, "charges": charges.ravel(), "delays": delays.ravel()}


class Expected(NamedTuple):
    """Errors of clusters of tracks from the origin, each (layers, 17) float64, at `COS_THETA`."""

    sigma_x: Floats  # mm
    sigma_v: Floats  # mm
    correlation: Floats


@lru_cache(maxsize=256)
def expected_errors(
    detector: Detector, readout: ChargeReadout, estimator: str, of_track: bool, cgem: tuple[int, ...] | None = None
) -> Expected:
    """Return the errors that a readout is expected to have, without events.

    The formulas are those of a cluster that is seen, for the mean width, and the geometric mean over numbers of
    electrons in equal steps of their distribution.

    Parameters
    ----------
    detector : Detector
    readout : ChargeReadout
    estimator : str
    of_track : bool
        Whether clusters know the slopes of their tracks.
    cgem : tuple of int or None
        See `cgem_layers`.
    """
    layers = cgem_layers(detector, cgem)
    if not layers:
        none = np.zeros((0, len(COS_THETA)))
        return Expected(none, none, none)
    inputs = error_inputs(detector, readout, cgem)
    tilt = COS_THETA / np.sqrt(1 - COS_THETA**2)  # z over radius
    path = np.hypot(1.0, tilt)
    lorentz = np.zeros(len(layers))
    if isinstance(readout, AnalogReadout) and readout.lorentz:
        lorentz = drift_columns(detector, cgem)["tan_lorentz"]
    slopes = np.array(
        [
            [
                -tan * layer.r_readout / layer.r_mid + 0 * tilt,
                -math.sin(layer.stereo) * tilt - tan * math.cos(layer.stereo) * layer.r_readout / layer.r_mid,
            ]
            for tan, layer in zip(lorentz, layers, strict=True)
        ]
    )  # (layers, 2, angles)
    numbers = np.array(
        [
            [
                cluster_shares(layer.gas.ionization).quantiles(
                    float(clusters_per_mm(layer.gas, np.array([_MUON]))[0]) * layer.drift_gap * length
                )
                for length in path
            ]
            for layer in layers
        ]
    )  # (layers, angles, numbers)
    variances = np.empty((2, *numbers.shape))
    plane = {name: values.reshape(2, len(layers)) for name, values in inputs.planes.items()}
    for view, i in np.ndindex(2, len(layers)):
        slope = np.broadcast_to(slopes[i, view][:, None], numbers[i].shape)
        variances[view, i] = _core.reconstruction.charge_variances(
            chip=inputs.chip, planes=inputs.planes, shares=inputs.shares,
            estimator=estimator, of_track=of_track, view=view, layer=i, slope=slope.ravel(),
            path=np.repeat(path, numbers.shape[2]), number=numbers[i].ravel(),
        ).reshape(numbers[i].shape)  # fmt: skip
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


#: Numbers of strips with factors of their own; the last one stands for all larger clusters, too.
LARGEST_SIZE = 4
_COLUMNS = ("layer", "view", "size", "hits", "factor", "err")


@dataclass(frozen=True, eq=False, repr=False)
class ErrorFactors(Shown, Tabular):
    """Factors on the errors of clusters, one row for each layer, view and number of strips.

    Attributes
    ----------
    layer, view, size : ndarray, (n,) int64
        View 0 X, 1 V; the size 4 stands for all clusters with four or more strips.
    hits : ndarray, (n,) int64
        From which the factor follows; a class with few has the factor of its layer and view, or of its view.
    factor, err : ndarray, (n,) float64
        On the standard deviation, and its error; NaN where there is none.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> path = cg.cluster_error_factors(r).save("errors.csv")
    >>> settings = cg.ClusterSettings(error_factors=str(path))
    >>> wider = cg.cluster(r.detector, r.digis, settings)
    >>> len(wider) == len(r.clusters)
    True
    """

    layer: npt.NDArray[np.int64]
    view: npt.NDArray[np.int64]
    size: npt.NDArray[np.int64]
    hits: npt.NDArray[np.int64]
    factor: Floats
    err: Floats

    def columns(self) -> dict[str, Sequence[Any]]:
        """Return the rows as columns."""
        return {name: getattr(self, name).tolist() for name in _COLUMNS}

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        sizes = [f"{size}+" if size == LARGEST_SIZE else f"{size}" for size in self.size]
        rows = [
            [
                str(self.layer[i]), "XV"[self.view[i]], sizes[i], str(self.hits[i]),
                with_error(self.factor[i], self.err[i]),
            ]
            for i in range(len(self.layer))
        ]  # fmt: skip
        return "factors on errors of clusters", ("layer", "view", "strips", "hits", "factor"), rows

    def of_hits(self, layer: npt.NDArray[Any], view: npt.NDArray[Any], size: npt.NDArray[Any]) -> Floats:
        """Return the factors of clusters, (n,) float64; 1 for layers and views without one.

        Parameters
        ----------
        layer, view, size : ndarray, (n,) int
        """
        factors = np.ones(len(layer))
        size = np.minimum(size, LARGEST_SIZE)
        for i in range(len(self.layer)):
            factors[(layer == self.layer[i]) & (view == self.view[i]) & (size == self.size[i])] = self.factor[i]
        return factors

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the table as CSV, as the setting `cluster.error_factors` reads it, and return its path.

        Parameters
        ----------
        path : path
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        """
        path = Path(path)
        with new_file(path, overwrite=overwrite) as temporary:
            write_csv(temporary, {name: getattr(self, name) for name in _COLUMNS})
        return path


def read_error_factors(path: str) -> ErrorFactors:
    """Read the table that `ErrorFactors.save` writes.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        Listing the lines that are wrong.
    """
    rows = list(csv.reader(read_text(Path(path)).splitlines()))
    if not rows or tuple(rows[0]) != _COLUMNS:
        raise ValueError(
            f"{path}: line 1: got {','.join(rows[0] if rows else [])!r:.80}, expected {','.join(_COLUMNS)}"
        )
    problems, factor_rows = [], []
    for line, row in enumerate(rows[1:], 2):
        try:
            layer, view, size, hits = (int(cell) for cell in row[:4])
            factor, err = (float(cell) if cell else math.nan for cell in row[4:])
        except ValueError:
            problems.append(f"line {line}: got {','.join(row)!r:.80}, expected four whole and two other numbers")
            continue
        if layer < 0 or view not in (0, 1) or not 1 <= size <= LARGEST_SIZE or not 0 < factor < 1e3:
            problems.append(
                f"line {line}: got {','.join(row)!r:.80}, expected a layer, view 0 or 1, size 1 to {LARGEST_SIZE}, "
                "and a factor above 0 and below 1000"
            )
        factor_rows.append((layer, view, size, hits, factor, err))
    report(path, problems)
    columns = np.array(factor_rows, np.float64).reshape(-1, len(_COLUMNS)).T
    return ErrorFactors(*(column.astype(np.int64) for column in columns[:4]), *columns[4:])


def refuse_other_errors(name: str, clusters: Table) -> None:
    """Raise an error if errors of clusters follow from their incidence, so that the fit takes them from elsewhere.

    Parameters
    ----------
    name : str
        Of the function that needs them.
    clusters : Table

    Raises
    ------
    ValueError
    """
    if len(clusters) and not (clusters["method"] == 1).all():
        raise ValueError(
            f"{name}: got clusters whose errors the fit takes from strips and incidence, expected those of a readout "
            "with charge, such as tiger"
        )


def with_factors(detector: Detector, clusters: Table, factors: ErrorFactors) -> Table:
    """Return clusters with factors on the errors of X and V; those of phi and z follow.

    Parameters
    ----------
    detector : Detector
    clusters : Table
        Of a readout with charge.
    factors : ErrorFactors

    Raises
    ------
    ValueError
        If the errors of clusters follow from strips and incidence.
    """
    refuse_other_errors("cluster.error_factors", clusters)
    layer, view = clusters["layer"], clusters["view"]
    factor = factors.of_hits(layer, view, clusters["size"])
    err_x, err_v = clusters["err_x"] * factor, clusters["err_v"] * factor
    joined = view == XV_CLUSTER
    err_x[joined], err_v[joined] = err_x[clusters["x_cluster"][joined]], err_v[clusters["v_cluster"][joined]]
    radius = np.array([one.r_readout for one in detector.layers])[layer]
    cosine, sine = np.array([(math.cos(one.stereo), one.sin_stereo) for one in detector.layers]).T[:, layer]
    err_z = np.hypot(err_v, cosine * err_x) / np.abs(sine)
    columns = {"err_x": err_x, "err_v": err_v}
    columns["err_phi"] = np.where(np.isfinite(clusters["err_phi"]), err_x / radius, clusters["err_phi"])
    columns["err_z"] = np.where(np.isfinite(clusters["err_z"]), err_z, clusters["err_z"])
    return clusters.with_columns(**columns)
