"""How the charge of one track reaches the strips: drift, multiplication and strips as lines and bars to be drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from cgemit.chain import run
from cgemit.detector.parts import CgemLayer
from cgemit.digitize.transport import transport
from cgemit.draw.formation import FormationPanel
from cgemit.study.readout.beam import beam_detector, beam_particles

Floats = npt.NDArray[np.float64]

_PIECES = 12  # of a line in a gap
_AVALANCHE = 6  # lines that stand for an avalanche behind the first foil
_EVENTS = 20  # of which that with the median charge is drawn
_SWITCHES = ((False, 0.0), (True, 0.0), (False, 1.0), (True, 1.0))  # Lorentz angle, diffusion


def formation(
    readout: Any, *, angle: float = 20.0, bz: float = 1.0, seed: int = 1, particle: str = "mu-", p: float = 1.0
) -> list[FormationPanel]:
    """Return one track's way to the strips without and with Lorentz angle and diffusion.

    The track and its ionization are simulated, and strips and charges are those of the read-out. Lines of electrons
    have the same drift and diffusion, drawn for the picture.

    Parameters
    ----------
    readout : AnalogReadout
    angle : float
        deg, of incidence.
    bz : float
        T.
    seed : int
    particle : str
    p : float
        GeV/c.

    Raises
    ------
    ValueError
        If the read-out has no drift.
    """
    if not hasattr(readout, "diffusion"):
        raise ValueError(f"readout: got {readout.name}, expected one with drift: tiger or apv25")
    detector = beam_detector(bz)
    layer = detector.cgem[0]
    particles = beam_particles(detector, particle, p, np.radians(angle), _EVENTS, seed)
    panels = []
    for lorentz, diffusion in _SWITCHES:
        one = replace(readout, lorentz=lorentz, diffusion=diffusion * readout.diffusion)
        result = run(detector, particles, seed=seed, readout=one, until="digitize", threads=1)
        event = int(result.truths["event"][np.argsort(result.truths["energy"])[len(result.truths) // 2]])
        truth = int(np.flatnonzero(result.truths["event"] == event)[0])
        mine = result.steps["truth"] == truth
        count = result.steps["n_electrons"][mine]
        x, y = (np.repeat(result.steps[axis][mine], count) for axis in "xy")
        middle = float(result.truths["phi"][truth])
        start = np.column_stack([_across(layer, np.arctan2(y, x), middle), np.hypot(x, y) - layer.r_gap_in])
        random = np.random.default_rng(seed)  # the same numbers with each switch
        strips = (result.digis["event"] == event) & (result.digis["view"] == 0)
        zero = float(layer.r_readout * np.mod(middle - layer.sheet_phi[0], 2 * np.pi))
        ends = [[result.truths[f"{end}_{axis}"][truth] for axis in "xy"] for end in ("entry", "exit")]
        end_x, end_y = np.array(ends).T
        track = [_across(layer, np.arctan2(end_y, end_x), middle), np.hypot(end_x, end_y) - layer.r_gap_in]
        switches = ((lorentz, "Lorentz angle"), (diffusion, "diffusion"))
        names = [f"{'with' if on else 'without'} {what}" for on, what in switches]
        panels.append(
            FormationPanel(
                title=", ".join(names),
                track=np.column_stack(track),
                drift=_lines(layer, start, bz if lorentz else 0.0, bz, one.diffusion, random),
                foils=_foils(layer),
                anode=layer.anode_radius - layer.r_gap_in,
                pitch=layer.pitch_x,
                strips=(result.digis["strip"][strips] + 0.5) * layer.pitch_x - zero,
                charge=result.digis["charge"][strips],
            )
        )
    return panels


def _across(layer: CgemLayer, phi: Floats, middle: float) -> Floats:
    """Return X from the crossing of mid-gap, mm."""
    return np.asarray(layer.r_readout * np.angle(np.exp(1j * (phi - middle))))


def _foils(layer: CgemLayer) -> Floats:
    """Return the middles of the foils, mm from the cathode."""
    thickness = sum(part.thickness for part in layer.foil)
    steps = np.arange(layer.foils, dtype=np.float64) * (layer.transfer_gap + thickness)
    return np.asarray(layer.drift_gap + thickness / 2 + steps, np.float64)


def _lines(
    layer: CgemLayer, start: Floats, bend: float, bz: float, diffusion: float, random: np.random.Generator
) -> list[Floats]:
    """Return lines of electrons from their start to the anode, each (m, 2) mm: X and distance from the cathode."""
    foils = _foils(layer)
    anode = layer.anode_radius - layer.r_gap_in
    stops = [*zip(foils, (layer.drift_field, *([layer.transfer_field] * (layer.foils - 1))), strict=True)]
    stops.append((anode, layer.induction_field))
    lines: list[Floats] = []
    points = start
    for number, (stop, field) in enumerate(stops):
        gas = transport(layer.gas.ionization, field, bz)
        tangent = np.sign(bend) * gas.tan_lorentz if bend else 0.0
        length = np.maximum(stop - points[:, 1], 0) / _PIECES
        noise = random.normal(size=(len(points), _PIECES)) * diffusion * gas.sigma_x * np.sqrt(length)[:, None]
        at = np.arange(1, _PIECES + 1) * length[:, None]
        x = points[:, :1] + tangent * at + np.cumsum(noise, axis=1)
        path = np.stack([np.hstack([points[:, :1], x]), np.hstack([points[:, 1:], points[:, 1:] + at])], axis=2)
        lines += list(path)
        # Behind the first foil a few lines stand for all electrons of an avalanche.
        points = np.repeat(path[:, -1], _AVALANCHE if number == 0 else 1, axis=0)
    return lines
