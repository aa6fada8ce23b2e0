"""The chain: the same numbers however the work is cut, and what a run cannot do is said before it begins."""

from __future__ import annotations

import csv
import pickle
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import cgemit as cg
from cgemit import GaussianReadout, _core, extrapolate
from cgemit.chain import executor
from cgemit.chain import run as run_of_refusals
from cgemit.chain.executor import Workers
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.chain.settings import STAGES, TABLES, Settings, tables_made
from cgemit.detector import load, write_field_map
from cgemit.detector.readouts import READOUTS
from cgemit.particles.gun import Gun
from cgemit.particles.table import particles_from
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table, load_tables
from cgemit.tables.schema import FitStatus

GUN = Gun("mu-", p=(0.2, 1.5), cos_theta=(-0.9, 0.9), vertex_sigma=(0.3, 0.01, 8.0)) + Gun("pi+", pt=0.3, theta=1.2)
SETTINGS = Settings(fit=FitSettings(residuals=True))
LINKS = {"truth", "wire_truth", "x_cluster", "v_cluster", "candidate", "track", "hit"}


@pytest.fixture(scope="module")
def result() -> Result:
    """Sixty events of two particles."""
    return run("besiii-cgem-design", GUN, 60, seed=3, settings=SETTINGS, workers=1)


@pytest.mark.parametrize(("threads", "chunk"), [(2, 1000), (1, 7), (2, 1), (2, 59)])
def test_threads_and_chunks_change_no_byte(result: Result, threads: int, chunk: int) -> None:
    """Every column of every table is the same to the last bit for any number of threads and any chunk size."""
    other = run("besiii-cgem-design", GUN, 60, seed=3, settings=SETTINGS, workers=Workers(threads=threads, chunk=chunk))
    for name, table in result.tables.items():
        for column, values in table.columns.items():
            assert values.tobytes() == other.tables[name][column].tobytes(), f"{name}.{column}"


def test_processes_give_the_same_result(result: Result) -> None:
    """Any executor will do: a pool of processes gives what threads give."""
    with ProcessPoolExecutor(2) as pool:
        assert (
            run("besiii-cgem-design", GUN, 60, seed=3, settings=SETTINGS, workers=Workers(executor=pool, chunk=20))
            == result
        )


@pytest.mark.parametrize("event", [0, 17, 59])
def test_one_event_alone_is_the_same(result: Result, event: int) -> None:
    """An event replayed by itself has the bytes that it has among others; only links count other rows."""
    particles = result.particles.select_events(event, event + 1)
    alone = run("besiii-cgem-design", particles, seed=3, settings=SETTINGS)
    for name, table in alone.tables.items():
        expected = result.tables[name].select_events(event, event + 1)
        for column, values in table.columns.items():
            if column not in LINKS:
                assert values.tobytes() == expected[column].tobytes(), f"{name}.{column}"


def test_seeds_differ(result: Result) -> None:
    """Another seed gives other events."""
    other = run("besiii-cgem-design", GUN, 60, seed=4, settings=SETTINGS)
    assert not np.array_equal(other.tracks["dr"], result.tracks["dr"])


def test_designs_share_their_noise() -> None:
    """Two designs see the same particles and scatters: the difference of a residual is far below its spread."""
    gun, design = Gun("mu-", p=1.0, cos_theta=0.0), load("besiii-cgem-design").with_readout("gaussian")
    a = run(design, gun, 300, seed=5)
    b = run(design.with_overrides({"cgem.L1.drift_gap": "4.9 mm"}), gun, 300, seed=5)
    assert (a.tracks["res_dr"] - b.tracks["res_dr"]).std() < 0.2 * a.tracks["res_dr"].std()


def test_links_point_to_what_they_say(result: Result) -> None:
    """Digis, hits and residuals link to rows of the same event, layer and cell, also across chunks."""
    joined = run("besiii-cgem-design", GUN, 60, seed=3, settings=SETTINGS, workers=Workers(chunk=13))
    truths, wires = joined.truths, joined.wire_truths
    assert np.array_equal(truths["event"][joined.digis["truth"]], joined.digis["event"])
    assert np.array_equal(truths["layer"][joined.digis["truth"]], joined.digis["layer"])
    assert np.array_equal(wires["wire"][joined.wire_hits["wire_truth"]], joined.wire_hits["wire"])
    residuals = joined.residuals
    assert residuals is not None
    assert np.array_equal(joined.tracks["event"][residuals["track"]], residuals["event"])
    on_wire = residuals["view"] == 2
    assert np.array_equal(joined.wire_hits["layer"][residuals["hit"][on_wire]], residuals["layer"][on_wire])
    assert np.array_equal(joined.clusters["layer"][residuals["hit"][~on_wire]], residuals["layer"][~on_wire])


