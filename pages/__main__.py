"""What the programs of this folder share: where they write, what they say on the way, and how they end."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from cgemit.draw.style import Picture
from results import FOLDER, IMAGES, PAGE

_START = time.perf_counter()


def options(text: str | None) -> argparse.ArgumentParser:
    """Return a parser with the option for the place of everything."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, help="folder for everything (default: each its place)")
    return parser


def places(output: Path | None) -> tuple[Path, Path, Path]:
    """Return the folders of results and pictures, which are there afterwards, and the file of the page."""
    folder, images, page = (output, output, output / PAGE.name) if output else (FOLDER, IMAGES, PAGE)
    images.mkdir(parents=True, exist_ok=True)
    return folder, images, page


def say(text: str) -> None:
    """Report progress with the time since the start."""
    print(f"{time.perf_counter() - _START:5.0f} s  {text}", file=sys.stderr)


def save_pictures(folder: Path, pictures: Mapping[str, Picture]) -> None:
    """Write pictures as PNG under the names by which the page shows them."""
    for name, picture in pictures.items():
        picture.save(folder / f"validation-{name}.png", overwrite=True)


def verdict(wrong: Sequence[str]) -> int:
    """Print what is wrong and return the exit code."""
    print("\n".join(wrong), end="\n" if wrong else "", file=sys.stderr)
    return 1 if wrong else 0
