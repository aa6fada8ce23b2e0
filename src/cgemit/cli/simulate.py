"""`cgemit simulate`: run the chain and write its tables."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgemit.base.version import __version__
from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.chain.result import Result
    from cgemit.particles.gun import Source


DESCRIPTION = """\
Shoot particles through a detector and write the tables of the chain: particles, truths, steps, wire_truths, digis,
wire_hits, clusters, with --fit tracks, and with --states also states. One file a table (.npz: numpy.load, or
cgemit.Table.load), tables.json, detector.toml, summary.json, and run.json, which holds everything that the tables
depend on. cgemit.Result.load(DIR) reads it all back. With --keep the tables are written in parts while the run goes
on, so that the memory does not depend on the number of events; cgemit.open(DIR) reads them as they are needed."""

EXAMPLES = """\
A quantity is a number (fixed), A:B (uniform range), A:B:N (N values from A to B in turn) or A,B,C (values in turn);
momenta in GeV/c, angles in rad, lengths in mm unless a unit is given, as in "500 MeV/c" or "30 deg".

examples:
  cgemit simulate -d besiii-cgem-design --particle mu- --p 1 --cos-theta -0.93:0.93 -n 10000 --fit -o muons
  cgemit simulate -d besiii-cgem --particle pi+ --pt 0.1:0.5 --theta "30 deg:150 deg" -n 1000 -o pions
  cgemit simulate -d my-detector.toml --particle K- --p 0.3,0.5,1 --cos-theta 0 --vertex 1,0,0 -n 300 -o kaons
  cgemit simulate -d besiii-cgem --particle pi+ --p 0.5 --cos-theta 0 -n 100 --states beam_pipe,hits,"90 cm" -o states
  cgemit simulate -d besiii-cgem --set cgem.L1.drift_gap="3 mm" --name thin --p 1 --cos-theta 0 -n 1000 -o thin
  cgemit simulate -d besiii-cgem --settings mine.toml --set fit.loss=mean --p 1 --cos-theta 0 -n 1000 -o mine
  cgemit simulate -d besiii-cgem --field my-map.npz --p 1 --cos-theta 0 -n 1000 -o mapped
  cgemit simulate -d besiii-cgem --p 1 --cos-theta -0.93:0.93 -n 1e7 --keep tracks --format parquet -o many
  cgemit simulate -d besiii-cgem --particles events.hepmc --fit -o generated
  cgemit simulate -d besiii-cgem --sample jpsi-rhopi -n 1000 --finder ckf -o rhopi"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    from cgemit.tables.formats import FORMATS

    options.add_detector(parser)
    add_gun(parser, files=True)
    parser.add_argument(
        "-n",
        "--events",
        type=options.positive,
        metavar="N",
        help="number of events (with --particles: those of the file)",
    )
    parser.add_argument(
        "--fit",
        action="store_true",
        help="fit too: candidates, tracks and their matches with particles "
        "(so do --finder, --states, --hypothesis, --set fit.*, --set find.*)",
    )
    add_finder(parser, more="; implies --fit")
    parser.add_argument(
        "--states", type=options.surfaces, metavar="SURFACE,...",
        help="also write the states of the fitted tracks: radii (mm), origin, beam_line, beam_pipe, hits",
    )  # fmt: skip
    options.add_hypothesis(parser, several=True)
    parser.add_argument("--json", action="store_true", help="write the summary to stdout as JSON")
    options.add_output(parser, required=True)
    parser.add_argument(
        "--format",
        choices=tuple(FORMATS),
        default="npz",
        help="of the tables' files (default npz); root: a TTree a file",
    )
    parser.add_argument(
        "--keep", type=options.names, metavar="TABLE,...",
        help="write only these tables (all: every one; tracks: with their matches), in parts while the run goes on, "
        "without holding them in memory",
    )  # fmt: skip
    options.add_readout(parser)
    options.add_physics(parser)
    options.add_run(parser)
    options.add_common(parser)


