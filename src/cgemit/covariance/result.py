"""Covariances of a grid of points as numpy arrays, their widths and their error budget."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.analysis.quantities import ABSOLUTE, NAMES, QUANTITIES, UPPER, quantity_of
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems
from cgemit.covariance.losses import Losses
from cgemit.covariance.tracks import Points, Sample, Tracks, core_width, mean, status_of
from cgemit.detector import Detector
from cgemit.detector.inventory import part_of
from cgemit.detector.matter import slabs
from cgemit.reconstruction.fit import compiled_for_fit
from cgemit.tables.schema import FitStatus
from cgemit.tables.show import Shown, data_frame
from cgemit.units import GEV_PER_T_MM

#: Tracks whose covariances are in memory at once, more than the points of a detector have.
_MOST_TRACKS = 100_000


@dataclass(frozen=True, eq=False)
class Entries:
    """Covariances at the origin of the tracks of a sample in one detector.

    Attributes
    ----------
    sample : Sample or Tracks
    covariance : ndarray, (tracks, 15) float64
        The upper triangle, NaN without a covariance.
    status : ndarray, (tracks,) int8
        `FitStatus`.
    mixed : int
        Neighbouring points that are one mixture.
    """

    sample: Sample | Tracks
    covariance: Floats
    status: npt.NDArray[np.int8]
    mixed: int = 1


@dataclass(frozen=True, eq=False)
class Widths:
    """Resolutions of one detector, as of `Covariance`; arrays have one axis, the points in order.

    Attributes
    ----------
    sigma, rms : mapping of str to ndarray, float64
        Core resolution of each quantity, and root of its mean variance, in its quoted unit.
    status : ndarray, int8
    reached : ndarray, float64
    """

    sigma: Mapping[str, Floats]
    rms: Mapping[str, Floats]
    status: npt.NDArray[np.int8]
    reached: Floats


def core_widths(found: Sequence[Entries], quantities: Sequence[str]) -> list[Widths]:
    """Return the core resolutions of each of some detectors.

    Parameters
    ----------
    found : sequence of Entries
        Neighbours with the same sample are computed together.
    quantities : sequence of str
        As of `Covariance.sigma`.
    """
    return [
        width
        for _, group in groupby(found, key=lambda one: id(one.sample))
        for part in _parts(list(group))
        for width in _together(part, quantities)
    ]


def _parts(entries: Sequence[Entries]) -> Iterator[Sequence[Entries]]:
    step = max(1, _MOST_TRACKS // len(entries[0].status))
    return (entries[i : i + step] for i in range(0, len(entries), step))


def _together(entries: Sequence[Entries], quantities: Sequence[str]) -> Iterator[Widths]:
    sample, count = entries[0].sample, len(entries)
    samples = len(sample.phases) * entries[0].mixed
    n_points = sample.kappa.size // samples
    covariance = np.stack([one.covariance for one in entries])
    at = sample.kappa, sample.tanl, sample.charge
    every = np.array([quantity_of(name).variance(covariance, *at) for name in quantities]).reshape(-1, samples)
    with np.errstate(invalid="ignore"):
        rms = np.sqrt(mean(every, ~np.isnan(every))).reshape(len(quantities), count, -1)
    sigma = core_width(every).reshape(rms.shape)
    status, reached = status_of(np.stack([one.status for one in entries]).reshape(-1, samples))
    weak = unconstrained(covariance, sample.kappa, sample.tanl, samples).ravel()
    status[weak] = FitStatus.unconstrained
    for number, name in enumerate(quantities):
        if quantity_of(name).is_momentum:
            sigma[number].reshape(-1)[weak] = rms[number].reshape(-1)[weak] = np.nan
    for i in range(count):
        points = slice(i * n_points, (i + 1) * n_points)
        core, root = (dict(zip(quantities, widths[:, i], strict=True)) for widths in (sigma, rms))
        yield Widths(core, root, status[points], reached[points])


def unconstrained(covariance: Floats, kappa: Floats, tanl: Floats, number: int) -> npt.NDArray[np.bool_]:
    """Return the points whose momentum is not measured, (..., points) bool: it is known to half of itself or worse.

    Parameters
    ----------
    covariance : ndarray, (..., tracks, 15) float64
        The upper triangle, NaN without a covariance.
    kappa, tanl : ndarray, (tracks,) float64
    number : int
        Of the tracks of each point.
    """
    known = QUANTITIES["p_rel"]
    variance = known.variance(covariance, kappa, tanl, 1.0) / known.factor**2  # relative: of any charge
    variance = variance.reshape(*variance.shape[:-1], -1, number)
    with np.errstate(invalid="ignore"):
        return np.asarray(mean(variance, ~np.isnan(variance)) > _core.reconstruction.MOST_ERROR**2)


_LIGHT = 1e-3  # GeV/c2, above the mass of electrons

By = Literal["source", "part", "material", "cause"]
#: Causes of uncertainty.
MEASUREMENT, SCATTERING, STRAGGLING, PRIOR = "measurement", "scattering", "straggling", "prior"
ALIGNMENT = "alignment"


@dataclass(frozen=True)
class Source:
    """What makes one term of the budget.

    Attributes
    ----------
    name : str
        Of the term, such as ``"L1 X"`` or ``"L1 foils scattering"``.
    part : str
        Of the detector.
    cause : str
        ``"measurement"``, ``"scattering"``, ``"straggling"``, ``"prior"`` (of the filter, negligible) or
        ``"alignment"`` (errors of the constants of the detector).
    materials : tuple of (str, float)
        Of a scatterer, each with its share of the term: of X/X0 for scattering, of Landau's xi for straggling.
    """

    name: str
    part: str
    cause: str
    materials: tuple[tuple[str, float], ...] = ()


def sources(detector: Detector) -> tuple[Source, ...]:
    """Return the terms of a detector's budgets, in the order of the core."""
    sources = [Source(f"{layer.label} {view}", layer.label, MEASUREMENT) for layer in detector.layers for view in "XV"]
    chamber = detector.drift_chamber
    if chamber is not None:
        sources += [Source(f"wires {layer.number}", "wires", MEASUREMENT) for layer in chamber.layers]
    for slab in slabs(detector):
        first, part_name = slab.shells[0], part_of(detector, slab)
        name = f"{part_name} {first.group}" if part_name != first.group else f"{first.group} {first.r_in:.5g} mm"
        for cause, weight in ((SCATTERING, "x0"), (STRAGGLING, "xi")):
            total = getattr(slab, weight)
            shares: dict[str, float] = {}
            for shell in slab.shells:
                material = shell.material.name
                shares[material] = shares.get(material, 0.0) + getattr(shell, weight) / total
            sources.append(Source(f"{name} {cause}", part_name, cause, tuple(shares.items())))
    return (*sources, Source("prior", "prior", PRIOR))


