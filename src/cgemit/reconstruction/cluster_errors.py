"""Errors of clusters of charge and time, calibrated with a reference sample (docs/methods/readout.md)."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import resources

import numpy as np
import numpy.typing as npt

from cgemit.base.errors import Problem, Problems, ProblemsError
from cgemit.base.files import read_text
from cgemit.detector import Detector
from cgemit.detector.readouts import AnalogReadout, CalibratedReadout, Estimator

#: cos(theta) of tracks for which errors are expected, where these depend on it; linear between, constant beyond.
COS_THETA = np.array([-0.9, -0.85, -0.78, -0.69, -0.58, -0.45, -0.3, -0.15, 0.0,
                      0.15, 0.3, 0.45, 0.58, 0.69, 0.78, 0.85, 0.9])  # fmt: skip


Floats = npt.NDArray[np.float64]

ESTIMATORS: tuple[Estimator, ...] = ("merged", "centroid", "micro-tpc")
SIZES = 24
"""Numbers of strips with errors of their own; larger clusters have the error of this number."""
CHARGES = 7
"""Ranges of the charge of clusters with errors of their own."""
SLOPE_EDGES = np.array([0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.1])
"""Where ranges of the slope of electrons' places of origin at the anode begin, each with errors of its own."""
SLOPE_SIZES = 8
"""Numbers of strips with such errors of their own."""
DISTANCES = 8
"""Ranges of the distance of centroid and line, each with a factor on the error; the first: there is no line."""
SLOPE_KNOTS = np.array([0.0, *SLOPE_EDGES, 1.5])
"""Of the slope at the anode, for `Calibration.direction_depths`."""
PATH_KNOTS = np.array([1.0, 1.04, 1.1, 1.2, 1.4, 1.7, 2.2])
"""Of the path of a track per radius, for the same."""
DIRECTIONS = len(SLOPE_KNOTS) + len(PATH_KNOTS)
PAIR = 6
"""Numbers of the likelihood of a pair of X and V."""

#: Changes with everything that makes stored calibrations wrong.
MODEL = 7
_MISSING = (
    "got no calibration for this detector, field and read-out, "
    "expected digitize.readout.calibration = a file written by: "
    "cgemit readout --readout NAME -d DETECTOR --calibrate FILE (cgemit.study.readout.calibrate)"
)
#: Keys of a layer that calibrations depend on, with those of the gaps' gas.
_LAYER = (
    "anode_radius", "readout_offset", "length", "sheets", "pitch_x", "pitch_v", "stereo", "strips_x", "strips_v",
    "offset_v", "drift_gap", "transfer_gap", "induction_gap", "drift_field", "transfer_field", "induction_field",
    "foils", "hole_pitch",
)  # fmt: skip
_FOLDER = "calibrations"


class CalibrationError(ProblemsError):
    """A calibration that is missing or wrong; `problems` lists every problem."""


#: Shapes of the arrays of a calibration; -1 stands for the number of layers.
_SHAPES = {
    "edges": (2, -1, CHARGES - 1), "depth": (2, -1, CHARGES), "height": (2, -1, CHARGES),
    "typical_errors": (2, 3, 2, -1, len(COS_THETA)),
    "errors": (3, 2, -1, CHARGES, SIZES), "pairs": (-1, PAIR),
    "shares": (2, -1, CHARGES, SIZES), "slope_errors": (3, 2, -1, len(SLOPE_EDGES) + 1, SLOPE_SIZES),
    "slope_shares": (2, -1, len(SLOPE_EDGES) + 1, SLOPE_SIZES), "charge_factors": (3, 2, -1, CHARGES, SIZES),
    "distance_edges": (2, 2, -1, DISTANCES - 2), "distance_factors": (2, 3, 2, -1, DISTANCES),
    "direction_depths": (2, 3, 2, -1, DIRECTIONS), "direction_factors": (2, 3, 2, -1, DIRECTIONS),
    "correlations": (2, 3, -1, len(COS_THETA)),
}  # fmt: skip


#: Least and largest value of each: far beyond any layer, so that a wrong unit is seen.
_LIMITS = {
    "edges": (0.0, 1e6, "fC"), "depth": (-50.0, 50.0, "mm"), "height": (-50.0, 50.0, "mm"),
    "typical_errors": (1e-4, 100.0, "mm"), "errors": (1e-4, 100.0, "mm"), "slope_errors": (1e-4, 100.0, "mm"),
    "charge_factors": (1e-3, 1e4, ""), "distance_edges": (0.0, 1e4, "mm"), "distance_factors": (1e-3, 1e4, ""),
    "shares": (0.0, 1.0, ""), "slope_shares": (0.0, 1.0, ""), "pairs": (-1e4, 1e4, "(ns)"),
    "direction_depths": (-50.0, 50.0, "mm"), "direction_factors": (1e-3, 1e4, ""),
    "correlations": (-0.99, 0.99, ""),
}  # fmt: skip


