"""The random numbers are Philox's, uniform, normal, and independent from stream to stream."""

import numpy as np
import pytest
from scipy import stats as distributions
from scipy.special import ndtri

from cgemit import _core
from stats import assert_within

TEST = _core.common.Purpose.test


def draws(function, n, seed=1, particle=0, place=0, block=0, first=0):
    """Return (n, 4) numbers of the events first ... first + n - 1."""
    events = np.arange(first, first + n, dtype=np.int64)
    return function(seed, events, np.full(n, particle, np.int32), TEST, place, block)


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_known_answers(counter, key, expected):
    """Philox4x32-10 gives the words published with Random123 (kat_vectors)."""
    assert tuple(_core._testing.philox4x32(counter=counter, key=key)) == expected


def test_counter_and_key_of_a_stream():
    """Seed, event, particle, purpose, place and block each have their own bits of counter and key, as documented."""
    seed, event, particle, place, block = 0x0123456789ABCDEF, 0x1122334455667788, 0xABCDE, 0x2ABCDEF, 0x9AB
    counter = [(int(TEST) << 26) | place, (particle << 12) | block, event & 0xFFFFFFFF, event >> 32]
    words = np.array(_core._testing.philox4x32(counter=counter, key=[seed & 0xFFFFFFFF, seed >> 32]), dtype=np.float64)
    found = _core.common.uniforms(seed, np.array([event]), np.array([particle], np.int32), TEST, place, block)
    np.testing.assert_array_equal(found[0], (words + 0.5) / 2**32)


def test_normals_are_quantiles_of_the_uniforms():
    """A normal number is the quantile that the uniform one of the same draw stands for, to 2e-9."""
    u, g = draws(_core.common.uniforms, 25_000), draws(_core.common.normals, 25_000)
    np.testing.assert_allclose(g, ndtri(u), rtol=2e-9, atol=1e-12)
    assert np.abs(g).max() > 4  # the tails' own formula is among them


def test_pinned_first_draws():
    """The first numbers of seed 1 never change: every stored result depends on them."""
    pinned = [
        [0.6205046734539792, 0.06720580242108554, 0.7118037265026942, 0.34178201213944703],
        [0.8457191648194566, 0.9142801366979256, 0.39406230801250786, 0.9316674658330157],
    ]
    np.testing.assert_allclose(draws(_core.common.uniforms, 2), pinned, rtol=0, atol=1e-15)


def test_uniforms_are_uniform():
    """Numbers lie strictly inside (0, 1), with the moments and the distribution of a uniform variable."""
    u = draws(_core.common.uniforms, 50_000).ravel()
    assert u.min() > 0
    assert u.max() < 1
    assert_within(u.mean(), 0.5, np.sqrt(1 / 12 / u.size))
    assert_within(u.var(), 1 / 12, np.sqrt(1 / 180 / u.size))
    assert distributions.kstest(u, "uniform").pvalue > 6e-5  # four standard deviations


def test_normals_are_normal():
    """Mean, variance, skewness, kurtosis and the whole distribution are those of a standard normal variable."""
    g = draws(_core.common.normals, 50_000).ravel()
    assert np.all(np.isfinite(g))
    for power, expected, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert_within(np.mean(g**power), expected, np.sqrt(variance / g.size), what=f"moment {power}")
    assert distributions.kstest(g, "norm").pvalue > 6e-5
    # The gates see a width that is wrong by three per cent.
    assert distributions.kstest(1.03 * g, "norm").pvalue < 6e-5
    with pytest.raises(AssertionError, match="standard errors"):
        assert_within(np.mean((1.03 * g) ** 2), 1, np.sqrt(2 / g.size))


@pytest.mark.parametrize(
    "other", [{"seed": 2}, {"seed": 1 + 2**32}, {"particle": 1}, {"place": 1}, {"block": 1}, {"first": 1}]
)
def test_neighbouring_streams_are_independent(other):
    """Streams that differ by one in seed, event, particle, place or block are uncorrelated, as are their squares."""
    n = 50_000
    a, b = draws(_core.common.normals, n).ravel(), draws(_core.common.normals, n, **other).ravel()
    assert_within(np.mean(a * b), 0.0, 1 / np.sqrt(a.size), what="values")
    assert_within(np.mean((a**2 - 1) * (b**2 - 1)), 0.0, 2 / np.sqrt(a.size), what="squares")


def test_four_numbers_of_a_draw_are_independent():
    """The four numbers of one draw are uncorrelated, as are their squares."""
    g = draws(_core.common.normals, 50_000)
    for sample, variance in ((g, 1), (g**2 - 1, 2)):
        products = (sample.T @ sample / len(g))[np.triu_indices(4, 1)]
        assert_within(products, 0.0, variance / np.sqrt(len(g)))


def test_all_purposes_differ():
    """Every purpose has its own stream."""
    first = [
        _core.common.uniforms(1, np.arange(1), np.zeros(1, np.int32), purpose, 0)[0, 0]
        for purpose in _core.common.Purpose
    ]
    assert len(set(first)) == len(_core.common.Purpose) >= 7


def test_a_row_does_not_depend_on_the_others():
    """One event drawn alone gets the numbers it has among many."""
    alone = draws(_core.common.normals, 1, first=77)
    np.testing.assert_array_equal(alone[0], draws(_core.common.normals, 100)[77])


def test_wrong_shapes_are_refused():
    """Columns of different lengths raise an error that names the argument."""
    with pytest.raises(ValueError, match="particle"):
        _core.common.uniforms(1, np.arange(3), np.zeros(2, np.int32), TEST, 0)
