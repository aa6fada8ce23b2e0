"""Geometry of Delphes' TrackCovariance, the block ``DetectorGeometry`` of a card: barrels from there, and to there."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from cgemit.base.errors import DetectorError, Problem, Problems
from cgemit.base.files import read_text
from cgemit.detector.build import library, read_contents
from cgemit.detector.check import geometry_problems
from cgemit.detector.files import ROWS
from cgemit.detector.material import x0_of_fractions
from cgemit.detector.matter import row_shells
from cgemit.detector.parts import Contents
from cgemit.detector.shells import Shell, share_z

_M = 1000.0  # mm
_COLUMNS = 13
_LONGEST = 10_000.0  # mm, of a layer or a cylinder
_THICKEST = 50.0  # mm, of a layer
_ROUNDING = 1e-5  # mm, of the numbers of a card
_DENSEST = 25.0  # g/cm3, of the materials of a detector file
_GAS = 10_000.0  # mm: matter with a longer radiation length is gas
#: The thinnest gas that a detector file may have, a thousandth of air.
_VACUUM = {"composition": "H2", "density": "1e-6 g/cm3", "gas": True}
#: Materials of the library that a radiation length stands for, if it is theirs to a part in thousand.
_KNOWN = ("Si", "Be", "Al", "Cu", "Au", "Kapton", "CarbonFiber")


@dataclass(frozen=True)
class Row:
    """A barrel layer of a card: mm, rad; resolutions are 0 for coordinates that are not measured."""

    label: str
    ends: tuple[float, float]
    radius: float
    thickness: float
    x0: float
    stereo: tuple[float, float]
    sigma: tuple[float, float]
    gas: bool = False  # of wires: as thin as need be
    efficiency: float = 1.0

    @property
    def views(self) -> list[tuple[float, float]]:
        """Stereo angle and resolution of what is measured."""
        return [(angle, sigma) for angle, sigma in zip(self.stereo, self.sigma, strict=True) if sigma > 0]


def read_card(path: str | Path, *, field: bool = True) -> dict[str, Any]:
    """Return the tables of the detector file that the geometry of a card stands for.

    Rows that measure become ``[layer.NAME]``, others walls and the beam pipe. The card states no materials: a radiation
    length that is that of silicon, beryllium or another known material stands for it, any other one is carbon at the
    density that has it; iron or tungsten below 17 mm, as in a calorimeter. Between the rows is no matter. Rows that
    overlap become thinner and denser: radius, X/X0 and mass stay. Disks are left out, and listed in the description.

    The card is read as data: variables, ``source`` of files beside the card, comments, braces and quotes as in Tcl;
    other commands are not run. The field is the Bz of the module TrackCovariance, or B outside of modules. A text that
    begins with a row is the geometry alone, without a field.

    Parameters
    ----------
    path : path
    field : bool
        Whether a card without a field is an error; otherwise the tables have none.

    Raises
    ------
    DetectorError
        If the card has no geometry, or rows that cannot be read.
    """
    path = Path(path)
    try:
        text = read_text(path)
    except UnicodeDecodeError as error:
        line = f"line {1 + error.object.count(10, 0, error.start)}"
        raise DetectorError(str(path), [Problem(line, "bytes that are no text", "a card in UTF-8")]) from None
    return _tables(text, str(path), path.stem, path.parent, field=field)


class _Value(NamedTuple):
    """Value of a variable, and the line of the file where it begins."""

    text: str
    line: int
    source: str = ""


_Scope = dict[str, _Value]
_MOST_SOURCES = 50
_VARIABLE = re.compile(r"\$(?:\{([^}]{1,200})\}|((?:::)?\w{1,200}))")
#: Commands that set no variable, whatever they hold.
_WITHOUT_EFFECT = ("add", "exec", "puts", "proc")


class _Card:
    """Variables and TrackCovariance modules of a card; no command but ``set``, ``module`` and ``source`` acts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder.resolve()
        self.variables: _Scope = {}
        self.modules: dict[str, _Scope] = {}
        self.unread: list[str] = []
        self.problems: list[Problem] = []
        self.sources = 0

    def value(self, text: str, scope: _Scope) -> str:
        """Return a text with its variables replaced; those without a value stay."""

        def one(match: re.Match[str]) -> str:
            name = (match[1] or match[2]).removeprefix("::")
            found = scope.get(name) or self.variables.get(name)
            return match[0] if found is None else found.text

        return _VARIABLE.sub(one, text)

    def run(self, text: str, scope: _Scope, line: int = 1, source: str = "") -> None:
        """Take the variables and modules of a script."""
        for at, words, is_open in _commands(text, line):
            if is_open and not self.problems:
                begins = f'"{words[-1][0].strip().partition(chr(10))[0][:40]}"'
                where = f"{source} line {at}".lstrip()
                self.problems.append(
                    Problem(where, f"a brace or quote before {begins} that does not end", "a whole card")
                )
            known = [word if braced else self.value(word, scope) for word, braced in words]
            if known[0] == "set" and len(known) == 3:
                scope[known[1].removeprefix("::")] = _Value(known[2], at, source)
            elif known[0] == "module" and len(known) == 4:
                inner: _Scope = {}
                self.run(known[3], inner, at, source)
                if known[1] == "TrackCovariance":
                    if known[2] in self.modules:
                        where = f"{source} line {at}".lstrip()
                        self.problems.append(Problem(where, f"the module {known[2]} twice", "modules of other names"))
                    self.modules[known[2]] = inner
            elif known[0] == "source":
                self._source(known[1:], scope)
            elif known[0] == "add" and len(known) > 2 and known[1] in ("DetectorGeometry", "Bz"):
                scope[known[1]] = _Value("[add]", at, source)
            elif known[0] not in _WITHOUT_EFFECT:
                # A variable that a loop or a condition may set has no value that is known.
                for name in re.findall(r"\b(?:set|incr|append|lappend|unset)[ \t]+(\w+)", " ".join(known)):
                    scope[name] = _Value(f"[{known[0]} ...]", at, source)

    def _source(self, words: list[str], scope: _Scope) -> None:
        """Read a file beside the card, or note that it was not read."""
        self.sources += 1
        name = " ".join(words)
        try:
            path = (self.folder / name).resolve()
            beside = path.is_relative_to(self.folder) and path.is_file()
            text = read_text(path) if beside and self.sources <= _MOST_SOURCES else None
        except (OSError, ValueError):
            text = None
        if text is None:
            self.unread.append(name)
        else:
            self.run(text, scope, source=name)


