"""Residuals and efficiencies of hits on tracks, measured or simulated, without truth (docs/how-to/monitor.md)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.analysis.widths import Fraction
from cgemit.base.arrays import Flags, Floats
from cgemit.chain.result import Result
from cgemit.chain.settings import Settings, fit_settings
from cgemit.detector import Detector
from cgemit.detector.core import layer_table
from cgemit.detector.parts import cgem_numbers
from cgemit.helix import wrap_angle
from cgemit.reconstruction.fit import FitSettings, fit
from cgemit.reconstruction.states import crossings_of
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, is_fitted
from cgemit.tables.show import Shown, Tabular, with_error

#: Names of the views of hits.
VIEWS = ("X", "V", "wire")
#: Largest residual, in its errors, of hits that count for means and widths; hits of something else lie beyond.
LARGEST_PULL = 5.0
#: Hits that a mean or a width needs.
LEAST = 2
#: Distance from the predicted position within which a layer has seen a track, mm in X and V, and the part of a layer
#: beside edges of sheets and at its ends that does not count, mm.
NEAR, BORDER = 5.0, 5.0


@dataclass(frozen=True, eq=False, repr=False)
class HitResiduals(Shown, Tabular):
    """Residuals of hits from the tracks fitted without them, one row for each hit of a fitted track.

    Attributes
    ----------
    event, track : ndarray, (n,) int64
        Number of the event, and row of ``tracks``.
    view : ndarray, (n,) int8
        0 X, 1 V, 2 wire.
    layer, sheet : ndarray, (n,) int64
        Sheet is 0 for wires.
    hit : ndarray, (n,) int64
        Row of ``clusters`` or ``wire_hits``.
    residual, err, own : ndarray, (n,) float64, mm
        Measured minus predicted, its standard deviation, and the standard deviation of the hit alone.
    used : ndarray, (n,) bool
        Whether the fit used the hit.
    size : ndarray, (n,) int64
        Strips of a cluster; 1 for wires.
    charge : ndarray, (n,) float64, fC
        NaN for wires.
    time : ndarray, (n,) float64, ns
        Of the cluster, or drift time.
    phi, z : ndarray, (n,) float64, rad, mm
        Of the track at the hit.
    incidence : ndarray, (n,) float64, rad
        Angle of the track to the radius.
    p : ndarray, (n,) float64, GeV/c
        Momentum of the track there.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> hits = cg.study.hit_residuals(r)
    >>> sorted(set(hits.view.tolist())), bool(abs(hits.p - 1).max() < 0.1)
    ([0, 1, 2], True)
    """

    event: npt.NDArray[np.int64]
    track: npt.NDArray[np.int64]
    view: npt.NDArray[np.int8]
    layer: npt.NDArray[np.int64]
    sheet: npt.NDArray[np.int64]
    hit: npt.NDArray[np.int64]
    residual: Floats
    err: Floats
    own: Floats
    used: Flags
    size: npt.NDArray[np.int64]
    charge: Floats
    time: Floats
    phi: Floats
    z: Floats
    incidence: Floats
    p: Floats

    def __len__(self) -> int:
        return len(self.event)

    @property
    def pull(self) -> Floats:
        """Residual over its error, (n,) float64."""
        return self.residual / self.err

    @property
    def counts(self) -> Flags:
        """Which hits count for means and widths: those within five errors, (n,) bool."""
        return np.abs(self.pull) < LARGEST_PULL

    def columns(self) -> dict[str, Sequence[Any]]:
        """Return the rows as columns."""
        return {**{name: one.tolist() for name, one in vars(self).items()}, "pull": self.pull.tolist()}

    def select(self, rows: npt.NDArray[Any]) -> HitResiduals:
        """Return some of the rows.

        Parameters
        ----------
        rows : ndarray
            A mask, or numbers of rows.
        """
        return HitResiduals(**{name: one[rows] for name, one in vars(self).items()})

    def binned(self, by: str, edges: npt.ArrayLike | None = None) -> ResidualTable:
        """Return means and widths by view and by a column.

        Parameters
        ----------
        by : str
            A column, such as ``"layer"``, ``"sheet"``, ``"size"``, ``"charge"``, ``"time"``, ``"incidence"``,
            ``"phi"`` or ``"z"``.
        edges : array_like, (m,) float64, or None
            Edges of the bins; a value beyond them does not count. None: whole numbers have a bin each, other columns
            eight bins with equal numbers of hits of a view.

        Raises
        ------
        ValueError
            If there is no such column, or the edges do not grow.
        """
        if by not in vars(self) or by == "view":
            known = ", ".join(name for name in vars(self) if name != "view")
            raise ValueError(f"binned: by: got {by!r}, expected one of {known}")
        values, bounds, whole = vars(self)[by].astype(np.float64), _given(edges), vars(self)[by].dtype.kind in "iu"
        rows: dict[str, list[float]] = {name: [] for name in _RESIDUALS}
        for view in np.unique(self.view).tolist():
            mine = (self.view == view) & np.isfinite(values)
            own = bounds if bounds is not None else _edges(values[mine & self.counts], whole)
            for low, high, inside in _bins(values, own, whole):
                if (mine & inside).any():
                    _append(rows, float(view), low, high, self.select(mine & inside))
        return ResidualTable(by, **{name: np.array(column, np.float64) for name, column in rows.items()})

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        return self.binned("layer")._table()


_RESIDUALS = ("view", "low", "high", "n", "far", "mean", "err_mean", "rms", "err_rms", "pull", "err_pull")


@dataclass(frozen=True, eq=False, repr=False)
class ResidualTable(Shown, Tabular):
    """Means and widths of residuals in bins, one row for each.

    Attributes
    ----------
    by : str
        The column of the bins.
    view, low, high : ndarray, (n,) float64
        View (0 X, 1 V, 2 wire) and edges of the bin.
    n, far : ndarray, (n,) float64
        Hits, and those of them more than five errors away, which count for nothing else.
    mean, err_mean, rms, err_rms : ndarray, (n,) float64, mm
        NaN with fewer than two hits.
    pull, err_pull : ndarray, (n,) float64
        RMS of residual over error.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> table = cg.study.hit_residuals(r).binned("layer", edges=[0, 1, 2, 3])
    >>> table.by, table.low[:3].tolist()
    ('layer', [0.0, 1.0, 2.0])
    """

    by: str
    view: Floats
    low: Floats
    high: Floats
    n: Floats
    far: Floats
    mean: Floats
    err_mean: Floats
    rms: Floats
    err_rms: Floats
    pull: Floats
    err_pull: Floats

    def columns(self) -> dict[str, Sequence[Any]]:
        """Return the rows as columns."""
        return {name: getattr(self, name).tolist() for name in _RESIDUALS}

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        head = ("view", self.by, "hits", "far", "mean (um)", "RMS (um)", "pull")
        rows = [
            [
                VIEWS[int(self.view[i])],
                _bin_text(self.low[i], self.high[i]),
                f"{self.n[i]:.0f}", f"{self.far[i]:.0f}", with_error(1e3 * self.mean[i], 1e3 * self.err_mean[i]),
                with_error(1e3 * self.rms[i], 1e3 * self.err_rms[i]), with_error(self.pull[i], self.err_pull[i]),
            ]
            for i in range(len(self.n))
        ]  # fmt: skip
        return "residuals from tracks fitted without the hit", head, rows


def _given(edges: npt.ArrayLike | None) -> Floats | None:
    """Return edges of bins as they were given."""
    bounds = None if edges is None else np.asarray(edges, np.float64)
    if bounds is not None and (bounds.ndim != 1 or len(bounds) < 2 or not (np.diff(bounds) > 0).all()):
        raise ValueError(f"binned: edges: got {edges!r:.60}, expected two or more numbers that grow")
    return bounds


def _bins(values: Floats, edges: Floats, whole: bool) -> Iterator[tuple[float, float, Flags]]:
    """Yield the edges of each bin and which values lie in it; the last one has its upper edge unless `whole`."""
    for low, high in pairwise(edges.tolist()):
        below = values <= high if high == edges[-1] and not whole else values < high
        yield low, high, (values >= low) & below


def _bin_text(low: float, high: float) -> str:
    return f"{low:g}" if high == low + 1 else f"{low:.3g} to {high:.3g}"


def _edges(values: Floats, whole: bool) -> Floats:
    """Return the edges of the bins of some values."""
    if not len(values):
        return np.zeros(0)
    if whole:
        return np.arange(values.min(), values.max() + 2)
    edges = np.unique(np.quantile(values, np.linspace(0, 1, 9)))
    return edges if len(edges) > 1 else np.array([edges[0] - 0.5, edges[0] + 0.5])


def _append(rows: dict[str, list[float]], view: float, low: float, high: float, of: HitResiduals) -> None:
    near = of.select(of.counts)
    n = len(near)
    known = n >= LEAST
    mean = float(near.residual.mean()) if known else np.nan
    rms = float(near.residual.std(ddof=1)) if known else np.nan
    pull = float(np.sqrt(np.mean(near.pull**2))) if known else np.nan
    half = np.sqrt(2 * max(n - 1, 1))
    values = (view, low, high, len(of), len(of) - n, mean, rms / np.sqrt(max(n, 1)), rms, rms / half, pull, pull / half)
    for name, value in zip(_RESIDUALS, values, strict=True):
        rows[name].append(float(value))


def hit_residuals(result: Result) -> HitResiduals:
    """Return the residuals of all hits of the fitted tracks, each from the track fitted without it.

    Tracks are fitted again from their hits as the last fit took them. Only tracks with a measured momentum count.

    Parameters
    ----------
    result : Result
        Of `run` or of `cgemit.bes3.reconstruct.reconstruct_events`.

    Raises
    ------
    ValueError
        If the result has no tracks.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> found = cg.study.hit_residuals(r)
    >>> table = found.binned("layer", edges=[0, 1, 2, 3])
    >>> table.view[:3].tolist(), bool((table.pull < 2).all())
    ([0.0, 0.0, 0.0], True)
    """
    _check_fitted(result, "hit_residuals")
    clusters, wires = result.fitted_hits
    return residuals_of(result, clusters, wires)


def _check_fitted(result: Result, function: str) -> None:
    """Raise an error of a function if a result has no tracks with their hits."""
    if not {"tracks", "candidate_hits"} <= result.tables.keys():
        raise ValueError(f"{function}: got a result without tracks and their hits, expected one of a fit")


def residuals_of(result: Result, clusters: Table, wires: Table) -> HitResiduals:
    """Return the same of other hits, row by row those of the result, such as with other errors."""
    how = replace(_plain(result.settings), residuals=True, states=("hits",))
    made = fit.unchecked(result.detector, clusters, wires, result.candidates, result.candidate_hits, how)
    of, states = made["residuals"], made["states"]
    good = is_fitted(made["tracks"])[of["track"]] & (of["err"] > 0)
    of = of[good]
    view, hit = of["view"], of["hit"].astype(np.int64)
    is_wire = view == HIT_WIRE
    at = _state_rows(of, states)

    def joined(of_cluster: str, of_wire: str | None, none: float) -> npt.NDArray[Any]:
        column = np.full(len(of), none)
        column[~is_wire] = clusters[of_cluster][hit[~is_wire]]
        if of_wire is not None:
            column[is_wire] = wires[of_wire][hit[is_wire]]
        return column

    x, y, z, px, py, pz = (states[name][at] for name in ("x", "y", "z", "px", "py", "pz"))
    p, incidence = _direction(x, y, px, py, pz)
    layer = np.where(is_wire, joined("layer", "layer", 0), joined("layer", None, 0)).astype(np.int64)
    own = np.where(view == 0, joined("err_x", "sigma", np.nan), joined("err_v", "sigma", np.nan))
    return HitResiduals(
        event=of["event"].astype(np.int64), track=of["track"].astype(np.int64), view=view.astype(np.int8),
        layer=layer, sheet=joined("sheet", None, 0).astype(np.int64), hit=hit,
        residual=of["residual"], err=of["err"], own=own, used=of["used"] == 1,
        size=joined("size", None, 1).astype(np.int64), charge=joined("charge", None, np.nan),
        time=joined("time", "drift_time", np.nan), phi=np.arctan2(y, x), z=z,
        incidence=incidence, p=p,
    )  # fmt: skip


def _state_rows(of: Table, states: Table) -> npt.NDArray[np.int64]:
    """Return the row of the state at each residual's hit."""
    names = ("track", "view", "hit")
    rows = {key: i for i, key in enumerate(zip(*(states[name].tolist() for name in names), strict=True))}
    return np.array([rows[key] for key in zip(*(of[name].tolist() for name in names), strict=True)], np.int64)


