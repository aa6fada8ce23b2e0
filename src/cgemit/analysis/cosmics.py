"""Resolution without truth: halves of cosmic muons, fitted as two tracks and as one (docs/methods/vertex.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.analysis.quantities import QUANTITIES
from cgemit.analysis.widths import Resolution, measure
from cgemit.base.arrays import Floats
from cgemit.chain.result import Result
from cgemit.tables import Table
from cgemit.tables.check import refuse_wrong
from cgemit.tables.schema import FitStatus, is_fitted
from cgemit.tables.show import Shown, Tabular, with_error

#: Parameters of the same muon flown backward: signs of dr, phi0, kappa, dz, tanl; phi0 also turns by pi.
BACKWARD = np.array([-1.0, 1.0, -1.0, 1.0, -1.0])
_NAMES = (*helix.PARAMETERS, "p")


@dataclass(frozen=True, eq=False, repr=False)
class Cosmics(Shown, Tabular):
    """Resolutions from the halves of cosmic muons.

    Attributes
    ----------
    events : int
        Events with exactly two fitted tracks, one upward and one downward.
    halves : mapping of str to Resolution
        Difference of the halves over sqrt(2), in the quoted unit: the resolution of one half, without truth. Momenta
        that the curvature of a half does not measure are left out (`removed`).
    pulls : mapping of str to Resolution
        Difference over its error by both fits.
    truth : mapping of str to Resolution
        Residuals of the same halves; None for measured data.
    one_track : mapping of str to Resolution
        Residuals of both halves fitted as one track; None for measured data.
    parameters, cov : ndarray, (events, 5), (events, 5, 5) float64
        Of the one track: helices of the downward half at the origin.
    chi2 : ndarray, (events,) float64
        Of the two halves' being one track; five degrees of freedom, four without a field.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("cosmic"), n=100)
    >>> found = cg.study.cosmics(result)
    >>> found.halves["dr"].unit, found.events > 50
    ('um', True)
    """

    events: int
    halves: dict[str, Resolution]
    pulls: dict[str, Resolution]
    truth: dict[str, Resolution] | None
    one_track: dict[str, Resolution] | None
    parameters: Floats
    cov: Floats
    chi2: Floats

    def columns(self) -> dict[str, list[object]]:
        """Return the core widths as columns, one row for each parameter."""
        table: dict[str, list[object]] = {"parameter": list(_NAMES), "unit": [self.halves[n].unit for n in _NAMES]}
        for name, widths in (
            ("halves", self.halves), ("truth", self.truth), ("one_track", self.one_track), ("pull", self.pulls)
        ):  # fmt: skip
            if widths is not None:
                table[name] = [widths[n].core for n in _NAMES]
                table[f"{name}_error"] = [widths[n].core_error for n in _NAMES]
        return table

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        widths = (self.halves, self.truth, self.one_track, self.pulls)
        heads = ("difference/sqrt(2)", "true residual", "one track", "pull of the difference")
        head = ("parameter", *(text for text, one in zip(heads, widths, strict=True) if one is not None))
        rows = [
            [self.halves[n].label(), *(with_error(one[n].core, one[n].core_error) for one in widths if one is not None)]
            for n in _NAMES
        ]
        return f"halves of {self.events} cosmic muons: core widths", head, rows


def cosmics(given: Result | Table) -> Cosmics:
    """Compare both halves of muons that cross the detector, and fit them as one track.

    The fit of a half ends at the origin, with all matter between its hits and the origin. Halves share no hit and no
    matter, so that their weighted mean is the fit of all hits as one track.

    Parameters
    ----------
    given : Result, or Table of kind "tracks"
        With truth where the tracks hold it.

    Raises
    ------
    ValueError
        If it holds no tracks or wrong values, or no event has two halves.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("cosmic"), n=100)
    >>> found = cg.study.cosmics(result)
    >>> bool(0 < found.halves["dr"].core < 500), found.halves["dr"].unit
    (True, 'um')
    """
    tracks = given.tracks if isinstance(given, Result) else given
    if tracks is None or not isinstance(tracks, Table) or tracks.kind != "tracks":
        raise ValueError("cosmics: got no table of tracks, expected one, or a run that fits")
    if tracks is given:
        refuse_wrong("cosmics", tracks=tracks)
    upper, lower = _halves(tracks)
    if len(lower) < 2:
        raise ValueError(f"cosmics: got {len(lower)} events with an upward and a downward track, expected some")
    down, other = _values(tracks, lower), _backward(_values(tracks, upper))
    cov, cov_other = tracks["cov"][lower], BACKWARD[:, None] * tracks["cov"][upper] * BACKWARD
    parameters, joint, chi2 = _combined(down, cov, other, cov_other)
    difference = _differences(down, other)
    errors = np.sqrt(np.diagonal(cov + cov_other, axis1=1, axis2=2))
    p_error = np.hypot(helix.momentum_error(down, cov), helix.momentum_error(other, cov_other))
    error = dict(zip(_NAMES, [*errors.T, p_error], strict=True))
    pairs = np.stack([lower, upper])
    weak = {name: ~np.all(QUANTITIES[name].measured_by(tracks)[pairs], axis=0) for name in _NAMES}
    truth = one_track = None
    if "truth_dr" in tracks:
        rows = np.concatenate([lower, upper])
        known = np.isfinite(tracks["res_dr"][rows])
        truth = {
            name: _width(name, tracks[f"res_{name}"][rows][known], np.tile(weak[name], 2)[known]) for name in _NAMES
        }
        true = np.stack([tracks[f"truth_{name}"][lower] for name in helix.PARAMETERS], axis=1)
        fine = np.isfinite(true).all(axis=1)
        apart = _differences(parameters, true).items()
        one_track = {name: _width(name, value[fine], weak[name][fine]) for name, value in apart}
    return Cosmics(
        len(lower),
        {name: _width(name, value / np.sqrt(2), weak[name]) for name, value in difference.items()},
        {name: _width(name, value / error[name], weak[name], pull=True) for name, value in difference.items()},
        truth, one_track, parameters, joint, chi2,
    )  # fmt: skip


def _halves(tracks: Table) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the rows of the upward and the downward track of the events that have one of each and no other."""
    return halves(tracks["event"], tracks["phi0"], is_fitted(tracks) & np.isfinite(tracks["cov"]).all(axis=(1, 2)))


