"""The design CGEM and wire layers as hand-written numbers, and helix tracks through them in plain numpy."""

import numpy as np

from cgemit import _core
from cgemit.detector.drift import BESIII

RADIUS = 3335.6409519815204  # mm T/(GeV/c)
DEGREE = np.pi / 180


def in_place(name, n):
    """Columns of the placement of n parts that are where they are described."""
    return {f"{name}_shift": np.zeros((n, 3)), f"{name}_turn": np.tile(np.eye(3).ravel(), (n, 1))}


def design_layers(drift_gap=5.0):
    """Columns of the three design layers (anode radii 87.5, 132.5, 175 mm, pitch 0.65 mm)."""
    r_readout = np.array([87.5, 132.5, 175.0])
    half_length = np.array([266.0, 345.0, 423.5])
    sheets = np.array([1, 2, 2], "i4")
    sign = np.array([1, -1, 1])
    strips_x = np.floor(2 * np.pi * r_readout / (sheets * 0.65)).astype("i4")
    stereo = np.arctan((strips_x - 1) * 0.65 / (2 * half_length))
    strips_v = np.floor(4 * half_length * np.sin(stereo) / 0.65).astype("i4")
    per_layer = sheets * (strips_x + strips_v)
    return {
        "r_readout": r_readout,
        "r_gap_in": r_readout - 6.162 - drift_gap,
        "r_gap_out": r_readout - 6.162,
        "z_min": -half_length,
        "z_max": half_length,
        "pitch_x": np.full(3, 0.65),
        "pitch_v": np.full(3, 0.65),
        "stereo": sign * stereo,
        "offset_v": np.zeros(3),
        "dead_seam": np.zeros(3),
        "dead_ends": np.zeros(3),
        "ladders": np.zeros(3, np.int32),
        "ladder_gap": np.zeros(3),
        "ladder_first": np.zeros(3),
        "lorentz_shift": np.zeros(3),
        "z_scale": np.zeros(3),
        "slope": np.zeros(3),
        "has_x": np.ones(3, bool),
        "has_v": np.ones(3, bool),
        "phi_first": np.tile([np.pi, 0.0], (3, _core.detector.MOST_SHEETS // 2)),
        **in_place("placement", 3),
        "sheets": sheets,
        "strips_x": strips_x,
        "strips_v": strips_v,
        "gid_first": (np.cumsum(per_layer) - per_layer).astype("i4"),
    }


def wire_layers(sigma=0.13, sigma_slope=0.0, efficiency=1.0):
    """Columns of two small wire layers, numbered 8 and 11."""
    return {
        "number": np.array([8, 11], "i4"),
        "cells": np.array([100, 120], "i4"),
        "gid_first": np.array([484, 584], "i4"),
        "r_end": np.array([200.0, 250.0]),
        "z_min": np.array([-1000.0, -1000.0]),
        "z_max": np.array([1000.0, 1000.0]),
        "twist": np.zeros(2),
        "phi_east": np.zeros(2),
        "sigma": np.full(2, sigma),
        "sigma_slope": np.full(2, sigma_slope),
        "efficiency": np.full(2, efficiency),
        # The relation of BESIII.
        "point_layer": np.repeat(np.arange(2, dtype="i4"), len(BESIII.time)),
        "point_distance": np.tile(BESIII.distance, 2),
        "point_time": np.tile(BESIII.time, 2),
        "ramp_layer": np.zeros(0, "i4"),
        "ramp_from": np.zeros(0),
        "ramp_change": np.zeros(0),
        "masked_layer": np.zeros(0, "i4"),
        "masked_wire": np.zeros(0, "i4"),
        "single_layer": np.zeros(0, "i4"),
        "single_wire": np.zeros(0, "i4"),
        **{f"single_{end}_{way}": np.zeros(0) for end in ("east", "west") for way in ("r", "phi")},
        **{f"{end}_{name}": np.zeros(2) for end in ("east", "west") for name in ("x", "y", "rotation")},
        **in_place("placement", 2),
        **in_place("chamber", 1),
    }


def core_detector(cgem=None, wires=None, bz=-1.0):
    """Compiled detector without matter."""
    reals = ("r_in", "r_out", "radius", "spread", "z_min", "z_max", "x0", "xi")
    slabs = {name: np.empty(0) for name in reals} | {"gap": np.empty(0, "i4"), "filler": np.empty(0, "u1")}
    return _core.detector.Detector(
        bz=bz,
        slabs=slabs,
        log_terms=np.empty((0, _core.detector.LOSS_POINTS)),
        composition={"first": np.zeros(1, "i4")} | {name: np.empty(0) for name in ("z", "a", "moles")},
        layers=design_layers() if cgem is None else cgem,
        wires=wire_layers() if wires is None else wires,
        screening=_core.matter.Screening.wentzel,
    )


def truth_columns(event, layer, entry, exit_, middle=None, particle=None, energy=3.0, time=1.0):
    """Columns of truths from points (n, 3); mid-gap phi and z are those of `middle` (default: half-way)."""
    entry, exit_ = np.atleast_2d(entry).astype(float), np.atleast_2d(exit_).astype(float)
    n = len(entry)
    middle = 0.5 * (entry + exit_) if middle is None else middle

    def full(value, dtype):
        return np.ascontiguousarray(np.broadcast_to(value, n), dtype)

    columns = {"event": full(event, "i8"), "layer": full(layer, "i4")}
    columns["particle"] = full(0 if particle is None else particle, "i4")
    for name, points in (("entry", entry), ("exit", exit_)):
        columns |= {f"{name}_{axis}": points[:, k].copy() for k, axis in enumerate("xyz")}
    columns["phi"] = np.arctan2(middle[:, 1], middle[:, 0])
    columns["r"] = np.hypot(middle[:, 1], middle[:, 0])
    columns["z"] = middle[:, 2].copy()
    columns |= {name: full(0.0, "f8") for name in ("px", "py", "pz", "path")}
    columns |= {"time": full(time, "f8"), "energy": full(energy, "f8")}
    return columns | {"secondaries": full(0, "u1"), "daughter": full(0, "i4"), "half_turn": full(0, "i1")}


def step_columns(truths, truth, middle, vector, energy=1.0, parent=1, delta=1):
    """Columns of steps of the truths with row numbers `truth`, from middles and vectors (n, 3)."""
    middle, vector = np.atleast_2d(middle).astype(float), np.atleast_2d(vector).astype(float)
    truth = np.broadcast_to(truth, len(middle)).astype("i8")

    def full(value, dtype):
        return np.ascontiguousarray(np.broadcast_to(value, len(middle)), dtype)

    columns = {name: truths[name][truth] for name in ("event", "particle", "layer")} | {"truth": truth}
    for prefix, points in (("", middle), ("d", vector)):
        columns |= {prefix + axis: points[:, k].copy() for k, axis in enumerate("xyz")}
    columns |= {"energy": full(energy, "f8"), "n_electrons": full(0, "i4")}
    return columns | {"parent": full(parent, "i1"), "delta": full(delta, "i4")}


def no_steps():
    """Columns of steps without rows."""
    names = {"event": "i8", "particle": "i4", "layer": "i4"}
    truths = {name: np.empty(0, dtype) for name, dtype in names.items()}
    return step_columns(truths, np.empty(0), np.empty((0, 3)), np.empty((0, 3)))


def wire_truth_columns(event, layer, wire, doca, particle=0):
    """Columns of wire_truths; event, layer, wire, doca and particle are numbers or (n,)."""
    event, layer, wire, doca, particle = np.broadcast_arrays(event, layer, wire, np.atleast_1d(doca), particle)
    numbers = {"event": event, "particle": particle, "layer": layer, "wire": wire}
    columns = {name: values.astype("i8" if name == "event" else "i4") for name, values in numbers.items()}
    columns |= {name: np.zeros(len(doca)) for name in ("x", "y", "z", "time")}
    columns |= {"daughter": np.zeros(len(doca), "i4"), "half_turn": np.zeros(len(doca), "i1")}
    return columns | {"doca": doca.astype(float), "side": np.where(doca < 0, -1, 1).astype("i1")}


def helix_points(p, cos_theta, phi, charge, bz, radius):
    """Where helices from the origin cross a cylinder the first time: circle about (R cos, R sin) of the centre."""
    p_t = p * np.sqrt(1 - cos_theta**2)
    bend = RADIUS * p_t / (charge * bz)  # signed radius; bz < 0 turns positive charges to larger azimuth
    half_turn = np.arcsin(radius / (2 * np.abs(bend)))
    azimuth = phi - np.sign(bend) * half_turn
    z = 2 * np.abs(bend) * half_turn * cos_theta / np.sqrt(1 - cos_theta**2)
    return np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z])


def muons_through(cgem, n, seed, p=1.0, limit=0.93, charge=-1, bz=-1.0):
    """Truth columns of n tracks from the origin, one an event, cos(theta) uniform, through every layer."""
    rng = np.random.default_rng(seed)
    cos_theta, phi = rng.uniform(-limit, limit, n), rng.uniform(-np.pi, np.pi, n)
    layers = len(cgem["r_readout"])
    inner, outer = cgem["r_gap_in"], cgem["r_gap_out"]
    points = [
        [helix_points(p, cos_theta, phi, charge, bz, r) for r in (inner[i], outer[i], 0.5 * (inner[i] + outer[i]))]
        for i in range(layers)
    ]
    entry, exit_, middle = (np.stack([layer[k] for layer in points], axis=1).reshape(-1, 3) for k in range(3))
    return truth_columns(np.repeat(np.arange(n), layers), np.tile(np.arange(layers), n), entry, exit_, middle)
