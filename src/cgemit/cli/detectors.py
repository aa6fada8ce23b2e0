"""`cgemit detectors`: the presets."""

from __future__ import annotations

import argparse
import json

from cgemit.cli import options

DESCRIPTION = "List the names of the presets, each with one line about it."

EXAMPLES = """\
examples:
  cgemit detectors
  cgemit show besiii-cgem                   look at one
  cgemit resolution -d besiii-cgem ...      use one"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--json", action="store_true", help="write {name: description} as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the presets."""
    from cgemit.detector import detectors

    presets = detectors()
    if arguments.json:
        options.say(json.dumps(presets, indent=2))
        return options.OK
    width = max(map(len, presets))
    for name, description in presets.items():
        options.say(f"{name:{width}}  {description}")
    return options.OK
