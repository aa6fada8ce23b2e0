"""Tables keep their columns, offsets and links right, and their files are complete or absent."""

import builtins
import json
import pickle
import re
from dataclasses import replace
from typing import Any

import awkward as ak
import numpy as np
import pandas as pd
import pytest

from cgemit import Gun, RefineSettings, Settings, TigerReadout, Workers, _core, fit_vertices, run
from cgemit.base.files import new_file
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import ROWS, SCHEMAS, Table, concatenate, load_tables, save_tables, select_events, store
from cgemit.tables.formats import describe
from cgemit.tables.store import JoinedTables, about_of, column_of
from cgemit.tables.store import _join as joining
from cgemit.tables.table import linked, merged, targets


def make(kind, events, n_events, first_event=0, **columns):
    """Return a table of zeros with the given events and columns."""
    zeros = {c.name: np.zeros((len(events), *c.shape), c.dtype) for c in SCHEMAS[kind]}
    return Table(kind, zeros | {"event": np.asarray(events, np.int64)} | columns, n_events, first_event, {"seed": 1})


def test_columns_are_contiguous_read_only_and_typed():
    """Whatever fits is taken over without change of the caller's array; what is handed out cannot be written."""
    mine = np.arange(6.0)[::2]
    table = make("truths", [0, 0, 2], 3, phi=mine, layer=np.array([0, 1, 2], np.int64))
    for column in SCHEMAS["truths"]:
        array = table[column.name]
        assert array.dtype == column.dtype
        assert array.flags.c_contiguous
        assert not array.flags.writeable
    assert mine.flags.writeable
    with pytest.raises(ValueError, match="read-only"):
        table["phi"][0] = 1
    with pytest.raises(AttributeError, match="with_columns"):
        table.kind = "digis"
    with pytest.raises(TypeError):
        table.columns["phi"] = mine


def test_arrays_that_fit_are_not_copied():
    """A contiguous column of the right dtype is shared, not copied."""
    phi = np.zeros(2)
    assert np.shares_memory(make("truths", [0, 1], 2, phi=phi)["phi"], phi)


def test_offsets_point_at_the_rows_of_each_event():
    """Offsets agree with the event column, with empty events at both ends and between."""
    events = [11, 11, 13, 13, 13]
    table = make("digis", events, 6, first_event=10)
    assert table.offsets.tolist() == [0, 0, 2, 2, 5, 5, 5]
    for i in range(6):
        rows = table["event"][table.offsets[i] : table.offsets[i + 1]]
        assert rows.tolist() == [e for e in events if e == 10 + i]
    assert Table.empty("digis", 2).offsets.tolist() == [0, 0, 0]


def test_checks_of_columns_agree_with_numpy():
    """The compiled checks find what plain numpy finds, in right and in wrong columns."""
    draws = np.random.default_rng(1)
    for _ in range(300):
        first, n = draws.integers(-5, 5), draws.integers(0, 6)
        event = draws.integers(first - 1, first + n + 1, draws.integers(0, 8))
        event = np.sort(event) if draws.random() < 0.8 else event
        offsets = _core.common.event_offsets(event, first, n)
        fits = np.all(np.diff(event) >= 0) and np.all((event >= first) & (event < first + n))
        assert (offsets is not None) == fits
        if fits:
            assert offsets.tolist() == np.searchsorted(event, np.arange(first, first + n + 1)).tolist()

        target, mine = draws.integers(0, 3, 4), draws.integers(0, 3, 3)
        links = draws.integers(-2, 5, 3)
        strange = [row for row, to in enumerate(links) if to >= 0 and (to >= 4 or target[to] != mine[row])]
        assert _core.common.strange_link(links, mine, target) == (strange[0] if strange else -1)
    with pytest.raises(ValueError, match="0 or more"):
        _core.common.event_offsets(np.zeros(1, np.int64), 0, -1)


@pytest.mark.parametrize("key", [slice(1, 3), [1, 2], np.array([False, True, True, False])])
def test_picking_rows(key):
    """Slices, row numbers and masks give the same rows, with offsets to match."""
    picked = make("tracks", [0, 1, 1, 2], 3, dr=[1, 2, 3, 4])[key]
    assert picked["dr"].tolist() == [2, 3]
    assert picked.offsets.tolist() == [0, 0, 2, 2]
    assert picked.meta == {"seed": 1}


