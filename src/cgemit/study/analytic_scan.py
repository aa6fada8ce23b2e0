"""Resolutions against momentum without events, as lines beside the points of simulated ones."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from cgemit.covariance import Covariance, analytic
from cgemit.covariance.mixture import core_width, mean
from cgemit.detector import Detector, load
from cgemit.fit import FitStatus
from cgemit.species import HYPOTHESES, species
from cgemit.stages import Settings
from cgemit.statistics.curves import Line
from cgemit.statistics.forms import FORMS, FormFit, fit_form
from cgemit.study import samples
from cgemit.study.quantities import QUANTITIES, column
from cgemit.study.samples import Order, cosines_of, momentum_name, momentum_of, transverse
from cgemit.study.scan_files import ScanBase
from cgemit.study.scan_table import angle_text, leading_columns, shot_text
from cgemit.study.scans import QUOTED_PARAMETERS
from cgemit.study.sweeps.evaluate import QUANTITIES as OF_SWEEPS
from cgemit.values import InTurn

Floats = npt.NDArray[np.float64]

#: Momenta of a line, at least; those asked for are added.
LINE_POINTS = 60


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticScan(ScanBase):
    """Resolutions of one detector against momentum from the covariance, without events.

    Attributes
    ----------
    orders : tuple of Order
        One for each momentum asked for, with detector, gun and settings; no event is simulated.
    covariance : Covariance
        At the momenta of the lines (first axis), and the values of a list of cos(theta) (second axis).
    seed : int
        Kept for the record; nothing is random.
    seconds : float
        Wall time.
    """

    orders: tuple[Order, ...]
    covariance: Covariance
    seed: int
    seconds: float

    method: ClassVar[str] = "analytic"
    hits: ClassVar[str] = ""
    removed: ClassVar[Mapping[str, Mapping[str, int]]] = {}

    @property
    def detector(self) -> Detector:
        """The detector."""
        return self.orders[0].detector

    @property
    def momenta(self) -> list[float]:
        """The momenta asked for, GeV/c."""
        return [momentum_of(order) for order in self.orders]

    @cached_property
    def p(self) -> Floats:
        """Momenta of the lines: those asked for, and at least 60 from the first to the last of them."""
        return line_momenta(self.momenta)

    def sigma(self, name: str, *, rms: bool = False) -> Floats:
        """Return the core resolution at the momenta of the lines, in the quoted unit.

        Parameters
        ----------
        name : str
            Of `quantities.QUANTITIES`, such as ``"dr"`` um, ``"dz"`` mm, ``"p"`` MeV/c, ``"pt_rel"`` %.
        rms : bool
            Whether to return the root of the mean variance instead.
        """
        found = self.covariance
        if name == "pt_rel":  # sigma(pT)/pT = sigma(kappa)/|kappa|, track by track
            kappa = found._tracks.kappa.reshape(*found.p.shape, -1)
            variances, scale = found.variances("kappa") / kappa**2, 100.0
        elif name == "p_rel":
            variances, scale = found.variances("p") / found.p[..., None] ** 2, 100.0
        else:
            variances, scale = found.variances(name), OF_SWEEPS[name][1]
        rows = variances.reshape(len(self.p), -1)
        return scale * (np.sqrt(mean(rows, ~np.isnan(rows))) if rms else core_width(rows))

    @property
    def reached(self) -> Floats:
        """Fraction of the tracks with a covariance at the momenta of the lines."""
        return np.asarray(self.covariance.reached.reshape(len(self.p), -1).mean(axis=1))

    @property
    def angle(self) -> str:
        """Polar angle of the tracks, as text."""
        return angle_text(self.orders[0])

    @property
    def lines(self) -> list[Line]:
        """Core resolutions of d_rho, d_z and p against momentum; they have no statistical error."""
        return [line for line in self.all_lines if line.id.removeprefix("sigma_") in QUOTED_PARAMETERS]

    @cached_property
    def all_lines(self) -> list[Line]:
        """Core resolutions of all quantities against momentum, or transverse momentum."""
        none, about = np.full(len(self.p), np.nan), (self.method, str(self.orders[0].gun.particle))
        return [
            Line(f"sigma_{name}", self.detector.name, self.p, "GeV/c", self.sigma(name), none, unit, *about)
            for name, (unit, _) in QUANTITIES.items()
        ]

    @cached_property
    def fits(self) -> list[FormFit]:
        """The usual forms, fitted to the lines with equal relative weights; none against pT."""
        first = self.orders[0]
        if transverse(first):
            return []
        how: dict[str, Any] = {"particle": first.gun.particle, "cos_theta": cosines_of(first)}
        how |= {"detector": self.detector.name, "method": self.method}
        found = [fit_form(name, self.p, self.sigma("pt_rel" if name == "pt" else name), **how) for name in FORMS]
        return [one for one in found if one is not None]

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
        for name in QUANTITIES:
            columns[column("sigma", name)] = self.sigma(name).tolist()
            columns[column("rms", name)] = self.sigma(name, rms=True).tolist()
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
        title += f"; read-out {self.readout}" if self.readout else ""
        return title, (f"{momentum_name(self.orders[0])} [GeV/c]", *_HEAD), self._rows()

    def _rows(self) -> list[list[str]]:
        values = [self.at(name) for name in QUOTED_PARAMETERS]
        shares = self.reached[self._asked()]
        return [
            [f"{p:g}", *("-" if np.isnan(one) else f"{one:.4g}" for one in row), f"{100 * share:.4g} %"]
            for p, row, share in zip(self.momenta, zip(*values, strict=True), shares, strict=True)
        ]


_HEAD = ("sigma(d_rho) [um]", "sigma(d_z) [mm]", "sigma(p) [MeV/c]", "with covariance")


def line_momenta(momenta: Sequence[float]) -> Floats:
    """Return the momenta of a line: those given, in order, and 60 in equal steps between the least and the largest.

    Parameters
    ----------
    momenta : sequence of float
        One is returned as it is.
    """
    given = np.unique(np.asarray(momenta, np.float64))
    if len(given) == 1:
        return given
    steps = np.linspace(given[0], given[-1], LINE_POINTS)
    distance = np.min(np.abs(steps[:, None] - given), axis=1)
    more = steps[distance > 1e-9 * given[-1]]  # rounding must not make two points of one
    return np.sort(np.concatenate([given, more]))


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
        Of all stages; the read-out, the sides of the wires and the fit enter.
    threads : int, optional
        Default: all cores.

    Raises
    ------
    ValueError
        If particle or numbers make no sense, the particle is neutral, or the fit assumes the mass of another particle.
    """
    start = time.perf_counter()
    gun = samples.gun_arguments(momenta, pt, particle, cos_theta, theta)
    orders = samples.momentum_orders(load(detector), **gun, events=0, seed=seed, settings=settings)
    if not orders:
        raise ValueError("momenta: got none, expected at least one")
    first = orders[0]
    digitize, fit = first.settings.digitize, first.settings.fit
    if others := [name for name in fit.hypotheses() if HYPOTHESES[name].pdg != abs(species(first.gun.particle).pdg)]:
        # A covariance does not hold the bias of another mass.
        raise ValueError(
            f"fit.hypothesis: got {', '.join(others)} for {first.gun.particle}; "
            "the analytic method expects the particle's own mass"
        )
    p, angles = _grid(line_momenta([momentum_of(order) for order in orders]), first)
    found = analytic(
        first.detector, first.gun.particle, p, angles, readout=digitize.readout, reveal_sides=digitize.reveal_sides,
        fit=fit, threads=threads,
    )  # fmt: skip
    return AnalyticScan(tuple(orders), found, seed, time.perf_counter() - start)


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
