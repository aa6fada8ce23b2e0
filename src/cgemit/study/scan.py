"""Resolutions against momentum and angle, simulated and analytic, as lines to draw and rows to write."""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from cgemit.analysis.curves import Line
from cgemit.analysis.quantities import MAIN, QUANTITIES, REPORTED, median, median_error
from cgemit.analysis.resolutions import FORMS, FormFit, fit_form, resolution
from cgemit.analysis.widths import Resolution, core_sigma, jackknife, without_groups
from cgemit.base.arrays import Floats
from cgemit.base.files import SUMMARY, new_folder
from cgemit.base.validate import InTurn, check_numbers
from cgemit.base.version import __version__
from cgemit.chain.record import gun_data, record, write_record
from cgemit.chain.settings import FinderLike, Settings, hits_text, mass_by
from cgemit.covariance.analytic import analytic
from cgemit.covariance.result import Covariance
from cgemit.covariance.tracks import core_width, mean
from cgemit.detector import Detector, load
from cgemit.detector.export import write_files
from cgemit.particles.species import HYPOTHESES, species
from cgemit.reconstruction.candidates import finder_name
from cgemit.study import samples
from cgemit.study.samples import (
    Order,
    Sample,
    ShowProgress,
    angle_of,
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
from cgemit.tables.schema import FitStatus
from cgemit.tables.show import Shown, Tabular, text_table, with_error, write_csv

Columns = dict[str, list[Any]]


def leading_columns(orders: Sequence[Order], method: str) -> Columns:
    """Return the columns that say what a row is about: detector, particle, method, momentum and angle."""
    columns: Columns = {
        "name": [order.detector.name for order in orders],
        "hash": [order.detector.content_hash for order in orders],
        "particle": [str(order.gun.particle) for order in orders],
        "method": [method] * len(orders),
        f"{momentum_name(orders[0])} (GeV/c)": [momentum_of(order) for order in orders],
    }
    name = angle_of(orders[0])[0]
    return columns | {"theta (rad)" if name == "theta" else name: [angle_of(order)[1] for order in orders]}


def scan_columns(samples: Sequence[Sample]) -> Columns:
    """Return the widths of all quantities for each momentum.

    `sigma` is the core width, as in sweeps; `median_error` the median of the fit's own errors.
    """
    columns = leading_columns(samples, "mc") | {"events": [s.n_events for s in samples]}
    for name in REPORTED:
        column, widths = QUANTITIES[name].column, [resolution(s.tracks, name) for s in samples]
        columns |= {
            column("sigma"): [w.core for w in widths],
            column("sigma", "_error"): [w.core_error for w in widths],
        }
        columns |= {column("q68"): [w.q68 for w in widths], column("q68", "_error"): [w.q68_error for w in widths]}
        columns |= {column("rms"): [w.rms for w in widths], column("rms", "_error"): [w.rms_error for w in widths]}
        columns[f"tail_{name}"] = [w.tail for w in widths]
        columns[column("median_error")] = [median_error(s.tracks, name) for s in samples]
    columns["decayed"] = [decayed(s) for s in samples]
    columns["fitted"] = [fitted(s) for s in samples]
    columns["left out"] = [counts_text(s.removed) for s in samples]
    return columns


def counts_text(counts: Mapping[str, int]) -> str:
    """Return counts by name as text."""
    return "; ".join(f"{number} {name}" for name, number in counts.items()) or "none"


def difference(
    sample: Sample, base: Sample, quantity: str, kind: Literal["sigma", "median_error"] = "sigma"
) -> tuple[float, float]:
    """Return how much larger a resolution is than in another sample of the same events, with its paired error.

    The error follows from leaving out one of 20 groups of events in turn (jackknife), so that the correlation of both
    samples counts.

    Parameters
    ----------
    sample, base : Sample
        Of the same gun and seed.
    quantity : str
        Of `QUANTITIES`.
    kind : str
        The core width of the residuals, or the median of the fit's own errors.
    """
    known, widths, replicas = QUANTITIES[quantity], [], []
    for tracks in (sample.tracks, base.tracks):
        values, statistic = (known.residual(tracks), core_sigma) if kind == "sigma" else (known.error(tracks), median)
        rows = known.counts(tracks) & np.isfinite(values)  # tracks of no particle have no residual
        values = values[rows]
        widths.append(statistic(values))
        replicas.append(without_groups(values, tracks["event"][rows], statistic))
    return widths[0] - widths[1], jackknife(replicas[0] - replicas[1])


#: Kinds of `difference`.
_KINDS: tuple[Literal["sigma", "median_error"], ...] = ("sigma", "median_error")


def difference_columns(samples: Sequence[Sample], bases: Sequence[Sample]) -> Columns:
    """Return the columns of the differences to other samples of the same events."""
    columns: Columns = {}
    for name in REPORTED:
        for kind in _KINDS:
            pairs = [difference(*pair, name, kind) for pair in zip(samples, bases, strict=True)]
            columns[QUANTITIES[name].column(f"delta_{kind}")] = [value for value, _ in pairs]
            columns[QUANTITIES[name].column(f"delta_{kind}", "_error")] = [error for _, error in pairs]
    return columns


@dataclass(frozen=True, eq=False, repr=False)
class Differences(Shown, Tabular):
    """Differences of resolutions of two detectors that saw the same particles.

    Attributes
    ----------
    samples, bases : tuple of Sample
        Of the detector, and of the one that is subtracted.
    """

    samples: tuple[Sample, ...]
    bases: tuple[Sample, ...]

    def columns(self) -> Columns:
        """Return momenta, angles, and the differences of all quantities with their paired errors."""
        return leading_columns(self.samples, "mc") | difference_columns(self.samples, self.bases)

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        first, base = self.samples[0], self.bases[0]
        title = (
            f"{first.detector.name} minus {base.detector.name}, {first.gun.particle}: differences of core widths "
            "(sigma) and of medians of the fit's errors, with paired errors"
        )
        head = [f"{momentum_name(first)} [GeV/c]", *(text for name in MAIN for text in _head(name))]
        rows = [
            [
                f"{momentum_of(pair[0]):g}",
                *(_signed(*difference(*pair, name, kind)) for name in MAIN for kind in _KINDS),
            ]
            for pair in zip(self.samples, self.bases, strict=True)
        ]
        return title, head, rows


def _signed(value: float, error: float) -> str:
    """Return a difference with its sign and error."""
    text = with_error(value, error)
    return f"+{text}" if math.isfinite(value) and value > 0 else text


def _head(name: str) -> tuple[str, str]:
    """Return the heads of the columns of a resolution and of the median of the fit's own errors."""
    return f"{QUANTITIES[name].sigma} [{QUANTITIES[name].unit}]", "median error"


def shot_text(order: Order) -> str:
    """Return particle and angle of the tracks as text."""
    return f"{order.gun.particle}, {angle_text(order)}"


def angle_text(order: Order) -> str:
    """Return the angle of the tracks as text."""
    name, value = angle_of(order)
    text = f"{value:g}" if isinstance(value, float) else str(value).replace(":", " to ")
    unit = " rad" if name == "theta" else ""
    return f"{'θ' if name == 'theta' else 'cos θ'} = {text}{unit}"


@dataclass(frozen=True, eq=False, repr=False)
class ScanBase(Shown, Tabular):
    """Resolutions of one detector against momentum, simulated or analytic.

    Attributes
    ----------
    orders : tuple of Order
        One for each momentum: detector, gun, settings and number of events.
    seed : int
    seconds : float
        Wall time.
    """

    orders: tuple[Order, ...]
    seed: int
    seconds: float

    method: ClassVar[str]

    @property
    def detector(self) -> Detector:
        """The detector."""
        return self.orders[0].detector

    @property
    def angle(self) -> str:
        """Polar angle of the tracks, as text."""
        return angle_text(self.orders[0])

    @property
    def momenta(self) -> list[float]:
        """Momenta or transverse momenta of the orders, GeV/c."""
        return [momentum_of(order) for order in self.orders]

    @property
    def hits(self) -> str:
        """How hits came to their tracks; empty without events."""
        return ""

    @property
    def mass(self) -> str:
        """Particle whose mass the fit assumed, as text; empty without events."""
        return ""

    @property
    def removed(self) -> Mapping[str, Mapping[str, int]]:
        """Tracks that resolutions leave out, by sample and status."""
        return {}

    @property
    def readout(self) -> str:
        """Readout of the CGEM layers; empty for a detector without them."""
        first = self.orders[0]
        return first.detector.readout_text

    @property
    def lines(self) -> list[Line]:
        """Core resolutions of d_rho, d_z and p against momentum."""
        return [self.line(name) for name in MAIN]

    @cached_property
    def all_lines(self) -> list[Line]:
        """Core resolutions of all quantities against momentum, or transverse momentum."""
        about: dict[str, Any] = {"method": self.method, "particle": str(self.orders[0].gun.particle)}
        return [replace(self._line(name), **about) for name in REPORTED]

    def line(self, name: str) -> Line:
        """Return the core resolution of one of `REPORTED` against momentum, or transverse momentum."""
        return self.all_lines[REPORTED.index(name)]

    def _line(self, name: str) -> Line:
        raise NotImplementedError

    @cached_property
    def fits(self) -> list[FormFit]:
        """The usual forms, fitted to the lines; none with fewer than three momenta, or against pT.

        Analytic lines have no statistical error: their points have equal relative weights.
        """
        first = self.orders[0]
        if transverse(first):
            return []
        how: dict[str, Any] = {"particle": first.gun.particle, "cos_theta": cosines_of(first)}
        how |= {"detector": self.detector.name, "method": self.method}
        lines = [(name, self.line(name)) for name in FORMS]
        error = {name: None if self.method == "analytic" else line.y_error for name, line in lines}
        found = [fit_form(name, line.x, line.y, error[name], **how) for name, line in lines]
        return [one for one in found if one is not None]

    def empty(self) -> bool:
        """Tell whether there is no resolution at any momentum."""
        raise NotImplementedError

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


def summary_of(scans: Sequence[ScanBase]) -> dict[str, Any]:
    """Return what `summary.json` holds: the curves of all detectors and methods, for the same gun."""
    simulated = [scan for scan in scans if scan.method == "mc"]
    first = scans[0].orders[0]
    angle = angle_of(first)[0]
    value = getattr(first.gun, angle)
    particles = list(dict.fromkeys(scan.orders[0].gun.particle for scan in scans))
    inputs: dict[str, Any] = {"detectors": list(_detectors(scans))}
    inputs |= {"particle": particles[0]} if len(particles) == 1 else {"particles": particles}
    inputs[angle] = list(value.values) if isinstance(value, InTurn) else value
    inputs["momenta" if momentum_name(first) == "p" else "pt"] = [momentum_of(order) for order in scans[0].orders]
    if simulated:
        inputs["events"] = simulated[0].orders[0].n_events
    methods = {scan.method for scan in scans}
    inputs |= {"method": methods.pop() if len(methods) == 1 else "both", "settings": first.settings.to_dict()}
    if simulated:
        inputs["hits"], inputs["mass"] = simulated[0].hits, simulated[0].mass
    return {
        "program": "cgemit",
        "version": __version__,
        "inputs": inputs,
        "seed": scans[0].seed,
        "timings": {"total_s": sum(scan.seconds for scan in scans)},
        "removed": {label: dict(counts) for scan in scans for label, counts in scan.removed.items()},
        "curves": [line.as_json() for scan in scans for line in scan.all_lines],
        "fits": [fit.as_json() for scan in scans for fit in scan.fits],
    }


def save_scans(
    scans: Sequence[ScanBase], folder: str | os.PathLike[str], *, overwrite: bool = False, command: str = ""
) -> Path:
    """Write what `Scan.save` writes, for several detectors and methods: one table and one picture of all.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Same angles and momenta; each detector and particle with one scan of a method, detectors of distinct names. Of
        several detectors, each is written to a file of its own, ``detector-1-NAME.toml``.
    folder : path
    overwrite : bool
    command : str
        Command line for run.json, if there was one.

    Raises
    ------
    OutputExistsError
        If the folder holds files and `overwrite` is false.
    """
    from cgemit.draw.curves import resolutions

    detectors = _detectors(scans)
    with new_folder(folder, overwrite=overwrite) as place:
        write_csv(place / "resolution.csv", columns_of(scans))
        names = [f"-{number}-" + re.sub(r"[^\w.-]+", "-", name)[:60] for number, name in enumerate(detectors, start=1)]
        names = names if len(detectors) > 1 else [""]
        write_files(place, {f"detector{n}.toml": one for n, one in zip(names, detectors.values(), strict=True)})
        resolutions(scans).save(place / "resolution")
        write_record(_record(scans, command), place)
        (place / SUMMARY).write_text(json.dumps(summary_of(scans), indent=2) + "\n", encoding="utf-8")
    return Path(folder)


def columns_of(scans: Sequence[ScanBase]) -> dict[str, list[Any]]:
    """Return the columns of the CSV table; cells are empty where a method has no such number.

    Simulated scans beside one of another detector and the same particle have columns of the differences to the first.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
    """
    tables = []
    for scan in scans:
        base = base_of(scan, scans)
        more = scan.minus(base).columns() if isinstance(scan, Scan) and base is not None else {}
        tables.append({**scan.columns(), **more})
    names = dict.fromkeys(name for table in tables for name in table)
    sizes = [len(next(iter(table.values()))) for table in tables]
    return {
        name: [cell for table, size in zip(tables, sizes, strict=True) for cell in table.get(name, [""] * size)]
        for name in names
    }


def base_of(scan: ScanBase, scans: Sequence[ScanBase]) -> Scan | None:
    """Return the simulated scan of the first detector with the same particle; None for itself and analytic scans."""
    particle = scan.orders[0].gun.particle
    first = next((one for one in scans if isinstance(one, Scan) and one.orders[0].gun.particle == particle), None)
    return first if isinstance(scan, Scan) and first is not scan else None


def fits_text(scans: Sequence[ScanBase]) -> str:
    """Return the fits of the usual forms to some scans, one a line; empty with fewer than three momenta.

    Parameters
    ----------
    scans : sequence of Scan or AnalyticScan
        Of one detector.
    """
    kinds = {"mc": "simulated", "analytic": "analytic"}
    return "\n".join(f"{kinds[scan.method]}: {fit}" for scan in scans for fit in scan.fits)


def _detectors(scans: Sequence[ScanBase]) -> dict[str, Detector]:
    return {scan.detector.name: scan.detector for scan in scans}


def _record(scans: Sequence[ScanBase], command: str) -> dict[str, Any]:
    """Return what `run.json` holds: settings and detectors, and the gun of each sample and line."""
    source = []
    for scan in scans:
        for order in scan.orders:
            about: dict[str, Any] = {"label": order.label, "detector": order.detector.name, "gun": gun_data(order.gun)}
            about |= {"events": order.n_events, "seed": order.seed}
            about |= {} if order.finder == "truth" else {"finder": finder_name(order.finder)}
            source.append(about if scan.method == "mc" else about | {"method": scan.method})
    return record(
        detectors=_detectors(scans), settings=scans[0].orders[0].settings, seed=scans[0].seed, source=source,
        command=command,
    )  # fmt: skip


def momentum_line(samples: Sequence[Sample], quantity: str) -> Line:
    """Return the core resolution of a quantity against momentum (GeV/c) in the quoted unit."""
    widths = [resolution(s.tracks, quantity) for s in samples]
    return _line(samples, f"sigma_{quantity}", widths, QUANTITIES[quantity].unit)


def pull_line(samples: Sequence[Sample], parameter: str) -> Line:
    """Return the core width of a parameter's pull against momentum (GeV/c)."""
    return _line(samples, f"pull_{parameter}", [s.pulls[parameter] for s in samples], "")


def _line(samples: Sequence[Sample], name: str, widths: Sequence[Resolution], unit: str) -> Line:
    return Line(
        name, samples[0].detector.name, np.array([momentum_of(s) for s in samples]), "GeV/c",
        np.array([w.core for w in widths]), np.array([w.core_error for w in widths]), unit,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Scan(ScanBase):
    """Simulated resolutions of one detector against momentum; `orders` holds a `Sample` for each momentum.

    Examples
    --------
    >>> scan = cg.study.scan("besiii-cgem-design", [0.3, 1.0], events=100)
    >>> [len(sample.tracks) for sample in scan.orders]
    [100, 100]
    """

    orders: tuple[Sample, ...]

    method: ClassVar[str] = "mc"

    @property
    def samples(self) -> tuple[Sample, ...]:
        """The samples, one for each momentum."""
        return self.orders

    @property
    def hits(self) -> str:
        """How hits came to their tracks."""
        return hits_text(self.samples[0].tracks)

    @property
    def mass(self) -> str:
        """Particle whose mass the fit assumed, as text."""
        return mass_by(self.samples[0].tracks.meta)

    @property
    def removed(self) -> dict[str, Mapping[str, int]]:
        """Tracks that resolutions leave out, by sample and status."""
        return {s.label: s.removed for s in self.samples}

    def _line(self, name: str) -> Line:
        return momentum_line(self.samples, name)

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
        shots = [[(one.gun, one.n_events, one.seed) for one in scan.samples] for scan in (self, base)]
        if shots[0] != shots[1]:
            raise ValueError("difference of scans: got different particles, expected equal guns, events and seeds")
        return Differences(self.samples, base.samples)

    def empty(self) -> bool:
        """Tell whether no track was fitted."""
        return not any(map(fitted, self.samples))

    def _table(self) -> tuple[str, Sequence[str], list[list[str]]]:
        rows = []
        for i, sample in enumerate(self.samples):
            row = [f"{momentum_of(sample):g}"]
            for name, line in zip(MAIN, self.lines, strict=True):
                row += [with_error(line.y[i], line.y_error[i]), f"{median_error(sample.tracks, name):.4g}"]
            row += [f"{decayed(sample)}", f"{fitted(sample)}/{sample.n_events}", counts_text(sample.removed)]
            rows.append(row)
        first = self.samples[0]
        shot = f"{first.detector.name}, {shot_text(first)}"
        parts = [self.readout and f"readout {self.readout}", f"hits {self.hits}", f"mass {self.mass}"]
        made = ", ".join(filter(None, parts))
        title = f"{shot}: core widths, and medians of the fit's own errors; {made}"
        head = [f"{momentum_name(first)} [GeV/c]", *(text for name in MAIN for text in _head(name))]
        return title, [*head, "decayed", "fitted", "left out"], rows

    def note(self) -> str:
        """Return where hardly any track was fitted, and where the fit lost more than 5 % of them; empty if nowhere.

        Tracks of status `unconstrained` are lost to the resolution of the momentum alone.
        """
        few = hardly_fitted(self.samples)
        lines = [f"at {_momenta(few)} GeV/c: {why_unfitted(few)}"] if few else []
        for about, count in (
            ("over 5 % of the tracks are not fitted; the widths of the others may be too small", _failed),
            (_WEAK, _unconstrained),
        ):
            lost = [s for s in self.samples if count(s) > 0.05 * len(s.tracks) and not hardly_fitted([s])]
            if lost:
                lines.append(f"at {_momenta(lost)} GeV/c: {about}")
        return "\n".join(lines)


#: Resolutions leave these tracks out of the momentum alone.
_WEAK = (
    "over 5 % of the tracks do not measure their momentum (unconstrained); "
    "the momentum widths of the others may be too small"
)


def _failed(sample: Sample) -> int:
    """Return how many tracks the fit lost."""
    lost = FitStatus.__members__.keys() - {FitStatus.unconstrained.name}
    return sum(number for name, number in sample.removed.items() if name in lost)


def _unconstrained(sample: Sample) -> int:
    return sample.removed.get(FitStatus.unconstrained.name, 0)


def _momenta(samples: Sequence[Sample]) -> str:
    return ", ".join(f"{momentum_of(sample):g}" for sample in samples)


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
        As of `cgemit.run`. Found tracks have the mass of the particle, or of ``settings.find.hypothesis``.
    threads : int, optional
        Default: all cores.
    progress : callable, optional
        Called with the share that is done and what is running.

    Raises
    ------
    ValueError
        If particle or numbers make no sense, or the particle is neutral.

    Examples
    --------
    >>> scan = cg.study.scan("besiii-cgem-design", [0.3, 1.0], events=100)
    >>> scan.columns()["p (GeV/c)"]
    [0.3, 1.0]
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


#: Momenta of a line, at least; those asked for are added.
LINE_POINTS = 60


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticScan(ScanBase):
    """Resolutions of one detector against momentum from the covariance, without events.

    Attributes
    ----------
    orders, seed, seconds
        As of `ScanBase`. No event is simulated; the seed is written to the record.
    covariance : Covariance
        At the momenta of the lines (first axis), and the values of a list of cos(theta) (second axis).

    Examples
    --------
    >>> lines = cg.study.scan_analytic("besiii-cgem-design", [0.3, 1.0])
    >>> print(lines.at("dr").round(), lines.at("p").round(2))  # um, MeV/c
    [399. 197.] [0.95 4.68]
    """

    covariance: Covariance

    method: ClassVar[str] = "analytic"

    @cached_property
    def p(self) -> Floats:
        """Momenta of the lines: those asked for, and at least 60 from the first to the last of them."""
        return line_momenta(self.momenta)

    def sigma(self, name: str, *, rms: bool = False) -> Floats:
        """Return the core resolution at the momenta of the lines, in the quoted unit.

        Parameters
        ----------
        name : str
            Of `cgemit.analysis.quantities.QUANTITIES`.
        rms : bool
            Whether to return the root of the mean variance instead.
        """
        rows = self.covariance.variances(name).reshape(len(self.p), -1)
        return np.sqrt(mean(rows, ~np.isnan(rows))) if rms else core_width(rows)

    @property
    def reached(self) -> Floats:
        """Fraction of the tracks with a covariance at the momenta of the lines."""
        return np.asarray(self.covariance.reached.reshape(len(self.p), -1).mean(axis=1))

    def _line(self, name: str) -> Line:
        unit, none = QUANTITIES[name].unit, np.full(len(self.p), np.nan)
        return Line(f"sigma_{name}", self.detector.name, self.p, "GeV/c", self.sigma(name), none, unit)

    def at(self, name: str) -> Floats:
        """Return the core resolution at the momenta asked for, in the quoted unit."""
        return self.sigma(name)[self._asked()]

    def _asked(self) -> npt.NDArray[np.intp]:
        return np.searchsorted(self.p, self.momenta)

    def columns(self) -> dict[str, list[Any]]:
        """Return the widths for each momentum of the lines: the columns of the CSV table."""
        first, n = leading_columns(self.orders[:1], self.method), len(self.p)
        columns = {name: value * n for name, value in first.items()}
        columns[f"{momentum_name(self.orders[0])} (GeV/c)"] = self.p.tolist()
        for name in REPORTED:
            columns[QUANTITIES[name].column("sigma")] = self.sigma(name).tolist()
            columns[QUANTITIES[name].column("rms")] = self.sigma(name, rms=True).tolist()
        return columns | {"reached": self.reached.tolist()}

    def empty(self) -> bool:
        """Tell whether no track at any momentum has a covariance."""
        return not self.reached.any()

    def note(self) -> str:
        """Return the momenta asked for at which no track has a covariance, and why; empty if all have one."""
        without = self._asked()[self.reached[self._asked()] == 0]
        if not len(without):
            return ""
        status = self.covariance.status.reshape(len(self.p), -1)[without]
        why = ", ".join(FitStatus(int(one)).name for one in np.unique(status))
        momenta = ", ".join(f"{p:g}" for p in self.p[without])
        return f"at {momenta} GeV/c: no track has a covariance ({why})"

    def _table(self) -> tuple[str, Sequence[str], list[list[str]]]:
        title = f"{self.detector.name}, {shot_text(self.orders[0])}: core widths, analytic"
        title += f"; readout {self.readout}" if self.readout else ""
        head = [f"{momentum_name(self.orders[0])} [GeV/c]", *(_head(name)[0] for name in MAIN), "with covariance"]
        values = [self.at(name) for name in MAIN]
        shares = self.reached[self._asked()]
        rows = [
            [f"{p:g}", *("-" if np.isnan(one) else f"{one:.4g}" for one in row), f"{100 * share:.4g} %"]
            for p, row, share in zip(self.momenta, zip(*values, strict=True), shares, strict=True)
        ]
        return title, head, rows


def line_momenta(momenta: Sequence[float]) -> Floats:
    """Return the momenta of a line: those given, in order, and 60 in equal ratios from the least to the largest.

    Parameters
    ----------
    momenta : sequence of float
        One is returned as it is.
    """
    asked = np.unique(np.asarray(momenta, np.float64))
    if len(asked) == 1:
        return asked
    steps = np.geomspace(asked[0], asked[-1], LINE_POINTS)
    distance = np.min(np.abs(steps[:, None] - asked), axis=1)
    more = steps[distance > 1e-9 * asked[-1]]  # rounding must not make two points of one
    return np.sort(np.concatenate([asked, more]))


def scan_analytic(
    detector: Detector | str | Mapping[str, Any],
    momenta: Sequence[float] | None = None,
    *,
    pt: Sequence[float] | None = None,
    particle: str | int = "mu-",
    cos_theta: float | tuple[float, float] | list[float] | None = None,
    theta: Any = None,
    seed: int = 1,
    settings: Settings | None = None,
    threads: int | None = None,
) -> AnalyticScan:
    """Return the resolutions that `scan` measures from the covariance, without events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    momenta, pt : sequence of float, GeV/c
        Momenta or transverse momenta: one of them. The lines also have at least 60 from the first to the last of them.
    particle : str or int
        Name or number of the Particle Data Group.
    cos_theta, theta : float, (float, float) or list of float
        As in `scan`; averaged over a uniform range, or over some values. Transverse momenta need fixed angles.
    seed : int
        Kept for the record; nothing is random.
    settings : Settings, optional
        Of all stages; the sides of the wires and the fit enter.
    threads : int, optional
        Default: all cores.

    Raises
    ------
    ValueError
        If particle or numbers make no sense, the particle is neutral, or the fit assumes the mass of another particle.

    Examples
    --------
    >>> lines = cg.study.scan_analytic("besiii-cgem-design", [0.3, 1.0])
    >>> lines.at("dr").round()  # um
    array([399., 197.])
    """
    start = time.perf_counter()
    check_numbers("scan", seed, threads)
    gun = samples.gun_arguments(momenta, pt, particle, cos_theta, theta)
    orders = samples.momentum_orders(load(detector), **gun, events=0, seed=seed, settings=settings)
    first = orders[0]
    digitize, fit = first.settings.digitize, first.settings.fit
    if others := [name for name in fit.hypotheses() if HYPOTHESES[name].pdg != abs(species(first.gun.particle).pdg)]:
        # A covariance does not hold the bias of another mass.
        raise ValueError(
            f"fit.hypothesis: got {', '.join(others)} for {first.gun.particle}; "
            "the analytic method expects the particle's own mass"
        )
    p, angles = _grid(line_momenta([momentum_of(order) for order in orders]), first)
    covariance = analytic(
        first.detector, first.gun.particle, p, angles, reveal_sides=digitize.reveal_sides,
        fit=fit, threads=threads,
    )  # fmt: skip
    return AnalyticScan(tuple(orders), seed, time.perf_counter() - start, covariance)


def _grid(momenta: Floats, order: Order) -> tuple[Floats, Any]:
    """Return momenta, p or pT, as p; and the cosines to be broadcast with it."""
    angles = cosines_of(order)
    if isinstance(angles, InTurn | list):
        momenta, angles = momenta[:, None], list(angles.values if isinstance(angles, InTurn) else angles)
    if not transverse(order):
        return momenta, angles
    if isinstance(angles, tuple):
        raise ValueError(f"cos_theta: got a range, {angles}, with pT; the analytic method expects fixed angles")
    return momenta / np.sqrt(1 - np.square(angles)), angles


def compared(simulated: Scan, line: AnalyticScan) -> str:
    """Return a table of simulated and analytic core widths side by side, with their ratio.

    Parameters
    ----------
    simulated : Scan
    line : AnalyticScan
        Of the same detector and momenta.
    """
    first = line.orders[0]
    cells = [[f"{p:g}" for p in line.momenta]]
    head = [f"{momentum_name(first)} [GeV/c]"]
    for name, points in zip(MAIN, simulated.lines, strict=True):
        expected = line.at(name)
        head += [_head(name)[0], "analytic", "ratio"]
        cells.append([with_error(*pair) for pair in zip(points.y, points.y_error, strict=True)])
        cells.append([with_error(value, 0.0) for value in expected])
        ratios = zip(points.y / expected, points.y_error / expected, strict=True)
        cells.append([with_error(*pair) for pair in ratios])
    head += ["fitted", "left out"]
    cells.append([f"{fitted(sample)}/{sample.n_events}" for sample in simulated.samples])
    cells.append([counts_text(sample.removed) for sample in simulated.samples])
    title = (
        f"{first.detector.name}, {shot_text(first)}: core widths, simulated "
        f"({simulated.samples[0].n_events} events at each momentum, mass {simulated.mass}) and analytic, ratio "
        "simulated/analytic"
    )
    table = text_table(title, head, [list(row) for row in zip(*cells, strict=True)])
    return "\n".join([table, *filter(None, [simulated.note(), line.note()])])