def _commands(text: str, line: int) -> Iterator[tuple[int, list[tuple[str, bool]], bool]]:
    """Yield the commands of a Tcl script: line, words, each with whether it is in braces, and whether the last is open.

    A brace or quote that does not end is that of a file that was cut.
    """
    at, end = 0, len(text)
    words: list[tuple[str, bool]] = []
    first, is_open = line, False
    while at <= end:
        character = text[at] if at < end else "\n"
        if character in "\n;":
            if words:
                yield first, words, is_open
            words, line, at, is_open = [], line + (character == "\n"), at + 1, False
        elif character.isspace() or text.startswith("\\\n", at):
            line, at = line + (character == "\\"), at + 1 + (character == "\\")
        elif character == "#" and not words:
            while at < end and text[at] != "\n":
                skipped = 2 if text[at] == "\\" else 1
                line, at = line + text.count("\n", at, min(at + skipped, end)), at + skipped
        else:
            first = first if words else line
            stop, is_open = _word_end(text, at)
            inner = character in '{"'
            words.append((text[at + 1 : stop - (not is_open)] if inner else text[at:stop], character == "{"))
            line, at = line + text.count("\n", at, stop), stop


def _word_end(text: str, at: int) -> tuple[int, bool]:
    """Return where the word that begins here ends: braces and brackets in pairs, quotes up to the next one.

    Also whether its brace or quote is open at the end of the text.
    """
    first, depth, end, begin = text[at], 0, len(text), at
    pairs = {"{": "{}", '"': "[]"}.get(first, "[]")
    while at < end:
        character = text[at]
        if character == "\\":
            at += 2
            continue
        if first == '"' and depth == 0 and character == '"' and at > begin:
            return at + 1, False
        if first not in '{"' and depth == 0 and (character.isspace() or character == ";"):
            return at, False
        depth += (character == pairs[0]) - (character == pairs[1])
        at += 1
        if first == "{" and depth == 0:
            return at, False
    return min(at, end), first in '{"'


