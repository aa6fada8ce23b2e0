"""Pictures for a design: error budgets, sensitivities, sweeps and optimizations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, cycle
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.ticker import LogLocator, NullFormatter

from cgemit.analysis.quantities import KINEMATICS, QUANTITIES, quantity_of
from cgemit.base.arrays import Floats
from cgemit.covariance.result import Budget, By, Covariance
from cgemit.covariance.sensitivity import Sensitivity
from cgemit.draw.style import (
    COLORS,
    MARKERS,
    SERIES,
    Picture,
    fills,
    grid,
    legend_entries,
    mathematical,
    new_picture,
    plain,
    style,
)
from cgemit.tables.show import shown

_OTHER = "other"


def draw_budget(budget: Budget, by: By = "part", *, most: int = 8) -> Picture:
    """Draw the share of each group in the variance as stacked areas against momentum or polar angle.

    Parameters
    ----------
    budget : Budget
        At two momenta or more, in any order, and one cos(theta); or at one p or pT and several angles.
    by : str
        As for `Budget.grouped`.
    most : int
        Groups that are drawn: those with the largest mean share, the largest at the bottom. The rest is one group,
        ``other``.

    Returns
    -------
    Picture
        Points without a covariance are gaps; points are ticks of the lower axis. Momenta that span a factor of 5 have
        a logarithmic axis.

    Raises
    ------
    ValueError
        If `by` is not known, or the points are not a line of momenta or angles.

    Examples
    --------
    >>> budget = cg.analytic("besiii-cgem-design", p=[0.3, 0.5, 1.0]).budget("dr")
    >>> picture = cg.draw.draw_budget(budget)
    >>> picture.axes[0].get_xlabel()
    'p  (GeV/c)'
    """
    steep = np.ptp(budget.cos_theta) > 1e-12
    pt = budget.p * np.sqrt(1 - budget.cos_theta**2)
    fixed = [name for name, one in {"p": budget.p, "$p_T$": pt}.items() if np.ptp(one) <= 1e-9 * one.max(initial=0)]
    if budget.p.ndim != 1 or steep != bool(fixed) or not _is_count(most):
        raise ValueError(
            f"draw_budget: got points of shape {budget.p.shape}, cos(theta) {np.unique(budget.cos_theta)[:4]}, most "
            f"{most!r}; expected a list of two momenta or more at one cos(theta), or of angles at one p or pT, and "
            "most of at least 1"
        )
    every = budget.p if not steep else np.degrees(np.arccos(budget.cos_theta))
    order = np.argsort(every, kind="stable")
    x = every[order]
    shares = _shares(budget, by, most)
    edges = np.cumsum([np.zeros(len(x)), *(share[order] for share in shares.values())], axis=0)
    with style():
        width = 6.2 + 0.085 * max(map(len, shares))  # room for the legend
        picture, (axes,) = new_picture(1, 1, (width, 4.6))
        for number, (name, (colour, hatch)) in enumerate(zip(shares, fills(len(shares)), strict=True)):
            if name == _OTHER:
                colour, hatch = COLORS["matter"], ""
            low, high = edges[number], edges[number + 1]
            axes.fill_between(x, low, high, fc=colour, hatch=hatch, ec="white", lw=0, label=plain(name))
            axes.plot(x, high, color="white", lw=0.6)
        if not steep and x[-1] > 5 * x[0]:
            axes.set_xscale("log")
            _plain_numbers(axes.xaxis)
        axes.plot(x, np.zeros(len(x)), "|", color=COLORS["data"], ms=9, mew=0.9, clip_on=False, zorder=5)
        axes.set(xlim=(x[0], x[-1]), ylim=(0, 100), xlabel="θ  (deg)" if steep else "p  (GeV/c)")
        symbol = mathematical(QUANTITIES[budget.quantity].symbol)
        axes.set_ylabel(f"share of the variance of {symbol}  (%)")
        at = f"cos θ = {budget.points.texts(0)[1]}"
        if steep:
            at = f"{fixed[0]} = {(budget.p if fixed[0] == 'p' else pt)[0]:.4g} GeV/c"
        axes.set_title(f"{plain(f'{budget.detector}, {budget.particle}')}, {at}", loc="left")
        handles, labels = axes.get_legend_handles_labels()
        # From top to bottom, as the areas lie.
        axes.legend(handles[::-1], labels[::-1], loc="center left", bbox_to_anchor=(1.01, 0.5), title=by)
        picture.subplots_adjust(left=0.7 / width, right=5.6 / width, top=0.92, bottom=0.12)
    return picture


def draw_budgets(budgets: Mapping[str, Budget], by: By = "part", *, most: int = 8) -> Picture:
    """Draw what the variance of each variant of a detector is made of, as stacked bars.

    Parameters
    ----------
    budgets : mapping of str to Budget
        By the name of the variant, from top to bottom; of the same quantity at one point.
    by : str
        As for `Budget.grouped`.
    most : int
        Groups that are drawn: those with the largest variance in any variant. The rest is one group, ``other``.

    Returns
    -------
    Picture
        The length of a bar is the variance; the number beside it is its root.

    Raises
    ------
    ValueError
        If there is no budget, or one of several points.

    Examples
    --------
    >>> names = ("besiii-cgem", "besiii-idc")
    >>> picture = cg.draw.draw_budgets({name: cg.analytic(name, p=1.0).budget("dz") for name in names})
    >>> [label.get_text() for label in picture.axes[0].get_yticklabels()]
    ['besiii-cgem', 'besiii-idc']
    """
    if not budgets or not _is_count(most) or any(one.p.size != 1 for one in budgets.values()):
        sizes = [one.p.size for one in budgets.values()]
        raise ValueError(
            f"draw_budgets: got {sizes} points, most {most!r}; expected budgets of one point, and most of 1 or more"
        )
    first = next(iter(budgets.values()))
    pieces = _pieces(budgets, by, most)
    unit = shown(first.unit)
    names = [plain(name).replace("+", "\n+") for name in budgets]
    with style():
        tall = 1.5 + sum(0.2 + 0.17 * (1 + name.count("\n")) for name in names)
        before = 0.3 + 0.075 * max(len(line) for name in names for line in name.split("\n"))  # inches for the names
        width = before + 7.2
        picture, (axes,) = new_picture(1, 1, (width, tall))
        left = np.zeros(len(budgets))
        for (key, piece), (colour, hatch) in zip(pieces.items(), fills(len(pieces)), strict=True):
            if key == _OTHER:
                colour, hatch = COLORS["matter"], ""
            axes.barh(np.arange(len(names)), piece, 0.72, left, color=colour, hatch=hatch, edgecolor="white", lw=0.5,
                      label=plain(key))  # fmt: skip
            left = left + piece
        for row, total in enumerate(left):
            axes.text(total * 1.01, row, f"RMS {total**0.5:.4g} {unit}", va="center", fontsize=8.4)
        axes.set_yticks(np.arange(len(names)), names)
        axes.set(ylim=(len(names) - 0.4, -0.6), xlim=(0, 1.22 * left.max()))
        axes.set_xlabel(f"variance of {mathematical(QUANTITIES[first.quantity].symbol)}  ({unit}²)")
        axes.set_title(_about(first, 0), loc="left")
        axes.tick_params(axis="y", length=0)
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), title=by)
        right = 1 - 1.4 / width
        picture.subplots_adjust(left=before / width, right=right, top=1 - 0.35 / tall, bottom=0.55 / tall)
    return picture


def _about(result: Budget | Sensitivity, point: int) -> str:
    """Return detector, particle and a point as a title."""
    p, cosine = result.points.texts(point)
    return plain(f"{result.detector}, {result.particle}, p = {p} GeV/c, cos θ = {cosine}")


def _is_count(value: object, least: int = 1) -> bool:
    return isinstance(value, int | np.integer) and bool(value >= least)


def _pieces(budgets: Mapping[str, Budget], by: By, most: int) -> dict[str, Floats]:
    """Return the variances of each group, (variants,), the largest first; more groups than `most` are added up."""
    every = [{key: float(value.ravel()[0]) for key, value in one.grouped(by).items()} for one in budgets.values()]
    keys = dict.fromkeys(key for groups in every for key in groups)
    variances = {key: np.array([groups.get(key, 0.0) for groups in every]) for key in keys}
    names = sorted(variances, key=lambda key: -float(variances[key].max()))
    if len(names) <= most:
        return {name: variances[name] for name in names}
    others = np.sum([variances[name] for name in names[most:]], axis=0)
    return {name: variances[name] for name in names[:most]} | {_OTHER: others}


def _shares(budget: Budget, by: By, most: int) -> dict[str, Floats]:
    """Return the shares in %, the largest group first; more groups than `most` are added up."""
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = {name: 100 * value / budget.total for name, value in budget.grouped(by).items()}
    means = {name: float(np.nanmean(share)) if np.isfinite(share).any() else 0.0 for name, share in shares.items()}
    names = sorted(shares, key=lambda name: -means[name])
    if len(names) <= most:
        return {name: shares[name] for name in names}
    rest = np.sum([shares[name] for name in names[most:]], axis=0)
    return {name: shares[name] for name in names[:most]} | {_OTHER: rest}


def draw_maps(covariance: Covariance, quantities: Sequence[str] = ("dr", "dz", "p"), *, hits: bool = True) -> Picture:
    """Draw resolutions, and the mean number of hits, over momentum and cos(theta).

    Parameters
    ----------
    covariance : Covariance
        Of a grid: momenta along one axis of its points, cos(theta) along the other, each in order.
    quantities : sequence of str
        Names of `cgemit.analysis.quantities.QUANTITIES`, one panel each; core widths.
    hits : bool
        Whether to add a panel of clusters and wire hits.

    Returns
    -------
    Picture
        Points without a covariance are left white.

    Raises
    ------
    ValueError
        If the points are no grid of two momenta and two cosines or more.

    Examples
    --------
    >>> found = cg.analytic("besiii-cgem", p=np.array([[0.3], [1.0]]), cos_theta=[-0.5, 0.0, 0.5])
    >>> picture = cg.draw.draw_maps(found, ["dr"], hits=False)
    >>> picture.axes[0].get_xlabel(), picture.axes[0].get_ylabel()
    ('cos θ', 'p  (GeV/c)')
    """
    p, cosines = covariance.p, covariance.cos_theta
    if p.ndim == 2 and len(p) and np.ptp(p[:, :1]) == 0:  # momenta along the second axis
        p, cosines = p.T, cosines.T
    rows, columns = (p[:, 0], cosines[0]) if p.ndim == 2 and p.size else (np.zeros(0), np.zeros(0))
    whole = p.ndim == 2 and np.array_equal(p, np.broadcast_to(rows[:, None], p.shape))
    whole = whole and np.array_equal(cosines, np.broadcast_to(columns, p.shape))
    if not whole or len(rows) < 2 or len(columns) < 2 or (np.diff(rows) <= 0).any() or (np.diff(columns) <= 0).any():
        raise ValueError(
            f"draw_maps: got points of shape {covariance.p.shape}; expected a grid of two momenta and two cosines or "
            "more, each in order"
        )
    known = [quantity_of(name) for name in quantities]
    panels = [(f"{mathematical(one.sigma)}  ({shown(one.unit)})", covariance.sigma(one.name)) for one in known]
    if hits:
        panels.append((_MAP_OF_HITS, covariance.n_clusters + covariance.n_wires))
    across = min(2, len(panels))
    with style():
        down = -(-len(panels) // across)
        picture, every = new_picture(down, across, (0.4 + 5.2 * across, 0.5 + 3.6 * down))
        picture.set_layout_engine("constrained")
        for axes, (text, values) in zip(every, panels, strict=False):
            cells = values if covariance.p.shape == p.shape and np.array_equal(covariance.p, p) else values.T
            good = cells[np.isfinite(cells) & (cells > 0)]
            wide = len(good) and good.max() > 5 * good.min() and text != "clusters and wire hits"
            drawn = axes.pcolormesh(
                columns,
                rows,
                cells,
                cmap=_MAP,
                shading="nearest",
                norm=LogNorm(good.min(), good.max()) if wide else None,
            )
            picture.colorbar(drawn, ax=axes, label=text)
            axes.set(xlabel="cos θ", ylabel="p  (GeV/c)", yscale="log" if rows[-1] > 5 * rows[0] else "linear")
        for axes in every[len(panels) :]:
            axes.set_visible(False)
        title = f"{covariance.detector.name}, {covariance.particle}: core widths without events"
        picture.suptitle(plain(title), x=0.02, ha="left", fontsize=10.5)
    return picture


_MAP_OF_HITS = "clusters and wire hits"


def _plain_numbers(axis: Any) -> None:
    """Label a logarithmic axis with 1, 2, 5, 10 ..."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def draw_sensitivity(sensitivity: Sensitivity, *, point: int = 0, most: int = 15) -> Picture:
    """Draw what 1 % more of each number of the design does to the resolutions, as horizontal bars.

    Parameters
    ----------
    sensitivity : Sensitivity
    point : int
        Which of its points, counted through the flattened array.
    most : int
        Numbers of the design that are drawn: those with the largest effect on any of the quantities, the largest on
        top. Those that cannot be changed are left out.

    Returns
    -------
    Picture

    Raises
    ------
    ValueError
        If there is no such point, or nothing to draw.

    Examples
    --------
    >>> found = cg.sensitivity("besiii-cgem-design", p=1.0, keys=["cgem.L1.pitch_x", "field.bz"])
    >>> picture = cg.draw.draw_sensitivity(found)
    >>> [label.get_text() for label in picture.axes[0].get_yticklabels()]
    ['field.bz', 'cgem.L1.pitch_x']
    """
    points = sensitivity.p.size
    if not (_is_count(point, 0) and point < points and _is_count(most)):
        raise ValueError(
            f"draw_sensitivity: got point {point!r}, most {most!r}; "
            f"expected a point from 0 to {points - 1}, and most of at least 1"
        )
    values = sensitivity.values.reshape(len(sensitivity.keys), len(sensitivity.quantities), points)[..., point]
    known = np.flatnonzero(np.isfinite(values).any(axis=1))
    if not len(known):
        raise ValueError("draw_sensitivity: got no derivative; expected at least one number that can be changed")
    size = np.nanmax(np.abs(values[known]), axis=1)
    rows = known[np.argsort(-size, kind="stable")][:most]
    count = len(sensitivity.quantities)
    height = 0.8 / count
    with style():
        picture, (axes,) = new_picture(1, 1, (7.4, 1.3 + max(1.2, (0.16 + 0.13 * count) * len(rows))))
        for number, (name, (colour, hatch)) in enumerate(zip(sensitivity.quantities, fills(count), strict=True)):
            place = np.arange(len(rows)) + (number - 0.5 * (count - 1)) * height
            label = mathematical(QUANTITIES[name].sigma)
            axes.barh(place, values[rows, number], height, color=colour, hatch=hatch, edgecolor="white", lw=0.3,
                      label=label)  # fmt: skip
        axes.axvline(0, color=COLORS["data"], lw=0.8)
        axes.set_yticks(np.arange(len(rows)), [plain(sensitivity.keys[row]) for row in rows])
        axes.set(ylim=(len(rows) - 0.4, -0.6), xlabel="change of the resolution for 1 % more  (%)")
        axes.set_title(_about(sensitivity, point), loc="left", x=-0.45)
        axes.tick_params(axis="y", length=0)
        axes.legend(loc="lower right")  # the shortest bars are below
        grid(axes)
        tall = picture.get_size_inches()[1]
        picture.subplots_adjust(left=0.33, right=0.97, top=1 - 0.35 / tall, bottom=0.55 / tall)
    return picture


