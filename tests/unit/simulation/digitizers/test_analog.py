"""Steps of the analog read-out one by one, charge induced on neighbours, and mistakes."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.signal import fftconvolve
from scipy.special import erfc

import cgemit as cg
from cgemit import (
    Apv25Readout,
    Gun,
    Settings,
    SimulateSettings,
    TigerReadout,
    Workers,
    _core,
    load,
    run,
)
from cgemit.detector import compiled
from cgemit.detector.gas import drift_columns
from cgemit.detector.parts import local_v, strips_of_v
from cgemit.detector.readouts import APV25, TIGER, Shaper
from cgemit.reconstruction.cluster_errors import delays_of
from cgemit.simulation import digitize
from cgemit.tables import Table
from stats import assert_within

DESIGN = load("besiii-cgem-design")
GUN = Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))


@pytest.mark.parametrize("theta", [0.0, 0.36, 5.0])
def test_gain_is_a_gamma_distribution(theta: float) -> None:
    gains = _core._testing.polya_gains(theta, 5, 20_000)
    law = stats.gamma(1 + theta, scale=1 / (1 + theta))
    assert stats.kstest(gains, law.cdf).pvalue > 1e-4
    assert_within(gains.mean(), 1, law.std() / np.sqrt(len(gains)))
    assert stats.kstest(gains, stats.expon(scale=1.1).cdf).pvalue < 1e-4  # the gate can fail


def test_nearest_hole_is_that_of_all_holes() -> None:
    pitch, random = 0.14, np.random.default_rng(3)
    u, v = random.uniform(-1, 1, (2, 2000))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(-20, 21), np.arange(-12, 13)))
    holes = np.column_stack([pitch * (i + 0.5 * j), pitch * j * np.sqrt(0.75)])
    distance = np.hypot(u[:, None] - holes[:, 0], v[:, None] - holes[:, 1])
    found = _core._testing.nearest_holes(pitch, u, v)
    np.testing.assert_allclose(np.column_stack(found), holes[distance.argmin(axis=1)], atol=1e-12)
    assert_within(np.mean((u - found[0]) ** 2), 5 / 72 * pitch**2, 5 / 72 * pitch**2 / np.sqrt(len(u)))


@pytest.mark.parametrize("z", [30.0, 265.9])
@pytest.mark.parametrize("x", [200.0, 0.1])
def test_cloud_on_the_strips_against_points(x: float, z: float) -> None:
    """Points of a Gaussian, counted in the strips of both views: in the middle, at edges and at a corner."""
    layer, n = DESIGN.cgem[1], 200_000
    sheet, sigma_x, sigma_z = 1, 0.28, 0.31
    z = z - 265.9 + layer.half_length - 0.1 if z > 100 else z
    found = _core._testing.share_cloud(
        compiled(DESIGN), 1, layer.sheet_phi[sheet] + x / layer.r_readout, z, sigma_x, sigma_z
    )
    random = np.random.default_rng(7)
    points, along = random.normal(x, sigma_x, n), random.normal(z, sigma_z, n)
    inside = (points >= 0) & (points < layer.strips_x * layer.pitch_x) & (np.abs(along) <= layer.half_length)
    for view, place in ((0, points / layer.pitch_x), (1, strips_of_v(layer, local_v(layer, points, along)))):
        rows = (found["view"] == view) & (found["sheet"] == sheet)
        part = np.zeros(layer.strips_x if view == 0 else layer.strips_v)
        np.add.at(part, found["strip"][rows], found["part"][rows])
        strips = np.floor(place[inside]).astype(int)
        expected = np.bincount(strips[(strips >= 0) & (strips < len(part))], minlength=len(part)) / n
        np.testing.assert_allclose(part, expected, atol=5 * np.sqrt(0.25 / n))


@pytest.mark.parametrize("sigma", [1e-6, 0.28, 1.0, 3.0])
def test_cloud_on_the_strips_against_the_error_function(sigma: float) -> None:
    """Narrow and wide clouds in the middle of a sheet; what is beyond four widths is left out."""
    layer, x = DESIGN.cgem[1], 200.3
    found = _core._testing.share_cloud(
        compiled(DESIGN), 1, layer.sheet_phi[1] + x / layer.r_readout, 20.0, sigma, sigma
    )
    places = x / layer.pitch_x, float(strips_of_v(layer, local_v(layer, x, 20.0)))
    for view, place in enumerate(places):
        here = found["view"] == view
        strip, width = found["strip"][here], sigma / (layer.pitch_x, layer.pitch_v)[view]
        np.testing.assert_array_equal(strip, np.arange(np.floor(place - 4 * width), np.floor(place + 4 * width) + 1))
        below = [0.5 * erfc((place - edge) / width / np.sqrt(2)) for edge in np.append(strip, strip[-1] + 1)]
        np.testing.assert_allclose(found["part"][here], np.diff(below), atol=2e-9)


@pytest.mark.parametrize(
    ("shaper", "peak", "width"),
    [(TIGER.timing, 53.6, 123.0), (TIGER.charge, 154.7, 237.0), (APV25.timing, 50.0, 122.3)],
)
def test_pulse_shapes(shaper: Shaper, peak: float, width: float) -> None:
    """Peak times and widths at half maximum of the chips' responses."""
    t = np.arange(0.0, 800.0, 0.05)
    pulse = shaper.response(t)
    assert pulse.max() == pytest.approx(1, abs=1e-6)
    assert t[pulse.argmax()] == pytest.approx(peak, abs=0.1)
    assert np.count_nonzero(pulse > 0.5) * 0.05 == pytest.approx(width, abs=1.0)


