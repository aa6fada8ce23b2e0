"""Numbers of particles behind layers of matter, and their printed form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.matter.widths import ANGLES, LOSSES
from cgemit.tables.convert import data_frame

Floats = npt.NDArray[np.float64]
Row = tuple[str, ...]

_LAYER = ("layer", "mm", "g/cm3", "g/cm2", "X/X0 %", "core mrad", "mean loss keV")


@dataclass(frozen=True)
class LayerNumbers:
    """One layer by formula.

    Attributes
    ----------
    material, note : str
        Name, and the default chosen for an incomplete text.
    thickness_mm, density_gcm3, mass_gcm2, x_over_x0 : float
    core_mrad : float or None
        Share of the fit's core angle; None behind the point where the particle stops on average, and above 1 rad.
    mean_loss_kev : float or None
        Mean energy loss by collisions; None where the particle stops on average.
    """

    material: str
    note: str
    thickness_mm: float
    density_gcm3: float
    mass_gcm2: float
    x_over_x0: float
    core_mrad: float | None
    mean_loss_kev: float | None


@dataclass(frozen=True, eq=False, repr=False)
class SlabResult:
    """Particles through plane layers of matter at normal incidence.

    Plane angles are those of both planes across the flight together, of the particles that come through: half width
    of the central 68.27 %, of 98 % over 2.326 and of 99.9 % over 3.291, which agree for a Gaussian. A width with
    fewer than five entries beyond it is None. Stopped particles count in the losses with their full kinetic energy.

    Attributes
    ----------
    matter, particle, screening : str
    p : float, GeV/c
    n, seed : int
    stopped, turned : int
        Particles that lost all their energy, and that were turned out of the forward direction.
    layers : tuple of LayerNumbers
    mass_gcm2, x_over_x0 : float
    highland_mrad : float or None
        13.6 MeV/(beta p) sqrt(x/X0) [1 + 0.038 ln(x/(X0 beta^2))], PDG 2024, "Passage of particles through matter",
        eq. 34.16; None for so little matter that its logarithm is negative, and above 1 rad.
    core_mrad : float or None
        Core of the distribution that the fit assumes (docs/methods/matter.md); None above 1 rad.
    mean_loss_kev : float or None
        Mean loss by collisions by formula, with that by radiation for electrons.
    q68_mrad, q98_mrad, q999_mrad : float or None
    loss_kev_mean, loss_kev_q01, loss_kev_q16, loss_kev_q50, loss_kev_q84, loss_kev_q99 : float
    loss_kev_mode, loss_kev_fwhm : float or None
        Maximum of the distribution and its full width at half of it; None where it has no such shape.
    errors : dict of str to float or None
        Standard errors of the simulated numbers, by their names.
    angle_1, angle_2 : (n,) ndarray of float64, rad
        Plane angles; of particles that do not come through, those at their end point.
    shift_1, shift_2 : (n,) ndarray of float64, mm
        Displacements behind the last layer, of particles that do not come through, at their end point.
    loss : (n,) ndarray of float64, keV
    status : (n,) ndarray of int8
        `TransportStatus`: outside, stopped or curled.
    """

    matter: str
    particle: str
    screening: str
    p: float
    n: int
    seed: int
    stopped: int
    turned: int
    layers: tuple[LayerNumbers, ...]
    mass_gcm2: float
    x_over_x0: float
    highland_mrad: float | None
    core_mrad: float | None
    mean_loss_kev: float | None
    q68_mrad: float | None
    q98_mrad: float | None
    q999_mrad: float | None
    loss_kev_mean: float
    loss_kev_q01: float
    loss_kev_q16: float
    loss_kev_q50: float
    loss_kev_q84: float
    loss_kev_q99: float
    loss_kev_mode: float | None
    loss_kev_fwhm: float | None
    errors: dict[str, float | None]
    angle_1: Floats
    angle_2: Floats
    shift_1: Floats
    shift_2: Floats
    loss: Floats
    status: npt.NDArray[np.int8]

    @property
    def through(self) -> npt.NDArray[np.bool_]:
        """Which particles came through, (n,) bool."""
        return np.asarray(self.status == _core.TransportStatus.outside)

    @property
    def measured(self) -> npt.NDArray[np.bool_]:
        """Whose loss is known, (n,) bool: it is not complete for particles that turned away."""
        stopped = self.status == _core.TransportStatus.stopped
        return np.asarray(self.through | stopped)

    def to_dict(self) -> dict[str, Any]:
        """Return all numbers but the columns, ready for JSON."""
        names = [field.name for field in fields(self)]
        plain = {name: getattr(self, name) for name in names[: names.index("angle_1")]}
        plain["layers"] = [{f.name: getattr(layer, f.name) for f in fields(layer)} for layer in self.layers]
        return plain

    def to_pandas(self) -> Any:
        """Return the particles, one row each, as a `pandas.DataFrame`: columns of angles, shifts, loss and status."""
        names = ("angle_1", "angle_2", "shift_1", "shift_2", "loss", "status")
        return data_frame({name: getattr(self, name) for name in names})

    def tables(self) -> list[tuple[tuple[str, ...], list[Row]]]:
        """Return the printed tables: heads and rows of the layers, of the angles and of the losses."""
        angles = [("Highland (PDG 34.16)", _text(self.highland_mrad), "")]
        angles.append(("core, as the fit takes it", _text(self.core_mrad), ""))
        angles += [(width.label, *self.number(f"{name}_mrad")) for name, width in ANGLES.items()]
        losses = [("mean by formula", _text(self.mean_loss_kev), "")]
        losses += [(label, *self.number(f"loss_kev_{name}")) for name, label in LOSSES.items()]
        heads = (_LAYER, ("plane angle", "mrad", "error"), ("energy loss", "keV", "error"))
        return list(zip(heads, (self._layer_rows(), [*angles], [*losses]), strict=True))

    def _layer_rows(self) -> list[Row]:
        rows: list[Row] = []
        for s in self.layers:
            size = (s.material, f"{s.thickness_mm:.6g}", f"{s.density_gcm3:.4g}", f"{s.mass_gcm2:.4g}")
            rows.append((*size, f"{100 * s.x_over_x0:.4g}", _text(s.core_mrad), _text(s.mean_loss_kev)))
        if len(rows) > 1:
            total = ("all", "", "", f"{self.mass_gcm2:.4g}", f"{100 * self.x_over_x0:.4g}")
            rows.append((*total, _text(self.core_mrad), _text(self.mean_loss_kev)))
        return rows

    def number(self, name: str) -> tuple[str, str]:
        """Return the simulated number of a name to two digits of its error, and the error, as text."""
        value, error = getattr(self, name), self.errors[name]
        if error is None or error <= 1e-9 * value:  # rounding, where all particles lose the same
            return _text(value), "-" if error is None else "0"
        digits = max(0, 1 - math.floor(math.log10(error)))
        return f"{value:.{digits}f}", f"{error:.{digits}f}"

    def title(self) -> str:
        """Return particle, matter, number, seed and screening in two lines."""
        removed = ", ".join(f"{n:,} {what}" for n, what in ((self.stopped, "stopped"), (self.turned, "turned away")))
        return (
            f"{self.particle} of {self.p:g} GeV/c through {self.matter}\n"
            f"{self.n:,} particles ({removed}), seed {self.seed}, screening {self.screening}"
        )

    def notes(self) -> list[str]:
        """Return the defaults chosen for an incomplete text."""
        return [f"{s.material}: {s.note}" for s in self.layers if s.note]

    def __repr__(self) -> str:
        blocks = ["\n".join([self.title(), *self.notes()])]
        return "\n\n".join([*blocks, *("\n".join(_lines(head, rows)) for head, rows in self.tables())])

    def _repr_html_(self) -> str:
        parts = [f"<p>{escape(line)}</p>" for line in [*self.title().splitlines(), *self.notes()]]
        for head, rows in self.tables():
            cells = "".join(f"<th>{escape(cell)}</th>" for cell in head)
            lines = ("".join(f"<td>{escape(cell)}</td>" for cell in row) for row in rows)
            parts.append(f"<table><tr>{cells}</tr>{''.join(f'<tr>{line}</tr>' for line in lines)}</table>")
        return "".join(parts)


def _text(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"


def _lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table as lines: the first column to the left, numbers to the right."""
    cells = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]).rstrip()
        for row in cells
    ]
