"""Samples of physics events, which `cgemit.run` takes like a gun (docs/methods/samples.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.base.errors import Problem, Problems, did_you_mean
from cgemit.base.validate import Axes, InTurn, Quantity, Spread, Value, ValueLike, check_numbers, entries
from cgemit.detector import Detector
from cgemit.detector.matter import slabs
from cgemit.particles.decay_chains import DEFINITIONS, NAMES, SHOT, Draws, Particles, decay_all, directions, mass_of
from cgemit.particles.gun import Guns, Source
from cgemit.particles.records import ParticleError
from cgemit.particles.species import species
from cgemit.particles.table import FARTHEST, FASTEST
from cgemit.tables.schema import Array

#: Of the flux of background with the radius, as that of clusters in the levels of the presets.
POWER = -2.2
FARTHEST_Z = 400.0  # mm, where particles start


@dataclass(frozen=True, eq=False)
class Matter:
    """Shells of matter, and how often particles start in each.

    Attributes
    ----------
    r_in, r_out : ndarray, (n,) float64
        mm.
    z_min, z_max : ndarray, (n,) float64
        mm, up to `FARTHEST_Z` from the origin.
    shares : ndarray, (n,) float64
        Of the particles: X/X0 times the area times the flux at the shell's middle, with a sum of 1.
    """

    r_in: Floats
    r_out: Floats
    z_min: Floats
    z_max: Floats
    shares: Floats

    def points(self, u: Floats) -> Floats:
        """Return points (x, y, z), (n, 3) mm, for numbers uniform from 0 to 1, (n, 4)."""
        shell = np.searchsorted(np.cumsum(self.shares)[:-1], u[:, 0], side="right")
        inner, outer = self.r_in[shell] ** 2, self.r_out[shell] ** 2
        r, turn = np.sqrt(inner + (outer - inner) * u[:, 1]), 2 * np.pi * u[:, 2]
        middle, half = 0.5 * (self.z_min + self.z_max), 0.5 * (self.z_max - self.z_min)
        z = middle[shell] + half[shell] * (2 * u[:, 3] - 1)
        return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def matter_of(detector: Detector) -> Matter:
    """Return the matter of a detector, from the beam pipe outward."""
    shells = [shell for slab in slabs(detector, merge=False) for shell in slab.shells]
    r_in, r_out, low, high, x0 = np.array([(s.r_in, s.r_out, *s.ends, s.x0) for s in shells]).T
    low, high = np.maximum(low, -FARTHEST_Z), np.minimum(high, FARTHEST_Z)
    r = 0.5 * (r_in + r_out)
    weight = x0 * r * (0.5 * (high - low)) * r**POWER
    return Matter(r_in, r_out, low, high, weight / weight.sum())


_Triple = tuple[ValueLike, ValueLike, ValueLike]

#: Of cosmic muons, mu+ among all: a charge ratio of 1.28 (PDG, Cosmic Rays, 2024).
_POSITIVE = 0.561


@dataclass(frozen=True, repr=False)
class EventSample(Source):
    """Events of a named sample; `sample` makes them.

    Attributes
    ----------
    name : str
        One of `cgemit.samples.NAMES`.
    p, cos_theta, phi : GeV/c, a pure number, rad
        Of the particles that are shot; None for samples of colliding beams.
    vertex, vertex_sigma : tuple of three, mm
        Where they start, and its Gaussian spread.
    radius : mm
        Distance from `vertex` across the beam, in a random direction, for each particle; None for samples whose
        particles start together.
    crossing : rad
        Angle at which the beams cross, in the x-z plane; None for samples that are shot.

    Raises
    ------
    ParticleError
        Listing every problem.

    Examples
    --------
    >>> muons = cg.sample("cosmic", p=(2.0, 5.0))
    >>> muons.name, muons.p
    ('cosmic', (2.0, 5.0))
    """

    name: str
    p: ValueLike | None = None
    cos_theta: ValueLike | None = None
    phi: ValueLike | None = None
    vertex: _Triple | None = None
    vertex_sigma: _Triple | None = None
    radius: ValueLike | None = None
    crossing: ValueLike | None = None

    def __post_init__(self) -> None:
        if self.name not in DEFINITIONS:
            hint = did_you_mean(str(self.name), NAMES)
            raise ParticleError("sample", [Problem("name", f"{self.name!r:.50}", f"one of {', '.join(NAMES)}", hint)])
        problems = Problems()
        defaults = DEFINITIONS[self.name].options
        for name, constraint in _OPTIONS.items():
            stated = getattr(self, name)
            if name in defaults:
                value = constraint.read(name, defaults[name] if stated is None else stated, problems)
                object.__setattr__(self, name, value)
            elif stated is not None:
                problems.note(name, f"{stated!r:.50}", f"none, this sample has {', '.join(defaults)}")
        problems.report(f"sample {self.name}", ParticleError)

    @property
    def multiplicity(self) -> int:  # type: ignore[override]
        """Most particles in an event."""
        return DEFINITIONS[self.name].multiplicity

    @property
    def kinds(self) -> frozenset[int]:
        """Unsigned PDG numbers of the charged particles at the end of all decays."""
        definition = DEFINITIONS[self.name]
        ends: set[int] = set()
        left, seen = list(definition.first), set(definition.first)
        while left:
            name = left.pop()
            if name not in definition.modes:
                kind = species(name)
                ends |= {abs(kind.pdg)} if kind.charge else set()
            products = {one for mode in definition.modes.get(name, ()) for one in mode.products}
            left += sorted(products - seen)
            seen |= products
        return frozenset(ends)

    @property
    def text(self) -> str:
        """What the events are."""
        return DEFINITIONS[self.name].text

    def options(self) -> dict[str, Any]:
        """Return the options that the sample has, and their values."""
        return {name: getattr(self, name) for name in DEFINITIONS[self.name].options}

    def shoot(self, seed: int, events: npt.NDArray[np.int64], number: int) -> dict[str, Array]:
        """Return the columns of a particles table.

        Parameters
        ----------
        seed : int
        events : ndarray, (n,) int64
        number : int
            Of its first particle in each event.
        """
        check_numbers("sample", seed)
        return self._shoot(seed, events, number, None)

    def within(self, detector: Detector) -> Source:
        """Return the sample as it shoots in a detector."""
        return _Within(self, matter_of(detector)) if DEFINITIONS[self.name].in_matter else self

    def _shoot(self, seed: int, events: npt.NDArray[np.int64], number: int, matter: Matter | None) -> dict[str, Array]:
        if matter is None and DEFINITIONS[self.name].in_matter:
            problem = Problem("detector", "none", "one, since its particles start in matter")
            raise ParticleError(f"sample {self.name}", [problem])
        draws = Draws(seed, number)
        if self.name == "cosmic":
            columns = _columns(_cosmic(self, events, draws), number)
            return {**columns, "backward": (columns["particle"] == number).astype(np.int8)}
        definition = DEFINITIONS[self.name]
        first = [
            (name, self._first(name, place, events, draws, matter))
            for place, name in enumerate(definition.first, start=1)
        ]
        return _columns(decay_all(first, definition.modes, draws), number)

    def _first(
        self, name: str, node: int, events: npt.NDArray[np.int64], draws: Draws, matter: Matter | None
    ) -> Particles:
        """Return the first particles of the events, one each."""
        n, mass = len(events), mass_of(name)
        start = Particles(events, node, np.full(n, mass), np.zeros((n, 4)), np.zeros((n, 3)))
        vertex, u = _vertex(self, start, draws), draws.uniforms(start, SHOT, 3)
        if matter is not None:
            vertex = vertex + matter.points(draws.uniforms(start, SHOT + 4, 4))
        if self.crossing is not None:
            # Two beams of equal energy E: px = 2 E sin(angle/2), M = 2 E cos(angle/2).
            half = 0.5 * _one(self.crossing, events, u[:, 0])
            flight = np.stack([mass * np.tan(half), np.zeros(n), np.zeros(n)], axis=1)
        else:
            p, cos, phi = (_one(value, events, u[:, i]) for i, value in enumerate((self.p, self.cos_theta, self.phi)))
            flight = p[:, None] * directions(cos, phi)
        energy = np.sqrt(mass**2 + np.sum(flight**2, axis=1))
        return Particles(events, start.node, start.mass, np.concatenate([flight, energy[:, None]], axis=1), vertex)

    def __repr__(self) -> str:
        defaults = DEFINITIONS[self.name].options
        given = [f"{name}={value!r}" for name, value in self.options().items() if value != defaults[name]]
        return f"sample({', '.join([repr(self.name), *given])})"

    def _repr_html_(self) -> str:
        return Guns((self,))._repr_html_()


@dataclass(frozen=True)
class _Within(Source):
    """A sample whose particles start in the matter of a detector."""

    sample: EventSample
    matter: Matter

    @property
    def multiplicity(self) -> int:  # type: ignore[override]
        return self.sample.multiplicity

    def shoot(self, seed: int, events: npt.NDArray[np.int64], number: int) -> dict[str, Array]:
        check_numbers("sample", seed)
        return self.sample._shoot(seed, events, number, self.matter)


def sample(name: str, **options: Any) -> EventSample:
    """Return events of a sample, for `cgemit.run` in place of a gun; ``sample + gun`` shoots both.

    Parameters
    ----------
    name : str
        ``"jpsi-rhopi"``, ``"pipi-jpsi"``, ``"d0-d0bar"``: colliding beams at the mass of a resonance.
        ``"ks-pipi"``, ``"lambda-ppi"``: decays with flight. ``"slow-pions"``: a pair. ``"cosmic"``: two halves of a
        muon from above. ``"beam-gas"``, ``"touschek"``, ``"electrons"``: particles of the background, to be added;
        electrons start in the matter of the detector.
    **options
        `vertex`, `vertex_sigma`, `radius` (mm); `crossing` (rad) of the beams; `p` (GeV/c), `cos_theta` and
        `phi` (rad) of particles that are shot. Numbers, ranges and values in turn as of `Gun`.

    Returns
    -------
    EventSample

    Raises
    ------
    ParticleError
        A ValueError that lists every problem.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("ks-pipi"), n=10)
    >>> np.unique(result.particles["pdg"]).tolist()
    [-211, 211]
    """
    known = [f.name for f in fields(EventSample)][1:]
    problems = Problems()
    entries(options, "", known, problems)
    problems.report(f"sample {name}", ParticleError)
    return EventSample(name, **options)


def _columns(by_species: dict[str, list[Particles]], first: int) -> dict[str, Array]:
    """Return the columns of a particles table; particles of an event are numbered in the order of the chain."""
    groups = [(species(name), one) for name, several in by_species.items() for one in several]

    def joined(values: list[Any], dtype: str) -> Array:
        return np.concatenate(
            [np.broadcast_to(v, len(one.event)) for v, (_, one) in zip(values, groups, strict=True)]
        ).astype(dtype)

    event, node = (joined([getattr(one, name) for _, one in groups], "i8") for name in ("event", "node"))
    order = np.lexsort((node, event))
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order)) - np.searchsorted(event[order], event[order])
    columns = {"event": event, "particle": (first + rank).astype(np.int32)}
    for name, dtype in (("pdg", "i4"), ("charge", "i1"), ("mass", "f8")):
        columns[name] = joined([getattr(kind, name) for kind, _ in groups], dtype)
    for i, name in enumerate("xyz"):
        columns[name] = joined([one.vertex[:, i] for _, one in groups], "f8")
    for i, name in enumerate(("px", "py", "pz")):
        columns[name] = joined([one.momentum[:, i] for _, one in groups], "f8")
    return {**columns, "status": np.zeros(len(event), np.int8)}


def _cosmic(of: EventSample, events: npt.NDArray[np.int64], draws: Draws) -> dict[str, list[Particles]]:
    """Return both halves of muons from above, with y up, as particles that leave the same point.

    The zenith angle has the density cos^2. The upper half is the muon flown backward (column `backward`): the opposite
    charge and momentum, and hits before the two halves meet.
    """
    n = len(events)
    lower = Particles(events, 2, np.full(n, mass_of("mu-")), np.zeros((n, 4)), np.zeros((n, 3)))
    u = draws.uniforms(lower, SHOT, 4)
    p = _one(of.p, events, u[:, 0])
    across = directions(u[:, 1] ** (1 / 3), 2 * np.pi * u[:, 2])
    flight = p[:, None] * np.stack([across[:, 1], -across[:, 2], across[:, 0]], axis=1)
    vertex, energy = _vertex(of, lower, draws), np.hypot(p, mass_of("mu-"))
    down, up = (np.concatenate([sign * flight, energy[:, None]], axis=1) for sign in (1, -1))
    positive = u[:, 3] < _POSITIVE
    halves = {}
    for name, is_lower in (("mu+", positive), ("mu-", ~positive)):
        rows, other_rows = np.flatnonzero(is_lower), np.flatnonzero(~is_lower)
        halves[name] = [
            Particles(events[rows], 2, lower.mass[rows], down[rows], vertex[rows]),
            Particles(events[other_rows], 1, lower.mass[other_rows], up[other_rows], vertex[other_rows]),
        ]
    return halves


def _vertex(of: EventSample, start: Particles, draws: Draws) -> Floats:
    """Return where the first particles start, (n, 3) mm: the same for all of an event."""
    apart = of.radius is not None
    same = start if apart else replace(start, node=0)
    u = draws.uniforms(same, SHOT + 1, 10)
    radius, turn = np.sqrt(-2 * np.log(u[:, :2])), 2 * np.pi * u[:, 2:4]
    normal = np.stack(
        [radius[:, 0] * np.cos(turn[:, 0]), radius[:, 0] * np.sin(turn[:, 0]), radius[:, 1] * np.cos(turn[:, 1])]
    )
    middle, sigma = cast(Any, of.vertex), cast(Any, of.vertex_sigma)
    along = [
        _one(middle[i], start.event, u[:, 4 + i]) + _one(sigma[i], start.event, u[:, 7 + i]) * normal[i]
        for i in range(3)
    ]
    if apart:
        u = draws.uniforms(same, SHOT + 4, 2)
        r, turn = _one(of.radius, start.event, u[:, 0]), 2 * np.pi * u[:, 1]
        along[0], along[1] = along[0] + r * np.cos(turn), along[1] + r * np.sin(turn)
    return np.stack(along, axis=1)


def _one(value: ValueLike | None, events: npt.NDArray[np.int64], uniform: Floats) -> Floats:
    """Return one number for each event: the fixed one, one of the range, or the next in turn."""
    value = cast(Value, value)
    if isinstance(value, InTurn):
        return np.array(value.values)[events % len(value.values)]
    if isinstance(value, tuple):
        return np.asarray(value[0] + (value[1] - value[0]) * uniform)
    return np.full(len(events), float(value))


_OPTIONS: Mapping[str, Quantity] = {
    "p": Spread("momentum", 0, FASTEST, above=True),
    "cos_theta": Spread("dimensionless", -1, 1),
    "phi": Spread("angle"),
    "radius": Spread("length", 0, FARTHEST),
    "crossing": Spread("angle", -1, 1),
    "vertex": Axes("length", -FARTHEST, FARTHEST),
    "vertex_sigma": Axes("length", 0, FARTHEST),
}
