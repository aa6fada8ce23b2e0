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
# # What a muon meets on its way
#
# Matter limits the resolution of a light tracker below 1 GeV/c and makes the tails everywhere. This notebook follows a
# muon through the beam pipe, the three CGEM layers and the drift chamber, layer by layer: how much matter, how large
# the angles and losses, and where delta electrons go. Formulas and sources are in [matter](../docs/methods/matter.md)
# and [deltas](../docs/methods/deltas.md), the comparison with Geant4 in [validation](../docs/validation.md).

# %%
import matplotlib.pyplot as plt
import numpy as np

import cgemit as cg
from cgemit.analysis.clusters import cluster_residuals, x_widths
from cgemit.detector.export import describe

detector = cg.load("besiii-cgem-design")

# %% [markdown]
# ## Layer by layer
#
# Each scatterer is a group of sub-layers: thickness in radiation lengths, and the energy that a muon of 1 GeV/c loses
# in it on average. Most matter is in the beam pipe, the three layers and the separator; 58 cm of chamber gas are 4 % of
# the total.

# %%
parts = describe(detector)["material"]
for part in parts:
    if part["x0_percent"] > 0.02:
        print(f"{part['part']:14} r = {part['radius_mm']:6.1f} mm   {part['x0_percent']:.3f} % X0")

# %%
radius = np.array([part["radius_mm"] for part in parts])
total = np.cumsum([part["x0_percent"] for part in parts])
fig, axes = plt.subplots(figsize=(6, 3.2))
axes.step(radius, total, where="post")
axes.set(xlabel="radius  (mm)", ylabel="matter crossed  (% X0)", title=detector.name)
axes.grid(alpha=0.3)

# %% [markdown]
# ## A slab alone: scattering
#
# `cg.slab` sends particles through layers of matter. Many soft scatters give a Gaussian core, single hard scatters a
# tail: the half width of 99.9 % is three times that of a Gaussian with this core.

# %%
layer = "Kapton 300 um + Cu 33 um + CarbonFiber 120 um + Epoxy 150 um"
slab_result = cg.slab(layer, particle="mu-", p=1.0, n=100_000)
slab_result

# %%
cg.draw.draw_slab(slab_result)

# %% [markdown]
# Screening of the nucleus by its electrons decides where soft scattering ends. It is a named choice, in the simulation
# and in the fit alike: Moliere's own angle makes the core 3 to 5 % wider than the default.

# %%
for screening in ("wentzel", "moliere"):
    other = cg.slab(layer, particle="mu-", p=1.0, n=100_000, screening=screening)
    print(f"{screening:8} q68 = {other.q68_mrad:.3f} mrad, q98 = {other.q98_mrad:.3f} mrad")

# %% [markdown]
# ## Energy loss
#
# Slow particles lose more, and with a spread that is nearly Gaussian; fast ones have Landau's tail of rare hard
# collisions. The mean lies far above the most probable loss.

# %%
fig, axes = plt.subplots(figsize=(6, 4), layout="constrained")
for particle, p in (("mu-", 1.0), ("mu-", 0.2), ("K-", 0.5), ("p+", 0.8)):
    loss = cg.slab(layer, particle=particle, p=p, n=50_000).loss
    label = f"{particle} {p:g} GeV/c: median {np.median(loss):.0f}, mean {loss.mean():.0f} keV"
    axes.hist(loss, np.linspace(0, 900, 181), histtype="step", density=True, label=label)
axes.set(xlabel="energy loss  (keV)", ylabel="density  (1/keV)", yscale="log")
fig.legend(fontsize=8, loc="outside upper center", ncols=2)
axes.grid(alpha=0.3)

# %% [markdown]
# ## In the drift gap: clusters and delta electrons
#
# A muon of 1 GeV/c leaves 18 ionization clusters in 5 mm of gas at normal incidence, 23 on the slanted ways of this
# sample, most of a single electron. With `steps=True` every one is a row of the table of steps, the *Cgem Hits* of the
# paper.

# %%
settings = cg.Settings(simulate=cg.SimulateSettings(steps=True))
gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
result = cg.run(detector, gun, n=5000, seed=1, settings=settings)
steps = result.steps
own = steps["parent"] == 0
clusters, others = (np.count_nonzero(rows) / len(result.truths) for rows in (own, ~own))
print(f"{clusters:.1f} clusters and {others:.2f} steps of delta electrons in a crossing")

# %%
sizes = np.bincount(np.minimum(steps["n_electrons"][own], 40))[1:] / own.sum()
fig, axes = plt.subplots(figsize=(6, 3.2))
axes.step(np.arange(1, len(sizes) + 1), 100 * sizes, where="mid")
axes.set(xlabel="electrons in a cluster", ylabel="clusters  (%)", yscale="log", title="Ar/iC4H10 90/10")
axes.grid(alpha=0.3)

# %% [markdown]
# In one of twenty crossings a delta electron goes more than 0.2 mm away from the track, out of the cathode, the gas or
# the foils behind. The field winds it up in the bending plane, so that it goes farther along the beam.

# %%
fractions = cg.study.delta_fractions(result)
fractions

# %%
far = cg.study.delta_displacements(result.truths, result.steps)
fig, axes = plt.subplots(figsize=(6, 3.4))
for distance, name in zip(far, ("r-phi", "z"), strict=True):
    axes.step(np.sort(distance)[::-1], 100 * np.arange(1, len(distance) + 1) / len(distance), label=name)
axes.set(xlabel="farthest deposit from the track  (mm)", ylabel="crossings beyond  (%)", xscale="log", yscale="log")
axes.set(xlim=(0.05, 50), ylim=(0.01, 20))
axes.legend(title=f"{len(far[0]):,} crossings")
axes.grid(alpha=0.3)

# %% [markdown]
# ## What it does to a cluster
#
# The strips that a delta electron fires lengthen the cluster, or stand apart from it. The core of the X residual
# hardly changes, its RMS does: it depends on the window in which it is taken.

# %%
quiet = cg.run(detector, gun, n=5000, seed=1, settings=cg.Settings(simulate=cg.SimulateSettings(deltas=False)))
for label, run in (("with delta electrons", result), ("without", quiet)):
    widths = [f"{x_widths(cluster_residuals(run), window).rms:.0f}" for window in (1, 2, 3, 5)]
    print(f"{label:22} X residual RMS within 1, 2, 3, 5 mm: {', '.join(widths)} um")
