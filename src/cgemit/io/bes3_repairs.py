"""What pybes3 0.5 unpacks in a wrong way, put right; what it unpacks rightly stays as it is."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

_FLAGS, _STRIPS = 2, 4  # numbers in m_clusterflag and m_stripid


def clusters(of: dict[str, npt.NDArray[np.generic]]) -> dict[str, npt.NDArray[np.generic]]:
    """Return the fields of cluster records at their places.

    A record of 96 bytes has two words more than pybes3's fields of the shorter record. They are the lengths in front of
    `m_clusterflag` (2) and `m_stripid` (4), but pybes3 takes them for a field `m_recpositiony`: V is read as
    `m_recpositiony`, z as `m_recv`, and `m_recZ` holds a length and a flag. These lengths at their places tell such
    records apart from others, which stay as they are.

    Parameters
    ----------
    of : dict of str to ndarray
        Fields of pybes3's TRecCgemCluster, each (n, ...).
    """
    if "m_recpositiony" not in of or not len(of["m_recZ"]):
        return of
    words = np.ascontiguousarray(of["m_recZ"], ">f8").view(">i4").reshape(-1, 2)
    flags = np.asarray(of["m_clusterflag"])
    if not (np.all(words[:, 0] == _FLAGS) and np.all(flags[:, 1] == _STRIPS)):
        return of
    right = {"m_recv": of["m_recpositiony"], "m_recZ": of["m_recv"]}
    flag = np.stack([words[:, 1].astype(flags.dtype), flags[:, 0]], axis=1)
    return {name: one for name, one in of.items() if name != "m_recpositiony"} | right | {"m_clusterflag": flag}


def upper_triangles(given: npt.ArrayLike) -> Floats:
    """Return covariances of MdcTrack, (n, 5, 5).

    The software writes the upper triangle row by row (DstMdcTrack::setError), pybes3 fills the lower one row by row.
    Whichever order gives more positive definite matrices is right.

    Parameters
    ----------
    given : array_like, (n, 5, 5) float64
        As pybes3 returns them.
    """
    filled = np.array(given, np.float64).reshape(-1, 5, 5)
    below, above = np.tril_indices(5), np.triu_indices(5)
    moved = np.zeros_like(filled)
    moved[:, above[0], above[1]] = filled[:, below[0], below[1]]
    moved[:, above[1], above[0]] = filled[:, below[0], below[1]]
    return moved if _positive(moved) > _positive(filled) else filled


def _positive(matrices: Floats) -> int:
    """Return the number of positive definite matrices, whatever the units of their rows."""
    matrices = np.where(np.isfinite(matrices), matrices, 0.0)  # of fits that failed
    size = np.sqrt(np.abs(np.diagonal(matrices, axis1=1, axis2=2)))
    size = np.where(size > 0, size, 1.0)
    return int(np.count_nonzero(np.linalg.eigvalsh(matrices / (size[:, :, None] * size[:, None, :])).min(axis=1) > 0))
