"""Halves of cosmic muons as one track and as two."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_law

import cgemit as cg
from stats import assert_within

RESULT = cg.run("besiii-cgem-design", cg.sample("cosmic"), 1200, seed=2)


def test_the_difference_of_the_halves_is_the_resolution() -> None:
    """Difference over sqrt(2) has the width of the true residuals, without truth."""
    found = cg.study.cosmics(RESULT)
    assert found.events > 1100
    assert found.truth is not None
    for name, width in found.halves.items():
        error = np.hypot(width.core_error, found.truth[name].core_error)
        assert_within(width.core, found.truth[name].core, error, what=name)
        assert_within(found.pulls[name].core, 1, 0.035, what=name)


def test_one_track_is_better_than_two_by_more_than_their_number() -> None:
    """Hits on both sides of the origin interpolate: impact parameters gain more than sqrt(2)."""
    found = cg.study.cosmics(RESULT)
    assert found.truth is not None
    assert found.one_track is not None
    for name, gain in (("dr", 2.0), ("dz", 2.0), ("phi0", 2.0), ("kappa", 1.35)):
        assert found.one_track[name].core * gain < found.truth[name].core
    errors = np.sqrt(np.diagonal(found.cov, axis1=1, axis2=2))
    assert np.all(errors > 0)
    # The information of two measurements adds up.
    upward = np.cos(RESULT.fitted["phi0"]) > 0
    pairs = [RESULT.fitted["cov"][(RESULT.fitted["event"] == event)] for event in range(3)]
    assert [len(pair) for pair in pairs] == [2, 2, 2]
    signs = np.array([-1, 1, -1, 1, -1])  # of dr, phi0, kappa, dz, tanl of the same helix flown backward
    for pair, up, cov in zip(pairs, upward.reshape(-1)[: 2 * 3].reshape(3, 2), found.cov, strict=False):
        turned = [one * np.outer(signs, signs) if back else one for one, back in zip(pair, up, strict=True)]
        information = sum(np.linalg.inv(one) for one in turned)
        np.testing.assert_allclose(cov @ information, np.eye(5), atol=1e-6)
    assert_within(np.median(found.chi2), chi2_law.median(5), 3 / np.sqrt(found.events))


def test_a_measured_table_needs_no_truth() -> None:
    found = cg.study.cosmics(RESULT.fitted)
    assert found.truth is None
    assert found.one_track is None
    assert found.halves == cg.study.cosmics(RESULT).halves
    assert "true residual" not in repr(found)
    assert "true residual" in cg.study.cosmics(RESULT)._repr_html_()
    assert list(found.to_pandas()["parameter"]) == ["dr", "phi0", "kappa", "dz", "tanl", "p"]


def test_a_wrong_sign_is_seen() -> None:
    """With the wrong sign of dz of one half the difference is far from the truth."""
    upward = np.cos(RESULT.fitted["phi0"]) > 0
    wrong = RESULT.tracks.with_columns(dz=np.where(upward, -1, 1) * RESULT.tracks["dz"])
    assert cg.study.cosmics(wrong).halves["dz"].core > 10


def test_events_without_two_halves_are_refused() -> None:
    with pytest.raises(ValueError, match="got 0 events"):
        cg.study.cosmics(cg.run("besiii-cgem-design", cg.Gun("mu-", p=1, theta=1), 5))
    with pytest.raises(ValueError, match="got no table of tracks"):
        cg.study.cosmics(cg.run("besiii-cgem-design", cg.sample("cosmic"), 5, until="find"))
