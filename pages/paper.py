"""Renew the numbers of docs/paper.md: ``python docs/paper_numbers.py [--batches N] [--threads N]``, some minutes.

Rows of the tables that have an id come from ``cgemit study`` with seed 1. The table of other choices has runs of its
own: batches of events with the same seeds for every choice, so that particles and most of the noise are the same;
differences are taken batch by batch, and their scatter over batches is the error. Words stay as they are.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import cgemit as cg
from cgemit.analysis.clusters import cluster_residuals, x_beyond, x_widths
from cgemit.analysis.curves import windowed_resolution
from cgemit.study.paper import COS_THETA, DETECTORS, THIN_GAP, Reproduction
from cgemit.study.samples import seed_of
from cgemit.tables.show import with_error

PAGE = Path(__file__).resolve().parent / "paper.md"
SEED, BATCH = 11, 5000
PARAMETERS = {"dr": "d_rho (um)", "dz": "d_z (mm)", "p": "p (MeV/c)"}


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
        Choice("wires of 110 um", overrides={"drift_chamber.sigma": "110 um"}),
        Choice("wires of 150 um", overrides={"drift_chamber.sigma": "150 um"}),
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


def main() -> None:
    """Measure, and write the numbers into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batches", type=int, default=12, help=f"of {BATCH} events for each choice")
    parser.add_argument("--threads", type=int, default=None)
    given = parser.parse_args()
    text = with_study(PAGE.read_text(encoding="utf-8"), cg.study.reproduce(threads=given.threads))
    table = effects(choices(), given.batches, given.threads)
    begin, end = "<!-- begin effects -->\n", "<!-- end effects -->"
    (before, _), (_, after) = text.split(begin), text.split(end)
    PAGE.write_text(f"{before}{begin}{table}\n{end}{after}", encoding="utf-8")


def with_study(text: str, study: Reproduction) -> str:
    """Return the page with the study's numbers in the rows that name them by id."""

    def put(found: re.Match[str]) -> str:
        row = study[found[2]]
        return f"{found[1]}{with_error(row.value, row.error)} |"

    share, error = x_beyond(study.samples["cgem"].clusters)
    beyond = with_error(100 * share, 100 * error)
    text = re.sub(r"(\| `(\w+)` \| (?:[\d.]+|–) \| )[^|]*\|", put, text)
    return re.sub(r"(\| residuals beyond 3 mm \| \| \| )[^|]*\|", lambda m: f"{m[1]}{beyond} % |", text)


def effects(others: Sequence[Choice], batches: int, threads: int | None) -> str:
    """Return the table of other choices: widths, their change against the first, X residual and single strips."""
    head = ("", *PARAMETERS.values(), "X RMS within ±3 mm (um)", "X clusters of one strip")
    lines = [f"{batches * BATCH} tracks for each choice, seed {SEED}, cgemit {cg.__version__}:", ""]
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    nominal = None
    for choice in others:
        found = np.array([numbers(choice, seed_of(SEED, batch), threads) for batch in range(batches)])
        nominal = found if nominal is None else nominal
        lines.append(line(choice, found, nominal))
        print(lines[-1], flush=True)
    return "\n".join(lines)


def numbers(choice: Choice, seed: int, threads: int | None) -> list[float]:
    """Return widths of d_rho, d_z and p, the RMS of the X residual and the fraction of single strips of a batch."""
    detector = cg.load(choice.detector).with_overrides(dict(choice.overrides))
    if choice.magnet is not None:
        detector = detector.with_field(choice.magnet)
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-choice.cos_theta, choice.cos_theta))
    result = cg.run(detector, gun, BATCH, seed, settings=choice.settings, threads=threads)
    widths = [getattr(windowed_resolution(result.tracks, name), choice.width) for name in PARAMETERS]
    if not detector.cgem:
        return [*widths, math.nan, math.nan]
    residuals = cluster_residuals(result)
    return [*widths, x_widths(residuals).rms, residuals.single_strip_fraction[0]]


def line(choice: Choice, found: np.ndarray, nominal: np.ndarray) -> str:
    """Return a line of the table from values (batch, quantity)."""
    n, cells = len(found), []
    for i in range(len(PARAMETERS)):
        change = 100 * (found[:, i] - nominal[:, i]) / nominal[:, i].mean()
        text = f"{found[:, i].mean():.4g}"
        if found is not nominal and choice.detector == DETECTORS[0]:
            text += f" ({change.mean():+.1f} ± {change.std(ddof=1) / math.sqrt(n):.1f} %)"
        cells.append(text)
    x, single = found[:, 3].mean(), found[:, 4].mean()
    cells += ["–", "–"] if math.isnan(x) else [f"{x:.4g}", f"{single:.3f}"]
    return f"| {choice.title} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