def test_result_pickles_compares_and_shows_itself(result: Result) -> None:
    """A result survives pickling, compares by content and says what it is, as text and in a notebook."""
    copy = pickle.loads(pickle.dumps(result))
    assert copy == result
    assert copy != run("besiii-cgem-design", GUN, 60, seed=4, settings=SETTINGS)
    assert "besiii-cgem-design" in repr(result)
    assert "assigned by truth" in result._repr_html_()


def test_tables_are_saved_with_what_made_them(result: Result, tmp_path: Path) -> None:
    """Files hold version, configuration and seed, read back equal, and are never overwritten silently."""
    result.save(tmp_path / "run")
    loaded = load_tables(tmp_path / "run")
    assert loaded["tracks"] == result.fitted
    assert loaded["matches"] == result.matches
    assert loaded["tracks"].meta["seed"] == 3
    assert {"version", "configuration", "detector"} <= set(loaded["tracks"].meta)
    with pytest.raises(FileExistsError):
        result.save(tmp_path / "run")


def test_particles_from_anywhere() -> None:
    """A dict of columns serves as a gun; neutral ones make no track, charged ones that cannot be fitted say why."""
    columns = {
        "event": [0, 0, 1],
        "pdg": [13, 22, -211],
        **{axis: [0.0, 0.0, 0.0] for axis in "xyz"},
        "px": [1.0, 1.0, 0.3],
        "py": [0.0, 0.1, 0.2],
        "pz": [0.1, 0.0, 5.0],
    }
    result = run("besiii-cgem-design", columns)
    status = [FitStatus(s).name for s in result.tracks["status"]]
    assert status == ["ok", "too_few_hits"]
    for name in ("cov", "chi2", "dr", "p", "res_dr", "pull_p"):
        assert np.isnan(result.tracks[name][1]).all(), name
    assert result.removed() == {"too_few_hits": 1}
    assert result.transport()["neutral"] == 1


def test_no_events() -> None:
    """A run of no events has empty tables."""
    result = run("besiii-cgem-design", GUN, 0)
    assert len(result.tracks) == 0
    assert isinstance(result.clusters, Table)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n": -1}, "n: got -1"),
        ({"n": 5, "workers": Workers(chunk=0)}, "chunk: got 0"),
        ({"n": 5, "workers": 0}, "threads: got 0"),
        ({"n": 2.5, "seed": -1, "workers": Workers(chunk=0.5)}, r"(?s)n: got 2\.5.*chunk: got 0\.5.*seed: got -1"),
        ({"n": 5, "detector": "besii-cgem"}, "besiii-cgem"),
    ],
)
def test_wrong_arguments(arguments: dict[str, object], message: str) -> None:
    """Wrong arguments are named with what was given."""
    arguments = {"detector": "besiii-cgem-design", "gun": GUN, **arguments}
    with pytest.raises(ValueError, match=message):
        run(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (SimulateSettings(), r"settings: got SimulateSettings, expected Settings\(simulate=\.\.\.\)"),
        (FitSettings(), r"settings: got FitSettings, expected Settings\(fit=\.\.\.\)"),
        ({}, r"settings: got dict, expected Settings\(simulate="),
    ],
)
def test_settings_of_one_stage_are_not_those_of_all(settings: object, message: str) -> None:
    """What goes in their place is refused in words."""
    with pytest.raises(TypeError, match=message):
        run("besiii-cgem-design", GUN, 1, settings=settings)  # type: ignore[arg-type]


def test_settings_of_a_stage_are_of_its_class() -> None:
    """None, or the settings of another stage, are refused where they are given, all at once."""
    with pytest.raises(
        ValueError,
        match=r"(?s)digitize: got SimulateSettings\(...\), expected DigitizeSettings.*fit: got None, exp",
    ):
        Settings(digitize=SimulateSettings(), fit=None)  # type: ignore[arg-type]


