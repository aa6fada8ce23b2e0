"""The covariance without events against closed forms and against simulated events."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.quantities import QUANTITIES
from cgemit.fit_matter import tuned
from cgemit.helix import RADIUS_PER_KAPPA
from cgemit.reconstruction.fit import fit
from cgemit.simulation import transport

VACUUM = {"density": "1e-6 g/cm3", "composition": "He", "gas": True}


def equal_layers(n: int, first: float, last: float, sigma: float, bz: float) -> Any:
    """Return a chamber of n axial layers at equal distances, without other matter."""
    radii = np.linspace(first, last, n)
    layers = {
        str(i): {
            "cells": 24, "r_end": f"{r:.10f} mm", "half_length": "2000 mm", "twist_cells": 0.0, "phi_east": "0 rad",
            "sigma": f"{sigma} mm",
        }
        for i, r in enumerate(radii, start=1)
    }  # fmt: skip
    return cg.load({
        "name": "equal", "materials": {"Vacuum": VACUUM}, "field": {"kind": "uniform", "bz": f"{bz} T"},
        "drift_chamber": {"gas": "Vacuum", "layers": layers},
    })  # fmt: skip


def in_closed_form(n: int, length: float, sigma: float) -> float:
    """Error of the curvature from n equal points without matter; R. L. Gluckstern, NIM 24 (1963) 381, eq. 10."""
    m = n - 1
    return sigma / length**2 * np.sqrt(720 * m**3 / ((m - 1) * (m + 1) * (m + 2) * (m + 3)))


@pytest.mark.parametrize("n", [8, 20, 43])
@pytest.mark.parametrize("sigma", [0.1, 0.2])
def test_equal_layers_without_matter_are_those_of_gluckstern(n: int, sigma: float) -> None:
    detector = equal_layers(n, 300.0, 900.0, sigma, 1.5)
    found = cg.analytic(detector, "mu-", 200.0, 0.0, phi=0.05, reveal_sides=True)
    assert found.n_wires == n
    expected = in_closed_form(n, 600.0, sigma) * RADIUS_PER_KAPPA / 1.5
    kappa = float(np.sqrt(found.cov[..., 2, 2]))  # also where sigma(p) > p/2, and sigma("kappa") is NaN
    assert kappa == pytest.approx(expected, rel=3e-3)
    assert kappa != pytest.approx(in_closed_form(n + 1, 600.0, sigma) * RADIUS_PER_KAPPA / 1.5, rel=3e-3)


SETTINGS = cg.Settings(simulate=cg.SimulateSettings(fluctuations="gaussian", deltas=False, decays=False))


#: Particle, p (GeV/c) and cos(theta) of the points that every run of the tests measures.
POINTS = [("mu-", 0.2, 0.0), ("mu-", 1.0, 0.5), ("pi+", 0.5, 0.8), ("K+", 0.4, 0.3), ("proton", 0.6, 0.0)]
#: The last one is near the ends of the chamber, where scattering decides how many wires a track has.
POINTS += [("K+", 0.8, 0.9)]


@pytest.mark.slow
@pytest.mark.parametrize("detector", ["besiii-cgem-design", pytest.param("besiii-idc", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("particle", "p", "cos_theta"), POINTS)
def test_widths_are_those_of_simulated_events(detector: str, particle: str, p: float, cos_theta: float) -> None:
    """Where the fit's assumptions hold: 2 % or 3 standard errors."""
    gun = cg.Gun(particle, p=p, cos_theta=cos_theta)
    result = cg.run(detector, gun, n=8000, seed=21, settings=SETTINGS, readout="gaussian")
    found = cg.analytic(detector, particle, p, cos_theta, readout="gaussian")
    for quantity in ("dr", "phi0", "kappa", "dz", "tanl", "p", "pt", "theta", "p_rel", "pt_rel"):
        measured = cg.resolution(result, quantity)
        ratio = float(found.sigma(quantity)) / measured.core
        assert abs(ratio - 1) < max(0.02, 3 * measured.core_error / measured.core), (quantity, ratio)
        assert abs(1.05 * ratio - 1) > 0.02  # 5 % more would be seen


@pytest.mark.parametrize("detector", ["besiii-cgem-design", pytest.param("besiii-cgem", marks=pytest.mark.slow)])
def test_binary_clusters_are_a_mixture(detector: str) -> None:
    """RMS of the mixture, with sizes that the strips under the track decide; its core up to the shape of the errors."""
    gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.9, 0.9))
    result = cg.run(detector, gun, n=10_000, seed=5, settings=SETTINGS)
    found = cg.analytic(detector, "mu-", 1.0, (-0.9, 0.9), samples=2048)
    for quantity in ("dr", "dz", "p"):
        core = float(found.sigma(quantity))
        measured = cg.resolution(result, quantity, window=(-6 * core, 6 * core))
        assert float(found.rms(quantity)) == pytest.approx(measured.rms, rel=0.03)
        # The position in a strip is uniform, not Gaussian, which narrows the core of d_rho.
        assert core == pytest.approx(measured.core, rel=0.05)


