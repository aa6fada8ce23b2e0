"""Simulation: charged particles through field and matter to crossings of drift gaps and drift cells."""

from __future__ import annotations

from dataclasses import dataclass

from cgemit import _core
from cgemit.detector import Detector, compiled
from cgemit.tables import Table

FLUCTUATIONS = ("full", "gaussian", "off")
FOILS = ("effective", "lattice")
TransportStatus = _core.TransportStatus


@dataclass(frozen=True, kw_only=True)
class SimulateSettings:
    """What the simulation draws at random (docs/methods/simulate.md).

    Attributes
    ----------
    fluctuations : str
        ``"full"``: scattering and Landau-like straggling with collisions up to the largest transfer.
        ``"gaussian"``: exactly the noise that the fit assumes. ``"off"``: no scattering, and the loss that the fit
        subtracts.
    sublayers : bool
        Whether every sub-layer scatters by itself, instead of groups of neighbours merged to one scatterer.
    foil : str
        ``"effective"``: GEM foils are even matter. ``"lattice"``: they have holes, and a track meets the copper and
        Kapton that it really crosses (docs/methods/foils.md); with fluctuations ``"full"`` only, since the others make
        the fit's assumptions true.
    deltas : bool
        Whether delta electrons leave deposits of their own in the drift gaps.

    Raises
    ------
    ValueError
        If `fluctuations` or `foil` is not one of these, or if they do not go together.
    """

    fluctuations: str = "full"
    sublayers: bool = False
    foil: str = "effective"
    deltas: bool = True

    def __post_init__(self) -> None:
        if self.fluctuations not in FLUCTUATIONS:
            choices = ", ".join(map(repr, FLUCTUATIONS))
            raise ValueError(f"SimulateSettings.fluctuations: {self.fluctuations!r}, expected one of {choices}")
        if self.foil not in FOILS:
            choices = ", ".join(map(repr, FOILS))
            raise ValueError(f"SimulateSettings.foil: {self.foil!r}, expected one of {choices}")
        if self.foil == "lattice" and self.fluctuations != "full":
            raise ValueError("SimulateSettings.foil: 'lattice', expected 'effective' unless fluctuations are 'full'")


def simulate(
    detector: Detector, particles: Table, settings: SimulateSettings | None = None, seed: int = 0
) -> dict[str, Table]:
    """Transport particles outward until they leave, curl back or stop.

    Uniform field: exact helices between scatterers. Scattering by Highland's plane angles (PDG 2024 eq. 34.16) in both
    projections with lateral displacement, energy loss by Bethe (eq. 34.5) with straggling; valid for beta gamma > 0.3.
    Random numbers are those of (seed, event, particle, place), so results do not depend on how events are cut into
    chunks. Hits are recorded on the way out; a particle that first moves inward only meets the matter there.

    Parameters
    ----------
    detector : Detector
    particles : Table of kind "particles"
    settings : SimulateSettings or None
    seed : int
        Key of the random streams, 0 to 2**64 - 1.

    Returns
    -------
    dict of str to Table
        ``particles`` with `status` filled in (TransportStatus), ``truths``, ``steps`` and ``wire_truths``.
    """
    settings = settings or SimulateSettings()
    out = _core.simulate(
        compiled(detector, merge=not settings.sublayers, foil=settings.foil),
        {name: particles[name] for name in _COLUMNS},
        fluctuations=getattr(_core.Fluctuations, settings.fluctuations),
        seed=seed,
    )
    span = (particles.n_events, particles.first_event)
    return {
        "particles": particles.with_columns(status=out["status"]),
        "truths": Table("truths", out["truths"], *span),
        "steps": Table.empty("steps", *span),
        "wire_truths": Table("wire_truths", out["wire_truths"], *span),
    }


_COLUMNS = ("event", "particle", "charge", "mass", "x", "y", "z", "px", "py", "pz")