def test_wrong_settings_are_all_listed() -> None:
    """Settings that make no sense are refused, each problem named."""
    with pytest.raises(ValueError, match="fluctuations"):
        SimulateSettings(fluctuations="some")
    listed = r"(?s)sublayers: got 1,.*foil: got 'holes'.*deltas: got 'no',.*steps: got None,"
    with pytest.raises(ValueError, match=listed):
        SimulateSettings(foil="holes", sublayers=1, deltas="no", steps=None)  # type: ignore[arg-type]
    assert SimulateSettings(deltas=np.False_).deltas is False
    with pytest.raises(ValueError, match=r"(?s)loss.*tolerance.*prior_sigma"):
        FitSettings(loss="magic", tolerance=-1, prior_sigma=(1.0, 2.0, 3.0, 4.0, 0.0))


def test_truth_is_that_of_the_simulated_field() -> None:
    """A fit in another field is compared with the helix that was flown, also from a displaced vertex."""
    gun = Gun("mu-", p=0.5, cos_theta=0.3, phi=0.4, vertex=(-10.0, 15.0, 3.0))
    design = load("besiii-cgem-design")
    other = design.with_overrides({"field.bz": "-0.9 T"})
    truth, wrong = (run(design, gun, 3, fit_detector=fitted).tracks["truth_dr"] for fitted in (design, other))
    assert np.array_equal(truth, wrong)
    assert abs(truth[0]) > 10


def test_clusters_of_both_passes_assume_the_field_of_the_fit() -> None:
    """With a field of the fit that is 10 % off, the Lorentz shift is 0.2 mm off, alike before and after the fit."""
    design, gun = load("besiii-cgem-design"), Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8))
    other = design.with_overrides({"field.bz": "-0.9 T"})
    readout = cg.TigerReadout(second_pass=True)
    result = run(design, gun, 300, seed=3, readout=readout, fit_detector=other)
    first, second = result.clusters, result.fitted_hits[0]
    assert first == cg.cluster(other, result.digis, readout=readout)
    x = np.flatnonzero((first["view"] == 0) & (first["truth"] >= 0))
    right = cg.cluster(design, result.digis, readout="tiger")
    assert abs(np.median(first["x"][x] - right["x"][x])) > 0.15
    assert abs(np.median(second["x"][x] - first["x"][x])) < 0.05


def test_failed_fits_have_the_same_bytes_in_any_chunk() -> None:
    """A NaN has no sign of its own: its bits must not depend on the row's place in a chunk."""
    gun = Gun("pi+", p=(0.03, 0.12), cos_theta=(-0.93, 0.93), vertex_sigma=(5.0, 5.0, 30.0), multiplicity=3)
    settings = Settings(fit=FitSettings(residuals=True, states=("origin", "beam_pipe", "hits", 400.0)))
    whole = run("besiii-cgem-design", gun, 60, seed=5, settings=settings)
    assert np.isnan(whole.tracks["err_p"]).sum() > 10
    for chunk in (1, 7):
        other = run("besiii-cgem-design", gun, 60, seed=5, settings=settings, workers=Workers(chunk=chunk))
        for name, table in whole.tables.items():
            for column, values in table.columns.items():
                assert values.tobytes() == other.tables[name][column].tobytes(), f"{name}.{column}"


def test_particles_of_events_with_gaps() -> None:
    """Event numbers with gaps stay, whatever the chunks are, and the particles keep their draws."""
    momenta = {"px": [0.3, 0.4, 0.5, 0.6], "py": [0.0] * 4, "pz": [0.1] * 4}
    events = np.array([3, 70, 900, 901])
    plain = particles_from({"event": [0, 1, 2, 3], "pdg": [13] * 4, **momenta})
    table = Table("particles", {**plain.columns, "event": events}, 4, events=events)
    found = run("besiii-cgem-design", table, seed=3)
    np.testing.assert_array_equal(found.tracks.events, events)
    np.testing.assert_array_equal(found.tracks["event"], events)
    assert found.particles.n_events == 4
    for chunk in (1, 2, 3):
        assert run("besiii-cgem-design", table, seed=3, workers=Workers(chunk=chunk)) == found
    alone = run(
        "besiii-cgem-design",
        particles_from({"event": [70], "pdg": [13], "px": [0.4], "py": [0.0], "pz": [0.1]}),
        seed=3,
    )
    assert alone.tracks["dr"][0] == found.tracks["dr"][1]


