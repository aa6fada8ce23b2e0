"""`cgemit resolution`: resolutions of a detector against kinematics or a key of the design."""

from __future__ import annotations

import argparse
import json
import math
from typing import TYPE_CHECKING, Any

from cgemit.cli import options
from cgemit.cli.simulate import add_finder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cgemit.chain.settings import Settings
    from cgemit.detector import Detector
    from cgemit.study.scan import AnalyticScan, Scan


DESCRIPTION = """\
Resolutions sigma(d_rho), sigma(d_z) and sigma(p) of one or several detectors against momentum, angle, or any key of the
design (--against): points from simulated and fitted tracks, lines from the covariance of the fit without events, or
both. A table for each detector and the fits of the usual forms (with three momenta or more) go to stdout; the folder
gets resolution.csv, summary.json, the detectors as TOML, and the curves of all detectors in one picture as PNG and PDF,
also of sigma(p)/p, sigma(pT)/pT, pT, phi0, theta and tan(lambda). Several detectors see the same particles: differences
to the first have paired errors."""

EXAMPLES = """\
Of momenta and angles, A,B,C and A:B:COUNT (both ends included) have a row for each value: one option may be such a
list. A:B is a uniform range, over which the tracks of a row are mixed. In GeV/c, rad and mm unless a unit is given.

examples:
  cgemit resolution -d besiii-cgem-design --p 0.2:2.0:10 -o curves
  cgemit resolution -d besiii-cgem-design --set cgem.L1.drift_gap="3 mm" --name thin-gap --p 0.2:2.0:10 -o thin
  cgemit resolution -d besiii-cgem-design -d thin/detector.toml -d besiii-idc --p 0.2:2.0:10 -o compared
  cgemit resolution -d besiii-cgem-design -d besiii-idc --method both --cos-theta 0 --p 0.2:2.0:10 -o lines
  cgemit resolution -d besiii-cgem --particle pi+ --particle K+ --pt 0.2:1.0:5 --theta "60 deg" -o hadrons
  cgemit resolution -d besiii-cgem --method both --p 1 --against "theta=20 deg:160 deg:15" -o angles
  cgemit resolution -d besiii-cgem-design --method analytic --p 1 --against "cgem.*.pitch_x=300 um:900 um:7" -o pitches
  cgemit resolution -d besiii-cgem --set fit.loss=mean --p 0.2:2.0:10 -o mean-loss
  cgemit resolution -d besiii-cgem --method analytic --map --p 0.2:3:15 --cos-theta -0.9:0.9:25 -o maps
  cgemit resolution -d besiii-cgem --method analytic --budget dr --budget p --p 0.2:3:15 --cos-theta 0 -o budget
  cgemit resolution -d besiii-cgem --method analytic --budget dz --sensitivity --p 1 --theta "30 deg:90 deg:7" -o why
  cgemit resolution -d besiii-idc --particle pi+ --p 1 --cos-theta -0.8:0.8 --events 20000 -o pions --json"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_detector(parser, several=True)
    parser.add_argument(
        "--particle", action="append", metavar="PARTICLE",
        help="PDG name or number (default mu-); repeat it to compare particles",
    )  # fmt: skip
    momentum = parser.add_mutually_exclusive_group()
    momentum.add_argument("--p", type=options.momenta, metavar="VALUES", help="momenta, GeV/c (with --against: 1)")
    momentum.add_argument("--pt", type=options.momenta, metavar="VALUES", help="transverse momenta, GeV/c")
    polar = parser.add_mutually_exclusive_group()
    polar.add_argument(
        "--cos-theta", type=options.cosines, metavar="VALUES",
        help="cosine of the polar angle (default: the range -0.93:0.93)",
    )  # fmt: skip
    polar.add_argument("--theta", type=options.angles, metavar="VALUES", help="polar angle, rad")
    polar.add_argument("--eta", type=options.cosines, metavar="VALUES", help="pseudorapidity")
    parser.add_argument("--phi", type=options.angles, metavar="VALUES", help="azimuth, rad (default: all)")
    parser.add_argument(
        "--d", type=options.lengths, metavar="VALUES",
        help="tracks begin at x = d, mm (default 0); not by the analytic method",
    )  # fmt: skip
    parser.add_argument(
        "--against", metavar="AXIS[=VALUES]",
        help="what rows and the axis of the pictures go through: p, pt, cos_theta, theta, eta, phi or d, or a key of "
        "the detector with its values, KEY=A,B,C or KEY=A:B:COUNT (default: the option that is a list, else p or pt)",
    )  # fmt: skip
    parser.add_argument(
        "-n", "--events", type=options.positive, default=5000, metavar="N",
        help="in each row (default 5000); not used by the analytic method",
    )  # fmt: skip
    parser.add_argument(
        "--method", choices=("mc", "analytic", "both"), default="mc",
        help="mc: points from simulated events (default); analytic: lines through at least 60 points between the "
        "first and the last value, without events; both: lines and points",
    )  # fmt: skip
    parser.add_argument(
        "--map", action="store_true",
        help="with --method analytic and lists of momenta and of cos(theta): draw the resolutions over both (map.png), "
        "and write map.csv, instead of curves",
    )  # fmt: skip
    parser.add_argument(
        "--budget", action="append", metavar="QUANTITY",
        help="with --method analytic: what the variance of p, pt, dr, dz, phi0, theta ... is made of, instead of "
        "curves (budget_QUANTITY.csv and .png), against the list of momenta or of angles; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--sensitivity", action="store_true",
        help="with --method analytic: what 1 %% more of each number of the design does to the resolutions, instead of "
        "curves (sensitivity.csv and .png)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="write summary.json to stdout instead of the table")
    options.add_output(parser, required=True)
    options.add_hypothesis(parser)
    options.add_readout(parser)
    add_finder(parser, more=" with the mass of the particle (--set find.hypothesis=pi: of another)")
    options.add_physics(parser)
    options.add_run(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the scan."""
    from cgemit.base.files import check_free
    from cgemit.study.scan import save_scans, summary_of

    check_free(arguments.output, overwrite=arguments.overwrite)
    against = _against(arguments)
    if arguments.d is not None and arguments.method != "mc":
        raise options.InputError(f"--d: got --method {arguments.method}; expected mc")
    if arguments.p is None and arguments.pt is None and against is None:
        raise options.InputError("got no --p or --pt; expected one of them, or --against AXIS=VALUES")
    detectors, settings = options.load_inputs(arguments, _guns, one_track=True)
    if arguments.map or arguments.budget or arguments.sensitivity:
        return _expected(arguments, detectors, settings, against)
    points, lines = _scans(arguments, detectors, settings, against)
    scans: list[Scan | AnalyticScan] = [*points, *lines]
    if failed := [f"{scan.detector.name}: {scan.note()}" for scan in scans if scan.empty()]:
        raise options.RunFailedError("\n".join(failed))
    save_scans(scans, arguments.output, overwrite=arguments.overwrite, command=arguments.line)
    options.say(json.dumps(summary_of(scans), indent=2) if arguments.json else _text(points, lines))
    for scan in scans:
        if momenta := _unmeasured(scan):
            options.warn_unmeasured(scan.detector, momenta)
    options.note(arguments, f"curves: {arguments.output}/resolution.png")
    return 0


