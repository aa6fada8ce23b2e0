"""Checked tables of particles from any source, files of other programs included."""

from __future__ import annotations

import csv
import os
import re
import warnings
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.errors import Problem, Problems, did_you_mean
from cgemit.base.files import check_regular, is_number, package, read_npz
from cgemit.particles.records import (
    ENDINGS,
    ParticleError,
    Record,
    kind_of_root,
    read_edm4hep,
    read_hepmc,
    read_hepmc_root,
    taken,
    whole_root,
)
from cgemit.particles.species import KNOWN, charge_of, usual_mass
from cgemit.tables import SCHEMAS, Table
from cgemit.tables.formats import BY_SUFFIX, is_own
from cgemit.tables.schema import Array
from cgemit.tables.show import columns_of
from cgemit.tables.table import kind_problems
from cgemit.units import QuantityError, parse_quantity

#: Largest coordinate (mm) and momentum (GeV/c) of a simulated particle: far beyond any use, far from losing digits.
FARTHEST, FASTEST = 1e6, 1e6


def particles_from(
    source: Any,
    *,
    n_events: int | None = None,
    first_event: int | None = None,
    charges: Mapping[int, int] | None = None,
    units: Mapping[str, str] | None = None,
) -> Table:
    """Make a table of particles from arrays, a data frame, a table, lists per event or a file.

    Warnings count what is not simulated: charged particles at rest or far outside, and what is left out of event
    records.

    Parameters
    ----------
    source : Table, mapping, pandas.DataFrame, structured ndarray, awkward.Array or path
        Columns, each (n,): `event` int, `pdg` int, `px`, `py`, `pz` GeV/c are needed. `x`, `y`, `z` mm are 0
        where not given, `particle` (number within the event) counts the rows of the event, `charge` e and `mass`
        GeV/c2 follow from `pdg`. `time` is that of the production, ns (0 where not given), `decay_time` the time from
        there to a decay whose products are other rows, ns (infinite: none), `backward` 1 for particles whose hits are
        earlier. Other units are given in the name, as in ``px [MeV]``. Rows may come in any order; those of an event
        keep theirs. Further columns of numbers are kept. An awkward array holds one list of records per event, or a
        record of lists; events are then
        counted from 0, unless there is a field `event`. A file is a table of particles as `Table.save` or
        `Result.save` wrote it, a table of another program with these columns (``.csv``, ``.parquet``, ``.root``,
        ``.npz``), or an event record: HepMC2 or HepMC3 as text (``.hepmc``, ``.hepmc3``, ``.hepmc.gz``; needs
        pyhepmc) or in ROOT (``.hepmc3.tree.root``), or EDM4hep (``.root``). Of a record the particles of status 1 are
        taken, with their production vertices, and the charged ones of status 2 that decay in the detector.
    n_events, first_event : int or None
        Events that the table covers. If not given, those that `source` covers if it is a table, else those from
        the smallest to the largest event number.
    charges : mapping of int to int, or None
        Charges in e of PDG numbers that tell none.
    units : mapping of str to str, or None
        Units of columns that do not name them, such as ``{"px": "MeV", "x": "cm"}``.

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
    return read_particles(source, n_events=n_events, first_event=first_event, charges=charges, units=units)[0]


class Given(NamedTuple):
    """Particles that no gun makes.

    Attributes
    ----------
    particles : Table of kind "particles"
    events : Table of kind "events", or None
        None if the particles are of no event record.
    """

    particles: Table
    events: Table | None


def read_particles(
    source: Any,
    *,
    n_events: int | None = None,
    first_event: int | None = None,
    charges: Mapping[int, int] | None = None,
    units: Mapping[str, str] | None = None,
) -> Given:
    """Return the particles of `particles_from`, and the table of events of a record.

    Parameters
    ----------
    source, n_events, first_event, charges, units
        As in `particles_from`.

    Returns
    -------
    Given
    """
    charges, asked_events, numbers = _checked_charges(charges), n_events, None
    if isinstance(source, str | os.PathLike):
        source, numbers = _from_file(Path(source), charges)
        n_events = len(numbers["number"]) if numbers is not None and n_events is None else n_events
    elif type(source).__module__.partition(".")[0] == "awkward":
        source, n_events = _from_lists(source, n_events)
    if type(source).__module__.partition(".")[0] == "awkward":  # of a file
        source, n_events = _from_lists(source, n_events)
    counted = n_events is not asked_events  # from 0, with events that have no particles
    columns = _in_native_units(_columns(source), units)
    problems = _missing(columns) or _problems(columns, charges)
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
    n = n_events if n_events is not None else int(event[-1]) + 1 - first if len(event) else 0
    try:
        table = Table("particles", _filled(columns, charges), n, first, events=gaps)
    except ValueError as error:
        raise ParticleError("table of particles", [Problem("", str(error), "")]) from error
    _tell_not_transported(table)
    if numbers is None:
        return Given(table, None)
    rows = np.arange(first, first + n)
    values = {name: column[rows] for name, column in numbers.items()}
    return Given(table, Table("events", {"event": rows, **values}, n, first))


def _checked_charges(charges: Mapping[int, int] | None) -> Mapping[int, int]:
    """Return given charges of PDG numbers; raise an error that lists every wrong one."""
    problems = Problems()
    for pdg, charge in (charges or {}).items():
        whole = all(isinstance(one, int | np.integer) and not isinstance(one, bool) for one in (pdg, charge))
        if not whole or abs(charge) > _MOST_CHARGE:
            problems.note(f"charges[{pdg!r:.30}]", f"{charge!r:.30}", "a whole PDG number and a whole charge in e")
        elif int(pdg) in KNOWN and charge != KNOWN[int(pdg)].charge:
            problems.note(f"charges[{pdg}]", str(charge), f"{KNOWN[int(pdg)].charge}, that of {KNOWN[int(pdg)].name}")
    problems.report("table of particles", ParticleError)
    return {int(pdg): int(charge) for pdg, charge in (charges or {}).items()}


def not_transported(columns: Any) -> npt.NDArray[np.int8]:
    """Return the `TransportStatus` (n,) of charged particles that the simulation does not transport; 0 for others."""
    p = [np.abs(columns[f"p{axis}"]) for axis in "xyz"]
    reach = np.max([np.abs(columns[axis]) for axis in "xyz"], axis=0)
    out = (reach > FARTHEST) | (np.max(p, axis=0) > FASTEST)
    status = np.where(out, _core.common.TransportStatus.out_of_range, 0)
    status = np.where(np.max(p, axis=0) == 0, _core.common.TransportStatus.at_rest, status)
    return np.where(columns["charge"] == 0, 0, status).astype(np.int8)


def _tell_not_transported(particles: Table) -> None:
    """Warn of charged particles that are not simulated."""
    if not len(particles):
        return
    status = not_transported(particles)
    reasons = {
        _core.common.TransportStatus.at_rest: "at rest",
        _core.common.TransportStatus.out_of_range: f"born beyond {FARTHEST:g} mm, or above {FASTEST:g} GeV/c",
    }
    parts = [f"{n} {text}" for one, text in reasons.items() if (n := int(np.count_nonzero(status == one)))]
    if parts:
        warnings.warn(
            f"table of particles: charged particles that are not simulated, as their status says: {', '.join(parts)}",
            stacklevel=4,
        )


_REFUSED_ENDINGS = {
    (".lhe", ".lhe.gz", ".lhef"): (
        "Les Houches events, which hold partons", "hadrons: shower the file with Pythia 8 or Herwig, and write HepMC"
    ),
    (".hepevt", ".hepevt.gz"): (
        "HEPEVT, which does not name its units",
        "HepMC: read it with pyhepmc.open(path, format='HEPEVT'), set the units, and write it",
    ),
    (".slcio", ".stdhep"): (
        "a file of LCIO or StdHep", "EDM4hep or HepMC: convert it with lcio2edm4hep, or stdhep2hepmc"
    ),
}  # fmt: skip


def _from_file(path: Path, charges: Mapping[int, int]) -> tuple[Any, dict[str, Array] | None]:
    """Return the columns or the table of a file, and the columns of its events if it is a record."""
    for endings, (got, expected) in _REFUSED_ENDINGS.items():
        if path.name.lower().endswith(endings):
            raise ParticleError(str(path), [Problem("", got, expected)])
    kind = "hepmc text" if path.name.endswith(ENDINGS) else path.suffix
    if kind == ".root":
        check_regular(path)
        with whole_root(path):
            kind = kind_of_root(path)
    if kind in _RECORDS:
        read, name = _RECORDS[kind]
        with nullcontext() if kind == "hepmc text" else whole_root(path):
            record: Record = read(path)
        return taken(record, path, charges, name), record.events
    if kind == ".csv":
        return _read_csv(path), None
    if kind == "other":
        with whole_root(path):
            return _read_tree(path), None
    if path.suffix not in BY_SUFFIX:
        known = ", ".join((*BY_SUFFIX, ".csv", *ENDINGS))
        raise ParticleError("table of particles", [Problem("", f"the file {str(path)[:80]!r}", f"one of {known}")])
    check_regular(path)
    if not is_own(path):
        return _read_plain(path), None
    table = Table.load(path)
    if table.kind != "particles":
        raise ParticleError(str(path), [Problem("", f"a table of kind {table.kind!r}", "'particles'")])
    return table, None


_RECORDS: Mapping[str, tuple[Any, str]] = {
    "hepmc text": (read_hepmc, "hepmc_id"), "hepmc": (read_hepmc_root, "hepmc_id"),
    "edm4hep": (read_edm4hep, "edm4hep_id"),
}  # fmt: skip


def _refuse_plain(path: Path, problems: list[Problem]) -> NoReturn:
    """Raise the error about a table of another program."""
    raise ParticleError(f"{path}, a table of another program", problems)


def _numbers_of(path: Path, columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return the columns of numbers of a table of another program, with the needed ones; count the others in a note."""
    numbers = {name: column for name, column in columns.items() if column.ndim == 1 and column.dtype.kind in "iufb"}
    names = {_name_and_unit(name)[0] for name in numbers}
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        columns_there = ", ".join(list(numbers)[:20]) or "none"
        expected = f"the columns {', '.join(_NEEDED)} of one number a row (x, y, z, charge, mass, time are optional)"
        _refuse_plain(
            path, [Problem("", f"no column {', '.join(missing)} among columns of numbers: {columns_there}", expected)]
        )
    if left := [name for name in columns if name not in numbers]:
        warnings.warn(f"{path}: columns without one number a row are left out: {', '.join(left)}", stacklevel=5)
    return numbers


