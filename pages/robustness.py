"""docs/methods/robustness.md: difficult tracks, and slow pions that begin beside the beam line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import cgemit as cg
from cgemit import helix
from cgemit.analysis.widths import share_error
from cgemit.helix import PARAMETERS
from cgemit.reconstruction.fit import fit
from cgemit.tables import Table
from cgemit.tables.schema import has_momentum
from pages.page import Found, Numbers, Page, share_of, table
from pages.scenarios import SCENARIOS, Outcome, run_scenario

EVENTS, PIONS = 10_000, 4000
DETECTOR = "besiii-cgem-design"
RADII = (0.0, 20.0, 35.0, 50.0, 70.0, 100.0)  # mm
RADII_SHOWN = (20.0, 35.0, 100.0)
FAR = 8.0  # errors

#: Scenarios in the table of the page.
SHOWN = (
    "plain", "end plates", "layers missing", "one CGEM layer, inner", "drift chamber only", "CGEM only",
    "much noise", "wrong cluster", "loopers", "slow pions 50", "slow pions 65", "K_S pions", "electrons", "protons",
)  # fmt: skip


@dataclass(frozen=True)
class Fitted:
    """Tracks of a scenario: per cent fitted, statuses of the others, core widths with errors, widths of pulls."""

    name: str
    text: str
    fitted: float
    fitted_error: float
    removed: str
    p: float  # %
    p_error: float
    dr: float  # um
    dr_error: float
    dz: float  # mm
    dz_error: float
    pull_dr: float
    pull_phi0: float
    pull_kappa: float
    pull_dz: float
    pull_tanl: float
    iterations: float


@dataclass(frozen=True)
class Begin:
    """Pions from a radius (mm) fitted with one `start_radius`: good tracks, and per cent of them.

    `far` have a pull beyond 8, of all, of those that fly outward, and of those that fly inward first; `kappa` is half
    the width that holds 68 % of the pulls of kappa; `displaced` are marked so, `far_displaced` of those that are far.
    """

    radius: float
    start_radius: str
    tracks: int
    far: float
    far_outward: float | None
    far_inward: float | None
    kappa: float
    displaced: float
    far_displaced: float


def fitted(outcome: Outcome) -> Fitted:
    """Return what the table says of one scenario."""
    share, total = outcome.efficiency, int(np.count_nonzero(outcome.enough))
    numbers = {"fitted": 100 * share, "fitted_error": 100 * share_error(share, total)}
    for name, factor in (("p", 100.0), ("dr", 1000.0), ("dz", 1.0)):
        width = outcome.resolution(name)
        numbers |= {name: factor * width.core, f"{name}_error": factor * width.core_error}
    numbers |= {f"pull_{name}": outcome.pull(name).core for name in PARAMETERS}
    removed = ", ".join(f"{n} {status}" for status, n in outcome.removed.items())
    iterations = float(np.mean(outcome.good["iterations"]))
    one = outcome.scenario
    return Fitted(one.name, one.text, removed=removed, iterations=iterations, **numbers)


def pions(radius: float, n: int, seed: int = 1) -> dict[str, np.ndarray]:
    """Return pions of 0.065 to 0.1 GeV/c that begin at a radius, in any direction, cos(theta) within 0.6."""
    random = np.random.default_rng(seed)
    azimuth, flight = random.uniform(-np.pi, np.pi, (2, n))
    pt, cos_theta = random.uniform(0.065, 0.1, n), random.uniform(-0.6, 0.6, n)
    return {
        "event": np.arange(n), "pdg": np.where(random.random(n) < 0.5, 211, -211),
        "px": pt * np.cos(flight), "py": pt * np.sin(flight), "pz": pt * cos_theta / np.sqrt(1 - cos_theta**2),
        "x": radius * np.cos(azimuth), "y": radius * np.sin(azimuth), "z": np.zeros(n),
    }  # fmt: skip


def samples(radius: float, n: int) -> tuple[cg.Result, Table, np.ndarray]:
    """Return a simulated run, its tracks fitted with the radius of their vertex, and this radius with its sign."""
    settings = cg.Settings(simulate=cg.SimulateSettings(decays=False))
    run = cg.run(DETECTOR, pions(radius, n), seed=1, settings=settings)
    where = run.candidates["event"]
    vertex = np.stack([run.particles[axis][where] for axis in "xyz"], axis=1)
    helices = np.stack([run.tracks[name] for name in PARAMETERS], axis=1)
    begin = helix.start_radius(helices, vertex, run.detector.field.bz)
    candidates = run.candidates.with_columns(start_radius=np.nan_to_num(begin))
    again = fit(run.detector, run.clusters, run.wire_hits, candidates, run.candidate_hits)["tracks"]
    return run, again, begin


def pulls(run: cg.Result, tracks: Table) -> np.ndarray:
    """Return the pulls of the five parameters, (n, 5)."""
    found = []
    for name in PARAMETERS:
        off = tracks[name] - run.matches[f"truth_{name}"]
        off = np.remainder(off + np.pi, 2 * np.pi) - np.pi if name == "phi0" else off
        found.append(off / tracks[f"err_{name}"])
    return np.stack(found, axis=1)


def begins(radius: float, n: int) -> list[Begin]:
    """Fit the pions of a radius without and with the radius of their vertex."""
    run, again, begin = samples(radius, n)
    rows = []
    for name, tracks in (("0", run.tracks), ("of the vertex", again)):
        good = has_momentum(tracks)
        pull = pulls(run, tracks)
        far = (np.abs(pull) > FAR).any(axis=1)
        outward, inward = (
            float(100 * far[good & mine].mean()) if (good & mine).any() else None for mine in (begin > 0, begin < 0)
        )
        half = 0.5 * np.subtract(*np.quantile(pull[good, 2], [0.8413, 0.1587]))
        marked = tracks["displaced"] == 1
        shares = (float(100 * marked[good & mine].mean()) for mine in (good, far))
        total = float(100 * far[good].mean())
        rows.append(Begin(radius, name, int(good.sum()), total, outward, inward, float(half), *shares))
    return rows


def measure_scenarios(share: float) -> Numbers:
    """Run all scenarios."""
    events = share_of(EVENTS, share, 100)
    return Numbers([fitted(run_scenario(one, events)) for one in SCENARIOS], {"events": str(events)})


def measure_begins(share: float) -> Numbers:
    """Fit the pions of all radii."""
    n = share_of(PIONS, share, 200)
    return Numbers([row for radius in RADII for row in begins(radius, n)], {"events": str(n)})


def blocks(found: Found) -> dict[str, str]:
    """Return the tables of both parts and the numbers of events."""
    lines = []
    for row in found["scenarios"].rows:
        if row.name not in SHOWN:
            continue
        cells = [f"{row.fitted:.2f}", f"{row.p:.2f}", f"{row.dr:.0f}", f"{row.pull_kappa:.2f}"]
        lines.append([f"{row.name}: {row.text}", *cells])
    head = ["tracks", "fitted, %", "σ(p)/p, %", "σ(d_ρ), µm", "pull of κ"]
    texts = {"events": found["scenarios"].about["events"], "scenarios": table(head, lines)}
    lines = []
    for one in found["begins"].rows:
        if one.radius not in RADII_SHOWN:
            continue
        lines.append(
            [f"{one.radius:g}", one.start_radius, f"{one.far:.1f}", f"±{one.kappa:.2f}", f"{one.displaced:.1f}"]
        )
    head = [
        "radius of origin, mm", "`start_radius`", "tracks with a pull beyond 8, %", "central 68 % of κ pulls",
        "`displaced` = 1, %",
    ]  # fmt: skip
    beside = [row for row in found["begins"].rows if row.radius >= RADII_SHOWN[1] and row.start_radius == "0"]
    far = [row.far_displaced for row in beside]
    texts |= {
        "marked": f"{min(far):.0f} to {max(far):.0f}",
        "marked-origin": f"{found['begins'].rows[0].displaced:.1f}",
    }
    return texts | {"pions": found["begins"].about["events"], "begins": table(head, lines)}


PAGE = Page(
    "robustness",
    "docs/methods/robustness.md",
    "3 min",
    {"scenarios": (Fitted, measure_scenarios), "begins": (Begin, measure_begins)},
    blocks,
)
