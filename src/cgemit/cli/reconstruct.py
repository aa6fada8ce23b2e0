"""`cgemit reconstruct`: events of the experiment from fired cells and strips to tracks."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from cgemit.base.version import __version__
from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.bes3.reconstruct import PointOffset
    from cgemit.chain.result import Result
    from cgemit.tables import Table


DESCRIPTION = """\
Read events of BESIII (.raw of the readout, .rec or .rtraw of its software; pybes3, extra [bes3]), find the start time
of each event, make clusters of the fired strips, and find and fit the tracks of all fired cells and strips, without the
experiment's own reconstruction. The folder receives the tables, which `cgemit.open` reads; tracks, points and residuals
with the experiment's numbers of runs, events, strips and wires, as bes3_tracks.csv, bes3_points.csv, bes3_residuals.csv
(or .parquet, .root); summary.json; and a picture of the event with most clusters on tracks."""

EXAMPLES = """\
The detector needs the layers of the hits: besiii-idc before 2024, besiii-cgem since. Strips with time need an analog
readout, such as tiger.

examples:
  cgemit reconstruct run.raw -d besiii-cgem --field besiii --readout tiger -o run
  cgemit reconstruct run.raw -d besiii-cgem --field besiii --readout tiger --event 3 --event 7 -o run
  cgemit reconstruct run.raw -d besiii-cgem --field besiii --readout tiger --format root -o run
  cgemit reconstruct run.rec -d besiii-idc --field besiii --hypothesis mu -o old"""

#: Columns of tracks that are printed, with their formats.
_COLUMNS = {
    "event": "d", "p": ".3f", "err_p": ".3f", "dr": ".3f", "err_dr": ".3f", "phi0": ".4f", "dz": ".2f",
    "err_dz": ".2f", "tanl": ".4f", "chi2": ".1f", "ndf": "d", "n_clusters": "d", "n_wires": "d",
}  # fmt: skip


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_events(parser)
    parser.add_argument(
        "--event", type=options.event, action="append", metavar="N",
        help="event to draw, counted from 0 in the file; may be repeated (default: that with most clusters on tracks)",
    )  # fmt: skip
    parser.add_argument(
        "--format", choices=("csv", "parquet", "root"), default="csv",
        help="of tracks, points and residuals, and, but for csv, of the other tables (default csv, and npz for those)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    options.add_output(parser, "folder for tables, pictures, summary.json", required=True)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read, reconstruct, write and draw."""
    from cgemit.base.files import SUMMARY, check_free, new_folder
    from cgemit.bes3.events import read_events
    from cgemit.bes3.reconstruct import numbered_tables, point_offsets, reconstruct_events, save_numbered
    from cgemit.draw.display import event
    from cgemit.reconstruction.refine import StartTimeStatus
    from cgemit.tables.formats import check_format
    from cgemit.tables.schema import FitStatus, is_fitted
    from cgemit.tables.show import text_table

    check_free(arguments.output, overwrite=arguments.overwrite)
    form = check_format("npz" if arguments.format == "csv" else arguments.format)
    (detector,), settings = options.load_inputs(arguments, one_track=True)
    events = read_events(arguments.file, detector)
    numbers = _numbers(arguments, len(events.run))
    result = reconstruct_events(events, settings, points=arguments.points)
    offsets = point_offsets(events, result) if result.strip_times is not None else []
    report = _about(result, arguments) | {"run": sorted({int(one) for one in events.run})}
    fired = len(events.wire_digis["event"])
    report["cells"] = {"fired": fired, "outside": fired - len(result.wire_hits)}
    report["points"] = {one.label: _offset(one) for one in offsets}
    text = json.dumps(report, indent=2, allow_nan=False)
    with new_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        result.save(folder, command=arguments.line, format=form)
        save_numbered(numbered_tables(events, result), folder, arguments.format)
        (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
        for number in numbers or [_fullest(result.tracks)]:
            event(result, number).save(folder / f"event-{number}")
    tracks = result.tracks[is_fitted(result.tracks)]
    rows = [[format(tracks[name][i], kind) for name, kind in _COLUMNS.items()] for i in range(len(tracks))]
    for row, status in zip(rows, result.start_times["status"][tracks["event"]].tolist(), strict=True):
        row.append(StartTimeStatus(status).name)
    for row, status in zip(rows, tracks["status"].tolist(), strict=True):
        row.append(FitStatus(status).name)
    apart = [
        [one.label, str(one.n), f"{one.x:+.2f} ± {one.err_x:.2f}", f"{one.z:+.1f} ± {one.err_z:.1f}"] for one in offsets
    ]
    head = ["layer", "tracks", "X (mm)", "z (mm)"]
    more = [text_table("clusters minus tracks of wires", head, apart)] if offsets else []
    table = text_table("fitted tracks (mm, rad, GeV/c)", [*_COLUMNS, "start_time", "status"], rows)
    options.say(text if arguments.json else "\n".join([repr(events), repr(result), _left_out(report), *more, table]))
    if not len(tracks):
        raise options.RunFailedError("no track was found and fitted")
    options.note(arguments, f"tables and pictures: {arguments.output}")
    return options.OK


def _fullest(tracks: Table) -> int:
    """Return the event with most clusters on tracks, and of those the one with most wires; 0 without tracks."""
    import numpy as np

    if not len(tracks):
        return 0
    on_tracks = [np.bincount(tracks["event"], tracks[name]) for name in ("n_wires", "n_clusters")]
    return int(np.lexsort(on_tracks)[-1])


def _left_out(report: dict[str, Any]) -> str:
    """Return how many cells and strips are outside of the drift times, or in events without a start time."""
    cells, strips = report["cells"], report.get("strip_times")
    parts = [f"{cells['outside']} of {cells['fired']} cells"]
    if strips:
        parts.append(f"{strips['outside']} of {strips['strips']} strips")
    return f"outside of the drift time, or without a start time: {', '.join(parts)}"


def _offset(offset: PointOffset) -> dict[str, Any]:
    """Return an offset as plain numbers; without those that are not known."""
    numbers: dict[str, Any] = {"tracks": offset.n}
    for name, value, error in (("x", offset.x, offset.err_x), ("z", offset.z, offset.err_z)):
        if value == value:
            numbers[name] = {"value": value, "error": error, "unit": "mm"}
    return numbers


def _numbers(arguments: argparse.Namespace, events: int) -> list[int]:
    """Return the events that are asked for."""
    wrong = [number for number in arguments.event or () if number >= events]
    if wrong:
        given = ", ".join(map(str, wrong))
        raise options.InputError(f"--event: got {given}; expected numbers from 0 to {events - 1}")
    return list(dict.fromkeys(arguments.event or ()))


def _about(result: Result, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the numbers of the reconstruction."""
    from cgemit.reconstruction.refine import StartTimeStatus

    times = result.start_times["status"] == StartTimeStatus.ok
    report = {
        "version": __version__, "command": arguments.line, "file": str(arguments.file),
        "detector": result.detector.name, "events": result.n_events, "settings": result.settings.to_dict(),
        "rows": result.rows, "removed": result.removed(), "large_chi2": result.large_chi2(),
        "events_with_start_time": int(times.sum()),
    }  # fmt: skip
    if result.strip_times is None:
        return report
    offset, error = (result.strip_times.meta[name] for name in ("offset", "err_offset"))
    strips = {
        "offset": {"value": offset, "error": error, "unit": "ns"} if offset == offset else None,
        "strips": len(result.digis), "outside": int(result.strip_times["n_outside"].sum()),
    }  # fmt: skip
    return report | {"strip_times": strips}
