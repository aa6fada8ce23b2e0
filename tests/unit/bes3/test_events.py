"""Events of the BESIII software: simulated events in the layout of pybes3 come back, and its faults are repaired."""

import awkward as ak
import numpy as np
import pytest

import bes3_layout
import cgemit as cg
from cgemit import helix
from cgemit.bes3 import events as bes3_events
from cgemit.bes3.events import CLUSTER_ERRORS, columns_of_events, read_events
from cgemit.bes3.refit import refit
from cgemit.reconstruction.fit import fit

BZ = -1.0


@pytest.fixture(scope="module")
def run():
    settings = cg.Settings(digitize=cg.DigitizeSettings(reveal_sides=True), simulate=cg.SimulateSettings(decays=False))
    gun = cg.Gun("pi+", p=(0.3, 1.0), cos_theta=(-0.8, 0.8))
    return cg.run("besiii-cgem", gun, n=30, seed=3, settings=settings, readout="gaussian")


@pytest.fixture(scope="module")
def arrays(run):
    return bes3_layout.events_of(run)


@pytest.fixture(scope="module")
def events(arrays):
    return bes3_layout.tables_of(arrays, "besiii-cgem")


@pytest.mark.parametrize("name", ["wire_hits", "clusters", "particles", "truths", "wire_truths"])
def test_tables_come_back(run, events, name):
    ours, back = getattr(run, name), getattr(events, name)
    known = {
        "wire_hits": ("layer", "wire", "gid", "sigma", "drift_time"),
        "clusters": ("layer", "sheet", "view", "x", "v", "phi", "z", "r", "x_cluster", "v_cluster"),
        "particles": ("particle", "pdg", "charge", "mass", "x", "y", "z", "px", "py", "pz"),
        "truths": ("particle", "layer", "r", "entry_x", "exit_z", "energy"),
        "wire_truths": ("particle", "layer", "wire", "doca", "side", "x", "y", "z"),
    }[name]
    assert len(back) == len(ours) > 0
    assert np.array_equal(back["event"], ours["event"])
    for column in known:
        np.testing.assert_allclose(back[column], ours[column], rtol=1e-12, atol=1e-9, err_msg=column)


def test_distances_and_sides_come_back(run, events):
    signed = [of["side"] * of["drift"] for of in (run.wire_hits, events.wire_hits)]
    np.testing.assert_allclose(*signed, rtol=1e-12)
    assert (signed[0] != 0).all()


def test_digis_come_back():
    run = cg.run("besiii-cgem", cg.Gun("pi+", p=1, cos_theta=(-0.8, 0.8)), n=5, seed=1)
    back = bes3_layout.tables_of(bes3_layout.events_of(run), "besiii-cgem").digis
    for column in ("event", "layer", "sheet", "view", "strip", "gid", "charge", "time"):
        np.testing.assert_allclose(back[column], run.digis[column], rtol=1e-12, err_msg=column)
    assert len(back) > 50


