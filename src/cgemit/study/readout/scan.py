"""Resolution of a readout in a beam against incidence, fields, gain or threshold; ghosts and formation of clusters."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import TYPE_CHECKING, Any

import numpy as np

from cgemit.analysis.quantities import X
from cgemit.analysis.widths import Resolution, measure
from cgemit.base.arrays import Floats
from cgemit.base.validate import check_numbers
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.detector import Detector, load
from cgemit.detector.gas import transport
from cgemit.detector.layers import CgemLayer
from cgemit.detector.readouts import AnalogReadout, ChargeReadout, names_of
from cgemit.draw.cluster import FormationPanel
from cgemit.particles.gun import Gun
from cgemit.particles.species import species
from cgemit.particles.table import particles_from
from cgemit.reconstruction.cluster import cluster
from cgemit.study.readout.errors import Measurements, common, measurements, true_directions, with_estimator
from cgemit.tables import Table
from cgemit.tables.show import Shown, with_error

if TYPE_CHECKING:
    from cgemit.draw.style import Picture


RADIUS = 2000.0
"""Of the anode, mm."""
_SPREAD = 20.0  # mm, half-width of the beam at mid-gap
_FEWEST = 50  # clusters with a line that have a width
_BEFORE = 3.0  # mm, from the layer's inner face to where particles start


def beam_detector(bz: float = 0.0, **layer: Any) -> Detector:
    """Return a detector of one layer with 650 um strips, a 5/2/2/2 mm stack and Ar/iC4H10 90/10.

    Parameters
    ----------
    bz : float
        T; electrons are bent towards larger phi if it is positive.
    **layer
        Keys of the layer that differ, such as ``drift_field="2 kV/cm"``.
    """
    own = {"anode_radius": f"{RADIUS} mm", "length": "400 mm", "sheets": 1, "phi_first": "180 deg", "stereo": "45 deg"}
    tables = {
        "base": "besiii-cgem-design",
        "name": f"beam {bz:g} T",
        "remove": ["cgem.L2", "cgem.L3", "beam_pipe", "walls", "drift_chamber"],
        "field": {"kind": "uniform", "bz": f"{bz!r} T"},
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
    check_numbers("beam_particles", seed)
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
    """What a readout measures of a beam, in one view.

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
        Residuals in um by estimator: ``"micro-tpc"`` only of clusters with a line fit; ``"merged"`` the mean of this
        and the centroid; ``"track"`` uses the angle of the track (`AnalogReadout.second_pass`).
    """

    angle: float
    charge: float
    size: float
    efficiency: float
    widths: dict[str, Resolution]


def beam_run(
    detector: Detector, readout: ChargeReadout, angle: float, *, n: int, seed: int, particle: str = "pi-",
    p: float = 150.0, threads: int | None = None,
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
    return run(detector, particles, seed=seed, readout=readout, until="digitize", workers=threads)


def beam_views(
    detector: Detector, readout: ChargeReadout, angle: float, *, n: int = 4000, seed: int = 1,
    particle: str = "pi-", p: float = 150.0, threads: int | None = None,
) -> tuple[BeamPoint, BeamPoint]:  # fmt: skip
    """Return what a readout resolves in X and V at one angle.

    The mean of centroid and line has the weights of their widths in another sample at this angle.

    Parameters
    ----------
    detector : Detector
        As `beam_detector` makes it.
    readout : ChargeReadout
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
    check_numbers("beam_views", seed, threads)
    (samples, crossings), (other, _) = (
        _estimates(beam_run(detector, readout, angle, n=n, seed=one, particle=particle, p=p, threads=threads), angle)
        for one in (seed, seed + 1)
    )
    if "micro-tpc" in samples:
        line, centroid = common(samples["micro-tpc"], samples["centroid"])
        # Weights at this angle are found with another sample.
        share = _line_shares(*common(other["micro-tpc"], other["centroid"]))[line.view]
        merged = centroid.residual + share * (line.residual - centroid.residual)
        samples["merged"] = centroid._replace(residual=merged)
        # Clusters without a line have the centroid, which would be a second population.
        samples["micro-tpc"] = Measurements._make(values[line.residual != centroid.residual] for values in line)
    order = [name for name in ("centroid", "micro-tpc", "merged", "track") if name in samples]
    x, v = (_view_point({name: samples[name] for name in order}, view, angle, crossings) for view in (0, 1))
    return x, v


