"""The covariance without events against independent linear algebra, and the properties of its budget."""

from __future__ import annotations

import dataclasses
import math
import sys
import warnings
from typing import Any

import numpy as np
import pytest
from scipy.special import erf

import cgemit as cg
from cgemit import _core, isa
from cgemit.analysis.quantities import QUANTITIES
from cgemit.analysis.widths import SECOND_INSIDE, measure
from cgemit.covariance.result import sources
from cgemit.covariance.tracks import core_width, status_of
from cgemit.detector import slabs
from cgemit.detector.readouts import READOUTS
from cgemit.fit_matter import tuned
from cgemit.reconstruction.fit import compiled_for_fit
from fields import HARMONIC
from variants import varied

DESIGN, CHAMBER = cg.load("besiii-cgem-design"), cg.load("besiii-idc")
#: A beam pipe of 65 mm of beryllium: a track is also displaced inside it, by half as much as by its angle behind it.
THICK = DESIGN.with_overrides(
    {"remove": [f"beam_pipe.{name}" for name in ("gold", "inner-be", "coolant")]}
    | {"beam_pipe.outer-be.r_in": "5 mm", "beam_pipe.outer-be.r_out": "70 mm"}
)


def noiseless(detector: cg.Detector, p: float, cos_theta: float, phi: float, particle: str = "mu-") -> cg.Result:
    """One track on its reference trajectory, with its hits."""
    gun = cg.Gun(particle, p=p, cos_theta=cos_theta, phi=phi)
    settings = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="off"),
        digitize=cg.DigitizeSettings(reveal_sides=True),
    )
    return cg.run(detector, gun, n=1, seed=1, settings=settings, readout=cg.GaussianReadout(sigma_x=1e-7, sigma_v=1e-7))


@pytest.mark.parametrize(("detector", "p", "cos_theta", "phi"), [
    (DESIGN, 1.0, 0.0, 0.3), (DESIGN, 0.4, 0.6, -2.0), (CHAMBER, 0.7, -0.5, 1.0),
])  # fmt: skip
def test_hits_are_those_of_the_simulation(detector: cg.Detector, p: float, cos_theta: float, phi: float) -> None:
    result = noiseless(detector, p, cos_theta, phi)
    found = cg.analytic(detector, "mu-", p, cos_theta, phi=phi, readout="gaussian", reveal_sides=True)
    wires = len(result.wire_hits)
    assert found.n_wires == wires
    assert found.n_clusters == len(result.candidate_hits) - wires


@pytest.mark.parametrize(("detector", "p", "cos_theta", "phi"), [
    (DESIGN, 1.0, 0.0, 0.3), (DESIGN, 0.4, 0.6, -2.0), (CHAMBER, 0.7, -0.5, 1.0), (THICK, 0.8, 0.4, 1.0),
])  # fmt: skip
def test_covariance_is_that_of_the_fit(detector: cg.Detector, p: float, cos_theta: float, phi: float) -> None:
    """A fit of the same hits, started on the track, has the same covariance (its later priors cost up to 1e-3)."""
    gun = cg.Gun("mu-", p=p, cos_theta=cos_theta, phi=phi)
    settings = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="off"),
        digitize=cg.DigitizeSettings(reveal_sides=True),
        fit=cg.FitSettings(outlier_pull=0, kinks=False),
    )
    result = cg.run(detector, gun, n=200, seed=3, settings=settings, readout="gaussian")
    mean = result.fitted["cov"][result.fitted["status"] == 0].mean(axis=0)
    found = cg.analytic(detector, "mu-", p, cos_theta, phi=phi, readout="gaussian", reveal_sides=True)
    scale = np.sqrt(np.diagonal(mean))
    assert np.abs((found.cov - mean) / np.outer(scale, scale)).max() < 0.01


@pytest.mark.parametrize(("gap", "threshold"), [(0.1, 1.7), (0.3, 1.7), (1.0, 1.7), (1.0, 8.0), (5.0, 1.7)])
def test_thin_gaps_lose_hits_as_in_the_simulation(gap: float, threshold: float) -> None:
    """Without enough electrons there is no cluster of either view; a position needs none."""
    detector = DESIGN.with_overrides({"cgem.*.drift_gap": f"{gap} mm"})
    readout, n = cg.BinaryReadout(threshold=threshold), 4096
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = cg.analytic(detector, "mu-", 1.0, (-0.5, 0.5), readout=readout, samples=n)
        made = cg.run(detector, cg.Gun("mu-", p=1.0, cos_theta=(-0.5, 0.5)), n, 2, readout=readout, until="cluster")
    assert len(caught) == (2 if gap < 5 else 0)
    for one in caught:
        assert "crossings without clusters of readout binary, for lack of ionization: L1" in str(one.message)
    every = cg.analytic(detector, "mu-", 1.0, (-0.5, 0.5), readout="gaussian", samples=n)
    expected = float(found.n_clusters / every.n_clusters)
    x = made.clusters[made.clusters["view"] == 0]
    seen = len(np.unique(x["truth"])) / len(made.truths)
    error = math.sqrt(expected * (1 - expected) * 2 / len(made.truths))
    assert abs(seen - expected) <= 4 * error + 2e-3  # seams and ends: 0.0015 of the crossings
    assert float(every.n_clusters) > 5.95
    assert (expected < 0.35) == (gap == 0.1)


# In the beam pipe, in a cathode, in a gap, between wires and outside the last of them.
RADII = (20.0, 32.5, 78.84, 121.0, 171.0, 500.0, 900.0)


def test_text_names_the_status_of_points_without_a_covariance() -> None:
    found = cg.analytic(DESIGN, "mu-", [0.03, 1.0], 0.0, samples=2)
    assert found.status.tolist() == [cg.FitStatus.stopped, 0]
    _, stopped, good = repr(found).splitlines()
    assert stopped.endswith("sigma(p) nan MeV/c [stopped]")
    assert good.endswith(f"sigma(p) {found.sigma_p[1]:.4g} MeV/c>")


