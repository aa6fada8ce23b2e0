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
# # Hits of a test beam
#
# Four precise layers and a device under test in a beam of pions, without a field. `fit_hits` takes the hits as columns,
# from any program ([how to](../docs/how-to/own_hits.md)). Here they are simulated, so that the right answer is known.

# %%
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import cgemit as cg

reference = {"sigma": "10 um", "material": "Si", "thickness": "0.1 mm"}
layers = {f"T{i}": reference | {"radius": f"{r} mm"} for i, r in enumerate((100, 150, 250, 300))}
layers["DUT"] = reference | {"radius": "200 mm", "sigma": "60 um"}
setup = cg.load({"name": "beam", "field": {"bz": "0 T"}, "layer": layers})
[(number, layer.label) for number, layer in enumerate(setup.layers)]

# %%
beam = cg.Gun("pi-", p=10.0, theta=np.pi / 2, phi=(-0.1, 0.1))
run = cg.run(setup, beam, n=4000, seed=1, until="cluster")
points = run.clusters[run.clusters["view"] == 2]
hits = points.to_pandas()[["event", "layer", "phi", "z"]]
hits.head()

# %% [markdown]
# These are the columns that a file of a test beam would have. The analysis begins here. The errors of the device are
# not known: the first guess is 100 um. A track in no field needs the momentum of the beam for its scattering.

# %%
radius = np.array([layer.radius for layer in setup.layers])[hits["layer"]]
device = 2


def fitted(sigma: float) -> pd.DataFrame:
    """Return the residuals of all hits, each from the track fitted without it."""
    errors = np.where(hits["layer"] == device, sigma, 0.010)  # mm
    columns = hits.assign(err_phi=errors / radius, err_z=errors)
    how = cg.FitSettings(momentum=10.0, residuals=True, outlier_pull=0)
    return cg.fit_hits(setup, columns, hypothesis="pi", settings=how)["residuals"].to_pandas()


found = fitted(0.100)
x = found[(found["layer"] == device) & (found["view"] == 0)]
print(cg.study.measure(1000 * x["residual"].to_numpy(), parameter="residual in X", unit="um"))
print(cg.study.measure(x["pull"].to_numpy(), parameter="pull", unit=""))

# %% [markdown]
# The width of the pull tells by how much the guess was wrong, but for the error of the track. The error of the device
# follows from residual and error of the track, whose variances add up:

# %%
track = x["err"] ** 2 - 0.100**2
sigma = float(np.sqrt(np.mean(x["residual"] ** 2 - track)))
again = fitted(sigma)
good = again[(again["layer"] == device) & (again["view"] == 0)]
print(f"device: {1000 * sigma:.1f} um (true: 60), width of the pull now {good['pull'].std():.3f}")

# %%
figure, axes = plt.subplots(figsize=(6, 3.5))
for frame, name in ((x, "errors of 100 um"), (good, f"errors of {1000 * sigma:.0f} um")):
    axes.hist(frame["pull"], np.linspace(-5, 5, 61), histtype="step", label=name)
axes.set(xlabel="pull of X in the device", ylabel="tracks")
_ = axes.legend()

# %% [markdown]
# A shift of the device shows as a mean residual. Here the hits of the device are moved by 50 um in z:

# %%
hits.loc[hits["layer"] == device, "z"] += 0.050
moved = fitted(sigma)
z = moved[(moved["layer"] == device) & (moved["view"] == 1)]
print(cg.study.measure(1000 * z["residual"].to_numpy(), parameter="residual in V", unit="um"))
