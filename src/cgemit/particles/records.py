"""Event records of generators: the particles that the simulation takes of them, and records in ROOT files."""

from __future__ import annotations

import bz2
import gzip
import importlib.util
import lzma
import os
import re
import subprocess
import sys
import warnings
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from cgemit.base.errors import Problem, ProblemsError
from cgemit.base.files import check_regular, package
from cgemit.particles import hepmc_process
from cgemit.particles.species import KNOWN, charge_of, usual_mass
from cgemit.tables.schema import Array
from cgemit.units import LIGHT


class ParticleError(ProblemsError):
    """Bad input about particles; `problems` lists every problem."""


#: Endings of the names of HepMC files.
ENDINGS = tuple(f"{name}{packed}" for packed in ("", ".gz", ".bz2", ".xz") for name in (".hepmc", ".hepmc2", ".hepmc3"))
_PACKED: Mapping[str, Callable[..., Any]] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}

# Of momentum and length, as in a line "U GEV MM".
_UNITS = {(momentum, length) for momentum in (b"GEV", b"MEV") for length in (b"MM", b"CM")}

# pyhepmc reads lines as C does: of "0,5" and "x" it takes what can be read, 0; of large whole numbers the last bits; a
# second space is an empty value; positions without @ are none.
_NUMBER = rb"[-+]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|[nN][aA][nN]|[iI][nN][fF](?:inity)?)"
_POSITION = rb"(?: @(?: %b){4})?\s*" % _NUMBER
#: (HepMC3, HepMC2). Groups of particles: origin (HepMC3), PDG number; of vertices: number, particles (HepMC3).
_PARTICLES = (
    re.compile(rb"P \d+ (-?\d+) (-?\d+)(?: %b){5} -?\d+\s*" % _NUMBER),
    re.compile(rb"P -?\d+()( -?\d+)(?: %b){5} -?\d+(?: %b)*\s*" % (_NUMBER, _NUMBER)),
)
_VERTICES = (
    re.compile(rb"V (-?\d+) -?\d+ \[((?:\d+(?:,\d+)*)?)\]%b" % _POSITION),
    re.compile(rb"V (-?\d+)()(?: %b)*\s*" % _NUMBER),
)
_EVENTS = (re.compile(rb"E -?\d+ \d+ \d+%b" % _POSITION), re.compile(rb"E(?: %b)*\s*" % _NUMBER))
_LARGEST_PDG = 2**31 - 1

# A line of HepMC has some 200 bytes. A packed file may be much larger than it looks: only unpacked ones have any size.
_LONGEST_LINE, _MOST_UNPACKED = 1_000_000, 1_000_000_000

#: Particles that a generator lets decay are taken if they leave this radius (mm): no beam pipe is smaller.
INNERMOST = 5.0
_FINAL, _DECAYED = 1, 2  # status

_MOMENTA, _LENGTHS = {0: 1e-3, 1: 1.0}, {0: 1.0, 1: 10.0}  # GeV and mm, by the units of HepMC's ROOT files


@dataclass(frozen=True)
class Record:
    """Particles of all events of a file, as the generator wrote them.

    Attributes
    ----------
    columns : dict of str to ndarray
        Each (n,): `event`, counted from 0; `number` in the event; `pdg`; `status`; `mass` GeV/c2; `x`, `y`, `z` mm
        and `time` ns of the production; `px`, `py`, `pz` GeV/c; `end_x`, `end_y`, `end_z` mm and `end_time` ns of the
        decay, NaN without one (or without its time); `parent`, the number of the mother, -1 without one. Records that
        have charges have `charge`.
    events : dict of str to ndarray
        Each (n_events,): `number`, `weight` and `time` ns of the events.
    """

    columns: dict[str, Array]
    events: dict[str, Array]


