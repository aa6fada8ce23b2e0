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
# # From ionization to charge and time on strips
#
# A readout turns the crossing of a drift gap into digis: strips with a charge and a time. This notebook follows the
# electrons of a muon to the strips of one layer, compares the readouts, and shows what each effect does. Formulas and
# sources are in [the analog readout](../docs/methods/readout.md) and [digitization](../docs/methods/digitize.md).

# %%
import matplotlib.pyplot as plt
import numpy as np

import cgemit as cg
from cgemit.detector.gas import transport
from cgemit.study.readout.scan import formation

detector = cg.load("besiii-cgem-design")
muon = cg.Gun("mu-", p=1.0, cos_theta=(-0.93, 0.93))

# %% [markdown]
# ## One track on its way to the strips
#
# Electrons of ionization drift to the first GEM foil, multiply in three foils, and induce currents on the strips. In a
# magnetic field they drift at the Lorentz angle, and diffusion widens the cloud. The muon crosses at 20 degrees, nearly
# along the drift: with the Lorentz angle its charge reaches few strips.

# %%
cg.draw.draw_formation(formation(cg.TigerReadout(), angle=20.0, bz=1.0, seed=1))

# %% [markdown]
# ## Drift in Ar/iC4H10
#
# Velocity, Lorentz angle and diffusion come from tables of Magboltz. At 1 T the Lorentz angle falls with the drift
# field, and with it the width of a cluster.

# %%
fields = np.linspace(1.0, 3.0, 21)
drift = [transport("ar-ic4h10-90-10", field, 1.0) for field in fields]
fig, (left, right) = plt.subplots(1, 2, figsize=(8, 3.2))
left.plot(fields, [np.degrees(np.arctan(one.tan_lorentz)) for one in drift])
left.set(xlabel="drift field  (kV/cm)", ylabel="Lorentz angle  (deg)", title="1 T")
right.plot(fields, [1000 * np.sqrt(10) * one.sigma_x for one in drift], label="across B")
right.plot(fields, [1000 * np.sqrt(10) * one.sigma_par for one in drift], label="along B")
right.set(xlabel="drift field  (kV/cm)", ylabel="diffusion  (µm/√cm)", title="1 T")
right.legend()
fig.tight_layout()

# %% [markdown]
# ## The same muons in four readouts
#
# `binary` fires the strips that the projected path touches. `analog-projection` integrates a charge profile along it.
# `tiger` and `apv25` follow every electron, and their chips measure charge and time. All give the same table.

# %%
runs = {
    name: cg.run(detector, muon, n=500, seed=1, readout=name, until="digitize")
    for name in ("binary", "analog-projection", "tiger", "apv25")
}
for name, run in runs.items():
    x = run.digis["view"] == 0
    strips, charge = x.sum() / len(run.truths), run.digis["charge"][x].mean()
    print(f"{name:18} {strips:.2f} X strips a crossing, {charge:5.1f} fC a strip")

# %%
runs["tiger"].digis

# %% [markdown]
# Charges of a binary readout are shares of the deposit. A chip sees fluctuations of ionization and gain, loses charge
# below its threshold (2 and 1.67 fC) and saturates at 48 fC (TIGER) or 60 fC (APV25).

# %%
fig, axes = plt.subplots(figsize=(6, 3.4))
for name in ("tiger", "apv25"):
    digis = runs[name].digis
    axes.hist(digis["charge"], np.linspace(0, 62, 63), histtype="step", label=f"{name}, {len(digis)} strips")
axes.set(xlabel="charge of a strip  (fC)", ylabel="strips per fC", yscale="log", title="500 muons of 1 GeV/c")
axes.legend()
axes.grid(alpha=0.3)

# %% [markdown]
# ## Times
#
# The time of a strip is the time of flight, the drift from where its electrons started, and the delay of the chip. Its
# spread of some 140 ns is the drift through 5 mm of gas: this is what the micro-TPC fit uses.

# %%
fig, axes = plt.subplots(figsize=(6, 3.4))
for name in ("tiger", "apv25"):
    digis = runs[name].digis
    axes.hist(digis["time"][digis["layer"] == 0], np.linspace(100, 420, 65), histtype="step", label=name)
axes.set(xlabel="time of a strip  (ns)", ylabel="strips per 5 ns", title="innermost layer")
axes.legend()
axes.grid(alpha=0.3)

# %% [markdown]
# ## What each effect does
#
# Every effect has a switch. Without the Lorentz angle a muon of 1 GeV/c would fire three X strips instead of four.

# %%
switches = {"all effects": {}, "no diffusion": {"diffusion": 0.0}, "no Lorentz angle": {"lorentz": False},
            "no gain fluctuation": {"gain_fluctuation": False}, "gain 40 000": {"gain": 40_000.0}}  # fmt: skip
for name, values in switches.items():
    run = cg.run(detector, muon, n=300, seed=1, readout=cg.TigerReadout(**values), until="digitize")
    x = run.digis["view"] == 0
    strips, charge = x.sum() / len(run.truths), run.digis["charge"][x].mean()
    print(f"{name:20} {strips:.2f} X strips a crossing, {charge:5.1f} fC a strip")

# %% [markdown]
# ## Dead strips and gain maps
#
# A detector file may list dead and hot strips and the gain of parts of a sheet
# ([detector](../docs/methods/detector.md)). All other digis stay the same.

# %%
worn = detector.with_overrides({"cgem.L1.dead_x": ["0:200-260"], "cgem.L1.gain_map": [[[1.0, 1.0, 0.6, 1.0]]]})
strips = np.arange(0, detector.cgem[0].strips_x + 1, 13)
fig, axes = plt.subplots(figsize=(7, 3.2))
for name, one in (("as designed", detector), ("dead strips 200 to 260, gain 0.6 in the third quarter", worn)):
    digis = cg.run(one, muon, n=3000, seed=1, readout="analog-projection", until="digitize").digis
    here = (digis["layer"] == 0) & (digis["view"] == 0)
    axes.hist(digis["strip"][here], strips, weights=digis["charge"][here] / 1000, histtype="step", label=name)
axes.set(xlabel="X strip of the innermost layer", ylabel="charge per 13 strips  (pC)", ylim=(0, None))
axes.legend(loc="lower right", fontsize=8)
axes.grid(alpha=0.3)