@pytest.mark.parametrize("field", [None, HARMONIC])
def test_covariance_at_a_radius_is_that_of_the_states_of_the_fit(field: object) -> None:
    """States of fits of hits on one track, with their own variances, at the same cylinders."""
    detector = DESIGN if field is None else DESIGN.with_field(field)
    settings = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="off"),
        digitize=cg.DigitizeSettings(reveal_sides=True),
        fit=cg.FitSettings(outlier_pull=0, kinks=False, states=RADII),
    )
    gun = cg.Gun("mu-", p=0.5, cos_theta=0.3, phi=0.4)
    states = cg.run(detector, gun, n=100, seed=3, settings=settings, readout="gaussian").states
    how = {"phi": 0.4, "readout": "gaussian", "reveal_sides": True}
    found = cg.analytic(detector, "mu-", 0.5, 0.3, radius=list(RADII), **how)
    assert found.cov.shape == (len(RADII), 5, 5)
    for radius, cov in zip(RADII, found.cov, strict=True):
        mean = states["cov"][states["r"] == radius].mean(axis=0)
        scale = np.sqrt(np.diagonal(mean))
        assert np.abs((cov - mean) / np.outer(scale, scale)).max() < 0.01, radius
    # A cylinder on the other side of a wall has another covariance.
    near = cg.analytic(detector, "mu-", 0.5, 0.3, radius=[31.48, 33.71], **how)
    assert near.sigma_phi0[1] < 0.85 * near.sigma_phi0[0]


def test_a_small_cylinder_is_the_origin() -> None:
    """Without matter between, the covariance is that of the origin, seen from the point of the track."""
    for readout in ("gaussian", "binary"):
        origin = cg.analytic(DESIGN, "pi+", [0.3, 1.0], 0.5, readout=readout, samples=8)
        small = cg.analytic(DESIGN, "pi+", [0.3, 1.0], 0.5, readout=readout, samples=8, radius="1 um")
        np.testing.assert_allclose(small.variances("p"), origin.variances("p"), rtol=1e-6)
        np.testing.assert_allclose(small.cov, origin.cov, rtol=1e-3)


def test_near_the_ends_the_samples_scatter() -> None:
    """There, hits differ from sample to sample; elsewhere and for one track the trajectory is the expected one."""
    how = {"phi": 0.3, "readout": "gaussian"}
    one = cg.analytic(DESIGN, "K+", 0.8, 0.9, **how)
    many = cg.analytic(DESIGN, "K+", 0.8, 0.9, samples=256, **how)
    assert not one._tracks.scatters.any()
    assert many._tracks.scatters.all()
    # The expected trajectory has one number of wires; scattered ones leave earlier and later.
    wires = many._tracks.run(budget=False)["n_wires"]
    assert wires.min() < one.n_wires - 1
    assert wires.max() > one.n_wires + 1
    assert float(many.rms("p")) > 1.01 * float(one.rms("p"))
    middle = cg.analytic(DESIGN, "K+", 0.8, [0.0, -0.6], samples=4, **how)
    assert not middle._tracks.scatters.any()
    np.testing.assert_allclose(many.budget("p").total, many.rms("p") ** 2, rtol=1e-10)


def test_what_a_radius_cannot_have() -> None:
    lost = cg.analytic(DESIGN, "mu-", 0.1, 0.0, radius=[100.0, 760.0], phi=0.0, samples=2)
    assert list(lost.status) == [0, cg.FitStatus.does_not_reach]
    assert np.isnan(lost.sigma_p[1])
    with pytest.raises(ValueError, match="budget: got covariances at a radius"):
        lost.budget("p")
    with pytest.raises(ValueError, match="sensitivity: got covariances at a radius"):
        cg.sensitivity(DESIGN, "mu-", 1.0, keys=["field.bz"], radius=100.0, samples=2)
    with pytest.raises(ValueError, match=r"radius: got .*, expected positive lengths"):
        cg.analytic(DESIGN, "mu-", 1.0, radius=-1.0)


@pytest.mark.parametrize("field", [None, HARMONIC])
@pytest.mark.parametrize(("readout", "samples"), [("binary", 16), ("gaussian", 20)])
def test_budget_sums_to_the_variance(field: object, readout: str, samples: int) -> None:
    detector = DESIGN if field is None else DESIGN.with_field(field)
    found = cg.analytic(detector, "pi+", [0.3, 1.0], [[0.0], [0.7]], readout=readout, samples=samples)
    for quantity in QUANTITIES:
        budget = found.budget(quantity)
        assert budget.variances.shape == (2, 2, len(sources(detector)))
        assert np.all(budget.variances >= 0)
        np.testing.assert_allclose(budget.total, found.rms(quantity) ** 2, rtol=1e-10)
        for by in ("part", "material", "cause", "source"):
            np.testing.assert_allclose(sum(budget.grouped(by).values()), budget.total, rtol=1e-10)


def test_the_printed_budget_is_that_of_the_table() -> None:
    budget = cg.analytic(DESIGN, "mu-", [0.3, 1.0], 0.0, samples=4).budget("dr")
    groups, total = budget.grouped("part"), np.asarray(budget.total)
    parts = budget._parts()
    lines = repr(budget).splitlines()[2:]
    assert len(lines) == 2 * 9
    for line in lines:
        p, *words, sigma, percent = line.removesuffix("%").split()
        point, part = budget.p.tolist().index(float(p)), " ".join(words)
        rest = sum(sorted(one[point] for one in parts.values())[:-8])
        variance = rest if words[0] == "other" else parts[part][point]
        assert float(sigma) == pytest.approx(math.sqrt(variance), rel=1e-3)
        assert float(percent) == pytest.approx(100 * variance / total[point], abs=0.051)
    table = budget.table("part")
    np.testing.assert_allclose(table["share"], table["variance"] / np.repeat(total, len(groups)), rtol=1e-12)
    np.testing.assert_allclose(table["sigma"] ** 2, table["variance"], rtol=1e-12)


