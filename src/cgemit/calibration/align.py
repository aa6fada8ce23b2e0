"""`align`: constants of a detector from tracks, iterated until the description fits (docs/methods/alignment.md)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems
from cgemit.bes3.events import Bes3Events
from cgemit.bes3.refit import KINDS, Kind
from cgemit.calibration.constants import Constant
from cgemit.calibration.modes import Determined, Solution, solve
from cgemit.calibration.settings import AlignmentSettings, plan_of
from cgemit.calibration.sums import Sums, fitted_sums, residual_means
from cgemit.chain.executor import Workers, pool_of
from cgemit.chain.finders import finder_by_name
from cgemit.chain.result import Result
from cgemit.chain.settings import fit_settings
from cgemit.detector import Detector, load
from cgemit.detector.alignment import AlignmentTable, value_of
from cgemit.detector.drift import read_by as hits_read_by
from cgemit.reconstruction.candidates import Finder, by_finder
from cgemit.reconstruction.cluster import read_by as clusters_read_by
from cgemit.reconstruction.finders import HIT_FINDERS
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import Table
from cgemit.tables.show import Tabular

#: Tables that alignment takes.
TAKES = ("clusters", "wire_hits", "candidates", "candidate_hits")


@dataclass(frozen=True)
class Iteration(Tabular):
    """One iteration of an alignment.

    Attributes
    ----------
    tracks, hits, pairs : int
        That were used.
    left_out : int
        Pairs that were not, since they are too far apart.
    chi2 : float
        Of the tracks and pairs, before the step.
    step : float
        Largest change of a constant, in units of its error.
    outlier_pull : float
        Cut on the pulls of hits and pairs.
    """

    tracks: int
    hits: int
    pairs: int
    left_out: int
    chi2: float
    step: float
    outlier_pull: float


@dataclass(frozen=True, eq=False, repr=False)
class Alignment(Determined):
    """Constants of a detector from tracks.

    Attributes
    ----------
    table : AlignmentTable
        Values to be added to those of `before`.
    detector : Detector
        With these constants.
    before : Detector
        As it was described.
    solution : Solution
        Of the last iteration.
    history : tuple of Iteration
    improvement : float
        Chi-square that the constants gain over the description, with the tracks of the last iteration.
    p_value : float
        Probability of that much if the description were right.
    converged : bool
    at_limits : tuple of str
        Constants that were stopped at the end of their range.
    residuals : (mapping, mapping)
        Mean residuals of the first run with the description before, and with that found: mean and error, mm, by names
        such as ``"L1 X"``.

    Examples
    --------
    >>> nominal = cg.load("besiii-cgem").with_readout("gaussian")
    >>> real = nominal.misaligned(seed=3, sizes={"cgem.*": ("100 um", "0.1 mrad")})
    >>> run = cg.run(real, cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), n=500, fit_detector=nominal)
    >>> found = cg.align(run)
    >>> found.converged, len(found.table.name), bool(np.all(np.abs(found.compare(real)) < 5))
    (True, 18, True)
    """

    table: AlignmentTable
    detector: Detector
    before: Detector
    solution: Solution
    history: tuple[Iteration, ...]
    improvement: float
    p_value: float
    converged: bool
    at_limits: tuple[str, ...]
    residuals: tuple[Mapping[str, tuple[float, float]], Mapping[str, tuple[float, float]]]

    def compare(self, real: Detector) -> Floats:
        """Return the pulls of the free constants against a detector whose constants are known, (n,); for studies.

        Parameters
        ----------
        real : Detector
        """
        true = np.array([_difference(self.before, real, one) for one in self.solution.constants])
        value = np.array(self.table.value[: len(true)])
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray((value - true) / self.solution.err)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        title, head, rows = self.table._table()
        last = self.history[-1]
        return f"{title} from {last.tracks} tracks, {len(self.history)} iterations", head, rows

    def note(self) -> str:
        """Return what is not determined, and what the constants gain."""
        lines = [f"chi-square gained {self.improvement:.1f}, p-value {self.p_value:.3g}"]
        if self.zero_modes:
            lines.append(f"the data do not determine: {', '.join(self.zero_modes)}")
        if self.at_limits:
            lines.append(f"at the end of their range: {', '.join(self.at_limits)}")
        if last := self.history[-1].left_out:
            every = last + self.history[-1].pairs
            lines.append(f"{last} of {every} joined events or tracks left out: too far apart")
        if not self.converged:
            lines.append("not converged")
        return "; ".join(lines)


def _difference(before: Detector, real: Detector, constant: Constant) -> float:
    a, b = (value_of(detector, constant.name) for detector in (before, real))
    return (b[0] if b else 0.0) - (a[0] if a else 0.0)


@dataclass(frozen=True, eq=False)
class _Source:
    """Tables of one run, and how its tracks are found and fitted."""

    tables: Mapping[str, Table]
    fit: FitSettings
    find: Finder | None
    described: Detector


Given = Result | Bes3Events | Mapping[str, Table]


def align(
    runs: Given | Sequence[Given],
    settings: AlignmentSettings | None = None,
    *,
    detector: Detector | str | Mapping[str, Any] | None = None,
    fit: FitSettings | None = None,
    reference: Kind | None = None,
    threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> Alignment:
    """Determine constants of a detector from the tracks of runs.

    Every iteration fits all tracks with the constants of the one before, sums the normal equations of all free
    constants, and solves them. Runs whose tracks a finder of the package found are searched anew each time; other
    tables keep their candidates.

    Parameters
    ----------
    runs : Result, Bes3Events, mapping of str to Table, or a sequence of these
        A mapping holds ``clusters``, ``wire_hits``, ``candidates`` and ``candidate_hits``, and may hold ``reference``:
        tracks of these candidates that are known otherwise, of another program or detector, with their errors.
    settings : AlignmentSettings or None
    detector : Detector, what `load` accepts, or None
        Description to be corrected. None: that of the reconstruction of the first run, or of the events.
    fit : FitSettings or None
        None: those of each run.
    reference : str or None
        Tracks of the experiment that tracks of `Bes3Events` are to agree with: ``"kal"`` or ``"mdc"``. None: none.
    threads : int or None
        That sum; None: one for each core.
    progress : callable or None
        Called with the fraction of iterations done.

    Returns
    -------
    Alignment

    Raises
    ------
    ValueError
        Listing every problem: patterns that name nothing, runs without tables, no detector, runs that share events of
        one seed, and tracks that are fewer than the constants.

    Examples
    --------
    >>> run = cg.run("besiii-cgem", cg.sample("cosmic"), n=200, readout="gaussian")
    >>> found = cg.align(run, cg.AlignmentSettings(free=("cgem.*.shift_z",)))
    >>> found.converged, found.table.status
    (True, ('free', 'free', 'free'))
    """
    settings = AlignmentSettings.of(settings)
    given = list(runs) if isinstance(runs, Sequence) else [runs]
    before, sources = sources_of(given, detector, fit, reference)
    free, fixed, priors = plan_of(before, settings)
    total, history = np.zeros(len(free)), list[Iteration]()
    low, high = _limits(before, free)
    now, converged, zero, unseen = before, False, tuple[str, ...](), tuple[str, ...]()
    with pool_of(Workers(threads=threads)) as pool:
        for turn in range(settings.iterations):
            pull = settings.outlier_pull[min(turn, len(settings.outlier_pull) - 1)]
            sums = Sums.none(before, free)
            for source in sources:
                tables = tables_of(source, now)
                tuned = replace(source.fit, outlier_pull=pull)
                sums = sums + fitted_sums(now, tables, free, tuned, settings=settings, pool=pool)
            if sums.tracks <= len(free):
                problem = f"tracks: got {sums.tracks} that are fitted, expected more than the {len(free)} constants"
                raise ValueError(f"align:\n  {problem}")
            constrain = settings.zero_modes == "constrained"
            solution = solve(now, free, sums, priors, total, constrain=constrain, zero=zero, unseen=unseen)
            if turn == 0:
                unseen = tuple(one.name for one, seen in zip(free, sums.measured, strict=True) if seen == 0)
            zero = (*zero, *(name for name in solution.zero_modes if name not in zero))
            wanted = np.where(solution.determined, np.clip(total + solution.value, low, high), 0.0)
            step, total = wanted - total, wanted
            with np.errstate(invalid="ignore", divide="ignore"):
                moved = np.nan_to_num(np.abs(step) / solution.err).max(initial=0.0)
            history.append(Iteration(sums.tracks, sums.hits, sums.pairs, sums.left_out, sums.chi2, float(moved), pull))
            values = {one.name: float(value) for one, value in zip(free, total, strict=True) if value != 0}
            now = before.with_alignment(values)
            if progress is not None:
                progress((turn + 1) / settings.iterations)
            final = pull == settings.outlier_pull[-1]
            if moved < settings.tolerance and final:
                converged = True
                break

    def residuals(described: Detector) -> Mapping[str, tuple[float, float]]:
        return residual_means(described, tables_of(sources[0], described), sources[0].fit)

    at_end = solution.determined & ((total == low) | (total == high))
    at_limits = tuple(one.name for one, end in zip(free, at_end, strict=True) if end)
    improvement = float(total @ (solution.information @ total))
    result = Alignment(
        solution.table(total, fixed), now, before, replace(solution, value=total), tuple(history), improvement,
        _survival(improvement, float(np.count_nonzero(solution.determined))), converged, at_limits,
        (residuals(before), residuals(now)),
    )  # fmt: skip
    if not converged or at_limits:
        warnings.warn(f"align: {result.note()}", stacklevel=2)
    return result


def _survival(chi2: float, ndf: float) -> float:
    from scipy.stats import chi2 as distribution

    return float(distribution.sf(chi2, ndf)) if ndf else 1.0


def _limits(detector: Detector, constants: Sequence[Constant]) -> tuple[Floats, Floats]:
    """Return the ends of the range of each constant, as changes of the description, each (n,)."""
    low, high = [], []
    for one in constants:
        limits = value_of(detector, one.name)
        assert limits is not None
        low.append(limits[1])
        high.append(limits[2])
    return np.array(low), np.array(high)


def sources_of(
    runs: Sequence[object],
    detector: Detector | str | Mapping[str, Any] | None,
    fit: FitSettings | None,
    reference: Kind | None = None,
) -> tuple[Detector, list[_Source]]:
    """Return the description to be corrected, and the runs."""
    problems, sources = Problems(), list[_Source]()
    if reference is not None and (reference not in KINDS or not any(isinstance(one, Bes3Events) for one in runs)):
        problems.note(
            "reference", repr(reference), f"one of {', '.join(map(repr, KINDS))}, and events of the experiment"
        )
    before = None if detector is None else load(detector)
    if fit is not None:
        FitSettings.of(fit, "fit")
    if not runs:
        problems.note("runs", "none", "a run with tracks")
    for number, run in enumerate(runs):
        path = f"runs[{number}]"
        described, finds, fits = before, None, fit or FitSettings()
        tables: dict[str, Any]
        if isinstance(run, Result):
            described = run.fit_detector or run.detector
            tables = {name: run.tables.get(name) for name in TAKES}
            if all(table is not None for table in tables.values()):
                tables["clusters"], tables["wire_hits"] = run.fitted_hits
            finds = finder_by_name(run.finder, run.settings, run.gun) if run.finder in HIT_FINDERS else None
            fits = fit or fit_settings(run.settings, run.gun)
        elif isinstance(run, Bes3Events):
            described = run.detector
            tables = {name: getattr(run, name) for name in TAKES}
            if reference is not None:
                tables["reference"] = run.kal_tracks if reference == "kal" else run.mdc_tracks
        elif isinstance(run, Mapping):
            tables = {name: run.get(name) for name in TAKES} | (
                {"reference": run["reference"]} if "reference" in run else {}
            )
            if described is None:
                problems.note("detector", "none", "the description that made the tables")
        else:
            problems.note(path, type(run).__name__, "a Result, Bes3Events or tables by name")
            continue
        missing = [name for name, table in tables.items() if not isinstance(table, Table)]
        if missing:
            problems.note(path, f"no {', '.join(missing)}", "clusters, wire_hits, candidates and candidate_hits")
            continue
        if described is not None:
            before = before or described
            sources.append(_Source(tables, fits, finds, described))
    _note_shared(runs, problems)
    problems.report("align")
    assert before is not None
    return before, sources


def _note_shared(sources: Sequence[object], problems: Problems) -> None:
    """Note runs whose events have the same random numbers: their smearing is the same, and counts twice."""
    runs = [(number, one) for number, one in enumerate(sources) if isinstance(one, Result)]
    for i, (run_number, run) in enumerate(runs):
        for other_number, other in runs[:i]:
            begin = max(run.first_event, other.first_event)
            end = min(run.first_event + run.n_events, other.first_event + other.n_events)
            if run.seed == other.seed and begin < end:
                text = f"events {begin} to {end - 1} of seed {run.seed}, as runs[{other_number}]"
                problems.note(f"runs[{run_number}]", text, "another seed: smearing depends on seed and event alone")


def tables_of(source: _Source, now: Detector) -> Mapping[str, Table]:
    """Return the tables of a run with the present constants: clusters shifted, tracks found anew."""
    tables = dict(source.tables)
    tables["clusters"] = clusters_read_by(now, source.described, tables["clusters"])
    tables["wire_hits"] = hits_read_by(now, source.described, tables["wire_hits"])
    if source.find is not None:
        tables |= by_finder(source.find, now, tables["clusters"], tables["wire_hits"])
    return tables
