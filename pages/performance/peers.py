"""ACTS beside cgemit on the nearest layout that it can build; needs `pyacts`.

Both in one process and one thread, muons from the origin, best of several runs in turns. ACTS gets 40 cylinders of
matter at the radii and with the radiation lengths of the detector: beam pipe, three layers that measure r-phi and z,
separator, 35 layers that measure r-phi. Its hits are smeared positions on these surfaces: no strips, no drift distance,
no side of a wire, no inefficiency, and hits are assigned by truth. cgemit has its own detector, with strips and stereo
wires, sides known; both fits start from the true helix smeared alike.
"""

from __future__ import annotations

import csv
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cgemit.base.isa import available
from cgemit.detector import Detector, load
from cgemit.detector.matter import slabs
from cgemit.particles.gun import Gun
from cgemit.study import measure as width_of
from pages.page import MissingToolError, Numbers, say
from pages.performance.stages import stage_calls
from pages.performance.timing import DETECTOR, instruction_set

EVENTS, MUONS, RUNS = 20, 100, 3  # of ACTS: muons an event, and how often
CASES = {"1 GeV/c, cos(theta) within 0.8": (1.0, 0.8), "0.3 GeV/c, cos(theta) within 0.8": (0.3, 0.8)}
SIGMA_RPHI, SIGMA_Z = 0.139, 0.240  # mm, of the CGEM layers; the wires' error is that of the detector
HALF_LENGTH = 1600.0  # mm, so that every muon crosses every layer

# Kapton, scaled to the right number of radiation lengths everywhere: X0 mm, and what the energy loss needs.
X0 = 284.1
MATERIAL = {
    "kind": "material", "radiation_length": X0, "interaction_length": 600.0, "relative_atomic_mass": 12.4,
    "atomic_number": 6.36, "molar_density": 1.42e-3 / 12.4, "molar_electron_density": 1.42e-3 * 0.5126,
    "mean_excitation_energy": 79.6,
}  # fmt: skip
UNITS = {"length": "mm", "angle": "rad", "energy": "eV", "material_amount": "mol"}


@dataclass(frozen=True)
class Peer:
    """Cost of a step per muon in both programs, us."""

    case: str
    what: str
    isa: str
    acts_us: float
    us: float


@dataclass(frozen=True)
class Cylinder:
    """A surface: radius mm, thickness in radiation lengths, errors (mm) of r-phi and z as far as it measures them."""

    radius: float
    x0: float
    sigmas: tuple[float, ...]


def cylinders(detector: Detector) -> list[Cylinder]:
    """Return the detector as ACTS can have it: all matter up to the outer border of a part counts for its cylinder."""
    assert detector.drift_chamber is not None
    pipe, walls = detector.beam_pipe, detector.walls
    parts = [(0.5 * (pipe[0].r_in + pipe[-1].r_out), pipe[-1].r_out, ())]
    parts += [(0.5 * (c.r_gap_in + c.r_gap_out), c.r_out, (SIGMA_RPHI, SIGMA_Z)) for c in detector.cgem]
    parts += [(0.5 * (walls[0].r_in + walls[-1].r_out), walls[-1].r_out, ())]
    parts += [(wires.r_end, wires.r_end, (wires.sigma,)) for wires in detector.drift_chamber.layers]
    borders, x0 = np.array([border for _, border, _ in parts]), np.zeros(len(parts))
    for slab in slabs(detector):
        for shell in slab.shells:
            place = np.searchsorted(borders, 0.5 * (shell.r_in + shell.r_out))
            x0[min(place, len(parts) - 1)] += (shell.r_out - shell.r_in) / shell.material.x0
    return [Cylinder(radius, float(x), sigmas) for (radius, _, sigmas), x in zip(parts, x0, strict=True)]