Columns = Mapping[str, Sequence[Any]]

_MAP = "viridis"


def draw_sweep(columns: Columns, parameters: Sequence[str], quantity: str, *, kind: str | None = None) -> Picture:
    """Draw one result of a sweep.

    Parameters
    ----------
    columns : mapping of str to list
        The table of a sweep.
    parameters : sequence of str
        Its columns of what is varied.
    quantity : str
        The column to be drawn.
    kind : "scan", "map" or "parallel", optional
        Default: by the number of columns that are varied.

    Raises
    ------
    ValueError
        If there is no such kind, it does not fit the number of parameters, or nothing can be drawn.
    """
    drawers = {"scan": (_scan, 1), "map": (_map, 2), "parallel": (_parallel, None)}
    kind = kind or {1: "scan", 2: "map"}.get(len(parameters), "parallel")
    if kind not in drawers:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(drawers)}")
    draw, count = drawers[kind]
    if count is not None and len(parameters) != count:
        raise ValueError(f"kind: got {kind!r} for {len(parameters)} keys, expected {count}")
    values = np.array([value if isinstance(value, int | float) else np.nan for value in columns[quantity]], np.float64)
    drawn = np.isfinite(values) & (np.array(columns["status"]) == "ok")
    if not (drawn & (np.array(columns["variant"]) > 0)).any():  # the base alone shows no dependence
        raise ValueError(f"{quantity}: got no number to draw, expected at least one variant that could be evaluated")
    with style():
        return draw(columns, tuple(parameters), quantity, values, drawn)


