# Helices and their covariances.
from typing import Final

import numpy.typing as npt

from cgemit._core._arrays import _Floats

STRAIGHT_FIELD: Final[float]  # T, below which tracks are fitted as straight lines

def change_pivot(
    helix: npt.ArrayLike, cov: npt.ArrayLike, step: npt.ArrayLike, bz: npt.ArrayLike
) -> tuple[_Floats, _Floats]: ...
