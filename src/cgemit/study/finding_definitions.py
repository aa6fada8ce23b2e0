"""Which particles are findable, and which candidate belongs to a particle, by definition (docs/methods/match.md)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from cgemit.study.found_hits import CandidateCounts, ParticleCounts

Flags = npt.NDArray[np.bool_]

#: Classes of candidates; "decay": of the daughter of a particle that has a track of its own; "loop": of another half
#: turn of a particle than the first one.
CLASSES = ("matched", "clone", "decay", "loop", "fake")
MATCHED, CLONE, DECAY, LOOP, FAKE = range(5)


def findable_of(of: ParticleCounts, charged: Flags) -> tuple[Flags, dict[str, int]]:
    """Return which particles are findable, (particles,) bool, and how many charged ones each condition removes.

    Parameters
    ----------
    of : ParticleCounts
    charged : ndarray, (particles,) bool
    """
    three, mixed = of.points >= 3, (of.points >= 2) & (of.wires >= 3)
    chamber = (of.wires >= 10) & (of.stereo >= 3)
    findable = charged & (three | mixed | chamber)
    rest = charged & ~findable
    reasons: dict[str, Flags] = {
        "no hit at all": of.hits == 0,
        "3 stereo wires among 10 or more": of.wires >= 10,
        "3 wires beside 2 layers with X and V": of.points >= 2,
        "10 wires, or 2 layers with X and V": np.ones(len(rest), np.bool_),
    }
    removed: dict[str, int] = {}
    for name, which in reasons.items():
        removed[name] = int(np.count_nonzero(rest & which))
        rest = rest & ~which
    return findable, removed


def belle2(of: CandidateCounts, particles: ParticleCounts) -> npt.NDArray[np.int8]:
    """Return the class of each candidate by the definition of Belle II, (candidates,) int8.

    A candidate is of a particle that left 2/3 of its hits, if it holds 1/20 of the particle's hits.

    Parameters
    ----------
    of : CandidateCounts
    particles : ParticleCounts
    """
    left = np.append(particles.hits, 0)[of.particle]
    enough = (20 * of.found >= left) | _loops(of)
    good = (of.particle >= 0) & (3 * of.of_particle >= 2 * of.hits) & enough & (of.hits > 0)
    return _classes(of, good)


def _loops(of: CandidateCounts) -> Flags:
    """Tell which candidates have more hits of other half turns of their particle than of the first one."""
    return 2 * of.of_loops > of.of_particle


def acts(of: CandidateCounts) -> npt.NDArray[np.int8]:
    """Return the class of each candidate by the definition of ACTS, (candidates,) int8.

    A candidate is of a particle that left half of its hits.

    Parameters
    ----------
    of : CandidateCounts
    """
    return _classes(of, (of.particle >= 0) & (2 * of.of_particle >= of.hits) & (of.hits > 0))


def _classes(of: CandidateCounts, good: Flags) -> npt.NDArray[np.int8]:
    """Return the class of each candidate; of several of a particle the one with most of its hits is matched."""
    classes = np.where(of.hits > 0, FAKE, -1).astype(np.int8)
    classes[good & _loops(of)] = LOOP
    rows = np.flatnonzero(good & ~_loops(of))
    order = rows[np.lexsort((rows, -of.found[rows], of.particle[rows]))]
    first = np.diff(of.particle[order], prepend=-1) != 0
    classes[order] = np.where(2 * of.of_daughters[order] > of.of_particle[order], DECAY, CLONE)
    classes[order[first]] = MATCHED
    return classes
