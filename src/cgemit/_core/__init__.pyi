# Types of the compiled module; tests/quality/test_stubs.py compares them with it.
# Arrays go in C-contiguous and are converted to the dtype named here; they come out as new arrays that own the
# memory of the core. Dicts hold one array per column of the tables in docs/data_model.md.
import enum
from collections.abc import Sequence
from typing import Any, Final, TypeAlias, TypedDict

import numpy as np
import numpy.typing as npt

from cgemit._core import _testing as _testing

_Array: TypeAlias = npt.NDArray[Any]
_Floats: TypeAlias = npt.NDArray[np.float64]
_Bytes: TypeAlias = npt.NDArray[np.uint8]
_Columns: TypeAlias = dict[str, Any]  # of arrays; no other mapping will do

ELECTRON_GRID_FIRST: Final[float]  # keV
ELECTRON_POINTS: Final[int]
ELECTRON_STEPS: Final[int]  # equal steps of the electron energies from each power of two to the next
# Collisions that transfer less than this many times the xi of the track plus this share of p beta make the fit's loss.
CORE_CUT_XI: Final[float]
CORE_CUT_SHARE: Final[float]
MOST_ERROR: Final[float]  # relative, of a momentum above which it is not measured; also over the prior's, along z
STRAIGHT_FIELD: Final[float]  # T, below which tracks are fitted as straight lines
USUAL_MOMENTUM_ERROR: Final[float]  # relative, of which CORE_CUT_SHARE is
LOSS_GRID_FIRST: Final[float]  # ln(beta gamma) of the first column of log_terms
LOSS_GRID_STEP: Final[float]
LOSS_POINTS: Final[int]

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

class StateStatus(enum.IntEnum):
    ok = 0
    not_fitted = 1
    does_not_reach = 2
    stopped = 3
    left_field = 4

class Surface(enum.IntEnum):
    origin = 0
    beam_line = 1
    cylinder = 2
    hit = 3

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

class Screening(enum.IntEnum):
    wentzel = 0
    moliere = 1

class CoreLoss(enum.IntEnum):
    truncated = 0
    mean = 1
    most_probable = 2

class Fluctuations(enum.IntEnum):
    full = 0
    gaussian = 1
    off = 2

class DecaySpectrum(enum.IntEnum):
    phase_space = 0
    semileptonic = 1
    michel = 2

# Columns: pdg, mass (GeV), lifetime (ns); species, fraction, spectrum; mode, pdg, charge (e), mass (GeV). `species` and
# `mode` count the rows of the tables before.
class DecayTable:
    def __init__(self, species: _Columns, modes: _Columns, products: _Columns) -> None: ...

class Field:
    # Harmonic (b mm^-2, q mm^-4; reach: largest r and |z|, mm), or a grid. axes: first (mm), step (mm), points;
    # coefficients of cubic B-splines: points + 2 of each axis, then the component.
    def __init__(
        self,
        *,
        bz: float,
        tolerance: float,
        b: float = 0.0,
        q: float = 0.0,
        axes: Sequence[tuple[float, float, int]] = [],
        coefficients: npt.ArrayLike = [],
        reach: Sequence[float] | None = None,
    ) -> None: ...
    @property
    def bz(self) -> float: ...  # T, at the origin
    @property
    def is_uniform(self) -> bool: ...
    # points (n, 3) mm: field (n, 3) T, gradient (n, 3, 3) T/mm, inside the map (n,).
    def values(self, points: npt.ArrayLike) -> tuple[_Floats, _Floats, _Bytes]: ...
    # points (n, 7): x y z mm, direction of flight, charge/p; paths (n,) mm; derivatives (5, 5) at every point of how
    # neighbours lie in the plane across the transverse flight: to the left, azimuth, charge/p, up, slope.
    def advance(
        self, points: npt.ArrayLike, paths: npt.ArrayLike, derivatives: npt.ArrayLike
    ) -> tuple[_Floats, _Floats, _Bytes]: ...
    # points (n, 7): x y z ux uy tanl, charge/pT; out (n, 6) of the first six, whether inside the map (n,).
    def to_perigee(self, points: npt.ArrayLike) -> tuple[_Floats, _Bytes]: ...

class Material:
    def __init__(
        self, *, x0: float, xi: float, log_term: npt.ArrayLike, elements: Sequence[tuple[int, float, float, float]]
    ) -> None: ...

def sum_shells(
    *, materials: Sequence[Material], r_in: Sequence[float], r_out: Sequence[float]
) -> tuple[float, float, float, float, _Floats, _Floats]: ...

class Chamber:
    def __init__(self, wires: _Columns) -> None: ...

