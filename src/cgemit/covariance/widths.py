"""Core resolutions of many detectors at the same points, together: calls of numpy take longer than their work."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from cgemit.covariance.asked import Sample
from cgemit.covariance.mixture import core_width, status_of
from cgemit.covariance.tracks import variances

Floats = npt.NDArray[np.float64]

#: Tracks whose covariances are in memory at once, more than the points of a detector have.
_MOST_TRACKS = 100_000


@dataclass(frozen=True, eq=False)
class Entries:
    """Covariances at the origin of the tracks of a sample in one detector.

    Attributes
    ----------
    sample : Sample
    covariance : ndarray, (tracks, 15) float64
        The upper triangle, NaN without a covariance.
    status : ndarray, (tracks,) int8
        `FitStatus`.
    """

    sample: Sample
    covariance: Floats
    status: npt.NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class Widths:
    """Resolutions of one detector, as of `Covariance`; arrays have one axis, the points in order.

    Attributes
    ----------
    sigma : mapping of str to ndarray, float64
        Core resolution of each quantity, native units.
    status : ndarray, int8
    reached : ndarray, float64
    """

    sigma: Mapping[str, Floats]
    status: npt.NDArray[np.int8]
    reached: Floats


def core_widths(found: Sequence[Entries], quantities: Sequence[str]) -> list[Widths]:
    """Return the core resolutions of each of some detectors.

    Parameters
    ----------
    found : sequence of Entries
        Neighbours with the same sample are computed together.
    quantities : sequence of str
        As of `Covariance.sigma`.
    """
    return [
        width
        for _, group in groupby(found, key=lambda one: id(one.sample))
        for part in _parts(list(group))
        for width in _together(part, quantities)
    ]


def _parts(found: Sequence[Entries]) -> Iterator[Sequence[Entries]]:
    step = max(1, _MOST_TRACKS // len(found[0].status))
    return (found[i : i + step] for i in range(0, len(found), step))


def _together(found: Sequence[Entries], quantities: Sequence[str]) -> Iterator[Widths]:
    sample, count = found[0].sample, len(found)
    number = sample.kappa.size // sample.p.size
    covariance = np.stack([one.covariance for one in found])
    every = np.array([variances(covariance, sample.kappa, sample.tanl, name) for name in quantities])
    sigma = core_width(every.reshape(-1, number)).reshape(len(quantities), count, -1)
    status, reached = status_of(np.stack([one.status for one in found]).reshape(-1, number))
    for i in range(count):
        points = slice(i * sample.p.size, (i + 1) * sample.p.size)
        yield Widths(dict(zip(quantities, sigma[:, i], strict=True)), status[points], reached[points])
