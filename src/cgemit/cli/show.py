"""`cgemit show`: the numbers and pictures of a detector."""

from __future__ import annotations

import argparse
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cgemit.cli import options

if TYPE_CHECKING:
    from cgemit.detector import Detector


DESCRIPTION = """\
Print what a detector is made of (radii and X/X0 at normal incidence, per scatterer and per sub-layer) and its readout
(strips, pitch, stereo angles, wires), and draw it: r-phi.png, r-z.png, layers.png (and .pdf) in the output folder,
beside detector.toml (the complete description), summary.json (the printed numbers), with --gdml detector.gdml (volumes
and materials for Geant4, DD4hep and ROOT), and with --delphes detector.tcl (the block DetectorGeometry of a Delphes
card). A Delphes card is read as well: its barrel becomes a detector."""

EXAMPLES = """\
examples:
  cgemit show besiii-cgem                                            pictures in ./cgemit-show-besiii-cgem
  cgemit show my-detector.toml -o pictures --overwrite
  cgemit show besiii-cgem-design --set cgem.L1.drift_gap="3 mm" --set cgem.L2.pitch_x="500 um"
  cgemit show besiii-idc --set drift_chamber.wires=smeared --json
  cgemit show delphes_card_IDEA.tcl -o idea                          and idea/detector.toml"""

# Column of `describe`, heading, format.
_MATERIAL = (
    ("part", "part", "<s"), ("r_in_mm", "from r/mm", ".3f"), ("r_out_mm", "to r/mm", ".3f"),
    ("x0_percent", "X/X0 %", ".4f"), ("sum", "sum %", ".4f"),
)  # fmt: skip
_SUB_LAYERS = (
    ("part", "part", "<s"), ("label", "sub-layer", "<s"), ("material", "material", "<s"),
    ("r_in_mm", "from r/mm", ".4f"), ("r_out_mm", "to r/mm", ".4f"), ("thickness_mm", "thickness/mm", ".4f"),
    ("x0_percent", "X/X0 %", ".4f"),
)  # fmt: skip
_CGEM = (
    ("layer", "layer", "<s"), ("r_mid_gap_mm", "r mid gap/mm", ".3f"), ("r_readout_mm", "r readout/mm", ".4f"),
    ("length_mm", "length/mm", "g"), ("drift_gap_mm", "gap/mm", "g"), ("hole_outer_um", "hole/um", "g"),
    ("hole_inner_um", "waist/um", "g"), ("hole_pitch_um", "hole pitch/um", "g"), ("sheets", "sheets", "d"),
    ("phi_first_deg", "first phi/deg", ".3f"), ("pitch_x_um", "X pitch/um", "g"), ("pitch_v_um", "V pitch/um", "g"),
    ("strips_x", "X strips", "d"), ("strips_v", "V strips", "d"), ("stereo_deg", "stereo/deg", "+.3f"),
)  # fmt: skip
_LAYERS = (
    ("layer", "layer", "<s"), ("radius_mm", "r/mm", "g"), ("length_mm", "length/mm", "g"),
    ("material", "material", "<s"), ("thickness_mm", "thickness/mm", ".4g"), ("views", "measures", "<s"),
    ("error_x_um", "X error/um", ".4g"), ("error_v_um", "V error/um", ".4g"), ("pitch_x_um", "X pitch/um", "g"),
    ("pitch_v_um", "V pitch/um", "g"), ("stereo_deg", "stereo/deg", "+.3f"), ("efficiency", "efficiency", "g"),
)  # fmt: skip
_WIRES = (
    ("layer", "layer", "d"), ("cells", "cells", "d"), ("gid_first", "first gid", "d"), ("r_end_mm", "r end/mm", ".2f"),
    ("r_mid_mm", "r mid/mm", ".2f"), ("half_length_mm", "half length/mm", "g"), ("twist_deg", "twist/deg", "+.3f"),
    ("tilt_mrad", "tilt/mrad", "+.2f"), ("phi_east_deg", "phi east/deg", ".3f"), ("sigma_um", "sigma/um", "g"),
    ("sigma_slope_um_per_mm", "slope um/mm", "g"), ("efficiency", "efficiency", "g"),
)  # fmt: skip


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    detector = parser.add_argument(
        "detector",
        metavar="DETECTOR",
        help="a preset (see: cgemit detectors), a detector file in TOML, or a Delphes card",
    )
    detector.completer = options.preset_names  # type: ignore[attr-defined]
    options.add_set(parser, 'change one value, such as cgem.L2.pitch_x="500 um"; may be repeated')
    options.add_field(parser)
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON instead of tables")
    parser.add_argument("--gdml", action="store_true", help="write detector.gdml into the output folder, too")
    parser.add_argument("--delphes", action="store_true", help="write detector.tcl into the output folder, too")
    options.add_output(parser, "folder for the pictures (default cgemit-show-NAME)")


