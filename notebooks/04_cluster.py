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
# # From strips to positions
#
# Clusters are contiguous strips; an X and a V cluster that cross make a point. This notebook measures positions with
# charge and time, shows why the angle of the track helps, and how charge and time tell crossings of one particle from
# ghosts. Formulas are in [clusters](../docs/methods/cluster.md) and [the analog readout](../docs/methods/readout.md).

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import cgemit as cg
from cgemit.study.readout.scan import scan, scan_ghosts
from cgemit.truth import assign

detector = cg.load("besiii-cgem-design")
muon = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
tiger = cg.TigerReadout()

# %% [markdown]
# ## One cluster
#
# Fired strips of both views, the projected crossing, and the point where the X and the V cluster cross.

# %%
result = cg.run(detector, muon, n=2000, seed=2, readout=tiger)
cg.draw.draw_cluster(result, event=9)

# %% [markdown]
# ## Charge centroid, micro-TPC, and the line through the charge
#
# The centroid is the mean of the charge. Angle of incidence and Lorentz angle spread the charge, and then the centroid
# moves with every fluctuation of the ionization. The micro-TPC fit turns times into heights in the gap and fits a line.
# `merged` draws a line through centroid and mean height of the charge, with the slope of a straight track from the beam
# line, which the strips correct.


# %%
def x_residuals(run):
    """Residuals of X clusters of true crossings, in um."""
    clusters, _ = run.fitted_hits  # with the angle of the track in the second pass
    own = assign.own_clusters(detector, clusters, run.truths)
    own = own[clusters["view"][own] == 0]
    return 1000 * assign.residuals(detector, clusters, run.truths, own)


# %%
fig, axes = plt.subplots(figsize=(6, 3.6))
for estimator in ("centroid", "micro-tpc", "merged"):
    run = cg.run(detector, muon, n=2000, seed=2, readout=replace(tiger, estimator=estimator), until="cluster")
    residual = x_residuals(run)
    label = f"{estimator}: 68 % within {np.quantile(np.abs(residual), 0.683):.0f} µm"
    axes.hist(residual, np.linspace(-1000, 1000, 81), histtype="step", label=label)
axes.set(xlabel="X residual  (µm)", ylabel="clusters per 25 µm", title="TIGER, 2000 muons of 1 GeV/c, 1 T")
axes.legend(fontsize=8)
axes.grid(alpha=0.3)

# %% [markdown]
# ## The angle of the track
#
# After a first fit the angle of each track is known. A second pass makes its clusters again: the line through the
# charge has the slope of the track. Tracks are then fitted again.

# %%
second = cg.run(detector, muon, n=2000, seed=2, readout=replace(tiger, second_pass=True))
for name, run in (("first pass", result), ("second pass", second)):
    width = np.quantile(np.abs(x_residuals(run)), 0.683)
    print(f"{name:12} X: {width:3.0f} µm   {cg.resolution(run.tracks, 'dr')}")

# %% [markdown]
# ## Errors
#
# Errors come from a model of gas, strips and chip, with the charge and the width of each cluster. Residuals over
# errors, the pulls, show whether they hold: their core should have unit width. The tails are delta electrons.

# %%
fig, axes = plt.subplots(figsize=(6, 3.4))
grid = np.linspace(-6, 6, 61)
for name, run in (("first pass", result), ("second pass", second)):
    clusters, _ = run.fitted_hits
    own = assign.own_clusters(detector, clusters, run.truths)
    own = own[clusters["view"][own] == 0]
    pull = assign.residuals(detector, clusters, run.truths, own) / clusters["err_x"][own]
    axes.hist(pull, grid, histtype="step", label=f"{name}: 68 % within {np.quantile(np.abs(pull), 0.683):.2f}")
axes.plot(grid, len(pull) * 0.2 * np.exp(-0.5 * grid**2) / np.sqrt(2 * np.pi), "k:", label="unit Gaussian")
axes.set(xlabel="X residual / error", ylabel="clusters per 0.2")
axes.legend(fontsize=8)
axes.grid(alpha=0.3)

# %% [markdown]
# ## Angle of incidence
#
# In a beam on a nearly plane layer at 1 T, tracks along the drift direction (positive angles) have sharp centroids and
# no lever arm for the micro-TPC fit; for negative angles the micro-TPC is better.

# %%
angles = scan(tiger, "angle", np.linspace(-30, 30, 7), bz=1.0, n=600)
fig, axes = plt.subplots(figsize=(6, 3.6))
for name, (width, error) in angles.curves().items():
    axes.errorbar(angles.values, width, error, marker="o", ms=4, capsize=2, label=name)
axes.set(xlabel="angle of incidence  (deg)", ylabel="core width of X  (µm)", ylim=(0, 700), title=angles.title)
axes.legend(fontsize=8)
axes.grid(alpha=0.3)

# %% [markdown]
# ## Ghosts
#
# Several tracks on a sheet make more crossings of X and V clusters than points. X and V of one particle have the same
# charge and the same time; the score of a pair is the logarithm of the likelihood ratio of both. The track finder uses
# it.

# %%
pairs = cg.run(detector, muon + muon, n=600, seed=3, readout=tiger, until="cluster").clusters
is_pair = pairs["view"] == 2
fig, axes = plt.subplots(figsize=(6, 3.4))
for name, mask in (("one particle", pairs["truth"] >= 0), ("ghosts", pairs["truth"] < 0)):
    axes.hist(pairs["score"][is_pair & mask], np.linspace(-9, 5, 57), histtype="step", label=name)
axes.set(xlabel="score of the pair", ylabel="pairs per 0.25", title="two muons")
axes.legend()
axes.grid(alpha=0.3)

# %%
scan_ghosts(detector, tiger, n=300)
