"""Covariances of the same tracks in variants of a detector."""

from __future__ import annotations

from collections.abc import Sequence

from cgemit.covariance.result import Covariance
from cgemit.covariance.sensitivity import core_of, keeps_order, with_cores
from cgemit.detector import Detector


def varied(base: Covariance, variants: Sequence[Detector]) -> list[Covariance]:
    """Return the covariances of the same tracks with the same hits in variants with slabs and wires in their order."""
    cores = [core_of(base, one) for one in variants]
    assert all(keeps_order(base, core) for core in cores)
    return with_cores(base, list(zip(variants, cores, strict=True)))
