"""Why there are no numbers: what became of the tracks of samples that were hardly fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cgemit.detector import MapField
from cgemit.detector.field.core import extent
from cgemit.fit import FitStatus
from cgemit.simulate import TransportStatus
from cgemit.study.estimate import FEWEST
from cgemit.study.samples import Sample

if TYPE_CHECKING:
    from cgemit.detector import Detector


def fitted(sample: Sample) -> int:
    """Return how many tracks were fitted."""
    return int(np.count_nonzero(sample.tracks["status"] == FitStatus.ok))


def hardly_fitted(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples with too few fitted tracks for a width."""
    return [sample for sample in samples if fitted(sample) < FEWEST]


def why_unfitted(samples: Sequence[Sample]) -> str:
    """Return how transport and fit of samples of one detector ended, and where its map ends if tracks left it."""
    tracks = sum(len(sample.tracks) for sample in samples)
    particles = sum(sum(sample.transport.values()) for sample in samples)
    transport, removed = (_total([getattr(sample, name) for sample in samples]) for name in ("transport", "removed"))
    parts = [
        f"{sum(map(fitted, samples))} of {tracks} tracks fitted, expected at least {FEWEST} for a resolution",
        "transport: " + _words(transport, particles),
        "fit: " + _words(removed, tracks),
    ]
    if {TransportStatus.left_field.name, FitStatus.left_field.name} & (transport.keys() | removed.keys()):
        parts += _ends(samples[0].detector)
    return "; ".join(parts)


def _total(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: sum(one.get(name, 0) for one in counts) for name in names}


def _words(counts: Mapping[str, int], total: int) -> str:
    return ", ".join(f"{name} {number} of {total}" for name, number in counts.items()) or "all well"


def _ends(detector: Detector) -> list[str]:
    field, (r, z) = detector.field, extent(detector)
    if not isinstance(field, MapField):
        return []
    return [f"the map is of {field.grid.range_text()}", f"the detector goes to r = {r:g} mm, |z| = {z:g} mm"]
