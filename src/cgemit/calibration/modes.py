"""Solution of the normal equations of constants: errors, modes, and what the data do not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.calibration.blocks import Blocks, Factor
from cgemit.calibration.constants import LORENTZ, Z_SCALE, Constant
from cgemit.calibration.sums import Sums
from cgemit.detector import Detector
from cgemit.detector.alignment import PATTERNS, AlignmentTable, pattern_values, points_of_relation, value_of
from cgemit.detector.layers.layer import FAR, PLACEMENT
from cgemit.detector.layers.wires import END_SHIFT
from cgemit.tables.show import Shown, Tabular

#: Information on a mode over that of its constants with known tracks, below which there is none: rows of the fit are
#: those of layers in place, which tilts of 1 mrad make wrong by that much. Common tilts have four times as much.
_NONE = 1e-6
#: The same for modes that have no known name, in units of the mean of all.
_ROUNDING = 1e-10
_VELOCITY = 0.03  # mm/ns, typical of drifting electrons
#: Share of a constant in a zero mode from which on it is not determined.
_PART = 1e-4
#: The same as `_NONE` for single wires, whose rows are those of wires where they are; priors of tracks have up to 1e-8.
_NONE_OF_WIRES = 3e-8
#: Hits that a single wire needs.
LEAST_HITS = 10
#: Added to the information on a constant of a single wire, in units of that with known tracks.
_HELD = 1e-12


def known_modes(detector: Detector, constants: Sequence[Constant]) -> dict[str, Floats]:
    """Return displacements that tracks may not see, each (constants,) float64, by name.

    Parameters
    ----------
    detector : Detector
    constants : sequence of Constant
        Free ones.
    """
    names = [one.name for one in constants]
    known, vectors = set(names), dict[str, Floats]()
    wholes = [layer.path for layer in detector.layers] + ["drift_chamber"] * (detector.drift_chamber is not None)
    for key in PLACEMENT:
        moved: dict[str, float] = {}
        for path in wholes:
            ways = (way for way in [[f"{path}.{key}"], *_finer(detector, known, path, key)] if known.issuperset(way))
            moved |= dict.fromkeys(next(ways, []), 1.0)
        vectors[f"common {key}"] = _vector(names, moved)
    # A turn of all about the beam line turns the shifts, too.
    for part_path in {one.part for one in constants if one.key in PLACEMENT}:
        shift_x, shift_y = (_value(detector, f"{part_path}.shift_{axis}") for axis in "xy")
        vectors["common rotation"] += _vector(
            names, {f"{part_path}.shift_x": -shift_y, f"{part_path}.shift_y": shift_x}
        )
    for layer in detector.cgem:
        path = layer.path
        for way in ([f"{path}.rotation"], *_finer(detector, known, path, "rotation")):
            if known.issuperset({f"{path}.{LORENTZ}", *way}):
                # About the axis of the layer itself.
                values = dict.fromkeys(way, 1.0) | {f"{path}.{LORENTZ}": layer.r_readout}
                values |= {f"{path}.tilt_x": layer.tilt_y, f"{path}.tilt_y": -layer.tilt_x}
                vectors.setdefault(f"Lorentz shift and rotation of {layer.label}", _vector(names, values))
    # Lengths along the beam are those of the tracks where nothing else measures z.
    vectors["common z_scale"] = _vector(names, {f"{layer.path}.{Z_SCALE}": 1.0 for layer in detector.cgem})
    parts = [*wholes, *dict.fromkeys(one.part for one in constants if one.part not in wholes)]
    for path in parts:
        for key in (*PLACEMENT, *END_SHIFT):
            for way in _finer(detector, known, path, key):
                if known.issuperset({f"{path}.{key}", *way}):
                    values = {f"{path}.{key}": 1.0} | dict.fromkeys(way, -1.0)
                    vectors[f"{path}.{key} and {way[0].rpartition('.')[2]} of its parts"] = _vector(names, values)
    vectors |= _times(detector, names)
    for name in names:
        vectors[name] = _vector(names, {name: 1.0})
    return {name: vector for name, vector in vectors.items() if np.any(vector)}


def _finer(detector: Detector, known: set[str], path: str, key: str) -> list[list[str]]:
    """Return the constants of smaller parts that together do what a key of a part does, in each way."""
    for layer in detector.layers:
        if layer.path == path:
            return [[f"{path}.sheets.{i}.{key}" for i in range(layer.sheets)]] if key in ("shift_z", "rotation") else []
    wires = detector.drift_chamber.layers if detector.drift_chamber is not None else ()
    plates = sorted({name.rpartition(".")[0] for name in known if name.startswith("drift_chamber.plates.")})
    if ".plates." in path:
        first, last = map(int, path.rpartition(".")[2].split("-"))
        inside = [one.path for one in wires if first <= one.number <= last]
        return [[f"{one}.{key}" for one in inside]] if key in END_SHIFT else []
    both = [f"{end}_{key}" for end in ("east", "west") if f"{end}_{key}" in END_SHIFT]
    if path.startswith("drift_chamber.layers."):
        return [[f"{path}.{one}" for one in both]] if both else []
    if path != "drift_chamber":
        return []
    layers = [one.path for one in wires]
    ways = [[f"{one}.{name}" for one in group for name in both] for group in (plates, layers) if both and group]
    return [[f"{one}.{key}" for one in layers], *ways] if key in PLACEMENT else []


def _times(detector: Detector, names: Sequence[str]) -> dict[str, Floats]:
    """Return changes of the relation of drift distance and time that are changes of its zero, and the like."""
    wires, points = detector.wires, points_of_relation(detector)
    vectors = {}
    shared = [f"drift_chamber.drift_relation.{k}mm" for k in points]
    zeros = dict.fromkeys((f"{one.path}.t0" for one in wires), -1.0)
    vectors["t0 of all wire layers and their relation"] = _all(names, dict.fromkeys(shared, 1.0) | zeros)
    for layer in wires:
        shifts = dict.fromkeys((f"{layer.path}.drift_relation.{k}mm" for k in points), 1.0)
        vectors[f"t0 and relation of {layer.path}"] = _all(names, shifts | {f"{layer.path}.t0": -1.0})
    for k, name in zip(points, shared, strict=True):
        shifts = dict.fromkeys((f"{one.path}.drift_relation.{k}mm" for one in wires), -1.0)
        vectors[f"relation of all wire layers and of each at {k} mm"] = _all(names, {name: 1.0} | shifts)
    return vectors


def _all(names: Sequence[str], values: Mapping[str, float]) -> Floats:
    """Return the vector of some values, of those that are free; nothing unless there are two signs of them."""
    vector = _vector(names, values)
    return vector if (vector > 0).any() and (vector < 0).any() else np.zeros(len(names))


def _value(detector: Detector, name: str) -> float:
    found = value_of(detector, name)
    return found[0] if found else 0.0


def _vector(names: Sequence[str], values: Mapping[str, float]) -> Floats:
    return np.array([values.get(name, 0.0) for name in names])


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Shown, Tabular):
    """Combinations of constants that the data determine worst.

    Attributes
    ----------
    names : tuple of str
        Of the nearest pattern.
    shares : tuple of float
        Square of the cosine between mode and pattern, 0 to 1.
    sizes : tuple of float
        Error of the mode: standard deviation of its largest displacement, mm; infinite for zero modes.
    shapes : ndarray, (modes, constants) float64
        Mode of its largest displacement 1 mm.
    constants : tuple of str
    """

    names: tuple[str, ...]
    shares: tuple[float, ...]
    sizes: tuple[float, ...]
    shapes: Floats
    constants: tuple[str, ...]

    def columns(self) -> dict[str, list[object]]:
        """Return name, share, size (mm) and the constants of each mode."""
        columns: dict[str, list[object]] = {
            "name": list(self.names), "share": list(self.shares), "size_mm": list(self.sizes)
        }  # fmt: skip
        return columns | {name: list(self.shapes[:, i]) for i, name in enumerate(self.constants)}

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        rows = [
            [name, f"{share:.2f}", f"{1e3 * size:.4g}" if np.isfinite(size) else "not determined"]
            for name, share, size in zip(self.names, self.shares, self.sizes, strict=True)
        ]
        return "weakest modes", ("nearest pattern", "share", "error [um]"), rows


@dataclass(frozen=True, eq=False)
class Solution:
    """Constants that sums determine, and their errors.

    Attributes
    ----------
    constants : tuple of Constant
        Free ones.
    value : ndarray, (n,) float64
        To be added to the description: mm, rad or 1; 0 for those that are not determined.
    variance : ndarray, (n,) float64
    matrix : ndarray, (n, n) float64, or None
        Covariance, 0 in the zero modes; None: of single wires.
    status : tuple of str
        As in `AlignmentTable`.
    prior : ndarray, (n,) float64
        Errors of surveys; NaN: none.
    zero_modes : tuple of str
        Names of the combinations that the data do not determine.
    information : ndarray, (n, n) float64, or Blocks
        Of data and surveys.
    """

    detector: Detector
    constants: tuple[Constant, ...]
    value: Floats
    variance: Floats
    matrix: Floats | None
    status: tuple[str, ...]
    prior: Floats
    zero_modes: tuple[str, ...]
    zeros: Floats
    information: Floats | Blocks
    measured: Floats

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the constants."""
        return tuple(one.name for one in self.constants)

    @property
    def cov(self) -> Floats:
        """Covariance, (n, n) float64; 0 in the zero modes.

        Raises
        ------
        ValueError
            If the constants are those of single wires, of which only the diagonal is computed.
        """
        if self.matrix is None:
            raise ValueError("single wires have errors, and neither a covariance nor modes")
        return self.matrix

    @property
    def determined(self) -> npt.NDArray[np.bool_]:
        """Whether each constant has a number, (n,) bool."""
        return np.array([status != "undetermined" for status in self.status], bool)

    @cached_property
    def err(self) -> Floats:
        """Standard deviations, (n,); NaN without a number."""
        return np.where(self.determined, np.sqrt(np.maximum(self.variance, 0)), np.nan)

    @property
    def global_correlation(self) -> Floats:
        """Correlation of each constant with all others together, (n,); NaN without a number."""
        both = self.variance * self.information.diagonal()
        with np.errstate(invalid="ignore", divide="ignore"):
            found = np.sqrt(np.clip(1 - 1 / both, 0, 1))
        return np.where(self.determined, found, np.nan)

    def table(self, total: Floats | None = None, fixed: Sequence[Constant] = ()) -> AlignmentTable:
        """Return the constants as a table.

        Parameters
        ----------
        total : ndarray or None, (n,) float64
            Values instead of those of this solution.
        fixed : sequence of Constant
            Of value 0, after the others.
        """
        value = np.where(self.determined, self.value if total is None else total, np.nan)
        nan = (np.nan,) * len(fixed)
        every = (*self.constants, *fixed)
        return AlignmentTable(
            tuple(one.name for one in every), tuple(one.unit for one in every),
            (*map(float, value), *((0.0,) * len(fixed))),
            (*map(float, self.err), *nan), (*map(float, self.prior), *nan),
            (*map(float, self.global_correlation), *nan), (*self.status, *(("fixed",) * len(fixed))),
        )  # fmt: skip

    def modes(self, number: int = 5) -> Modes:
        """Return the weakest modes, zero modes first."""
        reach = np.array([_reach(self.detector, one) for one in self.constants])
        patterns = _patterns(self.detector, self.names)
        shapes = [zero / max(np.abs(zero * reach).max(), 1e-300) for zero in self.zeros]
        sizes, names, shares = [np.inf] * len(shapes), list(self.zero_modes), [1.0] * len(shapes)
        # In displacements, not in numbers of mm and rad.
        values, vectors = np.linalg.eigh(self.cov * reach[:, None] * reach)
        for i in np.argsort(-values)[: max(number - len(shapes), 0)]:
            moved = vectors[:, i] / np.abs(vectors[:, i]).max()
            overlaps = {
                name: float(np.dot(moved, one * reach) ** 2 / np.dot(moved, moved) / np.dot(one * reach, one * reach))
                for name, one in patterns.items()
            }
            best = max(overlaps, key=lambda name: overlaps[name]) if overlaps else ""
            shapes.append(moved / reach)
            sizes.append(float(np.sqrt(max(values[i], 0)) * np.abs(vectors[:, i]).max()))
            names.append(best)
            shares.append(overlaps.get(best, 0.0))
        shown = slice(0, number)
        array = np.array(shapes[shown]).reshape(-1, len(self.constants))
        return Modes(tuple(names[shown]), tuple(shares[shown]), tuple(sizes[shown]), array, self.names)


