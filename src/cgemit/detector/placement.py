"""Where parts of a detector really are: shifted and turned against their places in the description."""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cgemit.detector.kept import Part
from cgemit.detector.keys import key

Floats = npt.NDArray[np.float64]

_FAR, _TILT, _ROTATION = 2.0, 2e-3, 1e-2  # mm, rad: beyond, hits would be sought at other wires and strips


@dataclass(frozen=True, kw_only=True)
class Placed(Part):
    """A part with six degrees of freedom: it is turned about the x, then y, then z axis, and then shifted."""

    shift_x: float = field(metadata=key("length", "shift of the part along x", -_FAR, _FAR), default=0.0)  # mm
    shift_y: float = field(metadata=key("length", "shift of the part along y", -_FAR, _FAR), default=0.0)  # mm
    shift_z: float = field(metadata=key("length", "shift of the part along the beam", -_FAR, _FAR), default=0.0)  # mm
    tilt_x: float = field(metadata=key("angle", "turn of the part about the x axis", -_TILT, _TILT), default=0.0)
    tilt_y: float = field(metadata=key("angle", "turn of the part about the y axis", -_TILT, _TILT), default=0.0)
    rotation: float = field(
        metadata=key("angle", "turn of the part about the beam axis", -_ROTATION, _ROTATION), default=0.0
    )

    @property
    def is_moved(self) -> bool:
        """Whether the part is anywhere but where the description puts it."""
        return any(getattr(self, name) != 0 for name in PLACEMENT)

    def moved_text(self) -> str:
        """Return how the part is displaced, as the end of a line; nothing if it is in place."""
        if not self.is_moved:
            return ""
        shift = ", ".join(f"{1000 * value:g}" for value in self.shift)
        turn = ", ".join(f"{1000 * value:g}" for value in (self.tilt_x, self.tilt_y, self.rotation))
        return f", displaced by ({shift}) um and ({turn}) mrad"

    @property
    def shift(self) -> Floats:
        """Shift, (3,) float64 mm."""
        return np.array([self.shift_x, self.shift_y, self.shift_z])

    @property
    def turn(self) -> Floats:
        """Rotation from the beam's axes to those of the part, (3, 3) float64."""
        (cx, sx), (cy, sy), (cz, sz) = (
            (math.cos(angle), math.sin(angle)) for angle in (self.tilt_x, self.tilt_y, self.rotation)
        )
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return np.asarray((about_z @ about_y @ about_x).T)

    @property
    def placement(self) -> Floats:
        """Shift and the rows of the rotation, (12,) float64, as the core takes them."""
        return np.concatenate([self.shift, self.turn.ravel()])


#: Keys of `Placed`, which a file need not give.
PLACEMENT = ("shift_x", "shift_y", "shift_z", "tilt_x", "tilt_y", "rotation")

#: Placement of a part that is where the description puts it.
IN_PLACE = Placed().placement


def seen_by(part: Placed, points: Floats, direction: Floats) -> Floats:
    """Return where straight tracks that cross cylinders of the described part cross those of the real one.

    Parameters
    ----------
    part : Placed
    points : ndarray, (n, 3) float64, mm
        Points of the tracks, in the beam's axes.
    direction : ndarray, (n, 3) float64
        Their directions, of any length.

    Returns
    -------
    ndarray, (n, 3) float64, mm
        In the part's own axes, each at the radius that the point has in the beam's. A track along the surface is left
        where it is.
    """
    radius_2 = np.sum(points[:, :2] ** 2, axis=1)
    local, along = (points - part.shift) @ part.turn.T, direction @ part.turn.T
    # |p + t u| = radius, for the solution close to t = 0
    a, b = np.sum(along[:, :2] ** 2, axis=1), np.sum(local[:, :2] * along[:, :2], axis=1)
    c = np.sum(local[:, :2] ** 2, axis=1) - radius_2
    square = b * b - a * c
    t = np.where(square > 0, -c / (b + np.copysign(np.sqrt(np.maximum(square, 0)), b)), 0.0)
    return np.asarray(local + t[:, None] * along)
