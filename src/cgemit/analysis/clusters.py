"""Residuals of clusters against true crossings, and displacements by delta electrons.

Residuals are taken on the unrolled anode. Delta electrons make the RMS of the X residual depend on its window. The X
residual of Geant4 stands beside it.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import Any

import numpy as np

from cgemit import helix
from cgemit.analysis.curves import Spectrum, histograms
from cgemit.analysis.quantities import V, X
from cgemit.analysis.widths import GaussianFit, Resolution, gaussian_fit, measure, share_error
from cgemit.base.arrays import Floats, Ints
from cgemit.chain.result import Result
from cgemit.tables import Table
from cgemit.tables.check import refuse_wrong
from cgemit.tables.show import Comparable, Shown, Tabular, with_error
from cgemit.truth import assign

#: Half-widths of the windows by what result ids call them, mm.
X_WINDOWS: Mapping[str, float] = MappingProxyType({"1mm": 1.0, "2mm": 2.0, "3mm": 3.0, "5mm": 5.0, "all": math.inf})

#: Half-width of the window of `x_residual_rms`, mm; docs/paper.md says why.
X_WINDOW = 3.0

#: Strips of the paper, um. A whole crossing moves the centre of its V strips by less than half of it.
PITCH = 650.0
#: Distances of delta electrons from their track, mm.
DISTANCES = (0.2, 0.5, 1.0, 2.0, 5.0)

_HEAD = ("beyond [mm]", "in r-phi [%]", "in z [%]")


@dataclass(frozen=True)
class ClusterResiduals:
    """Measured minus true position of the cluster of each crossing and view, and the number of its strips.

    Attributes
    ----------
    x : (n,) float64, mm
        R_readout times the difference in azimuth at mid-gap.
    x_size : (n,) int32
    v : (m,) float64, mm
        V of the cluster minus V of the crossing's phi and z at mid-gap.
    v_size : (m,) int32
    without_truth : int
        Clusters left out since no true crossing belongs to them.
    beside : int
        Clusters left out since the crossing has a nearer one: clusters of delta electrons away from the
        track, and those on the other side of a seam.
    """

    x: Floats
    x_size: Ints
    v: Floats
    v_size: Ints
    without_truth: int
    beside: int

    @property
    def single_strip_fraction(self) -> tuple[float, float]:
        """Fraction of X clusters with one strip, and its binomial error."""
        n = len(self.x_size)
        share = float(np.mean(self.x_size == 1)) if n else float("nan")
        return share, float(np.sqrt(share * (1 - share) / n)) if n else float("nan")


def cluster_residuals(result: Result) -> ClusterResiduals:
    """Return the residuals of the clusters that the fit gets (`cgemit.truth.assign.own_clusters`).

    Returns
    -------
    ClusterResiduals
        Empty arrays for a detector without CGEM layers.
    """
    clusters, truths, detector = result.fitted_clusters, result.truths, result.detector
    rows = assign.own_clusters(detector, clusters, truths)
    residual, size, view = (
        assign.residuals(detector, clusters, truths, rows),
        clusters["size"][rows],
        clusters["view"][rows],
    )
    in_view = clusters["view"] < 2
    without_truth = int(np.count_nonzero(in_view & (clusters["truth"] < 0)))
    return ClusterResiduals(
        residual[view == 0],
        size[view == 0],
        residual[view == 1],
        size[view == 1],
        without_truth,
        int(np.count_nonzero(in_view)) - without_truth - len(rows),
    )


@dataclass(frozen=True)
class Geant4Run:
    """X residual of the same sample in Geant4 (`geant4_x_residual.toml`).

    Attributes
    ----------
    title : str
    rms : tuple of str
        In um, in the order of `X_WINDOWS`.
    beyond_3mm, single_strip : str
        Fraction of residuals beyond 3 mm, and of clusters of one strip.
    """

    title: str
    rms: tuple[str, ...]
    beyond_3mm: str
    single_strip: str


@cache
def geant4_runs() -> tuple[Geant4Run, ...]:
    """Return the runs on file."""
    text = resources.files("cgemit.analysis").joinpath("geant4_x_residual.toml").read_text(encoding="utf-8")
    return tuple(Geant4Run(**run | {"rms": tuple(run["rms"])}) for run in tomllib.loads(text)["run"])


def x_widths(residuals: ClusterResiduals, window: float = X_WINDOW) -> Resolution:
    """Return the widths of the X residual in um, with the RMS within plus and minus `window` (mm)."""
    reach = X.factor * window
    return measure(X.factor * residuals.x, parameter=X.name, unit=X.unit, window=(-reach, reach))


def x_beyond(residuals: ClusterResiduals, window: float = X_WINDOW) -> tuple[float, float]:
    """Return the fraction of the X residuals beyond plus or minus `window` (mm), and its error."""
    n = len(residuals.x)
    share = float(np.mean(np.abs(residuals.x) > window)) if n else math.nan
    return share, share_error(share, n)


def x_spectrum(residuals: ClusterResiduals, reach: float = 500.0, bins: int = 100) -> Spectrum:
    """Return the histogram of the X residuals with its parts from one and from several strips, in um.

    Parameters
    ----------
    residuals : ClusterResiduals
    reach : float
        Range to each side, um.
    bins : int
    """
    values = X.factor * residuals.x
    single = residuals.x_size == 1
    share, error = residuals.single_strip_fraction
    edges = np.linspace(-reach, reach, bins + 1)
    parts = {"all": values, "single strip": values[single], "several strips": values[~single]}
    extra = (f"one strip: {with_error(100 * share, 100 * error)} %",)
    return Spectrum(
        "X residual, R (φ − true φ)", X.unit, edges, histograms(parts, edges), x_widths(residuals), None,
        f"{X_WINDOW:g} mm", extra, gaussian=False,
    )  # fmt: skip


def v_fit(residuals: ClusterResiduals) -> GaussianFit:
    """Fit a Gaussian to the V residuals within one pitch, in um."""
    values = V.factor * residuals.v
    return gaussian_fit(values[np.abs(values) < PITCH])


def v_spectrum(residuals: ClusterResiduals) -> Spectrum:
    """Return the histogram of the V residuals with a Gaussian fitted to those within one pitch, in um."""
    values = V.factor * residuals.v
    edges = np.linspace(-500, 500, 101)
    widths = measure(values, parameter=V.name, unit=V.unit, window=(-PITCH, PITCH))
    return Spectrum(
        "V residual", V.unit, edges, histograms({"all": values}, edges), widths, v_fit(residuals), f"{PITCH:g} µm"
    )


@dataclass(frozen=True, eq=False, repr=False)
class DeltaFractions(Shown, Comparable, Tabular):
    """Fractions of the crossings of a drift gap with a delta electron's deposit beyond some distances from the track.

    Attributes
    ----------
    beyond : tuple of float, mm
    crossings : int
        Number of crossings, with and without delta electrons.
    rphi, rphi_error : tuple of float
        Fractions by distance along the circumference, and their binomial errors (half of Wilson's interval).
    z, z_error : tuple of float
        The same along the beam.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=200)
    >>> found = cg.study.delta_fractions(result, beyond=[1.0])
    >>> found.crossings, round(found.rphi[0], 2)
    (600, 0.01)
    """

    beyond: tuple[float, ...]
    crossings: int
    rphi: tuple[float, ...]
    rphi_error: tuple[float, ...]
    z: tuple[float, ...]
    z_error: tuple[float, ...]

    def columns(self) -> dict[str, list[Any]]:
        """Return the fractions as columns, one row for each distance."""
        names = ("beyond", "rphi", "rphi_error", "z", "z_error")
        crossings = {"crossings": [self.crossings] * len(self.beyond)}
        return {name: list(getattr(self, name)) for name in names} | crossings

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        pairs = zip(self.rphi, self.rphi_error, self.z, self.z_error, strict=True)
        cells = [[with_error(100 * v, 100 * e), with_error(100 * w, 100 * f)] for v, e, w, f in pairs]
        rows = [[f"{distance:g}", *row] for distance, row in zip(self.beyond, cells, strict=True)]
        return f"delta electrons away from their track, {self.crossings:,} crossings", _HEAD, rows


def delta_fractions(result: Result, beyond: Sequence[float] = DISTANCES) -> DeltaFractions:
    """Return how many crossings have a delta electron's deposit beyond some distances from the track.

    Parameters
    ----------
    result : Result
    beyond : sequence of float
        Distances, mm.

    Returns
    -------
    DeltaFractions
        NaN without any crossing.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=200)
    >>> print(cg.study.delta_fractions(result, beyond=[0.5, 2.0]))
    delta electrons away from their track, 600 crossings
    beyond [mm]  in r-phi [%]     in z [%]
            0.5   1.83 ± 0.55  2.00 ± 0.58
              2   1.17 ± 0.45  1.00 ± 0.41
    """
    rphi, z = delta_displacements(result.truths, result.steps)
    n = len(rphi)

    def shares(displacement: Floats) -> tuple[tuple[float, ...], tuple[float, ...]]:
        values = [float(np.mean(displacement > distance)) if n else float("nan") for distance in beyond]
        return tuple(values), tuple(share_error(value, n) for value in values)

    return DeltaFractions(tuple(beyond), n, *shares(rphi), *shares(z))


def delta_displacements(truths: Table, steps: Table) -> tuple[Floats, Floats]:
    """Return the largest distance of a delta electron's deposit from the track, for each crossing.

    The track is the line between entry and exit, taken at the deposit's radius; both ends of each step count.

    Parameters
    ----------
    truths, steps : Table
        Links of `steps` count rows of `truths`.

    Returns
    -------
    rphi, z : ndarray, (n,) float64, mm
        Along the circumference and along the beam, without sign; 0 where there is no delta electron.

    Raises
    ------
    ValueError
        If a table has wrong values or links.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=200)
    >>> across, along = cg.study.delta_displacements(result.truths, result.steps)
    >>> len(across) == len(result.truths), bool((across >= 0).all())
    (True, True)
    """
    refuse_wrong("delta_displacements", truths=truths, steps=steps)
    largest = np.zeros((2, len(truths)))
    rows = np.flatnonzero(steps["parent"] != 0)
    link = steps["truth"][rows]
    entry, exit_ = (_cylindrical(*(truths[f"{end}_{axis}"][link] for axis in "xyz")) for end in ("entry", "exit"))
    for side in (-0.5, 0.5):
        r, phi, z = _cylindrical(*(steps[axis][rows] + side * steps[f"d{axis}"][rows] for axis in "xyz"))
        share = (r - entry[0]) / (exit_[0] - entry[0])
        beside = r * helix.wrap_angle(phi - entry[1] - share * helix.wrap_angle(exit_[1] - entry[1]))
        along = z - entry[2] - share * (exit_[2] - entry[2])
        for values, distance in zip(largest, (beside, along), strict=True):
            np.maximum.at(values, link, np.abs(distance))
    return largest[0], largest[1]


def _cylindrical(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Floats, Floats]:
    return np.hypot(x, y), np.arctan2(y, x), z