class Determined(Shown, Tabular):
    """What tracks determine, or will determine: a table of constants, and their errors together."""

    table: AlignmentTable
    solution: Solution

    @property
    def cov(self) -> Floats:
        """Covariance of the free constants, (n, n) float64; 0 in the zero modes. A ValueError for single wires."""
        return self.solution.cov

    @property
    def zero_modes(self) -> tuple[str, ...]:
        """Names of the combinations that the tracks do not determine."""
        return self.solution.zero_modes

    def modes(self, number: int = 5) -> Modes:
        """Return the weakest modes, zero modes first, each with the name of the nearest pattern.

        Parameters
        ----------
        number : int
        """
        return self.solution.modes(number)

    def columns(self) -> dict[str, tuple[object, ...]]:
        """Return the table as columns."""
        return self.table.columns()


def _reach(detector: Detector, constant: Constant) -> float:
    """Return the displacement of the farthest point of a part by one unit of a constant, mm."""
    if constant.unit == "mm":
        return 1.0
    chamber = detector.drift_chamber
    r = max([layer.r_readout for layer in detector.layers] + ([chamber.layers[-1].r_end] if chamber else []))
    half = max([layer.half_length for layer in detector.layers] + [wires.half_length for wires in detector.wires])
    if constant.unit == "ns":
        return _VELOCITY
    for layer in detector.layers:
        if f"{constant.part}.".startswith(f"{layer.path}."):
            r, half = layer.r_readout, layer.half_length
    for wires in detector.wires:
        if constant.part == wires.path:
            r, half = wires.r_end, wires.half_length
    return half if constant.key.startswith("tilt") or constant.key == Z_SCALE else r