@dataclass(frozen=True, eq=False, repr=False)
class Budget(Shown):
    """The variance of one quantity, split exactly by its sources.

    Attributes
    ----------
    quantity, unit : str
        Variances are in the square of `unit`, the quoted one.
    sources : tuple of Source
    p, cos_theta : ndarray, float64
        Of the points; middles of ranges.
    variances : ndarray, shape of the points + (sources,) float64
        They sum to the mean variance of each point.
    detector, particle : str
    points : Points
        With the limits of ranges.
    """

    quantity: str
    unit: str
    sources: tuple[Source, ...]
    p: Floats
    cos_theta: Floats
    variances: Floats
    detector: str
    particle: str
    points: Points

    @property
    def total(self) -> Floats:
        """Mean variance of each point."""
        return np.asarray(self.variances.sum(axis=-1))

    def grouped(self, by: By = "part") -> dict[str, Floats]:
        """Return the variances of groups of sources.

        Parameters
        ----------
        by : str
            ``"source"``, ``"part"`` (CGEM layers, wires, walls ...), ``"material"`` (measurements are a group of their
            own; a scatterer of several materials counts for each by its share of X/X0, or of xi for straggling) or
            ``"cause"``.

        Returns
        -------
        dict of str to ndarray, float64
            Shape of the points; the groups sum to `total`.

        Raises
        ------
        ValueError
            If `by` is none of these.
        """
        groups: dict[str, Floats] = {}
        for row, source in enumerate(self.sources):
            for name, share in _groups(source, by):
                groups[name] = groups.get(name, np.zeros(self.p.shape)) + share * self.variances[..., row]
        return groups

    def table(self, by: By = "source") -> dict[str, npt.NDArray[Any]]:
        """Return one row per point and group as columns: variance, its share, and its root."""
        groups = self.grouped(by)
        n = self.p.size
        variance = np.stack([value.ravel() for value in groups.values()], axis=1)
        with np.errstate(invalid="ignore"):
            share, root = variance / self.total.reshape(-1, 1), np.sqrt(variance)
        return {
            "p": np.repeat(self.p.ravel(), len(groups)), "cos_theta": np.repeat(self.cos_theta.ravel(), len(groups)),
            by: np.tile(np.array(list(groups)), n), "variance": variance.ravel(), "share": share.ravel(),
            "sigma": root.ravel(),
        }  # fmt: skip

    def columns(self, by: By = "part") -> dict[str, list[Any]]:
        """Return `table` with units in the names of columns, as a CSV table has them."""
        units = {"p": " (GeV/c)", "variance": f" ({self.unit}2)", "sigma": f" ({self.unit})"}
        return {f"{name}{units.get(name, '')}": column.tolist() for name, column in self.table(by).items()}

    def to_pandas(self, by: By = "source") -> Any:
        """Return `table` as a pandas DataFrame."""
        return data_frame(self.table(by))

    def _parts(self) -> dict[str, Floats]:
        """Return the variances by part, of one that measures and scatters both apart."""
        pairs = [(one.part, MEASUREMENT if one.cause == MEASUREMENT else "matter") for one in self.sources]
        repeated = {part for part, what in pairs if what == MEASUREMENT} & {
            part for part, what in pairs if what == "matter"
        }
        groups: dict[str, Floats] = {}
        for row, (part, what) in enumerate(pairs):
            name = f"{part} {what}" if part in repeated else part
            groups[name] = groups.get(name, np.zeros(self.p.shape)) + self.variances[..., row]
        return groups

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        groups = {name: value.ravel() for name, value in self._parts().items()}
        total, rows = self.total.ravel(), []
        angles = bool(np.ptp(self.cos_theta) > 0)  # else they are those of all points
        for i in range(min(self.p.size, _SHOWN_POINTS)):
            order = sorted(groups, key=lambda name: -float(np.nan_to_num(groups[name][i])))
            shown = [(name, float(groups[name][i])) for name in order[:_SHOWN_PARTS]]
            if rest := order[_SHOWN_PARTS:]:
                shown.append((f"other ({len(rest)})", float(sum(groups[name][i] for name in rest))))
            for name, variance in shown:
                share = f"{100 * variance / total[i]:.1f} %"
                at = self.points.texts(i)
                rows.append([*(at if angles else at[:1]), name, f"{variance**0.5:.4g}", share])
        more = self.p.size - _SHOWN_POINTS
        head = ["p [GeV/c]", *(["cos(theta)"] if angles else []), "part", f"sigma [{self.unit}]", "of variance"]
        if more > 0:
            rows.append([f"{more} more points", *[""] * (len(head) - 1)])
        return f"{self.detector}, {self.particle}: budget of {self.quantity}", head, rows


