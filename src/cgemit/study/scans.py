"""Resolutions against momentum and angle, as lines to draw and rows to write."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from cgemit.detector import Detector, load
from cgemit.stages import FinderLike, Settings, hits_text
from cgemit.statistics.curves import Line
from cgemit.statistics.estimate import Resolution
from cgemit.statistics.formatting import with_error
from cgemit.statistics.forms import FORMS, FormFit, fit_form
from cgemit.statistics.resolutions import QUOTED, pulls, resolution
from cgemit.study.quantities import QUANTITIES, median_error, width
from cgemit.study.samples import (
    Sample,
    ShowProgress,
    cosines_of,
    decayed,
    fitted,
    gun_arguments,
    hardly_fitted,
    momentum_name,
    momentum_of,
    momentum_orders,
    run_samples,
    transverse,
    why_unfitted,
)
from cgemit.study.scan_files import ScanBase
from cgemit.study.scan_table import Differences, angle_text, counts_text, differences, scan_columns, shot_text
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


def quantity_line(samples: Sequence[Sample], quantity: str) -> Line:
    """Return the core resolution of one of `QUANTITIES` against momentum (GeV/c)."""
    widths = [width(s.tracks, quantity) for s in samples]
    return _line(samples, f"sigma_{quantity}", widths, QUANTITIES[quantity][0])


def _line(samples: Sequence[Sample], name: str, widths: Sequence[Resolution], unit: str) -> Line:
    return Line(
        name, samples[0].detector.name, np.array([momentum_of(s) for s in samples]), "GeV/c",
        np.array([w.core for w in widths]), np.array([w.core_error for w in widths]), unit,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Scan(ScanBase):
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
    def angle(self) -> str:
        """Polar angle of the tracks, as text."""
        return angle_text(self.samples[0])

    @property
    def lines(self) -> list[Line]:
        """Core resolutions of d_rho, d_z and p against momentum."""
        return [line for line in self.all_lines if line.id.removeprefix("sigma_") in QUOTED_PARAMETERS]

    @cached_property
    def all_lines(self) -> list[Line]:
        """Core resolutions of all quantities against momentum, or transverse momentum."""
        about: dict[str, Any] = {"method": self.method, "particle": str(self.samples[0].gun.particle)}
        return [replace(quantity_line(self.samples, name), **about) for name in QUANTITIES]

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
        """The usual forms, fitted to the resolutions; none with fewer than three momenta, or against pT."""
        first = self.samples[0]
        if transverse(first):
            return []
        how: dict[str, Any] = {"particle": first.gun.particle, "cos_theta": cosines_of(first)}
        how |= {"detector": self.detector.name, "method": self.method}
        p = [momentum_of(s) for s in self.samples]
        found = []
        for name in FORMS:
            widths = [width(s.tracks, "pt_rel" if name == "pt" else name) for s in self.samples]
            core, error = ([getattr(w, what) for w in widths] for what in ("core", "core_error"))
            found.append(fit_form(name, p, core, error, **how))
        return [one for one in found if one is not None]

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of the CSV table."""
        return scan_columns(self.samples)

    def minus(self, base: Scan) -> Differences:
        """Return the differences to the resolutions of another detector, with their paired errors.

        Parameters
        ----------
        base : Scan
            Of the same particles: equal momenta, angles, events and seed.

        Raises
        ------
        ValueError
            If the particles are not the same.
        """
        return differences(self.samples, base.samples)

    def empty(self) -> bool:
        """Tell whether no track was fitted."""
        return not any(map(fitted, self.samples))

    def _rows(self) -> list[list[str]]:
        widths = {name: quantity_line(self.samples, name) for name in QUOTED_PARAMETERS}
        rows = []
        for i, sample in enumerate(self.samples):
            cells = [
                cell
                for name, line in widths.items()
                for cell in (with_error(line.y[i], line.y_error[i]), f"{median_error(sample.tracks, name):.4g}")
            ]
            end = [f"{decayed(sample)}", f"{fitted(sample)}/{sample.n_events}", counts_text(sample.removed)]
            rows.append([f"{momentum_of(sample):g}", *cells, *end])
        return rows

    def _table(self) -> tuple[str, Sequence[str], list[list[str]]]:
        first = self.samples[0]
        shot = f"{first.detector.name}, {shot_text(first)}"
        made = ", ".join(filter(None, [self.readout and f"read-out {self.readout}", f"hits {self.hits}"]))
        title = f"{shot}: core widths, and medians of the fit's own errors; {made}"
        return title, (f"{momentum_name(first)} [GeV/c]", *_HEAD), self._rows()

    def note(self) -> str:
        """Return how the tracks ended where hardly any was fitted; empty if there are enough everywhere."""
        few = hardly_fitted(self.samples)
        momenta = ", ".join(f"{momentum_of(s):g}" for s in few)
        return f"at {momenta} GeV/c: {why_unfitted(few)}" if few else ""


_HEAD = (
    *("sigma(d_rho) [um]", "median error", "sigma(d_z) [mm]", "median error", "sigma(p) [MeV/c]", "median error"),
    *("decayed", "fitted", "not fitted"),
)


def scan(
    detector: Detector | str | Mapping[str, Any],
    momenta: Sequence[float] | None = None,
    *,
    pt: Sequence[float] | None = None,
    particle: str | int = "mu-",
    cos_theta: float | tuple[float, float] | list[float] | None = None,
    theta: Any = None,
    events: int = 5000,
    seed: int = 1,
    settings: Settings | None = None,
    finder: FinderLike = "truth",
    threads: int | None = None,
    progress: ShowProgress | None = None,
) -> Scan:
    """Simulate and fit tracks at several momenta.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    momenta, pt : sequence of float, GeV/c
        Momenta or transverse momenta: one of them.
    particle : str or int
        Name or number of the Particle Data Group.
    cos_theta, theta : float, (float, float) or list of float
        Cosine of the polar angle, or the angle in rad or with a unit: fixed, the limits of a uniform range, or values
        in turn. Default: cos(theta) uniform in (-0.93, 0.93).
    events : int
        For each momentum.
    seed : int
    settings : Settings, optional
        Of all stages.
    finder : "truth", "ckf" or callable
        As of `cgemit.run`. Found tracks are fitted with the mass of ``settings.find.hypothesis``.
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
    gun = gun_arguments(momenta, pt, particle, cos_theta, theta)
    orders = momentum_orders(load(detector), **gun, events=events, seed=seed, settings=settings, finder=finder)
    samples = run_samples(orders, threads=threads, progress=progress)
    return Scan(tuple(samples), seed, time.perf_counter() - start)


def scan_detectors(
    detectors: Sequence[Detector], particles: Sequence[str | int], *, progress: ShowProgress | None = None, **how: Any
) -> list[Scan]:
    """Run `scan` for each particle and detector, with its other arguments; all detectors see the same particles."""
    pairs = [(particle, detector) for particle in particles for detector in detectors]

    def part(number: int) -> ShowProgress | None:
        return progress and (lambda done, label: progress((number + done) / len(pairs), label))

    return [
        scan(detector, particle=particle, progress=part(number), **how)
        for number, (particle, detector) in enumerate(pairs)
    ]
