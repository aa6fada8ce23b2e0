"""Simulation: charged particles through field and matter to crossings of drift gaps and drift cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from cgemit import _core
from cgemit.base.errors import Problems
from cgemit.base.settings import SettingsData
from cgemit.base.validate import Whole, check_numbers
from cgemit.detector import Detector, Screening, compiled, load
from cgemit.fit_matter import tuned
from cgemit.particles.species import compiled_decays
from cgemit.particles.table import check_particles, not_transported
from cgemit.tables import Table

Fluctuations = Literal["full", "gaussian", "off"]
Foil = Literal["effective", "lattice"]
HalfTurns = Annotated[int, Whole(1, 15)]

TransportStatus = _core.common.TransportStatus


@dataclass(frozen=True, kw_only=True)
class SimulateSettings(SettingsData):
    """Random processes of the simulation (docs/methods/simulate.md).

    Attributes
    ----------
    fluctuations : str
        ``"full"``: single hard scatters and collisions, ionization clusters. ``"gaussian"``: the noise that the fit
        assumes. ``"off"``: no scattering, and the loss that the fit subtracts.
    sublayers : bool
        Whether every sub-layer scatters by itself, instead of merged slabs.
    foil : str
        ``"effective"``: GEM foils are uniform matter. ``"lattice"``: they have holes (docs/methods/foils.md); with
        fluctuations ``"full"`` only.
    screening : str
        Screening of nuclei in multiple scattering, in simulation and fit (docs/methods/matter.md).
    deltas : bool
        Whether delta electrons leave deposits in the drift gaps; with fluctuations ``"full"``.
    steps : bool
        Whether the steps table also holds the ionization clusters.
    decays : bool
        Whether muons, charged pions and charged kaons decay in flight.
    half_turns : int
        Half turns of a curling particle. 1: it is followed to its outermost point only.

    Raises
    ------
    ValueError
        Listing every value that is not one of these, and values that do not go together.

    Examples
    --------
    >>> settings = cg.Settings(simulate=cg.SimulateSettings(fluctuations="off", deltas=False))
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5, settings=settings)
    >>> print(result.truths["secondaries"].max())
    0
    """

    fluctuations: Fluctuations = "full"
    sublayers: bool = False
    foil: Foil = "effective"
    screening: Screening = "wentzel"
    deltas: bool = True
    steps: bool = False
    decays: bool = True
    half_turns: HalfTurns = 1

    def contradictions(self, problems: Problems) -> None:
        """Note the settings that need fluctuations ``"full"``."""
        full = str(self.fluctuations) == "full"
        if str(self.foil) == "lattice" and not full:
            problems.note("foil", "'lattice'", "'effective' unless fluctuations are 'full'")
        if self.steps is True and not full:
            problems.note("steps", "True", "False unless fluctuations are 'full'")


def simulate(
    detector: Detector | str | Mapping[str, Any],
    particles: Table,
    settings: SimulateSettings | None = None,
    seed: int = 0,
) -> dict[str, Table]:
    """Transport particles until they leave, stop, decay, or have made their half turns.

    Uniform field: exact helices between scatterers; field maps: Runge-Kutta-Nystrom steps (docs/methods/field.md).
    Scattering from the elements of the matter, soft as a Gaussian with lateral displacement, hard ones one by one;
    energy loss with Bethe's mean and collisions up to the largest transfer (docs/methods/matter.md), valid for
    beta gamma > 0.13; ionization clusters and delta electrons in the drift gaps (docs/methods/deltas.md).
    Random numbers are those of (seed, event, particle, place), so results do not depend on how events are cut into
    chunks. With one half turn, hits are recorded on the outward path; a particle that first moves inward only meets the
    matter there.
    The charged daughters of decays are transported in the same way, and their hits carry the number of the particle.

    Parameters
    ----------
    detector : Detector, or what `load` accepts
    particles : Table of kind "particles"
    settings : SimulateSettings or None
    seed : int
        Key of the random streams, 0 to 2**64 - 1.

    Returns
    -------
    dict of str to Table
        ``particles`` with `status` filled in (TransportStatus), ``decays``, ``truths``, ``steps`` and ``wire_truths``.

    Raises
    ------
    TypeError
        If the settings are something else.
    ParticleError
        Listing every problem of the particles.

    Examples
    --------
    >>> r = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=5)
    >>> tables = cg.simulate(r.detector, r.particles, seed=2)
    >>> sorted(tables), np.bincount(tables["truths"]["layer"]).tolist()
    (['decays', 'particles', 'steps', 'truths', 'wire_truths'], [5, 5, 5])
    """
    settings = SimulateSettings.of(settings)
    check_numbers("simulate", seed)
    check_particles(particles)
    return transport(load(detector), particles, settings, seed)


def transport(detector: Detector, particles: Table, settings: SimulateSettings, seed: int) -> dict[str, Table]:
    """Return what `simulate` does, for valid particles: those of a gun, or those that are checked already.

    Returns
    -------
    dict of str to Table
    """
    out = _core.simulation.simulate(**core_arguments(detector, particles, settings, seed))
    cover = particles.cover
    status = not_transported(particles)
    for name in ("decays", "truths", "wire_truths"):
        if "backward" in particles and particles["backward"].any():
            out[name]["time"] = np.where(_of_particles(particles, out[name], "backward"), -1, 1) * out[name]["time"]
        if "time" in particles and particles["time"].any():
            out[name]["time"] = out[name]["time"] + _of_particles(particles, out[name], "time")
    return {
        "particles": particles.with_columns(status=np.where(status > 0, status, out["status"]).astype(np.int8)),
        "decays": Table("decays", out["decays"], **cover),
        "truths": Table("truths", out["truths"], **cover),
        "steps": Table("steps", out["steps"], **cover),
        "wire_truths": Table("wire_truths", out["wire_truths"], **cover),
    }


def _of_particles(particles: Table, rows: Mapping[str, Any], name: str) -> Any:
    """Return the values of a column of the particles, for rows with their event and number."""
    first, most = particles.first_event, int(particles["particle"].max(initial=0)) + 1
    key = (particles["event"] - first) * most + particles["particle"]
    order = np.argsort(key, kind="stable")
    wanted = (np.asarray(rows["event"]) - first) * most + np.asarray(rows["particle"])
    return particles[name][order[np.searchsorted(key[order], wanted)]]


def core_arguments(detector: Detector, particles: Table, settings: SimulateSettings, seed: int) -> dict[str, Any]:
    """Return the arguments of the compiled simulation.

    Returns
    -------
    dict of str to object
        Arguments of ``_core.simulation.simulate`` by name.
    """
    columns = {name: particles[name] for name in _COLUMNS}
    if (left_out := not_transported(particles) > 0).any():
        columns["charge"] = np.where(left_out, 0, columns["charge"]).astype(np.int8)
    if "decay_time" in particles:
        columns["decay_time"] = particles["decay_time"].astype(np.float64)
    merge, screening = not settings.sublayers, settings.screening
    # Only noise like the fit's, and the loss that it subtracts, need what the fit assumes.
    full = settings.fluctuations == "full"
    core = compiled(detector, merge, screening, settings.foil) if full else tuned(detector, screening, merge=merge)
    return {
        "detector": core,
        "particles": columns,
        "fluctuations": getattr(_core.simulation.Fluctuations, settings.fluctuations),
        "deltas": settings.deltas,
        "steps": settings.steps,
        "decays": compiled_decays() if settings.decays else None,
        "half_turns": settings.half_turns,
        "seed": seed,
    }


_COLUMNS = ("event", "particle", "pdg", "charge", "mass", "x", "y", "z", "px", "py", "pz")


def transport_counts(status: Any) -> dict[str, int]:
    """Return the number of particles of each transport status that occurs, by its name.

    Parameters
    ----------
    status : (n,) array of int
        Column ``status`` of the particles (TransportStatus).
    """
    return {s.name: n for s in TransportStatus if (n := int((status == s).sum()))}