def _read_plain(path: Path) -> dict[str, Array]:
    """Return the columns of an npz or Parquet file of another program."""
    try:
        if path.suffix == ".npz":
            columns = read_npz(path, None)
        else:
            with package("pyarrow.parquet").ParquetFile(path) as file:
                table = file.read(use_threads=False)
            columns = {name: table[name].to_numpy() for name in table.column_names}
    except ImportError:
        raise
    except Exception as error:  # of numpy, pyarrow: a damaged file is bad input, whatever notices it
        raise ParticleError(
            str(path), [Problem("", f"a file that cannot be read ({error})", "a whole file")]
        ) from error
    return _numbers_of(path, columns)


def _read_tree(path: Path) -> Any:
    """Return the columns of the tree of a ROOT file of another program; lists per event as an awkward array."""
    with package("uproot").open(path) as file:
        trees = {name: file[name] for name, kind in file.classnames().items() if kind in ("TTree", "ROOT::RNTuple")}
        for tree in trees.values():
            names = {_name_and_unit(str(name))[0]: str(name) for name in tree.keys()}  # noqa: SIM118
            lists = set(_NEEDED[1:]) <= names.keys()
            if not lists:
                continue
            wanted = [names[name] for name in (*_NEEDED, *_OPTIONAL) if name in names]
            # One by one: a name such as "px [MeV]" is no expression.
            arrays = {name: tree[name].array(library="ak") for name in wanted}
            depth = {name: array.ndim for name, array in arrays.items()}
            if set(depth.values()) == {2}:
                return package("awkward").zip(arrays, depth_limit=1)
            if left := [str(name) for name in tree.keys() if str(name) not in wanted]:  # noqa: SIM118
                warnings.warn(f"{path}: branches that mean nothing here are left out: {', '.join(left)}", stacklevel=5)
            flat = [name for name in wanted if depth[name] == 1]
            return _numbers_of(path, {name: arrays[name].to_numpy() for name in flat})
        trees_there = "; ".join(
            f"{name.partition(';')[0]} with {', '.join(tree.keys()[:20])}" for name, tree in trees.items()
        )
        expected = f"a tree with the branches {', '.join(_NEEDED)}, or an event record of HepMC3 or EDM4hep"
        _refuse_plain(path, [Problem("", f"trees: {trees_there or 'none'}", expected)])


