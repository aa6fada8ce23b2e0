"""Settings of track finding without truth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from cgemit.kinds import Check, Positive
from cgemit.settings import SettingsData
from cgemit.species import Hypothesis

Method = Literal["combined", "segments", "chamber", "wires-first"]

_COUNT = "a whole number from {} to {}"
Count = Annotated[int, Check(lambda value: 1 <= value <= 1000, _COUNT.format(1, 1000))]
Few = Annotated[int, Check(lambda value: 1 <= value <= 50, _COUNT.format(1, 50))]
Layers = Annotated[int, Check(lambda value: 4 <= value <= 60, _COUNT.format(4, 60))]
Gate = Annotated[float, Check(lambda value: 2 <= value <= 20, "a number from 2 to 20 standard deviations")]
Efficiency = Annotated[float, Check(lambda value: 0.5 <= value < 1, "a probability from 0.5 to below 1")]
Score = Annotated[float, Check(math.isfinite, "a finite number")]
Length = Annotated[float, Check(lambda value: 0 < value <= 2000, "a length in mm, above 0, at most 2000")]


@dataclass(frozen=True, kw_only=True)
class FindSettings(SettingsData):
    """How tracks are found (docs/methods/find.md).

    Attributes
    ----------
    method : str
        Source of the seeds. ``"combined"``: CGEM segments, then circles in the drift chamber from the hits that are
        left. ``"segments"``: CGEM segments alone. ``"chamber"``: circles in the drift chamber alone; CGEM clusters
        join by the prediction of the track. ``"wires-first"``: the same with circles and lines of wires alone. In
        each case a track may have hits of all layers.
    hypothesis : str
        Particle whose mass the finder assumes, and which the candidates name for the fit.
    efficiency : float
        Probability that a layer or cell that a track crosses has its hit.
    gate : float
        A hit farther from the prediction is not tried, in standard deviations.
    branches : int
        Branches of a seed that are kept at a time.
    passes : int
        Passes of the filter over a track, each about the track that the last one found, as long as hits change.
    holes_in_row : int
        A branch ends after more missing hits than this, one after the other.
    max_d : float
        mm, largest distance of a track from the beam line at the closest approach.
    max_z : float
        mm, largest distance of this point from the origin along the beam line.
    min_pt : float
        GeV/c, smallest transverse momentum of a seed.
    least_axial : int
        Layers of axial wires and X clusters that a seed of the chamber needs.
    min_score : float
        Smallest logarithm of the likelihood ratio of a track to foreign hits, beyond 2.5 for each hit of a track that
        is followed. In a detector of three CGEM layers and nothing else, where no track is followed, without these 2.5.
    max_seeds : int
        Seeds of an event that are followed, of each source; the best ones come first.
    annealing : bool
        Whether a wire hit near several tracks is given to the one that it fits best, whichever was found first.

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    method: Method = "combined"
    hypothesis: Hypothesis = "mu"
    efficiency: Efficiency = 0.97
    gate: Gate = 4.5
    branches: Few = 5
    passes: Few = 8
    holes_in_row: Few = 5
    max_d: Length = 200.0
    max_z: Length = 400.0
    min_pt: Positive = 0.03
    least_axial: Layers = 6
    min_score: Score = 2.0
    max_seeds: Count = 200
    annealing: bool = True
