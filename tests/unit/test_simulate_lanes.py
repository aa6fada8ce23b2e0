"""Particles side by side in SIMD lanes are those that the scalar simulation makes: same draws, same rows."""

from itertools import pairwise

import numpy as np
import pytest

from cgemit import isa
from cgemit.detector import Detector, load, write_field_map
from cgemit.particles.gun import Gun, generate
from cgemit.simulation.transport import SimulateSettings, TransportStatus, simulate
from cgemit.tables import Table
from fields import HARMONIC, harmonic_by_hand, small_map
from tracks import particles

DESIGN = load("besiii-cgem-design")
LANES = [name for name in isa.available() if name != "scalar"]
TABLES = ("truths", "steps", "wire_truths", "decays")
# A draw at the edge of a decision may fall to the other side by rounding; the rows that follow are then others.
FLIPS = 1e-5
# The fastest numbers in lanes are rounded otherwise: positions of 1 m to 1e-8 mm, delta electrons after some hundred
# scatters to 1e-6 of their pieces.
TOLERANCE = {"truths": 1e-9, "wire_truths": 1e-9, "steps": 1e-5, "decays": 1e-9}

pytestmark = pytest.mark.skipif(not LANES, reason="no kernels for lanes on this machine")


def simulated(
    name: str, table: Table, settings: SimulateSettings | None = None, seed: int = 1, detector: Detector = DESIGN
):
    """Simulate with the kernels of one instruction set."""
    before = isa.name()
    isa.use(name)
    try:
        return simulate(detector, table, settings, seed)
    finally:
        isa.use(before)


def differing_events(one: Table, other: Table, n: int, relative: float) -> set[int]:
    """Return events whose rows differ by more than rounding, or are not the same in number."""
    rows = [np.bincount(table["event"], minlength=n) for table in (one, other)]
    differ = set(np.flatnonzero(rows[0] != rows[1]).tolist())
    same = [rows[0][table["event"]] == rows[1][table["event"]] for table in (one, other)]
    event = one["event"][same[0]]
    for column in one:
        if column == "truth":  # a row number, which moves with the rows before
            continue
        a, b = one[column][same[0]], other[column][same[1]]
        unlike = np.abs(a - b) > relative * (1 + np.abs(a)) if a.dtype.kind == "f" else a != b
        differ |= set(event[unlike].tolist())
    return differ


def mixture(n: int) -> Table:
    """Return muons, pions, protons and electrons from 50 MeV/c, some displaced and on their way in, some neutral."""
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(n, 3))
    momentum = direction / np.linalg.norm(direction, axis=1)[:, None] * 10 ** rng.uniform(-1.3, 0.3, n)[:, None]
    position = rng.normal(size=(n, 3)) * np.where(rng.random(n) < 0.3, 60.0, 1e-3)[:, None]
    return particles(position, momentum, rng.choice([13, -13, 211, -211, 2212, 11, 22], n, p=[0.4] + [0.1] * 6))


@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize(
    ("gun", "settings"),
    [
        (Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93)), SimulateSettings()),
        (Gun("pi+", p=(0.05, 0.3), cos_theta=(-0.93, 0.93)), SimulateSettings(steps=True)),
        (Gun("mu+", p=0.2, cos_theta=(-0.5, 0.5)), SimulateSettings(fluctuations="gaussian")),
        (Gun("mu-", p=0.12, cos_theta=(-0.9, 0.9)), SimulateSettings(fluctuations="off")),
        (Gun("pi-", p=(0.1, 0.5), cos_theta=(-0.8, 0.8)), SimulateSettings(foil="lattice")),
    ],
    ids=["default", "slow and every cluster", "gaussian", "off", "foils with holes"],
)
def test_same_rows_as_scalar(name, gun, settings):
    """Every row is the scalar one but for rounding, and no more decisions flip than one row in 10^5."""
    n = 2000
    table = generate(gun, n, seed=3)
    scalar, lanes = (simulated(kernels, table, settings) for kernels in ("scalar", name))
    np.testing.assert_array_equal(scalar["particles"]["status"], lanes["particles"]["status"])
    for kind in TABLES:
        differ = differing_events(scalar[kind], lanes[kind], n, TOLERANCE[kind])
        assert len(differ) <= np.ceil(FLIPS * len(scalar[kind])), f"{kind}: events {sorted(differ)[:9]}"


