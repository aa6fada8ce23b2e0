"""Stages of a run: names, tables and settings."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from cgemit.base.settings import SettingsData
from cgemit.detector import Detector
from cgemit.detector.readouts import READOUTS, Readout
from cgemit.particles.gun import Guns, Source, only_kind, usual_momentum
from cgemit.particles.species import KNOWN, hypothesis_name
from cgemit.reconstruction.candidates import Finder
from cgemit.reconstruction.cluster import CLUSTERERS, clusterer_of
from cgemit.reconstruction.clusterers.clusterer import Clusterer, ClusterSettings
from cgemit.reconstruction.find.ckf import FindSettings
from cgemit.reconstruction.fit import FitSettings
from cgemit.reconstruction.refine import ClusterDirection, Refinement, RefineSettings, refinements
from cgemit.simulation.background import BackgroundSettings
from cgemit.simulation.digitize import DIGITIZERS, DigitizeSettings, digitizer_of
from cgemit.simulation.digitizers import Digitizer
from cgemit.simulation.transport import SimulateSettings
from cgemit.tables import Table

#: A name of `cgemit.chain.finders.FINDERS`, or any function of (detector, clusters, wire_hits).
FinderLike = Finder | str

STAGES = ("simulate", "digitize", "cluster", "find", "fit")  # where a run can end

TABLES = (
    *("particles", "events", "decays", "truths", "steps", "wire_truths", "digis", "wire_hits", "clusters"),
    *("candidates", "candidate_hits", "searches", "refined_clusters", "refined_wire_hits"),
    *("tracks", "residuals", "states", "components", "start_times", "strip_times", "matches"),
)

#: Tables of every run, wherever it ends.
EVERY_RUN = ("particles", "decays", "truths", "steps", "wire_truths")

#: Tables of each stage in order, without those that a fit makes only if the settings say so (`tables_made`).
BY_STAGE = (
    EVERY_RUN, ("digis", "wire_hits"), ("clusters",), ("candidates", "candidate_hits"), ("tracks", "matches"),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Settings(SettingsData):
    """Settings of all stages.

    Raises
    ------
    SettingsError
        A ValueError that lists every stage whose settings are of another class.

    Examples
    --------
    >>> settings = cg.Settings(simulate=cg.SimulateSettings(deltas=False), fit=cg.FitSettings(residuals=True))
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20, settings=settings)
    >>> "residuals" in result.tables
    True
    """

    simulate: SimulateSettings = field(default_factory=SimulateSettings)
    digitize: DigitizeSettings = field(default_factory=DigitizeSettings)
    background: BackgroundSettings = field(default_factory=BackgroundSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    find: FindSettings = field(default_factory=FindSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)


def fit_settings(settings: Settings, source: Source | Guns | None = None, **changes: Any) -> FitSettings:
    """Return the settings of the fit; a screening of None becomes the simulated one, a momentum of None the gun's.

    Parameters
    ----------
    settings : Settings
    source : Source, Guns or None
        What shoots the particles.
    changes
        Other values of the settings.
    """
    fit = settings.fit
    known = {
        "screening": fit.screening or settings.simulate.screening, "momentum": fit.momentum or usual_momentum(source),
    }  # fmt: skip
    return replace(fit, **known | changes)


def find_settings(
    settings: Settings, source: Source | Guns | None = None, given: Table | None = None, stage: str = "find"
) -> Any:
    """Return the settings of the finder; a hypothesis of None becomes the particle that is shot, if of one kind.

    Parameters
    ----------
    settings : Settings
    source : Source, Guns or None
        What shoots the particles.
    given : Table of kind "particles", or None
        All particles of the run, if nothing shoots them.
    stage : str
        Field of the finder's settings.
    """
    find, kind = getattr(settings, stage), only_kind(source, given)
    own = hypothesis_name(kind) if kind is not None and kind in KNOWN else None
    return replace(find, hypothesis=find.hypothesis or own)


def register_readout(
    readout: type[Readout], digitizer: type[Digitizer] | None = None, clusterer: type[Clusterer] | None = None
) -> None:
    """Make a readout from outside the package known by its name, to settings, simulation and reconstruction.

    Call it where `readout` is defined, so that processes of an executor that import the class know it, too.

    Parameters
    ----------
    readout : type of Readout
        Its description: a frozen dataclass of settings, with a `name`.
    digitizer : type of Digitizer or None
    clusterer : type of Clusterer or None
        None: from the class which `readout` extends, such as `AnalogReadout`.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, kw_only=True)
    ... class FineReadout(cg.GaussianReadout):
    ...     name = "fine"
    ...     sigma_x: float = 0.05
    >>> cg.register_readout(FineReadout)
    >>> result = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.0), n=20, readout="fine")
    >>> print(result.clusters["err_x"][0])
    0.05
    """
    READOUTS[readout.name] = readout
    if digitizer is not None:
        DIGITIZERS[readout] = digitizer
    if clusterer is not None:
        CLUSTERERS[readout] = clusterer


def refinements_of(settings: Settings, detector: Detector) -> list[Refinement]:
    """Return the refinements that settings and readouts ask for, for one reconstruction.

    Parameters
    ----------
    settings : Settings
    detector : Detector
        Of the reconstruction.
    """
    found = refinements(settings.refine)
    return [*found, ClusterDirection(settings.cluster)] if _follows_tracks(detector) else found


def _follows_tracks(detector: Detector) -> bool:
    """Return whether clusters of any layer are made again with the directions of their tracks."""
    return any(clusterer_of(group.readout).follows_tracks for group in detector.groups)


def tables_made(until: str, settings: Settings, detector: Detector) -> tuple[str, ...]:
    """Return the tables that a run makes.

    Parameters
    ----------
    until : str
        Its last stage.
    settings : Settings
    detector : Detector
        Of its reconstruction.
    """
    names = {name for names in BY_STAGE[: STAGES.index(until) + 1] for name in names}
    if until == "fit":
        refine = settings.refine
        fitted_time = refine.start_time == "fitted"
        optional = {
            "residuals": settings.fit.residuals,
            "states": bool(settings.fit.states),
            "components": settings.fit.components,
            "start_times": fitted_time,
            "refined_wire_hits": fitted_time or refine.drift_times == "raw",
            "refined_clusters": _follows_tracks(detector),
        }
        names |= {name for name, on in optional.items() if on}
    return tuple(name for name in TABLES if name in names)


def for_run(settings: Settings, detector: Detector) -> Settings:
    """Return the settings of a run, with what the stages need of each other.

    A readout that starts from ionization clusters needs steps; raw drift times are corrected in the reconstruction.

    Parameters
    ----------
    settings : Settings
    detector : Detector
        That is simulated.

    Raises
    ------
    ValueError
        If the simulation cannot make what a readout needs.
    """
    if any(digitizer_of(group.readout).needs_steps for group in detector.groups) and not settings.simulate.steps:
        settings = replace(settings, simulate=replace(settings.simulate, steps=True))
    if settings.digitize.wire_times == "raw":
        settings = replace(settings, refine=replace(settings.refine, drift_times="raw"))
    return settings


def expected_settings(given: object) -> str:
    """Return the expected form of settings; those of one stage go into `Settings`."""
    stage = next((f.name for f in fields(Settings) if type(given) is f.default_factory), "")
    return (
        f"Settings({stage}=...)" if stage else "Settings(" + ", ".join(f"{f.name}=..." for f in fields(Settings)) + ")"
    )


def finder_of(table: Table) -> str:
    """Return the name of the finder of the candidates or tracks of a table; ``"given"`` if it has none.

    Parameters
    ----------
    table : Table
        Of candidates, of their hits, or of fitted tracks.
    """
    return finder_in(table.meta)


def finder_in(meta: Mapping[str, Any]) -> str:
    """Return the name of the finder in the metadata of a table, as `finder_of`."""
    return str(meta.get("finder", "given"))


def hits_text(table: Table) -> str:
    """Return how hits came to their tracks, for reports.

    Parameters
    ----------
    table : Table
        As in `finder_of`.
    """
    return hits_by(finder_of(table))


def hits_by(name: str) -> str:
    """Return how the hits of a finder of this name came to their tracks, as `hits_text`."""
    return {"truth": "assigned by truth", "given": "given with their candidates"}.get(name, f"found by {name}")


def mass_by(meta: Mapping[str, Any]) -> str:
    """Return which masses the finder or the fit of a table with this metadata assumed, for reports."""
    if "hypothesis" in meta:
        return str(meta["hypothesis"])
    return "each particle's own" if finder_in(meta) == "truth" else "those of the candidates"


class NotKeptError(AttributeError, ValueError):
    """A table that a run has made, but not kept."""


def left_out(tables: Collection[str]) -> set[str]:
    """Return the names of tables that a run made and did not keep: a run makes all of its stages up to the last.

    Parameters
    ----------
    tables : collection of str
        Names of those that it kept.
    """
    rank = {name: stage for stage, names in enumerate(BY_STAGE) for name in names}
    last = max((rank[name] for name in tables if name in rank), default=-1)
    return {name for name, stage in rank.items() if stage <= last and name not in tables}


def detectors_of(detector: Detector, fit_detector: Detector | None) -> dict[str, Detector]:
    """Return the detectors of a run by their role, as run.json names them."""
    return {"detector": detector} | ({} if fit_detector is None else {"fit_detector": fit_detector})
