"""ACTS beside cgemit on the nearest layout that it can build; needs `pyacts`.

Both in one process and one thread, muons from the origin, best of several runs in turns. ACTS gets 40 cylinders of
matter at the radii and with the radiation lengths of the detector: beam pipe, three layers that measure r-phi and z,
separator, 35 layers that measure r-phi. Its hits are smeared positions on these surfaces: no strips, no drift distance,
no side of a wire, no inefficiency, and hits are assigned by truth. cgemit has its own detector, with strips and stereo
wires, sides known; both fits start from the true helix smeared alike.

Fields: ACTS gets a map in r and z of the field that cgemit uses. Finding: ACTS makes seeds of its three CGEM layers
and follows them with its CKF; its wire layers have no stereo. cgemit finds tracks in its own detector and fits them.
"""

from __future__ import annotations

import csv
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cgemit as cg
from cgemit import isa as kernels
from cgemit.base.isa import available
from cgemit.detector import Detector, field_at, load
from cgemit.detector.matter import slabs
from cgemit.particles.gun import Gun
from cgemit.study import measure as width_of
from cgemit.tables.schema import has_momentum
from pages.page import MissingToolError, Numbers, say
from pages.performance.stages import stage_calls
from pages.performance.timing import DETECTOR, SEED, instruction_set, machine

EVENTS, MUONS, RUNS = 20, 100, 3  # of ACTS: muons an event, and how often
CASES = {"1 GeV/c, cos(theta) within 0.8": (1.0, 0.8), "0.3 GeV/c, cos(theta) within 0.8": (0.3, 0.8)}
FIELDS = ("uniform", "finite-solenoid")
TRACKS, IN_ALL, TURNS = (1, 4, 16, 64), 1280, 5  # muons of an event that are to be found, of all events, and how often
SEEDING = ("SpacePointMaker", "GridTripletSeedingAlgorithm", "TrackParamsEstimationAlgorithm", "SeedsToTracks")
FOLLOWING = ("TrackFindingAlgorithm", "GreedyAmbiguityResolutionAlgorithm")
CGEM_VOLUMES = (3, 4, 5)  # numbers of `geometry`: the vacuum has 1, the beam pipe 2
#: A track counts as a muon that is found if it has so many measurements and a momentum within so much of the muons'.
LEAST, WITHIN = 20, 0.1
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
class Found:
    """Cost of finding a muon among `tracks` of an event, us, and how many are found; `isa` is that of the fit."""

    tracks: int
    acts_seeding_us: float
    acts_ckf_us: float
    acts_found: float
    isa: str
    find_us: float
    fit_us: float
    found: float


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


def acts_field(name: str, folder: Path) -> Any:
    """Return one of `FIELDS` for ACTS: constant, or a map of the field in bins of 25 mm, z by z."""
    import acts

    u = acts.UnitConstants
    if name == "uniform":
        return acts.ConstantBField(acts.Vector3(0, 0, 1 * u.T))
    r, z = np.arange(0, 1201, 25.0), np.arange(-2000, 2001, 25.0)
    points = np.array([(radius, 0.0, height) for height in z for radius in r])
    field = -field_at(load(DETECTOR).with_field(name), points)
    np.savetxt(folder / "field.txt", np.column_stack([points[:, 0], points[:, 2], field[:, 0], field[:, 2]]))
    return acts.MagneticFieldMapRz(str(folder / "field.txt"), 1 * u.mm, 1 * u.T)


def sequencer(
    built: Any,
    folder: Path,
    events: int,
    muons: int,
    p: float,
    cos_theta: float,
    seed: int,
    field: Any,
    particle: str = "eMuon",
) -> Any:
    """Return a sequencer of ACTS with gun, simulation and digitization."""
    import acts
    import acts.examples
    from acts.examples import simulation

    u, random = acts.UnitConstants, acts.examples.RandomNumbers(seed=seed)
    s = acts.examples.Sequencer(
        events=events, numThreads=1, logLevel=acts.logging.FATAL, outputDir=str(folder), trackFpes=False
    )
    simulation.addParticleGun(
        s,
        simulation.MomentumConfig(p * u.GeV, p * u.GeV, transverse=False),
        simulation.EtaConfig(-np.arctanh(cos_theta), np.arctanh(cos_theta), uniform=False),
        simulation.PhiConfig(0, 360 * u.degree),
        simulation.ParticleConfig(muons, getattr(acts.PdgParticle, particle), randomizeCharge=False),
        rnd=random,
    )
    simulation.addFatras(s, built, field, random, pMin=0.03)
    simulation.addDigitization(s, built, field, digiConfigFile=folder / "digitization.json", rnd=random)
    return s


