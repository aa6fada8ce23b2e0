"""docs/methods/readout.md: what charge and time of the strips measure, and which chip pays at which pitch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

import cgemit as cg
from cgemit.analysis.resolutions import pulls as track_pulls
from cgemit.analysis.widths import measure
from cgemit.base.arrays import Floats
from cgemit.detector.gas import drift_columns
from cgemit.detector.induction import cloud_widths
from cgemit.detector.readouts import AnalogReadout, ChipErrors, Readout
from cgemit.particles.table import particles_from
from cgemit.reconstruction.cluster import charge_clusterer
from cgemit.reconstruction.cluster_errors import COS_THETA as COS_THETAS
from cgemit.reconstruction.cluster_errors import error_inputs, expected_errors
from cgemit.study.readout import errors, scan
from cgemit.tables import Table
from cgemit.truth import assign
from pages.page import Found, Numbers, Page, share_of, span, table

DETECTOR, P, COS_THETA, SEED = "besiii-cgem-design", 1.0, (-0.93, 0.93), 77
TRACKS, BEAM, GHOSTS = 12_000, 4000, 1000
EFFECTS = 4000  # tracks
DESIGNS, IN_EACH, DISPLACED = 32, 3000, 50.0  # designs, muons, mm from the beam line of half of them
READOUTS: dict[str, Readout] = {
    "`binary`": cg.BinaryReadout(), "`tiger`": cg.TigerReadout(),
    "`tiger`, second pass": cg.TigerReadout(second_pass=True),
    "`apv25`": cg.Apv25Readout(), "`apv25`, second pass": cg.Apv25Readout(second_pass=True),
    "`analog-projection`": cg.ProjectionReadout(),
}  # fmt: skip
#: Test beam as shipped with PARSIFAL: angle -> strips, charge (fC), centroid, micro-TPC, merged (um).
PUBLISHED = {
    0: (4.67, 128, 50, 350, 50), 5: (4.75, 114, 114, 330, 110), 10: (5.20, 143, 173, 155, 125),
    15: (5.85, 158, 228, 130, 125), 20: (6.54, 170, 280, 110, 105), 30: (7.90, 178, 380, 110, 105),
    40: (9.00, 190, 460, 120, 115),
}  # fmt: skip
BEAM_CHIP = cg.Apv25Readout(gain=39_000.0)  # nothing but the gain is adjusted
PITCHES = (300, 400, 500, 650, 800, 1000, 1200)  # um
SHOWN = (300, 500, 650, 800, 1200)  # um, in the table; the picture has all
SIMULATED = (300, 650, 1200)  # um
#: Constants of clusters without events in src/cpp/reconstruction/cluster/charge_errors.cpp.
CONSTANTS = {"k": 0.6, "n": 0.9, "wide": 0.8, "chance": 0.014}
CHIPS = {"binary": "#555555", "tiger": "#0072B2", "apv25": "#D55E00"}


@dataclass(frozen=True)
class Tracks:
    """Core widths of clusters (um) and tracks (um, mm, MeV/c), expected ones, and core widths of pulls."""

    readout: str
    x: float
    v: float
    pull_x: float
    pull_v: float
    d_rho: float
    d_z: float
    p: float
    expected_d_rho: float
    expected_d_z: float
    expected_p: float
    pull_dr: float
    pull_phi0: float
    pull_kappa: float
    pull_dz: float
    pull_tanl: float
    pull_p: float


@dataclass(frozen=True)
class Beam:
    """Number of strips, mean charge (fC) and core widths in X (um) at an angle (deg)."""

    angle: int
    strips: float
    charge: float
    centroid: float
    line: float
    merged: float
    track: float


@dataclass(frozen=True)
class Ghosts:
    """Wrong pairs, %, by what selects them."""

    readout: str
    tracks: int
    crossings: float
    geometry: float
    geometry_error: float
    charge_time: float
    charge_time_error: float


@dataclass(frozen=True)
class Pitch:
    """Expected widths (um, mm) at a pitch (um), and simulated ones."""

    readout: str
    pitch: int
    channels: int
    d_rho: float
    d_z: float
    simulated_d_rho: float | None
    simulated_d_z: float | None


@dataclass(frozen=True)
class Constant:
    """A constant of errors without events from simulated clusters: mean over designs, its error, spread of designs."""

    constant: str
    readout: str
    mean: float
    error: float
    spread: float


def simulated(detector: cg.Detector, readout: Readout | str, events: int) -> cg.Result:
    """Return a run of muons of 1 GeV/c."""
    return cg.run(detector, cg.Gun("mu-", p=P, cos_theta=COS_THETA), events, SEED, readout=readout)


def expected(detector: cg.Detector, readout: Readout | str) -> dict[str, float]:
    """Return core widths of the same muons without events."""
    found = cg.analytic(detector, "mu-", p=P, cos_theta=COS_THETA, readout=readout)
    return {name: float(found.sigma(name).item()) for name in ("d_rho", "d_z", "p")}


def widths(result: cg.Result) -> dict[str, float]:
    """Return core widths of the residuals of tracks."""
    return {name: float(cg.resolution(result, name).core) for name in ("d_rho", "d_z", "p")}


def cores(result: cg.Result, clusters: cg.Table) -> dict[str, float]:
    """Return core widths of residuals (um) and pulls of the muons' clusters."""
    own = assign.own_clusters(result.detector, result.clusters, result.truths)
    residual = 1000 * assign.residuals(result.detector, clusters, result.truths, own)
    view, found = clusters["view"][own], {}
    for number, name in enumerate("xv"):
        here, error = view == number, 1000 * clusters[f"err_{name}"][own]
        found[name] = float(measure(residual[here], parameter=name, unit="um").core)
        found[f"pull_{name}"] = float(measure((residual / error)[here], parameter=name, unit="").core)
    return found


