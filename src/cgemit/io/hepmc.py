"""Final-state particles of HepMC files (pyhepmc)."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.io.files import check_regular
from cgemit.io.packages import package

#: Endings of the names of HepMC files.
ENDINGS = (".hepmc", ".hepmc2", ".hepmc3", ".hepmc.gz", ".hepmc2.gz", ".hepmc3.gz")

# Of momentum and length, as in a line "U GEV MM".
_UNITS = {(momentum, length) for momentum in (b"GEV", b"MEV") for length in (b"MM", b"CM")}

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
        If it is damaged or no HepMC file, or does not name its units.
    """
    check_regular(path)
    pyhepmc = package("pyhepmc")
    expected = _events_of(path)
    rows: list[tuple[float, ...]] = []
    event: list[int] = []
    number = 0
    try:
        with pyhepmc.open(str(path)) as stream:
            for one in stream:
                one.set_units(pyhepmc.Units.GEV, pyhepmc.Units.MM)
                final = [_row(particle) for particle in one.particles if particle.status == _FINAL]
                rows += final
                event += [number] * len(final)
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
        begun, ended, marked = 0, False, False
        units: list[bytes] = []
        with gzip.open(path, "rb") if path.suffix == ".gz" else path.open("rb") as stream:
            for line in stream:
                begun += line.startswith(b"E ")
                if line.startswith(b"U "):
                    units.append(line)
                marked = marked or (line.startswith(b"HepMC::") and b"START_EVENT_LISTING" in line)
                ended = (line.startswith(b"HepMC::") and b"END_EVENT_LISTING" in line) or (ended and not line.strip())
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{path} is not a complete HepMC file ({error})") from error
    if not marked or not ended:
        what = "its last line does not end the list of events" if marked else "it does not begin a list of events"
        raise ValueError(f"{path} is not a complete HepMC file: {what}")
    wrong = sorted({line for line in units if tuple(line.split()[1:]) not in _UNITS})
    if wrong:
        text = wrong[0].decode("ascii", "replace").strip()
        raise ValueError(f"{path}: got the units {text!r:.50}; expected GEV or MEV, then MM or CM")
    if len(units) < begun:
        raise ValueError(
            f"{path}: {begun - len(units)} of its {begun} events do not name their units; expected U lines"
        )
    return begun
