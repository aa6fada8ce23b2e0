# Constants of the detector from tracks.
from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from cgemit._core.detector import Detector

# `normal` (n, n), `right` and `measured` (n,): sums over the tracks; and of each track `used`, `hits`, `chi2`,
# `helix` (5), `cov` (5, 5) and, if requested, `bias` (n, 5). Of single wires, with the first columns of blocks and the
# number of columns in `blocks`: the blocks by their numbers instead of `normal`, and `column_hits` (n,).
def sums(
    detector: Detector,
    *,
    columns: dict[str, Any],
    hit_offsets: npt.ArrayLike,
    hits: dict[str, Any],
    reference: npt.ArrayLike,
    kinks: npt.ArrayLike,
    mass: npt.ArrayLike,
    charge: npt.ArrayLike,
    matter_p: npt.ArrayLike,
    start_radius: npt.ArrayLike,
    prior_sigma: Sequence[float],
    bias: bool = False,
    scattering: bool = True,
    innovations: bool = False,
    blocks: Sequence[int] = [],
    scalar: bool = False,
) -> dict[str, Any]: ...
