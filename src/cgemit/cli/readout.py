"""`cgemit readout`: what an analog read-out resolves against the incidence, and calibrations of its errors."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cgemit.cli import changes, common, read

if TYPE_CHECKING:
    from cgemit.study.readout.scan import BeamScan

_DESCRIPTION = """\
Position resolution of a read-out against the angle of incidence, in one layer of 2 m radius with the gas, gaps and
strips of besiii-cgem-design, for the charge centroid, the micro-TPC fit and their weighted mean. Angles count from
the radius, in the plane across the beam line; electrons are bent towards positive angles if the field is positive.

With --calibrate FILE: errors of the clusters of a detector, from 1 GeV/c muons with |cos(theta)| < 0.93. A run with
--set digitize.readout.calibration=FILE uses them. Presets with the default settings of a read-out need none."""

_EXAMPLES = """\
examples:
  cgemit readout --readout apv25 --bz 0 -o test-beam
  cgemit readout --readout tiger --bz 1 --angles "-30 deg:30 deg:7" --set digitize.readout.gain=20000 -o one-tesla
  cgemit readout --readout tiger -d my-detector.toml --calibrate my-tiger.json"""

_ANGLES = "0 deg:40 deg:9"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    parser = subparsers.add_parser(
        "readout", help="resolution of an analog read-out against the incidence; calibrations",
        description=_DESCRIPTION, epilog=_EXAMPLES, formatter_class=common.HelpFormatter,
    )  # fmt: skip
    changes.add_readout(parser, default="tiger")
    parser.add_argument("--bz", type=float, default=1.0, metavar="T", help="magnetic field, T (default 1)")
    parser.add_argument(
        "--angles", type=read.angles, default=None, metavar="A:B:N", help=f'angles of incidence (default "{_ANGLES}")'
    )
    parser.add_argument("--particle", default="pi-", help="PDG name or number (default pi-)")
    parser.add_argument("--p", type=float, default=150.0, metavar="P", help="momentum, GeV/c (default 150)")
    parser.add_argument(
        "-n", "--events", type=read.positive, default=None, metavar="N",
        help="particles at each angle (default 4000), or muons of a calibration (default 20000)",
    )  # fmt: skip
    parser.add_argument("--calibrate", metavar="FILE", help="write the errors of a detector's clusters instead")
    parser.add_argument("-d", "--detector", metavar="NAME|FILE", help="of the calibration")
    changes.add_set(parser, "change one setting, such as digitize.readout.gain=20000; may be repeated")
    changes.add_settings(parser)
    parser.add_argument("-o", "--output", metavar="DIR", default=None, help="folder for readout.csv, .png and .pdf")
    parser.add_argument("--overwrite", action="store_true", help="write over files that exist")
    common.add_run(parser)
    common.add_common(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Scan the angles, or calibrate."""
    readout = changes.settings_of(arguments).digitize.readout
    if not hasattr(readout, "cluster_with"):
        raise changes.InputError(f"--readout: got {readout.name}, expected tiger, apv25 or analog-projection")
    if (arguments.calibrate is None) != (arguments.detector is None):
        raise changes.InputError("--calibrate, --detector: got one of them, expected both or none")
    if arguments.calibrate is not None:
        return _calibrate(arguments, readout)
    return _scan(arguments, readout)


def _calibrate(arguments: argparse.Namespace, readout: Any) -> int:
    from cgemit.detector import load
    from cgemit.io import new_file
    from cgemit.study.readout.calibrate import calibrate

    target = Path(arguments.calibrate)
    if target.exists() and not arguments.overwrite:
        raise changes.InputError(f"--calibrate: got {target}, which exists; expected another file, or --overwrite")
    detector = load(arguments.detector)
    if not detector.cgem:
        raise changes.InputError(f"--detector: got {detector.name} without CGEM layers, expected one with clusters")
    found = calibrate(detector, readout, n=arguments.events or 20_000, seed=arguments.seed, threads=arguments.threads)
    with new_file(target, overwrite=arguments.overwrite) as temporary:
        temporary.write_text(found.to_json(), encoding="utf-8")
    x, v = found.typical(readout.estimator)
    print(f"{found.about}\nerrors of X and V over all clusters, um, by layer:")
    for layer, *errors in zip(detector.cgem, x, v, strict=True):
        print(f"  {layer.label}  {1e3 * errors[0]:6.1f}  {1e3 * errors[1]:6.1f}")
    return common.OK


def _scan(arguments: argparse.Namespace, readout: Any) -> int:
    from cgemit.io.folders import check_free
    from cgemit.study.readout.scan import scan_angles

    given = read.angles(_ANGLES) if arguments.angles is None else arguments.angles
    if isinstance(given, tuple):
        raise changes.InputError("--angles: got a range, expected values such as 20 deg, or A:B:N")
    angles = [float(angle) for angle in np.atleast_1d(given)]
    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    with common.Progress("readout", quiet=arguments.quiet) as progress:
        scan = scan_angles(
            readout, angles, bz=arguments.bz, n=arguments.events or 4000, seed=arguments.seed,
            particle=arguments.particle, p=arguments.p, threads=arguments.threads, progress=progress,
        )  # fmt: skip
    print(scan)
    if arguments.output:
        _write(scan, arguments)
    return common.OK


def _write(scan: BeamScan, arguments: argparse.Namespace) -> None:
    from cgemit.draw import draw_readout
    from cgemit.io.folders import new_folder

    with new_folder(arguments.output, overwrite=arguments.overwrite) as place:
        (place / "readout.csv").write_text(scan.to_csv(), encoding="utf-8")
        draw_readout(scan.angle, scan.curves(), scan.size, scan.title).save(place / "readout")
    if not arguments.quiet:
        print(f"picture: {arguments.output}/readout.png", file=sys.stderr)