def add_finder(parser: argparse.ArgumentParser, *, default: str | None = None, more: str = "") -> None:
    """Add the option of the finder, with `more` help; without a default the commands take truth."""
    from cgemit.chain.finders import FINDERS

    names = (f"{name} (default)" if name == (default or "truth") else name for name in FINDERS)
    parser.add_argument(
        "--finder", metavar="NAME", default=default,
        help=f"assigns the hits to tracks: {', '.join(names)}; all but truth see measurements only{more}",
    )  # fmt: skip


def add_gun(parser: argparse.ArgumentParser, *, files: bool = False) -> None:
    """Add the options of the gun, and with `files` that of a file of particles."""
    gun = parser.add_argument_group("gun")
    gun.add_argument(
        "--sample", metavar="NAME",
        help="events of a sample instead of a gun: jpsi-rhopi, pipi-jpsi, d0-d0bar, ks-pipi, lambda-ppi, slow-pions, "
        "cosmic, beam-gas, touschek or electrons; of the options below, those that it has",
    )  # fmt: skip
    gun.add_argument("--particle", help="PDG name or number (default mu-)")
    momentum = gun.add_mutually_exclusive_group()
    momentum.add_argument("--p", type=options.momenta, metavar="VALUES", help="momentum, GeV/c")
    momentum.add_argument("--pt", type=options.momenta, metavar="VALUES", help="transverse momentum, GeV/c")
    polar = gun.add_mutually_exclusive_group()
    polar.add_argument("--theta", type=options.angles, metavar="VALUES", help="polar angle, rad")
    polar.add_argument("--cos-theta", type=options.cosines, metavar="VALUES", help="its cosine")
    polar.add_argument("--eta", type=options.cosines, metavar="VALUES", help="pseudorapidity")
    gun.add_argument("--phi", type=options.angles, metavar="VALUES", help="azimuth, rad (default: uniform)")
    gun.add_argument("--vertex", type=options.triple, metavar="X,Y,Z", help="vertex, mm (default 0,0,0)")
    gun.add_argument(
        "--vertex-sigma",
        type=options.triple,
        metavar="X,Y,Z",
        help="its Gaussian spread, the same for all particles of an event, mm (default 0,0,0)",
    )
    if not files:
        return
    gun.add_argument(
        "--particles",
        metavar="FILE",
        help="particles of a generator instead of the gun: HepMC (.hepmc, .hepmc.gz; needs pyhepmc; .root), EDM4hep "
        "(.root) or a table of particles (.csv, .npz, .parquet, .root)",
    )
    gun.add_argument(
        "--charges", type=options.charges, metavar="PDG=CHARGE,...",
        help="charges (e) of particles of the file whose PDG number tells none",
    )  # fmt: skip


_GUN = ("particle", "p", "pt", "theta", "cos_theta", "eta", "phi", "vertex", "vertex_sigma")


def gun_of(arguments: argparse.Namespace, *required: tuple[str, object]) -> Source:
    """Return the gun, or the sample, of the options.

    Parameters
    ----------
    arguments : Namespace
    *required : (str, object)
        Further options that must be given beside the gun's, and their values.

    Raises
    ------
    InputError
        Listing every option that is missing.
    """
    from cgemit.particles.gun import Gun
    from cgemit.particles.samples import sample

    options_of_gun = {name: getattr(arguments, name) for name in _GUN if getattr(arguments, name) is not None}
    missing = [name for name, value in required if value is None]
    instead = ""
    if arguments.sample is None:
        instead = f", or{' --particles FILE, or' if hasattr(arguments, 'particles') else ''} --sample NAME"
        for pair in (("--p", "--pt"), ("--theta", "--cos-theta", "--eta")):
            if not any(one[2:].replace("-", "_") in options_of_gun for one in pair):
                missing.append(" or ".join(pair))
    if missing:
        expected = "all of these" if len(missing) > 1 else "one"
        raise options.InputError(f"got no {', no '.join(missing)}; expected {expected}{instead}")
    return (
        Gun(**{"particle": "mu-", **options_of_gun})
        if arguments.sample is None
        else sample(arguments.sample, **options_of_gun)
    )


