"""The chain: the same numbers however the work is cut, and results that can be kept, compared and shown."""

from __future__ import annotations

import pickle
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from cgemit.chain.executor import Workers
from cgemit.chain.result import Result
from cgemit.chain.run import run
from cgemit.chain.settings import Settings
from cgemit.detector import load
from cgemit.particles.gun import Gun
from cgemit.particles.table import particles_from
from cgemit.reconstruction.fit import FitSettings, FitStatus
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table, load_tables

GUN = Gun("mu-", p=(0.2, 1.5), cos_theta=(-0.9, 0.9), vertex_sigma=(0.3, 0.01, 8.0)) + Gun("pi+", pt=0.3, theta=1.2)
SETTINGS = Settings(fit=FitSettings(residuals=True))
LINKS = {"truth", "wire_truth", "x_cluster", "v_cluster", "candidate", "row", "track", "hit"}


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
    settings = Settings(digitize=DigitizeSettings(readout="gaussian"))
    gun = Gun("mu-", p=1.0, cos_theta=0.0)
    a = run("besiii-cgem-design", gun, 300, seed=5, settings=settings)
    b = run(
        load("besiii-cgem-design").with_overrides({"cgem.L1.drift_gap": "4.9 mm"}), gun, 300, seed=5, settings=settings
    )
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
        ({"n": -1}, "n: -1"),
        ({"n": 5, "workers": Workers(chunk=0)}, "chunk: 0"),
        ({"n": 5, "workers": 0}, "threads: 0"),
        ({"n": 2.5, "seed": -1, "workers": Workers(chunk=0.5)}, r"(?s)n: 2\.5.*chunk: 0\.5.*seed: -1"),
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
