"""The table of a sweep: one row for each variant and point; written, printed, converted."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from cgemit.analysis.quantities import QUANTITIES
from cgemit.analysis.widths import jackknife
from cgemit.base.files import SUMMARY, add_files, keep_folder, package
from cgemit.base.validate import is_whole
from cgemit.base.version import PHYSICS
from cgemit.chain.record import versions
from cgemit.covariance.result import By
from cgemit.detector import Detector
from cgemit.detector.export import write_files
from cgemit.detector.variants import variant_name
from cgemit.study.sweep.evaluate import Evaluation, budgets
from cgemit.study.sweep.space import Space, axis_of
from cgemit.tables.show import Shown, data_frame, with_error, write_csv

if TYPE_CHECKING:
    from cgemit.draw.style import Picture


class TidyResult(Shown):
    """A result that is a table, `columns` by header."""

    columns: dict[str, list[Any]]

    def to_pandas(self) -> Any:
        """Return the table as a `pandas.DataFrame`."""
        return data_frame(self.columns)


class ChunkedResult(TidyResult):
    """A table that is made of chunks, whose names are its `plan`; its folder holds `work`, the name of the table."""

    plan: tuple[str, ...]
    work: ClassVar[str]

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds."""
        raise NotImplementedError

    def _detectors(self) -> dict[str, Detector]:
        """Return the detectors that are written, by file name."""
        raise NotImplementedError

    def write(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write sweep.csv or optimize.csv, detector.toml (the base), optimum.toml (if there is one) and summary.json.

        Parameters
        ----------
        folder : path
            One that is empty or missing, or holds results of the same plan, which are replaced.
        overwrite : bool
            Whether to replace all results that the folder holds.

        Returns
        -------
        list of Path
            The files.

        Raises
        ------
        OutputExistsError
            If the folder holds other files, or such that were changed after they were written.
        """
        keep_folder(folder, self.work, self.plan, overwrite=overwrite)
        with add_files(folder) as place:
            write_csv(place / f"{self.work}.csv", self.columns)
            files = write_files(place, self._detectors())
            (place / SUMMARY).write_text(json.dumps(self.summary(), indent=2) + "\n", encoding="utf-8")
            names = [str(path.relative_to(place)) for path in files]
        return [Path(folder) / name for name in (f"{self.work}.csv", *names, SUMMARY)]


#: Columns that say which variant a row is of and how it ended.
LEADING = ("variant", "name", "hash", "status", "problems")
_SHOWN_ROWS = 40
_LONGEST_CELL = 120  # characters


@dataclass(frozen=True, eq=False, repr=False)
class Sweep(ChunkedResult):
    """The result of a sweep.

    Attributes
    ----------
    columns : dict of str to list
        The tidy table: one row for each variant, momentum and angle; variant 0 is the base. `status` is "ok",
        "impossible" (`problems` says why the detector cannot be built), "failed" or "missing".
    parameters : tuple of str
        Columns of what is varied.
    results : tuple of str
        Columns of what was computed.
    space : Space
    evaluation : Evaluation
    bases : tuple of Detector
        The detector that each row's variant changes, by variant.
    plan : tuple of str
        Names of the chunks.

    Examples
    --------
    >>> variants, evaluation = {"cgem.*.pitch_x": ["400 um"]}, {"p": 1.0, "quantities": ["dr"]}
    >>> swept = cg.study.sweep("besiii-cgem-design", variants, evaluation)
    >>> [round(sigma) for sigma in swept.columns["sigma_dr (um)"]], swept.detector(1).cgem["L1"].pitch_x
    ([170, 134], 0.4)
    """

    work: ClassVar[str] = "sweep"

    columns: dict[str, list[Any]]
    parameters: tuple[str, ...]
    results: tuple[str, ...]
    space: Space
    evaluation: Evaluation
    bases: tuple[Detector, ...]
    plan: tuple[str, ...]

    @staticmethod
    def joined(
        space: Space, evaluation: Evaluation, bases: Sequence[Detector], rows: Sequence[Mapping[str, Any]],
        plan: tuple[str, ...],
    ) -> Sweep:  # fmt: skip
        """Return the table of the base and its variants, from one row each."""
        axes = [axis_of(key, bases[0], [one.get(key) for one in space.variants]) for key in space.keys]
        points = evaluation.points()
        by_variant = dict(zip(LEADING, _leading(space, bases, rows), strict=True)) | dict(axes)
        table = {name: [value for value in values for _ in points] for name, values in by_variant.items()}
        table |= {name: [point[name] for point in points] * len(rows) for name in points[0]}
        known = tuple(table)
        for number, row in enumerate(rows):
            first = number * len(points)
            for name, values in (row.get("columns", {}) | _differences(row, rows[0])).items():
                if name not in table:
                    table[name] = [None] * (len(rows) * len(points))
                table[name][first : first + len(points)] = values
        results = tuple(name for name in table if name not in known)
        table = {name: _of_one_kind(table[name]) for name in (*known, *results)}
        return Sweep(table, tuple(header for header, _ in axes), results, space, evaluation, tuple(bases), plan)

    def __len__(self) -> int:
        return len(self.columns["variant"])

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.columns)

    def __getitem__(self, name: str) -> Any:
        return np.array(self.columns[name])

    def missing(self) -> int:
        """Return how many variants were not computed, the base among them."""
        pairs = zip(self.columns["variant"], self.columns["status"], strict=True)
        return len({number for number, status in pairs if status == "missing"})

    def detector(self, variant: int) -> Detector:
        """Return a variant by its number in the table; 0 is the base. Raises ValueError if there is none."""
        if not is_whole(variant, 0, len(self.space)):
            raise ValueError(f"variant: got {variant!r:.60}, expected a whole number from 0 to {len(self.space)}")
        changes = _without_base(self.space.variants[variant - 1]) if variant else {}
        return self.bases[variant].with_overrides(dict(changes)) if changes else self.bases[variant]

    def to_xarray(self) -> Any:
        """Return the results of a grid as an `xarray.Dataset` with one dimension for each key, momentum and angle.

        Raises
        ------
        ValueError
            If the space is no grid, or xarray is not installed.
        """
        xarray = package("xarray")
        if self.space.kind != "grid":
            raise ValueError(f"to_xarray: got a space of kind {self.space.kind!r}, expected a grid")
        here = np.array(self.columns["variant"]) > 0
        dimensions = [*self.parameters, *self.evaluation.points()[0]]
        coordinates = {name: list(dict.fromkeys(self[name][here].tolist())) for name in dimensions}
        shape = tuple(len(values) for values in coordinates.values())
        data = {name: (dimensions, self[name][here].reshape(shape)) for name in (*self.results, "status", "name")}
        return xarray.Dataset(data, coords=coordinates, attrs={"base": self.bases[0].name})

    def _detectors(self) -> dict[str, Detector]:
        return {"detector.toml": self.bases[0]}

    def summary(self) -> dict[str, Any]:
        """Return what `summary.json` holds: what was varied and evaluated, and how the variants ended."""
        statuses = [status for status, point in zip(self.columns["status"], self._is_first(), strict=True) if point]
        return {
            "program": "cgemit", "versions": versions(), "physics": PHYSICS,
            "inputs": {
                "base": self.bases[0].name, "hash": self.bases[0].content_hash, "space": self.space.kind,
                "keys": list(self.space.keys), "evaluation": json.loads(json.dumps(self.evaluation.described())),
            },
            "variants": len(self.space), "status": {name: statuses.count(name) for name in sorted(set(statuses))},
            "parameters": list(self.parameters), "results": list(self.results),
        }  # fmt: skip

    def draw(self, quantity: str | None = None, **options: Any) -> Picture:
        """Draw one result against what is varied: a scan of one key, a map of two, parallel coordinates of more.

        Parameters
        ----------
        quantity : str, optional
            Column of `results`; default: the first resolution, or the first of all.
        **options
            Of `cgemit.draw.design.draw_sweep`; ``kind="budget"`` is `draw_budgets`.
        """
        from cgemit.draw.design import draw_sweep

        if quantity is not None and quantity not in self.results:
            raise ValueError(f"quantity: got {quantity!r}, expected one of {', '.join(self.results)}")
        first = next((name for name in self.results if name.startswith("sigma_dr")), self.results[0])
        if options.get("kind") == "budget":
            return self.draw_budgets((quantity or first).partition(" (")[0].removeprefix("sigma_"))
        return draw_sweep(self.columns, self.parameters, quantity or first, **options)

    def draw_budgets(self, quantity: str = "dr", by: By = "part", *, point: int = 0, most: int = 12) -> Picture:
        """Draw the error budgets of the base and the first variants at one point (`cgemit.draw.draw_budgets`).

        Parameters
        ----------
        quantity : str
            Resolution.
        by : str
            "part", "cause", "material" or "source".
        point : int
            Number of the momentum and angle among the points of a variant.
        most : int
            Detectors that are drawn, the base among them, in the order of the table; variants that cannot be built are
            left out.

        Raises
        ------
        ValueError
            If the evaluation was a function, or there is no such point or quantity.
        """
        from cgemit.draw.design import draw_budgets

        first = [i for i, here in enumerate(self._is_first()) if here and self.columns["status"][i] == "ok"][:most]
        names = {self.columns["variant"][i]: self.columns["name"][i] for i in first}
        short = {number: name.removeprefix(f"{self.bases[number].name}+") for number, name in names.items()}
        detectors = {short[number] if number else "base": self.detector(number) for number in names}
        return draw_budgets(budgets(self.evaluation, detectors, quantity, point), by)

    def _is_first(self) -> list[bool]:
        numbers = self.columns["variant"]
        return [i == 0 or numbers[i - 1] != number for i, number in enumerate(numbers)]

    def _table(self) -> tuple[str, list[str], list[list[str]]]:
        shown = [name for name in self.results if not name.startswith("delta_") and "_error" not in name][:6]
        head = ["variant", "status", *self.parameters, *self.evaluation.points()[0], *shown]
        count = min(len(self), _SHOWN_ROWS)
        head += ["problems"] if any(self.columns["problems"][:count]) else []
        rows = [[self._cell(name, i) for name in head] for i in range(count)]
        more = f"; {len(self) - count} more rows" if len(self) > count else ""
        return f"{self.bases[0].name}: {len(self.space)} variants, {len(self)} rows{more}", head, rows

    def _cell(self, name: str, row: int) -> str:
        """Return the value of a column, with its error if there is one."""
        value, (label, blank, unit) = self.columns[name][row], name.partition(" ")
        error = self.columns.get(f"{label}_error{blank}{unit}")
        return _cell(value) if error is None or name not in self.results else with_error(value, error[row])


def columns_before(space: Space, evaluation: Evaluation, base: Detector) -> tuple[str, ...]:
    """Return the columns of the table before the results."""
    headers = [axis_of(key, base, [one.get(key) for one in space.variants])[0] for key in space.keys]
    return (*LEADING, *headers, *evaluation.points()[0])


def _cell(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else " ".join(str(value).split())[:_LONGEST_CELL]


def _leading(space: Space, bases: Sequence[Detector], rows: Sequence[Mapping[str, Any]]) -> Iterator[list[Any]]:
    """Yield the columns `LEADING` of the base and its variants."""
    changes: list[Mapping[str, Any]] = [{}, *space.variants]
    yield list(range(len(rows)))
    yield [
        str(changed.get("name") or variant_name(base.name, _without_base(changed)))
        for changed, base in zip(changes, bases, strict=True)
    ]
    yield [row.get("hash", "") for row in rows]
    yield [row["status"] for row in rows]
    yield ["; ".join(row["problems"]) for row in rows]


def _of_one_kind(values: list[Any]) -> list[Any]:
    """Return a column with one kind of values.

    None becomes an empty text among texts, else NaN. Whole numbers and truth values become floats beside any float.
    """
    kinds = set(map(type, values))
    if type(None) in kinds:
        empty = "" if kinds == {str, type(None)} else math.nan
        values = [empty if value is None else value for value in values]
        kinds = set(map(type, values))
    return list(map(float, values)) if float in kinds and kinds <= {int, bool, float} else values


def _without_base(changes: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in changes.items() if key not in ("base", "field")}


def _differences(row: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the differences of simulated resolutions to the base's at all points, with their paired errors."""
    if "replicas" not in row or "replicas" not in base:
        return {}
    differences = {}
    pairs = list(zip(row["replicas"], base["replicas"], strict=True))
    for name in base["replicas"][0]:
        known = QUANTITIES[name]
        sigmas = zip(*(one["columns"][known.column()] for one in (row, base)), strict=True)
        differences[known.column("delta_sigma")] = [mine - other for mine, other in sigmas]
        errors = [jackknife(np.subtract(mine[name], other[name])) for mine, other in pairs]
        differences[known.column("delta_sigma", "_error")] = errors
    return differences
