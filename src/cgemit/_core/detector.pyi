# The detector as plain numbers, and its magnetic field.
from collections.abc import Sequence
from typing import Any, Final

import numpy.typing as npt

from cgemit._core._arrays import _Bytes, _Columns, _Floats
from cgemit._core.matter import CoreLoss, Screening

ELECTRON_GRID_FIRST: Final[float]  # keV
ELECTRON_POINTS: Final[int]
ELECTRON_STEPS: Final[int]  # equal steps of the electron energies from each power of two to the next
LOSS_GRID_FIRST: Final[float]  # ln(beta gamma) of the first column of log_terms
LOSS_GRID_STEP: Final[float]
LOSS_POINTS: Final[int]
MOST_SHEETS: Final[int]  # of a layer

class Field:
    # Harmonic (b mm^-2, q mm^-4; reach: largest r and |z|, mm), or a grid in r, z, in x, y, z or, if `polar`, in r,
    # phi, z. axes: first (mm, rad), step (mm, rad), points; coefficients of cubic B-splines: points + 2 of each axis,
    # then the component.
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
        polar: bool = False,
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
    def with_loss(self, *, loss: CoreLoss, radiation: bool, momentum_error: float) -> Detector: ...
    # table of errors for the truncated loss in place of `momentum_error`, (tanl, p_T)
    def with_errors(self, errors: dict[str, Any]) -> Detector: ...
    # parts (n_slabs, 5): of the scatters of each slab in the variances (5,) of a track; hits (5,): of its hits
    def with_shared_scattering(
        self, *, parts: npt.ArrayLike, variances: npt.ArrayLike, hits: npt.ArrayLike, p: float, mass: float
    ) -> Detector: ...
    @property
    def bz(self) -> float: ...  # T, at the origin
    @property
    def field(self) -> Field: ...
    @property
    def acting(self) -> _Floats: ...  # (n_slabs,) GeV2, of the matter that acts with each slab, infinite for all
    @property
    def unseen(self) -> _Floats: ...  # (n_slabs,) share of a loss in each slab that the fit does not see
    @property
    def by_hits(self) -> _Floats: ...  # (n_slabs,) (GeV/c)^-2, variance by hits over that by scattering
    def with_shared_loss(self, variances: npt.ArrayLike, *, p: float, mass: float, tanl: float = 0.0) -> Detector: ...
    def untuned(self) -> Detector: ...
    @property
    def last_measurement(self) -> float: ...  # mm, radius; infinite without any
    @property
    def has_equal_ends(self) -> bool: ...  # of all parts at both sides of z = 0
    @property
    def slope_through_most(self) -> float: ...  # tanl of a line from the origin through as many layers as possible
    @property
    def n_slabs(self) -> int: ...
    @property
    def n_layers(self) -> int: ...
    @property
    def n_wire_layers(self) -> int: ...
