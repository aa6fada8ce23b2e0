"""docs/paper.md: the table of linear covariances of an independent program, beside the optimal estimate and the fit.

An independent program made the table. The optimal linear covariance at 90 degrees goes step by step from the table's
model to that of the fit; the last line has the widths of simulated tracks where all is Gaussian.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import cgemit as cg
from cgemit.base.arrays import Floats
from cgemit.detector import Slab
from cgemit.detector.readouts import GaussianReadout
from cgemit.reconstruction.fit import PARAMETERS, FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.study import resolution
from pages.optimal import WIRE, Hit, Stack, TracedSlab, V, X, errors, optimum, stack_of
from pages.page import Found, Numbers, Page, share_of

DESIGN, AS_BUILT, IDC = "besiii-cgem-design", "besiii-cgem", "besiii-idc"
#: p (GeV/c) and cos(theta): sigma(d_rho) um, sigma(d_z) mm, sigma(p) MeV/c of mu-. Exact helix; Highland's formula with
#: one logarithm for the track; no energy loss; pipe of 0.982 % of a radiation length; X 138.7 um, V 132.7 um, wires
#: 130 um with known sides, one hit a layer.
TABLE = {
    DESIGN: {
        (0.2, 0.0): (475.0, 0.607, 0.568),
        (0.5, 0.0): (236.6, 0.339, 1.707),
        (1.0, 0.0): (160.7, 0.2585, 4.912),
        (1.5, 0.0): (133.0, 0.239, 9.820),
        (1.0, 0.6): (192.8, 0.315, 4.567),
        (1.0, 0.8): (249.3, 0.463, 4.398),
    },
    AS_BUILT: {(1.0, 0.0): (170.2, 0.265, 4.948)},
    IDC: {(0.5, 0.0): (169.4, 0.996, 1.450), (1.0, 0.0): (108.9, 0.982, 4.185)},
}
#: The table's errors of hits, and no noise but Gaussian.
READOUT, SIDES = GaussianReadout(sigma_x=0.1387, sigma_v=0.1327), DigitizeSettings(reveal_sides=True)
GAUSSIAN: dict[str, Any] = {
    "readout": READOUT,
    "settings": cg.Settings(simulate=SimulateSettings(fluctuations="gaussian", decays=False), digitize=SIDES),
}
_PIPE = 0.00982
_SIGMA = {X: 0.1387, V: 0.1327, WIRE: 0.13}
_MUON = 0.1056583755


class LosslessSlab(TracedSlab):
    """Matter that scatters like the fit's and takes no energy."""

    def loss(self, p: Floats, mass: float, path: Floats) -> tuple[Floats, Floats]:
        """Nothing is lost."""
        return 0 * p, 0 * p


class HighlandSlab(LosslessSlab):
    """Matter of the table: a share `part` of a total in radiation lengths, without loss."""

    def __init__(self, slab: Slab, part: float, total: float) -> None:
        super().__init__(slab, 0.0, 0.0, 0.0)
        self.part, self.total = part, total

    def angle(self, p: float, after: float, mass: float, path: float) -> float:
        """(13.6 MeV/(p beta)) sqrt(x/X0) [1 + 0.038 ln(T/beta^2)], T the track's total; PDG 2024, eq. 34.16."""
        beta2 = p * p / (p * p + mass * mass)
        logarithm = 1 + 0.038 * np.log(self.total / beta2)
        return float(13.6e-3 / (p * np.sqrt(beta2)) * np.sqrt(self.part * path) * logarithm)


def table_stack(detector: cg.Detector, tanl: float, error: float) -> list[TracedSlab]:
    """Return the matter of the table, which has a pipe of its own."""
    found = [traced.slab for traced in stack_of(detector, tanl, error)]
    pipe = sum(slab.x0 for slab in found if slab.shells[0].group == "pipe")
    parts = [slab.x0 * (_PIPE / pipe if slab.shells[0].group == "pipe" else 1) for slab in found]
    total = float(np.hypot(1, tanl)) * sum(parts)
    return [HighlandSlab(slab, part, total) for slab, part in zip(found, parts, strict=True)]


def lossless_stack(detector: cg.Detector, tanl: float, error: float) -> list[TracedSlab]:
    """Return the matter of the fit without energy loss."""
    found = stack_of(detector, tanl, error)
    return [LosslessSlab(one.slab, one.whole_xi, one.acting_chi_c2, error, by_hits=one.by_hits) for one in found]


SIMULATED = "simulated, 20 000 tracks"
STEPS: dict[str, tuple[Stack, bool]] = {
    "the table's model": (table_stack, True),
    "scattering from elements, pipe of the preset": (lossless_stack, True),
    "energy loss": (stack_of, True),
    "all cells that fire": (stack_of, False),
}


