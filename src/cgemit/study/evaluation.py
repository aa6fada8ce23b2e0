"""The rows of studies: what simulated and expected tracks of one particle, kinematics and design resolve.

Scans, sweeps, goals of optimizations and the paper's curves are views of these rows; no other module of studies
computes the width of a track quantity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any, Literal

import numpy as np

from cgemit.analysis.clusters import ClusterResiduals, DeltaFractions, cluster_residuals, delta_fractions
from cgemit.analysis.quantities import KINEMATICS, QUANTITIES, REPORTED, median, median_error
from cgemit.analysis.resolutions import Pulls, pulls, resolution
from cgemit.analysis.widths import FEWEST, Resolution, core_sigma, jackknife, share_error, without_groups
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems
from cgemit.base.validate import Listed
from cgemit.chain import run
from cgemit.chain.record import gun_data, record
from cgemit.chain.result import Result
from cgemit.chain.settings import FinderLike, Settings, fit_settings, tables_made
from cgemit.covariance.analytic import covariance_at, entries_at
from cgemit.covariance.result import Covariance, Entries
from cgemit.covariance.tracks import Points, points_of
from cgemit.detector import Detector, MapField
from cgemit.detector.inventory import material_scan
from cgemit.detector.parts import extent
from cgemit.particles.gun import Gun
from cgemit.particles.table import FARTHEST, FASTEST
from cgemit.reconstruction.candidates import finder_name
from cgemit.simulation.transport import TransportStatus
from cgemit.tables import Table
from cgemit.tables.schema import FitStatus
from cgemit.tables.show import Shown
from cgemit.truth.match import measuring

#: Shows progress: share of the work that is done (0 to 1) and what is running.
ShowProgress = Callable[[float, str], None]
Columns = dict[str, list[Any]]


#: How values of `KINEMATICS` are read.
READERS = {
    "p": Listed("momentum", 0, FASTEST, above=True, ranges=True),
    "pt": Listed("momentum", 0, FASTEST, above=True, ranges=True),
    "cos_theta": Listed("dimensionless", -1, 1, ranges=True),
    "theta": Listed("angle", 0, math.pi, ranges=True),
    "eta": Listed("dimensionless", -10, 10, ranges=True),
    "phi": Listed("angle", -2 * math.pi, 2 * math.pi, ranges=True),
    "d": Listed("length", 0, FARTHEST, ranges=True),
}
MOMENTA, POLAR = ("p", "pt"), ("cos_theta", "theta", "eta")
_ALL_AROUND = (-math.pi, math.pi)


def guns_of(particle: str | int, kinematics: Mapping[str, Sequence[Any]]) -> list[Gun]:
    """Return a gun for every combination of numbers and ranges of `KINEMATICS`, the last one changing fastest.

    Tracks begin at (d, 0, 0), and in all directions across the beam unless `phi` is given.
    """
    guns = []
    for values in product(*kinematics.values()):
        at = dict(zip(kinematics, values, strict=True))
        guns.append(Gun(particle, vertex=(at.pop("d", 0.0), 0.0, 0.0), **at))
    return guns


def at_gun(gun: Gun, name: str) -> Any:
    """Return one of `KINEMATICS` of a gun: a number, a range, or None."""
    value = gun.vertex[0] if name == "d" else getattr(gun, name)
    usual = {"d": 0.0, "phi": _ALL_AROUND}
    return None if name in usual and value == usual[name] else value


def kinematic_columns(guns: Sequence[Gun]) -> Columns:
    """Return momentum, polar angle, and what else differs from the usual, as columns; ranges as text ``LOW:HIGH``."""
    columns: Columns = {}
    for name, known in KINEMATICS.items():
        values = [at_gun(gun, name) for gun in guns]
        if all(value is None for value in values):
            continue
        instead = _ALL_AROUND if name == "phi" else 0.0
        values = [instead if value is None else value for value in values]
        as_text = any(isinstance(value, tuple) for value in values)
        columns[known.header] = [text_of(value) if as_text else float(value) for value in values]
    return columns


def text_of(value: Any, between: str = ":") -> str:
    """Return a number or a range as text."""
    return f"{value[0]:g}{between}{value[1]:g}" if isinstance(value, tuple) else f"{value:g}"


@dataclass(frozen=True)
class Point:
    """A particle and its kinematics in one design: what a row is about; `finder` as of `cgemit.run`."""

    label: str
    detector: Detector
    gun: Gun
    n_events: int
    seed: int
    settings: Settings
    finder: FinderLike = field(default="truth", kw_only=True)


#: Kinds of widths in a row.
_KINDS = {"sigma": "core", "q68": "q68", "rms": "rms"}
Compared = Literal["sigma", "median_error"]


@dataclass(frozen=True, repr=False)
class Row(Shown, Point):
    """What simulated tracks of a point resolve.

    Attributes
    ----------
    label : str
    detector : Detector
    gun : Gun
    n_events, seed : int
    settings : Settings
    finder : "truth", "ckf" or callable
    tracks : Table
    removed : mapping of str to int
        Tracks that resolutions leave out, by status.
    transport : mapping of str to int
        Particles by how their transport ended.
    timings : mapping of str to float, s
        As of the result.
    """

    tracks: Table
    removed: Mapping[str, int]
    transport: Mapping[str, int]
    timings: Mapping[str, float]

    @cached_property
    def _widths(self) -> dict[str, Resolution]:
        return {}

    def width(self, quantity: str) -> Resolution:
        """Return the widths of a quantity (`cgemit.resolution`)."""
        if quantity not in self._widths:
            self._widths[quantity] = resolution(self.tracks, quantity)
        return self._widths[quantity]

    @cached_property
    def pulls(self) -> Pulls:
        """Pulls of the tracks, see `cgemit.study.pulls`."""
        return pulls(self.tracks)

    @property
    def fitted(self) -> int:
        """How many tracks count in resolutions."""
        return int(np.count_nonzero(measuring(self.tracks)))

    @property
    def decayed(self) -> int:
        """How many particles decayed in flight."""
        return self.transport.get(TransportStatus.decayed.name, 0)

    @property
    def efficiency(self) -> tuple[float, float]:
        """Share of the events with a track that measures its particle, and its binomial error."""
        share = len(np.unique(self.tracks["event"][measuring(self.tracks)])) / self.n_events
        return share, share_error(share, self.n_events)

    def without_groups(self, quantity: str, kind: Compared = "sigma") -> tuple[float, Floats]:
        """Return core width or median error, and its values without each of 20 groups of events, for `jackknife`."""
        known = QUANTITIES[quantity]
        values = known.residual(self.tracks) if kind == "sigma" else known.error(self.tracks)
        rows = known.counts(self.tracks) & np.isfinite(values)  # tracks of no particle have no residual
        values, statistic = values[rows], core_sigma if kind == "sigma" else median
        return statistic(values), without_groups(values, self.tracks["event"][rows], statistic)

    def minus(self, base: Row, quantity: str, kind: Compared = "sigma") -> tuple[float, float]:
        """Return how much larger a resolution is than in another row of the same particles, with its paired error.

        The error follows from leaving out one of 20 groups of events in turn (jackknife), so that the correlation of
        both rows counts.

        Parameters
        ----------
        base : Row
            Of the same gun and seed.
        quantity : str
            Of `QUANTITIES`.
        kind : str
            The core width of the residuals, or the median of the fit's own errors.
        """
        (mine, parts), (other, other_parts) = (row.without_groups(quantity, kind) for row in (self, base))
        return mine - other, jackknife(parts - other_parts)

    def columns_of(self, quantities: Sequence[str], kinds: Sequence[str] = tuple(_KINDS)) -> dict[str, Any]:
        """Return the widths of some quantities with their errors by header, such as ``sigma_p (MeV/c)``."""
        columns: dict[str, Any] = {}
        for name in quantities:
            column, width = QUANTITIES[name].column, self.width(name)
            for kind in kinds:
                columns[column(kind)] = getattr(width, _KINDS[kind])
                columns[column(kind, "_error")] = getattr(width, f"{_KINDS[kind]}_error")
            if len(kinds) > 1:
                columns |= {f"tail_{name}": width.tail, column("median_error"): median_error(self.tracks, name)}
        return columns

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        left_out = counts_text(self.removed, ", ")
        cells = [self.label, repr(self.gun), str(self.n_events), str(self.seed), f"{self.fitted}/{len(self.tracks)}"]
        return "sample", ("sample", "gun", "events", "seed", "fitted", "left out"), [[*cells, left_out]]


@dataclass(frozen=True, repr=False)
class Sample(Row):
    """A row with the residuals of its clusters.

    Attributes
    ----------
    clusters : ClusterResiduals
    deltas : DeltaFractions
    """

    clusters: ClusterResiduals
    deltas: DeltaFractions


def counts_text(counts: Mapping[str, int], between: str = "; ") -> str:
    """Return counts by name as text."""
    return between.join(f"{number} {name}" for name, number in counts.items()) or "none"


def leading_columns(points: Sequence[Point], method: str) -> Columns:
    """Return the columns that say what rows are about: detector, particle, method and kinematics."""
    return {
        "name": [point.detector.name for point in points],
        "hash": [point.detector.content_hash for point in points],
        "particle": [str(point.gun.particle) for point in points],
        "method": [method] * len(points),
        **kinematic_columns([point.gun for point in points]),
    }


def matter_of(detectors: Sequence[Detector], guns: Sequence[Gun]) -> list[float]:
    """Return X/X0 of straight tracks from the origin, %, the mean of a range; NaN along the beam or from elsewhere."""
    found: dict[tuple[str, Any], float] = {}
    values = []
    for detector, gun in zip(detectors, guns, strict=True):
        key = detector.content_hash, tuple(at_gun(gun, name) for name in POLAR)
        if key not in found:
            cosines = np.atleast_1d(cosines_of(gun, many=True))
            along = np.any(np.abs(cosines) >= 1)
            found[key] = math.nan if along else float(np.mean(material_scan(detector, cosines).total))
        values.append(found[key] if at_gun(gun, "d") is None else math.nan)
    return values


def row_columns(rows: Sequence[Row]) -> Columns:
    """Return all widths of simulated rows as columns; `sigma` is the core width, as in sweeps.

    `median_error` is the median of the fit's own errors, `efficiency` the share of the events with a track that
    measures its particle, `clusters` and `wires` are the mean numbers of hits of these tracks, and `x0` is the matter
    that straight tracks cross.
    """
    columns = leading_columns(rows, "mc") | {"events": [row.n_events for row in rows]}
    every = [row.columns_of(REPORTED) for row in rows]
    columns |= {name: [one[name] for one in every] for name in every[0]}
    columns |= {"decayed": [row.decayed for row in rows], "fitted": [row.fitted for row in rows]}
    columns["left out"] = [counts_text(row.removed) for row in rows]
    efficiencies = [row.efficiency for row in rows]
    columns |= {"efficiency": [one[0] for one in efficiencies], "efficiency_error": [one[1] for one in efficiencies]}
    for name in ("clusters", "wires"):
        counts = [row.tracks[f"n_{name}"][measuring(row.tracks)] for row in rows]
        columns[name] = [float(np.mean(one)) if len(one) else math.nan for one in counts]
    return columns | {"x0 (%)": matter_of([row.detector for row in rows], [row.gun for row in rows])}


def difference_columns(rows: Sequence[Row], bases: Sequence[Row]) -> Columns:
    """Return the columns of the differences to other rows of the same particles."""
    columns: Columns = {}
    for name in REPORTED:
        for kind in DIFFERENCES:
            pairs = [row.minus(base, name, kind) for row, base in zip(rows, bases, strict=True)]
            columns[QUANTITIES[name].column(f"delta_{kind}")] = [value for value, _ in pairs]
            columns[QUANTITIES[name].column(f"delta_{kind}", "_error")] = [error for _, error in pairs]
    return columns


#: Kinds of `Row.minus`.
DIFFERENCES: tuple[Compared, ...] = ("sigma", "median_error")

#: Two thirds of the bytes of a run, which no row needs.
_LEFT_OUT = {"wire_truths", "digis", "wire_hits", "refined_wire_hits", "candidate_hits", "residuals", "states"}


def simulated(
    point: Point, *, threads: int | None = None, progress: Callable[[float], None] | None = None
) -> tuple[Result, dict[str, Any]]:
    """Return the run of a point, without tables that no row needs, and what makes it a `Row`."""
    result = run.run(
        point.detector,
        point.gun,
        point.n_events,
        point.seed,
        settings=point.settings,
        finder=point.finder,
        keep=[name for name in tables_made("fit", point.settings, point.detector) if name not in _LEFT_OUT],
        progress=progress,
        workers=threads,
    )
    about = {"tracks": result.tracks, "removed": result.removed(), "transport": result.transport()}
    return result, {**vars(point), **about, "timings": result.timings}


def run_samples(
    points: Sequence[Point], *, threads: int | None = None, progress: ShowProgress | None = None
) -> list[Sample]:
    """Run the chain for each point, one after the other: the largest single run determines the memory.

    Parameters
    ----------
    points : sequence of Point
    threads : int, optional
        Default: all cores.
    progress : callable, optional
        Called with the share of all events that is done and the label of what is running.

    Returns
    -------
    list of Sample
    """
    total = sum(point.n_events for point in points)
    samples, done = [], 0
    for point in points:
        result, about = simulated(point, threads=threads, progress=_part_of(progress, done, point, total))
        samples.append(Sample(**about, clusters=cluster_residuals(result), deltas=delta_fractions(result)))
        done += point.n_events
    return samples


def _part_of(progress: ShowProgress | None, before: int, point: Point, total: int) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda fraction: progress((before + point.n_events * fraction) / total, point.label)


def seed_of(seed: int, number: int) -> int:
    """Return a seed of its own for run `number` of a study (`numpy.random.SeedSequence`)."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0])


