"""Geometry of Delphes' TrackCovariance, the block ``DetectorGeometry`` of a card: barrels from there, and to there."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cgemit.base.errors import DetectorError, Problem, Problems
from cgemit.base.files import read_text
from cgemit.detector.build import library, read_contents
from cgemit.detector.check import geometry_problems
from cgemit.detector.material import x0_of_fractions
from cgemit.detector.parts import Contents, Shell
from cgemit.detector.readouts import GaussianReadout

#: Ending of the name of a card.
CARD = ".tcl"

_M = 1000.0  # mm
_COLUMNS = 13
_LONGEST = 10_000.0  # mm, of a layer or a cylinder
_THICKEST = 50.0  # mm, of a layer
_ROUNDING = 1e-5  # mm, of the numbers of a card
_GAS = 10_000.0  # mm: matter with a longer radiation length is gas
#: The thinnest gas that a detector file may have, a thousandth of air.
_VACUUM = {"composition": "H2", "density": "1e-6 g/cm3", "gas": True}
#: Materials of the library that a radiation length stands for, if it is theirs to a part in thousand.
_KNOWN = ("Si", "Be", "Al", "Cu", "Au", "Kapton", "CarbonFiber")


@dataclass(frozen=True)
class Row:
    """A barrel layer of a card: mm, rad; resolutions are 0 for coordinates that are not measured."""

    label: str
    half_length: float
    radius: float
    thickness: float
    x0: float
    stereo: tuple[float, float]
    sigma: tuple[float, float]
    gas: bool = False  # of wires: as thin as need be

    @property
    def views(self) -> list[tuple[float, float]]:
        """Stereo angle and resolution of what is measured."""
        return [(angle, sigma) for angle, sigma in zip(self.stereo, self.sigma, strict=True) if sigma > 0]


def read_card(path: str | Path) -> dict[str, Any]:
    """Return the tables of the detector file that the geometry of a card stands for.

    Rows that measure become ``[layer.NAME]``, others walls and the beam pipe. The card states no materials: a radiation
    length that is that of silicon, beryllium or another known material stands for it, any other one is carbon at the
    density that has it. Between the rows is no matter. A row that reaches into the one below begins where that ends.
    Disks are left out, and listed in the description.

    Parameters
    ----------
    path : path

    Raises
    ------
    DetectorError
        If the card has no geometry, or rows that cannot be read.
    """
    return _tables(read_text(Path(path)), str(path), Path(path).stem)


def _tables(text: str, source: str, name: str) -> dict[str, Any]:
    """Return the tables of the text of a card."""
    # The end of the block is looked for once: a pattern would look for it from each of many beginnings.
    begin = re.search(r"\bset[ \t]{1,80}DetectorGeometry\s{0,80}\{", text)
    end = text.find("}", begin.end()) if begin else -1
    if begin is None or end < 0:
        raise DetectorError(source, [Problem("", "no block DetectorGeometry", "a card with TrackCovariance")])
    fields = (re.fullmatch(r"set +Bz? +([-+.\deE]+)", " ".join(line.split())) for line in text.splitlines())
    field = next(filter(None, fields), None)
    problems: list[Problem] = []
    if not field:
        problems.append(Problem("B", "no field", "a line such as: set B 2.0"))
    rows, disks = _rows(text[begin.end() : end], text[: begin.end()].count("\n") + 1, problems)
    if problems:
        raise DetectorError(source, problems)
    left = f"; left out: {len(disks)} disks ({', '.join(dict.fromkeys(disks))})" if disks else ""
    tables: dict[str, Any] = {
        "name": name, "description": f"barrel of a Delphes card{left}",
        "field": {"kind": "uniform", "bz": f"{float(field[1]) if field else 0.0} T"},
        "beam_pipe": {}, "walls": {}, "layer": {}, "materials": {"Air": _VACUUM},
    }  # fmt: skip
    _add(rows, tables)
    return {name: value for name, value in tables.items() if value != {}}


def _rows(text: str, first_line: int, problems: list[Problem]) -> tuple[list[Row], list[str]]:
    """Return the barrel layers by radius, and the labels of the disks."""
    rows, disks = [], []
    for number, line in enumerate(text.splitlines(), start=first_line):
        words = line.split("#")[0].split()
        if not words:
            continue
        try:
            kind, label, numbers = words[0], words[1], [float(word) for word in words[2:]]
            if len(words) != _COLUMNS or kind not in ("1", "2") or not all(map(math.isfinite, numbers)):
                raise ValueError
        except (IndexError, ValueError):
            expected = f"{_COLUMNS} columns: 1 or 2, a label, and numbers"
            problems.append(Problem(f"line {number}", f'"{line.strip()[:60]}"', expected))
            continue
        if kind == "2":
            disks.append(label)
            continue
        low, high, radius, thickness, x0, measured, up, down, sigma_up, sigma_down, flag = numbers
        half = min(-low, high) * _M
        if half <= 0 or radius <= 0 or thickness <= 0 or x0 <= 0:
            expected = "z on both sides, and a radius, thickness and radiation length above 0"
            problems.append(Problem(f"line {number}", f'"{line.strip()[:60]}"', expected))
            continue
        on = [bool(flag) and measured >= count for count in (1, 2)]
        sigma = tuple(_M * value if use else 0.0 for value, use in zip((sigma_up, sigma_down), on, strict=True))
        rows.append(
            Row(
                label, min(half, 0.5 * _LONGEST), _M * radius, _M * thickness, _M * x0, (up, down), (sigma[0], sigma[1])
            )
        )
    return sorted(rows, key=lambda row: row.radius), disks


def _add(rows: Sequence[Row], tables: dict[str, Any]) -> None:
    """Add the parts that rows stand for to the tables of a detector file."""
    many = {row.label: sum(other.label == row.label for other in rows) for row in rows}
    seen: dict[str, int] = {}
    edge = 0.0
    measured = False
    for row in rows:
        seen[row.label] = seen.get(row.label, 0) + 1
        label = row.label if many[row.label] == 1 else f"{row.label}{seen[row.label]}"
        r_in, r_out = max(row.radius - 0.5 * row.thickness, edge), row.radius + 0.5 * row.thickness
        edge = r_out
        material = _material(row.x0, tables["materials"])
        measured = measured or bool(row.views)
        if not row.views:
            part = {"r_in": f"{r_in!r} mm", "r_out": f"{r_out!r} mm", "half_length": f"{row.half_length!r} mm"}
            tables["walls" if measured else "beam_pipe"][label] = part | {"material": material}
            continue
        shared = {"length": f"{2 * row.half_length!r} mm", "material": material}
        tables["layer"] |= {
            f"{label}{name}": shared | {"radius": f"{r!r} mm", "thickness": f"{width!r} mm"} | keys
            for name, r, width, keys in _layers(row, r_in, r_out)
        }


def _layers(row: Row, r_in: float, r_out: float) -> Iterator[tuple[str, float, float, dict[str, str]]]:
    """Yield suffix, radius, thickness and errors of the layers that a row stands for: two if neither view is X."""
    x = [sigma for angle, sigma in row.views if abs(angle) < 1e-9]
    v = [(angle, sigma) for angle, sigma in row.views if abs(angle) >= 1e-9]
    keys = {"sigma_x": f"{x[0]!r} mm"} if x else {}
    parts = v[:1] if x or len(v) < 2 else v  # r phi and V are one layer, two V are two
    width = (r_out - r_in) / max(len(parts), 1)
    for number, one in enumerate(parts or [None]):
        of_v = {}
        if one is not None:
            angle = math.copysign(min(abs(one[0]), math.pi / 2), one[0])
            of_v = {"sigma_v": f"{one[1]!r} mm", "stereo": f"{angle!r} rad"}
        suffix = "ab"[number] if len(parts) > 1 else ""
        yield suffix, r_in + (number + 0.5) * width, width, keys | of_v


def _material(x0: float, materials: dict[str, Any]) -> str:
    """Return the name of a material of this radiation length, mm, and add it to `materials` if it is a new one."""
    for name in _KNOWN:
        if abs(library()[name].x0 / x0 - 1) < 1e-3:
            return name
    name = f"X0-{x0:g}mm"
    density = x0_of_fractions({"C": 1.0}, 1.0) / x0  # a radiation length is inverse to the density
    materials[name] = {"composition": "C", "density": f"{density!r} g/cm3", "x0": f"{x0!r} mm", "gas": x0 > _GAS}
    return name


def card_of(detector: Contents) -> str:
    r"""Return the geometry of a detector as a block ``DetectorGeometry``, with the strength of the field before it.

    Clusters of CGEM layers have the errors of the readout ``gaussian``; a layer of wires is a cylinder at its radius
    at z = 0 that measures along its stereo angle, with the matter of its gas. The cylinder is so thin that it is
    beside all others. What other layers measure by a pitch has its error.

    Parameters
    ----------
    detector : Contents

    Raises
    ------
    DetectorError
        If `read_card` would not read it as the same barrel, such as one with a layer at the radius of wires.

    Examples
    --------
    >>> from cgemit.detector.delphes import card_of
    >>> print(*card_of(cg.load("besiii-cgem")).splitlines()[:3], sep="\n")
    set B -1
    set DetectorGeometry {
      # type label zmin zmax r w X0 n_meas th_up th_down reso_up reso_down flag; m, rad
    """
    rows = _parted(sorted(_written(detector), key=lambda row: row.radius))
    head = "  # type label zmin zmax r w X0 n_meas th_up th_down reso_up reso_down flag; m, rad"
    lines = map(_line, rows)
    text = "\n".join([f"set B {detector.field.bz:g}", "set DetectorGeometry {", head, *lines, "}", ""])
    _check_readable(text, rows, f"card of {detector.name}")
    return text


def _written(detector: Contents) -> Iterator[Row]:
    """Yield every barrel layer of a card."""
    for group, cylinders in (("pipe", detector.beam_pipe), ("wall", detector.walls)):
        for part in cylinders:
            shell = Shell(group, part.label, part.r_in, part.r_out, part.half_length, part.material)
            yield _row((shell,), part.label)
    gem = GaussianReadout()
    for layer in detector.cgem:
        for shells in layer.stacks():
            views = [(0.0, gem.sigma_x), (layer.stereo, gem.sigma_v)] if shells[0].group == "drift" else []
            yield _row(shells, f"{layer.label}-{shells[0].group}", views)
    for sensor in detector.layer:
        x, v = sensor.errors
        measured = [(0.0, x)] * (x > 0) + [(sensor.stereo, v)] * (v > 0)
        for number, shells in enumerate(sensor.stacks()):
            yield _row(shells, f"{sensor.label}{'-support' * number}", [] if number else measured)
    chamber = detector.drift_chamber
    begin = chamber.layers[0].r_mid if chamber else 0.0
    edges = [part.r_out for part in (*detector.beam_pipe, *detector.walls)]
    edges += [layer.r_out for layer in detector.cgem] + [layer.r_out for layer in detector.layer]
    before = max((edge for edge in edges if edge < begin), default=0.0)
    for wires in chamber.layers if chamber else ():
        width = min(wires.r_mid - before, 4 * math.pi * wires.r_mid / wires.cells)
        before = wires.r_mid
        tilt = math.atan(wires.r_end * math.sin(0.5 * wires.twist) / wires.half_length)
        gas = chamber.gas if chamber else None
        assert gas is not None
        shell = Shell("gas", "", wires.r_mid - 0.5 * width, wires.r_mid + 0.5 * width, wires.half_length, gas)
        yield _row((shell,), f"wires{wires.number}", [(tilt, wires.sigma)], gas=True)


def _parted(rows: Sequence[Row]) -> list[Row]:
    """Return rows by radius with cylinders of gas so thin that they are beside others, with the same matter each."""
    parted = []
    for place, row in enumerate(rows):
        width = row.thickness
        for other in (*rows[max(place - 1, 0) : place], *rows[place + 1 : place + 2]) if row.gas else ():
            apart = abs(row.radius - other.radius)
            width = min(width, apart if other.gas else 2 * apart - other.thickness)
        width = min(width, _THICKEST) if row.gas else width
        thin = 0 < width < row.thickness
        parted.append(replace(row, thickness=width, x0=row.x0 * width / row.thickness) if thin else row)
    return parted


def _check_readable(text: str, rows: Sequence[Row], source: str) -> None:
    """Raise an error if a card would not be read as the same layers."""
    problems, edge, below = Problems(), -math.inf, ""
    for row in rows:
        if row.radius - 0.5 * row.thickness < edge - _ROUNDING:
            between = f"{row.radius - 0.5 * row.thickness:g} to {row.radius + 0.5 * row.thickness:g} mm"
            problems.note(row.label, between, f"a cylinder beside {below}, which ends at {edge:g} mm")
        edge, below = row.radius + 0.5 * row.thickness, row.label
    problems.report(source, DetectorError)
    tables = _tables(text, source, "card")
    read = problems.collect(read_contents, source, tables, problems)
    if read is not None:
        problems.extend(geometry_problems(read.beam_pipe, read.cgem, read.layer, read.walls, read.drift_chamber))
    problems.report(source, DetectorError)


def _row(shells: Sequence[Shell], label: str, views: Sequence[tuple[float, float]] = (), *, gas: bool = False) -> Row:
    """Return the row of neighbouring shells, with their common thickness and radiation length."""
    thickness = sum(shell.thickness for shell in shells)
    x0 = thickness / sum(shell.x0 for shell in shells)
    (one, first), (other, second) = (*views, *[(0.0, 0.0)] * (2 - len(views)))
    radius, name = 0.5 * (shells[0].r_in + shells[-1].r_out), re.sub(r"\s+", "-", label)
    return Row(name, shells[0].half_length, radius, thickness, x0, (one, other), (first, second), gas)


def _line(row: Row) -> str:
    half, count = row.half_length, len(row.views)
    lengths = (value / _M for value in (-half, half, row.radius, row.thickness, row.x0))
    numbers = [*(f"{value:.9g}" for value in lengths), str(count)]
    numbers += [f"{value:.9g}" for value in (*row.stereo, *(sigma / _M for sigma in row.sigma))]
    return "  " + " ".join(["1", row.label, *numbers, "1" if count else "0"])
