"""Samples of tracks for the validation of the fit, and what is measured on them."""

from __future__ import annotations

import contextlib
import itertools
import math
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2, kstest

import cgemit as cg
from cgemit import _core
from cgemit.analysis.widths import measure
from cgemit.chain.result import Result
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.fit import LOSSES, PARAMETERS, FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from fit_results import ANGLES, DETECTORS, FAR, MOMENTA, PARTICLES, Chi2, Choice, Known, Point, Pull, Side, Width
from optimal import QUANTITIES, Optimum, errors, optimum
from plain_tracks import Hit, TurnsBackError

Floats = npt.NDArray[np.float64]
Columns = dict[str, npt.NDArray[np.generic]]

BLOCK = 5000  # events in memory at a time
# Drift distances, mm; the error takes them below 0 next to a wire.
BINS = (-1.0, 0.0, 0.065, 0.13, 0.195, 0.26, 0.325, 0.39, 0.52, 0.65, 0.9, 1.3, 2.0, 3.0, 4.5, 6.5, 9.0)
MIXED = (-0.93, 0.93)  # cos(theta) of the paper's sample
VIEWS = ("x", "v", "w")

# The particles do not decay: a gate on the fit is about tracks of one particle.
WITHOUT_DECAYS = cg.Settings(simulate=SimulateSettings(decays=False))
EXACT = cg.Settings(
    simulate=SimulateSettings(fluctuations="gaussian", decays=False),
    digitize=DigitizeSettings(readout="gaussian", reveal_sides=True),
    fit=FitSettings(residuals=True),
)
MODES = {
    "gaussian": EXACT,
    "hidden": replace(EXACT, digitize=DigitizeSettings(readout="gaussian")),
    "default": WITHOUT_DECAYS,
}


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
        residuals = residuals[result.tracks["status"][residuals["track"]] == 0]
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
    settings, gun = MODES[point.mode], cg.Gun(point.particle, p=point.p, cos_theta=point.cos_theta)
    seed = zlib.crc32(repr(point).encode())
    columns: dict[str, list[npt.NDArray[np.generic]]] = {}
    names = ["status", "chi2", "ndf", *(f"{kind}_{name}" for kind in ("pull", "res", "err") for name in QUANTITIES)]
    sums, first = _Sums({}, {}, {}), None
    for block in range(math.ceil(n / BLOCK)):
        count = min(BLOCK, n - block * BLOCK)
        result = cg.run(point.detector, gun, count, seed + block, settings=settings, threads=threads)
        first = first or result
        for name in names:
            columns.setdefault(name, []).append(result.tracks[name])
        if point.mode == "gaussian":
            sums.add(result)
    assert first is not None
    tracks = {name: np.concatenate(parts) for name, parts in columns.items()}
    good = (tracks["status"] == 0) & (tracks["ndf"] > 0)  # without degrees of freedom there is no chi-square
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
    expected = (float(np.mean([one.bias[i] for _, one in best])), float(best[0][1].pull[i])) if best else (0.0, 0.0)
    expected = expected[0], 0.0 if math.isnan(expected[1]) else expected[1]
    more = {"bias": bias, "expected_bias": expected[0], "expected_mean": expected[1], "tail": tail}
    return Pull(**asdict(point), parameter=name, n=n, **_named(numbers), **more)


def _named(numbers: Sequence[float]) -> dict[str, float]:
    return dict(zip(("width", "width_error", "mean", "mean_error"), numbers, strict=True))


def _layers(point: Point, sums: _Sums) -> list[Pull]:
    rows = []
    for name, n in sums.n.items():
        mean = sums.first[name] / n
        width = math.sqrt(sums.second[name] / n - mean**2)
        numbers = (width, 1 / math.sqrt(2 * n), mean, 1 / math.sqrt(n))
        more = {"bias": mean, "expected_bias": 0.0, "expected_mean": 0.0, "tail": 0.0}
        rows.append(Pull(**asdict(point), parameter=name, n=int(n), **_named(numbers), **more))
    return rows


def _optima(result: Result, some: int, *, pulls: bool = False) -> list[tuple[Floats, Optimum]]:
    """Return the fitted helices of some tracks and the optimum for their hits."""
    hits = collect_hits(result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
    fitted = np.stack([result.tracks[name] for name in PARAMETERS], axis=1)
    columns = ("kind", "layer", "channel", "sigma")
    cut = (_core.CORE_CUT_XI, _core.CORE_CUT_SHARE)
    found = []
    for track in np.flatnonzero(result.tracks["status"] == 0)[:some]:
        rows = range(hits.hit_offsets[track], hits.hit_offsets[track + 1])
        seen = [Hit(*(getattr(hits, name)[i].item() for name in columns)) for i in rows]
        mass = float(result.particles["mass"][track])
        with contextlib.suppress(TurnsBackError):  # where its neighbours reach other matter
            found.append((fitted[track], optimum(result.detector, seen, fitted[track], mass, cut, pulls=pulls)))
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
        found = cg.study.pulls(cg.run(DETECTORS[0], gun, n, 7, settings=settings, threads=threads).tracks)["kappa"]
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
            runs[reveal] = cg.run(DETECTORS[0], gun, n, 8, settings=settings, threads=threads)
        sides += _wrong_sides(p, runs[False])
        known.append(_known(p, runs[True], runs[False]))
    return sides, known


def _wrong_sides(p: float, result: Result) -> list[Side]:
    residuals = result.residuals
    assert residuals is not None
    fitted = result.tracks["status"][residuals["track"]] == 0
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
    good = (known.tracks["status"] == 0) & (hidden.tracks["status"] == 0)
    pairs = [run.tracks["res_p"][good] for run in (known, hidden)]
    whole = [measure(values).core for values in pairs]
    parts = [measure(pairs[1][i::samples]).core / measure(pairs[0][i::samples]).core for i in range(samples)]
    return Known(p, *whole, whole[1] / whole[0], float(np.std(parts, ddof=1)) / math.sqrt(samples))
