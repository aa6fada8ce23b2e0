"""Each kind of part works alone and in every combination with the others, in all that can be done with a detector."""

import itertools
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

import cgemit as cg
from cgemit.cli.main import main
from cgemit.detector import DetectorError, describe
from cgemit.detector.delphes import card_of

_DESIGN = tomllib.loads(cg.load("besiii-cgem-design").to_toml())
_GUN = cg.Gun("mu-", p=1.0, cos_theta=0.2)


def _sensor(radius: float, half_length: float) -> dict[str, str]:
    return _shell(radius, half_length, "50 um") | {"sigma": "20 um"}


def _shell(radius: float, half_length: float, thickness: str = "0.3 mm") -> dict[str, str]:
    """Return a layer that measures nothing."""
    return {"radius": f"{radius} mm", "length": f"{2 * half_length} mm", "thickness": thickness, "material": "Si"}


#: Sensors and shells lie inside and outside of the drift chamber.
SHELLS = {"SHELL": (70.0, 300.0), "COVER": (830.0, 1200.0)}
PARTS: dict[str, dict[str, Any]] = {
    "pipe": {"beam_pipe": _DESIGN["beam_pipe"]},
    "sensors": {"layer": {f"S{r}": _sensor(r, 300) for r in (40, 46, 52, 58, 64)} | {"OUT": _sensor(850, 1300)}},
    "shells": {"layer": {label: _shell(*size) for label, size in SHELLS.items()}},
    "cgem": {"cgem": _DESIGN["cgem"]},
    "walls": {"walls": _DESIGN["walls"]},
    "chamber": {"drift_chamber": _DESIGN["drift_chamber"]},
}
SUBSETS = [names for n in range(len(PARTS) + 1) for names in itertools.combinations(PARTS, n)]
MEASURING = [names for names in SUBSETS if {"sensors", "cgem", "chamber"} & set(names)]
#: A part alone or with shells, and all of them: the others are slow to draw.
FEW = [names for names in MEASURING if len(set(names) - {"shells"}) == 1 or len(names) == len(PARTS)]