def geometry(layers: list[Cylinder], folder: Path) -> Any:
    """Build the surfaces, give them their matter and write which of them are read out (digitization.json)."""
    import acts
    import acts.json

    config = acts.Blueprint.Config()
    config.envelope = acts.ExtentEnvelope(r=[0, 10], z=[10, 10])
    root = acts.Blueprint(config)
    container = root.addCylinderContainer("tracker", direction=acts.AxisDirection.AxisR)
    here = acts.Transform3.Identity()
    vacuum = acts.CylinderVolumeBounds(0, layers[0].radius - 2, HALF_LENGTH + 1)
    container.addStaticVolume(here, vacuum, "vacuum")
    # One volume for the wires: the faster way for ACTS.
    first_wire = 1 + max(i for i, layer in enumerate(layers) if not layer.sigmas)
    places = []
    for number, members in enumerate([*([layer] for layer in layers[:first_wire]), layers[first_wire:]]):
        node = container.addLayer(f"layer {number}")
        surfaces = [acts.Surface.createCylinder(here, acts.CylinderBounds(m.radius, HALF_LENGTH)) for m in members]
        for sensitive, (member, surface) in enumerate(zip(members, surfaces, strict=True)):
            # What is sensitive and not digitized ends the program in the assignment of hits.
            surface.assignIsSensitive(bool(member.sigmas))
            places.append({"volume": number + 2, "sensitive": sensitive + 1})
        node.surfaces = surfaces
        node.envelope = acts.ExtentEnvelope(r=[0.5, 0.5], z=[1, 1])
    nowhere = acts.GeometryContext.dangerouslyDefaultConstruct()
    built = root.construct(acts.BlueprintOptions(), nowhere, acts.logging.WARNING)
    (folder / "material.json").write_text(json.dumps(material_map(layers, places)))
    (folder / "digitization.json").write_text(json.dumps(digitization(layers, places)))
    acts.json.TrackingGeometryMaterialJsonConverter().fromFile(folder / "material.json").apply(built)
    if len(built.extractMaterialSurfaces()) != len(layers):
        raise RuntimeError("ACTS: a surface has no matter; expected it on all")
    return built


def material_map(layers: list[Cylinder], places: list[dict[str, int]]) -> dict[str, Any]:
    """Return the matter of each surface in the format of ACTS."""
    settings = {"mapping_type": "default", "split_factor": 1.0}
    surfaces = [
        {
            "target": {"kind": "geometry-id", "geometry_id": place},
            "material": {
                "kind": "homogeneous",
                "settings": settings,
                "slab": {"material": MATERIAL, "thickness": layer.x0 * X0},
            },
        }
        for layer, place in zip(layers, places, strict=True)
    ]
    return {"header": {"format": "acts-material-map", "version": 1, "units": UNITS}, "surfaces": surfaces}


def digitization(layers: list[Cylinder], places: list[dict[str, int]]) -> dict[str, Any]:
    """Return the errors of each measuring surface in the format of ACTS."""
    entries = [
        {
            **place,
            "value": {
                "smearing": [
                    {"index": index, "mean": 0.0, "stddev": sigma, "type": "Gauss"}
                    for index, sigma in enumerate(layer.sigmas)
                ]
            },
        }
        for layer, place in zip(layers, places, strict=True)
        if layer.sigmas
    ]
    header = {"format-version": 0, "value-identifier": "digitization-configuration"}
    return {"acts-geometry-hierarchy-map": header, "entries": entries}


def run_acts(built: Any, folder: Path, p: float, cos_theta: float, seed: int) -> dict[str, float]:
    """Return us per muon of each algorithm, sigma(p) (GeV/c) and the fraction of tracks with all measurements."""
    import acts
    import acts.examples
    from acts.examples import reconstruction, simulation

    u, quiet = acts.UnitConstants, acts.logging.FATAL
    field, random = acts.ConstantBField(acts.Vector3(0, 0, 1 * u.T)), acts.examples.RandomNumbers(seed=seed)
    s = acts.examples.Sequencer(events=EVENTS, numThreads=1, logLevel=quiet, outputDir=str(folder), trackFpes=False)
    simulation.addParticleGun(
        s,
        simulation.MomentumConfig(p * u.GeV, p * u.GeV, transverse=False),
        simulation.EtaConfig(-np.arctanh(cos_theta), np.arctanh(cos_theta), uniform=False),
        simulation.PhiConfig(0, 360 * u.degree),
        simulation.ParticleConfig(MUONS, acts.PdgParticle.eMuon, randomizeCharge=False),
        rnd=random,
    )
    simulation.addFatras(s, built, field, random, pMin=0.03)
    simulation.addDigitization(s, built, field, digiConfigFile=folder / "digitization.json", rnd=random)
    reconstruction.addTruthSmearedSeeding(
        s,
        random,
        "particles_simulated",
        reconstruction.TrackSmearingSigmas(1, 0, 0, 5, 0, 0, 1, 0.005, 0.005, 0.02),
        initialSigmas=[20, 100, 0.2, 0.2, 0.5 / u.GeV, 10 * u.ns],
        initialSigmaQoverPt=0.1 / u.GeV,
        initialSigmaPtRel=0.1,
        initialVarInflation=[1.0] * 6,
        particleHypothesis=acts.ParticleHypothesis.muon,
        logLevel=quiet,
    )
    reconstruction.addKalmanTracks(s, built, field)
    perigee = acts.Surface.createPerigee(acts.Vector3(0, 0, 0))
    s.addAlgorithm(
        acts.examples.TrackExtrapolationAlgorithm(
            level=quiet, inputTracks="kf_tracks", outputTracks="at_perigee", trackingGeometry=built,
            magneticField=field, targetSurface=perigee,
        )
    )  # fmt: skip
    tracks = collector(s)
    s.run()
    with (folder / "timing.csv").open() as file:
        times = {row["identifier"].partition(":")[2]: float(row["time_total_s"]) for row in csv.DictReader(file)}
    per_muon = {name: 1e6 * seconds / (EVENTS * MUONS) for name, seconds in times.items()}
    q_over_p, measurements = (np.concatenate(column) for column in zip(*tracks, strict=True))
    fitted = (q_over_p != 0) & (measurements >= 38)
    width = width_of(np.abs(1 / q_over_p[fitted]) - p).core
    return {**per_muon, "sigma_p": width, "fitted": float(np.mean(fitted))}


