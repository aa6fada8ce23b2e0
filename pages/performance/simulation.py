"""Cost of the parts of the simulation; one thread, processor time."""

from __future__ import annotations

from dataclasses import dataclass

from cgemit.detector import Detector, load
from cgemit.particles.gun import generate
from cgemit.simulation.transport import SimulateSettings, simulate
from pages.page import Numbers
from pages.performance.timing import DETECTOR, GUN, SEED, fastest, product_us

EVENTS, RUNS = 4000, 15
CASES = {
    "no fluctuations": SimulateSettings(fluctuations="off", deltas=False),
    "scattering, straggling and ionization": SimulateSettings(deltas=False),
    "and delta electrons (default)": SimulateSettings(),
    "and every ionization cluster kept": SimulateSettings(steps=True),
    "default, foils with holes": SimulateSettings(foil="lattice"),
    "default, every sub-layer by itself": SimulateSettings(sublayers=True),
}


@dataclass(frozen=True)
class CaseCost:
    """Cost per muon of one way to simulate: us, and in products of two 64 by 64 matrices."""

    case: str
    us: float
    products: float


def costs_us(calls: dict[str, tuple[Detector, SimulateSettings]]) -> dict[str, float]:
    """Return us per muon of each."""
    particles = generate(GUN, EVENTS, SEED)
    works = {name: lambda how=how: simulate(how[0], particles, how[1], SEED) for name, how in calls.items()}
    return {name: 1e6 * spent / EVENTS for name, spent in fastest(works, RUNS).items()}


def measure_cases(_share: float) -> Numbers:
    """Measure all ways to simulate."""
    unit, detector = product_us(), load(DETECTOR)
    costs = costs_us({name: (detector, settings) for name, settings in CASES.items()})
    return Numbers([CaseCost(name, cost, cost / unit) for name, cost in costs.items()])
