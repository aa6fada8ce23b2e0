"""Particle gun: momenta, angles and vertices of the particles that start an event."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from html import escape
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.errors import Problems, WrongValueError, refuse
from cgemit.base.validate import (
    Axes,
    InTurn,
    Spread,
    Value,
    ValueLike,
    Whole,
    check_fields,
    check_numbers,
    check_seed,
    check_whole,
)
from cgemit.particles.records import ParticleError
from cgemit.particles.species import species
from cgemit.particles.table import FARTHEST, FASTEST, Given, read_particles
from cgemit.tables import Table
from cgemit.tables.schema import Array

if TYPE_CHECKING:
    from cgemit.detector import Detector


class Source:
    """Anything that shoots particles; ``source + other`` shoots both in every event.

    Attributes
    ----------
    multiplicity : int
        Most particles in an event; particle numbers of the next source begin there.
    """

    multiplicity: int

    @property
    def kinds(self) -> frozenset[int] | None:
        """Unsigned PDG numbers of the charged particles that may be shot; None if they are not known."""
        return None

    def shoot(self, seed: int, events: npt.NDArray[np.int64], number: int) -> dict[str, Array]:
        """Return the columns of a particles table, rows in any order.

        Parameters
        ----------
        seed : int
        events : ndarray, (n,) int64
        number : int
            Of its first particle in each event.
        """
        raise NotImplementedError

    def within(self, detector: Detector) -> Source:
        """Return the source as it shoots in a detector: itself, unless its particles start in matter."""
        return self

    def __add__(self, other: Source | Guns) -> Guns:
        """Return the sources that shoot together in every event."""
        return Guns((self,)) + other


@dataclass(frozen=True, repr=False)
class Guns:
    """Several sources that shoot in every event, numbered in the order in which they were added.

    Guns of an event share the spread of its vertex (`Gun`); a sample draws the vertex of its events itself.
    """

    guns: tuple[Source, ...]

    @property
    def multiplicity(self) -> int:
        """Most particles in an event."""
        return sum(gun.multiplicity for gun in self.guns)

    @property
    def kinds(self) -> frozenset[int] | None:
        """Unsigned PDG numbers of the charged particles that may be shot; None if they are not known."""
        pdg_numbers: frozenset[int] = frozenset()
        for gun in self.guns:
            if gun.kinds is None:
                return None
            pdg_numbers |= gun.kinds
        return pdg_numbers

    def __add__(self, other: Source | Guns) -> Guns:
        """Return these sources and another one, or others, together."""
        if not isinstance(other, Source | Guns):
            return NotImplemented
        return Guns((*self.guns, *((other,) if isinstance(other, Source) else other.guns)))

    def __repr__(self) -> str:
        return " + ".join(map(repr, self.guns))

    def _repr_html_(self) -> str:
        names = [name for name in _UNITS if any(getattr(gun, name, None) is not None for gun in self.guns)]
        left = 'style="text-align:left"'
        rows = "".join(
            f"<tr><th {left}>{name} {_UNITS[name]}</th>"
            + "".join(f"<td {left}>{escape(_shown(getattr(gun, name, None)))}</td>" for gun in self.guns)
            + "</tr>"
            for name in names
        )
        return f"<p><b>Gun</b></p><table>{rows}</table>"


_UNITS = {
    "name": "", "particle": "", "p": "[GeV/c]", "pt": "[GeV/c]", "theta": "[rad]", "cos_theta": "", "eta": "",
    "phi": "[rad]", "vertex": "[mm]", "vertex_sigma": "[mm]", "vertex_spread": "", "radius": "[mm]",
    "crossing": "[rad]", "multiplicity": "",
}  # fmt: skip


def _shown(value: object) -> str:
    """Return a quantity as text: a fixed value, a range, or values in turn."""
    if isinstance(value, InTurn):
        shown = ", ".join(f"{one:g}" for one in value.values[:6])
        return f"in turn {shown}" + (f" ... ({len(value.values)})" if len(value.values) > 6 else "")
    if isinstance(value, tuple) and len(value) == 2:
        return f"{value[0]:g} to {value[1]:g}"
    if isinstance(value, tuple):
        return ", ".join(map(_shown, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


Momentum = Annotated[ValueLike, Spread("momentum", 0, FASTEST, above=True)] | None
Polar = Annotated[ValueLike, Spread("angle", 0, math.pi)] | None
Cosine = Annotated[ValueLike, Spread("dimensionless", -1, 1)] | None
Pseudorapidity = Annotated[ValueLike, Spread("dimensionless", -10, 10)] | None
Azimuth = Annotated[ValueLike, Spread("angle")]
Point = Annotated[tuple[ValueLike, ValueLike, ValueLike], Axes("length", -FARTHEST, FARTHEST)]
Sizes = Annotated[tuple[ValueLike, ValueLike, ValueLike], Axes("length", 0, FARTHEST)]
Count = Annotated[int, Whole(1, 100_000)]


@dataclass(frozen=True, repr=False)
class Gun(Source):
    """A source of equal particles; ``gun + other`` shoots both in every event.

    For every quantity a number is fixed, a tuple ``(low, high)`` a uniform range, and a list or array the values
    to use in turn: event number `i` gets the value at position ``i modulo length``. Text is read as on the command
    line: ``"200 MeV/c"`` or ``"90 deg"`` is a number, ``"A:B"`` a range, and ``"A,B,C"`` or ``"A:B:COUNT"``, with both
    ends, are values in turn.

    Parameters
    ----------
    particle : str or int
        Name (``"mu-"``, ``"proton"``, ``"K+"``) or number of the Particle Data Group.
    p, pt : GeV/c
        Momentum or transverse momentum: exactly one of them.
    theta, cos_theta, eta : rad, or a pure number
        Polar angle, its cosine or pseudorapidity: exactly one of them. A range is uniform in the one given.
    phi : rad
        Azimuth of the momentum at the vertex.
    vertex : tuple of three, mm
        x, y, z of the vertex; ranges are drawn for each particle.
    vertex_sigma : tuple of three, mm
        Standard deviations of the Gaussian spread added to it.
    vertex_spread : str
        ``"event"``: all particles of an event, also of other guns, have the same spread, as from one beam spot.
        ``"particle"``: each has its own.
    multiplicity : int
        Particles per event; but for the spread of the vertex, each is drawn on its own.

    Raises
    ------
    ParticleError
        Listing every problem.

    Examples
    --------
    >>> gun = cg.Gun("pi+", p=(0.2, 1.0), cos_theta=[-0.5, 0.5]) + cg.Gun("mu-", pt="300 MeV/c", theta="60 deg")
    >>> result = cg.run("besiii-cgem", gun, n=10)
    >>> print(result.particles["pdg"][:4], result.tracks["truth_tanl"][:4].round(2))
    [211  13 211  13] [-0.58  0.58  0.58  0.58]
    """

    particle: str | int
    p: Momentum = None
    pt: Momentum = None
    theta: Polar = None
    cos_theta: Cosine = None
    eta: Pseudorapidity = field(default=None, kw_only=True)
    phi: Azimuth = (-math.pi, math.pi)
    vertex: Point = (0.0, 0.0, 0.0)
    vertex_sigma: Sizes = (0.0, 0.0, 0.0)
    vertex_spread: Literal["event", "particle"] = "event"
    multiplicity: Count = 1

    def __post_init__(self) -> None:
        problems = Problems()
        try:
            object.__setattr__(self, "particle", species(self.particle).name)
        except WrongValueError as error:
            problems.take(error, "particle")
        for names in (("p", "pt"), ("theta", "cos_theta", "eta")):
            given = [name for name in names if getattr(self, name) is not None]
            if len(given) != 1:
                problems.note(", ".join(names), " and ".join(given) or "none", "exactly one of them")
        check_fields(self, problems)
        if self.pt is not None and not problems:
            _check_across(self, problems)
        problems.report("gun", ParticleError)

    @property
    def kinds(self) -> frozenset[int]:
        """Unsigned PDG number of the particle, if it is charged."""
        kind = species(self.particle)
        return frozenset([abs(kind.pdg)] if kind.charge else [])

    def shoot(self, seed: int, events: npt.NDArray[np.int64], number: int) -> dict[str, Array]:
        """Return the columns of a particles table.

        Parameters
        ----------
        seed : int
        events : ndarray, (n,) int64
        number : int
            Of its first particle in each event.
        """
        check_numbers("gun", seed)
        event = np.repeat(events, self.multiplicity)
        particle = np.tile(np.arange(number, number + self.multiplicity, dtype=np.int32), len(events))
        return _shoot(self, _Draws(seed, event, particle))

    def __repr__(self) -> str:
        given = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self)[1:] if getattr(self, f.name) != f.default]
        return f"Gun({', '.join([repr(self.particle), *given])})"

    def _repr_html_(self) -> str:
        return Guns((self,))._repr_html_()


def generate(
    gun: Source | Guns, n_events: int, seed: int, first_event: int = 0, detector: Detector | None = None
) -> Table:
    """Draw the particles of some events.

    A particle depends on the gun, the seed, its event and its number in the event only, so that events can be
    generated in chunks or one by one.

    Parameters
    ----------
    gun : Source or Guns
        A `Gun`, a sample (`cgemit.sample`), or several of them.
    n_events : int
    seed : int
        0 to 2^64 - 1.
    first_event : int
        Number of the first event.
    detector : Detector or None
        In whose matter particles start that do so; None: such a sample is an error.

    Returns
    -------
    Table
        Of kind "particles"; status is 0.

    Raises
    ------
    ParticleError
        If an argument is out of range, or a sample needs a detector.
    """
    guns = gun.guns if isinstance(gun, Guns) else (gun,)
    _check_arguments(guns, n_events, seed, first_event)
    events = np.arange(first_event, first_event + n_events, dtype=np.int64)
    parts, first = [], 0
    for source in guns:
        source = source if detector is None else source.within(detector)
        parts.append(source.shoot(seed, events, first))
        first += source.multiplicity
    for name in {name: None for part in parts for name in part}:  # a column that only some of them have
        for part in parts:
            part.setdefault(name, np.zeros(len(part["event"]), np.int8))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.lexsort((joined["particle"], joined["event"]))
    columns = {name: column[order] for name, column in joined.items()}
    return Table("particles", columns, n_events, first_event, {"gun": repr(gun), "seed": int(seed)})


@dataclass(frozen=True)
class _Draws:
    """The random numbers of some particles; `place` tells a gun's variables apart."""

    seed: int
    event: npt.NDArray[np.int64]
    particle: npt.NDArray[np.int32]

    def uniform(self, place: int, value: ValueLike | None) -> Array:
        """Return one number per particle: the fixed one, one from the range, or the next in turn."""
        value = cast(Value, value)
        if isinstance(value, InTurn):
            return np.array(value.values)[self.event % len(value.values)]
        if isinstance(value, tuple):
            low, high = value
            u = _core.common.uniforms(self.seed, self.event, self.particle, _core.common.Purpose.gun, place)[:, 0]
            return np.asarray(low + (high - low) * u)
        return np.full(len(self.event), value)

    def of_event(self) -> _Draws:
        """Return the same draws for all particles of an event: those of particle 0."""
        return replace(self, particle=np.zeros_like(self.particle))

    def normals(self, place: int) -> Array:
        """Return four standard normal numbers per particle, (n, 4)."""
        return np.asarray(_core.common.normals(self.seed, self.event, self.particle, _core.common.Purpose.gun, place))


