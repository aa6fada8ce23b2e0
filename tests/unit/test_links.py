"""Links between rows of tables: as lists per event, and after events were selected."""

from dataclasses import replace

import awkward as ak
import numpy as np
import pandas as pd
import pytest

from cgemit import Gun, RefineSettings, Settings, TigerReadout, fit_vertices, run
from cgemit.reconstruction.fit import FitSettings
from cgemit.tables import SCHEMAS, concatenate, select_events
from cgemit.tables.table import linked, targets

FIT = FitSettings(residuals=True, states=("hits",))


@pytest.fixture(scope="module")
def result():
    settings, readout = Settings(fit=FIT, refine=RefineSettings(start_time="fitted")), TigerReadout(second_pass=True)
    gun = Gun("mu-", p=0.5, theta=1, multiplicity=2)
    found = run("besiii-cgem-design", gun, n=12, settings=settings, readout=readout)
    vertices = fit_vertices(found.detector, found.tracks, np.arange(24).reshape(-1, 2), particles=("mu", "mu"))
    return replace(found, tables={**found.tables, "vertices": vertices})


def links():
    """Return (table, column, tables linked to by view) of every link."""
    return [(kind, column.name, targets(column)) for kind in SCHEMAS for column in SCHEMAS[kind] if column.links]


def test_links_are_known():
    assert ("clusters", "truth", ("truths",)) in links()
    assert linked("candidate_hits") == {"candidates", "clusters", "wire_hits"}


@pytest.mark.parametrize(("kind", "column", "to"), links())
def test_links_of_lists_per_event(result, kind, column, to):
    """A local link leads to the row that the link of the flat columns leads to."""
    lists, table = result.to_awkward(), result.tables[kind]
    assert len(table) or kind == "steps"
    view = table["view"] if len(to) > 1 else np.zeros(len(table), int)
    for number, event in enumerate(table.events):
        rows = np.flatnonzero(table["event"] == event)
        assert len(lists[kind][number]) == len(rows)
        for row, local in zip(rows, lists[kind][number][column], strict=True):
            flat = table[column][row]
            assert (local < 0) == (flat < 0)
            if flat >= 0:
                target = to[view[row]]
                name = "layer" if "layer" in result.tables[target] else "event"
                assert lists[target][number][name][local] == result.tables[target][name][flat]
                assert local == flat - np.searchsorted(result.tables[target]["event"], event)


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