NEUTRAL, MUON = (
    particles_from({"event": [0], "pdg": [pdg], "px": [0.3], "py": [0.2], "pz": [0.1]}) for pdg in (22, 13)
)
RAW = DigitizeSettings(wire_times="raw")
EMPTY_CHUNKS = {
    "simulate": {"until": "simulate", "settings": Settings(simulate=SimulateSettings(steps=True))},
    **{until: {"until": until} for until in STAGES[1:]},
    "residuals": {"settings": SETTINGS},
    "states": {"settings": Settings(fit=FitSettings(states=("origin", "beam_line", "beam_pipe", "hits", 400.0)))},
    "hypotheses": {"settings": Settings(fit=FitSettings(hypothesis=("mu", "K"), residuals=True, states=("hits",)))},
    "ckf": {"finder": "ckf", "settings": Settings(fit=FitSettings(states=("hits",)))},
    **{f"{readout}": {"readout": readout} for readout in READOUTS},
    "background": {
        "finder": "ckf",
        "settings": Settings(background=cg.BackgroundSettings(level="bes2026", factor=0.1)),
    },
    "start times": {"settings": Settings(background=cg.BackgroundSettings(start_time=3.0))},
    **{
        f"refine {times} {error} {again} {finder}": {
            "finder": finder,
            "settings": Settings(
                digitize=RAW if times == "raw" else DigitizeSettings(),
                fit=FitSettings(states=("hits",)),
                refine=cg.RefineSettings(
                    drift_times=times, start_time="fitted", start_time_error=error, find_again=again
                ),
            ),
        }
        for times, error, again, finder in (
            ("raw", None, True, "truth"),
            ("raw", 3.0, True, "ckf"),
            ("corrected", None, False, "ckf"),
        )
    },
}


@pytest.mark.parametrize("case", EMPTY_CHUNKS)
def test_chunks_without_tracks(case: str) -> None:
    """A chunk without a track, or without a particle, changes nothing of the chunks beside it."""
    how = EMPTY_CHUNKS[case] | {"seed": 3}
    rows = {name: np.concatenate([NEUTRAL[name], MUON[name]]) for name in NEUTRAL.columns} | {"event": [0, 2]}
    particles = Table("particles", rows, 4)
    whole = run("besiii-cgem", particles, **how)
    assert run("besiii-cgem", particles, **how, workers=Workers(chunk=1)) == whole
    for nothing in (NEUTRAL, Table.empty("particles", 3)):
        alone = run("besiii-cgem", nothing, **how)
        assert list(alone.tables) == list(whole.tables)
        assert alone.rows.get("tracks", 0) == 0 or "background" in case


GUN_REFUSALS = cg.Gun("mu-", p=1, cos_theta=(-0.5, 0.5))


@pytest.fixture
def nothing_runs(monkeypatch):
    def never(*_, **__):
        raise AssertionError("a chunk was begun")

    monkeypatch.setattr(run_of_refusals, "run_chunk", never)


def test_all_problems_of_a_run_at_once(nothing_runs):
    with pytest.raises(ValueError, match=r"^run:") as refused:
        cg.run(
            {"base": "besiii-cgem", "name": "x", "cgem": {"L9": {"pitch_x": "1 m"}}},
            GUN_REFUSALS,
            n=-1,
            seed=-2,
            finder="no",
            until="never",
            readout="none",
            output=cg.Output("folder", format="xlsx"),
        )
    text = str(refused.value)
    for part in ("cgem.L9", "n: got -1", "seed: got -2", "finder: got 'no'", "until: got 'never'", "readout", "xlsx"):
        assert part in text, part
    assert text.count("run:") == 1
    with pytest.raises(cg.DetectorError):  # one problem keeps its own kind
        cg.run({"base": "besiii-cgem", "name": "x", "cgem": {"L9": {}}}, GUN_REFUSALS, n=1)


def test_tables_to_keep_are_checked_first(nothing_runs):
    with pytest.raises(ValueError, match="keep: got tracks, which this run does not make, expected some of particles"):
        cg.run("besiii-cgem", GUN_REFUSALS, n=2, until="find", keep=["tracks", "clusters"])
    with pytest.raises(ValueError, match="keep: got states"):
        cg.run("besiii-cgem", GUN_REFUSALS, n=2, keep="states")


@pytest.mark.parametrize("until", STAGES)
def test_the_tables_that_a_run_makes(until):
    settings = Settings(fit=cg.FitSettings(residuals=True))
    result = cg.run("besiii-idc", GUN_REFUSALS, n=2, until=until, settings=settings)
    assert tuple(result.tables) == tuple(
        name for name in TABLES if name in tables_made(until, settings, load("besiii-idc"))
    )


