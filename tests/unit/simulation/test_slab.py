"""Layers of matter: what a text means, formulas by hand, widths and their errors, the command line."""

import json
import math
import pickle

import numpy as np
import pytest
from scipy import stats as distributions

import cgemit as cg
from cgemit.base.errors import Problems
from cgemit.cli.main import main
from cgemit.detector.build import library, material_named
from cgemit.simulation.slab import SlabError, angle_estimates, loss_estimates, parse_stack
from stats import assert_within

KEYS = [
    "x_over_x0", "highland_mrad", "q68_mrad", "q98_mrad", "q999_mrad", "loss_kev_mean", "loss_kev_q01",
    "loss_kev_q16", "loss_kev_q50", "loss_kev_q84", "loss_kev_q99",
]  # fmt: skip


def layers(text):
    problems = Problems()
    found = parse_stack(text, problems)
    assert not list(problems)
    return found


def test_layers_are_materials_with_thicknesses():
    kapton, copper = layers("Kapton 300 um+Cu 0.033mm")
    assert (kapton.material, kapton.thickness) == (library()["Kapton"], 0.3)
    assert (copper.material, copper.thickness) == (library()["Cu"], 0.033)
    (carbon,) = layers("C 2.0 g/cm3 2.135e+2 um")
    assert (carbon.material.density, carbon.thickness) == (2.0, 0.2135)
    assert 10 * 42.70 / carbon.material.density == pytest.approx(carbon.material.x0, rel=2e-3)  # PDG: 42.70 g/cm2
    assert layers("W 1 mm")[0].material.density == 19.3


@pytest.mark.parametrize(
    ("name", "density", "measured"),
    [("Ar", 1.662e-3, 2e-3), ("He", 1.663e-4, 2e-3), ("N", 1.165e-3, 2e-3), ("CO2", 1.842e-3, 0.01),
     ("C3H8", 1.868e-3, 0.02), ("Xe", 5.483e-3, 6e-3)],
)  # fmt: skip
def test_gases_have_the_density_of_ideal_gases(name, density, measured):
    """PDG, "Atomic and nuclear properties of materials", 20 C and 1 atm; real gases deviate a little."""
    material, _ = material_named(name)
    assert material.gas
    assert material.density == pytest.approx(density, rel=measured)


def test_gases_mix_by_volume():
    mixed, note = material_named("Ar/CO2", (70.0, 30.0))
    argon, carbon_dioxide = 0.7 * 39.95, 0.3 * (12.011 + 2 * 15.999)
    total = argon + carbon_dioxide
    assert not note
    assert mixed.density == pytest.approx(total / 24055.1, rel=1e-5)  # cm3/mol at 20 C, 1 atm
    assert dict(mixed.composition)["Ar"] == pytest.approx(argon / total)
    assert dict(mixed.composition)["O"] == pytest.approx(0.3 * 2 * 15.999 / total)
    usual, note = material_named("He/C3H8")
    assert usual == library()["MdcGas"]
    assert "60/40" in note
    equal, note = material_named("Ar/CF4")
    assert "equal parts" in note
    assert equal.composition == material_named("Ar/CF4", (50.0, 50.0))[0].composition


