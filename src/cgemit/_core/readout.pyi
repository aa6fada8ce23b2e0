# What digitizing and clustering both know.

import numpy.typing as npt

from cgemit._core._arrays import _Array, _Columns

def strip_delays(
    *,
    chip: _Columns,
    view: dict[str, float],
    way: npt.ArrayLike,
    induced: tuple[npt.ArrayLike, int],
    tracks: _Columns,
    slopes: npt.ArrayLike,
    charges: npt.ArrayLike,
) -> _Array: ...
