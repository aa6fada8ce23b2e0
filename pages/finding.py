"""docs/methods/find.md: what the combinatorial Kalman filter finds, and what it costs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import cgemit as cg
from cgemit.analysis.finding import finding, loop_links
from cgemit.particles.gun import Guns
from cgemit.particles.species import species
from cgemit.particles.table import particles_from
from pages.page import Found, Numbers, Page, say, share_of, table
from pages.scenarios import both_charges

BARREL = 0.93  # |cos(theta)|: beyond, tracks leave the chamber after a few layers
BOTH = ("besiii-cgem", "besiii-idc")
ALONE = "besiii-cgem, chamber off"
KLOE = "kloe2-like"
#: The page names samples with at least this share of events beyond the search.
MANY = 0.02
#: Samples that the page does not show: they are found as muons are.
AS_MUONS = {"pion of 0.2–2 GeV/c", "kaon of 0.2–2 GeV/c", "proton of 0.3–2 GeV/c"}
#: Samples in which the chambers differ, shown for the second one.
DIFFER = (
    "kaon of 0.2–2 GeV/c that may decay",
    "muon, p_T of 0.04–0.06 GeV/c", "4 tracks, `bes2009`", "4 tracks, 30 % of the cells", "20 tracks of 0.2–1.5 GeV/c",
    "64 tracks of 0.2–1.5 GeV/c", "4 pions of 0.1–1 GeV/c, up to 180 mm off the beam line, `bes2009`",
)  # fmt: skip
QUANTITIES = ("dr", "phi0", "dz", "tanl", "p")

Particles = Callable[[int, int], Any]


def guns(*names: str, multiplicity: int = 1, **what: Any) -> Particles:
    """Return a source whose events have `multiplicity` particles of each name."""
    what = {"cos_theta": (-BARREL, BARREL)} | what
    source = Guns(tuple(cg.Gun(name, multiplicity=multiplicity, **what) for name in names))
    return lambda n_events, seed: source


def displaced(n_events: int, seed: int) -> cg.Table:
    """Return four pions an event, 0.1 to 1 GeV/c, from vertices 0 to 180 mm beside the beam line and |z| < 100 mm."""
    random = np.random.default_rng(seed)
    n = 4 * n_events
    distance, azimuth, phi = random.uniform(0, 180, n), *random.uniform(-np.pi, np.pi, (2, n))
    p, cos = random.uniform(0.1, 1.0, n), random.uniform(-BARREL, BARREL, n)
    pt = p * np.sqrt(1 - cos**2)
    columns = {
        "event": np.repeat(np.arange(n_events), 4), "pdg": species("pi+").pdg * random.choice([-1, 1], n),
        "x": distance * np.cos(azimuth), "y": distance * np.sin(azimuth), "z": random.uniform(-100, 100, n),
        "px": pt * np.cos(phi), "py": pt * np.sin(phi), "pz": p * cos,
    }  # fmt: skip
    return particles_from(columns, n_events=n_events, first_event=0)


QUIET = cg.BackgroundSettings()
NOISE = cg.BackgroundSettings(level="bes2009")
NEW_NOISE = cg.BackgroundSettings(level="bes2026")


@dataclass(frozen=True)
class Sample:
    """Events of the table: their name, particles, number, detectors and settings."""

    name: str
    particles: Particles
    events: int
    detectors: tuple[str, ...] = BOTH
    background: cg.BackgroundSettings = QUIET
    readout: str | None = None
    decays: bool = False


FOUR = guns("mu-", "mu+", "pi-", "pi+", p=(0.2, 1.5))
INNER_CONE = (-0.9, 0.9)
INNER = guns("mu-", "mu+", "pi-", "pi+", p=(0.1, 1.0))
IN_KLOE = guns("mu-", p=(0.2, 1.0), cos_theta=(-0.86, 0.86))
SAMPLES = (
    Sample("muon of 0.2–2 GeV/c", guns("mu-", p=(0.2, 2.0)), 2000),
    Sample("pion of 0.2–2 GeV/c", guns("pi+", p=(0.2, 2.0)), 2000),
    Sample("kaon of 0.2–2 GeV/c", guns("K-", p=(0.2, 2.0)), 2000),
    Sample("proton of 0.3–2 GeV/c", guns("proton", p=(0.3, 2.0)), 2000),
    Sample("kaon of 0.2–2 GeV/c that may decay", guns("K-", p=(0.2, 2.0)), 2000, decays=True),
    Sample("pion, p_T of 0.1–0.2 GeV/c", guns("pi-", pt=(0.1, 0.2), cos_theta=INNER_CONE), 2000),
    Sample("pion, p_T of 0.06–0.1 GeV/c", guns("pi-", pt=(0.06, 0.1), cos_theta=INNER_CONE), 2000),
    Sample("muon, p_T of 0.04–0.06 GeV/c", guns("mu-", pt=(0.04, 0.06), cos_theta=INNER_CONE), 2000),
    Sample("4 tracks of 0.2–1.5 GeV/c", FOUR, 500),
    Sample("4 tracks, `bes2009`", FOUR, 500, background=NOISE),
    Sample("4 tracks, 10 % of the cells", FOUR, 250, background=cg.BackgroundSettings(cells=0.1)),
    Sample("4 tracks, 30 % of the cells", FOUR, 250, background=cg.BackgroundSettings(cells=0.3)),
    Sample("20 tracks of 0.2–1.5 GeV/c", guns("mu-", "mu+", "pi-", "pi+", multiplicity=5, p=(0.2, 1.5)), 100),
    Sample("64 tracks of 0.2–1.5 GeV/c", guns("mu-", "mu+", "pi-", "pi+", multiplicity=16, p=(0.2, 1.5)), 40),
    Sample("4 pions of 0.1–1 GeV/c, up to 180 mm off the beam line, `bes2009`", displaced, 500, background=NOISE),
    Sample("4 tracks of 0.1–1 GeV/c without chamber", INNER, 500, (ALONE,)),
    Sample("4 tracks without chamber, `bes2026`", INNER, 500, (ALONE,), NEW_NOISE),
    Sample("4 tracks without chamber, `bes2026`, `tiger`", INNER, 500, (ALONE,), NEW_NOISE, "tiger"),
    Sample("muon of 0.2–1 GeV/c", IN_KLOE, 2000, (KLOE,)),
)


@dataclass(frozen=True)
class Rates:
    """What is found in a sample; shares in %, time of an event in us, events that reach a limit of the search."""

    sample: str
    detector: str
    particles: int
    findable: float
    efficiency: float
    fakes: float
    clones: float
    purity: float
    time: float
    limited: int
    events: int


def detector_of(name: str) -> cg.Detector:
    """Return a preset, or `ALONE`, BESIII's CGEM without its chamber."""
    return replace(cg.load("besiii-cgem"), drift_chamber=None) if name == ALONE else cg.load(name)