def per_muon(folder: Path, muons: int) -> dict[str, float]:
    """Return the us per muon of each algorithm of the last run."""
    with (folder / "timing.csv").open() as file:
        times = {row["identifier"].partition(":")[2]: float(row["time_total_s"]) for row in csv.DictReader(file)}
    return {name: 1e6 * seconds / muons for name, seconds in times.items()}


def smeared_starts(sequencer: Any, seed: int, hypothesis: Any) -> None:
    """Add the true helices, smeared, from which tracks are fitted."""
    import acts
    import acts.examples
    from acts.examples import reconstruction

    u = acts.UnitConstants
    reconstruction.addTruthSmearedSeeding(
        sequencer,
        acts.examples.RandomNumbers(seed=seed),
        "particles_simulated",
        reconstruction.TrackSmearingSigmas(1, 0, 0, 5, 0, 0, 1, 0.005, 0.005, 0.02),
        initialSigmas=[20, 100, 0.2, 0.2, 0.5 / u.GeV, 10 * u.ns],
        initialSigmaQoverPt=0.1 / u.GeV,
        initialSigmaPtRel=0.1,
        initialVarInflation=[1.0] * 6,
        particleHypothesis=hypothesis,
        logLevel=acts.logging.FATAL,
    )


def at_perigee(sequencer: Any, built: Any, field: Any, name: str) -> list[tuple[Any, Any, Any]]:
    """Add the extrapolation of fitted tracks to the beam line; returns their `collector`."""
    import acts
    import acts.examples

    sequencer.addAlgorithm(
        acts.examples.TrackExtrapolationAlgorithm(
            level=acts.logging.FATAL, inputTracks=name, outputTracks=f"{name}_at_perigee", trackingGeometry=built,
            magneticField=field, targetSurface=acts.Surface.createPerigee(acts.Vector3(0, 0, 0)),
        )
    )  # fmt: skip
    return collector(sequencer, f"{name}_at_perigee")


def run_acts(built: Any, folder: Path, p: float, cos_theta: float, seed: int, field: Any) -> dict[str, float]:
    """Return us per muon of each algorithm, sigma(p) (GeV/c) and the fraction of tracks with all measurements."""
    import acts
    from acts.examples import reconstruction

    s = sequencer(built, folder, EVENTS, MUONS, p, cos_theta, seed, field)
    smeared_starts(s, seed, acts.ParticleHypothesis.muon)
    reconstruction.addKalmanTracks(s, built, field)
    tracks = at_perigee(s, built, field, "kf_tracks")
    s.run()
    q_over_p, _, measurements = (np.concatenate(column) for column in zip(*tracks, strict=True))
    fitted = (q_over_p != 0) & (measurements >= 38)
    width = width_of(np.abs(1 / q_over_p[fitted]) - p).core
    return {**per_muon(folder, EVENTS * MUONS), "sigma_p": width, "fitted": float(np.mean(fitted))}


