# Resolutions without events.
from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from cgemit._core.detector import Detector

def same_surfaces(detector: Detector, other: Detector) -> bool: ...
def covariances(
    detector: Detector,
    *,
    phi: npt.ArrayLike,
    kappa: npt.ArrayLike,
    tanl: npt.ArrayLike,
    mass: npt.ArrayLike,
    charge: npt.ArrayLike = ...,
    scatters: npt.ArrayLike,
    samples: int,
    phases: npt.ArrayLike,
    efficiencies: npt.ArrayLike = ...,
    model: dict[str, Any],
    budget: bool,
    hits: bool = False,
    variants: Sequence[Detector] = [],
    scalar: bool = False,  # with the scalar kernels, whichever are in use
    dr: npt.ArrayLike = ...,  # mm; none: from the origin
    dz: npt.ArrayLike = ...,
) -> dict[str, Any]: ...