def test_every_problem_is_listed_with_its_place():
    text = "Kaptn 300 um + Ar/CO2 70/20 5 mm + He 3 + Ar/Cu 1 mm + CH2 3 um + Cu -3 um + C 50 g/cm3 1 mm + Be 1 kg +"
    with pytest.raises(SlabError) as caught:
        cg.slab(text, "muon+-", "3 mm", n=3, seed=-1, screening="moliera")
    problems = caught.value.problems
    assert [p.path.partition(",")[0] for p in problems] == [
        *(f"layer {number}" for number in (1, 2, 3, 4, 5, 6, 7, 8, 9)), "particle", "p", "n", "seed", "screening"
    ]  # fmt: skip
    assert all(text[int(p.path.rpartition(" ")[2]) - 1] == word for p, word in zip(problems, "KAHACCCB", strict=False))
    assert "Kapton" in problems[0].hint
    assert "100 %" in problems[1].expected
    assert "density" in problems[4].expected
    assert "moliere" in problems[-1].hint
    assert pickle.loads(pickle.dumps(caught.value)).problems == problems


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Kapton",
        "Kapton 3 um 4 um",
        "Kapton 3 um Cu 2 um",
        "Kapton 60/40 3 um",
        "Kapton 0 um",
        "Kapton 1e-30 mm",
        "Kapton 1e-7 nm",
        "C1e 3 um",
        "CH0 1 g/cm3 1 mm",
    ],
)
def test_unclear_texts_are_refused(text):
    problems = Problems()
    parse_stack(text, problems)
    assert len(list(problems)) == 1


@pytest.mark.parametrize(
    ("matter", "path", "given"),
    [
        (None, "matter", "None"),
        (5, "matter", "5"),
        (["Kapton 300 um", "Cu 5 um"], "matter[0]", "'Kapton 300 um'"),
        ([(library()["Kapton"], "300 um")], "matter[0]", "300 um"),
        ([], "matter", "no layer"),
    ],
)
def test_what_is_no_matter_is_refused_in_words(matter, path, given):
    with pytest.raises(SlabError) as caught:
        cg.slab(matter)
    assert caught.value.problems[0].path == path
    assert given in caught.value.problems[0].given


@pytest.mark.parametrize("solid", ["W", "Kapton"])
def test_solids_do_not_mix_with_gases(solid):
    problems = Problems()
    parse_stack(f"{solid}/CO2 1 mm", problems)
    assert [(p.given, p.expected) for p in problems] == [(f'"{solid}" in "{solid}/CO2"', "a gas")]


def test_formulas_of_small_angles_end_at_1_rad():
    found = cg.slab("Pb 1 cm", "e-", 0.01, 1000)
    assert found.highland_mrad is None
    assert found.core_mrad is None
    assert cg.slab("Pb 1 mm", "mu-", 0.1, 1000).highland_mrad < 1000


@pytest.mark.parametrize("thickness", [math.nan, math.inf, 0.0, -1.0, 1e-30])
def test_sheets_have_a_thickness(thickness):
    with pytest.raises(SlabError, match="thickness"):
        cg.slab([(library()["Cu"], 1.0), (library()["Cu"], thickness)])


def test_neutral_particles_are_refused():
    with pytest.raises(SlabError, match="charged"):
        cg.slab("Cu 1 mm", "gamma")


def test_numbers_by_formula():
    found = cg.slab("Kapton 300 um + Cu 33 um", "pi-", "500 MeV/c", n=2000)
    x = 0.3 / 284.1 + 0.033 / 14.35
    beta = 0.5 / math.hypot(0.5, 0.13957039)
    assert found.x_over_x0 == pytest.approx(x)
    assert found.highland_mrad == pytest.approx(
        13.6 / (beta * 0.5) * math.sqrt(x) * (1 + 0.038 * math.log(x / beta**2))
    )
    assert found.mass_gcm2 == pytest.approx(0.03 * 1.42 + 0.0033 * 8.96)
    assert sum(layer.mean_loss_kev for layer in found.layers) == pytest.approx(found.mean_loss_kev)
    assert math.hypot(*(layer.core_mrad for layer in found.layers)) == pytest.approx(found.core_mrad)
    # PDG: minimum-ionizing loss 1.403 MeV cm2/g in Cu, 1.820 in Kapton; at beta gamma 3.6 it is within 2 % of it.
    assert found.mean_loss_kev == pytest.approx(1e3 * (0.0426 * 1.820 + 0.029568 * 1.403), rel=0.02)


