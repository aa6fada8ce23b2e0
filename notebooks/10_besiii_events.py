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
# # Events of BESIII
#
# Fired cells and strips become tracks without any truth. The events here are simulated as an experiment sees them: with
# noise of a real run, raw drift times, and a start time (t0) that is not known. Files of the experiment go the same way
# ([how to](../docs/how-to/real_events.md)):
#
# ```python
# from cgemit.bes3.events import read_events
# from cgemit.bes3.reconstruct import reconstruct_events
#
# detector = cg.load("besiii-cgem").with_field("besiii").with_readout("tiger")
# result = reconstruct_events(read_events("run.raw", detector))
# ```

# %%
import matplotlib.pyplot as plt

import cgemit as cg

detector = cg.load("besiii-cgem").with_field("besiii")
settings = cg.Settings(
    background=cg.BackgroundSettings(level="run91668", start_time=5.0),
    digitize=cg.DigitizeSettings(wire_times="raw"),
    refine=cg.RefineSettings(start_time="fitted"),
)
sample = cg.sample("pipi-jpsi")  # psi(2S) -> pi+ pi- J/psi, J/psi -> mu+ mu-
result = cg.run(detector, sample, n=150, seed=1, readout="tiger", settings=settings, finder="ckf")
result

# %%
cg.draw.event(result, 1)

# %% [markdown]
# The start time of each event is fitted from its tracks:

# %%
result.start_times

# %% [markdown]
# The page of a run answers the questions of a shift; `cgemit monitor` writes it as HTML.

# %%
page = cg.study.monitor(result)
page.efficiencies

# %%
cg.draw.draw_hit_residuals(detector, cg.study.hit_residuals(result))

# %% [markdown]
# The two fastest tracks of opposite charge are muons of the J/psi. They were fitted as pions, which hardly matters at
# their momentum:

# %%
tracks = result.fitted
fast = tracks[tracks["p"] > 1.0]
pairs = cg.fit_vertices(detector, fast, particles=("mu", "mu"))
good = pairs[pairs["status"] == 0]
masses = good["mass"][(good["mass"] > 2.9) & (good["mass"] < 3.3)]
print(cg.study.measure(1000 * masses, parameter="mass", unit="MeV/c2"))

# %%
figure, axes = plt.subplots(figsize=(6, 3.5))
axes.hist(masses, 30)
_ = axes.set(xlabel="mass of two muons [GeV/c2]", ylabel="pairs")

# %% [markdown]
# What if the chamber is displaced against its description? [Alignment](../docs/how-to/align.md) finds it from tracks.