def test_materials_share_a_term_by_what_causes_it() -> None:
    """Scattering by thickness in radiation lengths, straggling by electrons: Z/A times mass of an area."""
    weights = {"scattering": lambda one, t: t / one.x0, "straggling": lambda one, t: t * one.density * one.z_over_a}
    every = {slab.shells[0]: slab for slab in slabs(DESIGN)}
    terms = [one for one in sources(DESIGN) if one.cause in weights]
    assert len(terms) == 2 * len(every)
    for slab, pair in zip(every.values(), zip(terms[::2], terms[1::2], strict=True), strict=True):
        for term in pair:
            of_material: dict[str, float] = {}
            for shell in slab.shells:
                weight = weights[term.cause](shell.material, shell.thickness)
                of_material[shell.material.name] = of_material.get(shell.material.name, 0.0) + weight
            expected = {name: weight / sum(of_material.values()) for name, weight in of_material.items()}
            assert dict(term.materials) == pytest.approx(expected, rel=1e-9)


def test_the_status_of_a_point_is_that_of_most_samples() -> None:
    samples = np.array([[1, 1, 5], [0, 9, 9], [2, 7, 7], [0, 0, 0]], np.int8)
    status, reached = status_of(samples)
    assert status.tolist() == [1, 0, 7, 0]
    np.testing.assert_allclose(reached, [0, 1 / 3, 0, 1])


def test_points_and_errors_of_clusters_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    detector = DESIGN.with_overrides({"cgem.L1.pitch_x": "601 um"})
    first = cg.analytic(detector, "mu-", 0.7, 0.1, phi=0.2, readout="gaussian")
    for module, name in (("tracks", "_numbers"), ("analytic", "_errors")):
        monkeypatch.setattr(sys.modules[f"cgemit.covariance.{module}"], name, lambda *_: pytest.fail("made again"))
    again = cg.analytic(detector, "mu-", 0.7, 0.1, phi=0.2, readout="gaussian")
    np.testing.assert_array_equal(again.cov, first.cov)
    for other in ({"p": 0.8}, {"fit": cg.FitSettings(least_width=0.2)}, {"readout": "tiger"}, {"reveal_sides": True}):
        with pytest.raises(pytest.fail.Exception, match="made again"):
            cg.analytic(detector, **{"p": 0.7, "cos_theta": 0.1, "phi": 0.2, "readout": "gaussian"} | other)


def test_who_changes_a_result_changes_no_later_one() -> None:
    first, names = cg.analytic(DESIGN, p=0.7, radius=60.0), ("p", "cos_theta", "phi", "radius", "status", "cov")
    before = [getattr(first, name).copy() for name in names]
    for name in names:
        getattr(first, name)[...] = 7
    later = cg.analytic(DESIGN, p=0.7, radius=60.0)
    for name, expected in zip(names, before, strict=True):
        np.testing.assert_array_equal(getattr(later, name), expected)


def test_covariance_of_a_variant_is_its_own() -> None:
    base = cg.analytic(DESIGN, p=[0.3, 1.0])
    (found,) = varied(base, [DESIGN.with_overrides({"cgem.*.drift_gap": "+0.1 %"})])
    assert np.all(found.cov[:, 0, 0] != base.cov[:, 0, 0])
    np.testing.assert_allclose(1e3 * np.sqrt(found.cov[:, 0, 0]), found.rms("dr"), rtol=1e-12)


def test_a_readout_may_hold_what_has_no_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclasses.dataclass(frozen=True, kw_only=True)
    class Weighted(cg.GaussianReadout):
        name = "weighted"
        weights: list = dataclasses.field(default_factory=list)  # type: ignore[type-arg]

    monkeypatch.setitem(READOUTS, "weighted", Weighted)
    plain, own = (cg.analytic(DESIGN, readout=one) for one in ("gaussian", Weighted()))
    np.testing.assert_array_equal(own.cov, plain.cov)


def test_a_derivative_at_an_upper_bound_is_that_below_it() -> None:
    """Only a smaller number is possible there; its sign is that of the change."""
    at, below = (
        cg.sensitivity(DESIGN.with_overrides({"field.bz": bz}), "mu-", 1.0, keys=["field.bz"], quantities=("p", "dr"),
                       samples=4)
        for bz in ("10 T", "9.99 T")
    )  # fmt: skip
    for quantity in ("p", "dr"):
        assert float(at.of("field.bz", quantity)) == pytest.approx(float(below.of("field.bz", quantity)), rel=0.02)


@pytest.mark.parametrize("samples", [1, 7, 20, 100])
def test_budget_counts_every_sample_of_a_point(samples: int) -> None:
    """Also the last ones, where lanes stay empty."""
    found = cg.analytic(DESIGN, "mu-", 0.7, 0.2, readout="gaussian", samples=samples)
    np.testing.assert_allclose(found.budget("dr").total, found.rms("dr") ** 2, rtol=1e-10)


def test_a_track_does_not_know_its_neighbours() -> None:
    p, cos_theta = np.linspace(0.15, 2, 37), np.linspace(-0.9, 0.9, 37)
    for name in isa.available():
        isa.use(name)
        try:
            many = cg.analytic(DESIGN, "mu-", p, cos_theta, phi=0.3).cov
            one = [cg.analytic(DESIGN, "mu-", a, b, phi=0.3).cov for a, b in zip(p, cos_theta, strict=True)]
        finally:
            isa.use(isa.available()[-1])
        assert np.array_equal(many, np.array(one), equal_nan=True)


