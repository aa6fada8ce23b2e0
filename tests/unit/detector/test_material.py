"""Materials against published numbers."""

import math

import numpy as np
import pytest

from cgemit.detector import DetectorError, load
from cgemit.detector.build import library
from cgemit.detector.material import (
    K,
    elements,
    excitation_of_fractions,
    fractions_of_formula,
    general_density_effect,
    radiation_length,
    shell_correction,
)

MUON, ELECTRON = 0.1056583755, 0.51099895e-3  # GeV


def bethe(name: str, betagamma: float) -> float:
    """Return the mean loss of a muon in MeV cm2/g: PDG 2024, "Passage of particles through matter", eq. 34.5."""
    material = library()[name]
    gamma = math.hypot(1, betagamma)
    beta2 = (betagamma / gamma) ** 2
    ratio = ELECTRON / MUON
    w_max = 2 * ELECTRON * betagamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    log_term = material.log_term(np.array([math.log(betagamma)]))[0]
    bracket = math.log(2 * ELECTRON * betagamma**2 * w_max) + log_term - 2 * beta2
    return 0.5 * K * 1e3 * material.z_over_a / beta2 * bracket


@pytest.mark.parametrize(
    ("name", "pdg"), [("Be", 1.595), ("Al", 1.615), ("Cu", 1.403), ("Ar", 1.519), ("Au", 1.134), ("Kapton", 1.820)]
)
def test_minimum_ionization_is_the_pdg_value(name: str, pdg: float) -> None:
    losses = [bethe(name, betagamma) for betagamma in np.geomspace(2, 6, 41)]
    assert min(losses) == pytest.approx(pdg, rel=0.004)
    assert losses[0] > min(losses) < losses[-1]


@pytest.mark.parametrize(
    ("name", "plasma_ev"),
    [("Be", 26.10), ("Al", 32.86), ("Ar", 0.789), ("Cu", 58.27), ("Au", 80.22), ("Kapton", 24.59)],
)
def test_at_high_energy_only_the_plasma_energy_matters(name: str, plasma_ev: float) -> None:
    # delta -> 2 ln(beta gamma) + 2 ln(plasma energy/I) - 1 (PDG 2024, eq. 34.6), plasma energies of the PDG tables.
    betagamma = 3e4
    ratio = ELECTRON / MUON
    w_max = 2 * ELECTRON * betagamma**2 / (1 + 2 * betagamma * ratio + ratio**2)
    bracket = math.log(2 * ELECTRON * w_max / (plasma_ev * 1e-9) ** 2) - 1
    expected = 0.5 * K * 1e3 * library()[name].z_over_a * bracket
    assert bethe(name, betagamma) == pytest.approx(expected, rel=0.001)


@pytest.mark.parametrize(
    ("symbol", "pdg"),
    [("H", 63.04), ("He", 94.32), ("Be", 65.19), ("C", 42.70), ("N", 37.99), ("O", 34.24), ("F", 32.93), ("Al", 24.01),
     ("Si", 21.82), ("Ar", 19.55), ("Fe", 13.84), ("Cu", 12.86), ("Xe", 8.48), ("W", 6.76), ("Au", 6.46), ("Pb", 6.37)],
)  # fmt: skip
def test_radiation_lengths_of_elements(symbol: str, pdg: float) -> None:
    assert radiation_length(elements()[symbol]) == pytest.approx(pdg, rel=0.002)


@pytest.mark.parametrize("symbol", ["Al", "Cu", "W", "Au", "Pb"])
def test_the_coulomb_correction_is_the_sum_of_its_series(symbol: str) -> None:
    """Davies, Bethe and Maximon: a^2 sum of 1/n/(n^2 + a^2), a = Z alpha; Tsai's polynomial has four digits of it."""
    element, n = elements()[symbol], np.arange(1, 20_000)
    a2 = (element.z / 137.035999) ** 2
    screened = math.log(184.15 * element.z ** (-1 / 3)) - a2 * np.sum(1 / n / (n**2 + a2))
    inelastic = math.log(1194 * element.z ** (-2 / 3))
    expected = 716.408 * element.a / (element.z**2 * screened + element.z * inelastic)
    assert radiation_length(element) == pytest.approx(expected, rel=1e-4)


def proton_loss(material: object, kinetic: float) -> float:
    """Return the collision loss of a proton, MeV cm2/g, by the material's own logarithm; kinetic energy in GeV."""
    mass = 0.93827208816
    gamma = 1 + kinetic / mass
    betagamma = math.sqrt(gamma**2 - 1)
    beta2, ratio = (betagamma / gamma) ** 2, ELECTRON / mass
    w_max = 2 * ELECTRON * betagamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    log_term = material.log_term(np.array([math.log(betagamma)]))[0]
    bracket = math.log(2 * ELECTRON * betagamma**2 * w_max) + log_term - 2 * beta2
    return 0.5 * K * 1e3 * material.z_over_a / beta2 * bracket