# The table of particles refuses momenta that are not finite or too large.
@np.errstate(over="ignore", invalid="ignore")
def taken(record: Record, path: Path, charges: Mapping[int, int], name: str) -> dict[str, Array]:
    """Return the columns of the particles that are simulated: final ones, and charged ones that decay in the detector.

    A warning counts particles whose charge or mass is not known, which are taken as neutral, and the decays that are
    taken and left out. Neither counts particles that are no rows whatever their charge, such as strings and clusters.

    Parameters
    ----------
    record : Record
    path : Path
        For warnings.
    charges : mapping of int to int
        Charges in e of PDG numbers, before those that follow from the number.
    name : str
        Of the column with the numbers of the particles in their events.
    """
    columns = record.columns
    start, end = (np.stack([columns[prefix + axis] for axis in "xyz"]) for prefix in ("", "end_"))
    momentum = np.sqrt(sum(columns[f"p{axis}"] ** 2 for axis in "xyz"))
    final = columns["status"] == _FINAL
    flight = np.sqrt(((end - start) ** 2).sum(axis=0))
    far = np.maximum(np.hypot(*start[:2]), np.hypot(*end[:2])) > INNERMOST
    flies = (columns["status"] == _DECAYED) & (flight > 0)  # NaN: no decay
    charge, mass = _charge_and_mass(columns, path, charges, final | (flies & far))
    flies &= charge != 0
    decays = flies & far & (mass > 0) & (momentum > 0)
    _tell_decays(path, int(decays.sum()), int((flies & ~decays).sum()))
    # The chord and the speed give the time where the record has none, or one that the chord is too long for.
    duration = columns["end_time"] - columns["time"]
    speed = LIGHT * momentum / np.maximum(np.hypot(momentum, mass), 1e-300)
    least = flight / np.maximum(speed, 1e-300)
    duration = np.where(duration > 0.5 * least, duration, least)
    rows = np.flatnonzero(final | decays)
    if not len(rows) and len(final):
        counts = Counter(columns["status"].tolist()).most_common(5)
        given = ", ".join(f"{status} ({count})" for status, count in counts)
        _refuse(path, None, f"no particle of status {_FINAL} among {len(final)}, statuses {given}", "final particles")
    out = {key: columns[key][rows] for key in ("event", "pdg", "x", "y", "z", "px", "py", "pz", "time", "parent")}
    out |= {"charge": charge[rows], "mass": mass[rows], name: columns["number"][rows]}
    if decays.any():
        out["decay_time"] = np.where(decays, duration, np.inf)[rows]
    if not out["time"].any():
        del out["time"]
    return out


def _tell_decays(path: Path, taken: int, left: int) -> None:
    """Warn of the choice among charged particles that the generator let decay."""
    parts = [f"{taken} are followed to their decay"] if taken else []
    parts += [f"{left} that decay within {INNERMOST:g} mm of the beam line are left out"] if left else []
    if parts:
        warnings.warn(f"{path}: of the charged particles of status 2, {' and '.join(parts)}", stacklevel=5)


def _charge_and_mass(
    columns: Mapping[str, Array], path: Path, charges: Mapping[int, int], used: Array
) -> tuple[Array, Array]:
    """Return the charge (int64, e) and mass (GeV/c2) of each particle; warn of unknown ones among those `used`."""
    pdg, file_charge = columns["pdg"], columns.get("charge")
    numbers, row_of = np.unique(pdg, return_inverse=True)
    charge_of_number = [charges.get(int(one), charge_of(int(one))) for one in numbers]
    known = np.array([one is not None for one in charge_of_number], np.bool_)[row_of]
    charge = np.array([one or 0 for one in charge_of_number], np.int64)[row_of]
    usual = np.array([usual_mass(int(one)) for one in numbers], np.float64)[row_of]
    if file_charge is not None:  # of a record that has charges
        from_file = ~np.isin(pdg, [*KNOWN, *charges]) & np.isfinite(file_charge) & (file_charge == np.rint(file_charge))
        charge, known = np.where(from_file, np.rint(file_charge), charge).astype(np.int64), known | from_file
    mass = np.where(np.isnan(usual), columns["mass"], usual)
    unknown, massless = used & ~known, used & (charge != 0) & ~(mass > 0)
    for rows, what in ((unknown, "charge"), (massless, "mass")):
        if not rows.any():
            continue
        counts = Counter(pdg[rows].tolist()).most_common()
        some = ", ".join(f"{number} ({count})" for number, count in counts[:5]) + (", ..." if len(counts) > 5 else "")
        give = f"; give charges={{{counts[0][0]}: ...}} for a track" if what == "charge" else ""
        warnings.warn(
            f"{path}: {np.count_nonzero(rows)} particles whose {what} is not known are taken as neutral, by their "
            f"PDG number: {some}{give}",
            stacklevel=5,
        )
    charge[massless] = 0
    return charge, np.where(np.isfinite(mass) & (mass > 0), mass, 0.0)


