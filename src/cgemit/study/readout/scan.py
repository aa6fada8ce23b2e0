"""Resolution of a read-out in a beam against incidence, fields, gain or threshold, as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from cgemit.detector import Detector
from cgemit.statistics.formatting import text_table, with_error
from cgemit.study.readout.beam import BeamPoint, beam_detector, beam_views

if TYPE_CHECKING:
    from cgemit.draw import Picture

Floats = npt.NDArray[np.float64]

#: What can be scanned, with the unit of its values.
QUANTITIES = {"angle": "deg", "bz": "T", "drift_field": "kV/cm", "gain": "", "threshold": "fC"}
WORDS = {"angle": "angle of incidence", "bz": "magnetic field"}  # others are what they are called
VIEWS = ("X", "V")

_ABOUT = ("charge_fC", "strips", "efficiency")


@dataclass(frozen=True, eq=False, repr=False)
class BeamScan:
    """What a read-out resolves at several values of one quantity.

    Attributes
    ----------
    title : str
        Read-out, beam, and what is fixed.
    quantity : str
        One of `QUANTITIES`.
    values : (n,) float64
        In its unit.
    points : tuple of (BeamPoint, BeamPoint)
        Of X and V at each value.
    """

    title: str
    quantity: str
    values: Floats
    points: tuple[tuple[BeamPoint, BeamPoint], ...]

    @property
    def label(self) -> str:
        """The quantity with its unit, such as ``"drift field  (kV/cm)"``, for an axis."""
        unit = QUANTITIES[self.quantity]
        return WORDS.get(self.quantity, self.quantity.replace("_", " ")) + (f"  ({unit})" if unit else "")

    def of_view(self, view: int, name: str) -> Floats:
        """Return an attribute of `BeamPoint`, such as ``"size"``, in X (0) or V (1), (n,) float64."""
        return np.array([getattr(point[view], name) for point in self.points])

    def curves(self, view: int = 0) -> dict[str, tuple[Floats, Floats]]:
        """Return core widths and their errors in X (0) or V (1), each (n,) float64 um, by estimator."""
        return {
            name: (
                np.array([point[view].widths[name].core for point in self.points]),
                np.array([point[view].widths[name].core_error for point in self.points]),
            )
            for name in self.points[0][view].widths
        }

    def to_csv(self) -> str:
        """Return the text of a CSV file, one row for a value and a view; widths are those of the core, in um."""
        names = list(self.points[0][0].widths)
        unit = QUANTITIES[self.quantity].replace("/", "_per_")
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        head = [f"{self.quantity}_{unit}" if unit else self.quantity, "view", *_ABOUT]
        writer.writerow([*head, *(f"{name}{end}_um" for name in names for end in ("", "_error", "_q68"))])
        for value, views in zip(self.values, self.points, strict=True):
            for view, point in zip(VIEWS, views, strict=True):
                widths = [(one.core, one.core_error, one.q68) for one in (point.widths[name] for name in names)]
                numbers = [point.charge, point.size, point.efficiency, *(number for one in widths for number in one)]
                writer.writerow([f"{value:.6g}", view, *(f"{number:.6g}" for number in numbers)])
        return text.getvalue()

    def draw(self) -> Picture:
        """Draw core widths of the estimators, number of strips and efficiency in both views."""
        from cgemit.draw import ViewCurves, draw_readout

        views = [
            ViewCurves(name, self.curves(view), self.of_view(view, "size"), self.of_view(view, "efficiency"))
            for view, name in enumerate(VIEWS)
        ]
        return draw_readout(self.values, self.label, views, self.title)

    def __repr__(self) -> str:
        names = list(self.points[0][0].widths)
        rows = [
            [f"{value:g}", view, f"{point.charge:.1f}", f"{point.size:.2f}", f"{100 * point.efficiency:.2f}"]
            + [with_error(point.widths[name].core, point.widths[name].core_error) for name in names]
            for view, one in zip(VIEWS, range(2), strict=True)
            for value, point in zip(self.values, (views[one] for views in self.points), strict=True)
        ]
        unit = QUANTITIES[self.quantity]
        first = self.quantity.replace("_", " ") + (f" [{unit}]" if unit else "")
        head = (first, "view", "Q [fC]", "strips", "eff. [%]", *(f"{name} [um]" for name in names))
        return text_table(self.title, head, rows)


def scan(
    readout: Any, quantity: str, values: Sequence[float], *, angle: float = 0.0, bz: float = 1.0, n: int = 4000,
    seed: int = 1, particle: str = "pi-", p: float = 150.0, threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> BeamScan:  # fmt: skip
    """Return what a read-out resolves at several values of one quantity, all else fixed.

    Parameters
    ----------
    readout : AnalogReadout or ProjectionReadout
    quantity : str
        One of `QUANTITIES`.
    values : sequence of float
        In its unit.
    angle : float
        deg, of incidence, positive towards larger phi.
    bz : float
        T.
    n : int
        Particles at each value.
    seed : int
    particle : str
    p : float
        GeV/c.
    threads : int or None
    progress : callable or None
        Called with the fraction done after every value.
    """
    points = []
    for number, value in enumerate(values):
        detector, one, degrees = _setting(readout, quantity, float(value), angle, bz)
        points.append(beam_views(detector, one, degrees, n=n, seed=seed, particle=particle, p=p, threads=threads))
        if progress is not None:
            progress((number + 1) / len(values))
    fixed = [f"{bz:g} T"] * (quantity != "bz") + [f"{angle:g} deg"] * (quantity != "angle")
    title = ", ".join([readout.name, *fixed, f"{particle} of {p:g} GeV/c", f"{n} at each value"])
    return BeamScan(title, quantity, np.array(values, np.float64), tuple(points))


def _setting(readout: Any, quantity: str, value: float, angle: float, bz: float) -> tuple[Detector, Any, float]:
    """Return detector, read-out and angle (deg) of one value."""
    if quantity == "angle":
        angle = float(np.round(value, 9))
    layer = {"drift_field": f"{value!r} kV/cm"} if quantity == "drift_field" else {}
    detector = beam_detector(value if quantity == "bz" else bz, **layer)
    if quantity == "gain":
        readout = replace(readout, gain=value)
    if quantity == "threshold":
        both = {"threshold_x": value, "threshold_v": value}
        readout = replace(readout, **(both if hasattr(readout, "threshold_x") else {"threshold": value}))
    return detector, readout, angle
