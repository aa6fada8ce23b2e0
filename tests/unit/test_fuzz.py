"""Nothing that the fit is given makes it raise, warn or return a number that is none; `tests/fuzz.py` says how."""

import numpy as np
import pytest

import fuzz
from cgemit import isa
from cgemit.reconstruction.fit import FitStatus


def test_twenty_thousand_tracks_and_garbage():
    """Half of them tracks with all kinds of damage, half nonsense."""
    counts, found = fuzz.fuzz(20_000, seed=3)
    assert not found
    assert sum(counts.values()) == 20_000
    assert {status for _, status in counts} >= {status.name for status in FitStatus} - {"left_field"}


@pytest.mark.parametrize("name", [name for name in isa.available() if name != isa.available()[-1]])
def test_with_every_instruction_set(name):
    """The same for the kernels that are not in use by default."""
    before = isa.name()
    isa.use(name)
    try:
        assert not fuzz.fuzz(2_000, seed=4)[1]
    finally:
        isa.use(before)


def test_a_wrong_number_is_seen():
    """The check itself: a covariance or residual that is no number, or not positive, is listed."""
    random = np.random.default_rng(1)
    tables = fuzz.run(fuzz.tracks(200, random), fuzz.FitSettings(residuals=True))
    assert not fuzz.problems(tables)
    good = np.flatnonzero(tables["tracks"]["status"] == FitStatus.ok)[0]
    for value in (np.nan, -1.0):
        cov = tables["tracks"]["cov"].copy()
        cov[good, 2, 2] = value
        assert fuzz.problems(tables | {"tracks": tables["tracks"].with_columns(cov=cov)})
    kappa = tables["tracks"]["kappa"].copy()
    kappa[good] = np.inf
    assert fuzz.problems(tables | {"tracks": tables["tracks"].with_columns(kappa=kappa)})
    pull = tables["residuals"]["pull"].copy()
    pull[0] = np.nan
    assert fuzz.problems(tables | {"residuals": tables["residuals"].with_columns(pull=pull)})
