"""Slow pions that begin beside the beam line, fitted with and without `start_radius`.

`python validation/begins.py 4000` prints the table of docs/methods/robustness.md.
"""

from __future__ import annotations

import sys

import numpy as np

import cgemit as cg
from cgemit import helix
from cgemit.helix import PARAMETERS
from cgemit.reconstruction.fit import FitStatus, fit
from cgemit.tables import Table

DETECTOR = "besiii-cgem-design"
RADII = (0.0, 20.0, 35.0, 50.0, 70.0, 100.0)  # mm
FAR = 8.0  # errors
HEAD = (
    "begin at mm",
    "start_radius",
    "tracks",
    "a pull beyond 8, %",
    "outward %",
    "inward first %",
    "68 % of pulls of kappa",
    "displaced %",
    "of those beyond 8, %",
)


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
    fitted = np.stack([run.tracks[name] for name in PARAMETERS], axis=1)
    begin = helix.start_radius(fitted, vertex, run.detector.field.bz)
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


def rows(n: int) -> list[tuple[str, ...]]:
    """Return the rows of the table, two for each radius."""
    found = []
    for radius in RADII:
        run, again, begin = samples(radius, n)
        for name, tracks in (("0", run.tracks), ("of the vertex", again)):
            good = tracks["status"] == FitStatus.ok
            pull = pulls(run, tracks)
            far = (np.abs(pull) > FAR).any(axis=1)
            shares = [
                f"{100 * far[good & mine].mean():.1f}"
                for mine in (begin > -1, begin > 0, begin < 0)
                if (good & mine).any()
            ]
            shares[0] = f"{100 * far[good].mean():.1f}"
            half = 0.5 * np.subtract(*np.quantile(pull[good, 2], [0.8413, 0.1587]))
            marked = tracks["displaced"] == 1
            shares = [*(shares + ["–"] * 3)[:3], f"±{half:.2f}"]
            shares += [f"{100 * marked[good & mine].mean():.1f}" for mine in (good, far)]
            found.append((f"{radius:g}", name, str(int(good.sum())), *shares))
    return found


def table(n: int) -> str:
    """Return the table as Markdown."""
    lines = [HEAD, tuple("---" for _ in HEAD), *rows(n)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


if __name__ == "__main__":
    sys.stdout.write(table(int(sys.argv[1]) if len(sys.argv) > 1 else 4000))