def _tables(text: str, source: str, name: str, folder: Path, *, field: bool = True) -> dict[str, Any]:
    """Return the tables of the text of a card."""
    card = _Card(folder)
    card.run(text, card.variables)
    plain = ROWS.match(text)
    problems = [] if plain else card.problems
    scope = _tracker(card, problems)
    geometry = scope.get("DetectorGeometry") or (_Value(text, 1) if plain else None)
    unread = f"; not read: {', '.join(card.unread)}" if card.unread else ""
    if geometry is None:
        expected = f"a card with TrackCovariance{unread}"
        raise DetectorError(source, [*problems, Problem("", "no block DetectorGeometry", expected)])
    bz = scope.get("Bz") or (scope.get("B") if scope is card.variables else None)
    bz_text = card.value(bz.text, scope).strip() if bz else ""
    bz_number = _number(bz_text)
    if bz_number is None and field:
        got = f'"{bz_text}"' if bz else "no field"
        where = "in the module TrackCovariance" if card.modules else "beside the geometry"
        expected = f"a line such as: set B{'z' if card.modules else ''} 2.0, {where}, or " * (not plain)
        expected += f"a detector file with the {'file' if plain else 'card'} as base and a table [field]{unread}"
        problems.append(Problem("B", got, expected))
    rows, disks = _rows(card, geometry, scope, problems)
    rows, moved = _apart(rows, problems)
    if problems:
        raise DetectorError(source, problems)
    left = f"; left out: {len(disks)} disks ({', '.join(dict.fromkeys(disks))})" if disks else ""
    put = f"; put behind a layer at the same radius: {', '.join(moved)}" if moved else ""
    tables: dict[str, Any] = {
        "name": name, "description": f"barrel of a Delphes card{left}{put}{unread}",
        "field": {} if bz_number is None else {"kind": "uniform", "bz": f"{bz_number!r} T"},
        "beam_pipe": {}, "walls": {}, "layer": {}, "materials": {"Air": _VACUUM},
    }  # fmt: skip
    _add(rows, tables)
    return {name: value for name, value in tables.items() if value != {}}


def _tracker(card: _Card, problems: list[Problem]) -> _Scope:
    """Return the variables of the module TrackCovariance that is used; those of the card without one."""
    path = card.variables.get("ExecutionPath")
    used = path.text.split() if path else []
    scopes = {name: scope for name, scope in card.modules.items() if name in used} or card.modules
    if len(scopes) > 1:
        expected = "one of them, alone in ExecutionPath"
        problems.append(Problem("TrackCovariance", f"modules {', '.join(scopes)}", expected))
    return next(iter(scopes.values()), card.variables)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _rows(card: _Card, geometry: _Value, scope: _Scope, problems: list[Problem]) -> tuple[list[Row], list[str]]:
    """Return the barrel layers by radius, and the labels of the disks."""
    rows: list[Row] = []
    disks = []
    without_value: dict[tuple[str, ...], int] = {}  # variables -> the problem of the first row with them
    more: Counter[int] = Counter()
    for line_number, line in enumerate(geometry.text.splitlines(), start=geometry.line):
        words = card.value(line.split("#")[0].rstrip("; \t"), scope).split()
        if not words:
            continue
        where = f"{geometry.source} line {line_number}".lstrip()
        got = f'"{line.strip()[:60]}"'
        try:
            kind, label, numbers = words[0], words[1], [float(word) for word in words[2:]]
            if len(words) != _COLUMNS or kind not in ("1", "2") or not all(map(math.isfinite, numbers)):
                raise ValueError
        except (IndexError, ValueError):
            unknown = [word for word in words if word[0] in "$["]
            if unknown and (before := without_value.get(tuple(unknown))) is not None:
                more[before] += 1
                continue
            if unknown:
                without_value[tuple(unknown)] = len(problems)
            expected = f"{_COLUMNS} columns: 1 or 2, a label, and numbers"
            hint = f"; no value is set for {', '.join(unknown)}" if unknown else ""
            hint += f": add a line such as set {unknown[0][1:]} 1.0" if unknown and unknown[0][0] == "$" else ""
            problems.append(Problem(where, got, expected + hint))
            continue
        if kind == "2":
            disks.append(label)
            continue
        low, high, radius, thickness, x0, measured, up, down, sigma_up, sigma_down, efficiency = numbers
        ends = max(low * _M, -0.5 * _LONGEST), min(high * _M, 0.5 * _LONGEST)
        if measured not in (0, 1, 2) or sigma_up < 0 or sigma_down < 0:
            expected = "0, 1 or 2 coordinates, and resolutions of 0 (not measured) or more"
            problems.append(Problem(where, got, expected))
            continue
        if ends[0] >= ends[1] or radius <= 0 or thickness <= 0 or x0 <= 0 or not 0 <= efficiency <= 1:
            expected = "z from low to high, within 5 m of z = 0, a radius, thickness and radiation length above 0, an "
            problems.append(Problem(where, got, expected + "efficiency from 0 to 1"))
            continue
        on = [efficiency > 0 and measured >= count for count in (1, 2)]
        sigma = tuple(_M * value if use else 0.0 for value, use in zip((sigma_up, sigma_down), on, strict=True))
        rows.append(
            Row(
                label, ends, _M * radius, _M * thickness, _M * x0, (up, down), (sigma[0], sigma[1]),
                efficiency=efficiency if any(on) else 1.0,
            )
        )  # fmt: skip
    for k, count in more.items():
        problems[k] = problems[k]._replace(given=f"{problems[k].given} and {count} more rows")
    return sorted(rows, key=lambda row: row.radius), disks


