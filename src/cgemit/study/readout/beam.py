"""A test beam: one layer of 2 m radius, which is nearly plane, and particles at a given angle to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cgemit.chain import run
from cgemit.detector import Detector, load
from cgemit.particles import particles_from
from cgemit.result import Result
from cgemit.species import species
from cgemit.statistics.estimate import Resolution, measure
from cgemit.study.readout.calibrate import calibration_from
from cgemit.study.readout.measure import Measurements, common, measurements, true_directions
from cgemit.tables import Table

RADIUS = 2000.0
"""Of the anode, mm."""
LEAST_FIELD = 1e-3  # T
_SPREAD = 20.0  # mm, half-width of the beam at mid-gap
_BEFORE = 3.0  # mm, from the layer's inner face to where particles start


def beam_detector(bz: float = 0.0, **layer: Any) -> Detector:
    """Return a detector of one layer with 650 um strips, a 5/2/2/2 mm stack and Ar/iC4H10 90/10.

    Parameters
    ----------
    bz : float
        T; electrons are bent towards larger phi if it is positive. 0 stands for 1 mT, the least field of a detector.
    **layer
        Keys of the layer that differ, such as ``drift_field="2 kV/cm"``.
    """
    own = {"anode_radius": f"{RADIUS} mm", "length": "400 mm", "sheets": 1, "phi_first": "180 deg", "stereo": "45 deg"}
    tables = {
        "base": "besiii-cgem-design",
        "name": f"beam {bz:g} T",
        "remove": ["cgem.L2", "cgem.L3", "beam_pipe", "walls", "drift_chamber"],
        "field": {"kind": "uniform", "bz": f"{bz or LEAST_FIELD!r} T"},
        "cgem": {"L1": own | layer},
    }
    return load(tables)


def beam_particles(detector: Detector, particle: str, p: float, angle: float, n: int, seed: int) -> Table:
    """Return particles that cross the middle of the gap at an angle to the radius.

    Parameters
    ----------
    detector : Detector
    particle : str
    p : float
        GeV/c.
    angle : float
        rad, in the plane across the beam line, positive towards larger phi.
    n : int
    seed : int
    """
    layer = detector.cgem[0]
    random = np.random.default_rng(seed)
    phi, z = random.uniform(-_SPREAD, _SPREAD, (2, n)) / np.array([[layer.r_mid], [1.0]])
    back = (layer.r_mid - layer.r_in + _BEFORE) / np.cos(angle)
    ux, uy = np.cos(phi + angle), np.sin(phi + angle)
    return particles_from(
        {
            "event": np.arange(n), "pdg": np.full(n, species(particle).pdg), "x": layer.r_mid * np.cos(phi) - back * ux,
            "y": layer.r_mid * np.sin(phi) - back * uy, "z": z, "px": p * ux, "py": p * uy, "pz": np.zeros(n),
        }
    )  # fmt: skip


@dataclass(frozen=True)
class BeamPoint:
    """What a read-out measures of a beam, in one view.

    Attributes
    ----------
    angle : float, deg
    charge : float, fC
        Mean of the clusters, without the largest 2 %.
    size : float
        Mean number of strips.
    efficiency : float
        Share of crossings with a cluster.
    widths : dict of str to Resolution
        Residuals in um by estimator: ``"micro-tpc"`` only of clusters with a line fit; ``"track"`` uses the angle of
        the track (`AnalogReadout.second_pass`).
    """

    angle: float
    charge: float
    size: float
    efficiency: float
    widths: dict[str, Resolution]


def beam_run(
    detector: Detector, readout: Any, angle: float, *, n: int, seed: int, particle: str = "pi-", p: float = 150.0,
    threads: int | None = None,
) -> Result:  # fmt: skip
    """Return a run of a beam up to its digis.

    Parameters
    ----------
    detector : Detector
    readout : AnalogReadout
    angle : float
        deg.
    n : int
    seed : int
    particle : str
    p : float
        GeV/c.
    threads : int or None
    """
    particles = beam_particles(detector, particle, p, np.radians(angle), n, seed)
    return run(detector, particles, seed=seed, readout=readout, until="digitize", threads=threads)


def beam_point(
    detector: Detector, readout: Any, angle: float, *, n: int = 4000, seed: int = 1, particle: str = "pi-",
    p: float = 150.0, threads: int | None = None,
) -> BeamPoint:  # fmt: skip
    """Return what a read-out resolves in X at one angle, see `beam_views`.

    Parameters
    ----------
    detector, readout, angle, n, seed, particle, p, threads
        See `beam_views`.
    """
    return beam_views(detector, readout, angle, n=n, seed=seed, particle=particle, p=p, threads=threads)[0]


def beam_views(
    detector: Detector, readout: Any, angle: float, *, n: int = 4000, seed: int = 1, particle: str = "pi-",
    p: float = 150.0, threads: int | None = None,
) -> tuple[BeamPoint, BeamPoint]:  # fmt: skip
    """Return what a read-out resolves in X and V at one angle; another sample at the same angle calibrates it.

    Parameters
    ----------
    detector : Detector
        As `beam_detector` makes it.
    readout : AnalogReadout or ProjectionReadout
    angle : float
        deg, positive towards larger phi.
    n : int
        Particles in each of the samples.
    seed : int
    particle : str
    p : float
        GeV/c.
    threads : int or None
    """
    other, result = (
        beam_run(detector, readout, angle, n=n, seed=one, particle=particle, p=p, threads=threads)
        for one in (seed + 1, seed)
    )
    calibration = calibration_from(other, readout, "beam")
    if not len(result.truths) or not len(result.digis):
        raise ValueError(
            f"readout: got no {'charge on strips' if len(result.truths) else 'crossing of the layer'} at "
            f"{angle:g} degrees; expected charged particles that cross it, and a lower threshold"
        )
    samples: dict[str, Measurements] = {}
    for name in readout.estimators:
        clusters = replace(readout, estimator=name).cluster_with(detector, result.digis, calibration)
        samples[name] = measurements(detector, clusters, result.truths, lorentz=readout.lorentz)
    if "micro-tpc" in readout.estimators:
        directions = true_directions(detector, clusters, result.truths)
        merged = replace(readout, estimator="merged")
        clusters = merged.cluster_with(detector, result.digis, calibration, directions=directions)
        # Clusters without a line have the centroid, which would be a second population.
        line, centroid = common(samples["micro-tpc"], samples["centroid"])
        samples["micro-tpc"] = Measurements._make(values[line.residual != centroid.residual] for values in line)
        samples["track"] = measurements(detector, clusters, result.truths, lorentz=readout.lorentz)
    x, v = (_view_point(samples, view, angle, len(result.truths)) for view in (0, 1))
    return x, v


def _view_point(samples: dict[str, Measurements], view: int, angle: float, crossings: int) -> BeamPoint:
    """Return what is measured in one view."""
    widths = {
        name: measure(1e3 * sample.residual[sample.view == view], parameter=name, unit="um")
        for name, sample in samples.items()
    }
    sample = next(iter(samples.values()))
    across = sample.view == view
    charges = np.sort(sample.charge[across])
    charge = float(np.mean(charges[: int(0.98 * len(charges))]))
    return BeamPoint(
        angle, charge, float(np.mean(sample.size[across])), int(np.count_nonzero(across)) / crossings, widths
    )
