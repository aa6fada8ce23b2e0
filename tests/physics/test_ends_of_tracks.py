"""Every layer is reached up to its own ends, whatever the length of the layers inside of it."""

import numpy as np
import pytest

import cgemit as cg

#: Radius and half length, mm, of layers that measure. The chamber between them is shorter than the outer ones reach.
LAYERS = {
    "IN1": (40.0, 300.0),
    "IN2": (70.0, 120.0),
    "IN3": (90.0, 400.0),
    "OUT1": (600.0, 1500.0),
    "OUT2": (640.0, 900.0),
}
WIRES = {"radii": (200.0, 500.0), "half_length": 500.0}
#: A field map that is almost uniform; it holds farther out than any part.
FIELDS = {
    "uniform": {"kind": "uniform", "bz": "1 T"},
    "map": {"kind": "harmonic", "bz": "1 T", "b": "1e-4 /m2", "r_max": "2 m", "z_max": "3 m"},
}
TANL = (0.2, -0.9, 1.2, -1.7, 2.2, -2.45, 2.8, 4.0, -6.0, 9.0)


def tracker(field: str = "uniform", chamber: bool = True) -> cg.Detector:
    layers = {
        label: {
            "radius": f"{r} mm",
            "length": f"{2 * half} mm",
            "thickness": "50 um",
            "material": "Si",
            "sigma": "20 um",
        }
        for label, (r, half) in LAYERS.items()
    }
    tables = {
        "name": "tracker", "field": FIELDS[field], "layer": layers,
        "walls": {"shell": {"r_in": "560 mm", "r_out": "561 mm", "half_length": "450 mm", "material": "CarbonFiber"}},
    }  # fmt: skip
    if chamber:
        first = WIRES["radii"][0]
        tables["drift_chamber"] = {
            "gas": "MdcGas", "sigma": "100 um", "half_length": f"{WIRES['half_length']} mm",
            "superlayers": {"S": {"layers": 16, "cells": "20 mm", "height": "20 mm", "r_in": f"{first - 10} mm"}},
        }  # fmt: skip
    return cg.load(tables)


def gun(tanl: float, pt: float = 5.0) -> cg.Gun:
    """Return tracks that are straight to 0.1 mm."""
    return cg.Gun("mu-", p=pt * np.hypot(1.0, tanl), cos_theta=tanl / np.hypot(1.0, tanl))


def reached(detector: cg.Detector, tanl: float) -> list[bool]:
    """Return whether a straight track from the origin crosses the layers, by radius."""
    return [abs(tanl) * layer.r_mid <= layer.half_length for layer in detector.layers]


@pytest.mark.parametrize("chamber", [True, False])
@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("tanl", TANL)
def test_each_layer_is_hit_up_to_its_ends(tanl: float, field: str, chamber: bool) -> None:
    """Simulation, found candidates and expected hits of a stiff track have one hit in each layer that it crosses."""
    detector, n = tracker(field, chamber), 20
    expected = reached(detector, tanl)
    result = cg.run(detector, gun(tanl), n=n, seed=1, workers=1)
    hits = np.bincount(result.truths["layer"], minlength=len(expected)) / n
    np.testing.assert_array_equal(hits, np.array(expected, float))
    if chamber:
        wires = result.wire_truths
        inside = [abs(tanl) * layer.r_mid < 0.98 * layer.half_length for layer in detector.drift_chamber.layers]
        beyond = [abs(tanl) * layer.r_mid > 1.05 * layer.half_length for layer in detector.drift_chamber.layers]
        seen = [
            len(np.unique(wires["event"][wires["layer"] == layer.number])) for layer in detector.drift_chamber.layers
        ]
        assert all(count == n for count, one in zip(seen, inside, strict=True) if one)
        assert not any(count for count, one in zip(seen, beyond, strict=True) if one)
    p, cos_theta = 5.0 * np.hypot(1.0, tanl), tanl / np.hypot(1.0, tanl)
    cov = cg.analytic(detector, "mu-", p=p, cos_theta=cos_theta, threads=1)
    fitted = result.tracks["status"] == 0
    assert fitted.all() == (int(cov.status) == 0) == fitted.any()
    assert fitted.all() or sum(expected) < 3
    if fitted.all():
        assert float(cov.n_clusters) == pytest.approx(2 * sum(expected))
        assert (result.tracks["n_clusters"] == 2 * sum(expected)).all()