_SHARES = ("x", "v", "both")


@dataclass(frozen=True, eq=False, repr=False)
class LayerEfficiencies(Shown, Tabular):
    """Shares of tracks that layers have seen, one row for each layer and region.

    Attributes
    ----------
    label : list of str
        Of the layer.
    region : list of str
        ``"all"``, a sheet, ``"-z"`` and ``"+z"``, or the bin of a column.
    low, high : ndarray, (n,) float64
        Edges of the bin; NaN for regions that are none.
    tracks : ndarray, (n,) int64
        Tracks that cross the region away from its borders.
    x, v, both : ndarray, (n,) float64
        Shares with an X cluster, a V cluster and both near the track; NaN without tracks.
    x_low, x_high, v_low, v_high, both_low, both_high : ndarray, (n,) float64
        Limits of the 68 % intervals of Wilson, which stay within 0 and 1; NaN without tracks.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> found = cg.study.layer_efficiencies(r)
    >>> sorted(set(found.label)), found.region[0], bool(found.both_high.max() <= 1)
    (['L1', 'L2', 'L3'], 'all', True)
    """

    label: list[str]
    region: list[str]
    low: Floats
    high: Floats
    tracks: npt.NDArray[np.int64]
    x: Floats
    x_low: Floats
    x_high: Floats
    v: Floats
    v_low: Floats
    v_high: Floats
    both: Floats
    both_low: Floats
    both_high: Floats

    def columns(self) -> dict[str, Sequence[Any]]:
        """Return the rows as columns."""
        return {name: list(column) for name, column in vars(self).items()}

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        rows = [
            [self.label[i], self.region[i], f"{self.tracks[i]}", *(self._share(name, i) for name in _SHARES)]
            for i in range(len(self.label))
        ]
        return "efficiency of layers", ("layer", "region", "tracks", "X (%)", "V (%)", "X and V (%)"), rows

    def _share(self, name: str, i: int) -> str:
        """Return a share and how far its interval reaches on either side."""
        value, low, high = (100 * getattr(self, key)[i] for key in (name, f"{name}_low", f"{name}_high"))
        return f"{value:.1f} +{high - value:.1f} -{value - low:.1f}" if self.tracks[i] else "-"


