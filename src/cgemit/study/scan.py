"""Resolutions against kinematics or a key of the design, simulated and analytic, as lines to draw and rows to write."""

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
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from cgemit.analysis.curves import Line
from cgemit.analysis.quantities import KINEMATICS, MAIN, QUANTITIES, REPORTED, median_error
from cgemit.analysis.resolutions import FORMS, FormFit, fit_form
from cgemit.analysis.widths import Resolution
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems, did_you_mean
from cgemit.base.files import SUMMARY, new_folder
from cgemit.base.validate import NO, check_numbers
from cgemit.base.version import __version__
from cgemit.chain.record import record, write_record
from cgemit.chain.settings import FinderLike, Settings, hits_text, mass_by
from cgemit.covariance.result import Covariance, Widths, core_widths
from cgemit.detector import Detector, load
from cgemit.detector.export import write_files
from cgemit.particles.gun import Gun
from cgemit.particles.species import HYPOTHESES, species
from cgemit.study.evaluation import (
    DIFFERENCES,
    MOMENTA,
    POLAR,
    READERS,
    Columns,
    Expectation,
    Point,
    Sample,
    ShowProgress,
    about_point,
    at_gun,
    cosines_of,
    counts_text,
    difference_columns,
    guns_of,
    hardly_fitted,
    leading_columns,
    matter_of,
    points_at,
    row_columns,
    run_samples,
    text_of,
    why_unfitted,
)
from cgemit.study.sweep.space import axis_of, key_problems, value_problems
from cgemit.tables.schema import FitStatus
from cgemit.tables.show import Shown, Tabular, text_table, with_error, write_csv

#: What rows of a scan go through: the name of a list, or a key with its values.
Against = str | Mapping[str, Any]
#: A number, a range, or a list of these, also as text.
Values = Any


@dataclass(frozen=True)
class Axis:
    """What the rows of a scan differ in.

    Attributes
    ----------
    name : str
        One of `KINEMATICS`, or a dotted key of the detector file.
    unit : str
    values : tuple
        Numbers, or texts.
    detector : Detector or None
        Whose key is varied.
    """

    name: str
    unit: str
    values: tuple[Any, ...]
    detector: Detector | None = None

    @property
    def words(self) -> tuple[str, ...]:
        """The values if they are texts, else none."""
        return () if all(isinstance(value, float) for value in self.values) else tuple(map(str, self.values))

    @property
    def x(self) -> Floats:
        """The values, or their numbers from 0 on if they are texts."""
        return np.array(range(len(self.values)) if self.words else self.values, np.float64)

    @property
    def head(self) -> str:
        """Name with the unit, as in printed tables."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def symbol(self) -> str:
        """What stands at the axis of a picture, without the unit."""
        return KINEMATICS[self.name].symbol if self.name in KINEMATICS else self.name

    def text(self, number: int) -> str:
        """Return a value as text."""
        value = self.values[number]
        return f"{value:g}" if isinstance(value, float) else str(value)

    def at(self, numbers: Sequence[int]) -> str:
        """Return some of the values as text, such as ``0.3, 1 GeV/c`` or ``cos θ = 0.5``."""
        before = "" if self.name in MOMENTA else f"{self.symbol} = "
        unit = f" {self.unit}" if self.unit else ""
        return before + ", ".join(self.text(number) for number in numbers) + unit


@dataclass(frozen=True, eq=False, repr=False)
class Differences(Shown, Tabular):
    """Differences of resolutions of two detectors that saw the same particles.

    Attributes
    ----------
    scan, base : Scan
        Of the detector, and of the one that is subtracted.
    """

    scan: Scan
    base: Scan

    def columns(self) -> Columns:
        """Return what the rows differ in, and the differences of all quantities with their paired errors."""
        return self.scan.leading() | difference_columns(self.scan.samples, self.base.samples)

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        title = (
            f"{self.scan.detector.name} minus {self.base.detector.name}, {self.scan.particle}: differences of core "
            "widths (sigma) and of medians of the fit's errors, with paired errors"
        )
        head = [self.scan.against.head, *(text for name in MAIN for text in _head(name))]
        pairs = zip(self.scan.samples, self.base.samples, strict=True)
        rows = [
            [self.scan.against.text(i), *(_signed(*one.minus(other, *what)) for what in _COMPARED)]
            for i, (one, other) in enumerate(pairs)
        ]
        return title, head, rows


_COMPARED = [(name, kind) for name in MAIN for kind in DIFFERENCES]


def _signed(value: float, error: float) -> str:
    """Return a difference with its sign and error."""
    text = with_error(value, error)
    return f"+{text}" if math.isfinite(value) and value > 0 else text


def _head(name: str) -> tuple[str, str]:
    """Return the heads of the columns of a resolution and of the median of the fit's own errors."""
    return f"{QUANTITIES[name].sigma} [{QUANTITIES[name].unit}]", "median error"