def label(header: str) -> str:
    """Return the header of a column as an axis label: ``cgem.L2.pitch_x (um)`` as ``cgem.L2.pitch_x  (µm)``."""
    name, bracket, unit = header.partition(" (")
    quantity, at, point = name.partition(" at ")
    before, sigma, short = quantity.partition("sigma_")
    if sigma and short in QUANTITIES and before in ("", "delta_"):
        text = mathematical(QUANTITIES[short].sigma) + (" − base" if before else "") + at + point
    else:
        text = escaped(name)
    return text + (f"  ({shown(unit)}" if bracket else "")


def escaped(text: str) -> str:
    """Return a text in which dollar signs of names are no formula; labels of this module hold complete formulas."""
    return text if text.count("$") == 2 else text.replace("$", r"\$")


def points(columns: Columns) -> list[tuple[str, Any]]:
    """Return each point (momentum and angle) of a table as text with the rows that it has, (n,) bool."""
    known = [one for one in KINEMATICS.values() if one.header in columns]
    values = [columns[one.header] for one in known]
    rows = list(zip(*values, strict=True)) if known else [()] * len(columns["variant"])
    rows_of = []
    for point in dict.fromkeys(rows):
        text = ", ".join(one.text(value) for one, value in zip(known, point, strict=True))
        rows_of.append((text, np.array([row == point for row in rows])))
    return rows_of


