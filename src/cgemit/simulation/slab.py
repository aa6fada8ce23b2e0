"""`slab`: particles through plane layers of matter, scattering angles and energy loss."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from html import escape
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Floats
from cgemit.base.errors import Problems, ProblemsError, WrongValueError, did_you_mean
from cgemit.base.validate import NO, Quantity, check_seed, check_whole
from cgemit.detector.build import MaterialNameError, material_named
from cgemit.detector.core import SCREENINGS, compiled_stack
from cgemit.detector.material import Material
from cgemit.particles.species import Species, species
from cgemit.particles.table import FASTEST
from cgemit.tables.show import data_frame
from cgemit.units import NATIVE, QuantityError, parse_quantity

_EXAMPLE = '"Kapton 300 um", "He/C3H8 60/40 16 mm" or "C 2.0 g/cm3 213.5 um"'
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?\s*(?:[^\s\d.+-]\S*)?)")
_FRACTIONS = re.compile(r"\s*((?:\d+\.?\d*|\.\d+)(?:/(?:\d+\.?\d*|\.\d+))+)%?(?=\s|$)")
#: mm. Thinner than an atom is no layer; far below, X/X0 vanishes in the arithmetic.
THINNEST, THICKEST = 1e-9, 1e6
_DENSITIES = (1e-6, 25.0)  # g/cm3, as in detector files


class Layer(NamedTuple):
    """A plane layer: material, thickness in mm, and the default chosen for an incomplete text."""

    material: Material
    thickness: float
    note: str = ""


def parse_stack(text: str, problems: Problems) -> tuple[Layer, ...]:
    """Return the layers that a text describes; add its problems to `problems`.

    Parameters
    ----------
    text : str
        Layers with "+" between them: name of the material (`material_named`), for gases fractions by volume such as
        ``60/40``, a density if it is not the usual one, and the thickness.
    problems : list of Problem
        Added to; their path names the layer and its first character.

    """
    layers = []
    # An exponent such as 1e+3 is not the end of a layer.
    ends = [m.start() for m in re.finditer(r"(?<![\d.][eE])\+", text)]
    starts = [0, *(end + 1 for end in ends)]
    for layer_number, (start, end) in enumerate(zip(starts, [*ends, len(text)], strict=True), 1):
        words = text[start:end]
        column = start + len(words) - len(words.lstrip()) + 1
        layer = _layer(words, f"layer {layer_number}, character {column}", problems)
        if layer:
            layers.append(layer)
    return tuple(layers)


def _layer(part: str, where: str, problems: Problems) -> Layer | None:
    name, _, amount = part.strip().partition(" ")
    if not name:
        problems.note(where, "nothing", f"material and thickness, as {_EXAMPLE}")
        return None
    before = len(problems)
    volumes = None
    fractions = _FRACTIONS.match(amount)
    if fractions:
        volumes = tuple(map(float, fractions[1].split("/")))
        amount = amount[fractions.end() :]
    density, thickness = _numbers(amount, where, problems)
    try:
        material, note = material_named(name, volumes, density)
    except MaterialNameError as error:
        problems.take(error, where)
    return Layer(material, thickness, note) if len(problems) == before else None


def _numbers(text: str, where: str, problems: Problems) -> tuple[float | None, float]:
    """Return density (None if not given) and thickness; 1 for a wrong value, since the name is still to be read."""
    quantities = [match[1] for match in _QUANTITY.finditer(text)]
    if re.sub(r"\s", "", "".join(quantities)) != re.sub(r"\s", "", text) or not 1 <= len(quantities) <= 2:
        given = f'"{text.strip()}" after the material' if text.strip() else "no thickness"
        problems.note(where, given, f"a thickness, before it a density if need be, as {_EXAMPLE}")
        return 1.0, 1.0
    limits = {"density": _DENSITIES, "length": (THINNEST, THICKEST)}
    values = []
    for quantity, dimension in zip(quantities, ("density", "length")[-len(quantities) :], strict=True):
        least, most = limits[dimension]
        values.append(1.0)
        try:
            value = parse_quantity(quantity, dimension)
        except QuantityError as error:
            problems.take(error, where)
            continue
        if least <= value <= most:
            values[-1] = value
        else:
            expected = f"a {dimension} from {least:g} to {most:g} {NATIVE[dimension]}"
            problems.note(where, f'"{quantity.strip()}"', expected)
    return (values[0] if len(values) == 2 else None), values[-1]


class Width(NamedTuple):
    """Half width that holds a fraction of the angles, in units of what it is for a Gaussian of width 1."""

    inside: float
    gaussian: float
    label: str


#: Widths of the plane angle by name.
ANGLES = {
    "q68": Width(math.erf(1 / math.sqrt(2)), 1.0, "q68, half of the central 68.27 %"),
    "q98": Width(0.98, 2.326, "q98, of 98 % / 2.326"),
    "q999": Width(0.999, 3.291, "q999, of 99.9 % / 3.291"),
}
#: Numbers of the loss by name, with their labels.
LOSSES = {
    "mean": "mean",
    "mode": "most probable",
    "fwhm": "full width at half maximum",
    "q01": "1 % quantile",
    "q16": "16 % quantile",
    "q50": "median",
    "q84": "84 % quantile",
    "q99": "99 % quantile",
}
_QUANTILES = {"q01": 0.01, "q16": 0.16, "q50": 0.5, "q84": 0.84, "q99": 0.99}
_FEWEST = 5  # entries beyond a quantile, for it to be quoted
_PARTS = 16  # subsamples whose spread is the error of mode and width at half maximum
_KERNEL = 0.03  # width of the smoothing over the central 68 %: widens a Landau distribution by 1 %

#: Value and standard error; None where the sample does not tell.
Estimate = tuple[float | None, float | None]


def angle_estimates(angle_1: Floats, angle_2: Floats) -> dict[str, Estimate]:
    """Return the widths of `ANGLES` of the angles of both planes, (n,) float64 each, in their unit.

    The two angles of a particle are not independent in the tails; the error counts how many of the two are inside.
    """
    pairs = np.abs(np.stack([angle_1, angle_2]))
    ordered = np.sort(pairs, axis=None)
    estimates: dict[str, Estimate] = {}
    for name, width in ANGLES.items():
        if (1 - width.inside) * ordered.size < _FEWEST:
            estimates[name] = None, None
            continue
        edge = float(np.quantile(ordered, width.inside))
        spread = float(np.std(np.mean(pairs <= edge, axis=0))) / math.sqrt(len(angle_1))
        estimates[name] = edge / width.gaussian, _quantile_error(ordered, width.inside, spread) / width.gaussian
    return estimates


def loss_estimates(loss: Floats) -> dict[str, Estimate]:
    """Return the numbers of `LOSSES` of a sample, (n,) float64, in its unit."""
    ordered = np.sort(loss)
    root = math.sqrt(len(loss))
    estimates: dict[str, Estimate] = {"mean": (float(np.mean(loss)), float(np.std(loss, ddof=1)) / root)}
    for name, fraction in _QUANTILES.items():
        spread = math.sqrt(fraction * (1 - fraction)) / root
        estimates[name] = float(np.quantile(ordered, fraction)), _quantile_error(ordered, fraction, spread)
    estimates |= _peak(loss, *(float(np.quantile(ordered, f)) for f in (0.16, 0.84)))
    return estimates


def _quantile_error(ordered: Floats, fraction: float, spread: float) -> float:
    """Return the standard error of a quantile from that of the fraction below it."""
    low, high = np.quantile(ordered, np.clip([fraction - spread, fraction + spread], 0, 1))
    return float(high - low) / 2


def _peak(loss: Floats, q16: float, q84: float) -> dict[str, Estimate]:
    """Return mode and full width at half maximum of the smoothed distribution, with errors from subsamples."""
    whole = _shape(loss, q16, q84)
    parts = [_shape(loss[i::_PARTS], q16, q84) for i in range(_PARTS)]
    if whole is None or None in parts:
        return {"mode": (None, None), "fwhm": (None, None)}
    errors = np.std([part for part in parts if part], axis=0, ddof=1) / math.sqrt(_PARTS)
    return {name: (whole[i], float(errors[i])) for i, name in enumerate(("mode", "fwhm"))}


def _shape(loss: Floats, q16: float, q84: float) -> tuple[float, float] | None:
    """Return mode and full width at half maximum; None if the distribution has not fallen to half at 0 or far out."""
    step = 0.2 * _KERNEL * (q84 - q16)
    if not step > 0:
        return None
    edges = np.arange(max(0.0, q16 - 2 * (q84 - q16)), q84 + 2 * (q84 - q16), step)
    counts = np.histogram(loss, edges)[0].astype(np.float64)
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / 5) ** 2)
    density = np.convolve(counts, kernel / kernel.sum(), mode="same")
    x = 0.5 * (edges[1:] + edges[:-1])
    above = np.flatnonzero(density >= 0.5 * density.max())
    if above[0] == 0 or above[-1] == len(x) - 1:
        return None
    # The top is flat: its position is the maximum of a curve of fourth order through the logarithm of the upper third.
    top = np.flatnonzero(density > 0.67 * density.max())
    if len(top) < 10:
        return None
    curve = np.polynomial.Polynomial.fit(x[top], np.log(density[top]), 4)
    fine = np.linspace(x[top[0]], x[top[-1]], 1001)
    return float(fine[np.argmax(curve(fine))]), float(x[above[-1]] - x[above[0]])


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

    Plane angles are taken in both planes across the flight together, of the particles that come through: half width
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
        return np.asarray(self.status == _core.common.TransportStatus.outside)

    @property
    def measured(self) -> npt.NDArray[np.bool_]:
        """Whose loss is known, (n,) bool: it is not complete for particles that turned away."""
        stopped = self.status == _core.common.TransportStatus.stopped
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


#: Number of particles: fewer have no 1 % quantile, the columns of more take over 1 GB.
FEWEST, MOST = 1000, 20_000_000
_CHUNK = 20_000
_PIECE = 0.02  # a layer is cut where the particle would lose more of its kinetic energy, or cross more X0, at once
_MOST_PIECES = 100  # of a layer
_STOPPED = 1e-3  # a particle has stopped on average where it has this fraction of its kinetic energy left
_WIDEST = 1e3  # mrad; formulas for small angles are not valid above
_KEV = 1e6  # per GeV


class SlabError(ProblemsError):
    """Bad input about layers of matter; `problems` lists every problem.

    Attributes
    ----------
    source : str
        The function with the bad input.
    problems : tuple of Problem
        Each with `path`, `given`, `expected`, `hint`.
    """


class _Order(NamedTuple):
    """The checked arguments."""

    layers: tuple[Layer, ...]
    kind: Species
    p: float


class _Piece(NamedTuple):
    """A part of a layer that is crossed at one momentum; core angle squared (rad^2) and mean loss (GeV) in it."""

    layer: int
    share: float
    variance: float
    loss: float


def slab(
    matter: str | Sequence[tuple[Material, float]],
    particle: str | int = "mu-",
    p: float | str = 1.0,
    n: int = 200_000,
    seed: int = 1,
    screening: str = "wentzel",
    *,
    progress: Callable[[float], None] | None = None,
) -> SlabResult:
    """Send particles through plane layers of matter at normal incidence and measure their angles and losses.

    Thick layers are cut into pieces that a particle crosses with less than 2 % of its kinetic energy and of X0; the
    part behind the point where it stops on average stays in one piece.

    Parameters
    ----------
    matter : str, or sequence of (Material, float)
        ``"Kapton 300 um + Cu 33 um"``: materials of detector files, elements, chemical formulas, gases
        (``"He/C3H8 60/40 16 mm"``), with a density where it is not the usual one (``"C 2.0 g/cm3 213.5 um"``); or
        materials and thicknesses in mm.
    particle : str or int
        Name or PDG number of a charged particle.
    p : float or str
        Momentum in GeV/c, or with its unit.
    n : int
        Number of particles, 1000 to 20 000 000.
    seed : int
        0 to 2**64 - 1.
    screening : str
        Of nuclei in multiple scattering, ``"wentzel"`` or ``"moliere"`` (docs/methods/matter.md).
    progress : callable or None
        Called with the fraction done.

    Returns
    -------
    SlabResult

    Raises
    ------
    SlabError
        Listing every problem.

    Examples
    --------
    >>> found = cg.slab("Kapton 300 um", "pi-", p=0.5, n=2000)
    >>> round(found.core_mrad, 3), round(found.highland_mrad, 3)
    (0.639, 0.681)
    """
    order = _check(matter, particle, p, n, seed, screening)
    parts = [(layer.material, layer.thickness) for layer in order.layers]
    pieces = _pieces(parts, order, screening)
    cut = [(parts[piece.layer][0], parts[piece.layer][1] * piece.share) for piece in pieces]
    columns = _send(compiled_stack(cut, screening), order, n, seed, progress)
    columns["loss"] *= _KEV
    status = columns["status"]
    through = status == _core.common.TransportStatus.outside
    stopped = status == _core.common.TransportStatus.stopped
    angles = angle_estimates(1e3 * columns["angle_1"][through], 1e3 * columns["angle_2"][through])
    simulated = {f"{name}_mrad": angles[name] for name in ANGLES}
    # The loss of a particle that turned away is not complete.
    losses = loss_estimates(columns["loss"][through | stopped])
    simulated |= {f"loss_kev_{name}": losses[name] for name in LOSSES}
    numbers = {**_by_formula(order, pieces), **{name: value for name, (value, _) in simulated.items()}, **columns}
    return SlabResult(
        matter=_layer_text(matter), particle=order.kind.name, screening=screening, p=order.p, n=n, seed=seed,
        stopped=int(np.sum(stopped)), turned=int(np.sum(~through & ~stopped)), **numbers,
        errors={name: error for name, (_, error) in simulated.items()},
    )  # fmt: skip


def _layer_text(matter: str | Sequence[tuple[Material, float]]) -> str:
    return matter if isinstance(matter, str) else " + ".join(f"{m.name} {length:g} mm" for m, length in matter)


def _check(
    matter: str | Sequence[tuple[Material, float]],
    particle: str | int,
    p: float | str,
    n: int,
    seed: int,
    screening: str,
) -> _Order:
    problems = Problems()
    layers = parse_stack(matter, problems) if isinstance(matter, str) else _layers(matter, problems)
    if not problems and (not layers or not all(THINNEST <= layer.thickness < math.inf for layer in layers)):
        expected = f"layers of {THINNEST:g} mm or more, and finite"
        problems.note("matter", "no layer, or one without thickness", expected)
    kind, momentum = _kind(particle, problems), _momentum(p, problems)
    check_whole("n", n, FEWEST, MOST, problems)
    check_seed(seed, problems)
    if screening not in SCREENINGS:
        expected = "one of " + ", ".join(SCREENINGS)
        problems.note("screening", repr(screening), expected, did_you_mean(str(screening), SCREENINGS))
    problems.report("slab", SlabError)
    return _Order(layers, kind, momentum)


def _layers(matter: object, problems: Problems) -> tuple[Layer, ...]:
    """Return the layers of pairs of material and thickness; anything else is a problem."""
    expected = 'a text such as "Kapton 300 um", or a sequence of (Material, thickness in mm)'
    if not isinstance(matter, Sequence):
        problems.note("matter", repr(matter), expected)
        return ()
    layers = []
    for i, pair in enumerate(matter):
        match pair:
            case (Material() as material, int() | float() | np.number() as thickness) if math.isfinite(thickness):
                layers.append(Layer(material, float(thickness)))
            case _:
                problems.note(f"matter[{i}]", repr(pair), "(Material, thickness in mm)")
    return tuple(layers)


def _kind(particle: str | int, problems: Problems) -> Species:
    try:
        kind = species(particle)
    except WrongValueError as error:
        problems.take(error, "particle")
        return species("mu-")
    if kind.charge == 0:
        problems.note("particle", repr(particle), "a charged particle")
    return kind


def _momentum(p: float | str, problems: Problems) -> float:
    value = Quantity("momentum", 0, FASTEST, above=True).read("p", p, problems)
    return 1.0 if value is NO else float(value)


def _pieces(parts: Sequence[tuple[Material, float]], order: _Order, screening: str) -> list[_Piece]:
    """Cut the layers for a particle with the mean energy loss."""
    whole = compiled_stack(parts, screening)
    mass, charge = order.kind.mass, float(order.kind.charge)
    chi_c2 = _core.matter.total_matter(whole, 0.0)[2]
    start = kinetic = math.hypot(order.p, mass) - mass
    pieces = []
    for i, (material, thickness) in enumerate(parts):
        x0, left = thickness / material.x0, 1.0
        while left > 0:
            if kinetic < _STOPPED * start:
                pieces.append(_Piece(i, left, math.nan, math.nan))
                break
            rate = _mean_loss(whole, i, _momentum_of(kinetic, mass), order.kind, x0)
            most = min(_PIECE * kinetic / max(rate, 1e-300), _PIECE / x0)
            share = min(left, max(most, 1 / _MOST_PIECES))
            share = left if left - share < 1e-9 else share
            loss = min(rate * share, 0.999 * kinetic)
            variance = _core.matter.scattering_angle(
                whole, i, path=share, p=_momentum_of(kinetic - loss / 2, mass), mass=mass, charge=charge,
                track_chi_c2=chi_c2,
            ) ** 2  # fmt: skip
            pieces.append(_Piece(i, share, variance, loss))
            kinetic -= loss
            left = left - share if share < left else 0.0
    return pieces


def _momentum_of(kinetic: float, mass: float) -> float:
    return math.sqrt(kinetic * (kinetic + 2 * mass))


def _mean_loss(whole: _core.detector.Detector, i: int, p: float, kind: Species, x0: float) -> float:
    """Return the mean loss in a layer, GeV, at a momentum; of electrons with radiation, E x/X0."""
    charge = float(kind.charge)
    collisions = _core.matter.restricted_loss(whole, i, path=1.0, p=p, mass=kind.mass, charge=charge, cut=1e9)
    light = abs(kind.pdg) == 11
    return collisions + (math.hypot(p, kind.mass) * x0 if light else 0.0)


def _by_formula(order: _Order, pieces: Sequence[_Piece]) -> dict[str, Any]:
    layers = []
    for i, (material, thickness, note) in enumerate(order.layers):
        variance = sum(piece.variance for piece in pieces if piece.layer == i)
        loss = sum(piece.loss for piece in pieces if piece.layer == i)
        layers.append(
            LayerNumbers(
                material=material.name, note=note, thickness_mm=thickness, density_gcm3=material.density,
                mass_gcm2=0.1 * material.density * thickness, x_over_x0=thickness / material.x0,
                core_mrad=_angle(1e3 * math.sqrt(variance)), mean_loss_kev=_known(_KEV * loss),
            )
        )  # fmt: skip
    x_over_x0 = sum(layer.x_over_x0 for layer in layers)
    energy = math.hypot(order.p, order.kind.mass)
    beta = order.p / energy
    logarithm = 1 + 0.038 * math.log(x_over_x0 / beta**2)
    highland = 13.6 / (beta * order.p) * math.sqrt(x_over_x0) * logarithm
    return {
        "layers": tuple(layers),
        "mass_gcm2": sum(layer.mass_gcm2 for layer in layers),
        "x_over_x0": x_over_x0,
        "highland_mrad": _angle(highland) if logarithm > 0 else None,
        "core_mrad": _angle(1e3 * math.sqrt(sum(piece.variance for piece in pieces))),
        "mean_loss_kev": _known(_KEV * sum(piece.loss for piece in pieces)),
    }


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _angle(value: float) -> float | None:
    return value if value <= _WIDEST else None  # NaN, where the particle stops on average, is None, too


def _send(
    stack: _core.detector.Detector, order: _Order, n: int, seed: int, progress: Callable[[float], None] | None
) -> dict[str, Any]:
    """Return the columns of the core; chunks let Ctrl-C through and do not change the result."""
    charge, parts = float(order.kind.charge), []
    for first in range(0, n, _CHUNK):
        count = min(_CHUNK, n - first)
        parts.append(
            _core.simulation.through_slabs(
                stack, p=order.p, mass=order.kind.mass, charge=charge, n=count, seed=seed, first=first
            )
        )  # fmt: skip
        if progress:
            progress((first + count) / n)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