@pytest.mark.parametrize("name", LANES)
def test_mixture_of_particles_comes_in_its_order(name):
    """Particles that lanes leave to scalar code stand where they stood, with their statuses."""
    n = 1500
    scalar, lanes = (simulated(kernels, mixture(n)) for kernels in ("scalar", name))
    np.testing.assert_array_equal(scalar["particles"]["status"], lanes["particles"]["status"])
    assert len(np.unique(scalar["particles"]["status"])) == 6
    for kind in TABLES:
        assert len(differing_events(scalar[kind], lanes[kind], n, TOLERANCE[kind])) <= 1
        assert np.all(np.diff(lanes[kind]["event"]) >= 0)


@pytest.fixture(scope="module")
def fields(tmp_path_factory):
    """The design in fields of every kind; tracks leave the maps before the outermost wires."""
    folder = tmp_path_factory.mktemp("fields")
    x, z = np.linspace(-450, 450, 19), np.linspace(-1300, 1300, 53)
    values = harmonic_by_hand(x[:, None, None], x[None, :, None], z[None, None, :])
    box = {"x": x, "y": x, "z": z} | {f"b{axis}": values[..., i] for i, axis in enumerate("xyz")}
    return {
        "uniform": DESIGN,
        "harmonic": DESIGN.with_field(HARMONIC),
        "cylinder": DESIGN.with_field(small_map(folder)),
        "box": DESIGN.with_field(write_field_map(folder / "box.npz", box)),
    }


@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize("field", ["harmonic", "cylinder", "box"])
def test_same_rows_as_scalar_in_a_field_map(name, field, fields):
    """Steps through the field round otherwise, too; particles of all kinds, on their way in or out, leave the map."""
    n = 800
    scalar, lanes = (simulated(kernels, mixture(n), detector=fields[field]) for kernels in ("scalar", name))
    np.testing.assert_array_equal(scalar["particles"]["status"], lanes["particles"]["status"])
    leave = (lanes["particles"]["status"] == TransportStatus.left_field).sum()
    assert leave == 0 if field == "harmonic" else leave > n / 3
    for kind in TABLES:
        assert len(scalar[kind]["event"]) > (10 if kind == "decays" else n)
        assert len(differing_events(scalar[kind], lanes[kind], n, TOLERANCE[kind])) <= 1


@pytest.mark.parametrize("name", LANES)
@pytest.mark.parametrize("field", ["uniform", "harmonic", "cylinder"])
def test_companions_change_nothing(name, field, fields):
    """Alone, or with other neighbours, a particle is the same to the last bit."""
    table = mixture(200)
    detector, cuts = fields[field], pairwise([0, 1, 18, 75, 200])
    everything = simulated(name, table, detector=detector)
    parts = [simulated(name, table.select_events(*cut), detector=detector) for cut in cuts]
    for kind in TABLES:
        for column in everything[kind]:
            if column != "truth":
                joined = np.concatenate([part[kind][column] for part in parts])
                np.testing.assert_array_equal(everything[kind][column], joined, err_msg=f"{kind}.{column}")


def test_other_draws_are_seen():
    """The comparison fails for another seed, and for a momentum larger by a millionth."""
    table = generate(Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), 300, seed=3)
    one, other = (simulated("scalar", table, seed=seed) for seed in (1, 2))
    assert len(differing_events(one["wire_truths"], other["wire_truths"], 300, 1e-9)) > 290
    shifted = simulated("scalar", table.with_columns(px=table["px"] * (1 + 1e-6)))
    assert len(differing_events(one["truths"], shifted["truths"], 300, 1e-9)) > 290