def _apart(rows: Sequence[Row], problems: list[Problem]) -> tuple[list[Row], list[str]]:
    """Return rows of different radii at each z, and the labels of those of matter alone put behind a layer for it."""
    rows_apart: list[Row] = []
    moved = []
    for row in sorted(rows, key=lambda row: (row.radius, not row.views)):
        before = next((one for one in reversed(rows_apart) if share_z(one.ends, row.ends)), None)
        if before is None or row.radius - before.radius >= _ROUNDING:
            rows_apart.append(row)
        elif row.views:
            given = f"{before.label} and {row.label} at r = {row.radius:g} mm"
            problems.append(Problem("DetectorGeometry", given, "layers that measure at different radii"))
        else:
            behind = before.radius + 0.5 * (before.thickness + row.thickness)
            rows_apart.append(replace(row, radius=behind))
            moved.append(row.label)
    return sorted(rows_apart, key=lambda row: row.radius), moved


def _neighbours(rows: Sequence[Row]) -> list[tuple[int, int]]:
    """Return the numbers of rows, by radius, of which one is the next to the other at some z; the inner one first."""
    n = len(rows)
    above = [(i, next((k for k in range(i + 1, n) if share_z(rows[i].ends, rows[k].ends)), n)) for i in range(n)]
    below = [(next((k for k in range(i - 1, -1, -1) if share_z(rows[i].ends, rows[k].ends)), n), i) for i in range(n)]
    return sorted({pair for pair in (*above, *below) if n not in pair})


def _beside(rows: Sequence[Row]) -> list[float]:
    """Return the thickness of each row, mm, with which it is beside its neighbours about its own radius."""
    halves = [0.5 * row.thickness for row in rows]
    for i, k in _neighbours(rows):
        gap = rows[k].radius - rows[i].radius
        half, other = 0.5 * rows[i].thickness, 0.5 * rows[k].thickness
        if half + other <= gap:
            continue
        halves[i] = min(halves[i], max(gap - other, 0.5 * gap))
        halves[k] = min(halves[k], max(gap - half, 0.5 * gap))
    return [2 * half for half in halves]


