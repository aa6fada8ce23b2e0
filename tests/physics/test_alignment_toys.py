"""Displaced detectors that are aligned: errors of the constants with all correlations (docs/methods/alignment.md)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from pages.toys import CASES, toys

TOYS = 4


@pytest.mark.slow
@pytest.mark.parametrize("readout", ["gaussian", "binary"])
def test_constants_have_their_errors(readout: str) -> None:
    """Chi-square of 18 constants of four toys, tracks found by `ckf`; normal equations without scattering fail."""
    case = next(one for one in CASES if one.readout == readout and one.finder == "ckf")
    found = list(toys(case, range(100, 100 + TOYS)))
    assert all(toy.converged and toy.iterations <= 5 for toy in found)
    assert 5e-5 < chi2.sf(sum(toy.chi2 for toy in found), TOYS * len(found[0].pull)) < 1 - 5e-5
    squares, without = (np.mean([getattr(toy, name) ** 2 for toy in found]) for name in ("pull", "without"))
    assert without > 1.2 * squares