def find_acts(built: Any, folder: Path, tracks: int, seed: int, p: float, cos_theta: float) -> dict[str, float]:
    """Return us per muon of each algorithm and the muons that were found, for so many muons an event."""
    import acts
    import acts.examples
    from acts.examples import reconstruction

    u, quiet, field = acts.UnitConstants, acts.logging.FATAL, acts_field("uniform", folder)
    (folder / "space_points.json").write_text(json.dumps([{"volume": volume} for volume in CGEM_VOLUMES]))
    s = sequencer(built, folder, IN_ALL // tracks, tracks, p, cos_theta, seed, field)
    # The layers have radii of 82, 124 and 167 mm. The limits for scattering include the errors of the points.
    reconstruction.addSeeding(
        s, built, field,
        geoSelectionConfigFile=folder / "space_points.json",
        seedingAlgorithm=reconstruction.SeedingAlgorithm.GridTriplet,
        seedFinderConfigArg=reconstruction.SeedFinderConfigArg(
            r=(0, 200), z=(-500, 500), deltaR=(10, 120), rMinMiddle=100, rMaxMiddle=140, useVariableMiddleSPRange=False,
            collisionRegion=(-50, 50), impactMax=5 * u.mm, minPt=0.1 * u.GeV, cotThetaMax=1.5, maxSeedsPerSpM=1,
            sigmaScattering=50, radLengthPerSeed=0.1,
        ),
        seedFinderOptionsArg=reconstruction.SeedFinderOptionsArg(bFieldInZ=1 * u.T, beamPos=(0, 0)),
        initialSigmas=[5 * u.mm, 20 * u.mm, 3 * u.degree, 5 * u.degree, 0.5 / u.GeV, 10 * u.ns],
        initialSigmaQoverPt=0.1 / u.GeV, initialSigmaPtRel=0.1, initialVarInflation=[1.0] * 6,
        particleHypothesis=acts.ParticleHypothesis.muon, logLevel=quiet,
        rnd=acts.examples.RandomNumbers(seed=seed),
        inputParticles="particles_simulated", selectedParticles="particles_simulated",
    )  # fmt: skip
    reconstruction.addCKFTracks(
        s, built, field,
        ckfConfig=reconstruction.CkfConfig(
            chi2CutOffMeasurement=15.0, chi2CutOffOutlier=25.0, numMeasurementsCutOff=1, seedDeduplication=True,
            stayOnSeed=True,
        ),
        writeTrackSummary=False, writePerformance=False, logLevel=quiet,
    )  # fmt: skip
    reconstruction.addAmbiguityResolution(
        s,
        reconstruction.AmbiguityResolutionConfig(maximumSharedHits=3, nMeasurementsMin=7, maximumIterations=100_000),
        writeTrackSummary=False, writePerformance=False, logLevel=quiet,
    )  # fmt: skip
    kept = collector(s, "tracks")
    s.run()
    q_over_p, _, measurements = (np.concatenate(column) for column in zip(*kept, strict=True))
    momentum = 1 / np.abs(np.where(q_over_p == 0, np.inf, q_over_p))
    return {**per_muon(folder, IN_ALL), "found": found(momentum, measurements, p)}


def found(momentum: Any, measurements: Any, p: float) -> float:
    """Return the tracks that count as found muons, divided by `IN_ALL`; tracks are not matched to muons."""
    return float(np.sum((measurements >= LEAST) & (np.abs(momentum - p) < WITHIN * p)) / IN_ALL)


def collector(sequencer: Any, name: str) -> list[tuple[Any, Any, Any]]:
    """Add an algorithm that keeps q/p (1/GeV), its error and the number of measurements of the tracks of each event."""
    import acts
    import acts.examples

    kept: list[tuple[Any, Any, Any]] = []

    class Collector(acts.examples.IAlgorithm):
        def __init__(self) -> None:
            acts.examples.IAlgorithm.__init__(self, "Collector", acts.logging.FATAL)
            self.tracks = acts.examples.ReadDataHandle(self, acts.examples.ConstTrackContainer, "InputTracks")
            self.tracks.initialize(name)

        def execute(self, context: Any) -> Any:
            tracks = self.tracks(context.eventStore)
            parameters = np.array(tracks.parameters).reshape(-1, 6)
            errors = np.sqrt(np.array(tracks.covariance).reshape(-1, 6, 6)[:, 4, 4])
            kept.append((parameters[:, 4], errors, np.array(tracks.nMeasurements)))
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
    good = has_momentum(tracks)
    return {**costs, "sigma_p": width_of(tracks["p"][good] - p).core, "fitted": float(np.mean(good))}


def find_cgemit(detector: Detector, tracks: int, p: float, cos_theta: float) -> dict[str, float]:
    """Return us per muon of finding and fit and the muons that were found, for so many muons an event."""
    gun = Gun("mu-", multiplicity=tracks, p=p, cos_theta=(-cos_theta, cos_theta))
    made = cg.run(detector, gun, IN_ALL // tracks, SEED, until="cluster", workers=1)
    start = time.perf_counter()
    chosen = cg.find_tracks(detector, made.clusters, made.wire_hits)
    middle = time.perf_counter()
    fitted = cg.fit(detector, made.clusters, made.wire_hits, chosen["candidates"], chosen["candidate_hits"])["tracks"]
    end = time.perf_counter()
    hits = fitted["n_clusters"] + fitted["n_wires"]
    return {
        "find": 1e6 * (middle - start) / IN_ALL,
        "fit": 1e6 * (end - middle) / IN_ALL,
        "found": found(fitted["p"], np.where(has_momentum(fitted), hits, 0), p),
    }


def compare(
    detector: Detector, built: Any, folder: Path, case: str, fields: Sequence[str], runs: int
) -> dict[str, list[Peer]]:
    """Measure one of `CASES` in each field, in turns."""
    p, cos_theta = CASES[case]
    theirs: dict[str, list[dict[str, float]]] = {field: [] for field in fields}
    acts_fields = {field: acts_field(field, folder) for field in fields}
    ours: dict[tuple[str, str], list[dict[str, float]]] = {(field, isa): [] for field in fields for isa in available()}
    for seed in range(1, runs + 1):
        for field, acts_runs in theirs.items():
            acts_runs.append(run_acts(built, folder, p, cos_theta, seed, acts_fields[field]))
        for (field, isa), own_runs in ours.items():
            with instruction_set(isa):
                own_runs.append(run_cgemit(detector.with_field(field), p, cos_theta))

    def best(runs: list[dict[str, float]], *names: str) -> float:
        return min(sum(run[name] for name in names) for run in runs)

    fit = ("TrackFittingAlgorithm", "TrackExtrapolationAlgorithm")
    pairs = (
        ("simulation", ("FatrasSimulation",), "simulate"),
        ("fit, smoother, state at the origin", fit, "fit_kernel"),
        ("the same with tables, first helix from the hits", fit, "fit"),
    )
    for field, acts_runs in theirs.items():
        one, own = acts_runs[0], ours[field, available()[0]][0]
        say(
            f"{case}, {field}: sigma(p) {1e3 * one['sigma_p']:.2f} MeV/c in ACTS, {1e3 * own['sigma_p']:.2f} here; "
            f"fitted {one['fitted']:.2%} there, {own['fitted']:.2%} here"
        )
    return {
        field: [
            Peer(case, what, isa, best(theirs[field], *names), best(ours[field, isa], stage))
            for isa in available()
            for what, names, stage in pairs
        ]
        for field in fields
    }


def versions() -> dict[str, str]:
    """Return the version of ACTS."""
    try:
        import acts
    except ModuleNotFoundError as error:
        raise MissingToolError("it needs ACTS: pip install 'cgemit[validation]'") from error
    return {"ACTS": ".".join(map(str, acts.__version__))}


def measure(_share: float) -> Numbers:
    """Measure all cases."""
    about, detector = versions(), load(DETECTOR)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = geometry(cylinders(detector), folder)
        rows = [row for case in CASES for row in compare(detector, built, folder, case, ("uniform",), RUNS)["uniform"]]
    return Numbers(rows, about)


def measure_finding(_share: float) -> Numbers:
    """Measure the search for tracks, with the widest instruction set, in turns."""
    about, detector, rows = versions(), load(DETECTOR), []
    p, cos_theta = next(iter(CASES.values()))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        built = geometry(cylinders(detector), folder)
        for tracks in TRACKS:
            theirs, ours = [], []
            for seed in range(1, TURNS + 1):
                theirs.append(find_acts(built, folder, tracks, seed, p, cos_theta))
                ours.append(find_cgemit(detector, tracks, p, cos_theta))
            seeding, ckf = (min(sum(run[name] for name in names) for run in theirs) for names in (SEEDING, FOLLOWING))
            find, fit = (min(run[what] for run in ours) for what in ("find", "fit"))
            acts_found = float(np.mean([run["found"] for run in theirs]))
            rows.append(Found(tracks, seeding, ckf, acts_found, kernels.name(), find, fit, ours[0]["found"]))
    return Numbers(rows, about | {"machine": machine()})
