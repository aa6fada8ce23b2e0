"""Numbers that every function reads in the same way, and texts of constraints."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.base.errors import Problems, ProblemsError
from cgemit.base.validate import NO, Axes, Quantity, Whole
from cgemit.cli import options
from cgemit.detector.keys import Key
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


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1.0), ("200 MeV/c", 0.2), (" 1e-1 ", 0.1), ("0.2:0.8", (0.2, 0.8)), ("100 MeV/c:1 GeV/c", (0.1, 1.0)),
        ("0.2:1.0:5", [0.2, 0.4, 0.6, 0.8, 1.0]), ("2:3:1", [2.0]), ("1,500 MeV/c", [1.0, 0.5]),
    ],
)  # fmt: skip
def test_command_guns_samples_and_plans_read_a_text_alike(text: str, value: Any) -> None:
    assert options.momenta(text) == value
    gun = cg.Gun("mu-", p=value, theta=1.0)
    assert gun == cg.Gun("mu-", p=text, theta=1.0) == cg.Gun("mu-", p=options.momenta(text), theta=1.0)
    assert cg.sample("cosmic", p=value).p == cg.sample("cosmic", p=text).p == gun.p
    angles = text.replace(" MeV/c", " mrad").replace(" GeV/c", " rad")
    assert cg.Gun("mu-", p=1, theta=1, phi=angles) == cg.Gun("mu-", p=1, theta=1, phi=options.angles(angles))
    if not isinstance(value, tuple):
        assert cg.study.Evaluation(p=text).p == cg.study.Evaluation(p=value).p
        np.testing.assert_array_equal(cg.analytic(DESIGN, "mu-", p=text).p, cg.analytic(DESIGN, "mu-", p=value).p)


@pytest.mark.parametrize(
    "text", ["", "x", "1 GeV", "nan", "1:x", "1:2:0", "1:2:1.5", "1:2:1e9", "1:2:3:4", "1,,2", "2:1", "1,2 mm,x"]
)
def test_command_guns_and_plans_refuse_a_text_with_the_same_words(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError) as command:
        options.momenta(text)
    with pytest.raises(ProblemsError) as gun:
        cg.Gun("mu-", p=text, theta=1.0)
    words = "; ".join(str(problem._replace(path=problem.path.removeprefix("p"))) for problem in gun.value.problems)
    assert str(command.value) == words
    with pytest.raises(ProblemsError) as plan:
        cg.study.Evaluation(p=text)
    words = "; ".join(str(problem._replace(path=problem.path.removeprefix("p"))) for problem in plan.value.problems)
    assert str(command.value) == words


def test_ranges_in_plans_are_those_of_the_command() -> None:
    for text in ("-0.5:0.5", "0.1,0.2", "0:0.8:3", "0.3"):
        assert cg.study.Evaluation(cos_theta=text) == cg.study.Evaluation(cos_theta=options.cosines(text))
    assert cg.study.Evaluation(cos_theta="0:0.5,0.5:0.9").cos_theta == ((0.0, 0.5), (0.5, 0.9))
    assert cg.study.Evaluation(p="0.2:0.8").p == ((0.2, 0.8),)


def test_vertices_are_those_of_the_command() -> None:
    for text in ("1,2,3 cm", "0:1,0,-1:1 cm"):
        gun = cg.Gun("mu-", p=1.0, theta=1.0, vertex=text)
        assert gun == cg.Gun("mu-", p=1.0, theta=1.0, vertex=options.triple(text))
    assert gun.vertex == ((0.0, 1.0), 0.0, (-1.0, 10.0))
    problems = Problems()
    assert Axes("length").read("vertex", "1,2", problems) is NO
    assert str(problems[0]) == "vertex: got '1,2', expected three, along x, y and z"


@pytest.mark.parametrize(
    ("constraint", "text", "good", "bad"),
    [
        (Whole(1, 50), "a whole number from 1 to 50", [1, 50, np.int64(7)], [0, 51, 1.0, True, "3", None]),
        (Quantity(), "a finite number", [-1, 0.0, "2"], [math.inf, math.nan, None, True]),
        (Quantity(low=0), "zero or a positive number", [0, 1e300], [-1e-300, math.inf]),
        (Quantity(low=0, above=True), "a positive number", [1e-300], [0, -1]),
        (Quantity(low=1e-12), "a number of at least 1e-12", [1e-12], [0]),
        (Quantity(low=0, high=1, below=True), "a number from 0 to below 1", [0, 0.999], [1]),
        (Quantity(low=0, high=1, above=True, below=True), "a number between 0 and 1", [0.5], [0, 1]),
        (Quantity(low=2, high=20), "a number from 2 to 20", [2, 20], [1.9, 21]),
        (Quantity("length", 0, 2000, above=True), "a length in mm above 0, up to 2000", [2000, "20 cm"], [0, "3 m"]),
        (Quantity("length", 0, above=True), "a length in mm above 0", [1, "1 um"], [0, "1 T"]),
        (Quantity("time", -1e3, 1e3), "a time in ns within +-1000", [-1000, "1 us"], [1001, "-2 us"]),
        (Key("integer", 4, 10_000), "a whole number from 4 to 10000", [], []),
        (Key("length", 0, 9, True), "a length with its unit (mm, um, nm, cm, m) above 0, up to 9 mm", ["9 mm"], [9]),
    ],
    ids=repr,
)  # fmt: skip
def test_constraints_write_what_they_allow(constraint: Any, text: str, good: list[Any], bad: list[Any]) -> None:
    assert constraint.expected() == text
    for value in good:
        problems = Problems()
        assert constraint.read("x", value, problems) is not NO
        assert not problems
    for value in bad:
        problems = Problems()
        assert constraint.read("x", value, problems) is NO
        assert [problem.path for problem in problems] == ["x"]
