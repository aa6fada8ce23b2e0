"""docs/paper.md: numbers of the study, and the effect of other choices.

The study's numbers are those of ``cgemit study`` with seed 1. Other choices have runs of their own: batches of events
with the same seeds for every choice, so that particles and most of the noise are the same; differences are taken batch
by batch, and their scatter over batches is the error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

import cgemit as cg
from cgemit.analysis.clusters import cluster_residuals, x_beyond, x_widths
from cgemit.analysis.curves import windowed_resolution
from cgemit.covariance.result import Covariance
from cgemit.study.evaluation import seed_of
from cgemit.study.paper import COS_THETA, DETECTORS, THIN_GAP
from cgemit.tables.show import with_error
from pages.page import Found, Numbers, Page, sample, share_of, table

SEED, BATCHES, BATCH = 11, 12, 5000
#: Choices that the page leaves out; the numbers on file have all.
LEFT_OUT = (
    "cos(theta) within ±0.6", "efficiency of cells 0.95", "field of +1 T", "`--field besiii` within ±0.6",
    "`--field finite-solenoid`", "sides of wires given", '`foil="lattice"`', "wires of 110 µm",
    "efficiency of cells 0.9", "`FitSettings(delta_strips=0)`", "both of them", "`besiii-idc`", "`besiii-idc-boss`",
)  # fmt: skip
#: Numbers of the study that the page shows.
SHOWN = (
    "x_residual_rms", "x_residual_core", "x_single_strip_fraction", "v_residual_sigma",
    "sigma_dr", "sigma_dz", "sigma_p", "sigma_dr_idc", "sigma_dz_idc", "sigma_p_idc",
)  # fmt: skip
PARAMETERS = {"dr": "d_rho (µm)", "dz": "d_z (mm)", "p": "p (MeV/c)"}


@dataclass(frozen=True)
class Number:
    """A number of the study by its id; "beyond_3mm" is the per cent of X residuals beyond 3 mm."""

    id: str
    value: float
    error: float


@dataclass(frozen=True)
class Effect:
    """Core widths for a choice, their changes (%) where it is one of the study's detector, X residual and clusters."""

    title: str
    dr: float
    dr_change: float | None
    dr_error: float | None
    dz: float
    dz_change: float | None
    dz_error: float | None
    p: float
    p_change: float | None
    p_error: float | None
    x_rms: float | None  # um, within 3 mm
    single_strip: float | None  # fraction of the X clusters


@dataclass(frozen=True)
class Choice:
    """What is done otherwise than in the study."""

    title: str
    detector: str = DETECTORS[0]
    overrides: Mapping[str, object] = field(default_factory=dict)
    magnet: str | None = None
    cos_theta: float = COS_THETA[1]
    settings: cg.Settings = field(default_factory=cg.Settings)
    width: str = "core"


def choices() -> list[Choice]:
    """Return the study's own choice and all others, in the order of the table."""

    def changed(**stages: object) -> cg.Settings:
        return replace(cg.Settings(), **stages)  # type: ignore[arg-type]

    gap = {f"cgem.{layer.label}.drift_gap": f"{THIN_GAP:g} mm" for layer in cg.load(DETECTORS[0]).cgem}
    no_deltas = cg.SimulateSettings(deltas=False)
    gaussian = cg.SimulateSettings(fluctuations="gaussian")
    blind = cg.FitSettings(delta_strips=0)
    return [
        Choice("as in the study"),
        Choice("drift gap 3 mm", overrides=gap),
        Choice("cos(theta) within ±0.8", cos_theta=0.8),
        Choice("cos(theta) within ±0.6", cos_theta=0.6),
        Choice("wires of 110 µm", overrides={"drift_chamber.sigma": "110 um"}),
        Choice("wires of 150 µm", overrides={"drift_chamber.sigma": "150 um"}),
        Choice('`drift_chamber.wires = "smeared"`', overrides={"drift_chamber.wires": "smeared"}),
        Choice("efficiency of cells 0.95", overrides={"drift_chamber.efficiency": 0.95}),
        Choice("efficiency of cells 0.9", overrides={"drift_chamber.efficiency": 0.9}),
        Choice("field of +1 T", overrides={"field.bz": "1 T"}),
        Choice("`--field besiii`", magnet="besiii"),
        Choice("`--field besiii` within ±0.6", magnet="besiii", cos_theta=0.6),
        Choice("`--field finite-solenoid`", magnet="finite-solenoid"),
        Choice("RMS within five core widths", width="rms"),
        Choice(
            '`FitSettings(cluster_errors="cluster")`', settings=changed(fit=cg.FitSettings(cluster_errors="cluster"))
        ),
        Choice("sides of wires given", settings=changed(digitize=cg.DigitizeSettings(reveal_sides=True))),
        Choice('`screening="moliere"`', settings=changed(simulate=cg.SimulateSettings(screening="moliere"))),
        Choice('`foil="lattice"`', settings=changed(simulate=cg.SimulateSettings(foil="lattice"))),
        Choice("no delta electrons (`--no-deltas`)", settings=changed(simulate=no_deltas)),
        Choice("`FitSettings(delta_strips=0)`", settings=changed(fit=blind)),
        Choice("both of them", settings=changed(simulate=no_deltas, fit=blind)),
        Choice('no delta electrons, no tails: `fluctuations="gaussian"`', settings=changed(simulate=gaussian)),
        Choice("`besiii-idc`", detector="besiii-idc"),
        Choice("`besiii-idc-boss`", detector="besiii-idc-boss"),
    ]