def _read_csv(path: Path) -> dict[str, Array]:
    """Return the columns of a csv file: a first line of names; commas, semicolons or tabs; # begins a comment."""
    check_regular(path)
    try:
        lines = [
            (number, line)
            for number, line in enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
    except UnicodeDecodeError as error:
        raise ParticleError(str(path), [Problem("", f"bytes that are no text ({error})", "a csv file")]) from error
    if not lines:
        _refuse_plain(path, [Problem("", "no lines", "a line of names, and a line a particle")])
    separator = max(",;\t", key=lines[0][1].count)
    names, *rows = csv.reader((line for _, line in lines), delimiter=separator, skipinitialspace=True)
    names = [name.strip() for name in names]
    problems = [
        Problem(f"line {number}", f"{len(row)} values", f"{len(names)}, as the line of names has")
        for (number, _), row in zip(lines[1:], rows, strict=True)
        if len(row) != len(names)
    ]
    if len(set(names)) < len(names):
        problems.append(Problem(f"line {lines[0][0]}", "a name twice", "different names"))
    if problems:
        more = [] if len(problems) <= 10 else [Problem("", f"{len(problems) - 10} more such lines", "")]
        _refuse_plain(path, problems[:10] + more)
    columns: dict[str, Array] = {}
    for k, name in enumerate(names):
        texts = [row[k] for row in rows]
        try:
            columns[name] = np.array(texts, np.float64) if texts else np.empty(0)
        except ValueError:
            if _name_and_unit(name)[0] in (*_NEEDED, *_OPTIONAL):
                bad = next(i for i, text in enumerate(texts) if not is_number(text))
                problems.append(Problem(f"line {lines[1 + bad][0]}", f"{name} {texts[bad]!r:.40}", "a number"))
            columns[name] = np.array(texts)
    if problems:
        _refuse_plain(path, problems)
    return _numbers_of(path, columns)


_HEADER = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]")
_DIMENSIONS = (
    dict.fromkeys(("px", "py", "pz", "mass"), "energy") | dict.fromkeys("xyz", "length")
    | dict.fromkeys(("time", "decay_time"), "time")
)  # fmt: skip