@pytest.mark.parametrize("detector", ["besiii-cgem-design", "besiii-idc"])
def test_tracks_of_one_point_are_those_traced_one_by_one(detector: str) -> None:
    """Tracks that differ by a turn share one reference, unless they turn back; with variants, these do too."""
    base = cg.load(detector)
    p, cos_theta = [[0.06], [0.09], [0.15], [0.4], [2.0]], [0.0, -0.5, 0.88]
    together = cg.analytic(base, "pi+", p, cos_theta, readout="gaussian", samples=32)._tracks
    together = dataclasses.replace(together, scatters=np.zeros(len(together.phi)))
    alone = dataclasses.replace(together, samples=1, phases=together.phases[:1])
    cores = [tuned(base.with_overrides({"field.bz": "x1.001"}))]
    for name in ("scalar", isa.available()[-1]):
        isa.use(name)
        try:
            one, other = (tracks.run(budget=False, variants=cores) for tracks in (together, alone))
        finally:
            isa.use(isa.available()[-1])
        for column in ("status", "n_wires", "n_clusters"):
            assert np.array_equal(one[column], other[column]), column
        assert 0.5 < np.mean(one["status"] == 0) < 1
        scale = np.sqrt(np.abs(other["covariance"][..., [0, 5, 9, 12, 14]]))
        size = np.stack([scale[..., i] * scale[..., j] for i in range(5) for j in range(i, 5)], axis=-1)
        differences = np.abs(one["covariance"] - other["covariance"]) / size
        assert np.nanmax(differences) < 1e-7


def test_lanes_give_what_scalar_code_gives() -> None:
    p, cos_theta = np.linspace(0.15, 2, 33), np.linspace(-0.9, 0.9, 33)
    found = {}
    for name in isa.available():
        isa.use(name)
        try:
            found[name] = cg.analytic(DESIGN, "mu-", p, cos_theta, samples=8)
        finally:
            isa.use(isa.available()[-1])
    for other in found.values():
        assert np.array_equal(other.n_wires, found["scalar"].n_wires)
        np.testing.assert_allclose(other.sigma("p"), found["scalar"].sigma("p"), rtol=1e-8)
        np.testing.assert_allclose(
            other.budget("dr").variances, found["scalar"].budget("dr").variances, rtol=1e-6, atol=1e-16
        )


def test_chunks_and_threads_do_not_matter() -> None:
    p = np.linspace(0.3, 1, 200)
    one = cg.analytic(DESIGN, "mu-", p, 0.2, samples=64, threads=1)
    assert np.array_equal(one.cov, cg.analytic(DESIGN, "mu-", p, 0.2, samples=64, threads=2).cov)
    assert np.array_equal(one.cov[7], cg.analytic(DESIGN, "mu-", p[7], 0.2, samples=64).cov)


def test_core_of_a_mixture_is_what_a_sample_of_it_has() -> None:
    variances = np.array([[1.0, 1.0, 4.0, 25.0]])
    rng = np.random.default_rng(3)
    sample = rng.normal(size=2_000_000) * np.sqrt(variances[0])[rng.integers(0, 4, 2_000_000)]
    core = measure(sample)
    assert abs(core_width(variances)[0] - core.core) < 4 * core.core_error
    # Gaussians of equal width, one wide outlier, and very different widths: a variance that the window reproduces.
    for mixture in ([1.0] * 9, [1.0] * 9 + [1e4], [1e-4, 1.0, 100.0], [1.0, 1.001]):
        square = float(core_width(np.array([mixture]))[0]) ** 2
        u = 3 * np.sqrt(square / np.array(mixture))
        inside = erf(u / np.sqrt(2))
        second = np.array(mixture) * (inside - u * np.sqrt(2 / np.pi) * np.exp(-0.5 * u * u))
        assert second.sum() / inside.sum() == pytest.approx(SECOND_INSIDE * square, rel=1e-10)
    assert core_width(np.array([[2.0, np.nan, 2.0]]))[0] == pytest.approx(np.sqrt(2.0), rel=1e-9)


def test_errors_scale_with_the_measurements() -> None:
    """Without matter, twice the errors give twice the resolution."""
    thin = CHAMBER.with_overrides({"field.bz": "-1 T"})
    one = cg.analytic(thin, "mu-", 1e3, 0.1, phi=0.2, reveal_sides=True)
    two = cg.analytic(thin.with_overrides({"drift_chamber.sigma": "x2"}), "mu-", 1e3, 0.1, phi=0.2, reveal_sides=True)
    assert one.status == cg.FitStatus.unconstrained  # 1 TeV/c: kappa has an error, but the momentum is not measured
    np.testing.assert_allclose(np.sqrt(two.cov[2, 2] / one.cov[2, 2]), 2, rtol=1e-3)


def test_quantities_follow_from_the_covariance() -> None:
    found = cg.analytic(DESIGN, "mu-", 0.8, 0.5, phi=1.0, readout="gaussian")
    tanl = 0.5 / np.sqrt(0.75)
    kappa = -1 / (0.8 * np.sqrt(0.75))
    by_kappa, by_tanl = -0.8 / kappa, 0.8 * tanl / (1 + tanl**2)
    c = found.cov
    variance = by_kappa**2 * c[2, 2] + 2 * by_kappa * by_tanl * c[2, 4] + by_tanl**2 * c[4, 4]
    expected = {
        "p": 1e3 * np.sqrt(variance), "pt": 1e3 * np.sqrt(c[2, 2]) / kappa**2,  # MeV/c
        "p_rel": 100 * np.sqrt(variance) / 0.8, "pt_rel": 100 * np.sqrt(c[2, 2]) / abs(kappa),  # %
        "dr": 1e3 * np.sqrt(c[0, 0]), "dz": np.sqrt(c[3, 3]),  # um, mm
        "phi0": 1e3 * np.sqrt(c[1, 1]), "theta": 1e3 * np.sqrt(c[4, 4]) / (1 + tanl**2),  # mrad
        "tanl": 1e3 * np.sqrt(c[4, 4]), "kappa": np.sqrt(c[2, 2]),  # 1e-3, (GeV/c)^-1
    }  # fmt: skip
    assert expected.keys() == QUANTITIES.keys()
    for name, value in expected.items():
        assert float(found.sigma(name)) == pytest.approx(value, rel=1e-12), name
        assert float(found.rms(name)) == pytest.approx(value, rel=1e-12), name
        assert found.budget(name).unit == QUANTITIES[name].unit
    assert found.sigma_d_rho == found.sigma_dr == found.sigma("d_rho")