def hits_of(result: cg.Result, track: int, one_a_layer: bool) -> list[Hit]:
    """Return the hits of an event with one track, ordered outward; of a layer's cells all, or the nearest."""
    clusters = result.clusters[(result.clusters["event"] == track) & (result.clusters["view"] < WIRE)]
    rows = zip(*(clusters[name].tolist() for name in ("view", "layer", "sheet")), strict=True)
    found = sorted(((layer, view, sheet) for view, layer, sheet in rows))
    hits = [Hit(view, layer, sheet, _SIGMA[view]) for layer, view, sheet in found]
    wires = result.wire_hits[result.wire_hits["event"] == track]
    cells = sorted(zip(*(wires[name].tolist() for name in ("layer", "drift", "wire")), strict=True))
    seen: set[int] = set()
    for layer, _, wire in cells:
        if not (one_a_layer and layer in seen):
            hits.append(Hit(WIRE, layer, wire, _SIGMA[WIRE]))
        seen.add(layer)
    return hits


def expected(
    detector: cg.Detector, p: float, matter: Stack, one_a_layer: bool, tracks: int = 12
) -> tuple[Floats, float]:
    """Return sigma(d_rho) um, sigma(d_z) mm, sigma(p) MeV/c at 90 degrees, and the number of cells of a track.

    Means over some tracks: the number of cells differs from one to the next.
    """
    gun = cg.Gun("mu-", p=p, cos_theta=0.0)
    settings = cg.Settings(
        simulate=SimulateSettings(fluctuations="off", decays=False), digitize=SIDES, fit=FitSettings()
    )
    result = cg.run(detector, gun, tracks, 5, settings=settings, readout=READOUT)
    found, cells = [], 0
    for track in range(tracks):
        hits = hits_of(result, track, one_a_layer)
        helix = np.array([result.tracks[name][track] for name in PARAMETERS])
        helix[[0, 2, 3, 4]] = 0.0, -1 / p, 0.0, 0.0
        sigma = errors(helix, optimum(detector, hits, helix, _MUON, matter=matter).cov)
        found.append([1000 * sigma["dr"], sigma["dz"], 1000 * sigma["p"]])
        cells += sum(hit.kind == WIRE for hit in hits)
    return np.mean(found, axis=0), cells / tracks


def simulated(detector: cg.Detector, p: float, n: int) -> Floats:
    """Return the core widths of fitted tracks where all is Gaussian."""
    tracks = cg.run(detector, cg.Gun("mu-", p=p, cos_theta=0.0), n, 2, **GAUSSIAN).tracks
    return np.array([resolution(tracks, name).core for name in ("dr", "dz", "p")])


@dataclass(frozen=True)
class Step:
    """Widths of a detector at 90 degrees in one step, and the mean number of cells of a track."""

    detector: str
    p: float  # GeV/c
    step: str
    wires: float
    dr: float  # um
    dz: float  # mm
    sigma_p: float  # MeV/c


def measure(share: float) -> Numbers:
    """Work out all steps for each detector and momentum."""
    events, rows = share_of(20_000, share, 200), []
    tracks = share_of(12, share, 1)
    for name, points in TABLE.items():
        detector = cg.load(name)
        for p in [p for p, angle in points if angle == 0]:
            found = {step: expected(detector, p, *choice, tracks) for step, choice in STEPS.items()}
            found = {"the table": (np.array(points[p, 0.0]), found["the table's model"][1]), **found}
            found[SIMULATED] = simulated(detector, p, events), found["all cells that fire"][1]
            rows += [Step(name, p, step, cells, *map(float, values)) for step, (values, cells) in found.items()]
    return Numbers(rows, {"events": f"{events} simulated tracks, hits of {tracks}"})


def blocks(found: Found) -> dict[str, str]:
    """Return how far the programs, and simulated tracks, agree."""
    return _agreement(found["steps"].rows)


def _agreement(rows: Sequence[Step]) -> dict[str, str]:
    """Return the largest difference (%) of both programs, and of simulated tracks from the last covariance."""
    steps = {(row.detector, row.p, row.step): row for row in rows}
    found = {}
    for name, one, other in (
        ("programs", "the table's model", "the table"), ("tracks", SIMULATED, "all cells that fire")
    ):  # fmt: skip
        pairs = [(row, steps[row.detector, row.p, other]) for row in rows
                 if row.step == one and (row.detector, row.p, other) in steps]  # fmt: skip
        off = [getattr(a, key) / getattr(b, key) - 1 for a, b in pairs for key in ("dr", "dz", "sigma_p")]
        found[name] = f"{100 * max(map(abs, off)):.1f}"
    return found


PAGE = Page("linear_table", "docs/paper.md", "5 min", {"steps": (Step, measure)}, blocks)
