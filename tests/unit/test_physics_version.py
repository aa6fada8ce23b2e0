"""The physics version of stored sweeps changes with the golden numbers."""

import hashlib
from pathlib import Path

from cgemit.base.version import PHYSICS

GOLDEN = Path(__file__).parents[1] / "golden" / "numbers.json"

#: Hash of the golden numbers for each physics version. When they change, raise `cgemit.base.version.PHYSICS` and add
#: a line; lines of released versions stay.
HASHES = {
    1: "1849c2212b1724b7",
    2: "d0649b4511db3e6c",
    3: "d0649b4511db3e6c",  # covariances near the ends of layers, which the golden numbers do not hold
    4: "d0649b4511db3e6c",  # clusters of tiger, apv25 and analog-projection
    5: "d0649b4511db3e6c",  # strips out of time and pairs of tiger and apv25; tracks of the finder
    6: "d0649b4511db3e6c",  # tracks in the CGEM alone; rounding of tiger and apv25
    7: "d0649b4511db3e6c",  # errors of clusters of tiger and apv25; annealed tracks of the finder; rounding of helices
    8: "d0649b4511db3e6c",  # clusters of tiger, apv25 and analog-projection by the direction of their tracks
    9: "d0649b4511db3e6c",  # tracks of the finder that share hits
    10: "d0649b4511db3e6c",  # calibrations of tiger, apv25 and analog-projection; correlated X and V clusters
    11: "d0649b4511db3e6c",  # expected errors of tiger, apv25 and analog-projection by cos(theta)
    12: "d0649b4511db3e6c",  # the same from fits with scattering and the other hits
}


def test_golden_numbers_belong_to_the_physics_version() -> None:
    assert max(HASHES) == PHYSICS
    found = hashlib.sha256(GOLDEN.read_bytes()).hexdigest()[:16]
    assert found == HASHES[PHYSICS], (
        "golden numbers have changed: raise cgemit.base.version.PHYSICS and add a line here"
    )