def _patterns(detector: Detector, names: Sequence[str]) -> dict[str, Floats]:
    """Return the constants of each pattern that the parts can follow."""
    vectors = {name: _vector(names, pattern_values(detector, name)[0]) for name in PATTERNS}
    parts = {name.rpartition(".")[0] for name in names if name.rpartition(".")[2] in PLACEMENT}
    for key in PLACEMENT:
        vectors[f"common {key}"] = _vector(names, {f"{part}.{key}": 1.0 for part in parts})
    vectors |= {name: _vector(names, {name: 1.0}) for name in names}
    return {name: vector for name, vector in vectors.items() if np.any(vector)}


def solve(
    detector: Detector, constants: Sequence[Constant], sums: Sums, priors: Mapping[str, float],
    offset: Floats | None = None, *, constrain: bool = False, zero: Sequence[str] = (),
    unseen: Sequence[str] = (),
) -> Solution:  # fmt: skip
    """Solve the normal equations.

    Parameters
    ----------
    detector : Detector
    constants : sequence of Constant
    sums : Sums
    priors : mapping of str to float
        Errors of surveys by name.
    offset : ndarray or None, (n,) float64
        Present values of the constants minus those of the survey. None: 0.
    constrain : bool
        Whether zero modes are set to 0; otherwise the constants in them are not determined.
    zero : sequence of str
        Names of zero modes that are known before.
    unseen : sequence of str
        Constants that no hit measures in the parts' places, and only by the tilts of an iteration.
    """
    n = len(constants)
    prior = np.array([priors.get(one.name, np.nan) for one in constants])
    survey = np.where(np.isfinite(prior), 1 / prior**2, 0.0)
    if isinstance(sums.normal, Blocks):
        return _solve_wires(detector, constants, sums, sums.normal, prior, offset, constrain=constrain, zero=zero)
    seen = (sums.measured > 0) & ~np.isin([one.name for one in constants], unseen)
    known = seen | (survey > 0)
    scale = np.zeros(n)
    scale[known] = 1 / np.sqrt(np.where(seen, sums.measured, survey)[known])
    normal = sums.normal * scale[:, None] * scale
    right = (sums.right - survey * (0.0 if offset is None else offset)) * scale
    names, zeros = [], np.zeros((0, n))
    for name, vector in known_modes(detector, constants).items():
        vector = np.where(seen, vector, 0.0)
        if not np.any(vector):
            continue
        scaled = np.divide(vector, scale, out=np.zeros(n), where=scale > 0)
        information = float(vector @ sums.normal @ vector) / float(scaled @ scaled)
        rest = scaled - zeros.T @ (zeros @ scaled)
        if (information < _NONE or name in zero) and rest @ rest > 1e-6 * (scaled @ scaled):
            zeros = np.vstack([zeros, rest / np.linalg.norm(rest)])
            names.append(name)
    # What is known not to be seen is taken out of the data: rounding must not look like information.
    normal = _without(normal, zeros)
    values, vectors = np.linalg.eigh(normal)
    for i in np.flatnonzero(values < _ROUNDING):
        vector = np.where(seen, vectors[:, i], 0.0)
        rest = vector - zeros.T @ (zeros @ vector)
        if rest @ rest > 1e-3:
            zeros = np.vstack([zeros, rest / np.linalg.norm(rest)])
            names.append(constants[int(np.abs(rest).argmax())].name + " and others")
    normal = _without(normal, zeros) + np.diag(survey * scale**2)
    right = right - zeros.T @ (zeros @ (sums.right * scale))
    # Surveys may determine some of them.
    inside = zeros @ np.diag(survey * scale**2) @ zeros.T
    strengths, turned = np.linalg.eigh(inside) if len(zeros) else (np.zeros(0), np.zeros((0, 0)))
    open_ = (turned.T @ zeros)[strengths < 1e-14] if len(zeros) else zeros
    if len(zeros) and len(open_) == len(zeros):
        open_names = tuple(names)
        open_ = zeros
    else:
        open_names = tuple(names[int(np.abs(turned[:, i]).argmax())] for i in range(len(names)) if strengths[i] < 1e-14)
    none = np.eye(n)[~known]
    full = normal + open_.T @ open_ + none.T @ none
    inverse = np.linalg.inv(full) - open_.T @ open_ - none.T @ none
    inverse = 0.5 * (inverse + inverse.T)
    in_zero = np.sqrt(np.sum(open_**2, axis=0)) > _PART
    status = np.where(~known, "undetermined", np.where(in_zero, "constrained" if constrain else "undetermined", "free"))
    value = scale * (inverse @ right)
    value[status == "undetermined"] = 0.0
    physical, cov = open_ * scale, inverse * scale[:, None] * scale
    return Solution(
        detector, tuple(constants), value, np.diagonal(cov), cov, tuple(map(str, status)), prior,
        open_names, physical, sums.normal + np.diag(survey), sums.measured,
    )  # fmt: skip