def run(arguments: argparse.Namespace) -> int:
    """Print the tables and write the pictures."""
    from cgemit.base.errors import Problems
    from cgemit.base.files import check_free
    from cgemit.detector import describe

    problems = Problems()
    overrides = options.split(arguments.overrides, problems, settings=False).detector
    if problems:
        raise options.InputError("\n".join(map(str, problems)))
    detector = options.load_detector(arguments.detector, overrides, arguments.field)
    numbers = describe(detector)
    folder = arguments.output or "cgemit-show-" + re.sub(r"[^\w.-]+", "-", detector.name)
    check_free(folder, overwrite=arguments.overwrite)
    options.say(json.dumps(numbers, indent=2, ensure_ascii=False) if arguments.json else text(numbers))
    _write(detector, numbers, folder, overwrite=arguments.overwrite, gdml=arguments.gdml, delphes=arguments.delphes)
    if not arguments.json:
        options.say(f"\npictures in {folder}")
    return options.OK


def text(numbers: Mapping[str, Any]) -> str:
    """Return the tables of `describe` as text."""
    about = [numbers["name"], numbers["description"]]
    lines = [": ".join(filter(None, about)), f"field {numbers['field']}"]
    lines += ["", "Material at normal incidence, from the beam line outward", *_rows(_MATERIAL, _with_sums(numbers))]
    sub_layers = [
        {**row, "part": row_of_part["part"]}
        for row_of_part in numbers["material"]
        for row in row_of_part["sub_layers"]
        if len(row_of_part["sub_layers"]) > 1 and row_of_part["part"] != "chamber gas"
    ]
    if sub_layers:
        lines += ["", "Sub-layers", *_rows(_SUB_LAYERS, sub_layers)]
    if numbers["cgem"]:
        lines += ["", "CGEM readout (strips per sheet)", *_rows(_CGEM, numbers["cgem"])]
    if numbers["layers"]:
        lines += ["", "Layers that measure positions (V at 90 deg: z)", *_rows(_LAYERS, numbers["layers"])]
    if numbers["wires"]:
        lines += ["", "Wire layers", *_rows(_WIRES, numbers["wires"])]
    if numbers["unreachable"]:
        lines += ["", *numbers["unreachable"]]
    return "\n".join(lines)


def _with_sums(numbers: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the scatterers, the gas between wire layers as one, with the thickness up to and including each."""
    total = 0.0
    for name, found in itertools.groupby(numbers["material"], key=lambda row: row["part"]):
        rows = list(found)
        thickness = sum(row["x0_percent"] for row in rows)
        total += thickness
        edges = {"r_in_mm": rows[0]["r_in_mm"], "r_out_mm": rows[-1]["r_out_mm"]}
        yield {"part": name, **edges, "x0_percent": thickness, "sum": total}


def _rows(columns: Sequence[tuple[str, str, str]], rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return a table as lines: text to the left, numbers to the right."""
    cells = [[heading for _, heading, _ in columns]]
    cells += [[format(row[name], form) for name, _, form in columns] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    left = [form.startswith("<") for _, _, form in columns]
    aligned = [
        "  ".join(c.ljust(w) if to_left else c.rjust(w) for c, w, to_left in zip(line, widths, left, strict=True))
        for line in cells
    ]
    return [line.rstrip() for line in [aligned[0], "-" * len(aligned[0]), *aligned[1:]]]


def _write(
    detector: Detector, numbers: Mapping[str, Any], folder: str, *, overwrite: bool, gdml: bool, delphes: bool
) -> None:
    from cgemit.base.files import SUMMARY, new_folder
    from cgemit.detector.delphes import card_of
    from cgemit.detector.export import write_files
    from cgemit.detector.files import CARD
    from cgemit.detector.inventory import material_scan
    from cgemit.draw.detector import draw_detector, draw_layers, draw_material, draw_sides
    from cgemit.tables.show import write_csv

    with new_folder(folder, overwrite=overwrite) as temporary:
        draw_detector(detector).save(temporary / "r-phi")
        draw_sides(detector).save(temporary / "r-z")
        scan = material_scan(detector)
        draw_material(scan).save(temporary / "material")
        write_csv(temporary / "material.csv", scan.columns())
        if detector.cgem:
            draw_layers(detector).save(temporary / "layers")
        write_files(temporary, {"detector.toml": detector})
        if gdml:
            detector.to_gdml(temporary / "detector.gdml")
        if delphes:
            Path(temporary / f"detector{CARD}").write_text(card_of(detector), encoding="utf-8")
        Path(temporary / SUMMARY).write_text(json.dumps(numbers, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