def points_at(
    detectors: Sequence[Detector], guns: Sequence[Gun], *, events: int, seed: int, settings: Settings | None = None,
    finder: FinderLike = "truth",
) -> list[Point]:  # fmt: skip
    """Return the points of guns in detectors, one each; point number n has the same particles in every design."""
    points = []
    for number, (detector, gun) in enumerate(zip(detectors, guns, strict=True), start=1):
        names = [name for name in KINEMATICS if at_gun(gun, name) is not None]
        parts = [f"{text_of(at_gun(gun, name))} GeV/c" for name in names if name in MOMENTA]
        if any(at_gun(gun, name) != at_gun(guns[0], name) for name in names if name not in MOMENTA):
            parts += [f"{name} {text_of(at_gun(gun, name))}" for name in names if name not in MOMENTA]
        label = ", ".join([detector.name, str(gun.particle), *parts])
        here = settings or Settings()
        points.append(Point(label, detector, gun, events, seed_of(seed, number), here, finder=finder))
    return points


#: Values that stand for a range of which a covariance has no average of its own.
_MIDDLES = 64


@dataclass(frozen=True, eq=False)
class Expectation:
    """Points at which tracks are expected, the same for every design; `mixed` neighbours make a row."""

    points: Points
    mixed: int
    settings: Settings

    @staticmethod
    def of(guns: Sequence[Gun], settings: Settings, samples: int | None = None) -> Expectation:
        """Return the points of guns of one particle.

        A range of cos(theta) is averaged as in `cgemit.analytic`; one of theta or eta, or with pT, is 64 values.

        Raises
        ------
        ValueError
            If tracks do not begin at the origin, or a transverse momentum or an azimuth is a range.
        """
        problems = Problems()
        for name, expected in (("d", "tracks from the origin"), ("pt", "fixed values"), ("phi", "fixed values")):
            found = {at_gun(gun, name) for gun in guns if name == "d" or isinstance(at_gun(gun, name), tuple)} - {None}
            for value in found:
                problems.note(name, text_of(value), f"{expected} with the analytic method")
        turned = [at_gun(gun, "phi") for gun in guns]
        if None in turned and any(one is not None for one in turned):
            problems.note("phi", "all azimuths beside fixed ones", "one of these with the analytic method")
        problems.report("analytic")
        ranges = any(isinstance(at_gun(gun, name), tuple) for gun in guns for name in POLAR)
        mixed = _MIDDLES if ranges and (guns[0].cos_theta is None or guns[0].pt is not None) else 1
        p, cosine = np.empty((2, len(guns), mixed)), np.empty((2, len(guns), mixed))
        for i, gun in enumerate(guns):
            values = cosines_of(gun, many=mixed > 1)
            cosine[0, i], cosine[1, i] = values if isinstance(values, tuple) else (values, values)
            if gun.pt is not None:
                p[:, i] = gun.pt / np.sqrt(1 - cosine[:, i] ** 2)
            else:
                p[:, i] = np.array(gun.p, np.float64).reshape(-1, 1)
        phi = None if turned[0] is None else np.repeat(np.array(turned, np.float64)[:, None], mixed, axis=1)
        shape = (2, -1) if p[0].size > 1 else (2,)  # as of `cgemit.analytic`, one point is no array
        (p_low, p_high), (low, high) = p.reshape(shape), cosine.reshape(shape)
        phi = None if phi is None else phi.reshape(shape[1:])
        points = points_of(guns[0].particle, (p_low, p_high), (low, high), phi, samples=samples)
        return Expectation(points, mixed, settings)

    def entries(self, detector: Detector) -> Entries:
        """Return what `core_widths` needs of a design, on one core."""
        return entries_at(self.points, detector, self.settings.digitize, fit_settings(self.settings), self.mixed)

    def covariance(self, detector: Detector, threads: int | None = 1) -> Covariance:
        """Return the covariances in a design, `mixed` of them for each row."""
        return covariance_at(self.points, detector, self.settings.digitize, fit_settings(self.settings), threads)


