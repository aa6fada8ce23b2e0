"""docs/methods/foils.md: GEM foils with holes against even ones, on every observable of the study.

Three detectors differ in their foils only: ``effective`` has the densities of the preset, ``even`` the mean density of
the lattice, ``lattice`` the holes. They share their random numbers, and the fit always assumes the preset. Differences
are taken batch by batch; the scatter over batches is their error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import cgemit as cg
from cgemit import _core
from cgemit.analysis.clusters import cluster_residuals, v_fit, x_widths
from cgemit.analysis.curves import windowed_resolution
from cgemit.chain.settings import Settings
from cgemit.detector import CgemLayer, Detector, SubLayer, compiled, slabs
from cgemit.detector.shells import Holes
from cgemit.simulation.transport import SimulateSettings
from cgemit.study.evaluation import seed_of
from cgemit.study.paper import COS_THETA
from pages.page import Found, Numbers, Page, sample, share_of, table

PRESET, SEED = "besiii-cgem-design", 1
MOMENTA = (0.2, 0.5, 1.0)  # GeV/c
BATCHES, EVENTS = 30, 3000  # of each momentum, of each batch
UNITS = {"dr": "µm", "dz": "mm", "p": "MeV/c"}
TRACK, MARK, LENGTH = "#0072B2", "#CC3311", "#009E73"  # colours of the picture


@dataclass(frozen=True)
class Effect:
    """An observable with effective foils, and its changes (%) to even foils, from even ones to holes, and in all."""

    p: float  # GeV/c
    observable: str
    effective: float
    effective_error: float
    even: float
    even_error: float
    holes: float
    holes_error: float
    both: float
    both_error: float


def observables(
    detector: Detector, foil: str, believed: Detector, p: float, events: int, seed: int
) -> dict[str, float]:
    """Return the study's numbers of one batch; those of clusters at 1 GeV/c only, as in the study."""
    settings = Settings(simulate=SimulateSettings(foil=foil))
    gun = cg.Gun("mu-", p=p, cos_theta=COS_THETA)
    result = cg.run(detector, gun, events, seed, settings=settings, fit_detector=believed)
    found = {}
    if p == 1.0:
        clusters = cluster_residuals(result)
        found = {
            "X residual, RMS within 3 mm (µm)": x_widths(clusters, 3.0).rms,
            "X clusters of one strip": clusters.single_strip_fraction[0],
            "V residual, Gaussian (µm)": v_fit(clusters).sigma,
        }
    for name, unit in UNITS.items():
        found[f"sigma({name}) ({unit})"] = windowed_resolution(result.tracks, name).core
    return found


def effect(p: float, name: str, values: np.ndarray) -> Effect:
    """Return the changes of an observable from values (case, batch)."""
    effective, even, lattice = values
    mean, root = effective.mean(), math.sqrt(values.shape[1])
    numbers = [mean, effective.std(ddof=1) / root]
    for change in (even - effective, lattice - even, lattice - effective):
        numbers += [100 * change.mean() / mean, 100 * change.std(ddof=1) / root / mean]
    return Effect(p, name, *map(float, numbers))


def measure(share: float) -> Numbers:
    """Measure the observables of all foils at all momenta."""
    preset, events = cg.load(PRESET), share_of(EVENTS, share, 100)
    cases = [(preset, "effective"), (evened(preset), "effective"), (preset, "lattice")]
    seeds = [seed_of(SEED, batch) for batch in range(BATCHES)]
    rows = []
    for p in MOMENTA:
        found = [[observables(detector, foil, preset, p, events, seed) for seed in seeds] for detector, foil in cases]
        values = np.array([[list(batch.values()) for batch in case] for case in found])  # (case, batch, observable)
        rows += [effect(p, name, values[:, :, i]) for i, name in enumerate(found[0][0])]
    return Numbers(rows, {"events": f"{BATCHES} × {events} events at each momentum, seed {SEED}"})


def blocks(found: Found) -> dict[str, str]:
    """Return the table of the largest momentum, what was run, and the numbers of the text."""
    head = ["observable", "effective", "holes alone", "holes and matter"]
    lines = []
    for row in (row for row in found["effects"].rows if row.p == MOMENTA[-1]):
        changes = ((row.holes, row.holes_error), (row.both, row.both_error))
        cells = [f"{row.effective:.4g} ± {row.effective_error:.2g}"]
        lines.append([row.observable, *cells, *(f"{change:+.2f} ± {error:.2f} %" for change, error in changes)])
    built = cg.load("besiii-cgem")
    return {
        "sample": sample(found["effects"]),
        "effects": table(head, lines),
        "largest": f"{max(abs(row.holes) / row.holes_error for row in found['effects'].rows):.1f}",
        "x0-effective": f"{foil_x0(built):.3f}",
        "x0-holes": f"{foil_x0(evened(built)):.3f}",
    }


def foil_x0(detector: Detector) -> float:
    """Return X/X0 (%) of all foils at normal incidence, without holes."""
    return 100 * sum(layer.foils * part.thickness / part.material.x0 for layer in detector.cgem for part in layer.foil)


