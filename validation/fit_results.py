"""What the validation of the fit finds, as rows of files, with what each number has to be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from results import FOLDER, read_rows

#: Momenta (GeV/c) of each particle, and cos(theta) of the grid. Slower kaons and protons stop on the way.
_LIGHT, _HEAVY = (0.1, 0.2, 0.5, 1.0, 2.0), (0.35, 0.5, 0.8)
PARTICLES = {"mu-": _LIGHT, "mu+": _LIGHT, "pi-": _LIGHT, "pi+": _LIGHT, "K-": _HEAVY, "proton": _HEAVY}
MOMENTA = tuple(sorted({*_LIGHT, *_HEAVY}))
ANGLES = (0.0, 0.5, 0.8)
DETECTORS = ("besiii-cgem-design", "besiii-cgem", "besiii-idc", "besiii-idc-boss")

FAR = 8.0  # a pull beyond is another helix, no fluctuation: such tracks are counted, and not in the widths
N_SIGMA = 4.0  # standard errors of a number that it may be off
FLAT = 1 / 16_000  # least probability of the Kolmogorov-Smirnov distance: that of 4 standard errors


@dataclass(frozen=True)
class Point:
    """One point of the grid; `mode` is "gaussian", "hidden" (the same with sides to be found) or "default"."""

    mode: str
    detector: str
    particle: str
    p: float  # GeV/c
    cos_theta: float

    def label(self) -> str:
        """Return the point in words."""
        return f"{self.detector}, {self.mode}, {self.particle}, {self.p:g} GeV/c, cos(theta) {self.cos_theta:g}"


def point_of(row: Point) -> Point:
    """Return the point of the grid that a row is about."""
    return Point(row.mode, row.detector, row.particle, row.p, row.cos_theta)


@dataclass(frozen=True)
class Pull(Point):
    """Width and mean of a pull: of the core in the default simulation, else of all tracks within `FAR`.

    `parameter` is one of the helix, "p", or a layer of hits ("x0", "v2", "w17"). `tail` is what lies beyond that.
    `bias` is the mean residual over the root mean square of the errors: where the error changes with what is found, as
    that of scattering does with tan(lambda), the mean of the pull is another number. Both are expected to be those of
    the optimal linear estimate (0 where they were not worked out, the mean only where a pull of the point is off).
    """

    parameter: str
    n: float
    width: float
    width_error: float
    mean: float
    mean_error: float
    bias: float
    expected_bias: float
    expected_mean: float
    tail: float

    @property
    def tolerances(self) -> tuple[float, float]:
        """By how much width and mean may be off."""
        if self.mode == "default":
            least = (0.15, 0.2) if self.parameter in ("kappa", "p") and self.p <= 0.2 else (0.06, 0.08)
        else:
            least = (0.1 if self.p < 0.15 else 0.05 if self.mode == "hidden" else 0.02,) * 2
        return max(least[0], N_SIGMA * self.width_error), max(least[1], N_SIGMA * self.mean_error)

    @property
    def agrees(self) -> bool:
        """Whether width and mean are what they have to be."""
        width, mean = self.tolerances
        return abs(self.width - 1) <= width and abs(self.mean) <= mean


@dataclass(frozen=True)
class Chi2(Point):
    """Chi-square probability: rows, rows lost, mean, and probability of a larger Kolmogorov-Smirnov distance."""

    n: float
    lost: float
    mean: float
    flat: float

    @property
    def agrees(self) -> bool:
        """Whether the distribution is flat where all is Gaussian."""
        return self.mode != "gaussian" or self.flat > FLAT  # strips, tails and hits left two-sided do not make it so


@dataclass(frozen=True)
class Width(Point):
    """Core width of dr, dz (mm) or p (GeV/c), and that of the optimal linear estimate."""

    quantity: str
    core: float
    core_error: float
    optimal: float

    @property
    def ratio(self) -> float:
        """Found over optimal."""
        return self.core / self.optimal

    @property
    def ratio_error(self) -> float:
        """Standard error of the ratio."""
        return self.core_error / self.optimal

    @property
    def agrees(self) -> bool:
        """Whether they agree within 3 %."""
        return abs(self.ratio - 1) <= max(0.03, N_SIGMA * self.ratio_error)


@dataclass(frozen=True)
class Choice:
    """Core of the pull of kappa for one choice of the loss subtracted."""

    p: float  # GeV/c
    loss: str
    width: float
    width_error: float
    mean: float
    mean_error: float

    @property
    def agrees(self) -> bool:
        """Whether the default choice leaves width and mean as they have to be."""
        width, mean = max(0.06, N_SIGMA * self.width_error), max(0.08, N_SIGMA * self.mean_error)
        return self.loss != "truncated" or (abs(self.width - 1) < width and abs(self.mean) < mean)


@dataclass(frozen=True)
class Side:
    """Hits of a range of drift distance (mm), and how many of them are on the wrong side."""

    p: float  # GeV/c
    first: float
    last: float
    n: float
    wrong: float


@dataclass(frozen=True)
class Known:
    """Core width of p (GeV/c) with sides given and with sides to be found, of the same tracks."""

    p: float  # GeV/c
    known: float
    hidden: float
    ratio: float
    ratio_error: float

    @property
    def agrees(self) -> bool:
        """Whether finding the sides costs less than 3 %."""
        return self.ratio < 1 + max(0.03, N_SIGMA * self.ratio_error)


def wrong_sides(sides: Sequence[Side], p: float) -> float:
    """Return the fraction of wrong sides beyond 0.25 mm from the wire; it has to be below 1e-3."""
    far = [side for side in sides if side.p == p and side.first > 0.25]
    return sum(side.wrong for side in far) / sum(side.n for side in far)


@dataclass(frozen=True)
class FitResults:
    """The rows of all files, and what was run for each file."""

    pulls: list[Pull]
    chi2: list[Chi2]
    residuals: list[Pull]
    widths: list[Width]
    losses: list[Choice]
    sides: list[Side]
    known: list[Known]
    about: Mapping[str, Mapping[str, str]]


KINDS = {"pulls": Pull, "chi2": Chi2, "residuals": Pull, "widths": Width, "losses": Choice, "sides": Side,
         "known": Known}  # fmt: skip


def read_fit_results(folder: Path = FOLDER) -> FitResults:
    """Return what the files of a folder hold."""
    files = {name: read_rows(folder / f"fit_{name}.csv", kind) for name, kind in KINDS.items()}
    rows = {name: found for name, (found, _) in files.items()}
    return FitResults(**rows, about={name: about for name, (_, about) in files.items()})  # type: ignore[arg-type]


def failures(results: FitResults) -> list[str]:
    """Return what is not within its tolerance, in words."""
    wrong = [
        f"{row.label()}, {row.parameter}: width {row.width:.3f}, mean {row.mean:+.3f}"
        for row in (*results.pulls, *results.residuals)
        if not row.agrees
    ]
    curved = [row for row in results.chi2 if not row.agrees]
    wrong += [f"{row.label()}: chi-square probability, flat with {row.flat:.1g}" for row in curved]
    wide = [row for row in results.widths if not row.agrees]
    wrong += [f"{row.label()}: sigma of {row.quantity} {row.ratio:.3f} of the optimum" for row in wide]
    return wrong