def test_picking_wrongly():
    """Unknown columns get a hint; shuffled rows, numbers beyond the end and what is no number are refused."""
    table = make("tracks", [0, 1], 2)
    with pytest.raises(KeyError, match='did you mean "kappa"'):
        table["kapa"]
    with pytest.raises(ValueError, match="sorted by event"):
        table[[1, 0]]
    for key in (2, -3, True, 0.0, np.zeros((1, 1), int)):
        with pytest.raises(IndexError):
            table[key]
    assert len(table[[]]) == 0


def test_a_row_has_the_values_of_all_columns():
    """By number from either end; it is printed with its units, and compares and pickles as a dict."""
    table = make("tracks", [0, 0, 1], 2, dr=[0.5, 1.5, -2.5], cov=np.arange(75.0).reshape(3, 5, 5))
    row = table[1]
    assert list(row) == list(table)
    assert (row["event"], row["dr"], row["cov"].tolist()) == (0, 1.5, table["cov"][1].tolist())
    assert table[-1]["dr"] == table[np.int64(2)]["dr"] == -2.5
    lines = dict(line.split(maxsplit=1) for line in repr(row).splitlines())
    assert lines["dr"] == "1.5 mm"
    assert lines["cov"].startswith("5x5")
    assert lines.keys() == row.keys()
    digi = make("digis", [0], 1)[0]
    copied = pickle.loads(pickle.dumps(digi))
    assert dict(copied) == dict(digi)
    assert repr(copied) == repr(digi)


def test_the_head_of_a_table():
    """The first rows, of the same events."""
    table = make("tracks", range(8), 8, dr=np.arange(8.0))
    assert table.head()["dr"].tolist() == [0, 1, 2, 3, 4]
    assert table.head(2) == table[:2]
    assert table.head(2).n_events == 8
    assert table.head(99) == table


def test_select_events():
    """A span of events keeps its numbers, and events outside are refused."""
    table = make("digis", [4, 5, 5, 7], 4, first_event=4)
    part = table.select_events(5, 7)
    assert (part.first_event, part.n_events, len(part)) == (5, 2, 2)
    with pytest.raises(IndexError, match="not within 4 to 8"):
        table.select_events(5, 9)


def test_all_mistakes_at_once():
    """Missing columns, wrong shapes, dtypes and events are listed together."""
    with pytest.raises(ValueError, match="wire_hits") as error:
        Table("wire_hits", {"event": [3, 1], "layer": [0.5, 1], "wire": [1], "gid": [2**40, 1], "side": [300, 0],
                            "drift": ["a", "b"]}, 2)  # fmt: skip
    text = str(error.value)
    for problem in ("sigma: missing", "layer: has dtype float64, expected int32", "wire: has shape (1,), expected (2)",
                    "gid: has values that do not fit into int32", "side: has values", "event: decreases",
                    "drift: has dtype <U1"):  # fmt: skip
        assert problem in text
    with pytest.raises(ValueError, match="event: runs from 0 to 5, expected 0 to 4"):
        make("digis", [0, 5], 5)
    with pytest.raises(ValueError, match='did you mean "digis"'):
        Table("digi", {}, 0)


def test_with_columns_adds_and_replaces():
    """Columns are added behind the schema's, and the table itself stays as it was."""
    table = make("particles", [0], 1)
    more = table.with_columns(status=[2], weight=[0.5])
    assert (more["status"][0], more["weight"][0], table["status"][0]) == (2, 0.5, 0)
    assert list(more.keys())[-1] == "weight"
    assert "weight" not in table
    assert more != table
    assert more.with_meta(a=1).meta == {"seed": 1, "a": 1}


def test_equality_and_pickle():
    """Equal rows are equal, NaN too; one different number, event range or dtype is not."""
    table = make("clusters", [0, 1], 2, z=[np.nan, 1])
    again = pickle.loads(pickle.dumps(table))
    assert again == table
    assert not again["z"].flags.writeable
    assert again.meta == table.meta
    assert make("clusters", [0, 1], 2, z=[np.nan, 2]) != table
    assert make("clusters", [0, 1], 3, z=[np.nan, 1]) != table
    assert table != 3


def test_file_round_trip(tmp_path):
    """A file gives the same table back and says units, version and seed."""
    table = make("tracks", [5, 6, 6], 4, first_event=4, cov=np.arange(75.0).reshape(3, 5, 5))
    path = tmp_path / "tracks.npz"
    table.save(path)
    again = Table.load(path)
    assert again == table
    assert again.meta == {"seed": 1}
    with np.load(path) as stored:
        assert stored["offsets"].tolist() == table.offsets.tolist()
        about = json.loads(str(stored["__meta__"]))
    assert about["units"]["dr"] == "mm"
    assert about["version"]


