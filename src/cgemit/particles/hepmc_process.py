"""Read a HepMC file in a process of its own: pyhepmc ends the process that reads some damaged files.

`cgemit.particles.records` runs this file with the same interpreter, so it imports nothing of the package. The path
comes from the standard input. Rows of `WIDTH` float64 go to the standard output: the number of the event in the file,
from 0, then `COLUMNS`. After the rows of an event follows one of -1, the number of all its particles, the number that
the file gives the event, its weight, its time (ct, mm), and zeros. What pyhepmc cannot read goes to the standard error,
with `REFUSED` as the exit code; other codes are those of a process that was ended.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

#: Values of a particle after the number of its event: mm, GeV/c. Times are lengths ct.
COLUMNS = (
    *("number", "pdg", "status", "mass", "x", "y", "z", "time", "px", "py", "pz"),
    *("end_x", "end_y", "end_z", "end_time", "parent"),
)
WIDTH = 1 + len(COLUMNS)

REFUSED = 3
_FINAL, _DECAYED = 1, 2  # status of particles that the generator did not let decay, and of those that it did


def _rows(event: Any, event_number: int, mev: bool, cm: bool) -> list[float]:
    """Return the values of the final and the decayed particles of an event.

    The numbers of the event are converted here: `GenEvent.set_units` leaves the position of the event as it is.
    """
    momentum_unit, length_unit = 1e-3 if mev else 1.0, 10.0 if cm else 1.0
    points: dict[int, tuple[float, float, float, float]] = {}

    def point(vertex: Any) -> tuple[float, float, float, float]:
        if vertex.id not in points:
            at = vertex.position
            points[vertex.id] = tuple(length_unit * one for one in (at.x, at.y, at.z, at.t))
        return points[vertex.id]

    nowhere = (float("nan"),) * 4
    rows: list[float] = []
    for particle in event.particles:
        status = particle.status
        if status not in (_FINAL, _DECAYED):
            continue
        born, ends = particle.production_vertex, particle.end_vertex
        start = (0.0,) * 4 if born is None else point(born)
        end = nowhere if status == _FINAL or ends is None else point(ends)
        if status == _DECAYED and (end is nowhere or end[:3] == start[:3]):
            continue
        mothers = [] if born is None else born.particles_in
        p = particle.momentum
        rows += (event_number, particle.id, particle.pid, status, momentum_unit * particle.generated_mass, *start)
        rows += (momentum_unit * p.px, momentum_unit * p.py, momentum_unit * p.pz, *end)
        rows.append(mothers[0].id if mothers and mothers[0].id > 0 else -1)
    return rows


def _write(path: str, out: int) -> None:
    """Write the rows of a file, event by event, so that the reader knows where a process ended."""
    from array import array

    pyhepmc: Any = importlib.import_module("pyhepmc")
    with pyhepmc.open(path) as stream:
        reader, event_number = stream._reader, 0
        # Iterating over the stream would end at the first event without particles.
        while not reader.failed() and reader.read_event(event := pyhepmc.GenEvent()):
            if reader.failed() and not event.particles:
                break  # nothing but the end of the file
            mev = event.momentum_unit == pyhepmc.Units.MEV
            cm = event.length_unit == pyhepmc.Units.CM
            rows = array("d", _rows(event, event_number, mev, cm))
            weights = event.weights
            time = event.event_pos().t * (10.0 if cm else 1.0)
            about = [-1.0, len(event.particles), event.event_number, weights[0] if weights else 1.0, time]
            rows.extend(about + [0.0] * (WIDTH - len(about)))
            event_number += 1
            data = memoryview(rows.tobytes())
            while data:
                data = data[os.write(out, data) :]


def main() -> int:
    """Read the file whose path is the standard input; nothing if that is empty."""
    out, errors = os.dup(1), os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)  # messages of the compiled library
    os.dup2(nowhere, 2)
    importlib.import_module("pyhepmc")  # while the path is on its way
    path = os.fsdecode(sys.stdin.buffer.read())
    try:
        if path:
            _write(path, out)
    except Exception as error:  # of pyhepmc: a damaged file is bad input, whatever notices it
        os.write(errors, str(error).encode())
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())