def _add(rows: Sequence[Row], tables: dict[str, Any]) -> None:
    """Add the parts that rows stand for to the tables of a detector file."""
    many = {row.label: sum(other.label == row.label for other in rows) for row in rows}
    seen: dict[str, int] = {}
    measured = False
    for row, thickness in zip(rows, _beside(rows), strict=True):
        seen[row.label] = seen.get(row.label, 0) + 1
        label = row.label if many[row.label] == 1 else f"{row.label}{seen[row.label]}"
        r_in, r_out = row.radius - 0.5 * thickness, row.radius + 0.5 * thickness
        material = _material(row.x0, thickness / row.thickness, tables["materials"])
        measured = measured or bool(row.views)
        if not row.views:
            part = {"r_in": f"{r_in!r} mm", "r_out": f"{r_out!r} mm", **_ends(row, "half_length", 0.5)}
            tables["walls" if measured else "beam_pipe"][label] = part | {"material": material}
            continue
        shared: dict[str, Any] = {**_ends(row, "length", 1.0), "material": material}
        shared |= {"efficiency": row.efficiency} if row.efficiency < 1 else {}
        tables["layer"] |= {
            f"{label}{name}": shared | {"radius": f"{r!r} mm", "thickness": f"{width!r} mm"} | keys
            for name, r, width, keys in _layers(row, r_in, r_out)
        }


def _ends(row: Row, short_form: str, share: float) -> dict[str, str]:
    """Return the keys of the ends of a part: the short form of equal ones."""
    low, high = row.ends
    if low == -high:
        return {short_form: f"{share * (high - low)!r} mm"}
    return {"z_min": f"{low!r} mm", "z_max": f"{high!r} mm"}


def _layers(row: Row, r_in: float, r_out: float) -> Iterator[tuple[str, float, float, dict[str, str]]]:
    """Yield suffix, radius, thickness and errors of the layers that a row stands for: two if neither view is X."""
    x = [sigma for angle, sigma in row.views if abs(angle) < 1e-9]
    v = [(angle, sigma) for angle, sigma in row.views if abs(angle) >= 1e-9]
    keys = {"sigma_x": f"{x[0]!r} mm"} if x else {}
    parts = v[:1] if x or len(v) < 2 else v  # r phi and V are one layer, two V are two
    width = (r_out - r_in) / max(len(parts), 1)
    for i, view in enumerate(parts or [None]):
        of_v = {}
        if view is not None:
            angle = math.copysign(min(abs(view[0]), math.pi / 2), view[0])
            of_v = {"sigma_v": f"{view[1]!r} mm", "stereo": f"{angle!r} rad"}
        suffix = "ab"[i] if len(parts) > 1 else ""
        yield suffix, r_in + (i + 0.5) * width, width, keys | of_v


def _material(x0: float, share: float, materials: dict[str, Any]) -> str:
    """Return the name of a material of this radiation length, mm, and add it to `materials` if it is a new one.

    A row that has only a `share` of its thickness has the material at a density that is higher by as much.
    """
    denser = share < 1 - 1e-6
    for known in _KNOWN:
        if abs(library()[known].x0 / x0 - 1) < 1e-3:
            name = f"{known}-{1 / share:g}" if denser else known
            if denser:
                material = library()[known]
                materials[name] = {
                    "base": known, "density": f"{material.density / share!r} g/cm3",
                    "x0": f"{material.x0 * share!r} mm",
                }  # fmt: skip
            return name
    gas = x0 > _GAS
    x0 *= share if denser else 1.0
    name = f"X0-{x0:g}mm"
    for element in ("C", "Fe", "W"):  # the lightest that is not denser than a material may be
        density = x0_of_fractions({element: 1.0}, 1.0) / x0  # a radiation length is inverse to the density
        if density <= _DENSEST:
            break
    materials[name] = {"composition": element, "density": f"{density!r} g/cm3", "x0": f"{x0!r} mm", "gas": gas}
    return name


