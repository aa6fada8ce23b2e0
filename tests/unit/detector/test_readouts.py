"""Readouts as keys of layers; one from outside the package: description, digitizer, clusterer, and its line."""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

import cgemit as cg
from cgemit import (
    BinaryReadout,
    FitSettings,
    GaussianReadout,
    Gun,
    Result,
    Settings,
    Workers,
    analytic,
    load,
    register_readout,
    run,
)
from cgemit.detector import DetectorError, ReadoutGroup
from cgemit.detector.layers.cgem import strips_of_v
from cgemit.detector.layers.layer import local_v
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
            with pytest.raises(ValueError, match=rf"{name}: got .*, expected a .*1"):
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
    settings = Settings(fit=FitSettings(residuals=True))
    return run(
        DESIGN, Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), n, seed=3, settings=settings, readout=readout,
        workers=Workers(chunk=40),
    )  # fmt: skip


def test_it_is_known_by_its_name() -> None:
    """The name stands for its defaults, and is listed with the others where a name is wrong."""
    assert DESIGN.with_readout("one-strip").cgem["L2"].readout == OneStrip()
    with pytest.raises(ValueError, match=r"expected one of binary, .*, one-strip; did you mean \"one-strip\"?"):
        DESIGN.with_readout("one strip")


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
    detector, numbers = DESIGN.with_readout(readout), np.array([3, 10, 11, 50_000_000])

    def apart(table: Table) -> Table:
        columns = {**table.columns, "event": numbers[table["event"]]}
        return Table(table.kind, columns, 4, events=numbers)

    simulated = simulate(DESIGN, apart(result.particles), seed=3)
    assert all(np.array_equal(table.events, numbers) for table in simulated.values())
    made = digitize.digitize(detector, apart(result.truths), apart(result.wire_truths))
    plain = digitize.digitize(detector, result.truths, result.wire_truths)
    made["clusters"] = cluster(detector, made["digis"])
    plain["clusters"] = cluster(detector, plain["digis"])
    for name, table in made.items():
        assert np.array_equal(table.events, numbers)
        assert np.array_equal(table["event"], numbers[plain[name]["event"]])
        assert np.array_equal(table.offsets, plain[name].offsets)


TIGER_L1 = {"cgem.L1.readout": "tiger"}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (TIGER_L1, {"L1": TigerReadout(), "L2": BinaryReadout()}),
        # A name alone is another readout with its defaults, in any order with keys of its values.
        (
            {"cgem.*.readout": "tiger", "cgem.L1.readout.threshold_x": "3 fC"},
            {"L1": TigerReadout(threshold_x=3.0), "L3": TigerReadout()},
        ),
        (
            {"cgem.L1.readout.threshold_x": "0.003 pC", "cgem.*.readout": "tiger"},
            {"L1": TigerReadout(threshold_x=3.0)},
        ),
        (
            {"readout": "gaussian", "readout.sigma_x": "50 um"},
            dict.fromkeys(("L1", "L2"), GaussianReadout(sigma_x=0.05)),
        ),
        ({"readout.gain": 6000.0}, {"L1": BinaryReadout(gain=6000.0)}),
        ({"cgem.*.readout.gain": "x2"}, {"L1": BinaryReadout(gain=24_000.0)}),
        ({"cgem.L2.readout": {"name": "apv25", "noise": "0.4 fC"}}, {"L2": cg.Apv25Readout(noise=0.4)}),
        ({"cgem.L2.readout": {"gain": 6000.0}}, {"L2": BinaryReadout(gain=6000.0)}),
        ({"cgem.L2.readout": OneStrip(scale=2.0)}, {"L2": OneStrip(scale=2.0)}),
        ({"cgem.L2.readout.name": "tiger"}, {"L2": TigerReadout()}),
    ],
)
def test_keys_of_readouts(changes: dict[str, object], expected: dict[str, Readout]) -> None:
    """Values are those of the object; what is written is read back, and the name of the variant tells what changed."""
    found = DESIGN.with_overrides(changes)
    assert {label: found.cgem[label].readout for label in expected} == expected
    assert load(tomllib.loads(found.to_toml())) == found
    assert found.content_hash != DESIGN.content_hash
    assert found.name.startswith("besiii-cgem-design+")


