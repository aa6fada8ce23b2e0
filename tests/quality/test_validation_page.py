"""docs/validation.md is what validation/results say, and these are within the tolerances that the page states."""

from __future__ import annotations

import dataclasses
import re

from sources import ROOT

from cgemit.study.windows import X_WINDOWS
from delta_fractions import ARRANGEMENTS, DISTANCES, failures
from geant4_page import page, read_results
from geant4_reference import ANGLES, cases

PAGE = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")


def test_page_is_up_to_date() -> None:
    """Write it anew with `python validation/geant4.py`."""
    assert page(read_results()) == PAGE


def test_pictures_of_the_page_exist() -> None:
    pictures = re.findall(r"!\[[^]]*\]\((\S+)\)", PAGE)
    assert len(pictures) == 4
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
    assert "**(off)**" not in PAGE
