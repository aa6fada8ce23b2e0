"""docs/methods/vertex.md: vertices and masses of pairs, and the two halves of cosmic muons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import cgemit as cg
from cgemit.analysis.vertices import with_truth
from cgemit.reconstruction.fit import fit
from cgemit.reconstruction.vertex import begin_at_vertices
from cgemit.tables.show import with_error
from pages.page import Found, Numbers, Page, share_of, table

DETECTOR, EVENTS, COSMICS, SEED = "besiii-cgem", 3000, 4000, 1
BEAM_PIPE = 28.0  # mm
#: Sample -> label, masses of the two tracks.
SAMPLES = {
    "ks-pipi": ("`ks-pipi`, 0.2–1.2 GeV/c", ("pi", "pi")),
    "lambda-ppi": ("`lambda-ppi`, 0.3–1.2 GeV/c", ("p", "pi")),
    "pipi-jpsi": ("J/psi → mu mu of `pipi-jpsi`", ("mu", "mu")),
}
QUANTITIES = (("x", 1.0), ("z", 1.0), ("mass", 1e3))  # factors to mm, MeV/c2
LATE = (80.0, 110.0)  # mm, decays behind the beam pipe


@dataclass(frozen=True)
class Width:
    """Core widths of a residual (mm, MeV/c2) and of its pull."""

    sample: str
    quantity: str
    width: float
    pull: float
    pull_error: float


@dataclass(frozen=True)
class Late:
    """Pull of the mass of K_S that decay behind the beam pipe: width and median."""

    fit: str
    width: float
    median: float
    n: int


@dataclass(frozen=True)
class Mass:
    """Core width of the pull of the mass of Lambda whose tracks are fitted as muons."""

    pull: float
    pull_error: float


@dataclass(frozen=True)
class Half:
    """Core widths of halves of cosmic muons; quantities and units as of `cgemit.study.cosmics`."""

    quantity: str
    unit: str
    difference: float
    difference_error: float
    residual: float
    residual_error: float
    one_track: float
    one_track_error: float
    pull: float
    pull_error: float


def widths(share: float) -> Numbers:
    """Fit the vertices of all samples and compare them with the truth."""
    events = share_of(EVENTS, share, 200)
    rows = []
    for name, (_, masses) in SAMPLES.items():
        found = _inside(_vertices(_run(name, events), masses), 0.0, BEAM_PIPE)
        if masses == ("mu", "mu"):
            found = found[found["truth_mass"] > 3.0]  # the pions are a pair, too
        for quantity, factor in QUANTITIES:
            pull = cg.study.measure(found[f"pull_{quantity}"], parameter=quantity)
            width = factor * cg.study.measure(found[f"res_{quantity}"], parameter=quantity).core
            rows.append(Width(name, quantity, width, pull.core, pull.core_error))
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def late(share: float) -> Numbers:
    """Fit K_S behind the beam pipe with all matter down to the origin, and from their vertex on."""
    events = share_of(4 * EVENTS, share, 400)
    result = _run("ks-pipi", events)
    first = _vertices(result, ("pi", "pi"))
    begun = begin_at_vertices(DETECTOR, result.candidates, result.fitted, first)
    again = fit(result.detector, result.clusters, result.wire_hits, begun, result.candidate_hits)["tracks"]
    second = with_truth(
        cg.fit_vertices(DETECTOR, again, particles=("pi", "pi")), again, result.matches, result.particles
    )
    rows = []
    for name, found in (("all matter", first), ("from the vertex", second)):
        pull = _inside(found, *LATE)["pull_mass"]
        rows.append(Late(name, cg.study.measure(pull, parameter="mass").core, float(np.median(pull)), len(pull)))
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def wrong(share: float) -> Numbers:
    """Fit Lambda from tracks with the mass of a muon."""
    events, settings = share_of(EVENTS, share, 200), cg.Settings(fit=cg.FitSettings(hypothesis="mu"))
    result = cg.run(DETECTOR, cg.sample("lambda-ppi"), events, SEED, settings=settings)
    pulls = _inside(_vertices(result, SAMPLES["lambda-ppi"][1]), 0.0, BEAM_PIPE)["pull_mass"]
    found = cg.study.measure(pulls, parameter="mass")
    return Numbers([Mass(*_core(found))], {"events": f"{events:,} events, seed {SEED}"})


def halves(share: float) -> Numbers:
    """Compare both halves of cosmic muons."""
    events = share_of(COSMICS, share, 400)
    found = cg.study.cosmics(_run("cosmic", events))
    assert found.truth is not None
    assert found.one_track is not None
    rows = [
        Half(
            name, found.halves[name].unit, *_core(found.halves[name]), *_core(found.truth[name]),
            *_core(found.one_track[name]), *_core(found.pulls[name]),
        )
        for name in ("dr", "dz", "p")
    ]  # fmt: skip
    return Numbers(rows, {"events": f"{events:,} events, seed {SEED}"})


def _run(sample: str, events: int) -> cg.Result:
    return cg.run(DETECTOR, cg.sample(sample), events, SEED)


def _vertices(result: cg.Result, particles: tuple[str, str]) -> cg.Table:
    found = cg.fit_vertices(DETECTOR, result.fitted, particles=particles)
    return with_truth(found, result.fitted, result.matches, result.particles)


def _inside(vertices: cg.Table, least: float, most: float) -> cg.Table:
    """Return the good vertices whose true distance from the beam line is in this range, mm."""
    radius = np.hypot(vertices["truth_x"], vertices["truth_y"])
    return vertices[(vertices["status"] == 0) & (radius >= least) & (radius < most)]


def _core(found: cg.Resolution) -> tuple[float, float]:
    return found.core, found.core_error


def blocks(found: Found) -> dict[str, str]:
    """Return both tables and the numbers of late decays."""
    head = ["sample", "σ(x) mm", "σ(z) mm", "σ(mass) MeV/c²", "pull of x", "of z", "of the mass"]
    lines = []
    for name, (label, _) in SAMPLES.items():
        rows = {row.quantity: row for row in found["widths"].rows if row.sample == name}
        pulls = [f"{rows[q].pull:.2f} ± {rows[q].pull_error:.2f}" for q, _ in QUANTITIES]
        lines.append([label, *(f"{rows[q].width:.3g}" for q, _ in QUANTITIES), *pulls])
    first, second = found["late"].rows
    late_text = f"the width of the mass pull from {first.width:.2f} to {second.width:.2f} and its median from "
    late_text += f"{first.median:.2f} to {second.median:.2f}"
    cosmics = [
        [f"{row.quantity} ({row.unit.replace('um', 'µm')})", with_error(row.difference, row.difference_error),
         with_error(row.residual, row.residual_error), with_error(row.one_track, row.one_track_error),
         with_error(row.pull, row.pull_error)]
        for row in found["halves"].rows
    ]  # fmt: skip
    return {
        "events": found["widths"].about["events"],
        "vertices": table(head, lines),
        "late": late_text,
        "muons": found["halves"].about["events"],
        "wrong": f"{found['wrong'].rows[0].pull:.1f}",
        "cosmics": table(["", "difference/√2", "true residual", "one track", "pull of the difference"], cosmics),
    }


PAGE = Page(
    "vertex", "docs/methods/vertex.md", "20 s",
    {"widths": (Width, widths), "late": (Late, late), "wrong": (Mass, wrong), "halves": (Half, halves)}, blocks,
)  # fmt: skip