def _ticks(axes: Axes, values: Sequence[Any], axis: str) -> Any:
    """Return positions of a column's values: numbers as they are, words counted and named at the axis."""
    if all(isinstance(value, int | float) for value in values):
        return np.array(values, np.float64)
    words = list(dict.fromkeys(map(str, values)))
    getattr(axes, f"set_{axis}ticks")(range(len(words)), [escaped(word) for word in words])
    return np.array([words.index(str(value)) for value in values], np.float64)


def _scan(columns: Columns, parameters: tuple[str, ...], quantity: str, values: Any, drawn: Any) -> Picture:
    """Draw a quantity against one key, a line for each point; the base is an open marker, no result a cross below."""
    picture, (axes,) = new_picture(1, 1, (6.2, 4.4))
    x = _ticks(axes, columns[parameters[0]], "x")
    errors = _errors(columns, quantity)
    variant = np.array(columns["variant"])
    bases = drawn & (variant == 0) & np.isfinite(x)
    for (text, here), marker, colour in zip(points(columns), cycle(MARKERS), cycle(SERIES), strict=False):
        rows = np.flatnonzero(here & drawn & (variant > 0))
        rows = rows[np.argsort(x[rows], kind="stable")]
        bars = errors[rows] if errors is not None else None
        axes.errorbar(x[rows], values[rows], bars, fmt=f"{marker}-", ms=4.5, lw=1.2, color=colour, label=text or None)
        base = here & bases
        axes.plot(x[base], values[base], marker, ms=9, mfc="none", mec=colour, mew=1.3)
    if bases.any():
        axes.plot([], [], "o", ms=9, mfc="none", mec=COLORS["text"], label="base")
    without = (variant > 0) & ~np.isin(variant, variant[drawn])
    _crosses(axes, x, np.zeros(len(x)), columns, without, transform=axes.get_xaxis_transform(), clip_on=False)
    axes.set(xlabel=label(parameters[0]), ylabel=label(quantity))
    grid(axes)
    if legend_entries([axes]):
        axes.legend()
    picture.subplots_adjust(left=0.13, right=0.97, top=0.96, bottom=0.13)
    return picture