def _name_and_unit(header: str) -> tuple[str, str]:
    """Return the name and unit of a column such as ``px [MeV]``; the whole text and no unit for columns without one."""
    match = _HEADER.fullmatch(header.strip())
    known = (*_NEEDED, *_OPTIONAL, "particle")
    return (match[1], match[2].strip()) if match and match[1] in known else (header, "")


def _in_native_units(columns: Mapping[str, Array], units: Mapping[str, str] | None) -> dict[str, Array]:
    """Return columns without units in their names, in GeV, mm and ns."""
    problems, out, units_of = Problems(), {}, dict(units or {})
    for header, column in columns.items():
        name, unit = _name_and_unit(header)
        if name in out:
            problems.note(header, "a second column of this name", "one")
        other = units_of.pop(name, "")
        if unit and other and unit != other:
            problems.note(f"units[{name!r}]", repr(other), f"{unit!r}, as the name of the column says")
        unit = unit or other
        out[name] = column
        if not unit:
            continue
        if name not in _DIMENSIONS:
            if unit not in ("", "-", "1", "e"):
                problems.note(header, f"the unit {unit!r:.40}", "none: it is a pure number")
            continue
        dimension = _DIMENSIONS[name]
        plain = re.sub(r"/c(\^?2|²)?$", "", unit) if dimension == "energy" else unit
        try:
            factor = parse_quantity(f"1 {plain}", dimension)
        except QuantityError as error:
            problems.note(header, f"the unit {unit!r:.40}", error.expected)
            continue
        if factor != 1:
            out[name] = column * factor if column.ndim == 1 and column.dtype.kind in "iufb" else column
    for name, unit in units_of.items():
        problems.note(f"units[{name!r}]", repr(unit), f"a unit of one of the columns {', '.join(out)}")
    problems.report("table of particles", ParticleError)
    return out


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

    Raises
    ------
    ParticleError
        Listing every problem of the columns.
    """
    wrong = [Problem("", one, "") for one in kind_problems(particles=particles)]
    problems = Problems(wrong) or _problems(particles.columns, {})
    problems.report("table of particles", ParticleError)


def _filled(columns: Mapping[str, Array], charges: Mapping[int, int]) -> dict[str, Array]:
    """Return the columns with those that may be left out, whole numbers as integers."""
    charge, mass, _ = _charge_and_mass(columns["pdg"], charges)
    zeros = {name: np.zeros(len(mass)) for name in ("x", "y", "z", "status")}
    filled: dict[str, Array] = {"charge": charge, "mass": mass, **zeros, **columns}
    for name in (*_FLOATS, *_WHOLE):
        filled[name] = filled[name].astype(np.float64 if name in _FLOATS else np.int64)
    return filled


_NEEDED = ("event", "pdg", "px", "py", "pz")
_OPTIONAL = ("x", "y", "z", "charge", "mass", "time", "decay_time", "backward", "particle")
_MOST_CHARGE = 127
_LARGEST = 1e12  # mm or GeV/c: no number of a particle
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


def _problems(columns: Mapping[str, Array], charges: Mapping[int, int]) -> Problems:
    """Return the problems of the values."""
    bad: dict[tuple[str, str], tuple[str, npt.NDArray[np.bool_]]] = {}
    for name, column in columns.items():
        if name in _FLOATS or name == "time":
            bad[name, "is not finite"] = name, ~np.isfinite(column)
        elif name in _WHOLE:
            bad[name, "is not a whole number"] = name, ~(np.isfinite(column) & (column == np.rint(column)))
    if "backward" in columns:
        bad["backward", "is not 0 or 1"] = "backward", ~np.isin(columns["backward"], (0, 1))
    if "decay_time" in columns:
        bad["decay_time", "is not above 0"] = "decay_time", ~(columns["decay_time"] > 0)
    for name in ("x", "y", "z", "px", "py", "pz"):
        if name in columns:
            column = columns[name]
            bad[name, f"is beyond +-{_LARGEST:g}"] = name, np.isfinite(column) & (np.abs(column) > _LARGEST)
    event, pdg = columns["event"], columns["pdg"]
    bad["event", "is negative"] = "event", event < 0
    bad["event", f"is above {_LAST_EVENT}"] = "event", event > _LAST_EVENT
    known = np.isin(pdg, list(KNOWN))
    usual, masses, told = _charge_and_mass(pdg, charges)
    charge = columns.get("charge", usual)
    if "charge" not in columns:
        way = "give charges={pdg: charge}, or a column charge"
        bad["pdg", f"is unknown and does not tell the charge: {way}"] = "pdg", ~told
    # Neutral particles leave no hits, so that the mass of unknown ones does not matter.
    if "mass" not in columns:
        bad["pdg", "is unknown, and there is no column mass"] = (
            "pdg",
            (told | ("charge" in columns)) & (charge != 0) & (masses == 0),
        )
    if "charge" in columns:
        bad["charge", "is not that of the pdg number"] = "charge", known & (charge != usual)
        bad["charge", f"is beyond +-{_MOST_CHARGE}"] = "charge", np.abs(charge) > _MOST_CHARGE
    if "mass" in columns:
        bad["mass", "is negative"] = "mass", columns["mass"] < 0
        bad["mass", "is 0 for a charged particle"] = "mass", (columns["mass"] == 0) & (charge != 0)
        # Resonances vary by less than that; a mass in MeV/c2 or of another particle does not.
        ratio = columns["mass"] / np.where(masses > 0, masses, 1.0)
        far = (masses > 0) & (usual != 0) & (columns["mass"] > 0) & ((ratio < 0.5) | (ratio > 2.0))
        bad["mass", "is not that of the pdg number"] = "mass", far
    if "particle" in columns:
        bad["particle", "is negative"] = "particle", columns["particle"] < 0
        bad["particle", "is there before in the same event"] = "particle", _repeated(event, columns["particle"])
    problems = Problems(_problem(what, columns[name], rows) for what, (name, rows) in bad.items() if rows.any())
    if len(event) and not problems and np.ptp(event) >= _MOST_EVENTS:
        problems.note("event", f"{event.min()} to {event.max()}", f"numbers within {_MOST_EVENTS} events")
    return problems


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


def _charge_and_mass(pdg: Array, charges: Mapping[int, int]) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Return charge (e) and mass (GeV/c2) of each PDG number, 0 where unknown, and whether it tells the charge."""
    numbers, row_of = np.unique(pdg, return_inverse=True)
    whole = [int(number) if np.isfinite(number) else 0 for number in numbers]
    charge_of_number = [charges.get(number, charge_of(number)) for number in whole]
    charge = np.array([one or 0 for one in charge_of_number], np.int16)
    masses = np.nan_to_num([usual_mass(number) for number in whole])
    return (
        charge[row_of],
        masses[row_of],
        np.array([one is not None for one in charge_of_number], np.bool_)[row_of],
    )
