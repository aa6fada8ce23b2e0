"""Resolutions without events: the covariance of a track's helix, and its exact split by cause.

The compiled stage ``covariance/`` traces a track from the origin with the fit's own kernels, expects a hit wherever the
track crosses a read-out, and runs the filter (docs/methods/analytic.md).
"""

from cgemit.covariance.budget import Budget as Budget
from cgemit.covariance.derivatives import Sensitivity as Sensitivity
from cgemit.covariance.derivatives import sensitivity as sensitivity
from cgemit.covariance.points import analytic as analytic
from cgemit.covariance.result import Covariance as Covariance
from cgemit.covariance.tracks import QUANTITIES as QUANTITIES
