"""Quantities as strings with units."""

import math
import pickle

import pytest
import scipy.constants
from hypothesis import given
from hypothesis import strategies as st

from cgemit.units import GEV_PER_T_MM, LIGHT, NATIVE, QuantityError, format_quantity, parse_quantity, units_of


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        ("87.5 mm", "length", 87.5),
        ("650 um", "length", 0.65),
        ("650 µm", "length", 0.65),
        ("8.75cm", "length", 87.5),
        (".5 m", "length", 500.0),
        ("45 deg", "angle", math.pi / 4),
        ("-31.05 deg", "angle", math.radians(-31.05)),
        ("0.5 rad", "angle", 0.5),
        ("-1 T", "field", -1.0),
        ("9 kG", "field", 0.9),
        ("1.74515e-3 g/cm3", "density", 1.74515e-3),
        ("1.2 kg/m^3", "density", 1.2e-3),
        ("79.6 eV", "energy", 79.6e-9),
        ("150 MeV/c", "momentum", 0.15),
        ("10 ps", "time", 0.01),
        ("1.7 fC", "charge", 1.7),
        ("2.2 um/mm", "slope", 2.2e-3),
        ("0.9", "dimensionless", 0.9),
        (0.9, "dimensionless", 0.9),
        ("90 %", "dimensionless", 0.9),
    ],
)
def test_values(text: object, dimension: str, value: float) -> None:
    assert parse_quantity(text, dimension) == pytest.approx(value, rel=1e-15)


def test_decimal_factors_are_exact() -> None:
    for um in (3, 14.36, 50, 130, 650, 660):
        assert parse_quantity(f"{um} um", "length") == float(f"{um}e-3")


@pytest.mark.parametrize(
    ("text", "dimension", "given", "hint"),
    [
        ("650", "length", "no unit", '"650 mm" or "650 um"'),
        (650, "length", "no unit", '"650 mm"'),
        ("5 T", "length", "a field", ""),
        ("5 mm", "energy", "a length", ""),
        ("5 dge", "angle", 'unknown unit "dge"', "deg"),
        ("nan mm", "length", "not finite", ""),
        ("inf mm", "length", "not finite", ""),
        (math.inf, "dimensionless", "not finite", ""),
        ("wide", "length", '"wide"', ""),
        ("1,5 mm", "length", "unknown unit", ""),
        (None, "length", "None", ""),
        (True, "dimensionless", "True", ""),
        ([1], "length", "[1]", ""),
    ],
)
def test_errors_say_what_was_given_and_expected(text: object, dimension: str, given: str, hint: str) -> None:
    with pytest.raises(QuantityError) as caught:
        parse_quantity(text, dimension)
    assert given in caught.value.given
    assert hint in caught.value.hint
    assert caught.value.expected in str(caught.value)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(sorted(NATIVE)))
def test_native_text_reads_back_exactly(value: float, dimension: str) -> None:
    assert parse_quantity(format_quantity(value, dimension), dimension) == value


@pytest.mark.parametrize("dimension", sorted(NATIVE))
def test_every_unit_reads_back(dimension: str) -> None:
    for unit in units_of(dimension):
        assert parse_quantity(format_quantity(1.25, dimension, unit), dimension) == pytest.approx(1.25, rel=1e-5)


def test_constants_against_codata() -> None:
    assert scipy.constants.c * 1e-6 == LIGHT  # mm/ns
    momentum = scipy.constants.e * 1e-3 / scipy.constants.e * scipy.constants.c * 1e-9  # e 1 T 1 mm, in GeV/c
    assert math.isclose(momentum, GEV_PER_T_MM, rel_tol=1e-15)