def test_chunks_that_do_not_fit_into_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(executor, "available", lambda: 1 << 30)
    for output in ({"output": tmp_path / "out"}, {}):
        with pytest.raises(ValueError, match=r"chunk: \d of 10000000 events at a time need about .* GB"):
            cg.run(
                "besiii-cgem",
                GUN_REFUSALS,
                n=10**7,
                keep=["tracks"],
                workers=cg.Workers(threads=1, chunk=10**7),
                **output,
            )
    assert not (tmp_path / "out").exists()
    executor.check_chunk({"tracks": 1000}, 1, 1000, 4)
    with pytest.raises(ValueError, match="expected at most 268,435 events"):
        executor.check_chunk({"tracks": 1000}, 1, 300_000, 4)


DESIGN = "besiii-cgem-design"
N = 1500


@pytest.fixture(scope="module")
def twins():
    """Return a run with two equal particles in each event."""
    gun = Gun("mu-", p=0.5, cos_theta=0.1, phi=0.3, multiplicity=2)
    return run(DESIGN, gun, N, seed=3, readout=GaussianReadout())


def paired(table, value):
    """Return a column of the first and of the second particle, where both have one row."""
    rows = [np.flatnonzero(table["particle"] == number) for number in (0, 1)]
    _, first, second = np.intersect1d(table["event"][rows[0]], table["event"][rows[1]], return_indices=True)
    return value[rows[0][first]], value[rows[1][second]]


def assert_independent(first, second):
    """Check that two columns have no correlation beyond 4 of its standard errors."""
    assert len(first) > 0.8 * N
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(len(first))


def test_equal_particles_of_an_event_have_draws_of_their_own(twins):
    """Scattering, energy loss, drift distances and positions of twins are independent."""
    truths = twins.truths[twins.truths["layer"] == 2]
    for name in ("phi", "z", "energy"):
        first, second = paired(truths, truths[name])
        assert_independent(first, second)
        assert np.std(first) > 0
    particle = twins.truths["particle"][twins.digis["truth"]]
    digis = twins.digis.with_columns(particle=particle)
    for layer, view in ((0, 0), (0, 1), (1, 0), (2, 1)):
        picked = digis[(digis["layer"] == layer) & (digis["view"] == view)]
        residual = picked["position"] - np.median(picked["position"])
        assert_independent(*paired(picked, residual))


def test_equal_particles_have_drift_errors_of_their_own():
    """Beside each other, so that each has cells of its own; the second one by whole cells of the layer."""
    layer = load(DESIGN).drift_chamber.layers[0]
    turn = 5 * 2 * np.pi / layer.cells
    guns = [Gun("mu-", p=0.5, cos_theta=0.1, phi=0.3 + number * turn) for number in (0, 1)]
    result = run(DESIGN, guns[0] + guns[1], N, seed=3, until="digitize")
    wires = result.wire_hits[result.wire_hits["layer"] == layer.number]
    crossing = wires["wire_truth"]
    wires = wires.with_columns(particle=result.wire_truths["particle"][crossing])
    errors = paired(wires, wires["drift"] - np.abs(result.wire_truths["doca"][crossing]))
    assert_independent(*errors)
    assert np.std(errors[0]) > 0.05


def test_twins_fit_independently(twins):
    tracks = twins.tracks[twins.tracks["status"] == 0]
    for name in ("dr", "dz", "kappa"):
        assert_independent(*paired(tracks, tracks[f"res_{name}"]))


def test_a_map_in_csv_has_the_numbers_it_was_made_of(tmp_path):
    """Axes and components stand in mm and T, row by row."""
    r, z = np.linspace(0, 120, 5), np.linspace(-200, 400, 7)
    bz = -1 + 1e-3 * r[:, None] + 2e-4 * z
    write_field_map(tmp_path / "map.csv", {"r": r, "z": z, "br": 1e-5 * r[:, None] + 0 * z, "bz": bz})
    with (tmp_path / "map.csv").open() as stream:
        head, *rows = csv.reader(stream)
    assert head == ["r[mm]", "z[mm]", "br[T]", "bz[T]"]
    numbers = np.array(rows, float)
    np.testing.assert_array_equal(numbers[:, 0], np.repeat(r, 7))
    np.testing.assert_array_equal(numbers[:, 1], np.tile(z, 5))
    np.testing.assert_array_equal(numbers[:, 3], bz.ravel())