@pytest.mark.parametrize(("kinetic", "pstar"), [(0.01, 45.67), (0.05, 12.45), (0.1, 7.289)])
def test_slow_protons_in_water(kinetic: float, pstar: float) -> None:
    # PSTAR (NIST), stopping power of liquid water with I = 75 eV, MeV cm2/g; compared with copies of the table in
    # public repositories.
    water = own(density="1 g/cm3", composition="H2O", excitation_energy="75 eV")
    assert proton_loss(water, kinetic) == pytest.approx(pstar, rel=0.005)


def test_shell_correction_by_hand() -> None:
    # Copper, I = 322 eV, beta gamma = 0.3, 1/0.09 = 11.111, 123.46, 1371.7:
    # (0.422377 x 11.111 + 0.0304043 x 123.46 - 0.00038106 x 1371.7) 1e-6 x 103684 = 0.8216
    # (3.858019 x 11.111 - 0.1667989 x 123.46 + 0.00157955 x 1371.7) 1e-9 x 33386248 = 0.8159
    copper, at = library()["Cu"], np.log([0.3, 0.13, 0.05, 30.0])
    c = shell_correction(322.0, at)
    assert c[0] == pytest.approx(1.6375, rel=1e-3)
    assert c[1] == c[2]  # held constant where the formula ends
    assert c[3] < 1e-3
    without = -2 * math.log(322e-9) - copper.density_effect.delta(at)
    assert copper.log_term(at) == pytest.approx(without - 2 * c / 29, rel=1e-12)
    # Electrons of a compound count one by one, with the excitation energies of the elements.
    water = own(density="1 g/cm3", composition="H2O", excitation_energy="75 eV")
    shells = (2 * shell_correction(19.2, at) + shell_correction(95.0, at)) / 10
    found = -2 * math.log(75e-9) - water.density_effect.delta(at) - water.log_term(at)
    assert found == pytest.approx(2 * shells, rel=1e-9, abs=1e-12)


def test_matter_known_in_bulk_gets_one_equivalent_element() -> None:
    # Aluminium by its radiation length and Z/A alone is nearly element 13.
    bulk = own(density="2.70 g/cm3", x0="88.97 mm", z_over_a=13 / 26.982, excitation_energy="166 eV")
    ((element, moles),) = bulk.elements()
    assert element.z == pytest.approx(13, rel=0.03)
    assert element.z * moles == pytest.approx(13 / 26.982)
    assert element.excitation == pytest.approx(166)


def test_kapton_by_hand() -> None:
    # C22 H10 N2 O5: 264.242 + 10.08 + 28.014 + 79.995 = 382.331 g/mol, 196 electrons.
    fractions = fractions_of_formula("C22H10N2O5")
    assert fractions["C"] == pytest.approx(264.242 / 382.331)
    assert library()["Kapton"].z_over_a == pytest.approx(196 / 382.331)
    # Bragg: exp[(132 ln 81 + 10 ln 19.2 + 14 ln 82 + 40 ln 95)/196]
    bragg = math.exp((132 * math.log(81) + 10 * math.log(19.2) + 14 * math.log(82) + 40 * math.log(95)) / 196)
    assert excitation_of_fractions(fractions) == pytest.approx(bragg * 1e-9, rel=1e-12)


def test_general_form_is_near_the_published_parameters() -> None:
    # A difference of 0.5 in delta is 2 % of the loss.
    for name in ("Be", "Al", "Cu", "Au", "Ar", "Kapton"):
        material = library()[name]
        general = general_density_effect(material.excitation_energy, material.z_over_a, material.density, material.gas)
        assert general.c == pytest.approx(material.density_effect.c, abs=0.015)
        grid = np.log(np.geomspace(1, 1e4, 30))
        assert np.max(np.abs(general.delta(grid) - material.density_effect.delta(grid))) < 0.5