def _efficiencies(rows: Sequence[tuple[str, str, float, float, LayerCrossings]]) -> LayerEfficiencies:
    """Return the shares of crossings with clusters, each with label, region and edges."""
    label, region, low, high, crossings = zip(*rows, strict=True) if rows else ((),) * 5
    columns: dict[str, list[float]] = {f"{name}{end}": [] for name in _SHARES for end in ("", "_low", "_high")}
    for mine in crossings:
        for name, seen in zip(_SHARES, (mine.has_x, mine.has_v, mine.has_x & mine.has_v), strict=True):
            share = Fraction(int(np.count_nonzero(seen)), len(mine))
            ends = (share.value, *share.interval())
            for end, value in zip(("", "_low", "_high"), ends, strict=True):
                columns[f"{name}{end}"].append(value)
    return LayerEfficiencies(
        list(label), list(region), np.array(low, np.float64), np.array(high, np.float64),
        np.array([len(mine) for mine in crossings], np.int64),
        **{name: np.array(column, np.float64) for name, column in columns.items()},
    )  # fmt: skip


@dataclass(frozen=True, eq=False, repr=False)
class LayerCrossings(Shown, Tabular):
    """Tracks that cross CGEM layers away from their borders, fitted without the layer's hits, one row for each.

    Attributes
    ----------
    labels : dict of int to str
        Of all CGEM layers, by number.
    event, track : ndarray, (n,) int64
        Number of the event, and row of ``tracks``.
    layer, sheet : ndarray, (n,) int64
    phi, z : ndarray, (n,) float64, rad, mm
        Where the track crosses, in the layer's axes.
    incidence : ndarray, (n,) float64, rad
        Angle of the track to the radius.
    p : ndarray, (n,) float64, GeV/c
    time : ndarray, (n,) float64, ns
        Start of the event in the readout window; NaN without start times.
    has_x, has_v : ndarray, (n,) bool
        Whether an X and a V cluster are near.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> found = cg.study.layer_crossings(r)
    >>> bool(found.has_x.mean() > 0.9), int(found.binned("z", [-400, 0, 400]).tracks.sum()) == len(found)
    (True, True)
    """

    labels: dict[int, str]
    event: npt.NDArray[np.int64]
    track: npt.NDArray[np.int64]
    layer: npt.NDArray[np.int64]
    sheet: npt.NDArray[np.int64]
    phi: Floats
    z: Floats
    incidence: Floats
    p: Floats
    time: Floats
    has_x: Flags
    has_v: Flags

    def __len__(self) -> int:
        return len(self.event)

    def columns(self) -> dict[str, Sequence[Any]]:
        """Return the rows as columns."""
        return {name: one.tolist() for name, one in vars(self).items() if name != "labels"}

    def select(self, rows: npt.NDArray[Any]) -> LayerCrossings:
        """Return some of the rows.

        Parameters
        ----------
        rows : ndarray
            A mask, or numbers of rows.
        """
        return LayerCrossings(self.labels, **{n: one[rows] for n, one in vars(self).items() if n != "labels"})

    def binned(self, by: str, edges: npt.ArrayLike | None = None) -> LayerEfficiencies:
        """Return efficiencies by layer and by a column.

        Parameters
        ----------
        by : str
            ``"event"``, ``"sheet"``, ``"phi"``, ``"z"``, ``"incidence"``, ``"p"`` or ``"time"``.
        edges : array_like, (m,) float64, or None
            Edges of the bins; a value beyond them does not count. None: as `HitResiduals.binned`.

        Raises
        ------
        ValueError
            If there is no such column, or the edges do not grow.
        """
        known = ("event", "sheet", "phi", "z", "incidence", "p", "time")
        if by not in known:
            raise ValueError(f"binned: by: got {by!r}, expected one of {', '.join(known)}")
        values, bounds, whole = vars(self)[by].astype(np.float64), _given(edges), by == "sheet"
        rows = []
        for number, label in self.labels.items():
            mine = (self.layer == number) & np.isfinite(values)
            own = bounds if bounds is not None else _edges(values[mine], whole)
            for low, high, inside in _bins(values, own, whole):
                if (mine & inside).any():
                    rows.append((label, _bin_text(low, high), low, high, self.select(mine & inside)))
        return _efficiencies(rows)

    def _table(self) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
        return self.regions()._table()

    def regions(self) -> LayerEfficiencies:
        """Return the efficiencies of whole layers, their sheets, and both halves along the beam."""
        rows = []
        for number, label in self.labels.items():
            own = self.select(self.layer == number)
            sheets = np.unique(own.sheet).tolist()
            regions = {"all": np.ones(len(own), np.bool_)}
            if len(sheets) > 1:
                regions |= {f"sheet {i}": own.sheet == i for i in sheets}
            regions |= {"-z": own.z < 0, "+z": own.z >= 0}
            rows += [(label, name, np.nan, np.nan, own.select(mine)) for name, mine in regions.items()]
        return _efficiencies(rows)