def found_in(sample: Sample, detector: str, events: int) -> Rates:
    """Return the rates of a sample in a detector."""
    settings = cg.Settings(background=sample.background, simulate=cg.SimulateSettings(decays=sample.decays))
    result = cg.run(
        detector_of(detector), sample.particles(events, 1), events, seed=1, settings=settings, readout=sample.readout,
        finder="ckf", until="find", workers=1,
    )  # fmt: skip
    found = finding(result)
    rates = found.rates()
    return Rates(
        sample.name, detector, int(found.charged.sum()),
        float(100 * found.findable.sum() / found.charged.sum()),
        100 * rates.efficiency.value, 100 * rates.fakes.value, 100 * rates.clones.value, 100 * found.purity,
        1e6 * result.timings["find"] / events, result.beyond_search(), events,
    )  # fmt: skip


def measure_rates(share: float) -> Numbers:
    """Measure all samples in their detectors."""
    rows = []
    for sample in SAMPLES:
        for detector in sample.detectors:
            say(f"finding: {sample.name}, {detector}")
            rows.append(found_in(sample, detector, share_of(sample.events, share)))
    return Numbers(rows)


@dataclass(frozen=True)
class Core:
    """Core widths of a quantity of fitted tracks, with hits by truth and found ones."""

    detector: str
    particle: str
    level: str
    quantity: str
    truth: float
    found: float


