"""Resolutions against momentum without events, as lines beside the points of simulated ones."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from cgemit.covariance import Covariance, analytic
from cgemit.covariance.mixture import core_width, mean
from cgemit.detector import Detector, load
from cgemit.fit import FitSettings, FitStatus
from cgemit.result import Settings
from cgemit.species import HYPOTHESES, species
from cgemit.statistics.curves import Line
from cgemit.statistics.formatting import html_table, text_table, with_error
from cgemit.statistics.forms import FORMS, FormFit, fit_form
from cgemit.statistics.resolutions import QUOTED
from cgemit.study.samples import Order, momentum_of, momentum_orders
from cgemit.study.scan_files import save_scans, summary_of
from cgemit.study.scans import QUOTED_PARAMETERS, Scan
from cgemit.values import InTurn

Floats = npt.NDArray[np.float64]

#: Momenta of a line, at least; those asked for are added.
LINE_POINTS = 60


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticScan:
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
            ``"dr"`` um, ``"dz"`` mm, ``"p"`` MeV/c; ``"pt"``: sigma(pT)/pT in %.
        rms : bool
            Whether to return the root of the mean variance instead.
        """
        found = self.covariance
        if name == "pt":  # sigma(pT)/pT = sigma(kappa)/|kappa|, track by track
            kappa = found._tracks.kappa.reshape(*found.p.shape, -1)
            variances, scale = found.variances("kappa") / kappa**2, 100.0
        else:
            variances, scale = found.variances(name), QUOTED[name][1]
        rows = variances.reshape(len(self.p), -1)
        return scale * (np.sqrt(mean(rows, ~np.isnan(rows))) if rms else core_width(rows))

    @property
    def reached(self) -> Floats:
        """Fraction of the tracks with a covariance at the momenta of the lines."""
        return np.asarray(self.covariance.reached.reshape(len(self.p), -1).mean(axis=1))

    @cached_property
    def lines(self) -> list[Line]:
        """Core resolutions of d_rho, d_z and p against momentum; they have no statistical error."""
        none = np.full(len(self.p), np.nan)
        return [
            Line(f"sigma_{name}", self.detector.name, self.p, "GeV/c", self.sigma(name), none, QUOTED[name][0],
                 self.method)
            for name in QUOTED_PARAMETERS
        ]  # fmt: skip

    @cached_property
    def fits(self) -> list[FormFit]:
        """The usual forms, fitted to the lines with equal relative weights; none with fewer than three momenta."""
        gun = self.orders[0].gun
        how: dict[str, Any] = {"particle": gun.particle, "cos_theta": gun.cos_theta}
        how |= {"detector": self.detector.name, "method": self.method}
        found = [fit_form(name, self.p, self.sigma(name), **how) for name in FORMS]
        return [one for one in found if one is not None]

    def at(self, name: str) -> Floats:
        """Return the core resolution at the momenta asked for, in the quoted unit."""
        return self.sigma(name)[self._asked()]

    def _asked(self) -> npt.NDArray[np.intp]:
        return np.searchsorted(self.p, self.momenta)

    def columns(self) -> dict[str, list[Any]]:
        """Return the widths for each momentum of the lines: the columns of the CSV table."""
        n = len(self.p)
        columns: dict[str, list[Any]] = {"detector": [self.detector.name] * n, "p (GeV/c)": self.p.tolist()}
        columns |= {"method": [self.method] * n}
        for name in QUOTED_PARAMETERS:
            unit = QUOTED[name][0]
            columns[f"core_{name} ({unit})"] = self.sigma(name).tolist()
            columns[f"rms_{name} ({unit})"] = self.sigma(name, rms=True).tolist()
        return columns | {"covariance": self.reached.tolist()}

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds."""
        return summary_of([self])

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Write the files that `Scan.save` writes.

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

    def _title(self) -> str:
        gun = self.orders[0].gun
        return f"{self.detector.name}, {gun.particle}, cos(theta) {gun.cos_theta}: core widths, analytic"

    def _rows(self) -> list[list[str]]:
        values = [self.at(name) for name in QUOTED_PARAMETERS]
        shares = self.reached[self._asked()]
        return [
            [f"{p:g}", *("-" if np.isnan(one) else f"{one:.4g}" for one in row), f"{100 * share:.4g} %"]
            for p, row, share in zip(self.momenta, zip(*values, strict=True), shares, strict=True)
        ]

    def __repr__(self) -> str:
        return "\n".join([text_table(self._title(), _HEAD, self._rows()), *filter(None, [self.note()])])

    def _repr_html_(self) -> str:
        note = f"<p>{escape(self.note())}</p>" if self.note() else ""
        return html_table(self._title(), _HEAD, self._rows()) + note


_HEAD = ("p [GeV/c]", "sigma(d_rho) [um]", "sigma(d_z) [mm]", "sigma(p) [MeV/c]", "with covariance")


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
    momenta: Sequence[float],
    *,
    particle: str | int = "mu-",
    cos_theta: float | tuple[float, float] | list[float] = (-0.93, 0.93),
    seed: int = 1,
    settings: Settings | None = None,
    threads: int | None = None,
) -> AnalyticScan:
    """Return the resolutions that `scan` measures from the covariance, without events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    momenta : sequence of float
        GeV/c; the lines also have at least 60 momenta from the first to the last of them.
    particle : str or int
        Name or number of the Particle Data Group.
    cos_theta : float, (float, float) or list of float
        Cosine of the polar angle: fixed, averaged over a uniform range, or over some values.
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
    gun: dict[str, Any] = {"particle": particle, "cos_theta": cos_theta}
    orders = momentum_orders(load(detector), momenta, **gun, events=0, seed=seed, settings=settings)
    if not orders:
        raise ValueError("momenta: got none, expected at least one")
    first = orders[0]
    digitize, fit = first.settings.digitize, first.settings.fit
    _check_hypothesis(fit, first.gun.particle)
    p: Any = line_momenta([momentum_of(order) for order in orders])
    angles: Any = first.gun.cos_theta
    if isinstance(angles, InTurn):
        p, angles = p[:, None], list(angles.values)
    found = analytic(
        first.detector, first.gun.particle, p, angles, readout=digitize.readout, reveal_sides=digitize.reveal_sides,
        fit=fit, threads=threads,
    )  # fmt: skip
    return AnalyticScan(tuple(orders), found, seed, time.perf_counter() - start)


