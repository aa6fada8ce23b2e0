"""Covariances of variants of a detector with the hits of the detector itself."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.covariance.result import Covariance
from cgemit.detector import Detector
from cgemit.detector.parts import CgemLayer
from cgemit.digitize import Readout
from cgemit.digitize.calibration import key_of
from cgemit.fit import compiled_for_fit

Floats = npt.NDArray[np.float64]

OTHER_ORDER = "got slabs and wires in another order than in the detector whose hits are kept, expected the same"


class SurfacesError(ValueError):
    """A variant that cannot have the hits of another one, since its slabs and wires are in another order."""


def varied(base: Covariance, variants: Sequence[Detector]) -> list[Covariance]:
    """Return the covariances of the same tracks with the same hits in variants of the detector.

    Parameters
    ----------
    base : Covariance
    variants : sequence of Detector
        Which differ so little that their surfaces keep their order.

    Raises
    ------
    SurfacesError
        If they do not.
    """
    cores = [core_of(base, one) for one in variants]
    if not all(keeps_order(base, core) for core in cores):
        raise SurfacesError(OTHER_ORDER)
    return with_cores(base, list(zip(variants, cores, strict=True)))


def with_cores(base: Covariance, variants: Sequence[tuple[Detector, _core.Detector]]) -> list[Covariance]:
    """Return the covariances in variants and their compiled detectors."""
    if not variants:
        return []
    rows = base._tracks.run(budget=False, variants=[core for _, core in variants])["covariance"]
    samples = rows.reshape(1 + len(variants), *base._samples.shape)[1:]
    return [
        dataclasses.replace(base, detector=one, _samples=row) for (one, _), row in zip(variants, samples, strict=True)
    ]


def core_of(base: Covariance, variant: Detector) -> _core.Detector:
    """Return a variant as the fit of a covariance compiles it, with stereo angles that follow continuously."""
    return compiled_for_fit(_with_stereo(variant, base.detector), base._tracks.fit)


def keeps_order(base: Covariance, core: _core.Detector) -> bool:
    """Return whether a variant has the slabs and wires of the detector of a covariance in the same order."""
    return _core.same_surfaces(compiled_for_fit(base.detector, base._tracks.fit), core)


def calibrated_apart(readout: Readout, detector: Detector, variants: Iterable[Detector]) -> bool:
    """Return whether a read-out has calibrated errors, and a calibration of the detector is none of some variant.

    Parameters
    ----------
    readout : Readout
    detector : Detector
    variants : iterable of Detector
    """
    if not hasattr(readout, "calibration"):
        return False
    own = key_of(detector, readout)
    return any(key_of(one, readout) != own for one in variants)


def errors_do_not_follow(readout: Readout, keys: Sequence[str]) -> str:
    """Return the message about a read-out whose calibrated errors do not follow some keys."""
    return f"got read-out {readout.name!r}, which has calibrated errors that do not follow {', '.join(keys)}"


def _with_stereo(variant: Detector, base: Detector) -> Detector:
    """Return a variant whose derived stereo angles follow radius and length continuously, not in whole strips."""
    layers = []
    for layer, old in zip(variant.cgem, base.cgem, strict=True):
        derived = abs(abs(layer.stereo) - math.atan2((layer.strips_x - 1) * layer.pitch_x, layer.length)) < 1e-12
        if derived:
            angle = abs(old.stereo) + _diagonal(layer) - _diagonal(old)
            # The hits are given: one V strip fits at any angle.
            layer = dataclasses.replace(layer, stereo=math.copysign(angle, old.stereo), strips_v=1)
        layers.append(layer)
    return dataclasses.replace(variant, cgem=tuple(layers))


def _diagonal(layer: CgemLayer) -> float:
    return math.atan2(2 * math.pi * layer.r_readout / layer.sheets, layer.length)
