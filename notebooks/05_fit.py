# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # One track, from hits to helix
#
# The fit turns 3 CGEM clusters and some 40 drift distances into the five parameters of a helix at the origin, with a
# covariance. This notebook shows how the fit converges, how hits reduce the covariance and matter increases it, the
# residual of each hit, and the pulls. Derivations are in [fit](../docs/methods/fit.md), the checks in
# [validation](../docs/validation.md).

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Ellipse

import cgemit as cg
from cgemit.reconstruction.candidates import collect_hits
from cgemit.reconstruction.fit import PARAMETERS, FitSettings, fit
from cgemit.tables.schema import HIT_WIRE

detector = cg.load("besiii-cgem-design")
settings = cg.Settings(fit=FitSettings(residuals=True))
result = cg.run(detector, cg.Gun("mu-", p=0.5, cos_theta=0.3), n=1, seed=5, settings=settings)
cg.draw.event(result, 0)

# %% [markdown]
# ## The hits
#
# A candidate is a set of hits: an X and a V position in each CGEM layer, and a drift distance from each wire. The
# side on which the track passed the wire is unknown. The table `candidate_hits` has a row for each hit, which points to
# the cluster or wire hit; the fit takes them from the beam line outward.

# %%
hits = collect_hits(detector, result.candidates, result.candidate_hits, result.clusters, result.wire_hits)
for kind, name in ((0, "X"), (1, "V"), (HIT_WIRE, "wires")):
    of_kind = hits.kind == kind
    print(f"{name:5} {of_kind.sum():2} hits, error {1000 * hits.sigma[of_kind].mean():.0f} um each")

# %% [markdown]
# ## Iterations
#
# The helix is followed through the detector, every hit becomes a linear function of the five parameters about it, the
# Kalman filter finds the best ones, and all is repeated about the new helix. Differences to the last helix, in
# standard deviations: while sides are open the first steps are cautious, then it converges fast.


# %%
def fitted(candidate_hits, start=None, **changes):
    """Fit the candidate with some of its hits and return its row of the tracks table."""
    chosen = replace(FitSettings(), **changes)
    tables = (result.clusters, result.wire_hits, result.candidates, candidate_hits)
    tracks = fit(detector, *tables, chosen, start=start)["tracks"]
    return {name: tracks[name][0] for name in (*PARAMETERS, "cov", "chi2", "ndf", "iterations")}


final = fitted(result.candidate_hits)
error = np.sqrt(np.diag(final["cov"]))
for iterations in range(1, int(final["iterations"]) + 1):
    row = fitted(result.candidate_hits, max_iterations=iterations)
    steps = [(row[name] - final[name]) / sigma for name, sigma in zip(PARAMETERS, error, strict=True)]
    print(f"after {iterations}: chi2 {row['chi2']:7.1f}  ", " ".join(f"{x:+9.4f}" for x in steps))

# %% [markdown]
# ## The shrinking error ellipse
#
# The filter goes inward: the outer wires first, the first CGEM layer last. After each group of hits the state at the
# origin has a covariance, the matter on the way in included. Wires alone measure the curvature well and the vertex
# poorly; the CGEM layers bring the closest approach and z from centimetres to a fraction of a millimetre. Each of these
# fits begins at the final helix: a few hits make no first helix of their own.

# %%
radius = {layer.number: layer.r_mid for layer in detector.drift_chamber.layers}
n = len(hits.kind)
wires = int(np.count_nonzero(hits.kind == HIT_WIRE))
used = {"12 outer wires": 12, "all wires": wires, "and L3": wires + 2, "and L2": wires + 4, "and L1": n}
states = {}
for name, outer in used.items():
    states[name] = fitted(result.candidate_hits[n - outer :], start=[[final[parameter] for parameter in PARAMETERS]])


# %%
UNITS = {"dr": "mm", "phi0": "rad", "dz": "mm", "tanl": "1"}


