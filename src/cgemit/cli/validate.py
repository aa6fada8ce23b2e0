"""`cgemit validate`: checks of detector files."""

from __future__ import annotations

import argparse
import json
import sys

from cgemit.cli import options

DESCRIPTION = """\
Check detector files and list every problem: where it is, what was given, what was expected. Of a good file, say what
part of a layer no track from the origin reaches, since the field map ends there, and in which layers the finder ckf
begins no track.
Exit code 0 if all files are good, 2 otherwise."""

EXAMPLES = """\
examples:
  cgemit validate my-detector.toml
  cgemit validate variants/*.toml
  cgemit validate --schema > detector.schema.json     for editors that complete and check TOML files"""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("files", nargs="*", metavar="FILE", help="detector files (or names of presets)")
    parser.add_argument("--schema", action="store_true", help="write the JSON Schema of detector files to stdout")


def run(arguments: argparse.Namespace) -> int:
    """Check the files; print the schema."""
    from cgemit.base.errors import DetectorError
    from cgemit.detector import load, schema
    from cgemit.detector.check import unreachable
    from cgemit.reconstruction.finders import HIT_FINDERS

    if not arguments.files and not arguments.schema:
        raise options.InputError("validate: got no file; expected at least one FILE, or --schema")
    if arguments.schema:
        options.say(json.dumps(schema(), indent=2, ensure_ascii=False))
    code = options.OK
    for file in arguments.files:
        try:
            detector = load(file)
        except DetectorError as error:
            options.say(error, sys.stderr)
            code = options.BAD_INPUT
        else:
            # The schema on stdout must stay clean JSON.
            stream = sys.stderr if arguments.schema else sys.stdout
            options.say(f"{file}: good (detector {detector.name!r})", stream)
            missing = {one.name: one.seedless(detector, one.settings()) for one in HIT_FINDERS.values()}
            lost = [f"finder {name}: {text}" for name, text in missing.items() if text]
            for line in [*unreachable(detector), *lost]:
                options.say(f"  {line}", stream)
    return code
