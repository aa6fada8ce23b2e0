"""docs/methods/fit.md: what kinks and the share of delta electrons do to pulls, and iterations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import cgemit as cg
from cgemit.analysis.clusters import PITCH, X_WINDOWS, geant4_runs
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables.schema import has_momentum
from pages.fit import EXACT, MIXED, WITHOUT_DECAYS
from pages.page import Found, Numbers, Page, share_of

DETECTOR, SEED = "besiii-cgem-design", 5
MUONS, PIONS = 100_000, 50_000


@dataclass(frozen=True)
class Deltas:
    """Pull of d_rho of mu- of 1 GeV/c: core, RMS; mean number of iterations."""

    delta_strips: float
    core: float
    core_error: float
    rms: float
    rms_error: float
    iterations: float


@dataclass(frozen=True)
class Kinks:
    """Mean residual of kappa over the root mean square of its errors, pi- of 0.1 GeV/c at 90 degrees."""

    kinks: bool
    bias: float
    bias_error: float
    iterations: float


def deltas(share: float) -> Numbers:
    """Fit the same muons with several probabilities of delta electrons in the errors of clusters."""
    n, rows, gun = share_of(MUONS, share, 1000), [], cg.Gun("mu-", p=1.0, cos_theta=MIXED)
    default = FitSettings().delta_strips
    for strips in (default, 0.0, default / 2, 2 * default):
        settings = replace(WITHOUT_DECAYS, fit=FitSettings(delta_strips=strips))
        tracks = cg.run(DETECTOR, gun, n, SEED, settings=settings, keep=("tracks",)).tracks
        pull, iterations = cg.study.pulls(tracks)["dr"], float(tracks["iterations"].mean())
        rows.append(Deltas(strips, pull.core, pull.core_error, pull.rms, pull.rms_error, iterations))
    return Numbers(rows, {"events": f"{n:,} mu-, seed {SEED}"})


def kinks(share: float) -> Numbers:
    """Fit the same pions, all Gaussian, about straight and about scattered paths."""
    n, rows, gun = share_of(PIONS, share, 1000), [], cg.Gun("pi-", p=0.1, cos_theta=0.0)
    for on in (False, True):
        settings = replace(EXACT, fit=FitSettings(kinks=on))
        tracks = cg.run(DETECTOR, gun, n, SEED, settings=settings, readout="gaussian", keep=("tracks",)).tracks
        tracks = tracks[has_momentum(tracks)]
        bias = float(np.mean(tracks["res_kappa"]) / np.sqrt(np.mean(tracks["err_kappa"] ** 2)))
        rows.append(Kinks(on, abs(bias), len(tracks) ** -0.5, float(tracks["iterations"].mean())))
    return Numbers(rows, {"events": f"{n:,} pi-, seed {SEED}"})


def shares_in_geant4() -> list[float]:
    """Return q from the RMS of Geant4's X residuals within each finite window, with its lowest range cut.

    k strips of probability q/k move the centre by k/2 pitches: up to K strips add q K (K + 1)/8 to the mean square.
    """
    rms = {run.title: run.rms for run in geant4_runs()}
    found = []
    for window, wide, narrow in zip(X_WINDOWS.values(), rms["range cut 1 um"], rms["no delta electrons"], strict=True):
        if np.isfinite(window):
            most = 2000 * window / PITCH
            found.append((float(wide) ** 2 - float(narrow) ** 2) / PITCH**2 * 8 / (most * (most + 1)))
    return found


def blocks(found: Found) -> dict[str, str]:
    """Return the numbers within the text."""
    given, none, half, twice = found["deltas"].rows
    straight, scattered = found["kinks"].rows
    windows = shares_in_geant4()
    return {
        "iterations": f"{given.iterations:.1f} times",
        "q-geant4": f"q = {', '.join(f'{q:.3f}' for q in windows[:-1])} and {windows[-1]:.3f}",
        "q": f"a core of {given.core:.2f} and an RMS of {given.rms:.2f}. With q = 0 these are {none.core:.2f} and "
        f"{none.rms:.2f}; with {half.delta_strips:g} and {twice.delta_strips:g} the cores are {half.core:.2f} and "
        f"{twice.core:.2f}",
        "kinks": f"from {straight.bias:.2f} to {scattered.bias:.2f} standard deviations",
        "more": f"{scattered.iterations - straight.iterations:.1f}",
    }


PAGE = Page("track_fit", "docs/methods/fit.md", "30 s", {"deltas": (Deltas, deltas), "kinks": (Kinks, kinks)}, blocks)
