"""`cgemit monitor`: a page of a run of the experiment, or of a stored run."""

from __future__ import annotations

import argparse

from cgemit.cli import options

DESCRIPTION = """\
Write a page of a run: strips that fire, hot and dead ones, times and charges, residuals of X, V and drift distances
from tracks fitted without the hit, efficiencies of layers and their regions, Lorentz angles and tracks. FILE is a
.raw, .rec or .rtraw file of BESIII (pybes3, extra [bes3]), which is reconstructed as `cgemit reconstruct` does, or the
folder of a run. The folder receives index.html, its pictures and monitor.json with all numbers. No truth is used."""

EXAMPLES = """\
Numbers that the events do not tell, such as a width of one hit or a dead strip in ten events, are left out.

examples:
  cgemit monitor run.raw -d besiii-cgem --field besiii --readout tiger -o page
  cgemit monitor run -o page"""


#: Options that say how a file is reconstructed.
_OF_FILES = {"detector": "detector", "set": "overrides"} | {
    name: name for name in ("settings", "field", "name", "readout", "points", "hypothesis")
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_events(parser, or_folder=True)
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    options.add_output(parser, "folder for index.html, pictures, monitor.json", required=True)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read or reconstruct, count, draw and write."""
    import json
    from pathlib import Path

    from cgemit.base.files import check_free, new_folder
    from cgemit.bes3.events import read_events
    from cgemit.bes3.reconstruct import reconstruct_events
    from cgemit.chain.result import open as open_run
    from cgemit.study.monitor import monitor
    from cgemit.tables.schema import is_fitted

    check_free(arguments.output, overwrite=arguments.overwrite)
    path = Path(arguments.file)
    if path.is_dir():
        flags = [f"--{name}" for name, of in _OF_FILES.items() if getattr(arguments, of)]
        if flags:
            raise options.InputError(
                f"{', '.join(flags)}: got the folder of a run, which has its own; expected a .raw, .rec or .rtraw file"
            )
        result = open_run(path)
        title = f"{path.name}: {result.n_events} events, {result.detector.name}"
    else:
        if not arguments.detector:
            raise options.InputError(f"--detector: got none for {path.name}; expected one with the layers of its hits")
        (detector,), settings = options.load_inputs(arguments, one_track=True)
        events = read_events(path, detector)
        result = reconstruct_events(events, settings, points=arguments.points)
        runs = ", ".join(str(one) for one in sorted({int(one) for one in events.run}))
        title = f"{path.name}: run {runs}, {result.n_events} events, {detector.name}"
    if result.tracks is None or not is_fitted(result.tracks).any():
        raise options.RunFailedError("no track was found and fitted")
    page = monitor(result)
    with new_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        page.write(folder, title)
    options.say(json.dumps(page.to_dict(), indent=2, allow_nan=False) if arguments.json else f"{title}\n\n{page!r}")
    options.note(arguments, f"page and pictures: {arguments.output}")
    return options.OK
