# Particles to digis: one call for a chunk of events, without the GIL.
import enum
from collections.abc import Sequence
from typing import TypedDict

import numpy as np
import numpy.typing as npt

from cgemit._core._arrays import _Array, _Columns
from cgemit._core.detector import Detector
from cgemit._core.matter import DecayTable

class Fluctuations(enum.IntEnum):
    full = 0
    gaussian = 1
    off = 2

class _Simulated(TypedDict):
    status: npt.NDArray[np.int8]
    truths: dict[str, _Array]
    steps: dict[str, _Array]
    wire_truths: dict[str, _Array]
    decays: dict[str, _Array]

def through_slabs(
    detector: Detector, *, p: float, mass: float, charge: float, n: int, seed: int, first: int = 0
) -> dict[str, _Array]: ...

# Stages: one call for a chunk of events, without the GIL.
def simulate(
    detector: Detector,
    particles: _Columns,
    *,
    fluctuations: Fluctuations,
    deltas: bool = True,
    steps: bool = False,
    decays: DecayTable | None = None,
    half_turns: int = 1,
    seed: int,
) -> _Simulated: ...
def read_out_strips(
    detector: Detector,
    truths: _Columns,
    steps: _Columns,
    *,
    gain: float,
    w_values: npt.ArrayLike,
    threshold: float,
    gains: _Columns = {},
) -> dict[str, _Array]: ...
def seen_crossings(
    detector: Detector, truths: _Columns, *, efficiency: npt.ArrayLike, seed: int
) -> npt.NDArray[np.bool_]: ...
def smear_positions(
    detector: Detector,
    truths: _Columns,
    *,
    gain: float,
    w_values: npt.ArrayLike,
    errors: _Columns,
    seed: int,
) -> dict[str, _Array]: ...
def read_out_analog(
    detector: Detector,
    truths: _Columns,
    steps: _Columns,
    *,
    drift: _Columns,
    physics: _Columns,
    chip: _Columns,
    share_spread: float,
    way: npt.ArrayLike,
    induced: tuple[npt.ArrayLike, int],
    seed: int,
    gains: _Columns = {},
) -> dict[str, _Array]: ...
def read_out_profiles(
    detector: Detector,
    truths: _Columns,
    steps: _Columns,
    *,
    gain: float,
    w_values: npt.ArrayLike,
    sigma: float,
    threshold: float,
    noise: float,
    seed: int,
    gains: _Columns = {},
) -> dict[str, _Array]: ...
def read_out_wires(
    detector: Detector,
    wire_truths: _Columns,
    *,
    reveal_sides: bool,
    seed: int,
) -> dict[str, _Array]: ...
def background_cells(
    detector: Detector,
    events: npt.ArrayLike,
    *,
    begins: npt.ArrayLike,
    lengths: npt.ArrayLike,
    window: float,
    hot: npt.ArrayLike,
    hot_fires: npt.ArrayLike,
    seed: int,
) -> dict[str, _Array]: ...
def background_strips(
    detector: Detector,
    events: npt.ArrayLike,
    *,
    clusters: npt.ArrayLike,
    most_strips: int,
    single: npt.ArrayLike,
    charge: Sequence[float],
    noise_charge: Sequence[float],
    window: float,
    hot: npt.ArrayLike,
    hot_fires: npt.ArrayLike,
    seed: int,
) -> dict[str, _Array]: ...

# Rows in the order of event, gid and time (n,); index into it of the first row of each event and gid (m,).
def by_channel(event: npt.ArrayLike, gid: npt.ArrayLike, time: npt.ArrayLike) -> tuple[_Array, _Array]: ...