def read_hepmc(path: Path) -> Record:
    """Return the final and the decayed particles (status 1 and 2) of a HepMC2 or HepMC3 file in text form.

    Particles of status 2 that end where they begin are left out.

    Parameters
    ----------
    path : Path
        With one of `ENDINGS`.

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
    width = 8 * hepmc_process.WIDTH
    values = np.frombuffer(data[: len(data) - len(data) % width], np.float64).reshape(-1, hepmc_process.WIDTH)
    is_end = values[:, 0] < 0
    n_read = int(np.count_nonzero(is_end))
    if process.returncode != 0:
        refused = process.returncode == hepmc_process.REFUSED
        reason = message.decode(errors="replace").strip() if refused else "pyhepmc ends the process that reads it"
        _refuse(path, begins[n_read] if n_read < len(begins) else None, f"an event that cannot be read ({reason})")
    if n_read != len(begins):
        read = f"{n_read} of its {len(begins)} events can be read"
        _refuse(path, begins[n_read] if n_read < len(begins) else None, f"an event that cannot be read: {read}")
    read = values[is_end, 1].astype(np.int64)
    none = np.flatnonzero((read == 0) & (np.asarray(counts) > 0))
    if len(none):
        _refuse(
            path, begins[none[0]], f"an event that cannot be read: 0 of its {counts[none[0]]} particles can be read"
        )
    lost = np.flatnonzero(read != counts)
    if len(lost):
        first = lost[0]
        warnings.warn(
            f"{path}: {read[first]} of the {counts[first]} particles of the event that begins in line {begins[first]} "
            f"are read, of all events {read.sum()} of {sum(counts)}; vertices that no particle enters are left out",
            stacklevel=5,
        )
    about = values[is_end]
    events = {"number": about[:, 2].astype(np.int64), "weight": about[:, 3], "time": about[:, 4] / LIGHT}
    return record_of(values[~is_end], events)


def _refuse(path: Path, line: int | str | None, got: str, expected: str = "a complete HepMC file") -> NoReturn:
    """Raise the error about a line or an entry of a file, or the file as a whole."""
    where = f"line {line}" if isinstance(line, int) else line or ""
    raise ParticleError(str(path), [Problem(where, got, expected)])


def _events_of(path: Path) -> tuple[array[int], array[int]]:
    """Return the lines that begin events, each with known units and all its lines, and their numbers of particles.

    pyhepmc ends in silence where it cannot go on, takes GeV and mm where a file says nothing, or something else, and
    takes particles for those of another vertex where lines are missing.
    """
    if path.suffix in _PACKED and _unpacks_to_too_much(path):
        most = f"{_MOST_UNPACKED / 1e6:.0f} MB"
        _refuse(path, None, f"more than {most} unpacked", f"at most {most}: split it, or unpack it before")
    begins, counts, event = array("q"), array("q"), _Event(path)
    marked, ended, line_number = False, False, 0
    try:
        with _PACKED[path.suffix](path, "rb") if path.suffix in _PACKED else path.open("rb") as stream:
            while line := stream.readline(_LONGEST_LINE):
                line_number += 1
                if len(line) == _LONGEST_LINE:
                    _refuse(path, line_number, f"a line of more than {_LONGEST_LINE} bytes")
                key = line[:2]
                if line[-1:] != b"\n" and not line.startswith(b"HepMC::"):  # the last one, cut
                    ended = ended and not line.strip()
                elif key == b"P ":
                    event.particle(line_number, line)
                elif key == b"V ":
                    event.vertex(line_number, line)
                elif key == b"E ":
                    if begins:
                        event.end(line_number)
                        counts.append(event.particles)
                    begins.append(line_number)
                    event.begin(line_number, line)
                elif key == b"U ":
                    event.units(line_number, line)
                elif line[:1] in (b"E", b"P", b"V", b"U") and key[1:].isspace() and line.strip():
                    _refuse(path, line_number, f"{line.decode('ascii', 'replace').strip()!r:.60}", "single spaces")
                elif line.startswith(b"HepMC::"):
                    marked = marked or b"START_EVENT_LISTING" in line
                    event.is_old = event.is_old or b"IO_GenEvent-START" in line
                    ended = b"END_EVENT_LISTING" in line
                    continue
                ended = ended and not line.strip()
    except (OSError, EOFError, lzma.LZMAError) as error:  # of an archive that is damaged
        _refuse(path, None, str(error))
    if not marked or not ended:
        what = "a last line that does not end the list of events" if marked else "no beginning of a list of events"
        _refuse(path, line_number if marked else None, what)
    if begins:
        event.end(line_number)
        counts.append(event.particles)
    return begins, counts


class _Event:
    """Counts of the lines of an event, against those that its first line and its vertices announce."""

    def __init__(self, path: Path) -> None:
        self.path, self.is_old = path, False  # HepMC2
        self.first = self.vertices = self.particles = 0
        self.expected: list[int] = []  # particles; in HepMC2 also vertices
        self.has_units = True
        self.vertex_numbers: set[bytes] = set()  # HepMC3: those that the event has
        self.origins: dict[bytes, int] = {}  # HepMC3: vertices and particles that lines name, and the first such line

    def begin(self, line_number: int, line: bytes) -> None:
        words = line.split()
        self.first, self.vertices, self.particles, self.has_units = line_number, 0, 0, False
        self.vertex_numbers, self.origins = set(), {}
        # E event vertices particles, or E event interactions scale alpha alpha process signal vertices ...
        counts = self._whole(line_number, words, (8,) if self.is_old else (3,))
        self._matched(_EVENTS, line_number, line)
        self.expected = [0, *counts] if self.is_old else counts

    def particle(self, line_number: int, line: bytes) -> None:
        self.particles += 1
        origin, pdg = self._matched(_PARTICLES, line_number, line).groups()
        if abs(int(pdg)) > _LARGEST_PDG:
            self._refuse(line_number, line, f"a PDG number up to {_LARGEST_PDG}")
        if not self.is_old and origin != b"0":
            self.origins.setdefault(origin, line_number)

    def vertex(self, line_number: int, line: bytes) -> None:
        self.vertices += 1
        number, entering = self._matched(_VERTICES, line_number, line).groups()
        self.vertex_numbers.add(number)
        for one in filter(None, entering.split(b",")):
            self.origins.setdefault(one, line_number)
        if self.is_old and self.first:
            # V number id x y z ct orphans outgoing weights: their particles follow before the next vertex.
            self._check(line_number, "particles", self.particles, self.expected[0])
            self.expected[0] += sum(self._whole(line_number, line.split(), (7, 8)))

    def units(self, line_number: int, line: bytes) -> None:
        words = line.split()[1:]
        if tuple(words) not in _UNITS:
            text = line.decode("ascii", "replace").strip()
            _refuse(self.path, line_number, f"the units {text!r:.50}", "GEV or MEV, then MM or CM")
        self.has_units = True

    def end(self, line_number: int) -> None:
        """Refuse an event that ends before a line, and is not complete."""
        if not self.has_units:
            _refuse(self.path, self.first, "an event that does not name its units", "a U line")
        self._check(line_number, "particles", self.particles, self.expected[0])
        if self.is_old:
            self._check(line_number, "vertices", self.vertices, self.expected[1])
        for origin in self.origins.keys() - self.vertex_numbers:
            if not 0 < int(origin) <= self.particles:
                got = f"a line that names {origin.decode()}"
                _refuse(self.path, self.origins[origin], got, "vertices (below 0) and particles of its event")

    def _check(self, line_number: int, what: str, count: int, expected: int) -> None:
        if count != expected:
            event = f"{count} {what} of the event that begins in line {self.first}"
            _refuse(self.path, line_number, f"{event}, before this line", f"{expected}, as announced")

    def _matched(self, forms: tuple[re.Pattern[bytes], re.Pattern[bytes]], line_number: int, line: bytes) -> Any:
        found = forms[self.is_old].fullmatch(line)
        if found is None:
            form = "V number status [particles] @ x y z ct, with " * (forms is _VERTICES and not self.is_old)
            self._refuse(line_number, line, f"{form}numbers such as -1.5e-3 between single spaces")
        return found

    def _refuse(self, line_number: int, line: bytes, expected: str) -> NoReturn:
        text = b" ".join(line.split()).decode("ascii", "replace")
        _refuse(self.path, line_number, f"{text!r:.90}", expected)

    def _whole(self, line_number: int, words: list[bytes], places: tuple[int, ...]) -> list[int]:
        """Return numbers of a line that count something."""
        numbers = [int(words[i]) for i in places if i < len(words) and words[i].isdigit()]
        if len(numbers) != len(places):
            names = " and ".join(str(i + 1) for i in places)
            self._refuse(line_number, b" ".join(words), f"a whole number in column {names}")
        return numbers


def _unpacks_to_too_much(path: Path) -> bool:
    try:
        with _PACKED[path.suffix](path, "rb") as stream:
            return stream.seek(_MOST_UNPACKED) == _MOST_UNPACKED and bool(stream.read(1))  # in small blocks
    except (OSError, EOFError, lzma.LZMAError) as error:
        _refuse(path, None, str(error))


def read_hepmc_root(path: Path) -> Record:
    """Return the events of HepMC3's tree in a ROOT file (``.hepmc3.tree.root``).

    Raises
    ------
    ParticleError
        If the file is damaged, or lacks a branch.
    """
    tree = _tree(path, "hepmc3_tree")
    names = ("pid", "status", "mass", *(f"momentum.m_v{k}" for k in (1, 2, 3)))
    pid, status, mass, *momenta = (_lists(path, tree, f"particles.{name}") for name in names)
    corners = [_lists(path, tree, f"vertices.position.m_v{k}") for k in (1, 2, 3, 4)]
    firsts, seconds = (_lists(path, tree, name) for name in ("links1", "links2"))
    weights = _lists(path, tree, "weights")
    event_number, momentum_unit, length_unit = (_values(path, tree, key) for key in _HEPMC_EVENT)
    positions = [_values(path, tree, f"event_pos.m_v{k}") for k in (1, 2, 3, 4)]
    blocks: list[Array] = []
    for i in range(tree.num_entries):
        n = len(pid[i])
        scale = _LENGTHS.get(int(length_unit[i]))
        gev = _MOMENTA.get(int(momentum_unit[i]))
        if scale is None or gev is None:
            _refuse(path, f"entry {i}", f"units {momentum_unit[i]} and {length_unit[i]}", "0 or 1 each")
        position = np.array([float(one[i]) for one in positions])
        vertices = np.stack([corner[i] for corner in corners], axis=1)
        born, ends, mother = _graph(path, i, n, len(vertices), firsts[i], seconds[i])
        at = _vertex_positions(vertices, position, born, mother, ends) * scale
        start = at[born]  # vertex 0: that of the event
        end = np.where((ends > 0)[:, None], at[ends], np.nan)
        rows = np.empty((n, len(_COLUMNS)))
        rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3] = i, np.arange(1, n + 1), pid[i], status[i]
        rows[:, 4] = mass[i] * gev
        rows[:, 5:9] = start
        for k in range(3):
            rows[:, 9 + k] = momenta[k][i] * gev
        rows[:, 12:16], rows[:, 16] = end, mother
        blocks.append(rows)
    table = np.concatenate(blocks) if blocks else np.empty((0, len(_COLUMNS)))
    times = positions[3] * np.array([_LENGTHS[int(unit)] for unit in length_unit]) / LIGHT
    first_weights = np.array([float(one[0]) if len(one) else 1.0 for one in weights])
    return record_of(table, {"number": event_number, "weight": first_weights, "time": times})


_HEPMC_EVENT = ("event_number", "momentum_unit", "length_unit")
_COLUMNS = ("event", *hepmc_process.COLUMNS)
_WHOLE = ("event", "number", "pdg", "status", "parent")


def record_of(rows: Array, events: Mapping[str, Array]) -> Record:
    """Return the record of rows (n, 17) of HepMC, whose times are lengths ct in mm."""
    columns: dict[str, Array] = {
        name: rows[:, k].astype(np.int64 if name in _WHOLE else np.float64) for k, name in enumerate(_COLUMNS)
    }
    for name in ("time", "end_time"):
        columns[name] = columns[name] / LIGHT
    return Record(columns, {name: np.asarray(one) for name, one in events.items()})


def _graph(path: Path, entry: int, n: int, n_vertices: int, first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Return for each particle the vertex where it is born (0: that of the event) and ends (0: none), and a mother."""
    born, ends, mother = np.zeros(n, np.int64), np.zeros(n, np.int64), np.full(n, -1)
    enters: dict[int, int] = {}
    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        particle, vertex = (a, -b) if a > 0 else (b, -a)
        if not (1 <= particle <= n and 0 <= vertex <= n_vertices):
            _refuse(path, f"entry {entry}", f"a link from {a} to {b}", f"{n} particles and {n_vertices} vertices")
        if a > 0:
            ends[particle - 1] = vertex
            enters.setdefault(vertex, particle)
        else:
            born[particle - 1] = vertex
    for k in range(n):
        mother[k] = enters.get(int(born[k]), -1) if born[k] else -1
    return born, ends, mother


