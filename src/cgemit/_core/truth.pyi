# Links of hits and tracks to particles.

import numpy.typing as npt

from cgemit._core._arrays import _Array, _Columns

def match_hits(
    *,
    particles: _Columns,
    truths: _Columns,
    wire_truths: _Columns,
    clusters: _Columns,
    wire_hits: _Columns,
    candidate_hits: _Columns,
    candidates: int,
) -> dict[str, _Array]: ...
def assign_hits(
    *,
    particles: _Columns,
    truths: _Columns,
    wire_truths: _Columns,
    clusters: _Columns,
    wire_hits: _Columns,
    candidates: npt.ArrayLike,
    rows: npt.ArrayLike,
) -> dict[str, _Array]: ...
