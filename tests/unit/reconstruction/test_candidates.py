"""Candidates from anywhere: any order of hits, any finder, no truth; what is wrong with hits is said at once."""

from __future__ import annotations

import functools
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

import cgemit as cg
from cgemit import _core
from cgemit.fit_matter import tuned
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.fit import fit
from cgemit.tables import Table
from cgemit.tables.schema import HIT_V, HIT_WIRE, HIT_X, HIT_XV
from cgemit.truth.match import joined, match

DETECTOR = cg.load("besiii-cgem-design")
GUN = cg.Gun("mu-", p=(0.3, 1.2), cos_theta=(-0.8, 0.8)) + cg.Gun("pi+", p=0.4, cos_theta=(-0.5, 0.5))
TRUTH = {"clusters": ("truth", "n_truths"), "wire_hits": ("wire_truth",)}
RESIDUALS = cg.Settings(fit=cg.FitSettings(residuals=True))


@pytest.fixture(scope="module")
def result():
    """Return a run of 40 events with two particles each."""
    return cg.run(DETECTOR, GUN, 40, seed=8, settings=RESIDUALS)


def tables_of(result):
    """Return what the fit takes."""
    return {name: result.tables[name] for name in ("clusters", "wire_hits", "candidates", "candidate_hits")}


def fitted(tables, **settings):
    """Fit with residuals."""
    return fit(DETECTOR, *tables.values(), cg.FitSettings(residuals=True, **settings))


def same(a, b):
    """Tell whether two tables have the same bytes."""
    return list(a) == list(b) and all(a[name].tobytes() == b[name].tobytes() for name in a)


def everything(detector, clusters, wire_hits):
    """A toy finder: all hits of an event are one track."""
    return cg.label_candidates(clusters, wire_hits, np.zeros(len(clusters), int), np.zeros(len(wire_hits), int))


# ----- no truth


def test_truth_changes_no_bit_of_a_track(result):
    """Links to truth removed or scrambled, particles and truths not there at all: the same tracks and residuals."""
    tables, expected = tables_of(result), {name: result.tables[name] for name in ("tracks", "residuals")}
    random = np.random.default_rng(1)
    for change in (lambda column: np.full_like(column, -1), random.permutation):
        for name, links in TRUTH.items():
            scrambled = {link: change(tables[name][link]) for link in links}
            tables[name] = tables[name].with_columns(**scrambled)
        out = fitted(tables, screening="wentzel")
        assert all(same(out[name], expected[name]) for name in expected)


def test_a_finder_needs_no_truth_either(result):
    """Found and fitted from clusters and wire hits without their links as with them."""
    found = []
    for blind in (False, True):
        hits = [result.clusters, result.wire_hits]
        if blind:
            hits = [t.with_columns(**{n: np.full(len(t), -1) for n in TRUTH[t.kind]}) for t in hits]
        candidates = everything(DETECTOR, *hits)
        found.append(fit(DETECTOR, *hits, *candidates.values())["tracks"])
    assert same(*found)
    assert len(found[0]) == 40


# ----- any order


def test_the_order_of_hits_changes_no_bit(result):
    """Hits of all candidates of an event mixed, from the outside inward: sorted by the fit."""
    tables, hits = tables_of(result), result.candidate_hits
    random = np.random.default_rng(2)
    for key in (random.random(len(hits)), -np.arange(len(hits))):
        tables["candidate_hits"] = hits[np.lexsort((key, hits["event"]))]
        out = fitted(tables)
        assert all(same(out[name], result.tables[name]) for name in ("tracks", "residuals"))


def test_the_order_of_the_tables_changes_no_bit(result):
    """Clusters and wire hits in another order within their events, with candidates that follow them."""
    random, hits = np.random.default_rng(3), result.candidate_hits
    row, tables = hits["hit"].copy(), tables_of(result)
    for name, mine in (("clusters", hits["view"] != HIT_WIRE), ("wire_hits", hits["view"] == HIT_WIRE)):
        table = tables[name]
        order = np.lexsort((random.random(len(table)), table["event"]))
        tables[name] = table[order]
        row[mine] = np.argsort(order)[row[mine]]
    tables["candidate_hits"] = hits.with_columns(hit=row)
    assert same(fitted(tables)["tracks"], result.fitted)


