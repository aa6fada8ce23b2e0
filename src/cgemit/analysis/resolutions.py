"""Resolutions, pulls and chi-square of fitted tracks, with the rows that each status removed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from cgemit.analysis.quantities import NAMES, QUANTITIES, Columns, Quantity, quantity_of, true_charge
from cgemit.analysis.widths import HEAD, Resolution, measure, stacked
from cgemit.base.arrays import Floats
from cgemit.base.errors import did_you_mean, report
from cgemit.base.validate import InTurn
from cgemit.chain.result import Result, TrackColumns, track_columns, tracks_of
from cgemit.particles.species import species
from cgemit.tables import PARAMETERS, Table
from cgemit.tables.schema import is_fitted
from cgemit.tables.show import Comparable, Shown, Tabular, html_table, with_error
from cgemit.truth.match import counts_left_out

#: What tracks can be binned in: a function of the table, and the unit.
BY: dict[str, tuple[Callable[[Table | TrackColumns], Floats], str]] = {
    "p": (lambda tracks: tracks["truth_p"], "GeV/c"),
    "pt": (lambda tracks: np.abs(true_charge(tracks)) * (1 / np.abs(tracks["truth_kappa"])), "GeV/c"),
    "cos_theta": (lambda tracks: tracks["truth_tanl"] / np.sqrt(1 + tracks["truth_tanl"] ** 2), ""),
    "charge": (true_charge, "e"),
}


def resolution(tracks: Table | Result, parameter: str, *, window: tuple[float, float] | None = None) -> Resolution:
    """Return the widths of the residual (fitted minus true) of one parameter.

    Of a run in files (`cgemit.open`), only the columns that are needed are read, part by part.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table. Tracks that were fitted well and measure their particle (`MatchStatus`)
        are used, and those of status `unconstrained` for quantities that they measure (not momenta); the others are
        counted by status. Tracks fitted with the mass of another particle are used, and counted (`other_mass`).
    parameter : str
        Name or symbol, such as "dr", "d_rho" or "σ(d_ρ)"; all are in `cgemit.analysis.quantities.NAMES`.
    window : (low, high) or None
        Range of the RMS, in the quoted unit; None: all rows.

    Returns
    -------
    Resolution
        In the quoted unit.

    Raises
    ------
    TypeError, ValueError
        If `tracks` is of another kind, the parameter is unknown or the window is empty.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=500, seed=1)
    >>> found = cg.resolution(result, "dr")
    >>> found.unit, round(found.core), round(found.core_error), found.n
    ('um', 198, 7, 500)
    """
    known, columns = quantity_of(parameter, "parameter"), track_columns(tracks)
    return _measure(known, columns, known.residual(columns), known.name, known.unit, window)


@dataclass(frozen=True, eq=False, repr=False)
class Resolutions(Shown, Comparable, Tabular):
    """The widths of several quantities, by their name.

    Attributes
    ----------
    widths : tuple of Resolution

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> widths = cg.study.resolutions(result)
    >>> widths["theta"].unit, round(widths["theta"].core, 1)
    ('mrad', 2.2)
    """

    widths: tuple[Resolution, ...]

    def columns(self) -> dict[str, list[Any]]:
        """Return the numbers as columns, one row for each quantity."""
        return stacked([one.columns() for one in self.widths])

    def names(self) -> list[str]:
        """Return the names of the quantities."""
        return [one.parameter for one in self.widths]

    def __getitem__(self, parameter: str) -> Resolution:
        return self.widths[self.names().index(_known(NAMES.get(parameter, parameter), "parameter", self.names()))]

    def _ipython_key_completions_(self) -> list[str]:
        return self.names()

    def __iter__(self) -> Iterator[Resolution]:
        return iter(self.widths)

    def __len__(self) -> int:
        return len(self.widths)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        return "resolutions", ("quantity", *HEAD), [[one.label(), *one.cells()] for one in self.widths]


class Pulls(Resolutions):
    """The pulls (residual / error) of all parameters; `rms` and `mean` are the plain width and mean.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> pulls = cg.study.pulls(result)
    >>> pulls.names(), round(pulls["dr"].core, 1)
    (['dr', 'phi0', 'kappa', 'dz', 'tanl', 'p'], 1.0)
    """

    @property
    def pulls(self) -> tuple[Resolution, ...]:
        """The widths of the pulls."""
        return self.widths

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        rows = [[one.parameter, *one.cells(), with_error(one.mean, one.mean_error)] for one in self.widths]
        return "pulls", ("parameter", *HEAD, "mean"), rows


def resolutions(tracks: Table | Result) -> Resolutions:
    """Return `resolution` of all parameters, shown as one table.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> print([one.label() for one in cg.study.resolutions(result)][:4])
    ['dr [um]', 'dz [mm]', 'p [MeV/c]', 'pt [MeV/c]']
    """
    return Resolutions(tuple(resolution(tracks, name) for name in QUANTITIES))


def pulls(tracks: Table | Result) -> Pulls:
    """Return mean and width of the pulls of dr, phi0, kappa, dz, tanl and p, core and plain, with errors.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> {one.parameter: round(one.core, 1) for one in cg.study.pulls(result)}
    {'dr': 1.0, 'phi0': 1.0, 'kappa': 1.0, 'dz': 1.1, 'tanl': 1.0, 'p': 1.0}
    """
    columns = track_columns(tracks)
    return Pulls(tuple(_measure(QUANTITIES[name], columns, columns[f"pull_{name}"], name) for name in PARAMETERS))


@dataclass(frozen=True, eq=False, repr=False)
class Curve(Shown, Comparable, Tabular):
    """The widths of one parameter in bins of something.

    Attributes
    ----------
    parameter, unit, by, by_unit : str
    edges : tuple of float
        Limits of the bins, one more than bins.
    x : tuple of float
        Mean of `by` in each bin; NaN where it is empty.
    values : tuple of Resolution
        One per bin.
    outside : int
        Rows in no bin.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> curve = cg.study.resolution_against(result, "dz", "cos_theta", [-0.9, 0.0, 0.9])
    >>> print(curve.column("core").round(2), curve.unit)
    [0.33 0.31] mm
    """

    parameter: str
    unit: str
    by: str
    by_unit: str
    edges: tuple[float, ...]
    x: tuple[float, ...]
    values: tuple[Resolution, ...]
    outside: int

    def columns(self) -> dict[str, list[Any]]:
        """Return limits, mean and numbers of the bins as columns, one row for each bin."""
        bins = {f"{self.by}_low": list(self.edges[:-1]), f"{self.by}_high": list(self.edges[1:]), self.by: list(self.x)}
        return bins | stacked([value.columns() for value in self.values])

    def column(self, name: str) -> Floats:
        """Return one number of each bin, such as ``"core"`` or ``"core_error"``, (bins,) float64."""
        return np.array([getattr(value, name) for value in self.values], np.float64)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        label = f"{self.parameter} [{self.unit}]" if self.unit else self.parameter
        head = (f"{self.by} [{self.by_unit}]" if self.by_unit else self.by, *HEAD)
        bins = zip(self.edges[:-1], self.edges[1:], self.values, strict=True)
        rows = [[f"{low:g} to {high:g}", *value.cells()] for low, high, value in bins]
        return f"{label} against {self.by}, {self.outside} rows in no bin", head, rows


def resolution_against(
    tracks: Table | Result,
    parameter: str,
    by: str = "cos_theta",
    bins: int | npt.ArrayLike = 10,
    *,
    kind: Literal["residual", "pull"] = "residual",
    window: tuple[float, float] | None = None,
) -> Curve:
    """Return the widths of a parameter's residual or pull in bins of a true quantity.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    parameter : str
        As of `resolution`; of pulls one of dr, phi0, kappa, dz, tanl, p.
    by : str
        p, pt (GeV/c), cos_theta or charge (e), all true values.
    bins : int or (m + 1,) array_like
        Number of equal bins, or their increasing limits. A bin holds its lower limit, the last one both. Where all
        tracks have the same value, a number of bins gives a single one.
    kind : str
        "residual" (quoted units) or "pull".
    window : (low, high) or None
        Range of the RMS.

    Raises
    ------
    TypeError, ValueError
        If `tracks` is of another kind, a name is unknown or the limits do not increase.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> curve = cg.study.resolution_against(result, "dz", "cos_theta", [-0.9, -0.3, 0.3, 0.9])
    >>> print(curve.column("core").round(2), curve.unit)
    [0.4  0.26 0.34] mm
    """
    known = quantity_of(parameter, "parameter")
    quantity, by_unit = BY[_known(by, "by", list(BY))]
    columns = track_columns(tracks)
    if _known(kind, "kind", ["residual", "pull"]) == "residual":
        sample, unit = known.residual(columns), known.unit
    else:
        sample, unit = columns[f"pull_{_known(known.name, 'parameter', list(PARAMETERS))}"], ""
    x = np.asarray(quantity(columns), np.float64)
    edges = _edges(x, bins)
    bin_of = np.searchsorted(edges, x, side="right") - 1
    bin_of[x == edges[-1]] = len(edges) - 2
    bin_of[~np.isfinite(x) | (x > edges[-1])] = -1
    chosen = [bin_of == i for i in range(len(edges) - 1)]
    state = {name: columns[name] for name in ("status", "match", "other_mass", "err_dz", "err_tanl", "p", "p_mode")}
    values = tuple(
        _measure(known, {name: one[rows] for name, one in state.items()}, sample[rows], known.name, unit, window)
        for rows in chosen
    )
    means = tuple(float(x[rows].mean()) if rows.any() else math.nan for rows in chosen)
    outside = len(x) - sum(int(np.count_nonzero(rows)) for rows in chosen)
    return Curve(known.name, unit, by, by_unit, tuple(map(float, edges)), means, values, outside)


def _known(name: str, what: str, known: list[str]) -> str:
    if name not in known:
        hint = did_you_mean(name, known, "; ")
        raise ValueError(f"{what}: got {name!r}; expected one of {', '.join(known)}{hint}")
    return name


def _measure(
    known: Quantity,
    tracks: Columns,
    values: Floats,
    parameter: str,
    unit: str = "",
    window: tuple[float, float] | None = None,
) -> Resolution:
    """Measure the values of the tracks that were fitted well and measure their particle and the quantity."""
    good, fitted = known.counts(tracks), known.measured_by(tracks)
    usable = good & np.isfinite(values)
    left_out = counts_left_out(tracks["status"], tracks["match"], fitted)
    removed = _removed(left_out, int(np.count_nonzero(good & ~usable)))
    other = int(np.count_nonzero(usable & (tracks["other_mass"] > 0)))
    electrons = int(np.count_nonzero(usable & (tracks["p_mode"] != tracks["p"])))
    return measure(
        values[usable], parameter=parameter, unit=unit, window=window, removed=removed, other_mass=other,
        electrons=electrons,
    )  # fmt: skip


def _edges(x: Floats, bins: int | npt.ArrayLike) -> Floats:
    if isinstance(bins, int | np.integer):
        finite = x[np.isfinite(x)]
        if bins < 1 or not len(finite):
            raise ValueError(f"bins: got {bins} for {len(finite)} rows; expected at least one bin and one row")
        return _equal_bins(finite, int(bins))
    edges = np.asarray(bins, np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
        raise ValueError(f"bins: got {bins!r}; expected a number of bins or at least two increasing limits")
    return edges


def _equal_bins(x: Floats, bins: int) -> Floats:
    """Return the limits of equal bins; of a single one where all values agree, as for a gun of one angle."""
    low, high = float(x.min()), float(x.max())
    margin = 1e-6 * max(1.0, abs(low), abs(high))
    if high - low < margin:
        return np.array([low - margin, high + margin])
    return np.linspace(low, high, bins + 1)


def _removed(counts: Mapping[str, int], no_value: int) -> tuple[tuple[str, int], ...]:
    """Return how many rows each status removed, and how many good ones had no number."""
    return (*counts.items(), *([("without a value", no_value)] if no_value else []))


#: A cosine of the polar angle, the limits of a uniform range, or values of equal weight.
CosTheta = float | tuple[float, float] | Sequence[float] | InTurn

# A term is printed as 0 if it is below a thousandth of the largest that the curve allows, anywhere: its square below
# this, in units of that one.
_NOTHING = 1e-6

#: Fewest momenta for a fit of two parameters.
FEWEST_POINTS = 3


@dataclass(frozen=True)
class Form:
    """A form of a resolution curve.

    Attributes
    ----------
    quantity : str
        Of `QUANTITIES`.
    formula : str
    unit : str
        Of sigma.
    a_unit, b_unit : str
    power : float
        Of sin(theta) in the term with p.
    """

    quantity: str
    formula: str
    unit: str
    a_unit: str
    b_unit: str
    power: float

    def variables(self, p: Floats, particle: str | int, cos_theta: CosTheta) -> tuple[Floats, Floats]:
        """Return what multiplies a and b: pT and 1/beta, or 1 and 1/(p beta sin^power theta).

        Over a range of cos(theta), the power of sin(theta) is replaced by its mean.
        """
        beta = p / np.hypot(p, species(particle).mass)
        if self.quantity == "pt_rel":
            return p * mean_sine(cos_theta, self.power), 1 / beta
        return np.ones_like(p), mean_sine(cos_theta, -self.power) / (p * beta)


#: The forms by quantity, in the order in which they are printed.
FORMS = {
    form.quantity: form
    for form in (
        Form("dr", "sigma(d_rho) = a (+) b/(p beta sin^{3/2} theta)", "um", "um", "um GeV/c", 1.5),
        Form("dz", "sigma(d_z) = a (+) b/(p beta sin^{5/2} theta)", "mm", "mm", "mm GeV/c", 2.5),
        Form("pt_rel", "sigma(pT)/pT = a pT (+) b/beta", "%", "%/(GeV/c)", "%", 1.0),
    )
}


@dataclass(frozen=True)
class FormFit(Tabular):
    """A form fitted to a curve.

    Attributes
    ----------
    quantity, formula : str
    a, a_error, b, b_error : float
        Errors are statistical, and NaN where the curve has none. They reach upward to where the square of the parameter
        is one standard deviation larger, so that they also hold at zero.
    a_unit, b_unit : str
    points : int
        Momenta that were fitted.
    chi2 : float
        NaN for a curve without statistical errors.
    deviation : float
        Largest relative distance of the form from a fitted point.
    detector, method : str

    Examples
    --------
    >>> found = cg.study.fit_form("dr", p=[0.3, 0.5, 1.0], sigma=[309, 230, 168])
    >>> found.formula, found.a_unit
    ('sigma(d_rho) = a (+) b/(p beta sin^{3/2} theta)', 'um')
    """

    quantity: str
    formula: str
    a: float
    a_error: float
    b: float
    b_error: float
    a_unit: str
    b_unit: str
    points: int
    chi2: float
    deviation: float
    detector: str = ""
    method: str = ""

    @property
    def statistical(self) -> bool:
        """Whether the fitted curve has statistical errors."""
        return math.isfinite(self.chi2)

    def __str__(self) -> str:
        a, b = with_error(self.a, self.a_error), with_error(self.b, self.b_error)
        quality = f"chi2/ndf {self.chi2:.1f}/{self.points - 2}, " if self.statistical else "no statistical error, "
        return (
            f"{self.formula}: a = {a} {self.a_unit}, b = {b} {self.b_unit}"
            f" ({quality}within {100 * self.deviation:.2g} %)"
        )

    def columns(self) -> dict[str, list[Any]]:
        """Return all values as columns of one row."""
        return {name: [value] for name, value in self.as_json().items()}

    def as_json(self) -> dict[str, Any]:
        """Return the fit as `summary.json` has it: a number that is not finite becomes null."""
        values = asdict(self) | {"statistical": self.statistical}
        return {
            name: None if isinstance(value, float) and not math.isfinite(value) else value
            for name, value in values.items()
        }


def fit_form(
    quantity: str,
    p: npt.ArrayLike,
    sigma: npt.ArrayLike,
    error: npt.ArrayLike | None = None,
    *,
    particle: str | int = "mu-",
    cos_theta: CosTheta = 0.0,
    detector: str = "",
    method: str = "",
) -> FormFit | None:
    """Fit the usual form to a resolution curve by least squares.

    Parameters
    ----------
    quantity : str
        ``"dr"``: a (+) b/(p beta sin^{3/2} theta). ``"dz"``: with 5/2. ``"pt_rel"``: sigma(pT)/pT = a pT (+) b/beta.
    p : (n,) array_like, GeV/c
    sigma : (n,) array_like
        um (dr), mm (dz), % (sigma(pT)/pT). Points that are not finite are left out.
    error : (n,) array_like or None
        Statistical errors. None: the curve has none, and all points have the same relative weight.
    particle : str or int
        Whose beta enters.
    cos_theta : float, (low, high) or sequence of float
        Over several angles, the powers of sin(theta) are replaced by their means.
    detector, method : str
        Kept in the result.

    Returns
    -------
    FormFit or None
        None if fewer than three momenta have a resolution.

    Raises
    ------
    ValueError
        Listing every problem of the arguments.

    Examples
    --------
    >>> muons = cg.analytic("besiii-cgem-design", p=[0.3, 0.5, 1.0, 2.0])
    >>> found = cg.study.fit_form("dr", muons.p, muons.sigma("dr"))
    >>> print(found.formula, round(found.a), round(found.b), found.b_unit)
    sigma(d_rho) = a (+) b/(p beta sin^{3/2} theta) 137 82 um GeV/c
    """
    x, y = np.asarray(p, np.float64), np.asarray(sigma, np.float64)
    weight = y if error is None else np.asarray(error, np.float64)
    report("fit_form", _problems(quantity, x, y, weight))
    form = FORMS[quantity]
    used = np.isfinite(y) & (y > 0) & np.isfinite(weight) & (weight > 0)
    if len(np.unique(x[used])) < FEWEST_POINTS:
        return None
    y, weight = y[used], weight[used]
    terms = form.variables(x[used], particle, cos_theta)
    (a, a_error), (b, b_error), residuals = _sum_in_quadrature(terms, y, weight)
    if error is None:
        a_error = b_error = math.nan
    chi2 = math.nan if error is None else float(residuals @ residuals)
    deviation = float(np.max(np.abs(residuals * weight / y)))
    return FormFit(
        quantity, form.formula, a, a_error, b, b_error, form.a_unit, form.b_unit, len(y), chi2, deviation, detector,
        method,
    )  # fmt: skip


def _problems(quantity: str, p: Floats, sigma: Floats, error: Floats) -> list[str]:
    texts = []
    if quantity not in FORMS:
        texts.append(f"quantity: got {quantity!r}; expected one of {', '.join(FORMS)}")
    if p.ndim != 1 or p.shape != sigma.shape or p.shape != error.shape:
        texts.append(f"p, sigma, error: got shapes {p.shape}, {sigma.shape}, {error.shape}; expected lists of one size")
    if not np.all(np.isfinite(p) & (p > 0)):
        texts.append("p: expected positive momenta in GeV/c")
    return texts


def _sum_in_quadrature(
    variables: tuple[Floats, Floats], y: Floats, error: Floats
) -> tuple[tuple[float, float], tuple[float, float], Floats]:
    """Fit y = sqrt(a^2 u^2 + b^2 v^2); return a and b with their errors, and the residuals in units of the error.

    The parameters are the squares, in units of the largest that they can be: the derivatives by a and b vanish at zero,
    those by the squares do not.
    """
    from scipy.optimize import least_squares

    scale = np.array([np.max(y / one) ** 2 for one in variables])
    terms = np.stack([one * one for one in variables], axis=1) * scale

    def residuals(squares: Floats) -> Floats:
        return np.asarray((np.sqrt(terms @ squares) - y) / error)

    def jacobian(squares: Floats) -> Floats:
        return np.asarray(terms / (2 * np.sqrt(terms @ squares) * error)[:, None])

    start, tolerances = np.full(2, 0.25), {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    solution = least_squares(residuals, start, jac=jacobian, bounds=(0, np.inf), max_nfev=1000, **tolerances)
    spread = np.sqrt(np.diag(np.linalg.inv(solution.jac.T @ solution.jac)))
    # At the bound the square is zero but for rounding.
    solution.x[solution.x < _NOTHING] = 0.0
    low, high = np.sqrt(solution.x * scale), np.sqrt((solution.x + spread) * scale)
    (a, b), (a_error, b_error) = low.tolist(), (high - low).tolist()
    return (a, a_error), (b, b_error), residuals(solution.x)


def mean_sine(cos_theta: CosTheta, power: float) -> float:
    """Return the mean of sin(theta)^power over the cosines that tracks have.

    Parameters
    ----------
    cos_theta : float, (low, high) or sequence of float
    power : float
    """
    if isinstance(cos_theta, InTurn):
        cosines = np.array(cos_theta.values)
    elif isinstance(cos_theta, tuple):
        nodes, weights = np.polynomial.legendre.leggauss(64)
        low, high = cos_theta
        cosines = 0.5 * (low + high) + 0.5 * (high - low) * nodes
        return float(0.5 * weights @ (1 - cosines * cosines) ** (0.5 * power))
    else:
        cosines = np.atleast_1d(np.asarray(cos_theta, np.float64))
    return float(np.mean((1 - cosines * cosines) ** (0.5 * power)))


def chi2_probability(tracks: Table | Result) -> Floats:
    """Return the probability of a larger chi-square, (n,) float64, for fitted tracks, `unconstrained` ones included.

    It is uniform between 0 and 1 if the errors are right: Q(ndf/2, chi2/2), the regularised incomplete gamma
    function. Tracks without degrees of freedom have no probability and are left out.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> probability = cg.study.chi2_probability(result)
    >>> print(len(probability), probability.mean().round(1))
    400 0.5
    """
    from scipy.special import gammaincc  # scipy takes half a second to import

    tracks = tracks_of(tracks)
    rows = is_fitted(tracks) & (tracks["ndf"] > 0) & np.isfinite(tracks["chi2"])
    return np.asarray(gammaincc(tracks["ndf"][rows] / 2, tracks["chi2"][rows] / 2), np.float64)


@dataclass(frozen=True, eq=False, repr=False)
class Flatness(Comparable, Tabular):
    """How well the chi-square probability agrees with a uniform distribution.

    Attributes
    ----------
    n : int
        Tracks used.
    removed : tuple of (str, int)
        Why tracks were not used, and how many each.
    mean, mean_error : float
        Mean probability, expected 0.5, and its error if uniform.
    kolmogorov : float
        Probability of a larger Kolmogorov-Smirnov distance.
    chi2, ndf, binned : float, int, float
        Chi-square of equal bins against uniform, its degrees of freedom, probability of a larger one.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> flat = cg.study.chi2_flatness(result, bins=10)
    >>> flat.n, flat.ndf, 0.4 < flat.mean < 0.6
    (400, 9, True)
    """

    n: int
    removed: tuple[tuple[str, int], ...]
    mean: float
    mean_error: float
    kolmogorov: float
    chi2: float
    ndf: int
    binned: float

    def columns(self) -> dict[str, list[Any]]:
        """Return all numbers as columns of one row; `removed` as text."""
        removed = ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"
        return {name: list(values) for name, values in super().columns().items()} | {"removed": [removed]}

    def _repr_html_(self) -> str:
        removed = ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"
        cells = [with_error(self.mean, self.mean_error), f"{self.kolmogorov:.3g}", f"{self.binned:.3g}",
                 f"{self.chi2:.1f}/{self.ndf}", str(self.n), removed]  # fmt: skip
        head = ("mean (0.5 expected)", "flat (Kolmogorov)", "flat (bins)", "chi2/ndf", "rows", "removed")
        return html_table("chi-square probability", head, [cells])

    def __repr__(self) -> str:
        removed = ", ".join(f"{number} {reason}" for reason, number in self.removed) or "none"
        return (
            f"<chi-square probability: mean {with_error(self.mean, self.mean_error)} (0.5 expected), flat with"
            f" probability {self.kolmogorov:.3g} (Kolmogorov) and {self.binned:.3g} (chi2 {self.chi2:.1f}/{self.ndf}),"
            f" rows {self.n}, removed {removed}>"
        )


def chi2_flatness(tracks: Table | Result, bins: int = 20) -> Flatness:
    """Test whether the chi-square probability of the tracks is uniform.

    Kolmogorov's limiting distribution is taken at D (sqrt(n) + 0.12 + 0.11/sqrt(n)) (Stephens, J. R. Stat. Soc. B 32
    (1970) 115), good from n = 5 on.

    Parameters
    ----------
    tracks : Table or Result
        Of kind "tracks", or with such a table.
    bins : int
        Number of equal bins of the chi-square test.

    Raises
    ------
    ValueError
        If fewer than 5 tracks a bin are left.

    Examples
    --------
    >>> result = cg.run("besiii-cgem-design", cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9)), n=400, seed=1)
    >>> flat = cg.study.chi2_flatness(result, bins=10)
    >>> flat.n, round(flat.mean, 1), flat.kolmogorov > 0.001
    (400, 0.5, True)
    """
    from scipy import special

    tracks = tracks_of(tracks)
    probability = np.sort(chi2_probability(tracks))
    n = len(probability)
    if bins < 2 or n < 5 * bins:
        raise ValueError(f"bins: got {bins} for {n} tracks; expected at least 2, with 5 tracks each")
    steps = np.arange(n + 1) / n
    distance = max(np.max(steps[1:] - probability), np.max(probability - steps[:-1]))
    kolmogorov = special.kolmogorov(distance * (math.sqrt(n) + 0.12 + 0.11 / math.sqrt(n)))
    counts = np.histogram(probability, bins, (0.0, 1.0))[0]
    chi2 = float(np.sum((counts - n / bins) ** 2) / (n / bins))
    good = is_fitted(tracks)
    removed = _removed(counts_left_out(tracks["status"], fitted=good), int(np.count_nonzero(good)) - n)
    mean, error = float(probability.mean()), math.sqrt(1 / 12 / n)
    binned = float(special.gammaincc((bins - 1) / 2, chi2 / 2))
    return Flatness(n, removed, mean, error, float(kolmogorov), chi2, bins - 1, binned)
