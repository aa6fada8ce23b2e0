"""Single tracks for tests: particles on a given helix, the hits they make, and what the fit needs of them."""

from __future__ import annotations

import math

import numpy as np

from cgemit import _core
from cgemit.detector import Detector, slab_table, slabs
from cgemit.detector.core import compiled_field, layer_table, wire_table
from cgemit.fit_matter import tuned
from cgemit.particles.species import species
from cgemit.reconstruction.candidates import FitHits, collect_hits
from cgemit.tables import Table

MUON = 0.1056583755


def particles(position, momentum, pdg=13):
    """Return a particles table: one event per row of position (n, 3) mm and momentum (n, 3) GeV/c."""
    position, momentum = np.broadcast_arrays(np.atleast_2d(position), np.atleast_2d(momentum))
    n = len(position)
    kind = [species(int(code)) for code in np.broadcast_to(pdg, n)]
    columns = {
        "event": np.arange(n, dtype=np.int64),
        "particle": np.zeros(n, np.int32),
        "pdg": np.array([k.pdg for k in kind], np.int32),
        "charge": np.array([k.charge for k in kind], np.int8),
        "mass": np.array([k.mass for k in kind]),
        "status": np.zeros(n, np.int8),
    }
    columns |= {name: position[:, i] for i, name in enumerate("xyz")}
    columns |= {name: momentum[:, i] for i, name in enumerate(("px", "py", "pz"))}
    return Table("particles", columns, n_events=n)


def hits_of_result(result) -> FitHits:
    """Return the measurements of the candidates of a run, as the fit takes them."""
    return collect_hits(result.detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)


def true_views(detector: Detector, layer, sheet, phi, z):
    """Return X and V, (n,) float64 mm, of points on sheets; one sheet stands for two."""
    cgem = detector.cgem
    start = np.array([(one.sheet_phi * 2)[:2] for one in cgem])[layer, sheet]
    radius, stereo, z_ref = np.array([(one.r_readout, one.stereo, one.z_ref) for one in cgem])[layer].T
    x = radius * np.remainder(phi - start, 2 * np.pi)
    return x, x * np.cos(stereo) + (z_ref - z) * np.sin(stereo)


def on_helix(helix, pdg=13):
    """Return particles that start at the closest points of helices, rows of (dr, phi0, kappa, dz, tanl).

    The sign of kappa chooses between particle and antiparticle.
    """
    dr, phi0, kappa, dz, tanl = np.atleast_2d(helix).T
    pdg = np.where(kappa * species(pdg).charge > 0, pdg, -pdg)
    position = np.stack([dr * np.cos(phi0), dr * np.sin(phi0), dz], axis=1)
    momentum = np.stack([-np.sin(phi0), np.cos(phi0), tanl], axis=1) / np.abs(kappa)[:, None]
    return particles(position, momentum, pdg)


def without_matter(detector: Detector, density=0.0):
    """Return the compiled detector with slabs that neither scatter nor absorb, or do so little: `density` of usual."""
    table = slab_table(slabs(detector))
    columns = table.slabs | {name: density * table.slabs[name] for name in ("x0", "xi", "spread")}
    composition = table.composition | {"moles": density * table.composition["moles"]}
    return _core.detector.Detector(
        bz=detector.field.bz, slabs=columns, log_terms=table.log_terms, composition=composition,
        layers=layer_table(detector.cgem), wires=wire_table(detector.drift_chamber),
        screening=_core.matter.Screening.wentzel,
        field=compiled_field(detector),
    )  # fmt: skip


def transport(core, table, fluctuations="off", seed=1, decays=None, half_turns=1):
    """Run the compiled simulation alone; nothing decays unless a table of decays is given."""
    names = ("event", "particle", "pdg", "charge", "mass", "x", "y", "z", "px", "py", "pz")
    columns = {name: table[name] for name in names}
    fluctuations = getattr(_core.simulation.Fluctuations, fluctuations)
    return _core.simulation.simulate(
        core, columns, fluctuations=fluctuations, decays=decays, half_turns=half_turns, seed=seed
    )


def hits_of(detector: Detector, out):
    """Return one X and one V hit per crossed gap and one hit per wire layer: where simulated, without errors.

    Positions are those of the track in the middle of the gap, by the formulas of docs/conventions.md.
    """
    rows = []
    truths, wires = out["truths"], out["wire_truths"]
    for i, number in enumerate(truths["layer"]):
        layer = detector.cgem[number]
        for sheet, edge in enumerate(layer.sheet_phi):
            x = layer.r_readout * ((truths["phi"][i] - edge) % (2 * math.pi))
            if x < layer.strips_x * layer.pitch_x:
                v = x * math.cos(layer.stereo) + (layer.z_ref - truths["z"][i]) * math.sin(layer.stereo)
                rows += [(0, number, sheet, x, 0), (1, number, sheet, v, 0)]
                break
    for number in np.unique(wires["layer"]):
        in_layer = np.flatnonzero(wires["layer"] == number)
        i = in_layer[np.argmin(np.abs(wires["doca"][in_layer]))]
        rows.append((2, number, wires["wire"][i], abs(wires["doca"][i]), wires["side"][i]))
    kind, layer, channel, value, side = zip(*rows, strict=True)
    return {
        "kind": np.array(kind, np.uint8),
        "layer": np.array(layer, np.int32),
        "channel": np.array(channel, np.int32),
        "size": np.zeros(len(rows), np.int32),
        "value": np.array(value),
        "sigma": np.where(np.array(kind) == 2, 0.13, 0.12),
        "side": np.array(side, np.int8),
    }


def hits_on(detector: Detector, helix, pdg=13):
    """Return the hits of a particle that starts on a helix and slows down, but does not scatter."""
    return hits_of(detector, transport(tuned(detector), on_helix(helix, pdg)))


def order_of_matter(detector, hits, n_noise, turns_back=False):
    """Return for each hit how many noise vectors lie inside it, from the radii of slabs and layers."""
    columns = slab_table(slabs(detector)).slabs
    shifts = columns["spread"] * 13.6e-3 * np.sqrt(columns["x0"]) > 5e-3
    vectors = np.where(shifts, 5, 3)  # two angles and the loss, two shifts where the matter is thick
    layers = {layer.number: layer.r_mid for layer in detector.drift_chamber.layers}
    inside = []
    for kind, number in zip(hits["kind"], hits["layer"], strict=True):
        radius = layers[number] if kind == 2 else columns["radius"][columns["gap"] == number][0]
        inside.append(vectors[columns["radius"] < radius - 1e-9].sum())
    crossed = np.maximum.accumulate(inside)  # also where a curling track comes back
    if turns_back:  # perhaps between a slab and a wire behind it
        return np.minimum(crossed, n_noise)
    assert crossed[-1] == n_noise
    return crossed