def test_any_number_of_candidates():
    """None, several of the same hits, and events without any."""
    run = cg.run(DETECTOR, cg.Gun("mu-", p=1.0, cos_theta=0.2), 3, seed=1)
    hits = run.candidate_hits[run.candidate_hits["event"] == 1]
    twice = np.repeat(np.arange(2), len(hits))
    columns = {name: np.tile(hits[name], 2) for name in hits} | {"candidate": twice}
    kinds = {"pdg": [13, 211], "mass": [0.10566, 0.13957], "charge": [1, 1]}
    candidates = Table("candidates", {"event": [1, 1], "candidate": [0, 1]} | kinds, 3)
    given = (run.clusters, run.wire_hits)
    tracks = fit(DETECTOR, *given, candidates, Table("candidate_hits", columns, 3))["tracks"]
    assert tracks["event"].tolist() == [1, 1]
    assert tracks["hypothesis"].tolist() == [13, 211]
    assert tracks["p"][0] != tracks["p"][1]
    none = fit(DETECTOR, *given, Table.empty("candidates", 3), Table.empty("candidate_hits", 3))["tracks"]
    assert (len(none), none.n_events) == (0, 3)


# ----- finders


def test_a_toy_finder_runs_through_the_chain_and_the_study():
    """Three lines from outside: its name stands in the tables, its tracks have resolutions."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5))
    result = cg.run(DETECTOR, gun, 300, seed=2, finder=everything)
    assert result.finder == result.tracks.meta["finder"] == "everything"
    assert "found by everything" in repr(result)
    assert len(result.tracks) == 300
    assert np.all(result.matches["particle"] == 0)
    by_truth = cg.run(DETECTOR, gun, 300, seed=2)
    widths = [cg.resolution(run, "p").core for run in (result, by_truth)]
    assert widths[0] == pytest.approx(widths[1], rel=0.1)
    assert len(cg.study.pulls(result.tracks)) > 4


def test_finders_are_functions_classes_and_partial_functions():
    """Each has a name; in threads and chunks the result is the same."""

    class Finder:
        def __call__(self, *given):
            return everything(*given)

    for finder, name in ((Finder(), "Finder"), (functools.partial(everything), "everything")):
        runs = [
            cg.run(DETECTOR, GUN, 10, finder=finder, workers=cg.Workers(threads=2, chunk=chunk)) for chunk in (10, 3)
        ]
        assert runs[0].finder == name
        assert runs[0] == runs[1]


def test_processes_need_finders_that_can_be_sent():
    """A function of a module can, one defined on the way cannot, which is said before anything runs."""
    refused = pytest.raises(TypeError, match=r"finder: got <lambda>, which cannot be sent to other processes")
    with ProcessPoolExecutor(1) as pool, refused:
        cg.run(DETECTOR, GUN, 4, finder=lambda *given: everything(*given), workers=pool)


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (None, TypeError, "finder answering: returned NoneType; expected a mapping with 'candidates' and 'candidate_h"),
        ({"candidates": 1}, TypeError, "returned a mapping with 'candidates'; expected"),
        ({"candidates": 1, "candidate_hits": 2}, ValueError, "(?s)candidates: got int, .*candidate_hits: got int"),
        (
            {kind: Table.empty(kind, 7) for kind in ("candidates", "candidate_hits")},
            ValueError,
            "(?s)candidates: cover other events than the clusters.*candidate_hits: cover",
        ),
    ],
)
def test_wrong_answers_of_finders(answer, error, message):
    """Something else than the two tables of these events."""

    def answering(detector, clusters, wire_hits):
        return answer

    with pytest.raises(error, match=message):
        cg.run(DETECTOR, GUN, 4, finder=answering)


def test_wrong_finder_and_end():
    """Both are named."""
    with pytest.raises(ValueError, match=r"(?s)finder: got 'hough', expected 'truth'.*until: got 'track', expected"):
        cg.run(DETECTOR, GUN, 4, finder="hough", until="track")


@pytest.mark.parametrize("until", ["simulate", "digitize", "cluster", "find"])
def test_runs_may_end_early(until, result):
    """What was made is what a whole run makes; the rest is None, also in pictures and reports."""
    part = cg.run(DETECTOR, GUN, 40, seed=8, settings=RESIDUALS, until=until)
    order = ("simulate", "digitize", "cluster", "find")
    made = {"digis": "digitize", "clusters": "cluster", "candidates": "find", "candidate_hits": "find"}
    for name, stage in made.items():
        there = order.index(stage) <= order.index(until)
        assert (getattr(part, name) is not None) == there
        assert not there or part.tables[name] == result.tables[name]
    assert (part.tracks, part.fitted, part.matches, part.residuals) == (None,) * 4
    assert (part.finder == "truth") == (until == "find")
    assert part.removed() == {}
    assert "tracks" not in repr(part)
    cg.draw.event(part, 0)
    with pytest.raises(ValueError, match="tracks: the result has none"):
        cg.resolution(part, "p")


def test_labels(result):
    """Candidates by event and number; XV clusters that repeat labelled ones are left out, others are points."""
    clusters, wires = result.clusters, result.wire_hits
    label = np.where(clusters["view"] == 2, 5, np.where(clusters["layer"] == 1, -1, 2))
    found = cg.label_candidates(clusters, wires, label, np.full(len(wires), 2), hypothesis="K")
    candidates, hits = found.values()
    assert candidates["event"].tolist() == np.repeat(np.arange(40), 2).tolist()
    assert candidates["candidate"].tolist() == [2, 5] * 40
    assert set(candidates["pdg"]) == {321}
    number = candidates["candidate"][hits["candidate"]]
    assert set(hits["view"][number == 2]) == {HIT_X, HIT_V, HIT_WIRE}
    assert set(hits["view"][number == 5]) == {HIT_XV}
    assert 1 not in clusters["layer"][hits["hit"][(number == 2) & (hits["view"] != HIT_WIRE)]]
    same_label = cg.label_candidates(clusters, wires, np.zeros(len(clusters), int), np.full(len(wires), -1))
    assert HIT_XV not in same_label["candidate_hits"]["view"]


def test_wrong_labels(result):
    """All problems at once."""
    with pytest.raises(
        ValueError, match=r"(?s)cluster_label: got shape \(3,\).*wire_label: got .*float64.*is: got 'm'"
    ):
        cg.label_candidates(result.clusters, result.wire_hits, [1, 2, 3], np.zeros(len(result.wire_hits)), "m")


# ----- checks of what is measured


def test_every_problem_is_listed_with_its_row(result):
    """Wrong numbers of hits, hits given twice, of another event, not there, of the wrong kind: one message."""
    tables = tables_of(result)
    clusters, wires, hits = (tables[name] for name in ("clusters", "wire_hits", "candidate_hits"))
    on_x, on_wire = (np.flatnonzero(hits["view"] == view) for view in (HIT_X, HIT_WIRE))
    x, w = hits["hit"][on_x[:3]], hits["hit"][on_wire[:5]]
    changed = {name: clusters[name].copy() for name in ("x", "err_x", "size", "layer")}
    changed["x"][x[0]], changed["err_x"][x[1]], changed["size"][x[1]], changed["layer"][x[2]] = np.nan, 0.0, -1, 3
    wire = {name: wires[name].copy() for name in ("wire", "layer", "sigma", "side", "drift")}
    wire["wire"][w[0]], wire["layer"][w[1]], wire["sigma"][w[2]], wire["side"][w[3]] = 100_000, 1, np.inf, 2
    wire["drift"][w[4]], wire["side"][w[4]] = -3.0, 1
    row, event, candidate, view = (hits[name].copy() for name in ("hit", "event", "candidate", "view"))
    row[on_wire[6]] = row[on_wire[5]]
    row[on_wire[-1]] = row[on_wire[7]]
    candidate[on_wire[9]], row[on_wire[10]], view[on_x[4]], view[on_x[5]] = 80, len(wires), HIT_V, 7
    tables |= {"clusters": clusters.with_columns(**changed), "wire_hits": wires.with_columns(**wire)}
    tables["candidate_hits"] = hits.with_columns(hit=row, event=event, candidate=candidate, view=view)
    with pytest.raises(ValueError, match="hits of candidates") as error:
        fit.unchecked(DETECTOR, *tables.values())
    text = str(error.value)
    expected = [
        f"clusters row {x[0]}: x: got nan, expected a finite number, mm",
        f"clusters row {x[1]}: err_x: got 0, expected a finite number above 0, mm",
        f"clusters row {x[1]}: size: got -1, expected 0 or more strips",
        f"clusters row {x[2]}: layer: got 3, expected a CGEM layer of the detector",
        f"wire_hits row {w[0]}: wire: got 100000, expected 0 to ",
        f"wire_hits row {w[1]}: layer: got 1, expected the number of a wire layer of the detector",
        f"wire_hits row {w[2]}: sigma: got inf, expected a finite number above 0, mm",
        f"wire_hits row {w[3]}: side: got 2, expected -1, 0 (unknown) or 1",
        f"wire_hits row {w[4]}: drift: got -3, expected none so far below 0 on a known side",
        f"candidates row 0: got wire_hits row {row[on_wire[5]]} twice, expected once",
        f"candidate_hits row {on_wire[-1]}: event: got 39, expected that of wire_hits row {row[on_wire[7]]}, 0",
        f"candidate_hits row {on_wire[9]}: candidate: got 80, expected 0 to 80 (excluded), rows of candidates",
        f"candidate_hits row {on_wire[10]}: hit: got {len(wires)}, expected 0 to {len(wires)} (excluded), rows of wire",
        f"candidate_hits row {on_x[4]}: view: got 1, expected that of clusters row {row[on_x[4]]}, whose view is 0",
        f"candidate_hits row {on_x[5]}: view: got 7, expected 0 (X), 1 (V), 2 (wire) or 3 (XV cluster)",
    ]
    assert [line for line in expected if line not in text] == []


def test_measurements_alone_are_checked_too(result):
    """Also where nothing is wrong with candidates; a thousand problems make no message of a thousand lines."""
    tables = tables_of(result)
    tables["wire_hits"] = result.wire_hits.with_columns(sigma=np.zeros(len(result.wire_hits)))
    with pytest.raises(ValueError, match=r"wire_hits row 0: sigma: got 0, expected") as error:
        fitted(tables)
    lines = str(error.value).splitlines()
    assert lines[-1] == f"  and {len(result.wire_hits) - 50} more"


def test_masses_and_starts_are_checked(result):
    """A mass that is none, and helices that do not fit the candidates."""
    tables = tables_of(result)
    mass = result.candidates["mass"].copy()
    mass[3] = np.nan
    tables["candidates"] = result.candidates.with_columns(mass=mass)
    with pytest.raises(ValueError, match="candidates row 3: mass: got nan, expected a number from 0 to 1e"):
        fitted(tables)
    for start, message in (
        (np.zeros((3, 5)), r"got shape \(3, 5\), expected \(80, 5\)"),
        (np.full((80, 5), np.nan), "row 0"),
    ):
        with pytest.raises(ValueError, match=f"start: .*{message}"):
            fit(DETECTOR, *tables_of(result).values(), start=start)


def test_a_candidate_of_an_event_has_hits_of_that_event(result):
    """A candidate whose event is not that of its hits is named."""
    tables = tables_of(result)
    event = result.candidates["event"].copy()
    event[-2:] -= 1
    tables["candidates"] = result.candidates.with_columns(event=event)
    with pytest.raises(
        ValueError, match=r"candidate_hits row \d+: candidate: got 78, expected a row of candidates, of the same event"
    ):
        fitted(tables)


def test_columns_of_the_compiled_fit_are_checked(result):
    """Given directly: broken offsets, hits from the outside inward, and numbers that are none."""
    hits = collect_hits(DETECTOR, *list(tables_of(result).values())[2:], result.clusters, result.wire_hits)
    arguments = {
        "mass": result.candidates["mass"], "start": np.empty((0, 5)), "residuals": False,
        "settings": {
            "max_iterations": 5, "tolerance": 0.1, "errors_from_track": True, "least_width": 0.1, "delta_strips": 0.0,
            "kinks": False, "outlier_pull": 0.0, "momentum": 1.0, "prior_sigma": (200.0, 0.5, 5.0, 1000.0, 2.0),
            "beam": (0.0, 0.0),
        },
    }  # fmt: skip

    def run(offsets=hits.hit_offsets, **columns):
        return _core.reconstruction.fit(
            tuned(DETECTOR), hit_offsets=offsets, hits=hits.columns() | columns, **arguments
        )

    assert np.all(run()["status"] == 0)
    for offsets in (hits.hit_offsets + 1, hits.hit_offsets[::-1].copy()):
        with pytest.raises(ValueError, match="hit_offsets: expected to"):
            run(offsets)
    last = hits.hit_offsets[1] - 1
    order = np.arange(len(hits.kind))
    order[[0, last]] = order[[last, 0]]
    with pytest.raises(ValueError, match="track 0: hit 1 lies inside the one before"):
        run(**{name: column[order] for name, column in hits.columns().items()})
    sigma = hits.sigma.copy()
    sigma[4] = -1
    with pytest.raises(ValueError, match=f"row {hits.hit[4]}: err_.: got -1"):
        run(sigma=sigma)


def test_points_beside_their_strips_are_refused(result):
    """An XV cluster and the X cluster that it is made of measure the same."""
    points = np.flatnonzero(result.clusters["view"] == 2)
    first = result.clusters["x_cluster"][points[0]]
    columns = {"event": [0, 0], "candidate": [0, 0], "view": [HIT_X, HIT_XV], "hit": [first, points[0]]}
    hits = Table("candidate_hits", columns, 40)
    with pytest.raises(ValueError, match=f"row 0: got clusters row {points[0]}, an XV cluster, and row {first}"):
        fit(DETECTOR, result.clusters, result.wire_hits, result.candidates, hits)


# ----- matching


def matched(result, hits, tracks=None):
    """Return the matches of some hits of the run's candidates."""
    names = ("clusters", "wire_hits", "particles", "truths", "wire_truths")
    tables = [result.tables[name] for name in names]
    tracks = fit(DETECTOR, *tables[:2], result.candidates, hits)["tracks"] if tracks is None else tracks
    return match(tracks, result.candidates, hits, *tables, detector=DETECTOR)["matches"]


