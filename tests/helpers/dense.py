"""Tracks whose measurements and noise are known as dense matrices, from the reference trajectory of the fit."""

from functools import cache

import numpy as np

from cgemit import _core
from cgemit.detector import load
from cgemit.fit_matter import tuned
from cgemit.reconstruction.fit import FitSettings
from tracks import MUON, hits_of, on_helix, order_of_matter, transport

PRIOR = np.array(FitSettings().prior_sigma)
#: Of momenta, for all tracks: rows are derivatives for a given error, which would otherwise follow the track.
ERROR = 0.004
# dr mm, phi0, kappa (GeV/c)^-1, dz mm, tanl
HELICES = {
    "1 GeV/c": (0.1, 0.7, -1.0, 3.0, 0.1),
    "0.3 GeV/c": (-0.4, -2.0, 1 / 0.3, -6.0, 0.6),
    "0.18 GeV/c": (0.2, 2.9, -1 / 0.18, 10.0, -0.3),
    "displaced": (20.0, 1.5, 1 / 0.8, 15.0, 0.3),
}


@cache
def smeared_track(name, which, seed=3):
    """Return detector, core, true helix and smeared hits of a scattered track."""
    detector = load(name)
    core, helix = tuned(detector, momentum_error=ERROR), np.array(HELICES[which])
    hits = hits_of(detector, transport(core, on_helix(helix), "gaussian", seed))
    rng = np.random.default_rng(seed)
    noise = hits["sigma"] * rng.normal(size=len(hits["kind"]))
    hits["value"] = hits["value"] + np.where(hits["side"] < 0, -noise, noise)
    return detector, core, helix, hits


def linear_model(detector, core, helix, hits, prior=PRIOR):
    """Return residuals, rows and covariance of all measurements on a reference, the prior's five included.

    A noise vector changes what a measurement beyond it sees by row . vector, so two measurements share the noise of
    all matter inside both. The prior describes the track beyond all matter.
    """
    reference = _core._testing.reference(core, helix, MUON, hits)
    n = len(hits["kind"])
    assert reference["reached"] == n
    inside = order_of_matter(detector, hits, len(reference["noise"]))
    seen = reference["rows"] @ reference["noise"].T
    seen[np.arange(len(reference["noise"])) >= inside[:, None]] = 0
    seen = np.concatenate([seen, reference["noise"].T])
    covariance = seen @ seen.T + np.diag(np.concatenate([hits["sigma"] ** 2, prior**2]))
    measured = np.where(hits["kind"] == 2, hits["value"] * hits["side"], hits["value"])
    residual = np.concatenate([measured - reference["predicted"], np.zeros(5)])
    return residual, np.concatenate([reference["rows"], np.eye(5)]), covariance


def least_squares(residual, rows, covariance):
    """Return estimate, covariance and chi-square of generalised least squares."""
    factor = np.linalg.cholesky(covariance)
    white_rows, white = np.linalg.solve(factor, rows), np.linalg.solve(factor, residual)
    estimate = np.linalg.lstsq(white_rows, white, rcond=None)[0]
    inverse = np.linalg.inv(np.linalg.qr(white_rows)[1])
    return estimate, inverse @ inverse.T, float(np.sum((white - white_rows @ estimate) ** 2))
