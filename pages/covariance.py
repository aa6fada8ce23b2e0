"""docs/methods/analytic.md: the covariance without events beside simulated tracks.

Every preset, four particles, their momenta and angles; once all Gaussian, where the model of the fit holds, and once
with the default simulation and binary clusters.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import count, repeat

import cgemit as cg
from cgemit.analysis.quantities import QUANTITIES as SYMBOLS
from cgemit.draw.style import COLORS, Picture, grid, legend_entries, mathematical, new_picture, style
from cgemit.tables.show import with_error
from pages.page import Found, Numbers, Page, say, share_of, table

#: Momenta of each particle, GeV/c.
MOMENTA = {
    "mu-": (0.2, 0.5, 1.0, 2.0), "pi-": (0.2, 0.5, 1.0, 2.0), "K-": (0.3, 0.8, 2.0), "proton": (0.4, 0.8, 2.0),
}  # fmt: skip
ANGLES = (0.0, 0.5, 0.8, 0.9)
QUANTITIES = ("dr", "phi0", "kappa", "dz", "tanl", "p")
SAMPLES = 1024  # tracks that a point of the covariance averages
TRACKS = 50_000  # simulated tracks of a point

#: Readout, simulation and the limit of each mode: a fraction, or three standard errors where these are larger.
MODES = {
    "gaussian": ("gaussian", cg.SimulateSettings(fluctuations="gaussian", deltas=False, decays=False), 0.02),
    "default": ("binary", cg.SimulateSettings(decays=False), 0.05),
}


@dataclass(frozen=True)
class Ratio:
    """Core width of a quantity from the covariance over that of simulated tracks, at one point."""

    mode: str
    detector: str
    particle: str
    p: float  # GeV/c
    cos_theta: float
    quantity: str
    analytic: float  # unit of cgemit.resolution
    simulated: float
    simulated_error: float

    @property
    def ratio(self) -> float:
        """Covariance over simulation."""
        return self.analytic / self.simulated

    @property
    def error(self) -> float:
        """Standard error of the ratio, from the number of simulated tracks."""
        return self.ratio * self.simulated_error / self.simulated

    @property
    def fails(self) -> bool:
        """Whether the ratio is off by more than the limit of the mode and by more than three standard errors."""
        return abs(self.ratio - 1) > max(MODES[self.mode][2], 3 * self.error)


DESIGN = "besiii-cgem-design"
Point = tuple[str, str, str, float, float]
#: With CGEM layers or a chamber alone; tests/physics/test_measurement_layers.py has silicon.
SILICON = ("babar-like", "belle2-like", "besiii-pixel", "cepc-like", "clas12-like", "epic-like", "idea-like")
DETECTORS = tuple(name for name in cg.detectors() if name not in SILICON)


def points() -> Iterator[Point]:
    """Yield mode, detector, particle, momentum and cos(theta) of every point."""
    for mode in MODES:
        for detector in DETECTORS:
            for particle, momenta in MOMENTA.items():
                for p in momenta:
                    for cos_theta in ANGLES:
                        yield mode, detector, particle, p, cos_theta


def ratios(point: Point, tracks: int, seed: int) -> list[Ratio]:
    """Simulate and fit the tracks of a point and return the ratios of all quantities."""
    mode, detector, particle, p, cos_theta = point
    readout, simulate, _ = MODES[mode]
    settings, gun = cg.Settings(simulate=simulate), cg.Gun(particle, p=p, cos_theta=cos_theta)
    result = cg.run(
        detector, gun, n=tracks, seed=seed, settings=settings, readout=readout, keep=("tracks",), workers=1
    )  # fmt: skip
    expected = cg.analytic(detector, particle, p, cos_theta, readout=readout, samples=SAMPLES)
    rows = []
    for quantity in QUANTITIES:
        width = cg.resolution(result, quantity)
        rows.append(Ratio(*point, quantity, float(expected.sigma(quantity)), width.core, width.core_error))
    return rows


def measure(share: float) -> Numbers:
    """Measure all points, two at a time."""
    wanted, tracks, rows = list(points()), share_of(TRACKS, share, 200), []
    with ThreadPoolExecutor(2) as pool:
        for number, found in enumerate(pool.map(ratios, wanted, repeat(tracks), count())):
            rows += found
            say(f"{number + 1} of {len(wanted)}: {', '.join(map(str, wanted[number]))}")
    return Numbers(rows, {"events": f"{tracks} tracks"})


def _pipe() -> str:
    """Return the share of the beam pipe in the variance of d_rho, and by how much it falls without a pipe."""
    whole, without = (
        cg.analytic(cg.load({"base": DESIGN, "name": "d", "remove": parts}), "mu-", 0.3, 0.0)
        for parts in ([], ["beam_pipe"])
    )
    parts = whole.budget("dr").grouped("part")
    share, less = float(parts["pipe"] / sum(parts.values())), 1 - float(without.rms("dr") / whole.rms("dr")) ** 2
    return f"has {100 * share:.0f} % of the variance of d_rho; without the pipe it is {100 * less:.0f} % smaller"


def draw(found: Found) -> Picture:
    """Draw the ratios of the Gaussian mode, a panel for each quantity; grey is what is allowed."""
    rows = found["ratios"].rows
    names = list(dict.fromkeys(row.detector for row in rows))
    looks = dict(zip(names, ("o", "s", "^", "v", "D", "x"), strict=False))
    colours = dict(zip(MOMENTA, (COLORS["x"], COLORS["fit"], COLORS["truth"], COLORS["single"]), strict=True))
    with style():
        picture, axes = new_picture(3, 2, (8.6, 10.5))
        for plot, quantity in zip(axes, QUANTITIES, strict=True):
            plot.axhspan(0.98, 1.02, color=COLORS["matter"], lw=0)
            for row in rows:
                if (row.mode, row.quantity) != ("gaussian", quantity):
                    continue
                # Points of one momentum stand side by side, in the order of detectors and angles.
                shift = 1 + 0.012 * (names.index(row.detector) - 2) + 0.05 * (ANGLES.index(row.cos_theta) - 1.5)
                plot.errorbar(
                    row.p * shift, row.ratio, row.error, fmt=looks[row.detector], color=colours[row.particle],
                    ms=3, lw=0.8,
                )  # fmt: skip
            plot.axhline(1, color=COLORS["data"], lw=0.8)
            plot.set(
                title=mathematical(SYMBOLS[quantity].symbol),
                xscale="log",
                xlabel="p  (GeV/c)",
                ylabel="covariance / simulation",
            )
            plot.set_xticks([0.2, 0.5, 1.0, 2.0], ["0.2", "0.5", "1", "2"])
            plot.minorticks_off()
            grid(plot)
        for name, colour in colours.items():
            axes[0].plot([], [], "o", color=colour, ms=6, label=name)
        for name, marker in looks.items():
            axes[0].plot([], [], marker, color=COLORS["data"], ms=5, label=name)
        entries = legend_entries(axes)
        picture.legend(entries.values(), entries.keys(), loc="lower center", ncols=4)
        picture.subplots_adjust(left=0.1, right=0.99, top=0.97, bottom=0.14, wspace=0.3, hspace=0.4)
    return picture


def blocks(found: Found) -> dict[str, str]:
    """Return what was run, and mean ratios with the number that fail and the one farthest from 1."""
    rows = found["ratios"].rows
    lines, tails = [], [row.ratio for row in rows if row.mode == "default"]
    for mode in dict.fromkeys(row.mode for row in rows):
        own = [row for row in rows if row.mode == mode]
        by_place: dict[tuple[str, str], list[float]] = {}
        for row in own:
            by_place.setdefault((row.detector, row.quantity), []).append(row.ratio)
        means = [sum(ratios) / len(ratios) for ratios in by_place.values()]
        off = [row for row in own if row.fails]
        worst = max(off, key=lambda row: abs(row.ratio - 1), default=None)
        where = Counter(row.detector for row in off).most_common()
        found_off = ", ".join(f"{number} {detector}" for detector, number in where)
        lines.append([
            mode, f"{min(means):.3f} to {max(means):.3f}", f"{len(off)} of {len(own)}", found_off or "–",
            _text(worst) if worst else "–",
        ])  # fmt: skip
    return {
        "checks-sample": f"{len(rows) // len(QUANTITIES)} points (preset, particle, momentum, angle), with "
        f"{found['ratios'].about['events']} each",
        "mean-default": f"{sum(tails) / len(tails):.3f}",
        "pipe": _pipe(),
        "checks": table(["mode", "mean ratios of a preset", "fail", "in", "farthest from 1"], lines),
    }


def _text(row: Ratio) -> str:
    place = f"{row.detector}, {row.quantity}, {row.particle}, {row.p:g} GeV/c, {row.cos_theta:g}"
    return f"{with_error(row.ratio, row.error)}, {place}"


def failures(found: Found) -> list[str]:
    """Return the ratios of the Gaussian mode that fail."""
    return [str(row) for row in found["ratios"].rows if row.fails and row.mode == "gaussian"]


PAGE = Page(
    "covariance", "docs/methods/analytic.md", "12 min",
    {"ratios": (Ratio, measure)}, blocks,
    {"validation-covariance.png": draw}, failures,
)  # fmt: skip
