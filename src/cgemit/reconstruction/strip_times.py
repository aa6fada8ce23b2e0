"""When an event began in the times of its strips (docs/methods/reconstruct.md).

Strips with time measure when the electrons of a track arrive: evenly over the drift time of the whole gap. The times of
an experiment count from another moment. This moment follows from the times themselves, or from the start times of the
wires and a constant between both electronics.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from cgemit.base.arrays import Flags, Floats
from cgemit.detector import Detector, ReadoutGroup
from cgemit.detector.channels import checked
from cgemit.detector.readouts import AnalogReadout
from cgemit.reconstruction.cluster_errors import chip_delays
from cgemit.reconstruction.clusterers.charge import ChargeTimeClusterer
from cgemit.tables import Table

#: Standard deviation of the time of a strip about the arrival of its charge, ns.
STRIP_ERROR = 10.0
#: Share of the strips with a neighbour that belong to something else than the event, and the time over which these are
#: spread, ns. An event begins where its own strips are most likely.
OTHERS, SPREAD = 0.5, 1000.0
#: Steps of the search, ns; another time counts as possible if its likelihood is within 4.5 of the best, three standard
#: deviations, and further away than a strip's whole drift time is resolved.
STEP, UNLIKELY, APART = 2.0, 4.5, 60.0
#: Strips with a neighbour that an event needs.
LEAST_STRIPS = 6
#: Part of a gap that a strip sees, as a time in ns, for the delay of the chip.
SEEN = 40.0


class StripTimeStatus(enum.IntEnum):
    """How the search for the start of an event in its strips ended; 0 is good.

    Examples
    --------
    >>> cg.StripTimeStatus.ok.value, [status.name for status in cg.StripTimeStatus][:3]
    (0, ['ok', 'no_strips', 'ambiguous'])
    """

    ok = 0
    no_strips = 1
    ambiguous = 2


class Arrivals(NamedTuple):
    """Times of strips after the arrival of the first electrons that a track in the gap can have.

    Attributes
    ----------
    time : ndarray, (digis,) float64, ns
        NaN for digis of layers whose readout has no time.
    longest : ndarray, (digis,) float64, ns
        Drift time of the whole gap.
    margin : ndarray, (digis,) float64, ns
        By how much a strip may lie outside of it and still enter a cluster.
    paired : ndarray, (digis,) bool
        Whether a strip beside it has fired.
    """

    time: Floats
    longest: Floats
    margin: Floats
    paired: Flags


@checked("digis", ignore=("gid",))
def strip_times(detector: Detector, digis: Table, start: npt.ArrayLike | None = None) -> Table:
    """Find when each event began in the times of its strips.

    The electrons of a track arrive evenly over the drift time T of a gap. A strip of an event that began at t0 has the
    probability density (Phi((t - t0)/s) - Phi((t - t0 - T)/s))/T after the delays of layer, flight and chip, s = 10 ns;
    a constant density stands for strips of something else. Strips without a fired neighbour do not count. The result is
    the mean of the likelihood about its maximum.

    Without `start`, each event tells its own time: a track of 1 GeV/c to 11 ns, and another particle that crosses at
    another time can take its place. With the start times of the wires, all events share one constant between both
    electronics, whose error falls with the number of events.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
        With readouts that measure time.
    digis : Table
        Of kind ``digis``, with times as the experiment counts them.
    start : array_like, (events,) float64, or None
        ns, start of each event by its wires, whatever these count from. Events without one (NaN) tell their own time.

    Returns
    -------
    Table of kind "strip_times"
        One row for each event. `Table.meta` has ``offset`` and ``err_offset``, ns: the constant between strips and
        `start`, NaN without `start`.

    Raises
    ------
    ValueError
        If no layer has strips with time, or there is another number of start times than of events.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=50, readout="tiger", until="digitize")
    >>> late = r.digis.with_columns(time=r.digis["time"] - 8000.0)  # ns
    >>> found = cg.strip_times(r.detector, late, start=np.zeros(50))
    >>> abs(found.meta["offset"] + 8000) < 5 * found.meta["err_offset"] < 25
    True
    >>> clusters = cg.cluster(r.detector, cg.from_start(late, found))
    """
    events = digis.events
    n = len(events)
    if start is not None:
        start = np.asarray(start, np.float64)
        if start.shape != (n,):
            raise ValueError(f"strip_times: start: got shape {start.shape}, expected one for each of {n} events")
    arrivals = arrivals_of(detector, digis)
    event = np.searchsorted(events, digis["event"])
    count = np.isfinite(arrivals.time) & arrivals.paired
    used = np.bincount(event[count], minlength=n)
    time, err = np.full(n, np.nan), np.full(n, np.nan)
    status = np.full(n, StripTimeStatus.no_strips, np.int8)
    offset = err_offset = np.nan
    enough = used >= LEAST_STRIPS
    known = enough & np.isfinite(start) if start is not None else np.zeros(n, np.bool_)
    if known.any():
        assert start is not None
        rows = count & known[event]
        offset, err_offset, _ = _most_likely(arrivals, rows, start[event])
        known = np.isfinite(start)
        time[known], err[known], status[known] = start[known] + offset, err_offset, StripTimeStatus.ok
    for i in np.flatnonzero(enough & ~known).tolist():
        time[i], err[i], alone = _most_likely(arrivals, count & (event == i), np.zeros(len(digis)))
        status[i] = StripTimeStatus.ok if alone else StripTimeStatus.ambiguous
    after = arrivals.time - time[event]
    inside = (after >= -arrivals.margin) & (after <= arrivals.longest + arrivals.margin)
    outside = np.isfinite(arrivals.time) & ~inside
    columns = {
        "event": events, "strip_time": time, "err_strip_time": err, "n_strips": used,
        "n_outside": np.bincount(event[outside], minlength=n), "status": status,
    }  # fmt: skip
    meta = {"offset": float(offset), "err_offset": float(err_offset)}
    return Table("strip_times", columns, meta=meta, **digis.cover)


def from_start(digis: Table, times: Table) -> Table:
    """Return digis whose times count from the start of their events; those of events without one are left out.

    Parameters
    ----------
    digis : Table
        Of kind ``digis``.
    times : Table
        Of `strip_times` of these digis.

    Raises
    ------
    ValueError
        If the tables are of other events.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=5, readout="tiger", until="digitize")
    >>> late = r.digis.with_columns(time=r.digis["time"] + 300.0)  # ns
    >>> again = cg.from_start(late, cg.strip_times(r.detector, late))
    >>> bool(np.abs(again["time"] - r.digis["time"]).max() < 60)
    True
    """
    if not np.array_equal(digis.events, times["event"]):
        raise ValueError("from_start: times: got those of other events, expected a row for each event of the digis")
    begin = times["strip_time"][np.searchsorted(times["event"], digis["event"])]
    timed = np.isfinite(digis["time"])
    begin = np.where(timed, begin, 0.0)
    counted: Table = digis.with_columns(time=digis["time"] - begin)[np.isfinite(begin)]
    return counted


def arrivals_of(detector: Detector, digis: Table) -> Arrivals:
    """Return when the charge of strips arrived, if their event began at 0.

    Raises
    ------
    ValueError
        If no layer has strips with time.
    """
    groups = [group for group in detector.groups if isinstance(group.readout, AnalogReadout)]
    if not groups:
        raise ValueError(f"strip_times: {detector.name} has no readout with times, expected such as readout='tiger'")
    time, longest, margin = np.full((3, len(digis)), np.nan)
    for group in groups:
        _fill(group, digis, time, longest, margin)
    return Arrivals(time, longest, margin, _paired(digis))


def _fill(group: ReadoutGroup, digis: Table, time: Floats, longest: Floats, margin: Floats) -> None:
    """Set times, drift times of the gaps and margins of the digis of a group."""
    readout = group.readout
    assert isinstance(readout, AnalogReadout)
    timing = ChargeTimeClusterer(readout).strip_rules(group)["timing"]
    delays = chip_delays(group.detector, readout, group.numbers)
    n = len(group.layers)
    charges, late = delays["charges"].reshape(2 * n, -1), delays["delays"].reshape(2 * n, len(delays["spreads"]), -1)
    near = int(np.argmin(np.abs(delays["spreads"] - SEEN)))
    for i, (layer_number, layer) in enumerate(zip(group.numbers, group.layers, strict=True)):
        whole = (layer.r_gap_out - layer.r_gap_in) / timing["velocity"][i]
        for view in (0, 1):
            rows = np.flatnonzero((digis["layer"] == layer_number) & (digis["view"] == view))
            plane = view * n + i
            delay = np.interp(digis["charge"][rows], charges[plane], late[plane, near])
            time[rows] = digis["time"][rows] - timing["delay"][i] - delay
            longest[rows], margin[rows] = whole, readout.time_margin


def _paired(digis: Table) -> Flags:
    """Return which strips have a fired strip beside them, (digis,) bool."""
    keys = [digis[name] for name in ("strip", "view", "sheet", "layer", "event")]
    order = np.lexsort(keys)
    strip = digis["strip"][order].astype(np.int64)
    same = np.ones(max(len(order) - 1, 0), np.bool_)
    for key in keys[1:]:
        same &= np.diff(key[order]) == 0
    beside = same & (np.diff(strip) == 1)
    is_paired = np.zeros(len(order), np.bool_)
    is_paired[order[1:][beside]] = True
    is_paired[order[:-1][beside]] = True
    return is_paired


def _most_likely(arrivals: Arrivals, rows: Flags, start: Floats) -> tuple[float, float, bool]:
    """Return the most likely begin of strips after `start`, ns, its error, and whether there is no other."""
    time, longest = arrivals.time[rows] - start[rows], arrivals.longest[rows]
    grid = np.arange(time.min() - longest.max(), time.max() + STEP, STEP)
    likelihood = np.zeros(len(grid))
    for first in range(0, len(time), 1000):  # strips at a time, for memory
        block = slice(first, first + 1000)
        after = time[block, None] - grid
        inside = ndtr(after / STRIP_ERROR) - ndtr((after - longest[block, None]) / STRIP_ERROR)
        likelihood += np.log((1 - OTHERS) * inside / longest[block, None] + OTHERS / SPREAD).sum(axis=0)
    best = int(likelihood.argmax())
    near = np.abs(grid - grid[best]) < APART
    weight = np.where(near, np.exp(likelihood - likelihood[best]), 0.0)
    mean = float((weight * grid).sum() / weight.sum())
    error = float(np.sqrt((weight * (grid - mean) ** 2).sum() / weight.sum() + STEP**2 / 12))
    return mean, error, bool(likelihood[~near].max(initial=-np.inf) < likelihood[best] - UNLIKELY)