_COSINES: Mapping[str, Callable[[Any], Any]] = {"cos_theta": np.asarray, "theta": np.cos, "eta": np.tanh}


def cosines_of(gun: Gun, *, many: bool = False) -> Any:
    """Return the cosines of the polar angles of a gun: a number, a range, or 64 values of one in theta or eta.

    With `many`, a range of cosines becomes 64 values, too.
    """
    name = next(name for name in POLAR if getattr(gun, name) is not None)
    value, function = getattr(gun, name), _COSINES[name]
    if not isinstance(value, tuple):
        return float(function(value))
    if name == "cos_theta" and not many:
        return value
    return function(value[0] + (value[1] - value[0]) * (np.arange(_MIDDLES) + 0.5) / _MIDDLES)


def hardly_fitted(rows: Sequence[Row]) -> list[Row]:
    """Return the rows with too few fitted tracks for a width."""
    return [row for row in rows if row.fitted < FEWEST]


def why_unfitted(rows: Sequence[Row]) -> str:
    """Return how transport and fit of rows of one detector ended, and where its map ends if tracks left it."""
    tracks = sum(len(row.tracks) for row in rows)
    particles = sum(sum(row.transport.values()) for row in rows)
    transport, removed = (_total([getattr(row, name) for row in rows]) for name in ("transport", "removed"))
    parts = [
        f"{sum(row.fitted for row in rows)} of {tracks} tracks fitted, expected at least {FEWEST} for a resolution",
        "transport: " + _shares_text(transport, particles),
        "fit: " + _shares_text(removed, tracks),
    ]
    field = rows[0].detector.field
    left = {TransportStatus.left_field.name, FitStatus.left_field.name} & (transport.keys() | removed.keys())
    if left and isinstance(field, MapField):
        r, z = extent(rows[0].detector)
        parts += [f"the map is of {field.grid.range_text()}", f"the detector goes to r = {r:g} mm, |z| = {z:g} mm"]
    return "; ".join(parts)


def _total(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: sum(one.get(name, 0) for one in counts) for name in names}


def _shares_text(counts: Mapping[str, int], total: int) -> str:
    return ", ".join(f"{name} {number} of {total}" for name, number in counts.items()) or "all well"


def record_of(points: Sequence[Point], seed: int, command: str = "", method: str = "mc") -> dict[str, Any]:
    """Return what `run.json` of a study holds: its settings and detectors, and the gun of each point.

    Parameters
    ----------
    points : sequence of Point
        With the same settings, at detectors of distinct names or equal ones.
    seed : int
        Of the study.
    command : str
        The command line that made it; none from Python.
    """
    source = [about_point(point) for point in points]
    detectors = {point.detector.name: point.detector for point in points}
    return record(detectors=detectors, settings=points[0].settings, seed=seed, source=source, command=command)


def about_point(point: Point) -> dict[str, Any]:
    """Return what a record says of a point."""
    about: dict[str, Any] = {"label": point.label, "detector": point.detector.name, "gun": gun_data(point.gun)}
    about |= {"events": point.n_events, "seed": point.seed}
    return about if point.finder == "truth" else about | {"finder": finder_name(point.finder)}