def measure_tracks(share: float) -> Numbers:
    """Simulate muons with every readout."""
    detector, events, rows = cg.load(DETECTOR), share_of(TRACKS, share, 500), []
    for name, readout in READOUTS.items():
        result = simulated(detector, readout, events)
        second = isinstance(readout, AnalogReadout) and readout.second_pass
        rows.append(
            Tracks(
                name,
                **cores(result, result.refined_clusters if second else result.clusters),
                **widths(result),
                **{f"expected_{key}": value for key, value in expected(detector, readout).items()},
                **{f"pull_{one.parameter}": float(one.core) for one in track_pulls(result).pulls},
            )
        )
    return Numbers(rows, {"events": f"{events:,} mu- a row, seed {SEED}"})


class Shares(NamedTuple):
    """Simulated clusters, and parts of the variances (mm2) that `charge_errors.cpp` gives them."""

    key: npt.NDArray[np.int64]
    charge: Floats  # fC
    squares: Floats  # k
    even: Floats  # k of a charge that does not fluctuate
    share: Floats  # S
    strips: Floats  # n
    jitter: Floats  # mm2, (u v sigma_t)^2
    excess: Floats  # mm2, epsilon above 0
    width: Floats  # mm2, sigma_w^2
    variance: Floats  # mm2
    without: Floats  # mm2, variance without the part of epsilon