# Places of the random streams; part of every stream, so new ones go to the end.
_MOMENTUM, _POLAR, _AZIMUTH, _SPREAD, _VERTEX, _SIGMA = 0, 1, 2, 3, 4, 7


def _shoot(gun: Gun, draws: _Draws) -> dict[str, Array]:
    """Return the columns of one gun's particles."""
    kind = species(gun.particle)
    if gun.cos_theta is not None:
        cos = draws.uniform(_POLAR, gun.cos_theta)
        sin = np.sqrt((1 - cos) * (1 + cos))
    elif gun.eta is not None:
        eta = draws.uniform(_POLAR, gun.eta)
        cos, sin = np.tanh(eta), 1 / np.cosh(eta)
    else:
        theta = draws.uniform(_POLAR, gun.theta)
        cos, sin = np.cos(theta), np.sin(theta)
    size = draws.uniform(_MOMENTUM, gun.p if gun.pt is None else gun.pt)
    p = size if gun.pt is None else size / sin
    phi = draws.uniform(_AZIMUTH, gun.phi)
    pt = p * sin
    rows = len(phi)
    vertex = [draws.uniform(_VERTEX + i, gun.vertex[i]) for i in range(3)]
    if any(sigma != 0.0 for sigma in gun.vertex_sigma):
        spread = draws.of_event() if gun.vertex_spread == "event" else draws
        normals = spread.normals(_SPREAD)
        vertex = [v + spread.uniform(_SIGMA + i, gun.vertex_sigma[i]) * normals[:, i] for i, v in enumerate(vertex)]
    return {
        "event": draws.event,
        "particle": draws.particle,
        "pdg": np.full(rows, kind.pdg, np.int32),
        "charge": np.full(rows, kind.charge, np.int8),
        "mass": np.full(rows, kind.mass),
        **dict(zip("xyz", vertex, strict=True)),
        "px": pt * np.cos(phi),
        "py": pt * np.sin(phi),
        "pz": p * cos,
        "status": np.zeros(rows, np.int8),
    }


