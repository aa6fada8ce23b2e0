"""The matter of a detector as a GDML file, for Geant4, DD4hep and ROOT: cylinders and their materials."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from cgemit.detector.material import Material, elements
from cgemit.detector.parts import Contents
from cgemit.detector.shell import Shell
from cgemit.detector.slabs import ENDLESS, slabs
from cgemit.io.files import new_file

_SCHEMA = "http://service-spi.web.cern.ch/service-spi/app/releases/GDML/schema/gdml.xsd"
_MARGIN = 10.0  # mm, from the detector to the wall of the world
_VACUUM = 1e-25  # g/cm3, as Geant4's G4_Galactic


def write_gdml(detector: Contents, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write the volumes and materials of a detector; see `Detector.to_gdml`."""
    tree = ElementTree.ElementTree(_gdml(detector))
    ElementTree.indent(tree, "  ")
    with new_file(path, overwrite=overwrite) as temporary, Path(temporary).open("wb") as stream:
        tree.write(stream, encoding="UTF-8", xml_declaration=True)


def _gdml(detector: Contents) -> ElementTree.Element:
    """Return the root of the file: a world of air with one tube for each shell, and a tube of vacuum on the axis."""
    found = [slab.shells for slab in slabs(detector, merge=False)]
    placed = [shells for shells in found if shells[0].half_length < ENDLESS]
    length = max(shell.half_length for shells in placed for shell in shells)
    radius = max(shell.r_out for shells in placed for shell in shells)
    root = ElementTree.Element("gdml")
    root.set("xmlns:xsi", "http://www.w3.org/2001/XMLSchema-instance")
    root.set("xsi:noNamespaceSchemaLocation", _SCHEMA)
    ElementTree.SubElement(root, "define")
    materials = _Materials(ElementTree.SubElement(root, "materials"))
    solids, structure = ElementTree.SubElement(root, "solids"), ElementTree.SubElement(root, "structure")
    volumes: list[tuple[str, float, float, float, str, float | None]] = [
        ("beam_vacuum", 0.0, placed[0][0].r_in, length, "vacuum", None)
    ]
    for number, shells in enumerate(placed):
        name = _name(f"tube{number:03d}_{shells[0].group}_{shells[0].label}")
        shell = shells[0]
        volumes.append((name, shell.r_in, shell.r_out, shell.half_length, materials.of(shells), _x0(shells)))
    for name, r_in, r_out, half, material, x0 in volumes:
        about = {"name": f"{name}_solid", "lunit": "mm", "aunit": "deg", "startphi": "0", "deltaphi": "360"}
        size = {"rmin": repr(float(r_in)), "rmax": repr(float(r_out)), "z": repr(float(2 * half))}
        ElementTree.SubElement(solids, "tube", about | size)
        _volume(structure, name, material, f"{name}_solid", x0)
    across, along = repr(2 * (radius + _MARGIN)), repr(2 * (length + _MARGIN))
    ElementTree.SubElement(solids, "box", name="world_solid", lunit="mm", x=across, y=across, z=along)
    air = Shell("air", "air", 0.0, 1.0, 1.0, detector.air)
    world = _volume(structure, "world", materials.of((air,)), "world_solid", detector.air.x0)
    for name, *_ in volumes:
        physical = ElementTree.SubElement(world, "physvol", name=f"{name}_placed")
        ElementTree.SubElement(physical, "volumeref", ref=name)
    materials.write()
    setup = ElementTree.SubElement(root, "setup", name="Default", version="1.0")
    ElementTree.SubElement(setup, "world", ref="world")
    return root


def _volume(
    structure: ElementTree.Element, name: str, material: str, solid: str, x0: float | None
) -> ElementTree.Element:
    """Add a volume; the radiation length that cgemit uses stands beside it, since GDML has no place for it."""
    volume = ElementTree.SubElement(structure, "volume", name=name)
    ElementTree.SubElement(volume, "materialref", ref=material)
    ElementTree.SubElement(volume, "solidref", ref=solid)
    if x0 is not None:
        ElementTree.SubElement(volume, "auxiliary", auxtype="X0", auxvalue=repr(x0), auxunit="mm")
    return volume


def _x0(shells: Sequence[Shell]) -> float:
    """Return the radiation length of shells in the same place, mm: gas and the wires spread over it."""
    return 1 / sum(1 / shell.material.x0 for shell in shells)


class _Materials:
    """The materials of a file; equal ones are written once, under names that differ."""

    def __init__(self, parent: ElementTree.Element) -> None:
        self._parent = parent
        self._names: dict[tuple[Material, ...], str] = {}
        self._elements: set[str] = set()
        self._mixtures: list[ElementTree.Element] = []
        vacuum = ElementTree.Element("material", name="vacuum", Z="1")
        ElementTree.SubElement(vacuum, "D", value=repr(_VACUUM), unit="g/cm3")
        ElementTree.SubElement(vacuum, "atom", value="1.008")
        self._mixtures.append(vacuum)

    def of(self, shells: Sequence[Shell]) -> str:
        """Return the name of the material of shells in the same place."""
        key = tuple(shell.material for shell in shells)
        if key not in self._names:
            wanted = _name("_and_".join(material.name for material in key))
            taken = {*self._names.values(), "vacuum"}
            names = itertools.chain([wanted], (f"{wanted}_{i}" for i in itertools.count(2)))
            self._names[key] = next(name for name in names if name not in taken)
            self._mixtures.append(self._mixture(self._names[key], key))
        return self._names[key]

    def write(self) -> None:
        """Add elements and materials to the file, the elements first."""
        self._parent.extend(self._mixtures)

    def _mixture(self, name: str, parts: Sequence[Material]) -> ElementTree.Element:
        """Return a material; that of several parts has the sum of their densities."""
        density = sum(part.density for part in parts)
        shares: dict[str, float] = {}
        for part in parts:
            for element, share in self._composition(part):
                shares[element] = shares.get(element, 0.0) + share * part.density / density
        gas = all(part.gas for part in parts)
        made = ElementTree.Element("material", name=name, state="gas" if gas else "solid")
        ElementTree.SubElement(made, "D", value=repr(density), unit="g/cm3")
        total = sum(shares.values())
        for element, share in shares.items():
            ElementTree.SubElement(made, "fraction", n=repr(share / total), ref=element)
        return made

    def _composition(self, material: Material) -> list[tuple[str, float]]:
        """Return the elements of a material by mass; one equivalent element where only bulk properties are known."""
        if not material.composition:
            ((equivalent, _),) = material.elements()
            name = _name(f"element_of_{material.name}")
            self._add(name, name, equivalent.z, equivalent.a)
            return [(name, 1.0)]
        for symbol, _ in material.composition:
            self._add(f"element_{symbol}", symbol, elements()[symbol].z, elements()[symbol].a)
        return [(f"element_{symbol}", share) for symbol, share in material.composition]

    def _add(self, name: str, formula: str, z: float, a: float) -> None:
        if name in self._elements:
            return
        self._elements.add(name)
        element = ElementTree.SubElement(self._parent, "element", name=name, formula=formula, Z=f"{z:g}")
        ElementTree.SubElement(element, "atom", type="A", unit="g/mol", value=repr(a))


def _name(text: str) -> str:
    """Return a name that XML allows as a reference."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", text)
    return plain if re.match(r"[A-Za-z_]", plain) else f"v{plain}"