@pytest.mark.parametrize(
    ("shaper", "factors"),
    [
        (APV25.timing, (0.950, 0.768, 0.634)),
        (TIGER.timing, (0.940, 0.757, 0.637)),
        (TIGER.charge, (0.986, 0.924, 0.860)),
    ],
)
def test_ballistic_deficit(shaper: Shaper, factors: tuple[float, ...]) -> None:
    t = np.arange(0.0, 800.0, 0.1)
    found = [shaper.pulse(t, duration).max() for duration in (56.5, 137.0, 193.0)]
    np.testing.assert_allclose(found, factors, atol=1.5e-3)


@pytest.mark.parametrize("shaper", [TIGER.timing, TIGER.charge, APV25.timing])
def test_filter_against_a_convolution(shaper: Shaper) -> None:
    """Random steps of a current, filtered in one pass, and summed over all pairs of times."""
    dt, random = 2.0, np.random.default_rng(1)
    steps = random.normal(size=120)
    times = dt * np.arange(len(steps))
    lag = times[:, None] - times[None, :]
    undelayed = Shaper(shaper.terms)
    response = np.array([undelayed._step(row) for row in np.maximum(lag, 0.0)])
    found = _core._testing.shaped(shaper.normalised, dt, steps)
    np.testing.assert_allclose(found, response @ steps, atol=1e-9)
    assert np.abs(found - _core._testing.shaped(shaper.normalised, 2.1, steps)).max() > 0.1  # the gate can fail


def test_delays_of_the_chips() -> None:
    """Time walk of a leading edge at a fixed threshold; half of the largest sample of a slow pulse."""
    assert TIGER.sample_delay == 162.5  # ns: 6.5 cycles of 4 periods of the clock (PARSIFAL)
    charge, delays = delays_of(TIGER, 57.0, 2.0)
    delay = delays[0]
    t = np.arange(0, 400, 0.01)
    for i in (3, 30, 60):
        true = charge[i] / TIGER.charge.pulse(np.array([delay[i] + TIGER.sample_delay]), 57.0)[0]
        assert t[np.flatnonzero(true * TIGER.timing.pulse(t, 57.0) > 2.0)[0]] == pytest.approx(delay[i], abs=0.2)
    assert np.all(np.diff(charge) > 0)
    assert np.all(np.diff(delay) < 0)
    exact = APV25.timing.pulse(t, 57.0)
    half = t[np.flatnonzero(exact > 0.5 * exact.max())[0]]
    assert delays_of(APV25, 57.0, 2.0)[1][0] == pytest.approx(half, abs=2.0)


