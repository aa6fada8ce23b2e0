"""`cgemit readout`: what an analog read-out resolves against the incidence, and calibrations of its errors."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.detector.readouts import CalibratedReadout
    from cgemit.study.readout.scan import BeamScan


DESCRIPTION = """\
Position resolution, number of strips and efficiency of a read-out in both views, in one layer of 2 m radius with the
gas, gaps and strips of besiii-cgem-design, for the charge centroid, the micro-TPC fit, their weighted mean, and with
the angle of the track. --scan selects what varies: the angle of incidence, the magnetic field (T), the drift field
(kV/cm), the gain or the threshold (fC). Angles count from the radius, in the plane across the beam line; electrons are
bent towards positive angles if the field is positive.

With --calibrate FILE: errors of the clusters of a detector, from muons of both charges with |cos(theta)| < 0.93: of
1 GeV/c, and of 0.2 to 10 GeV/c for clusters of known tracks. A run with --set digitize.readout.calibration=FILE uses
them. Presets with the default settings of a read-out need none."""

EXAMPLES = """\
examples:
  cgemit readout --readout apv25 --bz 0 -o test-beam
  cgemit readout --readout tiger --bz 1 --angles "-30 deg:30 deg:7" --set digitize.readout.gain=20000 -o one-tesla
  cgemit readout --readout tiger --scan drift_field --values 1:3:5 -o fields
  cgemit readout --readout tiger -d my-detector.toml --calibrate my-tiger.json"""

_ANGLES = "0 deg:40 deg:9"
_GRAZING = 80  # deg, beyond which a beam does not cross the layer
#: Values of a scan if none are given.
_VALUES = {"bz": "0:1:5", "drift_field": "1:3:5", "gain": "5000,8000,12000,20000,40000", "threshold": "1:5:5"}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_readout(parser, default="tiger")
    parser.add_argument("--bz", type=float, default=1.0, metavar="T", help="magnetic field, T (default 1)")
    parser.add_argument("--scan", choices=("angle", *_VALUES), default="angle", help="what varies (default angle)")
    parser.add_argument(
        "--values",
        type=options.numbers,
        default=None,
        metavar="A:B:N",
        help="values of what varies, unless it is the angle",
    )
    parser.add_argument(
        "--angle", type=options.angles, default=0.0, metavar="A", help="angle of the other scans (default 0)"
    )
    parser.add_argument(
        "--angles",
        type=options.angles,
        default=None,
        metavar="A:B:N",
        help=f'angles of incidence (default "{_ANGLES}")',
    )
    parser.add_argument("--particle", default="pi-", help="PDG name or number (default pi-)")
    parser.add_argument("--p", type=float, default=150.0, metavar="P", help="momentum, GeV/c (default 150)")
    parser.add_argument(
        "-n", "--events", type=options.positive, default=None, metavar="N",
        help="particles at each angle (default 4000), or muons of a calibration (40000)",
    )  # fmt: skip
    parser.add_argument("--calibrate", metavar="FILE", help="write the errors of a detector's clusters instead")
    parser.add_argument("-d", "--detector", metavar="NAME|FILE", help="of the calibration")
    options.add_set(parser, "change one setting, such as digitize.readout.gain=20000; may be repeated")
    options.add_settings(parser)
    options.add_output(parser, "folder for readout.csv, .png and .pdf")
    options.add_run(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Scan the angles, or calibrate."""
    from cgemit.detector.readouts import CalibratedReadout, names_of

    readout = options.settings_of(arguments).digitize.readout
    if not isinstance(readout, CalibratedReadout):
        raise options.InputError(f"--readout: got {readout.name}, expected one of {names_of(CalibratedReadout)}")
    if arguments.calibrate is not None and arguments.detector is None:
        raise options.InputError("--calibrate: got no --detector, expected the one whose clusters are calibrated")
    if arguments.detector is not None and arguments.calibrate is None:
        raise options.InputError("--detector: got it without --calibrate, expected it with it")
    if arguments.calibrate is not None:
        return _calibrate(arguments, readout)
    return _scan(arguments, readout)