def _check_hypothesis(fit: FitSettings, particle: str | int) -> None:
    """Refuse a fit that assumes the mass of another particle, since a covariance does not hold its bias."""
    own = abs(species(particle).pdg)
    if others := [name for name in fit.hypotheses() if HYPOTHESES[name].pdg != own]:
        raise ValueError(
            f"fit.hypothesis: got {', '.join(others)} for {particle}; "
            "the analytic method expects the particle's own mass"
        )


def compared(simulated: Scan, line: AnalyticScan) -> str:
    """Return a table of simulated and analytic core widths side by side, with their ratio.

    Parameters
    ----------
    simulated : Scan
    line : AnalyticScan
        Of the same detector and momenta.
    """
    cells = [[f"{p:g}" for p in line.momenta]]
    head = ["p [GeV/c]"]
    for name, text, points in zip(QUOTED_PARAMETERS, _HEAD[1:4], simulated.lines, strict=True):
        expected = line.at(name)
        head += [text, "analytic", "ratio"]
        cells.append([with_error(*pair) for pair in zip(points.y, points.y_error, strict=True)])
        cells.append([with_error(value, 0.0) for value in expected])
        ratios = zip(points.y / expected, points.y_error / expected, strict=True)
        cells.append([with_error(*pair) for pair in ratios])
    first = line.orders[0]
    title = (
        f"{first.detector.name}, {first.gun.particle}, cos(theta) {first.gun.cos_theta}: core widths, simulated "
        f"({simulated.samples[0].n_events} events at each momentum) and analytic, ratio simulated/analytic"
    )
    table = text_table(title, head, [list(row) for row in zip(*cells, strict=True)])
    return "\n".join([table, *filter(None, [simulated.note(), line.note()])])