def test_simulation_agrees_with_the_formulas_where_they_hold():
    found = cg.slab("Be 1.4 mm", n=100_000)
    assert found.q68_mrad == pytest.approx(found.core_mrad, rel=0.02)
    assert_within(found.loss_kev_mean, found.mean_loss_kev, found.errors["loss_kev_mean"])


def test_numbers_do_not_depend_on_chunks_and_a_seed_repeats():
    long, short = (cg.slab("Cu 14 um", n=n) for n in (30_000, 25_000))
    assert np.array_equal(long.angle_1[:25_000], short.angle_1)
    assert np.array_equal(cg.slab("Cu 14 um", n=25_000).loss, short.loss)
    assert not np.array_equal(cg.slab("Cu 14 um", n=25_000, seed=2).loss, short.loss)


def test_thick_sheets_are_cut():
    whole = cg.slab("C 2 g/cm3 20 mm", p=0.2, n=40_000)
    halves = cg.slab("C 2 g/cm3 10 mm + C 2 g/cm3 10 mm", p=0.2, n=40_000, seed=2)
    for name in ("q68_mrad", "q98_mrad", "loss_kev_q50", "loss_kev_mean"):
        error = math.hypot(whole.errors[name], halves.errors[name])
        assert_within(getattr(whole, name), getattr(halves, name), error, what=name)


def test_particles_that_stop_are_counted():
    found = cg.slab("Pb 20 cm", "p", 0.3, n=1000)
    assert found.stopped + found.turned == 1000
    assert found.stopped > 900
    assert found.loss_kev_q50 == pytest.approx(1e6 * (math.hypot(0.3, 0.93827208816) - 0.93827208816))
    assert found.core_mrad is None
    assert found.mean_loss_kev is None
    assert found.q68_mrad is None
    assert "-" in str(found)
    json.dumps(found.to_dict(), allow_nan=False)


def test_widths_of_a_gaussian_agree():
    rng = np.random.default_rng(1)
    found = angle_estimates(*rng.normal(scale=2.0, size=(2, 200_000)))
    for name, (value, error) in found.items():
        assert_within(value, 2.0, error, what=name)
        assert error < 0.03


def test_mode_and_width_at_half_maximum():
    """Of Moyal's approximation to Landau's distribution: mode at its location, width found numerically 3.585."""
    sample = distributions.moyal.rvs(50, 3, size=200_000, random_state=np.random.default_rng(1))
    found = loss_estimates(sample)
    assert_within(found["mode"][0], 50, found["mode"][1])
    # The smoothing adds up to 1 %.
    assert found["fwhm"][0] == pytest.approx(3.585 * 3, abs=4 * found["fwhm"][1] + 0.1)
    assert loss_estimates(np.exp(-np.linspace(0, 9, 5000)))["mode"] == (None, None)  # highest at 0


def test_quoted_errors_are_the_spread_of_repetitions():
    runs = [cg.slab("Cu 14 um", n=3000, seed=seed) for seed in range(60)]
    for name in ("q68_mrad", "q98_mrad", "loss_kev_q01", "loss_kev_q50", "loss_kev_q84"):
        spread = np.std([getattr(run, name) for run in runs], ddof=1)
        quoted = np.mean([run.errors[name] for run in runs])
        assert_within(spread / quoted, 1.0, 1 / math.sqrt(2 * 59), what=name)


def test_passage_shows_itself(tmp_path):
    found = cg.slab("He/C3H8 16 mm", n=2000)
    assert max(map(len, str(found).splitlines())) <= 80
    assert "60/40" in str(found)
    assert found._repr_html_().count("<table>") == 3
    files = cg.draw.draw_slab(found).save(tmp_path / "slab.png")
    assert files[0].stat().st_size > 20_000


