"""Checked tables of particles from any source, HepMC files included."""

from __future__ import annotations

import gzip
import importlib.util
import os
import re
import subprocess
import sys
import warnings
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import Problem, Problems, ProblemsError, did_you_mean
from cgemit.base.files import check_regular, package
from cgemit.particles import hepmc_process
from cgemit.particles.species import KNOWN, UNKNOWN
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.formats import BY_SUFFIX
from cgemit.tables.schema import Array
from cgemit.tables.show import columns_of
from cgemit.tables.table import kind_problems

#: Endings of the names of HepMC files.
ENDINGS = (".hepmc", ".hepmc2", ".hepmc3", ".hepmc.gz", ".hepmc2.gz", ".hepmc3.gz")

# Of momentum and length, as in a line "U GEV MM".
_UNITS = {(momentum, length) for momentum in (b"GEV", b"MEV") for length in (b"MM", b"CM")}

# A line of HepMC has some 200 bytes. A packed file may be much larger than it looks: only unpacked ones have any size.
_LONGEST_LINE, _MOST_UNPACKED = 1_000_000, 1_000_000_000

_DTYPES = {name: np.int64 if name in ("pdg", "hepmc_id") else np.float64 for name in hepmc_process.COLUMNS}


class ParticleError(ProblemsError):
    """Bad input about particles; `problems` lists every problem."""


def read_hepmc(path: Path) -> tuple[dict[str, np.ndarray[Any, Any]], int]:
    """Return the particles of status 1 of a HepMC2 or HepMC3 file in text form, and the number of events.

    Parameters
    ----------
    path : Path
        With one of `ENDINGS`.

    Returns
    -------
    columns : dict of str to ndarray
        Each (n,): `event`, counted from 0 in the order of the file; `pdg`; `hepmc_id`, the number of the particle in
        its event of the file; `x`, `y`, `z` of the production vertex, mm; `px`, `py`, `pz`, GeV/c.
    n_events : int

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ParticleError
        If it is damaged or no HepMC file, does not name its units, or unpacks to more than 1 GB.
    """
    check_regular(path)
    if importlib.util.find_spec("pyhepmc") is None:
        package("pyhepmc")  # says what installs it
    # pyhepmc ends the process that reads some damaged files, so it reads in another one, which starts meanwhile.
    command = [sys.executable, "-P", hepmc_process.__file__]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, env=environment) as process:
        try:
            begins, counts = _events_of(path)
            data, message = process.communicate(os.fsencode(path.absolute()))
        except BaseException:
            process.kill()
            raise
    values = np.frombuffer(data[: len(data) - len(data) % _ROW], np.float64).reshape(-1, 1 + len(_DTYPES))
    is_end = values[:, 0] < 0
    number = int(np.count_nonzero(is_end))
    if process.returncode != 0:
        refused = process.returncode == hepmc_process.REFUSED
        reason = message.decode(errors="replace").strip() if refused else "pyhepmc ends the process that reads it"
        _refuse(path, begins[number] if number < len(begins) else None, f"an event that cannot be read ({reason})")
    if number != len(begins):
        read = f"{number} of its {len(begins)} events can be read"
        _refuse(path, begins[number] if number < len(begins) else None, f"an event that cannot be read: {read}")
    read = values[is_end, 1].astype(np.int64)
    lost = np.flatnonzero(read != counts)
    if len(lost):
        first = lost[0]
        warnings.warn(
            f"{path}: {read[first]} of the {counts[first]} particles of the event that begins in line {begins[first]} "
            f"are read, of all events {read.sum()} of {sum(counts)}; vertices that no particle enters are left out",
            stacklevel=3,
        )
    rows = values[~is_end].T
    columns = {name: value.astype(dtype) for (name, dtype), value in zip(_DTYPES.items(), rows[1:], strict=True)}
    return {"event": rows[0].astype(np.int64), **columns}, number


#: Bytes of a row of the other process.
_ROW = 8 * (1 + len(_DTYPES))


def _refuse(path: Path, line: int | None, given: str, expected: str = "a complete HepMC file") -> NoReturn:
    """Raise the error about a line of a file, or the file as a whole."""
    raise ParticleError(str(path), [Problem("" if line is None else f"line {line}", given, expected)])


