"""README.md: its picture, the numbers of its table, and the output of its example."""

from __future__ import annotations

import contextlib
import io
import os
import re
import tempfile
import tomllib
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import cgemit as cg
from cgemit.analysis.curves import Line
from cgemit.analysis.quantities import QUANTITIES
from cgemit.draw.curves import draw_curves
from cgemit.draw.style import style
from pages import covariance, geant4, paper, performance, presets
from pages.page import ROOT, Found, Page, span

DETECTORS = ("besiii-cgem-design", "besiii-idc")
MOMENTA = [0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4, 2.0]  # GeV/c
ANGLES = (-0.8, 0.8)  # of cos(theta): tracks cross all layers


def example() -> str:
    """Return the Python example of README.md."""
    (text,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)
    return str(text)


def run_example(code: str, folder: Path) -> tuple[str, dict[str, object]]:
    """Run an example in a folder; return what it prints, and its variables."""
    before, names, printed = Path.cwd(), dict[str, object](), io.StringIO()
    os.chdir(folder)
    try:
        with contextlib.redirect_stdout(printed):
            exec(compile(code, "README.md", "exec"), names)
    finally:
        os.chdir(before)
    return printed.getvalue(), names


def printed() -> str:
    """Return what the example prints."""
    with tempfile.TemporaryDirectory() as folder:
        return run_example(example(), Path(folder))[0]


def resolutions(found: Found) -> Figure:
    """Draw sigma(d_rho) and sigma(d_z) of both detectors against momentum: analytic lines, simulated points."""
    detectors = [cg.load(name) for name in DETECTORS]
    fine = np.geomspace(0.15, 2.0, 40).tolist()
    scans = [cg.study.scan_analytic(one, fine, cos_theta=ANGLES) for one in detectors]
    scans += [cg.study.scan(one, MOMENTA, cos_theta=ANGLES, events=5000) for one in detectors]
    curves: list[Line] = [line for scan in scans for line in scan.all_lines]
    with style():
        figure, axes = plt.subplots(1, 2, figsize=(10.4, 3.7), dpi=100)
        for plot, name in zip(axes, ("dr", "dz"), strict=True):
            draw_curves(plot, [line for line in curves if line.id == f"sigma_{name}"], QUANTITIES[name].sigma, "p")
            plot.set_ylim(bottom=0)
            plot.legend(loc="upper right", fontsize=8.5)
        figure.suptitle(
            r"$\mu^-$, |cos $\theta$| < 0.8, 5000 simulated muons a point", x=0.01, ha="left", fontsize=10.5
        )
        figure.tight_layout()
    return figure


def blocks(found: Found) -> dict[str, str]:
    """Return the numbers of the table, from the numbers on file of other pages."""
    slabs = [row for row in geant4.PAGE.read()["slabs"].rows if row.gated]
    peers = performance.PAGE.read()
    fits = [row for row in peers["peers"].rows if row.what.startswith("the same with tables")]
    faster = [row.acts_us / row.us for row in fits if row.case.startswith("1 GeV")]
    found_by = sorted(peers["peers_finding"].rows, key=lambda row: row.tracks)
    finding = [(row.acts_seeding_us + row.acts_ckf_us) / (row.find_us + row.fit_us) for row in found_by]
    ratios = [row.ratio for row in covariance.PAGE.read()["ratios"].rows]
    study = {row.id: row for row in paper.PAGE.read()["study"].rows}
    cgem, idc = (cg.analytic(name, "mu-", p=MOMENTA, cos_theta=ANGLES) for name in DETECTORS)
    epic = presets.PAGE.read()["epic"].rows
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {
        "repository": f"<{project['urls']['Repository']}>",
        "angle": span([row.value / row.reference for row in slabs if row.quantity == "q68_mrad"]),
        "loss": span([row.value / row.reference for row in slabs if row.quantity == "loss_kev_q50"]),
        "speed": f"{min(faster):.1f} to {max(faster):.1f}",
        "speed-finding": f"{finding[0]:.1f} to {finding[-1]:.1f}",
        "ratios": span(np.percentile(ratios, [2.5, 97.5]).tolist()),
        "points": f"{len(ratios)}",
        "better-dz": span((idc.sigma_dz / cgem.sigma_dz).tolist()),
        "worse-dr": span((cgem.sigma_dr / idc.sigma_dr).tolist()),
        "epic": span([row.expected / row.published for row in epic if row.quantity != "p"]),
        "epic-p": span([row.expected / row.published for row in epic if row.quantity == "p"]),
        "dr": f"{study['sigma_dr'].value:.0f}",
        "dz": f"{study['sigma_dz'].value:.2f}",
        "p": f"{study['sigma_p'].value:.1f}",
        "printed": f"```text\n{printed()}```",
    }


PAGE = Page("readme", "README.md", "20 s", blocks=blocks, pictures={"resolution.png": resolutions})
