"""The search for the best design of one objective, its rounding to whole strips, and what it took."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from cgemit.detector import Detector
from cgemit.detector.parts import CgemLayer
from cgemit.detector.variants import matching, value_at
from cgemit.study.optimizer.descent import Descent, NoStartError
from cgemit.study.optimizer.evaluator import Design, Evaluator
from cgemit.study.optimizer.goals import Goal
from cgemit.study.optimizer.variables import Variable, changes_of

#: Most times that hits are renewed, and the step, in units of the ranges, below which they need not be.
_ROUNDS, _MOVED = 6, 2e-3


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes
    ----------
    designs : tuple of Design
        All that were evaluated, in order; the last one is the optimum if `kind` says so.
    gradients : int
        Number of gradients.
    message : str
        How the search ended.
    """

    designs: tuple[Design, ...]
    gradients: int
    message: str


def search(
    evaluator: Evaluator,
    variables: tuple[Variable, ...],
    objective: Goal,
    *,
    method: Literal["gradient", "cobyla"],
    tolerance: float,
    steps: int,
    progress: Callable[[float, str], None] | None,
) -> Found:
    """Return the designs of a search from the base's own values.

    Parameters
    ----------
    evaluator : Evaluator
    variables : tuple of Variable
        All continuous.
    objective : Goal
    method : "gradient" or "cobyla"
    tolerance : float
        Relative change of the objective at which "gradient" ends, and of the variables, in units of their ranges, at
        which "cobyla" ends.
    steps : int
        Most iterations of "gradient", most designs of "cobyla".
    progress : callable or None

    Raises
    ------
    NoStartError
        If the start is impossible.
    """
    descent = Descent(evaluator, variables, objective, fixed_hits=method == "gradient", progress=progress)
    own = [one.start(evaluator.base) for one in variables]
    pairs = zip(own, variables, strict=True)
    first = np.array([(value - one.low) / (one.high - one.low) for value, one in pairs])
    descent.start(first)
    message = (_with_gradients if method == "gradient" else _without)(descent, first, tolerance, steps)
    best = _best(descent)
    if best is None:
        message = with_failures(f"{message}; no design keeps all limits", descent.designs)
        return Found(tuple(descent.designs), descent.gradients, message)
    values = rounded(evaluator.base, variables, best.values)
    row = evaluator.rows([changes_of(variables, values)])[0]
    if not evaluator.allowed(row):  # filling the sheet went over a limit
        values, row = best.values, best.row
    designs = (*descent.designs, Design(len(descent.designs) + 1, "optimum", values, row))
    return Found(designs, descent.gradients, with_failures(message, designs))


def with_failures(message: str, designs: Sequence[Design]) -> str:
    """Return how a search ended: if evaluations failed, how many and why the first one did, and no success.

    Parameters
    ----------
    message : str
        Of the search.
    designs : sequence of Design
    """
    failed = [one.row for one in designs if one.row["status"] == "failed"]
    if not failed:
        return message
    ended = message.replace(" successfully", "")
    return f"{ended}; {len(failed)} of {len(designs)} evaluations failed, the first with {failed[0]['problems'][0]}"


def _with_gradients(descent: Descent, u: Any, tolerance: float, steps: int) -> str:
    """Minimize with fixed hits, renew the hits at the minimum, and repeat until this changes nothing."""
    from scipy.optimize import minimize

    limits = {"type": "ineq", "fun": descent.margins, "jac": descent.margin_slopes}
    descent.renew(u)
    message = ""
    for _ in range(_ROUNDS):
        found: Any = minimize(
            descent.value, u, jac=descent.slope, method="SLSQP", bounds=[(0.0, 1.0)] * len(u), constraints=[limits],
            options={"ftol": tolerance, "maxiter": steps},
        )  # fmt: skip
        new = np.clip(found.x, 0, 1)
        moved, message = float(np.abs(new - u).max()), str(found.message)
        try:
            descent.renew(new)
        except NoStartError as error:  # the last step touched another part
            return f"{message}; {error}"
        u = new
        if moved < _MOVED:
            break
    return message


def _without(descent: Descent, u: Any, tolerance: float, steps: int) -> str:
    from scipy.optimize import minimize

    limits = {"type": "ineq", "fun": descent.margins}
    found: Any = minimize(
        descent.value, u, method="COBYLA", bounds=[(0.0, 1.0)] * len(u), constraints=[limits],
        options={"rhobeg": 0.2, "tol": tolerance, "maxiter": steps},
    )  # fmt: skip
    return str(found.message)


def _best(descent: Descent) -> Design | None:
    """Return the allowed design with the lowest objective, of those with their own hits."""
    header = descent.objective.header
    allowed = [one for one in descent.designs if one.kind == "value" and descent.evaluator.allowed(one.row)]
    return min(allowed, key=lambda one: float(one.row["values"][header]), default=None)


def rounded(base: Detector, variables: tuple[Variable, ...], values: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return values in which a pitch of one layer is such that whole strips fill the sheet.

    The number of strips stays. X strips fill the sheet around the layer, V strips the sheet across them. A pitch that
    several layers share, and one that would leave its range, stay as they are.

    Parameters
    ----------
    base : Detector
    variables : tuple of Variable
    values : tuple
        Of the variables.
    """
    found = list(values)
    for view in "xv":  # V strips cross the X strips: these come first
        detector = base.with_overrides(dict(changes_of(variables, found)))
        for i, one in enumerate(variables):
            paths = list(matching(base, one.key, [])) if "," not in one.key else []
            if len(paths) != 1 or not paths[0].endswith(f".pitch_{view}") or one.before:
                continue
            layer = next(layer for layer in detector.cgem if paths[0] == f"cgem.{layer.label}.pitch_{view}")
            now = value_at(detector, paths[0])
            wanted = found[i] * _filling(layer, view) / now[0] if now else found[i]
            # Downward in the last of the eight digits, so that the last strip still fits.
            wanted = math.floor(wanted * 10 ** (7 - _digits(wanted))) / 10 ** (7 - _digits(wanted))
            found[i] = wanted if one.low <= wanted <= one.high else found[i]
    return tuple(found)


def _digits(value: float) -> int:
    return math.floor(math.log10(value))


def _filling(layer: CgemLayer, view: str) -> float:
    """Return the pitch with which the strips of a view fill the sheet."""
    width = 2 * math.pi * layer.r_readout / layer.sheets
    if view == "x":
        return width / layer.strips_x
    across = layer.strips_x * layer.pitch_x * math.cos(layer.stereo) + layer.length * math.sin(abs(layer.stereo))
    return across / (layer.strips_v + layer.offset_v)