def pulse_of(shaper: Shaper, duration: float, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and amplitudes of a charge of 1 that arrives evenly within a time, each for a current's duration."""
    step = 0.02  # ns
    t = np.arange(0, 900, step)
    found = shaper.response(t)
    for length in (duration, spread):
        box = np.full(round(length / step), step / length)
        found = fftconvolve(found, box)[: len(t)]
    return t + step, found


@pytest.mark.parametrize("spread", [80.0, 160.0])
def test_delay_of_charge_that_arrives_evenly(spread: float) -> None:
    """Against convolutions of the response with both boxes: TIGER's by charge, APV25's mean over its clock."""
    duration, threshold, row = 57.0, 2.0, round(spread / 20)
    t, edge = pulse_of(TIGER.timing, duration, spread)
    _, sampled = pulse_of(TIGER.charge, duration, spread)
    charges, delays = delays_of(TIGER, duration, threshold)
    rise = slice(0, edge.argmax())
    for true in (5.0, 12.0, 60.0):
        crossed = np.interp(threshold / true, edge[rise], t[rise])
        measured = true * np.interp(crossed + TIGER.sample_delay, t, sampled)
        found = np.interp(measured, charges, delays[row])
        assert found == pytest.approx(crossed - spread / 2, abs=0.4)
        assert abs(np.interp(measured, charges, delays[0]) - found) > 1.0  # a narrow pulse's is another one
    t, edge = pulse_of(APV25.timing, duration, spread)
    times = []
    for phase in np.arange(0.25, APV25.clock, 0.5):
        at = APV25.clock * np.arange(APV25.samples) - 4 * APV25.clock - phase
        samples = np.interp(at, t, edge, left=0.0)
        last = np.flatnonzero(samples[: samples.argmax() + 1] <= samples.max() / 2)[-1]
        times.append(np.interp(samples.max() / 2, samples[last : last + 2], at[last : last + 2]))
    assert delays_of(APV25, duration, threshold)[1][row] == pytest.approx(np.mean(times) - spread / 2, abs=0.4)


def test_line_fit_against_least_squares() -> None:
    random = np.random.default_rng(2)
    height, charge = random.uniform(-2, 2, 6), random.uniform(1, 30, 6)
    position = 3 + 0.4 * height + random.normal(0, 0.1, 6)
    weight = 1 / (1 + charge.mean() / charge)
    slope, middle = np.polyfit(height, position, 1, w=np.sqrt(weight))
    np.testing.assert_allclose(_core._testing.fit_line(position, charge, height), (middle, slope, True), rtol=1e-9)
    assert _core._testing.fit_line(position[:2], charge[:2], height[:2])[2] is False
    assert _core._testing.fit_line(position, charge, np.ones(6))[2] is False
    stiff = np.sqrt(np.append(weight, 0.7))  # one more point: slope 0, weight of the stiffness
    rows = np.column_stack([np.append(np.ones(6), 0), np.append(height, 1)])
    expected = np.linalg.lstsq(rows * stiff[:, None], np.append(position, 0) * stiff, rcond=None)[0]
    np.testing.assert_allclose(_core._testing.fit_line(position, charge, height, 0.7)[:2], expected, rtol=1e-9)
    assert _core._testing.fit_line(position, charge, np.ones(6), 0.1)[1:] == (0.0, True)
    upright = _core._testing.fit_line(np.full(6, 5.0), charge, height)  # normal incidence
    np.testing.assert_allclose(upright[:2], (5.0, 0.0), atol=1e-12)


@pytest.mark.parametrize("readout", ["tiger", "apv25"])
def test_chunks_and_threads_change_nothing(readout: str) -> None:
    """Digis and clusters of an event depend on seed and event only."""
    whole = run(DESIGN, GUN, 24, seed=4, readout=readout, until="cluster", workers=Workers(chunk=24))
    parts = run(DESIGN, GUN, 24, seed=4, readout=readout, until="cluster", workers=Workers(threads=2, chunk=5))
    other = run(DESIGN, GUN, 24, seed=5, readout=readout, until="cluster")
    assert len(whole.digis) > 24 * 12
    for name in ("charge", "time", "gid"):
        assert np.array_equal(whole.digis[name], parts.digis[name])
    assert np.array_equal(whole.clusters["err_x"], parts.clusters["err_x"], equal_nan=True)
    assert not np.array_equal(whole.digis["charge"][:50], other.digis["charge"][:50])


def test_charge_follows_gain_and_stays() -> None:
    """Without threshold and noise the strips of both views hold what survives of the ionization."""
    quiet = Apv25Readout(
        threshold_x=1e-6,
        threshold_v=1e-6,
        noise=0,
        saturation=1e9,
        gain_fluctuation=False,
        share_spread=0,
        survival=1.0,
    )
    result = run(DESIGN, GUN, 300, seed=8, readout=quiet, until="digitize")
    steps, half = result.steps, np.array([layer.half_length for layer in DESIGN.cgem])
    assert np.all(np.abs(result.truths["z"]) < half[result.truths["layer"]] - 20)
    electrons = steps["n_electrons"].sum()
    expected = 0.5 * electrons * quiet.gain * 1.602176634e-4
    for view in (0, 1):  # the largest sample of each strip: less than the charge, more than after the worst deficit
        share = result.digis["charge"][result.digis["view"] == view].sum() / expected
        assert 0.80 < share < 0.97
    double = run(DESIGN, GUN, 300, seed=8, readout=replace(quiet, gain=24_000.0), until="digitize")
    assert double.digis["charge"].sum() == pytest.approx(2 * result.digis["charge"].sum(), rel=1e-4)


def test_tiger_samples_the_charge_after_its_delay() -> None:
    """All charge of a gap in one point and on one strip of each view: the amplitude of a pulse of known length."""
    whole = run(DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 20, seed=2, until="simulate", readout="tiger")
    point = whole.steps[np.unique(whole.steps["truth"], return_index=True)[1]]
    electrons = np.full(len(point), 100, "i4")
    point = point.with_columns(n_electrons=electrons, energy=whole.truths["energy"][point["truth"]])
    quiet = TigerReadout(
        noise=0, jitter=0, saturation=1e9, gain_fluctuation=False, share_spread=0, survival=1.0, diffusion=0,
        holes=False, lorentz=False,
    )  # fmt: skip
    settings = digitize.DigitizeSettings(readout=quiet)
    digis = digitize.digitize(DESIGN, whole.truths, whole.wire_truths, settings, 1, steps=point)["digis"]
    assert len(digis) == 2 * len(point)
    charge = 0.5 * 100 * quiet.gain * 1.602176634e-4  # fC
    length = drift_columns(DESIGN)["induction"][0]  # ns, through the induction gap
    t = np.arange(0, 100, 0.01)
    fired = t[np.flatnonzero(charge * TIGER.timing.pulse(t, length) > quiet.threshold_x)[0]]
    at = charge * TIGER.charge.pulse(fired + TIGER.sample_delay + np.array([0.0, TIGER.charge.delay]), length)
    assert digis["charge"] == pytest.approx(at[0], rel=4e-4)
    assert at[1] / at[0] > 1 + 8e-4  # the gate can fail


def test_it_needs_all_ionization() -> None:
    """The chain makes clusters rows of the steps; without them the truth is named."""
    settings = Settings(simulate=SimulateSettings(steps=False))
    result = run(DESIGN, GUN, 3, seed=4, settings=settings, until="simulate")
    with pytest.raises(ValueError, match=r"truths row 0: its steps deposit .* SimulateSettings\(steps=True\)"):
        digitize.digitize(DESIGN, result.truths, result.wire_truths, digitize.DigitizeSettings(readout="tiger"), 1,
                          steps=result.steps)  # fmt: skip
    with pytest.raises(ValueError, match="steps: got True, expected False unless fluctuations are 'full'"):
        run(DESIGN, GUN, 3, readout="tiger", settings=Settings(simulate=SimulateSettings(fluctuations="off")))


def test_every_wrong_setting_is_listed() -> None:
    with pytest.raises(ValueError, match="4 problems") as caught:
        TigerReadout(gain=0, survival=1.2, neighbour=-0.1, estimator="mean")  # type: ignore[arg-type]
    assert all(name in str(caught.value) for name in ("gain", "survival", "neighbour", "estimator"))


def test_a_detector_without_layers() -> None:
    found = run("besiii-idc", Gun("mu-", p=1.0, cos_theta=0.1), 5, seed=1, readout="tiger")
    assert len(found.clusters) == 0
    assert (found.tracks["status"] == 0).all()


DESIGN_NEIGHBOURS = cg.load("besiii-cgem-design")
STRAIGHT = DESIGN_NEIGHBOURS.with_overrides({"field.bz": "1 mT"})
# Hardly any field, no diffusion: few strips with much charge. V has another threshold than X.
OFF = cg.Apv25Readout(gain=30_000.0, diffusion=0.0, threshold_v=2.5)
ON = dataclasses.replace(OFF, random_neighbours=True)
MUONS = cg.Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6))