def test_gradients_are_the_derivatives_of_the_values() -> None:
    """Central differences of every quantity that is a function of the helix."""
    kappa, tanl, charge, step = np.array([-1.4, 0.7]), np.array([0.6, -1.2]), np.array([1, 2]), 1e-6
    for known in QUANTITIES.values():
        if known.value is None:
            continue
        for number, name in ((2, "kappa"), (4, "tanl")):
            up, down = ({"kappa": kappa, "tanl": tanl, "charge": charge} for _ in range(2))
            up[name], down[name] = up[name] + step, down[name] - step
            slope = (known.value(up) - known.value(down)) / (2 * step)
            slope = slope / known.value({"kappa": kappa, "tanl": tanl, "charge": charge}) if known.relative else slope
            found = known.gradient(kappa, tanl, charge)[:, number]
            np.testing.assert_allclose(found, known.factor * slope, rtol=1e-7, atol=1e-6)


def test_shapes_ranges_and_status() -> None:
    found = cg.analytic(DESIGN, "mu-", [0.02, 0.5], [[0.0], [0.3], [0.995]], samples=8)
    assert found.p.shape == (3, 2) == found.sigma_p.shape
    assert found.cov.shape == (3, 2, 5, 5)
    assert found.status[0, 0] != 0
    assert np.isnan(found.sigma_p[0, 0])
    assert found.reached[0, 0] == 0
    assert found.status[0, 1] == 0
    assert found.reached[0, 1] == 1
    assert found.status[2, 1] == cg.FitStatus.too_few_hits
    mixed = cg.analytic(DESIGN, "mu-", (0.3, 1.0), (-0.93, 0.93))
    assert mixed.p.shape == ()
    assert mixed.rms_p > mixed.sigma_p > 0


def test_ranges_are_printed_as_ranges() -> None:
    """Columns hold their middle."""
    text = "p 0.3 to 1 GeV/c, cos(theta) -0.93 to 0.93"
    found = cg.analytic(DESIGN, "mu-", (0.3, 1.0), (-0.93, 0.93), samples=8)
    head, line = repr(found).splitlines()
    assert (head, line.strip().partition(":")[0]) == (f"<{DESIGN.name}, mu-, readout binary", text)
    assert (found.p, found.cos_theta) == (0.65, 0.0)
    assert [found.table()[name].tolist() for name in ("p", "cos_theta")] == [[0.65], [0.0]]
    assert repr(found.budget("dr")).splitlines()[2].strip().startswith("0.3 to 1  ")
    moved = cg.sensitivity(DESIGN, "mu-", (0.3, 1.0), (-0.93, 0.93), keys=["field.bz"], samples=8)
    assert repr(moved).splitlines()[0] == f"{DESIGN.name}, mu-, {text}"
    titles = [
        cg.draw.draw_sensitivity(moved).axes[0].get_title(loc="left"),
        cg.draw.draw_budgets({"design": found.budget("dr")}).axes[0].get_title(loc="left"),
    ]
    assert titles == [f"{DESIGN.name}, mu-, p = 0.3 to 1 GeV/c, cos θ = -0.93 to 0.93"] * 2
    lines = cg.analytic(DESIGN, "mu-", [0.3, 1.0], (-0.93, 0.93), samples=8)
    assert [line.strip().partition(":")[0] for line in repr(lines).splitlines()[1:]] == [
        f"p {p} GeV/c, cos(theta) -0.93 to 0.93" for p in ("0.3", "1")
    ]
    title = cg.draw.draw_budget(lines.budget("dr")).axes[0].get_title(loc="left")
    assert title == f"{DESIGN.name}, mu-, cos θ = -0.93 to 0.93"


def test_no_readout_is_printed_without_cgem_layers() -> None:
    assert repr(cg.analytic("besiii-idc")).splitlines()[0] == "<besiii-idc, mu-"


def test_curves_have_steps_where_azimuths_and_cells_have_a_common_factor() -> None:
    """The same for every readout; all tracks cross layers of 128 and 256 cells at the same position in a cell."""
    p = np.linspace(0.5, 2.0, 76)

    def scatter(samples: int, readout: str) -> tuple[float, float]:
        found = cg.analytic(DESIGN, "mu-", p, samples=samples, readout=readout)
        second = np.diff(np.log(found.sigma_p), 2)  # of independent errors it has 6 times their variance
        return float(np.std(second)) / 6**0.5, float(np.abs(np.diff(found.n_wires)).max())

    for readout in ("binary", "gaussian"):
        (noise, jump), (less, smaller) = scatter(128, readout), scatter(127, readout)
        assert 0.004 < noise < 0.005
        assert less < 0.0004
        assert jump > 0.9
        assert smaller < 0.3


def test_every_problem_is_listed() -> None:
    with pytest.raises(ValueError, match=r"p: got -1, expected positive.*\n.*cos_theta.*\n.*samples") as error:
        cg.analytic(DESIGN, "mu-", -1, 1.5, samples=0)
    assert str(error.value).count("\n") == 3
    with pytest.raises(ValueError, match="charged particles"):
        cg.analytic(DESIGN, "gamma", 1.0)
    with pytest.raises(ValueError, match="quantity: got 'q'; expected one of dr"):
        cg.analytic(DESIGN, "mu-", 1.0, samples=2).sigma("q")
    with pytest.raises(ValueError, match="budget of p: got a range"):
        cg.analytic(DESIGN, "mu-", (0.5, 1.0), samples=4).budget("p")


