"""`cgemit find`: how well tracks are found."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgemit.base.version import __version__
from cgemit.cli import options
from cgemit.cli.simulate import add_finder, add_gun, gun_of

if TYPE_CHECKING:
    from cgemit.analysis.finding import Finding, LoopLinks
    from cgemit.analysis.widths import Fraction


DESCRIPTION = """\
Simulate events, find their tracks, and compare them with the particles: efficiency, fakes and clones as Belle II and
ACTS define them, tracks cut short or wrong in z, hit purity and hit efficiency, the share of findable particles and
what each condition removes, and layers that make no seed.
With simulate.half_turns above 1, half turns of one particle are also linked.
With -o also the efficiency against pT, cos(theta), phi and, where they vary, the number of findable particles in the
event, the occupancy of the cells (without a chamber of the strips) and the distance of the vertex from the beam line,
as picture (efficiency.png) and table (efficiency.csv)."""

EXAMPLES = """\
A quantity is a number (fixed), A:B (uniform range), A:B:N (N values from A to B in turn) or A,B,C (values in turn).

examples:
  cgemit find -d besiii-cgem --p 0.3:2 --cos-theta -0.93:0.93 -n 2000
  cgemit find -d besiii-cgem --particle pi+ --pt 0.05:0.3 --cos-theta -0.9:0.9 -n 5000 -o slow-pions
  cgemit find -d besiii-idc --tracks 4 --p 0.2:1.5 --cos-theta -0.93:0.93 -n 500 --set background.level=bes2009 -o four
  cgemit find -d besiii-cgem --set find.method=chamber --p 0.5 --cos-theta -0.9:0.9 -n 1000
  cgemit find -d besiii-cgem --sample d0-d0bar -n 1000
  cgemit find -d besiii-cgem --particle e- --p 0.03:0.11 --cos-theta -0.9:0.9 -n 500 --set simulate.half_turns=4
  cgemit find -d besiii-cgem --finder truth --p 0.5 --cos-theta -0.9:0.9 -n 1000         the perfect finder"""

#: Bins of the efficiency.
_BINS = 20


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_detector(parser)
    add_gun(parser)
    parser.add_argument(
        "--tracks", type=options.positive, default=1, metavar="N", help="such particles in every event (default 1)"
    )
    parser.add_argument("-n", "--events", type=options.positive, required=True, metavar="N", help="number of events")
    add_finder(parser, default="ckf")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")
    options.add_output(parser, "folder for the efficiency and summary.json")
    options.add_readout(parser)
    options.add_physics(parser)
    options.add_run(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Find and compare."""
    from cgemit.analysis.finding import finding, loop_links
    from cgemit.base.files import check_free
    from cgemit.chain import run
    from cgemit.chain.finders import seedless_layers
    from cgemit.particles.gun import Guns

    if arguments.output:
        check_free(arguments.output, overwrite=arguments.overwrite)
    (detector,), settings = options.load_inputs(arguments, gun_of)
    gun = gun_of(arguments)
    # Half turns are linked by their fitted helices, with one mass hypothesis.
    links = settings.simulate.half_turns > 1 and not isinstance(settings.fit.hypothesis, tuple)
    with options.progress_bar(arguments, "find") as progress:
        result = run.run(
            detector,
            gun if arguments.tracks == 1 else Guns((gun,) * arguments.tracks),
            arguments.events,
            arguments.seed,
            settings=settings,
            finder=arguments.finder,
            until="fit",
            progress=progress,
            workers=arguments.threads,
        )
    result_of_finding = finding(result)
    linked = loop_links(result) if links else None
    seconds = result.timings["find"]
    report = {
        "version": __version__, "command": arguments.line, "detector": detector.name, "events": arguments.events,
        "seed": arguments.seed, "settings": settings.to_dict(),
        "time_per_event": {"value": 1e3 * seconds / arguments.events, "unit": "ms"},
        "beyond_search": result.beyond_search(),
        **numbers_of(result_of_finding), **({} if linked is None else {"loops": loop_numbers(linked)}),
    }  # fmt: skip
    text = json.dumps(report, indent=2, allow_nan=False)
    if arguments.output:
        _write(result_of_finding, text, arguments.output, overwrite=arguments.overwrite)
    rows = [] if linked is None else linked.rows()
    missing = seedless_layers(result.finder, result.fit_detector or result.detector, settings)
    rows += [("layers without seeds", missing)] * bool(missing)
    rows.append(("events beyond the search", f"{result.beyond_search():,}"))
    rows.append(("time of an event", f"{1e3 * seconds / arguments.events:.2f} ms"))
    options.say(
        text
        if arguments.json
        else "\n".join([repr(result_of_finding), *(f"  {name:<48}{value}" for name, value in rows)])
    )
    if arguments.output:
        options.note(arguments, f"picture: {arguments.output}/efficiency.png")
    return options.OK