def tables(names: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {"name": "+".join(names) or "none", "field": {"kind": "uniform", "bz": "-1 T"}}
    for name in names:
        for group, parts in PARTS[name].items():
            found[group] = found.get(group, {}) | parts
    return found


def _cylinders(detector: cg.Detector) -> list[Any]:
    return [*detector.beam_pipe, *detector.layer, *detector.walls]


def some(cases: Sequence[Sequence[str]], slow: bool = True) -> Any:
    """Parametrize with combinations; those that are not few are slow."""
    marks: Any = [pytest.mark.slow]
    return pytest.mark.parametrize(
        "names",
        [pytest.param(one, id="+".join(one) or "none", marks=[] if one in FEW or not slow else marks) for one in cases],
    )


@some(MEASURING, slow=False)
def test_tracks_are_simulated_found_and_fitted(names: Sequence[str]) -> None:
    """All particles are found and fitted, but for three CGEM layers alone, which hardly constrain the curvature."""
    detector, n = cg.load(tables(names)), 20
    for finder in ("truth", "ckf"):
        result = cg.run(detector, _GUN, n=n, seed=1, finder=finder, workers=1)
        fitted = int((result.tracks["status"] == 0).sum())
        assert fitted == n or not {"sensors", "chamber"} & set(names)
        assert fitted > 0 or finder == "ckf"
    views = 2 * len(detector.layers)
    assert np.median(cg.run(detector, _GUN, n=n, seed=1, workers=1).tracks["n_clusters"]) == views


@some(MEASURING, slow=False)
def test_resolutions_are_expected_split_and_derived(names: Sequence[str]) -> None:
    """Expected errors, budget, sensitivities and sweeps are numbers; the budget names each layer of matter."""
    detector = cg.load(tables(names))
    found = cg.analytic(detector, "mu-", p=1.0, cos_theta=0.2, threads=1)
    # Few of the tracks that stand for a direction pass through a seam.
    assert float(found.n_clusters) == pytest.approx(2 * len(detector.layers), abs=0.1)
    # Three layers alone do not measure the momentum of a muon of 1 GeV/c.
    for quantity in ("dr", "dz", "p") if np.isfinite(found.sigma("p")) else ("dr", "dz"):
        budget = found.budget(quantity)
        assert float(np.sum(budget.variances)) == pytest.approx(float(found.rms(quantity)) ** 2, rel=1e-6)
    inside = {"SHELL"} if "shells" in names else set()
    assert {source.part for source in budget.sources} >= inside
    assert "sensor" not in {source.part for source in budget.sources}
    derived = cg.sensitivity(detector, "mu-", p=1.0)
    assert len(derived.keys)
    assert np.isfinite(derived.values[:, : 3 if np.isfinite(found.sigma("p")) else 2]).all()
    evaluation = cg.study.Evaluation(p=1.0, quantities=["dr"])
    swept = cg.study.sweep(detector, {"field.bz": ["-1 T", "-0.9 T"]}, evaluation, workers=1)
    assert swept["status"].tolist() == ["ok"] * 3


@some(MEASURING, slow=False)
def test_a_detector_is_exported(names: Sequence[str], tmp_path: Path) -> None:
    """TOML is read back, GDML has a tube for each piece of matter, and a Delphes card holds what it can."""
    detector = cg.load(tables(names))
    assert cg.load(tomllib.loads(detector.to_toml())) == detector
    detector.to_gdml(tmp_path / "detector.gdml")
    tubes = ElementTree.parse(tmp_path / "detector.gdml").getroot().findall("solids/tube")
    labels = [tube.get("name") for tube in tubes]
    shells = [one for one in describe(detector)["material"] if one["part"].split()[0] in SHELLS]
    assert len(shells) == (len(SHELLS) if "shells" in names else 0)
    assert len([name for name in labels if "_sensor_" in name]) == len(detector.layer)
    (tmp_path / "card.tcl").write_text(card_of(detector), encoding="utf-8")
    again = cg.load(tmp_path / "card.tcl")
    assert {label for label in SHELLS if "shells" in names} <= {part.label for part in _cylinders(again)}
    x0 = [
        [(part.r_out - part.r_in) / part.material.x0 for part in _cylinders(one) if part.label in SHELLS]
        for one in (detector, again)
    ]
    assert x0[1] == pytest.approx(x0[0], rel=1e-3)


@some(MEASURING)
def test_a_detector_is_drawn_and_shown(names: Sequence[str], tmp_path: Path) -> None:
    """`show` writes all its files and pictures, and events are drawn."""
    file = tmp_path / "detector.toml"
    file.write_text(cg.load(tables(names)).to_toml(), encoding="utf-8")
    assert main(["show", str(file), "-o", str(tmp_path / "out"), "--gdml", "--delphes"]) == 0
    assert {"r-phi.png", "r-z.png", "detector.gdml", "detector.tcl"} <= {
        one.name for one in (tmp_path / "out").iterdir()
    }
    assert cg.draw.event(cg.run(file, _GUN, n=1, seed=1, workers=1), 0).axes


@some([names for names in MEASURING if "shells" in names], slow=False)
def test_a_layer_of_matter_is_a_wall(names: Sequence[str]) -> None:
    """Cylinders of the same matter give the same tracks, whether they are layers or walls."""
    layered = cg.load(tables(names))
    walls = {
        label: {"r_in": f"{r - 0.15} mm", "r_out": f"{r + 0.15} mm", "half_length": f"{half} mm", "material": "Si"}
        for label, (r, half) in SHELLS.items()
    }
    other = tables([name for name in names if name != "shells"])
    walled = cg.load(other | {"walls": other.get("walls", {}) | walls})
    for name in ("truths", "wire_truths", "tracks"):
        one, two = (cg.run(detector, _GUN, n=10, seed=2, workers=1).tables[name] for detector in (layered, walled))
        for column in one:
            np.testing.assert_array_equal(one[column], two[column], err_msg=f"{name}: {column}")
    for quantity in ("dr", "p"):  # the momentum is NaN where three layers alone do not measure it
        one, two = (cg.analytic(detector, "mu-", p=1.0, threads=1).sigma(quantity) for detector in (layered, walled))
        np.testing.assert_array_equal(one, two)


@some([names for names in SUBSETS if names not in MEASURING], slow=False)
def test_nothing_that_measures_is_refused(names: Sequence[str]) -> None:
    """One message names what is missing."""
    with pytest.raises(DetectorError, match="nothing that measures") as error:
        cg.load(tables(names))
    assert len(error.value.problems) == 1
