"""Runs of the chain that a study needs, each reduced to its tracks and cluster residuals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from cgemit.analysis.clusters import ClusterResiduals, DeltaFractions, cluster_residuals, delta_fractions
from cgemit.analysis.resolutions import Pulls, pulls
from cgemit.analysis.widths import FEWEST
from cgemit.base.errors import report
from cgemit.base.validate import InTurn
from cgemit.chain import run
from cgemit.chain.record import gun_data, record
from cgemit.chain.settings import FinderLike, Settings, tables_made
from cgemit.detector import Detector, MapField
from cgemit.detector.parts import extent
from cgemit.particles.gun import Gun
from cgemit.particles.species import species
from cgemit.reconstruction.candidates import finder_name
from cgemit.simulation.transport import TransportStatus
from cgemit.tables import Table
from cgemit.tables.schema import FitStatus
from cgemit.tables.show import Shown
from cgemit.truth.match import measuring

#: Shows progress: share of the work that is done (0 to 1) and what is running.
ShowProgress = Callable[[float, str], None]


@dataclass(frozen=True)
class Order:
    """A sample to be run; `finder` as of `cgemit.run`."""

    label: str
    detector: Detector
    gun: Gun
    n_events: int
    seed: int
    settings: Settings
    finder: FinderLike = field(default="truth", kw_only=True)


@dataclass(frozen=True, repr=False)
class Sample(Shown, Order):
    """One run of the chain: its inputs, tracks, residuals and counts.

    Attributes
    ----------
    label : str
    detector : Detector
    gun : Gun
    n_events, seed : int
    settings : Settings
    finder : "truth", "ckf" or callable
    tracks : Table
    clusters : ClusterResiduals
    deltas : DeltaFractions
    removed : mapping of str to int
        Tracks that resolutions leave out, by status.
    transport : mapping of str to int
        Particles by how their transport ended.
    timings : mapping of str to float, s
        As of the result.
    """

    tracks: Table
    clusters: ClusterResiduals
    deltas: DeltaFractions
    removed: Mapping[str, int]
    transport: Mapping[str, int]
    timings: Mapping[str, float]

    @cached_property
    def pulls(self) -> Pulls:
        """Pulls of the tracks, see `cgemit.study.pulls`."""
        return pulls(self.tracks)

    def _table(self) -> tuple[str, tuple[str, ...], list[list[str]]]:
        tracks = f"{fitted(self)}/{len(self.tracks)}"
        row = [self.label, repr(self.gun), str(self.n_events), str(self.seed), tracks, _counts(self.removed)]
        return "sample", _HEAD, [row]


_HEAD = ("sample", "gun", "events", "seed", "fitted", "left out")


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{number} {name}" for name, number in counts.items()) or "none"


def run_samples(
    orders: Sequence[Order], *, threads: int | None = None, progress: ShowProgress | None = None
) -> list[Sample]:
    """Run the chain for each order, one after the other: the largest single run determines the memory.

    Parameters
    ----------
    orders : sequence of Order
    threads : int, optional
        Default: all cores.
    progress : callable, optional
        Called with the share of all events that is done and the label of what is running.

    Returns
    -------
    list of Sample
    """
    total = sum(order.n_events for order in orders)
    samples, done = [], 0
    for order in orders:
        samples.append(_run(order, threads, _part_of(progress, done, order, total)))
        done += order.n_events
    return samples


def _part_of(progress: ShowProgress | None, before: int, order: Order, total: int) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda fraction: progress((before + order.n_events * fraction) / total, order.label)


#: Two thirds of the bytes of a run, which no sample needs.
_LEFT_OUT = {"wire_truths", "digis", "wire_hits", "refined_wire_hits", "candidate_hits", "residuals", "states"}


def _run(order: Order, threads: int | None, progress: Callable[[float], None] | None) -> Sample:
    result = run.run(
        order.detector,
        order.gun,
        order.n_events,
        order.seed,
        settings=order.settings,
        finder=order.finder,
        keep=[name for name in tables_made("fit", order.settings, order.detector) if name not in _LEFT_OUT],
        progress=progress,
        workers=threads,
    )
    return Sample(
        **vars(order), tracks=result.tracks, clusters=cluster_residuals(result), deltas=delta_fractions(result),
        removed=result.removed(), transport=result.transport(), timings=result.timings,
    )  # fmt: skip


def seed_of(seed: int, number: int) -> int:
    """Return a seed of its own for run `number` of a study (`numpy.random.SeedSequence`)."""
    return int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0])


def momentum_orders(
    detector: Detector,
    momenta: Sequence[float],
    *,
    particle: str | int = "mu-",
    cos_theta: Any = None,
    theta: Any = None,
    transverse: bool = False,
    events: int,
    seed: int,
    settings: Settings | None = None,
    finder: FinderLike = "truth",
) -> list[Order]:
    """Return the samples of a momentum scan; each momentum has a seed of its own, the same for every detector."""
    orders = []
    for number, p in enumerate(momenta, start=1):
        momentum: dict[str, Any] = {"pt" if transverse else "p": p}
        gun = Gun(particle, **momentum, cos_theta=cos_theta, theta=theta)
        if species(gun.particle).charge == 0:
            raise ValueError(f"particle: got {particle!r}; expected a charged particle")
        label = f"{detector.name}, {gun.particle}, {p:g} GeV/c"
        seed_here = seed_of(seed, number)
        orders.append(Order(label, detector, gun, events, seed_here, settings or Settings(), finder=finder))
    return orders


def gun_arguments(momenta: Any, pt: Any, particle: str | int, cos_theta: Any, theta: Any) -> dict[str, Any]:
    """Return the arguments of `momentum_orders` that say what is shot.

    Raises
    ------
    ValueError
        If there is not exactly one list of momenta with at least one, or both angles are given.
    """
    problems = []
    values, name = (momenta, "momenta") if pt is None else (pt, "pt")
    if (momenta is None) == (pt is None):
        problems.append("momenta, pt: expected exactly one of them")
    elif np.ndim(values) != 1 or not len(values):
        problems.append(f"{name}: got {values!r:.60}, expected a list of at least one")
    if cos_theta is not None and theta is not None:
        problems.append("cos_theta, theta: got both, expected one of them")
    report("scan", problems)
    if cos_theta is None and theta is None:
        cos_theta = (-0.93, 0.93)
    return {
        "momenta": list(values),
        "transverse": pt is not None,
        "particle": particle,
        "cos_theta": cos_theta,
        "theta": theta,
    }


def transverse(order: Order) -> bool:
    """Tell whether the gun has a transverse momentum."""
    return order.gun.p is None


def momentum_of(sample: Order) -> float:
    """Return the momentum, or transverse momentum, of a sample shot with one, GeV/c."""
    return float(sample.gun.pt if transverse(sample) else sample.gun.p)  # type: ignore[arg-type]


def momentum_name(sample: Order) -> str:
    """Return ``"p"``, or ``"pt"`` where the gun has a transverse momentum."""
    return "pt" if transverse(sample) else "p"


def angle_of(order: Order) -> tuple[str, Any]:
    """Return ``"cos_theta"`` or ``"theta"`` and the value of the gun as a number or as text, LO:HI or A,B,C."""
    name = "cos_theta" if order.gun.theta is None else "theta"
    value = getattr(order.gun, name)
    if isinstance(value, InTurn):
        return name, ",".join(f"{one:g}" for one in value.values)
    return name, f"{value[0]:g}:{value[1]:g}" if isinstance(value, tuple) else float(value)


def cosines_of(order: Order) -> Any:
    """Return the cosines of the polar angles of a gun, a number, a uniform range or values in turn.

    A range uniform in theta becomes 64 values.
    """
    gun = order.gun
    if gun.theta is None:
        return gun.cos_theta
    if isinstance(gun.theta, tuple):
        low, high = gun.theta
        return [math.cos(low + (high - low) * (i + 0.5) / 64) for i in range(64)]
    if isinstance(gun.theta, InTurn):
        return [math.cos(one) for one in gun.theta.values]
    return math.cos(gun.theta)  # type: ignore[arg-type]


def fitted(sample: Sample) -> int:
    """Return how many tracks count in resolutions."""
    return int(np.count_nonzero(measuring(sample.tracks)))


def decayed(sample: Sample) -> int:
    """Return how many particles decayed in flight."""
    return sample.transport.get(TransportStatus.decayed.name, 0)


def hardly_fitted(samples: Sequence[Sample]) -> list[Sample]:
    """Return the samples with too few fitted tracks for a width."""
    return [sample for sample in samples if fitted(sample) < FEWEST]


def why_unfitted(samples: Sequence[Sample]) -> str:
    """Return how transport and fit of samples of one detector ended, and where its map ends if tracks left it."""
    tracks = sum(len(sample.tracks) for sample in samples)
    particles = sum(sum(sample.transport.values()) for sample in samples)
    transport, removed = (_total([getattr(sample, name) for sample in samples]) for name in ("transport", "removed"))
    parts = [
        f"{sum(map(fitted, samples))} of {tracks} tracks fitted, expected at least {FEWEST} for a resolution",
        "transport: " + _counts_text(transport, particles),
        "fit: " + _counts_text(removed, tracks),
    ]
    if {TransportStatus.left_field.name, FitStatus.left_field.name} & (transport.keys() | removed.keys()):
        parts += _ends(samples[0].detector)
    return "; ".join(parts)


def _total(counts: Sequence[Mapping[str, int]]) -> dict[str, int]:
    names = dict.fromkeys(name for one in counts for name in one)
    return {name: sum(one.get(name, 0) for one in counts) for name in names}


def _counts_text(counts: Mapping[str, int], total: int) -> str:
    return ", ".join(f"{name} {number} of {total}" for name, number in counts.items()) or "all well"


def _ends(detector: Detector) -> list[str]:
    field, (r, z) = detector.field, extent(detector)
    if not isinstance(field, MapField):
        return []
    return [f"the map is of {field.grid.range_text()}", f"the detector goes to r = {r:g} mm, |z| = {z:g} mm"]


def record_of(samples: Sequence[Sample], seed: int, command: str = "") -> dict[str, Any]:
    """Return what `run.json` of a study holds: its settings and detectors, and the gun of each sample.

    Parameters
    ----------
    samples : sequence of Sample
        Run with the same settings, at detectors of distinct names or equal ones.
    seed : int
        Of the study.
    command : str
        The command line that made it; none from Python.
    """
    source = [
        {"label": s.label, "detector": s.detector.name, "gun": gun_data(s.gun), "events": s.n_events, "seed": s.seed}
        | ({} if s.finder == "truth" else {"finder": finder_name(s.finder)})
        for s in samples
    ]
    detectors = {s.detector.name: s.detector for s in samples}
    return record(detectors=detectors, settings=samples[0].settings, seed=seed, source=source, command=command)