def test_files_are_not_overwritten_and_never_half_written(tmp_path, monkeypatch):
    """An existing file stays unless asked, and an interrupted write leaves nothing."""
    table, path = make("digis", [0], 1), tmp_path / "digis.npz"
    table.save(path)
    with pytest.raises(FileExistsError, match="overwrite=True"):
        table.save(path)
    table.with_columns(strip=[7]).save(path, overwrite=True)
    before = path.read_bytes()

    def interrupted(stream, **_arrays):
        stream.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", interrupted)
    for target in (path, tmp_path / "other.npz"):
        with pytest.raises(KeyboardInterrupt):
            table.save(target, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["digis.npz"]
    assert path.read_bytes() == before


def test_new_file_refuses_one_that_appeared_meanwhile(tmp_path):
    """A file that somebody else wrote during the block is not replaced."""
    path = tmp_path / "a.txt"

    def write():
        with new_file(path) as temporary:
            temporary.write_text("mine")
            path.write_text("theirs")

    with pytest.raises(FileExistsError):
        write()
    assert path.read_text() == "theirs"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_damaged_and_foreign_files(tmp_path):
    """A cut, foreign or missing file says so."""
    good, path = tmp_path / "good.npz", tmp_path / "x.npz"
    make("digis", [0], 1).save(good)
    path.write_bytes(good.read_bytes()[:-100])
    with pytest.raises(ValueError, match="not a complete table file"):
        Table.load(path)
    np.savez(path, a=np.zeros(2))
    with pytest.raises(ValueError, match="not a complete table file"):
        Table.load(path)
    np.save(tmp_path / "plain.npy", np.zeros(2))
    with pytest.raises(ValueError, match="not a complete table file"):
        Table.load(tmp_path / "plain.npy")
    right = {"format": "cgemit-table-1", "kind": "digis", "n_events": 1, "first_event": 0, "meta": {}}
    for about in ([], 5, None, "digis"):
        np.savez(path, __meta__=np.array(json.dumps(about)), event=np.zeros(1, int))
        with pytest.raises(ValueError, match=r"x\.npz is not a complete table file .*description holds"):
            Table.load(path)
    for name, value in (("kind", None), ("n_events", "1"), ("first_event", None), ("meta", [])):
        np.savez(path, __meta__=np.array(json.dumps(right | {name: value})), event=np.zeros(1, int))
        with pytest.raises(ValueError, match=rf"x\.npz is not a complete table file .*missing or wrong: .*{name}"):
            Table.load(path)
    with pytest.raises(FileNotFoundError, match="nothing"):
        Table.load(tmp_path / "nothing.npz")


def test_sets_of_tables(tmp_path):
    """A set is refused as a whole if one file exists, and is complete only with its index."""
    tables = {kind: make(kind, [0], 1) for kind in ("truths", "digis")}
    written = save_tables(tables, tmp_path / "set")
    assert {p.name for p in written} == {"truths.npz", "digis.npz", "tables.json"}
    assert load_tables(tmp_path / "set") == tables
    with pytest.raises(FileExistsError, match=r"truths\.npz"):
        save_tables({"truths": tables["truths"], "clusters": make("clusters", [0], 1)}, tmp_path / "set")
    assert not (tmp_path / "set" / "clusters.npz").exists()
    for text in ("5", "{"):
        (tmp_path / "set" / "tables.json").write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=r"tables\.json is damaged"):
            load_tables(tmp_path / "set")
    (tmp_path / "set" / "tables.json").unlink()
    with pytest.raises(FileNotFoundError, match="no complete set"):
        load_tables(tmp_path / "set")


def test_names_of_tables_are_known_without_reading_them(tmp_path):
    save_tables({kind: make(kind, [0], 1) for kind in ("truths", "digis")}, tmp_path)
    whole = store.StoredTables(tmp_path)
    (part,) = whole.parts()
    joined = JoinedTables([{"truths": make("truths", [0], 1), "digis": make("digis", [0], 1)}])
    for file in tmp_path.glob("*.npz"):
        file.unlink()
    for tables in (whole, part, joined):
        assert (list(tables), len(tables)) == (["truths", "digis"], 2)
        assert ("truths" in tables, "tracks" in tables) == (True, False)
    with pytest.raises(FileNotFoundError):
        part["truths"]
    assert joined["truths"] is joined["truths"]