def test_a_detector_states_only_what_differs() -> None:
    """The default of a kind of layers is in no file and no hash: both are as before layers had readouts."""
    assert "readout =" not in DESIGN.to_toml()
    assert DESIGN.with_overrides({"cgem.*.readout": "binary"}).content_hash == DESIGN.content_hash
    written = tomllib.loads(DESIGN.with_overrides({"readout": "apv25", "cgem.L2.readout.noise": "0.4 fC"}).to_toml())
    assert [written["cgem"][label]["readout"] for label in ("L1", "L2")] == [
        "apv25",
        {"name": "apv25", "noise": "0.4 fC"},
    ]


BASE = {"base": "besiii-cgem-design", "name": "variant"}


def test_the_readout_of_the_top_level_is_for_all_layers_without_their_own() -> None:
    """Of the file and of its base; a value without a name changes readouts that the base has; copies keep theirs."""
    first = {**BASE, "readout": "tiger", "cgem": {"L2": {"readout": "binary"}, "L3": {"readout": {"noise": "1 fC"}}}}
    one = load(first)
    assert [layer.readout for layer in one.cgem] == [TigerReadout(), BinaryReadout(), TigerReadout(noise=1.0)]
    second = one.with_overrides({"readout": {"gain": 5000.0}})
    assert [layer.readout.gain for layer in second.cgem] == [5000.0] * 3  # type: ignore[attr-defined]
    assert [layer.readout.name for layer in second.cgem] == ["tiger", "binary", "tiger"]
    copied = one.with_overrides(
        {
            "cgem.L0": cg.like("L3", anode_radius="62 mm"),
            "cgem.LX": cg.like("L3", anode_radius="210 mm", readout="apv25"),
        }
        | {"remove": ["drift_chamber"]}
    )
    assert copied.cgem["L0"].readout == TigerReadout(noise=1.0)
    assert copied.cgem["LX"].readout == cg.Apv25Readout()
    whole = tomllib.loads(DESIGN.to_toml())
    whole["cgem"]["L2"]["readout"] = {"threshold_x": "3 fC"}
    given = {**whole, "readout": {"name": "tiger", "noise": "0.7 fC"}}
    before = copy.deepcopy(given)
    of_file = load(given)
    assert given == before
    assert of_file.cgem["L1"].readout == TigerReadout(noise=0.7)
    assert of_file.cgem["L2"].readout == TigerReadout(noise=0.7, threshold_x=3.0)


@pytest.mark.parametrize(
    ("changes", "messages"),
    [
        ({"readout": "tigre"}, ["  readout: got \"tigre\", expected one of binary, .*; did you mean \"tiger\"?"]),
        ({"cgem.L1.readout": 5}, ["cgem.L1.readout: got 5, expected one of binary"]),
        (
            {"cgem.L1.readout": {"name": "tiger", "threshold_x": 3.0, "nosie": 1}, "cgem.L2.readout.sigma_x": "1 mm"},
            ['L1.readout.threshold_x: got 3.0 \\(no unit\\), .* as in "3 fC"', 'nosie: .*did you mean "noise"',
             "L2.readout.sigma_x: .*it is a key of name = 'gaussian', and name is 'binary' here"],
        ),
        ({"cgem.L1.readout.threshold": "-1 fC"}, ['threshold: got "-1 fC", expected a charge .* from 0 to']),
        ({**TIGER_L1, "cgem.L1.readout.missing": 11}, ["L1.readout.missing: got 11, expected a whole number"]),
        ({"readout.gain": 0}, [r"L\d.readout.gain: got 0, expected a finite number above 0, up to 1e\+08"] * 3),
    ],
)  # fmt: skip
def test_wrong_readouts_are_all_named(changes: dict[str, object], messages: list[str]) -> None:
    with pytest.raises(DetectorError) as caught:
        DESIGN.with_overrides(changes)
    assert [message for message in messages if not re.search(message, str(caught.value))] == []
    assert len(caught.value.problems) == len(messages)


def test_a_sensor_has_the_readout_of_positions() -> None:
    sensor = {"radius": "30 mm", "sigma": "5 um", "material": "Si"}
    assert load({**BASE, "layer": {"VTX": sensor | {"readout": "positions"}}}).layer["VTX"].readout.makes == "positions"
    with pytest.raises(DetectorError, match=r'layer\.VTX\.readout: got "tiger", expected one of positions'):
        load({**BASE, "layer": {"VTX": sensor | {"readout": "tiger"}}})