def card_of(detector: Contents) -> str:
    r"""Return the geometry of a detector as a block ``DetectorGeometry``, with the strength of the field before it.

    Clusters of CGEM layers have the errors of the readout ``gaussian``; a layer of wires is a cylinder at its radius
    at z = 0 that measures along its stereo angle, with the matter of its gas. The cylinder is so thin that it is
    beside all others. What other layers measure by a pitch has its error. Gaps between ladders lower the efficiency.

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
            shell = Shell(group, part.label, part.r_in, part.r_out, part.ends, part.material)
            yield _row((shell,), part.label)
    for layer in detector.barrels:
        x, v = layer.card_errors
        for shells in layer.stacks():
            measures = bool(layer.views) and shells[0].group == layer.sensitive
            views = [(0.0, x)] * (x > 0) + [(layer.stereo, v)] * (v > 0) if measures else []
            row = _row(shells, layer.card_label(shells[0].group), views)
            alive = 1 - layer.ladders * layer.ladder_gap / (2 * math.pi * layer.r_readout)
            yield replace(row, efficiency=layer.efficiency * alive) if measures else row
    chamber = detector.drift_chamber
    begin = chamber.layers[0].r_mid if chamber else 0.0
    edges = [part.r_out for part in (*detector.beam_pipe, *detector.walls)]
    edges += [layer.r_out for layer in detector.barrels]
    before = max((edge for edge in edges if edge < begin), default=0.0)
    for wires in chamber.layers if chamber else ():
        width = min(wires.r_mid - before, 4 * math.pi * wires.r_mid / wires.cells)
        before = wires.r_mid
        assert chamber is not None
        row = _row(row_shells(chamber, wires, width), f"wires{wires.number}", [(wires.tilt, wires.sigma)], gas=True)
        yield replace(row, efficiency=wires.efficiency)


def _parted(rows: Sequence[Row]) -> list[Row]:
    """Return rows by radius with cylinders of gas so thin that they are beside others, with the same matter each."""
    parted, pairs = [], _neighbours(rows)
    for i_row, row in enumerate(rows):
        width = row.thickness
        beside = [rows[i + k - i_row] for i, k in pairs if i_row in (i, k)]
        for other in beside if row.gas else ():
            apart = abs(row.radius - other.radius)
            width = min(width, apart if other.gas else 2 * apart - other.thickness)
        width = min(width, _THICKEST) if row.gas else width
        thin = 0 < width < row.thickness
        parted.append(replace(row, thickness=width, x0=row.x0 * width / row.thickness) if thin else row)
    return parted


def _check_readable(text: str, rows: Sequence[Row], source: str) -> None:
    """Raise an error if a card would not be read as the same layers."""
    problems = Problems()
    for i, k in _neighbours(rows):
        row, edge = rows[k], rows[i].radius + 0.5 * rows[i].thickness
        if row.radius - 0.5 * row.thickness < edge - _ROUNDING:
            between = f"{row.radius - 0.5 * row.thickness:g} to {row.radius + 0.5 * row.thickness:g} mm"
            problems.note(row.label, between, f"a cylinder beside {rows[i].label}, which ends at {edge:g} mm")
    problems.report(source, DetectorError)
    tables = _tables(text, source, "card", Path())
    read = problems.collect(read_contents, source, tables, problems)
    if read is not None:
        problems.extend(geometry_problems(read.beam_pipe, read.barrels, read.walls, read.drift_chamber))
    problems.report(source, DetectorError)


def _row(shells: Sequence[Shell], label: str, views: Sequence[tuple[float, float]] = (), *, gas: bool = False) -> Row:
    """Return the row of neighbouring shells, with their common thickness and radiation length."""
    thickness = shells[0].thickness if gas else sum(shell.thickness for shell in shells)  # wires fill the gas
    x0 = thickness / sum(shell.x0 for shell in shells)
    (angle, first), (other, second) = (*views, *[(0.0, 0.0)] * (2 - len(views)))
    radius, name = 0.5 * (shells[0].r_in + shells[-1].r_out), re.sub(r"\s+", "-", label)
    return Row(name, shells[0].ends, radius, thickness, x0, (angle, other), (first, second), gas)


def _line(row: Row) -> str:
    count = len(row.views)
    lengths = (value / _M for value in (*row.ends, row.radius, row.thickness, row.x0))
    numbers = [*(f"{value:.9g}" for value in lengths), str(count)]
    numbers += [f"{value:.9g}" for value in (*row.stereo, *(sigma / _M for sigma in row.sigma))]
    return "  " + " ".join(["1", row.label, *numbers, f"{row.efficiency:.9g}" if count else "0"])
