"""The one list of quantities whose resolutions are quoted: names, units, symbols, residuals and derivatives.

A new quantity of tracks is one entry of `QUANTITIES`. Resolutions, covariances, budgets, scans, sweeps, goals of
optimizations and figures follow from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix, tables
from cgemit.analysis.widths import FEWEST
from cgemit.base.arrays import Floats
from cgemit.base.errors import did_you_mean
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables.schema import FitStatus, has_momentum
from cgemit.truth.match import is_matched

#: Places of the 15 entries of the upper triangle in a covariance.
UPPER = np.triu_indices(len(helix.PARAMETERS))


class Columns(Protocol):
    """A table or mapping of columns by name."""

    def __getitem__(self, name: str, /) -> Any: ...


@dataclass(frozen=True)
class Quantity:
    """A quantity and the unit in which its resolution is quoted.

    Attributes
    ----------
    name : str
        In arguments and in the names of columns.
    native : str
        Unit of the quantity in tables.
    unit : str
        Unit of its resolution everywhere.
    factor : float
        Number of quoted units in a native one.
    symbol : str
        On axes.
    spellings : tuple of str
        Further names that arguments may have, beside `name`, `symbol` and `sigma`.
    value : callable or None
        Value, native unit, from columns of helix parameters and ``charge``. None: tracks have a column of residuals.
    slopes : callable or None
        Non-zero derivatives of `value` with respect to helix parameters, by parameter, from columns ``kappa``,
        ``tanl`` and ``charge``.
    relative : bool
        Whether residual and resolution are divided by the value.
    reported : bool
        Whether scans report it, and, unless it is relative, sweeps compute it by default.
    """

    name: str
    native: str
    unit: str
    factor: float
    symbol: str
    spellings: tuple[str, ...] = ()
    value: Callable[[Columns], Floats] | None = None
    slopes: Callable[[Columns], Mapping[str, Any]] | None = None
    relative: bool = False
    reported: bool = True

    @property
    def sigma(self) -> str:
        """Symbol of the resolution, such as ``σ(d_ρ)`` or ``σ(p)/p``."""
        return f"σ({self.symbol})" + (f"/{self.symbol}" if self.relative else "")

    def column(self, kind: str = "sigma", end: str = "") -> str:
        """Return the header of a column, such as ``sigma_p (MeV/c)``, or ``sigma_p_error (MeV/c)`` with an end."""
        return f"{kind}_{self.name}{end} ({self.unit})"

    def residual(self, tracks: Columns) -> Floats:
        """Return fitted minus true value of each track, (n,) float64 in the quoted unit; NaN without a truth."""
        if self.name in tables.PARAMETERS:
            return np.asarray(self.factor * tracks[f"res_{self.name}"], np.float64)
        assert self.value is not None
        with np.errstate(invalid="ignore", divide="ignore"):
            fitted, true = self.value(tracks), self.value(_Truth(tracks))
            return np.asarray(self.factor * (fitted / true - 1 if self.relative else fitted - true), np.float64)

    def error(self, tracks: Columns) -> Floats:
        """Return the fit's own error of each track, (n,) float64 in the quoted unit; NaN without a covariance."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.variance(tracks["cov"][:, *UPPER], tracks["kappa"], tracks["tanl"], tracks["charge"]))

    @property
    def is_momentum(self) -> bool:
        """Whether the quantity depends on kappa."""
        return self.name == "kappa" or (self.slopes is not None and "kappa" in self.slopes(_ANY))

    def counts(self, tracks: Columns) -> npt.NDArray[np.bool_]:
        """Return whether each track counts in resolutions: it measures its particle and this quantity, (n,) bool."""
        return self.measured_by(tracks) & is_matched(tracks)

    def measured_by(self, tracks: Columns) -> npt.NDArray[np.bool_]:
        """Return whether each track was fitted, and measures this quantity, (n,) bool.

        Tracks of status `unconstrained` do not measure their momentum, nor perhaps their position along z: they count
        in the other quantities, and in those along z if the error is far below that of the fit's prior.
        """
        status = np.asarray(tracks["status"])
        ok, weak = has_momentum(tracks), status == FitStatus.unconstrained
        if self.is_momentum or not weak.any():
            return np.asarray(ok)
        along = {"dz": "dz", "tanl": "tanl", "theta": "tanl"}.get(self.name)
        if along is not None:
            prior = getattr(tracks, "meta", {}).get("prior_sigma", FitSettings().prior_sigma)
            sigma = prior[helix.PARAMETERS.index(along)]
            weak = weak & (np.asarray(tracks[f"err_{along}"]) < _core.reconstruction.MOST_ERROR * sigma)
        return np.asarray(ok | weak)

    def gradient(self, kappa: Floats, tanl: Floats, charge: npt.ArrayLike) -> Floats:
        """Return the derivatives with respect to (dr, phi0, kappa, dz, tanl), quoted per native unit.

        Parameters
        ----------
        kappa, tanl : ndarray, (tracks,) float64, (GeV/c)^-1 and 1
        charge : array_like, (tracks,) or (), e

        Returns
        -------
        ndarray, (tracks, 5) float64
        """
        rows = np.zeros((len(kappa), len(helix.PARAMETERS)))
        at = {"kappa": kappa, "tanl": tanl, "charge": np.asarray(charge)}
        slopes = {self.name: 1.0} if self.slopes is None else self.slopes(at)
        for name, slope in slopes.items():
            rows[:, helix.PARAMETERS.index(name)] = slope
        if self.relative:
            assert self.value is not None
            rows /= self.value(at)[:, None]
        return self.factor * rows

    def variance(self, entries: Floats, kappa: Floats, tanl: Floats, charge: npt.ArrayLike) -> Floats:
        """Return the variance for each covariance, in the square of the quoted unit.

        Parameters
        ----------
        entries : ndarray, (..., tracks, 15) float64
            Upper triangles of covariances of (dr, phi0, kappa, dz, tanl); detectors may add axes in front.
        kappa, tanl : ndarray, (tracks,) float64, (GeV/c)^-1 and 1
        charge : array_like, (tracks,) or (), e

        Returns
        -------
        ndarray, (..., tracks) float64
        """
        weights = self.gradient(kappa, tanl, charge)
        used = np.any(weights != 0, axis=0)  # one to three of the five parameters
        variance = np.zeros(entries.shape[:-1])
        for entry, (i, j) in enumerate(zip(*UPPER, strict=True)):
            if used[i] and used[j]:  # entries beside the diagonal stand for two
                variance += (1 if i == j else 2) * weights[:, i] * weights[:, j] * entries[..., entry]
        return variance