def test_numbers_of_a_readout_are_keys_of_studies() -> None:
    """A sweep over thresholds, the derivative by an error, and the allowed range are those of the object."""
    found = cg.study.sweep(DESIGN, {"cgem.*.readout": ["binary", {"name": "tiger", "threshold_x": "4 fC"}]})
    sigmas = [
        float(cg.analytic(DESIGN, readout=one).sigma("dr"))
        for one in ("binary", "binary", TigerReadout(threshold_x=4.0))
    ]
    assert found["sigma_dr (um)"] == pytest.approx(sigmas, rel=1e-9)
    gaussian = DESIGN.with_readout("gaussian")
    slope = cg.sensitivity(gaussian, keys=["cgem.*.readout.sigma_x"], quantities=["dr"]).of(
        "cgem.*.readout.sigma_x", "dr"
    )
    sigma = [
        float(cg.analytic(gaussian, readout=GaussianReadout(sigma_x=0.1387 * factor)).sigma("dr"))
        for factor in (0.99, 1.01)
    ]
    assert float(slope) == pytest.approx(50 * np.log(sigma[1] / sigma[0]), rel=1e-3)
    assert gaussian.bounds("cgem.L1.readout.gain")[1] == 1e8


MIXED = {"cgem.L1.readout": "tiger", "cgem.L2.readout": "gaussian"}


def test_layers_of_several_readouts_are_read_out_as_each_alone() -> None:
    """Draws belong to layers: digis and clusters of a layer are those of a detector with its readout in all layers."""
    mixed, gun = DESIGN.with_overrides(MIXED), Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    steps = Settings(simulate=cg.SimulateSettings(steps=True))
    together = run(mixed, gun, 60, seed=3, settings=steps)
    assert [group.numbers for group in mixed.groups] == [(0,), (1,), (2,)]
    for number, name in enumerate(("tiger", "gaussian", "binary")):
        alone = run(DESIGN, gun, 60, seed=3, settings=steps, readout=name)
        for kind in ("digis", "clusters"):
            one, other = (getattr(result, kind) for result in (together, alone))
            one, other = one[one["layer"] == number], other[other["layer"] == number]
            assert len(one) > 60
            for column in (one.keys() & other.keys()) - {"x_cluster", "v_cluster"}:
                np.testing.assert_allclose(one[column], other[column], rtol=1e-14, err_msg=f"{name} {kind} {column}")
    assert (together.tracks["status"] == 0).mean() > 0.98
    assert "readout tiger (L1), gaussian (L2), binary (L3)" in repr(cg.analytic(mixed))


def test_each_layer_needs_the_electrons_of_its_own_readout() -> None:
    """In thin gaps a binary layer loses clusters, one of positions none."""
    thin = DESIGN.with_overrides({"cgem.*.drift_gap": "0.3 mm", "cgem.L2.readout": "gaussian"})
    with pytest.warns(UserWarning, match=r"ionization: L1 \d+% [^,]*, L3 \d+%"):
        found = run(thin, Gun("mu-", p=1.0, cos_theta=0.0), 400, seed=3, until="cluster").clusters
    x = found[found["view"] == 0]
    lost = [1 - np.count_nonzero(x["layer"] == number) / 400 for number in range(3)]
    assert lost[1] == 0
    assert min(lost[0], lost[2]) > 0.1
    with pytest.warns(UserWarning, match="ionization"):
        expected = float(cg.analytic(thin, samples=2000).n_clusters)
    assert expected == pytest.approx(6 - 2 * (lost[0] + lost[2]), abs=2 * 4 * np.sqrt(0.25 * 2 / 400))


def test_a_fit_with_other_readouts_is_refused_or_told() -> None:
    """Positions are no strips; another name is told, and `readout` is for both detectors."""
    tiger, gun = DESIGN.with_readout("tiger"), Gun("mu-", p=1.0, cos_theta=0.0)
    with pytest.raises(
        ValueError, match=r"fit_detector\.L1: got readout gaussian, of positions, expected one of strips"
    ):
        run(tiger, gun, 3, fit_detector=DESIGN.with_readout("gaussian"))
    with pytest.warns(UserWarning, match="other readouts than the simulation: L1 binary instead of tiger, L2"):
        run(tiger, gun, 3, fit_detector=DESIGN)
    moved = DESIGN.with_overrides({"cgem.L1.shift_x": "0.1 mm"})
    both = run(DESIGN, gun, 3, fit_detector=moved, readout={"name": "tiger", "noise": "0.4 fC"})
    assert {one.cgem["L1"].readout for one in (both.detector, both.fit_detector)} == {TigerReadout(noise=0.4)}