def layer_efficiencies(result: Result, near: float = NEAR) -> LayerEfficiencies:
    """Count how many tracks have clusters in each CGEM layer, and in its regions; see `layer_crossings`.

    Parameters
    ----------
    result : Result
    near : float
        mm, largest distance in X and in V.

    Raises
    ------
    ValueError
        If the result has no tracks, or `near` is not positive.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=50, readout="tiger")
    >>> found = cg.study.layer_efficiencies(r)
    >>> found.label[0], found.region[0], bool(found.both[0] > 0.9)
    ('L1', 'all', True)
    """
    return layer_crossings(result, near).regions()


def layer_crossings(result: Result, near: float = NEAR) -> LayerCrossings:
    """Return where tracks cross CGEM layers, fitted without the layer's hits, and whether clusters are near.

    A track counts with its own hits of other layers, and clusters of any kind near it: whether the finder took the
    cluster plays no role. Tracks that cross within 5 mm of a border of a sheet, or of an end of the layer, do not
    count, and tracks whose prediction has an error above a third of `near` do not either.

    Parameters
    ----------
    result : Result
    near : float
        mm, largest distance in X and in V.

    Raises
    ------
    ValueError
        If the result has no tracks, or `near` is not positive.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=(-0.7, 0.7)), n=20, readout="tiger")
    >>> found = cg.study.layer_crossings(r)
    >>> sorted(set(found.layer.tolist())), bool(abs(found.p - 1).max() < 0.1)
    ([0, 1, 2], True)
    """
    _check_fitted(result, "layer_crossings")
    if not near > 0:
        raise ValueError(f"layer_crossings: near: got {near}, expected a positive distance in mm")
    parts = [_crossings(result, number, near) for number in cgem_numbers(result.detector)]
    names = [name for name in LayerCrossings.__dataclass_fields__ if name != "labels"]
    columns: dict[str, Any] = {
        name: np.concatenate([part[name] for part in parts]) if parts else np.zeros(0) for name in names
    }
    labels = {number: result.detector.layers[number].label for number in cgem_numbers(result.detector)}
    return LayerCrossings(labels, **columns)


