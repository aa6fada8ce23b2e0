"""The detector: an immutable, checked dataclass of its parts, loaded from a preset, a file or a dict."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.arrays import Floats
from cgemit.base.errors import DetectorError, Problem, Problems, shown
from cgemit.detector import check, delphes, export, variants
from cgemit.detector.alignment import (
    AlignmentTable,
    constants_in,
    displacements_of,
    misaligned_values,
    overrides_of,
)
from cgemit.detector.build import read_contents
from cgemit.detector.files import field_tables, is_card, is_preset, open_source, place_map, resolve
from cgemit.detector.keys import Known, once
from cgemit.detector.layers import CgemLayer, Layer
from cgemit.detector.parts import Contents, Cylinder, cgem_layers
from cgemit.detector.reader import merged, readout_of, readout_table, set_path
from cgemit.detector.readouts import Readout
from cgemit.tables import Table
from cgemit.units import NATIVE


@dataclass(frozen=True, kw_only=True)
class Detector(Contents):
    """A complete detector, parts ordered from the beam line outward.

    Raises
    ------
    DetectorError
        With every problem, if parts overlap, strips do not fit, or a value is out of its range.

    Examples
    --------
    >>> det = cg.load("besiii-cgem")
    >>> [layer.label for layer in det.cgem], det.cgem["L1"].strips_x, len(det.drift_chamber.layers)
    (['L1', 'L2', 'L3'], 856, 35)
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        problems = check.value_problems(self) + check.geometry_problems(
            self.beam_pipe, self.barrels, self.walls, self.drift_chamber
        )
        if problems:
            raise DetectorError(self.name, problems)

    def __hash__(self) -> int:
        # Caches look up the detector at every call; the hash of all parts would slow this down.
        return hash((self.name, self.description))

    def __repr__(self) -> str:
        return export.summary(self)

    def _repr_html_(self) -> str:
        return export.summary_html(self)

    def to_toml(self) -> str:
        """Return a complete detector file, without a base, that `load` reads back to an equal detector."""
        return export.to_toml(self)

    def to_gdml(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write volumes and materials as GDML, for Geant4, DD4hep and ROOT.

        The world is air; each sub-layer is a tube of its material at its effective density, with an `auxiliary` that
        states its radiation length; the gas of the chamber is one tube for each wire layer, smeared wires mixed in.
        Readout, wires one by one, and the field are not written.

        Parameters
        ----------
        path : path
        overwrite : bool

        Raises
        ------
        FileExistsError
            If `path` exists and `overwrite` is false.

        """
        export.write_gdml(self, path, overwrite=overwrite)

    def with_overrides(self, overrides: dict[str, object]) -> Detector:
        """Return a variant: dotted keys of the detector file and their values.

        For example ``{"cgem.L2.pitch_x": "500 um"}``. Strip counts and stereo angles that depend on a changed value
        are recomputed. Labels may be patterns (``"cgem.*.pitch_x"``), several keys may stand together, separated by
        commas, and numbers may be relative (``"x2"``, ``"+5 %"``). The name is made of what changed.

        Raises
        ------
        DetectorError
            With every problem of the result.

        Examples
        --------
        >>> det = cg.load("besiii-cgem").with_overrides({"cgem.*.pitch_x": "500 um", "field.bz": "0.9 T"})
        >>> det.name, det.cgem["L2"].pitch_x
        ('besiii-cgem+cgem.pitch_x=500um+field.bz=0.9T', 0.5)
        """
        return override(self, overrides)

    @cached_property
    def content_hash(self) -> str:
        """Sixteen hexadecimal digits that name the content, whatever name and description are."""
        return variants.content_hash(self)

    def bounds(self, key: str) -> tuple[float, float]:
        """Return the range of a number, in its native unit, for which the detector is possible with all else kept.

        Parameters
        ----------
        key : str
            Dotted key. If it stands for several values, as a pattern does, these must be equal.

        Returns
        -------
        (float, float)
            The lowest and the highest allowed value. Neighbouring parts then touch, or the sensible range of the key
            ends.

        Raises
        ------
        DetectorError
            If the key does not stand for one number.

        Examples
        --------
        >>> [round(end, 2) for end in cg.load("besiii-cgem").bounds("cgem.L2.anode_radius")]
        [107.47, 157.68]
        """
        return bounds(self, key)

    def with_field(self, source: str | Path | Mapping[str, Any]) -> Detector:
        """Return the same detector in another field: a preset (see `fields`), a map, a TOML file, or a table [field].

        Raises DetectorError with every problem of the field.

        Examples
        --------
        >>> cg.load("besiii-cgem").with_field({"kind": "uniform", "bz": "0.9 T"}).field.bz
        0.9
        """
        return replace_field(self, source)

    def with_readout(self, readout: Readout | str | Mapping[str, Any]) -> Detector:
        """Return the same detector, of the same name, with one readout of all CGEM layers.

        The keys ``cgem.LABEL.readout`` and `with_overrides` choose the readout of each layer.

        Parameters
        ----------
        readout : Readout, str or mapping
            A name stands for the readout with its defaults; a mapping is a table as in a detector file, such as
            ``{"name": "tiger", "noise": "0.4 fC"}``.

        Raises
        ------
        DetectorError
            With every problem of the readout.

        Examples
        --------
        >>> det = cg.load("besiii-cgem").with_readout("tiger")
        >>> det.cgem["L1"].readout.threshold_x  # fC
        2.0
        """
        return replace_readout(self, readout)

    def with_alignment(self, table: AlignmentTable | Mapping[str, float] | str | os.PathLike[str]) -> Detector:
        """Return the detector with constants from tracks, or displacements, added to those that it has.

        Parameters
        ----------
        table : AlignmentTable, mapping or path
            Of `cgemit.align`; the CSV file that it writes; or numbers by name, such as ``{"cgem.L1.shift_x": 0.1}``,
            mm, rad and ns. Constants that were not determined stay as they are.

        Raises
        ------
        DetectorError
            Listing every problem: unknown names, values out of the range of their keys.

        Examples
        --------
        >>> det = cg.load("besiii-cgem").with_alignment({"cgem.L1.shift_x": 0.1})
        >>> det.with_alignment({"cgem.L1.shift_x": 0.05}).cgem["L1"].shift_x
        0.15000000000000002
        """
        values = overrides_of(self, constants_in(table, self.name))
        return override(self, {**values, "name": self.name}) if values else self

    def misaligned(self, seed: int, sizes: Mapping[str, object]) -> Detector:
        """Return the detector with displaced parts, for studies of alignment.

        Parameters
        ----------
        seed : int
            A displacement depends on it and on the name of the constant alone.
        sizes : mapping
            Standard deviations of random displacements: of the shifts and the turns of parts,
            ``{"cgem.*": ("100 um", "0.1 mrad")}``, or of one key, ``{"cgem.L1.shift_x": "50 um"}``; later ones count.
            A pattern and its size, ``{"telescope": "100 um"}``, is added as it is, as well as whole parts can follow
            it, or else the ends of wires (twist). Patterns are radial, telescope, layer_rotation, curl, bowing,
            z_expansion, twist, elliptical, skew, clamshell and sagitta.

        Raises
        ------
        DetectorError
            Listing every problem: unknown parts, sizes that are none, patterns that the parts of this detector cannot
            follow, displacements out of the range of their keys.

        Examples
        --------
        >>> det = cg.load("besiii-cgem").misaligned(seed=1, sizes={"cgem.*": ("100 um", "0.1 mrad"), "curl": "50 um"})
        >>> det.cgem["L1"].is_moved, det.drift_chamber.is_moved
        (True, True)
        """
        return self.with_alignment(misaligned_values(self, seed, sizes))

    def displacements(self) -> AlignmentTable:
        """Return the displacements of all parts as a table, with status ``"fixed"``.

        Examples
        --------
        >>> len(cg.load("besiii-cgem").displacements().name)  # three layers and the chamber
        24
        """
        return displacements_of(self)

    @property
    def groups(self) -> tuple[ReadoutGroup, ...]:
        """The layers by their readout, by the innermost layer of each; every layer is in one of them.

        A detector without layers has one group without layers.

        Examples
        --------
        >>> det = cg.load("besiii-pixel").with_readout("tiger")
        >>> [(group.readout.name, group.numbers) for group in det.groups]
        [('positions', (0,)), ('tiger', (1, 2, 3))]
        """
        return _groups(self)

    @property
    def readout_text(self) -> str:
        """Names of the readouts of the CGEM layers, such as ``tiger``, or ``tiger (L1), apv25 (L2, L3)``.

        Examples
        --------
        >>> cg.load("besiii-cgem").with_overrides({"cgem.L1.readout": "tiger"}).readout_text
        'tiger (L1), binary (L2, L3)'
        """
        labels: dict[str, list[str]] = {}
        for layer in self.cgem:
            labels.setdefault(layer.readout.name, []).append(layer.label)
        if len(labels) == 1:
            return next(iter(labels))
        return ", ".join(f"{name} ({', '.join(layers)})" for name, layers in labels.items())


@once
def _groups(detector: Detector) -> tuple[ReadoutGroup, ...]:
    """Return the groups of a detector; see `Detector.groups`."""
    by_readout: list[tuple[Readout, list[int]]] = []  # a readout from outside the package may have no hash
    for layer_number, layer in enumerate(detector.layers):
        numbers = next((numbers for readout, numbers in by_readout if readout == layer.readout), None)
        if numbers is None:
            by_readout.append((layer.readout, [layer_number]))
        else:
            numbers.append(layer_number)
    by_readout = by_readout or [(CgemLayer.usual_readout, [])]
    return tuple(ReadoutGroup(detector, readout, tuple(numbers)) for readout, numbers in by_readout)


@dataclass(frozen=True)
class ReadoutGroup:
    """The layers of a detector that are read out alike, as digitizers and clusterers see them.

    Rows of tables keep the numbers of layers and strips of the whole detector.

    Attributes
    ----------
    detector : Detector
    readout : Readout
    numbers : tuple of int
        Of its layers in `Detector.layers`, growing.

    Examples
    --------
    >>> pixels, cgem = cg.load("besiii-pixel").groups
    >>> [(number, layer.label) for number, layer in cgem.items()]
    [(1, 'L1'), (2, 'L2'), (3, 'L3')]
    """

    detector: Detector
    readout: Readout
    numbers: tuple[int, ...]

    def __hash__(self) -> int:  # a readout from outside the package may have no hash
        return hash((self.detector, self.readout.name, self.numbers))

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The layers; `items` tells their numbers."""
        return tuple(self.detector.layers[number] for number in self.numbers)

    @property
    def cgem(self) -> tuple[CgemLayer, ...]:
        """The same, of a readout of CGEM layers."""
        return cgem_layers(self.detector, self.numbers)

    def items(self) -> Iterator[tuple[int, Layer]]:
        """Return the layers with their numbers, which are those of the rows of tables."""
        return zip(self.numbers, self.layers, strict=True)

    def owns(self, table: Table) -> npt.NDArray[np.bool_]:
        """Return which rows of a table are those of the group's layers, (rows,) bool.

        Parameters
        ----------
        table : Table
            With a column `layer`.

        Raises
        ------
        ValueError
            If a layer is not in the detector.
        """
        layer, layers = table["layer"], len(self.detector.layers)
        wrong = np.flatnonzero((layer < 0) | (layer >= layers))
        if len(wrong):
            expected = f"a layer of the detector, 0 to {layers - 1}"
            raise ValueError(f"{table.kind} row {wrong[0]}: layer: got {layer[wrong[0]]}, expected {expected}")
        is_own = np.zeros(layers, np.bool_)
        is_own[list(self.numbers)] = True
        return np.asarray(is_own[layer])

    def columns(self, names: Sequence[str], rows: Sequence[Sequence[float]]) -> dict[str, Floats]:
        """Return a row of numbers for each of the group's layers as columns by name; see `among_all`.

        Parameters
        ----------
        names : sequence of str
        rows : sequence of sequences of float
        """
        table = self.among_all(np.array(rows, np.float64).reshape(-1, len(names)))
        return dict(zip(names, table.T.copy(), strict=True))

    def among_all(
        self, values: npt.NDArray[np.float64], views: int = 1, fill: float = np.nan
    ) -> npt.NDArray[np.float64]:
        """Return values of the group's layers as the core takes them, for all layers of the detector.

        Parameters
        ----------
        values : ndarray, (views * layers, ...) float64
            Layer by layer of a view, then of the next one. Of one dimension, each layer may have several.
        views : int
        fill : float
            For the other layers, of which there are no rows: a kernel that reads it makes a mistake, which NaN shows.
        """
        layers, n = len(self.detector.layers), len(self.numbers)
        if n == layers:
            return values
        filled = np.full((views, layers, values.size // (views * n)), fill)
        filled[:, list(self.numbers)] = values.reshape(views, n, -1)
        return filled.ravel() if values.ndim == 1 else filled.reshape(views * layers, *values.shape[1:])


def load(source: str | Path | Mapping[str, Any] | Detector) -> Detector:
    """Return the detector that a preset, a detector file or a mapping of the same form describes.

    Parameters
    ----------
    source : str, Path, mapping or Detector
        Name of a preset (see `detectors`), path to a TOML file or to a Delphes card (``.tcl``, of which the barrel is
        read; a ``.txt`` with its rows alone can be a `base`), or tables as `tomllib` returns them; a `Detector` is
        returned as it is.

    Raises
    ------
    DetectorError
        With all problems of the description.

    Examples
    --------
    >>> det = cg.load({"base": "besiii-cgem", "name": "fine", "cgem": {"L1": {"pitch_x": "400 um"}}})
    >>> det.name, det.cgem["L1"].pitch_x, det.cgem["L1"].strips_x
    ('fine', 0.4, 1416)
    """
    if isinstance(source, Detector):
        return source
    if not isinstance(source, Mapping) and is_preset(str(source)):
        return preset(str(source))
    return _loaded(source)


@cache
def preset(name: str) -> Detector:
    """Return a preset; its file does not change while the program runs."""
    return _loaded(name)


def _loaded(source: str | Path | Mapping[str, Any]) -> Detector:
    """Return the detector of a preset, a file or tables; see `load`."""
    if not isinstance(source, Mapping) and is_card(Path(source)):
        source = delphes.read_card(source)
    opened = open_source(source)
    problems = Problems()
    try:
        tables = resolve(opened, problems, partial(delphes.read_card, field=False))
    except RecursionError:
        raise DetectorError(opened.name, [Problem("", "tables in tables in tables ...", "fewer levels")]) from None
    if "name" not in opened.tables:
        tables["name"] = Path(opened.name).stem
    if "description" not in opened.tables:
        base = opened.tables.get("base")
        tables["description"] = f"variant of {base}" if base else ""
    return build(opened.name, tables, problems)


def override(detector: Detector, overrides: Mapping[str, object]) -> Detector:
    """Return the detector with some values changed; see `Detector.with_overrides`."""
    problems = Problems()
    if not isinstance(overrides, Mapping) or not all(isinstance(key, str) for key in overrides):
        raise DetectorError(detector.name, [Problem("", f"{overrides!r:.80}", "values by dotted key")])
    variant: dict[str, Any] = {}
    for path, value in variants.expanded(detector, overrides, problems).items():
        if path == "base":
            problems.append(Problem(path, shown(value), "a value of the detector; load another base instead"))
        elif not set_path(variant, path, _table_of(path, value)):
            problems.append(Problem(path, shown(value), "a value whose table is not itself overridden by a value"))
    tables = merged(export.tables_of(detector, variant), place_map(variant, None), problems)
    if "name" not in variant:
        tables["name"] = variants.variant_name(detector.name, overrides)
    return build(detector.name, tables, problems)


def _table_of(path: str, value: object) -> object:
    """Return the name of a readout as a table, in which longer keys may change values; any other value as it is."""
    is_readout = path.rpartition(".")[2] == "readout" and isinstance(value, str | Readout)
    return readout_table(value) if is_readout else value  # type: ignore[arg-type]


def replace_field(detector: Detector, source: str | Path | Mapping[str, Any]) -> Detector:
    """Return the detector in another field; see `Detector.with_field`."""
    tables = export.tables_of(detector) | {"field": field_tables(source)}
    text = dict(source) if isinstance(source, Mapping) else Path(source).stem
    return build(detector.name, tables | {"name": variants.variant_name(detector.name, {"field": text})}, Problems())


def replace_readout(detector: Detector, readout: Readout | str | Mapping[str, Any]) -> Detector:
    """Return the detector with one readout of all CGEM layers; see `Detector.with_readout`."""
    readout = readout_of(readout)
    if all(layer.readout == readout for layer in detector.cgem):
        return detector
    return _with_readout(detector, readout)


@once
def _with_readout(detector: Detector, readout: Readout) -> Detector:
    return replace(detector, barrels=[layer.with_readout(readout) for layer in detector.barrels])  # type: ignore[arg-type]


def bounds(detector: Detector, key: str) -> tuple[float, float]:
    """Return the allowed range of a number; see `Detector.bounds`."""
    problems = Problems()
    now = variants.values_at(detector, key, problems) if isinstance(key, str) else []
    stated = [found for found in now if found and found[0] is not None]
    numbers = [found for found in stated if found[1].kind in NATIVE or found[1].kind == "integer"]
    if not numbers or len(numbers) < len(now) or len({number for number, _ in numbers}) > 1:
        different = ", ".join(dict.fromkeys(f"{number:g}" for number, _ in numbers))
        given = f"different values: {different}" if len(numbers) > 1 else "no number"
        raise DetectorError(detector.name, problems or [Problem(str(key), given, "the dotted key of one number")])
    start, limits = numbers[0]
    order = _order(detector)

    def allowed(value: float) -> bool:
        try:  # a part that has jumped over its neighbour is beyond the range
            return _order(override(detector, {key: Known(value)})) == order
        except DetectorError:
            return False

    whole = limits.kind == "integer"
    low, high = (_edge(allowed, start, end, whole) for end in (limits.low, limits.high))
    return low, high


def _order(detector: Detector) -> list[str]:
    """Return the parts from inside outward."""
    parts: list[Cylinder | Layer] = [*detector.beam_pipe, *detector.barrels, *detector.walls]
    radii = [(part.r_in, part.label) for part in parts]
    if detector.drift_chamber:
        radii += [(layer.r_mid, str(layer.number)) for layer in detector.drift_chamber.layers]
    return [label for _, label in sorted(radii)]


def _edge(allowed: Callable[[float], bool], inside: float, outside: float, whole: bool) -> float:
    """Return the value nearest to `outside` that is allowed, by bisection from `inside`, which is."""
    if allowed(outside):
        return outside
    while abs(outside - inside) > (1 if whole else 1e-9 * max(1.0, abs(inside))):
        middle = (inside + outside) // 2 if whole else 0.5 * (inside + outside)
        inside, outside = (middle, outside) if allowed(middle) else (inside, middle)
    return inside


def build(source: str, tables: Mapping[str, Any], problems: Problems) -> Detector:
    """Return the detector that complete tables describe; `problems` are those found before.

    Raises
    ------
    DetectorError
        With `problems` and all others of the tables.

    """
    contents = read_contents(source, tables, problems)
    try:
        return Detector(**contents.__getstate__())
    except DetectorError as error:
        raise DetectorError(source, error.problems) from None
