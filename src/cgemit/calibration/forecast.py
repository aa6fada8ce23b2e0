"""`alignment_forecast`: errors of constants that tracks will reach, without events (docs/methods/alignment.md)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cgemit import helix
from cgemit.analysis.quantities import UPPER, quantity_of
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems
from cgemit.base.validate import is_whole
from cgemit.calibration.constants import columns_of, of_single_wires
from cgemit.calibration.modes import Determined, Solution, solve
from cgemit.calibration.settings import AlignmentSettings, plan_of
from cgemit.calibration.sums import WIDER, Sums, as_fitted, core_sums, expected_sums
from cgemit.chain.executor import Workers, pool_of
from cgemit.covariance.analytic import tracks_at
from cgemit.covariance.tracks import Tracks, points_of
from cgemit.detector import Detector, load
from cgemit.detector.alignment import AlignmentTable
from cgemit.particles.gun import Guns, Source
from cgemit.reconstruction.fit import FitSettings, compiled_for_fit
from cgemit.simulation.digitize import DigitizeSettings

#: Most events of a sample that are followed; they stand for all.
MOST_EVENTS = 4000
_FOR_WIRES = 10  # times as many for single wires, of which each track has few
_SAMPLES = 127  # tracks of a point, averaged over azimuth


@dataclass(frozen=True, eq=False, repr=False)
class AlignmentForecast(Determined):
    """Errors of constants that samples of tracks will reach.

    Attributes
    ----------
    detector : Detector
    settings : AlignmentSettings
    table : AlignmentTable
        With the value 0 of all constants.
    sums : Sums
        Of all samples; `alignment_forecast` with other settings needs new ones.
    solution : Solution
    fit : FitSettings

    Examples
    --------
    >>> muons, cosmics = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), cg.sample("cosmic")
    >>> forecast = cg.alignment_forecast("besiii-cgem", [(muons, 10_000), (cosmics, 10_000)])
    >>> len(forecast.table.name), forecast.zero_modes
    (18, ())
    >>> induced = forecast.induced("mu-", p=1.0, cos_theta=0.0)  # mm, mm, GeV/c
    >>> 0 < induced["dr"] < 0.02
    True
    """

    detector: Detector
    settings: AlignmentSettings
    table: AlignmentTable
    sums: Sums
    solution: Solution
    fit: FitSettings

    def induced(self, particle: str = "mu-", p: Any = 1.0, cos_theta: Any = 0.0) -> dict[str, float]:
        """Return the errors of one track's parameters that the errors of the constants make, averaged over azimuth.

        Parameters
        ----------
        particle, p, cos_theta
            As of `cgemit.analytic`, one point.

        Returns
        -------
        dict of str to float
            ``dr`` and ``dz`` (mm), ``p`` (GeV/c).
        """
        points = points_of(particle, p, cos_theta, samples=_SAMPLES)
        _, tracks = tracks_at(points, self.detector, DigitizeSettings(), self.fit)
        added = self(tracks)
        errors = {}
        for name in ("dr", "dz", "p"):
            known = quantity_of(name)
            variance = known.variance(added, tracks.kappa, tracks.tanl, tracks.charge)
            errors[name] = float(np.sqrt(np.nanmean(variance)) / known.factor)
        return errors

    def __call__(self, tracks: Tracks) -> Floats:
        """Return the covariances of helices that the errors of the constants make.

        Parameters
        ----------
        tracks : Tracks
            From the origin.

        Returns
        -------
        ndarray, (tracks, 15) float64
            The upper triangle; NaN for tracks without hits.
        """
        cov_of_constants = self.cov
        n, core = len(tracks.kappa), compiled_for_fit(tracks.detector, tracks.fit)
        zero = np.zeros(n)
        phi0 = helix.wrap_angle(tracks.phi - 0.5 * np.pi)
        helices = np.stack([zero, phi0, tracks.kappa, zero, tracks.tanl], axis=1)
        expected = tracks.run(budget=False, hits=True)
        offsets, hits, of_tracks, good = as_fitted(core, expected, helices, tracks.mass, tracks.charge)
        prior = [WIDER * sigma for sigma in tracks.fit.prior_in(tracks.detector)]
        columns = columns_of(tracks.detector, self.solution.constants)
        bias = core_sums(core, columns, offsets, hits, of_tracks, good, prior, bias=True)["bias"]
        cov = np.full((n, 15), np.nan)
        cov[good] = np.einsum("nci,cd,ndj->nij", bias, cov_of_constants, bias, optimize=True)[:, UPPER[0], UPPER[1]]
        return cov

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        if self.solution.matrix is None:
            title, head, lines = self.table._table()
            return f"{self.detector.name}: errors of {title} from {self.sums.tracks} tracks", head, lines
        rows = []
        for name, unit, err, correlation, status in zip(
            self.table.name, self.table.unit, self.table.err, self.table.global_correlation, self.table.status,
            strict=True,
        ):  # fmt: skip
            factor, shown = {"mm": (1e3, "um"), "rad": (1e6, "urad")}.get(unit, (1.0, unit))
            rows.append(
                [name, shown, f"{factor * err:.4g}" if np.isfinite(err) else "-",
                 f"{correlation:.3f}" if np.isfinite(correlation) else "-", status]
            )  # fmt: skip
        title = f"{self.detector.name}: errors of {len(rows)} constants from {self.sums.tracks} tracks"
        return title, ("constant", "unit", "error", "correlation", "status"), rows

    def note(self) -> str:
        """Return what is not determined."""
        return f"not determined: {', '.join(self.zero_modes)}" if self.zero_modes else ""


def alignment_forecast(
    detector: Detector | str | Mapping[str, Any],
    samples: Sequence[tuple[Source | Guns, int]],
    settings: AlignmentSettings | None = None,
    *,
    fit: FitSettings | None = None,
    reveal_sides: bool = False,
    seed: int = 1,
    threads: int | None = None,
) -> AlignmentForecast:
    """Forecast the errors of constants from samples of tracks, without simulation.

    The tracks are those that the samples shoot, with their own directions and vertices. Each is expected to leave the
    hits of `analytic`. Up to 4000 events of a sample, 40 000 for single wires, are followed and stand for all.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    samples : sequence of (Source, int)
        Guns and samples, each with its number of events.
    settings : AlignmentSettings or None
        Cuts and iterations play no part.
    fit : FitSettings or None
    reveal_sides : bool
        Whether wire hits tell their side.
    seed : int
        Of the directions.
    threads : int or None
        None: all cores.

    Returns
    -------
    AlignmentForecast

    Raises
    ------
    ValueError
        Listing every problem of the samples and the settings.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    >>> settings = cg.AlignmentSettings(free=("cgem.*.shift_z",))
    >>> cg.alignment_forecast("besiii-cgem", [(gun, 10_000)], settings).table.status
    ('free', 'free', 'free')
    """
    detector, settings, fit = load(detector), AlignmentSettings.of(settings), FitSettings.of(fit, "fit")
    problems = Problems()
    pairs = list(samples) if isinstance(samples, Sequence) else []
    if not pairs:
        problems.note("samples", repr(samples)[:80], "pairs of a gun or sample and its number of events")
    for i, pair in enumerate(pairs):
        if not (isinstance(pair, tuple) and len(pair) == 2 and isinstance(pair[0], Source | Guns)):
            problems.note(f"samples[{i}]", repr(pair)[:80], "a gun or sample and its number of events")
        elif not is_whole(pair[1], 1, 2**62):
            problems.note(f"samples[{i}]", repr(pair[1])[:80], "a whole number of events, at least 1")
    problems.report("alignment_forecast")
    free, fixed, priors = plan_of(detector, settings)
    total = Sums.none(detector, free)
    with pool_of(Workers(threads=threads)) as pool:
        for i, (source, events) in enumerate(pairs):
            followed = min(events, MOST_EVENTS * (_FOR_WIRES if of_single_wires(free) else 1))
            # Samples share no direction.
            sums = expected_sums(
                detector, source, followed, free, fit, seed=seed + i, reveal_sides=reveal_sides,
                settings=settings, pool=pool,
            )  # fmt: skip
            total = total + sums.scaled(events / followed)
    found = solve(detector, free, total, priors, constrain=settings.zero_modes == "constrained")
    return AlignmentForecast(detector, settings, found.table(fixed=fixed), total, found, fit)
