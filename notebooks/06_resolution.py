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
# # Resolution without events
#
# `cg.analytic` returns the covariance of a track without events, in about a millisecond. This notebook shows which
# resolution a tracker reaches, its error budget, and its dependence on each number of the design. Where a kernel runs,
# sliders change the design; elsewhere the figures show the preset. Formulas are on [their
# page](../docs/methods/analytic.md).

# %%
import numpy as np
from matplotlib.figure import Figure

import cgemit as cg

detector = cg.load("besiii-cgem-design")
momenta = np.geomspace(0.15, 2, 25)

# %% [markdown]
# ## A curve
#
# Tracks at one momentum differ in azimuth and in their position on the strips, so that their residuals are a mixture of
# Gaussians. `sigma` is its core, as `cg.resolution` measures it, `rms` the root of the mean variance.

# %%
covariance = cg.analytic(detector, "mu-", p=momenta, cos_theta=0.0)
for p, dr, dz, sp in zip(momenta, covariance.sigma_dr, covariance.sigma_dz, covariance.sigma_p, strict=True):
    if p in momenta[::6]:
        print(f"{p:.2f} GeV/c: d_rho {dr:4.0f} um, d_z {dz:.3f} mm, p {sp:5.2f} MeV/c")


# %%
def curves(*designs, quantity="dr", label=r"$\sigma(d_\rho)$  (µm)"):
    """Draw a resolution against momentum for some designs."""
    picture = cg.draw.Picture(figsize=(6.4, 4.0))
    axes = picture.subplots()
    for design in designs:
        found = cg.analytic(design, "mu-", p=momenta, cos_theta=0.0)
        axes.plot(momenta, found.sigma(quantity), label=design.name.replace("+", "\n+"))
    axes.set(xlabel="p  (GeV/c)", ylabel=label, ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return picture


curves(detector, cg.load("besiii-idc"))

# %%
curves(detector, cg.load("besiii-idc"), quantity="dz", label=r"$\sigma(d_z)$  (mm)")

# %% [markdown]
# V strips at a large stereo angle measure $d_z$ better than the inner drift chamber does, by a factor that grows from
# 1.6 at 0.15 GeV/c to 3.6 at 2 GeV/c. In $d_\rho$ the inner drift chamber is better: by 5 % at 0.15 GeV/c, where
# scattering dominates, and 1.5 times above 0.7 GeV/c, where the binary readout of 650 um strips does.
#
# ## Error budget
#
# The variance is a sum of one term for each measurement and each scatterer. The terms sum to the variance exactly.

# %%
budget = covariance.budget("dr")
cg.draw.draw_budget(budget)

# %%
for by in ("part", "cause", "material"):
    shares = {name: 100 * value / budget.total for name, value in budget.grouped(by).items()}
    largest = sorted(shares, key=lambda name: -shares[name][8])[:5]
    print(f"{by:9} at {momenta[8]:.2f} GeV/c: " + ", ".join(f"{name} {shares[name][8]:.0f} %" for name in largest))

# %% [markdown]
# The first layer contributes most, below 0.5 GeV/c by scattering; at 1 GeV/c the strips of all layers contribute half
# of the variance. Gas and wires of the drift chamber dominate the momentum resolution.

# %%
cg.draw.draw_budget(covariance.budget("p"))

# %% [markdown]
# ## What a change does
#
# The derivatives of $\ln\sigma$ by the logarithm of each number of the detector file: how many percent 1 % more of it
# changes the resolution. Hits are held fixed, so that these are derivatives of a smooth function.

# %%
sensitivity = cg.sensitivity(detector, "mu-", p=0.3)
cg.draw.draw_sensitivity(sensitivity, most=10)

# %%
radius, pitch = (float(sensitivity.of(f"cgem.L1.{name}", "dr")) for name in ("anode_radius", "pitch_x"))
print(f"1 mm less radius of L1:   {-100 * radius / 87.5:+.2f} % of sigma(d_rho) at 0.3 GeV/c")
print(f"100 um less pitch of L1:  {-100 * pitch * 100 / 650:+.2f} %")

# %% [markdown]
# ## A design of one's own
#
# `with_overrides` changes any number of the detector file; strip counts and stereo angles follow. With a live kernel
# the sliders below do the same.


# %%
def variant(radius=80.0, pitch=500.0, foils=3):
    """Return the design with another first layer."""
    return detector.with_overrides(
        {"cgem.L1.anode_radius": f"{radius} mm", "cgem.*.pitch_x": f"{pitch} um", "cgem.*.foils": foils}
    )


curves(detector, variant())


# %%
def show(radius=80.0, pitch=500.0, foils=3, p=0.3):
    """Draw the curve of a variant beside its budget."""
    design = variant(radius, pitch, foils)
    found = cg.analytic(design, "mu-", p=p, cos_theta=0.0)
    picture: Figure = cg.draw.draw_budgets(
        {"design": cg.analytic(detector, "mu-", p=p, cos_theta=0.0).budget("dr"), "variant": found.budget("dr")}
    )
    return picture


show()

# %%
try:
    import ipywidgets
except ImportError:
    sliders = 'pip install "cgemit[notebook]" for sliders'
else:
    sliders = ipywidgets.interactive(
        show, radius=(76.0, 100.0, 1.0), pitch=(300.0, 1000.0, 50.0), foils=(1, 3), p=(0.15, 2.0, 0.05)
    )
sliders
