"""docs/validation.md is what validation/results say, and these are within the tolerances that the page states."""

from __future__ import annotations

import re

from sources import ROOT

import deltas
from geant4_page import page
from geant4_reference import ANGLES, cases
from geant4_results import read_results

PAGE = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")


def test_page_is_up_to_date() -> None:
    """Write it anew with `python validation/geant4.py`."""
    assert page(*read_results(), deltas.section()) == PAGE


def test_pictures_of_the_page_exist() -> None:
    pictures = re.findall(r"!\[[^]]*\]\((\S+)\)", PAGE)
    assert len(pictures) >= 3
    assert all((ROOT / "docs" / picture).exists() for picture in pictures)


def test_results_hold_every_reference_and_agree() -> None:
    rows, about = read_results()
    assert {(row.slab, row.p) for row in rows} == set(cases())
    assert about["reference"].startswith("Geant4")
    gated = [row for row in rows if row.gated]
    assert {row.quantity for row in gated} == {*ANGLES, "loss_kev_q50", "loss_kev_q99"}
    assert not [row for row in gated if not row.agrees]


def test_a_number_that_is_off_is_marked() -> None:
    rows, about = read_results()
    wrong = [type(row)(**{**vars(row), "value": 1.2 * row.value}) for row in rows]
    assert "**(off)**" in page(wrong, about)
    assert "**(off)**" not in PAGE