def _crossings(result: Result, number: int, near: float) -> dict[str, npt.NDArray[Any]]:
    """Return the columns of `LayerCrossings` of one layer."""
    detector, layer = result.detector, result.detector.layers[number]
    clusters, wires = result.fitted_hits
    hits = result.candidate_hits
    here = (hits["view"] != HIT_WIRE) & (_layers_of(hits, clusters) == number)
    made = fit.unchecked(detector, clusters, wires, result.candidates, hits[~here], _plain(result.settings))
    fitted = np.flatnonzero(is_fitted(made["tracks"]))
    at = crossings_of(detector, made["tracks"][fitted], number)
    width = layer.r_readout * 2 * np.pi / layer.sheets
    low, high = layer.ends
    fine = (at.x > BORDER) & (at.x < width - BORDER) & (at.z > low + BORDER) & (at.z < high - BORDER)
    fine &= np.sqrt(np.maximum(at.cov[:, 0, 0], at.cov[:, 1, 1])) < near / 3
    states = at.states[fine]
    mine = clusters[clusters["layer"] == number]
    has = {HIT_X: np.zeros(len(states), np.bool_), HIT_V: np.zeros(len(states), np.bool_)}
    for i, k in enumerate(np.flatnonzero(fine).tolist()):
        own = mine[mine["event"] == at.states["event"][k]]
        xs, vs = own[own["view"] == HIT_X], own[own["view"] == HIT_V]
        has[HIT_X][i] = (np.abs(layer.r_readout * wrap_angle(xs["phi"] - at.phi[k])) < near).any()
        has[HIT_V][i] = ((np.abs(vs["v"] - at.v[k]) < near) & (vs["sheet"] == at.sheet[k])).any()
    begin = np.full(len(states), np.nan)
    if result.start_times is not None:
        begin = result.start_times["start_time"][np.searchsorted(result.start_times["event"], states["event"])]
    p, incidence = _direction(*(states[name] for name in ("x", "y", "px", "py", "pz")))
    return {
        "event": states["event"].astype(np.int64), "track": fitted[states["track"]],
        "layer": np.full(len(states), number), "sheet": at.sheet[fine], "phi": at.phi[fine], "z": at.z[fine],
        "incidence": incidence, "p": p, "time": begin, "has_x": has[HIT_X], "has_v": has[HIT_V],
    }  # fmt: skip


