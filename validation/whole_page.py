"""docs/validation.md: the comparison with Geant4, then the fit."""

from __future__ import annotations

from fit_page import fit_section
from fit_results import FitResults, read_fit_results
from geant4_page import Results, page, read_results


def whole_page(geant4: Results | None = None, fit: FitResults | None = None) -> str:
    """Return the page as Markdown; what is not given is read from validation/results."""
    return page(geant4 or read_results()) + fit_section(fit or read_fit_results())
