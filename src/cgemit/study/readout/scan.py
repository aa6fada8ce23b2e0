"""Resolution of a read-out against the angle of incidence, as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.statistics.formatting import text_table, with_error
from cgemit.study.readout.beam import BeamPoint, beam_detector, beam_point

Floats = npt.NDArray[np.float64]

_COLUMNS = ("angle_deg", "charge_fC", "strips", "efficiency")


@dataclass(frozen=True, eq=False, repr=False)
class BeamScan:
    """What a read-out resolves at several angles.

    Attributes
    ----------
    title : str
        Read-out, field and beam.
    points : tuple of BeamPoint
    """

    title: str
    points: tuple[BeamPoint, ...]

    @property
    def angle(self) -> Floats:
        """Angles, (n,) float64, deg."""
        return np.array([point.angle for point in self.points])

    @property
    def size(self) -> Floats:
        """Mean number of strips, (n,) float64."""
        return np.array([point.size for point in self.points])

    def curves(self) -> dict[str, tuple[Floats, Floats]]:
        """Return core widths and their errors, each (n,) float64 um, by estimator."""
        return {
            name: (
                np.array([point.widths[name].core for point in self.points]),
                np.array([point.widths[name].core_error for point in self.points]),
            )
            for name in self.points[0].widths
        }

    def to_csv(self) -> str:
        """Return the text of a CSV file, one row an angle; widths are those of the core, in um."""
        names = list(self.points[0].widths)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*_COLUMNS, *(f"{name}{end}_um" for name in names for end in ("", "_error", "_q68"))])
        for point in self.points:
            widths = [(one.core, one.core_error, one.q68) for one in (point.widths[name] for name in names)]
            row = [point.angle, point.charge, point.size, point.efficiency, *(value for one in widths for value in one)]
            writer.writerow([f"{value:.6g}" for value in row])
        return text.getvalue()

    def __repr__(self) -> str:
        names = list(self.points[0].widths)
        rows = [
            [f"{point.angle:g}", f"{point.charge:.1f}", f"{point.size:.2f}", f"{100 * point.efficiency:.2f}"]
            + [with_error(point.widths[name].core, point.widths[name].core_error) for name in names]
            for point in self.points
        ]
        head = ("angle [deg]", "Q [fC]", "strips", "eff. [%]", *(f"{name} [um]" for name in names))
        return text_table(self.title, head, rows)


def scan_angles(
    readout: Any, angles: Sequence[float], *, bz: float, n: int = 4000, seed: int = 1, particle: str = "pi-",
    p: float = 150.0, threads: int | None = None, progress: Callable[[float], None] | None = None,
) -> BeamScan:  # fmt: skip
    """Return what a read-out resolves at several angles of incidence.

    Parameters
    ----------
    readout : AnalogReadout or ProjectionReadout
    angles : sequence of float
        rad, positive towards larger phi.
    bz : float
        T.
    n : int
        Particles at each angle.
    seed : int
    particle : str
    p : float
        GeV/c.
    threads : int or None
    progress : callable or None
        Called with the fraction done after every angle.
    """
    detector, points = beam_detector(bz), []
    for number, angle in enumerate(np.degrees(angles)):
        degrees = float(np.round(angle, 9))
        points.append(beam_point(detector, readout, degrees, n=n, seed=seed, particle=particle, p=p, threads=threads))
        if progress is not None:
            progress((number + 1) / len(angles))
    return BeamScan(f"{readout.name}, {bz:g} T, {particle} of {p:g} GeV/c, {n} at each angle", tuple(points))