def numbers_of(finding: Finding) -> dict[str, Any]:
    """Return the results as plain numbers; fractions with their Wilson intervals."""
    from cgemit.analysis.widths import Fraction

    findable = Fraction(int(finding.findable.sum()), int(finding.charged.sum()))
    numbers: dict[str, Any] = {
        "finder": finding.finder, "mass": finding.mass, "findable": _plain(findable), "removed": dict(finding.removed),
        "seedless": int(finding.seedless.sum()),
    }  # fmt: skip
    for definition in ("belle2", "acts"):
        rates = finding.rates(definition)
        numbers[definition] = {
            name: _plain(getattr(rates, name))
            for name in ("efficiency", "fakes", "clones", "decays", "loops", "short", "wrong_z")
        }
    for name in ("purity", "hit_efficiency"):
        value = getattr(finding, name)
        numbers[name] = value if value == value else None
    return numbers


def loop_numbers(linked: LoopLinks) -> dict[str, Any]:
    """Return the results of linking as plain numbers."""
    return {name: _plain(getattr(linked, name)) for name in ("before", "after", "wrong", "lost")}


def _plain(fraction: Fraction) -> dict[str, Any]:
    low, high = fraction.interval()
    value = {"value": fraction.value, "low": low, "high": high} if fraction.n else {}
    return {"count": fraction.count, "n": fraction.n, **value}


def _write(finding: Finding, text: str, folder: str, *, overwrite: bool) -> None:
    import numpy as np

    from cgemit.analysis.finding import curve
    from cgemit.base.files import SUMMARY, new_folder
    from cgemit.draw.curves import draw_finding
    from cgemit.tables.show import write_csv

    curves = {name: curve(finding, name, edges) for name, edges in _edges(finding).items()}
    bins = [len(one["low"]) for one in curves.values()]
    columns = {"quantity": np.repeat(list(curves), bins)}
    columns |= {name: np.concatenate([one[name] for one in curves.values()]) for name in next(iter(curves.values()))}
    rates = finding.rates()
    lines = [f"efficiency {rates.efficiency}", f"fakes {rates.fakes.count}", f"clones {rates.clones.count}"]
    lines += [f"cut short {rates.short.count}", f"wrong in z {rates.wrong_z.count}"]
    lines += [f"hit purity {100 * finding.purity:.2f} %", f"hit efficiency {100 * finding.hit_efficiency:.2f} %"]
    with new_folder(folder, overwrite=overwrite) as temporary:
        title = f"{finding.detector}, finder {finding.finder}, findable particles, Belle II matching"
        draw_finding(curves, title, lines).save(Path(temporary) / "efficiency")
        write_csv(Path(temporary) / "efficiency.csv", columns)
        (Path(temporary) / SUMMARY).write_text(text + "\n", encoding="utf-8")


def _edges(finding: Finding) -> dict[str, Any]:
    """Return the edges of bins of each quantity: the first three always, the others where they vary."""
    import numpy as np

    values = {name: getattr(finding, name)[finding.charged] for name in ("pt", "cos_theta", "occupancy", "distance")}
    edges = {name: _equal_bins(one) for name, one in values.items()}
    edges["phi"] = _equal_bins(np.array([-np.pi, np.pi]))
    tracks = finding.tracks[finding.findable]
    if len(np.unique(tracks)) > 1:
        step = -(-int(np.ptp(tracks) + 1) // _BINS)  # whole numbers in each bin
        edges["tracks"] = np.arange(tracks.min() - 0.5, tracks.max() + 0.5 + step, step)
    vary = ["tracks", *(name for name in ("occupancy", "distance") if len(np.unique(values[name])) > 1)]
    return {name: edges[name] for name in ("pt", "cos_theta", "phi", *vary) if name in edges}


def _equal_bins(values: Any) -> Any:
    import numpy as np

    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    wide = max(high - low, 1e-6 * max(abs(high), 1.0))
    return np.linspace(low, low + wide * (1 + 1e-9), _BINS + 1)