@pytest.mark.parametrize("field", FIELDS)
def test_found_tracks_have_the_outer_hits(field: str) -> None:
    """The finder follows tracks beyond the end of the chamber to the layer behind it."""
    detector, tanl = tracker(field), 2.2
    result = cg.run(detector, gun(tanl, pt=2.0), n=40, seed=2, finder="ckf", workers=1)
    good = result.tracks["status"] == 0
    assert good.sum() > 35
    assert np.median(result.tracks["n_clusters"][good]) == 2 * sum(reached(detector, tanl))


def test_the_momentum_error_does_not_jump_where_the_chamber_ends() -> None:
    """The layers behind the chamber measure the momentum of tracks that leave it through its end."""
    end = WIRES["half_length"] / WIRES["radii"][1]
    tanl = end * np.array([0.95, 1.15])
    detector = tracker()
    chamber = detector.with_overrides({"remove": ["layer.OUT*"]})
    errors = [
        cg.analytic(one, "mu-", p=20.0, cos_theta=tanl / np.hypot(1, tanl), threads=1).sigma("p")
        for one in (detector, chamber)
    ]
    assert errors[0][1] == pytest.approx(errors[0][0], rel=0.2)
    assert errors[1][1] > 2 * errors[0][1]


def test_wrapper_of_a_preset() -> None:
    """Tracks of `idea-like` have a hit in each wrapper up to the end of the wrapper, at |cos(theta)| of 0.755."""
    detector = cg.load("idea-like")
    for cos_theta, hits in ((0.70, 1.0), (0.72, 1.0), (-0.75, 1.0), (0.76, 0.0)):
        result = cg.run(detector, cg.Gun("mu-", p=10.0, cos_theta=cos_theta), n=20, seed=1, workers=1)
        counts = np.bincount(result.truths["layer"], minlength=7) / 20
        np.testing.assert_array_equal(counts[5:], hits)


def test_inward_tracks_reach_what_is_inside() -> None:
    """A particle from outside misses the chamber beyond its end and crosses the layers near the beam line."""
    detector = tracker()
    start = np.array([700.0, 0.0, 1700.0])
    p = -50.0 * start / np.linalg.norm(start)
    row = dict(zip(("x", "y", "z", "px", "py", "pz"), map(np.atleast_1d, (*start, *p)), strict=True))
    particles = {
        "event": np.zeros(1, np.int64),
        "particle": np.zeros(1, np.int32),
        "pdg": np.full(1, 13, np.int32),
    } | row
    result = cg.run(detector, particles, seed=1, until="simulate", workers=1)
    tanl = start[2] / start[0]
    assert abs(tanl) * 490 > WIRES["half_length"]
    expected = [number for number, one in enumerate(reached(detector, tanl)) if one]
    assert sorted(result.truths["layer"]) == expected
    both = cg.run(detector, particles, seed=1, until="simulate", workers=1,
                  settings=cg.Settings(simulate=cg.SimulateSettings(half_turns=2)))  # fmt: skip
    assert sorted(both.truths["layer"][both.truths["half_turn"] == -1]) == expected


def test_a_track_ends_where_nothing_is_ahead() -> None:
    """Its status tells tracks that miss what is behind the chamber from those that leave through the outermost part."""
    detector = tracker()
    for tanl, name in ((0.2, "outside"), (1.2, "outside"), (2.45, "end"), (2.8, "end"), (9.0, "end")):
        result = cg.run(detector, gun(tanl), n=5, seed=1, until="simulate", workers=1)
        assert {cg.TransportStatus(s).name for s in result.particles["status"]} == {name}, tanl
