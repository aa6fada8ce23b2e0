"""The paper's numbers, measured, each with the reason for a difference."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.analysis.clusters import DISTANCES, PITCH, X_WINDOW, X_WINDOWS, geant4_runs, v_fit, x_beyond, x_widths
from cgemit.analysis.curves import WINDOW, Line, windowed_resolution
from cgemit.analysis.widths import Resolution
from cgemit.chain.record import versions
from cgemit.chain.result import Result
from cgemit.chain.settings import FinderLike, Settings, hits_text, mass_by
from cgemit.detector.readouts import Readout
from cgemit.study.evaluation import Sample
from cgemit.study.paper.published import paper_values
from cgemit.tables.show import Shown, Tabular, with_error

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
    readout: Readout | None = None  # None: the detectors' own


@dataclass(frozen=True, eq=False, repr=False)
class Reproduction(Shown, Tabular):
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

    Examples
    --------
    >>> study = cg.study.reproduce(events=400)  # 20 000 by default
    >>> found = {row.id: row for row in study.results}
    >>> found["sigma_dr"].paper, found["sigma_dr"].unit
    (192.0, 'um')
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
        """The samples at 1 GeV/c and of the momentum scans."""
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
                "hits": hits_text(self.every_sample[0].tracks), "mass": mass_by(self.every_sample[0].tracks.meta),
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

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        rows = [
            [row.id, f"{row.paper:g}", with_error(row.value, row.error), row.unit]
            for row in self.results
            if row.paper is not None
        ]
        title = f"arXiv:1504.02570 with {self.inputs.events:,} events, seed {self.inputs.seed}"
        return f"{title}; hits {hits_text(next(iter(self.samples.values())).tracks)}", _HEAD, rows

    def note(self) -> str:
        """Return where the other numbers are."""
        others, place = sum(row.paper is None for row in self.results), "report.html" if self.folder else "results"
        return f"{place}: {others} numbers that the paper does not give, and why any number differs"


_HEAD = ("quantity", "paper", "cgemit", "unit")


_LIMIT = PITCH / np.sqrt(12)  # um, RMS of a rectangle as wide as the pitch

_OPEN = "The paper states neither the range of its Gaussian fit nor the resolution of its wires"


def make_rows(samples: Mapping[str, Sample]) -> list[Row]:
    """Return one row for each quantity and detector.

    Parameters
    ----------
    samples : mapping of str to Sample
        ``"cgem"``, ``"idc"``, and ``"gap"``: the CGEM with a thinner drift gap; all of 1 GeV/c.
    """
    cgem, gap = samples["cgem"], samples["gap"]
    rows = [*_x_rows(cgem), _v_row(cgem)]
    tracks = {name: _track_row(cgem, name) for name in ("dr", "dz", "p")}
    rows += tracks.values()
    rows += [_idc_row(samples["idc"], name, row.value) for name, row in tracks.items()]
    nominal = {row.id: row.value for row in rows}
    return [*rows, *_gap_rows(gap, nominal), *_window_rows(cgem), *_delta_rows(cgem)]


def _row(name: str, sample: Sample, value: float, error: float, note: str) -> Row:
    known = paper_values()[name]
    return Row(name, sample.detector.name, value, error, known.unit, known.value, note)


def _x_numbers(sample: Sample) -> dict[str, tuple[float, float]]:
    widths = x_widths(sample.clusters)
    return {
        "x_residual_rms": (widths.rms, widths.rms_error),
        "x_residual_core": (widths.core, widths.core_error),
        "x_single_strip_fraction": sample.clusters.single_strip_fraction,
    }


def _x_rows(sample: Sample) -> list[Row]:
    numbers = _x_numbers(sample)
    (rms, error), (core, _) = numbers["x_residual_rms"], numbers["x_residual_core"]
    if _readout(sample) != "binary":
        return [_other_readout(name, sample, *pair) for name, pair in numbers.items()]
    notes = {
        "x_residual_rms": explain_x_rms(rms, error, _published("x_residual_rms"), x_beyond(sample.clusters)[0]),
        "x_residual_core": explain_x_core(core, rms),
        "x_single_strip_fraction": explain_single_strips(sample.detector.cgem[0].drift_gap),
    }
    return [_row(name, sample, *numbers[name], note) for name, note in notes.items()]


def _gap_rows(sample: Sample, nominal: Mapping[str, float]) -> list[Row]:
    gap = sample.detector.cgem[0].drift_gap
    return [
        _row(f"{name}_gap3mm", sample, *pair, explain_gap_variant(gap, pair[0], nominal[name], _readout(sample)))
        for name, pair in _x_numbers(sample).items()
    ]


def _window_rows(sample: Sample) -> list[Row]:
    rows = []
    for number, (name, window) in enumerate(X_WINDOWS.items()):
        widths = x_widths(sample.clusters, window)
        note = explain_x_window(window, widths.outside, widths.n, number, _readout(sample))
        rows.append(_row(f"x_residual_rms_{name}", sample, widths.rms, widths.rms_error, note))
    return rows


def _delta_rows(sample: Sample) -> list[Row]:
    deltas, rows = sample.deltas, []
    for way, values, errors in (("rphi", deltas.rphi, deltas.rphi_error), ("z", deltas.z, deltas.z_error)):
        for distance, value, error in zip(DISTANCES, values, errors, strict=True):
            name = f"{distance:g}mm" if distance >= 1 else f"{1e3 * distance:.0f}um"
            note = explain_deltas(deltas.crossings, simulated=sample.settings.simulate.deltas)
            rows.append(_row(f"delta_fraction_{way}_{name}", sample, value, error, note))
    return rows


def _v_row(sample: Sample) -> Row:
    fit = v_fit(sample.clusters)
    if _readout(sample) != "binary":
        return _other_readout("v_residual_sigma", sample, fit.sigma, fit.sigma_error)
    note = explain_v_width(fit.sigma, fit.sigma_error, _published("v_residual_sigma"))
    return _row("v_residual_sigma", sample, fit.sigma, fit.sigma_error, note)


def _track_row(sample: Sample, parameter: str) -> Row:
    name, widths = f"sigma_{parameter}", windowed_resolution(sample.tracks, parameter)
    note = explain_track(parameter, widths, _published(name))
    return _row(name, sample, widths.core, widths.core_error, note)


def _idc_row(sample: Sample, parameter: str, cgem: float) -> Row:
    widths = windowed_resolution(sample.tracks, parameter)
    note = explain_idc(parameter, widths.core, cgem)
    return _row(f"sigma_{parameter}_idc", sample, widths.core, widths.core_error, note)


def _readout(sample: Sample) -> str:
    return sample.detector.readout_text


def _other_readout(name: str, sample: Sample, value: float, error: float) -> Row:
    """Return the row of a number of clusters whose readout differs from the paper's."""
    paper = paper_values()[name].value
    text = "" if paper is None else f"{deviation(value, error, paper).capitalize()}. "
    note = f"{text}Readout {_readout(sample)}; the paper's clusters are binary. docs/methods/readout.md says more."
    return _row(name, sample, value, error, note)


