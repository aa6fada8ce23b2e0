"""Matter and momentum errors that the fit assumes, from expected fits of muons (docs/methods/matter.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain, pairwise
from typing import Any, NamedTuple

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Flags, Floats
from cgemit.detector.core import compiled
from cgemit.detector.detector import Detector
from cgemit.detector.keys import once
from cgemit.detector.layers import Layer
from cgemit.particles.species import species
from cgemit.units import GEV_PER_T_MM

#: Relative error of momenta that straggling is counted for where the field measures none.
USUAL_MOMENTUM_ERROR = _core.matter.USUAL_MOMENTUM_ERROR
_MUON = species("mu-").mass
_MOMENTUM = 1.0  # GeV/c, of that muon
_KAPPA = 2  # its number among the parameters
_TANL = 4
#: Errors of momenta are worked out at these transverse momenta, over the one that turns back at the last measurement,
#: and at these tan(lambda).
_TRANSVERSE = np.geomspace(0.35, 5.6, 7)
_SLOPES = np.array([0.0, 0.6, 1.2, 1.6, 2.0, 2.5])
#: GeV/c. In weak fields the grid is that of tracks which turn back with this transverse momentum: slower ones stop.
_LEAST_TURNING = 0.06


def tuned(
    detector: Detector,
    screening: str = "wentzel",
    loss: str = "truncated",
    radiation: bool = True,
    *,
    merge: bool = True,
    matter: bool = True,
    momentum_error: float | None = None,
    hits_of: Detector | None = None,
) -> _core.detector.Detector:
    """Return the compiled detector with the matter that the fit assumes, without what only the simulation reads.

    Parameters
    ----------
    detector : Detector
        The description.
    screening : str
        Screening of nuclei in multiple scattering, ``"wentzel"`` or ``"moliere"`` (docs/methods/matter.md).
    loss : str
        Energy loss that the fit subtracts (``FitSettings.loss``).
    radiation : bool
        Whether it includes the bremsstrahlung of electrons and positrons.
    merge : bool
        See `slabs`.
    matter : bool
        Whether there is matter.
    momentum_error : float or None
        See `FitSettings`. None: those of each track, `momentum_error`.
    hits_of : Detector or None
        Of which this one is a variant: the muons have the hits that they have there. Matter and errors then change in
        no steps where a muon crosses another cell. Without effect where slabs or wires have another order.

    Raises
    ------
    ValueError
        If ``CGEMIT_ISA`` names an instruction set that is not available.

    Examples
    --------
    >>> from cgemit.detector import compiled
    >>> from cgemit.fit_matter import tuned
    >>> det = cg.load("besiii-cgem")
    >>> print(compiled(det).acting[:2], (1e7 * tuned(det).acting[:2]).round(1))  # GeV2
    [inf inf] [6.6 6.3]
    """
    how = screening, loss, radiation, merge, matter, momentum_error
    return _kept(detector, *how) if hits_of is None else _tuned(detector, *how, hits_of)


def _tuned(
    detector: Detector, screening: str, loss: str, radiation: bool, merge: bool, matter: bool,
    momentum_error: float | None, hits_of: Detector | None = None,
) -> _core.detector.Detector:  # fmt: skip
    core, choice = compiled(detector, merge, screening, gaps=False, matter=matter), getattr(_core.matter.CoreLoss, loss)
    errors = None
    if matter:
        core = _assumed(core)
        kept: _core.detector.Detector | None = None
        if hits_of is not None:
            kept = _kept(hits_of, screening, loss, radiation, merge, matter, momentum_error)
            kept = kept if _core.covariance.same_surfaces(kept, core) else None
        terms = _muon_terms(core, detector.layers, _assumed(kept) if kept else None)
        if terms is not None:
            core = _with_shared_matter(core, terms)
            # With this matter muons scatter less than with all of it. However slabs are merged, those that turn back at
            # a layer have the same hits.
            if momentum_error is None:
                same = core if merge else _kept(detector, screening, loss, radiation, True, matter, momentum_error)
                errors = _momentum_errors(
                    _without_straggling(same), detector.layers, _without_straggling(kept) if kept and merge else None
                )
    constant = USUAL_MOMENTUM_ERROR if momentum_error is None else momentum_error
    core = core.with_loss(loss=choice, radiation=radiation, momentum_error=constant)
    return core.with_errors(errors) if errors else core


def _assumed(core: _core.detector.Detector) -> _core.detector.Detector:
    """Return the detector in which the muon is fitted: all matter acts alike, the error counts no straggling."""
    return _without_straggling(core.untuned())


def _without_straggling(core: _core.detector.Detector) -> _core.detector.Detector:
    return core.with_loss(loss=_core.matter.CoreLoss.truncated, radiation=True, momentum_error=0.0)


_kept = once(_tuned)


def momentum_error(detector: Detector, particle: str, p: float, tanl: float = 0.0) -> float:
    """Return the relative error of a momentum that the fit counts straggling for.

    See `FitSettings.momentum_error`: by hits and scattering, of a particle from the origin, at most 10 %.

    Parameters
    ----------
    detector : Detector
    particle : str
    p, tanl : float
        Of the track at the origin, GeV/c and 1.
    """
    kind = species(particle)
    return _core.matter.momentum_error(tuned(detector), p=p, mass=kind.mass, charge=kind.charge, tanl=tanl)


class _Terms(NamedTuple):
    """Parts of the variances of a muon, (terms, 5 parameters), and its tanl."""

    budget: Floats
    tanl: float


def _with_shared_matter(core: _core.detector.Detector, terms: _Terms) -> _core.detector.Detector:
    """Return a detector in which every slab knows which matter acts with it, and how much of its loss is unseen."""
    budget, p = terms.budget, _MOMENTUM * math.hypot(1.0, terms.tanl)
    first = _first_slab(budget, core.n_slabs)
    core = core.with_shared_scattering(
        parts=budget[first:-1:2], variances=budget.sum(axis=0), hits=budget[:first].sum(axis=0), p=p, mass=_MUON
    )
    return core.with_shared_loss(budget[first + 1 : -1 : 2, _KAPPA], p=p, mass=_MUON, tanl=terms.tanl)


def _momentum_errors(
    core: _core.detector.Detector, layers: Sequence[Layer], hits_of: _core.detector.Detector | None = None
) -> dict[str, Any] | None:
    """Return the relative errors of muons without straggling, a table for `with_errors`.

    None without a field, where no momentum is measured. Where a muon cannot be fitted, the errors are those of the next
    larger transverse momentum, or else of the next smaller slope.
    """
    hits = hits_of or core
    if abs(hits.bz) < _core.kalman.STRAIGHT_FIELD or not 0 < hits.last_measurement < math.inf:
        return None
    turning = max(0.5 * GEV_PER_T_MM * abs(hits.bz) * hits.last_measurement, _LEAST_TURNING)  # GeV/c
    slopes = _SLOPES if hits.has_equal_ends else np.concatenate([-_SLOPES[:0:-1], _SLOPES])
    pt, slope = (grid.ravel() for grid in np.meshgrid(turning * _TRANSVERSE, slopes))
    fits = _muons(hits, layers, pt, slope, budget=True, **({"variants": [core]} if hits_of else {}))
    terms, first = fits["budget"], _first_slab(fits["budget"][0], core.n_slabs)
    # ln p = ln sec(lambda) - ln |kappa|; the last column is the covariance of kappa and tanl.
    bend = (slope / (1 + slope**2))[:, None]
    kappa = _charge(hits) / pt[:, None]
    by = terms[..., _KAPPA] / kappa**2 - 2 * bend * terms[..., 5] / kappa + bend**2 * terms[..., _TANL]
    p = pt * np.sqrt(1 + slope**2)
    columns = {
        "hits": np.sqrt(by[:, :first].sum(axis=1)) / pt,
        "scattered": np.sqrt(by[:, first:-1:2].sum(axis=1)) * p / np.hypot(p, _MUON),
    }
    good = (fits["status"].reshape(-1, len(pt)) == 0).all(axis=0).reshape(len(slopes), -1)
    if not good.any():
        return None
    middle = int(np.flatnonzero(slopes == 0)[0])
    for name, column in columns.items():
        columns[name] = np.ascontiguousarray(_filled(column.reshape(good.shape), good, middle).ravel())
    step = math.log(_TRANSVERSE[1] / _TRANSVERSE[0])
    return {"log_first": math.log(pt[0]), "step": step, "tanl": slopes, **columns}


def _filled(table: Floats, good: Flags, middle: int) -> Floats:
    """Return a table whose entries that are not good are those of the next column, or of the next row to the middle."""
    table, good = table.copy(), good.copy()
    for k in reversed(range(table.shape[1] - 1)):
        table[:, k] = np.where(good[:, k], table[:, k], table[:, k + 1])
        good[:, k] |= good[:, k + 1]
    outward = [range(middle, len(table)), range(middle, -1, -1)]
    inward = [side[::-1] for side in outward]
    for before, i in chain.from_iterable(pairwise(side) for side in outward + inward + outward):
        table[i] = np.where(good[i], table[i], table[before])
        good[i] |= good[before]
    return table


def _first_slab(terms: Floats, n_slabs: int) -> int:
    """Return the first term of slabs, after those of hits: scattering and straggling of each, then the prior."""
    return len(terms) - 1 - 2 * n_slabs


def _muon_terms(
    core: _core.detector.Detector, layers: Sequence[Layer], hits_of: _core.detector.Detector | None = None
) -> _Terms | None:
    """Return the budget of a muon across the beam, or where it cannot be fitted, of one through the most layers.

    None where that one cannot be fitted, either.
    """
    variants = {"variants": [core]} if hits_of else {}
    hits = hits_of or core
    for tanl in dict.fromkeys((0.0, hits.slope_through_most)):
        found = _muons(hits, layers, np.array([_MOMENTUM]), np.array([tanl]), budget=True, **variants)
        if not found["status"].any():
            return _Terms(np.ascontiguousarray(found["budget"][0, :, :5]), tanl)  # the last column is a covariance
    return None


def _charge(core: _core.detector.Detector) -> float:
    """Return the charge of muons, which follows the field: in a reversed one they cross the same cells."""
    return math.copysign(1.0, core.bz)


def _muons(
    core: _core.detector.Detector, layers: Sequence[Layer], pt: Floats, slope: Floats, **how: Any
) -> dict[str, Any]:
    """Return the expected covariances of muons of these transverse momenta and tan(lambda)."""
    ones, none = np.ones(len(pt)), np.zeros(len(pt))
    # With wider priors the parts of slabs lose digits to rounding, which `sensitivity` needs. Tuned detectors are
    # kept: with the scalar kernels they are the same whichever instruction set was in use when they were made.
    return _core.covariance.covariances(
        core, phi=0.1 * ones, kappa=_charge(core) / pt, tanl=slope, mass=_MUON * ones, scatters=none, samples=1,
        scalar=True, phases=np.full((1, 2 * len(layers)), 0.5), **{"budget": False} | how,
        model={
            "least_width": 0.1, "delta_strips": 0.0, "sides_known": True, "seed": 0,
            "prior_sigma": (20.0, 0.1, 1.0, 100.0, 0.2), "cos_theta": [0.0], "corr_xv": [0.0] * len(layers),
            "sigma_x": [layer.errors[0] or 1.0 for layer in layers],
            "sigma_v": [layer.errors[1] or 1.0 for layer in layers],
        },
    )  # fmt: skip
