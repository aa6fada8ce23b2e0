"""Which tracks are fitted to a vertex, and where the beams meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from cgemit.kinds import Check
from cgemit.settings import SettingsData
from cgemit.species import HYPOTHESES
from cgemit.tables import Table

Rows = npt.NDArray[np.intp]

Length = Annotated[float, Check(lambda value: abs(value) <= 1e6, "a length in mm, within +-1e6")]
Spread = Annotated[float, Check(lambda value: 0 < value <= 1e9, "a length in mm above 0, up to 1e9")]


@dataclass(frozen=True, kw_only=True)
class BeamSpot(SettingsData):
    """Where the beams meet: a measurement of the vertex with uncorrelated Gaussian errors.

    Attributes
    ----------
    position : tuple of three float, mm
    sigma : tuple of three float, mm

    Raises
    ------
    ValueError
        Listing every invalid value.
    """

    position: tuple[Length, Length, Length] = (0.0, 0.0, 0.0)
    sigma: tuple[Spread, Spread, Spread]


def pair_tracks(tracks: Table, particles: tuple[str, str] | None = None) -> Rows:
    """Return all pairs of fitted tracks of opposite charge of each event.

    Parameters
    ----------
    tracks : Table of kind "tracks"
    particles : tuple of two str, or None
        Where tracks were fitted with several hypotheses: those of the positive and of the negative track.

    Returns
    -------
    ndarray, (n, 2) intp
        Rows of the positive and of the negative track.
    """
    good = (tracks["status"] == 0) & np.isfinite(tracks["kappa"])
    fitted = [good, good] if particles is None else [good & _of(tracks, name) for name in particles]
    plus, minus = (
        np.flatnonzero(one & (sign * tracks["kappa"] > 0)) for one, sign in zip(fitted, (1, -1), strict=True)
    )
    event = tracks["event"]
    first = np.searchsorted(event[minus], event[plus], side="left")
    count = np.searchsorted(event[minus], event[plus], side="right") - first
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.stack([np.repeat(plus, count), minus[np.repeat(first, count) + within]], axis=1)


def checked_pairs(tracks: Table, pairs: npt.ArrayLike | None, particles: tuple[str, str], beam_spot: object) -> Rows:
    """Return the rows of pairs, (n, 2) intp.

    Parameters
    ----------
    tracks, pairs, particles, beam_spot
        As of `fit_vertices`.

    Raises
    ------
    ValueError
        Listing every problem of the arguments.
    """
    if not isinstance(tracks, Table) or tracks.kind != "tracks":
        raise ValueError(f"fit_vertices: tracks: got {type(tracks).__name__}, expected a table of kind 'tracks'")
    problems = []
    known = isinstance(particles, tuple | list) and len(particles) == 2 and set(particles) <= set(HYPOTHESES)
    if pairs is None:
        several = known and len(np.unique(tracks["hypothesis"])) > 1 and _several(tracks)
        pairs = pair_tracks(tracks, particles if several else None)
    given = np.asarray(pairs)
    given = given.reshape(0, 2) if given.size == 0 else given
    if not known:
        problems.append(f"particles: got {particles!r}, expected two of {', '.join(map(repr, HYPOTHESES))}")
    if not isinstance(beam_spot, BeamSpot | None):
        problems.append(f"beam_spot: got {type(beam_spot).__name__}, expected BeamSpot or None")
    if given.ndim != 2 or given.shape[1] != 2 or (given.size and given.dtype.kind not in "iu"):
        problems.append(f"pairs: got shape {given.shape} of {given.dtype}, expected (n, 2) whole numbers")
    elif given.size and (given.min() < 0 or given.max() >= len(tracks)):
        problems.append(f"pairs: got rows {given.min()} to {given.max()}, expected 0 to {len(tracks)} (excluded)")
    elif given.size:
        event = tracks["event"][given]
        for text, wrong in (
            ("two events", event[:, 0] != event[:, 1]),
            ("one track twice", given[:, 0] == given[:, 1]),
        ):
            if wrong.any():
                problems.append(f"pairs: row {np.argmax(wrong)}: got {text}, expected two tracks of one event")
    if problems:
        raise ValueError("fit_vertices:\n  " + "\n  ".join(problems))
    return given.astype(np.intp)


def _several(tracks: Table) -> bool:
    """Tell whether some candidate was fitted with several hypotheses."""
    own = np.stack([tracks["event"], tracks["candidate"]])
    return bool(np.any(np.all(own[:, 1:] == own[:, :-1], axis=0)))


def _of(tracks: Table, name: str) -> npt.NDArray[np.bool_]:
    """Mark the tracks of a hypothesis."""
    return np.asarray(tracks["hypothesis"] == abs(HYPOTHESES[name].pdg))
