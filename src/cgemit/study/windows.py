"""The X residual within windows, and what Geant4 has there: delta electrons make the RMS depend on the window."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from cgemit.study.estimate import Resolution, measure, share_error

if TYPE_CHECKING:
    from cgemit.study.cluster_residuals import ClusterResiduals

#: Half-widths of the windows by what result ids call them, mm.
X_WINDOWS: Mapping[str, float] = MappingProxyType({"1mm": 1.0, "2mm": 2.0, "3mm": 3.0, "5mm": 5.0, "all": math.inf})

#: Half-width of the window of `x_residual_rms`, mm; docs/paper.md says why.
X_WINDOW = 3.0


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