def _estimates(result: Result, angle: float) -> tuple[dict[str, Measurements], int]:
    """Return the clusters of a beam by estimator, ``"track"`` with the true slope, and the number of crossings."""
    detector, digis, truths = result.detector, result.digis, result.truths
    readout = detector.cgem[0].readout
    assert isinstance(readout, ChargeReadout)
    if not len(truths) or not len(digis):
        raise ValueError(
            f"readout: got no {'charge on strips' if len(truths) else 'crossing of the layer'} at "
            f"{angle:g} degrees; expected charged particles that cross it, and a lower threshold"
        )
    estimates: dict[str, Measurements] = {}
    for name in ("centroid", "micro-tpc") if isinstance(readout, AnalogReadout) else ("centroid",):
        clusters = cluster(detector, digis, readout=with_estimator(readout, name))
        estimates[name] = measurements(detector, clusters, truths)
    if isinstance(readout, AnalogReadout):
        directions = true_directions(detector, clusters, truths)
        clusters = cluster(detector, digis, readout=with_estimator(readout, name), directions=directions)
        estimates["track"] = measurements(detector, clusters, truths)
    return estimates, len(truths)


def _line_shares(line: Measurements, centroid: Measurements) -> Floats:
    """Return the weights of lines in X and V, (2,): inverse squares of the core widths, as in the published means."""
    shares = np.zeros(2)
    for view in (0, 1):
        mine = (line.view == view) & (line.residual != centroid.residual)
        if np.count_nonzero(mine) >= _FEWEST:
            of_line, of_centroid = (measure(one.residual[mine]).core for one in (line, centroid))
            shares[view] = of_centroid**2 / (of_centroid**2 + of_line**2)
    return shares


def _view_point(samples: dict[str, Measurements], view: int, angle: float, crossings: int) -> BeamPoint:
    """Return what is measured in one view."""
    widths = {
        name: measure(X.factor * sample.residual[sample.view == view], parameter=name, unit=X.unit)
        for name, sample in samples.items()
    }
    sample = next(iter(samples.values()))
    across = sample.view == view
    charges = np.sort(sample.charge[across])
    charge = float(np.mean(charges[: int(0.98 * len(charges))]))
    return BeamPoint(
        angle, charge, float(np.mean(sample.size[across])), int(np.count_nonzero(across)) / crossings, widths
    )


#: What can be scanned, with the unit of its values.
QUANTITIES = {"angle": "deg", "bz": "T", "drift_field": "kV/cm", "gain": "", "threshold": "fC"}
WORDS = {"angle": "angle of incidence", "bz": "magnetic field"}  # others are what they are called
VIEWS = ("X", "V")

_ABOUT = ("charge_fC", "strips", "efficiency")