# Each kind of number that a design has; steps of 2 % where neighbours allow it.
KINDS = {
    "field.bz": 0.02, "cgem.L1.anode_radius": 0.005, "cgem.*.pitch_v": 0.02, "cgem.L2.stereo": 0.02,
    "cgem.L1.drift_gap": 0.02, "cgem.*.foil.Kapton.thickness": 0.02, "drift_chamber.sigma": 0.02,
}  # fmt: skip


@pytest.mark.parametrize("key", KINDS)
def test_derivatives_predict_small_changes(key: str) -> None:
    """Taylor: what the first order leaves falls with the square of the step."""
    how = {"readout": cg.GaussianReadout(), "phi": 0.4, "reveal_sides": True}
    found = cg.sensitivity(DESIGN, "mu-", 0.6, 0.3, keys=[key], **how)
    base = cg.analytic(DESIGN, "mu-", 0.6, 0.3, **how)
    for quantity in ("dr", "dz", "p"):
        left = []
        for step in (KINDS[key], KINDS[key] / 4):
            (one,) = varied(base, [base.detector.with_overrides({key: f"x{1 + step!r}"})])
            change = float(np.log(one.sigma(quantity) / base.sigma(quantity)))
            left.append(abs(change - float(found.of(key, quantity)) * np.log1p(step)))
        assert left[1] < left[0] / 8 + 2e-6, (quantity, left)


@pytest.mark.parametrize("cos_theta", [0.0, 0.85, 0.93])
@pytest.mark.parametrize("samples", [1, 16])
def test_a_variant_without_a_change_has_the_same_covariance(cos_theta: float, samples: int) -> None:
    """Also near the ends, where tracks pass some wires beyond their ends."""
    base = cg.analytic(DESIGN, "mu-", [0.3, 1.0], cos_theta, samples=samples)
    (same,) = varied(base, [DESIGN])
    np.testing.assert_allclose(same.sigma("p"), base.sigma("p"), rtol=1e-8)


@pytest.mark.parametrize("samples", [1, 16])
def test_the_budget_is_that_of_the_last_variant(samples: int) -> None:
    base = cg.analytic(DESIGN, "mu-", [0.3, 1.0], 0.3, samples=samples)
    tracks, thick = base._tracks, DESIGN.with_overrides({"cgem.*.foil.Kapton.thickness": "x2"})
    columns = {name: getattr(tracks, name) for name in ("phi", "kappa", "tanl", "mass", "scatters", "phases", "model")}

    def budget(detector: cg.Detector, variants: list[_core.detector.Detector]) -> np.ndarray:
        core = compiled_for_fit(detector, tracks.fit)
        return _core.covariance.covariances(core, **columns, samples=samples, budget=True, variants=variants)["budget"]

    alone = budget(DESIGN, [])
    np.testing.assert_allclose(budget(DESIGN, [compiled_for_fit(DESIGN, tracks.fit)]), alone, rtol=1e-9, atol=1e-20)
    changed = budget(DESIGN, [compiled_for_fit(thick, tracks.fit)]).sum(axis=1) / alone.sum(axis=1)
    assert (changed[:, 0] > 1.03).all()


def test_a_derivative_that_cannot_keep_the_hits_is_named() -> None:
    """At its bound a layer touches the next one: the gas between them would come or go with any change."""
    key = "cgem.L2.anode_radius"
    touching = DESIGN.with_overrides({key: f"{DESIGN.bounds(key)[1]!r} mm"})
    found = cg.sensitivity(touching, "mu-", 1.0, 0.0, keys=[key, "field.bz"], quantities=("p",), samples=4)
    assert np.isnan(found.of(key, "p"))
    assert np.isfinite(found.of("field.bz", "p"))
    assert "in another order" in found.problems[key]


@pytest.mark.parametrize("layer", ["L1", "L2", "L3"])
def test_stereo_angles_follow_the_radius_in_no_steps(layer: str) -> None:
    """Per step, changes are the same for one that adds an X strip (1 in 1000) and one that does not."""
    base = cg.analytic(DESIGN, "mu-", 1.0, 0.3, phi=0.4, readout="gaussian")
    steps = (1e-4, 2e-3)
    key = f"cgem.{layer}.anode_radius"
    others = varied(base, [base.detector.with_overrides({key: f"x{1 + h!r}"}) for h in steps])
    small, large = (float(np.log(one.sigma("dz") / base.sigma("dz"))) / h for one, h in zip(others, steps, strict=True))
    assert small == pytest.approx(large, abs=0.01)


@pytest.mark.usefixtures("equal_weights")  # else it also changes the matter that acts with each slab
def test_derivative_by_an_error_is_its_share_of_the_budget() -> None:
    how = {"readout": "gaussian", "phi": 0.4, "reveal_sides": True}
    detector = cg.load(DESIGN.name)  # compiled anew
    found = cg.sensitivity(detector, "mu-", 1.0, 0.0, keys=["drift_chamber.sigma"], quantities=("p", "dr"), **how)
    for quantity in ("p", "dr"):
        budget = cg.analytic(detector, "mu-", 1.0, 0.0, **how).budget(quantity)
        wires = sum(v for s, v in zip(budget.sources, budget.variances, strict=True) if s.name.startswith("wires"))
        assert float(found.of("drift_chamber.sigma", quantity)) == pytest.approx(float(wires / budget.total), rel=1e-4)


def test_the_field_scales_the_momentum_resolution() -> None:
    """At high momentum, where only measurements count, sigma(p) falls like 1/B."""
    found = cg.sensitivity(CHAMBER, "mu-", 50.0, 0.0, keys=["field.bz"], quantities=("p",), phi=0.1, reveal_sides=True)
    assert float(found.of("field.bz", "p")) == pytest.approx(-1, abs=0.01)
    # Scattering does, too; and where the side of a wire is hidden, tracks keep their distances from wires.
    found = cg.sensitivity(DESIGN, "mu-", 1.0, 0.0, keys=["field.bz"], quantities=("p",))
    assert float(found.of("field.bz", "p")) == pytest.approx(-1, abs=0.01)


