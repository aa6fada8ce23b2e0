"""The particles that truths and hits come from."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cgemit import _core
from cgemit.base.arrays import Flags, Rows
from cgemit.tables import Table


def have_flown(particles: Table) -> Any:
    """Return which particles may have left hits, (n,) bool: charged ones that the simulation transports."""
    return (particles["charge"] != 0) & (particles["status"] < _core.common.TransportStatus.at_rest)


def particle_rows(particles: Table, truths: Table) -> npt.NDArray[np.int64]:
    """Return the particle behind each truth.

    Parameters
    ----------
    particles : Table
    truths : Table
        Of kind "truths" or "wire_truths".

    Returns
    -------
    ndarray, (truths,) int64
        Row of the particles table; -1 where it holds no such particle.
    """
    found: npt.NDArray[np.int64] = _core.common.particle_rows(dict(particles.columns), dict(truths.columns))
    return found


class Origins(NamedTuple):
    """Row of the particle of each truth (-1: none), and whether a daughter or another half turn left it."""

    owner: Rows
    late: Flags
    looped: Flags

    @property
    def first(self) -> Flags:
        """Whether a particle left it on its first half turn."""
        return (self.owner >= 0) & ~self.late & ~self.looped

    def linked(self, link: Rows) -> Origins:
        """Return the same for rows that link to truths."""
        position = np.where(link >= 0, link, -1)
        return Origins(
            *(
                np.append(values, values.dtype.type(none)).take(position)
                for values, none in zip(self, (-1, 0, 0), strict=True)
            )
        )


def origins_of(particles: Table, truths: Table) -> Origins:
    """Return the origins of truths.

    Parameters
    ----------
    particles : Table
    truths : Table
        Of kind "truths" or "wire_truths".
    """
    return Origins(particle_rows(particles, truths), truths["daughter"] > 0, truths["half_turn"] != 0)