def ellipse(axes, state, first, second, colour, label):
    """Draw one standard deviation of two parameters about the final helix."""
    i, j = PARAMETERS.index(first), PARAMETERS.index(second)
    values, vectors = np.linalg.eigh(state["cov"][np.ix_((i, j), (i, j))])
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    centre = state[first] - final[first], state[second] - final[second]
    width, height = 2 * np.sqrt(values[::-1])
    axes.add_patch(Ellipse(centre, width, height, angle=angle, fill=False, color=colour, lw=1.6, label=label))
    axes.set(xlabel=f"{first} [{UNITS[first]}]", ylabel=f"{second} [{UNITS[second]}]")


fig, axes = plt.subplots(2, 2, figsize=(10, 8), layout="constrained")
pairs = (("dr", "phi0"), ("dz", "tanl"))
shown = (("all wires", "and L3", "and L2", "and L1"), ("and L3", "and L2", "and L1"))
colours = dict(zip(used, plt.get_cmap("viridis")(np.linspace(0.9, 0, len(used))), strict=True))
for row, names in zip(axes, shown, strict=True):
    for plot, pair in zip(row, pairs, strict=True):
        for name in names:
            ellipse(plot, states[name], *pair, colours[name], name)
        plot.autoscale_view()
        plot.grid(alpha=0.3)
fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
# %%
for name, state in states.items():
    sigma = np.sqrt(np.diag(state["cov"]))
    relative = 100 * sigma[2] / abs(state["kappa"])
    print(f"{name:15} dr {sigma[0]:8.3f} mm   dz {sigma[3]:9.3f} mm   kappa {relative:5.2f} %")

# %% [markdown]
# ## Unbiased residuals
#
# The smoother goes outward again and compares every hit with the track fitted without it. The difference over its error
# is a pull of width 1; one hit in a hundred is beyond 2.6, and a noise hit far out.

# %%
residuals = result.residuals
place = [radius.get(int(layer), detector.cgem[min(int(layer), 2)].r_mid) for layer in residuals["layer"]]
fig, axes = plt.subplots(figsize=(8, 3))
for view, name, marker in ((0, "X", "o"), (1, "V", "s"), (2, "wires", ".")):
    rows = residuals["view"] == view
    axes.plot(np.array(place)[rows], residuals["pull"][rows], marker, label=name)
axes.axhspan(-1, 1, color="0.9", zorder=0)
axes.set(xlabel="radius  (mm)", ylabel="pull of the residual")
axes.legend(ncols=3)

# %% [markdown]
# ## Many tracks: can the errors be believed?
#
# Where simulation and readout do exactly what the fit assumes, its pulls are standard normal and the chi-square
# probability is flat. Strips, hard scatters and straggling add tails; the cores stay close to 1.

# %%
settings = cg.Settings(
    simulate=cg.SimulateSettings(fluctuations="gaussian"), digitize=cg.DigitizeSettings(reveal_sides=True)
)
exact = {"settings": settings, "readout": "gaussian"}
gun = cg.Gun("mu-", p=0.5, cos_theta=(-0.8, 0.8))
samples = {"all Gaussian": cg.run(detector, gun, n=3000, seed=2, **exact)}
samples["default"] = cg.run(detector, gun, n=3000, seed=2)
cg.study.pulls(samples["all Gaussian"].tracks)

# %%
cg.study.pulls(samples["default"].tracks)

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
bins = np.linspace(-5, 5, 51)
for name, sample in samples.items():
    left.hist(sample.tracks["pull_kappa"], bins=bins, histtype="step", density=True, label=name)
    probability = cg.study.chi2_probability(sample.tracks)
    right.hist(probability, bins=np.linspace(0, 1, 26), histtype="step", density=True, label=name)
left.plot(bins, np.exp(-(bins**2) / 2) / np.sqrt(2 * np.pi), "k:", lw=1)
left.set(xlabel="pull of kappa", yscale="log", ylim=(1e-4, 1))
right.set(xlabel="chi-square probability", ylim=(0, None))
left.legend()

# %% [markdown]
# A fit that assumes a field 0.3 % stronger than the real one finds momenta 0.3 % too high, most of a standard
# deviation.

# %%
believed = detector.with_overrides({"field.bz": "-1.003 T"})
wrong = cg.run(detector, gun, n=3000, seed=2, fit_detector=believed, **exact)
cg.study.pulls(wrong.tracks)["kappa"]
