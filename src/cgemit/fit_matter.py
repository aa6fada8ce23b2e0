"""Matter and momentum error that the fit assumes, both from the expected fit of one muon (docs/methods/matter.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.detector.core import compiled
from cgemit.detector.detector import Detector
from cgemit.detector.keys import once
from cgemit.detector.layers import Layer
from cgemit.particles.species import species

MOST_MOMENTUM_ERROR = (
    _core.matter.USUAL_MOMENTUM_ERROR
)  #: Largest relative error of momenta that straggling is counted for.
_MUON = species("mu-").mass
_MOMENTUM = 1.0  # GeV/c, of that muon
_KAPPA = 2  # its number among the parameters


def tuned(
    detector: Detector,
    screening: str = "wentzel",
    loss: str = "truncated",
    radiation: bool = True,
    *,
    merge: bool = True,
    matter: bool = True,
    momentum_error: float | None = None,
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
        See `FitSettings`. None: that of the detector, `usual_momentum_error`; of electrons, that at their momentum.

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
    return _kept(detector, screening, loss, radiation, merge, matter, momentum_error).core


class _Tuned(NamedTuple):
    """A compiled detector, and the relative errors of momenta that its loss is for, see `_momentum_errors`."""

    core: _core.detector.Detector
    heavy: float
    light: tuple[float, float]


def _tuned(
    detector: Detector, screening: str, loss: str, radiation: bool, merge: bool, matter: bool,
    momentum_error: float | None,
) -> _Tuned:  # fmt: skip
    core, choice = compiled(detector, merge, screening, gaps=False, matter=matter), getattr(_core.matter.CoreLoss, loss)
    heavy = MOST_MOMENTUM_ERROR if momentum_error is None else momentum_error
    light = 0.0, heavy
    if matter:
        core = _assumed(core)
        terms = _muon_terms(core, detector.layers)
        if terms is not None:
            core = _with_shared_matter(core, terms)
            # With this matter the muon scatters less than with all of it.
            terms = _muon_terms(core, detector.layers) if momentum_error is None else None
        if terms is not None:
            heavy, light = _momentum_errors(terms.budget, core.n_slabs)
    core = core.with_loss(loss=choice, radiation=radiation, momentum_error=heavy, light_error=light)
    return _Tuned(core, heavy, light)


def _assumed(core: _core.detector.Detector) -> _core.detector.Detector:
    """Return the detector in which the muon is fitted: all matter acts alike, the error counts no straggling."""
    return core.untuned().with_loss(loss=_core.matter.CoreLoss.truncated, radiation=True, momentum_error=0.0)


_kept = once(_tuned)


def with_hits_of(
    kept: _core.detector.Detector, core: _core.detector.Detector, layers: Sequence[Layer]
) -> _core.detector.Detector:
    """Return a variant of a detector in which the same hits tell the matter that acts with each slab.

    It then changes in no steps where the muon crosses another cell. With slabs or wires in another order the variant is
    returned as it is.

    Parameters
    ----------
    kept, core : _core.detector.Detector
        The detector and the variant, both tuned.
    layers : sequence of Layer
        Of the variant.
    """
    if not _core.covariance.same_surfaces(kept, core):
        return core
    assumed = _assumed(core)
    terms = _muon_terms(assumed, layers, kept)
    if terms is None:
        return core
    shared = _with_shared_matter(assumed, terms)
    return core.with_acting(shared.acting).with_unseen(shared.unseen)


def usual_momentum_error(detector: Detector) -> float:
    """Return the relative error of momenta that the fit of heavy particles counts straggling for.

    See `FitSettings.momentum_error`: without straggling, of a muon of 1 GeV/c across the beam, at most 0.3 %.

    Parameters
    ----------
    detector : Detector
    """
    return _kept(detector, "wentzel", "truncated", True, True, True, None).heavy


def unseen_cut(
    detector: Detector, screening: str, radiation: bool, momentum_error: float | None, p: float, tanl: float
) -> float:
    """Return the loss of electrons above which the fit counts none, as a share of p, if all of it were unseen.

    That of ``loss="truncated"``: collisions and photons that lose more are tails.

    Parameters
    ----------
    detector, screening, radiation, momentum_error
        As of `tuned`.
    p, tanl : float
        Of the track at the origin, GeV/c and 1.
    """
    found = _kept(detector, screening, "truncated", radiation, True, True, momentum_error)
    measured, scattered = found.light
    path = math.hypot(1.0, tanl)
    error = math.hypot(measured * p / path, scattered * math.sqrt(path))
    xi = _core.matter.total_matter(found.core, tanl)[1]
    return _core.matter.CORE_CUT_XI * xi / p + _core.matter.CORE_CUT_SHARE / MOST_MOMENTUM_ERROR * error


class _Terms(NamedTuple):
    """Parts of the variances of a muon, (terms, 5 parameters), and its tanl."""

    budget: Floats
    tanl: float


def _with_shared_matter(core: _core.detector.Detector, terms: _Terms) -> _core.detector.Detector:
    """Return a detector in which every slab knows which matter acts with it, and how much of its loss is unseen."""
    budget = terms.budget
    first = _first_slab(budget, core.n_slabs)
    core = core.with_shared_scattering(parts=budget[first:-1:2], variances=budget.sum(axis=0))
    return core.with_shared_loss(budget[first + 1 : -1 : 2, _KAPPA], p=_MOMENTUM, mass=_MUON, tanl=terms.tanl)


def _momentum_errors(terms: Floats, n_slabs: int) -> tuple[float, tuple[float, float]]:
    """Return relative errors of momenta without straggling, from the parts of that muon's variance of kappa.

    Returns
    -------
    heavy : float
        Of the muon, at most `MOST_MOMENTUM_ERROR`.
    light : (float, float)
        Of electrons of any momentum: by hits, per GeV/c of transverse momentum, and by scattering.
    """
    first = _first_slab(terms, n_slabs)
    hits, scatters = (math.sqrt(part[:, _KAPPA].sum()) for part in (terms[:first], terms[first:-1:2]))
    beta = _MOMENTUM / math.hypot(_MOMENTUM, _MUON)
    heavy = _MOMENTUM * math.hypot(hits, scatters)
    return min(MOST_MOMENTUM_ERROR, heavy), (hits, _MOMENTUM * scatters * beta)


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
        found = _muon(hits, layers, tanl, budget=True, **variants)
        if found is not None:
            return _Terms(np.ascontiguousarray(found["budget"][0, :, :5]), tanl)  # the last column is a covariance
    return None


def _muon(core: _core.detector.Detector, layers: Sequence[Layer], tanl: float, **how: Any) -> dict[str, Any] | None:
    """Return the expected covariance of a muon with a pT of 1 GeV/c, None where it cannot be fitted."""
    one = np.ones(1)
    # With wider priors the parts of slabs lose digits to rounding, which `sensitivity` needs. Tuned detectors are
    # kept: with the scalar kernels they are the same whichever instruction set was in use when they were made.
    found = _core.covariance.covariances(
        core, phi=0.1 * one, kappa=-one / _MOMENTUM, tanl=tanl * one, mass=_MUON * one, scatters=np.zeros(1), samples=1,
        scalar=True, phases=np.full((1, 2 * len(layers)), 0.5), **{"budget": False} | how,
        model={
            "least_width": 0.1, "delta_strips": 0.0, "sides_known": True, "seed": 0,
            "prior_sigma": (20.0, 0.1, 1.0, 100.0, 0.2), "cos_theta": [0.0], "corr_xv": [0.0] * len(layers),
            "sigma_x": [layer.errors[0] or 1.0 for layer in layers],
            "sigma_v": [layer.errors[1] or 1.0 for layer in layers],
        },
    )  # fmt: skip
    return None if found["status"].any() else found
