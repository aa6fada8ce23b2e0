"""A readout from outside the package: description, digitizer and clusterer, and one line that registers them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from cgemit import DigitizeSettings, FitSettings, Gun, Result, Settings, Workers, analytic, load, register_readout, run
from cgemit.detector import ReadoutGroup
from cgemit.detector.parts import local_v, strips_of_v
from cgemit.detector.readouts import READOUTS, TIGER, AnalogReadout, Chip, ChipErrors, Readout, TigerReadout
from cgemit.reconstruction.cluster import CLUSTERERS, cluster, clusterer_of
from cgemit.reconstruction.cluster_errors import chip_errors
from cgemit.reconstruction.clusterers.binary import BinaryClusterer
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings, Floats
from cgemit.simulation import digitize
from cgemit.simulation.digitizers import Digitizer
from cgemit.simulation.transport import simulate
from cgemit.tables import Table
from stats import assert_within

DESIGN = load("besiii-cgem-design")


@pytest.mark.parametrize("kind", READOUTS.values(), ids=READOUTS)
def test_settings_that_make_infinite_charges_or_positions_are_refused(kind: type[Readout]) -> None:
    """A gain of 1.7e308 made charges infinite."""
    limits = {"gain": 1e8, "first_gain": 1e8, "sigma_x": 1000, "sigma_v": 1000, "sigma": 1000, "share_spread": 10}
    limits = {name: most for name, most in limits.items() if name in kind.__dataclass_fields__}
    kind(**limits)
    for name, most in limits.items():
        for wrong in (1.0001 * most, 1.7e308, np.nan, np.inf):
            with pytest.raises(ValueError, match=rf"{name}: got .*, expected a number .*1"):
                kind(**{name: wrong})


@dataclass(frozen=True, kw_only=True)
class OneStrip(Readout):
    """One strip a view fires, that under the middle of the crossing; its error is `scale` times pitch/sqrt(12)."""

    name: ClassVar[str] = "one-strip"

    scale: float = 1.0


class OneStripDigitizer(Digitizer):
    """Fires the strip under the middle of the crossing."""

    def digitize(self, group: ReadoutGroup, truths: Table, steps: Table, seed: int) -> Table:
        """Return two digis for each crossing of a sheet."""
        found = []
        for number, layer in zip(group.numbers, group.cgem, strict=True):
            for sheet, start in enumerate(layer.sheet_phi):
                x = layer.r_readout * ((truths["phi"] - start) % (2 * np.pi))
                v = local_v(layer, x, truths["z"])
                strips = np.floor([x / layer.pitch_x, strips_of_v(layer, v)]).astype("i4")
                on = (truths["layer"] == number) & (strips[0] < layer.strips_x)
                on &= (np.abs(truths["z"]) < layer.half_length) & (strips[1] >= 0) & (strips[1] < layer.strips_v)
                rows = np.flatnonzero(on)
                for view in (0, 1):
                    same = (np.full_like(rows, value) for value in (sheet, view))
                    found.append(np.column_stack([rows, *same, strips[view, rows]]))
        rows, sheet, view, strip = np.concatenate(found).T
        order = np.lexsort((strip, view, sheet, truths["layer"][rows], truths["event"][rows]))
        rows, sheet, view, strip = (values[order] for values in (rows, sheet, view, strip))
        columns = {name: truths[name][rows] for name in ("event", "layer", "time")}
        columns |= {"sheet": sheet.astype("i4"), "view": view.astype("i1"), "strip": strip.astype("i4"), "truth": rows}
        columns |= {"gid": np.full(len(rows), -1, "i4"), "n_truths": np.ones(len(rows), "i4")}
        columns |= {"position": np.full(len(rows), np.nan), "charge": np.ones(len(rows))}
        return Table("digis", columns, truths.n_events, truths.first_event)


class OneStripClusterer(BinaryClusterer):
    """Joins contiguous strips; the errors hold at any incidence."""

    readout: OneStrip  # type: ignore[assignment]

    def cluster(
        self, group: ReadoutGroup, digis: Table, settings: ClusterSettings, directions: Floats | None = None
    ) -> Table:
        """Return clusters with errors of their own."""
        clusters = super().cluster(group, digis, settings)
        errors = group.among_all(self.expected_errors(group)[0])[clusters["layer"]]
        own = {name: np.where(np.isnan(clusters[name]), np.nan, errors) for name in ("err_x", "err_v")}
        return clusters.with_columns(**own, method=np.ones(len(clusters), "i1"))

    def expected_errors(self, group: ReadoutGroup) -> tuple[Floats, Floats]:
        """Return the error of a strip."""
        error = self.readout.scale * np.array([layer.pitch_x for layer in group.cgem]) / np.sqrt(12)
        return error, error


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    """Make the readout known: the one line."""
    register_readout(OneStrip, OneStripDigitizer, OneStripClusterer)
    yield
    del READOUTS[OneStrip.name], digitize.DIGITIZERS[OneStrip], CLUSTERERS[OneStrip]


def chain(readout: OneStrip | str, n: int = 150) -> Result:
    """Muons of 1 GeV/c, read out and fitted."""
    settings = Settings(digitize=DigitizeSettings(readout=readout), fit=FitSettings(residuals=True))
    return run(
        DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), n, seed=3, settings=settings, workers=Workers(chunk=40)
    )


def test_it_is_known_by_its_name() -> None:
    """The name stands for its defaults, and is listed with the others where a name is wrong."""
    assert DigitizeSettings(readout="one-strip").readout == OneStrip()
    with pytest.raises(ValueError, match=r"expected one of 'binary', .*, 'one-strip'"):
        DigitizeSettings(readout="one strip")


def test_it_runs_through_the_chain() -> None:
    """Every muon is fitted; X is uniform within a strip, so that its residual has an RMS of pitch/sqrt(12)."""
    result = chain("one-strip")
    assert not result.tracks["status"].any()
    x = result.clusters[result.clusters["view"] == 0]
    assert set(x["size"]) == {1}
    assert len(x) == pytest.approx(3 * len(result.tracks), abs=3)
    radius = np.array([layer.r_readout for layer in DESIGN.cgem])[x["layer"]]
    residual = radius * np.angle(np.exp(1j * (x["phi"] - result.truths["phi"][x["truth"]])))
    assert np.abs(residual).max() <= 0.325 + 1e-9
    assert_within(residual.std(), 0.65 / np.sqrt(12), 0.65 / np.sqrt(12) * np.sqrt(0.2 / len(x)))


def test_the_fit_takes_its_errors() -> None:
    """Clusters that are said to be a hundred times worse count for little, whatever their number of strips says."""
    good, bad = chain("one-strip", 20), chain(OneStrip(scale=100.0), 20)
    np.testing.assert_allclose(np.nanmax(bad.clusters["err_x"]), 65 / np.sqrt(12))
    assert np.median(good.tracks["err_dz"]) < 1
    assert np.median(bad.tracks["err_dz"]) > 2
    assert np.array_equal(good.clusters["x"], bad.clusters["x"], equal_nan=True)


def test_the_covariance_expects_its_errors() -> None:
    """Without events, the error of d_z grows with the scale, too."""
    good, bad = (float(analytic(DESIGN, readout=OneStrip(scale=scale)).sigma("dz")) for scale in (1.0, 100.0))
    assert good < 1 < 2 < bad


def test_it_serves_cgem_layers_beside_a_sensor() -> None:
    """Numbers of layers are those of the detector: X is uniform within a strip behind a layer of pixels, too."""
    result = run("besiii-pixel", Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), 60, seed=3, readout="one-strip")
    assert not result.tracks["status"].any()
    x = result.clusters[(result.clusters["view"] == 0) & (result.clusters["layer"] > 0)]
    assert set(x["layer"]) == {1, 2, 3}
    assert set(x["size"]) == {1}
    assert np.array_equal(result.truths["layer"][x["truth"]], x["layer"])
    radius = np.array([layer.r_readout for layer in result.detector.layers])[x["layer"]]
    residual = radius * np.angle(np.exp(1j * (x["phi"] - result.truths["phi"][x["truth"]])))
    assert np.abs(residual).max() <= 0.325 + 1e-9


def test_what_it_makes_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing, another table, or one of other events is refused, and the readout is named."""
    stages = {"digis": (OneStripDigitizer, "digitize"), "clusters": (OneStripClusterer, "cluster")}
    for kind, stage in stages.items():
        for wrong, message in (
            (None, "got NoneType, expected a table of kind"),
            (Table.empty("truths", 5), "got a table of kind 'truths'"),
            (Table.empty(kind, 1), "cover other events than"),
        ):  # fmt: skip
            with monkeypatch.context() as patch:
                patch.setattr(*stage, lambda *_, wrong=wrong: wrong)
                with pytest.raises((TypeError, ValueError), match=f"readout one-strip: {kind}: {message}"):
                    chain("one-strip", 5)