def digis_of(readout: cg.Apv25Readout, n: int = 400, workers: cg.Workers | None = None) -> Table:
    return cg.run(STRAIGHT, MUONS, n, seed=4, readout=readout, until="digitize", workers=workers).digis


@pytest.fixture(scope="module")
def digis() -> tuple[Table, Table]:
    """Return the digis of the same electrons, without and with induced charge."""
    return digis_of(OFF), digis_of(ON)


def keys(table: Table) -> np.ndarray:
    """Return one number per digi, one apart for neighbours of one view of a sheet, and far for others."""
    gap = 10_000
    view = ((table["event"] * 8 + table["layer"]) * 2 + table["sheet"]) * 2 + table["view"]
    return np.asarray(view * gap + table["strip"])


def strips(table: Table) -> np.ndarray:
    """Return the number of strips of the view of each digi."""
    x, v = (np.array([getattr(layer, f"strips_{view}") for layer in DESIGN_NEIGHBOURS.cgem]) for view in "xv")
    return np.where(table["view"] == 0, x[table["layer"]], v[table["layer"]])


@pytest.mark.parametrize(
    ("charge", "probability", "share", "delay"),
    [
        # By hand, q = 900: -9.428 + 95.67 - 169.371 + 146.8935 - 35.947719 = 27.816781
        (30.0, 0.27816781, (math.exp(1.82236) + math.exp(1.1153) + math.exp(-15.068)) / 100, -20.640953),
        # q = 300: -9.428 + 31.89 - 18.819 + 5.4405 - 0.443799 = 8.639701
        (10.0, 0.08639701, (math.exp(1.51612) + math.exp(2.6291) + math.exp(0.766)) / 100, -15.079739),
        (1.0, 0.0, 0.5, -6.88981974),  # -6.4 %, and more than half
        (60.0, 1.0, (math.exp(2.28172) + math.exp(-1.1554) + math.exp(-38.819)) / 100, None),
    ],
)
def test_functions(charge: float, probability: float, share: float, delay: float | None) -> None:
    found = _core._testing.induced_by(charge)
    assert found[0] == pytest.approx(probability, abs=1e-9)
    assert found[1] == pytest.approx(share, rel=1e-9)
    if delay is not None:
        assert found[2] == pytest.approx(delay, abs=1e-6)