def _events_of(path: Path) -> tuple[array[int], array[int]]:
    """Return the lines that begin events, each with known units and all its lines, and their numbers of particles.

    pyhepmc ends in silence where it cannot go on, takes GeV and mm where a file says nothing, or something else, and
    takes particles for those of another vertex where lines are missing.
    """
    if path.suffix == ".gz" and _unpacks_to_too_much(path):
        most = f"{_MOST_UNPACKED / 1e6:.0f} MB"
        _refuse(path, None, f"more than {most} unpacked", f"at most {most}: split it, or unpack it before")
    begins, counts, event = array("q"), array("q"), _Event(path)
    marked, ended, number = False, False, 0
    try:
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as stream:
            while line := stream.readline(_LONGEST_LINE):
                number += 1
                if len(line) == _LONGEST_LINE:
                    _refuse(path, number, f"a line of more than {_LONGEST_LINE} bytes")
                key = line[:2]
                if key == b"P ":
                    event.particles += 1
                elif key == b"V ":
                    event.vertex(number, line)
                elif key == b"E ":
                    if begins:
                        event.end(number)
                        counts.append(event.particles)
                    begins.append(number)
                    event.begin(number, line)
                elif key == b"U ":
                    event.units(number, line)
                elif line.startswith(b"HepMC::"):
                    marked = marked or b"START_EVENT_LISTING" in line
                    event.is_old = event.is_old or b"IO_GenEvent-START" in line
                    ended = b"END_EVENT_LISTING" in line
                    continue
                ended = ended and not line.strip()
    except (OSError, EOFError) as error:  # of an archive that is damaged
        _refuse(path, None, str(error))
    if not marked or not ended:
        what = "a last line that does not end the list of events" if marked else "no beginning of a list of events"
        _refuse(path, number if marked else None, what)
    if begins:
        event.end(number)
        counts.append(event.particles)
    return begins, counts


class _Event:
    """Counts of the lines of an event, against those that its first line and its vertices announce."""

    def __init__(self, path: Path) -> None:
        self.path, self.is_old = path, False  # HepMC2
        self.first = self.vertices = self.particles = 0
        self.expected: list[int] = []  # particles; in HepMC2 also vertices
        self.has_units = True

    def begin(self, number: int, line: bytes) -> None:
        words = line.split()
        self.first, self.vertices, self.particles, self.has_units = number, 0, 0, False
        # E event vertices particles, or E event interactions scale alpha alpha process signal vertices ...
        found = self._whole(number, words, (8,) if self.is_old else (3,))
        self.expected = [0, *found] if self.is_old else found

    def vertex(self, number: int, line: bytes) -> None:
        self.vertices += 1
        if self.is_old and self.first:
            # V number id x y z ct orphans outgoing weights: their particles follow before the next vertex.
            self._check(number, "particles", self.particles, self.expected[0])
            self.expected[0] += sum(self._whole(number, line.split(), (7, 8)))

    def units(self, number: int, line: bytes) -> None:
        words = line.split()[1:]
        if tuple(words) not in _UNITS:
            text = line.decode("ascii", "replace").strip()
            _refuse(self.path, number, f"the units {text!r:.50}", "GEV or MEV, then MM or CM")
        self.has_units = True

    def end(self, number: int) -> None:
        """Refuse an event that ends before a line, and is not complete."""
        if not self.has_units:
            _refuse(self.path, self.first, "an event that does not name its units", "a U line")
        self._check(number, "particles", self.particles, self.expected[0])
        if self.is_old:
            self._check(number, "vertices", self.vertices, self.expected[1])

    def _check(self, number: int, what: str, found: int, expected: int) -> None:
        if found != expected:
            event = f"{found} {what} of the event that begins in line {self.first}"
            _refuse(self.path, number, f"{event}, before this line", f"{expected}, as announced")

    def _whole(self, number: int, words: list[bytes], places: tuple[int, ...]) -> list[int]:
        """Return numbers of a line that count something."""
        found = [int(words[i]) for i in places if i < len(words) and words[i].isdigit()]
        if len(found) != len(places):
            text = b" ".join(words).decode("ascii", "replace")
            names = " and ".join(str(i + 1) for i in places)
            _refuse(self.path, number, f"{text!r:.60}", f"a whole number in column {names}")
        return found