def _vertex_positions(vertices: Array, event: Array, born: Array, mother: Array, ends: Array) -> Array:
    """Return the positions (n_vertices + 1, 4) of the vertices; those without one have that of their mother's birth."""
    at = np.concatenate([event[None], vertices])
    enters = {int(vertex): k for k, vertex in reversed(list(enumerate(ends.tolist()))) if vertex}
    for vertex in range(1, len(at)):
        seen, other = set(), vertex
        while other and not at[other].any() and other not in seen:
            seen.add(other)
            other = int(born[enters[other]]) if other in enters else 0
        at[vertex] = at[other]
    return at


def read_edm4hep(path: Path) -> Record:
    """Return the particles of an EDM4hep file, and its event headers.

    Particles are those of the collection ``MCParticles``, or of the only one that has statuses of a generator.

    Raises
    ------
    ParticleError
        If the file is damaged, or lacks a branch.
    """
    tree = _tree(path, "events")
    collections = _collections(tree)
    collection = "MCParticles" if "MCParticles" in collections else collections[0]
    if collection != "MCParticles" and len(collections) > 1:
        _refuse(path, None, f"collections of particles {', '.join(collections)}", "one, or one of the name MCParticles")

    def read(name: str) -> tuple[Array, Array]:
        lists = _lists(path, tree, f"{collection}.{name}")
        return np.concatenate(lists) if len(lists) else np.empty(0), np.array([len(one) for one in lists], np.int64)

    pdg, sizes = read("PDG")
    columns: dict[str, Array] = {"pdg": pdg.astype(np.int64), "status": read("generatorStatus")[0].astype(np.int64)}
    columns |= {name: read(name)[0].astype(np.float64) for name in ("charge", "mass", "time")}
    for axis in "xyz":
        columns[axis], columns[f"p{axis}"], columns[f"end_{axis}"] = (
            read(f"{name}.{axis}")[0].astype(np.float64) for name in ("vertex", "momentum", "endpoint")
        )
    first = np.cumsum(sizes) - sizes
    columns["event"] = np.repeat(np.arange(len(sizes)), sizes)
    columns["number"] = np.arange(len(pdg)) - np.repeat(first, sizes)
    columns["end_time"] = np.full(len(pdg), np.nan)
    columns["parent"] = np.full(len(pdg), -1)
    if (index := _relation(tree, collection)) is not None:
        begin, stop = (read(f"parents_{end}")[0].astype(np.int64) for end in ("begin", "end"))
        links = _lists(path, tree, index)
        offsets = np.repeat(np.cumsum([0, *(len(one) for one in links[:-1])]), sizes)
        flat = np.concatenate(links) if len(links) else np.empty(0, np.int64)
        has = stop > begin
        columns["parent"][has] = flat[offsets[has] + begin[has]]
    # A particle without an end has the origin or its production vertex there: neither is a decay.
    start, end = (np.stack([columns[prefix + axis] for axis in "xyz"]) for prefix in ("", "end_"))
    without = ~end.any(axis=0) | (end == start).all(axis=0)
    for axis in "xyz":
        columns[f"end_{axis}"][without] = np.nan
    n_events = len(sizes)
    events = {"number": np.arange(n_events), "weight": np.ones(n_events), "time": np.zeros(n_events)}
    for name, branch in (("number", "EventHeader.eventNumber"), ("weight", "EventHeader.weight")):
        if _has(tree, branch):
            lists = _lists(path, tree, branch)
            events[name] = np.array(
                [one[0] if len(one) else default for one, default in zip(lists, events[name], strict=True)]
            )
    return Record(columns, events)