@dataclass(frozen=True, eq=False, repr=False)
class ScanBase(Shown, Tabular):
    """Resolutions of one detector against kinematics or a key of the design, simulated or analytic.

    Attributes
    ----------
    orders : tuple of Point
        One for each row: detector, gun, settings and number of events.
    seed : int
    seconds : float
        Wall time.
    against : Axis
        What the rows differ in.
    """

    orders: tuple[Point, ...]
    seed: int
    seconds: float
    against: Axis

    method: ClassVar[str]

    @property
    def detector(self) -> Detector:
        """The detector, that of the varied key without the change."""
        return self.against.detector or self.orders[0].detector

    @property
    def particle(self) -> str:
        """The particle."""
        return str(self.orders[0].gun.particle)

    @property
    def fixed(self) -> str:
        """Momentum, angle and the rest of what all rows have, as text; a range is a mixture of tracks."""
        texts = []
        for name, known in KINEMATICS.items():
            value = at_gun(self.orders[0].gun, name)
            if name != self.against.name and value is not None:
                texts.append(known.text(value) + (" (mixture)" if isinstance(value, tuple) else ""))
        return ", ".join(texts)

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
        """Readout of the CGEM layers; empty for a detector without them, or if it is varied."""
        texts = {one.detector.readout_text for one in self.orders}
        return texts.pop() if len(texts) == 1 else ""

    def leading(self) -> Columns:
        """Return the columns that say what the rows are about."""
        columns = leading_columns(self.orders, self.method)
        if self.against.detector is not None:
            columns[self.against.head.replace("[", "(").replace("]", ")")] = list(self.against.values)
        return columns

    @property
    def lines(self) -> list[Line]:
        """Core resolutions of d_rho, d_z and p."""
        return [self.line(name) for name in MAIN]

    @cached_property
    def all_lines(self) -> list[Line]:
        """Core resolutions of all quantities."""
        about: dict[str, Any] = {"method": self.method, "particle": self.particle}
        return [replace(self._line(name), **about) for name in REPORTED]

    def line(self, name: str) -> Line:
        """Return the core resolution of one of `REPORTED`."""
        return self.all_lines[REPORTED.index(name)]

    def _line(self, name: str) -> Line:
        raise NotImplementedError

    @cached_property
    def fits(self) -> list[FormFit]:
        """The usual forms, fitted to the lines; none with fewer than three momenta, or against anything else than p.

        Analytic lines have no statistical error: their points have equal relative weights.
        """
        if self.against.name != "p" or self.against.words:
            return []
        first = self.orders[0]
        how: dict[str, Any] = {"particle": first.gun.particle, "cos_theta": cosines_of(first.gun)}
        how |= {"detector": self.detector.name, "method": self.method}
        lines = [(name, self.line(name)) for name in FORMS]
        error = {name: None if self.method == "analytic" else line.y_error for name, line in lines}
        found = [fit_form(name, line.x, line.y, error[name], **how) for name, line in lines]
        return [one for one in found if one is not None]

    def empty(self) -> bool:
        """Tell whether there is no resolution in any row."""
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
    first, against = scans[0].orders[0], scans[0].against
    particles = list(dict.fromkeys(scan.particle for scan in scans))
    inputs: dict[str, Any] = {"detectors": list({scan.detector.name: None for scan in scans})}
    inputs |= {"particle": particles[0]} if len(particles) == 1 else {"particles": particles}
    for name in KINEMATICS:
        values = list(dict.fromkeys(at_gun(order.gun, name) for order in scans[0].orders))
        if values != [None]:
            listed = name in MOMENTA or len(values) > 1
            inputs["momenta" if name == "p" else name] = values if listed else values[0]
    inputs |= {"against": against.name} if against.name not in MOMENTA else {}
    inputs |= {against.head: list(against.values)} if against.detector is not None else {}
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
        Against the same values; each detector and particle with one scan of a method, detectors of distinct names. Of
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

    detectors = {order.detector.name: order.detector for scan in scans for order in scan.orders}
    points = [(scan.method, order) for scan in scans for order in scan.orders]
    source = [about_point(one) | ({} if method == "mc" else {"method": method}) for method, one in points]
    with new_folder(folder, overwrite=overwrite) as place:
        write_csv(place / "resolution.csv", columns_of(scans))
        names = [f"-{number}-" + re.sub(r"[^\w.-]+", "-", name)[:60] for number, name in enumerate(detectors, start=1)]
        names = names if len(detectors) > 1 else [""]
        write_files(place, {f"detector{n}.toml": one for n, one in zip(names, detectors.values(), strict=True)})
        resolutions(scans).save(place / "resolution")
        settings, seed = scans[0].orders[0].settings, scans[0].seed
        write_record(record(detectors=detectors, settings=settings, seed=seed, source=source, command=command), place)
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
    first = next((one for one in scans if isinstance(one, Scan) and one.particle == scan.particle), None)
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


