"""Losses of electrons that the fit takes for another momentum: their probability, and the parts that cause them.

A share y of the momentum lost in a slab makes the fitted momentum p (1 - y)/(1 - y (1 - T)) of the true p, with the
share T of a change of kappa in this slab that the fit does not see: 1 before the first hit, 0 behind the last.
Photons are those of PDG 2024, eq. 34.29 (complete screening), collisions those of Moller and Bhabha for gamma >> 1
(docs/methods/matter.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.tables.show import Shown, data_frame

_LEAST_UNSEEN = 1e-3  # losses in slabs that are seen better change no momentum
_PER_SIGMA = 16  # steps of the grid of momenta per error
_MOST_STEPS = 2**19
#: What a print-out shows.
_SHOWN_POINTS, _SHOWN_PARTS = 6, 8
_LARGEST = 3.0  # ln(p/p_fit) of the largest loss that is told apart


def photons_above(y: npt.ArrayLike) -> Floats:
    """Return the number of photons above a share of the energy per radiation length, 0 from a share of 1 on.

    Parameters
    ----------
    y : array_like
        Photon energy over the electron's energy, above 0.
    """
    y = np.minimum(np.asarray(y, np.float64), 1.0)
    return np.asarray(-4 / 3 * np.log(y) - 4 / 3 * (1 - y) + 0.5 * (1 - y * y))


def collisions_above(y: npt.ArrayLike, charge: float) -> Floats:
    """Return the number of collisions that transfer more than a share of the energy, per xi over the energy.

    Parameters
    ----------
    y : array_like
        Transfer over the energy of an electron or positron with gamma >> 1, above 0. Of two electrons the slower one
        counts as struck: 0 from a share of 1/2 on.
    charge : float
        Negative for electrons.
    """
    if charge < 0:
        y = np.minimum(np.asarray(y, np.float64), 0.5)
        return np.asarray(1 / y - 1 / (1 - y) + 0.5 - y)
    y = np.minimum(np.asarray(y, np.float64), 1.0)
    return np.asarray(1 / y - 1 + 2 * np.log(y) + 3 * (1 - y) - (1 - y * y) + (1 - y**3) / 3)


@dataclass(frozen=True, eq=False, repr=False)
class Losses(Shown):
    """Losses of electrons or positrons of some points that the fit does not see.

    Attributes
    ----------
    detector, particle : str
    charge : float
    slabs, parts : tuple of str
        Names of the slabs, and of the parts of the detector that they belong to.
    p, cos_theta : ndarray, (points,) float64, GeV/c and 1
    thickness : ndarray, (points, slabs) float64
        Radiation lengths along the track.
    xi : ndarray, (points, slabs) float64, GeV
        Of Landau, along the track.
    unseen : ndarray, (points, slabs) float64
        Share of a loss that the fit takes for another momentum at the origin.
    error : ndarray, (points,) float64
        Relative error of the momentum without straggling.
    cut : ndarray, (points,) float64
        Unseen losses below this share of the momentum are those whose mean the fit subtracts.
    """

    detector: str
    particle: str
    charge: float
    slabs: tuple[str, ...]
    parts: tuple[str, ...]
    p: Floats
    cos_theta: Floats
    thickness: Floats
    xi: Floats
    unseen: Floats
    error: Floats
    cut: Floats

    @property
    def effective(self) -> Floats:
        """Radiation lengths of each slab times `unseen`, (points, slabs): what makes tails of the momentum."""
        return self.unseen * self.thickness

    def grouped(self) -> dict[str, Floats]:
        """Return the effective radiation lengths of each part, (points,)."""
        groups: dict[str, Floats] = {}
        for number, part in enumerate(self.parts):
            groups[part] = groups.get(part, np.zeros(len(self.p))) + self.effective[:, number]
        return groups

    def table(self, by: Literal["part", "slab"] = "part") -> dict[str, npt.NDArray[Any]]:
        """Return one row per point and part (or slab) as columns: effective radiation lengths and their share."""
        if by not in ("part", "slab"):
            raise ValueError(f"by: got {by!r}; expected one of part, slab")
        groups = self.grouped() if by == "part" else dict(zip(self.slabs, self.effective.T, strict=True))
        lengths = np.stack(list(groups.values()), axis=1)
        n = len(groups)
        columns = {"p": np.repeat(self.p, n), "cos_theta": np.repeat(self.cos_theta, n)}
        columns |= {by: np.tile(list(groups), len(self.p)), "effective": lengths.ravel()}
        with np.errstate(invalid="ignore"):
            columns["share"] = (lengths / lengths.sum(axis=1, keepdims=True)).ravel()
        return columns

    def to_pandas(self, by: Literal["part", "slab"] = "part") -> Any:
        """Return `table` as a pandas DataFrame."""
        return data_frame(self.table(by))

    def loss_probability(self, x: npt.ArrayLike) -> Floats:
        """Return the probability that unseen losses make the fitted momentum smaller by more than a share of itself.

        One minus the probability that no single loss does. Errors of hits and scattering are left out: `x` should be
        several of them.

        Parameters
        ----------
        x : array_like
            Shares of the momentum, above 0 and below 1.

        Returns
        -------
        ndarray, (points,) + shape of x, float64

        Raises
        ------
        ValueError
            If a share is not between 0 and 1.
        """
        x = _shares("loss_probability", x)
        return np.stack([-np.expm1(-self._above(i, x)) for i in range(len(self.p))])

    def share_within(self, x: npt.ArrayLike) -> Floats:
        """Return the share of tracks whose fitted momentum is within +-x of the true one, errors included.

        Parameters
        ----------
        x : array_like
            Shares of the momentum, above 0 and below 1.

        Returns
        -------
        ndarray, (points,) + shape of x, float64

        Raises
        ------
        ValueError
            If a share is not between 0 and 1.
        """
        x = _shares("share_within", x)
        return np.stack([response.below(np.log1p(x)) - response.below(np.log1p(-x)) for response in self._responses])

    def deviation(self, share: float) -> Floats:
        """Return the share of the momentum that the fitted momentum of this share of the tracks is off by at most.

        Parameters
        ----------
        share : float
            Of the tracks, such as 0.68 or 0.95.

        Returns
        -------
        ndarray, (points,) float64

        Raises
        ------
        ValueError
            If the share is not between 0 and 1.
        """
        _shares("deviation", share)
        x = np.geomspace(1e-6, 0.95, 2000)
        within = self.share_within(x)
        return np.array([np.interp(share, row, x) for row in within])

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        groups, rows = self.grouped(), []
        for i in range(min(len(self.p), _SHOWN_POINTS)):
            total = sum(float(value[i]) for value in groups.values())
            order = sorted(groups, key=lambda name: -float(groups[name][i]))
            for name in order[:_SHOWN_PARTS]:
                length = float(groups[name][i])
                share = f"{100 * length / total:.1f} %" if total > 0 else "-"
                rows.append([f"{self.p[i]:.4g}", name, f"{100 * length:.3f} %", share])
            if rest := order[_SHOWN_PARTS:]:
                length = sum(float(groups[name][i]) for name in rest)
                rows.append([f"{self.p[i]:.4g}", f"other ({len(rest)})", f"{100 * length:.3f} %", ""])
        head = ["p [GeV/c]", "part", "unseen X/X0", "of all"]
        return f"{self.detector}, {self.particle}: matter whose radiation the fit does not see", head, rows

    def note(self) -> str:
        """Return the shares of tracks near the truth at the first point."""
        near = ", ".join(f"{100 * self.share_within(x)[0]:.1f} % within {100 * x:g} %" for x in (0.01, 0.02, 0.05))
        return f"p {self.p[0]:.4g} GeV/c: fitted momenta {near} of the true one"

    def _above(self, i: int, x: Floats) -> Floats:
        """Return the expected number of losses that make the fitted momentum of point i smaller by a share above x."""
        use = self.unseen[i] > _LEAST_UNSEEN
        unseen = self.unseen[i, use]
        x = x[..., None]
        y = x / (unseen + x * (1 - unseen))
        xi = self.xi[i, use] / self.p[i]
        found = self.thickness[i, use] * photons_above(y) + xi * collisions_above(y, self.charge)
        return np.asarray(found.sum(axis=-1))

    @cached_property
    def _responses(self) -> list[Response]:
        return [self._response(i) for i in range(len(self.p))]

    def _response(self, i: int) -> Response:
        sigma = float(self.error[i])
        step = max(sigma / _PER_SIGMA, 2 * _LARGEST / _MOST_STEPS)
        n = 1 << math.ceil(math.log2(2 * _LARGEST / step + 64))
        edges = (np.arange(n // 2) + 0.5) * step
        # The sum over slabs is smooth: it is taken at fewer points.
        few = np.geomspace(edges[0], edges[-1], 2000)
        numbers = np.maximum(self._above(i, -np.expm1(-few)), 1e-300)
        above = np.exp(np.interp(np.log(edges), np.log(few), np.log(numbers)))
        masses = np.zeros(n)
        masses[1 : n // 2] = -np.diff(above)
        masses[n // 2] = above[-1]
        # Softer losses have their mean subtracted by the fit, and their variance: theirs is that of losses of density
        # dN/du = N(u)/u below, which is exact for collisions.
        soft = above[0] * edges[0] ** 2
        cut = float(self.cut[i])
        inside = edges < cut
        subtracted = 0.0
        if np.count_nonzero(inside) > 1:
            grid = np.append(edges[inside], cut)
            numbers = np.append(above[inside], self._above(i, np.array(-np.expm1(-cut))))
            subtracted = float(edges[0] * numbers[0] - cut * numbers[-1] + np.trapezoid(numbers, grid))
        frequency = 2 * np.pi * np.fft.rfftfreq(n, step)
        transform = np.exp(np.fft.rfft(masses) - masses.sum() - 0.5 * (sigma**2 + soft) * frequency**2)
        lost = np.fft.irfft(transform, n)  # of bins about k step; those of negative losses are at the end
        lost = np.roll(np.maximum(lost, 0), n // 8)
        change = subtracted - (np.arange(n) - n // 8) * step
        return Response(np.asarray(change[::-1], np.float64), lost[::-1] / lost.sum())


@dataclass(frozen=True, eq=False)
class Response:
    """Distribution of ln(fitted over true momentum).

    Attributes
    ----------
    change : ndarray, (n,) float64
        Equally spaced, rising.
    probability : ndarray, (n,) float64
        Of each bin; the sum is 1.
    """

    change: Floats
    probability: Floats

    def below(self, change: npt.ArrayLike) -> Floats:
        """Return the probability of a smaller change."""
        step = self.change[1] - self.change[0]
        edges = np.append(self.change - 0.5 * step, self.change[-1] + 0.5 * step)
        return np.asarray(np.interp(np.asarray(change, np.float64), edges, np.append(0.0, np.cumsum(self.probability))))


def _shares(what: str, shares: npt.ArrayLike) -> Floats:
    """Return shares as an array; raise ValueError that names the first wrong one."""
    x = np.asarray(shares, np.float64)
    wrong = ~((x > 0) & (x < 1))
    if np.any(wrong):
        raise ValueError(f"{what}: got {x[wrong].flat[0]:g}; expected shares between 0 and 1")
    return x
