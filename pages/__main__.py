"""Every measured table and picture of the documentation: ``python -m pages list | renew PAGE | check``.

Run it in the root of the repository. A page is one file of this folder and one line of `PAGES`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl

from pages import (
    alignment,
    background,
    cluster,
    covariance,
    data_model,
    deltas,
    digitize,
    finding,
    fit,
    foils,
    geant4,
    linear_table,
    matter,
    mismatch,
    paper,
    performance,
    pictures,
    presets,
    readme,
    readout,
    real_events,
    robustness,
    toys,
    track_fit,
    vertex,
)
from pages.page import DATA, IMAGES, ROOT, Page, markers, torn_lines

PAGES: dict[str, Page] = {
    page.name: page
    for page in (
        geant4.PAGE,
        deltas.PAGE,
        fit.PAGE,
        track_fit.PAGE,
        covariance.PAGE,
        paper.PAGE,
        linear_table.PAGE,
        performance.PAGE,
        finding.PAGE,
        robustness.PAGE,
        matter.PAGE,
        foils.PAGE,
        mismatch.PAGE,
        alignment.PAGE,
        toys.PAGE,
        background.PAGE,
        vertex.PAGE,
        digitize.PAGE,
        cluster.PAGE,
        readout.PAGE,
        real_events.PAGE,
        data_model.PAGE,
        pictures.CONVENTIONS,
        readme.PAGE,
        pictures.GALLERY,
        presets.PAGE,
    )
}


def problems() -> list[str]:
    """Return where pages differ from stored numbers, blocks that nothing writes, and paragraphs that markers tear."""
    wrong, written = [], {page.file: set[str]() for page in PAGES.values()}
    for page in PAGES.values():
        wrong += page.problems()
        written[page.file] |= page.blocks(page.read()).keys()
    for file, names in written.items():
        text = (ROOT / file).read_text(encoding="utf-8")
        wrong += [f"{file}: no page writes the block {name}" for name in sorted(set(markers(text)) - names)]
        wrong += [
            f"{file}: line {line} begins with <!--, which ends its paragraph: put a word in front of it"
            for line in torn_lines(text)
        ]
    return wrong


def renew(page: Page, parts: Sequence[str], output: Path | None, share: float, stored: bool) -> list[str]:
    """Measure a page, write it and its pictures; returns what is not renewed, and what should agree and does not."""
    unknown = sorted(set(parts) - page.parts.keys())
    if unknown:
        raise ValueError(f"{page.name} has no {', '.join(unknown)}, expected {', '.join(page.parts) or 'no part'}")
    data, file, images = DATA, ROOT / page.file, IMAGES
    if output:
        data, file, images = output, output / Path(page.file).name, output
        output.mkdir(parents=True, exist_ok=True)
    missing = [] if stored else page.measure(data, share, parts)
    found = page.read(data)  # what the files hold is what the page and the pictures show
    page.write(found, file, images)
    return missing + page.failures(found)


def main(arguments: Sequence[str] | None = None) -> int:
    """Return 1 if a page is not what its numbers say, or numbers do not agree as they should; 2 for wrong input."""
    parser = argparse.ArgumentParser(prog="python -m pages", description=__doc__.split("\n\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="list the pages, what they write, and how long renewing them takes")
    commands.add_parser("check", help="check that pages hold what their stored numbers say; measures nothing")
    one = commands.add_parser(
        "renew", help="measure the numbers of a page, store them, write the page and its pictures"
    )
    one.add_argument("page", choices=PAGES, metavar="PAGE")
    one.add_argument("part", nargs="*", help="measure these files of numbers only (default: all)")
    one.add_argument("--stored", action="store_true", help="measure nothing: write the page from the stored numbers")
    one.add_argument("--share", type=float, default=1.0, help="share of the events, for a quick look; needs -o")
    one.add_argument("-o", "--output", type=Path, help="write numbers, page and pictures into this folder")
    given = parser.parse_args(arguments)
    if given.command == "list":
        for page in PAGES.values():
            print(f"{page.name:13} {page.takes:18} {page.file:33} {' '.join(page.parts)}")
        return 0
    if given.command == "check":
        wrong = problems()
    else:
        if given.share != 1 and not given.output:
            parser.error("--share needs -o: pages show full samples")
        mpl.use("agg")
        try:
            wrong = renew(PAGES[given.page], given.part, given.output, given.share, given.stored)
        except ValueError as error:
            parser.error(str(error))
    print("\n".join(wrong), end="\n" if wrong else "", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
