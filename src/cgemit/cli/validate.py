"""`cgemit validate`: check detector files."""

from __future__ import annotations

import argparse
import json
import sys

from cgemit.cli import common

_DESCRIPTION = """\
Check detector files and list every problem: where it is, what was given, what was expected.
Exit code 0 if all files are good, 2 otherwise."""

_EXAMPLES = """\
examples:
  cgemit validate my-detector.toml
  cgemit validate variants/*.toml
  cgemit validate --schema > detector.schema.json     for editors that complete and check TOML files"""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the sub-command."""
    parser = subparsers.add_parser(
        "validate", help="check detector files, listing every problem", description=_DESCRIPTION, epilog=_EXAMPLES,
        formatter_class=common.HelpFormatter,
    )  # fmt: skip
    parser.add_argument("files", nargs="*", metavar="FILE", help="detector files (or names of presets)")
    parser.add_argument("--schema", action="store_true", help="write the JSON Schema of detector files to stdout")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Check the files; print the schema."""
    from cgemit.detector import DetectorError, load, schema

    if not arguments.files and not arguments.schema:
        raise common.InputError("validate: got no file; expected at least one FILE, or --schema")
    if arguments.schema:
        print(json.dumps(schema(), indent=2, ensure_ascii=False))
    code = common.OK
    for file in arguments.files:
        try:
            detector = load(file)
        except DetectorError as error:
            print(error, file=sys.stderr)
            code = common.BAD_INPUT
        else:
            # The schema on stdout must stay clean JSON.
            print(f"{file}: good (detector {detector.name!r})", file=sys.stderr if arguments.schema else sys.stdout)
    return code