def _wire_modes(detector: Detector, constants: Sequence[Constant]) -> dict[str, Floats]:
    """Return displacements of the chamber as those of the ends of its wires, each (constants,) mm, by name."""
    moved = dict[str, list[Floats]]()
    for layer in detector.wires:
        ends = layer.wire_ends(np.arange(layer.cells))  # (wires, end, 3)
        slope = (ends[:, 0, :2] - ends[:, 1, :2]) / (ends[:, 0, 2] - ends[:, 1, 2])[:, None]
        phi = np.arctan2(ends[..., 1], ends[..., 0])
        outward = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
        for axis, letter in enumerate("xyz"):
            unit = np.eye(3)[axis]
            turn = "rotation" if letter == "z" else f"tilt_{letter}"
            for key, at in ((f"shift_{letter}", np.broadcast_to(unit, ends.shape)), (turn, np.cross(unit, ends))):
                # A wire that moves along the beam lies where one moves across it, by its slope.
                across = at[..., :2] - at[..., 2:] * slope[:, None, :]
                radial = np.sum(across * outward, axis=-1)
                along_phi = outward[..., 0] * across[..., 1] - outward[..., 1] * across[..., 0]
                values = np.stack([radial, along_phi], axis=-1).reshape(layer.cells, 4)
                moved.setdefault(f"common {key}", []).append(values)
    first = np.cumsum([0, *(layer.cells for layer in detector.wires)])
    layer_of, wire, key_of = np.array([one.columns[0][1] for one in constants]).T
    return {name: np.concatenate(values)[first[layer_of] + wire, key_of] for name, values in moved.items()}


