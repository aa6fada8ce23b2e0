"""`cgemit detectors`: list the presets."""

from __future__ import annotations

import argparse
import json

from cgemit.cli import common

_EXAMPLES = """\
examples:
  cgemit detectors
  cgemit show besiii-cgem                   look at one
  cgemit resolution -d besiii-cgem ...      use one"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    parser = subparsers.add_parser(
        "detectors", help="list the detectors that come with cgemit", epilog=_EXAMPLES,
        description="List the names of the presets, each with one line about it.",
        formatter_class=common.HelpFormatter,
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="write {name: description} as JSON")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Print the presets."""
    from cgemit.detector import detectors

    presets = detectors()
    if arguments.json:
        print(json.dumps(presets, indent=2))
        return common.OK
    width = max(map(len, presets))
    for name, description in presets.items():
        print(f"{name:{width}}  {description}")
    return common.OK
