"""`cgemit slab`: scattering and energy loss in layers of matter."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from cgemit.cli import options
from cgemit.simulation.slab import FEWEST, MOST

if TYPE_CHECKING:
    from cgemit.simulation.slab import SlabResult


DESCRIPTION = """\
Send particles through plane layers of matter and print X/X0, scattering angles and energy losses: simulated ones with
their statistical errors, and those of Highland's formula, of the track fit and of Bethe's formula.

MATTER is a list of layers with "+" between them, each a material and a thickness:
  "Kapton 300 um + Cu 33 um"   materials of detector files (such as CarbonFiber, Epoxy, CgemGas), element symbols
  "He/C3H8 60/40 16 mm"        gases at 20 C and 1 atm, with fractions by volume in %; without them He/C3H8 is 60/40 and
                               Ar/iC4H10 90/10, as in detector files, and other mixtures have equal parts
  "C 2.0 g/cm3 213.5 um"       a density, where it is not the usual one; a compound such as "CH2 0.94 g/cm3 1 mm" needs
                               one unless it is a gas

Plane angles, of both planes together: half width of the central 68.27 % (q68), of 98 % over 2.326 (q98) and of 99.9 %
over 3.291 (q999); for a Gaussian all three are its width. A particle with less than 0.1 MeV of kinetic energy
counts as stopped. Formulas give no angle above 1 rad ("-")."""

EXAMPLES = """\
examples:
  cgemit slab "Kapton 300 um + Cu 33 um" --particle pi- --p 0.5 -n 200000
  cgemit slab "He/C3H8 16 mm" --p "200 MeV/c" --screening moliere --json
  cgemit slab "Be 1.4 mm" --particle K+ --p 0.3 -o beryllium      pictures of both distributions in ./beryllium"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("matter", metavar="MATTER", help='layers, such as "Kapton 300 um + Cu 33 um"')
    parser.add_argument("--particle", default="mu-", help="PDG name or number (default mu-)")
    parser.add_argument("--p", default=1.0, metavar="P", help="momentum, GeV/c unless a unit is given (default 1)")
    parser.add_argument(
        "-n", "--n", type=_particles, default=200_000, metavar="N",
        help=f"number of particles, {FEWEST} to {MOST} (default 200000)",
    )  # fmt: skip
    parser.add_argument(
        "--screening", default="wentzel", metavar="NAME",
        help="screening of nuclei in multiple scattering: wentzel (default) or moliere",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON instead of tables")
    options.add_output(parser, "folder for slab.png and slab.pdf, and summary.json")
    options.add_seed(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Send the particles, print and draw."""
    from cgemit.base.files import check_free
    from cgemit.simulation.slab import slab

    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    with options.progress_bar(arguments, "slab") as progress:
        result = slab(
            arguments.matter, arguments.particle, arguments.p, arguments.n, arguments.seed, arguments.screening,
            progress=progress,
        )  # fmt: skip
    numbers = json.dumps(result.to_dict(), indent=2, ensure_ascii=False, allow_nan=False)
    if arguments.output:
        _write(result, numbers, arguments.output, overwrite=arguments.overwrite)
    options.say(numbers if arguments.json else result)
    if arguments.output:
        options.note(arguments, f"picture: {arguments.output}/slab.png")
    return options.OK


def _write(result: SlabResult, numbers: str, folder: str, *, overwrite: bool) -> None:
    from cgemit.base.files import SUMMARY, new_folder
    from cgemit.draw.slab import draw_slab

    with new_folder(folder, overwrite=overwrite) as temporary:
        draw_slab(result).save(temporary / "slab")
        (temporary / SUMMARY).write_text(numbers + "\n", encoding="utf-8")


def _particles(text: str) -> int:
    return options.whole(text, FEWEST, MOST)