def test_rows(digis: tuple[Table, Table]) -> None:
    """Strips stay, in order, with their times; they gain charge up to saturation, and neighbours get digis."""
    off, on = digis
    before, after = keys(off), keys(on)
    assert (np.diff(on["event"]) >= 0).all()
    order = np.lexsort((on["strip"], on["view"], on["sheet"], on["layer"], on["event"]))
    np.testing.assert_array_equal(order, np.arange(len(on)))
    old = np.isin(after, before)
    np.testing.assert_array_equal(after[old], before)
    for name in ("time", "truth", "gid", "n_truths"):
        np.testing.assert_array_equal(on[name][old], off[name])
    gain = on["charge"][old] - off["charge"]
    assert gain.min() == 0
    assert 0.1 < np.mean(gain > 0) < 0.9
    assert on["charge"].max() == ON.saturation
    assert 0.02 < np.mean(~old) < 0.5
    assert (np.isin(after[~old] - 1, before) | np.isin(after[~old] + 1, before)).all()
    threshold = np.array([ON.threshold_x, ON.threshold_v])[on["view"][~old]]
    assert (on["charge"][~old] > threshold).all()
    assert ((on["strip"] >= 0) & (on["strip"] < strips(on))).all()


def test_rate_charge_and_time_of_new_strips(digis: tuple[Table, Table]) -> None:
    """Beside the last strips of clusters, with charge enough: the share of the charge, at a random time before."""
    off, on = digis
    before, after = keys(off), keys(on)
    for side in (-1, 1):
        alone = ~np.isin(before + side, before) & ~np.isin(before + 2 * side, before)
        inside = (off["strip"] > 0) & (off["strip"] < strips(off) - 1)
        sources = np.flatnonzero(alone & inside & (off["charge"] > 12))
        charge = off["charge"][sources]
        probability, share, delay = np.array([_core._testing.induced_by(one) for one in charge]).T
        place = np.searchsorted(after, before[sources] + side)
        there = after[np.minimum(place, len(after) - 1)] == before[sources] + side
        spread = math.sqrt(np.sum(probability * (1 - probability)))
        assert len(sources) > 500
        assert abs(np.count_nonzero(there) - probability.sum()) < 4 * spread
        rows = place[there]
        np.testing.assert_allclose(on["charge"][rows], (share * charge)[there], rtol=1e-12)
        pull = (on["time"][rows] - off["time"][sources[there]] - delay[there]) / 30
        assert abs(pull.mean()) < 4 / math.sqrt(len(pull))
        assert abs(pull.std() - 1) < 4 / math.sqrt(2 * len(pull))
        np.testing.assert_array_equal(on["truth"][rows], off["truth"][sources[there]])


