"""docs/methods/detector.md: expected resolutions of the presets, and beside them what others publish."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

import cgemit as cg
from cgemit.detector.export import describe
from cgemit.detector.gas import layer_drift
from cgemit.draw.detector import draw_rz
from cgemit.draw.style import mathematical
from pages.page import Found, Numbers, Page, table

PRESETS = (
    *("besiii-cgem-design", "besiii-pixel", "clas12-like", "stcf-like", "kloe2-like"),
    *("babar-like", "belle2-like", "epic-like", "idea-like", "cepc-like"),
)
MOMENTA = (1.0, 10.0)
THIN = ("epic-like", "idea-like", "cepc-like")  # of thin layers that measure precisely
BESIII = ("besiii-cgem-design", "besiii-cgem")  # whose CGEM layers are in a table

#: Quantity -> its name and unit.
QUANTITIES = {"p": ("σ(p)/p", "%"), "dr": ("σ(d_ρ)", "µm"), "dz": ("σ(d_z)", "µm")}
#: Fits to the full simulation of ePIC (Geant4 and ACTS, true seeds) in the card 2ndDET_cards/delphes_card_ePIC.tcl
#: of github.com/delphes/delphes. Pseudorapidities -> quantity -> a and b: a (+) b p for p, a (+) b/pT for others.
EPIC = {
    (0.0, 0.5): {"p": (0.4, 0.053), "dr": (6.5, 24.1), "dz": (4.7, 26.4)},
    (0.5, 1.0): {"p": (0.5, 0.051), "dr": (6.8, 28.3), "dz": (5.7, 35.1)},
}
EPIC_MOMENTA = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
MUON = 0.1056583755  # GeV, its mass

#: Of the yellow report (arXiv:2103.05419), for a tracker in 3 T.
EIC_MATRIX = "delphes_EICmatrixv2_3T.tcl of github.com/miguelignacio/delphes_EIC at 1c2850e, −1 < η < 1"

#: Abstract of the paper with this title: sigma(pT)/pT ~ 0.5 % at 1 GeV.
CGEM = "*A cylindrical GEM detector with analog readout for the BESIII experiment*, abstract"


@dataclass(frozen=True)
class Resolution:
    """Expected resolutions of muons across the beam: GeV/c, per cent, um."""

    preset: str
    momentum: float
    p: float
    dr: float
    dz: float


@dataclass(frozen=True)
class Published:
    """An expected resolution of pions beside the published one: GeV/c, per cent or um."""

    low: float  # pseudorapidity
    high: float
    quantity: str
    momentum: float
    expected: float
    published: float


@dataclass(frozen=True)
class Statement:
    """What an experiment publishes of its tracks across the beam: per cent or um of the momentum in GeV/c."""

    preset: str
    quantity: str
    formula: str
    value: Callable[[float], float]
    momenta: tuple[float, ...]
    source: str
    bound: bool = False  # a requirement, not a resolution


@dataclass(frozen=True)
class Stated:
    """An expected resolution of muons across the beam beside a published statement: GeV/c, per cent or um."""

    preset: str
    quantity: str
    momentum: float
    expected: float
    published: float


@dataclass(frozen=True)
class Core:
    """The core width of simulated muons of 1 GeV/c over the expected one."""

    preset: str
    quantity: str
    ratio: float
    error: float


def inverse_beta(p: float) -> float:
    """Return 1/beta of a muon."""
    return float(np.hypot(1, MUON / p))


STATEMENTS = (
    Statement("besiii-idc", "p", "0.5 %", lambda p: 0.5, (1,), "english.ihep.cas.cn/bes/doc/2124.html"),
    Statement("besiii-cgem", "p", "about 0.5 %", lambda p: 0.5, (1,), CGEM),
    Statement("besiii-cgem-design", "p", "about 0.5 %", lambda p: 0.5, (1,), CGEM),
    Statement(
        "belle2-like", "p", "0.1 % pT ⊕ 0.3 %/β",
        lambda p: float(np.hypot(0.1 * p, 0.3 * inverse_beta(p))), (0.3, 1, 3),
        "`resolutions_SuperKEKB` in python/resolutions_cfi.py of github.com/veelken/tautau-Entanglement",
    ),
    Statement(
        "idea-like", "p", "0.01145 % ⊕ 0.02024 % √pT ⊕ 0.002093 % pT",
        lambda p: float(np.hypot(np.hypot(0.01145, 0.02024 * p**0.5), 0.002093 * p)), (1, 5, 10, 20, 50, 100),
        "cards/delphes_card_IDEA.tcl of github.com/delphes/delphes at 3051358",
    ),
    Statement(
        "epic-like", "p", "0.05 % p + 0.5 %", lambda p: 0.05 * p + 0.5, (1, 10, 20),
        "eic.jlab.org/Requirements/DET.html, 6.03.01.02, −1 < η < 1", True,
    ),
    Statement(
        "idea-like", "dr", "5 µm ⊕ 15 µm/p", lambda p: float(np.hypot(5, 15 / p)), (1, 10, 100),
        "requirements for detectors at FCC-ee, FCCee_MDI_Oct10.tex of github.com/oviazlo/presentations", True,
    ),
    Statement(
        "cepc-like", "p", "0.1 % ⊕ 0.001 % pT", lambda p: float(np.hypot(0.1, 0.001 * p)), (1, 10, 50, 100),
        "cards/delphes_card_CEPC.tcl of github.com/delphes/delphes at 0ee14ba, −1 < η < 1",
    ),
    Statement(
        "epic-like", "dr", "5 µm ⊕ 30 µm/pT", lambda p: float(np.hypot(5, 30 / p)), (1, 10, 20), EIC_MATRIX, True,
    ),
    Statement(
        "epic-like", "dz", "5 µm ⊕ 30 µm/pT", lambda p: float(np.hypot(5, 30 / p)), (1, 10, 20), EIC_MATRIX, True,
    ),
)  # fmt: skip


def resolutions(
    name: str | cg.Detector, particle: str, p: float, cos_theta: float | tuple[float, float]
) -> dict[str, float]:
    """Return the expected resolutions by quantity: per cent, um."""
    found = cg.analytic(name, particle, p=p, cos_theta=cos_theta)
    return {"p": float(found.sigma_p) / p / 10, "dr": float(found.sigma_dr), "dz": 1e3 * float(found.sigma_dz)}


def epic(p: float, low: float, high: float, quantity: str, shift: float = 0.0) -> float:
    """Return what the card says in the middle of a range of pseudorapidity, with a shift of its constant term."""
    a, b = EPIC[low, high][quantity]
    return float(np.hypot(a + shift, b * p if quantity == "p" else b * np.cosh(0.5 * (low + high)) / p))


def expected(share: float) -> Numbers:
    """Compute the resolutions of all presets."""
    rows = [Resolution(name, p, **resolutions(name, "mu-", p, 0.0)) for name in PRESETS for p in MOMENTA]
    return Numbers(rows)


def beside_epic(share: float) -> Numbers:
    """Compute the resolutions of `epic-like` where they are published."""
    return Numbers(list(_epic_rows()))


def stated(share: float) -> Numbers:
    """Compute the resolutions that experiments publish across the beam."""
    rows = []
    for one in STATEMENTS:
        for p in one.momenta:
            ours = resolutions(one.preset, "mu-", p, 0.0)[one.quantity]
            rows.append(Stated(one.preset, one.quantity, p, ours, one.value(p)))
    return Numbers(rows)


def simulated(share: float) -> Numbers:
    """Simulate muons with all fluctuations, cos(theta) within 0.7."""
    events, angles, rows = max(400, int(20_000 * share)), (-0.7, 0.7), []
    for name in THIN:
        found = cg.analytic(name, "mu-", p=1.0, cos_theta=angles)
        result = cg.run(name, cg.Gun("mu-", p=1.0, cos_theta=angles), events)
        for quantity in ("dr", "phi0", "dz", "tanl", "p"):
            core = cg.resolution(result, quantity)
            width = float(found.sigma(quantity))
            rows.append(Core(name, quantity, core.core / width, core.core_error / width))
    return Numbers(rows, {"events": events})


def _epic_rows() -> Iterator[Published]:
    for low, high in EPIC:
        for p in EPIC_MOMENTA:
            ours = resolutions("epic-like", "pi-", p, (float(np.tanh(low)), float(np.tanh(high))))
            for quantity, value in ours.items():
                yield Published(low, high, quantity, p, value, epic(p, low, high, quantity))


def blocks(found: Found) -> dict[str, str]:
    """Return the tables, and the drift in X."""
    head = ["preset", "σ(d_ρ), σ(d_z) at 1 GeV/c [µm]", "at 10 GeV/c [µm]", "σ(p)/p at 1, 10 GeV/c [%]"]
    lines = []
    for name in PRESETS:
        one, ten = (row for row in found["expected"].rows if row.preset == name)
        impact = [f"{row.dr:.3g}, {row.dz:.3g}" for row in (one, ten)]
        lines.append([f"`{name}`", *impact, ", ".join(f"{row.p:#.2g}".rstrip(".") for row in (one, ten))])
    return {
        "expected": table(head, lines), "layers": _layers(),
        "stated": _stated(found["stated"].rows),
        "simulated": _simulated(found["simulated"].rows),
        "lorentz": _lorentz_shifts(),
    }  # fmt: skip


def _stated(rows: Sequence[Stated]) -> str:
    """Return the table of published statements and the ratios to them."""
    head, lines, left = ["preset", "published", "p [GeV/c]", "expected / published", "source"], [], list(rows)
    for one in STATEMENTS:
        here, left = left[: len(one.momenta)], left[len(one.momenta) :]
        name, _ = QUANTITIES[one.quantity]
        lines.append([
            f"`{one.preset}`", f"{name} {'at most' if one.bound else '='} {one.formula}",
            ", ".join(f"{row.momentum:g}" for row in here),
            ", ".join(f"{row.expected / row.published:.2f}" for row in here), one.source,
        ])  # fmt: skip
    return table(head, lines)


def _simulated(rows: Sequence[Core]) -> str:
    """Return the table of simulated over expected resolutions."""
    head = ["simulated / expected", *(f"σ({name})" for name in ("d_ρ", "φ0", "d_z", "tan λ", "p"))]
    texts = [[f"`{name}`", *(f"{row.ratio:.2f}" for row in rows if row.preset == name)] for name in THIN]
    return table(head, texts)


def _layers() -> str:
    """Return the table of the CGEM layers of BESIII."""
    head = [
        "layer", "strips at r, length [mm]", "drift gap [mm]", "sheets", "X, V strips", "pitch [µm]", "stereo [°]",
        "X/X0 [%]", "cos θ up to ±",
    ]  # fmt: skip
    lines = []
    for name in BESIII:
        parts = describe(cg.load(name))
        for layer in parts["cgem"]:
            r, half = layer["r_readout_mm"], layer["length_mm"] / 2
            matter = sum(part["x0_percent"] for part in parts["material"] if part["part"].split()[0] == layer["layer"])
            strips = ", ".join(f"{layer['sheets'] * layer[f'strips_{view}']}" for view in "xv")
            stereo = f"{layer['stereo_deg']:.1f}".replace("-", "−")
            lines.append([
                f"`{name}` {layer['layer']}", f"{r:.1f}, {layer['length_mm']:g}", f"{layer['drift_gap_mm']:.2f}",
                f"{layer['sheets']}", strips, f"{layer['pitch_x_um']:g}", stereo, f"{matter:.2f}",
                f"{half / np.hypot(half, r):.3f}",
            ])  # fmt: skip
    return table(head, lines)


def _lorentz_shifts() -> str:
    """Return the smallest and the largest drift in X (mm) between mid-gap and anode in the design at -1 T."""
    shifts = []
    for layer in cg.load(PRESETS[0]).cgem:
        drift = layer_drift(layer, -1.0)
        angle = drift.shift + drift.tan_lorentz * np.log(layer.r_gap_out / layer.r_mid)
        shifts.append(abs(angle * layer.r_readout))
    return f"−{min(shifts):.1f} to −{max(shifts):.1f}"


def draw_presets(found: Found) -> Figure:
    """Draw one half of the presets along the beam."""
    figure, axes = plt.subplots(5, 2, figsize=(11.6, 20.0), dpi=75)
    entries = {}  # of one legend for all, below
    for plot, name in zip(axes.flat[: len(PRESETS)], PRESETS, strict=True):
        draw_rz(name, plot)
        legend = plot.get_legend()
        entries |= {text.get_text(): mark for text, mark in zip(legend.texts, legend.legend_handles, strict=True)}
        legend.remove()
    figure.legend(entries.values(), entries.keys(), loc="lower center", ncols=4, fontsize=9)
    figure.tight_layout(rect=(0, 0.03, 1, 1))
    return figure


def draw_published(found: Found) -> Figure:
    """Draw the resolutions of `epic-like` over the published ones."""
    figure, axes = plt.subplots(1, 3, figsize=(11.6, 4.0), dpi=85)
    momenta = np.geomspace(EPIC_MOMENTA[0], EPIC_MOMENTA[-1], 60)
    for plot, (quantity, (name, unit)) in zip(axes, QUANTITIES.items(), strict=True):
        for (low, high), color, mark in zip(EPIC, ("#0072B2", "#D55E00"), "os", strict=True):
            rows = [row for row in found["epic"].rows if (row.low, row.quantity) == (low, quantity)]
            where = f"{low:g} < $\\eta$ < {high:g}"
            plot.plot(momenta, [epic(p, low, high, quantity) for p in momenta], color=color, label=f"ePIC, {where}")
            plot.plot(
                [row.momentum for row in rows], [row.expected for row in rows], mark, color=color, mfc="white",
                label=f"epic-like, {where}",
            )  # fmt: skip
        plot.set(xscale="log", xlabel="p (GeV/c)", ylabel=f"{mathematical(name)} ({unit})", ylim=(0, None))
        plot.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
        plot.minorticks_off()
        plot.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.suptitle("pions: lines are fits to ePIC's full simulation, points are expected for epic-like", fontsize=10)
    figure.tight_layout()
    return figure


PAGE = Page(
    "presets", "docs/methods/detector.md", "10 s",
    {
        "expected": (Resolution, expected), "epic": (Published, beside_epic), "stated": (Stated, stated),
        "simulated": (Core, simulated),
    },
    blocks,
    {"presets.png": draw_presets, "presets-published.png": draw_published},
)  # fmt: skip
