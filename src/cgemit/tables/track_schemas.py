"""The columns of tables of fitted tracks: tracks, matches, residuals, start times, states and vertices."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from cgemit.tables.columns import EVENT as _EVENT
from cgemit.tables.columns import Column
from cgemit.tables.columns import column_of as _column
from cgemit.tables.columns import link as _link
from cgemit.tables.columns import momentum as _momentum
from cgemit.tables.columns import point as _point
from cgemit.tables.columns import real as _f8
from cgemit.tables.columns import whole as _i4

#: The fitted quantities, each with its native unit.
PARAMETERS: Mapping[str, str] = MappingProxyType(
    {"dr": "mm", "phi0": "rad", "kappa": "1/(GeV/c)", "dz": "mm", "tanl": "", "p": "GeV/c"}
)


def _comparison() -> tuple[Column, ...]:
    """Truth, residual and pull of each fitted quantity."""
    return tuple(
        column
        for name, unit in PARAMETERS.items()
        for column in (
            _f8(f"truth_{name}", unit, f"true {name}"),
            _f8(f"res_{name}", unit, f"fitted minus true {name}"),
            _f8(f"pull_{name}", "", f"res_{name} / err_{name}"),
        )
    )


def _helix(pivot: str) -> tuple[Column, ...]:
    """Parameters with respect to a pivot, and their covariance."""
    return (
        _f8("dr", "mm", f"signed distance of closest approach to {pivot} (d_rho)"),
        _f8("phi0", "rad", "azimuth of the point of closest approach; the flight azimuth is phi0 + pi/2"),
        _f8("kappa", "1/(GeV/c)", "charge / pT"),
        _f8("dz", "mm", "z at the point of closest approach, from the pivot"),
        _f8("tanl", "", "pz / pT"),
        Column("cov", np.dtype("f8"), "mixed", "covariance of these, products of their units", shape=(5, 5)),
    )


_HYPOTHESIS = _i4("hypothesis", "particle whose mass the fit assumed, number of the Particle Data Group, unsigned")

TRACKS = (
    _EVENT,
    _link("candidate", "the candidate", "candidates"),
    _HYPOTHESIS,
    *_helix("the z axis"),
    _f8("p", "GeV/c", "momentum"),
    _f8("chi2", "", "chi-square of the fit"),
    _i4("ndf", "number of degrees of freedom"),
    _i4("n_clusters", "number of clusters used; an XV point counts twice"),
    _i4("n_wires", "number of wire hits used"),
    _i4("n_outliers", "number of hits left out as outliers"),
    _i4("iterations", "number of iterations"),
    _column("i1", "status", "", "how the fit ended (FitStatus; 0 is good)"),
    *(_f8(f"err_{name}", unit, f"standard deviation of {name}") for name, unit in PARAMETERS.items()),
    _column("i1", "displaced", "", "1 if it misses the beam line: the fit may correct for matter not crossed"),
)

MATCHES = (
    _EVENT,
    _link("track", "the track", "tracks"),
    _i4("particle", "number of the particle within its event that it and its daughters left most hits of; -1 none"),
    _f8("purity", "", "share of the candidate's hits that it left itself, before any decay; NaN without hits"),
    _f8(
        "efficiency",
        "",
        "share of its clusters and wire hits of the first half turn that the candidate has; NaN without one",
    ),
    _column("i1", "decayed", "", "1 if it decayed in flight, 0 if not; -1 without a particle"),
    *_comparison(),
)

RESIDUALS = (
    _EVENT,
    _link("track", "the track", "tracks"),
    _column("i1", "view", "", "0 X, 1 V, 2 wire; an XV point has a row for X and one for V given X"),
    _i4("layer", "layer of the cluster or wire"),
    _link("hit", "the cluster (views 0 and 1) or wire hit (view 2)", ("clusters", "clusters", "wire_hits")),
    _f8("residual", "mm", "measured minus predicted by the track fitted without this hit"),
    _f8("err", "mm", "standard deviation of the residual"),
    _f8("pull", "", "residual / err"),
    _column("i1", "side", "", "side of the wire the fit chose, +1 or -1; 0 for clusters"),
    _column("u1", "used", "", "1 used, 0 left out as an outlier"),
)

START_TIMES = (
    _EVENT,
    _f8("start_time", "ns", "by how much the drift times of the event are too long; 0 where no track gives it"),
    _f8("err_start_time", "ns", "its standard deviation; where no track gives it, that of the given one, or NaN"),
    _i4("n_tracks", "number of candidates that gave it"),
    _column("i1", "status", "", "how the fit ended (StartTimeStatus; 0 is good)"),
)

STATES = (
    _EVENT,
    _link("track", "the track", "tracks"),
    _HYPOTHESIS,
    _column("i1", "surface", "", "surface: 0 origin, 1 closest approach to the beam line, 2 cylinder, 3 hit (Surface)"),
    _column("i1", "view", "", "of a hit: 0 X, 1 V, 2 wire; -1 elsewhere"),
    _i4("layer", "layer of the cluster or wire; -1 elsewhere"),
    _link("hit", "the cluster (views 0 and 1) or wire hit (view 2)", ("clusters", "clusters", "wire_hits")),
    _f8("r", "mm", "distance from the beam line"),
    *_point("", "point of the track"),
    *_momentum("momentum there"),
    *_point("pivot_", "pivot of the helix: the point itself, but for surface 0 the origin"),
    *_helix("the pivot, in the plane across the beam"),
    _f8(
        "residual",
        "mm",
        "of a hit: measured minus predicted by the track, fitted with it unless it was left out; NaN elsewhere",
    ),
    _f8("err", "mm", "standard deviation of the residual"),
    _f8("pull", "", "residual / err"),
    _column("i1", "status", "", "whether there is a state (StateStatus; 0 is good)"),
)

VERTICES = (
    _EVENT,
    _link("first", "first track of the pair", "tracks"),
    _link("second", "second track of the pair", "tracks"),
    *(_i4(f"{name}_pdg", f"particle whose mass the {name} track has, unsigned") for name in ("first", "second")),
    *_point("", "vertex"),
    Column("cov", np.dtype("f8"), "mm2", "covariance of x, y, z", shape=(3, 3)),
    *(_f8(f"err_{axis}", "mm", f"standard deviation of {axis}") for axis in "xyz"),
    *_momentum("momentum of the pair at the vertex"),
    _f8("mass", "GeV/c2", "invariant mass of the pair"),
    _f8("err_mass", "GeV/c2", "its standard deviation"),
    _f8("chi2", "", "chi-square of the fit"),
    _i4("ndf", "number of degrees of freedom"),
    _i4("iterations", "number of iterations"),
    _column("i1", "status", "", "how the fit ended (VertexStatus; 0 is good)"),
)
