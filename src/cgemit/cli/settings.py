"""`cgemit settings`: the settings of all stages as a file."""

from __future__ import annotations

import argparse

from cgemit.cli import options

DESCRIPTION = """\
Print the settings of all stages as TOML, each with what it may be: the defaults, or what --settings and --set make of
them. The text is a file that --settings takes; what is left out of such a file has its default."""

EXAMPLES = """\
examples:
  cgemit settings > settings.toml                              a file with all defaults, to be changed
  cgemit settings --settings mine.toml --set fit.loss=mean     what a run with the same options uses
  cgemit settings --settings out/run.json                      what an earlier run used
  cgemit simulate -d besiii-cgem --settings settings.toml --p 1 --cos-theta 0 -n 1000 -o out"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    options.add_settings(parser)
    options.add_set(parser, "change one setting, such as fit.loss=mean; may be repeated")


def run(arguments: argparse.Namespace) -> int:
    """Print the settings."""
    settings = options.settings_of(arguments)
    options.say((settings.to_toml(comments=True)).rstrip())
    return options.OK
