"""Steps of the analog readout one by one, charge induced on neighbours, and mistakes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.special import erfc

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
from cgemit.detector import compiled, induction
from cgemit.detector.gas import drift_columns
from cgemit.detector.layers.cgem import strips_of_v
from cgemit.detector.layers.layer import local_v
from cgemit.detector.readouts import APV25, TIGER, Shaper
from cgemit.simulation import digitize
from pulses import pulse, response, risen
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


def cloud_on_strips(x: float, z: float, sigma_x: float, sigma_z: float) -> dict[str, np.ndarray]:
    """Return the charges of a cloud of charge 1 for each view on the strips of the second layer."""
    layer, sheet = DESIGN.cgem[1], 1
    sigma_v = math.hypot(math.cos(layer.stereo) * sigma_x, math.sin(layer.stereo) * sigma_z)
    reach = max(4, math.ceil(4 * max(sigma_x, sigma_v) / layer.pitch_x))
    planes = [
        induction._of_plane(layer.pitch_x, layer.induction_gap, sigma, 0.0, reach)
        for sigma in (sigma_x,) * 3 + (sigma_v,) * 3
    ]
    return _core._testing.share_cloud(
        compiled(DESIGN), 1, layer.sheet_phi[sheet] + x / layer.r_readout, z, sigma_x, sigma_z,
        way=induction.WAY, induced=(np.array(planes), reach),
    )  # fmt: skip


@pytest.mark.parametrize("z", [30.0, 265.9])
@pytest.mark.parametrize("x", [200.0, 0.1])
def test_cloud_on_the_strips_against_points(x: float, z: float) -> None:
    """Points of a Gaussian, counted in the strips of both views: in the middle, at edges and at a corner."""
    layer, n = DESIGN.cgem[1], 200_000
    sheet, sigma_x, sigma_z = 1, 0.28, 0.31
    z = z - 265.9 + layer.half_length - 0.1 if z > 100 else z
    found = cloud_on_strips(x, z, sigma_x, sigma_z)
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
    """Narrow and wide clouds in the middle of a sheet; within a strip charges are linear between 33 places."""
    layer, x = DESIGN.cgem[1], 200.2  # mm, at a place 8/32 of a strip
    found = cloud_on_strips(x, 20.0, sigma, sigma)
    places = x / layer.pitch_x, float(strips_of_v(layer, local_v(layer, x, 20.0)))
    for view, place in enumerate(places):
        here = found["view"] == view
        strip, width = found["strip"][here], sigma / (layer.pitch_x, layer.pitch_v)[view]
        below = [0.5 * erfc((place - edge) / width / np.sqrt(2)) for edge in np.append(strip, strip[-1] + 1)]
        assert found["part"][here].sum() == pytest.approx(1, abs=1e-3)
        np.testing.assert_allclose(found["part"][here], np.diff(below), atol=2e-3)
        assert (found["largest"][here] > found["part"][here] - 1e-9).all()


@pytest.mark.parametrize(
    ("shaper", "peak", "width"),
    [(TIGER.timing, 53.6, 123.0), (TIGER.charge, 154.7, 237.0), (APV25.timing, 50.0, 122.3)],
)
def test_pulse_shapes(shaper: Shaper, peak: float, width: float) -> None:
    """Peak times and widths at half maximum of the chips' responses."""
    t = np.arange(0.0, 800.0, 0.05)
    amplitude = response(shaper, t)
    assert amplitude.max() == pytest.approx(1, abs=1e-6)
    assert t[amplitude.argmax()] == pytest.approx(peak, abs=0.1)
    assert np.count_nonzero(amplitude > 0.5) * 0.05 == pytest.approx(width, abs=1.0)


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
    found = [pulse(shaper, t, duration).max() for duration in (56.5, 137.0, 193.0)]
    np.testing.assert_allclose(found, factors, atol=1.5e-3)