@pytest.mark.usefixtures("undrawn")
def test_command_prints_tables_or_json_and_draws(tmp_path, capsys):
    arguments = ["slab", "Kapton 300 um + Cu 33 um", "--particle", "pi-", "--p", "0.5", "-n", "5000"]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert "Highland" in captured.out
    assert max(map(len, captured.out.splitlines())) <= 80
    assert main([*arguments, "--json", "--quiet", "-o", str(tmp_path / "out")]) == 0
    captured = capsys.readouterr()
    numbers = json.loads(captured.out)
    assert not captured.err
    assert [key for key in KEYS if key not in numbers] == []
    assert [layer["material"] for layer in numbers["layers"]] == ["Kapton", "Cu"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        ".cgemit",
        "slab.pdf",
        "slab.png",
        "summary.json",
    ]
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == numbers
    assert main([*arguments, "-o", str(tmp_path / "out")]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_each_option_of_the_command_reaches_the_simulation(capsys):
    usual = {"matter": "Kapton 0.3 mm", "particle": "mu-", "p": 1.0, "n": 1000, "seed": 1, "screening": "wentzel"}
    other = {"matter": "Cu 0.3 mm", "particle": "K+", "p": 0.5, "n": 1001, "seed": 2, "screening": "moliere"}
    for changed in ((), ("matter",), ("particle",), ("p",), ("n",), ("seed",), ("screening",)):
        given = usual | {name: other[name] for name in changed}
        options = [word for name, value in given.items() if name != "matter" for word in (f"--{name}", str(value))]
        assert main(["slab", given["matter"], *options, "--json", "--quiet"]) == 0
        numbers = json.loads(capsys.readouterr().out)
        assert numbers == json.loads(json.dumps(cg.slab(**given).to_dict()))
        assert (numbers == json.loads(json.dumps(cg.slab(**usual).to_dict()))) is (not changed)


def test_command_explains_bad_input_with_exit_code_2(capsys):
    assert main(["slab", "Kaptn 300 um + Cu 33", "--particle", "muon+-", "--p", "3 mm", "--quiet"]) == 2
    captured = capsys.readouterr()
    assert "4 problems" in captured.err
    assert not captured.out
    for number, limit in (("0", "from 1000"), ("999", "from 1000"), ("20000001", "to 20000000")):
        assert main(["slab", "Cu 1 mm", "-n", number]) == 2
        assert limit in capsys.readouterr().err
    with pytest.raises(SlabError, match="from 1000 to 20000000"):
        cg.slab("Cu 1 mm", n=999)


@pytest.mark.parametrize(
    ("text", "particle", "p"),
    [
        pytest.param("H 1 nm", "p", 10, marks=pytest.mark.slow), ("Cu 1e-9 mm", "mu-", 1), ("Pb 20 cm", "p", 0.3),
        pytest.param("Ne 1 m", "e+", 0.01, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_extremes_are_drawn_and_written(text, particle, p, tmp_path, capsys):
    arguments = ["slab", text, "--particle", particle, "--p", str(p), "-n", "2000", "--quiet"]
    assert main([*arguments, "-o", str(tmp_path / "out")]) == 0
    assert "nan" not in capsys.readouterr().out
    assert (tmp_path / "out" / "slab.png").exists()


def test_empty_panel_says_why_and_losses_are_counted():
    """Electrons of 3 MeV in lead: some stop and some turn away, none comes through."""
    found = cg.slab("Pb 1 cm", "e-", 0.003, n=1000)
    assert 0 < found.turned < found.n
    shown = [text.get_text() for axes in cg.draw.draw_slab(found).axes for text in axes.texts]
    assert "no particle came through" in shown
    assert found.turned == found.n - np.count_nonzero(found.measured)
    assert any(text.startswith(f"{found.stopped:,} losses") for text in shown)


def test_rounding_is_no_error() -> None:
    """Protons that all stop lose the same: the error is 0, and the loss is printed to four digits."""
    found = cg.slab("Pb 10 cm", "p", 0.1, 1000)
    assert found.stopped == found.n
    assert found.number("loss_kev_mean") == ("5314", "0")
