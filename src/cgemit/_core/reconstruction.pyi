# Digis to tracks.
import enum
from typing import Any, Final

import numpy.typing as npt

from cgemit._core._arrays import _Array, _Columns, _Floats
from cgemit._core.detector import Detector

MOST_ERROR: Final[float]  # relative, of a momentum above which it is not measured; also over the prior's, along z

class Surface(enum.IntEnum):
    origin = 0
    beam_line = 1
    cylinder = 2
    hit = 3

def find_clusters(
    detector: Detector,
    digis: _Columns,
    *,
    err_x: npt.ArrayLike,
    err_v: npt.ArrayLike,
    by_charge: bool,
    masked: npt.ArrayLike = ...,
    bridge: int = 0,
) -> dict[str, _Array]: ...
def find_charge_time_clusters(
    detector: Detector,
    digis: _Columns,
    *,
    timing: _Columns,
    delays: _Columns,
    chip: dict[str, float],
    planes: _Columns,
    shares: _Columns,
    estimator: str,
    missing: int,
    edge: float,
    masked: npt.ArrayLike = ...,
    bridge: int = 0,
    gain: npt.ArrayLike = ...,
    valley: float = 0.0,
    margin: float,
    timed: bool = True,
    slopes: npt.ArrayLike = ...,
    paths: npt.ArrayLike = ...,
) -> dict[str, _Array]: ...
def charge_variances(
    *,
    chip: dict[str, float],
    planes: _Columns,
    shares: _Columns,
    estimator: str,
    of_track: bool,
    view: int,
    layer: int,
    slope: npt.ArrayLike,
    path: npt.ArrayLike,
    number: npt.ArrayLike,
) -> _Array: ...
def clusters_of_positions(detector: Detector, digis: _Columns, *, errors: _Columns) -> dict[str, _Array]: ...
def size_errors(extents: npt.ArrayLike, pitch: float, sizes: int) -> _Array: ...

# Number of the hit, its column, what it holds and what was expected.
def hit_problems(detector: Detector, hits: _Columns) -> tuple[list[tuple[int, str, str, str]], int]: ...

# Columns as in the tables; `clusters` may have cov_xv, mm2. What comes out are the fields of FitHits.
def collect_hits(
    detector: Detector, *, candidates: _Columns, candidate_hits: _Columns, clusters: _Columns, wire_hits: _Columns
) -> dict[str, _Array]: ...
def fit(
    detector: Detector,
    *,
    hit_offsets: npt.ArrayLike,
    hits: _Columns,
    mass: npt.ArrayLike,
    charge: npt.ArrayLike = ...,
    start: npt.ArrayLike,
    start_radius: npt.ArrayLike = ...,
    settings: dict[str, Any],
    residuals: bool,
    states: bool = False,
    densities: bool = False,
) -> dict[str, _Array]: ...
def circle_layers(detector: Detector, *, least_axial: int) -> int: ...
def segment_pairs(detector: Detector) -> list[tuple[int, int]]: ...
def view_layers(*, layers: int, least_axial: int) -> int: ...
def find_tracks(
    detector: Detector,
    *,
    event_offsets: npt.ArrayLike,
    hits: _Columns,
    settings: dict[str, Any],
    pairs: _Columns = {},
) -> dict[str, _Array]: ...

# States: pivot (n, 3) mm, helix (n, 5) dr phi0 kappa dz tanl with that pivot, cov (n, 25); `targets` has the columns
# surface, radius (mm) and share, which part of the slab that a cylinder cuts lies inside it. Columns come out as
# status, track, target, hit, pivot, helix, cov (n, 5, 5), residual, err.
def states(
    detector: Detector,
    *,
    hit_offsets: npt.ArrayLike,
    hits: _Columns,
    reference: npt.ArrayLike,
    kinks: npt.ArrayLike,
    prior: npt.ArrayLike,
    mass: npt.ArrayLike,
    charge: npt.ArrayLike = ...,
    matter_p: npt.ArrayLike = ...,
    start_radius: npt.ArrayLike = ...,
    fitted: npt.ArrayLike,
    targets: _Columns,
) -> dict[str, _Array]: ...
def extrapolate(
    detector: Detector,
    *,
    pivot: npt.ArrayLike,
    helix: npt.ArrayLike,
    cov: npt.ArrayLike,
    mass: npt.ArrayLike,
    charge: npt.ArrayLike = ...,
    matter_p: npt.ArrayLike = ...,
    radius: float,
    share: npt.ArrayLike,
    target_share: float,
) -> dict[str, _Array]: ...
def matter_momenta(
    *,
    kappa: npt.ArrayLike,
    sigma: npt.ArrayLike,
    tanl: npt.ArrayLike,
    charge: npt.ArrayLike = ...,
    momentum: float,
    bz: float,
) -> _Floats: ...
