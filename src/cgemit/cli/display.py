"""`cgemit display`: one event as a picture, and as a page that turns in three dimensions."""

from __future__ import annotations

import argparse
from dataclasses import replace

from cgemit.cli import options
from cgemit.cli.simulate import add_finder, add_gun, gun_of

DESCRIPTION = """\
Draw one event: the detector, true crossings, clusters, ghosts (XV clusters of different crossings), drift circles,
fired strips on the unrolled anodes, and the fitted tracks. event.png and event.pdf go to the folder, with --html also
event.html, which turns in three dimensions and needs no network (extra [notebook]). run.json and detector.toml say what
was drawn."""

EXAMPLES = """\
Options of the gun are those of `cgemit simulate`. Event N is event N of a run with the same options and seed.

examples:
  cgemit display -d besiii-cgem --p 1 --cos-theta -0.93:0.93 -o event
  cgemit display -d besiii-cgem --particle pi- --p 0.1 --cos-theta 0.2 --event 3 --html -o slow"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_detector(parser)
    add_gun(parser)
    parser.add_argument("--event", type=options.event, default=0, metavar="N", help="number of the event (default 0)")
    parser.add_argument("--html", action="store_true", help="also write event.html, in three dimensions")
    options.add_output(parser, required=True)
    options.add_readout(parser)
    add_finder(parser)
    options.add_hypothesis(parser)
    options.add_physics(parser)
    options.add_seed(parser)
    options.add_common(parser)


def run(arguments: argparse.Namespace) -> int:
    """Simulate the event and draw it."""
    from cgemit.base.files import check_free, new_folder
    from cgemit.chain import run
    from cgemit.chain.record import write_about
    from cgemit.draw.display import event, event_3d, save_page
    from cgemit.particles.gun import generate

    check_free(arguments.output, overwrite=arguments.overwrite)
    (detector,), settings = options.load_inputs(arguments, gun_of, one_track=True)
    gun = gun_of(arguments)
    particles = generate(gun, 1, arguments.seed, arguments.event, detector)
    result = run.run(
        detector, particles, seed=arguments.seed, settings=settings, finder=arguments.finder or "truth", workers=1
    )
    figure = event_3d(result, arguments.event) if arguments.html else None
    with new_folder(arguments.output, overwrite=arguments.overwrite) as folder:
        event(result, arguments.event).save(folder / "event")
        if figure is not None:
            save_page(figure, folder / "event.html", overwrite=True)
        write_about(folder, {"detector": detector}, result.entries(arguments.line))
    options.say(replace(result, gun=gun))
    options.note(arguments, f"event: {arguments.output}/event.{'html' if arguments.html else 'png'}")
    return 0
