"""The reproduction's results: the paper's numbers and curves beside ours, and the samples they were made from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cgemit.record import versions
from cgemit.result import Result
from cgemit.stages import FinderLike, Settings, hits_text
from cgemit.statistics.curves import Line
from cgemit.statistics.formatting import Tabular, html_table, text_table, with_error
from cgemit.study.paper.published import paper_values
from cgemit.study.samples import Sample

#: The detectors that the paper compares.
DETECTORS = ("besiii-cgem-design", "besiii-idc")
#: Momenta of the curves, GeV/c.
MOMENTA = (0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
#: Range of cos(theta), uniform: where a track crosses all CGEM layers.
COS_THETA = (-0.93, 0.93)
#: Drift gap of the variant, mm; the paper does not state its own.
THIN_GAP = 3.0


@dataclass(frozen=True)
class Row:
    """One number of the study beside the paper's.

    Attributes
    ----------
    id, detector, unit : str
    value, error : float
        In `unit`; the error is statistical, one standard deviation.
    paper : float or None
        Published number, where there is one.
    note : str
        What the number is, and why it differs.
    """

    id: str
    detector: str
    value: float
    error: float
    unit: str
    paper: float | None
    note: str

    @property
    def title(self) -> str:
        """Its usual name."""
        return paper_values()[self.id].title

    def as_json(self) -> dict[str, Any]:
        """Return the row as `summary.json` has it."""
        return {
            "id": self.id, "detector": self.detector, "value": self.value, "error": self.error, "unit": self.unit,
            "paper": self.paper, "note": self.note,
        }  # fmt: skip


@dataclass(frozen=True)
class Inputs:
    """The arguments of a reproduction."""

    events: int
    events_per_momentum: int
    seed: int
    threads: int | None
    quick: bool
    settings: Settings
    field: str | None = None  # None: the detectors' own
    finder: FinderLike = "truth"


@dataclass(frozen=True, eq=False, repr=False)
class Reproduction(Tabular):
    """The paper's numbers beside ours.

    Attributes
    ----------
    results : tuple of Row
        One for each quantity and detector.
    curves : tuple of Line
        sigma_dr, sigma_dz and sigma_p against momentum for both detectors.
    inputs : Inputs
    samples : mapping of str to Sample
        The samples at 1 GeV/c: ``"cgem"``, ``"idc"``, and ``"gap"`` with a thinner drift gap.
    scans : mapping of str to tuple of Sample
        The momentum scans: ``"cgem"`` and ``"idc"``.
    display : Result
        A few events to draw.
    timings : mapping of str to float, s
        Wall time of the parts, and stage times summed over threads.
    folder : Path or None
        Where the files are.
    """

    results: tuple[Row, ...]
    curves: tuple[Line, ...]
    inputs: Inputs
    samples: Mapping[str, Sample]
    scans: Mapping[str, tuple[Sample, ...]]
    display: Result
    timings: Mapping[str, float]
    folder: Path | None = None

    def __eq__(self, other: object) -> bool:
        """Compare the arguments, except the threads, and all numbers."""
        if not isinstance(other, Reproduction):
            return NotImplemented
        mine, theirs = ((replace(s.inputs, threads=None), s.results, s.curves) for s in (self, other))
        return mine == theirs

    def __hash__(self) -> int:
        return hash(self.results)

    def _ipython_key_completions_(self) -> list[str]:
        return [row.id for row in self.results]

    def __getitem__(self, name: str) -> Row:
        """Return a result by its id.

        Raises
        ------
        KeyError
            If there is none.
        """
        for row in self.results:
            if row.id == name:
                return row
        raise KeyError(f"{name!r}; there are {', '.join(row.id for row in self.results)}")

    @property
    def every_sample(self) -> list[Sample]:
        """The samples at 1 GeV/c, and those of the momentum scans."""
        return [*self.samples.values(), *(s for scan in self.scans.values() for s in scan)]

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds."""
        return {
            "program": "cgemit",
            "paper": "arXiv:1504.02570",
            "versions": versions(),
            "inputs": {
                "detectors": list(DETECTORS), "particle": "mu-", "p": "1 GeV/c", "cos_theta": list(COS_THETA),
                "events": self.inputs.events, "momenta": list(MOMENTA),
                "events_per_momentum": self.inputs.events_per_momentum, "quick": self.inputs.quick,
                "settings": self.inputs.settings.to_dict(), "field": self.inputs.field,
                "hits": hits_text(self.every_sample[0].tracks),
            },
            "seed": self.inputs.seed,
            "timings": dict(self.timings),
            "removed": {s.label: {"fit": dict(s.removed), "transport": dict(s.transport)} for s in self.every_sample},
            "results": [row.as_json() for row in self.results],
            "curves": [line.as_json() for line in self.curves],
        }  # fmt: skip

    def columns(self) -> dict[str, list[Any]]:
        """Return the paper's numbers and ours as columns, one row for each quantity."""
        rows = [row.as_json() for row in self.results]
        return {name: [row[name] for row in rows] for name in rows[0]}

    def _rows(self) -> list[list[str]]:
        return [
            [row.id, f"{row.paper:g}" if row.paper is not None else "-", with_error(row.value, row.error), row.unit]
            for row in self.results
        ]

    def __repr__(self) -> str:
        title = f"arXiv:1504.02570 with {self.inputs.events:,} events, seed {self.inputs.seed}"
        return text_table(f"{title}; hits {self._hits()}", _HEAD, self._rows())

    def _repr_html_(self) -> str:
        return html_table(f"arXiv:1504.02570; hits {self._hits()}", _HEAD, self._rows())

    def _hits(self) -> str:
        return hits_text(next(iter(self.samples.values())).tracks)


_HEAD = ("quantity", "paper", "cgemit", "unit")
