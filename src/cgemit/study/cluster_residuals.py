"""Residuals of X and V clusters against the true crossing, on the unrolled anode; Geant4's X residual.

Delta electrons make the RMS of the X residual depend on its window.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from cgemit import find
from cgemit.result import Result
from cgemit.statistics.curves import Spectrum, histograms
from cgemit.statistics.estimate import GaussianFit, Resolution, gaussian_fit, measure, share_error
from cgemit.statistics.formatting import with_error

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

#: Half-widths of the windows by what result ids call them, mm.
X_WINDOWS: Mapping[str, float] = MappingProxyType({"1mm": 1.0, "2mm": 2.0, "3mm": 3.0, "5mm": 5.0, "all": math.inf})

#: Half-width of the window of `x_residual_rms`, mm; docs/paper.md says why.
X_WINDOW = 3.0

#: Strips of the paper, um. A whole crossing moves the centre of its V strips by less than half of it.
PITCH = 650.0


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
        Clusters left out since the crossing has one that is nearer to it: those of delta electrons away from the
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
    """Return the residuals of the clusters that the fit gets (`cgemit.find.own_clusters`).

    Parameters
    ----------
    result : Result

    Returns
    -------
    ClusterResiduals
        Empty arrays for a detector without CGEM layers.
    """
    clusters, truths, detector = result.clusters, result.truths, result.detector
    own = find.own_clusters(detector, clusters, truths)
    residual, size, view = find.residuals(detector, clusters, truths, own), clusters["size"][own], clusters["view"][own]
    in_view = clusters["view"] < 2
    without_truth = int(np.count_nonzero(in_view & (clusters["truth"] < 0)))
    return ClusterResiduals(
        residual[view == 0],
        size[view == 0],
        residual[view == 1],
        size[view == 1],
        without_truth,
        int(np.count_nonzero(in_view)) - without_truth - len(own),
    )


@dataclass(frozen=True)
class Geant4Run:
    """X residual of the same sample in Geant4 (`data/geant4_x_residual.toml`).

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
    text = resources.files("cgemit.data").joinpath("geant4_x_residual.toml").read_text(encoding="utf-8")
    return tuple(Geant4Run(**run | {"rms": tuple(run["rms"])}) for run in tomllib.loads(text)["run"])


def x_widths(residuals: ClusterResiduals, window: float = X_WINDOW) -> Resolution:
    """Return the widths of the X residual in um, with the RMS within plus and minus `window` (mm)."""
    reach = 1e3 * window
    return measure(1e3 * residuals.x, parameter="X", unit="um", window=(-reach, reach))


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
    values = 1e3 * residuals.x
    single = residuals.x_size == 1
    share, error = residuals.single_strip_fraction
    edges = np.linspace(-reach, reach, bins + 1)
    parts = {"all": values, "single strip": values[single], "several strips": values[~single]}
    extra = (f"one strip: {with_error(100 * share, 100 * error)} %",)
    return Spectrum(
        "X residual, R (φ − true φ)", "um", edges, histograms(parts, edges), x_widths(residuals), None,
        f"{X_WINDOW:g} mm", extra,
    )  # fmt: skip


def v_fit(residuals: ClusterResiduals) -> GaussianFit:
    """Fit a Gaussian to the V residuals within one pitch, in um."""
    values = 1e3 * residuals.v
    return gaussian_fit(values[np.abs(values) < PITCH])


def v_spectrum(residuals: ClusterResiduals) -> Spectrum:
    """Return the histogram of the V residuals with a Gaussian fitted to those within one pitch, in um."""
    values = 1e3 * residuals.v
    edges = np.linspace(-500, 500, 101)
    widths = measure(values, parameter="V", unit="um", window=(-PITCH, PITCH))
    return Spectrum(
        "V residual", "um", edges, histograms({"all": values}, edges), widths, v_fit(residuals), f"{PITCH:g} µm"
    )
