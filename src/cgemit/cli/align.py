"""`cgemit align`: constants of a detector from tracks of runs, or the errors that samples will reach."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgemit.base.version import __version__
from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.calibration.align import Alignment
    from cgemit.calibration.forecast import AlignmentForecast
    from cgemit.calibration.settings import AlignmentSettings


DESCRIPTION = """\
Find how parts of a detector are displaced, from the tracks of runs that cgemit simulate --fit wrote
(docs/how-to/align.md). With --forecast no run is needed: the errors that samples of tracks will reach.
With -o also the table (alignment.csv, which Detector.with_alignment takes), the detector with these constants
(detector.toml), report.json and pictures."""

EXAMPLES = """\
examples:
  cgemit align run cosmics --free 'cgem.*' -o aligned
  cgemit align run --free 'cgem.*' --free drift_chamber --prior 'drift_chamber=10 um' --fix 'drift_chamber.tilt_*'
  cgemit align jpsi --free field.scale --pairs mass --mass 3.0969
  cgemit align --forecast -d besiii-cgem --muons 10000 --cosmics 10000"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("runs", nargs="*", metavar="RUN", help="folders of runs with clusters and candidates")
    parser.add_argument("-d", "--detector", help="detector of a forecast; of runs: description to be corrected")
    parser.add_argument(
        "--free",
        action="append",
        metavar="PATTERN",
        help="part or constant that is free (default cgem.*); may repeat; single wires:"
        " 'drift_chamber.layers.*.wires.*'",
    )
    parser.add_argument("--fix", action="append", default=[], metavar="PATTERN", help="of those, stay as they are")
    parser.add_argument(
        "--calibrate", action="append", default=[], choices=("lorentz", "z_scale", "field", "t0", "relation"),
        help="constants of no displacement; may repeat",
    )  # fmt: skip
    parser.add_argument(
        "--plates", type=_numbers, default=(), metavar="N,N", help="wire layers of each pair of end plates, from inside"
    )
    parser.add_argument(
        "--pairs", action="append", metavar="WHAT", choices=("cosmic", "vertex", "beam_line", "mass", "none"),
        help="what tracks of an event share (default cosmic): cosmic, vertex, beam_line, mass, none; may repeat",
    )  # fmt: skip
    parser.add_argument(
        "--mass", type=options.number, metavar="MASS",
        help="of two tracks that are alone in their event, GeV/c2; with --pairs mass",
    )  # fmt: skip
    parser.add_argument(
        "--mass-width", type=options.number, default=0.0, metavar="WIDTH", help="of the true masses, GeV/c2 (default 0)"
    )
    parser.add_argument("--mille", metavar="FILE", help="also write records for pede")
    parser.add_argument(
        "--prior", action="append", default=[], metavar="PATTERN=ERROR", help="survey, 'cgem.*.shift_z=100 um'"
    )
    parser.add_argument(
        "--zero-modes", choices=("undetermined", "constrained"), default="undetermined",
        help="constants that tracks see only in combinations (default undetermined: no number)",
    )  # fmt: skip
    parser.add_argument("--forecast", action="store_true", help="errors without events")
    parser.add_argument("--muons", type=options.positive, metavar="N", help="muons of 1 GeV/c, |cos(theta)| < 0.8")
    parser.add_argument("--cosmics", type=options.positive, metavar="N", help="cosmic muons")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    options.add_output(parser, "folder for table, detector, report and pictures")
    options.add_common(parser)


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