def _collections(tree: Any) -> list[str]:
    """Return the names of the collections of generated particles in a tree of EDM4hep."""
    ending = ".generatorStatus"
    found = [name.removesuffix(ending) for name in _branches(tree) if name.endswith(ending)]
    return [name for name in found if not (name.startswith("n") and name[1:] in found)]  # n...: counters of uproot


def _relation(tree: Any, collection: str) -> str | None:
    """Return the branch of the indexes of mothers, under the name of any version of podio."""
    names = (f"_{collection}_parents.index", f"{collection}#0.index")
    return next((name for name in names if _has(tree, name)), None)


def kind_of_root(path: Path) -> str:
    """Return what a ROOT file holds: "hepmc", "edm4hep", "cgemit" or "other"."""
    with package("uproot").open(path) as file:
        names = {name.partition(";")[0] for name in file.keys(recursive=False)}
        if "cgemit" in names:
            return "cgemit"
        if "hepmc3_tree" in names:
            return "hepmc"
        return "edm4hep" if "events" in names and _collections(file["events"]) else "other"


@contextmanager
def whole_root(path: Path) -> Iterator[None]:
    """Refuse a ROOT file where anything of uproot fails: a damaged file is bad input, whatever notices it."""
    try:
        yield
    except (ParticleError, ImportError, FileNotFoundError):
        raise
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        _refuse(path, None, f"a file that uproot cannot read ({reason:.80})", "a whole ROOT file")