@pytest.mark.parametrize(
    ("c", "excitation", "gas", "x0", "x1"),
    [
        (9.9, 50, True, 1.6, 4), (10.4, 50, True, 1.7, 4), (10.9, 50, True, 1.8, 4), (11.4, 50, True, 1.9, 4),
        (12.2, 50, True, 2.0, 4), (12.3, 50, True, 2.0, 5), (13.79, 50, True, 2.0, 5), (14.0, 50, True, 2.064, 5),
        (3.6, 99, False, 0.2, 2), (3.7, 99, False, 0.2062, 2), (5.2, 101, False, 0.2, 3), (5.3, 101, False, 0.2278, 3),
    ],
)  # fmt: skip
def test_general_form_as_published(c: float, excitation: float, gas: bool, x0: float, x1: float) -> None:
    """On both sides of each limit of Sternheimer and Peierls; a makes delta 0 at x0, for any density."""
    density = (28.816 * math.exp((c - 1) / 2) / excitation) ** -2 / 0.5
    found = general_density_effect(excitation * 1e-9, 0.5, density, gas)
    expected = (c, x0, x1, (c - 2 * math.log(10) * x0) / (x1 - x0) ** 3, 3)
    assert tuple(found) == pytest.approx(expected, rel=1e-12)


def test_density_effect_is_continuous() -> None:
    for material in library().values():
        effect = material.density_effect
        edges = np.array([effect.x0, effect.x1]) * math.log(10)
        jumps = effect.delta(edges + 1e-9) - effect.delta(edges - 1e-9)
        assert np.all(np.abs(jumps) < 0.15), material.name  # conductors: delta of up to 0.14 below x0 is neglected


def test_foils_are_the_same_matter_at_lower_density() -> None:
    bulk, foil = library()["Cu"], library()["CuFoil"]
    assert foil.x0 * foil.density == pytest.approx(bulk.x0 * bulk.density)
    assert foil.excitation_energy == bulk.excitation_energy
    assert foil.density_effect == bulk.density_effect


def own(**material: object) -> object:
    tables = {
        "base": "besiii-cgem",
        "materials": {"Own": material},
        "cgem": {"L1": {"cathode": [{"material": "Own", "thickness": "1 mm"}]}},
    }
    return load(tables).cgem[0].cathode[0].material


def test_own_materials() -> None:
    argon = own(density="1.662e-3 g/cm3", composition="Ar", gas=True)
    assert argon.x0 == pytest.approx(19.55 / 1.662e-3 * 10, rel=0.003)
    mix = own(density="1.5e-3 g/cm3", composition={"Ar": 0.7, "C": 0.1, "O": 0.2}, gas=True)
    assert mix.z_over_a == pytest.approx(0.7 * 18 / 39.95 + 0.1 * 6 / 12.011 + 0.2 * 8 / 15.999)
    bulk = own(density="1 g/cm3", x0="300 mm", z_over_a=0.5, excitation_energy="75 eV")
    assert (bulk.x0, bulk.z_over_a, bulk.composition) == (300.0, 0.5, ())
    thin = own(base="CgemGas", density="3.4903e-3 g/cm3")
    assert thin.x0 == pytest.approx(121650 / 2)
    assert thin.density_effect.c == pytest.approx(library()["CgemGas"].density_effect.c - math.log(2))


@pytest.mark.parametrize(
    ("material", "path", "given"),
    [
        ({"composition": "Ar"}, "materials.Own", "only composition"),
        ({"density": "1 g/cm3"}, "materials.Own", "only density"),
        ({"density": "1 g/cm3", "composition": "Qq2"}, "materials.Own.composition", "Qq"),
        ({"density": "1 g/cm3", "composition": "h2o"}, "materials.Own.composition", "h2o"),
        ({"density": "1 g/cm3", "composition": {"C": 0.5}}, "materials.Own.composition", "sum 0.5"),
        ({"density": "1 g/cm3", "composition": {"C": -1}}, "materials.Own.composition.C", "-1"),
        ({"density": "1 g/cm3", "composition": 3}, "materials.Own.composition", "3"),
        ({"density": "-1 g/cm3", "composition": "C"}, "materials.Own.density", "-1 g/cm3"),
        ({"base": "Kaptn", "density": "1 g/cm3"}, "materials.Own.base", "Kaptn"),
        ({"base": "Own", "density": "1 g/cm3"}, "materials.Own.base", "Own"),
        ({"base": "Kapton", "composition": "C"}, "materials.Own.composition", "beside base"),
        ({"density": "1 g/cm3", "composition": "C", "gas": 1}, "materials.Own.gas", "1"),
        (
            {"density": "1 g/cm3", "composition": "C", "density_effect": {"c": 1}},
            "materials.Own.density_effect",
            "table",
        ),
    ],
)
def test_bad_materials(material: dict[str, object], path: str, given: str) -> None:
    with pytest.raises(DetectorError) as caught:
        own(**material)
    assert [problem.path for problem in caught.value.problems] == [path]
    assert given in caught.value.problems[0].given
