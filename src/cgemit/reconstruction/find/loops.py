"""Links between fitted half turns of one particle (docs/methods/find.md)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats, Rows
from cgemit.base.errors import report
from cgemit.helix import PARAMETERS, RADIUS_PER_KAPPA, wrap_angle
from cgemit.tables import Table
from cgemit.tables.check import table_problems
from cgemit.tables.schema import has_momentum

#: Relative change of the momentum from one half turn to another by energy loss, as a standard deviation.
LOSS = 0.12
#: Largest chi-square of a pair, with five terms.
GATE = 20.0
#: Whole turns between the closest approaches of two half turns.
MOST_TURNS = 7
#: mm, width of the vertices along the beam line and across it.
VERTEX = (10.0, 1.0)

_DR, _PHI0, _KAPPA, _DZ, _TANL = range(len(PARAMETERS))


def link_loops(tracks: Table, bz: float) -> Rows:
    """Link fitted tracks that are half turns of one particle to one of them, the first.

    Two half turns lie on one circle and one helix: the perigee is the same, or whole turns further on. A half turn
    that leads inward is fitted as one that leads outward, with the opposite charge. Every pair of tracks of an event
    gets a chi-square of five terms: perigee distance and azimuth, momentum, slope, and height at the perigee without
    whole turns, with the errors of the fit and an allowance for the energy loss. Pairs below `GATE` are linked, the
    best first, unless this joins a pair above it. Of linked tracks, the one closest to the origin is the first half
    turn.

    Parameters
    ----------
    tracks : Table of kind "tracks"
        Tracks whose fit failed are not linked. Tracks with different mass hypotheses are not compared.
    bz : float
        T, field at the origin, signed. Without one no track turns back, and none is linked.

    Returns
    -------
    ndarray, (tracks,) int64
        Row of the first half turn of each track; its own where the track is not linked to an earlier one.

    Raises
    ------
    ValueError
        If the table is of another kind, or the field no finite number.
    """
    problems = table_problems(tracks=tracks)
    if not np.isfinite(bz):
        problems.append(f"bz: got {bz}, expected a field in T")
    report("link_loops", problems)
    first = np.arange(len(tracks))
    if bz == 0:
        return first
    good = np.flatnonzero(has_momentum(tracks))
    one, other = _pairs(tracks, good)
    group = _groups(len(tracks), one, other, pair_chi2(tracks, one, other, bz))
    order = np.lexsort((_distance(tracks), group))
    start = np.flatnonzero(np.diff(group[order], prepend=-1))
    first[order] = np.repeat(order[start], np.diff(start, append=len(order)))
    return first


def _pairs(tracks: Table, rows: Rows) -> tuple[Rows, Rows]:
    """Return all pairs of rows of one event and mass hypothesis."""
    rows = rows[np.lexsort((tracks["hypothesis"][rows], tracks["event"][rows]))]
    event, kind = tracks["event"][rows], tracks["hypothesis"][rows]
    pairs = []
    for step in range(1, len(rows)):
        same = np.flatnonzero((event[step:] == event[:-step]) & (kind[step:] == kind[:-step]))
        if not len(same):
            break
        pairs.append((rows[same], rows[same + step]))
    none = (np.zeros(0, np.int64), np.zeros(0, np.int64))
    one, other = (np.concatenate(side) for side in zip(none, *pairs, strict=True))
    return one, other


def _groups(n: int, first: Rows, other: Rows, chi2: Floats) -> Rows:
    """Return a number per row, the same for linked ones: best pairs first, if no two rows of the group disagree."""
    group, members = np.arange(n), {row: [row] for row in {*first.tolist(), *other.tolist()}}
    pairs = sorted(zip(chi2.tolist(), first.tolist(), other.tolist(), strict=True))
    apart = {frozenset(pair) for value, *pair in pairs if value >= GATE}
    for value, a, b in pairs:
        if value >= GATE:
            break
        group_a, added = int(group[a]), int(group[b])
        if group_a != added and not any(frozenset((i, k)) in apart for i in members[group_a] for k in members[added]):
            members[group_a] += members.pop(added)
            group[members[group_a]] = group_a
    return group


def pair_chi2(tracks: Table, first: Rows, other: Rows, bz: float) -> Floats:
    """Return how badly tracks agree with two half turns of one particle.

    Parameters
    ----------
    tracks : Table of kind "tracks"
    first, other : ndarray, (pairs,) int64
        Rows.
    bz : float
        T.

    Returns
    -------
    ndarray, (pairs,) float64
        Chi-square of five terms.
    """
    helices = np.stack([tracks[name] for name in PARAMETERS], axis=1)
    a, b = helices[first], helices[other].copy()
    opposite = a[:, _KAPPA] * b[:, _KAPPA] < 0
    b[opposite] = _reversed(b[opposite])
    variance = np.stack([tracks["cov"][:, k, k] for k in range(len(PARAMETERS))], axis=1)
    variance = variance[first] + variance[other]
    radius = np.abs(RADIUS_PER_KAPPA / bz) / np.sqrt(np.abs(a[:, _KAPPA] * b[:, _KAPPA]))
    slope = 0.5 * (a[:, _TANL] + b[:, _TANL])
    kappa = np.log(b[:, _KAPPA] / a[:, _KAPPA])
    loose_kappa = variance[:, _KAPPA] / (a[:, _KAPPA] * b[:, _KAPPA]) + LOSS**2
    advance = 2 * np.pi * radius * slope
    turns = _turns(b[:, _DZ] - a[:, _DZ], advance, opposite)
    # The mean of two slopes and radii has a quarter of the summed variance.
    spread = (2 * np.pi * radius) ** 2 * (variance[:, _TANL] + slope**2 * loose_kappa) / 4
    azimuth = wrap_angle(b[:, _PHI0] - a[:, _PHI0])
    terms = (
        (b[:, _DR] - a[:, _DR], variance[:, _DR] + (0.5 * LOSS * radius) ** 2),
        (azimuth, variance[:, _PHI0] + LOSS**2),
        (kappa, loose_kappa),
        (b[:, _TANL] - a[:, _TANL], variance[:, _TANL] + (0.25 * LOSS * (1 + slope**2)) ** 2),
        (b[:, _DZ] - a[:, _DZ] - turns * advance, variance[:, _DZ] + turns**2 * spread),
    )
    return np.asarray(sum(difference**2 / width for difference, width in terms), np.float64)


def _reversed(helix: Floats) -> Floats:
    """Return the helices of the same circles flown in the opposite direction."""
    dr, phi0, kappa, dz, tanl = helix.T
    return np.stack([-dr, phi0 + np.pi, -kappa, dz, -tanl], axis=1)


def _turns(difference: Floats, advance: Floats, opposite: npt.NDArray[np.bool_]) -> Floats:
    """Return the whole turns between two perigees; half turns in the same direction do not share one."""
    ratio = np.divide(difference, advance, out=np.zeros_like(advance), where=advance != 0)
    turns = np.clip(np.rint(ratio), -MOST_TURNS, MOST_TURNS)
    return np.where(~opposite & (turns == 0), np.where(ratio < 0, -1.0, 1.0), turns)


def _distance(tracks: Table) -> Floats:
    """Return how far tracks start from the origin, in standard deviations of their errors and of vertices."""
    along, across = VERTEX
    cov = tracks["cov"]
    return np.asarray(
        tracks["dz"] ** 2 / (cov[:, _DZ, _DZ] + along**2) + tracks["dr"] ** 2 / (cov[:, _DR, _DR] + across**2)
    )
