"""`cgemit refit`: tracks of the experiment fitted again, beside its own fit."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgemit.base.version import __version__
from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.bes3.refit import Refit


DESCRIPTION = """\
Read the hits of BESIII tracks from a .rec file of the experiment's software (pybes3, extra [bes3]), fit them, and put
the result beside the experiment's own fits of the same hits: MdcKalTrack with matter, MdcTrack without.
With -o also a line for each track (kal.csv, mdc.csv), pictures (kal.png, mdc.png) and summary.json."""

EXAMPLES = """\
The detector needs the layers of the hits: besiii-idc before 2024, besiii-cgem since. The experiment's fits use its
field map, which --field besiii describes.

examples:
  cgemit refit run.rec -d besiii-idc --field besiii
  cgemit refit muons.rec -d besiii-cgem --field besiii --hypothesis mu -o beside
  cgemit refit muons.rec -d besiii-cgem --tracks kal --clusters all
                                         with the clusters of events of one track, which the file gives to no track"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("file", metavar="FILE", help="a .rec file")
    options.add_detector(parser)
    parser.add_argument("--tracks", choices=("kal", "mdc", "both"), default="both", help="whose fit (default both)")
    parser.add_argument(
        "--clusters", choices=("tracks", "all"), default="tracks",
        help="clusters to fit: those of the tracks (default), or in events of one track all of them",
    )  # fmt: skip
    parser.add_argument(
        "--cluster-errors", type=options.length, nargs=2, metavar=("X", "V"),
        help="errors of clusters, which the file does not hold (default 160 um and 150 um)",
    )  # fmt: skip
    options.add_hypothesis(parser)
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    options.add_output(parser, "folder for tables, pictures, summary.json")
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read, fit and compare."""
    from cgemit.base.files import check_free
    from cgemit.bes3.events import CLUSTER_ERRORS, read_events
    from cgemit.bes3.refit import CLUSTER_POSITIONS, KINDS, refit

    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    (detector,), settings = options.load_inputs(arguments)
    errors = CLUSTER_ERRORS if arguments.cluster_errors is None else tuple(arguments.cluster_errors)
    events = read_events(arguments.file, detector, errors=errors, every_cluster=arguments.clusters == "all")
    kinds = KINDS if arguments.tracks == "both" else (arguments.tracks,)
    refits = {kind: refit(events, kind, settings.fit) for kind in kinds}
    report: dict[str, Any] = {
        "version": __version__, "command": arguments.line, "file": str(arguments.file), "detector": detector.name,
        "events": len(events.run), "settings": settings.to_dict(), "clusters": CLUSTER_POSITIONS,
    }  # fmt: skip
    for kind, one in refits.items():
        report[kind] = {"tracks": len(one.ours), "fitted": int(one.good.sum()), **one.summary()}
    text = json.dumps(_without_nan(report), indent=2, allow_nan=False)
    if arguments.output:
        _write(refits, text, arguments.output, overwrite=arguments.overwrite)
    options.say(text if arguments.json else "\n".join([repr(events), *map(repr, refits.values())]))
    if not any(one.good.any() for one in refits.values()):
        raise options.RunFailedError("no track was fitted by both")
    if arguments.output:
        options.note(arguments, f"tables and pictures: {arguments.output}")
    return options.OK


def _without_nan(value: Any) -> Any:
    """Return the same with None for what is not a number, as JSON has none."""
    if isinstance(value, dict):
        return {name: _without_nan(one) for name, one in value.items()}
    return None if value != value else value


def _write(refits: dict[str, Refit], text: str, folder: str, *, overwrite: bool) -> None:
    from cgemit.base.files import SUMMARY, new_folder
    from cgemit.draw.curves import draw_refit
    from cgemit.tables.show import write_csv

    pictures = {kind: draw_refit(one) for kind, one in refits.items() if one.good.any()}
    with new_folder(Path(folder), overwrite=overwrite) as results:
        for kind, one in refits.items():
            write_csv(results / f"{kind}.csv", one.columns, digits=17)
        for kind, picture in pictures.items():
            picture.save(results / kind)
        (results / SUMMARY).write_text(text + "\n", encoding="utf-8")