def _solve_wires(
    detector: Detector, constants: Sequence[Constant], sums: Sums, normal: Blocks, prior: Floats,
    offset: Floats | None, *, constrain: bool, zero: Sequence[str],
) -> Solution:  # fmt: skip
    """Solve the normal equations of single wires, in blocks of neighbours.

    Zero modes are 0 in the solution. Wires with few hits, and constants with an error beyond their range, have no
    number; they stay free, so that their hits do not pull the others.
    """
    n = len(constants)
    survey = np.where(np.isfinite(prior), 1 / prior**2, 0.0)
    measured = sums.measured + survey
    known = measured > 0
    scale = np.where(known, 1 / np.sqrt(np.where(known, measured, 1.0)), 0.0)
    right = (sums.right - survey * (0.0 if offset is None else offset)) * scale
    information = normal.scaled(np.ones(n), survey)
    # A constant without information stands alone; one that others determine exactly is held by rounding.
    matrix = normal.scaled(scale, survey * scale**2 + np.where(known, _HELD, 1.0))
    names, zeros = [], np.zeros((0, n))
    for name, vector in _wire_modes(detector, constants).items():
        scaled = np.divide(vector, scale, out=np.zeros(n), where=scale > 0)
        inside = scaled * scale
        if not np.any(scaled):
            continue
        rest = scaled - zeros.T @ (zeros @ scaled)
        found = float(inside @ (information @ inside)) / float(scaled @ scaled)
        if (found < _NONE_OF_WIRES or name in zero) and rest @ rest > 1e-6 * (scaled @ scaled):
            zeros = np.vstack([zeros, rest / np.linalg.norm(rest)])
            names.append(name)
    factor = Factor(matrix)
    solved = factor.solve(np.stack([right, *zeros], axis=1))
    value, beside = solved[:, 0], solved[:, 1:]
    # With the condition zeros x = 0.
    inside_zeros = zeros @ beside
    value = value - beside @ np.linalg.solve(inside_zeros, zeros @ value)
    variance = factor.variances() - np.sum(beside * np.linalg.solve(inside_zeros, beside.T).T, axis=1)
    variance, value = variance * scale**2, value * scale
    in_zero = np.sqrt(np.sum(zeros**2, axis=0)) > _PART
    surveyed = survey > 0
    open_ = ~known | (variance > FAR**2) | (~surveyed & (normal.hits < LEAST_HITS))
    status = np.where(open_, "undetermined", np.where(in_zero, "constrained" if constrain else "undetermined", "free"))
    value[status == "undetermined"] = 0.0
    return Solution(
        detector, tuple(constants), value, variance, None, tuple(map(str, status)), prior, tuple(names), zeros * scale,
        information, sums.measured,
    )  # fmt: skip


def _without(normal: Floats, zeros: Floats) -> Floats:
    kept = np.eye(len(normal)) - zeros.T @ zeros
    return np.asarray(kept @ normal @ kept)