def _check_arguments(guns: tuple[Source, ...], n_events: int, seed: int, first_event: int) -> None:
    problems = Problems()
    check_whole("n_events", n_events, 0, 2**31 - 1, problems)
    check_seed(seed, problems)
    check_whole("first_event", first_event, 0, 2**62, problems)
    for source in guns:
        if not isinstance(source, Source):
            problems.note("gun", type(source).__name__, "a Gun")
    problems.report("generate", ParticleError)


def only_kind(source: Source | Guns | None, particles: Table | None = None) -> int | None:
    """Return the unsigned PDG number of all charged particles of a source, or of given ones; None if they differ."""
    kinds = None if source is None else source.kinds
    if particles is not None:
        kinds = frozenset(np.unique(np.abs(particles["pdg"][particles["charge"] != 0])).tolist())
    return next(iter(kinds)) if kinds is not None and len(kinds) == 1 else None


def usual_momentum(source: Source | Guns | None) -> float | None:
    """Return the momentum that is known of the particles of guns, GeV/c; None without a gun.

    The geometric mean of the ends of a range or of the values in turn, and of several guns. With pT, at the middle of
    the polar angles.
    """
    guns = source.guns if isinstance(source, Guns) else (source,)
    if not all(isinstance(gun, Gun) for gun in guns):
        return None
    return math.exp(np.mean([np.mean(np.log(_momenta(gun))) for gun in guns if isinstance(gun, Gun)]))


