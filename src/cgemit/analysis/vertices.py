"""Fitted vertices against true ones, and masses of pairs with electrons."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats, Rows
from cgemit.particles.species import KNOWN
from cgemit.tables import Table
from cgemit.tables.check import refuse_wrong
from cgemit.tables.show import Shown, Tabular
from cgemit.truth.match import joined

_QUANTITIES = ("x", "y", "z", "mass")


def with_truth(vertices: Table, tracks: Table, matches: Table, particles: Table) -> Table:
    """Return vertices with true values, residuals and pulls.

    Parameters
    ----------
    vertices, tracks, matches, particles : Table
        Of the same run. `tracks` may hold the matches already.

    Returns
    -------
    Table of kind "vertices"
        With the columns `truth_`, `res_` and `pull_` of x, y, z (mm) and mass (GeV/c2); NaN where the two tracks are
        not of two particles from one point. The mass is that of the true momenta with the particles' own masses.

    Raises
    ------
    ValueError
        If a table has wrong values or links.
    """
    refuse_wrong("with_truth", vertices=vertices, tracks=tracks, matches=matches, particles=particles)
    tracks = tracks if "truth_dr" in tracks else joined(tracks, matches)
    rows = [_particle_rows(tracks, particles, vertices[name]) for name in ("first", "second")]
    known = (rows[0] >= 0) & (rows[1] >= 0) & (rows[0] != rows[1])
    first, second = (np.where(known, one, 0) for one in rows)
    truth = {}
    for axis in "xyz":
        known &= particles[axis][first] == particles[axis][second]
        truth[axis] = particles[axis][first]
    total = [sum(particles[name][one] for one in (first, second)) for name in ("px", "py", "pz")]
    energy = sum(
        np.sqrt(sum(particles[name][one] ** 2 for name in ("px", "py", "pz", "mass"))) for one in (first, second)
    )
    truth["mass"] = np.sqrt(np.maximum(energy**2 - sum(p**2 for p in total), 0.0))
    columns: dict[str, np.ndarray] = {}
    for name in _QUANTITIES:
        true = np.where(known, truth[name], np.nan)
        residual = vertices[name] - true
        columns |= {f"truth_{name}": true, f"res_{name}": residual, f"pull_{name}": residual / vertices[f"err_{name}"]}
    return vertices.with_columns(**columns)


def _particle_rows(tracks: Table, particles: Table, row: np.ndarray) -> np.ndarray:
    """Return the row of the particle behind each track; -1 for none."""
    span = int(particles["particle"].max(initial=0)) + 1
    first = particles.first_event
    known = (particles["event"] - first) * span + particles["particle"]
    key = (tracks["event"][row] - first) * span + tracks["particle"][row]
    order = np.argsort(known, kind="stable")
    place = order[np.minimum(np.searchsorted(known, key, sorter=order), max(len(known) - 1, 0))]
    return np.where((tracks["particle"][row] >= 0) & (known[place] == key), place, -1)


#: Probabilities of the limits of `PairMasses`.
_LIMITS = {"low95": 0.025, "low": 0.16, "high": 0.84, "high95": 0.975}
_HALVINGS = 24  # of an interval of ln m, down to 1e-7 of it


class _Density(NamedTuple):
    """Sum of normal distributions of ln m for each pair: (pairs, k) each; weights sum to 1."""

    weight: Floats
    mean: Floats
    sigma: Floats

    def below(self, at: Floats) -> Floats:
        """Return the probability below ln m, (pairs,) for `at` (pairs,)."""
        from scipy.special import ndtr

        return np.asarray((self.weight * ndtr((at[:, None] - self.mean) / self.sigma)).sum(axis=1))

    def quantile(self, probability: float) -> Floats:
        """Return ln m below which a probability lies, (pairs,)."""
        low = (self.mean - 9 * self.sigma).min(axis=1, initial=np.inf)
        high = (self.mean + 9 * self.sigma).max(axis=1, initial=-np.inf)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            above = self.below(middle) > probability
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return np.asarray(0.5 * (low + high))

    def mode(self) -> Floats:
        """Return ln m where m is densest, of 201 points within four deviations of the heaviest component, (pairs,)."""
        rows, heaviest = np.arange(len(self.weight)), self.weight.argmax(axis=1)
        at = self.mean[rows, heaviest][:, None] + np.linspace(-4, 4, 201) * self.sigma[rows, heaviest][:, None]
        density = np.zeros_like(at)
        for k in range(self.weight.shape[1]):
            pull = (at - self.mean[:, k, None]) / self.sigma[:, k, None]
            density += (self.weight / self.sigma)[:, k, None] * np.exp(-0.5 * pull**2 - at)
        return np.asarray(at[rows, density.argmax(axis=1)])


@dataclass(frozen=True, eq=False, repr=False)
class PairMasses(Shown, Tabular):
    """Densities of the masses of pairs of tracks, of which electrons may have radiated.

    Attributes
    ----------
    mass : ndarray, (pairs,) float64, GeV/c2
        Most probable mass; NaN, like all others, where the vertex has none.
    low, high, low95, high95 : ndarray, (pairs,) float64, GeV/c2
        Limits of the central 68 and 95 %.
    radiated : ndarray, (pairs,) float64
        Probability that one of the tracks has lost energy visibly.

    Examples
    --------
    >>> pair = cg.Gun("e+", p=1.5, cos_theta=0.0, phi=0.0) + cg.Gun("e-", p=1.5, cos_theta=0.0, phi=3.0)
    >>> how = cg.Settings(fit=cg.FitSettings(components=True))
    >>> result = cg.run("besiii-cgem", pair, n=20, settings=how)
    >>> vertices = cg.fit_vertices(result.detector, result.fitted, particles=("e", "e"))
    >>> masses = cg.study.pair_masses(vertices, result.fitted, result.tables["components"])
    >>> bool((masses.low < masses.high).all()), len(masses.below(3.0))
    (True, 20)
    """

    mass: Floats
    low: Floats
    high: Floats
    low95: Floats
    high95: Floats
    radiated: Floats
    _density: _Density = field(repr=False)
    _known: npt.NDArray[np.bool_] = field(repr=False)

    def below(self, mass: npt.ArrayLike) -> Floats:
        """Return the probability that the mass of each pair is below another one.

        Parameters
        ----------
        mass : array_like, () or (pairs,), GeV/c2

        Returns
        -------
        ndarray, (pairs,) float64
        """
        at = np.broadcast_to(np.asarray(mass, np.float64), self.mass.shape)[self._known]
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self._density.below(np.log(at))
        return _spread(found, self._known)

    def columns(self) -> dict[str, list[float]]:
        """Return mass, limits and probability of radiation, one row for each pair."""
        names = ("mass", "low", "high", "low95", "high95", "radiated")
        return {name: getattr(self, name).tolist() for name in names}

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        most = 10
        rows = [[f"{value:.5g}" for value in row] for row in list(zip(*self.columns().values(), strict=True))[:most]]
        return f"masses of {len(self.mass)} pairs (GeV/c2)", list(self.columns()), rows

    def note(self) -> str:
        """Return how many pairs are not shown."""
        more = len(self.mass) - 10
        return f"and {more} more" if more > 0 else ""


def pair_masses(vertices: Table, tracks: Table, components: Table | None = None) -> PairMasses:
    """Return the densities of the masses of pairs, of which electrons may have radiated.

    With the components of ln(p/p_fit) of both tracks, each combination of two has the mass of the changed momenta at
    the same angle, and the variance of ln m of the vertex fit, in which the variance of ln p of the component stands
    for that of the track: d ln m/d ln p_1 = (p_1^2 E_2/E_1 - p_1 p_2)/m^2. Valid where angles do not depend on the
    momenta, as in a vertex close to the beam line.

    Parameters
    ----------
    vertices : Table of kind "vertices"
    tracks : Table of kind "tracks"
        That the vertices are of.
    components : Table of kind "components", or None
        Of these tracks (``FitSettings(components=True)``). Tracks without components have a normal density.

    Raises
    ------
    ValueError
        If a table has wrong values or links.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.sample("ks-pipi"), n=20)
    >>> vertices = cg.fit_vertices(result.detector, result.fitted)
    >>> masses = cg.study.pair_masses(vertices, result.fitted)
    >>> bool(abs(masses.mass[0] / vertices["mass"][0] - 1) < 0.001)
    True
    """
    given = {} if components is None else {"components": components}
    refuse_wrong("pair_masses", vertices=vertices, tracks=tracks, **given)
    known = (vertices["status"] == 0) & np.isfinite(vertices["err_mass"]) & (vertices["mass"] > 0)
    pairs = vertices[known]
    density = _pair_density(pairs, tracks, *(_components_of(pairs[name], tracks, components) for name in _TRACKS))
    limits = {name: _spread(np.exp(density.quantile(share)), known) for name, share in _LIMITS.items()}
    quiet = np.ones(len(pairs))
    for name in _TRACKS:
        quiet *= 1 - np.nan_to_num(tracks["radiated"][pairs[name]])
    mode, radiated = _spread(np.exp(density.mode()), known), _spread(1 - quiet, known)
    return PairMasses(mass=mode, radiated=radiated, _density=density, _known=known, **limits)


_TRACKS = ("first", "second")


def _spread(values: Floats, known: npt.NDArray[np.bool_]) -> Floats:
    """Return values of the known pairs among all; NaN elsewhere."""
    every = np.full(len(known), np.nan)
    every[known] = values
    return every


def _components_of(rows: Rows, tracks: Table, components: Table | None) -> _Density:
    """Return the density of ln(p/p_fit) of some tracks; a normal one for those without components."""
    relative = (tracks["err_p"] / tracks["p"])[rows]
    if components is None or not len(components):
        one = np.ones((len(rows), 1))
        return _Density(one, 0 * one, relative[:, None])
    count = np.bincount(components["track"], minlength=len(tracks))
    place = np.arange(len(components)) - np.repeat(np.cumsum(count) - count, count)
    order = np.argsort(components["track"], kind="stable")
    columns = {}
    for name, none in (("weight", 0.0), ("change", 0.0), ("spread", 1.0)):
        padded = np.full((len(tracks), max(int(count.max()), 1)), none)
        padded[components["track"][order], place] = components[name][order]
        columns[name] = padded[rows]
    plain = count[rows] == 0
    columns["weight"][plain, 0], columns["spread"][plain, 0] = 1.0, relative[plain]
    return _Density(columns["weight"], columns["change"], columns["spread"])


def _pair_density(pairs: Table, tracks: Table, first: _Density, second: _Density) -> _Density:
    """Return the density of ln m of pairs from those of ln(p/p_fit) of their tracks."""
    m, of = pairs["mass"], (first, second)
    momenta = [tracks["p"][pairs[name]] for name in _TRACKS]
    squares = [np.array([KNOWN[int(pdg)].mass ** 2 for pdg in pairs[f"{name}_pdg"]]) for name in _TRACKS]
    energies = [np.sqrt(p**2 + square) for p, square in zip(momenta, squares, strict=True)]
    product = energies[0] * energies[1] - 0.5 * (m**2 - squares[0] - squares[1])  # of the momenta, scalar

    shape = first.weight.shape[1], second.weight.shape[1]
    weight = (first.weight[:, :, None] * second.weight[:, None, :]).reshape(len(m), shape[0] * shape[1])
    index = np.unravel_index(np.arange(weight.shape[1]), shape)
    change, spread = (
        [getattr(part, name)[:, at] for part, at in zip(of, index, strict=True)] for name in ("mean", "sigma")
    )
    changed = [
        np.sqrt((p[:, None] * np.exp(log)) ** 2 + square[:, None])
        for p, log, square in zip(momenta, change, squares, strict=True)
    ]
    square = (squares[0] + squares[1])[:, None] + 2 * (
        changed[0] * changed[1] - product[:, None] * np.exp(change[0] + change[1])
    )
    variance = np.broadcast_to((pairs["err_mass"] / m)[:, None] ** 2, weight.shape).copy()
    for name, sigma, p, energy, other in zip(_TRACKS, spread, momenta, energies, energies[::-1], strict=True):
        slope = (p**2 * other / energy - product) / m**2
        error = (tracks["err_p"] / tracks["p"])[pairs[name]]
        variance += slope[:, None] ** 2 * (sigma**2 - error[:, None] ** 2)
    least = 0.01 * (pairs["err_mass"] / m)[:, None] ** 2
    mean = 0.5 * np.log(np.maximum(square, 1e-12))
    return _Density(weight / weight.sum(axis=1, keepdims=True), mean, np.sqrt(np.maximum(variance, least)))
