"""Clusterers that expect other errors of their clusters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy.typing as npt
import pytest

from cgemit.detector.readouts import Readout, part_of
from cgemit.reconstruction.cluster import CLUSTERERS


def expect(
    monkeypatch: pytest.MonkeyPatch,
    readout: type[Readout],
    errors: Sequence[npt.ArrayLike] | None = None,
    correlations: npt.ArrayLike | None = None,
) -> None:
    """Give a readout a clusterer, which extends its own, with these expected errors and correlations."""
    given = {"expected_errors": errors, "expected_correlations": correlations}
    methods = {name: lambda *_, one=one: one for name, one in given.items() if one is not None}
    monkeypatch.setitem(CLUSTERERS, readout, type("Expecting", (part_of(readout(), CLUSTERERS),), methods))
