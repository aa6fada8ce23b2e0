"""Schemas of all tables: every column with dtype, unit and link, and the check against them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Flags
from cgemit.base.errors import did_you_mean, report

FitStatus = _core.common.FitStatus

HIT_X, HIT_V, HIT_WIRE, HIT_XV = 0, 1, 2, 3
"""Views of hits; a hit of view `HIT_XV` is an XV cluster with both its coordinates."""
XV_CLUSTER = 2
"""View of XV clusters in the clusters table."""


@dataclass(frozen=True)
class Column:
    """One column of a table.

    Parameters
    ----------
    name : str
    dtype : numpy.dtype
    unit : str
        Empty for counts, numbers of things and other pure numbers.
    doc : str
    links : str, tuple of str or None
        The table whose rows the column counts (-1: none). A tuple picks the table by the row's `view`.
    shape : tuple of int
        Shape of one entry; ``()`` is a plain number.

    Examples
    --------
    >>> from cgemit.tables import SCHEMAS
    >>> [column.name for column in SCHEMAS["digis"] if column.unit == "fC"]
    ['charge']
    """

    name: str
    dtype: np.dtype[np.generic]
    unit: str
    doc: str
    links: str | tuple[str, ...] | None = None
    shape: tuple[int, ...] = ()


def column_of(code: str, name: str, unit: str, doc: str, links: str | tuple[str, ...] | None = None) -> Column:
    """Return a column of a dtype code."""
    return Column(name, np.dtype(code), unit, doc, links)


def real(name: str, unit: str, doc: str) -> Column:
    """Return a column of numbers, float64."""
    return column_of("f8", name, unit, doc)


def whole(name: str, doc: str) -> Column:
    """Return a column of counts or numbers of things, int32."""
    return column_of("i4", name, "", doc)


def link(name: str, doc: str, links: str | tuple[str, ...]) -> Column:
    """Return a column that counts rows of another table, int64."""
    return column_of("i8", name, "", doc, links)


def point(prefix: str, doc: str) -> tuple[Column, ...]:
    """Return the columns of the three coordinates of a point."""
    return tuple(real(prefix + axis, "mm", f"{doc}, {axis}") for axis in "xyz")


def momentum(doc: str) -> tuple[Column, ...]:
    """Return the columns of the three components of a momentum."""
    return tuple(real("p" + axis, "GeV/c", f"{doc}, {axis}") for axis in "xyz")


#: The first column of every table.
EVENT = column_of("i8", "event", "", "event number")


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
            real(f"truth_{name}", unit, f"true {name} of the particle where it started; NaN without one"),
            real(f"res_{name}", unit, f"fitted minus true {name}; NaN without a particle, and for other half turns"),
            real(f"pull_{name}", "", f"res_{name} / err_{name}; NaN where res_{name} is"),
        )
    )


def _helix(pivot: str) -> tuple[Column, ...]:
    """Parameters with respect to a pivot, and their covariance."""
    return (
        real("dr", "mm", f"signed distance of closest approach to {pivot} (d_rho)"),
        real(
            "phi0",
            "rad",
            "flight azimuth at the point of closest approach, minus pi/2: the azimuth from the pivot to this point if "
            "dr > 0, and the opposite one if dr < 0",
        ),
        real("kappa", "1/(GeV/c)", "charge / pT"),
        real("dz", "mm", "z at the point of closest approach, from the pivot"),
        real("tanl", "", "pz / pT"),
        Column("cov", np.dtype("f8"), "mixed", "covariance of these, products of their units", shape=(5, 5)),
    )


_HYPOTHESIS = whole("hypothesis", "PDG number, unsigned, of the particle whose mass and charge the fit assumed")
_CHARGE = column_of("i1", "charge", "e", "unsigned charge that the fit assumed; kappa has the sign")

TRACKS = (
    EVENT,
    link("candidate", "the candidate", "candidates"),
    _HYPOTHESIS,
    *_helix("the z axis"),
    _CHARGE,
    real("p", "GeV/c", "momentum"),
    real("chi2", "", "chi-square of the fit"),
    whole("ndf", "number of degrees of freedom"),
    whole("n_clusters", "number of clusters used; an XV cluster counts twice"),
    whole("n_wires", "number of wire hits used"),
    whole("n_outliers", "number of hits left out: outliers, and hits that the track does not meet"),
    whole("iterations", "number of iterations"),
    column_of("i1", "status", "", "how the fit ended (FitStatus; 0 is good)"),
    *(real(f"err_{name}", unit, f"standard deviation of {name}") for name, unit in PARAMETERS.items()),
    column_of("i1", "displaced", "", "1 if the track misses the beam line: the fit may correct for matter not crossed"),
    real("p_mode", "GeV/c", "most probable momentum"),
    *(
        real(f"p_{end}{name}", "GeV/c", f"{which} limit of the central {share} % of the density of the momentum{none}")
        for name, share in (("", 68), ("95", 95))
        for end, which, none in (("low", "lower", ""), ("high", "upper", "; NaN where the inverse may be 0"))
    ),
    real("radiated", "", "probability that the hits show a break by radiation, of electrons and positrons; else 0"),
    real("radius_radiated", "mm", "where this break is most probable; 0 if `radiated` is"),
)

COMPONENTS = (
    EVENT,
    link("track", "the electron or positron", "tracks"),
    real("weight", "", "probability of the component; those of a track sum to 1"),
    real("change", "", "mean of ln(p of the particle/p of the track)"),
    real("spread", "", "standard deviation of this logarithm"),
)

MATCHES = (
    EVENT,
    link("track", "the track", "tracks"),
    whole("particle", "number of the particle that left most hits, with its daughters; -1 none"),
    column_of("i1", "match", "", "class of the track (MatchStatus; 0 is the one that measures its particle)"),
    column_of(
        "i1",
        "half_turn",
        "",
        "half turn of most hits that the particle left itself (truths.half_turn, from -1); 0 without any",
    ),
    real("purity", "", "share of the candidate's hits that the particle left itself; NaN without hits"),
    real(
        "efficiency",
        "",
        "share of the particle's hits of the first half turn that the candidate has; NaN without hits",
    ),
    column_of("i1", "decayed", "", "1 if the particle decayed in flight, 0 if not; -1 without a particle"),
    column_of("i1", "other_mass", "", "1 if the fit assumed another particle, 0 if this one; -1 without a particle"),
    real(
        "quantile_p",
        "",
        "probability by the fit that the momentum is below the true one; NaN also for electrons without components",
    ),
    *_comparison(),
)

RESIDUALS = (
    EVENT,
    link("track", "the track", "tracks"),
    column_of("i1", "view", "", "0 X, 1 V, 2 wire; an XV cluster has a row for X and one for V"),
    whole("layer", "layer of the cluster or the wire, as in their tables"),
    link("hit", "the cluster (views 0 and 1) or wire hit (view 2)", ("clusters", "clusters", "wire_hits")),
    real(
        "residual",
        "mm",
        "measured minus predicted by the track fitted without this hit; of V - gamma X where X and V are correlated",
    ),
    real("err", "mm", "standard deviation of the residual"),
    real("pull", "", "residual / err"),
    column_of("i1", "side", "", "side of the wire the fit chose, +1 or -1; 0 for clusters"),
    column_of("u1", "used", "", "1 used, 0 left out as an outlier"),
)

START_TIMES = (
    EVENT,
    real("start_time", "ns", "common excess of all drift times of the event; 0 without a track"),
    real("err_start_time", "ns", "its standard deviation; without a track the error of the given start time, or NaN"),
    whole("n_tracks", "number of candidates used"),
    column_of("i1", "status", "", "how the fit ended (StartTimeStatus; 0 is good)"),
)

STRIP_TIMES = (
    EVENT,
    real("strip_time", "ns", "start of the event in the times of its strips; NaN where unknown"),
    real("err_strip_time", "ns", "its standard deviation; NaN where unknown"),
    whole("n_strips", "strips with a fired neighbour, which tell it"),
    whole("n_outside", "strips whose times are outside of the drift time after it; all of them where it is unknown"),
    column_of("i1", "status", "", "how the search ended (StripTimeStatus; 0 is good)"),
)

STATES = (
    EVENT,
    link("track", "the track", "tracks"),
    _HYPOTHESIS,
    column_of(
        "i1", "surface", "", "surface: 0 origin, 1 closest approach to the beam line, 2 cylinder, 3 hit (Surface)"
    ),
    column_of("i1", "view", "", "of a hit: 0 X, 1 V, 2 wire; -1 elsewhere"),
    whole("layer", "layer of the cluster or the wire, as in their tables; -1 elsewhere"),
    link("hit", "the cluster (views 0 and 1) or wire hit (view 2)", ("clusters", "clusters", "wire_hits")),
    real("r", "mm", "distance from the beam line"),
    *point("", "point of the track"),
    *momentum("momentum there"),
    *point("pivot_", "pivot of the helix: the point itself, but for surface 0 the origin"),
    *_helix("the pivot, in the plane across the beam"),
    _CHARGE,
    real(
        "residual",
        "mm",
        "of a hit: measured minus predicted by the track, fitted with it unless left out; NaN elsewhere",
    ),
    real("err", "mm", "standard deviation of the residual; NaN without one"),
    real("pull", "", "residual / err; NaN without one"),
    column_of("i1", "status", "", "whether there is a state (StateStatus; 0 is good)"),
)

VERTICES = (
    EVENT,
    link("first", "first track of the pair", "tracks"),
    link("second", "second track of the pair", "tracks"),
    *(whole(f"{name}_pdg", f"PDG number, unsigned, of the mass of the {name} track") for name in ("first", "second")),
    *point("", "vertex"),
    Column("cov", np.dtype("f8"), "mm2", "covariance of x, y, z", shape=(3, 3)),
    *(real(f"err_{axis}", "mm", f"standard deviation of {axis}") for axis in "xyz"),
    *momentum("momentum of the pair at the vertex; NaN with an unconstrained track"),
    real("mass", "GeV/c2", "invariant mass of the pair; NaN with an unconstrained track"),
    real("err_mass", "GeV/c2", "its standard deviation; NaN with an unconstrained track"),
    real("chi2", "", "chi-square of the fit"),
    whole("ndf", "number of degrees of freedom"),
    real("other_chi2", "", "chi-square of a second vertex of the tracks that competes (less than 25 more); NaN: none"),
    real("other_distance", "mm", "distance of the second vertex; NaN: none"),
    whole("iterations", "number of iterations, from all starting points"),
    column_of("i1", "status", "", "how the fit ended (VertexStatus; 0 is good)"),
)


_PARTICLE = whole("particle", "number of the particle within its event")
_SHEET = whole("sheet", "sheet of the layer; 0 for layers without sheets")
_LAYER = whole("layer", "layer that measures positions (`Detector.layers`), CGEM or other, 0 innermost")
_WIRE_LAYER = whole("layer", "drift-chamber layer, by its number in the detector file (BESIII: 0 to 42)")
_X_V = "0 X (r phi), 1 V (across the V strips; z for layers with a stereo angle of 90 degrees)"

_PARTICLES = (
    EVENT,
    _PARTICLE,
    whole("pdg", "PDG number"),
    column_of("i1", "charge", "e", "electric charge"),
    real("mass", "GeV/c2", "mass"),
    *point("", "vertex"),
    *momentum("momentum at the vertex"),
    column_of("i1", "status", "", "how its transport ended (TransportStatus; 0 before simulation)"),
)

_DAUGHTER = whole("daughter", "left by: 0 the particle itself, k its k-th charged daughter")
_HALF_TURN = column_of(
    "i1", "half_turn", "", "0 the first outward half turn, odd ones inward; -1 the inward path before it"
)

_DECAYS = (
    EVENT,
    _PARTICLE,
    whole("daughter", "number of the charged daughter, from 1"),
    whole("parent", "decayed: 0 the particle itself, k its k-th charged daughter"),
    whole("pdg", "PDG number of the daughter"),
    whole("mode", "decay mode of the parent, from 0 (`cgemit.particles.species.DECAYS`)"),
    *point("", "point of the decay"),
    real("time", "ns", "time of the decay since the particle left its vertex"),
    *(real(f"parent_p{axis}", "GeV/c", f"momentum of the parent at its decay, {axis}") for axis in "xyz"),
    *momentum("momentum of the daughter at the decay"),
    column_of("i1", "status", "", "how the transport of the daughter ended (TransportStatus)"),
)

_TRUTHS = (
    EVENT,
    _PARTICLE,
    _LAYER,
    *point("entry_", "entry into the drift gap"),
    *point("exit_", "exit from the drift gap"),
    real("r", "mm", "radius of the middle of the gap"),
    real("phi", "rad", "azimuth at mid-gap"),
    real("z", "mm", "z at mid-gap"),
    *momentum("momentum at mid-gap"),
    real("path", "mm", "path length in the gap"),
    real("time", "ns", "time of flight from the vertex"),
    real("energy", "keV", "energy deposited in the gap, by the particle and its delta electrons"),
    column_of("u1", "secondaries", "", "delta electrons of this crossing that left deposits in the gap"),
    _DAUGHTER,
    _HALF_TURN,
)

_STEPS = (
    EVENT,
    _PARTICLE,
    _LAYER,
    *point("", "middle of the step"),
    *(real(f"d{axis}", "mm", f"end minus begin of the step (0 for an ionization cluster), {axis}") for axis in "xyz"),
    real("energy", "keV", "deposited energy"),
    whole("n_electrons", "electrons of ionization"),
    column_of("i1", "parent", "", "source: 0 the particle itself, 1 a delta electron"),
    whole("delta", "number of the delta electron within the crossing, from 1; 0 for the particle itself"),
    link("truth", "the crossing", "truths"),
)

_WIRE_TRUTHS = (
    EVENT,
    _PARTICLE,
    _WIRE_LAYER,
    whole("wire", "cell of the layer"),
    real("doca", "mm", "signed distance of closest approach to the wire"),
    column_of("i1", "side", "", "sign of doca, +1 or -1"),
    *point("", "point of the track closest to the wire"),
    real("time", "ns", "time of flight from the vertex"),
    _DAUGHTER,
    _HALF_TURN,
)

_DIGIS = (
    EVENT,
    _LAYER,
    _SHEET,
    column_of("i1", "view", "", _X_V),
    whole("strip", "strip of the view and sheet; -1 if a position is measured without strips"),
    whole("gid", "strip number in the whole detector; -1 without strips"),
    real("position", "mm", "X or V measured without strips; NaN with strips"),
    real("charge", "fC", "collected charge"),
    real("time", "ns", "arrival time"),
    link("truth", "crossing with the largest contribution", "truths"),
    whole("n_truths", "number of crossings that contributed"),
)

_NOT_MEASURED = "NaN if not measured"
_WIRE_HITS = (
    EVENT,
    _WIRE_LAYER,
    whole("wire", "cell of the layer"),
    whole("gid", "wire number in the whole drift chamber"),
    real("drift", "mm", "measured drift distance"),
    real("sigma", "mm", "its standard deviation"),
    real("drift_time", "ns", f"drift time; {_NOT_MEASURED}"),
    column_of("i1", "side", "", "side of the wire, +1 or -1; 0 hidden"),
    link("wire_truth", "the cell crossing it comes from", "wire_truths"),
)

_CLUSTERS = (
    EVENT,
    _LAYER,
    _SHEET,
    column_of("i1", "view", "", f"{_X_V}, 2 XV: both"),
    whole("first", "first strip; -1 where there is none"),
    whole("last", "last strip; -1 where there is none"),
    whole("size", "number of strips"),
    real("charge", "fC", f"sum of the strips' charges; {_NOT_MEASURED}"),
    real("time", "ns", f"arrival time; {_NOT_MEASURED}"),
    real("x", "mm", f"X on the unrolled readout surface; {_NOT_MEASURED}"),
    real("v", "mm", f"V on the unrolled readout surface; {_NOT_MEASURED}"),
    real("phi", "rad", f"azimuth at mid-gap; {_NOT_MEASURED}"),
    real("z", "mm", f"z at mid-gap; {_NOT_MEASURED}"),
    real("r", "mm", "radius of the middle of the gap"),
    real("err_x", "mm", f"standard deviation of x; {_NOT_MEASURED}"),
    real("err_v", "mm", f"standard deviation of v; {_NOT_MEASURED}"),
    real("err_phi", "rad", f"standard deviation of phi; {_NOT_MEASURED}"),
    real("err_z", "mm", f"standard deviation of z; {_NOT_MEASURED}"),
    link("x_cluster", "the X cluster of an XV cluster", "clusters"),
    link("v_cluster", "the V cluster of an XV cluster", "clusters"),
    link("truth", "crossing with the largest contribution", "truths"),
    whole("n_truths", "number of crossings that contributed"),
    column_of("i1", "method", "", "0 strip position, 1 position with an error that holds at any incidence"),
    real("score", "", "ln(likelihood ratio) that X and V of an XV cluster are of one particle; NaN elsewhere"),
)


_CANDIDATES = (
    EVENT,
    whole("candidate", "number of the candidate within its event"),
    whole("pdg", "PDG number, unsigned, of the particle that is assumed"),
    real("mass", "GeV/c2", "its mass"),
    column_of("i1", "charge", "e", "its unsigned charge"),
)

_CANDIDATE_HITS = (
    EVENT,
    link("candidate", "the candidate", "candidates"),
    column_of("i1", "view", "", "0 X, 1 V, 2 wire, 3 XV: both coordinates of the cluster, with their covariance"),
    link("hit", "the cluster or wire hit", ("clusters", "clusters", "wire_hits", "clusters")),
)

_SEARCHES = (
    EVENT,
    whole("seeds", "number of seeds that were followed"),
    column_of("i1", "limits", "", "sum of the limits that the search has reached (SearchLimits); 0 none"),
)

_EVENTS = (
    EVENT,
    column_of("i8", "number", "", "number that the generator gave the event"),
    real("weight", "", "first weight; 1 without any"),
    real("time", "ns", "time of the event's position; 0 without one"),
)

_KINDS = (
    ("particles", _PARTICLES, "one generated particle"),
    ("events", _EVENTS, "one event of a generator's record"),
    ("decays", _DECAYS, "one charged daughter of a decay in flight"),
    ("truths", _TRUTHS, "one crossing of a CGEM drift gap, or of the sensor of another layer"),
    ("steps", _STEPS, "one deposit in a CGEM drift gap: a step of a delta electron, or an ionization cluster"),
    ("wire_truths", _WIRE_TRUTHS, "one crossing of a drift-chamber cell"),
    ("digis", _DIGIS, "one fired strip, or one position measured without strips"),
    ("wire_hits", _WIRE_HITS, "one fired cell"),
    ("clusters", _CLUSTERS, "one X, V or XV cluster"),
    ("candidates", _CANDIDATES, "one set of hits of one track"),
    ("candidate_hits", _CANDIDATE_HITS, "one hit of a candidate"),
    ("searches", _SEARCHES, "one event and how the search for its tracks ended"),
    ("refined_clusters", _CLUSTERS, "a row of `clusters`, corrected by the fitted tracks"),
    ("refined_wire_hits", _WIRE_HITS, "a row of `wire_hits`, corrected by the fitted tracks"),
    ("tracks", TRACKS, "one candidate, with one mass, and the track fitted to it"),
    ("matches", MATCHES, "one track and its particle"),
    ("residuals", RESIDUALS, "one hit of a fitted track"),
    ("states", STATES, "one track at one surface"),
    ("components", COMPONENTS, "one normal distribution of the density of an electron's momentum"),
    ("start_times", START_TIMES, "one event and its start time, fitted from its tracks"),
    ("strip_times", STRIP_TIMES, "one event and when it began in the times of its strips"),
    ("vertices", VERTICES, "one pair of tracks and their vertex"),
)

#: All tables by name.
SCHEMAS: Mapping[str, tuple[Column, ...]] = MappingProxyType({name: columns for name, columns, _ in _KINDS})

#: What a row of each table is.
ROWS: Mapping[str, str] = MappingProxyType({name: row for name, _, row in _KINDS})


Array = np.ndarray[Any, Any]

#: Numbers beyond that are no measurements: their squares would lose all digits, or be infinite.
_LARGEST = {"mm": 1e12, "rad": 1e6, "mixed": 1e30, "mm2": 1e30}
_LARGEST_OTHER = 1e15
_ENDLESS = float(np.iinfo(np.int64).max)

#: Ranges of columns, ends included, by name or by ``table.name``; other numbers are finite, and not too large.
_RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        **dict.fromkeys(("err", "sigma", "mass", "r", "path", "chi2", "purity", "efficiency"), (0.0, np.inf)),
        **dict.fromkeys(("other_chi2", "other_distance"), (0.0, np.inf)),
        "matches.match": (0, 5),
        **{f"{table}.charge": (1, 127) for table in ("candidates", "tracks", "states")},
        **dict.fromkeys(("truths.energy", "steps.energy", "err_mass"), (0.0, np.inf)),
        **dict.fromkeys(("err_start_time", "err_strip_time"), (0.0, np.inf)),
        **{f"err_{name}": (0.0, np.inf) for name in (*PARAMETERS, "x", "y", "z", "v", "phi")},
        **dict.fromkeys(("sheet", "size", "secondaries", "daughter", "parent", "mode"), (0, _ENDLESS)),
        **dict.fromkeys(("n_clusters", "n_wires", "n_outliers", "n_tracks", "iterations"), (0, _ENDLESS)),
        **dict.fromkeys(("n_strips", "n_outside"), (0, _ENDLESS)),
        **dict.fromkeys(("layer", "wire", "seeds", "limits", "delta", "n_electrons", "hypothesis"), (0, _ENDLESS)),
        **dict.fromkeys(("particle", "candidates.candidate", "candidates.pdg", "first_pdg"), (0, _ENDLESS)),
        **dict.fromkeys(("strip", "gid", "n_truths", "matches.particle", "states.layer", "half_turn"), (-1, _ENDLESS)),
        **dict.fromkeys(("clusters.first", "clusters.last", "refined_clusters.first"), (-1, _ENDLESS)),
        **dict.fromkeys(("refined_clusters.last",), (-1, _ENDLESS)),
        **dict.fromkeys(("wire_hits.gid", "second_pdg"), (0, _ENDLESS)),
        **dict.fromkeys(("p_low", "p_low95", "p_mode", "p_high", "p_high95"), (0.0, np.inf)),
        **dict.fromkeys(("radius_radiated", "spread"), (0.0, np.inf)),
        **dict.fromkeys(("radiated", "components.weight", "quantile_p"), (0, 1)),
        **dict.fromkeys(("displaced", "used", "method", "digis.view", "steps.parent"), (0, 1)),
        **dict.fromkeys(("clusters.view", "refined_clusters.view", "residuals.view"), (0, 2)),
        **dict.fromkeys(("candidate_hits.view", "states.surface"), (0, 3)),
        **dict.fromkeys(("side", "decayed", "other_mass"), (-1, 1)),
        "states.view": (-1, 2),
        "status": (0, 127),
        **{
            f"{table}.status": (0, len(kind.__members__) - 1)
            for table, kind in (
                ("particles", _core.common.TransportStatus), ("decays", _core.common.TransportStatus),
                ("tracks", FitStatus), ("states", _core.common.StateStatus),
            )
        },
    }
)  # fmt: skip

#: Statuses of the rows whose numbers count, by table; in other tables all rows count.
FITTED: Mapping[str, tuple[int, ...]] = MappingProxyType(
    {
        "tracks": (int(FitStatus.ok), int(FitStatus.unconstrained), int(FitStatus.large_chi2)),
        **dict.fromkeys(("states", "vertices", "start_times", "strip_times"), (0,)),
    }
)


def is_fitted(tracks: Any) -> Flags:
    """Return which tracks were fitted, with a measured momentum or without (`unconstrained`), (tracks,) bool.

    Those of status `large_chi2` count: without them, resolutions, pulls and efficiencies would lose their tails.

    Parameters
    ----------
    tracks : Table, or columns by name
    """
    return np.isin(tracks["status"], FITTED["tracks"])


def has_momentum(tracks: Any) -> Flags:
    """Return which tracks were fitted and measure their momentum, whatever their chi-square, (tracks,) bool.

    Parameters
    ----------
    tracks : Table, or columns by name
    """
    return np.isin(tracks["status"], (FitStatus.ok, FitStatus.large_chi2))


#: Links that lead to a row; others are -1 where there is none.
NEEDED_LINKS = frozenset(
    {"steps.truth", "candidate_hits.candidate", "candidate_hits.hit", "tracks.candidate", "matches.track"}
    | {"residuals.track", "residuals.hit", "states.track", "vertices.first", "vertices.second"}
)


def range_of(kind: str, column: Column) -> tuple[float, float, bool]:
    """Return the least and the largest value of a column, and whether it may be NaN in any row, as its text says.

    Parameters
    ----------
    kind : str
        Of the table.
    column : Column
    """
    name = f"{kind}.{column.name}"
    low, high = _RANGES.get(name, _RANGES.get(column.name, (-np.inf, np.inf)))
    if column.links is not None:
        low, high = -1, _ENDLESS
    elif column.dtype.kind == "f":
        largest = _LARGEST.get(column.unit, _LARGEST_OTHER)
        low, high = max(low, -largest), min(high, largest)
    return low, high, "NaN" in column.doc


#: Further arrays of files.
RESERVED = {"offsets": "the per-event offsets", "events": "the numbers of the events"}


_MOST_EVENTS = 2**31 - 1


class Rows(Protocol):
    """The interface of a `Table` for modules that write, convert or show it."""

    kind: str
    columns: Mapping[str, Array]
    n_events: int
    first_event: int
    offsets: np.ndarray[tuple[int], np.dtype[np.int64]]
    meta: Mapping[str, Any]

    def __len__(self) -> int: ...
    @property
    def events(self) -> Array:
        """Numbers of the events covered."""
        ...

    @property
    def cover(self) -> dict[str, Any]:
        """Number, first and, where they have gaps, all numbers of the events covered."""
        ...


def schema_of(kind: str) -> tuple[Column, ...]:
    """Return the columns of a kind of table.

    Raises
    ------
    ValueError
        If there is no such kind.
    """
    if kind not in SCHEMAS:
        hint = did_you_mean(kind, SCHEMAS, "; ")
        raise ValueError(f"kind: there is no table {kind!r}, only {', '.join(SCHEMAS)}{hint}")
    return SCHEMAS[kind]


def event_range(n_events: int, first_event: int, events: npt.ArrayLike | None) -> tuple[int, Array | None]:
    """Return the first event, and the numbers of all where they have gaps, read-only (n_events,) int64.

    Raises
    ------
    ValueError
        If there are too many events, or `events` are not `n_events` whole numbers, each above the one before.
    """
    if not 0 <= n_events <= _MOST_EVENTS:
        raise ValueError(f"n_events: is {n_events}, expected 0 to {_MOST_EVENTS}")
    if events is None or not n_events:
        return int(first_event), None
    numbers = np.asarray(events)
    if numbers.shape != (n_events,) or numbers.dtype.kind not in "iu":
        expected = f"({n_events},), whole numbers"
        raise ValueError(f"events: got shape {numbers.shape}, {numbers.dtype}; expected {expected}")
    if np.any(numbers[1:] <= numbers[:-1]):
        raise ValueError("events: do not increase somewhere; expected each number above the one before")
    first = int(numbers[0])
    if not -(2**62) <= first <= int(numbers[-1]) <= 2**62:
        raise ValueError(f"events: got {first} to {numbers[-1]}, expected numbers within 2**62")
    if int(numbers[-1]) - first == n_events - 1:
        return first, None
    return first, read_only(numbers, np.dtype(np.int64))


def check_columns(
    kind: str,
    columns: Mapping[str, npt.ArrayLike],
    n_events: int,
    first_event: int,
    events: Array | None = None,
) -> tuple[dict[str, Array], Array]:
    """Return read-only contiguous columns in schema order, extra ones last, and where the rows of each event begin.

    The columns have the schema's dtypes. Arrays that fit already are not copied.

    Raises
    ------
    ValueError
        Listing every missing column, wrong shape, wrong dtype, and events that are unordered or out of range.
    """
    schema = schema_of(kind)
    problems = [f"{column.name}: missing ({column.doc})" for column in schema if column.name not in columns]
    rows = len(np.atleast_1d(np.asarray(columns["event"]))) if "event" in columns else None
    problems += [
        f"{name}: is the name of {what}, not of a column" for name, what in RESERVED.items() if name in columns
    ]
    known = {column.name: column for column in schema}
    order = [name for name in known if name in columns] + [name for name in columns if name not in known]
    checked = {}
    for name in order:
        array, column = np.asarray(columns[name]), known.get(name)
        # What the core makes fits as it is, column by column and chunk by chunk: said at once.
        fits = column is not None and array.dtype == column.dtype and array.shape == (rows, *column.shape)
        problem = "" if fits else _problem(array, rows, column)
        if problem:
            problems.append(f"{name}: {problem}")
        else:
            checked[name] = read_only(array, column.dtype if column else array.dtype)
    offsets = None
    if "event" in checked:
        offsets = _offsets(checked["event"], n_events, first_event, events)
        if offsets is None:
            problems += _event_problems(checked["event"], n_events, first_event, events)
    report(f"columns of a {kind} table", problems)
    assert offsets is not None
    return checked, read_only(offsets, np.dtype(np.int64))


def _offsets(event: Array, n_events: int, first_event: int, events: Array | None) -> Array | None:
    """Return where the rows of each event begin, (n_events + 1,) int64, or None if there is a problem with them."""
    if events is None:
        return _core.common.event_offsets(event, first_event, n_events)
    if _event_problems(event, n_events, first_event, events):
        return None
    return np.searchsorted(event, np.append(events, events[-1] + 1))


def read_only(array: Array, dtype: np.dtype[Any]) -> Array:
    """Return the array as contiguous, of the dtype, and read-only, without changing the caller's own."""
    flags = array.flags
    if array.dtype != dtype or not flags.c_contiguous:
        array = np.ascontiguousarray(array, dtype=dtype)
    elif not flags.writeable:
        return array
    view = array.view()
    view.setflags(write=False)
    return view