@pytest.mark.parametrize("shaper", [TIGER.timing, TIGER.charge, APV25.timing])
def test_filter_against_a_convolution(shaper: Shaper) -> None:
    """Random steps of a current, filtered in one pass, and summed over all pairs of times."""
    dt, random = 2.0, np.random.default_rng(1)
    steps = random.normal(size=120)
    times = dt * np.arange(len(steps))
    lag = times[:, None] - times[None, :]
    undelayed = Shaper(shaper.terms)
    rises = np.array([risen(undelayed, row) for row in np.maximum(lag, 0.0)])
    found = _core._testing.shaped(shaper.normalised, dt, steps)
    np.testing.assert_allclose(found, rises @ steps, atol=1e-9)
    assert np.abs(found - _core._testing.shaped(shaper.normalised, 2.1, steps)).max() > 0.1  # the gate can fail


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
    """All charge of a gap in one point without width: the amplitude of its current on the strip, and no other."""
    whole = run(DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.6, 0.6)), 7, seed=2, until="simulate", readout="tiger")
    point = whole.steps[np.unique(whole.steps["truth"], return_index=True)[1]]
    electrons = np.full(len(point), 100, "i4")
    point = point.with_columns(n_electrons=electrons, energy=whole.truths["energy"][point["truth"]])
    quiet = TigerReadout(
        noise=0, jitter=0, saturation=1e9, gain_fluctuation=False, share_spread=0, survival=1.0, diffusion=0,
        holes=False, lorentz=False,
    )  # fmt: skip
    detector = DESIGN.with_readout(quiet)
    digis = digitize.digitize(detector, whole.truths, whole.wire_truths, None, 1, steps=point)["digis"]
    charge = 0.5 * 100 * quiet.gain * 1.602176634e-4  # fC
    length = drift_columns(DESIGN)["induction"][0]  # ns, through the induction gap
    t = np.arange(0, 100, 0.01)
    found = dict(zip(zip(*(digis[name].tolist() for name in ("truth", "view", "strip")), strict=True), digis["charge"],
                     strict=True))  # fmt: skip
    middles, ways, transient = 0, np.linspace(0, 1, 65), 0
    for row, truth in enumerate(point["truth"].tolist()):
        layer = DESIGN.cgem[whole.truths["layer"][truth]]
        x, y, z = (point[name][row] for name in "xyz")
        turns = (np.arctan2(y, x) - np.array(layer.sheet_phi)) % (2 * np.pi)
        across = layer.r_readout * turns.min()
        for view, (pitch, place) in enumerate(
            ((layer.pitch_x, across / layer.pitch_x), (layer.pitch_v, strips_of_v(layer, local_v(layer, across, z))))
        ):
            if min(place % 1, -place % 1) < 0.04:  # charges are linear between places, 1/32 of a strip apart
                continue
            for strip in range(math.floor(place) - 3, math.floor(place) + 4):
                distance = np.array([pitch * (strip + 0.5 - place)])
                way = [induction.induced_charge(distance, w, pitch, layer.induction_gap)[0] for w in ways]
                parts = charge * np.diff(way)
                edge = pulse(TIGER.timing, t, length, parts)
                key = truth, view, strip
                if edge.max() < 0.9 * quiet.threshold_x:
                    assert key not in found
                elif edge.max() > 1.1 * quiet.threshold_x:
                    fired = t[np.flatnonzero(edge > quiet.threshold_x)[0]]
                    sampled = pulse(TIGER.charge, np.array([fired + TIGER.sample_delay]), length, parts)[0]
                    if abs(sampled - quiet.threshold_x) > 0.5:
                        read = sampled > quiet.threshold_x
                        assert (key in found) == read
                        assert not read or found[key] == pytest.approx(sampled, abs=0.006 * charge)
                        middles += read and strip == math.floor(place)
                        transient += not read
    assert middles > 30
    assert transient > 100  # the fast branch alone would read them


def test_it_needs_all_ionization() -> None:
    """The chain makes clusters rows of the steps; without them the truth is named."""
    settings = Settings(simulate=SimulateSettings(steps=False))
    result = run(DESIGN, GUN, 3, seed=4, settings=settings, until="simulate")
    with pytest.raises(ValueError, match=r"truths row 0: its steps deposit .* SimulateSettings\(steps=True\)"):
        digitize.digitize(DESIGN.with_readout("tiger"), result.truths, result.wire_truths, None, 1, steps=result.steps)
    with pytest.raises(ValueError, match="steps: got True, expected False unless fluctuations are 'full'"):
        run(DESIGN, GUN, 3, readout="tiger", settings=Settings(simulate=SimulateSettings(fluctuations="off")))


def test_every_wrong_setting_is_listed() -> None:
    with pytest.raises(ValueError, match="4 problems") as caught:
        TigerReadout(gain=0, survival=1.2, edge=-0.1, estimator="mean")  # type: ignore[arg-type]
    assert all(name in str(caught.value) for name in ("gain", "survival", "edge", "estimator"))


def test_a_detector_without_layers() -> None:
    found = run("besiii-idc", Gun("mu-", p=1.0, cos_theta=0.1), 5, seed=1, readout="tiger")
    assert len(found.clusters) == 0
    assert (found.tracks["status"] == 0).all()
