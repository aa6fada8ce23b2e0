"""Delays with which a chip measures the charge of a strip, against convolutions and a few lines of numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.signal import fftconvolve

from cgemit import Apv25Readout, TigerReadout, _core, load
from cgemit.detector.gas import cluster_sizes, ionization
from cgemit.detector.induction import WAY, charges_of_plane, induced_charge
from cgemit.detector.readouts import APV25, TIGER, AnalogReadout, Chip, Shaper, chip_arguments
from cgemit.reconstruction.cluster_errors import chip_delays
from pulses import response

Floats = npt.NDArray[np.float64]

DURATION, VELOCITY, THRESHOLD = 57.0, 0.04, 2.0
CHARGES = np.geomspace(2.1, 200.0, 64)
WIDE = 400.0  # mm, a pitch at which the current of a charge is constant


def delays(
    readout: AnalogReadout, tracks: dict[str, Any], slopes: list[float], *, pitch: float, gap: float, width: float = 0.3
) -> Floats:
    """Return what the core finds."""
    view = {"pitch": pitch, "gap": gap, "velocity": VELOCITY, "duration": DURATION, "margin": 2 * width,
            "threshold": THRESHOLD}  # fmt: skip
    return np.asarray(
        _core.readout.strip_delays(
            chip=chip_arguments(readout), view=view, way=WAY, induced=charges_of_plane(pitch, 2.0, width),
            tracks=tracks, slopes=np.array(slopes), charges=CHARGES,
        )
    )  # fmt: skip


def pulse_of(shaper: Shaper, spread: float) -> tuple[Floats, Floats]:
    """Return times and amplitudes of a charge of 1 that arrives evenly within a time."""
    step = 0.05  # ns
    t = np.arange(0, 900, step)
    found = response(shaper, t)
    for length in (DURATION, spread) if spread > 0 else (DURATION,):
        found = fftconvolve(found, np.full(round(length / step), step / length))[: len(t)]
    return t + step, found


@pytest.mark.parametrize("spread", [0.0, 80.0, 160.0])
def test_delay_of_charge_that_arrives_evenly(spread: float) -> None:
    """Against convolutions of the response with both boxes: TIGER's by charge, APV25's mean over its clock."""
    assert TIGER.sample_delay == 162.5  # ns: 6.5 cycles of 4 periods of the clock (PARSIFAL)
    gap = max(spread, 1.0) * VELOCITY
    height = (np.arange(200) + 0.5) / 200 - 0.5 if spread > 0 else np.zeros(1)
    n = 64  # tracks, at as many phases of a clock
    tracks = {
        "first": len(height) * np.arange(n + 1), "height": np.tile(height, n), "charge": np.ones(len(height) * n),
        "place": np.zeros(n),
    }  # fmt: skip
    found = delays(TigerReadout(), tracks, [0.0], pitch=WIDE, gap=gap)[0]
    t, edge = pulse_of(TIGER.timing, spread)
    _, sampled = pulse_of(TIGER.charge, spread)
    rise = slice(0, edge.argmax())
    for true in (5.0, 12.0, 60.0):
        crossed = np.interp(THRESHOLD / true, edge[rise], t[rise])
        measured = true * np.interp(crossed + TIGER.sample_delay, t, sampled)
        assert np.interp(measured, CHARGES, found) == pytest.approx(crossed - spread / 2, abs=0.5)
    assert np.all(np.diff(found) <= 1e-9)
    t, edge = pulse_of(APV25.timing, spread)
    mean = []
    for phase in np.arange(0.25, APV25.clock, 0.5):
        at = APV25.clock * np.arange(APV25.samples) - 4 * APV25.clock - phase
        samples = np.interp(at, t, edge, left=0.0)
        last_below = np.flatnonzero(samples[: samples.argmax() + 1] <= samples.max() / 2)[-1]
        mean.append(np.interp(samples.max() / 2, samples[last_below : last_below + 2], at[last_below : last_below + 2]))
    of_apv = delays(Apv25Readout(), tracks, [0.0], pitch=WIDE, gap=gap)[0]
    np.testing.assert_allclose(of_apv, np.mean(mean) - spread / 2, atol=0.6)


def random_tracks(n: int) -> dict[str, Any]:
    """Return tracks of 1 to 12 clusters."""
    random = np.random.default_rng(8)
    first = np.concatenate([[0], np.cumsum(random.integers(1, 13, n))])
    clusters = first[-1]
    return {
        "first": first, "height": random.uniform(-0.5, 0.5, clusters), "charge": random.gamma(1.0, 2.0, clusters),
        "place": random.uniform(-0.5, 0.5, n),
    }  # fmt: skip


def test_tracks_whose_ionization_fluctuates() -> None:
    """The mean of TIGER's times after the mean arrival, weighted with charges: pulses on a grid of 0.5 ns."""
    pitch, gap, width, slopes = 0.65, 5.0, 0.3, [0.0, 0.8]
    tracks = random_tracks(30)
    found = delays(TigerReadout(), tracks, slopes, pitch=pitch, gap=gap, width=width)
    step = 0.5
    t = np.arange(0.0, 900.0, step)
    responses = [response(shaper, t + step / 2) for shaper in (TIGER.timing, TIGER.charge)]
    for slope, row in zip(slopes, found, strict=True):
        times, weights = [], []
        for i in range(30):
            own = slice(tracks["first"][i], tracks["first"][i + 1])
            height = gap * tracks["height"][own]
            beside = slope * height - (slope * gap + 2 * width) * tracks["place"][i]
            arrival = (gap / 2 - height) / VELOCITY
            nodes = np.array([induced_charge(beside, float(way), pitch, 2.0, width) for way in WAY])
            nodes *= tracks["charge"][own]
            if nodes[-1].sum() < 0.3:
                continue
            charge = sum(
                np.interp(t, at + DURATION * WAY, one) for at, one in zip(arrival, nodes.T, strict=True)
            ) / nodes[-1].sum()  # fmt: skip
            edge, sampled = (fftconvolve(np.diff(charge, prepend=0.0), one)[: len(t)] for one in responses)
            true = np.geomspace(1.01 * THRESHOLD / edge.max(), 4000.0, 4000)
            crossed = t[np.argmax(edge[None, :] > THRESHOLD / true[:, None], axis=1)]
            measured = true * np.interp(crossed + TIGER.sample_delay, t, sampled)
            mean = nodes[-1] @ arrival / nodes[-1].sum()
            times.append(np.interp(CHARGES, np.maximum.accumulate(measured), crossed) - mean)
            weights.append(nodes[-1].sum())
        assert len(times) > 15
        np.testing.assert_allclose(row, np.average(times, axis=0, weights=weights), atol=1.5)
    even = delays(TigerReadout(), {**tracks, "charge": np.ones(len(tracks["charge"]))}, slopes, pitch=pitch, gap=gap)
    assert np.abs(even - found).max() > 3


