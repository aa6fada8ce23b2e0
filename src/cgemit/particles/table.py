"""Checked tables of particles from any source, HepMC files included."""

from __future__ import annotations

import gzip
import os
import re
from array import array
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import Problem, Problems, ProblemsError, did_you_mean
from cgemit.base.files import check_regular, package
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

_FINAL = 1  # status of a particle that the generator did not let decay
_COLUMNS = {"pdg": np.int64, "hepmc_id": np.int64} | dict.fromkeys(("x", "y", "z", "px", "py", "pz"), np.float64)


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
    ValueError
        If it is damaged or no HepMC file, does not name its units, or unpacks to more than 1 GB.
    """
    check_regular(path)
    pyhepmc = package("pyhepmc")
    expected = _events_of(path)
    rows, event, number = array("d"), array("q"), 0  # 72 bytes a particle, less than its line
    try:
        with pyhepmc.open(str(path)) as stream:
            for one in stream:
                one.set_units(pyhepmc.Units.GEV, pyhepmc.Units.MM)
                for particle in one.particles:
                    if particle.status == _FINAL:
                        rows.extend(_row(particle))
                        event.append(number)
                number += 1
    except Exception as error:  # of pyhepmc: a damaged file is bad input, whatever notices it
        raise ValueError(f"{path} is not a complete HepMC file ({error})") from error
    if number != expected:
        raise ValueError(f"{path} is not a complete HepMC file: {number} of its {expected} events can be read")
    values = np.array(rows, np.float64).reshape(-1, len(_COLUMNS)).T
    columns = {name: value.astype(dtype) for (name, dtype), value in zip(_COLUMNS.items(), values, strict=True)}
    return {"event": np.array(event, np.int64), **columns}, number


def _row(particle: Any) -> tuple[float, ...]:
    """Return the values of a particle in the order of the columns."""
    vertex, momentum = particle.production_vertex, particle.momentum
    point = (0.0, 0.0, 0.0) if vertex is None else (vertex.position.x, vertex.position.y, vertex.position.z)
    return (particle.pid, particle.id, *point, momentum.px, momentum.py, momentum.pz)


def _events_of(path: Path) -> int:
    """Return the number of events that a file begins, each with units that are known.

    pyhepmc ends in silence where it cannot go on, and takes GeV and mm where a file says nothing, or something else.
    """
    try:
        if path.suffix == ".gz" and _unpacks_to_too_much(path):
            most = f"{_MOST_UNPACKED / 1e6:.0f} MB"
            raise ParticleError(
                str(path), [Problem("", f"more than {most} unpacked", f"at most {most}: split it, or unpack it before")]
            )
        begun, named, ended, marked = 0, 0, False, False
        units: set[bytes] = set()
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as stream:
            while line := stream.readline(_LONGEST_LINE):
                if len(line) == _LONGEST_LINE:
                    raise ValueError(f"a line has more than {_LONGEST_LINE} bytes")
                begun += line.startswith(b"E ")
                if line.startswith(b"U "):
                    units.add(line)
                    named += 1
                marked = marked or (line.startswith(b"HepMC::") and b"START_EVENT_LISTING" in line)
                ended = (line.startswith(b"HepMC::") and b"END_EVENT_LISTING" in line) or (ended and not line.strip())
    except ParticleError:
        raise
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{path} is not a complete HepMC file ({error})") from error
    if not marked or not ended:
        what = "its last line does not end the list of events" if marked else "it does not begin a list of events"
        raise ValueError(f"{path} is not a complete HepMC file: {what}")
    wrong = sorted(line for line in units if tuple(line.split()[1:]) not in _UNITS)
    if wrong:
        text = wrong[0].decode("ascii", "replace").strip()
        raise ValueError(f"{path}: got the units {text!r:.50}; expected GEV or MEV, then MM or CM")
    if named < begun:
        raise ValueError(f"{path}: {begun - named} of its {begun} events do not name their units; expected U lines")
    return begun


def _unpacks_to_too_much(path: Path) -> bool:
    with gzip.open(path, "rb") as stream:
        return stream.seek(_MOST_UNPACKED) == _MOST_UNPACKED and bool(stream.read(1))  # in small blocks


class ParticleError(ProblemsError):
    """Bad input about particles; `problems` lists every problem."""


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