class Detector:
    def __init__(
        self,
        *,
        bz: float,
        slabs: _Columns,
        log_terms: npt.ArrayLike,
        composition: _Columns,
        layers: _Columns,
        wires: Chamber | _Columns,
        screening: Screening,
        lattice: _Columns = {},
        gaps: list[dict[str, Any]] = [],
        field: Field | None = None,
        simulated: bool = True,
    ) -> None: ...
    # radius mm; matter inside was not crossed, or twice if it is negative.
    def beginning_at(self, radius: float) -> Detector: ...
    def in_field(self, bz: float) -> Detector: ...
    # momentum_error: relative, for the truncated loss
    def with_loss(
        self, *, loss: CoreLoss, radiation: bool, momentum_error: float, light_error: tuple[float, float] | None = None
    ) -> Detector: ...
    # parts (n_slabs, 5): of the scatters of each slab in the variances (5,) of a track
    def with_shared_scattering(self, *, parts: npt.ArrayLike, variances: npt.ArrayLike) -> Detector: ...
    @property
    def bz(self) -> float: ...  # T, at the origin
    @property
    def field(self) -> Field: ...
    @property
    def acting(self) -> _Floats: ...  # (n_slabs,) GeV2, of the matter that acts with each slab, infinite for all
    @property
    def unseen(self) -> _Floats: ...  # (n_slabs,) share of a loss in each slab that the fit does not see
    def with_acting(self, acting: npt.ArrayLike) -> Detector: ...
    def with_shared_loss(self, variances: npt.ArrayLike, *, p: float, mass: float, tanl: float = 0.0) -> Detector: ...
    def untuned(self) -> Detector: ...
    def with_unseen(self, unseen: npt.ArrayLike) -> Detector: ...
    @property
    def n_slabs(self) -> int: ...
    @property
    def n_layers(self) -> int: ...
    @property
    def n_wire_layers(self) -> int: ...

class _Simulated(TypedDict):
    status: npt.NDArray[np.int8]
    truths: dict[str, _Array]
    steps: dict[str, _Array]
    wire_truths: dict[str, _Array]
    decays: dict[str, _Array]

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

# Matter: GeV, GeV/c; path in units of normal incidence.
def total_matter(detector: Detector, tanl: float) -> tuple[float, float, float]: ...
def scattering_angle(
    detector: Detector, slab: int, *, path: float, p: float, mass: float, charge: float = 1.0, track_chi_c2: float
) -> float: ...
def restricted_loss(
    detector: Detector, slab: int, *, path: float, p: float, mass: float, charge: float = 1.0, cut: float
) -> float: ...
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
    xt_distance: npt.ArrayLike,
    xt_time: npt.ArrayLike,
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
    innermost: int,
    most_strips: int,
    single: Sequence[float],
    charge: Sequence[float],
    window: float,
    hot: npt.ArrayLike,
    hot_fires: npt.ArrayLike,
    seed: int,
) -> dict[str, _Array]: ...

# Rows in the order of event, gid and time (n,); index into it of the first row of each event and gid (m,).
def by_channel(event: npt.ArrayLike, gid: npt.ArrayLike, time: npt.ArrayLike) -> tuple[_Array, _Array]: ...
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
def clusters_of_positions(
    detector: Detector, digis: _Columns, *, err_x: npt.ArrayLike, err_v: npt.ArrayLike
) -> dict[str, _Array]: ...
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
) -> dict[str, _Array]: ...
def circle_layers(*, axial: int, across: int, single: bool, least_axial: int) -> int: ...
def find_tracks(
    detector: Detector,
    *,
    event_offsets: npt.ArrayLike,
    hits: _Columns,
    settings: dict[str, Any],
    pairs: _Columns = {},
) -> dict[str, _Array]: ...
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
) -> dict[str, Any]: ...

# Makes all stages at work, on any thread, raise KeyboardInterrupt, until it is called with False.
def stop_stages(stop: bool) -> None: ...
def isa() -> str: ...
def lanes() -> int: ...
def processor_runs(isa: str) -> bool: ...
def use_kernels(path: str) -> None: ...
def use_scalar_kernels() -> None: ...

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
def change_pivot(
    helix: npt.ArrayLike, cov: npt.ArrayLike, step: npt.ArrayLike, bz: npt.ArrayLike
) -> tuple[_Floats, _Floats]: ...
def keep_memory() -> None: ...
def event_offsets(event: npt.ArrayLike, first: int, n: int) -> _Array | None: ...
def strange_link(links: npt.ArrayLike, event: npt.ArrayLike, target: npt.ArrayLike) -> int: ...
def outside(numbers: npt.ArrayLike, limits: Sequence[int], kinds: npt.ArrayLike | None = None) -> int: ...
def particle_rows(particles: _Columns, crossings: _Columns) -> _Array: ...
def match_hits(
    *,
    particles: _Columns,
    truths: _Columns,
    wire_truths: _Columns,
    clusters: _Columns,
    wire_hits: _Columns,
    candidate_hits: _Columns,
    candidates: int,
) -> dict[str, _Array]: ...
def assign_hits(
    *,
    particles: _Columns,
    truths: _Columns,
    wire_truths: _Columns,
    clusters: _Columns,
    wire_hits: _Columns,
    candidates: npt.ArrayLike,
    rows: npt.ArrayLike,
) -> dict[str, _Array]: ...
