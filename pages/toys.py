"""docs/methods/alignment.md: pulls of constants of displaced detectors, the forecast of their errors, weak modes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

import cgemit as cg
from cgemit.base.arrays import Floats
from cgemit.calibration.settings import plan_of
from pages.page import Found, Numbers, Page, say, share_of, table

TRACKS = 300
GUN = cg.Gun("mu-", p=(0.4, 1.5), cos_theta=(-0.8, 0.8))
SHIFT, TURN = 0.1, 5e-4  # mm, rad: standard deviations of displacements
SIMULATED = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian"))
LAYERS = cg.AlignmentSettings()
PLATES = cg.AlignmentSettings(
    free=("cgem.*", "drift_chamber.plates.*"), plates=(2, 2, 2, 2, 2, 2, 23), fixed=("drift_chamber.plates.20-42",)
)


@dataclass(frozen=True)
class Case:
    """What is aligned, and in how many toys."""

    detector: str
    readout: str
    settings: cg.AlignmentSettings
    finder: str
    toys: int


CASES = (
    Case("besiii-cgem-design", "gaussian", LAYERS, "ckf", 200),
    Case("besiii-cgem-design", "binary", LAYERS, "ckf", 200),
    Case("besiii-cgem-design", "gaussian", PLATES, "ckf", 100),
    Case("besiii-cgem-design", "binary", PLATES, "ckf", 100),
    Case("kloe2-like", "gaussian", LAYERS, "truth", 100),
    Case("stcf-like", "gaussian", LAYERS, "truth", 100),
)


@dataclass(frozen=True)
class Toy:
    """One displaced detector: pulls of its constants, those without scattering, and over the forecast."""

    pull: Floats
    without: Floats
    over_forecast: Floats
    chi2: float
    iterations: int
    converged: bool


@dataclass(frozen=True)
class Pulls:
    """Pulls of all toys of a case: of one constant, or of ``all``.

    Chi-square has all correlations; the error of an RMS is that from the scatter of the toys.
    """

    detector: str
    readout: str
    constants: int
    constant: str
    toys: int
    mean: float
    rms: float
    error: float
    without: float
    over_forecast: float
    over_error: float
    chi2: float
    iterations: int
    not_converged: int


def toys(case: Case, numbers: Sequence[int], tracks: int = TRACKS) -> Iterator[Toy]:
    """Yield toys: a detector is displaced, simulated, reconstructed as described, and aligned."""
    nominal = cg.load(case.detector).with_readout(case.readout)
    free, _, _ = plan_of(nominal, case.settings)
    forecast = cg.alignment_forecast(nominal, [(GUN, tracks)], case.settings).solution.err
    size = np.array([SHIFT if one.unit == "mm" else TURN for one in free])
    for number in numbers:
        drawn = np.random.default_rng(number).standard_normal(len(free)) * size
        real = nominal.with_alignment({one.name: float(value) for one, value in zip(free, drawn, strict=True)})
        run = cg.run(
            real, GUN, tracks, seed=1 + number, settings=SIMULATED, fit_detector=nominal, finder=case.finder
        )  # fmt: skip
        found = cg.align(run, case.settings)
        pull = found.compare(real)
        # The last step again, without scattering.
        once = replace(case.settings, scattering=False, iterations=1, outlier_pull=(5.0,), tolerance=1e9)
        without = cg.align(run, once, detector=found.detector).compare(real)
        apart = pull * found.solution.err
        yield Toy(
            pull, without, apart / forecast, float(apart @ np.linalg.solve(found.cov, apart)), len(found.history),
            found.converged,
        )  # fmt: skip


def _rms(values: Floats) -> tuple[float, float]:
    """Return the RMS of (toys, constants), and its error from the scatter of the toys."""
    squares = np.mean(values**2, axis=1)
    rms = float(np.sqrt(squares.mean()))
    return rms, float(squares.std(ddof=1) / np.sqrt(len(squares)) / (2 * rms))


def pulls(case: Case, found: Sequence[Toy]) -> Iterator[Pulls]:
    """Yield the pulls of all constants of a case, and of each."""
    nominal = cg.load(case.detector).with_readout(case.readout)
    names = [one.name for one in plan_of(nominal, case.settings)[0]]
    every = [np.array([getattr(toy, name) for toy in found]) for name in ("pull", "without", "over_forecast")]
    chi2 = float(np.mean([toy.chi2 for toy in found])) / len(names)
    turns, bad = max(toy.iterations for toy in found), sum(not toy.converged for toy in found)
    for i, name in enumerate(("all", *names)):
        pull, without, over = every if i == 0 else [one[:, [i - 1]] for one in every]
        yield Pulls(
            case.detector, case.readout, len(names), name, len(found), float(pull.mean()), *_rms(pull),
            _rms(without)[0], *_rms(over), chi2, turns, bad,
        )  # fmt: skip


@dataclass(frozen=True)
class Mode:
    """A combination of the displacements of all parts of a detector that tracks determine worst, or not at all.

    The error of its largest displacement is in um, None without a number; with the chamber in place, ``held`` says
    whether it is a zero mode still.
    """

    detector: str
    name: str
    share: float
    error: float | None
    held: bool


DETECTORS = ("besiii-cgem-design", "kloe2-like", "stcf-like")
FORECAST = 1000  # tracks
SHOWN = 7


def modes(share: float) -> Numbers:
    """Forecast the modes of layers and chamber together, and those that are left with the chamber in place."""
    rows, tracks = list[Mode](), share_of(FORECAST, share, 100)
    for name in DETECTORS:
        nominal = cg.load(name).with_readout("gaussian")
        every = cg.AlignmentSettings(free=("cgem.*", "drift_chamber"))
        held = replace(every, fixed=tuple(f"drift_chamber.{key}" for key in ("shift_*", "rotation")))
        left = cg.alignment_forecast(nominal, [(GUN, tracks)], held).zero_modes
        found = cg.alignment_forecast(nominal, [(GUN, tracks)], every).modes(SHOWN)
        for mode, part, size in zip(found.names, found.shares, found.sizes, strict=True):
            rows.append(Mode(name, mode, part, 1e3 * size if np.isfinite(size) else None, mode not in left))
    return Numbers(rows, {"events": f"{tracks} tracks"})


def measure(share: float) -> Numbers:
    """Measure all cases."""
    rows = list[Pulls]()
    for case in CASES:
        number = share_of(case.toys, share, 2)
        say(f"{case.detector}, {case.readout}: {number} toys")
        rows += pulls(case, list(toys(case, range(number))))
    return Numbers(rows, {"events": f"{TRACKS} tracks in each toy"})


def blocks(found: Found) -> dict[str, str]:
    """Return the table of all cases, and that of modes."""
    head = ["detector", "readout", "constants", "toys", "RMS of the pulls", "mean", "spread over forecast"]
    head += ["χ² per constant", "RMS without scattering", "RMS of single constants", "iterations, at most"]
    rows: Sequence[Pulls] = found["pulls"].rows
    lines = []
    for one in rows:
        if one.constant != "all":
            continue
        same = [
            row.rms
            for row in rows
            if (row.detector, row.readout, row.constants) == (one.detector, one.readout, one.constants)
            and row.constant != "all"
        ]
        lines.append(
            [one.detector, f"`{one.readout}`", one.constants, one.toys, f"{one.rms:.3f} ± {one.error:.3f}",
             f"{one.mean:+.3f}", f"{one.over_forecast:.3f} ± {one.over_error:.3f}", f"{one.chi2:.3f}",
             f"{one.without:.2f}", f"{min(same):.2f} to {max(same):.2f}", one.iterations]
        )  # fmt: skip
    weak = list[list[object]]()
    for name in dict.fromkeys(row.detector for row in found["modes"].rows):
        own: Sequence[Mode] = [row for row in found["modes"].rows if row.detector == name]
        zero = [row.name + ("" if row.held else " (still)") for row in own if row.error is None]
        rest = [f"{row.name} {row.error:.0f} µm" for row in own if row.error is not None]
        weak.append([name, ", ".join(zero), ", ".join(rest)])
    return {"toys": table(head, lines), "modes": table(["detector", "zero modes", "weakest modes, error"], weak)}


PAGE = Page("toys", "docs/methods/alignment.md", "10 min", {"pulls": (Pulls, measure), "modes": (Mode, modes)}, blocks)