def _problem(array: Array, rows: int | None, column: Column | None) -> str:
    """Return the problem of one column, or an empty text."""
    shape = column.shape if column else array.shape[1:]
    if array.ndim == 0 or array.shape[1:] != shape or (rows is not None and len(array) != rows):
        expected = ", ".join(str(n) for n in ("n" if rows is None else rows, *shape))
        return f"has shape {array.shape}, expected ({expected})"
    if array.dtype.hasobject:
        return f"has dtype {array.dtype}, expected numbers"
    if column and array.size and not np.can_cast(array.dtype, column.dtype, "same_kind"):
        return f"has dtype {array.dtype}, expected {column.dtype}"
    if column and column.dtype.kind in "iu" and not np.can_cast(array.dtype, column.dtype) and array.size:
        limits = np.iinfo(column.dtype.str)
        if array.min() < limits.min or array.max() > limits.max:
            return f"has values that do not fit into {column.dtype}"
    return ""


def _event_problems(event: Array, n_events: int, first_event: int, events: Array | None) -> list[str]:
    problems = []
    if np.any(event[1:] < event[:-1]):
        problems.append("event: decreases somewhere, expected rows sorted by event")
    elif not len(event):
        return problems
    elif events is not None:
        place = np.minimum(np.searchsorted(events, event), n_events - 1)
        strange = event[events[place] != event]
        if len(strange):
            problems.append(f"event: holds {strange[0]}, which is none of the {n_events} events covered")
    elif event[0] < first_event or event[-1] >= first_event + n_events:
        problems.append(
            f"event: runs from {event[0]} to {event[-1]}, expected {first_event} to {first_event + n_events - 1}"
        )
    return problems