def shares_of(at: errors.Design, jitter: bool, displaced: float, n: int, seed: int) -> Shares:
    """Return the clusters of muons in a design; a single factor in the core's formulas gives each part."""
    readout = errors.with_estimator(at.readout, "centroid")  # its pairs, and so the rows, do not depend on factors
    assert isinstance(readout, AnalogReadout)
    used, inputs = readout if jitter else replace(readout, jitter=0.0), error_inputs(at.detector, readout)
    result = cg.run(at.detector, errors.muons(n, seed, displaced), seed=seed, readout=used, until="digitize")
    clusterer, none = charge_clusterer(used), dict.fromkeys((one.name for one in fields(ChipErrors)), 0.0)
    (group,) = at.detector.with_readout(used).groups
    none |= {"noise": 0.0, "jitter": 0.0, "rise": 0.0, "height_by_threshold": inputs.chip["height_by_threshold"]}

    def clusters(changed: dict[str, float], directions: Floats | None = None) -> Table:
        chip = inputs._replace(chip=inputs.chip | changed)
        columns = clusterer.columns(group, result.digis, chip, directions=directions)
        return Table("clusters", columns, **result.digis.cover)

    directions = errors.true_directions(at.detector, clusters(none), result.truths)

    def measured(changed: dict[str, float]) -> errors.Measurements:
        return errors.measurements(at.detector, clusters(changed, directions), result.truths, lorentz=readout.lorentz)

    base = measured(none)
    # Without a direction another cluster of the crossing is selected; at the edge of a sheet variances are no sums.
    own = assign.own_clusters(at.detector, clusters(none, directions), result.truths)
    known = np.isfinite(directions[own, 0]) & errors.inside_of_sheet(at.detector, base)
    plane = {name: values[base.view * len(at.detector.cgem) + base.layer] for name, values in inputs.planes.items()}

    def part(**changed: float) -> Floats:
        other = measured(none | changed)
        known[other.first != base.first] = False  # another part of a divided cluster has become that of the crossing
        return np.asarray(other.error**2 - base.error**2)

    width = plane["pitch"] ** 2 / 12 + plane["cloud"] + plane["diffusion"]
    along = base.slope**2 * plane["gap"] ** 2 / 12
    span = 12 / (12 / plane["gap"] ** 2 + base.slope**2 / width)
    share = part(span=1.0) / (base.slope**2 * span)
    electrons = np.maximum(base.charge * inputs.chip["electrons_per_fC"], 2.0)
    largest = np.sqrt(np.maximum(share - (1 + inputs.chip["gain_variance"]) / electrons, 0)).clip(1e-9, 0.75)
    # Without a largest ionization cluster there is no wide charge, but V has a share of X's at the edge of a sheet.
    excess = np.where(largest > 1e-9, part(wide=1.0) * (1 - largest) / largest, 0.0)
    cubic = part(noise=1.0) * 12 * base.charge**2 / plane["pitch"] ** 2  # n (n^2 - 1)
    found = Shares(
        (2 * base.truth + base.view) * (1 << 20) + base.first, base.charge,
        part(time=1.0, jitter=1e5) / (base.slope * plane["velocity"] * 1e5) ** 2,
        plane["pitch"] / np.sqrt(12 * (along + width)), share,
        np.searchsorted([i**3 - i - 0.5 for i in range(1, 1000)], cubic, side="right").astype(np.float64),
        (base.slope * plane["velocity"] * inputs.chip["jitter"]) ** 2, excess, width,
        measured({}).error ** 2, measured({"wide": 0.0}).error ** 2,
    )  # fmt: skip
    return Shares._make(values[known] for values in found)