def _unpacks_to_too_much(path: Path) -> bool:
    try:
        with gzip.open(path, "rb") as stream:
            return stream.seek(_MOST_UNPACKED) == _MOST_UNPACKED and bool(stream.read(1))  # in small blocks
    except (OSError, EOFError) as error:
        _refuse(path, None, str(error))


#: Largest coordinate (mm) and momentum (GeV/c) of a particle: far beyond any use, far from losing digits.
FARTHEST, FASTEST = 1e6, 1e6


def particles_from(source: Any, *, n_events: int | None = None, first_event: int | None = None) -> Table:
    """Make a table of particles from arrays, a data frame, a table, lists per event or a file.

    Parameters
    ----------
    source : Table, mapping, pandas.DataFrame, structured ndarray, awkward.Array or path
        Columns, each (n,): `event` int, `pdg` int, `px`, `py`, `pz` GeV/c are needed. `x`, `y`, `z` mm are 0
        where not given, `particle` (number within the event) counts the rows of the event, `charge` e and `mass`
        GeV/c2 follow from `pdg`. Rows may come in any order; those of an event keep theirs. Further columns of
        numbers are kept. An awkward array holds one list of records per event, or a record of lists; events are then
        counted from 0, unless there is a field `event`. A file is a table of particles as `Table.save` or
        `Result.save` wrote it, or the text form of HepMC2 or HepMC3 (``.hepmc``, ``.hepmc3``, ``.hepmc.gz``; needs
        pyhepmc), of which the particles of status 1 are taken, with their production vertices.
    n_events, first_event : int or None
        Events that the table covers. If not given, those that `source` covers if it is a table, else those from
        the smallest to the largest event number.

    Returns
    -------
    Table
        Of kind "particles".

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ParticleError
        Listing every problem of the columns.
    ValueError
        If a file is damaged, or needs a package that is not installed.
    """
    given = n_events
    if isinstance(source, str | os.PathLike):
        source, n_events = _from_file(Path(source), n_events)
    elif type(source).__module__.partition(".")[0] == "awkward":
        source, n_events = _from_lists(source, n_events)
    counted = n_events is not given  # from 0, with events that have no particles
    columns = _columns(source)
    problems = _missing(columns) or _problems(columns)
    problems.report("table of particles", ParticleError)
    gaps = None
    if isinstance(source, Table):
        gaps = source.cover["events"] if n_events is first_event is None else None
        n_events = source.n_events if n_events is None else n_events
        first_event = source.first_event if first_event is None else first_event
    elif first_event is None and counted:
        first_event = 0
    order = np.argsort(columns["event"], kind="stable")
    columns = {name: column[order] for name, column in columns.items()}
    event = columns["event"] = columns["event"].astype(np.int64)
    if "particle" not in columns:
        columns["particle"] = np.arange(len(event)) - np.searchsorted(event, event)
    first = first_event if first_event is not None else int(event[0]) if len(event) else 0
    number = n_events if n_events is not None else int(event[-1]) + 1 - first if len(event) else 0
    try:
        return Table("particles", _filled(columns), number, first, events=gaps)
    except ValueError as error:
        raise ParticleError("table of particles", [Problem("", str(error), "")]) from error


def _from_file(path: Path, n_events: int | None) -> tuple[Any, int | None]:
    """Return the columns or the table of a file, and the number of events if the file tells more than its rows."""
    if path.name.endswith(ENDINGS):
        columns, found = read_hepmc(path)
        return columns, found if n_events is None else n_events
    if path.suffix not in BY_SUFFIX:
        known = ", ".join((*BY_SUFFIX, *ENDINGS))
        raise ParticleError("table of particles", [Problem("", f"the file {str(path)[:80]!r}", f"one of {known}")])
    table = Table.load(path)
    if table.kind != "particles":
        raise ParticleError(str(path), [Problem("", f"a table of kind {table.kind!r}", "'particles'")])
    return table, n_events


