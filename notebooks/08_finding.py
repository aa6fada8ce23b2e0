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
# # Finding tracks
#
# In the other notebooks, hits are assigned to tracks by truth. `finder="ckf"` finds tracks from clusters and wire hits
# alone. This notebook looks at one event with background, measures the efficiency, and finds K_S mesons by their mass.
# Methods are in [finding](../docs/methods/find.md), [background](../docs/methods/background.md),
# [samples](../docs/methods/samples.md) and [vertices](../docs/methods/vertex.md).

# %%
import numpy as np
from scipy.stats import norm

import cgemit as cg

detector = cg.load("besiii-cgem")
noise = cg.Settings(background=cg.BackgroundSettings(level="bes2026"), find=cg.FindSettings(hypothesis="pi"))

# %% [markdown]
# ## An event
#
# A sample replaces the gun. Here are pi+ pi- J/psi, J/psi → mu+ mu-, with cells and strips that fire without a
# particle, as at BESIII.

# %%
one = cg.run(detector, cg.sample("pipi-jpsi"), n=1, seed=4, settings=noise, finder="ckf")
cg.draw.event(one)

# %% [markdown]
# Most wire hits of this event come from no particle. The four particles have a track each.

# %%
foreign = np.count_nonzero(one.wire_hits["wire_truth"] < 0)
print(f"{len(one.wire_hits)} wire hits, {foreign} of no particle")
for track, purity in enumerate(one.tracks["purity"]):
    print(
        f"track {track}: p = {one.tracks['p'][track]:.3f} GeV/c, {100 * purity:.0f} % of its hits are of its particle"
    )

# %% [markdown]
# ## Efficiency, fakes, clones
#
# `cg.study.finding` compares candidates with particles, as Belle II and ACTS do. A particle is findable if it left
# enough hits; the table says how many particles each condition removes.

# %%
gun = cg.Gun("pi+", pt=(0.05, 0.5), cos_theta=(-0.9, 0.9))
quiet = cg.Settings(find=cg.FindSettings(hypothesis="pi"), simulate=cg.SimulateSettings(decays=False))
found = cg.study.finding(cg.run(detector, gun, n=2000, settings=quiet, finder="ckf", until="find"))
found


# %%
def efficiency(found):
    """Draw the efficiency in bins of pT, cos(theta) and phi."""
    ranges = {"pt": (0.05, 0.5), "cos_theta": (-0.9, 0.9), "phi": (-np.pi, np.pi)}
    curves = {name: {} for name in ranges}
    for name, limits in ranges.items():
        edges = np.linspace(*limits, 13)
        bins = found.against(name, edges)
        low, high = np.array([one.interval() for one in bins]).T
        curves[name] = {
            "low": edges[:-1], "high": edges[1:], "findable": np.array([one.n for one in bins]),
            "efficiency": np.array([one.value for one in bins]), "efficiency_low": low, "efficiency_high": high,
        }  # fmt: skip
    return cg.draw.draw_finding(curves, f"{found.detector}, findable pi+, finder {found.finder}")


efficiency(found)

# %% [markdown]
# ## How much background can it take?
#
# A given share of all cells fires in clumps of neighbours, within the drift time. At 20 %, there are more foreign hits
# than hits of four muons.

# %%
for share in (0.0, 0.05, 0.1, 0.2):
    stress = cg.Settings(background=cg.BackgroundSettings(cells=share))
    muons = cg.Gun("mu-", pt=(0.3, 1.5), cos_theta=(-0.8, 0.8), multiplicity=4)
    result = cg.run(detector, muons, n=40, settings=stress, finder="ckf", until="find")
    rates = cg.study.finding(result).rates()
    print(f"{100 * share:2.0f} % of the cells: efficiency {rates.efficiency}, fakes {rates.fakes.count}")

# %% [markdown]
# ## The mass of the K_S
#
# `ks-pipi` are K_S that fly and decay to pi+ pi-. All pairs of found tracks of opposite charge are fitted to a vertex,
# with background, and the mass has an error from both covariances.

# %%
kaons = cg.run(detector, cg.sample("ks-pipi"), n=1500, settings=noise, finder="ckf")
vertices = cg.fit_vertices(detector, kaons.tracks)
good = (vertices["status"] == 0) & (vertices["chi2"] < 10)
mass, error = 1000 * vertices["mass"][good], 1000 * vertices["err_mass"][good]
peak = cg.study.measure(mass[np.abs(mass - 497.6) < 25], parameter="mass", unit="MeV/c2")
peak


# %%
def spectrum(mass, peak):
    """Draw the masses and the Gaussian of their core."""
    picture = cg.draw.Picture(figsize=(6.4, 4.0))
    axes = picture.subplots()
    edges = np.linspace(470, 525, 56)
    axes.hist(mass, edges, color="#4878a8", alpha=0.7, label=f"pairs of found tracks, {len(mass)}")
    x = np.linspace(edges[0], edges[-1], 300)
    inside = np.count_nonzero(np.abs(mass - peak.core_mean) < 3 * peak.core)
    law = inside * (edges[1] - edges[0]) * norm.pdf(x, peak.core_mean, peak.core)
    axes.plot(x, law, color="#c44e52", label=f"core: {peak.core_mean:.2f} ± {peak.core_mean_error:.2f}, "
              f"σ = {peak.core:.2f} ± {peak.core_error:.2f} MeV/c²")  # fmt: skip
    axes.axvline(497.611, color="0.4", linestyle=":", ymax=0.7, label="K_S, 497.611 MeV/c²")
    axes.set(xlabel="m(π⁺π⁻)  (MeV/c²)", ylabel="pairs in 1 MeV/c²", ylim=(0, 1.45 * axes.get_ylim()[1]))
    axes.legend(fontsize=8, loc="upper left")
    return picture


spectrum(mass, peak)

# %% [markdown]
# ## Is the error of the mass right?
#
# The pull of the mass has a width near 1. Vertices beyond the beam pipe are left out: the fit of a track adds matter
# there that a pion from outside the pipe never crossed.

# %%
inside = np.hypot(vertices["x"], vertices["y"])[good] < 28
pull = ((mass - 497.611) / error)[inside & (np.abs(mass - 497.6) < 25)]
cg.study.measure(pull, parameter="pull of the mass")

# %% [markdown]
# ## Resolution without truth
#
# Both halves of a cosmic muon are found as two tracks. Their difference over √2 is the resolution, and agrees with the
# true residuals.

# %%
cg.study.cosmics(cg.run(detector, cg.sample("cosmic"), n=1500, finder="ckf"))
