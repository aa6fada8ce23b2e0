"""Matter and momentum error that the fit assumes, both from the expected fit of one muon (docs/methods/matter.md)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cgemit import _core
from cgemit.detector.core import compiled
from cgemit.detector.detector import Detector
from cgemit.detector.keys import once
from cgemit.detector.parts import CgemLayer, DriftChamber, Layer, pitches
from cgemit.particles.species import species
from cgemit.units import GEV_PER_T_MM

MOST_MOMENTUM_ERROR = _core.USUAL_MOMENTUM_ERROR  #: Largest relative error of momenta that straggling is counted for.
_MUON = species("mu-").mass
_KAPPA = 9  # its variance among those of the upper triangle of a covariance


def tuned(
    detector: Detector,
    screening: str = "wentzel",
    loss: str = "truncated",
    radiation: bool = True,
    *,
    merge: bool = True,
    matter: bool = True,
    momentum_error: float | None = None,
) -> _core.Detector:
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
        See `FitSettings`. None: that of the detector, `usual_momentum_error`.

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
    error = usual_momentum_error(detector) if momentum_error is None else momentum_error
    return _kept(detector, screening, loss, radiation, merge, matter, error)


def _tuned(
    detector: Detector, screening: str, loss: str, radiation: bool, merge: bool, matter: bool, momentum_error: float
) -> _core.Detector:
    core = compiled(detector, merge, screening, gaps=False, matter=matter)
    core = core.with_loss(loss=getattr(_core.CoreLoss, loss), radiation=radiation, momentum_error=momentum_error)
    return _with_shared_scattering(core, detector.layers) if matter else core


_kept = once(_tuned)


def with_hits_of(kept: _core.Detector, core: _core.Detector, layers: Sequence[Layer]) -> _core.Detector:
    """Return a variant of a detector in which the same hits tell the matter that acts with each slab.

    It then changes in no steps where the muon crosses another cell. With slabs or wires in another order the variant is
    returned as it is.

    Parameters
    ----------
    kept, core : _core.Detector
        The detector and the variant, both tuned.
    layers : sequence of Layer
        Of the variant.
    """
    if not _core.same_surfaces(kept, core):
        return core
    return _with_shared_scattering(core.with_acting(np.full(core.n_slabs, np.inf)), layers, kept)


@once
def usual_momentum_error(detector: Detector) -> float:
    """Return the relative error of momenta that the fit counts straggling for, see `FitSettings.momentum_error`.

    The expected error of a muon of 1 GeV/c across the beam, at most 0.3 %. The error without matter is tried first:
    R.L. Gluckstern, Nucl. Instrum. Methods 24 (1963) 381.

    Parameters
    ----------
    detector : Detector
    """
    layers = detector.layers
    errors = [_error(layer, 0) for layer in layers]
    seen = [(layer.r_mid, layer.r_mid, error, 1) for layer, error in zip(layers, errors, strict=True) if error > 0]
    if detector.drift_chamber and detector.drift_chamber.layers:
        seen.append(_reach(detector.drift_chamber))
    first, last, least, many = zip(*seen, strict=True) if seen else ((0.0,), (0.0,), (0.0,), (0,))
    lever, number = max(last) - min(first), sum(many)
    sagitta = GEV_PER_T_MM * abs(detector.field.bz) * lever**2
    if number < 3 or min(least) * math.sqrt(720 / (number + 4)) > MOST_MOMENTUM_ERROR * sagitta:
        return MOST_MOMENTUM_ERROR
    found = _muon_across(tuned(detector, momentum_error=0.0), layers)
    if found is None:
        return MOST_MOMENTUM_ERROR
    return float(min(MOST_MOMENTUM_ERROR, math.sqrt(found["covariance"][0, _KAPPA])))


def _with_shared_scattering(
    core: _core.Detector, layers: Sequence[Layer], hits_of: _core.Detector | None = None
) -> _core.Detector:
    """Return a detector in which every slab knows which matter acts with it."""
    variants = {"variants": [core]} if hits_of else {}
    found = _muon_across(hits_of or core, layers, budget=True, **variants)
    if found is None:
        return core
    # Terms of the budget: hits, scattering and straggling of each slab, the prior. The last column is a covariance.
    terms = found["budget"][0, :, :5]
    parts = terms[len(terms) - 1 - 2 * core.n_slabs : -1 : 2]
    return core.with_shared_scattering(parts=parts, variances=terms.sum(axis=0))


def _muon_across(core: _core.Detector, layers: Sequence[Layer], **how: Any) -> dict[str, Any] | None:
    """Return the expected covariance of a muon of 1 GeV/c across the beam, None where it cannot be fitted."""
    one, none = np.ones(1), np.zeros(1)
    # With wider priors the parts of slabs lose digits to rounding, which `sensitivity` needs. Tuned detectors are
    # kept: with the scalar kernels they are the same whichever instruction set was in use when they were made.
    found = _core.covariances(
        core, phi=0.1 * one, kappa=-one, tanl=none, mass=_MUON * one, scatters=none, samples=1, scalar=True,
        phases=np.full((1, 2 * len(layers)), 0.5), **{"budget": False} | how,
        model={
            "least_width": 0.1, "delta_strips": 0.0, "sides_known": True, "seed": 0,
            "prior_sigma": (20.0, 0.1, 1.0, 100.0, 0.2), "cos_theta": [0.0], "corr_xv": [0.0] * len(layers),
            "sigma_x": [_error(layer, 0) or 1.0 for layer in layers],
            "sigma_v": [_error(layer, 1) or 1.0 for layer in layers],
        },
    )  # fmt: skip
    return None if found["status"].any() else found


def _error(layer: Layer, view: int) -> float:
    return pitches(layer)[view] / math.sqrt(12) if isinstance(layer, CgemLayer) else layer.errors[view]


@once
def _reach(chamber: DriftChamber) -> tuple[float, float, float, int]:
    """Return the radii of the first and the last wires, their least error, and the number of layers."""
    return (
        chamber.layers[0].r_mid,
        chamber.layers[-1].r_mid,
        min(one.sigma for one in chamber.layers),
        len(chamber.layers),
    )