def _direction(x: Floats, y: Floats, px: Floats, py: Floats, pz: Floats) -> tuple[Floats, Floats]:
    """Return momentum and angle to the radius at points."""
    p = np.sqrt(px**2 + py**2 + pz**2)
    outward = np.abs(x * px + y * py) / (np.hypot(x, y) * p)
    return p, np.arccos(np.clip(outward, 0, 1))


def _plain(settings: Settings) -> FitSettings:
    """Return the settings of a fit with one mass, without beam spot and densities of electrons."""
    given = fit_settings(settings)
    one = given.hypothesis if len(given.hypotheses()) == 1 else "pi"
    return replace(given, components=False, beam=None, hypothesis=one)


def _layers_of(hits: Table, clusters: Table) -> npt.NDArray[np.int64]:
    """Return the layers of the clusters of candidates, -1 for wires."""
    layers = np.full(len(hits), -1, np.int64)
    of_cluster = hits["view"] != HIT_WIRE
    layers[of_cluster] = clusters["layer"][hits["hit"][of_cluster]]
    return layers


def strip_status(detector: Detector, digis: Table) -> npt.NDArray[np.int8]:
    """Return a mask of hot and dead strips of CGEM layers, from how often each fires.

    A strip is hot if it fires in more events than five standard deviations above the median of 31 neighbours of its
    view and sheet, and dead if it never fires where, at that rate, fewer than one of a million strips would be silent.
    Few events show neither.

    Parameters
    ----------
    detector : Detector
    digis : Table
        Of kind ``digis``.

    Returns
    -------
    ndarray, (strips,) int8
        By `gid`: 1 hot, -1 dead, 0 neither.

    Examples
    --------
    >>> muons = cg.Gun("mu-", p=1.0, cos_theta=0.3)
    >>> r = cg.run("besiii-cgem", muons, n=5, until="digitize")
    >>> int(np.count_nonzero(cg.study.strip_status(r.detector, r.digis)))
    0
    """
    table = layer_table(detector.layers)
    strips = [layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.layers]
    first = table["gid_first"]
    total = int(first[-1] + strips[-1]) if len(first) else 0
    has_strip = digis["gid"] >= 0
    pairs = np.unique(np.stack([digis["event"][has_strip], digis["gid"][has_strip]]), axis=1)
    fires = np.bincount(pairs[1], minlength=total)
    status = np.zeros(total, np.int8)
    for number in cgem_numbers(detector):
        layer = detector.layers[number]
        for sheet in range(layer.sheets):
            begin = int(first[number]) + sheet * (layer.strips_x + layer.strips_v)
            for mine in (
                slice(begin, begin + layer.strips_x),
                slice(begin + layer.strips_x, begin + layer.strips_x + layer.strips_v),
            ):
                status[mine] = _status(fires[mine])
    return status


#: Standard deviations above which a strip is hot, probability of a dead one by chance, and strips on either side that
#: tell how often one should fire.
_HOT, _CHANCE, _BESIDE = 5.0, 1e-6, 15


def _status(fires: npt.NDArray[np.int64]) -> npt.NDArray[np.int8]:
    """Return hot and dead strips of one view of one sheet."""
    padded = np.pad(fires.astype(np.float64), _BESIDE, mode="reflect" if len(fires) > _BESIDE else "edge")
    around = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * _BESIDE + 1), axis=1)
    status = np.zeros(len(fires), np.int8)
    status[fires > around + _HOT * np.sqrt(around + 1)] = 1
    status[(fires == 0) & (around > -np.log(_CHANCE))] = -1
    return status