def _crosses(axes: Axes, x: Floats, y: Floats, columns: Columns, rows: Any, **options: Any) -> None:
    """Draw a cross for each of some rows, which have no result, with how they ended as the label."""
    ends = dict.fromkeys(status for status, here in zip(columns["status"], rows, strict=True) if here)
    text = ", ".join("no result" if status == "ok" else status for status in ends)
    axes.plot(x[rows], y[rows], "x", color=COLORS["wire"], ms=7, label=text or None, **options)


def _errors(columns: Columns, quantity: str) -> Any:
    name, _, unit = quantity.partition(" (")
    header = f"{name}_error" + (f" ({unit}" if unit else "")
    return np.array(columns[header], np.float64) if header in columns else None


def _map(columns: Columns, parameters: tuple[str, ...], quantity: str, values: Any, drawn: Any) -> Picture:
    """Draw a quantity over two keys, a panel for each point; variants without a result are crosses."""
    panels = points(columns)
    across = min(3, len(panels))
    down = -(-len(panels) // across)
    picture, every = new_picture(down, across, (0.9 + 4.4 * across, 0.3 + 3.7 * down))
    picture.set_layout_engine("constrained")
    variant = np.array(columns["variant"])
    for axes, (text, here) in zip(every, panels, strict=False):
        x, y = (_ticks(axes, columns[name], axis) for name, axis in zip(parameters, "xy", strict=True))
        rows = here & drawn & (variant > 0)
        _cells(axes, x[here & (variant > 0)], y[here & (variant > 0)], x[rows], y[rows], values[rows], label(quantity))
        _crosses(axes, x, y, columns, here & ~drawn & (variant > 0))
        base = here & drawn & (variant == 0) & np.isfinite(x) & np.isfinite(y)
        text_of_base = "base" if base.any() else None
        axes.plot(x[base], y[base], "o", ms=10, mfc="none", mec=COLORS["fit"], mew=1.6, label=text_of_base)
        axes.set(xlabel=label(parameters[0]), ylabel=label(parameters[1]), title=text)
    for axes in every[len(panels) :]:
        axes.set_visible(False)
    entries = legend_entries(every)
    if entries:
        picture.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=len(entries))
    return picture