@pytest.mark.parametrize(("particle", "p", "cos_theta"), [("mu-", 0.4, 0.3), ("pi+", 1.0, -0.5)])
def test_widths_in_the_gaps_are_those_of_simulated_events(particle: str, p: float, cos_theta: float) -> None:
    """Where tracks cross the middles of the drift gaps: fitted states against true points, 4 standard errors."""
    design, n = cg.load("besiii-cgem-design"), 4000
    middles = [layer.r_mid for layer in design.cgem]
    how = cg.Settings(
        simulate=cg.SimulateSettings(fluctuations="gaussian", deltas=False, decays=False),
        digitize=cg.DigitizeSettings(reveal_sides=True),
        fit=cg.FitSettings(states=tuple(middles)),
    )
    gun = cg.Gun(particle, p=p, cos_theta=cos_theta)
    result = cg.run(design, gun, n=n, seed=8, settings=how, readout="gaussian")
    found = cg.analytic(design, particle, p, cos_theta, radius=middles, readout="gaussian", reveal_sides=True)
    origin = cg.analytic(design, particle, p, cos_theta, readout="gaussian", reveal_sides=True)
    states, truths = result.states, result.truths
    for layer, radius in enumerate(middles):
        at, true = states[states["r"] == radius], truths[truths["layer"] == layer]
        _, mine, row = np.intersect1d(at["event"], true["event"], return_indices=True)
        assert len(row) > 0.98 * n
        azimuth = np.arctan2(at["y"], at["x"])[mine]
        around = radius * (np.remainder(azimuth - true["phi"][row] + np.pi, 2 * np.pi) - np.pi)
        incidence = np.arctan2(at["py"], at["px"])[mine] - azimuth
        # Both points are on the cylinder; dr and dz are displacements at the same path.
        up = at["z"][mine] - true["z"][row] - at["tanl"][mine] * np.sin(incidence) * around
        for name, residual in (("dr", 1000 * around * np.cos(incidence)), ("dz", up)):  # um, mm
            ratio = residual.std() / float(found.rms(name)[layer])
            assert abs(ratio - 1) < 4 / np.sqrt(2 * len(residual)), (layer, name, ratio)
            assert residual.std() < 0.9 * origin.rms(name)  # the covariance of the origin fails


def test_each_cause_alone_makes_its_terms_of_the_budget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events in which only the wires, only the clusters or only the matter fluctuate, fitted with all weights.

    Matter fluctuates as the fit of the design assumes. With exact wires, smaller losses and scatters would be tails.
    """
    design = cg.load("besiii-cgem-design")
    monkeypatch.setattr(transport, "tuned", lambda _, *how, **more: tuned(design, *how, **more))
    exact_wires = design.with_overrides({"drift_chamber.sigma": "1 um"})
    given, tiny = cg.GaussianReadout(), cg.GaussianReadout(sigma_x=1e-4, sigma_v=1e-4)
    gun = cg.Gun("mu-", p=0.6, cos_theta=0.3, phi=0.2)
    found = cg.analytic(design, "mu-", 0.6, 0.3, phi=0.2, readout=given, reveal_sides=True)
    causes = {
        "wires": (design, tiny, "off"), "clusters": (exact_wires, given, "off"),
        "matter": (exact_wires, tiny, "gaussian"),
    }  # fmt: skip
    for cause, (detector, readout, fluctuations) in causes.items():
        how = cg.Settings(
            simulate=cg.SimulateSettings(fluctuations=fluctuations, deltas=False, decays=False),
            digitize=cg.DigitizeSettings(reveal_sides=True),
        )
        ran = cg.run(detector, gun, n=5000, seed=4, settings=how, readout=readout, until="find", workers=1)
        n = len(ran.clusters)
        clusters = dict(ran.clusters.columns) | {"err_x": np.full(n, given.sigma_x), "err_v": np.full(n, given.sigma_v)}
        wires = dict(ran.wire_hits.columns) | {"sigma": np.full(len(ran.wire_hits), 0.13)}
        tracks = fit(
            design, cg.Table("clusters", clusters, **ran.clusters.cover),
            cg.Table("wire_hits", wires, **ran.wire_hits.cover), ran.candidates, ran.candidate_hits,
            cg.FitSettings(outlier_pull=0, kinks=False),
        )["tracks"]  # fmt: skip
        for quantity in ("dr", "kappa", "dz"):
            budget = found.budget(quantity)
            expected = sum(
                v for source, v in zip(budget.sources, budget.variances, strict=True)
                if (cause == "wires") == source.name.startswith("wires") and source.cause != "prior"
                and (cause == "matter") == (source.cause != "measurement")
            )  # fmt: skip
            measured = np.var(QUANTITIES[quantity].factor * tracks[quantity])
            assert measured / expected == pytest.approx(1, abs=4 * np.sqrt(2 / 5000)), (cause, quantity)