@dataclass(frozen=True)
class Kinematic:
    """What tells tracks of studies apart: a kinematic variable of what is shot."""

    name: str
    unit: str
    symbol: str

    @property
    def header(self) -> str:
        """Name of its column, such as ``p (GeV/c)``."""
        return f"{self.name} ({self.unit})" if self.unit else self.name

    def text(self, value: Any) -> str:
        """Return a value, (low, high) of a range, or the text of one, such as ``p = 1 GeV/c``."""
        if isinstance(value, tuple):
            value = f"{value[0]:g} to {value[1]:g}"
        shown = value.replace(":", " to ") if isinstance(value, str) else f"{value:g}"
        return f"{self.symbol} = {shown}" + (f" {self.unit}" if self.unit else "")


#: Kinematic variables by name, in the order in which rows of studies go through them, slowest first; `d` is the
#: distance of the origin of tracks from the beam line.
KINEMATICS = {
    name: Kinematic(name, unit, symbol)
    for name, unit, symbol in (
        ("p", "GeV/c", "p"), ("pt", "GeV/c", "pT"), ("cos_theta", "", "cos θ"), ("theta", "rad", "θ"), ("eta", "", "η"),
        ("phi", "rad", "φ"), ("d", "mm", "d"),
    )
}  # fmt: skip


_ANY: Columns = {"kappa": np.ones(1), "tanl": np.zeros(1), "charge": np.ones(1)}


class _Truth:
    """The true helix parameters and charge of tracks, by the names of the fitted ones."""

    def __init__(self, tracks: Columns) -> None:
        self._tracks = tracks

    def __getitem__(self, name: str, /) -> Any:
        return np.abs(true_charge(self._tracks)) if name == "charge" else self._tracks[f"truth_{name}"]


def true_charge(tracks: Columns) -> Floats:
    """Return the charge of the particle of each track, (tracks,) float64, e; NaN without a truth."""
    kappa, tanl = tracks["truth_kappa"], tracks["truth_tanl"]
    return np.asarray(np.rint(tracks["truth_p"] * kappa / np.sqrt(1 + tanl**2)))


