"""Fitted vertices against true ones."""

from __future__ import annotations

import numpy as np

from cgemit.tables import Table
from cgemit.tables.check import refuse_wrong
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