def _cells(axes: Axes, all_x: Any, all_y: Any, x: Any, y: Any, values: Any, text: str) -> None:
    """Fill the cells of a grid with colours; scattered points are drawn as such."""
    xs, ys = np.unique(all_x), np.unique(all_y)
    if len(xs) * len(ys) == len(all_x) and len(xs) > 1 and len(ys) > 1:
        cells = np.full((len(ys), len(xs)), np.nan)
        cells[np.searchsorted(ys, y), np.searchsorted(xs, x)] = values
        drawn: Any = axes.pcolormesh(xs, ys, cells, cmap=_MAP, shading="nearest")
    else:
        drawn = axes.scatter(x, y, c=values, cmap=_MAP, s=45)
    axes.figure.colorbar(drawn, ax=axes, label=text)


def _parallel(columns: Columns, parameters: tuple[str, ...], quantity: str, values: Any, drawn: Any) -> Picture:
    """Draw a line for each variant through an axis for each key and one for the quantity, at one point."""
    # The first point with a number of any variant.
    varied = drawn & (np.array(columns["variant"]) > 0)
    text, here = next(one for one in points(columns) if (one[1] & varied).any())
    rows = np.flatnonzero(here & varied)
    names = [*parameters, quantity]
    picture, (axes,) = new_picture(1, 1, (max(6.0, 1.9 * len(names)), 4.6))
    ticks = [label(name).replace("  (", "\n(") for name in names]
    _coordinates(axes, columns, names, rows, values[rows], ticks)
    note = f"; the best and worst {_BRIGHT} of {len(rows)} in colour" if len(rows) > _FEW else ""
    axes.set_title(text + note, loc="left", fontsize=9.5)
    picture.subplots_adjust(left=0.03, right=0.97, top=0.91, bottom=0.15)
    return picture


_FEW, _BRIGHT = 100, 25  # lines that can all be coloured; at either end of the values, of more


