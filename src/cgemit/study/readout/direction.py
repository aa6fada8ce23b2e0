"""What the direction of a track does to the positions of its clusters (docs/methods/readout.md)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.detector.strips import local_v
from cgemit.digitize.calibration import PATH_KNOTS, SLOPE_KNOTS, Calibration
from cgemit.study.readout.measure import FEWEST, Measurements, crossing_paths, lorentz_slopes
from cgemit.tables import Table

Floats = npt.NDArray[np.float64]

_ROUNDS = 5  # of outlier removal
_MEDIAN = 0.6745  # of the distance of a Gaussian variable from its mean, in its sigmas
_CORE = 2.0  # widths, within which residuals count
_USUAL = 0.5  # mm, of depths; keeps those that nothing tells near zero


def known_directions(
    detector: Detector, truths: Table, sample: Measurements, *, of_track: bool, lorentz: bool
) -> tuple[Floats, Floats]:
    """Return slope at the anode and path per radius as the clusters know them, (n,) float64 each.

    Parameters
    ----------
    detector : Detector
    truths : Table
    sample : Measurements
    of_track : bool
        Whether the track is known, else it is a straight one from the beam line.
    lorentz : bool
        Whether electrons drift at the Lorentz angle.
    """
    if of_track:
        return sample.slope, crossing_paths(truths)[sample.truth]
    slope = np.zeros(len(sample.residual))
    rise = truths["z"][sample.truth] / np.array([one.r_mid for one in detector.cgem])[sample.layer]
    for number, one in enumerate(detector.cgem):
        here = (sample.view == 1) & (sample.layer == number)
        slope[here] = local_v(one, np.zeros(np.count_nonzero(here)), one.z_ref + rise[here])
    return slope - lorentz_slopes(detector, lorentz)[sample.layer, sample.view], np.hypot(1, rise)


def set_depths(
    found: Calibration, of_track: bool, which: int, sample: Measurements, direction: tuple[Floats, Floats]
) -> None:
    """Set the depths of one estimator.

    Parameters
    ----------
    found : Calibration
        Changed; had no depths for the estimator when the clusters of the sample were made.
    of_track : bool
    which : int
        In `ESTIMATORS`.
    sample : Measurements
    direction : (ndarray, ndarray)
        See `known_directions`.
    """
    for view, layer in np.ndindex(found.depth.shape[:2]):
        mine = (sample.view == view) & (sample.layer == layer)
        if np.count_nonzero(mine) >= FEWEST:
            depths = _depths(sample.residual[mine], direction[0][mine], direction[1][mine])
            found.direction_depths[int(of_track), which, view, layer] = depths


def _depths(residual: Floats, slope: Floats, path: Floats) -> Floats:
    """Return the depths at all knots, mm, that times the slope give the residuals."""
    terms = np.hstack([_shares(np.abs(slope), SLOPE_KNOTS), _shares(path, PATH_KNOTS)]) * slope[:, None]
    depths: Floats = np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        left = residual - terms @ depths
        width = float(np.median(np.abs(left))) / _MEDIAN
        use = np.abs(left) < _CORE * width
        weight = (width / _USUAL) ** 2 * np.eye(len(depths))
        depths = np.asarray(np.linalg.solve(terms[use].T @ terms[use] + weight, terms[use].T @ residual[use]))
    return depths


def _shares(values: Floats, knots: Floats) -> Floats:
    """Return the shares of the knots in values between them, (n, knots) float64."""
    return np.column_stack([np.interp(values, knots, one) for one in np.eye(len(knots))])