def test_extrapolation_loses_the_energy_of_the_particle():
    """Every row is extrapolated with the mass of its own hypothesis."""
    fit = FitSettings(hypothesis=("mu", "K"))
    tracks = run(DESIGN, Gun("K+", p=0.4, cos_theta=0.0), 60, settings=Settings(fit=fit)).tracks
    tracks = tracks[tracks["status"] == 0]
    own = extrapolate(DESIGN, tracks, 190.0)
    for number, name in ((-13, "mu"), (321, "K")):
        rows = np.abs(tracks["hypothesis"]) == abs(number)
        assert rows.sum() > 40
        one = extrapolate(DESIGN, tracks, 190.0, particle=name)
        np.testing.assert_array_equal(own["kappa"][rows], one["kappa"][rows])
    lost = helix_momentum(tracks) - np.sqrt(own["px"] ** 2 + own["py"] ** 2 + own["pz"] ** 2)
    kaon = np.abs(tracks["hypothesis"]) == 321
    # dE/dx at 0.4 GeV/c goes roughly with 1/beta^2, and dp = dE/beta.
    ratio = (np.hypot(0.4, 0.493677) / np.hypot(0.4, 0.105658)) ** 3
    assert np.median(lost[kaon]) / np.median(lost[~kaon]) == pytest.approx(ratio, rel=0.2)


def helix_momentum(tracks):
    return np.hypot(1, tracks["tanl"]) / np.abs(tracks["kappa"])


def test_radiation_length_of_the_chamber_gas():
    """He/C3H8 60/40 by volume at 20 C and 1 atm, from the radiation lengths of the Particle Data Group."""
    gas = load(DESIGN).drift_chamber.gas
    molar, length = {"He": 4.0026, "C3H8": 44.0956}, {"He": 94.32, "C3H8": 45.37}  # g/mol, g/cm2
    mass = {"He": 0.6 * molar["He"], "C3H8": 0.4 * molar["C3H8"]}
    total = sum(mass.values())
    per = sum(part / total / length[name] for name, part in mass.items())
    assert gas.density == pytest.approx(total / 24055, rel=0.03)  # cm3/mol
    assert gas.x0 == pytest.approx(10 / (per * gas.density), rel=0.03)  # the file states that of the geometry
    cgem = load(DESIGN).cgem[0].gas  # Ar/iC4H10 90/10
    mass = {"Ar": 0.9 * 39.948, "iC4H10": 0.1 * 58.122}
    per = (mass["Ar"] / 19.55 + mass["iC4H10"] / 45.23) / sum(mass.values())
    assert cgem.x0 == pytest.approx(10 / (per * cgem.density), rel=0.01)


def test_weights_of_the_sides_of_a_wire(monkeypatch):
    """The two sides weigh as the likelihoods of the track fitted without the hit: tanh(drift predicted / variance)."""
    kept = {}
    real = _core.reconstruction.fit

    def keep(detector, **given):
        kept.update(given=given, out=real(detector, **given))
        return kept["out"]

    monkeypatch.setattr(_core.reconstruction, "fit", keep)
    fit = FitSettings(residuals=True, states=("origin",), outlier_pull=0)
    run(DESIGN, Gun("mu-", p=1.0, cos_theta=0.1), 300, settings=Settings(fit=fit), workers=1)
    out, hits = kept["out"], kept["given"]["hits"]
    track = np.repeat(np.arange(len(out["status"])), np.diff(kept["given"]["hit_offsets"]))
    wires = (np.asarray(hits["kind"]) == 2) & (out["status"][track] == 0)
    drift = np.asarray(hits["value"])[wires]
    weight = out["used_value"][wires] / drift
    noise, variance = np.asarray(hits["sigma"])[wires] ** 2, out["used_variance"][wires]
    predicted = out["used_value"][wires] - out["residual"][wires]
    spread = np.maximum(out["err"][wires] ** 2 - variance, 0)
    # The first iterations take the error of the prediction for half of what it is.
    off = [np.abs(weight - np.tanh(drift * predicted / (noise + caution * spread))) for caution in (1.0, 4.0)]
    between = np.abs(weight) < 0.95
    assert between.sum() > 50
    assert np.minimum(*off)[between].max() < 0.05
    np.testing.assert_allclose(variance, noise + (1 - weight**2) * drift**2, rtol=1e-6, atol=1e-9)