def _published(name: str) -> float:
    value = paper_values()[name].value
    assert value is not None, name
    return value


def deviation(value: float, error: float, paper: float) -> str:
    """Return how far a value is from the paper's, such as ``6.2 % above the paper (5.1 standard errors)``."""
    share, errors = value / paper - 1, abs(value - paper) / error
    where = "above" if share > 0 else "below"
    # Beyond ten errors it is no longer the statistics that matter.
    return f"{100 * abs(share):.1f} % {where} the paper" + (f" ({errors:.1f} standard errors)" if errors < 10 else "")


def explain_x_rms(value: float, error: float, paper: float, beyond: float) -> str:
    """Explain the RMS of the X residual; `beyond` is the fraction of the residuals outside its window."""
    text = f"{deviation(value, error, paper).capitalize()}. Residuals within ±{X_WINDOW:g} mm. "
    limit = (
        "Strips that fire where the crossing is projected cannot do worse than a rectangle one pitch wide: "
        f"650 um / sqrt(12) = {_LIMIT:.1f} um. "
    )
    if beyond == 0:
        return text + limit + (
            "So no projection reaches 217.1 um: the rest is most likely that of delta electrons, of which there are "
            "none here."
        )  # fmt: skip
    return text + limit + (
        "What is beyond comes from delta electrons, whose strips join those of the track, and depends on the window: "
        f"{100 * beyond:.2f} % lie outside this one. The paper does not state its own; the documentation on the "
        "paper says why this one was taken."
    )  # fmt: skip