#: What a printed budget shows.
_SHOWN_POINTS, _SHOWN_PARTS = 6, 8


def _groups(source: Source, by: By) -> list[tuple[str, float]]:
    """Return the groups to which a source belongs, with its share in each."""
    if by == "source":
        return [(source.name, 1.0)]
    if by == "part":
        return [(source.part, 1.0)]
    if by == "cause":
        return [(source.cause, 1.0)]
    if by == "material":
        return list(source.materials) or [(source.cause, 1.0)]
    raise ValueError(f"by: got {by!r}; expected one of source, part, material, cause")


def budget_of(
    tracks: Tracks, quantity: str, detector: Detector, points: Points, p: Floats, cos_theta: Floats, reached: Floats
) -> Budget:
    """Return the budget of a quantity for the points of some tracks.

    Parameters
    ----------
    tracks : Tracks
    quantity : str
    detector : Detector
    points : Points
    p, cos_theta, reached : ndarray, float64
        Of the points, as in `Covariance`.

    Raises
    ------
    ValueError
        If the quantity is not known, or depends on a parameter that varies within a point.
    """
    known = quantity_of(quantity)
    rows = known.gradient(tracks.kappa, tracks.tanl, tracks.charge).reshape(-1, tracks.samples, 5)
    if np.any(np.ptp(rows, axis=1) > 1e-12 * np.abs(rows).max(axis=1)):
        raise ValueError(f"budget of {quantity}: got a range of p or cos(theta); expected fixed values")
    weights = rows[:, 0]
    used = np.flatnonzero(np.any(weights != 0, axis=0)).tolist()
    if len(used) > 1 and used != [2, 4]:  # the core sums no other correlations
        raise ValueError(f"budget of {quantity}: expected a function of one parameter, or of kappa and tanl")
    sums = tracks.run(budget=True)["budget"]  # (points, terms, 6)
    variance = np.einsum("pi,pti->pt", weights**2, sums[..., :5])
    variance += 2 * (weights[:, 2] * weights[:, 4])[:, None] * sums[..., 5]
    variance = np.maximum(variance, 0)  # a term is a square; where its parts cancel, rounding may leave -1e-16 of all
    names = sources(detector)
    if tracks.alignment is not None:
        names = (*names, Source(ALIGNMENT, ALIGNMENT, ALIGNMENT))
        added = known.variance(tracks.alignment, tracks.kappa, tracks.tanl, tracks.charge)
        per_point = np.nansum(added.reshape(-1, tracks.samples), axis=1, keepdims=True)
        variance = np.concatenate([variance, per_point], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = variance / np.round(reached.reshape(-1, 1) * tracks.samples)
    shape = (*p.shape, len(names))
    variance, about = variance.reshape(shape), (detector.name, points.particle, points)
    return Budget(known.name, known.unit, names, p, cos_theta, variance, *about)


def losses_of(tracks: Tracks, resolution: Covariance) -> Losses:
    """Return the losses of electrons that the fit does not see.

    Parameters
    ----------
    tracks : Tracks
    resolution : Covariance
        Of these tracks.

    Raises
    ------
    ValueError
        As `Covariance.losses`.
    """
    problems, fit, points = Problems(), tracks.fit, resolution.points
    if np.any(points.mass > _LIGHT):
        problems.note("particle", resolution.particle, "e- or e+")
    if any(np.any(low != high) for low, high in (points.p, points.cos_theta)):
        problems.note("p, cos_theta", "a range", "fixed values")
    wanted = {"loss": "truncated", "radiation": True, "matter": True, "start_radius": 0.0}
    for name, value in wanted.items():
        if getattr(fit, name) != value:
            problems.note(f"fit.{name}", repr(getattr(fit, name)), repr(value))
    problems.report("losses")
    p, cosine = resolution.p.ravel(), resolution.cos_theta.ravel()
    kappa, momentum = resolution.budget("kappa"), resolution.budget("p")
    straggles = [number for number, one in enumerate(kappa.sources) if one.cause == STRAGGLING]
    rest = [number for number, one in enumerate(kappa.sources) if one.cause != STRAGGLING]
    by_slab = kappa.variances.reshape(len(p), -1)[:, straggles]
    error = np.sqrt(momentum.variances.reshape(len(p), -1)[:, rest].sum(axis=1)) * 1e-3 / p
    core, inner = compiled_for_fit(resolution.detector, fit), slabs(resolution.detector)
    slope = cosine / np.sqrt(1 - cosine**2)
    slant = np.hypot(1.0, slope)
    # Of a helix from the origin in the field there; matter that it does not reach is not in the budget.
    bend = 0.5 * GEV_PER_T_MM * abs(resolution.detector.field.bz) * slant / p
    across = np.minimum(bend[:, None] * np.array([one.radius for one in inner]), 0.99)
    path = slant[:, None] / np.sqrt(1 - across**2)
    mass = np.broadcast_to(points.mass, resolution.p.shape).ravel()
    charge = np.broadcast_to(points.charge, resolution.p.shape).ravel()
    unseen = [
        core.with_shared_loss(row, p=float(p[i]), mass=float(mass[i]), tanl=float(slope[i])).unseen
        for i, row in enumerate(by_slab)
    ]
    cut = [
        _core.matter.light_cut(core, p=float(p[i]), mass=float(mass[i]), charge=float(charge[i]), tanl=float(slope[i]))
        for i in range(len(p))
    ]
    straggling = [kappa.sources[number] for number in straggles]
    return Losses(
        resolution.detector.name, resolution.particle, float(charge[0]),
        tuple(one.name.removesuffix(f" {STRAGGLING}") for one in straggling), tuple(one.part for one in straggling),
        p, cosine, path * np.array([one.x0 for one in inner]), path * np.array([one.xi for one in inner]),
        np.array(unseen), error, np.array(cut),
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class Covariance:
    """Covariances of (dr, phi0, kappa, dz, tanl) at the origin, or where tracks leave a cylinder, for a grid of tracks.

    Arrays have the shape of the arguments of `analytic`, broadcast. What varies within a point (azimuth, position of
    the strips under the track, ranges of p and cos(theta)) is sampled, so that the residuals of a point are a mixture
    of Gaussians: ``sigma`` is the core of the mixture, as `resolution` measures it (Gaussian within 3 of its sigmas),
    ``rms`` the root of the mean variance. Each quantity has both as arrays in its quoted unit: ``sigma_p``, ``rms_p``,
    ``sigma_pt``, ``rms_pt`` (MeV/c), ``sigma_p_rel``, ``rms_p_rel``, ``sigma_pt_rel``, ``rms_pt_rel`` (%),
    ``sigma_dr``, ``rms_dr`` (um), ``sigma_dz``, ``rms_dz`` (mm), ``sigma_phi0``, ``rms_phi0``, ``sigma_theta``,
    ``rms_theta`` (mrad), ``sigma_tanl``, ``rms_tanl`` (1e-3), ``sigma_kappa``, ``rms_kappa`` (1/(GeV/c)).

    Attributes
    ----------
    detector : Detector
    particle : str
    p, cos_theta, phi : ndarray, float64, GeV/c, 1, rad
        Of each point, at the origin; middles of ranges. `phi` (azimuth of the momentum) is NaN where it is averaged.
    radius : ndarray, float64, mm
        Of the cylinder; NaN at the origin. All matter inside it has acted, and none outside. The pivot is the point of
        the track there, so that dr and dz are the displacements across the flight and along the beam.
    points : Points
        With the limits of ranges.
    """

    detector: Detector
    particle: str
    p: Floats
    cos_theta: Floats
    phi: Floats
    radius: Floats
    points: Points
    _tracks: Tracks
    _columns: Mapping[str, npt.NDArray[Any]]  # of the core, by track; entries of the covariance are NaN without one

    @cached_property
    def status(self) -> npt.NDArray[np.int8]:
        """`FitStatus`: ok if any sample of the point has a covariance, else that of most samples.

        It is `unconstrained` where the momentum is not measured: its error exceeds half of it.
        """
        status = status_of(self._by_point("status"))[0]
        status[self._unconstrained] = FitStatus.unconstrained
        return status.reshape(self.p.shape)

    @cached_property
    def _unconstrained(self) -> npt.NDArray[np.bool_]:
        tracks = self._tracks
        return unconstrained(self._columns["covariance"], tracks.kappa, tracks.tanl, tracks.samples)

    @cached_property
    def reached(self) -> Floats:
        """Fraction of the samples with a covariance."""
        return status_of(self._by_point("status"))[1].reshape(self.p.shape)

    @cached_property
    def n_clusters(self) -> Floats:
        """Mean number of clusters of the samples with a covariance."""
        return self._mean("n_clusters")

    @cached_property
    def n_wires(self) -> Floats:
        """Mean number of wire hits of the samples with a covariance."""
        return self._mean("n_wires")

    @cached_property
    def cov(self) -> Floats:
        """Mean covariance of the samples with one, shape + (5, 5): mm, rad, (GeV/c)^-1."""
        cov = np.empty((*self.p.shape, 5, 5))
        cov[..., UPPER[0], UPPER[1]] = cov[..., UPPER[1], UPPER[0]] = self._mean("covariance")
        return cov

    def entries(self, mixed: int = 1) -> Entries:
        """Return what `core_widths` needs; so many neighbouring points are one mixture."""
        return Entries(self._tracks, self._columns["covariance"], self._columns["status"], mixed)

    def _mean(self, name: str) -> Floats:
        """Return the mean of a column over the samples with a covariance, shape + that of its entries."""
        ok = self._by_point("status") == 0
        values = np.moveaxis(self._by_point(name), 1, -1)
        found = mean(values, ok.reshape(len(ok), *(1,) * (values.ndim - 2), -1))
        return found.reshape(self.p.shape + found.shape[1:])

    def _by_point(self, name: str) -> npt.NDArray[Any]:
        """Return a column as (points, samples, ...)."""
        column = self._columns[name]
        return column.reshape(-1, self._tracks.samples, *column.shape[1:])

    def sigma(self, quantity: str) -> Floats:
        """Return the core resolution: the Gaussian within 3 of its sigmas.

        Parameters
        ----------
        quantity : str
            Of `cgemit.analysis.quantities.QUANTITIES`.

        Returns
        -------
        ndarray, float64
            In the quoted unit; NaN where no sample has a covariance, and for momenta that are not measured.

        Raises
        ------
        ValueError
            If the quantity is not known.

        Examples
        --------
        >>> cg.analytic("besiii-cgem-design", p=[0.3, 1.0]).sigma("d_rho").round()
        array([307., 170.])
        """
        return core_width(self.variances(quantity).reshape(-1, self._tracks.samples)).reshape(self.p.shape)

    def rms(self, quantity: str) -> Floats:
        """Return the root of the mean variance; see `sigma`."""
        variances = self.variances(quantity)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.sqrt(mean(variances, ~np.isnan(variances))))

    def variances(self, quantity: str) -> Floats:
        """Return the variance of every sample, shape + (samples,), in the square of the quoted unit.

        It is NaN without a covariance, and for momenta and kappa where the status is `unconstrained`.
        """
        tracks, known = self._tracks, quantity_of(quantity)
        variance = known.variance(self._columns["covariance"], tracks.kappa, tracks.tanl, tracks.charge)
        variance = variance.reshape(-1, tracks.samples)
        if known.is_momentum:
            variance[self._unconstrained] = np.nan
        return variance.reshape(*self.p.shape, tracks.samples)

    def budget(self, quantity: str) -> Budget:
        """Return the exact split of the mean variance by measurement and scatterer.

        Parameters
        ----------
        quantity : str
            As in `sigma`.

        Returns
        -------
        Budget
            Whose terms sum to the square of `rms`.

        Raises
        ------
        ValueError
            As `sigma`; for covariances elsewhere than at the origin.

        Examples
        --------
        >>> budget = cg.analytic("besiii-cgem-design", p=1.0).budget("dr")
        >>> shares = {cause: variance / budget.total for cause, variance in budget.grouped("cause").items()}
        >>> {cause: round(float(share), 2) for cause, share in shares.items()}
        {'measurement': 0.49, 'scattering': 0.51, 'straggling': 0.0, 'prior': 0.0}
        """
        self.only_at_origin("budget")
        return budget_of(self._tracks, quantity, self.detector, self.points, self.p, self.cos_theta, self.reached)

    def losses(self) -> Losses:
        """Return what the fit of electrons does not see of their losses: tails of the momentum, and their causes.

        Returns
        -------
        Losses
            Of the points in order.

        Raises
        ------
        ValueError
            Listing everything that is not for electrons and positrons of fixed momentum and angle at the origin, and
            the default loss of the fit.

        Examples
        --------
        >>> electrons = cg.analytic("besiii-cgem", "e-", p=[0.3, 1.0])
        >>> electrons.losses().loss_probability([0.01, 0.1]).round(2)
        array([[0.17, 0.07],
               [0.15, 0.07]])
        >>> electrons.losses().share_within(0.01).round(2)
        array([0.83, 0.82])
        """
        self.only_at_origin("losses")
        return losses_of(self._tracks, self)

    def loss_probability(self, x: npt.ArrayLike) -> Floats:
        """Return the probability that losses make the fitted momentum of electrons smaller by more than a share of it.

        Parameters
        ----------
        x : array_like
            See `Losses.loss_probability`.

        Returns
        -------
        ndarray, shape of the points + shape of x, float64

        Raises
        ------
        ValueError
            As `losses`, and for shares that are not between 0 and 1.
        """
        found = self.losses().loss_probability(x)
        return found.reshape(*self.p.shape, *found.shape[1:])

    def only_at_origin(self, what: str) -> None:
        """Raise ValueError unless these are covariances at the origin; `what` is what is wanted."""
        if not np.all(np.isnan(self.radius)):
            raise ValueError(f"{what}: got covariances at a radius; expected covariances at the origin")

    def __getattr__(self, name: str) -> Floats:
        """Return ``sigma_p`` for ``sigma("p")``, ``rms_dr`` for ``rms("dr")``."""
        kind, _, quantity = name.partition("_")
        if kind in ("sigma", "rms") and quantity in NAMES:
            return self.sigma(quantity) if kind == "sigma" else self.rms(quantity)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __dir__(self) -> list[str]:
        return sorted([*super().__dir__(), *(f"{kind}_{name}" for kind in ("sigma", "rms") for name in QUANTITIES)])

    def table(self) -> dict[str, npt.NDArray[Any]]:
        """Return one row per point as columns: arguments, status, core and RMS of all quantities in quoted units.

        Relative resolutions are left out.
        """
        columns: dict[str, npt.NDArray[Any]] = {"p": self.p.ravel(), "cos_theta": self.cos_theta.ravel()}
        columns |= {"phi": self.phi.ravel(), "radius": self.radius.ravel(), "status": self.status.ravel()}
        columns["reached"] = self.reached.ravel()
        columns |= {"n_clusters": self.n_clusters.ravel(), "n_wires": self.n_wires.ravel()}
        for name in ABSOLUTE:
            columns[f"sigma_{name}"], columns[f"rms_{name}"] = self.sigma(name).ravel(), self.rms(name).ravel()
        return columns

    def to_pandas(self) -> Any:
        """Return `table` as a pandas DataFrame."""
        return data_frame(self.table())

    def __repr__(self) -> str:
        columns = self.sigma("dr"), self.sigma("dz"), self.sigma("p"), self.status
        rows = [
            "  p {} GeV/c, cos(theta) {}: ".format(*self.points.texts(i))
            + f"sigma(d_rho) {dr:.4g} um, sigma(d_z) {dz:.4g} mm, sigma(p) {sp:.4g} MeV/c"
            + ("" if s == 0 else f" [{FitStatus(int(s)).name}]")
            for i, (dr, dz, sp, s) in enumerate(zip(*(np.ravel(one) for one in columns), strict=True))
        ]
        more = [f"  ... {len(rows) - 12} more"] if len(rows) > 12 else []
        head = f"<{self.detector.name}, {self.particle}"
        head += f", readout {self.detector.readout_text}" if self.detector.cgem else ""
        radii = np.unique(self.radius[~np.isnan(self.radius)])
        if len(radii):
            head += f", on cylinders of {', '.join(f'{radius:g}' for radius in radii)} mm"
        return "\n".join([head, *rows[:12], *more]) + ">"