def _shape(name: str, layers: int) -> tuple[int, ...]:
    return tuple(layers if n < 0 else n for n in _SHAPES[name])


@dataclass(frozen=True, eq=False)
class Calibration:
    """Errors of clusters by estimator, view, layer, charge and number of strips.

    Attributes
    ----------
    errors : (3, 2, layers, CHARGES, SIZES) float64, mm
        In the order of `ESTIMATORS`; views X and V.
    depth : (2, layers, CHARGES) float64, mm
        Outward; what to add to the heights in the gap that times give, so that line fits do not depend on the slope.
    height : (2, layers, CHARGES) float64, mm
        Outward from mid-gap; mean height of the charge in the gap, at which centroids are corrected for the Lorentz
        shift.
    edges : (2, layers, CHARGES - 1) float64, fC
        Charges of clusters where the next range begins.
    typical_errors : (2, 3, 2, layers, len(COS_THETA)) float64, mm
        Over all charges and sizes, by cos(theta) of the track, for clusters without and with its angle: equal errors
        with which straight lines through the layers are as precise at the beam line.
    slope_errors : (3, 2, layers, len(SLOPE_EDGES) + 1, SLOPE_SIZES) float64, mm
        Errors of positions that use the angle of the track, by estimator, view, layer, range of the slope and number of
        strips.
    shares : (2, layers, CHARGES, SIZES) float64
        Weight of the centroid in the merged position, 0 to 1.
    slope_shares : (2, layers, len(SLOPE_EDGES) + 1, SLOPE_SIZES) float64
        The same for positions that use the angle of the track.
    charge_factors : (3, 2, layers, CHARGES, SIZES) float64
        On `slope_errors`, by charge and number of strips.
    distance_edges : (2, 2, layers, DISTANCES - 2) float64, mm
        Distances of centroid and line where the next range begins, without and with the angle of the track.
    distance_factors : (2, 3, 2, layers, DISTANCES) float64
        On all errors, by that distance; clusters without a line are in the first range.
    direction_depths : (2, 3, 2, layers, DIRECTIONS) float64, mm
        Height by which positions are wrong along the slope, at `SLOPE_KNOTS` and at `PATH_KNOTS`, to be added up; for
        the direction of a straight track from the beam line, and with the angle of the track.
    direction_factors : (2, 3, 2, layers, DIRECTIONS) float64
        On the errors, by range of the same.
    correlations : (2, 3, layers, len(COS_THETA)) float64
        Of the errors of X and V of one crossing, by cos(theta) of the track, for clusters without and with its angle.
    pairs : (layers, PAIR) float64
        Mean and width of ln(charge of X / charge of V) and of the difference of their times (ns) for one particle, and
        the widths of both for two particles.
    key : str
        Hash of what the calibration belongs to, see `key_of`.
    about : str
        Detector, read-out and sample, for people.
    """

    errors: Floats
    depth: Floats
    height: Floats
    edges: Floats
    typical_errors: Floats
    slope_errors: Floats
    shares: Floats
    slope_shares: Floats
    charge_factors: Floats
    distance_edges: Floats
    distance_factors: Floats
    direction_depths: Floats
    direction_factors: Floats
    correlations: Floats
    pairs: Floats
    key: str
    about: str

    def typical(self, estimator: str, second_pass: bool = False) -> tuple[Floats, Floats]:
        """Return the errors of X and V over all sizes, each (layers, len(COS_THETA)) float64 mm."""
        x, v = self.typical_errors[int(second_pass), ESTIMATORS.index(estimator)]
        return x, v

    def correlation(self, estimator: str, second_pass: bool = False) -> Floats:
        """Return the correlation of the errors of X and V of one crossing, (layers, len(COS_THETA)) float64."""
        found: Floats = self.correlations[int(second_pass), ESTIMATORS.index(estimator)]
        return found

    def mean_correlation(self, estimator: str, second_pass: bool = False) -> Floats:
        """Return the mean of `correlation` over cos(theta), (layers,) float64, for clusters of unknown tracks."""
        from scipy.integrate import trapezoid  # scipy takes half a second to import

        values = self.correlation(estimator, second_pass)
        return np.asarray(trapezoid(values, COS_THETA) / (COS_THETA[-1] - COS_THETA[0]))

    def to_json(self) -> str:
        """Return the text of a calibration file."""
        data = {
            "about": self.about, "key": self.key,
            **{name: np.round(getattr(self, name), 6).tolist() for name in _SHAPES},
        }  # fmt: skip
        return json.dumps(data) + "\n"


