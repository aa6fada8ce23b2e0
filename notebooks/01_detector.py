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
# # What a tracker is made of
#
# A detector is one immutable description: field, matter, strips, wires. This notebook looks at the layers of the CGEM
# tracker of arXiv:1504.02570, adds up their matter, changes them, and computes the sensitivity of the resolutions to
# each number. The keys of a description are listed in [the page on detectors](../docs/methods/detector.md).

# %%
import cgemit as cg
from cgemit.detector.export import describe

detector = cg.load("besiii-cgem-design")
detector

# %%
cg.draw.draw_detector(detector)

# %%
cg.draw.draw_sides(detector)

# %% [markdown]
# ## One layer
#
# From inside: cathode, drift gap, three GEM foils with gaps, anode with X and V strips. The stereo angle follows from
# the number of strips and the length, so that V strips run from one corner of a sheet to the other.

# %%
first = detector.cgem[0]
first

# %%
{"X strips": first.strips_x, "V strips": first.strips_v, "X radius [mm]": first.r_readout}

# %% [markdown]
# ## Matter
#
# `describe` adds up what lies between the beam line and the last wire, in per cent of a radiation length at normal
# incidence.

# %%
rows = describe(detector)["material"]
parts = [row for row in rows if row["part"] != "chamber gas"]
{row["part"]: round(row["x0_percent"], 4) for row in parts}

# %%
gas = sum(row["x0_percent"] for row in rows if row["part"] == "chamber gas")
print(f"inside the chamber {sum(row['x0_percent'] for row in parts):.2f} % of X0, gas of the chamber {gas:.2f} %")

# %% [markdown]
# ## Variants
#
# A variant changes some keys; dependent values are recomputed. `bounds` gives the range of a number in which parts do
# not overlap.

# %%
detector.bounds("cgem.L2.anode_radius")

# %%
coarse = detector.with_overrides({"cgem.*.pitch_x": "900 um", "name": "coarse"})
coarse.cgem[0]

# %% [markdown]
# A wrong description is refused, with every problem at once:

# %%
try:
    detector.with_overrides({"cgem.L1.pitch_x": "3 kg", "cgem.L2.anode_radius": "60 mm"})
except cg.DetectorError as error:
    print(error)

# %% [markdown]
# ## Sensitivities
#
# `sensitivity` gives the change of each resolution for 1 % more of each number of the design, `budget` splits the
# variance of one by its causes ([how](../docs/methods/analytic.md)).

# %%
cg.sensitivity(detector, "mu-", p=1.0)

# %%
cg.draw.draw_budget(cg.analytic(detector, "mu-", p=[0.2, 0.5, 1.0, 1.5]).budget("dr"))

# %%
scans = [cg.study.scan_analytic(one, [0.2, 1.5], cos_theta=0.0) for one in (detector, coarse)]
cg.draw.resolutions(scans)

# %% [markdown]
# [A detector of your own](../docs/how-to/own_detector.md) starts from nothing.
