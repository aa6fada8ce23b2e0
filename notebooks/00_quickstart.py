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
# # From a detector to a resolution
#
# Which resolution does a tracker reach, and what should change? This notebook loads the CGEM inner tracker of BESIII
# with the outer drift chamber, follows muons through it, looks at one track, measures resolutions, and compares a
# variant. Units are mm, ns, GeV, GeV/c, T and rad throughout ([conventions](../docs/conventions.md)).

# %%
import numpy as np

import cgemit as cg

# %% [markdown]
# ## A detector
#
# Presets are TOML files with a source beside each number. `besiii-cgem-design` is the detector of arXiv:1504.02570, and
# `detector.cgem["L1"]` its first layer.

# %%
cg.detectors()

# %%
detector = cg.load("besiii-cgem-design")
detector

# %%
cg.draw.draw_detector(detector)

# %% [markdown]
# ## Events
#
# A gun shoots particles: a number is fixed, a tuple a uniform range, a list the values in turn. `run` simulates,
# digitizes, clusters and fits. The same seed gives the same result, whatever the number of threads.

# %%
gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))
result = cg.run(detector, gun, n=2000, seed=1)
result

# %% [markdown]
# Every stage leaves a table: plain numpy columns, one row per object, described in the [data
# model](../docs/data_model.md). `table[0]` is a row and `table[:10]` a table. Links between tables are row numbers.
# Here is the truth behind the first X cluster:

# %%
result.clusters

# %%
first = int(np.flatnonzero(result.clusters["view"] == 0)[0])
truth = int(result.clusters["truth"][first])
measured, true = result.clusters["phi"][first], result.truths["phi"][truth]
print(f"layer {result.clusters['layer'][first]}: phi measured {measured:.5f}, true {true:.5f} rad")

# %% [markdown]
# ## One track
#
# The drift gaps are crossed where the circles are; crosses are reconstructed clusters, small circles drift distances.
# In a script, `.show()` opens a window.

# %%
cg.draw.event(result, 0)

# %%
track = {name: result.tracks[name][0] for name in ("dr", "phi0", "kappa", "dz", "tanl", "p", "chi2", "ndf")}
{name: round(float(value), 4) for name, value in track.items()}

# %% [markdown]
# ## Resolution
#
# A resolution is never one number: the width of the core, the half-width that holds 68.3 %, the RMS and the share of
# tails, each with its error. Pulls (residual over estimated error) tell whether the errors can be believed.

# %%
cg.resolution(result.tracks, "p")

# %%
cg.draw.residual(result, "p")

# %% [markdown]
# The core of a pull has the width 1 where the errors are right. The plain RMS is larger: delta electrons and hard
# scatters make tails, which no Gaussian error describes.

# %%
cg.study.pulls(result)

# %% [markdown]
# ## A variant
#
# What does a finer first layer bring? A variant needs a base, a name and the changed values. The seed is the same, so
# that both designs see the same particles.

# %%
fine = cg.load({"base": "besiii-cgem-design", "name": "fine-L1", "cgem": {"L1": {"pitch_x": "400 um"}}})
variant = cg.run(fine, gun, n=2000, seed=1)
for run in (result, variant):
    print(run.detector.name, cg.resolution(run, "dr"))

# %% [markdown]
# End of the tour. `cg.study.reproduce(output="out")`, or `cgemit study` in a shell, makes every figure of the paper.