def collector(sequencer: Any) -> list[tuple[Any, Any]]:
    """Add an algorithm that keeps q/p (1/GeV) and the number of measurements of the fitted tracks of each event."""
    import acts
    import acts.examples

    kept: list[tuple[Any, Any]] = []

    class Collector(acts.examples.IAlgorithm):
        def __init__(self) -> None:
            acts.examples.IAlgorithm.__init__(self, "Collector", acts.logging.FATAL)
            self.tracks = acts.examples.ReadDataHandle(self, acts.examples.ConstTrackContainer, "InputTracks")
            self.tracks.initialize("at_perigee")

        def execute(self, context: Any) -> Any:
            tracks = self.tracks(context.eventStore)
            kept.append((np.array(tracks.parameters)[:, 4], np.array(tracks.nMeasurements)))
            return acts.examples.ProcessCode.SUCCESS

    sequencer.addAlgorithm(Collector())
    return kept


def run_cgemit(detector: Detector, p: float, cos_theta: float) -> dict[str, float]:
    """Return us per muon of simulation and fit, sigma(p) (GeV/c) and the fraction of good fits."""
    gun = Gun("mu-", p=p, cos_theta=(-cos_theta, cos_theta))
    calls = stage_calls(detector, gun, EVENTS * MUONS)
    costs = {}
    for stage in ("simulate", "fit_kernel", "fit"):
        start = time.perf_counter()
        calls[stage]()
        costs[stage] = 1e6 * (time.perf_counter() - start) / (EVENTS * MUONS)
    tracks = calls["fit"]()["tracks"]
    good = tracks["status"] == 0
    return {**costs, "sigma_p": width_of(tracks["p"][good] - p).core, "fitted": float(np.mean(good))}


def compare(detector: Detector, built: Any, folder: Path, case: str) -> list[Peer]:
    """Measure one case in turns."""
    p, cos_theta = CASES[case]
    theirs = [run_acts(built, folder, p, cos_theta, seed) for seed in range(1, RUNS + 1)]
    ours = {}
    for isa in available():
        with instruction_set(isa):
            ours[isa] = [run_cgemit(detector, p, cos_theta) for _ in range(RUNS)]

    def best(runs: list[dict[str, float]], *names: str) -> float:
        return min(sum(run[name] for name in names) for run in runs)

    fit = ("TrackFittingAlgorithm", "TrackExtrapolationAlgorithm")
    pairs = (
        ("simulation", ("FatrasSimulation",), "simulate"),
        ("fit, smoother, state at the origin", fit, "fit_kernel"),
        ("the same with tables, first helix from the hits", fit, "fit"),
    )
    rows = [
        Peer(case, what, isa, best(theirs, *names), best(runs, stage))
        for isa, runs in ours.items()
        for what, names, stage in pairs
    ]
    here = next(iter(ours.values()))[0]
    say(
        f"{case}: sigma(p) {1e3 * theirs[0]['sigma_p']:.2f} MeV/c in ACTS, {1e3 * here['sigma_p']:.2f} here; fitted "
        f"{theirs[0]['fitted']:.2%} there, {here['fitted']:.2%} here"
    )
    return rows


def measure(_share: float) -> Numbers:
    """Measure all cases."""
    try:
        import acts
    except ModuleNotFoundError as error:
        raise MissingToolError("it needs ACTS: pip install 'cgemit[validation]'") from error
    detector = load(DETECTOR)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = geometry(cylinders(detector), folder)
        rows = [row for case in CASES for row in compare(detector, built, folder, case)]
    return Numbers(rows, {"ACTS": ".".join(map(str, acts.__version__))})
