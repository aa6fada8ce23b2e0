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
# # A detector from an empty file
#
# A detector file is TOML, with a unit beside each number. This notebook writes one from nothing: first three layers,
# then a beam pipe and a drift chamber, and looks at the result after each step. All keys are on [the page on
# detectors](../docs/methods/detector.md).

# %%
from pathlib import Path

import cgemit as cg

text = """
name = "mine"

[field]
bz = "-1 T"

[cgem.L1]
anode_radius = "80 mm"
length = "500 mm"
sheets = 1
phi_first = "0 deg"
pitch_x = "500 um"
pitch_v = "500 um"
drift_gap = "4 mm"
transfer_gap = "2 mm"
induction_gap = "2 mm"
gas = "Gas"
cathode = [{ label = "Kapton", material = "Kapton", thickness = "50 um" }]
foil = [
  { label = "Cu in", material = "Cu", thickness = "3 um" },
  { label = "Kapton", material = "Kapton", thickness = "50 um" },
  { label = "Cu out", material = "Cu", thickness = "3 um" },
]
anode = [{ label = "Kapton", material = "Kapton", thickness = "100 um" }]

[cgem.L2]
like = "L1"                       # a copy of L1; strips and stereo angle are computed anew
anode_radius = "120 mm"

[cgem.L3]
like = "L1"
anode_radius = "160 mm"

[materials.Gas]
density = "1.66e-3 g/cm3"
composition = { Ar = 0.95, C = 0.04, H = 0.01 }
gas = true
"""
Path("mine.toml").write_text(text, encoding="utf-8")
detector = cg.load("mine.toml")
detector

# %% [markdown]
# The stereo angle follows from the number of strips and the length of a layer: V strips run from one corner of a sheet
# to the other. Mistakes are listed all at once, with the place, the given and the expected value:

# %%
try:
    detector.with_overrides({"cgem.L1.pitch_x": "3 kg", "cgem.L2.anode_radius": "60 mm"})
except cg.DetectorError as error:
    print(error)

# %% [markdown]
# Three layers alone hardly measure a momentum. A second file adds a beam pipe and a chamber of 24 wire layers: it names
# the first one as its base and states only what is new.

# %%
more = """
base = "mine.toml"
name = "with-chamber"

[beam_pipe.pipe]
r_in = "30 mm"
r_out = "30.8 mm"
half_length = "150 mm"
material = "Be"

[drift_chamber]
gas = "MdcGas"
sigma = "120 um"
half_length = "1000 mm"

[drift_chamber.superlayers.stereo]
layers = 16
r_in = "200 mm"
cells = "12 mm"
stereo = ["60 mrad", "-60 mrad"]

[drift_chamber.superlayers.axial]
layers = 8
r_in = "400 mm"
cells = "14 mm"
"""
Path("chamber.toml").write_text(more, encoding="utf-8")
chamber = cg.load("chamber.toml")
cg.draw.draw_sides(chamber)

# %%
cg.draw.draw_material(chamber)

# %% [markdown]
# What does the chamber change? The analytic resolution takes milliseconds.

# %%
for one in (detector, chamber):
    print(cg.analytic(one, "mu-", p=0.5, cos_theta=0.0))

# %%
cg.draw.draw_budget(cg.analytic(chamber, "mu-", p=[0.2, 0.5, 1.0, 1.5]).budget("p"))

# %% [markdown]
# The same detector goes through the whole chain, here without truth in finding and fit:

# %%
result = cg.run(chamber, cg.Gun("mu-", p=(0.3, 1.0), cos_theta=(-0.7, 0.7)), n=500, seed=1, finder="ckf")
print(cg.study.finding(result))
cg.draw.event(result, 0)

# %% [markdown]
# [Sweeps](../docs/how-to/sweeps.md) and [optimization](../docs/how-to/optimize.md) vary such a file.
