"""Send particles through plane layers of matter."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from cgemit import _core
from cgemit.detector.compile import SCREENINGS, compiled_stack
from cgemit.detector.material import Material
from cgemit.matter.layers import THINNEST, Layer, parse_stack
from cgemit.matter.result import LayerNumbers, SlabResult
from cgemit.matter.widths import ANGLES, LOSSES, angle_estimates, loss_estimates
from cgemit.particles import FASTEST
from cgemit.problems import Problem, ProblemsError, did_you_mean
from cgemit.species import Species, species
from cgemit.units import QuantityError, parse_quantity

#: Number of particles: fewer have no 1 % quantile, the columns of more take over 1 GB.
FEWEST, MOST = 1000, 20_000_000
_CHUNK = 20_000
_PIECE = 0.02  # a layer is cut where the particle would lose more of its kinetic energy, or cross more X0, at once
_MOST_PIECES = 100  # of a layer
_STOPPED = 1e-3  # a particle has stopped on average where it has this fraction of its kinetic energy left
_WIDEST = 1e3  # mrad; formulas for small angles are not valid above
_KEV = 1e6  # per GeV


class SlabError(ProblemsError[Problem]):
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
    """
    order = _check(matter, particle, p, n, seed, screening)
    parts = [(layer.material, layer.thickness) for layer in order.layers]
    pieces = _pieces(parts, order, screening)
    cut = [(parts[piece.layer][0], parts[piece.layer][1] * piece.share) for piece in pieces]
    columns = _send(compiled_stack(cut, screening), order, n, seed, progress)
    columns["loss"] *= _KEV
    status = columns["status"]
    through = status == _core.TransportStatus.outside
    stopped = status == _core.TransportStatus.stopped
    angles = angle_estimates(1e3 * columns["angle_1"][through], 1e3 * columns["angle_2"][through])
    simulated = {f"{name}_mrad": angles[name] for name in ANGLES}
    # The loss of a particle that turned away is not complete.
    losses = loss_estimates(columns["loss"][through | stopped])
    simulated |= {f"loss_kev_{name}": losses[name] for name in LOSSES}
    numbers = {**_by_formula(order, pieces), **{name: value for name, (value, _) in simulated.items()}, **columns}
    return SlabResult(
        matter=_text(matter), particle=order.kind.name, screening=screening, p=order.p, n=n, seed=seed,
        stopped=int(np.sum(stopped)), turned=int(np.sum(~through & ~stopped)), **numbers,
        errors={name: error for name, (_, error) in simulated.items()},
    )  # fmt: skip


def _text(matter: str | Sequence[tuple[Material, float]]) -> str:
    return matter if isinstance(matter, str) else " + ".join(f"{m.name} {length:g} mm" for m, length in matter)


def _check(
    matter: str | Sequence[tuple[Material, float]],
    particle: str | int,
    p: float | str,
    n: int,
    seed: int,
    screening: str,
) -> _Order:
    problems: list[Problem] = []
    layers = parse_stack(matter, problems) if isinstance(matter, str) else _layers(matter, problems)
    if not problems and (not layers or not all(THINNEST <= layer.thickness < math.inf for layer in layers)):
        expected = f"layers of {THINNEST:g} mm or more, and finite"
        problems.append(Problem("matter", "no layer, or one without thickness", expected))
    kind, momentum = _kind(particle, problems), _momentum(p, problems)
    for name, value, least, most in (("n", n, FEWEST, MOST), ("seed", seed, 0, 2**64 - 1)):
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or not least <= value <= most:
            problems.append(Problem(name, repr(value), f"a whole number from {least} to {most}"))
    if screening not in SCREENINGS:
        expected = "one of " + ", ".join(SCREENINGS)
        problems.append(Problem("screening", repr(screening), expected, did_you_mean(str(screening), SCREENINGS)))
    if problems:
        raise SlabError("slab", problems)
    return _Order(layers, kind, momentum)


