"""The columns of every table, with dtype, unit and meaning; `docs/data_model.md` is written from here."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from cgemit.tables import track_schemas as tracks
from cgemit.tables.columns import EVENT as _EVENT
from cgemit.tables.columns import Column
from cgemit.tables.columns import column_of as _column
from cgemit.tables.columns import link as _link
from cgemit.tables.columns import momentum as _momentum
from cgemit.tables.columns import point as _point
from cgemit.tables.columns import real as _f8
from cgemit.tables.columns import whole as _i4

_PARTICLE = _i4("particle", "number of the particle within its event")
_SHEET = _i4("sheet", "sheet of the layer's read-out")

_PARTICLES = (
    _EVENT,
    _PARTICLE,
    _i4("pdg", "particle number of the Particle Data Group"),
    _column("i1", "charge", "e", "electric charge"),
    _f8("mass", "GeV/c2", "mass"),
    *_point("", "vertex"),
    *_momentum("momentum at the vertex"),
    _column("i1", "status", "", "how its transport ended (TransportStatus; 0 before simulation)"),
)

_DAUGHTER = _i4("daughter", "who left it: 0 the particle itself, k the k-th charged daughter of its decays")
_HALF_TURN = _column(
    "i1", "half_turn", "", "half turn: 0 the first outward one, odd ones inward; -1 the inward path before it"
)

_DECAYS = (
    _EVENT,
    _PARTICLE,
    _i4("daughter", "number of this charged daughter among those of the particle, from 1"),
    _i4("parent", "what decayed: 0 the particle itself, k its k-th charged daughter"),
    _i4("pdg", "the daughter's number of the Particle Data Group"),
    _i4("mode", "decay mode of the parent, counted from 0 as in `cgemit.decays.DECAYS`"),
    *_point("", "point of the decay"),
    _f8("time", "ns", "time of the decay since the particle left its vertex"),
    *(_f8(f"parent_p{axis}", "GeV/c", f"momentum of the parent at its decay, {axis}") for axis in "xyz"),
    *_momentum("momentum of the daughter at the decay"),
    _column("i1", "status", "", "how the transport of the daughter ended (TransportStatus)"),
)

_TRUTHS = (
    _EVENT,
    _PARTICLE,
    _i4("layer", "CGEM layer, 0 innermost"),
    *_point("entry_", "entry into the drift gap"),
    *_point("exit_", "exit from the drift gap"),
    _f8("r", "mm", "radius of the middle of the gap"),
    _f8("phi", "rad", "azimuth at mid-gap"),
    _f8("z", "mm", "z at mid-gap"),
    *_momentum("momentum at mid-gap"),
    _f8("path", "mm", "path length in the gap"),
    _f8("time", "ns", "time of flight from the vertex"),
    _f8("energy", "keV", "energy deposited in the gap, by the particle and its delta electrons"),
    _column("u1", "secondaries", "", "delta electrons of this crossing that left deposits in the gap"),
    _DAUGHTER,
    _HALF_TURN,
)

_STEPS = (
    _EVENT,
    _PARTICLE,
    _i4("layer", "CGEM layer, 0 innermost"),
    *_point("", "middle of the step"),
    *(_f8(f"d{axis}", "mm", f"end minus begin of the step, {axis}; 0 for an ionization cluster") for axis in "xyz"),
    _f8("energy", "keV", "deposited energy"),
    _i4("n_electrons", "electrons of ionization"),
    _column("i1", "parent", "", "source: 0 the particle itself, 1 a delta electron"),
    _i4("delta", "number of the delta electron within the crossing, from 1; 0 for the particle itself"),
    _link("truth", "the crossing", "truths"),
)

_WIRE_TRUTHS = (
    _EVENT,
    _PARTICLE,
    _i4("layer", "drift-chamber layer as the experiment numbers it (0..42)"),
    _i4("wire", "cell of the layer"),
    _f8("doca", "mm", "signed distance of closest approach to the wire"),
    _column("i1", "side", "", "sign of doca, +1 or -1"),
    *_point("", "point of the track closest to the wire"),
    _f8("time", "ns", "time of flight from the vertex"),
    _DAUGHTER,
    _HALF_TURN,
)

_DIGIS = (
    _EVENT,
    _i4("layer", "CGEM layer, 0 innermost"),
    _SHEET,
    _column("i1", "view", "", "0 X, 1 V"),
    _i4("strip", "strip of the view and sheet; -1 if a position is measured without strips"),
    _i4("gid", "strip number in the whole CGEM; -1 without strips"),
    _f8("position", "mm", "X or V measured without strips; NaN with strips"),
    _f8("charge", "fC", "collected charge"),
    _f8("time", "ns", "arrival time"),
    _link("truth", "crossing with the largest contribution", "truths"),
    _i4("n_truths", "number of crossings that contributed"),
)

_WIRE_HITS = (
    _EVENT,
    _i4("layer", "drift-chamber layer as the experiment numbers it (0..42)"),
    _i4("wire", "cell of the layer"),
    _i4("gid", "wire number in the whole drift chamber"),
    _f8("drift", "mm", "measured drift distance"),
    _f8("sigma", "mm", "its standard deviation"),
    _f8("drift_time", "ns", "drift time"),
    _column("i1", "side", "", "side of the wire, +1 or -1; 0 hidden"),
    _link("wire_truth", "the cell crossing it comes from", "wire_truths"),
)

_NOT_MEASURED = "NaN where the cluster's view does not measure it"
_CLUSTERS = (
    _EVENT,
    _i4("layer", "CGEM layer, 0 innermost"),
    _SHEET,
    _column("i1", "view", "", "0 X, 1 V, 2 XV"),
    _i4("first", "first strip; -1 where there is none"),
    _i4("last", "last strip; -1 where there is none"),
    _i4("size", "number of strips"),
    _f8("charge", "fC", "sum of the strips' charges"),
    _f8("time", "ns", "arrival time"),
    _f8("x", "mm", f"X on the unrolled anode; {_NOT_MEASURED}"),
    _f8("v", "mm", f"V on the unrolled anode; {_NOT_MEASURED}"),
    _f8("phi", "rad", f"azimuth at mid-gap; {_NOT_MEASURED}"),
    _f8("z", "mm", f"z at mid-gap; {_NOT_MEASURED}"),
    _f8("r", "mm", "radius of the middle of the gap"),
    _f8("err_x", "mm", f"standard deviation of x; {_NOT_MEASURED}"),
    _f8("err_v", "mm", f"standard deviation of v; {_NOT_MEASURED}"),
    _f8("err_phi", "rad", f"standard deviation of phi; {_NOT_MEASURED}"),
    _f8("err_z", "mm", f"standard deviation of z; {_NOT_MEASURED}"),
    _link("x_cluster", "the X cluster of an XV cluster", "clusters"),
    _link("v_cluster", "the V cluster of an XV cluster", "clusters"),
    _link("truth", "crossing with the largest contribution", "truths"),
    _i4("n_truths", "number of crossings that contributed"),
    _column("i1", "method", "", "0 position of the strips, 1 position with an error that holds at any incidence"),
    _f8("score", "", "ln(likelihood ratio) that X and V of an XV cluster are of one particle, from charge and time"),
)


_CANDIDATES = (
    _EVENT,
    _i4("candidate", "number of the candidate within its event"),
    _i4("pdg", "particle whose mass is assumed, number of the Particle Data Group, unsigned"),
    _f8("mass", "GeV/c2", "its mass"),
)

_CANDIDATE_HITS = (
    _EVENT,
    _link("candidate", "the candidate", "candidates"),
    _column("i1", "view", "", "0 X, 1 V, 2 wire, 3 XV: both coordinates of the cluster, with their covariance"),
    _link("row", "the cluster or wire hit", ("clusters", "clusters", "wire_hits", "clusters")),
)

_KINDS = (
    ("particles", _PARTICLES, "one generated particle"),
    ("decays", _DECAYS, "one charged daughter of a decay in flight"),
    ("truths", _TRUTHS, "one crossing of a CGEM drift gap"),
    ("steps", _STEPS, "one deposit in a CGEM drift gap: a step of a delta electron, or an ionization cluster"),
    ("wire_truths", _WIRE_TRUTHS, "one crossing of a drift-chamber cell"),
    ("digis", _DIGIS, "one fired strip, or one position measured without strips"),
    ("wire_hits", _WIRE_HITS, "one fired cell"),
    ("clusters", _CLUSTERS, "one X, V or XV cluster"),
    ("candidates", _CANDIDATES, "one set of hits that is taken for one track"),
    ("candidate_hits", _CANDIDATE_HITS, "one hit of a candidate"),
    ("tracks", tracks.TRACKS, "one candidate, with one mass, and the track fitted to it"),
    ("matches", tracks.MATCHES, "one track and its particle"),
    ("residuals", tracks.RESIDUALS, "one hit of a fitted track"),
    ("states", tracks.STATES, "one track at one surface"),
    ("start_times", tracks.START_TIMES, "one event and its start time, fitted from its tracks"),
    ("vertices", tracks.VERTICES, "one pair of tracks and their vertex"),
)

#: All tables by name.
SCHEMAS: Mapping[str, tuple[Column, ...]] = MappingProxyType({name: columns for name, columns, _ in _KINDS})

#: What a row of each table is.
ROWS: Mapping[str, str] = MappingProxyType({name: row for name, _, row in _KINDS})