def _against(arguments: argparse.Namespace) -> str | dict[str, list[Any]] | None:
    """Return what rows go through, as of `scan`, and set the option that `--against` gives the values of."""
    from cgemit.analysis.quantities import KINEMATICS
    from cgemit.study.evaluation import MOMENTA, POLAR

    if arguments.against is None:
        return None
    name, equals, text = (part.strip() for part in str(arguments.against).partition("="))
    known = name.replace("-", "_")
    option = f"--{known.replace('_', '-')}"
    if known not in KINEMATICS:
        if not equals or not text:
            expected = f"one of {', '.join(KINEMATICS)}, or KEY=VALUES of the detector"
            raise options.InputError(f"--against: got {arguments.against!r}; expected {expected}")
    elif equals:
        same = next((kind for kind in (MOMENTA, POLAR) if known in kind), (known,))
        for other in [one for one in same if getattr(arguments, one) is not None]:
            raise options.InputError(f"--against, --{other.replace('_', '-')}: got both; expected one of them")
    if equals:
        try:
            if known not in KINEMATICS:
                return {name: options.values_of_key(text)}
            setattr(arguments, known, _READ[known](text))
        except argparse.ArgumentTypeError as error:
            raise options.InputError(f"--against: {name}: {error}") from None
    elif getattr(arguments, known) is None:
        raise options.InputError(f"--against: got {name} alone; expected {name}=VALUES, or {option} VALUES beside it")
    return known