def _source(arguments: argparse.Namespace) -> Any:
    """Return the gun of the options, or the table of particles of a file.

    Raises
    ------
    InputError
        Listing every option that is missing, or that says the same as another.
    """
    from cgemit.particles.table import read_particles

    if arguments.particles is None:
        if arguments.charges is not None:
            raise options.InputError("--charges: got charges without --particles, expected both")
        return gun_of(arguments, ("-n", arguments.events))
    flags = [name for name in ("sample", *_GUN) if getattr(arguments, name) is not None]
    if flags:
        wrong = ", ".join("--" + name.replace("_", "-") for name in flags)
        raise options.InputError(f"--particles: got {wrong}, too; expected particles of a file or of a gun")
    if not Path(arguments.particles).exists():
        raise options.InputError(f"--particles: got {arguments.particles}, which does not exist; expected a file")
    return read_particles(arguments.particles, charges=arguments.charges)


def run(arguments: argparse.Namespace) -> int:
    """Run the chain and write its tables."""
    from cgemit.base.files import SUMMARY, new_folder
    from cgemit.chain.run import Output
    from cgemit.chain.run import run as run_chain
    from cgemit.tables.formats import check_format

    (detector,), settings = options.load_inputs(arguments, _source)
    gun = _source(arguments)
    fits = _fits(arguments)
    how: dict[str, Any] = {"settings": settings, "until": "fit" if fits else "cluster", "workers": arguments.threads}
    how["finder"] = arguments.finder or "truth"
    check_format(arguments.format)
    with new_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        if arguments.keep is not None:
            keep = None if arguments.keep == ("all",) else arguments.keep
            how |= {"keep": keep, "output": Output(folder, arguments.format, command=arguments.line)}
        with options.progress_bar(arguments, "simulate") as progress:
            result = run_chain(detector, gun, arguments.events, arguments.seed, progress=progress, **how)
        if arguments.keep is None:
            result.save(folder, command=arguments.line, format=arguments.format)
        summary, text = _summary(result), repr(result)
        unmeasured = 2 * result.removed().get("unconstrained", 0) > result.rows.get("tracks", 0)
        (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    options.say(json.dumps(summary, indent=2) if arguments.json else text)
    if unmeasured:
        options.warn_unmeasured(detector, "most of the momenta")
    options.note(arguments, f"tables: {arguments.output}{'' if fits else ' (nothing was fitted: --fit does)'}")
    return 0


def _fits(arguments: argparse.Namespace) -> bool:
    """Tell whether the command line asks for fitted tracks, by `--fit` or something that only the fit can give."""
    from cgemit.chain.settings import TABLES

    fitted = set(TABLES[TABLES.index("candidates") :])
    kept_tables = set(arguments.keep or ()) & fitted
    asked = (
        arguments.fit, arguments.finder is not None, arguments.states is not None, arguments.hypothesis is not None,
        bool(kept_tables),
    )  # fmt: skip
    return any(asked) or any(text.strip().startswith(("fit.", "find.", "refine.")) for text in arguments.overrides)


def _summary(result: Result) -> dict[str, Any]:
    """Return what people want to see first; run.json holds everything that the results depend on."""
    summary = {
        "version": __version__, "detector": result.detector.name, "gun": repr(result.gun), "events": result.n_events,
        "seed": result.seed, "settings": result.settings.to_dict(), "transport": result.transport(),
        "rows": result.rows,
    }  # fmt: skip
    if "tracks" not in result.tables:
        return summary
    return summary | {"mass": result.mass, "removed": result.removed(), "large_chi2": result.large_chi2()}
