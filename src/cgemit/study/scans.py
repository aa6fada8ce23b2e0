"""Resolutions against momentum and angle, as lines to draw and rows to write."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector, load
from cgemit.fit import FitStatus
from cgemit.result import Settings, hits_text
from cgemit.statistics.curves import Line
from cgemit.statistics.estimate import Resolution, measure
from cgemit.statistics.formatting import html_table, text_table, with_error
from cgemit.statistics.forms import FORMS, FormFit, fit_form
from cgemit.statistics.resolutions import QUOTED, pulls, resolution, resolution_against
from cgemit.study.samples import (
    Sample,
    ShowProgress,
    decayed,
    fitted,
    hardly_fitted,
    momentum_of,
    momentum_orders,
    run_samples,
    why_unfitted,
)  # fmt: skip
from cgemit.study.scan_files import save_scans, summary_of
from cgemit.tables import Table
from cgemit.values import check_numbers

#: Parameters whose resolution is quoted.
QUOTED_PARAMETERS = ("dr", "dz", "p")


def momentum_line(samples: Sequence[Sample], parameter: str) -> Line:
    """Return the core resolution of a parameter against momentum (GeV/c) in the quoted unit."""
    widths = [resolution(s.tracks, parameter) for s in samples]
    return _line(samples, f"sigma_{parameter}", widths, QUOTED[parameter][0])


def pull_line(samples: Sequence[Sample], parameter: str) -> Line:
    """Return the core width of a parameter's pull against momentum (GeV/c)."""
    return _line(samples, f"pull_{parameter}", [pulls(s.tracks)[parameter] for s in samples], "")


def _line(samples: Sequence[Sample], name: str, widths: Sequence[Resolution], unit: str) -> Line:
    return Line(
        name, samples[0].detector.name, np.array([momentum_of(s) for s in samples]), "GeV/c",
        np.array([w.core for w in widths]), np.array([w.core_error for w in widths]), unit,
    )  # fmt: skip


def angle_lines(tracks: Table, detector: str, parameter: str, edges: npt.ArrayLike) -> tuple[Line, Line]:
    """Return the core resolution and the core width of the pull of a parameter against cos(theta)."""
    lines = []
    for kind, name in (("residual", "sigma"), ("pull", "pull")):
        curve = resolution_against(tracks, parameter, "cos_theta", edges, kind=kind)  # type: ignore[arg-type]
        unit = curve.unit
        core, error = curve.column("core"), curve.column("core_error")
        lines.append(Line(f"{name}_{parameter}_cos_theta", detector, np.array(curve.x), "", core, error, unit))
    return lines[0], lines[1]


def scan_columns(samples: Sequence[Sample]) -> dict[str, list[Any]]:
    """Return the widths of all quoted parameters for each momentum: the columns of the CSV table."""
    columns: dict[str, list[Any]] = {
        "detector": [s.detector.name for s in samples],
        "p (GeV/c)": [momentum_of(s) for s in samples],
        "method": ["mc"] * len(samples),
        "events": [s.n_events for s in samples],
    }
    for name in QUOTED_PARAMETERS:
        widths = [resolution(s.tracks, name) for s in samples]
        unit = QUOTED[name][0]
        for what in ("core", "q68", "rms"):
            columns[f"{what}_{name} ({unit})"] = [getattr(w, what) for w in widths]
            columns[f"{what}_{name}_error ({unit})"] = [getattr(w, f"{what}_error") for w in widths]
        columns[f"tail_{name}"] = [w.tail for w in widths]
    columns["decayed"] = [decayed(s) for s in samples]
    columns["fitted"] = [fitted(s) for s in samples]
    columns["not fitted"] = [_counts_text(s.removed) for s in samples]
    return columns


def _counts_text(counts: Mapping[str, int]) -> str:
    return "; ".join(f"{number} {name}" for name, number in counts.items()) or "none"