def test_fluctuations_make_leading_edges_early() -> None:
    """Few clusters with most of the charge pass a low threshold before their mean arrival more than many small ones."""
    n = 400
    random = np.random.default_rng(3)

    def tracks(clusters: int) -> dict[str, Any]:
        return {
            "first": clusters * np.arange(n + 1), "height": random.uniform(-0.5, 0.5, n * clusters),
            "charge": np.ones(n * clusters), "place": np.zeros(n),
        }  # fmt: skip

    few, many = (delays(TigerReadout(), tracks(number), [0.0], pitch=WIDE, gap=6.0)[0] for number in (4, 200))
    large = np.searchsorted(CHARGES, 50.0)
    assert few[large] > many[large] + 5


def test_sizes_of_clusters() -> None:
    """They have the shares of the gas's table, and its tail falls as 1/n^2."""
    table = ionization("ar-ic4h10-90-10")
    sizes = cluster_sizes(table, np.random.default_rng(1).random((2, 400_000)))
    listed = len(table.sizes) - len(table.tail) + 1
    for size in (1, 2, 10, listed):
        assert np.mean(sizes <= size) == pytest.approx(table.sizes[size - 1], abs=2e-3)
    low, high = table.tail[:2]
    assert np.mean(sizes[sizes > listed] < high) > 0.1
    inside = sizes[(sizes >= low) & (sizes < high)]
    assert np.mean(1 / inside) == pytest.approx((1 / low**2 - 1 / high**2) / 2 / (1 / low - 1 / high), rel=0.03)


def test_tables_of_a_detector() -> None:
    """X of all layers, then V; the same at each call, with delays that fall with the charge."""
    design = load("besiii-cgem-design")
    readout = TigerReadout()
    found = chip_delays(design, readout)
    charges, tables = found["charges"].reshape(6, -1), found["delays"].reshape(6, len(found["spreads"]), -1)
    assert np.all(np.diff(charges) > 0)
    assert np.all(np.diff(tables[:, 3]) <= 0)
    other = chip_delays(design.with_overrides({"cgem.L2.pitch_v": "1.3 mm"}), readout)
    changed = np.any(other["delays"].reshape(tables.shape) != tables, axis=(1, 2))
    np.testing.assert_array_equal(changed, [False, False, False, False, True, False])


def test_every_wrong_number_is_listed() -> None:
    tracks = random_tracks(3)
    tracks["height"][1] = 0.7
    tracks["first"] = tracks["first"] + 1
    with pytest.raises(ValueError, match=r"(?s)velocity.*height.*first"):
        _core.readout.strip_delays(
            chip=chip_arguments(TigerReadout()),
            view={"pitch": 0.65, "gap": 5.0, "velocity": -1.0, "duration": 57.0, "margin": 0.6, "threshold": 2.0},
            way=WAY, induced=charges_of_plane(0.65, 2.0, 0.3), tracks=tracks, slopes=np.zeros(1), charges=CHARGES,
        )  # fmt: skip


def test_a_chip_of_another_kind_is_none_of_those_known() -> None:
    view = {"pitch": 0.65, "gap": 5.0, "velocity": 0.04, "duration": 57.0, "margin": 0.6, "threshold": 2.0}
    rest = {"view": view, "way": WAY, "induced": charges_of_plane(0.65, 2.0, 0.3), "tracks": random_tracks(3)}
    chip = chip_arguments(TigerReadout())
    for wrong, expected in (
        (chip | {"kind": "vmm3"}, "got vmm3, expected tiger or apv25"),
        ({name: value for name, value in chip.items() if name != "clock"}, "clock: missing"),
    ):
        with pytest.raises(ValueError, match=expected):
            _core.readout.strip_delays(chip=wrong, slopes=np.zeros(1), charges=CHARGES, **rest)
    with pytest.raises(TypeError, match="level"):  # where it takes the time has no default
        Chip(kind="vmm3", timing=TIGER.timing, charge=TIGER.charge, clock=25.0)  # type: ignore[call-arg]
