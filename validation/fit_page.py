"""The section of docs/validation.md on the fit, written from validation/results."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from cgemit.reconstruction.fit import LOSSES
from fit_results import ANGLES, DETECTORS, MOMENTA, PARTICLES, Chi2, FitResults, Pull, Width
from results import table

_HEAD = """
# The fit beside what it promises

Pulls, chi-square, residuals and widths of fitted tracks over momentum, angle, charge, particle and detector, written by

```sh
python validation/fit.py
```

(twenty minutes; `--quick` takes five, with 2000 tracks a point; `--only` renews some points). {versions}.
{events}.

Muons and pions of both charges at {light} GeV/c, K- and protons at {heavy} GeV/c, cos(theta) {angles}, a random seed
for each point. Particles do not decay in flight (`decays=False`). Pulls are those of the helix parameters and of p.
Numbers beyond their tolerance are set in bold type.

## All Gaussian

`fluctuations="gaussian"`, read-out `gaussian`, sides known: simulation and read-out do exactly what the fit assumes.
**Width and mean of every pull have to be within 0.02 or four standard errors of 1 and 0** (0.1 at 0.1 GeV/c), those of
every layer's residuals (hit against the track fitted without it) too, and **the chi-square probability flat**
(Kolmogorov-Smirnov, probability above 1/16000). Pulls beyond 8 are no fluctuations: such tracks have ended at another
helix. They are counted, at the worst point, and left out of the widths.

![Pulls against momentum](images/validation-fit-pulls.png)

Largest deviations over parameters, angles, particles and charges:
"""

_OFF = """
Beyond the tolerance{where}, with the mean residual over the root mean square of the errors (bias){expected}:
"""
_EXPECTED = """, and both
as the optimal estimate must have them (`validation/optimal.py`, which knows nothing of the fit)"""

_OFF_WHY = """
Here the error of a track depends on what was found: a slow, inclined track meets the more matter the steeper it is, and
the more curved it is the more it scatters. Tracks that are found too steep get larger errors, and the mean of the pull
moves although that of the residual does not. Least squares with errors worked out at the estimate cannot have another
mean: it is the bias, less the covariance of the estimate and the logarithm of its error. No estimate that is unbiased
gets nearer to 0. What bias there is, is of second order in what the hits do not show of the angles.
"""

_SLOW = """
The same, and for the same reason: where kappa of a track came out too large, so did its error, and the means are those
of the pulls, not of the residuals. (The optimum is not worked out where tracks turn back after 0.4 m: there second
derivatives are not enough.)
"""

_RESIDUALS = """
![Pulls of residuals](images/validation-fit-residuals.png)

Residuals of all layers in {detector}: {rows} pulls, {off} beyond the tolerance{named}.
"""

_HIDDEN = """
With sides to be found, in {detector}, widths have to be within 0.05:
"""

_DEFAULT = """
## Default simulation

Strips, delta electrons, single scattering, straggling to W_max, sides to be found. **The core of every pull has to have
a width of 1 ± 0.06 and a mean within 0.08, for kappa and p up to 0.2 GeV/c 1 ± 0.15 and 0.2, or four standard
errors.** The tail is what lies beyond three core widths, 0.27 % of a Gaussian.
"""

_OPTIMUM = """
## Against the optimal linear estimate

Core widths where all is Gaussian over those of generalised least squares with the same noise model, worked out by other
means: a track followed in plain numpy, differentiated by its parameters and by every scattering angle and loss
(`validation/optimal.py`), about the helices of ten fitted tracks. Errors differ with the layers that are hit, so the
optimum of a sample is the median error of its tracks times the median ratio of the optimum to the fit's own error of a
track. **sigma(d_rho), sigma(d_z), sigma(p) have to be within 3 %.**
"""

_LOSSES = """
## Which loss to subtract

Core of the pull of kappa, default simulation, {events}.
The default is `truncated` ([matter](methods/matter.md) says why).

![Losses, sides, and widths over the optimum](images/validation-fit-choices.png)
"""

_SIDES = """
## Left or right

