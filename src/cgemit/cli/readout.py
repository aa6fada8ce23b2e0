"""`cgemit readout`: what an analog readout resolves against the incidence, and the errors of its clusters."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.detector.readouts import ChargeReadout
    from cgemit.study.readout.scan import BeamScan


DESCRIPTION = """\
Position resolution, number of strips and efficiency of a readout in both views, in one layer of 2 m radius with the
gas, gaps and strips of besiii-cgem-design, for the charge centroid, the micro-TPC fit, the line through the charge, and
with the angle of the track. --scan selects what varies: the angle of incidence, the magnetic field (T), the drift field
(kV/cm), the gain or the threshold (fC). Angles count from the radius, in the plane across the beam line; electrons are
bent towards positive angles if the field is positive.

With --fit FILE: factors of the readout's chip in the errors of its clusters, found with muons in designs drawn at
random (pitch 0.3 to 1.2 mm, gap 3 to 8 mm, gain and threshold x 0.5 to 2, 0 to 1.2 T), and the pulls of clusters in
other designs. The readouts of the package have theirs."""

EXAMPLES = """\
examples:
  cgemit readout --readout apv25 --bz 0 -o test-beam
  cgemit readout --readout tiger --bz 1 --angles "-30 deg:30 deg:7" --set readout.gain=20000 -o one-tesla
  cgemit readout --readout tiger --scan drift_field --values 1:3:5 -o fields
  cgemit readout --readout apv25 --fit my-apv25.toml"""

_ANGLES = "0 deg:40 deg:9"
_GRAZING = 80  # deg, beyond which a beam does not cross the layer
#: Values of a scan if none are given.
_VALUES = {"bz": "0:1:5", "drift_field": "1:3:5", "gain": "5000,8000,12000,20000,40000", "threshold": "1:5:5"}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_readout(parser, default="tiger")
    parser.add_argument("--bz", type=options.field, default=1.0, metavar="T", help="magnetic field, T (default 1)")
    parser.add_argument("--scan", choices=("angle", *_VALUES), default="angle", help="what varies (default angle)")
    parser.add_argument(
        "--values",
        type=options.listed_numbers,
        default=None,
        metavar="A:B:N",
        help="values of what varies, unless it is the angle",
    )
    parser.add_argument(
        "--angle", type=options.angle, default=0.0, metavar="A", help="angle of the other scans (default 0)"
    )
    parser.add_argument(
        "--angles",
        type=options.listed_angles,
        default=None,
        metavar="A:B:N",
        help=f'angles of incidence (default "{_ANGLES}")',
    )
    parser.add_argument("--particle", default="pi-", help="PDG name or number (default pi-)")
    parser.add_argument("--p", type=options.momentum, default=150.0, metavar="P", help="momentum, GeV/c (default 150)")
    parser.add_argument(
        "-n", "--events", type=options.positive, default=None, metavar="N",
        help="particles at each angle (default 4000), or in each design (3000)",
    )  # fmt: skip
    parser.add_argument("--fit", metavar="FILE", help="write the factors of the errors of clusters instead")
    options.add_set(parser, "change one setting, such as readout.gain=20000; may be repeated")
    options.add_settings(parser)
    options.add_output(parser, "folder for readout.csv, .png and .pdf")
    options.add_run(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Scan the angles, or fit the errors."""
    from cgemit.detector.readouts import ChargeReadout, names_of

    _, readout = options.settings_and_readout(arguments)
    assert readout is not None  # it has a default
    if not isinstance(readout, ChargeReadout):
        raise options.InputError(f"--readout: got {readout.name}, expected one of {names_of(ChargeReadout)}")
    return _scan(arguments, readout) if arguments.fit is None else _fit(arguments, readout)


def _fit(arguments: argparse.Namespace, readout: ChargeReadout) -> int:
    from cgemit.base.files import new_file
    from cgemit.study.readout.errors import as_toml, fit_errors, pulls

    target = Path(arguments.fit)
    if target.exists() and not arguments.overwrite:
        raise options.InputError(f"--fit: got {target}, which exists; expected another file, or --overwrite")
    how = {"n": arguments.events or 3000, "seed": arguments.seed, "threads": arguments.threads}
    with new_file(target, overwrite=arguments.overwrite) as temporary:
        with options.progress_bar(arguments, "readout") as progress:
            errors = fit_errors(readout, **how, progress=progress)
        text = as_toml(readout.name, errors)
        temporary.write_text(text, encoding="utf-8")
    options.say(text)
    options.say("pulls of clusters that know their track, in other designs: median, core width, share beyond 3")
    for pull in pulls(readout, errors=errors, **how):
        where = pull.quantity if pull.quantity == "all" else f"{pull.quantity} {pull.low:g} to {pull.high:g}"
        options.say(f"  {where:<20} {pull.clusters:8d} {pull.mean:+7.2f} {pull.core:6.2f} {100 * pull.beyond:6.1f} %")
    return options.OK


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
        option, values = "--angles", arguments.angles or options.listed_angles(_ANGLES)
    else:
        option, values = "--values", arguments.values or options.listed_numbers(_VALUES[arguments.scan])
    wrong = "--values" if arguments.scan == "angle" else "--angles"
    if (arguments.values if arguments.scan == "angle" else arguments.angles) is not None:
        raise options.InputError(f"{wrong}: got it with --scan {arguments.scan}, expected {option}")
    return _incidence(option, values) if arguments.scan == "angle" else values


def _scan(arguments: argparse.Namespace, readout: ChargeReadout) -> int:
    from cgemit.base.files import check_free
    from cgemit.study.readout.scan import scan

    values, angle = _values(arguments), _incidence("--angle", [arguments.angle])[0]
    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    with options.progress_bar(arguments, "readout") as progress:
        beam_scan = scan(
            readout, arguments.scan, values, angle=angle, bz=arguments.bz, n=arguments.events or 4000,
            seed=arguments.seed, particle=arguments.particle, p=arguments.p, threads=arguments.threads,
            progress=progress,
        )  # fmt: skip
    options.say(beam_scan)
    if arguments.output:
        _write(beam_scan, arguments)
    return options.OK


def _write(beam_scan: BeamScan, arguments: argparse.Namespace) -> None:
    from cgemit.base.files import new_folder

    with new_folder(arguments.output, overwrite=arguments.overwrite) as temporary:
        (temporary / "readout.csv").write_text(beam_scan.to_csv(), encoding="utf-8")
        beam_scan.draw().save(temporary / "readout")
    options.note(arguments, f"picture: {arguments.output}/readout.png")