@dataclass(frozen=True, kw_only=True)
class SlowChip(AnalogReadout):
    """A chip like TIGER whose branch for the time is slower: data alone."""

    name: ClassVar[str] = "slow-chip"
    chip: ClassVar[Chip] = replace(TIGER, timing=TIGER.charge)
    errors: ClassVar[ChipErrors] = chip_errors("tiger")


def test_a_chip_like_tiger_is_one_class() -> None:
    """Digitizer and clusterer of TIGER serve it: its edges are later, which the clusterer knows."""
    register_readout(SlowChip)
    gun, times = Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), {}
    try:
        for readout in (TigerReadout(), SlowChip()):
            digis = run(DESIGN, gun, 50, seed=3, readout=readout, until="digitize").digis
            clusters = cluster(DESIGN, digis, readout=readout)
            times[readout.name] = digis["time"].mean(), clusters["time"].mean()
        of_digis, of_clusters = np.subtract(times["slow-chip"], times["tiger"])
        assert of_digis > 20  # ns
        assert abs(of_clusters) < 0.1 * of_digis
    finally:
        del READOUTS[SlowChip.name]


def test_every_readout_has_both_halves() -> None:
    """Each is served by a digitizer and a clusterer."""
    for one in READOUTS.values():
        assert digitize.digitizer_of(one()).readout == clusterer_of(one()).readout == one()


@pytest.mark.parametrize("readout", ["binary", "gaussian"])
def test_event_numbers_with_gaps(readout: str) -> None:
    """Each stage takes tables whose event numbers have gaps; digis and clusters are those of numbers without."""
    result = run(DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), 4, seed=3)
    settings, numbers = DigitizeSettings(readout=readout), np.array([3, 10, 11, 50_000_000])

    def apart(table: Table) -> Table:
        columns = {**table.columns, "event": numbers[table["event"]]}
        return Table(table.kind, columns, 4, events=numbers)

    simulated = simulate(DESIGN, apart(result.particles), seed=3)
    assert all(np.array_equal(table.events, numbers) for table in simulated.values())
    made = digitize.digitize(DESIGN, apart(result.truths), apart(result.wire_truths), settings)
    plain = digitize.digitize(DESIGN, result.truths, result.wire_truths, settings)
    made["clusters"] = cluster(DESIGN, made["digis"], readout=settings.readout)
    plain["clusters"] = cluster(DESIGN, plain["digis"], readout=settings.readout)
    for name, table in made.items():
        assert np.array_equal(table.events, numbers)
        assert np.array_equal(table["event"], numbers[plain[name]["event"]])
        assert np.array_equal(table.offsets, plain[name].offsets)
