# Single steps of the core that only tests ask for.
import enum
from collections.abc import Sequence
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from cgemit._core.detector import Detector

_Array = npt.NDArray[Any]
_Floats = npt.NDArray[np.float64]
_Bytes = npt.NDArray[np.uint8]
_Columns = dict[str, Any]

class _Reference(TypedDict):
    rows: _Floats  # (hits, 5)
    noise: _Floats  # (noise vectors, 5)
    noise_units: _Floats  # (noise vectors,), the kinks in units of each
    predicted: _Floats  # (hits,), mm
    extent: _Floats  # (hits,), mm
    reached: bool
    stopped: bool

def philox4x32(*, counter: Sequence[int], key: Sequence[int]) -> list[int]: ...

# Motion: points (n, 7) float64, rows of x y z (mm), flight direction ux uy, tanl, signed curvature w (1/mm);
# arcs (n,) float64, mm, transverse.
def step_to_cylinder(
    points: npt.ArrayLike, radius: float, *, outward: bool = True
) -> tuple[_Floats, _Floats, _Bytes]: ...
def advance(points: npt.ArrayLike, arcs: npt.ArrayLike) -> tuple[_Floats, _Floats]: ...
def approach_wire(
    points: npt.ArrayLike, detector: Detector, layer: int, wire: int
) -> tuple[_Floats, _Floats, _Floats, _Bytes]: ...
def with_acting(detector: Detector, acting: npt.ArrayLike) -> Detector: ...
def with_unseen(detector: Detector, unseen: npt.ArrayLike) -> Detector: ...
def core_loss(
    detector: Detector, slab: int, *, path: float, p: float, mass: float, charge: float = 1.0, track_xi: float
) -> tuple[float, float, float]: ...
def sample_loss(
    detector: Detector, slab: int, *, path: float, p: float, mass: float, charge: float = 1.0, seed: int, n: int
) -> _Floats: ...

# Which part (0 to 1) of a straight line through a slab with holes lies beside them: u, v (mm) where it crosses the
# middle of the foil, slopes du/dw, dv/dw with w outward; (n,) float64.
def solid_fraction(
    detector: Detector,
    slab: int,
    *,
    u: npt.ArrayLike,
    v: npt.ArrayLike,
    slope_u: npt.ArrayLike,
    slope_v: npt.ArrayLike,
) -> _Floats: ...

# Drift gaps: keV, mm. Columns of `ionize` are energy, electrons, deltas per track, and deposit_crossing (the
# track), deposit_x y z dx dy dz energy electrons delta origin per deposit; origin 0 gas, 1 cathode, 2 behind.
def ionize(
    detector: Detector,
    layer: int,
    *,
    p: float,
    mass: float,
    charge: float = 1.0,
    n: int,
    seed: int,
    deltas: bool,
    keep_clusters: bool,
    tanl: float = 0.0,
    slope: float = 0.0,
) -> dict[str, _Array]: ...

# Columns u w z, energy left, length of the path and energy deposited in the gap of electrons that start at
# (0, w, 0).
def follow_electrons(
    detector: Detector, layer: int, *, w: float, energy: float, outward: float, n: int, seed: int
) -> dict[str, _Array]: ...
def reference(
    detector: Detector,
    helix: npt.ArrayLike,
    mass: float,
    hits: _Columns,
    kinks: npt.ArrayLike | None = None,
    *,
    spans: bool = False,
) -> _Reference: ...

class SeedFrom(enum.Enum):
    wires = 0
    wires_and_clusters = 1
    azimuths = 2

def sine_cosine_of_turn(turns: npt.ArrayLike) -> tuple[_Floats, _Floats]: ...
def seeds(
    detector: Detector, *, hit_offsets: npt.ArrayLike, hits: _Columns, mass: npt.ArrayLike, source: SeedFrom
) -> _Array: ...
def function(name: str, values: npt.ArrayLike) -> _Array: ...
def shaped(terms: npt.ArrayLike, dt: float, steps: npt.ArrayLike) -> npt.NDArray[np.float64]: ...
def polya_gains(theta: float, seed: int, n: int) -> npt.NDArray[np.float64]: ...
def nearest_holes(
    pitch: float, u: npt.ArrayLike, v: npt.ArrayLike
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]: ...
def share_cloud(
    detector: Detector,
    layer: int,
    phi: float,
    z: float,
    sigma_x: float,
    sigma_z: float,
    way: npt.ArrayLike,
    induced: tuple[npt.ArrayLike, int],
) -> dict[str, _Array]: ...
def turn_between(from_x: float, from_y: float, to_x: float, to_y: float) -> float: ...
def profile_below(edge: float, a: float, b: float, sigma: float) -> float: ...
def fit_line(
    position: npt.ArrayLike, charge: npt.ArrayLike, height: npt.ArrayLike, stiffness: float = 0.0
) -> tuple[float, float, bool]: ...
def settle_tracks(*, tracks: _Columns, entries: _Columns, hits: _Columns, min_score: float) -> dict[str, _Array]: ...
def count_ranges(first: npt.ArrayLike, last: npt.ArrayLike) -> tuple[_Bytes, int, _Bytes]: ...
