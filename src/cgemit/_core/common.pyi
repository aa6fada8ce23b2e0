# What all parts of the core share: statuses, random numbers, checks of tables, memory, interrupts.
import enum

import numpy.typing as npt

from cgemit._core._arrays import _Array, _Columns, _Floats

class TransportStatus(enum.IntEnum):
    outside = 0
    end = 1
    curled = 2
    stopped = 3
    neutral = 4
    left_field = 5
    decayed = 6
    at_rest = 7
    out_of_range = 8

class FitStatus(enum.IntEnum):
    ok = 0
    too_few_hits = 1
    seed_failed = 2
    does_not_reach = 3
    stopped = 4
    not_converged = 5
    not_positive_definite = 6
    left_field = 7
    unconstrained = 8
    hits_left_out = 9
    large_chi2 = 10

class StateStatus(enum.IntEnum):
    ok = 0
    not_fitted = 1
    does_not_reach = 2
    stopped = 3
    left_field = 4

class Purpose(enum.IntEnum):
    gun = 0
    scattering = 1
    energy_loss = 2
    digitization = 3
    drift_distance = 4
    fit_seed = 5
    test = 6
    ionization = 7
    deltas = 8
    radiation = 9
    foil = 10
    decay = 11
    readout_electron = 12
    readout_truth = 13
    readout_strip = 14
    half_turn = 15
    background_runs = 16
    background_cell = 17
    background_clusters = 18
    background_noise = 19
    background_strip = 20
    channel_kind = 21
    mixed_event = 22
    start_time = 23

# Random numbers: events (n,) int64, particle (n,) int32, place () or (n,) uint32; out (n, 4).
def uniforms(
    seed: int,
    events: npt.ArrayLike,
    particle: npt.ArrayLike,
    purpose: Purpose,
    place: npt.ArrayLike,
    block: int = 0,
) -> _Floats: ...
def normals(
    seed: int,
    events: npt.ArrayLike,
    particle: npt.ArrayLike,
    purpose: Purpose,
    place: npt.ArrayLike,
    block: int = 0,
) -> _Floats: ...

# Makes all stages at work, on any thread, raise KeyboardInterrupt, until it is called with False.
def stop_stages(stop: bool) -> None: ...
def keep_memory() -> None: ...
def event_offsets(event: npt.ArrayLike, first: int, n: int) -> _Array | None: ...
def strange_link(links: npt.ArrayLike, event: npt.ArrayLike, target: npt.ArrayLike) -> int: ...
def particle_rows(particles: _Columns, crossings: _Columns) -> _Array: ...