def test_matches_of_pure_candidates(result):
    """By truth each track is of its own particle, with all of its hits but clusters that delta electrons made."""
    matches = result.matches
    assert matches["particle"].tolist() == [0, 1] * 40
    assert np.all(matches["purity"] == 1)
    assert 0.97 < matches["efficiency"].mean() < 1
    truth = cg.helix.at_origin(result.particles, DETECTOR.field.bz)
    np.testing.assert_array_equal(matches["truth_kappa"], truth[:, 2])
    np.testing.assert_array_equal(matches["res_dr"], result.fitted["dr"] - truth[:, 0])
    np.testing.assert_array_equal(result.tracks["pull_dr"], matches["res_dr"] / result.fitted["err_dr"])
    assert joined(result.fitted, matches) == result.tracks


def test_rows_that_are_not_there_are_listed(result):
    """Tracks and hits that count rows beyond the tables, or before them, are refused all at once."""
    hits = {name: result.candidate_hits[name].copy() for name in ("candidate", "view", "hit")}
    hits["candidate"][:2] = 99, -1
    wire = np.flatnonzero(hits["view"] == HIT_WIRE)[0]
    hits["hit"][[3, wire]] = -1, 10**6
    candidate = result.fitted["candidate"].copy()
    candidate[5] = 80
    with pytest.raises(ValueError, match="match:") as error:
        matched(result, result.candidate_hits.with_columns(**hits), result.fitted.with_columns(candidate=candidate))
    assert [line.strip() for line in str(error.value).splitlines()[1:]] == [
        "tracks row 5: candidate: got 80, expected a row of candidates, of the same event",
        "candidate_hits row 0: candidate: got 99, expected a row of candidates, of the same event (2 such rows)",
        "candidate_hits row 3: hit: got -1, expected a row of clusters, of the same event",
        f"candidate_hits row {wire}: hit: got 1000000, expected a row of wire_hits, of the same event",
    ]
    hits["view"][2] = 9
    with pytest.raises(ValueError, match="candidate_hits row 2: view: got 9, expected a whole number from 0 to 3"):
        matched(result, result.candidate_hits.with_columns(**hits), result.fitted)