#: How values of `--against` are read.
_READ = {
    "p": options.momenta, "pt": options.momenta, "cos_theta": options.cosines, "theta": options.angles,
    "eta": options.cosines, "phi": options.angles, "d": options.lengths,
}  # fmt: skip


def _expected(arguments: argparse.Namespace, detectors: Sequence[Detector], settings: Settings, against: Any) -> int:
    """Draw maps, budgets and sensitivities of the resolutions of a detector, and write their numbers."""
    import numpy as np

    from cgemit.base.files import new_folder
    from cgemit.chain.record import record, write_about
    from cgemit.covariance.analytic import analytic
    from cgemit.covariance.sensitivity import sensitivity
    from cgemit.draw.design import draw_budget, draw_budgets, draw_maps, draw_sensitivity
    from cgemit.tables.show import write_csv

    shot = _shot(arguments, detectors, against)
    (detector,), particle = detectors, (arguments.particle or ["mu-"])[0]
    how = {"reveal_sides": settings.digitize.reveal_sides, "fit": settings.fit, "threads": arguments.threads}
    resolution = analytic(detector, particle, **shot, **how)
    if not resolution.reached.any():
        raise options.RunFailedError(f"{detector.name}: no track at any point has a covariance")
    budgets = {name: resolution.budget(name) for name in dict.fromkeys(arguments.budget or [])}
    effects = sensitivity(detector, particle, **shot, **how) if arguments.sensitivity else None
    given = {name: np.ravel(value).tolist() for name, value in shot.items() if value is not None}
    source = {"particle": str(particle), **given, "method": "analytic"}
    entries = record(
        detectors={"detector": detector}, settings=settings, seed=arguments.seed, source=source, command=arguments.line
    )
    with new_folder(arguments.output, overwrite=arguments.overwrite) as temporary:
        if arguments.map:
            columns = {_header(name): column.tolist() for name, column in resolution.table().items()}
            write_csv(temporary / "map.csv", columns)
            draw_maps(resolution).save(temporary / "map")
        for name, budget in budgets.items():
            write_csv(temporary / f"budget_{name}.csv", budget.columns())
            drawn = draw_budget(budget) if budget.p.size > 1 else draw_budgets({detector.name: budget})
            drawn.save(temporary / f"budget_{name}")
        if effects is not None:
            columns = {_header(name): column.tolist() for name, column in effects.table().items()}
            write_csv(temporary / "sensitivity.csv", columns)
            draw_sensitivity(effects).save(temporary / "sensitivity")
        write_about(temporary, {"detector": detector}, entries)
    shown = [resolution] if arguments.map else []
    options.say("\n\n".join(map(str, [*shown, *budgets.values(), *([effects] if effects is not None else [])])))
    made = ["map"] if arguments.map else []
    made += [f"budget_{name}" for name in budgets] + (["sensitivity"] if effects is not None else [])
    options.note(arguments, f"pictures: {', '.join(f'{arguments.output}/{name}.png' for name in made)}")
    return 0


def _shot(arguments: argparse.Namespace, detectors: Sequence[Detector], against: Any) -> dict[str, Any]:
    """Return the momenta and angles of `analytic` for maps, budgets and sensitivities; a list means points."""
    import numpy as np

    asked = [f"--{name}" for name in ("map", "budget", "sensitivity") if getattr(arguments, name)]
    momentum = "p" if arguments.pt is None else "pt"
    angle = next((name for name in ("theta", "eta") if getattr(arguments, name) is not None), "cos_theta")
    momenta, angles = getattr(arguments, momentum), getattr(arguments, angle)
    momenta = 1.0 if momenta is None else momenta
    momenta = momenta if isinstance(momenta, list | tuple) else [momenta]
    problems = [f"--{name}: {asked[0]} has none" for name in ("phi", "d") if getattr(arguments, name) is not None]
    if isinstance(against, dict):
        problems.append(f"--against: {asked[0]} expects momenta or angles")
    if arguments.map:
        problems += [
            f"{name}: got {value}; --map expects two values or more, as A,B,C or A:B:COUNT"
            for name, value in {"--p": arguments.p and momenta, "--cos-theta": arguments.cos_theta}.items()
            if not isinstance(value, list) or len(set(value)) < 2
        ]
    elif isinstance(angles, list) and len(set(angles)) > 1 and isinstance(momenta, list) and len(set(momenta)) > 1:
        expected = f"{' and '.join(asked)} expects several momenta or several angles, not both"
        problems.append(f"--{momentum}, --{angle.replace('_', '-')}: got lists; {expected}")
    if arguments.map and len(asked) > 1:
        problems.append(f"{' and '.join(asked)}: got both; expected one of them beside --map")
    problems += [f"--method: {asked[0]} expects analytic"] if arguments.method != "analytic" else []
    problems += [f"-d: {asked[0]} expects one detector"] if len(detectors) > 1 else []
    problems += [f"--particle: {asked[0]} expects one particle"] if len(arguments.particle or []) > 1 else []
    problems += [f"--json: {asked[0]} has no summary"] if arguments.json else []
    if problems:
        raise options.InputError("\n".join(problems))
    p = np.unique(momenta) if isinstance(momenta, list) else momenta
    angles = (-0.93, 0.93) if angles is None else angles
    angles = np.unique(angles) if isinstance(angles, list) else angles
    return {"p": None, "cos_theta": None} | {momentum: np.reshape(p, (-1, 1)) if arguments.map else p, angle: angles}


