"""How well half turns of one particle are linked (docs/methods/find.md)."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape

import numpy as np

from cgemit.find.loops import Rows, link_loops
from cgemit.result import Result
from cgemit.statistics.fractions import Fraction
from cgemit.study.finding_definitions import FAKE, LOOP
from cgemit.study.finding_metrics import Finding, finding


@dataclass(frozen=True, eq=False)
class LoopLinks:
    """Links of a run's fitted tracks to the first half turns of their particles.

    Attributes
    ----------
    first : ndarray, (tracks,) int64
        Row of the track that each track is linked to; its own if none.
    found : Finding
        Comparison of the candidates with the particles.
    before, after : Fraction
        Loop clones among all candidates, and among those that are not linked to another one.
    wrong : Fraction
        Links of tracks of two particles, among all links.
    lost : Fraction
        Particles whose matched track is linked to another track and so no longer kept, among those with one.
    """

    first: Rows
    found: Finding
    before: Fraction
    after: Fraction
    wrong: Fraction
    lost: Fraction

    def rows(self) -> list[tuple[str, str]]:
        """Return the results as text, name and value."""
        return [
            ("loop clones after linking", str(self.after)),
            ("links of two particles", str(self.wrong)),
            ("first half turns linked to another track", str(self.lost)),
        ]

    def __repr__(self) -> str:
        return "\n".join(["LoopLinks", *(f"  {name:<48}{text}" for name, text in self.rows())])

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self.rows())
        return f"<table>{rows}</table>"


def loop_links(result: Result) -> LoopLinks:
    """Link the fitted tracks of a simulated run, and compare the links with the truth.

    Parameters
    ----------
    result : Result
        Of a run up to the stage ``"fit"``, with one mass hypothesis.

    Raises
    ------
    ValueError
        If the run ended before, or has several hypotheses.
    """
    if result.fitted is None or len(result.fitted) != len(result.candidates):
        raise ValueError("loop_links: expected a run with until='fit' and one mass hypothesis that keeps all tables")
    detector = result.fit_detector or result.detector
    found = finding(result)
    first = link_loops(result.fitted, detector.field.bz)
    classes, particle = found.classes["belle2"], found.candidates.particle
    of_track = result.fitted["candidate"]
    classes, particle = classes[of_track], particle[of_track]
    known = classes >= 0
    linked = first != np.arange(len(first))
    matched = classes == 0
    foreign = linked & ((particle != particle[first]) | (classes == FAKE) | (classes[first] == FAKE))
    return LoopLinks(
        first=first,
        found=found,
        before=_fraction(classes == LOOP, known),
        after=_fraction(classes == LOOP, known & ~linked),
        wrong=_fraction(foreign, linked),
        lost=_fraction(linked, matched),
    )


def _fraction(
    which: np.ndarray[tuple[int], np.dtype[np.bool_]], among: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> Fraction:
    return Fraction(int(np.count_nonzero(which & among)), int(np.count_nonzero(among)))