@pytest.mark.parametrize("readout", ["tiger", "apv25", "analog-projection"])
def test_derivatives_with_analog_readouts_are_differences(readout: str) -> None:
    """Errors of clusters follow pitch and gap. Variants keep the stereo angle, which else jumps with whole strips."""
    how: dict[str, Any] = {"readout": readout, "cos_theta": 0.0}
    angles = {f"cgem.{one.label}.stereo": f"{one.stereo!r} rad" for one in DESIGN.cgem}
    keys = ("cgem.*.pitch_x", "cgem.*.drift_gap")
    found = cg.sensitivity(DESIGN, keys=keys, **how)
    for key in keys:
        up, down = (cg.analytic(DESIGN.with_overrides({key: f"x{by}"} | angles), **how) for by in (1.001, 0.999))
        for quantity in ("dr", "dz"):
            slope = math.log(up.sigma(quantity) / down.sigma(quantity)) / math.log(1.001 / 0.999)
            assert float(found.of(key, quantity)) == pytest.approx(slope, rel=0.02, abs=2e-4), (key, quantity)


def test_finer_strips_measure_better_with_charge_and_time() -> None:
    pitches = ("0.5 mm", "0.65 mm", "0.8 mm")
    found = [
        cg.analytic(DESIGN.with_overrides({"cgem.*.pitch_x": one, "cgem.*.pitch_v": one}), readout="tiger")
        for one in pitches
    ]
    for quantity in ("dr", "dz"):
        fine, middle, coarse = (float(one.sigma(quantity)) for one in found)
        assert fine < middle < coarse


def test_small_effects_are_counted_not_printed() -> None:
    found = cg.sensitivity(DESIGN, "mu-", 1.0, 0.0, keys=["field.bz", "cgem.L3.induction_gap"], samples=4)
    assert 0 < np.abs(found.values[1]).max() < 0.005
    assert "cgem.L3.induction_gap" not in repr(found)
    assert repr(found).splitlines()[-1].startswith("1 more change each by less than 0.005 %")
    assert len(found.to_pandas()) == 2


def test_numbers_that_cannot_move_say_why() -> None:
    found = cg.sensitivity(DESIGN, "mu-", 1.0, 0.0, keys=["drift_chamber.sigma", "cgem.L1.sheets"], samples=4)
    assert "sheets" in found.problems["cgem.L1.sheets"]
    assert np.isnan(found.of("cgem.L1.sheets", "p"))
    assert found.ordered()[0] == "drift_chamber.sigma"
    assert "drift_chamber.sigma" in repr(found)


@pytest.mark.parametrize("name", ["p", "cos_theta", "phi", "radius", "charge", "mass"])
def test_empty_and_wrong_numbers_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: got no number"):
        cg.analytic("besiii-cgem-design", "mu-", **{name: []})
    with pytest.raises(ValueError, match=f"{name}: got {{}}, expected one or more numbers"):
        cg.analytic("besiii-cgem-design", "mu-", **{name: {}})


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"samples": 1_000_000}, "samples: got 1000000, expected a whole number from 1 to 65536"),
        ({"threads": 0}, "threads: got 0"),
        ({"fit": 5}, "^fit: got int, expected FitSettings$"),
        ({"particle": []}, "particle: got"),
    ],
)
def test_other_wrong_arguments_are_named(wrong: dict[str, Any], expected: str) -> None:
    with pytest.raises((ValueError, TypeError), match=expected):
        cg.analytic("besiii-cgem-design", **wrong)


def test_keys_that_are_no_numbers_are_refused() -> None:
    keys = ["foo.bar", "cgem.L9.pitch_x", "cgem.*.foo", "cgem.L1.gas", "drift_chamber.sigma", "cgem.*.pitch_x"]
    with pytest.raises(cg.DetectorError) as caught:
        cg.sensitivity(DESIGN, keys=keys, samples=4)
    assert [one.path for one in caught.value.problems] == keys[:4]
    for wrong in ({"keys": 5}, {"keys": "foo"}, {"keys": []}, {"quantities": 5}, {"quantities": []}):
        with pytest.raises(ValueError, match=rf"{next(iter(wrong))}: got .*expected a list"):
            cg.sensitivity(DESIGN, **wrong)


def test_a_printed_budget_shows_the_largest_parts_of_each_point_and_the_rest() -> None:
    budget = cg.analytic("besiii-cgem", "mu-", p=[10.0, 100.0, 0.2]).budget("p")
    _, _, rows = budget._table()
    parts = budget._parts()
    assert {"L1 measurement", "L1 matter", "gas", "wires"} <= parts.keys()
    assert sum(parts.values()) == pytest.approx(budget.total, rel=1e-12)
    for i, p in enumerate(("10", "100", "0.2")):
        shown = [row[1] for row in rows if row[0] == p]
        assert shown[:-1] == sorted(parts, key=lambda name: -parts[name][i])[: len(shown) - 1]
        assert shown[-1] == f"other ({len(parts) - 8})"
        shares = [float(row[3].removesuffix(" %")) for row in rows if row[0] == p]
        assert sum(shares) == pytest.approx(100, abs=0.5)


def test_a_share_of_the_variance_is_less_than_what_removing_the_part_gains() -> None:
    """Without a part the fit has other weights, which are the best ones: docs/methods/analytic.md has these numbers."""
    budget = cg.analytic(DESIGN, p=0.3).budget("dr")
    share = float(budget.grouped("part")["pipe"] / budget.total)
    without = cg.analytic(
        DESIGN.with_overrides({"remove": [f"beam_pipe.{one.label}" for one in DESIGN.beam_pipe]}), p=0.3
    )
    gain = 1 - float(without.budget("dr").total / budget.total)
    assert (share, gain) == pytest.approx((0.180, 0.213), abs=0.002)