def run(arguments: argparse.Namespace) -> int:
    """Align, or forecast."""
    from cgemit.base.files import check_free
    from cgemit.calibration.align import Alignment, align
    from cgemit.calibration.mille import write_mille
    from cgemit.calibration.settings import AlignmentSettings
    from cgemit.chain.result import Result

    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    pairs: Any = tuple(one for one in arguments.pairs or ("cosmic",) if one != "none")
    settings = AlignmentSettings(
        free=tuple(arguments.free or ("cgem.*",)), fixed=tuple(arguments.fix), calibrate=tuple(arguments.calibrate),
        priors=tuple(arguments.prior), zero_modes=arguments.zero_modes, plates=arguments.plates,
        pairs=pairs, mass=arguments.mass, mass_width=arguments.mass_width,
    )  # fmt: skip
    outcome: Alignment | AlignmentForecast
    if arguments.forecast:
        outcome = _forecast(arguments, settings)
    else:
        if not arguments.runs or arguments.muons or arguments.cosmics:
            raise ValueError(
                "align: got no run, or a sample without --forecast; expected folders of runs, or --forecast"
            )
        runs = [Result.load(folder) for folder in arguments.runs]
        if arguments.mille:
            write_mille(arguments.mille, runs, settings, detector=arguments.detector, overwrite=arguments.overwrite)
        outcome = align(runs, settings, detector=arguments.detector)
    report = _report(outcome, settings, arguments)
    text = json.dumps(report, indent=2, allow_nan=False)
    if arguments.output:
        _write(outcome, text, arguments.output, overwrite=arguments.overwrite)
    options.say(text if arguments.json else outcome)
    if arguments.output:
        options.note(arguments, f"table, report and pictures: {arguments.output}")
    if isinstance(outcome, Alignment) and not outcome.converged:
        raise options.RunFailedError("the alignment has not converged")
    return options.OK


def _forecast(arguments: argparse.Namespace, settings: AlignmentSettings) -> AlignmentForecast:
    from cgemit.calibration.forecast import alignment_forecast
    from cgemit.particles.gun import Gun
    from cgemit.particles.samples import sample

    samples: list[tuple[Any, int]] = []
    if arguments.muons:
        samples.append((Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), arguments.muons))
    if arguments.cosmics:
        samples.append((sample("cosmic"), arguments.cosmics))
    if arguments.runs or arguments.mille or not samples or not arguments.detector:
        expected = "-d DETECTOR and --muons N, --cosmics N, or both, and neither a run nor --mille"
        raise ValueError(f"align --forecast: expected {expected}")
    return alignment_forecast(arguments.detector, samples, settings)


def _report(
    outcome: Alignment | AlignmentForecast, settings: AlignmentSettings, arguments: argparse.Namespace
) -> dict[str, Any]:
    from cgemit.calibration.align import Alignment

    modes = outcome.modes(5) if outcome.solution.matrix is not None else None
    report: dict[str, Any] = {
        "version": __version__, "command": arguments.line, "settings": settings.to_dict(),
        "constants": [
            dict(zip(outcome.table.columns(), map(_plain, row), strict=True))
            for row in zip(*outcome.table.columns().values(), strict=True)
        ],
        "not_determined": list(outcome.zero_modes),
        "weak_modes": [
            {"name": name, "share": share, "error_mm": _plain(size)}
            for name, share, size in zip(modes.names, modes.shares, modes.sizes, strict=True)
        ] if modes else [],
    }  # fmt: skip
    if isinstance(outcome, Alignment):
        report |= {
            "detector": outcome.detector.name, "converged": outcome.converged, "at_limits": list(outcome.at_limits),
            "chi2_gained": outcome.improvement, "p_value": outcome.p_value,
            "history": [vars(one) for one in outcome.history],
        }  # fmt: skip
    else:
        report |= {"detector": outcome.detector.name, "tracks": outcome.sums.tracks}
    return report


def _plain(value: Any) -> Any:
    """Return None for a number that is not finite, as JSON has none."""
    return None if isinstance(value, float) and not abs(value) < float("inf") else value


def _write(outcome: Alignment | AlignmentForecast, text: str, folder: str, *, overwrite: bool) -> None:
    from cgemit.base.files import new_folder
    from cgemit.calibration.align import Alignment
    from cgemit.draw.alignment import draw_constants, draw_modes, draw_residual_means

    with new_folder(Path(folder), overwrite=overwrite) as results:
        outcome.table.save(results / "alignment.csv")
        (results / "report.json").write_text(text + "\n", encoding="utf-8")
        draw_constants(outcome).save(results / "constants")
        if outcome.solution.matrix is not None:  # not of single wires
            draw_modes(outcome).save(results / "modes")
        if isinstance(outcome, Alignment):
            (results / "detector.toml").write_text(outcome.detector.to_toml(), encoding="utf-8")
            draw_residual_means(outcome).save(results / "residuals")