def _coordinates(axes: Axes, columns: Columns, names: Sequence[str], rows: Any, values: Floats, ticks: Any) -> None:
    """Draw a line for each row through an axis for each column; of many only those with extreme values in colour."""
    scaled, ends = zip(*(unit_scaled(columns[name], rows) for name in names), strict=True)
    colours = mpl.colormaps[_MAP](Normalize(values.min(), values.max())(values))
    rank = np.argsort(np.argsort(values, kind="stable"))
    bright = (rank < _BRIGHT) | (rank >= len(rows) - _BRIGHT) | (len(rows) <= _FEW)
    for line, colour, strong in zip(np.array(scaled).T, colours, bright, strict=True):
        look: dict[str, Any] = {"lw": 1.1, "alpha": 0.8, "zorder": 2} if strong else {"lw": 0.4, "zorder": 1}
        axes.plot(range(len(names)), line, color=colour if strong else COLORS["matter"], **look)
    for i, (low, high) in enumerate(ends):
        axes.plot([i, i], [0, 1], color=COLORS["wire"], lw=0.9)
        for height, end, side in ((-0.03, low, "top"), (1.03, high, "bottom")):
            axes.text(i, height, escaped(end), ha="center", va=side, fontsize=8.4)
    axes.set_xticks(range(len(names)), ticks, fontsize=8.2)
    axes.set(ylim=(-0.12, 1.12), xlim=(-0.5, len(names) - 0.5), yticks=[])
    axes.tick_params(top=False, bottom=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def unit_scaled(column: Sequence[Any], rows: Any) -> tuple[Any, tuple[str, str]]:
    """Return a column scaled to 0 to 1, and the texts of its ends; words are counted."""
    chosen = [column[i] for i in rows]
    if not all(isinstance(value, int | float) for value in chosen):
        words = list(dict.fromkeys(map(str, chosen)))
        position = np.array([words.index(str(value)) for value in chosen], np.float64)
        return position / max(1, len(words) - 1), (words[0], words[-1])
    numbers = np.array(chosen, np.float64)
    low, high = float(np.nanmin(numbers)), float(np.nanmax(numbers))
    width = high - low
    return ((numbers - low) / width if width else np.full(len(numbers), 0.5)), (f"{low:.4g}", f"{high:.4g}")


_NAMES = {
    "x0": "X/X₀ of the CGEM", "area": "readout area", "gap": "smallest gap", "pt_threshold": "threshold in $p_T$",
    "outer_radius": "outer radius", "inner_radius": "inner radius",
}  # fmt: skip
#: Most lines of parallel coordinates that can be told apart.
_LINES = 300


def optimum_label(header: str) -> str:
    """Return the header of a column as an axis label: ``sigma_dr at 1 GeV/c (um)`` as ``σ(d_ρ) at 1 GeV/c  (µm)``."""
    name, bracket, unit = header.partition(" (")
    return label(header) if name not in _NAMES else _NAMES[name] + (f"  ({shown(unit)}" if bracket else "")


def draw_convergence(columns: Columns, objective: str, error: str | None, title: str) -> Picture:
    """Draw the objective of every design and the best one so far.

    Parameters
    ----------
    columns : mapping of str to list
        The table of an optimization.
    objective : str
        Its column.
    error : str or None
        The column of its errors.
    title : str
    """
    values, allowed = np.array(columns[objective], np.float64), np.array(columns["allowed"], bool)
    number = np.array(columns["design"])
    good, wrong = allowed & np.isfinite(values), ~allowed & np.isfinite(values)
    if not (good | wrong).any():
        raise ValueError(f"{objective}: got no design that could be evaluated, expected at least one")
    with style():
        picture, (axes,) = new_picture(1, 1, (6.6, 4.4))
        if wrong.any():
            axes.plot(number[wrong], values[wrong], "x", color=COLORS["wire"], ms=6, label="outside of limits")
        bars = np.array(columns[error], np.float64)[good] if error else None
        axes.errorbar(number[good], values[good], bars, fmt="o", ms=4.5, color=COLORS["cgem"], label="allowed")
        best = np.fmin.accumulate(np.where(good, values, np.nan))
        axes.step(number, best, where="post", color=COLORS["idc"], lw=1.4, label="best allowed design so far")
        axes.set(xlabel="evaluated designs (0: base)", ylabel=optimum_label(objective))
        axes.set_title(escaped(title), loc="left", fontsize=9.5)
        grid(axes)
        axes.legend()
        picture.subplots_adjust(left=0.13, right=0.97, top=0.92, bottom=0.12)
    return picture


def draw_hypervolume(growth: Sequence[tuple[int, int, float]], error: float, title: str) -> Picture:
    """Draw the hypervolume of the front against the number of designs.

    Parameters
    ----------
    growth : sequence of (int, int, float)
        Call, number of designs, hypervolume.
    error : float
        Of the last hypervolume.
    title : str
    """
    designs, volumes = np.array([one[1] for one in growth]), np.array([one[2] for one in growth])
    last = volumes[-1] or 1.0
    with style():
        picture, (axes,) = new_picture(1, 1, (6.6, 4.4))
        axes.plot(designs, volumes / last, "-", color=COLORS["cgem"], lw=1.5, label="front of all designs so far")
        axes.errorbar(designs[-1:], volumes[-1:] / last, [error / last], fmt="o", ms=5, capsize=3, color=COLORS["cgem"],
                      label="error from the sample of tracks")  # fmt: skip
        axes.set(xlabel="evaluated designs", ylabel="hypervolume / its last value", ylim=(0, 1.08))
        axes.set_title(escaped(title), loc="left", fontsize=9.5)
        grid(axes)
        axes.legend(loc="lower right")
        picture.subplots_adjust(left=0.12, right=0.97, top=0.92, bottom=0.12)
    return picture


def draw_front(columns: Columns, objectives: Sequence[str], errors: Sequence[str | None], title: str) -> Picture:
    """Draw designs in the plane of each pair of objectives; the front is coloured by the third one.

    Parameters
    ----------
    columns : mapping of str to list
        The table of an optimization.
    objectives, errors : sequence of str
        Its columns of the objectives and their errors (None: no error).
    title : str

    Raises
    ------
    ValueError
        If there is only one objective, or no design is allowed.
    """
    kind = np.array(columns["front"], dtype=object)
    loose, tied = kind == "front within errors", kind == "within errors"
    front = (kind == "front") | loose
    allowed = np.array(columns["allowed"], bool)
    if len(objectives) < 2 or not front.any():
        raise ValueError("front: got one objective or no allowed design, expected several objectives and a design")
    values = [np.array(columns[name], np.float64) for name in objectives]
    pairs = list(combinations(range(len(objectives)), 2))
    with style():
        picture, every = new_picture(1, len(pairs), (0.6 + 4.7 * len(pairs), 4.9))
        picture.set_layout_engine("constrained", wspace=0.08)  # a colour bar's label keeps off the next axis
        for axes, (i, k) in zip(every, pairs, strict=True):
            x, y = values[i], values[k]
            rest = allowed & ~front & ~tied
            axes.plot(x[rest], y[rest], ".", ms=2.5, color=COLORS["matter"], label="other allowed designs")
            if tied.any():
                axes.plot(x[tied], y[tied], ".", ms=5, color=COLORS["multi"], label="dominated by less than errors")
            across, up = (_optimum_errors(columns, errors[one], front) for one in (i, k))
            axes.errorbar(x[front], y[front], up, across, fmt="none", ecolor=COLORS["wire"], lw=0.7, zorder=2)
            others = [m for m in range(len(values)) if m not in (i, k)]
            if others:
                colour: Any = {"c": values[others[0]][front], "cmap": _MAP}
            else:
                colour = {"color": COLORS["cgem"]}
            drawn = axes.scatter(x[front], y[front], s=17, zorder=3, label="front", **colour)
            if others:
                picture.colorbar(drawn, ax=axes, label=optimum_label(objectives[others[0]]))
            if loose.any():
                axes.plot(x[loose], y[loose], "o", ms=6.5, mfc="none", mec=COLORS["wire"], mew=0.6, zorder=2.5,
                          label="of the front by less than errors")  # fmt: skip
            axes.plot(x[:1], y[:1], "*", ms=12, mfc="white", mec=COLORS["fit"], mew=1.4, zorder=4, label="base")
            _near(axes, x, y, front | tied)
            axes.set(xlabel=optimum_label(objectives[i]), ylabel=optimum_label(objectives[k]))
            grid(axes)
        entries = legend_entries(every[:1])
        columns_of_legend = min(2 * len(pairs), 4)  # as wide as the panels
        picture.legend(
            entries.values(), entries.keys(), loc="outside lower center", ncols=columns_of_legend, markerscale=1.3
        )
        picture.suptitle(escaped(title), fontsize=9.5)
    return picture


def _optimum_errors(columns: Columns, name: str | None, rows: Any) -> Any:
    return np.array(columns[name], np.float64)[rows] if name else None


def _near(axes: Any, x: Any, y: Any, rows: Any) -> None:
    """Show the front and the base with some space around them; bad designs are far away."""
    chosen = rows.copy()
    chosen[0] = np.isfinite(x[0] + y[0])
    for values, limits in ((x[chosen], axes.set_xlim), (y[chosen], axes.set_ylim)):
        low, high = float(values.min()), float(values.max())
        space = 0.12 * (high - low) or 0.05 * abs(high) or 1.0
        limits(low - space, high + 1.5 * space)


def draw_parallel(
    columns: Columns, names: Sequence[str], title: str, *, colour_by: str, best: Sequence[int]
) -> Picture:
    """Draw a line for each of the best designs through an axis for each variable and objective.

    Parameters
    ----------
    columns : mapping of str to list
        The table of an optimization.
    names : sequence of str
        Columns, from left to right.
    title : str
    colour_by : str
        The column that gives the colours.
    best : sequence of int
        Rows.

    Raises
    ------
    ValueError
        If there are no rows.
    """
    if not best:
        raise ValueError("parallel: got no allowed design, expected at least one")
    rows = np.array(best)[np.linspace(0, len(best) - 1, min(len(best), _LINES)).round().astype(int)]
    values = np.array([columns[colour_by][i] for i in rows], np.float64)
    with style():
        picture, (axes,) = new_picture(1, 1, (max(6.4, 0.8 + 1.35 * len(names)), 4.9))
        _coordinates(axes, columns, names, rows, values, [_broken(optimum_label(name)) for name in names])
        axes.set_title(escaped(title), loc="left", fontsize=9.5)
        picture.subplots_adjust(left=0.02, right=0.98, top=0.92, bottom=0.17)
    return picture


def _broken(text: str) -> str:
    """Return a label on several lines: keys break at their last dot, units and points of a resolution follow below."""
    name, bracket, unit = text.partition("  (")
    if "." in name and "$" not in name:
        first, _, last = name.rpartition(".")
        name = f"{first}.\n{last}"
    return name.replace(" at ", "\nat ") + (f"\n({unit}" if bracket else "")