@dataclass(frozen=True, eq=False, repr=False)
class Scan:
    """Resolutions of one detector against momentum.

    Attributes
    ----------
    samples : tuple of Sample
        One per momentum.
    seed : int
    seconds : float
        Wall time.
    """

    samples: tuple[Sample, ...]
    seed: int
    seconds: float

    method: ClassVar[str] = "mc"

    @property
    def lines(self) -> list[Line]:
        """Core resolutions of d_rho, d_z and p against momentum."""
        return [replace(momentum_line(self.samples, name), method=self.method) for name in QUOTED_PARAMETERS]

    @property
    def detector(self) -> Detector:
        """The detector."""
        return self.samples[0].detector

    @property
    def orders(self) -> tuple[Sample, ...]:
        """The samples: their detector, gun and settings."""
        return self.samples

    @property
    def hits(self) -> str:
        """How hits came to their tracks."""
        return hits_text(self.samples[0].tracks)

    @property
    def removed(self) -> dict[str, Mapping[str, int]]:
        """Tracks that did not fit, by sample and status."""
        return {s.label: s.removed for s in self.samples}

    @property
    def fits(self) -> list[FormFit]:
        """The usual forms, fitted to the resolutions; none with fewer than three momenta."""
        gun = self.samples[0].gun
        how: dict[str, Any] = {"particle": gun.particle, "cos_theta": gun.cos_theta}
        how |= {"detector": self.detector.name, "method": self.method}
        p = [momentum_of(s) for s in self.samples]
        found = []
        for name in FORMS:
            widths = [_relative_pt(s) if name == "pt" else resolution(s.tracks, name) for s in self.samples]
            core, error = ([getattr(w, what) for w in widths] for what in ("core", "core_error"))
            found.append(fit_form(name, p, core, error, **how))
        return [one for one in found if one is not None]

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of the CSV table."""
        return scan_columns(self.samples)

    def empty(self) -> bool:
        """Tell whether no track was fitted."""
        return not any(map(fitted, self.samples))

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds."""
        return summary_of([self])

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write resolution.csv, summary.json, run.json, the detector and the curves as PNG and PDF.

        Parameters
        ----------
        folder : path
        overwrite : bool

        Raises
        ------
        OutputExistsError
            If the folder holds files and `overwrite` is false.
        """
        return save_scans([self], folder, overwrite=overwrite)

    def _rows(self) -> list[list[str]]:
        pairs = [zip(line.y, line.y_error, strict=True) for line in self.lines]
        cells = [[with_error(*pair) for pair in column] for column in pairs]
        ends = [[f"{decayed(s)}", f"{fitted(s)}/{s.n_events}", _counts_text(s.removed)] for s in self.samples]
        momenta = [f"{momentum_of(s):g}" for s in self.samples]
        return [[p, *row, *end] for p, row, end in zip(momenta, zip(*cells, strict=True), ends, strict=True)]

    def _title(self) -> str:
        first = self.samples[0]
        shot = f"{first.gun.particle}, cos(theta) {first.gun.cos_theta}"
        return f"{first.detector.name}, {shot}: core widths; hits {hits_text(first.tracks)}"

    def note(self) -> str:
        """Return how the tracks ended where hardly any was fitted; empty if there are enough everywhere."""
        few = hardly_fitted(self.samples)
        momenta = ", ".join(f"{momentum_of(s):g}" for s in few)
        return f"at {momenta} GeV/c: {why_unfitted(few)}" if few else ""

    def __repr__(self) -> str:
        return "\n".join([text_table(self._title(), _HEAD, self._rows()), *filter(None, [self.note()])])

    def _repr_html_(self) -> str:
        return html_table(self._title(), _HEAD, self._rows()) + (
            f"<p>{escape(note)}</p>" if (note := self.note()) else ""
        )


def _relative_pt(sample: Sample) -> Resolution:
    """Return the widths of fitted over true pT, minus 1, in %."""
    tracks = sample.tracks
    rows = tracks["status"] == FitStatus.ok
    return measure(100 * (np.abs(tracks["truth_kappa"][rows] / tracks["kappa"][rows]) - 1), parameter="pt", unit="%")


_HEAD = ("p [GeV/c]", "sigma(d_rho) [um]", "sigma(d_z) [mm]", "sigma(p) [MeV/c]", "decayed", "fitted", "not fitted")


def scan(
    detector: Detector | str | Mapping[str, Any],
    momenta: Sequence[float],
    *,
    particle: str | int = "mu-",
    cos_theta: float | tuple[float, float] | list[float] = (-0.93, 0.93),
    events: int = 5000,
    seed: int = 1,
    settings: Settings | None = None,
    threads: int | None = None,
    progress: ShowProgress | None = None,
) -> Scan:
    """Simulate and fit tracks at several momenta.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    momenta : sequence of float
        GeV/c.
    particle : str or int
        Name or number of the Particle Data Group.
    cos_theta : float, or (float, float)
        Cosine of the polar angle: fixed, or the limits of a uniform range.
    events : int
        For each momentum.
    seed : int
    settings : Settings, optional
        Of all stages.
    threads : int, optional
        Default: all cores.
    progress : callable, optional
        Called with the share that is done and what is running.

    Raises
    ------
    ValueError
        If particle or numbers make no sense, or the particle is neutral.
    """
    start = time.perf_counter()
    check_numbers("scan", seed, threads, events=(events, 1, 2**31 - 1))
    gun: dict[str, Any] = {"particle": particle, "cos_theta": cos_theta}
    orders = momentum_orders(load(detector), momenta, **gun, events=events, seed=seed, settings=settings)
    samples = run_samples(orders, threads=threads, progress=progress)
    return Scan(tuple(samples), seed, time.perf_counter() - start)


def scan_detectors(
    detectors: Sequence[Detector], momenta: Sequence[float], *, progress: ShowProgress | None = None, **how: Any
) -> list[Scan]:
    """Run `scan` for each detector, with its other arguments; the particles are the same for all."""

    def part(number: int) -> ShowProgress | None:
        return progress and (lambda done, label: progress((number + done) / len(detectors), label))

    return [scan(detector, momenta, progress=part(number), **how) for number, detector in enumerate(detectors)]