def _momenta(gun: Gun) -> Array:
    """Return the ends of the range of momenta, the values in turn, or the only one."""
    if gun.p is not None:
        return _ends(gun.p)
    name = next(name for name in ("theta", "cos_theta", "eta") if getattr(gun, name) is not None)
    polar = _ends(getattr(gun, name))
    middle = float(np.mean([polar.min(), polar.max()]))
    sines = {"theta": np.sin(middle), "cos_theta": np.sqrt(max(0.0, 1 - middle**2)), "eta": 1 / np.cosh(middle)}
    return np.asarray(_ends(gun.pt) / sines[name])


def _ends(value: object) -> Array:
    found = value.values if isinstance(value, InTurn) else value
    return np.atleast_1d(np.asarray(found, np.float64))


def _check_across(gun: Gun, problems: Problems) -> None:
    """Note polar angles along z: with a given pT the momentum cannot point there."""
    for name, least, most in (("theta", 0, math.pi), ("cos_theta", -1, 1)):
        value = getattr(gun, name)
        ends = value.values if isinstance(value, InTurn) else value if isinstance(value, tuple) else (value,)
        if value is not None and (min(ends) <= least or max(ends) >= most):
            problems.note(name, repr(value), f"a number between {least:g} and {most:g}, ends excluded with pt")


def source_of(
    gun: Any, n: int | None, charges: Mapping[int, int] | None = None
) -> tuple[Source | Guns | None, int, Table | None, Table | None]:
    """Return the source of the particles, or None, with the number of events; and given particles with their events.

    Parameters
    ----------
    gun : Source, Guns, or what `particles_from` takes
    n : int or None
        Number of events; 1000 for a source if None.
    charges : mapping of int to int, or None
        Of given particles, as in `particles_from`.

    Raises
    ------
    ProblemsError
        If `n` is not the number of events of the particles.
    """
    if isinstance(gun, Source | Guns):
        if charges is not None:
            refuse("run", "charges", repr(charges)[:50], "none for a gun or a sample")
        return gun, 1000 if n is None else n, None, None
    table, events = gun if isinstance(gun, Given) else read_particles(gun, charges=charges)
    if n is not None and n != table.n_events:
        refuse("run", "n", str(n), f"{table.n_events}, the events of the table of particles", "leave n out")
    return None, table.n_events, table, events