def neutral(layers: int) -> Calibration:
    """Return the calibration with which calibrations are made: equal errors, no correction."""
    zero = ("depth", "height", "edges", "shares", "slope_shares", "distance_edges", "direction_depths",
            "correlations")  # fmt: skip
    values = {name: (np.zeros if name in zero else np.ones)(_shape(name, layers)) for name in _SHAPES}
    return Calibration(**values, key="", about="none")


def key_of(detector: Detector, readout: CalibratedReadout) -> str:
    """Return the hash of what a calibration depends on: CGEM layers, field, settings and chip of the read-out.

    Parameters
    ----------
    detector : Detector
    readout : CalibratedReadout
        Its `calibration`, `estimator` and `second_pass` do not count; nor does `time_margin`, since hardly any strip of
        the particles of a calibration is out of time.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    settings = readout.to_dict()
    for name in ("calibration", "estimator", "second_pass", "time_margin"):
        settings.pop(name, None)
    chip = asdict(readout.chip) if isinstance(readout, AnalogReadout) else None
    layers = [[getattr(layer, name) for name in _LAYER] + [layer.gas.ionization] for layer in detector.cgem]
    text = json.dumps([MODEL, readout.name, settings, chip, layers, detector.field.bz], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@lru_cache(maxsize=64)
def calibration_of(detector: Detector, readout: CalibratedReadout) -> Calibration:
    """Return the calibration of a read-out: its file, or the one that comes with the program.

    Parameters
    ----------
    detector : Detector
    readout : CalibratedReadout

    Raises
    ------
    CalibrationError
        If there is none, or the file belongs to another detector, field or read-out.
    """
    if not detector.cgem:
        return neutral(0)
    key = key_of(detector, readout)
    if readout.calibration:
        try:
            text = read_text(readout.calibration)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise CalibrationError(
                "digitize.readout.calibration",
                [Problem("", f"{readout.calibration[:80]!r} ({reason})", "a file that `cgemit readout` has written")],
            ) from error
        found = read_calibration(text, readout.calibration)
    else:
        file = resources.files("cgemit.reconstruction") / _FOLDER / f"{readout.name}-{key}.json"
        if not file.is_file():
            raise CalibrationError(f"read-out {readout.name} of {detector.name}", [Problem("", _MISSING, "")])
        found = read_calibration(file.read_text(encoding="utf-8"), file.name)
    problems = Problems()
    if found.key != key:
        expected = f"one of the layers and field of {detector.name} and of these settings of {readout.name}"
        hint = f"cgemit readout --readout {readout.name} -d DETECTOR --calibrate FILE"
        problems.note("", f"a calibration of {found.about}", expected, hint)
    if found.depth.shape[1] != len(detector.cgem):
        problems.note("", f"{found.depth.shape[1]} layers", str(len(detector.cgem)))
    problems.report(readout.calibration or key, CalibrationError)
    return found


def read_calibration(text: str, source: str) -> Calibration:
    """Return the calibration of a file.

    Parameters
    ----------
    text, source : str
        Its content and its name, for messages.

    Raises
    ------
    CalibrationError
        Listing every problem of the file.
    """
    try:
        data = json.loads(text)
        values = {name: np.array(data[name], np.float64) for name in _SHAPES}
        key, about = str(data["key"]), str(data["about"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise CalibrationError(source, [Problem("", f"{error!r:.200}", "a calibration file")]) from error
    problems = Problems()
    layers = values["depth"].shape[1] if values["depth"].ndim == 3 else 0
    for name, array in values.items():
        if array.shape != _shape(name, layers):
            hint = "made by another version? Make it again: cgemit readout --readout NAME -d DETECTOR --calibrate FILE"
            problems.note(name, f"shape {array.shape}", str(_shape(name, layers)), hint)
        low, high, unit = _LIMITS[name]
        wrong = array[~((array >= low) & (array <= high))]
        if wrong.size:
            problems.note(name, f"{wrong[0]:g}", f"numbers from {low:g} to {high:g} {unit}".rstrip())
        elif name.endswith("edges") and array.ndim and (np.diff(array) < 0).any():
            problems.note(name, f"{'distances' if name != 'edges' else 'charges'} that fall", "rising ones")
    problems.report(source, CalibrationError)
    return Calibration(**values, key=key, about=about)
