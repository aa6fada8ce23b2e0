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
# # Resolution against the polar angle
#
# The second plot of every tracker paper: resolutions against cos(theta), analytic and simulated, for momenta and
# particles.

# %%
import matplotlib.pyplot as plt
import numpy as np

import cgemit as cg

detector = cg.load("besiii-cgem-design")
angles = np.linspace(-0.92, 0.92, 47)
lines = cg.analytic(detector, "mu-", p=np.array([0.3, 1.0])[:, None], cos_theta=angles)
lines.sigma_dr.shape

# %% [markdown]
# Points are simulated: one run with all angles, its residuals in bins of the true cos(theta).

# %%
gun = cg.Gun("mu-", p=1.0, cos_theta=(-0.92, 0.92))
result = cg.run(detector, gun, n=10_000, seed=1)
points = {name: cg.study.resolution_against(result.tracks, name, by="cos_theta", bins=10) for name in ("dr", "dz", "p")}
points["dr"]

# %%
figure, axes = plt.subplots(1, 3, figsize=(12, 3.6))
for plot, (name, curve) in zip(axes, points.items(), strict=True):
    for i, p in enumerate(lines.p[:, 0]):
        plot.plot(angles, lines.sigma(name)[i], label=f"{p:g} GeV/c")
    core, error = curve.column("core"), curve.column("core_error")
    plot.errorbar(curve.x, core, error, fmt="o", color="black", label="simulated, 1 GeV/c")
    plot.set(xlabel=r"$\cos\theta$", ylabel=f"sigma of {name}")
axes[0].legend()
figure.tight_layout()

# %% [markdown]
# Momentum and angle together, with the number of hits, which falls where tracks leave through an end plate:

# %%
grid = cg.analytic(detector, p=np.geomspace(0.2, 2, 10)[:, None], cos_theta=np.linspace(-0.92, 0.92, 24))
cg.draw.draw_maps(grid)

# %% [markdown]
# Why do resolutions grow with the angle? The budget at three angles: matter counts with 1/sin(theta), and fewer wires
# are hit.

# %%
for cosine in (0.0, 0.6, 0.9):
    budget = cg.analytic(detector, "mu-", p=1.0, cos_theta=cosine).budget("p")
    shares = {name: 100 * float(value / budget.total) for name, value in budget.grouped("cause").items()}
    print(f"cos(theta) {cosine}: sigma(p) {float(np.sqrt(budget.total)):.2f} MeV/c,", end=" ")
    print(", ".join(f"{name} {share:.0f} %" for name, share in shares.items() if share > 1))

# %% [markdown]
# Other particles: protons and kaons of the same momentum scatter more.

# %%
figure, plot = plt.subplots(figsize=(6, 3.6))
for particle in ("mu-", "K-", "proton"):
    plot.plot(angles, cg.analytic(detector, particle, p=0.5, cos_theta=angles).sigma_dr, label=particle)
plot.set(xlabel=r"$\cos\theta$", ylabel="sigma of dr at 0.5 GeV/c [um]")
_ = plot.legend()