@dataclass(frozen=True, eq=False, repr=False)
class BeamScan(Shown):
    """What a readout resolves at several values of one quantity.

    Attributes
    ----------
    title : str
        Readout, beam, and what is fixed.
    quantity : str
        One of `QUANTITIES`.
    values : (n,) float64
        In its unit.
    points : tuple of (BeamPoint, BeamPoint)
        Of X and V at each value.
    """

    title: str
    quantity: str
    values: Floats
    points: tuple[tuple[BeamPoint, BeamPoint], ...]

    @property
    def label(self) -> str:
        """The quantity with its unit, such as ``"drift field  (kV/cm)"``, for an axis."""
        unit = QUANTITIES[self.quantity]
        return WORDS.get(self.quantity, self.quantity.replace("_", " ")) + (f"  ({unit})" if unit else "")

    def of_view(self, view: int, name: str) -> Floats:
        """Return an attribute of `BeamPoint`, such as ``"size"``, in X (0) or V (1), (n,) float64."""
        return np.array([getattr(point[view], name) for point in self.points])

    def curves(self, view: int = 0) -> dict[str, tuple[Floats, Floats]]:
        """Return core widths and their errors in X (0) or V (1), each (n,) float64 um, by estimator."""
        return {
            name: (
                np.array([point[view].widths[name].core for point in self.points]),
                np.array([point[view].widths[name].core_error for point in self.points]),
            )
            for name in self.points[0][view].widths
        }

    def to_csv(self) -> str:
        """Return the text of a CSV file, one row for a value and a view; widths are core widths, in um."""
        names = list(self.points[0][0].widths)
        unit = QUANTITIES[self.quantity].replace("/", "_per_")
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        head = [f"{self.quantity}_{unit}" if unit else self.quantity, "view", *_ABOUT]
        writer.writerow([*head, *(f"{name}{end}_um" for name in names for end in ("", "_error", "_q68"))])
        for value, views in zip(self.values, self.points, strict=True):
            for view, point in zip(VIEWS, views, strict=True):
                widths = [(one.core, one.core_error, one.q68) for one in (point.widths[name] for name in names)]
                numbers = [point.charge, point.size, point.efficiency, *(number for one in widths for number in one)]
                writer.writerow([f"{value:.6g}", view, *(f"{number:.6g}" for number in numbers)])
        return text.getvalue()

    def draw(self) -> Picture:
        """Draw core widths of the estimators, number of strips and efficiency in both views."""
        from cgemit.draw.curves import ViewCurves, draw_readout

        views = [
            ViewCurves(name, self.curves(view), self.of_view(view, "size"), self.of_view(view, "efficiency"))
            for view, name in enumerate(VIEWS)
        ]
        return draw_readout(self.values, self.label, views, self.title)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        names = list(self.points[0][0].widths)
        rows = [
            [f"{value:g}", view, f"{point.charge:.1f}", f"{point.size:.2f}", f"{100 * point.efficiency:.2f}"]
            + [with_error(point.widths[name].core, point.widths[name].core_error) for name in names]
            for view, one in zip(VIEWS, range(2), strict=True)
            for value, point in zip(self.values, (views[one] for views in self.points), strict=True)
        ]
        unit = QUANTITIES[self.quantity]
        first = self.quantity.replace("_", " ") + (f" [{unit}]" if unit else "")
        head = (first, "view", "Q [fC]", "strips", "eff. [%]", *(f"{name} [um]" for name in names))
        return self.title, head, rows


