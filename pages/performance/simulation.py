"""Cost of the parts of the simulation, of field maps in it, and of the analog readouts; one thread, processor time."""

from __future__ import annotations

from dataclasses import dataclass

import cgemit as cg
from cgemit import isa
from cgemit.detector import Detector, load
from cgemit.detector.readouts import Apv25Readout, Readout, TigerReadout
from cgemit.particles.gun import generate
from cgemit.simulation.digitize import digitizer_of
from cgemit.simulation.transport import SimulateSettings, simulate
from cgemit.tables import Table
from pages.page import Numbers
from pages.performance.fits import FieldCost
from pages.performance.timing import DETECTOR, GUN, SEED, fastest, instruction_set, product_us

EVENTS, RUNS = 4000, 15
CASES = {
    "no fluctuations": SimulateSettings(fluctuations="off", deltas=False),
    "scattering, straggling and ionization": SimulateSettings(deltas=False),
    "and delta electrons (default)": SimulateSettings(),
    "and every ionization cluster kept": SimulateSettings(steps=True),
    "default, foils with holes": SimulateSettings(foil="lattice"),
    "default, every sub-layer by itself": SimulateSettings(sublayers=True),
}
FIELDS = ("uniform", "besiii", "finite-solenoid")  # the last one on a grid in (r, z)
READOUT_MUONS, READOUT_SEED, READOUT_RUNS, FACTORS = 500, 5, 7, (1, 2, 4, 8)


@dataclass(frozen=True)
class CaseCost:
    """Cost per muon of one way to simulate: us, and in products of two 64 by 64 matrices."""

    case: str
    us: float
    products: float


@dataclass(frozen=True)
class ReadoutCost:
    """Digitization and clustering of a muon with a mean number of electrons, us."""

    isa: str
    readout: str
    electrons: float
    us: float


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


def measure_fields(_share: float) -> Numbers:
    """Measure the default simulation in every field for each instruction set."""
    calls = {field: (load(DETECTOR).with_field(field), SimulateSettings()) for field in FIELDS}
    rows = []
    for code in isa.available():
        with instruction_set(code):
            rows += [FieldCost(code, field, us) for field, us in costs_us(calls).items()]
    return Numbers(rows)


def muons(n: int = READOUT_MUONS) -> cg.Result:
    """Return muons of 1 GeV/c with their ionization clusters."""
    return cg.run(DETECTOR, GUN, n, READOUT_SEED, readout="tiger", until="simulate", workers=1)


def with_electrons(steps: Table, factor: int) -> Table:
    """Return the steps with so many times the electrons."""
    return steps.with_columns(n_electrons=(factor * steps["n_electrons"]).astype(steps["n_electrons"].dtype))


def read_out(result: cg.Result, readout: Readout, steps: Table) -> None:
    """Digitize and cluster."""
    (group,) = result.detector.with_readout(readout).groups
    digis = digitizer_of(readout).digitize(group, result.truths, steps, READOUT_SEED)
    cg.cluster(result.detector, digis, readout=readout)


def measure_readouts(_share: float) -> Numbers:
    """Measure the analog readouts against the number of electrons of the same muons."""
    result, rows = muons(), []
    for code in isa.available():
        with instruction_set(code):
            for readout in (TigerReadout(), Apv25Readout()):
                for factor in FACTORS:
                    steps = with_electrons(result.steps, factor)
                    calls = {"all": lambda one=readout, steps=steps: read_out(result, one, steps)}
                    us = 1e6 * fastest(calls, READOUT_RUNS)["all"] / READOUT_MUONS
                    electrons = float(steps["n_electrons"].sum()) / READOUT_MUONS
                    rows.append(ReadoutCost(code, readout.name, electrons, us))
    return Numbers(rows)