def explain_x_window(window: float, outside: int, n: int, number: int, readout: str = "binary") -> str:
    """Explain the RMS of the X residual in one window, the `number`-th of `X_WINDOWS`."""
    where = f"{outside:,} of {n:,} residuals are outside" if np.isfinite(window) else "A few clusters decide it"
    if readout != "binary":
        return f"{where}. Readout {readout}."
    geant4 = ", ".join(f"{run.rms[number]} um ({run.title})" for run in geant4_runs())
    return f"{where}. Geant4: {geant4}."


def explain_deltas(crossings: int, *, simulated: bool) -> str:
    """Explain the fraction of crossings with a delta electron away from the track."""
    if not simulated:
        return "Delta electrons were left out."
    return f"Of {crossings:,} crossings; farthest deposit in the drift gap, from the track at the same radius."


def explain_x_core(core: float, rms: float) -> str:
    """Explain the core width of the X residual."""
    return (
        f"The core of the same residuals. It is close to the RMS ({rms:.1f} um), since without delta electrons the "
        "distribution has no tails."
        if abs(core / rms - 1) < 0.05
        else f"The core of the same residuals, whose RMS is {rms:.1f} um: clusters that a delta electron made longer "
        "are tails. The core is what the track fit needs."
    )


def explain_single_strips(gap: float) -> str:
    """Explain the fraction of single-strip clusters."""
    return (
        f"Share of the rectangular part of the X residual. It depends on the drift gap ({gap:g} mm here), "
        "which the paper does not state."
    )


def explain_gap_variant(gap: float, value: float, nominal: float, readout: str = "binary") -> str:
    """Explain the numbers of a thinner drift gap."""
    change = value / nominal - 1
    more = "more" if change > 0 else "less"
    return (
        "A variant of ours, since the paper does not state its drift gap. "
        f"{100 * abs(change):.1f} % {more} than with the nominal gap"
        + (
            f": in a {gap:g} mm gap crossings are shorter and fire one strip more often."
            if readout == "binary"
            else "."
        )
    )


def explain_v_width(value: float, error: float, paper: float) -> str:
    """Explain the width of the V residual."""
    text = f"{deviation(value, error, paper).capitalize()}. "
    return text + (
        f"Centres of the fired strips: 650 um / sqrt(24) = {PITCH / np.sqrt(24):.1f} um is expected if crossings are "
        "long. This is an unbinned likelihood fit to the entries within one pitch, twice as far as a whole crossing "
        "reaches: delta electrons that add a strip or two widen it, those that add more lie beyond, and so do "
        "crossings cut off at the ends of the layers. The result of a least-squares fit to a histogram moves by "
        "several per cent with its binning, which the paper does not state."
    )


def explain_track(parameter: str, widths: Resolution, paper: float) -> str:
    """Explain the core width of a track parameter at 1 GeV/c."""
    if abs(widths.core - paper) < 2 * widths.core_error:
        text = "Agrees within two standard errors. "
    else:
        text = f"{deviation(widths.core, widths.core_error, paper).capitalize()}. "
    shape = (
        f"{_OPEN}. Here cos(theta) is uniform in ±0.93, which mixes narrow and wide distributions: the core is "
        f"quoted, the RMS within {WINDOW:g} core widths is {widths.rms:.3g} {widths.unit}, and "
        f"{100 * widths.tail:.1f} % of the tracks lie beyond three core widths."
    )
    reasons = {
        "dr": "d_ρ follows matter and the core of the X residual; delta electrons add to its tails.",
        "dz": "d_z follows the V measurement of the inner layers and the angular range.",
        "p": "p follows the wires: 130 um, all efficient, without material; the documentation says more.",
    }
    return f"{text}{shape} {reasons[parameter]}"


def explain_idc(quantity: str, value: float, cgem: float) -> str:
    """Compare the inner drift chamber with the CGEM tracker as the paper's figures do."""
    ratio = value / cgem
    says = {
        "dr": "comparable with the CGEM",
        "dz": "much worse than with the CGEM",
        "p": "comparable with the CGEM",
    }
    return (
        f"{ratio:.2f} times the CGEM value, with all wires at 130 um. The paper gives a curve without numbers: "
        f"{says[quantity]}."
    )