def _from_lists(source: Any, n_events: int | None) -> tuple[dict[str, Array], int | None]:
    """Return the columns of an awkward array with one list per event, and the number of events."""
    awkward = package("awkward")
    fields = awkward.fields(source)
    try:
        lists = {name: source[name] for name in fields}
        depth = {name: one.ndim for name, one in lists.items()}
        if not fields or set(depth.values()) != {2}:
            given = ", ".join(f"{name} {ndim}" for name, ndim in depth.items()) or "no fields"
            raise ValueError(f"got {given} dimensions")
        sizes = np.asarray(awkward.num(lists[fields[0]]))
        wrong = [name for name, one in lists.items() if not np.array_equal(np.asarray(awkward.num(one)), sizes)]
        if wrong:
            raise ValueError(f"{', '.join(wrong)}: got lists of other lengths than {fields[0]}")
        columns = {name: awkward.to_numpy(awkward.flatten(one), allow_missing=False) for name, one in lists.items()}
    except (ValueError, TypeError) as error:
        problem = Problem("", "an awkward array", f"a list of records per event ({error})")
        raise ParticleError("table of particles", [problem]) from error
    if "event" in columns:
        return columns, n_events
    columns["event"] = np.repeat(np.arange(len(sizes)), sizes)
    return columns, len(sizes) if n_events is None else n_events


def check_particles(particles: Table) -> None:
    """Raise an error for a table of particles with invalid values.

    Parameters
    ----------
    particles : Table of kind "particles"

    Raises
    ------
    ParticleError
        Listing every problem of the columns.
    """
    wrong = [Problem("", one, "") for one in kind_problems(particles=particles)]
    problems = Problems(wrong) or _problems(particles.columns)
    problems.report("table of particles", ParticleError)


