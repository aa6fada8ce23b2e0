"""`cgemit simulate`: run the chain and write its tables."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING, Any

from cgemit.cli import changes, common, read
from cgemit.version import VERSION

if TYPE_CHECKING:
    from cgemit.gun import Gun
    from cgemit.result import Result

_DESCRIPTION = """\
Shoot particles through a detector and write the tables of the chain: particles, truths, steps, wire_truths, digis,
wire_hits, clusters, with --fit tracks, and with --states also states. One .npz file a table (numpy.load, or
cgemit.Table.load), tables.json, detector.toml, summary.json, and run.json, which holds everything that the tables
depend on. cgemit.Result.load(DIR) reads it all back."""

_EXAMPLES = """\
A quantity is a number (fixed), A:B (uniform range), A:B:N (N values from A to B in turn) or A,B,C (values in turn);
momenta in GeV/c, angles in rad, lengths in mm unless a unit is given, as in "500 MeV/c" or "30 deg".

examples:
  cgemit simulate -d besiii-cgem-design --particle mu- --p 1 --cos-theta -0.93:0.93 -n 10000 --fit -o muons
  cgemit simulate -d besiii-cgem --particle pi+ --pt 0.1:0.5 --theta "30 deg:150 deg" -n 1000 -o pions
  cgemit simulate -d my-detector.toml --particle K- --p 0.3,0.5,1 --cos-theta 0 --vertex 1,0,0 -n 300 -o kaons
  cgemit simulate -d besiii-cgem --particle pi+ --p 0.5 --cos-theta 0 -n 100 --states beam_pipe,hits,"90 cm" -o states
  cgemit simulate -d besiii-cgem --set cgem.L1.drift_gap="3 mm" --name thin --p 1 --cos-theta 0 -n 1000 -o thin
  cgemit simulate -d besiii-cgem --settings mine.toml --set fit.loss=mean --p 1 --cos-theta 0 -n 1000 -o mine
  cgemit simulate -d besiii-cgem --field my-map.npz --p 1 --cos-theta 0 -n 1000 -o mapped"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    parser = subparsers.add_parser(
        "simulate", help="shoot particles and write hits, clusters and tracks as tables", description=_DESCRIPTION,
        epilog=_EXAMPLES, formatter_class=common.HelpFormatter,
    )  # fmt: skip
    common.add_detector(parser)
    add_gun(parser)
    parser.add_argument("-n", "--events", type=read.positive, required=True, metavar="N", help="number of events")
    parser.add_argument(
        "--fit",
        action="store_true",
        help="fit too: candidates, tracks and their matches with particles (so do --states, --hypothesis, --set fit.*)",
    )
    parser.add_argument(
        "--states", type=read.surfaces, metavar="SURFACE,...",
        help="also write the states of the fitted tracks: radii (mm), origin, beam_line, beam_pipe, hits",
    )  # fmt: skip
    changes.add_hypothesis(parser, several=True)
    parser.add_argument("--json", action="store_true", help="write the summary to stdout as JSON")
    common.add_output(parser)
    changes.add_readout(parser)
    changes.add_physics(parser)
    common.add_run(parser)
    common.add_common(parser)
    parser.set_defaults(run=run)


def add_gun(parser: argparse.ArgumentParser) -> None:
    """Add the options of the gun."""
    gun = parser.add_argument_group("gun")
    gun.add_argument("--particle", default="mu-", help="PDG name or number (default mu-)")
    momentum = gun.add_mutually_exclusive_group(required=True)
    momentum.add_argument("--p", type=read.momenta, metavar="VALUES", help="momentum, GeV/c")
    momentum.add_argument("--pt", type=read.momenta, metavar="VALUES", help="transverse momentum, GeV/c")
    polar = gun.add_mutually_exclusive_group(required=True)
    polar.add_argument("--theta", type=read.angles, metavar="VALUES", help="polar angle, rad")
    polar.add_argument("--cos-theta", type=read.cosines, metavar="VALUES", help="its cosine")
    gun.add_argument("--phi", type=read.angles, metavar="VALUES", help="azimuth, rad (default: uniform)")
    gun.add_argument("--vertex", type=read.triple, metavar="X,Y,Z", help="vertex, mm (default 0,0,0)")
    gun.add_argument(
        "--vertex-sigma", type=read.triple, metavar="X,Y,Z", help="its Gaussian spread, mm (default 0,0,0)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the chain and write its tables."""
    from cgemit import chain
    from cgemit.gun import Gun
    from cgemit.io.folders import SUMMARY, new_folder

    (detector,), settings = common.load_inputs(arguments)
    names = ("particle", "p", "pt", "theta", "cos_theta", "phi", "vertex", "vertex_sigma")
    given = {name: getattr(arguments, name) for name in names}
    gun = Gun(**{name: value for name, value in given.items() if value is not None})
    fits = _fits(arguments)
    with new_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        with common.Progress("simulate", quiet=arguments.quiet) as progress:
            result = chain.run(
                detector, gun, arguments.events, arguments.seed, settings=settings,
                until="fit" if fits else "cluster", threads=arguments.threads, progress=progress,
            )  # fmt: skip
        result.save(folder, command=arguments.line)
        summary = _summary(result, gun)
        (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    print(json.dumps(summary, indent=2) if arguments.json else result)
    if not arguments.quiet:
        rest = "" if fits else " (nothing was fitted: --fit does)"
        print(f"tables: {arguments.output}{rest}", file=sys.stderr)
    return 0


def _fits(arguments: argparse.Namespace) -> bool:
    """Tell whether the command line asks for fitted tracks, by `--fit` or something that only the fit can give."""
    asked = (arguments.fit, arguments.states is not None, arguments.hypothesis is not None)
    return any(asked) or any(text.strip().startswith("fit.") for text in arguments.overrides)


def _summary(result: Result, gun: Gun) -> dict[str, Any]:
    """Return what people want to see first; run.json holds everything that the results depend on."""
    summary = {
        "version": VERSION, "detector": result.detector.name, "gun": repr(gun), "events": result.particles.n_events,
        "seed": result.seed, "settings": result.settings.to_dict(), "transport": result.transport(),
        "rows": {name: len(table) for name, table in result.tables.items()},
    }  # fmt: skip
    return summary | ({"removed": result.removed()} if "tracks" in result.tables else {})