def line_of(samples: Sequence[Sample], quantity: str, against: Axis | None = None) -> Line:
    """Return the core resolution of a quantity against momentum, or what else rows differ in, in the quoted unit."""
    widths = [sample.width(quantity) for sample in samples]
    return _line(samples, f"sigma_{quantity}", widths, QUANTITIES[quantity].unit, against)


def pull_line(samples: Sequence[Sample], parameter: str) -> Line:
    """Return the core width of a parameter's pull against momentum (GeV/c)."""
    return _line(samples, f"pull_{parameter}", [sample.pulls[parameter] for sample in samples], "", None)


def _line(samples: Sequence[Sample], name: str, widths: Sequence[Resolution], unit: str, against: Axis | None) -> Line:
    against = against or Axis("p", "GeV/c", tuple(sample.gun.p for sample in samples))
    return Line(
        name, (against.detector or samples[0].detector).name, against.x, against.unit,
        np.array([w.core for w in widths]), np.array([w.core_error for w in widths]), unit,
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Scan(ScanBase):
    """Simulated resolutions of one detector; `orders` holds a `Sample` for each row.

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
        """The samples, one for each row."""
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
        return line_of(self.samples, name, self.against)

    def columns(self) -> dict[str, list[Any]]:
        """Return the columns of the CSV table."""
        return self.leading() | row_columns(self.samples)

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
        return Differences(self, base)

    def empty(self) -> bool:
        """Tell whether no track was fitted."""
        return not any(sample.fitted for sample in self.samples)

    def _table(self) -> tuple[str, Sequence[str], list[list[str]]]:
        rows = []
        for i, sample in enumerate(self.samples):
            row = [self.against.text(i)]
            for name in MAIN:
                width = sample.width(name)
                row += [with_error(width.core, width.core_error), f"{median_error(sample.tracks, name):.4g}"]
            rows.append([*row, f"{sample.decayed}", f"{sample.fitted}/{sample.n_events}", counts_text(sample.removed)])
        parts = [self.readout and f"readout {self.readout}", f"hits {self.hits}", f"mass {self.mass}"]
        shot = f"{self.detector.name}, {self.particle}, {self.fixed}"
        title = f"{shot}: core widths, and medians of the fit's own errors; {', '.join(filter(None, parts))}"
        head = [self.against.head, *(text for name in MAIN for text in _head(name))]
        return title, [*head, "decayed", "fitted", "left out"], rows

    def note(self) -> str:
        """Return where hardly any track was fitted, and where the fit lost more than 5 % of them; empty if nowhere.

        Tracks of status `unconstrained` are lost to the resolution of the momentum alone.
        """
        few = hardly_fitted(self.samples)
        lines = [f"at {self._at(few)}: {why_unfitted(few)}"] if few else []
        for about, count in (
            ("over 5 % of the tracks are not fitted; the widths of the others may be too small", _failed),
            (_WEAK, _unconstrained),
        ):
            lost = [s for s in self.samples if count(s) > 0.05 * len(s.tracks) and not hardly_fitted([s])]
            if lost:
                lines.append(f"at {self._at(lost)}: {about}")
        return "\n".join(lines)

    def _at(self, samples: Sequence[Any]) -> str:
        return self.against.at([i for i, sample in enumerate(self.samples) if any(sample is one for one in samples)])


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


def _shots(
    detector: Detector, particle: str | int, given: Mapping[str, Values], against: Against | None
) -> tuple[list[Detector], list[Gun], Axis]:
    """Return design and gun of each row, and what the rows differ in.

    Raises
    ------
    ProblemsError
        Listing every problem.
    """
    problems = Problems()
    given = {name: value for name, value in given.items() if value is not None}
    axis: str | None = against if isinstance(against, str) else None
    key: str | None = None
    if isinstance(against, Mapping):
        if len(against) != 1:
            problems.note("against", f"{len(against)} keys", "one key with its values")
        for name, values in against.items():
            if not isinstance(name, str):
                problems.note("against", f"the key {name!r:.60}", "a dotted key of the design")
            elif name not in KINEMATICS:
                axis = key = name
            elif name in given:
                problems.note(f"against, {name}", "both", "one of them")
            else:
                axis, given[name] = name, values
    elif axis in KINEMATICS:
        if axis not in given:
            problems.note("against", f"{axis!r} alone", f"{axis} with its values")
    elif against is not None:
        expected = f"one of {', '.join(KINEMATICS)}, or a key of the design with its values"
        problems.note("against", f"{against!r:.60}", expected)
    momenta = [name for name in MOMENTA if name in given]
    if len(momenta) > 1 or (not momenta and against is None):
        problems.note("p, pt", " and ".join(momenta) or "none", "exactly one of them")
    angles = [name for name in POLAR if name in given]
    if len(angles) > 1:
        problems.note(", ".join(POLAR), " and ".join(angles), "one of them")
    usual = ({} if momenta else {"p": 1.0}) | ({} if angles else {"cos_theta": (-0.93, 0.93)}) | given
    read = {name: READERS[name].read(name, usual[name], problems) for name in KINEMATICS if name in usual}
    values = {name: list(value) for name, value in read.items() if value is not NO}
    several = [name for name, one in values.items() if len(one) > 1]
    axis = axis or (several[0] if several else momenta[0] if momenta else "p")
    if others := [name for name in several if name != axis]:
        more = "" if key is None else f" beside {key}"
        problems.note(
            ", ".join(dict.fromkeys([*([axis] if key is None else []), *others])), f"lists{more}",
            "one list; the others are numbers or ranges (low, high)",
        )  # fmt: skip
    if key is None and any(isinstance(one, tuple) and len(values[axis]) > 1 for one in values.get(axis, ())):
        problems.note(axis, "a range in a list", "numbers")
    if against is not None and key is None and len(only := values.get(axis, ())) == 1 and isinstance(only[0], tuple):
        low, high = only[0]
        expected = f'values, as in "{low:g}:{high:g}:5" or "{low:g},{high:g}"'
        problems.note(axis, "a range, of which one row is a mixture", expected)
    for name in several:
        if len(set(values[name])) < len(values[name]):
            problems.note(name, f"{values[name]!r:.60}", "each value once")
    designs, known = [detector], None
    if key is not None and isinstance(against, Mapping):
        known, designs = _varied(detector, key, against[key], problems)
    problems.report("scan")
    guns = guns_of(particle, values)
    if species(guns[0].particle).charge == 0:
        raise ValueError(f"particle: got {particle!r}; expected a charged particle")
    if known is None:
        known = Axis(axis, KINEMATICS[axis].unit, tuple(_cell(one) for one in values[axis]))
    return designs * (len(guns) // len(designs) or 1), guns * (len(designs) // len(guns) or 1), known


def _cell(value: Any) -> Any:
    return text_of(value, " to ") if isinstance(value, tuple) else float(value)


def _varied(detector: Detector, key: str, given: Any, problems: Problems) -> tuple[Axis | None, list[Detector]]:
    """Return a detector with each value of a key."""
    values = given.tolist() if isinstance(given, np.ndarray) else given
    if isinstance(values, str) or not isinstance(values, Sequence) or not len(values):
        problems.note(key, repr(given), "a list of at least one value")
        return None, []
    if len({repr(value) for value in values}) < len(values):
        problems.note(key, f"{values!r:.60}", "each value once")
    pairs = [(detector, {key: value}) for value in values]
    wrong = key_problems(pairs) + value_problems(pairs)
    if "." not in key:  # more likely meant as an angle or momentum
        expected = f"one of {', '.join(KINEMATICS)}, or a key of the design such as cgem.*.pitch_x"
        hint = did_you_mean(key, KINEMATICS)
        wrong = [one._replace(expected=expected, hint=hint) if one.unknown else one for one in wrong]
    problems.extend(wrong)
    designs = [problems.collect(detector.with_overrides, {key: value}) for value in values] if not wrong else []
    header, (_, *cells) = axis_of(key, detector, values)
    name, _, unit = header.partition(" (")
    cells = [float(one) if isinstance(one, int | float) and not isinstance(one, bool) else str(one) for one in cells]
    return Axis(name, unit.removesuffix(")"), tuple(cells), detector), [one for one in designs if one is not None]


def scan(
    detector: Detector | str | Mapping[str, Any],
    p: Values | None = None,
    *,
    pt: Values | None = None,
    particle: str | int = "mu-",
    cos_theta: Values | None = None,
    theta: Values | None = None,
    eta: Values | None = None,
    phi: Values | None = None,
    d: Values | None = None,
    against: Against | None = None,
    events: int = 5000,
    seed: int = 1,
    settings: Settings | None = None,
    finder: FinderLike = "truth",
    threads: int | None = None,
    progress: ShowProgress | None = None,
) -> Scan:
    """Simulate and fit tracks against momentum, angle, distance of the origin, or a key of the design.

    A number is fixed, a tuple a uniform range, of which a row is a mixture, and a list has a row for each value. Text
    is read as on the command line. One of the arguments may be a list, or the key of `against`.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    p, pt : float, (float, float) or list of float, GeV/c
        Momentum or transverse momentum: one of them. Default: 1 GeV/c, if `against` is given.
    particle : str or int
        Name or number of the Particle Data Group.
    cos_theta, theta, eta : float, (float, float) or list of float
        Cosine of the polar angle, polar angle in rad or with a unit, or pseudorapidity. Default: cos(theta) uniform in
        (-0.93, 0.93).
    phi : float, (float, float) or list of float, rad
        Azimuth of the momentum. Default: all.
    d : float, (float, float) or list of float, mm
        Tracks begin at (d, 0, 0).
    against : str or dict of one list
        What the rows differ in: ``{"cos_theta": [0.0, 0.5]}`` stands for ``cos_theta=[0.0, 0.5]``, and
        ``{"cgem.*.pitch_x": ["400 um", "650 um"]}`` varies a key of the design.
    events : int
        For each row.
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
        If particle or numbers make no sense, the particle is neutral, or there is more than one list.
    PlanError, DetectorError
        If the detector has no such key, or cannot have one of its values.

    Examples
    --------
    >>> scan = cg.study.scan("besiii-cgem-design", [0.3, 1.0], events=100)
    >>> scan.columns()["p (GeV/c)"]
    [0.3, 1.0]
    >>> wide = cg.study.scan("besiii-cgem-design", 1.0, against={"cgem.*.pitch_x": ["400 um", "650 um"]}, events=100)
    >>> wide.columns()["cgem.*.pitch_x (um)"]
    [400.0, 650.0]
    """
    start = time.perf_counter()
    check_numbers("scan", seed, threads, events=(events, 1, 2**31 - 1))
    given = {"p": p, "pt": pt, "cos_theta": cos_theta, "theta": theta, "eta": eta, "phi": phi, "d": d}
    designs, guns, axis = _shots(load(detector), particle, given, against)
    points = points_at(designs, guns, events=events, seed=seed, settings=settings, finder=finder)
    samples = run_samples(points, threads=threads, progress=progress)
    return Scan(tuple(samples), seed, time.perf_counter() - start, axis)


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


#: Points of a line, at least; those asked for are added.
LINE_POINTS = 60


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticScan(ScanBase):
    """Resolutions of one detector from the covariance, without events.

    Attributes
    ----------
    orders, seed, seconds, against
        As of `ScanBase`. No event is simulated; the seed is written to the record.
    x : ndarray, (points,) float64
        Where the lines have points: at the values asked for and, of kinematic variables, at least 60 from the first to
        the last of them.
    widths : Widths
        At the points.
    covariances : tuple of Covariance
        At the points, one for each design.
    guns : tuple of Gun
        At the points.

    Examples
    --------
    >>> lines = cg.study.scan_analytic("besiii-cgem-design", [0.3, 1.0])
    >>> print(lines.at("dr").round(), lines.at("p").round(2))  # um, MeV/c
    [399. 197.] [0.95 4.68]
    """

    x: Floats
    widths: Widths
    covariances: tuple[Covariance, ...]
    guns: tuple[Gun, ...]

    method: ClassVar[str] = "analytic"

    @property
    def covariance(self) -> Covariance:
        """The covariance at the points, of a key's axis that of the first design."""
        return self.covariances[0]

    def sigma(self, name: str, *, rms: bool = False) -> Floats:
        """Return the core resolution at the points of the lines, in the quoted unit.

        Parameters
        ----------
        name : str
            Of `cgemit.analysis.quantities.QUANTITIES`.
        rms : bool
            Whether to return the root of the mean variance instead.
        """
        return (self.widths.rms if rms else self.widths.sigma)[name]

    @property
    def reached(self) -> Floats:
        """Fraction of the tracks with a covariance at the points of the lines."""
        return self.widths.reached

    def _line(self, name: str) -> Line:
        unit, none = QUANTITIES[name].unit, np.full(len(self.x), np.nan)
        return Line(f"sigma_{name}", self.detector.name, self.x, self.against.unit, self.sigma(name), none, unit)

    def at(self, name: str) -> Floats:
        """Return the core resolution at the values asked for, in the quoted unit."""
        return self.sigma(name)[self._asked()]

    def _asked(self) -> npt.NDArray[np.intp]:
        return np.searchsorted(self.x, self.against.x) if len(self.covariances) == 1 else np.arange(len(self.x))

    def columns(self) -> dict[str, list[Any]]:
        """Return the widths for each point of the lines: the columns of the CSV table."""
        if len(self.x) == len(self.orders):
            columns = self.leading()
        else:
            columns = {name: value[:1] * len(self.x) for name, value in self.leading().items()}
            columns[KINEMATICS[self.against.name].header] = self.x.tolist()
        for name in REPORTED:
            columns[QUANTITIES[name].column("sigma")] = self.sigma(name).tolist()
            columns[QUANTITIES[name].column("rms")] = self.sigma(name, rms=True).tolist()
        columns["reached"] = self.reached.tolist()
        for name in ("clusters", "wires"):
            counts = np.concatenate([np.ravel(getattr(one, f"n_{name}")) for one in self.covariances])
            columns[name] = counts.reshape(len(self.x), -1).mean(axis=1).tolist()
        designs = [one.detector for one in self.covariances] * (len(self.x) // len(self.covariances))
        return columns | {"x0 (%)": matter_of(designs, self.guns * (len(self.x) // len(self.guns)))}

    def empty(self) -> bool:
        """Tell whether no track of any point has a covariance."""
        return not self.reached.any()

    def note(self) -> str:
        """Return the values asked for at which no track has a covariance, and why; empty if all have one."""
        asked = self._asked()
        without = [i for i, row in enumerate(asked) if self.reached[row] == 0]
        if not without:
            return ""
        why = ", ".join(FitStatus(int(one)).name for one in np.unique(self.widths.status[asked[without]]))
        return f"at {self.against.at(without)}: no track has a covariance ({why})"

    def _table(self) -> tuple[str, Sequence[str], list[list[str]]]:
        title = f"{self.detector.name}, {self.particle}, {self.fixed}: core widths, analytic"
        title += f"; readout {self.readout}" if self.readout else ""
        head = [self.against.head, *(_head(name)[0] for name in MAIN), "with covariance"]
        values = np.array([self.at(name) for name in MAIN]).T
        rows = [
            [self.against.text(i), *("-" if np.isnan(one) else f"{one:.4g}" for one in row), f"{100 * share:.4g} %"]
            for i, (row, share) in enumerate(zip(values, self.reached[self._asked()], strict=True))
        ]
        return title, head, rows


def line_values(values: Floats, *, equal_ratios: bool = True) -> Floats:
    """Return the points of a line: the values given, in order, and 60 from the least to the largest.

    Parameters
    ----------
    values : ndarray, (n,) float64
        One is returned as it is.
    equal_ratios : bool
        Whether the 60 are in equal ratios, as momenta, instead of equal steps.
    """
    asked = np.unique(np.asarray(values, np.float64))
    if len(asked) == 1:
        return asked
    steps = (np.geomspace if equal_ratios else np.linspace)(asked[0], asked[-1], LINE_POINTS)
    distance = np.min(np.abs(steps[:, None] - asked), axis=1)
    more = steps[distance > 1e-9 * np.max(np.abs(asked))]  # rounding must not make two points of one
    return np.sort(np.concatenate([asked, more]))


def scan_analytic(
    detector: Detector | str | Mapping[str, Any],
    p: Values | None = None,
    *,
    pt: Values | None = None,
    particle: str | int = "mu-",
    cos_theta: Values | None = None,
    theta: Values | None = None,
    eta: Values | None = None,
    phi: Values | None = None,
    against: Against | None = None,
    seed: int = 1,
    settings: Settings | None = None,
    threads: int | None = None,
) -> AnalyticScan:
    """Return the resolutions that `scan` measures from the covariance, without events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    p, pt, cos_theta, theta, eta, phi, against
        As in `scan`; lines have at least 60 points between the first and the last of the values. `pt` and `phi` are no
        ranges.
    particle : str or int
        Name or number of the Particle Data Group.
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
    >>> angles = cg.study.scan_analytic("besiii-cgem-design", 1.0, theta=["30 deg", "90 deg"])
    >>> angles.at("dz").round(2)  # mm
    array([0.58, 0.29])
    """
    start = time.perf_counter()
    check_numbers("scan", seed, threads)
    given = {"p": p, "pt": pt, "cos_theta": cos_theta, "theta": theta, "eta": eta, "phi": phi}
    designs, guns, axis = _shots(load(detector), particle, given, against)
    points = points_at(designs, guns, events=0, seed=seed, settings=settings)
    chosen = points[0].settings
    if others := [one for one in chosen.fit.hypotheses() if HYPOTHESES[one].pdg != abs(species(particle).pdg)]:
        # A covariance does not hold the bias of another mass.
        raise ValueError(
            f"fit.hypothesis: got {', '.join(others)} for {guns[0].particle}; "
            "the analytic method expects the particle's own mass"
        )
    x, lines = axis.x, guns[:1]
    if axis.detector is None and not axis.words:
        x = line_values(axis.x, equal_ratios=axis.name in MOMENTA)
        at = {name: [at_gun(guns[0], name)] for name in KINEMATICS if at_gun(guns[0], name) is not None}
        lines = guns_of(particle, at | {axis.name: x.tolist()})
        designs = designs[:1]
    expectation = Expectation.of(lines, chosen)
    covariances = tuple(expectation.covariance(one, threads) for one in designs)
    found = core_widths([one.entries(expectation.mixed) for one in covariances], tuple(QUANTITIES))
    widths = found[0] if len(found) == 1 else _stacked(found)
    return AnalyticScan(tuple(points), seed, time.perf_counter() - start, axis, x, widths, covariances, tuple(lines))


def _stacked(found: Sequence[Widths]) -> Widths:
    """Return the widths of designs as those of points."""
    sigma, rms = (
        {name: np.concatenate([getattr(one, kind)[name] for one in found]) for name in found[0].sigma}
        for kind in ("sigma", "rms")
    )
    return Widths(
        sigma, rms, *(np.concatenate([getattr(one, name) for one in found]) for name in ("status", "reached"))
    )


def compared(simulated: Scan, line: AnalyticScan) -> str:
    """Return a table of simulated and analytic core widths side by side, with their ratio.

    Parameters
    ----------
    simulated : Scan
    line : AnalyticScan
        Of the same detector, against the same values.
    """
    cells = [[line.against.text(i) for i in range(len(line.orders))]]
    head = [line.against.head]
    for name, points in zip(MAIN, simulated.lines, strict=True):
        expected = line.at(name)
        head += [_head(name)[0], "analytic", "ratio"]
        cells.append([with_error(*pair) for pair in zip(points.y, points.y_error, strict=True)])
        cells.append([with_error(value, 0.0) for value in expected])
        ratios = zip(points.y / expected, points.y_error / expected, strict=True)
        cells.append([with_error(*pair) for pair in ratios])
    head += ["fitted", "left out"]
    cells.append([f"{sample.fitted}/{sample.n_events}" for sample in simulated.samples])
    cells.append([counts_text(sample.removed) for sample in simulated.samples])
    each = "momentum" if line.against.name in MOMENTA else "point"
    title = (
        f"{line.detector.name}, {line.particle}, {line.fixed}: core widths, simulated "
        f"({simulated.samples[0].n_events} events at each {each}, mass {simulated.mass}) and analytic, ratio "
        "simulated/analytic"
    )
    table = text_table(title, head, [list(row) for row in zip(*cells, strict=True)])
    return "\n".join([table, *filter(None, [simulated.note(), line.note()])])