def _layers(matter: object, problems: list[Problem]) -> tuple[Layer, ...]:
    """Return the layers of pairs of material and thickness; anything else is a problem."""
    expected = 'a text such as "Kapton 300 um", or a sequence of (Material, thickness in mm)'
    if not isinstance(matter, Sequence):
        problems.append(Problem("matter", repr(matter), expected))
        return ()
    found = []
    for number, pair in enumerate(matter):
        match pair:
            case (Material() as material, int() | float() | np.number() as thickness) if math.isfinite(thickness):
                found.append(Layer(material, float(thickness)))
            case _:
                problems.append(Problem(f"matter[{number}]", repr(pair), "(Material, thickness in mm)"))
    return tuple(found)


def _kind(particle: str | int, problems: list[Problem]) -> Species:
    try:
        kind = species(particle)
    except ValueError as error:
        given, _, expected = str(error).removeprefix("got ").partition("; expected ")
        problems.append(Problem("particle", given, expected))
        return species("mu-")
    if kind.charge == 0:
        problems.append(Problem("particle", repr(particle), "a charged particle"))
    return kind


def _momentum(p: float | str, problems: list[Problem]) -> float:
    try:
        value = parse_quantity(p, "momentum") if isinstance(p, str) else float(p)
    except QuantityError as error:
        problems.append(Problem("p", error.given, error.expected, error.hint))
        return 1.0
    except (TypeError, ValueError):
        value = math.nan
    if not 0 < value <= FASTEST:
        problems.append(Problem("p", repr(p), f"a momentum above 0, up to {FASTEST:g} GeV/c"))
    return value


def _pieces(parts: Sequence[tuple[Material, float]], order: _Order, screening: str) -> list[_Piece]:
    """Cut the layers for a particle with the mean energy loss."""
    whole = compiled_stack(parts, screening)
    mass, charge = order.kind.mass, float(order.kind.charge)
    chi_c2 = _core.total_matter(whole, 0.0)[2]
    start = kinetic = math.hypot(order.p, mass) - mass
    found = []
    for number, (material, thickness) in enumerate(parts):
        x0, left = thickness / material.x0, 1.0
        while left > 0:
            if kinetic < _STOPPED * start:
                found.append(_Piece(number, left, math.nan, math.nan))
                break
            rate = _mean_loss(whole, number, _momentum_of(kinetic, mass), order.kind, x0)
            most = min(_PIECE * kinetic / max(rate, 1e-300), _PIECE / x0)
            share = min(left, max(most, 1 / _MOST_PIECES))
            share = left if left - share < 1e-9 else share
            loss = min(rate * share, 0.999 * kinetic)
            variance = _core.scattering_angle(
                whole, number, path=share, p=_momentum_of(kinetic - loss / 2, mass), mass=mass, charge=charge,
                track_chi_c2=chi_c2,
            ) ** 2  # fmt: skip
            found.append(_Piece(number, share, variance, loss))
            kinetic -= loss
            left = left - share if share < left else 0.0
    return found


def _momentum_of(kinetic: float, mass: float) -> float:
    return math.sqrt(kinetic * (kinetic + 2 * mass))


def _mean_loss(whole: _core.Detector, number: int, p: float, kind: Species, x0: float) -> float:
    """Return the mean loss in a layer, GeV, at a momentum; of electrons with radiation, E x/X0."""
    charge = float(kind.charge)
    collisions = _core.restricted_loss(whole, number, path=1.0, p=p, mass=kind.mass, charge=charge, cut=1e9)
    light = abs(kind.pdg) == 11
    return collisions + (math.hypot(p, kind.mass) * x0 if light else 0.0)


def _by_formula(order: _Order, pieces: Sequence[_Piece]) -> dict[str, Any]:
    layers = []
    for number, (material, thickness, note) in enumerate(order.layers):
        variance = sum(piece.variance for piece in pieces if piece.layer == number)
        loss = sum(piece.loss for piece in pieces if piece.layer == number)
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
    stack: _core.Detector, order: _Order, n: int, seed: int, progress: Callable[[float], None] | None
) -> dict[str, Any]:
    """Return the columns of the core; chunks let Ctrl-C through and do not change the result."""
    charge, parts = float(order.kind.charge), []
    for first in range(0, n, _CHUNK):
        count = min(_CHUNK, n - first)
        parts.append(
            _core.through_slabs(
                stack, p=order.p, mass=order.kind.mass, charge=charge, n=count, seed=seed, first=first
            )
        )  # fmt: skip
        if progress:
            progress((first + count) / n)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
