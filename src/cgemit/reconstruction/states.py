"""States of fitted tracks at any surface: smoothed, and extrapolated through matter (docs/methods/states.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core, helix
from cgemit.base.arrays import Columns, Floats
from cgemit.base.errors import report
from cgemit.base.validate import number
from cgemit.detector import SCREENINGS, Detector, load, slabs
from cgemit.detector.layers.layer import local_v, seen_by
from cgemit.fit_matter import tuned
from cgemit.particles.species import HYPOTHESES, usual_mass
from cgemit.reconstruction.candidates import FitHits
from cgemit.tables import Table
from cgemit.tables.check import table_problems
from cgemit.tables.table import what

Surface = _core.reconstruction.Surface
StateStatus = _core.common.StateStatus

#: Surfaces of states by name; a number is the radius of a cylinder in mm.
SurfaceName = Literal["origin", "beam_line", "beam_pipe", "hits"]

#: GeV/c, assumed where neither the curvature nor anything else tells the momentum.
USUAL_MOMENTUM = 1.0


def state_columns(
    detector: Detector,
    core: _core.detector.Detector,
    surfaces: tuple[float | str, ...],
    tracks: Table,
    mass: Floats,
    radii: Floats,
    hits: FitHits,
    fitted: dict[str, npt.NDArray[Any]],
    settled: npt.NDArray[np.bool_],
) -> Columns:
    """Columns of the states table.

    Parameters
    ----------
    detector : Detector
        Detector that the fit assumed.
    core : _core.detector.Detector
        The same, compiled for it.
    surfaces : tuple of float or str
        Radii in mm, and names of `SurfaceName`.
    tracks : Table of kind "tracks"
    mass : ndarray, (n,) float64, GeV/c2
        That the fit assumed for each.
    radii : ndarray, (n,) float64, mm
        Where each begins.
    hits : FitHits
        Of each track.
    fitted : dict of ndarray
        Of the fit: `reference` (n, 5) float64, the helix of the reference trajectory of its last iteration, with the
        azimuth of flight for phi0; `kinks` (n slabs, 2) float64, rad, the scattering of that trajectory in every slab;
        `prior` (n, 25) float64, the covariance of its filter's prior; `used` (hits,) uint8, whether it used a hit;
        `used_value`, `used_variance` (hits,) float64, mm and mm2, what it measured; `matter_p` (n,) float64, GeV/c,
        the momentum with which the track scatters, 0 for that of its kappa.
    settled : ndarray, (n,) bool
        Whether the fit has settled; otherwise its last iteration may have begun far from its result.

    Returns
    -------
    dict of array_like
    """
    targets = _targets(detector, surfaces)
    used = {name: fitted[name] for name in ("used", "used_value", "used_variance")}
    out = _core.reconstruction.states(
        core,
        hit_offsets=hits.hit_offsets,
        hits=hits.columns() | used,
        reference=fitted["reference"],
        kinks=fitted["kinks"].reshape(len(fitted["reference"]), 2 * len(slabs(detector))),
        prior=fitted["prior"].reshape(-1, 25),
        mass=mass,
        charge=np.asarray(tracks["charge"], np.float64),
        matter_p=fitted["matter_p"],
        start_radius=radii,
        fitted=settled.astype(np.uint8),
        targets=targets,
    )
    track, target = out["track"], out["target"]
    surface = targets["surface"][target]
    columns: Columns = {
        "event": tracks["event"][track],
        "track": track,
        "hypothesis": tracks["hypothesis"][track],
        "charge": tracks["charge"][track],
        "surface": surface,
    }
    columns |= _hit_columns(hits, out["hit"]) | _at(out, tracks["charge"][track])
    columns["r"] = np.where(
        surface == Surface.cylinder, targets["radius"][target], np.hypot(columns["x"], columns["y"])
    )
    residual, err = out["residual"], out["err"]
    return columns | {"residual": residual, "err": err, "pull": residual / err, "status": out["status"]}


def extrapolate(
    detector: Detector | str | Mapping[str, Any],
    table: Table,
    radius: float,
    *,
    particle: str | None = None,
    screening: str = SCREENINGS[0],
    loss: str = "truncated",
    radiation: bool = True,
    momentum: float | None = None,
) -> Table:
    """Extrapolate fitted tracks to a cylinder, outward or inward, through the matter in between.

    Tracks are helices in a uniform field, Runge-Kutta steps in any other. The energy loss changes the state, and the
    noise of the matter adds to its covariance. No measurement is added. Between measurements, and from the innermost
    one to the origin, ``FitSettings(states=...)`` is more precise: its states use all measurements, on either side.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    table : Table of kind "states" or "tracks"
        Where to start; tracks start at the origin.
    radius : float
        mm. A track that does not reach it, or leaves the field map before, gets a row with such a `status`.
    particle : str or None
        Name of the particle (``"e"``, ``"mu"``, ``"pi"``, ``"K"``, ``"p"``); that of the column `hypothesis` if None.
    screening, loss, radiation : str, str, bool
        Screening of nuclei in multiple scattering, the energy loss subtracted, and whether electrons and positrons
        radiate, as in `FitSettings`.
    momentum : float or None
        GeV/c, with which tracks scatter and lose energy whose curvature does not measure their momentum, as in
        `FitSettings`. None: that of the fit.

    Returns
    -------
    Table of kind "states"
        One row per row of `table`.

    Raises
    ------
    ValueError
        Listing every invalid argument, or every problem of the detector.

    Examples
    --------
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> states = cg.extrapolate(result.detector, result.fitted, radius=900.0)
    >>> print(np.hypot(states["pivot_x"], states["pivot_y"]).round(3))
    [900. 900. 900. 900. 900.]
    """
    problems = _start_problems(table, radius, particle, screening, loss, momentum)
    report("extrapolate", problems)
    detector, of_state, n = load(detector), table.kind == "states", len(table)
    pivot = np.stack([table[f"pivot_{axis}"] if of_state else np.zeros(len(table)) for axis in "xyz"], axis=1)
    parameters = np.stack([table[name] for name in helix.PARAMETERS], axis=1)
    start = np.hypot(*(pivot[:, i] + table["dr"] * f(table["phi0"]) for i, f in enumerate((np.cos, np.sin))))
    mass = _masses(table, particle)
    charge = table["charge"] if particle is None else np.full(n, abs(HYPOTHESES[particle].charge), np.int8)
    in_matter = _core.reconstruction.matter_momenta(
        kappa=table["kappa"], sigma=np.sqrt(table["cov"][:, 2, 2]), tanl=table["tanl"], charge=charge,
        momentum=momentum or float(table.meta.get("momentum", USUAL_MOMENTUM)), bz=detector.field.bz,
    )  # fmt: skip
    out = _core.reconstruction.extrapolate(
        tuned(detector, screening, loss, bool(radiation)), pivot=pivot, helix=parameters,
        cov=table["cov"].reshape(-1, 25), mass=mass, charge=charge, matter_p=in_matter, radius=float(radius),
        share=shares_inside(detector, start), target_share=float(shares_inside(detector, np.array([radius]))[0]),
    )  # fmt: skip
    at = _at(out, charge)
    # Squares of numbers far beyond a detector may be infinite.
    finite = np.all([np.isfinite(one).reshape(n, -1).all(axis=1) for one in at.values()], axis=0)
    out["status"] = np.where((out["status"] == StateStatus.ok) & ~finite, StateStatus.not_fitted, out["status"])
    none, nan = np.full(n, -1), np.full(n, np.nan)
    columns: Columns = {
        "event": table["event"], "track": table["track"] if of_state else np.arange(n),
        "hypothesis": table["hypothesis"], "charge": charge,
        "surface": np.full(n, Surface.cylinder), "r": np.full(n, float(radius)),
        "view": none, "layer": none, "hit": none, "residual": nan, "err": nan, "pull": nan, "status": out["status"],
    }  # fmt: skip
    return Table("states", columns | at, meta=table.meta, **table.cover)


class Crossings(NamedTuple):
    """Where tracks cross a layer of strips, in the axes of the layer, one row for each track that crosses it.

    Attributes
    ----------
    states : Table of kind "states"
        On the cylinder in the middle of the layer; `track` is the row of the track.
    sheet : ndarray, (n,) int64
    phi, z : ndarray, (n,) float64, rad, mm
    x, v : ndarray, (n,) float64, mm
        X and V on the sheet.
    cov : ndarray, (n, 2, 2) float64, mm2
        Covariance of X and V.
    """

    states: Table
    sheet: npt.NDArray[np.int64]
    phi: Floats
    z: Floats
    x: Floats
    v: Floats
    cov: Floats


def crossings_of(detector: Detector, tracks: Table, number: int) -> Crossings:
    """Return where tracks cross a layer of strips.

    A track that is displaced by d across itself crosses the cylinder at a point that is shifted by d/cos(a) along the
    circumference, a being its angle to the radius, and by d tan(a) tan(lambda) along the beam.

    Parameters
    ----------
    detector : Detector
    tracks : Table of kind "tracks"
        Fitted without hits of the layer, if its prediction is wanted.
    number : int
        Of the layer.
    """
    layer = detector.layers[number]
    states = extrapolate(detector, tracks, layer.r_mid)
    states = states[states["status"] == StateStatus.ok]
    point, along = (np.stack([states[n] for n in names], axis=1) for names in (("x", "y", "z"), ("px", "py", "pz")))
    local = seen_by(layer, point, along)
    phi, z = np.arctan2(local[:, 1], local[:, 0]), local[:, 2]
    sheet = np.asarray(layer.sheet_at(phi), np.int64)
    x = layer.r_readout * np.remainder(phi - np.asarray(layer.sheet_phi)[sheet], 2 * np.pi)
    v = local_v(layer, x, z)
    # Unit vectors across (n) and along (u) the track, and outward (r) and around (f), in the transverse plane.
    n = np.stack([np.cos(states["phi0"]), np.sin(states["phi0"])])
    u = along[:, :2].T / np.hypot(along[:, 0], along[:, 1])
    r = point[:, :2].T / np.hypot(point[:, 0], point[:, 1])
    outward, around = np.sum(u * r, axis=0), u[1] * r[0] - u[0] * r[1]
    step = -np.sum(n * r, axis=0) / np.copysign(np.maximum(np.abs(outward), 1e-3), outward)
    dx = (n[1] * r[0] - n[0] * r[1] + step * around) * layer.r_readout / layer.r_mid
    dz = step * along[:, 2] / np.hypot(along[:, 0], along[:, 1])
    zero, one = np.zeros(len(x)), np.ones(len(x))
    slope = np.stack([np.stack([dx, zero], 1), np.stack([dz, one], 1)], axis=1)  # of X and z in dr and dz
    turn = np.array([[1.0, 0.0], [np.cos(layer.stereo), -layer.sin_stereo]])  # of X and V in X and z
    slope = turn @ slope
    cov = slope @ states["cov"][:, [[0, 0], [3, 3]], [[0, 3], [0, 3]]] @ np.swapaxes(slope, 1, 2)
    return Crossings(states, sheet, phi, z, x, v, cov)


def _start_problems(
    table: Table, radius: object, particle: object, screening: object, loss: object, momentum: object
) -> list[str]:
    """Return the problems of the arguments of `extrapolate`."""
    problems = []
    fits = isinstance(table, Table) and table.kind in ("states", "tracks")
    if not fits:
        problems.append(f"table: got {what(table)}, expected a table of kind 'states' or 'tracks'")
    else:
        problems += table_problems(**{table.kind: table})
    if not 0 < number(radius) < math.inf:
        problems.append(f"radius: got {radius!r}, expected a positive number, mm")
    if particle not in (None, *HYPOTHESES):
        problems.append(f"particle: got {particle!r}, expected one of {', '.join(map(repr, HYPOTHESES))}")
    if particle is None and fits and np.isnan(_masses(table, None)[np.isfinite(table["cov"][:, 0, 0])]).any():
        problems.append("particle: none given, and the mass of the table's hypothesis is not known")
    if loss not in tuple(_core.matter.CoreLoss.__members__):
        problems.append(f"loss: got {loss!r}, expected one of {', '.join(_core.matter.CoreLoss.__members__)}")
    if momentum is not None and not 0 < number(momentum) < math.inf:
        problems.append(f"momentum: got {momentum!r}, expected a positive number, GeV/c")
    if screening not in SCREENINGS:
        problems.append(f"screening: got {screening!r}, expected one of {', '.join(map(repr, SCREENINGS))}")
    return problems


def _masses(table: Table, particle: str | None) -> Floats:
    """Return the mass of each row, GeV/c2; NaN where it is not known."""
    if particle is not None:
        return np.full(len(table), HYPOTHESES[particle].mass)
    numbers, number = np.unique(table["hypothesis"], return_inverse=True)
    return np.array([usual_mass(int(pdg)) for pdg in numbers], np.float64)[number]


def _at(out: dict[str, npt.NDArray[Any]], charge: npt.NDArray[Any]) -> dict[str, Any]:
    """Columns of point, momentum, pivot, helix and covariance; `charge` of each state, e."""
    pivot, (dr, phi0, kappa, dz, tanl) = out["pivot"], out["helix"].T
    px, py, pz = helix.momentum_vector(out["helix"], charge).T
    return {
        "x": pivot[:, 0] + dr * np.cos(phi0), "y": pivot[:, 1] + dr * np.sin(phi0), "z": pivot[:, 2] + dz,
        "px": px, "py": py, "pz": pz, "pivot_x": pivot[:, 0], "pivot_y": pivot[:, 1], "pivot_z": pivot[:, 2],
        "dr": dr, "phi0": phi0, "kappa": kappa, "dz": dz, "tanl": tanl, "cov": out["cov"],
    }  # fmt: skip


def _hit_columns(hits: FitHits, hit: npt.NDArray[Any]) -> Columns:
    """Columns view, layer and hit of states at hits, by their row in `hits`; -1 for those that are at none."""
    at_hit = hit >= 0
    columns: Columns = {}
    for name, kind, values in (("view", "i1", hits.kind), ("layer", "i4", hits.layer), ("hit", "i8", hits.hit)):
        column = np.full(len(hit), -1, kind)
        column[at_hit] = values[hit[at_hit]]
        columns[name] = column
    return columns


def _targets(detector: Detector, surfaces: tuple[float | str, ...]) -> dict[str, npt.NDArray[Any]]:
    """Columns surface, radius (mm) and share of the requested surfaces, in their order."""
    kinds = {"origin": Surface.origin, "beam_line": Surface.beam_line, "hits": Surface.hit}
    if "beam_pipe" in surfaces and not detector.beam_pipe:
        raise ValueError("states: 'beam_pipe', but the detector has none")
    radii = [detector.beam_pipe[0].r_in if surface == "beam_pipe" else surface for surface in surfaces]
    kind = [kinds.get(surface, Surface.cylinder) if isinstance(surface, str) else Surface.cylinder for surface in radii]
    radius = np.array([0.0 if isinstance(surface, str) else float(surface) for surface in radii])
    return {"surface": np.array(kind, np.int8), "radius": radius, "share": shares_inside(detector, radius)}


def shares_inside(detector: Detector, radii: Floats) -> Floats:
    """Return which part of X/X0 of the scatterer that a radius cuts lies inside that radius; 0 if it cuts none.

    Parameters
    ----------
    detector : Detector
    radii : ndarray, (n,) float64, mm
    """
    shares = np.zeros(len(radii))
    for slab in slabs(detector):
        cut = (slab.r_in < radii) & (radii < slab.r_out)
        if cut.any():
            inside = [s.x0 * np.clip((radii[cut] - s.r_in) / s.thickness, 0, 1) for s in slab.shells]
            shares[cut] = np.sum(inside, axis=0) / slab.x0
    return shares