def _pt(h: Columns) -> Floats:
    return np.asarray(np.abs(h["charge"]) * (1 / np.abs(h["kappa"])))


def _pt_slopes(h: Columns) -> dict[str, Floats]:
    return {"kappa": -_pt(h) / h["kappa"]}


def _p(h: Columns) -> Floats:
    return np.asarray(_pt(h) * np.sqrt(1 + h["tanl"] ** 2))


def _p_slopes(h: Columns) -> dict[str, Floats]:
    p = _p(h)
    return {"kappa": -p / h["kappa"], "tanl": p * h["tanl"] / (1 + h["tanl"] ** 2)}


def _theta(h: Columns) -> Floats:
    return np.asarray(np.arctan2(1, h["tanl"]))


def _theta_slopes(h: Columns) -> dict[str, Floats]:
    return {"tanl": -1 / (1 + h["tanl"] ** 2)}


#: Quantities of tracks by name, in the order of tables and figures.
QUANTITIES: Mapping[str, Quantity] = {
    one.name: one
    for one in (
        Quantity("dr", "mm", "um", 1000.0, "d_ρ", ("d_rho", "drho", "d0")),
        Quantity("dz", "mm", "mm", 1.0, "d_z", ("z0",)),
        Quantity("p", "GeV/c", "MeV/c", 1000.0, "p", (), _p, _p_slopes),
        Quantity("pt", "GeV/c", "MeV/c", 1000.0, "p_T", ("pT",), _pt, _pt_slopes),
        Quantity("p_rel", "", "%", 100.0, "p", ("p/p",), _p, _p_slopes, relative=True),
        Quantity("pt_rel", "", "%", 100.0, "p_T", ("pt/pt", "pT/pT"), _pt, _pt_slopes, relative=True),
        Quantity("phi0", "rad", "mrad", 1000.0, "φ₀", ("phi_0", "phi")),
        Quantity("theta", "rad", "mrad", 1000.0, "θ", (), _theta, _theta_slopes),
        Quantity("tanl", "", "1e-3", 1000.0, "tan λ", ("tan_lambda", "tan(lambda)")),
        Quantity("kappa", "1/(GeV/c)", "1/(GeV/c)", 1.0, "κ", reported=False),
    )
}
#: Names of what scans report.
REPORTED = tuple(one.name for one in QUANTITIES.values() if one.reported)
#: Names of all but the relative ones.
ABSOLUTE = tuple(one.name for one in QUANTITIES.values() if not one.relative)
#: Names of the resolutions that short tables show, as the paper does.
MAIN = ("dr", "dz", "p")
#: Names by every accepted spelling: the names and symbols that tables and figures show, and others. A relative
#: resolution has the symbol of the quantity itself.
NAMES: Mapping[str, str] = {
    text: quantity.name
    for quantity in QUANTITIES.values()
    for text in (quantity.name, *quantity.spellings, quantity.sigma, *([] if quantity.relative else [quantity.symbol]))
}

#: Residuals of clusters in the two views.
X = Quantity("X", "mm", "um", 1000.0, "X")
V = Quantity("V", "mm", "um", 1000.0, "V")


def quantity_of(name: str, what: str = "quantity") -> Quantity:
    """Return the quantity of tracks that a name or another spelling stands for.

    Parameters
    ----------
    name : str
    what : str
        Name of the argument, for the message.

    Raises
    ------
    ValueError
        If there is none; the message lists all names.
    """
    if not isinstance(name, str) or name not in NAMES:
        hint = did_you_mean(str(name), list(NAMES), "; ")
        raise ValueError(f"{what}: got {name!r}; expected one of {', '.join(QUANTITIES)}{hint}")
    return QUANTITIES[NAMES[name]]


def median_error(tracks: Columns, quantity: str) -> float:
    """Return the median of the fit's own errors of a quantity, in its unit; NaN for fewer than 10 tracks.

    Of tracks with their matches, those that count in resolutions. It scatters much less than the core width, but it is
    right only where the pulls have the width 1.
    """
    known = QUANTITIES[quantity]
    return median(known.error(tracks)[known.counts(tracks)])


def median(errors: Floats) -> float:
    """Return the median of errors, (n,); NaN for fewer than 10."""
    return float(np.median(errors)) if len(errors) >= FEWEST else float("nan")