def evened(detector: Detector) -> Detector:
    """Return a detector whose foils have the lattice's matter, spread evenly."""
    solid = iter([coverage(slab.holes) for slab in slabs(detector, foil="lattice") if slab.holes])
    return replace(
        detector, barrels=tuple(replace(layer, foil=tuple(_evened(layer, solid))) for layer in detector.cgem)
    )


def _evened(layer: CgemLayer, solid: Iterator[float]) -> list[SubLayer]:
    parts = []
    for part, share in zip(layer.foil, [next(solid) for _ in range(layer.foils * len(layer.foil))], strict=False):
        full = part.material.solid()
        even = replace(full, name=f"{full.name}, even", density=full.density * share, x0=full.x0 / share)
        parts.append(replace(part, material=even))
    return parts


def coverage(holes: Holes) -> float:
    """Return which part of a sub-layer is solid: one minus the volume of a hole over that of its cell."""
    ends = sorted(abs(w) for w in (holes.begin, holes.end))
    edges = [(0.0, ends[0]), (0.0, ends[1])] if holes.begin < 0 < holes.end else [(ends[0], ends[1])]
    volume = 0.0
    for low, high in edges:
        a, b = (holes.waist + holes.widening * w for w in (low, high))
        volume += math.pi * (high - low) * (a * a + a * b + b * b) / 3
    return 1 - volume / ((holes.end - holes.begin) * math.sqrt(3) / 2 * holes.pitch**2)


def draw(found: Found) -> Figure:
    """Draw a cut through a GEM foil with tracks, and the matter of nine foils that tracks meet."""
    detector = cg.load("besiii-cgem")
    figure, (cut, matter) = plt.subplots(1, 2, figsize=(10.2, 3.6), width_ratios=(1.25, 1), dpi=90)
    draw_foil(cut, [slab.holes for slab in slabs(detector, foil="lattice") if slab.holes][:3])
    rng = np.random.default_rng(1)
    bins = np.linspace(0.1, 0.72, 125)
    for slope, color in ((0.0, TRACK), (1.0, LENGTH)):
        x0 = 100 * foil_matter(detector, slope, 20_000, rng) / np.hypot(1, slope)
        angle = np.degrees(np.arctan(slope))
        matter.hist(x0, bins=bins, histtype="step", color=color, label=f"lattice, {angle:.0f} deg")
    matter.axvline(foil_x0(detector), color=MARK, ls="--", lw=1.4, label="effective, as in the preset")
    matter.set(xlabel="X/X0 of nine foils times cos(angle), %", ylabel="tracks")
    matter.legend(fontsize=8.5, frameon=False)
    figure.tight_layout()
    return figure


def foil_matter(detector: cg.Detector, slope: float, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return X/X0 of all foils along n straight lines that cross them at random places."""
    core, total, foil = compiled(detector, foil="lattice"), np.zeros(n), -1
    for number, slab in enumerate(slabs(detector, foil="lattice")):
        if slab.holes and slab.holes.foil != foil:
            foil, (i, j) = slab.holes.foil, rng.random((2, n)) * slab.holes.pitch
            line = {"u": i + j / 2, "v": j * np.sqrt(0.75), "slope_u": np.full(n, slope), "slope_v": np.zeros(n)}
        if slab.holes:
            total += slab.x0 * np.hypot(1, slope) * _core._testing.solid_fraction(core, number, **line)
    return total


def draw_foil(plot: Axes, parts: Sequence[Holes]) -> None:
    """Draw a foil cut along a row of holes, in um, with three tracks; thick where they meet matter."""
    for holes in parts:
        w = np.unique([holes.begin, np.clip(0.0, holes.begin, holes.end), holes.end])
        radius = holes.waist + holes.widening * np.abs(w)
        color = "#D98A4E" if holes.widening == 0 else "#F2D45C"  # copper, Kapton
        for i in range(-1, 5):
            left, right = i * holes.pitch + radius, (i + 1) * holes.pitch - radius
            plot.fill(1e3 * np.concatenate([left, right[::-1]]), 1e3 * np.concatenate([w, w[::-1]]), color=color, lw=0)
    w = np.linspace(-0.03, 0.03, 4001)
    for start, slope in ((0.030, 0.0), (0.1, 0.5), (0.35, 2.0)):
        u = start + slope * w
        solid = np.zeros(len(w), bool)
        for holes in parts:
            inside = (w >= holes.begin) & (w <= holes.end)
            off = np.abs(u - holes.pitch * np.round(u / holes.pitch))
            solid |= inside & (off > holes.waist + holes.widening * np.abs(w))
        far = np.array([-0.06, 0.06])
        plot.plot(1e3 * (start + slope * far), 1e3 * far, color="black", lw=0.9)
        plot.plot(1e3 * np.where(solid, u, np.nan), 1e3 * w, color=MARK, lw=2.6)
    plot.set(xlim=(-60, 520), ylim=(-60, 60), aspect="equal", xlabel="u along r phi (µm)", ylabel="w outward (µm)")


PAGE = Page("foils", "docs/methods/foils.md", "2 min", {"effects": (Effect, measure)}, blocks, {"foils.png": draw})
