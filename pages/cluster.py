"""docs/methods/cluster.md: errors of binary clusters by layer and number of strips, and where they hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import cgemit as cg
from cgemit.analysis.widths import measure
from cgemit.detector.core import layer_table
from cgemit.reconstruction.clusterers.binary import MAX_SIZE, cluster_errors, reference_widths
from cgemit.truth import assign
from pages.page import Found, Numbers, Page, share_of, table

DETECTOR, SEED, TRACKS = "besiii-cgem-design", 3, 20_000
THIN = "3 mm"  # drift gap
#: Momenta of the tracks and of the reference sample, GeV/c.
MOMENTA = ((0.5, 1.0), (0.2, 1.0), (0.5, 0.5), (0.2, 0.2))


@dataclass(frozen=True)
class Pull:
    """RMS of the pulls of X clusters of mu-, with the errors of a reference momentum (GeV/c)."""

    p: float
    reference_p: float
    n: int
    rms: float
    rms_error: float


def pulls(share: float) -> Numbers:
    """Compare X clusters with the truth; delta electrons are off."""
    n, rows = share_of(TRACKS, share, 500), []
    detector, simulate = cg.load(DETECTOR), cg.SimulateSettings(deltas=False, decays=False)
    for p, reference in MOMENTA:
        settings = cg.Settings(simulate=simulate, cluster=cg.ClusterSettings(reference_p=reference))
        gun = cg.Gun("mu-", p=p, cos_theta=(-0.93, 0.93))
        result = cg.run(detector, gun, n, SEED, settings=settings, until="cluster")
        own = assign.own_clusters(detector, result.clusters, result.truths)
        own = own[result.clusters["view"][own] == 0]
        residual = assign.residuals(detector, result.clusters, result.truths, own)
        found = measure(residual / result.clusters["err_x"][own])
        rows.append(Pull(p, reference, found.n, found.rms, found.rms_error))
    return Numbers(rows, {"events": f"{n:,} mu- a momentum, cos(theta) uniform in ±0.93, seed {SEED}"})


def _reference(detector: cg.Detector) -> str:
    """Return RMS residual and share of clusters of one strip in X, over all sizes of the reference sample."""
    columns, squares, single, crossings = layer_table(detector.cgem), 0.0, 0.0, 0
    for i in range(len(detector.cgem)):
        layer = {name: column[i] for name, column in columns.items()}
        pitch, width = layer["pitch_x"], np.abs(reference_widths(layer, detector.field.bz, cg.ClusterSettings())[0])
        for n in range(1, MAX_SIZE):
            length = np.maximum(pitch - width if n == 1 else np.minimum(n * pitch - width, width - (n - 2) * pitch), 0)
            squares += float(np.sum(length**3)) / (12 * pitch)
            single += float(np.sum(length)) / pitch if n == 1 else 0.0
        crossings += len(width)
    return f"{1e3 * (squares / crossings) ** 0.5:.1f} µm, {100 * single / crossings:.1f} %"


def blocks(found: Found) -> dict[str, str]:
    """Return the table of the design, in um, and the numbers within the text."""
    design = cg.load(DETECTOR)
    lines = []
    for layer, x, v in zip(design.cgem, *cluster_errors(design, cg.ClusterSettings()), strict=True):
        x, v = 1e3 * x, 1e3 * v[:9]
        wide = ", ".join(f"{error:.0f}" for error in x[2:5])
        lines.append([layer.label, f"{x[0]:.1f}", f"{x[1]:.1f}", wide, f"{v.min():.1f} to {v.max():.1f}"])
    fixed, own = ([row for row in found["pulls"].rows if (row.p == row.reference_p) is same] for same in (False, True))
    fixed_text = " and ".join(f"{row.rms:.1f} at {row.p:g} GeV/c" for row in fixed)
    return {
        "errors": table(["", "1 X strip", "2 X strips", "3, 4, 5 X strips", "V, 1 to 9 strips"], lines),
        "reference": _reference(design),
        "thin": _reference(design.with_overrides({"cgem.*.drift_gap": THIN})),
        "fixed": fixed_text,
        "own": " and ".join(f"{row.rms:.2f}" for row in own),
    }


PAGE = Page("cluster", "docs/methods/cluster.md", "5 s", {"pulls": (Pull, pulls)}, blocks)
