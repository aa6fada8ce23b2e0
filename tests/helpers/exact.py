"""The mode in which simulation and readout do exactly what the fit assumes, and what must hold there."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, kstest

from cgemit.chain.settings import Settings
from cgemit.reconstruction.fit import PARAMETERS
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table
from stats import assert_within


def exact(**stages: Any) -> dict[str, Any]:
    """Return settings and readout of a run in that mode, with other settings of some stages."""
    settings = Settings(
        simulate=SimulateSettings(fluctuations="gaussian", decays=False), digitize=DigitizeSettings(reveal_sides=True)
    )
    return {"settings": replace(settings, **stages), "readout": "gaussian"}


def assert_no_bias(pull: npt.NDArray[np.float64], what: str) -> None:
    """Fail unless the mean is that of a standard normal sample."""
    assert_within(pull.mean(), 0, 1 / np.sqrt(len(pull)), what=f"mean pull of {what}")


def assert_standard_normal(pull: npt.NDArray[np.float64], what: str) -> None:
    """Fail unless mean and width are those of a standard normal sample."""
    assert_no_bias(pull, what)
    assert_within(pull.std(), 1, 1 / np.sqrt(2 * len(pull)), what=f"width of the pull of {what}")


def assert_pulls_are_standard_normal(tracks: Table) -> None:
    """Fail unless all tracks are fitted and the pulls of the five parameters have mean 0 and width 1."""
    assert not tracks["status"].any()
    for name in PARAMETERS:
        assert_standard_normal(tracks[f"pull_{name}"], name)


def assert_probability_is_flat(tracks: Table) -> None:
    """Fail unless the probability of chi-square is uniform (Kolmogorov-Smirnov, 1 in 16 000)."""
    assert kstest(chi2.sf(tracks["chi2"], tracks["ndf"]), "uniform").pvalue > 1 / 16_000