def measure_study(share: float) -> Numbers:
    """Run the study."""
    events = share_of(20_000, share, 600)
    study = cg.study.reproduce(events=events)
    share, error = x_beyond(study.samples["cgem"].clusters)
    rows = [Number(row.id, row.value, row.error) for row in study.results]
    return Numbers([*rows, Number("beyond_3mm", 100 * share, 100 * error)], {"events": f"{events} events, seed 1"})


def measure_found(share: float) -> Numbers:
    """Run the study with found tracks; keep the resolutions."""
    events = share_of(20_000, share, 600)
    study = cg.study.reproduce(events=events, finder="ckf")
    rows = [Number(row.id, row.value, row.error) for row in study.results if row.id.startswith("sigma_")]
    return Numbers(rows, {"events": f"{events} events, seed 1"})


def measure_choices(share: float) -> Numbers:
    """Measure every choice."""
    events, rows, nominal = share_of(BATCH, share, 200), [], None
    for choice in choices():
        found = np.array([numbers(choice, events, seed_of(SEED, batch)) for batch in range(BATCHES)])
        nominal = found if nominal is None else nominal
        rows.append(effect(choice, found, nominal))
    return Numbers(rows, {"events": f"{BATCHES * events} tracks for each choice, seed {SEED}"})


def numbers(choice: Choice, events: int, seed: int) -> list[float]:
    """Return widths of d_rho, d_z and p, the RMS of the X residual and the fraction of single strips of a batch."""
    detector = cg.load(choice.detector).with_overrides(dict(choice.overrides))
    if choice.magnet is not None:
        detector = detector.with_field(choice.magnet)
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-choice.cos_theta, choice.cos_theta))
    result = cg.run(detector, gun, events, seed, settings=choice.settings)
    widths = [windowed_resolution(result.tracks, name) for name in PARAMETERS]
    found = [width.rms if choice.width == "rms" else width.core for width in widths]
    if not detector.cgem:
        return [*found, math.nan, math.nan]
    residuals = cluster_residuals(result)
    return [*found, x_widths(residuals).rms, residuals.single_strip_fraction[0]]


def effect(choice: Choice, found: np.ndarray, nominal: np.ndarray) -> Effect:
    """Return the effect of a choice from values (batch, quantity)."""
    compared = found is not nominal and choice.detector == DETECTORS[0]
    cells: dict[str, float | None] = {}
    for i, name in enumerate(PARAMETERS):
        change = 100 * (found[:, i] - nominal[:, i]) / nominal[:, i].mean()
        cells[name] = float(found[:, i].mean())
        cells[f"{name}_change"] = float(change.mean()) if compared else None
        cells[f"{name}_error"] = float(change.std(ddof=1)) / math.sqrt(len(found)) if compared else None
    x, single = (None if math.isnan(value) else float(value) for value in found[:, 3:].mean(axis=0))
    return Effect(choice.title, **cells, x_rms=x, single_strip=single)  # type: ignore[arg-type]


def blocks(found: Found) -> dict[str, str]:
    """Return the numbers of the study that are shown, and the table of other choices."""
    shown = {row.id: with_error(row.value, row.error) for row in found["study"].rows if row.id in SHOWN}
    lines = []
    for row in found["choices"].rows:
        if row.title in LEFT_OUT:
            continue
        cells = [
            _changed(row.dr, row.dr_change, row.dr_error),
            _changed(row.dz, row.dz_change, row.dz_error),
            _changed(row.p, row.p_change, row.p_error),
        ]
        cells += ["–" if row.x_rms is None else f"{row.x_rms:.4g}"]
        lines.append([row.title, *cells])
    head = ["", *PARAMETERS.values(), "X RMS within ±3 mm (µm)"]
    return {**shown, **_texts(found), "sample": sample(found["choices"]), "choices": table(head, lines)}


def _texts(found: Found) -> dict[str, str]:
    """Return the numbers of the text."""
    study = {row.id: row.value for row in found["study"].rows}
    (no_deltas,) = (row.x_rms for row in found["choices"].rows if row.title.startswith("no delta electrons (`"))
    both_edges = 1e3 * cg.load(DETECTORS[0]).cgem[0].pitch_v / math.sqrt(24)
    ratios = [row.value / study[row.id] for row in found["found"].rows]
    own, fixed = (cg.analytic(DETECTORS[0], "mu-", p=1.0, readout=readout) for readout in ("binary", "gaussian"))
    return {
        "no-deltas": f"{no_deltas:.0f}",
        "v-wider": f"{100 * (study['v_residual_sigma'] / both_edges - 1):.0f}",
        **{f"matter-{name}": f"{_share_of_matter(own, name):.0f}" for name in ("dr", "p")},
        "found": f"{100 * max(abs(ratio - 1) for ratio in ratios):.1f}",
        "inclined": f"{study['sigma_dr']:.0f}",
        "binary": f"{float(own.sigma_dr):.1f}",
        "gaussian": f"{float(fixed.sigma_dr):.1f}",
    }


def _share_of_matter(covariance: Covariance, quantity: str) -> float:
    """Return which per cent of a variance scattering and straggling contribute."""
    budget = covariance.budget(quantity).to_pandas()
    return 100 * float(budget["share"][budget["source"].str.endswith(("scattering", "straggling"))].sum())


def _changed(value: float, change: float | None, error: float | None) -> str:
    return f"{value:.4g}" if change is None else f"{change:+.1f} ± {error:.1f} %"


PAGE = Page(
    "paper", "docs/paper.md", "5 min",
    {"study": (Number, measure_study), "found": (Number, measure_found), "choices": (Effect, measure_choices)}, blocks,
)  # fmt: skip
