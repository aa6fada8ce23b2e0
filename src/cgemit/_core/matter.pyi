# Scattering, energy loss, and species that decay.
import enum
from typing import Final

from cgemit._core._arrays import _Columns
from cgemit._core.detector import Detector

# The fit counts losses below this many standard deviations of the energy, of heavy particles and electrons.
CORE_SIGMAS: Final[float]
USUAL_MOMENTUM_ERROR: Final[float]  # relative, where none is known

class Screening(enum.IntEnum):
    wentzel = 0
    moliere = 1

class CoreLoss(enum.IntEnum):
    truncated = 0
    mean = 1
    most_probable = 2

class DecaySpectrum(enum.IntEnum):
    phase_space = 0
    semileptonic = 1
    michel = 2

# Columns: pdg, mass (GeV), lifetime (ns); species, fraction, spectrum; mode, pdg, charge (e), mass (GeV). `species` and
# `mode` count the rows of the tables before.
class DecayTable:
    def __init__(self, species: _Columns, modes: _Columns, products: _Columns) -> None: ...

# Matter: GeV, GeV/c; path in units of normal incidence.
def total_matter(detector: Detector, tanl: float) -> tuple[float, float, float]: ...
def scattering_angle(
    detector: Detector, slab: int, *, path: float, p: float, mass: float, charge: float = 1.0, track_chi_c2: float
) -> float: ...
def restricted_loss(
    detector: Detector, slab: int, *, path: float, p: float, mass: float, charge: float = 1.0, cut: float
) -> float: ...

# Of particles from the origin: relative error of p without straggling; largest unseen loss of the core over p.
def momentum_error(detector: Detector, *, p: float, mass: float, charge: float = 1.0, tanl: float = 0.0) -> float: ...
def light_cut(detector: Detector, *, p: float, mass: float, charge: float, tanl: float = 0.0) -> float: ...
