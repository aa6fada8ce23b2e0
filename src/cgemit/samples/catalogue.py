"""What the samples are: their first particles, and how these decay.

Masses, widths and branching fractions: S. Navas et al. (Particle Data Group), Phys. Rev. D 110, 030001 (2024).
Fractions of a list are scaled to a sum of 1. Masses and lifetimes of the others are those of ``data/particles.csv``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Mode:
    """One decay mode.

    Attributes
    ----------
    fraction : float
    products : tuple of str
    alpha : float
        Of 1 + alpha cos^2(theta), theta the polar angle of the last product in the rest frame of the parent.
    """

    fraction: float
    products: tuple[str, ...]
    alpha: float = 0.0


@dataclass(frozen=True)
class Definition:
    """A sample: one particle made at rest by the beams, or particles that are shot.

    Attributes
    ----------
    text : str
    first : tuple of str
        Particles that every event begins with.
    modes : mapping of str to tuple of Mode
        Of the particles that decay.
    multiplicity : int
        Most particles of an event.
    options : mapping of str to Any
        Options that the sample has, and their defaults.
    in_matter : bool
        Whether each particle starts in the matter of the detector.
    """

    text: str
    first: tuple[str, ...]
    modes: Mapping[str, tuple[Mode, ...]]
    multiplicity: int
    options: Mapping[str, Any] = field(default_factory=dict)
    in_matter: bool = False


#: Particles that do not fly: mass and width, GeV/c2.
RESONANCES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "J/psi": (3.0969, 0.0), "psi(2S)": (3.6861, 0.0), "psi(3770)": (3.7737, 0.0),
        "rho0": (0.77526, 0.1491), "rho+": (0.77526, 0.1491), "rho-": (0.77526, 0.1491),
    }
)  # fmt: skip

_VERTEX = {"vertex": (0.0, 0.0, 0.0), "vertex_sigma": (0.0, 0.0, 0.0)}
#: Beams that cross at an angle of 22 mrad (BEPCII, hep-ex/0701010).
_BEAMS = {**_VERTEX, "crossing": 0.022}


def _shot(p: tuple[float, float], cos_theta: float = 0.9) -> dict[str, Any]:
    return {"p": p, "cos_theta": (-cos_theta, cos_theta), "phi": (-math.pi, math.pi), **_VERTEX}


_RHO = {
    "rho0": (Mode(1, ("pi+", "pi-")),),
    "rho+": (Mode(1, ("pi+", "pi0")),),
    "rho-": (Mode(1, ("pi-", "pi0")),),
}
_KAONS = (Mode(0.692, ("pi+", "pi-")), Mode(0.3069, ("pi0", "pi0")))
# Ten large modes of the D0 with 56 % of its decays, resonances included in their products.
_D0 = {
    ("K-", "pi+"): 0.03945, ("K-", "pi+", "pi0"): 0.144, ("K-", "pi+", "pi+", "pi-"): 0.0822,
    ("K-", "pi+", "pi+", "pi-", "pi0"): 0.043, ("K-", "e+", "nu_e"): 0.03549, ("K-", "mu+", "nu_mu"): 0.0341,
    ("K0_S", "pi+", "pi-"): 0.028, ("K0_S", "pi+", "pi-", "pi0"): 0.052, ("K0_S", "pi0"): 0.0124,
    ("K-", "pi+", "pi0", "pi0"): 0.0886,
}  # fmt: skip
_BAR = {
    "K-": "K+", "pi+": "pi-", "pi-": "pi+", "e+": "e-", "nu_e": "anti-nu_e", "mu+": "mu-", "nu_mu": "anti-nu_mu",
}  # fmt: skip
_CHARM = {
    "D0": tuple(Mode(share, products) for products, share in _D0.items()),
    "anti-D0": tuple(Mode(share, tuple(_BAR.get(one, one) for one in products)) for products, share in _D0.items()),
    "K0_S": _KAONS,
}

DEFINITIONS: Mapping[str, Definition] = MappingProxyType(
    {
        "jpsi-rhopi": Definition(
            "J/psi -> rho pi -> pi+ pi- pi0, all charges of the rho, without interference",
            ("J/psi",),
            {"J/psi": tuple(Mode(1, (f"rho{a}", f"pi{b}"), 1.0) for a, b in ("00", "+-", "-+")), **_RHO},
            3,
            _BEAMS,
        ),
        "pipi-jpsi": Definition(
            "psi(2S) -> pi+ pi- J/psi, J/psi -> mu+ mu-",
            ("psi(2S)",),
            {"psi(2S)": (Mode(1, ("pi+", "pi-", "J/psi")),), "J/psi": (Mode(1, ("mu+", "mu-"), 1.0),)},
            4,
            _BEAMS,
        ),
        "d0-d0bar": Definition(
            "psi(3770) -> D0 anti-D0, each to one of its ten largest modes: 0 to 8 charged particles",
            ("psi(3770)",),
            {"psi(3770)": (Mode(1, ("D0", "anti-D0"), -1.0),), **_CHARM},
            10,
            _BEAMS,
        ),
        "ks-pipi": Definition(
            "K0_S -> pi+ pi- with flight", ("K0_S",), {"K0_S": (Mode(1, ("pi+", "pi-")),)}, 2, _shot((0.2, 1.2))
        ),
        "lambda-ppi": Definition(
            "Lambda -> p pi- with flight", ("Lambda",), {"Lambda": (Mode(1, ("p", "pi-")),)}, 2, _shot((0.3, 1.2))
        ),
        "slow-pions": Definition(
            "pi+ and pi- of 0.05 to 0.2 GeV/c, each in a direction of its own", ("pi+", "pi-"), {}, 2,
            _shot((0.05, 0.2)),
        ),
        "cosmic": Definition(
            "muons from above through the beam line, as two halves that leave the point nearest to it",
            ("mu-",), {}, 2, {"p": (1.0, 5.0), "vertex": (0.0, 0.0, 0.0), "vertex_sigma": (8.0, 8.0, 100.0)},
        ),
        "beam-gas": Definition(
            "p and pi- from one point on the beam line, of a nucleus of the rest gas", ("p", "pi-"), {}, 2,
            _shot((0.05, 1.0), 0.95) | {"vertex": (0.0, 0.0, (-300.0, 300.0))},
        ),
        "touschek": Definition(
            "an electron from the beam pipe, up to 30 mm from the beam line", ("e-",), {}, 1,
            _shot((0.05, 1.0), 0.95) | {"vertex": (0.0, 0.0, (-300.0, 300.0)), "radius": (0.0, 30.0)},
        ),
        "electrons": Definition(
            "20 electrons of 1 to 30 MeV/c from pipe, gas and walls, each from its own point", ("e-",) * 20, {}, 20,
            _shot((0.001, 0.03), 0.99), in_matter=True,
        ),
    }
)  # fmt: skip

#: Names of the samples.
NAMES = tuple(DEFINITIONS)
