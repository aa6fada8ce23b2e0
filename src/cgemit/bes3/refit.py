"""Tracks of the experiment fitted again, beside its own fits of the same hits (docs/how-to/real_events.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from cgemit import helix
from cgemit.analysis.quantities import QUANTITIES
from cgemit.base.arrays import Column, Columns
from cgemit.bes3.events import Bes3Events
from cgemit.detector import Detector, compiled
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.tables import Table
from cgemit.tables.schema import PARAMETERS, has_momentum

Kind = Literal["kal", "mdc"]
KINDS: tuple[Kind, ...] = get_args(Kind)

#: What the experiment's fits assume.
FITS = {"kal": "Kalman filter with matter (MdcKalTrack)", "mdc": "first fit, without matter (MdcTrack)"}

#: Which Lorentz shift the clusters of the fits have.
CLUSTER_POSITIONS = "the positions of the file, with the Lorentz shift of the experiment's software"

_HALF = 0.6827  # of a Gaussian within one standard deviation
_LEAST_TRACKS = 4  # for a displacement


@dataclass(frozen=True, eq=False)
class Refit:
    """Tracks fitted by us and by the experiment from the same hits, one row for each in all of these.

    Attributes
    ----------
    kind : str
        ``"kal"`` or ``"mdc"``.
    detector : str
    ours, boss : Table of kind "tracks"
    columns : dict of str to ndarray
        ``run``, ``number`` (of the event), ``event`` (in the file), ``track``, ``hypothesis``, ``status``, numbers of
        hits, chi-square of both, and for each parameter and p: ours, ``boss_``..., errors, ``diff_`` ours minus
        theirs, ``pull_`` that over their error, and where the events are simulated ``truth_``... (NaN without a
        particle near the track).
    """

    kind: str
    detector: str
    ours: Table
    boss: Table
    columns: Columns

    @property
    def good(self) -> Column:
        """Whether both fits have succeeded, (n,) bool."""
        return has_momentum(self.ours) & has_momentum(self.boss)

    def summary(self) -> dict[str, dict[str, Any]]:
        """Return median and half-width of the central 68 % of the differences, by parameter.

        ``diff`` and ``diff_width`` in ``unit``, ``pull`` and ``pull_width`` over the experiment's error,
        ``error_ratio``: the median of our error over theirs.
        """
        of = {name: one[self.good] for name, one in self.columns.items()}
        summary = {}
        for name in PARAMETERS:
            ratio, diff = of[f"err_{name}"] / of[f"boss_err_{name}"], QUANTITIES[name].factor * of[f"diff_{name}"]
            summary[name] = {
                "unit": QUANTITIES[name].unit, "diff": _middle(diff), "diff_width": _width(diff),
                "pull": _middle(of[f"pull_{name}"]), "pull_width": _width(of[f"pull_{name}"]),
                "error_ratio": _middle(ratio),
            }  # fmt: skip
        return summary

    def __repr__(self) -> str:
        n, good = len(self.ours), int(self.good.sum())
        lines = [f"{FITS[self.kind]}: {n} tracks, {good} fitted by both, with {self.detector}"]
        if not good:
            return lines[0]
        lines.append(f"  {'':15}{'ours - BOSS':>24}{'over the error of BOSS':>26}{'our error':>12}")
        lines.append(f"  {'':15}{'median':>12}{'68 % within':>12}{'median':>14}{'68 % within':>12}{'/ theirs':>12}")
        for name, row in self.summary().items():
            label, diff, width = f"{name} {row['unit']}", *(f"{row[key]:.3g}" for key in ("diff", "diff_width"))
            lines.append(
                f"  {label:<16}{diff:>11}{width:>12}{row['pull']:>14.3f}{row['pull_width']:>12.3f}"
                f"{row['error_ratio']:>12.3f}"
            )
        if self.ours["n_clusters"].any():
            lines.append(f"  clusters at {CLUSTER_POSITIONS}")
        ours, boss = (_middle((one["chi2"] / np.maximum(one["ndf"], 1))[self.good]) for one in (self.ours, self.boss))
        lines.append(f"  chi2/ndf, median: ours {ours:.3f}, BOSS {boss:.3f}")
        return "\n".join(lines)


def refit(events: Bes3Events, kind: Kind = "kal", settings: FitSettings | None = None) -> Refit:
    """Fit the hits of the experiment's tracks, and put the result beside theirs.

    Parameters
    ----------
    events : Bes3Events
    kind : str
        ``"kal"``: beside the tracks of the Kalman filter, with matter. ``"mdc"``: beside those of the first fit, which
        knows no matter; our fit then has ``matter=False``.
    settings : FitSettings or None
        `hypothesis` tells the masses (None: the pion, the experiment's default); `matter` follows from `kind`.

    Raises
    ------
    ValueError
        If there is no such kind, or no track with hits.
    """
    if kind not in KINDS:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(map(repr, KINDS))}")
    settings = FitSettings() if settings is None else settings
    settings = replace(settings, matter=kind == "kal", hypothesis=settings.hypothesis or "pi")
    if kind == "mdc":  # without matter the mass plays no role
        settings = replace(settings, hypothesis="pi")
    boss = events.kal_tracks if kind == "kal" else events.mdc_tracks
    hits = events.clusters, events.wire_hits, events.candidates, events.candidate_hits
    if not len(events.candidates) or not len(boss):
        raise ValueError(
            f"got {len(events.candidates)} sets of hits and {len(boss)} {FITS[kind]}; expected both, as in a .rec file "
            "(cgemit reconstruct takes .raw and .rtraw files)"
        )
    fitted = fit(events.detector, *hits, settings)["tracks"]
    mine, theirs = _same(fitted, boss, by_mass=kind == "kal")
    ours, boss = fitted[mine], boss[theirs]
    return Refit(kind, events.detector.name, ours, boss, _columns(events, ours, boss))


class Displacement(NamedTuple):
    """Place of the chamber, with respect to the description that our fit has.

    Attributes
    ----------
    value, error : ndarray, (4,) float64
        shift_x, shift_y, shift_z, mm, and rotation, rad, with their standard deviations.
    """

    value: npt.NDArray[np.float64]
    error: npt.NDArray[np.float64]

    @property
    def overrides(self) -> dict[str, str]:
        """Settings for `Detector.with_overrides`, which put the chamber there."""
        names, units = ("shift_x", "shift_y", "shift_z", "rotation"), ("mm", "mm", "mm", "rad")
        values = zip(names, self.value, units, strict=True)
        return {f"drift_chamber.{name}": f"{value:.6g} {unit}" for name, value, unit in values}


def displacement(beside: Refit, detector: Detector) -> Displacement:
    """Find how the chamber is displaced against our description, if the experiment's fits know it.

    A displacement moves d_rho, phi0 and d_z of our fits against theirs, by amounts that depend on the azimuth. Least
    squares give it. Tracks need hits of the chamber alone; tilts are not looked for.

    Parameters
    ----------
    beside : Refit
    detector : Detector
        Of our fit.

    Raises
    ------
    ValueError
        If both have fitted fewer than four tracks.
    """
    of = {name: one[beside.good] for name, one in beside.columns.items()}
    n = len(of["event"])
    if n < _LEAST_TRACKS:
        raise ValueError(f"displacement: got {n} tracks that both have fitted, expected {_LEAST_TRACKS} or more")
    cosine, sine, ones, zeros = np.cos(of["boss_phi0"]), np.sin(of["boss_phi0"]), np.ones(n), np.zeros(n)
    turn = of["boss_kappa"] * compiled(detector, gaps=False).field.bz / helix.RADIUS_PER_KAPPA  # per mm along the track
    slopes = {
        "dr": (-cosine, -sine, zeros, zeros),
        "phi0": (turn * sine, -turn * cosine, zeros, -ones),
        "dz": (-of["boss_tanl"] * sine, of["boss_tanl"] * cosine, -ones, zeros),
    }
    weight = {name: 1 / of[f"boss_err_{name}"] for name in slopes}
    matrix = np.concatenate([np.stack(slope, 1) * weight[name][:, None] for name, slope in slopes.items()])
    measured = np.concatenate([of[f"diff_{name}"] * weight[name] for name in slopes])
    constants, *_ = np.linalg.lstsq(matrix, measured)
    scatter = np.sum((measured - matrix @ constants) ** 2) / (len(measured) - len(constants))
    return Displacement(constants, np.sqrt(scatter * np.diagonal(np.linalg.inv(matrix.T @ matrix))))


def _same(ours: Table, boss: Table, *, by_mass: bool) -> tuple[Column, Column]:
    """Return the rows of the tracks that both have: of the same candidate and, with matter, mass."""
    mass = "hypothesis" if by_mass else "candidate"
    rows = {key: i for i, key in enumerate(zip(boss["candidate"].tolist(), boss[mass].tolist(), strict=True))}
    found = [rows.get(key, -1) for key in zip(ours["candidate"].tolist(), ours[mass].tolist(), strict=True)]
    theirs = np.array(found, np.int64)
    return np.flatnonzero(theirs >= 0), theirs[theirs >= 0]


def _columns(events: Bes3Events, ours: Table, boss: Table) -> Columns:
    event = ours["event"]
    columns: Columns = {
        "run": events.run[event],
        "number": events.number[event],
        "event": event,
        "track": boss["track"],
    }
    columns |= {
        name: ours[name] for name in ("hypothesis", "status", "n_clusters", "n_wires", "n_outliers", "chi2", "ndf")
    }
    columns |= {f"boss_{name}": boss[name] for name in ("status", "chi2", "ndf")}
    truth = _truth(events, boss)
    for name in PARAMETERS:
        diff = ours[name] - boss[name]
        if name == "phi0":
            diff = helix.wrap_angle(diff)
        columns |= {name: ours[name], f"err_{name}": ours[f"err_{name}"]}
        columns |= {f"boss_{name}": boss[name], f"boss_err_{name}": boss[f"err_{name}"]}
        with np.errstate(divide="ignore", invalid="ignore"):  # fits that failed have errors of 0
            columns |= {f"diff_{name}": diff, f"pull_{name}": diff / boss[f"err_{name}"], f"truth_{name}": truth[name]}
    return columns


#: Largest differences of a track from its generated particle: azimuth (rad), tan(lambda), relative kappa.
_NEAR = (0.1, 0.1, 0.2)


def _truth(events: Bes3Events, boss: Table) -> Columns:
    """Return the helix of the generated particle nearest to each track, NaN where none is near."""
    particles = events.particles
    true = helix.at_origin_in(particles, compiled(events.detector, gaps=False).field)
    nearest = np.full((len(boss), 5), np.nan)
    for row in range(len(boss)):
        mine = true[particles["event"] == boss["event"][row]]
        turn = helix.wrap_angle(mine[:, 1] - boss["phi0"][row])
        off = np.stack([turn, mine[:, 4] - boss["tanl"][row], mine[:, 2] / boss["kappa"][row] - 1], axis=1) / _NEAR
        far = np.where(np.isnan(off).any(axis=1), np.inf, np.abs(off).max(axis=1, initial=0))
        if len(far) and far.min() < 1:
            nearest[row] = mine[np.argmin(far)]
    with np.errstate(invalid="ignore"):
        return {**{name: nearest[:, i] for i, name in enumerate(helix.PARAMETERS)}, "p": helix.momentum(nearest)}


def _middle(values: Column) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _width(values: Column) -> float:
    """Return the half-width of the central 68 %."""
    low, high = np.quantile(values, [0.5 - _HALF / 2, 0.5 + _HALF / 2]) if len(values) else (np.nan, np.nan)
    return float(0.5 * (high - low))
