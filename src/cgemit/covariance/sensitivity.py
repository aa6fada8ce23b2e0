"""`sensitivity`: derivatives of resolutions with respect to the numbers of a design."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.analysis.quantities import quantity_of
from cgemit.base.arrays import Floats
from cgemit.base.errors import DetectorError, Problems
from cgemit.base.validate import NO, reader
from cgemit.covariance.analytic import analytic, with_errors_of
from cgemit.covariance.result import Covariance
from cgemit.covariance.tracks import Points, core_width
from cgemit.detector import Detector, load
from cgemit.detector.keys import once
from cgemit.detector.parts import Contents, Labelled
from cgemit.detector.variants import values_at
from cgemit.reconstruction.fit import compiled_for_fit
from cgemit.tables.show import Shown, data_frame
from cgemit.units import NATIVE

OTHER_ORDER = "got slabs and wires in another order than in the detector whose hits are kept, expected the same"


def with_cores(base: Covariance, variants: Sequence[tuple[Detector, _core.detector.Detector]]) -> list[Covariance]:
    """Return the covariances in variants and their compiled detectors."""
    if not variants:
        return []
    tracks = base._tracks
    smooth = [_with_stereo(one, base.detector) for one, _ in variants]  # as the cores are
    models = [with_errors_of(tracks.model, one) for one in smooth]
    same = [number for number, model in enumerate(models) if model == tracks.model]
    by_variant: dict[int, Floats] = {}
    if same:
        cores = [variants[number][1] for number in same]
        by_variant = dict(zip(same, tracks.run(budget=False, variants=cores)["covariance"][1:], strict=True))
    for i, (model, (_, core)) in enumerate(zip(models, variants, strict=True)):
        if i not in by_variant:  # the errors of its clusters differ
            own = dataclasses.replace(tracks, model=model)
            by_variant[i] = own.run(budget=False, variants=[core])["covariance"][1]
    return [
        dataclasses.replace(base, detector=one, _columns={**base._columns, "covariance": by_variant[number]})
        for number, (one, _) in enumerate(variants)
    ]


def core_of(base: Covariance, variant: Detector) -> _core.detector.Detector:
    """Return a variant as the fit of a covariance compiles it, with stereo angles that follow continuously."""
    return compiled_for_fit(_with_stereo(variant, base.detector), base._tracks.fit, base.detector)


def keeps_order(base: Covariance, core: _core.detector.Detector) -> bool:
    """Return whether a variant has the slabs and wires of the detector of a covariance in the same order."""
    return _core.covariance.same_surfaces(compiled_for_fit(base.detector, base._tracks.fit), core)


@once
def _with_stereo(variant: Detector, base: Detector) -> Detector:
    """Return a variant whose derived stereo angles follow radius and length continuously, not in whole strips."""
    layers = [layer.smooth(old) for layer, old in zip(variant.barrels, base.barrels, strict=True)]
    return dataclasses.replace(variant, barrels=Labelled(layers))


#: Relative steps of differences, tried in turn, outward and inward, where parts are so close that a larger one is
#: impossible. The hits are kept, so that nothing steps: what is left of the second order is as small as the step.
STEPS = (2e-5, 4e-6)

LEAST_PRINTED = 0.005
"""%; numbers of the design that change every resolution by less are not printed."""


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity(Shown):
    """Relative derivatives of resolutions by numbers of the design, d ln(sigma)/d ln(number).

    Attributes
    ----------
    detector, particle : str
    p, cos_theta : ndarray, float64
        Of the points; middles of ranges.
    keys : tuple of str
        Dotted keys of the detector file.
    quantities : tuple of str
    values : ndarray, (keys, quantities) + shape of the points, float64
        Percent that sigma grows by if the number grows by 1 %; NaN where the number cannot be changed.
    problems : dict of str to str
        Keys that cannot be changed, and why.
    points : Points
        With the limits of ranges.
    """

    detector: str
    particle: str
    p: Floats
    cos_theta: Floats
    keys: tuple[str, ...]
    quantities: tuple[str, ...]
    values: Floats
    problems: Mapping[str, str]
    points: Points

    def of(self, key: str, quantity: str) -> Floats:
        """Return the derivatives of `quantity` by the number of the dotted `key`, for all points."""
        return np.asarray(self.values[self.keys.index(key), self.quantities.index(quantity)])

    def ordered(self) -> list[str]:
        """Return the keys by their largest effect on any quantity at any point, largest first."""
        size = np.nanmax(np.abs(np.nan_to_num(self.values)).reshape(len(self.keys), -1), axis=1, initial=0)
        return [self.keys[i] for i in np.argsort(-size, kind="stable")]

    def table(self) -> dict[str, npt.NDArray[Any]]:
        """Return one row per point and key, largest effect first, with a column for each quantity."""
        rows = [self.keys.index(key) for key in self.ordered()]
        points = self.p.size
        columns: dict[str, npt.NDArray[Any]] = {
            "p": np.repeat(self.p.ravel(), len(rows)), "cos_theta": np.repeat(self.cos_theta.ravel(), len(rows)),
            "key": np.tile(np.array([self.keys[i] for i in rows], dtype=object), points),
        }  # fmt: skip
        flat = self.values.reshape(len(self.keys), len(self.quantities), points)
        for number, name in enumerate(self.quantities):
            columns[f"dln_sigma_{name}"] = flat[rows, number].T.ravel()
        return columns

    def to_pandas(self) -> Any:
        """Return `table` as a pandas DataFrame."""
        return data_frame(self.table())

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        head = ["1 % more of", *(f"sigma({name}) [%]" for name in self.quantities)]
        flat = self.values.reshape(len(self.keys), len(self.quantities), -1)[..., 0]
        rows = [[key, *(f"{x:+.3f}" for x in flat[self.keys.index(key)])] for key in self._printed()]
        where = "p {} GeV/c, cos(theta) {}".format(*self.points.texts(0))
        return f"{self.detector}, {self.particle}, {where}", head, rows

    def _printed(self) -> list[str]:
        """Return the keys whose effect at the first point shows in the printed digits, or is not known."""
        flat = self.values.reshape(*self.values.shape[:2], -1)[..., 0]
        largest = dict(zip(self.keys, np.abs(flat).max(axis=1), strict=True))
        return [key for key in self.ordered() if not largest[key] < LEAST_PRINTED]

    def note(self) -> str:
        """Return how many numbers are not printed."""
        left = len(self.keys) - len(self._printed())
        return f"{left} more change each by less than {LEAST_PRINTED} % (to_pandas() has them)" if left else ""


def sensitivity(
    detector: Detector | str | Mapping[str, Any],
    particle: str | int = "mu-",
    p: Any = 1.0,
    cos_theta: Any = 0.0,
    *,
    keys: Sequence[str] | None = None,
    quantities: Sequence[str] = ("dr", "dz", "p"),
    **how: Any,
) -> Sensitivity:
    """Return what 1 % more of each number of a detector does to its resolutions.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    particle : str or int
    p, cos_theta
        As for `analytic`.
    keys : sequence of str or None
        Dotted keys of numbers, also patterns such as ``"cgem.*.pitch_x"``, whose values then change together. None:
        field, radii, gaps, pitches, stereo angles and thicknesses of all CGEM layers, and the error of the wires.
    quantities : sequence of str
        As for `Covariance.sigma`.
    **how
        Further arguments of `analytic`.

    Returns
    -------
    Sensitivity

    Raises
    ------
    DetectorError, ValueError
        As for `analytic`; listing every key that is no number of the detector; if a quantity is not known.

    Notes
    -----
    Differences of the same kernels over small steps, one variant for each key: the hits (crossed cells, fired strips)
    and the sample of tracks are those of the detector itself, and the error of a cluster changes as its mean over all
    positions of the strips. Numbers of strips do not matter, and a stereo angle that follows from the diagonal of the
    sheet changes continuously with radius and length.

    Examples
    --------
    >>> cg.sensitivity("besiii-cgem-design", p=1.0, keys=["cgem.L1.pitch_x", "field.bz"])
    besiii-cgem-design, mu-, p 1 GeV/c, cos(theta) 0
    1 % more of      sigma(dr) [%]  sigma(dz) [%]  sigma(p) [%]
    field.bz                -0.082         -0.069        -1.000
    cgem.L1.pitch_x         +0.294         +0.012        +0.033
    """
    detector = load(detector)
    base = analytic(detector, particle, p, cos_theta, **how)
    detector = base.detector  # with the readout of the arguments
    base.only_at_origin("sensitivity")
    problems = Problems()
    read = reader(tuple[str, ...])
    names = read("quantities", quantities, problems)
    wanted = tuple(design_keys(detector)) if keys is None else read("keys", keys, problems)
    for name, found in (("quantities", names), ("keys", wanted)):
        if found == ():
            problems.note(name, "an empty list", "a list of at least one")
    for key in wanted if wanted is not NO else ():
        _check_number(detector, key, problems)
    problems.report("sensitivity", DetectorError)
    quantities = tuple(quantity_of(name).name for name in names)
    values, unmoved = logarithmic_slopes(base, detector, wanted, quantities)
    at = base.p, base.cos_theta
    return Sensitivity(detector.name, base.particle, *at, wanted, quantities, values, unmoved, base.points)


def _check_number(detector: Detector, key: str, problems: Problems) -> None:
    """Note a key that stands for nothing, or for something else than numbers."""
    before = len(problems)
    values = values_at(detector, key, problems)
    if len(problems) == before and not all(
        one and one[0] is not None and (one[1].kind in NATIVE or one[1].kind == "integer") for one in values
    ):
        problems.note(key, "no number", "the dotted key of a number", unknown=None in values)


def logarithmic_slopes(
    base: Covariance, detector: Detector, keys: Sequence[str], quantities: Sequence[str]
) -> tuple[Floats, dict[str, str]]:
    """Return d ln(sigma)/d ln(number) of a detector with the hits of `base`, and why some numbers cannot be changed.

    Parameters
    ----------
    base : Covariance
        Of this detector, or of one that differs so little that slabs and wires keep their order.
    detector : Detector
    keys, quantities : sequence of str

    Returns
    -------
    values : (keys, quantities) + shape of the points, float64
        NaN where the number cannot be changed.
    problems : dict of str to str
    """
    values = np.full((len(keys), len(quantities), *base.p.shape), np.nan)
    problems: dict[str, str] = {}
    neighbours: dict[int, _Neighbour] = {}
    for i, key in enumerate(keys):
        neighbour = _neighbour(base, detector, key)
        if isinstance(neighbour, str):
            problems[key] = neighbour
        else:
            neighbours[i] = neighbour
    variants = [(one.detector, one.core) for one in neighbours.values()]
    if detector is base.detector:
        centre, varied_ones = base, with_cores(base, variants)
    else:
        centre, *varied_ones = with_cores(base, [(detector, core_of(base, detector)), *variants])
    steps = np.array([one.step for one in neighbours.values()]).reshape(-1, *(1,) * base.p.ndim)
    for column, name in enumerate(quantities):
        logs = np.log(_sigmas([centre, *varied_ones], name))
        values[list(neighbours), column] = (logs[1:] - logs[0]) / steps
    return values, problems


def _sigmas(resolutions: Sequence[Covariance], quantity: str) -> Floats:
    """Return `Covariance.sigma` of detectors with the same tracks, (detectors,) + shape of the points."""
    every = np.stack([one.variances(quantity) for one in resolutions])
    return core_width(every.reshape(-1, every.shape[-1])).reshape(every.shape[:-1])


class _Neighbour(NamedTuple):
    """A variant of the detector, compiled, and by how much ln(number) differs."""

    detector: Detector
    core: _core.detector.Detector
    step: float


def _neighbour(base: Covariance, detector: Detector, key: str) -> _Neighbour | str:
    """Return the variant whose difference to the detector gives the derivative by a key, or why there is none."""
    problems = Problems()
    for variant, side in _variants(detector, key, problems):
        core = core_of(base, variant)
        if keeps_order(base, core):
            return _Neighbour(variant, core, math.log1p(side))
        problems.note(key, OTHER_ORDER, "")
    return str(problems[-1])


def _variants(detector: Detector, key: str, problems: Problems) -> Iterator[tuple[Detector, float]]:
    """Yield possible variants by relative steps of a key, the wanted one first; `problems` receives the others'."""
    for step in STEPS:
        for side in (step, -step):
            try:
                yield detector.with_overrides({key: f"x{1 + side!r}"}), side
            except DetectorError as error:
                problems.append(error.problems[0])


def design_keys(detector: Contents) -> Iterator[str]:
    """Yield the keys that `sensitivity` varies by default."""
    yield "field.bz"
    for _, layers in detector.by_kind():
        for layer in layers:
            yield from layer.design_keys()
    if detector.drift_chamber is not None:
        yield "drift_chamber.sigma"
