"""How often X and V clusters of different particles are paired, by geometry alone, with charge, and with time."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from cgemit.chain import run
from cgemit.detector import Detector
from cgemit.digitize.calibration import calibration_of
from cgemit.gun import Gun
from cgemit.statistics.formatting import text_table, with_error
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

WAYS = ("geometry", "charge", "charge and time")
_TOUCHED = 0.1  # as in the kernel
_APART = 1e6  # of the score of pairs that do not cross on the sheet
_HEAD = ("tracks", "crossings of clusters per track", *(f"wrong by {way} [%]" for way in WAYS))


@dataclass(frozen=True)
class GhostPoint:
    """Pairs at one number of tracks on a sheet.

    Attributes
    ----------
    tracks : int
    crossings : float
        Pairs that cross on the sheet, per track.
    wrong : dict of str to (float, float)
        Share of pairs of different particles and its error, by what selects the pairs (`WAYS`).
    """

    tracks: int
    crossings: float
    wrong: dict[str, tuple[float, float]]


@dataclass(frozen=True, repr=False)
class GhostScan:
    """Pairs at several numbers of tracks on a sheet.

    Attributes
    ----------
    title : str
    points : tuple of GhostPoint
    """

    title: str
    points: tuple[GhostPoint, ...]

    def to_csv(self) -> str:
        """Return the text of a CSV file, one row a number of tracks."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        names = [way.replace(" ", "_") for way in WAYS]
        writer.writerow(["tracks", "crossings", *(f"wrong_{name}{end}" for name in names for end in ("", "_error"))])
        for point in self.points:
            values = [value for way in WAYS for value in point.wrong[way]]
            writer.writerow([point.tracks, *(f"{value:.6g}" for value in (point.crossings, *values))])
        return text.getvalue()

    def __repr__(self) -> str:
        rows = [
            [str(point.tracks), f"{point.crossings:.2f}"]
            + [with_error(*(100 * value for value in point.wrong[way])) for way in WAYS]
            for point in self.points
        ]
        return text_table(self.title, _HEAD, rows)


def scan_ghosts(
    detector: Detector, readout: Any, tracks: Sequence[int] = (2, 4, 6), *, n: int = 1000, seed: int = 1,
    layer: int = 0, p: float = 1.0, cos_theta: float = 0.8, threads: int | None = None,
) -> GhostScan:  # fmt: skip
    """Return how often pairs are wrong if tracks cross one sheet together.

    Parameters
    ----------
    detector : Detector
    readout : AnalogReadout
    tracks : sequence of int
        Numbers of muons on the sheet.
    n : int
        Events with each number.
    seed : int
    layer : int
        Index of the CGEM layer; its first sheet counts.
    p : float
        GeV/c.
    cos_theta : float
        Muons have |cos(theta)| up to this, uniformly, and any azimuth on the sheet.
    threads : int or None
    """
    one = detector.cgem[layer]
    width = one.strips_x * one.pitch_x / one.r_readout
    edge = 0.0 if one.sheets == 1 else 0.15  # rad: muons turn on their way
    phi = (0.0, 2 * math.pi) if one.sheets == 1 else (one.phi_first + edge, one.phi_first + width - edge)
    gun = Gun("mu-", p=p, cos_theta=(-cos_theta, cos_theta), phi=phi)
    numbers = calibration_of(detector, readout).pairs[layer]
    points = []
    for number in tracks:
        result = run(
            detector, reduce(add, [gun] * number), n, seed, readout=readout, until="cluster", threads=threads,
            keep=["clusters", "truths"],
        )  # fmt: skip
        points.append(_point(result.clusters, numbers, layer, number, seed))
    title = f"{readout.name}, layer {one.label} of {detector.name}, mu- of {p:g} GeV/c, {n} events each"
    return GhostScan(title, tuple(points))


def pair_scores(numbers: Floats, clusters: Table, x: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Return the logarithms of likelihood ratios of pairs of clusters from charge and from time.

    The column ``score`` is ln(0.9 exp(sum of both) + 0.1), which has the same order.

    Parameters
    ----------
    numbers : (PAIR,) float64
        Of the layer, see `Calibration.pairs`.
    clusters : Table
    x, v : (n,) int
        Rows of X and V clusters.
    """
    charge = np.log(np.maximum(clusters["charge"][x], 1e-3) / np.maximum(clusters["charge"][v], 1e-3))
    late = clusters["time"][x] - clusters["time"][v]
    return _log_ratio(charge, *numbers[[0, 1, 4]]), _log_ratio(late, *numbers[[2, 3, 5]])


def _log_ratio(value: Floats, mean: float, width: float, apart: float) -> Floats:
    near, far = (value - mean) / width, value / apart
    return np.asarray(0.5 * (far**2 - near**2) + math.log(apart / width))


def _with_touched(ratio: Floats) -> Floats:
    return np.logaddexp(math.log1p(-_TOUCHED) + ratio, math.log(_TOUCHED))


def _point(clusters: Table, numbers: Floats, layer: int, tracks: int, seed: int) -> GhostPoint:
    """Return what the best assignment of all clusters of a sheet gets wrong."""
    random = np.random.default_rng(seed)
    pairs = np.flatnonzero((clusters["view"] == 2) & (clusters["layer"] == layer) & (clusters["sheet"] == 0))
    x, v = clusters["x_cluster"][pairs], clusters["v_cluster"][pairs]
    by_charge, by_time = pair_scores(numbers, clusters, x, v)
    scores = {
        "geometry": np.zeros(len(pairs)), "charge": _with_touched(by_charge),
        "charge and time": _with_touched(by_charge + by_time),
    }  # fmt: skip
    # Equal scores are decided by lot.
    scores = {way: values + 1e-9 * random.uniform(size=len(pairs)) for way, values in scores.items()}
    same = (clusters["truth"][x] == clusters["truth"][v]) & (clusters["truth"][x] >= 0)
    wrong = dict.fromkeys(WAYS, 0)
    assigned = dict.fromkeys(WAYS, 0)
    event = clusters["event"][pairs]
    for first, last in zip(
        *(np.searchsorted(event, np.unique(event), side=side) for side in ("left", "right")), strict=True
    ):
        here = slice(first, last)
        rows, row = np.unique(x[here], return_inverse=True)
        columns, column = np.unique(v[here], return_inverse=True)
        for way in WAYS:
            gain = np.full((len(rows), len(columns)), -_APART)
            gain[row, column] = scores[way][here]
            is_same = np.zeros(gain.shape, np.bool_)
            is_same[row, column] = same[here]
            best = linear_sum_assignment(gain, maximize=True)
            real = gain[best] > -0.5 * _APART
            wrong[way] += int(np.count_nonzero(real & ~is_same[best]))
            assigned[way] += int(np.count_nonzero(real))
    shares = {way: wrong[way] / max(assigned[way], 1) for way in WAYS}
    errors = {way: math.sqrt(shares[way] * (1 - shares[way]) / max(assigned[way], 1)) for way in WAYS}
    crossings = len(pairs) / max(tracks * len(clusters.events), 1)
    return GhostPoint(tracks, crossings, {way: (shares[way], errors[way]) for way in WAYS})
