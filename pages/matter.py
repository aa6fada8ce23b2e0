"""docs/methods/matter.md: core of the scattering in thin layers, choices of the energy loss, and electrons."""

from __future__ import annotations

from dataclasses import dataclass

import cgemit as cg
from pages import fit
from pages.page import Found, Numbers, Page, share_of

PARTICLES, TRACKS, SEED = 400_000, 20_000, 1
#: Layer -> the layer in the text, and its matter.
LAYERS = {
    "C 2.0 g/cm3 213.5 um": ("0.1 % X0 of carbon", "carbon"),
    "Cu 14 um": ("14 µm of copper", "copper"),
    "Ar 10 mm": ("1 cm of argon", "thin argon"),
}
SCREENINGS = ("wentzel", "moliere")
#: Preset, momenta (GeV/c) and the error of the momentum that BESIII's would be.
PRECISE, MOMENTA, COARSE = "idea-like", (1.0, 2.0, 5.0), 0.003
ELECTRONS = cg.Gun("e-", p=1.0, cos_theta=(-0.8, 0.8))


@dataclass(frozen=True)
class Layer:
    """Widths (mrad) of the plane angle of muons of 1 GeV/c: of the fit, and simulated with its error."""

    layer: str
    screening: str
    core: float
    q68: float
    q68_error: float


@dataclass(frozen=True)
class Electron:
    """Pull of a quantity of electrons of 1 GeV/c: core width, and per cent beyond three.

    `radiation` is the setting of the fit.
    """

    radiation: bool
    quantity: str
    value: float
    error: float | None
    tail: float | None


def layers(share: float) -> Numbers:
    """Scatter muons in each layer."""
    n, rows = share_of(PARTICLES, share, 2000), []
    for layer in LAYERS:
        for screening in SCREENINGS:
            found = cg.slab(layer, particle="mu-", p=1.0, n=n, seed=SEED, screening=screening)
            error = found.errors["q68_mrad"]
            assert found.core_mrad
            assert found.q68_mrad
            assert error
            rows.append(Layer(layer, screening, found.core_mrad, found.q68_mrad, error))
    return Numbers(rows, {"events": f"{n:,} mu- each, seed {SEED}"})


def electrons(share: float) -> Numbers:
    """Fit electrons with and without their radiation."""
    n, rows = share_of(TRACKS, share, 400), []
    for radiation in (True, False):
        settings = cg.Settings(fit=cg.FitSettings(radiation=radiation))
        result = cg.run("besiii-cgem-design", ELECTRONS, n, SEED, settings=settings)
        pulls = cg.study.pulls(result)
        for name in ("kappa", "dz", "tanl"):
            rows.append(Electron(radiation, name, pulls[name].core, pulls[name].core_error, 100 * pulls[name].tail))
    return Numbers(rows, {"events": f"{n:,} e-, |cos θ| < 0.8, seed {SEED}"})


def blocks(found: Found) -> dict[str, str]:
    """Return the numbers of the text."""
    widths = {(row.layer, row.screening): row for row in found["layers"].rows}
    plain = [widths[layer, SCREENINGS[0]] for layer in LAYERS]
    screened = [widths[layer, SCREENINGS[1]].q68 / widths[layer, SCREENINGS[0]].q68 for layer in LAYERS]
    of_electrons = {(row.radiation, row.quantity): row for row in found["electrons"].rows}
    kappa = of_electrons[True, "kappa"]
    return {
        "screening": _listed(screened, [matter for _, matter in LAYERS.values()]),
        "thin": _listed([row.core / row.q68 for row in plain], [text for text, _ in LAYERS.values()]),
        "coarse": _joined([f"{100 * (ratio - 1):.0f}" for ratio in map(_too_wide, MOMENTA)]),
        **_choices(),
        "electrons": f"{kappa.value:.2f} with {kappa.tail:.0f} %",
        "electrons-z": " and ".join(f"{of_electrons[True, name].value:.2f}" for name in ("dz", "tanl")),
        "electrons-off": f"{of_electrons[False, 'kappa'].value:.2f}",
    }


def _choices() -> dict[str, str]:
    """Return the pulls of kappa at 0.2 and 1 GeV/c for each choice of the loss."""
    rows = [row for row in fit.PAGE.read()["losses"].rows if row.p in (0.2, 1.0)]
    texts = {loss: " and ".join(f"{row.width:.2f}" for row in rows if row.loss == loss) for loss in ("mean",)}
    first, last = (row for row in rows if row.loss == "truncated")
    texts["truncated"] = f"{first.width:.2f} at 0.2 GeV/c and {last.width:.2f} at 1 GeV/c"
    probable = [row for row in rows if row.loss == "most_probable"]
    texts["probable"] = " and ".join(f"{row.width:.2f}" for row in probable)
    return texts | {"probable-mean": " and ".join(f"{abs(row.mean):.2f}" for row in probable)}


def _too_wide(p: float) -> float:
    """Return the expected width of the momentum with BESIII's error in the loss, over that with the own one."""
    own = cg.analytic(PRECISE, "mu-", p=p)
    return float(cg.analytic(PRECISE, "mu-", p=p, fit=cg.FitSettings(momentum_error=COARSE)).sigma_p / own.sigma_p)


def _listed(ratios: list[float], places: list[str]) -> str:
    return _joined([f"{100 * (ratio - 1):.0f} % in {place}" for ratio, place in zip(ratios, places, strict=True)])


def _joined(texts: list[str]) -> str:
    return f"{', '.join(texts[:-1])} and {texts[-1]}"


PAGE = Page(
    "matter", "docs/methods/matter.md", "10 s", {"layers": (Layer, layers), "electrons": (Electron, electrons)}, blocks
)