def measure_cores(share: float) -> Numbers:
    """Measure muons of 1 GeV/c and pions of 0.3 GeV/c with each finder; both have the same simulated events."""
    n = share_of(10_000, share, 400)
    return Numbers(list(cores(n)), {"events": f"{n:,} tracks"})


def cores(n: int) -> Iterator[Core]:
    """Yield the core widths."""
    for detector in BOTH:
        for particle, p in (("mu-", 1.0), ("pi-", 0.3)):
            for level in ("off", "bes2009"):
                settings = cg.Settings(
                    background=cg.BackgroundSettings(level=level), simulate=cg.SimulateSettings(decays=False)
                )
                gun = cg.Gun(particle, p=p, cos_theta=(-0.8, 0.8))
                by = [cg.run(detector, gun, n, seed=2, settings=settings, finder=name) for name in ("truth", "ckf")]
                for quantity in QUANTITIES:
                    truth, found = (cg.resolution(result, quantity).core for result in by)
                    yield Core(detector, particle, level, quantity, truth, found)


@dataclass(frozen=True)
class Loops:
    """Loop clones of particles with four half turns, before and after linking, %."""

    sample: str
    particles: int
    before: float
    after: float


def measure_loops(share: float) -> Numbers:
    """Measure single pions and four electrons an event."""
    n = share_of(1000, share, 40)
    slow: dict[str, Any] = {"p": (0.03, 0.11), "cos_theta": INNER_CONE}
    sources = (("pions", cg.Gun("pi-", **slow), n), ("electrons", both_charges("e-", multiplicity=2, **slow), n // 4))
    settings = cg.Settings(simulate=cg.SimulateSettings(half_turns=4, decays=False))
    rows = []
    for name, source, events in sources:
        links = loop_links(cg.run("besiii-cgem", source, events, seed=1, settings=settings, finder="ckf"))
        rows.append(Loops(name, n, 100 * links.before.value, 100 * links.after.value))
    return Numbers(rows)


def blocks(found: Found) -> dict[str, str]:
    """Return the table of samples, and the numbers within the text."""
    tables = []
    for detector in BOTH:
        rows = [row for row in found["rates"].rows if row.detector == detector and row.sample not in AS_MUONS]
        rows = rows if detector == BOTH[0] else [row for row in rows if row.sample in DIFFER]
        lines = [[row.sample, *_shares(row), f"{row.time / 1000:.2g}"] for row in rows]
        tables.append(table([f"`{detector}`", "findable", "found", "fakes", "clones", "hit purity", "ms"], lines))
    kloe = next(row for row in found["rates"].rows if row.detector == KLOE)
    many = [row for row in found["rates"].rows if row.limited >= MANY * row.events]
    limited = [f"{100 * row.limited / row.events:.0f} % ({row.sample}, `{row.detector}`)" for row in many]
    changes = {
        level: max(abs(row.found / row.truth - 1) for row in found["cores"].rows if row.level == level)
        for level in ("off", "bes2009")
    }
    loops = [f"from {row.before:.0f} to {row.after:.0f} % for {row.sample}" for row in found["loops"].rows]
    return {
        "rates": "\n\n".join(tables),
        "limited": ", ".join(limited),
        "kloe": f"{kloe.efficiency:.4g} % of {kloe.particles}",
        "cores": f"{100 * changes['off']:.1f} %, and by up to {100 * changes['bes2009']:.1f} % with `bes2009`",
        "loops": " and ".join(loops),
    }


def _shares(row: Rates) -> list[str]:
    """Return the shares in %, without decimals where they are exact."""
    shares = (row.findable, row.efficiency, row.fakes, row.clones, row.purity)
    return [f"{share:.0f}" if share in (0.0, 100.0) else f"{share:.2f}" for share in shares]


PAGE = Page(
    "finding",
    "docs/methods/find.md",
    "1 minute",
    {"rates": (Rates, measure_rates), "cores": (Core, measure_cores), "loops": (Loops, measure_loops)},
    blocks,
)
