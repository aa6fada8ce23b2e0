"""Numbers that every function reads in the same way."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.particles.gun import generate
from cgemit.study.optimize.search import Search
from cgemit.study.readout.errors import fit_errors, pulls
from cgemit.study.readout.scan import beam_detector, beam_particles, beam_views, scan, scan_ghosts
from cgemit.tables import Table

DESIGN = "besiii-cgem-design"
GUN = cg.Gun("mu-", p=1.0, cos_theta=0.0)
TIGER = cg.TigerReadout()
EVENTS = np.arange(2)


def empty(*names: str) -> list[Table]:
    return [Table.empty(name, 1) for name in names]


SEEDED: dict[str, Callable[[Any], object]] = {
    "run": lambda seed: cg.run(DESIGN, GUN, 1, seed, workers=1),
    "generate": lambda seed: generate(GUN, 1, seed),
    "gun": lambda seed: GUN.shoot(seed, EVENTS, 0),
    "sample": lambda seed: cg.sample("ks-pipi").shoot(seed, EVENTS, 0),
    "sample in matter": lambda seed: cg.sample("electrons").within(cg.load(DESIGN)).shoot(seed, EVENTS, 0),
    "simulate": lambda seed: cg.simulate(DESIGN, generate(GUN, 1, 1), seed=seed),
    "digitize": lambda seed: cg.digitize(DESIGN, *empty("truths", "wire_truths"), seed=seed),
    "add_background": lambda seed: cg.add_background(
        cg.load(DESIGN), *empty("digis", "wire_hits"), cg.BackgroundSettings(), seed
    ),
    "mix_events": lambda seed: cg.mix_events(
        DESIGN, *empty("digis", "wire_hits"), {name: empty(name)[0] for name in ("digis", "wire_hits")}, seed=seed,
    ),
    "slab": lambda seed: cg.slab("Si 1 mm", "mu-", 1.0, seed=seed),
    "scan": lambda seed: cg.study.scan(DESIGN, [1.0], events=1, seed=seed),
    "scan_analytic": lambda seed: cg.study.scan_analytic(DESIGN, [1.0], seed=seed, threads=1),
    "sweep": lambda seed: cg.study.Evaluation(seed=seed),
    "optimize": lambda seed: Search(seed=seed),
    "sobol": lambda seed: cg.study.sobol({"cgem.*.pitch_x": ("400 um", "650 um")}, 2, seed=seed),
    "latin_hypercube": lambda seed: cg.study.latin_hypercube({"cgem.*.pitch_x": ("400 um", "650 um")}, 2, seed=seed),
    "reproduce": lambda seed: cg.study.reproduce(seed=seed),
    "fit_errors": lambda seed: fit_errors(TIGER, designs=1, n=2, seed=seed),
    "pulls": lambda seed: pulls(TIGER, designs=1, n=2, seed=seed),
    "beam_particles": lambda seed: beam_particles(beam_detector(1.0), "mu-", 1.0, 0.0, 2, seed),
    "beam_views": lambda seed: beam_views(beam_detector(1.0), TIGER, 0.0, n=2, seed=seed),
    "readout scan": lambda seed: scan(TIGER, "angle", [0.0], n=2, seed=seed),
    "ghosts": lambda seed: scan_ghosts(cg.load(DESIGN), TIGER, n=1, seed=seed),
}  # fmt: skip


@pytest.mark.parametrize("name", SEEDED)
@pytest.mark.parametrize("seed", [None, -1, 1.5, "x", True, 2**64, float, [1, 2], np.array([1, 2])], ids=repr)
def test_every_function_refuses_a_seed_with_the_same_words(name: str, seed: Any) -> None:
    text = f"seed: got {seed!r}, expected a whole number from 0 to 18446744073709551615"
    with pytest.raises(ValueError, match="seed: got") as caught:
        SEEDED[name](seed)
    assert [line.strip().removeprefix("evaluate.") for line in str(caught.value).splitlines()[1:]] == [text]


@pytest.mark.parametrize("seed", [0, 2**64 - 1, np.int64(3), np.uint64(2**63)], ids=repr)
def test_seeds_are_whole_numbers_of_64_bits(seed: Any) -> None:
    assert len(GUN.shoot(seed, EVENTS, 0)["pdg"]) == 2
    assert cg.study.scan_analytic(DESIGN, [1.0], seed=seed, threads=1).seed == seed