def constants_of(at: errors.Design, n: int, seed: int) -> list[float]:
    """Return the constants in a design, in the order of `CONSTANTS`."""
    pairs = []
    for displaced in (0.0, DISPLACED):
        one, still = (shares_of(at, jitter, displaced, n // 2, seed) for jitter in (True, False))
        _, rows, others = np.intersect1d(one.key, still.key, return_indices=True)
        pairs.append([Shares._make(values[rows] for values in one), Shares._make(values[others] for values in still)])
    one, still = (Shares._make(map(np.concatenate, zip(*parts, strict=True))) for parts in zip(*pairs, strict=True))
    wide = (still.excess > 0) & (one.charge == still.charge) & (one.strips == still.strips)
    variance, without, width = (np.exp(np.log(each).mean()) for each in (still.variance, still.without, still.width))
    return [
        float((one.squares - one.even).sum() / (one.share * (1 - one.even)).sum()),
        float((one.strips - 1 / one.squares).mean()),
        float((one.excess - still.excess)[wide].sum() / one.jitter[wide].sum()),
        float((variance - without) / width),
    ]


def measure_constants(share: float) -> Numbers:
    """Measure the constants of clusters without events in simulated clusters of all designs."""
    designs, n, rows = share_of(DESIGNS, share, 4), share_of(IN_EACH, share, 400), []
    for readout in (cg.TigerReadout(), cg.Apv25Readout()):
        found = np.array([constants_of(errors.design(readout, number), n, 1 + number) for number in range(designs)])
        for name, values in zip(CONSTANTS, found.T, strict=True):
            spread = float(values.std(ddof=1))
            rows.append(Constant(name, readout.name, float(values.mean()), spread / designs**0.5, spread))
    return Numbers(rows, {"events": f"{n} muons in each of {designs} designs"})


def measure_beam(share: float) -> Numbers:
    """Measure a beam of pions at the angles of the test beam, without field."""
    n, rows = share_of(BEAM, share, 300), []
    found = scan.scan(BEAM_CHIP, "angle", list(PUBLISHED), bz=0.0, n=n)
    for angle, (point, _) in zip(PUBLISHED, found.points, strict=True):
        of = [float(point.widths[name].core) for name in ("centroid", "micro-tpc", "merged", "track")]
        rows.append(Beam(angle, point.size, point.charge, *of))
    return Numbers(rows, {"events": f"{n} pi- of 150 GeV/c at each angle"})


def measure_ghosts(share: float) -> Numbers:
    """Measure wrong pairs of several muons on a sheet."""
    n, rows = share_of(GHOSTS, share, 100), []
    for readout in (cg.TigerReadout(), cg.Apv25Readout()):
        for one in scan.scan_ghosts(cg.load(DETECTOR), readout, n=n).points:
            shares = [100 * value for way in scan.WAYS for value in one.wrong[way]]
            rows.append(Ghosts(readout.name, one.tracks, one.crossings, *shares))
    return Numbers(rows, {"events": f"{n} events each"})


@dataclass(frozen=True)
class Effect:
    """Pulls of clusters or tracks of a sample: core widths and means in the first and in the second pass."""

    sample: str
    readout: str
    quantity: str
    n: int
    first: float
    first_error: float
    first_mean: float
    second: float
    second_error: float
    second_mean: float


@dataclass(frozen=True)
class Sample:
    """Tracks that the errors are not made for, and the pulls that show it."""

    name: str
    source: cg.Gun | cg.Table
    quantities: tuple[str, ...] = ("x", "v")
    pitch: int = 650  # um
    readout: type[AnalogReadout] = cg.TigerReadout


def beside(distance: float, n: int) -> cg.Table:
    """Return mu- that pass the beam line on either side at a distance, mm."""
    random = np.random.default_rng(SEED)
    phi, cos_theta = random.uniform(-np.pi, np.pi, n), random.uniform(*COS_THETA, n)
    away, pt = distance * random.choice([-1, 1], n), P * np.sqrt(1 - cos_theta**2)
    columns = {
        "event": np.arange(n), "pdg": np.full(n, 13), "x": -away * np.sin(phi), "y": away * np.cos(phi),
        "z": np.zeros(n), "px": pt * np.cos(phi), "py": pt * np.sin(phi), "pz": P * cos_theta,
    }  # fmt: skip
    return particles_from(columns)


def samples(n: int) -> tuple[Sample, ...]:
    """Return the samples of the table of effects."""
    return (
        Sample("protons of 0.6 GeV/c", cg.Gun("proton", p=0.6, cos_theta=COS_THETA)),
        Sample("protons of 0.4 GeV/c", cg.Gun("proton", p=0.4, cos_theta=COS_THETA)),
        Sample("μ⁻, 0.85 < cos θ < 0.93", cg.Gun("mu-", p=P, cos_theta=(0.85, 0.93))),
        Sample("μ⁻ of 0.2 GeV/c", cg.Gun("mu-", p=0.2, cos_theta=COS_THETA), ("x",)),
        Sample("μ⁺ of 0.2 GeV/c", cg.Gun("mu+", p=0.2, cos_theta=COS_THETA), ("x",)),
        *(
            Sample(
                f"μ⁻ from z = {z} mm, −0.5 < cos θ < 0.5",
                cg.Gun("mu-", p=P, cos_theta=(-0.5, 0.5), vertex=(0, 0, z)),
                ("v",),
            )
            for z in (100, 200)
        ),
        Sample("μ⁻ from 40 mm beside the beam line", beside(40.0, n), ("dr",)),
        Sample(
            "μ⁻, `apv25`, pitch of 0.3 mm",
            cg.Gun("mu-", p=P, cos_theta=COS_THETA),
            ("dr", "dz"),
            pitch=300,
            readout=cg.Apv25Readout,
        ),
    )


def measure_effects(share: float) -> Numbers:
    """Measure the pulls of tracks that the errors are not made for."""
    n, rows = share_of(EFFECTS, share, 300), []
    for sample in samples(n):
        found = []
        for second in (False, True):
            result = cg.run(of_pitch(sample.pitch), sample.source, n, SEED, readout=sample.readout(second_pass=second))
            found.append([_pull_of(result, name) for name in sample.quantities])
        for name, first, again in zip(sample.quantities, *found, strict=True):
            of = [value for one in (first, again) for value in (one.core, one.core_error, one.core_mean)]
            rows.append(Effect(sample.name, sample.readout.name, name, first.n, *of))
    return Numbers(rows, {"events": f"{n:,} tracks a row, seed {SEED}"})


def _pull_of(result: cg.Result, name: str) -> cg.Resolution:
    """Return the pull of the clusters of a view, or of a parameter of the tracks."""
    if name not in "xv":
        return track_pulls(result)[name]
    clusters = result.clusters if result.refined_clusters is None else result.refined_clusters
    own = assign.own_clusters(result.detector, result.clusters, result.truths)
    own = own[clusters["view"][own] == "xv".index(name)]
    residual = assign.residuals(result.detector, clusters, result.truths, own)
    return measure(residual / clusters[f"err_{name}"][own], parameter=name, unit="")


def of_pitch(pitch: int) -> cg.Detector:
    """Return the detector with strips of a pitch, um, in both views."""
    return cg.load(DETECTOR).with_overrides({f"cgem.*.pitch_{view}": f"{pitch} um" for view in "xv"})


def pitches(events: int) -> Iterator[Pitch]:
    """Yield every chip at every pitch."""
    for pitch in PITCHES:
        detector = of_pitch(pitch)
        channels = sum(layer.sheets * (layer.strips_x + layer.strips_v) for layer in detector.cgem)
        for chip in CHIPS:
            at, seen = expected(detector, chip), {}
            if pitch in SIMULATED:
                seen = widths(simulated(detector, chip, events))
            yield Pitch(chip, pitch, channels, at["d_rho"], at["d_z"], seen.get("d_rho"), seen.get("d_z"))


def measure_pitches(share: float) -> Numbers:
    """Work out the widths at every pitch, and simulate some."""
    events = share_of(TRACKS, share, 500)
    return Numbers(list(pitches(events)), {"events": f"{events:,} mu- in each simulation, seed {SEED}"})


def blocks(found: Found) -> dict[str, str]:
    """Return all tables."""
    return {
        "sample": found["tracks"].about["events"],
        "pions": found["beam"].about["events"],
        **_gaps(),
        "correlations": _correlations(),
        "constants-sample": found["constants"].about["events"],
        "constants": _constants(found),
        "tracks": _tracks(found),
        "effects-sample": found["effects"].about["events"],
        "effects": _effects(found),
        "beam": _beam(found),
        "ghosts": _ghosts(found),
        "pitch": _pitches(found),
    }


def _constants(found: Found) -> str:
    """Return the means of each chip, and which constants differ from them by more than the spread of the designs."""
    rows = found["constants"].rows
    means = []
    for chip in ("tiger", "apv25"):
        own = (f"{row.mean:.{2 if row.mean > 0.1 else 4}f}" for row in rows if row.readout == chip)
        means.append(f"{', '.join(own)} (`{chip}`)")
    off = [row for row in rows if abs(row.mean - CONSTANTS[row.constant]) > row.spread]
    apart = " and ".join(f"{CONSTANTS[row.constant]} differs from the mean of `{row.readout}`" for row in off)
    return f"{' and '.join(means)}; {apart or 'none differs'} by more than the spread of the designs"


def _tracks(found: Found) -> str:
    head = ["", "X, V [µm]", "σ(d_ρ) [µm]", "σ(d_z) [µm]", "σ(p) [MeV/c]", "pulls of X, V",
            "pulls of d_ρ, φ_0, κ, d_z, tan λ, p"]  # fmt: skip
    lines = [
        [
            row.readout, f"{row.x:.0f}, {row.v:.0f}", f"{row.d_rho:.0f} ({row.expected_d_rho:.0f})",
            f"{1000 * row.d_z:.0f} ({1000 * row.expected_d_z:.0f})", f"{row.p:.2f} ({row.expected_p:.2f})",
            f"{row.pull_x:.2f}, {row.pull_v:.2f}",
            ", ".join(f"{getattr(row, f'pull_{name}'):.2f}" for name in ("dr", "phi0", "kappa", "dz", "tanl", "p")),
        ]
        for row in found["tracks"].rows
    ]  # fmt: skip
    return table(head, lines)


def _beam(found: Found) -> str:
    head = ["angle", "strips", "charge [fC]", "centroid [µm]", "micro-TPC [µm]", "merged [µm]", "track's angle [µm]"]
    lines = []
    for row in found["beam"].rows:
        strips, *published = PUBLISHED[row.angle]
        pairs = zip(published, (row.charge, row.centroid, row.line, row.merged), strict=True)
        there = [f"{one}, {own:.0f}" for one, own in pairs]
        lines.append([row.angle, f"{strips:.2f}, {row.strips:.2f}", *there, f"{row.track:.0f}"])
    return table(head, lines)


def _effects(found: Found) -> str:
    """Return widths and means of pulls; those of X and V, or of two parameters, stand in one row."""
    symbols = {"x": "X", "v": "V", "dr": "d_ρ", "dz": "d_z"}
    lines = []
    for name in dict.fromkeys(row.sample for row in found["effects"].rows):
        rows = [row for row in found["effects"].rows if row.sample == name]
        cells = [
            ", ".join(f"{round(getattr(row, column), 2) + 0.0:{form}}".replace("-", "−") for row in rows)
            for column, form in (("first", ".2f"), ("first_mean", "+.2f"), ("second", ".2f"), ("second_mean", "+.2f"))
        ]
        lines.append([name, ", ".join(symbols[row.quantity] for row in rows), *cells])
    return table(["tracks", "pulls of", "first pass: width", "mean", "second pass: width", "mean"], lines)


def _gaps() -> dict[str, str]:
    """Return what the gaps behind the first foil do to a cloud in the reference detector."""
    detector = cg.load(DETECTOR)
    drift, width = drift_columns(detector), cloud_widths(detector, 1.0)[0]
    cloud = f"the cloud is {drift['cloud_z'][0]:.2f} mm wide along z and {span(width)} mm along φ"
    return {
        "transfer": f"the transfer gaps delay by {drift['delay'][0]:.0f} ns, and {cloud}",
        "induction": f"{drift['induction'][0]:.0f} ns",
    }


def _correlations() -> str:
    straight = int(np.argmin(np.abs(COS_THETAS)))
    tiger, apv25 = (
        span(expected_errors(cg.load(DETECTOR), readout, "merged", True).correlation[:, straight])
        for readout in (cg.TigerReadout(), cg.Apv25Readout())
    )
    return f"{tiger} (`apv25` {apv25})"


def _ghosts(found: Found) -> str:
    head = ["tracks", "`tiger`: geometry [%]", "charge and time [%]", "`apv25`: geometry [%]", "charge and time [%]"]
    lines = []
    for number in dict.fromkeys(row.tracks for row in found["ghosts"].rows):
        cells = [
            f"{value:.1f} ± {error:.1f}"
            for row in found["ghosts"].rows
            if row.tracks == number
            for value, error in ((row.geometry, row.geometry_error), (row.charge_time, row.charge_time_error))
        ]
        lines.append([number, *cells])
    return table(head, lines)


def _pitches(found: Found) -> str:
    head = ["pitch [mm]", "channels", *(f"`{chip}` [µm]" for chip in CHIPS), "simulated [µm]"]
    rows = {(row.readout, row.pitch): row for row in found["pitch"].rows}
    lines = []
    for pitch in SHOWN:
        here = [rows[chip, pitch] for chip in CHIPS]
        seen = [f"{row.simulated_d_rho:.0f}" for row in here if row.simulated_d_rho is not None]
        values = [f"{row.d_rho:.0f}" for row in here]
        lines.append([f"{pitch / 1000:g}", here[0].channels, *values, ", ".join(seen)])
    return table(head, lines)


def draw(found: Found) -> Figure:
    """Draw sigma(d_rho) against the pitch and against the number of channels."""
    figure, plots = plt.subplots(1, 2, figsize=(9.6, 3.8), sharey=True, dpi=90)
    for chip, color in CHIPS.items():
        rows = [row for row in found["pitch"].rows if row.readout == chip]
        for plot, across in zip(
            plots, ([row.pitch / 1000 for row in rows], [row.channels / 1000 for row in rows]), strict=True
        ):
            plot.plot(across, [row.d_rho for row in rows], "-", color=color, label=f"{chip}, expected")
            seen = [(x, row.simulated_d_rho) for x, row in zip(across, rows, strict=True) if row.simulated_d_rho]
            plot.plot(*zip(*seen, strict=True), "o", color=color, ms=5, label="simulated")
    plots[0].set(xlabel="pitch of X and V (mm)", ylabel=r"$\sigma(d_\rho)$ (µm)")
    plots[1].set(xlabel="channels of X and V (thousands)")
    plots[0].set_ylim(bottom=0)
    plots[0].legend(fontsize=8, frameon=False)
    figure.tight_layout()
    return figure


PAGE = Page(
    "readout", "docs/methods/readout.md", "8 min",
    {
        "tracks": (Tracks, measure_tracks), "beam": (Beam, measure_beam),
        "ghosts": (Ghosts, measure_ghosts), "pitch": (Pitch, measure_pitches), "effects": (Effect, measure_effects),
        "constants": (Constant, measure_constants),
    },
    blocks, {"readout-pitch.png": draw},
)  # fmt: skip