Default simulation, {events}: hits for which the fit is on the wrong
side of the wire. **Beyond two standard deviations (0.26 mm) less than 0.1 % have to be, and sigma(p) at 1 GeV/c must
not lose 3 %.** GENFIT's annealing filter has 0.03 %.
"""


def fit_section(results: FitResults) -> str:
    """Return the section as Markdown."""
    about = results.about["pulls"]
    light, heavy, angles = (
        ", ".join(f"{value:g}" for value in values) for values in (PARTICLES["mu-"], PARTICLES["K-"], ANGLES)
    )
    parts = [
        _HEAD.format(**about, light=light, heavy=heavy, angles=angles),
        _pull_table(results, "gaussian"),
        _off_table(results, slow=False),
        _off_table(results, slow=True),
    ]
    parts.append(_residual_text(results))
    parts += [_HIDDEN.format(detector=DETECTORS[0]), _pull_table(results, "hidden")]
    parts += [_DEFAULT, _pull_table(results, "default"), _OPTIMUM, _width_table(results.widths)]
    parts += [_LOSSES.format(events=results.about["losses"]["events"]), _loss_table(results)]
    parts += [_SIDES.format(events=results.about["sides"]["events"]), _side_table(results), _known_table(results)]
    return "".join(parts)


def _groups(results: FitResults, mode: str) -> Iterable[tuple[str, float, list[Pull], list[Chi2]]]:
    """Return detector and momentum with their pulls and chi-squares."""
    for name, p in itertools.product(DETECTORS, MOMENTA):
        pulls = [row for row in results.pulls if (row.mode, row.detector, row.p) == (mode, name, p)]
        if pulls:
            yield name, p, pulls, [row for row in results.chi2 if (row.mode, row.detector, row.p) == (mode, name, p)]


def _pull_table(results: FitResults, mode: str) -> str:
    tail = "tail of kappa, %" if mode == "default" else "flat, least | beyond 8, of 10⁴"
    lines = []
    for name, p, pulls, chi2 in _groups(results, mode):
        off = sum(not row.agrees for row in pulls)
        lost = sum(row.lost for row in chi2) / sum(row.lost + row.n for row in chi2)
        widest = max(pulls, key=lambda row: abs(row.width - 1) / row.tolerances[0])
        farthest = max(pulls, key=lambda row: abs(row.mean) / row.tolerances[1])
        cells = [f"{widest.width:.3f} ± {widest.width_error:.3f}", _where(widest)]
        cells += [f"{farthest.mean:+.3f} ± {farthest.mean_error:.3f}", _where(farthest)]
        tails = [row.tail for row in pulls if row.parameter == "kappa"]
        far = 1e4 * max(row.tail for row in pulls)
        cells.append(f"{100 * sum(tails) / len(tails):.1f}" if mode == "default" else f"{_flat(chi2)} | {far:.1f}")
        lines.append([name, f"{p:g}", *cells, f"{100 * lost:.2f}", f"**{off}** of {len(pulls)}" if off else "0"])
    head = ["detector", "p, GeV/c", "width", "of", "mean", "of", tail, "lost, %", "off"]
    return table(head, lines)


def _off_table(results: FitResults, slow: bool) -> str:
    off = [row for row in results.pulls if row.mode == "gaussian" and not row.agrees and (row.p < 0.15) == slow]
    lines = []
    for row in off:
        point = [row.detector, row.particle, f"{row.p:g}", f"{row.cos_theta:g}", row.parameter]
        numbers = [f"{row.width:.3f}", f"{row.mean:+.4f} ± {row.mean_error:.4f}", f"{row.bias:+.4f}"]
        expected = [f"{row.expected_mean:+.4f}", f"{row.expected_bias:+.4f}"]
        lines.append([*point, *numbers] if slow else [*point, *numbers, *expected])
    if not lines:
        return ""
    head = ["detector", "particle", "p, GeV/c", "cos(theta)", "parameter", "width", "mean", "bias"]
    if slow:
        return _OFF.format(where=" at 0.1 GeV/c", expected="") + table(head, lines) + _SLOW
    text = _OFF.format(where=" from 0.2 GeV/c on", expected=_EXPECTED)
    return text + table([*head, "mean, optimal", "bias, optimal"], lines) + _OFF_WHY


def _residual_text(results: FitResults) -> str:
    off = [row for row in results.residuals if not row.agrees]
    named = ",".join(
        f"\n{row.parameter} of {row.particle} at {row.p:g} GeV/c, cos(theta) {row.cos_theta:g} ({row.n:,.0f} hits, "
        f"width {row.width:.3f}, mean {row.mean:+.4f} ± {row.mean_error:.4f})"
        for row in off
    )
    return _RESIDUALS.format(
        detector=DETECTORS[0], rows=len(results.residuals), off=len(off), named=":" + named if off else ""
    )


def _where(row: Pull) -> str:
    return f"{row.parameter}, {row.particle}, {row.cos_theta:g}" + ("" if row.agrees else " **(off)**")


def _flat(rows: Sequence[Chi2]) -> str:
    least = min(rows, key=lambda row: row.flat)
    return f"{least.flat:.2g}" if least.agrees else f"**{least.flat:.1g} ({least.particle}, {least.cos_theta:g})**"


def _width_table(rows: Sequence[Width]) -> str:
    quoted = {"dr": ("sigma(d_rho), um", 1000.0), "dz": ("sigma(d_z), mm", 1.0), "p": ("sigma(p), MeV/c", 1000.0)}
    lines = []
    muons = [row for row in rows if row.particle.startswith("mu")]
    for name, p, angle in itertools.product(DETECTORS, MOMENTA, ANGLES):
        cells = []
        for quantity, (_, scale) in quoted.items():
            found = [row for row in muons if (row.detector, row.p, row.cos_theta) == (name, p, angle)]
            found = [row for row in found if row.quantity == quantity]
            if found:
                ratio = sum(row.ratio for row in found) / len(found)
                optimal = scale * sum(row.optimal for row in found) / len(found)
                cells += [f"{optimal:.4g}", f"{ratio:.3f}" + ("" if all(row.agrees for row in found) else " **(off)**")]
        if cells:
            lines.append([name, f"{p:g}", f"{angle:g}", *cells])
    head = ["detector", "p, GeV/c", "cos(theta)", *(f"optimal {text} | ratio" for text, _ in quoted.values())]
    return table(head, lines)


def _loss_table(results: FitResults) -> str:
    lines = []
    for p in dict.fromkeys(row.p for row in results.losses):
        found = {row.loss: row for row in results.losses if row.p == p}
        cells = []
        for loss in LOSSES:
            row = found[loss]
            cells += [f"{row.width:.3f} ± {row.width_error:.3f}", f"{row.mean:+.3f} ± {row.mean_error:.3f}"]
        lines.append([f"{p:g}", *cells])
    return table(["p, GeV/c", *(f"{loss}: width | mean" for loss in LOSSES)], lines)


def _side_table(results: FitResults) -> str:
    lines = []
    for row in results.sides:
        if row.n:
            share = f"{100 * row.wrong / row.n:.4f}"
            cells = [f"{row.n:.0f}", f"{row.wrong:.0f}", share]
            lines.append([f"{row.p:g}", f"{row.first:g} to {row.last:g}", *cells])
    return table(["p, GeV/c", "drift distance, mm", "hits", "wrong", "wrong, %"], lines)


def _known_table(results: FitResults) -> str:
    lines = []
    for row in results.known:
        far = [side for side in results.sides if side.p == row.p and side.first >= 0.259]
        share = sum(side.wrong for side in far) / sum(side.n for side in far)
        cells = [f"{1000 * row.known:.4g}", f"{1000 * row.hidden:.4g}", f"{row.ratio:.4f} ± {row.ratio_error:.4f}"]
        lines.append([f"{row.p:g}", *cells, f"{100 * share:.4f}"])
    head = ["p, GeV/c", "sigma(p) sides known, MeV/c", "to be found", "ratio", "wrong beyond 0.26 mm, %"]
    return table(head, lines)
