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
# # A barrel of silicon
#
# `[layer.NAME]` is a cylinder of any technology that measures where tracks cross it
# ([keys](../docs/methods/detector.md#layers-that-measure-positions)). It builds a barrel of pixels and strips,
# compares it with a formula, adds layers to a preset, and looks at IDEA's tracker.

# %%
import numpy as np

import cgemit as cg

pixel = {"sigma": "5 um", "material": "Si", "thickness": "0.1 mm"}
strip = {"sigma_x": "10 um", "sigma_v": "100 um", "material": "Si", "thickness": "0.3 mm"}
layers = {f"PIX{i}": pixel | {"radius": f"{r} mm"} for i, r in enumerate((20, 30, 40))}
layers |= {f"STRIP{i}": strip | {"radius": f"{r} mm"} for i, r in enumerate((150, 300, 450, 600))}
barrel = cg.load({"name": "barrel", "field": {"bz": "2 T"}, "layer": layers})
barrel

# %%
momenta = np.geomspace(0.3, 50, 30)
cg.draw.resolutions([cg.study.scan_analytic(barrel, momenta, cos_theta=0.0)])

# %% [markdown]
# At high momentum matter does not count, and Gluckstern's formula holds for equal layers, equally spaced
# ([sources](../docs/sources.md)):

# %%
n, length = 11, 1000.0
equal = {f"S{i}": pixel | {"sigma": "10 um", "thickness": "1 um"} for i in range(n)}
for i, one in enumerate(equal.values()):
    one["radius"] = f"{50 + length * i / (n - 1)} mm"
ruler = cg.load({"name": "ruler", "field": {"bz": "2 T"}, "layer": equal})
p = 200.0
expected = 0.010 * p / (0.3e-3 * 2 * length**2) * np.sqrt(720 * (n - 1) ** 3 / ((n - 2) * n * (n + 1) * (n + 2)))
found = cg.analytic(ruler, "mu-", p=p, cos_theta=0.0)
print(f"sigma(p)/p: formula {100 * expected:.3f} %, cgemit {float(found.sigma_p_rel):.3f} %")

# %% [markdown]
# A layer of pixels before the CGEM of BESIII:

# %%
pixels = cg.load({"base": "besiii-cgem-design", "name": "with-pixels", "layer": {"VTX": pixel | {"radius": "35 mm"}}})
names = ("besiii-cgem-design", pixels)
cg.draw.resolutions([cg.study.scan_analytic(one, np.geomspace(0.2, 2, 20), cos_theta=0.0) for one in names])

# %% [markdown]
# Presets of other experiments have such layers, too. A [Delphes card](../docs/methods/detector.md) is read by
# `cg.load("card.tcl")`.

# %%
idea = cg.load("idea-like")
cg.draw.draw_sides(idea)

# %%
cg.draw.draw_budget(cg.analytic(idea, "mu-", p=[0.5, 1, 2, 5, 10, 20]).budget("dr"))

# %% [markdown]
# Simulated, found and fitted tracks confirm the barrel:

# %%
result = cg.run(barrel, cg.Gun("mu-", p=2.0, cos_theta=(-0.7, 0.7)), n=2000, seed=1, finder="ckf")
print(cg.study.pulls(result))
cg.draw.residual(result, "dr")