def halves(
    event: npt.NDArray[np.int64], phi0: Floats, good: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return the rows of the upward and the downward track of the events that have one of each and no other.

    Parameters
    ----------
    event : ndarray, (n,) int64
        Growing.
    phi0 : ndarray, (n,) float64, rad
    good : ndarray, (n,) bool
        Tracks that may be one of them.
    """
    first = np.flatnonzero(np.diff(event, prepend=event[:1] - 1))
    begin = first[np.diff(np.append(first, len(event))) == 2]
    begin = begin[good[begin] & good[begin + 1]]
    upward = np.cos(phi0) > 0  # the flight is along (-sin phi0, cos phi0)
    begin = begin[upward[begin] != upward[begin + 1]]
    first_up = upward[begin]
    return np.where(first_up, begin, begin + 1), np.where(first_up, begin + 1, begin)


def _values(tracks: Table, rows: npt.NDArray[np.intp]) -> Floats:
    return np.stack([np.asarray(tracks[name], np.float64)[rows] for name in helix.PARAMETERS], axis=1)


def _backward(parameters: Floats) -> Floats:
    """Return helices of the same points, flown in the other direction."""
    turned = np.array(parameters * BACKWARD)
    turned[:, 1] += np.pi
    return turned


def _differences(first: Floats, second: Floats) -> dict[str, Floats]:
    """Return the differences of parameters and momentum of helices."""
    difference = first - second
    difference[:, 1] = helix.wrap_angle(difference[:, 1])
    return dict(zip(_NAMES, [*difference.T, helix.momentum(first) - helix.momentum(second)], strict=True))


def _combined(first: Floats, cov: Floats, second: Floats, cov_second: Floats) -> tuple[Floats, Floats, Floats]:
    """Return weighted means of helices, their covariances, and the chi-square of the differences."""
    gain = cov @ np.linalg.inv(cov + cov_second)
    names = helix.PARAMETERS
    apart = np.stack([_differences(second, first)[name] for name in names], axis=1)
    chi2 = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(cov + cov_second), apart)
    return first + np.einsum("nij,nj->ni", gain, apart), cov - gain @ cov, chi2


def _width(name: str, sample: Floats, weak: npt.NDArray[np.bool_], *, pull: bool = False) -> Resolution:
    """Measure a sample in its quoted unit, or pulls, without those that are `weak`, not measured."""
    known = QUANTITIES[name]
    left_out = int(np.count_nonzero(weak))
    removed = ((FitStatus.unconstrained.name, left_out),) if left_out else ()
    sample = sample[~weak] if left_out else sample
    factor, unit = (1.0, "") if pull else (known.factor, known.unit)
    return measure(sample * factor, parameter=name, unit=unit, removed=removed)
