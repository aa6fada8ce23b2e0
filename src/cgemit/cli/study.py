"""`cgemit study`: the paper, number by number and figure by figure."""

from __future__ import annotations

import argparse
import json

from cgemit.cli import options
from cgemit.cli.simulate import add_finder

DESCRIPTION = """\
Reproduce arXiv:1504.02570: mu- of 1 GeV/c, cos(theta) uniform in +-0.93, in the CGEM tracker of the paper and in the
inner drift chamber, and both against momentum. Writes report.html (open this first), summary.json, the figures, and
a CSV table behind each of them."""

EXAMPLES = """\
examples:
  cgemit study                            20 000 events a detector, 5 000 a momentum; about 7 s on two cores
  cgemit study --quick -o look            fewer events, some seconds
  cgemit study --events 100000 --seed 7 -o precise
  cgemit study --pdf -o slides            figures as PDF too
  cgemit study --quick --json -o look     summary.json on stdout too
  cgemit study --no-deltas -o projected   without delta electrons: the pure projection
  cgemit study --set fit.loss=mean -o mean                any setting of any stage (cgemit settings lists them)
  cgemit study --finder ckf -o found       with tracks that are found, not assigned by truth
  cgemit study --readout tiger -o tiger   with charge and time on strips (--help lists the others)
  cgemit study --set readout.threshold="5 fC" -o coarse
  cgemit study --field besiii -o uneven    the field of BESIII; or a map of your own, --field map.npz

Ctrl-C leaves no results: the folder appears when everything is in it."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_output(parser, default="cgemit-study")
    parser.add_argument(
        "-n", "--events", type=options.positive, metavar="N",
        help="events at 1 GeV/c for each detector (default 20000); each of the ten momenta gets a quarter of it",
    )  # fmt: skip
    parser.add_argument("--quick", action="store_true", help="1500 events, unless --events says otherwise")
    parser.add_argument("--pdf", action="store_true", help="write the figures as PDF too")
    parser.add_argument("--json", action="store_true", help="write summary.json to stdout too")
    options.add_field(parser)
    options.add_set(parser, "change one setting, such as fit.loss=mean; may be repeated")
    options.add_settings(parser)
    options.add_readout(parser)
    add_finder(parser)
    options.add_physics(parser)
    options.add_run(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the study."""
    from cgemit.study.paper.run import reproduce

    settings, readout = options.settings_and_readout(arguments, one_track=True)
    with options.progress_bar(arguments, "study") as progress:
        study = reproduce(
            arguments.output, events=arguments.events, seed=arguments.seed, threads=arguments.threads,
            quick=arguments.quick, pdf=arguments.pdf, settings=settings, readout=readout, field=arguments.field,
            finder=arguments.finder or "truth", overwrite=arguments.overwrite, command=arguments.line,
            progress=progress,
        )  # fmt: skip
    options.say(json.dumps(study.summary(), indent=2) if arguments.json else study)
    options.note(arguments, f"report: {study.folder}/report.html")
    return 0