def test_most_hits_decide(result):
    """Hits of both particles of an event: the larger part names the particle; of equal parts the first one."""
    hits = result.candidate_hits
    mine = [np.flatnonzero((hits["candidate"] == i) & (hits["view"] == HIT_WIRE)) for i in (0, 1)]
    for parts, particle, purity in (((12, 4), 0, 0.75), ((4, 12), 1, 0.75), ((8, 8), 0, 0.5)):
        rows = np.concatenate([which[:n] for which, n in zip(mine, parts, strict=True)])
        some = hits[rows].with_columns(candidate=np.zeros(16, int))
        matches = matched(result, some)
        assert matches["particle"][0] == particle
        assert matches["purity"][0] == purity
        left = np.sum(result.candidate_hits["candidate"] == particle)
        assert matches["efficiency"][0] == pytest.approx(max(parts) / left, rel=0.1)
        assert matches["particle"][1] == -1
        assert np.isnan(matches["purity"][1])
        assert np.isnan(matches["truth_p"][1])


def test_noise_is_nobodys(result):
    """Hits without a truth count against the purity, and name no particle."""
    hits = result.candidate_hits
    wire_truth = result.wire_hits["wire_truth"].copy()
    first = hits["hit"][(hits["candidate"] == 0) & (hits["view"] == HIT_WIRE)]
    wire_truth[first[:10]] = -1
    tables = dict(result.tables) | {"wire_hits": result.wire_hits.with_columns(wire_truth=wire_truth)}
    order = ("tracks", "candidates", "candidate_hits", "clusters", "wire_hits", "particles", "truths", "wire_truths")
    matches = match(*(tables[name] for name in order), detector=DETECTOR)["matches"]
    n = np.sum(hits["candidate"] == 0)
    assert matches["particle"][0] == 0
    assert matches["purity"][0] == (n - 10) / n
    only = hits[(hits["candidate"] == 0) & np.isin(hits["hit"], first[:10]) & (hits["view"] == HIT_WIRE)]
    tables["candidate_hits"] = only
    matches = match(*(tables[name] for name in order), detector=DETECTOR)["matches"]
    assert (matches["particle"][0], matches["purity"][0]) == (-1, 0)


def test_hypotheses_share_their_candidate(result):
    """Each mass has a track, matched with the same particle."""
    tables = tables_of(result)
    tracks = fit(DETECTOR, *tables.values(), cg.FitSettings(hypothesis=("pi", "K")))["tracks"]
    assert tracks["candidate"].tolist() == np.repeat(np.arange(80), 2).tolist()
    matches = matched(result, result.candidate_hits, tracks)
    assert matches["particle"].tolist() == [0, 0, 1, 1] * 40
    start = np.stack([result.fitted[name] for name in cg.helix.PARAMETERS], axis=1)
    again = fit(DETECTOR, *tables.values(), cg.FitSettings(hypothesis=("mu", "pi")), start=start)["tracks"]
    assert again["iterations"].max() < result.fitted["iterations"].max() + 3
    assert np.all(again["status"] == 0)