def _tree(path: Path, name: str) -> Any:
    return package("uproot").open(os.fspath(path))[name]


def _has(tree: Any, name: str) -> bool:
    return _branch(tree, name) is not None


def _branch(tree: Any, name: str) -> Any:
    return _branches(tree).get(name)


def _branches(tree: Any) -> dict[str, Any]:
    """Return the branches of a TTree, or the fields of an RNTuple, by name without the branches around them."""
    return {name.rpartition("/")[2]: branch for name, branch in tree.iteritems(recursive=True)}


def _values(path: Path, tree: Any, name: str) -> Array:
    """Return a branch with one number or list of numbers an entry."""
    branch = _branch(tree, name)
    if branch is None:
        _refuse(
            path,
            None,
            f"no branch {name!r}",
            f"a whole event record of {'HepMC3' if tree.name == 'hepmc3_tree' else 'EDM4hep'}",
        )
    try:
        return np.asarray(branch.array(library="np"))
    except Exception as error:  # of uproot: a damaged file is bad input, whatever notices it
        _refuse(
            path, None, f"a branch {name!r} that cannot be read ({str(error).splitlines()[0]:.80})", "a whole ROOT file"
        )


def _lists(path: Path, tree: Any, name: str) -> list[Array]:
    return [np.asarray(one) for one in _values(path, tree, name)]