def test_both_sides_and_strips_are_independent(digis: tuple[Table, Table]) -> None:
    off, on = digis
    before, after = keys(off), keys(on)
    single = ~np.isin(before - 1, before) & ~np.isin(before + 1, before) & (off["charge"] > 12)
    single &= ~np.isin(before - 2, before) & ~np.isin(before + 2, before)
    left, right = (np.isin(before[single] + side, after) for side in (-1, 1))
    probability = np.array([_core._testing.induced_by(one)[0] for one in off["charge"][single]])
    expected = probability**2
    assert abs(np.count_nonzero(left & right) - expected.sum()) < 4 * math.sqrt(expected.sum()) + 1


def test_any_chunks_give_the_same_bytes() -> None:
    one, other = digis_of(ON, 60), digis_of(ON, 60, cg.Workers(chunk=7, threads=2))
    for name in one.columns:
        assert one[name].tobytes() == other[name].tobytes(), name


def test_setting_by_name() -> None:
    def chosen(name: str) -> object:
        changes = {"digitize.readout.name": name, "digitize.readout.random_neighbours": True}
        return cg.Settings().with_overrides(changes).digitize.readout

    assert chosen("apv25") == dataclasses.replace(cg.Apv25Readout(), random_neighbours=True)
    with pytest.raises(ValueError, match="random_neighbours"):
        chosen("tiger")
