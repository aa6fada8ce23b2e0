"""The usual forms of resolution curves: a constant and a term in the momentum, added in quadrature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares

from cgemit.species import species
from cgemit.statistics.formatting import Tabular, with_error
from cgemit.values import InTurn

Floats = npt.NDArray[np.float64]
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
        ``"pt"`` stands for sigma(pT)/pT.
    formula : str
    unit : str
        Of sigma.
    a_unit, b_unit : str
    power : float
        Of sin(theta) in the term that depends on the momentum.
    """

    quantity: str
    formula: str
    unit: str
    a_unit: str
    b_unit: str
    power: float

    def variable(self, p: Floats, particle: str | int, cos_theta: CosTheta) -> Floats:
        """Return what multiplies the parameter of the momentum term: pT, or 1/(p beta sin^power theta).

        Over a range of cos(theta), the power of sin(theta) is replaced by its mean.
        """
        if self.quantity == "pt":
            return p * mean_sine(cos_theta, 1.0)
        beta = p / np.hypot(p, species(particle).mass)
        return mean_sine(cos_theta, -self.power) / (p * beta)


#: The forms by quantity, in the order in which they are printed.
FORMS = {
    form.quantity: form
    for form in (
        Form("dr", "sigma(d_rho) = a (+) b/(p beta sin^{3/2} theta)", "um", "um", "um GeV/c", 1.5),
        Form("dz", "sigma(d_z) = a (+) b/(p beta sin^{5/2} theta)", "mm", "mm", "mm GeV/c", 2.5),
        Form("pt", "sigma(pT)/pT = a pT (+) b", "%", "%/(GeV/c)", "%", 1.0),
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
        ``"dr"``: a (+) b/(p beta sin^{3/2} theta). ``"dz"``: the same with 5/2. ``"pt"``: sigma(pT)/pT = a pT (+) b.
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
    """
    x, y = np.asarray(p, np.float64), np.asarray(sigma, np.float64)
    weight = y if error is None else np.asarray(error, np.float64)
    if problems := _problems(quantity, x, y, weight):
        raise ValueError("fit_form:\n  " + "\n  ".join(problems))
    form = FORMS[quantity]
    used = np.isfinite(y) & (y > 0) & np.isfinite(weight) & (weight > 0)
    if len(np.unique(x[used])) < FEWEST_POINTS:
        return None
    x, y, weight = form.variable(x[used], particle, cos_theta), y[used], weight[used]
    (constant, constant_error), (slope, slope_error), residuals = _sum_in_quadrature(x, y, weight)
    if error is None:
        constant_error = slope_error = math.nan
    pairs = [(constant, constant_error), (slope, slope_error)]
    (a, a_error), (b, b_error) = reversed(pairs) if quantity == "pt" else pairs
    chi2 = math.nan if error is None else float(residuals @ residuals)
    deviation = float(np.max(np.abs(residuals * weight / y)))
    return FormFit(
        quantity, form.formula, a, a_error, b, b_error, form.a_unit, form.b_unit, len(x), chi2, deviation, detector,
        method,
    )  # fmt: skip


def _problems(quantity: str, p: Floats, sigma: Floats, error: Floats) -> list[str]:
    found = []
    if quantity not in FORMS:
        found.append(f"quantity: got {quantity!r}; expected one of {', '.join(FORMS)}")
    if p.ndim != 1 or p.shape != sigma.shape or p.shape != error.shape:
        found.append(f"p, sigma, error: got shapes {p.shape}, {sigma.shape}, {error.shape}; expected lists of one size")
    if not np.all(np.isfinite(p) & (p > 0)):
        found.append("p: expected positive momenta in GeV/c")
    return found


def _sum_in_quadrature(x: Floats, y: Floats, error: Floats) -> tuple[tuple[float, float], tuple[float, float], Floats]:
    """Fit y = sqrt(c^2 + s^2 x^2); return c and s with their errors, and the residuals in units of the error.

    The parameters are the squares, in units of the largest that they can be: the derivatives by c and s vanish at zero,
    those by the squares do not.
    """
    scale = np.array([np.max(y) ** 2, np.max(y / x) ** 2])
    terms = np.stack([np.ones_like(x), x * x], axis=1) * scale

    def residuals(squares: Floats) -> Floats:
        return np.asarray((np.sqrt(terms @ squares) - y) / error)

    def jacobian(squares: Floats) -> Floats:
        return np.asarray(terms / (2 * np.sqrt(terms @ squares) * error)[:, None])

    start, tolerances = np.full(2, 0.25), {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    found = least_squares(residuals, start, jac=jacobian, bounds=(0, np.inf), max_nfev=1000, **tolerances)
    spread = np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))
    # At the bound the square is zero but for rounding.
    found.x[found.x < _NOTHING] = 0.0
    low, high = np.sqrt(found.x * scale), np.sqrt((found.x + spread) * scale)
    (c, s), (c_error, s_error) = low.tolist(), (high - low).tolist()
    return (c, c_error), (s, s_error), residuals(found.x)


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
