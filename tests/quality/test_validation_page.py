"""docs/validation.md is what validation/results say, and these are within the tolerances that the page states.

What the program does now is compared with the same tolerances in tests/physics: test_validation.py (slabs),
test_deltas.py, test_validation_fit.py and test_optimal_estimate.py (widths).
"""

from __future__ import annotations

import dataclasses
import math
import re

from sources import ROOT

from cgemit.analysis.clusters import X_WINDOWS
from cgemit.particles.species import species
from delta_fractions import ARRANGEMENTS, DISTANCES, failures
from fit_page import fit_section
from fit_results import ANGLES as FIT_ANGLES
from fit_results import DETECTORS, N_SIGMA, PARTICLES, Pull, read_fit_results, wrong_sides
from geant4_page import page, read_results
from geant4_reference import ANGLES, cases
from optimal import QUANTITIES
from whole_page import whole_page

PAGE = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")


def test_page_is_up_to_date() -> None:
    """Write it anew with `python validation/geant4.py` or `python validation/fit.py --page`."""
    assert whole_page() == PAGE


def test_pictures_of_the_page_exist() -> None:
    pictures = re.findall(r"!\[[^]]*\]\((\S+)\)", PAGE)
    assert len(pictures) == 7
    assert all((ROOT / "docs" / picture).exists() for picture in pictures)


def test_results_hold_every_reference_and_agree() -> None:
    results = read_results()
    assert {(row.slab, row.p) for row in results.slabs} == set(cases())
    assert all(about["reference"].startswith("Geant4") for about in results.about.values())
    gated = [row for row in results.slabs if row.gated]
    assert {row.quantity for row in gated} == {*ANGLES, "loss_kev_q50", "loss_kev_q99"}
    assert not [row for row in gated if not row.agrees]
    assert {row.arrangement for row in results.fractions} == set(ARRANGEMENTS)
    deltas = {(row.view, row.distance) for row in results.fractions if row.gated}
    assert deltas == {(view, distance) for view in ("r-phi", "z") for distance in DISTANCES}
    assert not failures(results.fractions)
    assert {row.quantity for row in results.residuals} == {*X_WINDOWS, "beyond_3mm", "single_strip"}


def test_a_number_that_is_off_is_marked() -> None:
    results = read_results()
    angles = [dataclasses.replace(row, value=1.2 * row.value) for row in results.slabs]
    fractions = [dataclasses.replace(row, percent=1.4 * row.percent) for row in results.fractions]
    sections = [dataclasses.replace(results, slabs=angles), dataclasses.replace(results, fractions=fractions)]
    assert all("**(off)**" in page(wrong) for wrong in sections)
    assert "**(off)**" not in page(results)


def slowness(row: Pull) -> float:
    """Return p beta in GeV/c, to which angles of scattering are inversely proportional."""
    mass = species(row.particle).mass
    return row.p**2 / math.hypot(row.p, mass)


def test_fit_holds_the_whole_grid_and_agrees() -> None:
    """What is off is the mean of pulls whose error changes with the estimate, by as much as has been worked out."""
    results = read_fit_results()
    grid = {(name, p, angle, particle) for name in DETECTORS for particle, momenta in PARTICLES.items()
            for p in momenta for angle in FIT_ANGLES}  # fmt: skip
    assert {"K-", "proton"} < PARTICLES.keys()
    for mode in ("gaussian", "default"):
        found = {(row.detector, row.p, row.cos_theta, row.particle) for row in results.pulls if row.mode == mode}
        assert found == grid
    assert {row.parameter for row in results.pulls} == {*QUANTITIES}
    off = [row for row in results.pulls if row.mode == "gaussian" and not row.agrees]
    assert all(slowness(row) < 0.25 and row.cos_theta >= 0.5 for row in off)
    # p, which joined the pulls last, has a bias of its own in three rows of 35000 tracks and more.
    momenta = {(row.detector, row.particle, row.p) for row in off if row.parameter == "p"}
    assert momenta <= {
        ("besiii-cgem-design", "pi+", 0.2), ("besiii-cgem", "pi+", 0.1), ("besiii-cgem", "proton", 0.35)
    }  # fmt: skip
    off = [row for row in off if row.parameter != "p"]
    assert {row.parameter for row in off} <= {"kappa", "dz", "tanl"}
    # The slowest protons scatter as muons of 0.19 GeV/c do: kappa is 2 to 3 % too narrow.
    assert all(abs(row.width - 1) <= (0.035 if row.particle == "proton" else row.tolerances[0]) for row in off)
    worked_out = [row for row in off if row.expected_mean]
    assert {row.p for row in worked_out if row.particle not in ("proton", "K-")} <= {0.2}
    assert {(row.p, row.particle) for row in worked_out} >= {(0.35, "proton"), (0.35, "K-")}
    # The second derivatives of one point of protons, near which a track stops, do not exist.
    stops = ("besiii-cgem-design", "proton", 0.35, 0.5)
    biases = [row for row in worked_out if (row.detector, row.particle, row.p, row.cos_theta) != stops]
    assert all(abs(row.bias - row.expected_bias) < N_SIGMA * row.mean_error for row in biases)
    assert all(abs(row.mean - row.expected_mean) < N_SIGMA * row.mean_error for row in worked_out)
    assert all(abs(row.bias) < 0.05 for row in off)
    assert not [row for rows in (results.chi2, results.widths) for row in rows if not row.agrees]
    assert not [row for row in results.residuals if row.p > 0.15 and not row.agrees]


def test_fit_agrees_in_the_default_simulation() -> None:
    results = read_fit_results()
    off = [row for row in results.pulls if row.mode == "default" and not row.agrees]
    assert not [row for row in off if row.detector == DETECTORS[0]]
    # Of the others dz and tanl of steep tracks of 0.1 GeV/c that turn back, and one kappa by chance (0.945 with more).
    assert all(row.p < 0.15 and row.cos_theta == 0.8 for row in off if row.parameter in ("dz", "tanl"))
    assert {(row.detector, row.p, row.particle) for row in off if row.parameter == "kappa"} <= {
        ("besiii-idc", 0.5, "pi-")
    }
    assert all(abs(row.width - 1) < 0.1 and abs(row.mean) < 0.08 for row in off)


def test_fit_finds_sides_and_loses_no_resolution() -> None:
    results = read_fit_results()
    for row in results.known:
        assert row.agrees
        assert wrong_sides(results.sides, row.p) < 1e-3
    assert all(row.agrees for row in results.losses)


def test_a_pull_that_is_off_is_marked() -> None:
    results = read_fit_results()
    wide = dataclasses.replace(results, pulls=[dataclasses.replace(row, width=1.3) for row in results.pulls])
    assert fit_section(wide).count("**(off)**") > fit_section(results).count("**(off)**")
