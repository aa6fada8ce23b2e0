"""docs/validation.md: pulls, chi-square, residuals and widths of the fit over its grid, and what each has to be.

Simulates and fits tracks over momentum, angle, charge, particle and detector. `pulls`, `chi2`, `residuals` and `widths`
are of the same tracks: renew them together.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from scipy.stats import chi2, kstest

import cgemit as cg
from cgemit.analysis.quantities import QUANTITIES as SYMBOLS
from cgemit.analysis.widths import measure
from cgemit.base.arrays import Floats
from cgemit.chain.result import Result
from cgemit.draw.style import COLORS, Picture, legend_entries, mathematical, new_picture, style
from cgemit.draw.style import grid as draw_grid
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.fit import LOSSES, PARAMETERS, FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables.schema import has_momentum
from pages.optimal import QUANTITIES, Hit, Optimum, TurnsBackError, errors, optimum
from pages.page import Found, Numbers, Page, say, share_of, span, table

#: Momenta (GeV/c) of each particle, and cos(theta) of the grid. Slower kaons and protons stop on the way.
_LIGHT, _HEAVY = (0.1, 0.2, 0.5, 1.0, 2.0), (0.35, 0.5, 0.8)
PARTICLES = {"mu-": _LIGHT, "mu+": _LIGHT, "pi-": _LIGHT, "pi+": _LIGHT, "K-": _HEAVY, "proton": _HEAVY}
MOMENTA = tuple(sorted({*_LIGHT, *_HEAVY}))
ANGLES = (0.0, 0.5, 0.8)
DETECTORS = ("besiii-cgem-design", "besiii-cgem", "besiii-idc", "besiii-idc-boss")

FAR = 8.0  # a pull beyond is another helix, no fluctuation: such tracks are counted, and not in the widths
N_SIGMA = 4.0  # standard errors of a number that it may be off
FLAT = 1 / 16_000  # least probability of the Kolmogorov-Smirnov distance: that of 4 standard errors
#: Tracks of a point: all Gaussian in the reference detector, and every other; of each choice; whose optimum is found.
TRACKS, OTHERS, CHOICES, OPTIMA = 50_000, 25_000, 20_000, 10

Columns = dict[str, npt.NDArray[np.generic]]

BLOCK = 5000  # events in memory at a time
# Drift distances, mm; the error takes them below 0 next to a wire.
BINS = (-1.0, 0.0, 0.065, 0.13, 0.195, 0.26, 0.325, 0.39, 0.52, 0.65, 0.9, 1.3, 2.0, 3.0, 4.5, 6.5, 9.0)
MIXED = (-0.93, 0.93)  # cos(theta) of the paper's sample
VIEWS = ("x", "v", "w")

# The particles do not decay: a gate on the fit is about tracks of one particle.
WITHOUT_DECAYS = cg.Settings(simulate=SimulateSettings(decays=False))
#: Settings that are exact with the readout `gaussian` alone.
EXACT = cg.Settings(
    simulate=SimulateSettings(fluctuations="gaussian", decays=False),
    digitize=DigitizeSettings(reveal_sides=True),
    fit=FitSettings(residuals=True),
)
#: Readout and settings of each mode.
MODES = {
    "gaussian": ("gaussian", EXACT),
    "hidden": ("gaussian", replace(EXACT, digitize=DigitizeSettings())),
    "default": ("binary", WITHOUT_DECAYS),
}

#: Titles of the samples in the table of pulls.
_SAMPLES = {"gaussian": "Gaussian", "hidden": "Gaussian, sides unknown", "default": "default"}
_ANGLE_COLOURS = dict(zip(ANGLES, (COLORS["x"], COLORS["single"], COLORS["fit"]), strict=True))
_MARKERS = {"mu-": "o", "mu+": "s", "pi-": "^", "pi+": "v", "K-": "P", "proton": "D"}
_LOSS_COLOURS = dict(zip(LOSSES, (COLORS["fit"], COLORS["x"], COLORS["truth"]), strict=True))


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


@dataclass(frozen=True)
class Pull(Point):
    """Width and mean of a pull: of the core in the default simulation, else of all tracks within `FAR`.

    `parameter` is one of the helix, "p", or a layer of hits ("x0", "v2", "w17"). `tail` is what lies beyond that.
    `bias` is the mean residual over the root mean square of the errors: where the error changes with what is found, as
    that of scattering does with tan(lambda), the mean of the pull is another number. Both are expected to be those of
    the optimal linear estimate (None where they were not worked out, the mean only where a pull of the point is off).
    """

    parameter: str
    n: float
    width: float
    width_error: float
    mean: float
    mean_error: float
    bias: float
    expected_bias: float | None
    expected_mean: float | None
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
    """The rows of all files."""

    pulls: list[Pull]
    chi2: list[Chi2]
    residuals: list[Pull]
    widths: list[Width]
    losses: list[Choice]
    sides: list[Side]
    known: list[Known]

    @classmethod
    def of(cls, found: Found) -> FitResults:
        """Return the rows of the numbers on file."""
        return cls(**{name: list(numbers.rows) for name, numbers in found.items()})


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


def grid() -> Iterator[Point]:
    """Return all points, the reference detector first; hidden sides are asked for on that one only."""
    for mode, detector in (("gaussian", DETECTORS[0]), ("hidden", DETECTORS[0]), ("default", DETECTORS[0]),
                           *((mode, name) for name in DETECTORS[1:] for mode in ("gaussian", "default"))):  # fmt: skip
        for p, angle, (particle, momenta) in itertools.product(MOMENTA, ANGLES, PARTICLES.items()):
            if p in momenta and (mode != "hidden" or momenta[0] == MOMENTA[0]):
                yield Point(mode, detector, particle, p, angle)


@dataclass
class _Sums:
    """Numbers, sums and sums of squares of the pulls of hits, per layer."""

    n: dict[str, int]
    first: dict[str, float]
    second: dict[str, float]

    def add(self, result: Result) -> None:
        """Count the residuals of a block."""
        residuals = result.residuals
        if residuals is None:
            return
        residuals = residuals[has_momentum(result.tracks)[residuals["track"]]]
        key = residuals["view"].astype(np.int64) * 1000 + residuals["layer"]
        found, place = np.unique(key, return_inverse=True)
        pull = np.clip(residuals["pull"], -FAR, FAR)
        columns = (np.bincount(place), np.bincount(place, pull), np.bincount(place, pull**2))
        for which, *sums in zip(found, *columns, strict=True):
            name = f"{VIEWS[which // 1000]}{which % 1000}"
            for store, value in zip((self.n, self.first, self.second), sums, strict=True):
                store[name] = store.get(name, 0) + value


def measure_point(
    point: Point, n: int, threads: int | None, some: int = 10
) -> tuple[list[Pull], Chi2, list[Pull], list[Width]]:
    """Simulate and fit the tracks of one point; returns pulls, chi-square, residual pulls and widths.

    The optimum is worked out for `some` of the tracks.
    """
    (readout, settings), gun = MODES[point.mode], cg.Gun(point.particle, p=point.p, cos_theta=point.cos_theta)
    seed = zlib.crc32(repr(point).encode())
    columns: dict[str, list[npt.NDArray[np.generic]]] = {}
    names = ["status", "chi2", "ndf", *(f"{kind}_{name}" for kind in ("pull", "res", "err") for name in QUANTITIES)]
    sums, first = _Sums({}, {}, {}), None
    for block in range(math.ceil(n / BLOCK)):
        count = min(BLOCK, n - block * BLOCK)
        result = cg.run(
            point.detector, gun, count, seed + block, settings=settings, readout=readout, workers=threads
        )  # fmt: skip
        first = first or result
        for name in names:
            columns.setdefault(name, []).append(result.tracks[name])
        if point.mode == "gaussian":
            sums.add(result)
    assert first is not None
    tracks = {name: np.concatenate(parts) for name, parts in columns.items()}
    good = has_momentum(tracks) & (tracks["ndf"] > 0)  # without degrees of freedom there is no chi-square
    tracks = {name: column[good] for name, column in tracks.items()}
    probability = chi2.sf(tracks["chi2"], tracks["ndf"])
    flat = float(kstest(probability, "uniform").pvalue)
    kept = len(probability)
    row = Chi2(**asdict(point), n=kept, lost=n - kept, mean=float(probability.mean()), flat=flat)
    best = _optima(first, some) if _has_optimum(point) else []
    pulls = [_pull(point, name, tracks, best) for name in QUANTITIES]
    if best and not all(row.agrees for row in pulls):  # mean pulls take ten times as long: where they are asked for
        best = _optima(first, 1, pulls=True) + best[1:]
        pulls = [_pull(point, name, tracks, best) for name in QUANTITIES]
    widths = _widths(point, tracks, best) if best else []
    return pulls, row, _layers(point, sums), widths


def _has_optimum(point: Point) -> bool:
    """Whether the independent calculation is made; second derivatives are not enough where tracks turn back early."""
    if point.mode != "gaussian" or point.p * math.sqrt(1 - point.cos_theta**2) < 0.08:
        return False
    slow = point.p < (0.25 if MOMENTA[0] in PARTICLES[point.particle] else 0.6)
    return point.detector == DETECTORS[0] or point.particle == "mu-" or slow


def _pull(point: Point, name: str, tracks: Columns, best: Sequence[tuple[Floats, Optimum]]) -> Pull:
    pull, residual, error = (np.asarray(tracks[f"{kind}_{name}"], np.float64) for kind in ("pull", "res", "err"))
    n, near = len(pull), np.abs(pull) < FAR
    if point.mode == "default":
        found = measure(pull)
        numbers, tail = (found.core, found.core_error, found.core_mean, found.core_mean_error), found.tail
    else:
        tail = 1 - float(near.mean())
        numbers = (float(pull[near].std()), 1 / math.sqrt(2 * n), float(pull[near].mean()), 1 / math.sqrt(n))
    bias = float(residual[near].mean() / np.sqrt(np.mean(error[near] ** 2)))
    i = QUANTITIES.index(name)
    expected_bias = float(np.mean([one.bias[i] for _, one in best])) if best else None
    expected_mean = float(best[0][1].pull[i]) if best and not math.isnan(best[0][1].pull[i]) else None
    more = {"bias": bias, "expected_bias": expected_bias, "expected_mean": expected_mean, "tail": tail}
    return Pull(**asdict(point), parameter=name, n=n, **_named(numbers), **more)


def _named(numbers: Sequence[float]) -> dict[str, float]:
    return dict(zip(("width", "width_error", "mean", "mean_error"), numbers, strict=True))


def _layers(point: Point, sums: _Sums) -> list[Pull]:
    rows = []
    for name, n in sums.n.items():
        mean = sums.first[name] / n
        width = math.sqrt(sums.second[name] / n - mean**2)
        numbers = (width, 1 / math.sqrt(2 * n), mean, 1 / math.sqrt(n))
        more = {"bias": mean, "expected_bias": None, "expected_mean": None, "tail": 0.0}
        rows.append(Pull(**asdict(point), parameter=name, n=int(n), **_named(numbers), **more))
    return rows


def _optima(result: Result, some: int, *, pulls: bool = False) -> list[tuple[Floats, Optimum]]:
    """Return the fitted helices of some tracks and the optimum for their hits."""
    hits = collect_hits(result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    fitted = np.stack([result.tracks[name] for name in PARAMETERS], axis=1)
    columns = ("kind", "layer", "channel", "sigma")
    found = []
    for track in np.flatnonzero(has_momentum(result.tracks))[:some]:
        rows = range(hits.hit_offsets[track], hits.hit_offsets[track + 1])
        seen = [Hit(*(getattr(hits, name)[i].item() for name in columns)) for i in rows]
        mass = float(result.particles["mass"][track])
        with contextlib.suppress(TurnsBackError):  # where its neighbours reach other matter
            found.append((fitted[track], optimum(result.detector, seen, fitted[track], mass, pulls=pulls)))
    return found


def _widths(point: Point, tracks: Columns, best: Sequence[tuple[Floats, Optimum]]) -> list[Width]:
    """Compare core widths with the optimum: the errors of the fit, times what the optimum is of them track by track.

    Errors differ by a few per cent from track to track, with the layers that are hit: of a few tracks only the ratio
    tells.
    """
    sigmas = [errors(helix, one.cov) for helix, one in best]
    rows = []
    for name in sigmas[0]:
        found = measure(np.asarray(tracks[f"res_{name}"], np.float64))
        error = np.asarray(tracks[f"err_{name}"], np.float64)
        ratio = np.median([sigma[name] / own for sigma, own in zip(sigmas, error, strict=False)])
        expected = float(np.median(error) * ratio)
        row = Width(**asdict(point), quantity=name, core=found.core, core_error=found.core_error, optimal=expected)
        rows.append(row)
    return rows


def measure_losses(n: int, threads: int | None, momenta: Sequence[float] = (0.1, 0.2, 0.5, 1.0)) -> list[Choice]:
    """Fit the same tracks with each choice of the loss."""
    rows = []
    for p, loss in itertools.product(momenta, LOSSES):
        settings = replace(WITHOUT_DECAYS, fit=FitSettings(loss=loss))
        gun = cg.Gun("mu-", p=p, cos_theta=MIXED)
        found = cg.study.pulls(cg.run(DETECTORS[0], gun, n, 7, settings=settings, workers=threads).tracks)["kappa"]
        numbers = (found.core, found.core_error, found.core_mean, found.core_mean_error)
        rows.append(Choice(p, loss, **_named(numbers)))
    return rows


def measure_sides(n: int, threads: int | None, momenta: Sequence[float] = (0.2, 1.0)) -> tuple[list[Side], list[Known]]:
    """Compare the sides that the fit finds with the true ones, and momenta with those of known sides."""
    sides, known = [], []
    for p in momenta:
        runs = {}
        for reveal in (False, True):
            settings = replace(
                WITHOUT_DECAYS, digitize=DigitizeSettings(reveal_sides=reveal), fit=FitSettings(residuals=True)
            )
            gun = cg.Gun("mu-", p=p, cos_theta=MIXED)
            runs[reveal] = cg.run(DETECTORS[0], gun, n, 8, settings=settings, workers=threads)
        sides += _wrong_sides(p, runs[False])
        known.append(_known(p, runs[True], runs[False]))
    return sides, known


def _wrong_sides(p: float, result: Result) -> list[Side]:
    residuals = result.residuals
    assert residuals is not None
    fitted = has_momentum(result.tracks)[residuals["track"]]
    rows = (residuals["view"] == 2) & (residuals["used"] == 1) & fitted
    hit, side = residuals["hit"][rows], residuals["side"][rows]
    true = result.wire_truths["side"][result.wire_hits["wire_truth"][hit]]
    drift = result.wire_hits["drift"][hit]
    found = []
    for first, last in itertools.pairwise(BINS):
        inside = (drift >= first) & (drift < last)
        found.append(Side(p, first, last, int(inside.sum()), int(np.sum(side[inside] != true[inside]))))
    return found


def _known(p: float, known: Result, hidden: Result, samples: int = 20) -> Known:
    """Compare the core widths of p of the same tracks; the error is that of parts of the sample."""
    good = has_momentum(known.tracks) & has_momentum(hidden.tracks)
    pairs = [run.tracks["res_p"][good] for run in (known, hidden)]
    whole = [measure(values).core for values in pairs]
    parts = [measure(pairs[1][i::samples]).core / measure(pairs[0][i::samples]).core for i in range(samples)]
    return Known(p, *whole, whole[1] / whole[0], float(np.std(parts, ddof=1)) / math.sqrt(samples))


@functools.cache
def _grid(share: float) -> dict[str, list[Pull | Chi2 | Width]]:
    """Measure all points and return the rows of each file."""
    rows: dict[str, list[Pull | Chi2 | Width]] = {"pulls": [], "chi2": [], "residuals": [], "widths": []}
    for point in grid():
        full = TRACKS if (point.mode, point.detector) == ("gaussian", DETECTORS[0]) else OTHERS
        pulls, one, residuals, widths = measure_point(point, share_of(full, share, 200), None, OPTIMA)
        # A file of all layers of all points is too long: the page shows those of the reference.
        kept = residuals if point.detector == DETECTORS[0] else []
        rows["pulls"] += pulls
        rows["chi2"] += [one]
        rows["residuals"] += kept
        rows["widths"] += widths
        off = sum(not row.agrees for row in (*pulls, one, *residuals, *widths))
        say(point.label() + (f": {off} numbers off" if off else ""))
    return rows


def _of_grid(name: str, share: float) -> Numbers:
    tracks, others = share_of(TRACKS, share, 200), share_of(OTHERS, share, 200)
    text = f"{tracks:,} tracks a point where all is Gaussian in {DETECTORS[0]}, {others:,} elsewhere"
    return Numbers(_grid(share)[name], {"events": text})


_choice_sides = functools.cache(measure_sides)


def _of_choices(name: str, share: float) -> Numbers:
    """Compare choices of the loss, and sides that are found with those that are known."""
    n = share_of(CHOICES, share, 500)
    about = {"events": f"{n:,} mu- a momentum, cos(theta) uniform in ±0.93"}
    if name == "losses":
        return Numbers(measure_losses(n, None), about)
    return Numbers(_choice_sides(n, None)[("sides", "known").index(name)], about)


def blocks(found: Found) -> dict[str, str]:
    """Return the tables, and what was run."""
    results = FitResults.of(found)
    tracks = {round(row.n + row.lost) for row in results.chi2}
    return {
        "fit-versions": found["pulls"].about["versions"],
        "fit-events": f"{min(tracks):,} to {max(tracks):,} tracks",
        "choice-events": found["losses"].about["events"],
        "pulls": _pull_table(results),
        "from-optimum": _from_optimum(results),
        "default-off": _default_off(results),
        "chi2-off": _chi2_text(results),
        "residual-pulls": _residual_text(results),
        "widths": _width_table(results.widths),
        "known": _known_table(results),
    }


def _pull_table(results: FitResults) -> str:
    lines = []
    for mode, name in itertools.product(MODES, DETECTORS):
        rows = [row for row in results.pulls if (row.mode, row.detector) == (mode, name)]
        slow, fast = ([row for row in rows if (row.p < 0.15) == low] for low in (True, False))
        if rows:
            widths, means = [row.width for row in fast], [row.mean for row in fast]
            cells = [f"{min(widths):.3f} to {max(widths):.3f}", f"{min(means):+.3f} to {max(means):+.3f}"]
            lines.append([_SAMPLES[mode], name, *cells, _off(fast), _off(slow)])
    head = ["sample", "detector", "width", "mean", "off", "off at 0.1 GeV/c"]
    return table(head, lines)


def _off(rows: Sequence[Pull]) -> str:
    off = sum(not row.agrees for row in rows)
    return f"**{off}** of {len(rows)}" if off else f"0 of {len(rows)}"


def _from_optimum(results: FitResults) -> str:
    """Return how far means beyond the tolerance are from those of the optimal estimate, where it is worked out."""
    off = [row for row in results.pulls if row.mode == "gaussian" and row.p > 0.15 and not row.agrees]
    away = [abs(row.mean - row.expected_mean) for row in off if row.expected_mean is not None]
    return f"{max(away):.3f}" if away else "0"


def _default_off(results: FitResults) -> str:
    """Return the pulls of the default sample that are outside the gate."""
    off: dict[tuple[str, str], list[Pull]] = {}
    for row in results.pulls:
        if row.mode == "default" and not row.agrees:
            place = f"{row.p:g} GeV/c and cos(theta) {row.cos_theta:g} in `{row.detector}`"
            off.setdefault((place, row.parameter), []).append(row)
    return "; ".join(
        f"{parameter} of {', '.join(row.particle for row in rows)} at {place} "
        f"(width {span([row.width for row in rows])})"
        for (place, parameter), rows in off.items()
    ) or "none"  # fmt: skip


def _chi2_text(results: FitResults) -> str:
    rows = [row for row in results.chi2 if row.mode == "gaussian"]
    return f"{sum(not row.agrees for row in rows)} of {len(rows)} points"


def _residual_text(results: FitResults) -> str:
    off = [
        f"{row.parameter} of {row.particle} at {row.p:g} GeV/c, cos(theta) {row.cos_theta:g} ({row.n:,.0f} hits, "
        f"width {row.width:.3f}, mean {row.mean:+.4f} ± {row.mean_error:.4f})"
        for row in results.residuals
        if not row.agrees
    ]
    return f"{len(results.residuals)} pulls, {len(off)} beyond the tolerance" + (f" ({'; '.join(off)})" if off else "")


def _width_table(rows: Sequence[Width]) -> str:
    lines = []
    for name in DETECTORS:
        cells = []
        for quantity in ("dr", "dz", "p"):
            found = [row for row in rows if (row.detector, row.quantity) == (name, quantity)]
            ratios = [row.ratio for row in found]
            off = sum(not row.agrees for row in found)
            cells.append(f"{min(ratios):.3f} to {max(ratios):.3f}" + (f" **({off} off)**" if off else ""))
        points = {(row.particle, row.p, row.cos_theta) for row in rows if row.detector == name}
        lines.append([name, len(points), *cells])
    return table(["detector", "points", "sigma(d_rho)", "sigma(d_z)", "sigma(p)"], lines)


def _known_table(results: FitResults) -> str:
    lines = []
    for row in results.known:
        far = [side for side in results.sides if side.p == row.p and side.first >= 0.259]
        share = sum(side.wrong for side in far) / sum(side.n for side in far)
        cells = [f"{1000 * row.known:.4g}", f"{1000 * row.hidden:.4g}", f"{row.ratio:.4f} ± {row.ratio_error:.4f}"]
        lines.append([f"{row.p:g}", *cells, f"{100 * share:.4f}"])
    head = ["p, GeV/c", "sigma(p), sides known, MeV/c", "sigma(p), sides unknown, MeV/c", "ratio"]
    head += ["wrong sides beyond 0.26 mm, %"]
    return table(head, lines)


def draw_pulls(found: Found) -> Picture:
    """Draw widths of the pulls of the reference detector against momentum; grey is what is allowed."""
    results = FitResults.of(found)
    rows = [row for row in results.pulls if row.detector == DETECTORS[0]]
    with style():
        picture, axes = new_picture(4, 3, (8.6, 10.0))
        panels = [(mode, name) for mode in ("gaussian", "default") for name in QUANTITIES]
        for plot, (mode, name) in zip(axes, panels, strict=True):
            _points(plot, [row for row in rows if (row.mode, row.parameter) == (mode, name)])
            title = f"{mathematical(SYMBOLS[name].symbol)}, {mode}"
            plot.set(title=title, ylabel="width of the pull", ylim=(0.85, 1.15))  # what fails by far is on file
        for name, marker in _MARKERS.items():
            axes[0].plot([], [], marker, color=COLORS["data"], ms=5, label=name)
        for angle, colour in _ANGLE_COLOURS.items():
            axes[0].plot([], [], "o", color=colour, ms=6, label=f"cos θ = {angle:g}")
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=4)
        picture.subplots_adjust(left=0.08, right=0.99, top=0.96, bottom=0.13, wspace=0.4, hspace=0.55)
    return picture


def _points(plot: Axes, rows: Sequence[Pull]) -> None:
    for row in rows:
        shift = 0.16 * ANGLES.index(row.cos_theta) - 0.22 + 0.025 * list(_MARKERS).index(row.particle)
        x = MOMENTA.index(row.p) + shift
        allowed = row.tolerances[0]
        plot.fill_between((x - 0.02, x + 0.02), 1 - allowed, 1 + allowed, color=COLORS["matter"], lw=0)
        colour = _ANGLE_COLOURS[row.cos_theta]
        plot.errorbar(x, row.width, row.width_error, fmt=_MARKERS[row.particle], color=colour, ms=2.5, lw=0.8)
    plot.axhline(1, color=COLORS["data"], lw=0.8)
    plot.set_xticks(range(len(MOMENTA)), [f"{p:g}" for p in MOMENTA])
    plot.set_xlabel("p  (GeV/c)")
    draw_grid(plot)


def draw_residuals(found: Found) -> Picture:
    """Draw width and mean of the pull of every hit against the track without it, layer by layer, mu-."""
    results = FitResults.of(found)
    rows = [row for row in results.residuals if row.particle == "mu-" and row.cos_theta == 0 and row.p > 0.15]
    names = list(dict.fromkeys(row.parameter for row in rows))
    names.sort(key=lambda name: ("xvw".index(name[0]) == 2, int(name[1:]), name[0]))
    with style():
        picture, axes = new_picture(2, 1, (8.6, 6.6))
        for plot, quantity in zip(axes, ("width", "mean"), strict=True):
            for number, p in enumerate(PARTICLES["mu-"][1:]):
                by_layer = {row.parameter: row for row in rows if row.p == p}
                x = [i + 0.15 * number - 0.22 for i, name in enumerate(names) if name in by_layer]
                y = [getattr(by_layer[name], quantity) for name in names if name in by_layer]
                error = [getattr(by_layer[name], f"{quantity}_error") for name in names if name in by_layer]
                colour = list(COLORS.values())[number]
                plot.errorbar(x, y, error, fmt="o", ms=2.5, lw=0.8, color=colour, label=f"{p:g} GeV/c")
            centre = 1.0 if quantity == "width" else 0.0
            plot.axhspan(centre - 0.02, centre + 0.02, color=COLORS["matter"], lw=0, zorder=0)
            plot.set(ylabel=f"{quantity} of the residual's pull", xlim=(-0.7, len(names) - 0.3))
            plot.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
            draw_grid(plot)
        axes[0].set_title(f"{DETECTORS[0]}, mu-, cos θ = 0, all Gaussian: each hit against the track without it")
        axes[1].set_xlabel("layer: X and V of the CGEM, wires")
        axes[0].legend(ncols=4, loc="upper right")
        picture.subplots_adjust(left=0.09, right=0.99, top=0.95, bottom=0.11, hspace=0.3)
    return picture


def draw_choices(found: Found) -> Picture:
    """Draw the core of the pull of kappa for each loss, wrong sides, and widths over the optimum."""
    results = FitResults.of(found)
    with style():
        picture, axes = new_picture(2, 2, (8.6, 7.2))
        _draw_losses(axes[0], axes[1], results)
        _draw_sides(axes[2], results)
        _draw_widths(axes[3], results)
        picture.subplots_adjust(left=0.09, right=0.99, top=0.95, bottom=0.08, wspace=0.28, hspace=0.35)
    return picture


def _draw_losses(left: Axes, right: Axes, results: FitResults) -> None:
    for plot, quantity in ((left, "width"), (right, "mean")):
        for loss, colour in _LOSS_COLOURS.items():
            rows = [row for row in results.losses if row.loss == loss]
            y, error = ([getattr(row, name) for row in rows] for name in (quantity, f"{quantity}_error"))
            plot.errorbar([row.p for row in rows], y, error, fmt="o-", ms=4, lw=1, color=colour, label=loss)
        plot.axhline(1 if quantity == "width" else 0, color=COLORS["data"], lw=0.8)
        plot.set(
            xscale="log",
            xlabel="p  (GeV/c)",
            ylabel=f"core {quantity} of the pull of {mathematical(SYMBOLS['kappa'].symbol)}",
            title="loss subtracted",
        )
        draw_grid(plot)
    right.legend()


def _draw_sides(plot: Axes, results: FitResults) -> None:
    for p, colour in zip(dict.fromkeys(row.p for row in results.sides), (COLORS["x"], COLORS["fit"]), strict=False):
        rows = [row for row in results.sides if row.p == p and row.wrong > 0]
        middle = [0.5 * (row.first + row.last) for row in rows]
        share = np.array([row.wrong / row.n for row in rows])
        error = np.sqrt([row.wrong for row in rows]) / [row.n for row in rows]
        plot.errorbar(middle, share, error, fmt="o", ms=4, lw=1, color=colour, label=f"{p:g} GeV/c")
    plot.axhline(1e-3, color=COLORS["data"], lw=0.8, ls="--", xmin=0.35)
    plot.set(xscale="log", yscale="log", ylim=(1e-6, 1), xlabel="drift distance  (mm)", ylabel="wrong sides")
    plot.set_title("sides found by the fit")
    plot.legend()
    draw_grid(plot)


def _draw_widths(plot: Axes, results: FitResults) -> None:
    for name, colour in (("dr", COLORS["x"]), ("dz", COLORS["single"]), ("p", COLORS["fit"])):
        rows = [row for row in results.widths if row.quantity == name]
        plot.errorbar(range(len(rows)), [row.ratio for row in rows], [row.ratio_error for row in rows], fmt="o", ms=2.5,
                      lw=0.7, color=colour, label=mathematical(SYMBOLS[name].symbol))  # fmt: skip
    plot.axhspan(0.97, 1.03, color=COLORS["matter"], lw=0, zorder=0)
    plot.axhline(1, color=COLORS["data"], lw=0.8)
    plot.set(xlabel="point of the grid", ylabel="core width over optimum", title="against the optimal estimate")
    plot.set_ylim(0.94, 1.06)
    plot.legend(ncols=3)
    draw_grid(plot)


PAGE = Page(
    "fit",
    "docs/validation.md",
    "30 min",
    {
        "pulls": (Pull, functools.partial(_of_grid, "pulls")),
        "chi2": (Chi2, functools.partial(_of_grid, "chi2")),
        "residuals": (Pull, functools.partial(_of_grid, "residuals")),
        "widths": (Width, functools.partial(_of_grid, "widths")),
        "losses": (Choice, functools.partial(_of_choices, "losses")),
        "sides": (Side, functools.partial(_of_choices, "sides")),
        "known": (Known, functools.partial(_of_choices, "known")),
    },
    blocks,
    {
        "validation-fit-pulls.png": draw_pulls,
        "validation-fit-residuals.png": draw_residuals,
        "validation-fit-choices.png": draw_choices,
    },
    lambda found: failures(FitResults.of(found)),
)
