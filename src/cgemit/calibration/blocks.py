"""Symmetric matrices of many constants in dense blocks, their solution and the diagonal of their inverse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.blas import dsyrk

from cgemit.base.arrays import Floats, Ints

#: Lower blocks by the numbers of their rows and columns.
Lower = Mapping[tuple[int, int], Floats]


@dataclass(frozen=True, eq=False)
class Blocks:
    """A symmetric matrix of constants that are neighbours only of some others.

    Attributes
    ----------
    order : ndarray, (n,) int
        Constant of each row: constants that are neighbours stand near to each other.
    first : ndarray, (blocks + 1,) int32
        Row where each block begins, and the number of constants.
    entries : mapping of (int, int) to ndarray
        Of rows and columns of the blocks of these numbers, the second at most the first; none: 0. On the diagonal the
        lower triangle counts.
    hits : ndarray, (n,) int64
        Of each constant.
    """

    order: Ints
    first: Ints
    entries: Lower
    hits: Ints

    def __add__(self, other: Blocks) -> Blocks:
        entries = dict(self.entries)
        for at, block in other.entries.items():
            entries[at] = entries[at] + block if at in entries else block
        return replace(self, entries=entries, hits=self.hits + other.hits)

    def __rmul__(self, factor: float) -> Blocks:
        entries = {at: factor * block for at, block in self.entries.items()}
        return replace(self, entries=entries, hits=np.rint(factor * self.hits).astype(np.int64))

    def __matmul__(self, vector: Floats) -> Floats:
        sorted_, found = vector[self.order], np.zeros(len(vector))
        for (i, j), block in self.entries.items():
            rows, columns = slice(*self.first[i : i + 2]), slice(*self.first[j : j + 2])
            if i == j:
                found[rows] += _whole(block) @ sorted_[rows]
            else:
                found[rows] += block @ sorted_[columns]
                found[columns] += block.T @ sorted_[rows]
        out = np.empty_like(found)
        out[self.order] = found
        return out

    def diagonal(self) -> Floats:
        """Return the diagonal by constants, (n,)."""
        out = np.zeros(len(self.order))
        for i in range(len(self.first) - 1):
            if (i, i) in self.entries:
                out[self.order[self.first[i] : self.first[i + 1]]] = np.diagonal(self.entries[i, i])
        return out

    def dense(self) -> Floats:
        """Return all entries by constants, (n, n)."""
        n = len(self.order)
        lower = np.zeros((n, n))
        for (i, j), block in self.entries.items():
            lower[self.first[i] : self.first[i + 1], self.first[j] : self.first[j + 1]] = block
        out = np.empty_like(lower)
        out[np.ix_(self.order, self.order)] = _whole(lower)
        return out

    def scaled(self, scale: Floats, added: Floats) -> Blocks:
        """Return the matrix with each constant in units of its scale, and something added to the diagonal.

        Parameters
        ----------
        scale, added : ndarray, (n,) float64
        """
        scale, added = scale[self.order], added[self.order]
        parts = [slice(*self.first[i : i + 2]) for i in range(len(self.first) - 1)]
        entries = {
            (i, j): block * scale[parts[i], None] * scale[parts[j]] for (i, j), block in self.entries.items()
        }  # fmt: skip
        for i, rows in enumerate(parts):
            block = entries.setdefault((i, i), np.zeros((len(added[rows]),) * 2))
            block[np.diag_indices_from(block)] += added[rows]
        return replace(self, entries=entries)


def _whole(lower: Floats) -> Floats:
    return np.tril(lower) + np.tril(lower, -1).T


def filled(entries: Lower, count: int) -> list[list[int]]:
    """Return the rows of blocks below the diagonal that the factor of a matrix has, of each column of blocks.

    Parameters
    ----------
    entries : Lower
    count : int
        Number of blocks of a row.
    """
    below = [set[int]() for _ in range(count)]
    for i, j in entries:
        if i > j:
            below[j].add(i)
    for rows in below:
        first = min(rows, default=None)
        if first is not None:
            below[first] |= rows - {first}
    return [sorted(rows) for rows in below]


class Factor:
    """Cholesky factor of a positive definite matrix in blocks.

    Parameters
    ----------
    matrix : Blocks

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is not positive definite.
    """

    def __init__(self, matrix: Blocks) -> None:
        self.matrix = matrix
        first = matrix.first.tolist()
        self.parts = [slice(a, b) for a, b in pairwise(first)]
        self.below = filled(matrix.entries, len(self.parts))
        #: The factor; `variances` replaces it by the inverse.
        self.lower = {at: np.array(block) for at, block in matrix.entries.items()}
        for k, rows in enumerate(self.below):
            diagonal = cholesky(self.lower[k, k], lower=True, check_finite=False)
            self.lower[k, k] = diagonal
            if not rows:
                continue
            stacked = self._stacked(k)
            stacked = solve_triangular(diagonal, stacked.T, lower=True, check_finite=False).T
            square = dsyrk(-1.0, stacked.T, trans=1, lower=1)
            places = self._places(rows)
            for i, at in zip(rows, places, strict=True):
                self.lower[i, k] = stacked[at]
            for a, i in enumerate(rows):
                for b, j in enumerate(rows[: a + 1]):
                    self._sum_into(i, j, square[places[a], places[b]])

    def _sum_into(self, i: int, j: int, block: Floats) -> None:
        if (i, j) in self.lower:
            self.lower[i, j] += block
        else:
            self.lower[i, j] = np.array(block)

    def _places(self, rows: Sequence[int]) -> list[slice]:
        ends = np.cumsum([0, *(self.parts[i].stop - self.parts[i].start for i in rows)]).tolist()
        return [slice(a, b) for a, b in pairwise(ends)]

    def _stacked(self, k: int) -> Floats:
        return np.concatenate([self.lower[i, k] for i in self.below[k]])

    def solve(self, right: Floats) -> Floats:
        """Return the solution, (n,) or (n, vectors), by constants.

        Parameters
        ----------
        right : ndarray
        """
        order, parts = self.matrix.order, self.parts
        x = np.array(right[order])
        for k, rows in enumerate(self.below):
            x[parts[k]] = solve_triangular(self.lower[k, k], x[parts[k]], lower=True, check_finite=False)
            for i in rows:
                x[parts[i]] -= self.lower[i, k] @ x[parts[k]]
        for k in reversed(range(len(parts))):
            for i in self.below[k]:
                x[parts[k]] -= self.lower[i, k].T @ x[parts[i]]
            x[parts[k]] = solve_triangular(self.lower[k, k], x[parts[k]], lower=True, trans=1, check_finite=False)
        out = np.empty_like(x)
        out[order] = x
        return out

    def variances(self) -> Floats:
        """Return the diagonal of the inverse by constants, (n,); the factor is gone then.

        The blocks of the inverse where the factor has some follow from the last to the first (Takahashi, Fagan and
        Chen, PICA 8 (1973) 63): of column k, with the rows S below, C_Sk = -C_SS L_Sk L_kk^-1.
        """
        inverse = self.lower
        out = np.empty(len(self.matrix.order))
        for k in reversed(range(len(self.parts))):
            rows, diagonal = self.below[k], inverse[k, k]
            root = solve_triangular(diagonal, np.eye(len(diagonal)), lower=True, check_finite=False)
            own = root.T @ root
            if rows:
                gain = self._stacked(k) @ root
                places = self._places(rows)
                known = np.empty((len(gain), len(gain)))
                for a, i in enumerate(rows):
                    for b, j in enumerate(rows[: a + 1]):
                        known[places[a], places[b]] = inverse[i, j]
                        known[places[b], places[a]] = inverse[i, j].T
                beside = -known @ gain
                own -= gain.T @ beside
                for i, at in zip(rows, places, strict=True):
                    inverse[i, k] = beside[at]
            inverse[k, k] = own
            out[self.matrix.order[self.parts[k]]] = np.diagonal(own)
        return out
