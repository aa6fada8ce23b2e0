"""Matter and hits against the angle: by hand, and beside matter at normal incidence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.detector import slabs
from cgemit.detector.inventory import part_of

AL = 88.97  # mm, radiation length of aluminium (PDG)
TUBE: dict[str, Any] = {
    "name": "tubes", "field": {"kind": "uniform", "bz": "1 T"},
    "layer": {
        "A": {"radius": "100 mm", "sigma": "20 um", "material": "Al", "thickness": "1 mm", "length": "400 mm"},
        "B": {"radius": "200 mm", "sigma": "20 um", "material": "Al", "thickness": "2 mm", "z_min": "-100 mm",
              "z_max": "600 mm"},
    },
}  # fmt: skip


def test_matter_by_hand() -> None:
    """A of 1 mm is crossed for |z| < 200 mm at 100 mm, B of 2 mm for -100 to 600 mm at 200 mm."""
    slopes = np.array([0.0, 1.0, 1.9, 2.1, 2.9, 3.1, -0.4, -0.6])  # z/r
    found = cg.material_scan(TUBE, slopes / np.hypot(1, slopes))
    path = np.hypot(1, slopes) * 100 / AL  # % for each mm
    in_a, in_b = np.abs(slopes) < 2, (slopes > -0.5) & (slopes < 3)
    np.testing.assert_allclose(found.x0["A"], 1 * path * in_a, rtol=2e-3)
    np.testing.assert_allclose(found.x0["B"], 2 * path * in_b, rtol=2e-3)
    np.testing.assert_allclose(found.total, sum(found.x0.values()), rtol=1e-12)
    assert found.hits["layers"].tolist() == (in_a * 1.0 + in_b).tolist()
    np.testing.assert_allclose(found.theta, np.arctan2(1, slopes))
    np.testing.assert_allclose(found.eta, np.arcsinh(slopes), atol=1e-12)


def test_a_border_within_a_shell_counts_in_part() -> None:
    """At z/r = 2 the line leaves A, of 99.5 to 100.5 mm and 200 mm long to each side, at r = 100 mm."""
    found = cg.material_scan(TUBE, [2 / math.sqrt(5)])
    assert float(found.x0["A"][0]) == pytest.approx(0.5 * math.sqrt(5) * 100 / AL, rel=2e-3)


@pytest.mark.parametrize("name", ["besiii-cgem", "idea-like", "belle2-like", "besiii-pixel"])
def test_matter_across_the_beam_is_that_of_all_slabs(name: str) -> None:
    detector = cg.load(name)
    by_part, by_material = (cg.material_scan(detector, [0.0], by=by) for by in ("part", "material"))
    total = 100 * sum(slab.x0 for slab in slabs(detector))
    assert float(by_part.total[0]) == pytest.approx(total, rel=1e-12)
    assert float(by_material.total[0]) == pytest.approx(total, rel=1e-12)
    assert set(by_material.x0) == {shell.material.name for slab in slabs(detector) for shell in slab.shells}
    assert set(by_part.x0) == {part_of(detector, slab) for slab in slabs(detector)}
    wires = len(detector.drift_chamber.layers) if detector.drift_chamber else 0
    hits = {kind: int(count[0]) for kind, count in by_part.hits.items()}
    assert hits.get("wires", 0) == wires
    assert hits.get("cgem", 0) + hits.get("layers", 0) == len([layer for layer in detector.layers if layer.views])


def test_wires_are_counted_where_tracks_are_expected_to_hit_them() -> None:
    """Nearly straight muons have a hit in each layer that they cross, and a second one in up to 7 % of them."""
    detector, cosines = cg.load("besiii-idc"), np.linspace(-0.9, 0.9, 10)
    ratio = cg.analytic(detector, p=50.0, cos_theta=cosines).n_wires / cg.material_scan(detector, cosines).hits["wires"]
    assert ((ratio >= 1) & (ratio < 1.08)).all()


def test_columns_and_text() -> None:
    found = cg.material_scan("besiii-cgem", [0.0, 0.6])
    columns = found.columns()
    assert columns["x0 (%)"] == found.total.tolist()
    assert columns["x0_L1 (%)"] == found.x0["L1"].tolist()
    assert columns["hits_cgem"] == [3, 3]
    assert f"{found.total[1]:.3f}" in str(found)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(([1.0],), "between -1 and 1"), (([],), "cos_theta"), (([[0.1]],), "cos_theta"), (([math.nan],), "cos_theta")],
)
def test_angles_that_make_no_sense(arguments: Any, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        cg.material_scan("besiii-cgem", *arguments)
    with pytest.raises(ValueError, match="part or material"):
        cg.material_scan("besiii-cgem", by="cause")  # type: ignore[arg-type]