def test_core_of_a_mixture_is_the_fixed_point_of_its_window():
    """As in iterations that take the variance found in the window for the next one, for each mixture alone."""
    rng = np.random.default_rng(1)
    variances = np.exp(rng.normal(0.0, np.linspace(0.01, 0.7, 20)[:, None], (20, 64)))
    variances[3, 5:] = np.nan
    variances[4] = np.nan
    found = core_width(variances)
    assert np.isnan(found[4])
    for i in np.delete(np.arange(20), 4):
        v = variances[i][~np.isnan(variances[i])]
        square = v.mean()
        for _ in range(200):
            u = 3 * np.sqrt(square / v)
            inside = erf(u / math.sqrt(2))
            square = np.sum(v * (inside - u * math.sqrt(2 / math.pi) * np.exp(-u * u / 2))) / inside.sum()
            square /= SECOND_INSIDE
        assert found[i] == pytest.approx(math.sqrt(square), rel=1e-14)
        assert core_width(variances[i : i + 1])[0] == found[i]


def test_numbers_that_are_none_are_not_left_out() -> None:
    """An azimuth or a radius of NaN is a mistake; numpy's whole numbers count as Python's."""
    for name in ("phi", "radius"):
        with pytest.raises(ValueError, match=f"analytic(?s:.*){name}: got nan, expected a number"):
            cg.analytic(DESIGN, p=1.0, **{name: [0.1, np.nan]})  # type: ignore[arg-type]
    how: Any = {"p": 0.5, "cos_theta": (-0.3, 0.4), "readout": "gaussian"}
    one, other = (cg.analytic(DESIGN, samples=number, **how).sigma_dr for number in (np.int64(13), 13))
    assert one == other


def test_points_in_a_field_map_do_not_depend_on_others() -> None:
    """Tracks that turn back end before others in the same lanes: what is beyond their end counts for nothing."""
    curved, before = DESIGN.with_field("besiii"), isa.name()
    for name in isa.available():
        isa.use(name)
        try:
            alone, both = (cg.analytic(curved, "pi+", p=p, cos_theta=0.0) for p in ([0.1], [0.1, 0.2]))
            budgets = [[found.budget(quantity).variances[0] for found in (alone, both)] for quantity in ("dr", "p")]
        finally:
            isa.use(before)
        assert both.sigma_dr[0] == pytest.approx(alone.sigma_dr[0], rel=1e-9), name
        for one, other in budgets:
            np.testing.assert_allclose(other, one, rtol=1e-9, err_msg=name)


def test_momenta_and_angles_by_other_names() -> None:
    """60 deg is cos(theta) 0.5; eta 1 is cos(theta) tanh(1); pT 0.6 at cos(theta) 0.6 is p = 0.75 GeV/c."""
    name = "besiii-cgem-design"
    expected = cg.analytic(name, p=0.75, cos_theta=0.5)
    for same in (
        cg.analytic(name, p="750 MeV/c", theta="60 deg"),
        cg.analytic(name, p=0.75, theta=math.pi / 3),
        cg.analytic(name, p=0.75, eta=math.atanh(0.5)),
        cg.analytic(name, pt=0.75 * math.sqrt(0.75), cos_theta=0.5),
    ):
        np.testing.assert_allclose(same.cov, expected.cov, rtol=1e-9)
    grid = cg.analytic(name, pt=[[0.3], [0.6]], theta=["90 deg", "45 deg"])
    np.testing.assert_allclose(grid.p, [[0.3, 0.3 * math.sqrt(2)], [0.6, 0.6 * math.sqrt(2)]])
    np.testing.assert_allclose(grid.cos_theta, [[0, math.sqrt(0.5)]] * 2, atol=1e-12)
    assert float(cg.analytic(name).p) == 1
    assert float(cg.analytic(name).cos_theta) == 0


@pytest.mark.parametrize(
    ("given", "texts"),
    [
        ({"p": 1.0, "pt": 0.5, "theta": 1.0, "eta": 0.1}, ("p and pt: got both", "theta and eta: got both")),
        ({"cos_theta": 0.1, "theta": 1.0, "eta": 0.1}, ("cos_theta and theta and eta: got all",)),
        ({"pt": (0.3, 1.0), "theta": (0.5, 1.0)}, ("pt: got the range", "theta: got the range")),
        ({"pt": 0.5, "cos_theta": (0.0, 0.5)}, ("cos_theta: got the range",)),
        ({"theta": "200 deg"}, ("theta: got '200 deg', expected angles between 0 and pi rad",)),
        ({"pt": "1 mm"}, ("pt: got",)),
        ({"theta": [1.0, 30]}, ('theta: got [1.0, 30], expected angles between 0 and pi rad; did you mean "30 deg"?',)),
        ({"cos_theta": "0:0.9"}, ("expected one or more numbers; a range is a tuple (low, high)",)),
        (
            {"p": [0.3, 1.0], "cos_theta": [0.0, 0.5, 0.9]},
            ("p, cos_theta: got shapes (2,), (3,), expected shapes that can be broadcast; with p as a column",),
        ),
    ],
)
def test_momenta_and_angles_that_make_no_sense(given: dict[str, Any], texts: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="analytic:") as caught:
        cg.analytic("besiii-cgem-design", **given)
    for text in texts:
        assert text in str(caught.value)


def test_text_of_a_right_angle() -> None:
    text = str(cg.analytic("besiii-cgem-design", theta=["90 deg", "91 deg"]))
    assert "cos(theta) 0: " in text
    assert "cos(theta) -0.01745: " in text


def test_names_that_physicists_type() -> None:
    found = cg.analytic("besiii-cgem-design", p=[0.3, 1.0])
    for name, same in {"d0": "dr", "z0": "dz", "phi": "phi0"}.items():
        assert found.sigma(name).tolist() == found.sigma(same).tolist()
        assert found.budget(name).total.tolist() == found.budget(same).total.tolist()