def _calibrate(arguments: argparse.Namespace, readout: CalibratedReadout) -> int:
    from cgemit.base.files import new_file
    from cgemit.detector import load
    from cgemit.reconstruction.cluster_errors import COS_THETA, read_calibration
    from cgemit.study.readout.calibrate import calibrate

    target = Path(arguments.calibrate)
    if target.exists() and not arguments.overwrite:
        raise options.InputError(f"--calibrate: got {target}, which exists; expected another file, or --overwrite")
    detector = load(arguments.detector)
    if not detector.cgem:
        raise options.InputError(f"--detector: got {detector.name} without CGEM layers, expected one with clusters")
    found = calibrate(detector, readout, n=arguments.events or 40_000, seed=arguments.seed, threads=arguments.threads)
    text = found.to_json()
    with new_file(target, overwrite=arguments.overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")
    found = read_calibration(text, target.name)  # which rounds
    shown = slice(None, None, 4)
    angles = "".join(f"{cos_theta:8.2f}" for cos_theta in COS_THETA[shown])
    options.say(f"{found.about}\nerrors over all clusters, um, by layer, view and cos(theta):\n        {angles}")
    for view, errors in zip("XV", found.typical(readout.estimator), strict=True):
        for layer, own in zip(detector.cgem, errors, strict=True):
            options.say(f"  {layer.label:>4} {view}" + "".join(f"{1e3 * error:8.1f}" for error in own[shown]))
    return options.OK


def _one_angle(arguments: argparse.Namespace) -> float:
    """Return the angle of incidence, deg."""
    if not isinstance(arguments.angle, float):
        raise options.InputError("--angle: got several values, expected one such as 20 deg")
    return _incidence("--angle", [arguments.angle])[0]


def _incidence(option: str, angles: list[float]) -> list[float]:
    """Return angles of incidence in deg, from rad."""
    degrees = [float(value) for value in np.degrees(angles)]
    if not all(abs(value) < _GRAZING for value in degrees):
        steepest = max(angles, key=abs)
        raise options.InputError(
            f"{option}: got {steepest:g} rad = {math.degrees(steepest):g} deg, expected between -{_GRAZING} and "
            f'{_GRAZING} deg; numbers without a unit are rad ("25 deg" has one)'
        )
    return degrees


def _values(arguments: argparse.Namespace) -> list[float]:
    """Return the values of the scan in its unit."""
    if arguments.scan == "angle":
        option, given = "--angles", options.angles(_ANGLES) if arguments.angles is None else arguments.angles
    else:
        option, given = (
            "--values",
            options.numbers(_VALUES[arguments.scan]) if arguments.values is None else arguments.values,
        )
    if isinstance(given, tuple):
        raise options.InputError(f"{option}: got a range, expected values, or A:B:N")
    wrong = "--values" if arguments.scan == "angle" else "--angles"
    if (arguments.values if arguments.scan == "angle" else arguments.angles) is not None:
        raise options.InputError(f"{wrong}: got it with --scan {arguments.scan}, expected {option}")
    values = [float(value) for value in np.atleast_1d(given)]
    return _incidence(option, values) if arguments.scan == "angle" else values


def _scan(arguments: argparse.Namespace, readout: CalibratedReadout) -> int:
    from cgemit.base.files import check_free
    from cgemit.study.readout.scan import scan

    values, angle = _values(arguments), _one_angle(arguments)
    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    with options.progress_bar(arguments, "readout") as progress:
        found = scan(
            readout, arguments.scan, values, angle=angle, bz=arguments.bz, n=arguments.events or 4000,
            seed=arguments.seed, particle=arguments.particle, p=arguments.p, threads=arguments.threads,
            progress=progress,
        )  # fmt: skip
    options.say(found)
    if arguments.output:
        _write(found, arguments)
    return options.OK


def _write(found: BeamScan, arguments: argparse.Namespace) -> None:
    from cgemit.base.files import new_folder

    with new_folder(arguments.output, overwrite=arguments.overwrite) as place:
        (place / "readout.csv").write_text(found.to_csv(), encoding="utf-8")
        found.draw().save(place / "readout")
    options.note(arguments, f"picture: {arguments.output}/readout.png")
