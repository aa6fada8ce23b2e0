"""Electrons from the solids at a drift gap: how many there are, and where the track bore them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cgemit import _core
from cgemit.detector import compiled, load
from cgemit.detector.gas import REST_ENERGY
from slabs import ELECTRON, PROTON

P = 0.2  # GeV/c, of protons: slow ones set more electrons free
BETA2 = P**2 / (P**2 + PROTON**2)
RATIO = ELECTRON / PROTON
W_MAX = 2e6 * ELECTRON * (P / PROTON) ** 2 / (1 + 2 * math.hypot(1, P / PROTON) * RATIO + RATIO**2)  # keV
SLOPE = 0.3


def electrons(origin: str, density: str, n: int, tanl: float, slope: float):
    """Return the layer and what protons leave in next to nothing between 1 mm of thin hydrogen and nothing."""
    light = [{"material": "Light", "thickness": "1 mm"}]
    thin = [{"material": "Thin", "thickness": "1 mm"}]
    changes = {
        "field.bz": "1 mT",
        "materials.Thin": {"density": "1e-6 g/cm3", "composition": "H", "gas": True},
        "materials.Light": {"density": density, "composition": "H", "gas": True},
        "cgem.L1.cathode": light if origin == "cathode" else thin,
        "cgem.L1.gas": "Thin",
        "cgem.L1.foils": 1,
        "cgem.L1.foil": light if origin == "behind" else thin,
        "cgem.L1.anode": thin,
    }
    detector = load("besiii-cgem").with_overrides(changes)
    found = _core._testing.ionize(
        compiled(detector), 0, p=P, mass=PROTON, n=n, seed=4, deltas=True, keep_clusters=False, tanl=tanl, slope=slope
    )
    begins = found["deposit_origin"] == ("cathode", "behind").index(origin) + 1
    each = found["deposit_crossing"] * 1000 + found["deposit_delta"]
    begins &= np.diff(each, prepend=-1) != 0
    return detector.cgem[0], {name: column[begins] for name, column in found.items() if name.startswith("deposit_")}


def to_the_gap(energy, c: float, turned_back: bool):
    """Return the share of electrons of these energies (keV) of the cathode that fly towards the gap, (n,).

    The track's cosine to the radius is c; at angle t to the track and azimuth a the electron's is
    c cos(t) + sqrt(1 - c^2) sin(t) cos(a). With `turned_back` also those that the field brings back within 50 mm.
    """
    cosine = np.sqrt(energy * (W_MAX + 2 * REST_ENERGY) / (W_MAX * (energy + 2 * REST_ENERGY)))
    radius = 1e-3 * np.sqrt(energy * (energy + 2 * REST_ENERGY)) / (0.299792458 * 1e-3)  # mm, at 1 mT
    least = -25 / radius if turned_back else 0.0
    across = np.maximum(np.sqrt((1 - c * c) * (1 - cosine**2)), 1e-12)
    return np.arccos(np.clip((least - c * cosine) / across, -1, 1)) / np.pi


@pytest.mark.parametrize("tanl", [0.0, 1.5])
def test_number_is_that_of_free_electrons(tanl: float) -> None:
    """xi/beta^2 (1 - beta^2 E/W_max)/E^2 above 1 keV on the slanted way, PDG 2024 sec. 34.2.4 (spin: 1e-9).

    From 0.1 ug/cm2, which stops and deflects hardly any. At tanl = 0 all fly outward; else some of those that leave
    inward come back.
    """
    n = 4_000_000
    layer, first = electrons("cathode", "1e-6 g/cm3", n, tanl, slope=0.0)
    energy = np.geomspace(1.0, W_MAX * (1 - 1e-9), 4000)
    length = math.hypot(1, tanl)
    spectrum = n * 1e6 * layer.cathode[0].material.xi(1.0) / BETA2 * length * (1 - BETA2 * energy / W_MAX) / energy**2
    least, most = (np.trapezoid(spectrum * to_the_gap(energy, 1 / length, back), energy) for back in (False, True))
    number = len(first["deposit_x"])
    error = math.hypot(math.sqrt(least), 0.01 * least)
    assert least - 4 * error < number < most + 4 * error
    assert 0.75 * number < least - 4 * error


@pytest.mark.parametrize("origin", ["cathode", "behind"])
def test_electrons_start_on_the_track(origin: str) -> None:
    """Traced back from the gap, electrons meet the track in the layer that they come from."""
    tanl = 1.5
    layer, first = electrons(origin, "2e-5 g/cm3", 400_000, tanl, SLOPE)
    x, y, z, dx, dy, dz = (first[f"deposit_{name}"] for name in ("x", "y", "z", "dx", "dy", "dz"))
    ends = []
    for side in (-0.5, 0.5):
        radius = np.hypot(x + side * dx, y + side * dy)
        azimuth = np.arctan2(y + side * dy, x + side * dx)
        ends.append(np.stack([radius * azimuth, radius - layer.r_gap_in, z + side * dz]))
    begin, flight = ends[0], ends[1] - ends[0]
    # The track on its way through the layer, there a straight line; behind the gap it has turned a little.
    depth = 0.0
    at, track = np.zeros(3), np.array([SLOPE, 1.0, tanl * math.hypot(1, SLOPE)])
    if origin == "behind":
        r, out = layer.r_gap_in, layer.r_gap_out
        cos, sin = 1 / math.hypot(1, SLOPE), SLOPE / math.hypot(1, SLOPE)
        arc = -r * cos + math.sqrt(out**2 - (r * sin) ** 2)
        azimuth = math.atan2(arc * sin, r + arc * cos)
        depth = out - r
        at = np.array([out * azimuth, depth, arc * tanl])
        outward = math.cos(math.atan2(sin, cos) - azimuth)
        track = np.array([math.tan(math.atan2(sin, cos) - azimuth), 1.0, tanl / outward])
    # Closest approach of the two lines.
    normal = np.cross(flight.T, track)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    distance = np.abs(np.sum((begin.T - at) * normal, axis=1))
    across = np.cross(flight.T, normal)
    met = np.sum((begin.T - at) * across, axis=1) / (across @ track)
    assert len(met) > 300
    assert np.median(distance) < 0.1  # scattering; a start on the other side is a millimetre off
    below = -met if origin == "cathode" else met
    inside = (below > -0.05) & (below < 1.05)
    assert np.mean(inside) > 0.6  # of the others most are from the gas behind the foil
    below = below[inside]
    # From the far side a few do not get out.
    assert 0.35 < np.median(below) < 0.5