def _filled(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return the columns with those that may be left out, whole numbers as integers."""
    charge, mass = _charge_and_mass(columns["pdg"])
    zeros = {name: np.zeros(len(mass)) for name in ("x", "y", "z", "status")}
    filled: dict[str, Array] = {"charge": charge, "mass": mass, **zeros, **columns}
    for name in (*_FLOATS, *_WHOLE):
        filled[name] = filled[name].astype(np.float64 if name in _FLOATS else np.int64)
    return filled


_NEEDED = ("event", "pdg", "px", "py", "pz")
_FLOATS = tuple(column.name for column in SCHEMAS["particles"] if column.dtype.kind == "f")
_WHOLE = tuple(column.name for column in SCHEMAS["particles"] if column.dtype.kind == "i")
_VERTEX = re.compile(r"(?:v|vtx_?|vertex_?|prod(?:uction)?_?)?([xyz])(?:_?[cm]?m)?", re.IGNORECASE)
_LAST_EVENT = 2**62
_MOST_EVENTS = 100_000_000  # a larger span of event numbers is a mistake, such as a run number in front


def _columns(source: Any) -> dict[str, Array]:
    """Return the columns of any accepted source."""
    columns = columns_of(source)
    if columns is not None:
        return columns
    expected = "a table, a mapping of arrays, a data frame or a structured array"
    raise ParticleError("table of particles", [Problem("", type(source).__name__, expected)])


def _missing(columns: Mapping[str, Array]) -> Problems:
    """Return which columns are missing or cannot be columns of one table of numbers."""
    rows = len(columns["event"]) if "event" in columns and columns["event"].ndim else None
    problems = Problems()
    for name in _NEEDED:
        if name not in columns:
            hint = did_you_mean(name, columns)
            problems.note(name, "nothing", f"a column for each of {', '.join(_NEEDED)}", hint)
    for name, column in columns.items():
        if (vertex := _VERTEX.fullmatch(name)) and (axis := vertex[1].lower()) not in columns:
            problems.note(name, "an unknown column", "the vertex in columns x, y and z, mm", f'did you mean "{axis}"?')
        if column.ndim != 1 or (rows is not None and len(column) != rows):
            problems.note(name, f"shape {column.shape}", f"({'n' if rows is None else rows},)")
        elif column.dtype.kind not in "iufb":
            problems.note(name, f"dtype {column.dtype}", "numbers")
    return problems


def _problems(columns: Mapping[str, Array]) -> Problems:
    """Return the problems of the values."""
    bad: dict[tuple[str, str], tuple[str, npt.NDArray[np.bool_]]] = {}
    for name, column in columns.items():
        if name in _FLOATS:
            bad[name, "is not finite"] = name, ~np.isfinite(column)
        elif name in _WHOLE:
            bad[name, "is not a whole number"] = name, ~(np.isfinite(column) & (column == np.rint(column)))
    event, pdg = columns["event"], columns["pdg"]
    bad["event", "is negative"] = "event", event < 0
    bad["event", f"is above {_LAST_EVENT}"] = "event", event > _LAST_EVENT
    bad |= _too_large(columns)
    bad["px, py, pz", "are all zero"] = "px", (columns["px"] == 0) & (columns["py"] == 0) & (columns["pz"] == 0)
    known = np.isin(pdg, list(KNOWN))
    # Neutral particles leave no hits, so that the mass of unknown ones does not matter.
    unknown = ~known & (columns.get("charge", np.ones(len(pdg))) != 0)
    if not {"charge", "mass"} <= set(columns):
        bad["pdg", "is unknown and the columns charge and mass are not both there"] = "pdg", unknown
    usual, masses = _charge_and_mass(pdg)
    charge = columns.get("charge", usual)
    if "charge" in columns:
        bad["charge", "is not that of the pdg number"] = "charge", known & (charge != usual)
        # Scattering, energy loss and the momentum of a helix are those of unit charge.
        bad["charge", "is none of -1, 0 and 1"] = "charge", np.abs(charge) > 1
    if "mass" in columns:
        bad["mass", "is negative"] = "mass", columns["mass"] < 0
        bad["mass", "is 0 for a charged particle"] = "mass", (columns["mass"] == 0) & (charge != 0)
        # Resonances vary by less than that; a mass in MeV/c2 or of another particle does not.
        ratio = columns["mass"] / np.where(masses > 0, masses, 1.0)
        far = known & (usual != 0) & (columns["mass"] > 0) & ((ratio < 0.5) | (ratio > 2.0))
        bad["mass", "is not that of the pdg number"] = "mass", far
    if "particle" in columns:
        bad["particle", "is negative"] = "particle", columns["particle"] < 0
        bad["particle", "is there before in the same event"] = "particle", _repeated(event, columns["particle"])
    problems = Problems(_problem(what, columns[name], rows) for what, (name, rows) in bad.items() if rows.any())
    if len(event) and not problems and np.ptp(event) >= _MOST_EVENTS:
        problems.note("event", f"{event.min()} to {event.max()}", f"numbers within {_MOST_EVENTS} events")
    return problems


def _too_large(columns: Mapping[str, Array]) -> dict[tuple[str, str], tuple[str, npt.NDArray[np.bool_]]]:
    """Mark finite coordinates and momenta beyond their limits."""
    limits = dict.fromkeys("xyz", (FARTHEST, "mm")) | dict.fromkeys(("px", "py", "pz"), (FASTEST, "GeV/c"))
    return {
        (name, f"is beyond +-{most:g} {unit}"): (name, np.isfinite(columns[name]) & (np.abs(columns[name]) > most))
        for name, (most, unit) in limits.items()
        if name in columns
    }


def _problem(what: tuple[str, str], column: Array, rows: npt.NDArray[np.bool_]) -> Problem:
    first, number = int(np.argmax(rows)), int(np.count_nonzero(rows))
    more = f" and {number - 1} more row" + ("s" if number > 2 else "") if number > 1 else ""
    return Problem(what[0], f"{what[1]} ({column[first]}) in row {first}{more}", "")


def _repeated(event: Array, particle: Array) -> npt.NDArray[np.bool_]:
    """Mark rows whose event and particle number an earlier row has."""
    order = np.lexsort((particle, event))
    repeated = np.zeros(len(event), np.bool_)
    repeated[order[1:]] = (np.diff(event[order]) == 0) & (np.diff(particle[order]) == 0)
    return repeated


def _charge_and_mass(pdg: Array) -> tuple[Array, Array]:
    """Return charge (int8, e) and mass (float64, GeV/c2) of each PDG number; 0 where it is unknown."""
    numbers, place = np.unique(pdg, return_inverse=True)
    known = [KNOWN.get(int(number), UNKNOWN) if np.isfinite(number) else UNKNOWN for number in numbers]
    charge = np.array([one.charge for one in known], np.int8)
    mass = np.array([one.mass for one in known], np.float64)
    return charge[place], mass[place]
