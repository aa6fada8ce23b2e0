"""Normal equations of one track, and derivatives by constants as finite differences of its predictions."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

import cgemit as cg
from cgemit import _core
from cgemit.calibration.constants import Constant, columns_of, constants_of, of_single_wires
from cgemit.detector.layers.layer import PLACEMENT
from cgemit.fit_matter import tuned
from dense import ERROR, PRIOR
from tracks import MUON

Floats = npt.NDArray[np.float64]
STEPS = {"mm": 1e-3, "rad": 1e-5, "ns": 1e-2, "": 1e-4}  # of finite differences


def rigid(detector: cg.Detector) -> tuple[Constant, ...]:
    """Return the constants that displace layers that make clusters, and the chamber."""
    return tuple(
        one
        for one in constants_of(detector)
        if one.key in PLACEMENT
        and not one.name.startswith(("drift_chamber.layers.", "drift_chamber.plates."))
        and ".sheets." not in one.name
    )


def predictions(detector: cg.Detector, helix: Floats, hits: dict[str, Any], values: dict[str, float]) -> Floats:
    moved = tuned(detector.with_alignment(values), momentum_error=ERROR)
    return np.asarray(_core._testing.reference(moved, helix, MUON, hits)["predicted"])


def derivatives(detector: cg.Detector, helix: Floats, hits: dict[str, Any], constants: tuple[Constant, ...]) -> Floats:
    """Return the derivatives of the predictions, (hits, constants), as differences with two steps."""
    found = []
    for one in constants:
        step = STEPS[one.unit]
        up, down = (predictions(detector, helix, hits, {one.name: sign * step}) for sign in (1, -1))
        found.append((up - down) / (2 * step))
    return np.stack(found, axis=1)


def summed(
    core: _core.detector.Detector, detector: cg.Detector, helix: Floats, hits: dict[str, Any],
    constants: tuple[Constant, ...], *, scalar: bool = False,
) -> dict[str, Any]:  # fmt: skip
    n, single = len(hits["kind"]), of_single_wires(constants)
    wire = hits["kind"] == 2
    used = {
        "used": np.ones(n, np.uint8), "used_variance": hits["sigma"] ** 2,
        "used_value": np.where(wire, hits["value"] * hits["side"], hits["value"]),
    }  # fmt: skip
    return _core.calibration.sums(
        core, columns=columns_of(detector, constants), hit_offsets=np.array([0, n]), hits=hits | used,
        reference=np.atleast_2d([helix[0], helix[1] + 0.5 * np.pi, *helix[2:]]), kinks=np.zeros((1, 2 * core.n_slabs)),
        mass=np.array([MUON]), charge=np.ones(1), matter_p=np.zeros(1), start_radius=np.zeros(1),
        prior_sigma=list(PRIOR), bias=not single, scalar=scalar, blocks=[0, len(constants)] if single else [],
    )  # fmt: skip