def test_crossings_of_a_gap_have_their_middle(run, events):
    ours, back = run.truths, events.truths
    turn = np.remainder(back["phi"] - ours["phi"] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(turn * ours["r"]).max() < 0.02  # mm: the chord instead of the arc
    assert np.abs(back["z"] - ours["z"]).max() < 0.05
    np.testing.assert_allclose(back["px"], ours["px"], atol=2e-3)  # GeV/c
    assert (np.abs(back["path"] / ours["path"] - 1) < 0.01).all()


@pytest.mark.parametrize("kind", ["kal_tracks", "mdc_tracks"])
def test_tracks_come_back(run, events, kind):
    back = getattr(events, kind)
    ours = run.tracks if kind == "mdc_tracks" else run.tracks[np.repeat(np.arange(len(run.tracks)), 5)]
    for name in (*helix.PARAMETERS, "p", "chi2", "ndf", "cov", "err_dr", "err_p", "n_wires", "n_clusters"):
        np.testing.assert_allclose(back[name], ours[name], rtol=1e-9, atol=1e-12, err_msg=name)
    expected = [11, 13, 211, 321, 2212] if kind == "kal_tracks" else [0]
    assert back["hypothesis"].tolist() == expected * len(run.tracks)
    assert (back["status"] == 0).all()


def test_the_refit_is_the_direct_fit(run, events):
    """Simulate, write as the experiment, read, fit: the same as fitting what was simulated, with the same errors."""
    clusters = run.clusters
    known = {
        f"err_{one}": np.where(np.isnan(clusters[one]), np.nan, error)
        for one, error in zip("xv", CLUSTER_ERRORS, strict=True)
    }
    settings = cg.FitSettings(hypothesis="pi")
    direct = fit(
        run.detector, clusters.with_columns(**known), run.wire_hits, run.candidates, run.candidate_hits, settings
    )
    again = refit(events, "kal", settings)
    assert (again.ours["status"] == 0).all()
    fitted = direct["tracks"]
    for name in (*helix.PARAMETERS, "p"):
        error, theirs = fitted[f"err_{name}"], run.tracks[f"err_{name}"]
        assert np.abs((again.ours[name] - fitted[name]) / error).max() < 1e-3  # a fit settles within 0.1
        np.testing.assert_allclose(again.ours[f"err_{name}"], error, rtol=1e-3)
        diff = again.ours[name] - run.tracks[name]
        np.testing.assert_allclose(again.columns[f"diff_{name}"], diff, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(again.columns[f"pull_{name}"], diff / theirs, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(again.columns[f"truth_{name}"], run.matches[f"truth_{name}"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.ours["chi2"], fitted["chi2"], rtol=1e-4)
    assert np.array_equal(again.ours["ndf"], fitted["ndf"])


def test_the_first_fit_is_without_matter(events):
    """What the experiment's first fit knows: the same hits, no scattering, no loss."""
    found = refit(events, "mdc")
    with_matter = refit(events, "kal", cg.FitSettings(hypothesis="pi"))
    by_hand = fit(
        events.detector, events.clusters, events.wire_hits, events.candidates, events.candidate_hits,
        cg.FitSettings(matter=False, hypothesis="e"),
    )["tracks"]  # fmt: skip
    assert np.abs((found.ours["dr"] - by_hand["dr"]) / by_hand["err_dr"]).max() < 0.05  # the mass does not matter
    assert np.median(found.ours["err_dr"] / with_matter.ours["err_dr"]) < 0.7
    assert found.ours["p"].mean() < with_matter.ours["p"].mean()  # which adds what was lost


def test_records_of_clusters_are_shifted_back():
    """A record of a public file: X and V of the same point, and the numbers of its X and V cluster."""
    given = {
        "m_flag": np.array([0, 1, 2]), "m_recphi": np.array([2.16, -99.0, 2.16]),
        "m_recpositiony": np.array([-99.0, 423.58, 423.58]), "m_recv": np.array([-99.0, -99.0, 134.04]),
        "m_recZ": np.array([[2, -1], [2, -1], [2, 0]], ">i4").view(">f8")[:, 0],
        "m_clusterflag": np.array([[-1, 4], [-1, 4], [1, 4]]),
    }  # fmt: skip
    back = bes3_events.clusters(given)
    assert "m_recpositiony" not in back
    assert back["m_recv"].tolist() == [-99.0, 423.58, 423.58]
    assert back["m_recZ"].tolist() == [-99.0, -99.0, 134.04]
    assert back["m_clusterflag"].tolist() == [[-1, -1], [-1, -1], [0, 1]]
    right = {**given, "m_recZ": np.array([-99.0, -99.0, 134.04]), "m_clusterflag": back["m_clusterflag"]}
    assert bes3_events.clusters(right) is right  # a record that has the field, and one without
    for name, number in (("m_recZ", np.array([[2, -1], [3, -1], [2, 0]], ">i4").view(">f8")[:, 0]),
                         ("m_clusterflag", np.array([[-1, 4], [-1, 3], [1, 4]]))):  # fmt: skip
        other = given | {name: number}
        assert bes3_events.clusters(other) is other  # one of the two lengths is another number
    short = {name: one for name, one in right.items() if name != "m_recpositiony"}
    assert bes3_events.clusters(short) is short


def test_covariances_of_the_first_fit_are_put_in_order(run):
    cov = run.tracks["cov"]
    mixed = bes3_layout.as_pybes3_fills(cov)
    assert np.linalg.eigvalsh(mixed).min() < 0
    np.testing.assert_array_equal(bes3_events.upper_triangles(mixed), cov)
    np.testing.assert_array_equal(bes3_events.upper_triangles(cov), cov)  # once pybes3 does it right


@pytest.mark.parametrize("charge", [-1, 1])
def test_another_pivot(charge):
    """The same circle for both charges; pybes3 0.5 takes the radius without its sign, right for one of them only."""
    import pybes3

    given = np.array([1.2, 0.7, charge / 0.4, 3.0, 0.5])
    pivot = np.array([5.0, -8.0, 2.0])
    moved, _ = helix.change_pivot(given, np.eye(5), np.zeros(3), pivot, BZ)
    radius = helix.RADIUS_PER_KAPPA / (BZ * given[2])

    def centre(parameters, point):
        return point[:2] + (parameters[0] + radius) * np.array([np.cos(parameters[1]), np.sin(parameters[1])])

    np.testing.assert_allclose(centre(moved, pivot), centre(given, np.zeros(3)), atol=1e-9)
    if charge < 0:
        theirs = pybes3.helix_obj(*(given * bes3_layout.CM)).change_pivot(*(0.1 * pivot))
        np.testing.assert_allclose([theirs.dr, theirs.dz], 0.1 * moved[[0, 3]], atol=1e-4)


@pytest.mark.parametrize(("flag", "side"), [(0, 1), (1, -1), (2, 0)])
def test_sides_and_distances(arrays, flag, side):
    hits = arrays["hits"][:1][:, :1]
    given = {name: ak.Array([[value]]) for name, value in (("m_lr", flag), ("m_ddl", -0.2), ("m_ddr", 0.4))}
    for name, value in given.items():
        hits = ak.with_field(hits, value, name)
    found = columns_of_events({"hits": hits})["wire_hits"]
    assert found["side"].tolist() == [side]
    assert found["drift"] == pytest.approx([{1: 2.0, -1: 4.0, 0: 3.0}[side]])  # mm


def test_all_clusters_of_events_with_one_track(run, arrays):
    free = ak.with_field(arrays["clusters"], -1 + 0 * arrays["clusters"]["m_trkid"], "m_trkid")
    none = bes3_layout.tables_of(arrays | {"clusters": free}, "besiii-cgem")
    every = bes3_layout.tables_of(arrays | {"clusters": free}, "besiii-cgem", every_cluster=True)
    assert (none.candidate_hits["view"] == 2).all()
    points = np.count_nonzero(run.clusters["view"] == 2)
    assert np.count_nonzero(every.candidate_hits["view"] == 3) == points
    assert np.median(refit(every).ours["err_dz"] / refit(none).ours["err_dz"]) < 0.3


def test_fits_of_the_experiment_that_failed(run, arrays):
    """No covariance, or none that is one: the row stays, with a status."""
    changed = {"kal_tracks": {"m_stat": 1, "m_zerror": 0.0}, "mdc_tracks": {"m_err": np.nan}}
    for collection, values in changed.items():
        lists = arrays[collection]
        for name, value in values.items():
            column = ak.to_numpy(ak.flatten(lists[name])).copy()
            column[0] = value
            lists = ak.with_field(lists, ak.unflatten(column, ak.num(lists)), name)
        arrays = {**arrays, collection: lists}
    events = bes3_layout.tables_of(arrays, "besiii-cgem")
    assert (events.kal_tracks["status"][:5] == cg.FitStatus.not_converged).all()
    found = refit(events, "kal", cg.FitSettings(hypothesis="pi"))
    assert found.good.tolist() == [False] + [True] * (len(run.tracks) - 1)
    assert np.isfinite([value for name, value in found.summary()["dr"].items() if name != "unit"]).all()
    assert np.isnan(events.mdc_tracks["err_dr"][0])
    np.testing.assert_allclose(events.mdc_tracks["cov"][1:], run.tracks["cov"][1:], rtol=1e-9)


def test_a_missing_field(arrays):
    hits = arrays["hits"][[name for name in arrays["hits"].fields if name != "m_lr"]]
    with pytest.raises(ValueError, match="TRecEvent/m_recMdcHitCol: has no field 'm_lr'"):
        bes3_layout.tables_of(arrays | {"hits": hits}, "besiii-cgem")


def test_event_numbers(events):
    assert events.run.tolist() == [-9989] * 30
    assert events.number.tolist() == list(range(100, 130))
    assert refit(events).columns["number"].tolist() == [100 + event for event in refit(events).columns["event"]]


def test_bad_input(arrays, tmp_path):
    with pytest.raises(ValueError, match=r"wire_hits: got layers .*expected those of besiii-idc") as refused:
        bes3_layout.tables_of(arrays | {"hits": _other_layer(arrays["hits"])}, "besiii-idc", errors=(0.1, 0.0))
    text = str(refused.value)
    assert "clusters: got layers 0, 1, 2; expected those of besiii-idc: no such layer" in text
    assert "errors: got (0.1, 0.0)" in text
    with pytest.raises(ValueError, match=r"expected one of \.rec: .*; \.dst: .*; \.rtraw: .*; \.raw: digis"):
        read_events(tmp_path / "x.root", "besiii-cgem")
    with pytest.raises(FileNotFoundError):
        read_events(tmp_path / "x.rec", "besiii-cgem")
    (tmp_path / "x.rec").write_bytes(b"root" + bytes(1000))
    with pytest.raises(ValueError, match="not a complete file of the BESIII software"):
        read_events(tmp_path / "x.rec", "besiii-cgem")
    with pytest.raises(ValueError, match="kind: got 'dst'"):
        refit(bes3_layout.tables_of(arrays, "besiii-cgem"), "dst")
    hitless = bes3_layout.tables_of(
        {name: one for name, one in arrays.items() if name not in ("hits", "clusters")}, "besiii-cgem"
    )
    assert (hitless.kal_tracks["candidate"] == -1).all()
    with pytest.raises(ValueError, match="got 0 sets of hits and 150"):
        refit(hitless)


def _other_layer(hits):
    return ak.with_field(hits, hits["m_mdcid"] | (0x3F << 9), "m_mdcid")