def _header(name: str) -> str:
    """Return the name of a column of a covariance's table with its unit."""
    from cgemit.analysis.quantities import QUANTITIES

    if name.startswith("dln_sigma_"):
        return f"{name} (% per %)"
    kind, _, quantity = name.partition("_")
    if quantity in QUANTITIES and kind in ("sigma", "rms"):
        return QUANTITIES[quantity].column(kind)
    return {"p": "p (GeV/c)", "phi": "phi (rad)", "radius": "radius (mm)"}.get(name, name)


def _unmeasured(scan: Scan | AnalyticScan) -> str:
    """Return the momenta asked for that are not measured: expected, or of most tracks."""
    from cgemit.study.scan import AnalyticScan

    if isinstance(scan, AnalyticScan):
        lost = [math.isnan(p) and not math.isnan(dr) for p, dr in zip(scan.at("p"), scan.at("dr"), strict=True)]
    else:
        lost = [options.mostly_unconstrained(one.tracks) for one in scan.samples]
    rows = [number for number, one in enumerate(lost) if one]
    return scan.against.at(rows) if rows else ""


def _guns(arguments: argparse.Namespace) -> None:
    """Raise an error if particle, momenta or angles are wrong."""
    from cgemit.particles.gun import Gun

    given = {name: getattr(arguments, name) for name in ("p", "pt", "cos_theta", "theta", "eta", "phi")}
    given = {name: value for name, value in given.items() if value is not None}
    if not given.keys() & {"p", "pt"}:
        given["p"] = 1.0
    if not given.keys() & {"cos_theta", "theta", "eta"}:
        given["cos_theta"] = 0.0
    for particle in arguments.particle or ["mu-"]:
        Gun(particle, **given)


def _scans(
    arguments: argparse.Namespace, detectors: Sequence[Detector], settings: Settings, against: Any
) -> tuple[list[Scan], list[AnalyticScan]]:
    """Return the scans of all detectors by simulation and by the covariance, as far as they are asked for."""
    from cgemit.study.scan import scan_analytic, scan_detectors

    names = ("p", "pt", "cos_theta", "theta", "eta", "phi", "seed", "threads")
    how = {name: getattr(arguments, name) for name in names} | {"settings": settings, "against": against}
    particles = arguments.particle or ["mu-"]
    points: list[Scan] = []
    lines: list[AnalyticScan] = []
    with options.progress_bar(arguments, "resolution") as progress:
        if arguments.method != "mc":  # first, since it is quick to find what is wrong
            lines = [scan_analytic(one, particle=particle, **how) for particle in particles for one in detectors]
        if arguments.method != "analytic":
            how |= {"events": arguments.events, "finder": arguments.finder or "truth", "d": arguments.d}
            points = scan_detectors(detectors, particles, progress=progress, **how)
    return points, lines


def _text(points: Sequence[Scan], lines: Sequence[AnalyticScan]) -> str:
    """Return a table and the fits of each detector and particle, and the differences to the first detector."""
    from cgemit.study.scan import base_of, compared, fits_text

    if points and lines:
        pairs = list(zip(points, lines, strict=True))
        parts = [[compared(*pair), fits_text(pair)] for pair in pairs]
    else:
        parts = [[str(scan), fits_text([scan])] for scan in points or lines]
    bases = [(scan, base_of(scan, points)) for scan in points]
    parts += [[str(scan.minus(base))] for scan, base in bases if base]
    return "\n\n".join("\n".join(filter(None, part)) for part in parts)