def chunk(first, n, truth_rows):
    """Return a chunk whose every digi links to the last truth of the chunk, and one to none."""
    truths = make("truths", [first] * truth_rows, n, first)
    digis = make("digis", [first, first + n - 1], n, first, truth=[truth_rows - 1, -1])
    clusters = make("clusters", [first], n, first, truth=[truth_rows - 1], x_cluster=[0], v_cluster=[-1])
    hits = make("wire_hits", [first] * 3, n, first, wire_truth=[-1] * 3)
    tracks = make("tracks", [first], n, first)
    candidates = make("candidates", [first], n, first)
    found = make("candidate_hits", [first] * 2, n, first, view=[2, 3], hit=[1, 0])
    residuals = make("residuals", [first] * 3, n, first, view=[0, 1, 2], hit=[0, -1, 2])
    tables = (truths, make("wire_truths", [], n, first), digis, clusters, hits, candidates, found, tracks, residuals)
    return {table.kind: table for table in tables}


def test_concatenate_shifts_links():
    """Links count rows of the joined tables, -1 stays, and a link by view follows its own table."""
    joined = concatenate([chunk(0, 2, 4), chunk(2, 3, 5), chunk(5, 1, 1)])
    assert joined["digis"]["truth"].tolist() == [3, -1, 8, -1, 9, -1]
    assert joined["clusters"]["x_cluster"].tolist() == [0, 1, 2]
    assert joined["clusters"]["v_cluster"].tolist() == [-1, -1, -1]
    assert joined["residuals"]["hit"].tolist() == [0, -1, 2, 1, -1, 5, 2, -1, 8]
    assert joined["residuals"]["track"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert joined["candidate_hits"]["hit"].tolist() == [1, 0, 4, 1, 7, 2]
    assert joined["candidate_hits"]["candidate"].tolist() == [0, 0, 1, 1, 2, 2]
    assert (joined["digis"].first_event, joined["digis"].n_events) == (0, 6)
    assert joined["digis"].meta == {"seed": 1}
    one = chunk(3, 2, 2)
    assert concatenate([one]) == one


def test_tables_are_joined_when_asked_for():
    """Descriptions and single columns come from the chunks; they are those of the joined tables."""
    chunks = [chunk(0, 2, 4), chunk(2, 3, 5), chunk(5, 1, 1)]
    lazy, joined = JoinedTables(chunks, meta={"run": 7}), concatenate(chunks)
    for name, table in joined.items():
        assert about_of(lazy, name) == describe(table.with_meta(run=7))
        for column in table.columns:
            np.testing.assert_array_equal(column_of(lazy, name, column), table[column])
    assert dict(lazy) == {name: table.with_meta(run=7) for name, table in joined.items()}
    assert pickle.loads(pickle.dumps(lazy)) == lazy


def test_a_run_joins_no_table_that_nobody_asks_for(monkeypatch):
    joined = []
    monkeypatch.setattr(store, "_join", lambda parts, before: joined.append(parts[0].kind) or joining(parts, before))
    result = run("besiii-cgem", Gun("mu-", p=1.0, cos_theta=0.0), 6, workers=Workers(threads=1, chunk=2))
    assert (result.rows["truths"], result.n_events, result.removed()) == (18, 6, {})
    assert joined == []
    assert len(result.truths) == len(result.truths) == 18
    assert joined == ["truths"]


def test_concatenate_refuses_what_does_not_join():
    """Gaps, missing tables and links into absent tables are named."""
    with pytest.raises(ValueError, match="ends before event 2, but the next chunk starts at 3"):
        concatenate([chunk(0, 2, 1), chunk(3, 1, 1)])
    with pytest.raises(ValueError, match="digis: links to truths"):
        concatenate([{"digis": make("digis", [0], 1)}, {"digis": make("digis", [1], 1, 1)}])
    with pytest.raises(ValueError, match="chunk 1: holds"):
        concatenate([{"truths": make("truths", [0], 1)}, {}])
    with pytest.raises(ValueError, match="at least one"):
        concatenate([])


def test_awkward_and_pandas():
    """One list per event in awkward, one row per row in pandas, matrices spread over columns."""
    table = make("tracks", [0, 2, 2], 3, dr=[1, 2, 3], cov=np.arange(75.0).reshape(3, 5, 5))
    assert table.to_awkward()["dr"].tolist() == [[1], [], [2, 3]]
    assert table.to_awkward()["cov"].tolist()[2][1] == table["cov"][2].tolist()
    frame = table.to_pandas()
    assert frame["cov_1_4"].tolist() == table["cov"][:, 1, 4].tolist()
    assert len(frame) == 3


@pytest.mark.parametrize("method", ["to_awkward", "to_pandas"])
def test_missing_extra_is_named(method, monkeypatch):
    """Without the optional package the message says what to install."""
    wanted = method.removeprefix("to_")
    import_module = builtins.__import__

    def without(name, *args, **kwargs):
        if name == wanted:
            raise ImportError(name)
        return import_module(name, *args, **kwargs)

    monkeypatch.setattr("cgemit.base.files.importlib.import_module", without)
    with pytest.raises(ImportError, match=r"pip install 'cgemit\[io\]'"):
        getattr(make("digis", [0], 1), method)()


@pytest.mark.parametrize(("n", "shown"), [(0, 0), (20, 20), (21, 5)])
def test_prints_its_first_rows(n, shown):
    """Text and HTML show the values of the first rows; text as many columns as a line holds, and names all others."""
    table = make("tracks", range(n), n, dr=np.linspace(-1, 1, n))
    lines = repr(table).splitlines()
    assert max(map(len, lines)) <= 100
    assert f"{n} rows" in lines[0]
    heads = re.findall(r"(\w+)(?: \[([^]]*)\])?", lines[1])
    assert heads[3:5] == [("dr", "mm"), ("phi0", "rad")]
    rows = [line.split() for line in lines[2 : 2 + shown]]
    assert [float(row[3]) for row in rows] == pytest.approx(table["dr"][:shown], rel=1e-5)
    rest = " ".join(lines[2 + shown :])
    assert (f"{n - shown} more rows" in rest) == (shown < n)
    others = re.findall(r"(\w+)(?: \[[^]]*\])?(?:,|$)", rest.partition("more columns: ")[2])
    assert [name for name, _ in heads] + others == list(table)
    html = table._repr_html_()
    assert html.count("<tr>") == 1 + shown
    cells = [re.findall(r"<td>(.*?)</td>", row) for row in html.split("<tr>")[2:]]
    assert [float(row[3]) for row in cells] == pytest.approx(table["dr"][:shown], rel=1e-5)
    assert all("5x5 matrix" in row for row in cells)
    assert (f"{n - shown} more rows" in html) == (shown < n)


def test_a_column_has_one_unit_with_and_without_truth():
    """True values, residuals and errors have the unit of the quantity; pulls have none."""
    table = make("tracks", [0], 1).with_columns(truth_dr=[0.0], res_p=[0.0], pull_dr=[0.0], mine=[0.0])
    lines = {line.split()[0]: line.split()[1:] for line in repr(table[0]).splitlines()}
    assert [lines[name][1:] for name in ("truth_dr", "res_p", "err_dr", "pull_dr", "mine")] == [
        ["mm"], ["GeV/c"], ["mm"], [], [],
    ]  # fmt: skip
    assert "truth_dr [mm]" in repr(table)


def test_schemas_are_sound():
    """Event comes first, names are unique, links name tables and are int64."""
    assert set(ROWS) == set(SCHEMAS)
    for columns in SCHEMAS.values():
        names = [column.name for column in columns]
        assert names[0] == "event"
        assert len(set(names)) == len(names)
        for column in columns:
            targets = (column.links,) if isinstance(column.links, str) else column.links or ()
            assert set(targets) <= set(SCHEMAS)
            assert not targets or column.dtype == np.int64


FAR = 900_000_000_001


def make_sparse(events, all_events):
    """Return digis in some of several events."""
    columns = make("digis", events, max(events) - min(events) + 1, min(events)).columns
    return Table("digis", columns, len(all_events), events=all_events)


def test_events_may_have_gaps(tmp_path):
    """Offsets count the events covered; picking, files, pickles and pictures of the table keep them."""
    table = make_sparse([4, 4, 20], [4, 17, 20])
    assert table.events.tolist() == [4, 17, 20]
    assert table.offsets.tolist() == [0, 2, 2, 3]
    assert (table.n_events, table.first_event) == (3, 4)
    assert table.select_events(5, 21).events.tolist() == [17, 20]
    assert table.select_events(4, 18)["event"].tolist() == [4, 4]
    assert table[[0, 2]].events.tolist() == [4, 17, 20]
    table.save(tmp_path / "digis.npz")
    assert Table.load(tmp_path / "digis.npz") == table
    assert pickle.loads(pickle.dumps(table)) == table
    assert table != make("digis", [4, 4, 20], 17, 4)
    assert table != make_sparse([4, 4, 20], [4, 18, 20])
    assert "3 events from 4 to 20, with gaps" in repr(table)
    assert table.to_awkward()["layer"].tolist() == [[0, 0], [], [0]]
    with pytest.raises(IndexError, match="4 to 22 are not within 4 to 21"):
        table.select_events(4, 22)


def test_numbers_far_apart_cost_nothing():
    """The last event may be a million millions away."""
    table = Table("digis", make("digis", [0], 1).columns | {"event": np.array([FAR])}, 2, events=[3, FAR])
    assert table.offsets.tolist() == [0, 0, 1]


def test_events_that_follow_each_other_have_no_gaps():
    """The same table however its events are given."""
    assert make_sparse([4, 5], [4, 5, 6]) == make("digis", [4, 5], 3, 4)


@pytest.mark.parametrize(
    ("events", "message"),
    [([4, 4, 20], "do not increase"), ([4, 20], "got shape"), ([4.0, 17.0, 20.0], "float64"), ([4, 5, 19], "holds 20")],
)
def test_wrong_events_are_refused(events, message):
    """Each once, in order, as many as said, and every row in one of them."""
    columns = make("digis", [4, 4, 20], 17, 4).columns
    with pytest.raises(ValueError, match=message):
        Table("digis", columns, 3, events=events)


def test_tables_with_gaps_are_joined():
    """Chunks follow each other with gaps inside and between; those that overlap do not."""
    digis = [make_sparse(events, events) for events in ([4, 17], [20, 33])]
    none = Table.empty("truths").columns
    chunks = [{"digis": table, "truths": Table("truths", none, **table.cover)} for table in digis]
    joined = concatenate(chunks)["digis"]
    assert joined.events.tolist() == [4, 17, 20, 33]
    assert joined["event"].tolist() == [4, 17, 20, 33]
    with pytest.raises(ValueError, match="ends before event 34, but the next chunk starts at 4"):
        concatenate(chunks[::-1])


def test_numbers_of_events_beyond_the_range():
    """Offsets need the number after the last one: it must fit, too."""
    for last in (2**63 - 1, 2**63):
        with pytest.raises(ValueError, match=f"events: got 5 to {last}, expected numbers within"):
            Table.empty("particles", 2, events=np.array([5, last], np.uint64))


FIT = FitSettings(components=True, residuals=True, states=("hits",))


@pytest.fixture(scope="module")
def result():
    settings, readout = Settings(fit=FIT, refine=RefineSettings(start_time="fitted")), TigerReadout(second_pass=True)
    gun = Gun("mu-", p=0.5, theta=1, multiplicity=2)
    found = run("besiii-cgem-design", gun, n=12, settings=settings, readout=readout)
    vertices = fit_vertices(found.detector, found.tracks, np.arange(24).reshape(-1, 2), particles=("mu", "mu"))
    return replace(found, tables={**found.tables, "vertices": vertices})


@pytest.fixture(scope="module")
def lists(result):
    return result.to_awkward()


def links():
    """Return (table, column, tables linked to by view) of every link."""
    return [(kind, column.name, targets(column)) for kind in SCHEMAS for column in SCHEMAS[kind] if column.links]


def test_links_are_known():
    assert ("clusters", "truth", ("truths",)) in links()
    assert linked("candidate_hits") == {"candidates", "clusters", "wire_hits"}


@pytest.mark.parametrize(("kind", "column", "to"), links())
def test_links_of_lists_per_event(result, lists, kind, column, to):
    """A local link leads to the row that the link of the flat columns leads to."""
    table = result.tables[kind]
    assert len(table) or kind in ("steps", "components")  # of electrons
    view = table["view"] if len(to) > 1 else np.zeros(len(table), int)
    for number, event in enumerate(table.events):
        rows = np.flatnonzero(table["event"] == event)
        assert len(lists[kind][number]) == len(rows)
        names = {target: "layer" if "layer" in result.tables[target] else "event" for target in to}
        there = {target: lists[target][number][name].to_list() for target, name in names.items()}
        first = {target: np.searchsorted(result.tables[target]["event"], event) for target in to}
        for row, local in zip(rows, lists[kind][number][column].to_list(), strict=True):
            flat = table[column][row]
            assert (local < 0) == (flat < 0)
            if flat >= 0:
                target = to[view[row]]
                assert there[target][local] == result.tables[target][names[target]][flat]
                assert local == flat - first[target]


def test_joined_tracks_have_local_links_too(result):
    tracks = result.to_awkward()["tracks"]
    assert ak.all(tracks.candidate == ak.local_index(tracks.candidate))
    assert "res_dr" in tracks.fields


def test_without_tables_links_stay(result):
    np.testing.assert_array_equal(ak.flatten(result.clusters.to_awkward().truth), result.clusters["truth"])


def test_tables_that_do_not_fit_are_named(result):
    other = {**result.tables, "truths": result.truths.select_events(0, 3)}
    with pytest.raises(ValueError, match="truths: covers other events than clusters"):
        result.clusters.to_awkward(other)
    with pytest.raises(ValueError, match="truths: missing; clusters links to it"):
        result.clusters.to_awkward({"clusters": result.clusters})


def test_selected_events_are_those_of_a_run_of_their_own(result):
    """Links of selected events begin at 0 again; the parts make the whole."""
    parts = [result.select_events(*limits) for limits in ((0, 5), (5, 6), (6, 12))]
    assert [part.particles.n_events for part in parts] == [5, 1, 6]
    lone = parts[1].clusters[parts[1].clusters["truth"] >= 0]
    assert len(lone)
    np.testing.assert_array_equal(parts[1].truths["layer"][lone["truth"]], lone["layer"])
    assert dict(concatenate([part.tables for part in parts])) == dict(result.tables)
    with pytest.raises(IndexError, match="not within"):
        result.select_events(5, 13)
    with pytest.raises(ValueError, match="clusters: links to truths, which is missing"):
        select_events({"clusters": result.clusters}, 0, 1)


@pytest.mark.parametrize("make", [pd.DataFrame, ak.Array, np.asarray, np.array])
def test_a_table_is_not_taken_for_its_names(result, make):
    with pytest.raises(TypeError, match=r"clusters: got a table; expected to_pandas\(\), to_awkward\(\)"):
        make(result.clusters)


def test_columns_are_a_mapping(result):
    frame = pd.DataFrame(dict(result.clusters.columns))
    pd.testing.assert_frame_equal(frame, result.clusters.to_pandas())
    assert dict(result.tracks.columns).keys() == result.tracks.keys()
    assert dict(result.clusters).keys() == result.clusters.keys()


def test_rows_of_parts_are_merged_by_event_and_layer() -> None:
    """Links among the rows of a part follow them, those to other tables stay; what a part lacks is 0 there."""

    def part(event: list[int], layer: list[int], truth: list[int], x_cluster: list[int], **more: Any) -> Table:
        n = len(event)
        columns = {name: np.zeros(n, one.dtype) for name, one in Table.empty("clusters", 1).columns.items()}
        given = {"event": event, "layer": layer, "truth": truth, "x_cluster": x_cluster, "v_cluster": [-1] * n}
        columns |= {name: np.array(values, columns[name].dtype) for name, values in given.items()}
        return Table("clusters", columns | more, 3, meta={"seed": 1})

    inner = part([0, 0, 2], [0, 2, 0], [5, 6, 7], [-1, 0, 2], corr_xv=np.array([0.1, 0.2, 0.3]))
    outer = part([0, 2, 2], [1, 1, 3], [1, 2, 3], [0, -1, 1])
    found = merged([inner, outer])
    assert found["event"].tolist() == [0, 0, 0, 2, 2, 2]
    assert found["layer"].tolist() == [0, 1, 2, 0, 1, 3]
    assert found["truth"].tolist() == [5, 1, 6, 7, 2, 3]
    assert found["x_cluster"].tolist() == [-1, 1, 0, 3, -1, 4]
    assert found["v_cluster"].tolist() == [-1] * 6
    assert found["corr_xv"].tolist() == [0.1, 0.0, 0.2, 0.3, 0.0, 0.0]
    assert (found.n_events, found.meta, found["x_cluster"].dtype) == (3, {"seed": 1}, inner["x_cluster"].dtype)
    assert merged([outer, inner]) == found
    assert merged([inner]) is inner