def scan(
    readout: ChargeReadout, quantity: str, values: Sequence[float], *, angle: float = 0.0, bz: float = 1.0,
    n: int = 4000, seed: int = 1, particle: str = "pi-", p: float = 150.0, threads: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> BeamScan:  # fmt: skip
    """Return what a readout resolves at several values of one quantity, all else fixed.

    Parameters
    ----------
    readout : ChargeReadout
    quantity : str
        One of `QUANTITIES`.
    values : sequence of float
        In its unit.
    angle : float
        deg, of incidence, positive towards larger phi.
    bz : float
        T.
    n : int
        Particles at each value.
    seed : int
    particle : str
    p : float
        GeV/c.
    threads : int or None
    progress : callable or None
        Called with the fraction done after every value.
    """
    check_numbers("scan", seed, threads)
    points = []
    for number, value in enumerate(values):
        detector, one, degrees = _setting(readout, quantity, float(value), angle, bz)
        points.append(beam_views(detector, one, degrees, n=n, seed=seed, particle=particle, p=p, threads=threads))
        if progress is not None:
            progress((number + 1) / len(values))
    fixed = [f"{bz:g} T"] * (quantity != "bz") + [f"{angle:g} deg"] * (quantity != "angle")
    title = ", ".join([readout.name, *fixed, f"{particle} of {p:g} GeV/c", f"{n} at each value"])
    return BeamScan(title, quantity, np.array(values, np.float64), tuple(points))


def _setting(
    readout: ChargeReadout, quantity: str, value: float, angle: float, bz: float
) -> tuple[Detector, ChargeReadout, float]:
    """Return detector, readout and angle (deg) of one value."""
    if quantity == "angle":
        angle = float(np.round(value, 9))
    layer = {"drift_field": f"{value!r} kV/cm"} if quantity == "drift_field" else {}
    detector = beam_detector(value if quantity == "bz" else bz, **layer)
    if quantity == "gain":
        readout = replace(readout, gain=value)
    if quantity == "threshold":
        if isinstance(readout, AnalogReadout):
            readout = replace(readout, threshold_x=value, threshold_v=value)
        else:
            readout = replace(readout, threshold=value)
    return detector, readout, angle


_PIECES = 12  # of a line in a gap
_AVALANCHE = 6  # lines that stand for an avalanche behind the first foil
_EVENTS = 20  # of which that with the median charge is drawn
_SWITCHES = ((False, 0.0), (True, 0.0), (False, 1.0), (True, 1.0))  # Lorentz angle, diffusion


def formation(
    readout: ChargeReadout,
    *,
    angle: float = 20.0,
    bz: float = 1.0,
    seed: int = 1,
    particle: str = "mu-",
    p: float = 1.0,
) -> list[FormationPanel]:
    """Return one track's way to the strips without and with Lorentz angle and diffusion.

    The track and its ionization are simulated, and strips and charges are those of the readout. Lines of electrons
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
        If the readout has no drift.
    """
    if not isinstance(readout, AnalogReadout):
        raise ValueError(f"readout: got {readout.name}, expected one of {names_of(AnalogReadout)}")
    detector = beam_detector(bz)
    layer = detector.cgem[0]
    particles = beam_particles(detector, particle, p, np.radians(angle), _EVENTS, seed)
    panels = []
    for lorentz, diffusion in _SWITCHES:
        changed = replace(readout, lorentz=lorentz, diffusion=diffusion * readout.diffusion)
        result = run(detector, particles, seed=seed, readout=changed, until="digitize", workers=1)
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
                drift=_lines(layer, start, bz if lorentz else 0.0, bz, changed.diffusion, random),
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


WAYS = ("geometry", "charge and time")
_APART = 1e6  # of the score of pairs that do not cross on the sheet
_HEAD = ("tracks", "crossings of clusters per track", *(f"wrong by {way} [%]" for way in WAYS))


@dataclass(frozen=True)
class GhostPoint:
    """Pairs at one number of tracks on a sheet.

    Attributes
    ----------
    tracks : int
    crossings : float
        Pairs that cross on the sheet, per track.
    wrong : dict of str to (float, float)
        Share of pairs of different particles and its error, by what selects the pairs (`WAYS`).
    """

    tracks: int
    crossings: float
    wrong: dict[str, tuple[float, float]]


@dataclass(frozen=True, repr=False)
class GhostScan(Shown):
    """Pairs at several numbers of tracks on a sheet.

    Attributes
    ----------
    title : str
    points : tuple of GhostPoint
    """

    title: str
    points: tuple[GhostPoint, ...]

    def to_csv(self) -> str:
        """Return the text of a CSV file, one row a number of tracks."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        names = [way.replace(" ", "_") for way in WAYS]
        writer.writerow(["tracks", "crossings", *(f"wrong_{name}{end}" for name in names for end in ("", "_error"))])
        for point in self.points:
            values = [value for way in WAYS for value in point.wrong[way]]
            writer.writerow([point.tracks, *(f"{value:.6g}" for value in (point.crossings, *values))])
        return text.getvalue()

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        rows = [
            [str(point.tracks), f"{point.crossings:.2f}"]
            + [with_error(*(100 * value for value in point.wrong[way])) for way in WAYS]
            for point in self.points
        ]
        return self.title, _HEAD, rows


def scan_ghosts(
    detector: Detector, readout: ChargeReadout, tracks: Sequence[int] = (2, 4, 6), *, n: int = 1000, seed: int = 1,
    layer: int = 0, p: float = 1.0, cos_theta: float = 0.8, threads: int | None = None,
) -> GhostScan:  # fmt: skip
    """Return how often pairs are wrong if tracks cross one sheet together.

    Parameters
    ----------
    detector : Detector
    readout : AnalogReadout
    tracks : sequence of int
        Numbers of muons on the sheet.
    n : int
        Events with each number.
    seed : int
    layer : int
        Index of the CGEM layer; its first sheet counts.
    p : float
        GeV/c.
    cos_theta : float
        Muons have |cos(theta)| up to this, uniformly, and any azimuth on the sheet.
    threads : int or None
    """
    check_numbers("scan_ghosts", seed, threads)
    cylinder = detector.cgem[layer]
    width = cylinder.strips_x * cylinder.pitch_x / cylinder.r_readout
    edge = 0.0 if cylinder.sheets == 1 else 0.15  # rad: muons turn on their way
    phi = (0.0, 2 * math.pi) if cylinder.sheets == 1 else (cylinder.phi_first + edge, cylinder.phi_first + width - edge)
    gun = Gun("mu-", p=p, cos_theta=(-cos_theta, cos_theta), phi=phi)
    points = []
    for number in tracks:
        result = run(
            detector,
            reduce(add, [gun] * number),
            n,
            seed,
            readout=readout,
            until="cluster",
            keep=["clusters", "truths"],
            workers=threads,
        )
        points.append(_point(result.clusters, layer, number, seed))
    title = f"{readout.name}, layer {cylinder.label} of {detector.name}, mu- of {p:g} GeV/c, {n} events each"
    return GhostScan(title, tuple(points))


def _point(clusters: Table, layer: int, tracks: int, seed: int) -> GhostPoint:
    """Return what the best assignment of all clusters of a sheet gets wrong."""
    from scipy.optimize import linear_sum_assignment

    random = np.random.default_rng(seed)
    pairs = np.flatnonzero((clusters["view"] == 2) & (clusters["layer"] == layer) & (clusters["sheet"] == 0))
    x, v = clusters["x_cluster"][pairs], clusters["v_cluster"][pairs]
    scores = {"geometry": np.zeros(len(pairs)), "charge and time": clusters["score"][pairs]}
    # Equal scores are decided by lot.
    scores = {way: values + 1e-9 * random.uniform(size=len(pairs)) for way, values in scores.items()}
    same = (clusters["truth"][x] == clusters["truth"][v]) & (clusters["truth"][x] >= 0)
    wrong = dict.fromkeys(WAYS, 0)
    assigned = dict.fromkeys(WAYS, 0)
    event = clusters["event"][pairs]
    for first, last in zip(
        *(np.searchsorted(event, np.unique(event), side=side) for side in ("left", "right")), strict=True
    ):
        here = slice(first, last)
        rows, row = np.unique(x[here], return_inverse=True)
        columns, column = np.unique(v[here], return_inverse=True)
        for way in WAYS:
            gain = np.full((len(rows), len(columns)), -_APART)
            gain[row, column] = scores[way][here]
            is_same = np.zeros(gain.shape, np.bool_)
            is_same[row, column] = same[here]
            best = linear_sum_assignment(gain, maximize=True)
            real = gain[best] > -0.5 * _APART
            wrong[way] += int(np.count_nonzero(real & ~is_same[best]))
            assigned[way] += int(np.count_nonzero(real))
    shares = {way: wrong[way] / max(assigned[way], 1) for way in WAYS}
    errors = {way: math.sqrt(shares[way] * (1 - shares[way]) / max(assigned[way], 1)) for way in WAYS}
    crossings = len(pairs) / max(tracks * len(clusters.events), 1)
    return GhostPoint(tracks, crossings, {way: (shares[way], errors[way]) for way in WAYS})
