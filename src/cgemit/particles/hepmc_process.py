"""Read a HepMC file in a process of its own: pyhepmc ends the process that reads some damaged files.

`cgemit.particles.table` runs this file with the same interpreter, so it imports nothing of the package. The path comes
from the standard input. Rows of nine float64 go to the standard output: the number of the event, then `COLUMNS`. After
the rows of an event follows one of -1, the number of all its particles, and zeros. What pyhepmc cannot read goes to the
standard error, with `REFUSED` as the exit code; other codes are those of a process that was ended.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

#: Values of a particle after the number of its event: mm, GeV/c.
COLUMNS = ("pdg", "hepmc_id", "x", "y", "z", "px", "py", "pz")

REFUSED = 3
_FINAL = 1  # status of a particle that the generator did not let decay


def _row(particle: Any) -> tuple[float, ...]:
    """Return the values of a particle in the order of the columns."""
    vertex, momentum = particle.production_vertex, particle.momentum
    point = (0.0, 0.0, 0.0) if vertex is None else (vertex.position.x, vertex.position.y, vertex.position.z)
    return (particle.pid, particle.id, *point, momentum.px, momentum.py, momentum.pz)


def _write(path: str, out: int) -> None:
    """Write the rows of a file, event by event, so that the reader knows where a process ended."""
    from array import array

    pyhepmc: Any = importlib.import_module("pyhepmc")
    zeros = [0.0] * (len(COLUMNS) - 1)
    with pyhepmc.open(path) as stream:
        for number, event in enumerate(stream):
            event.set_units(pyhepmc.Units.GEV, pyhepmc.Units.MM)
            rows, particles = array("d"), event.particles
            for particle in particles:
                if particle.status == _FINAL:
                    rows.append(number)
                    rows.extend(_row(particle))
            rows.extend([-1.0, len(particles), *zeros])
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
