"""Settings of alignment: which constants are free, and how tracks determine them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from cgemit.base.errors import Problems
from cgemit.base.settings import SettingsData
from cgemit.base.validate import NotNegative, Positive, Whole
from cgemit.calibration.constants import (
    FIELD,
    LORENTZ,
    Z_SCALE,
    Constant,
    chosen,
    constants_of,
    of_single_wires,
    priors_of,
)
from cgemit.detector import Detector
from cgemit.reconstruction.fit import Pull

Turns = Annotated[int, Whole(1, 50)]
Count = Annotated[int, Whole(1, 1000)]


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings(SettingsData):
    """Which constants of a detector are determined, and how.

    Attributes
    ----------
    free : tuple of str
        Parts, all displacements of which are free, such as ``"cgem.*"``, ``"layer.PIX"`` and ``"drift_chamber"``, and
        constants by their names, such as ``"cgem.*.shift_z"``. Other parts stay where the description puts them: the
        constants are relative to them. ``"drift_chamber.layers.*.wires.*"`` names the ends of all single wires, which
        are determined without any other constant and without joined tracks (``pairs=()``).
    fixed : tuple of str
        Of those, which stay as they are.
    calibrate : tuple of str
        Constants that are no displacement: ``"lorentz"``, shift of the clusters of each CGEM layer without an analog
        readout, which is known only if the layer's rotation is; ``"t0"``, zero of the drift times of each wire layer;
        ``"z_scale"``, length along the beam of the strip pattern of each CGEM layer, relative;
        ``"relation"``, times of the relation of drift distance and time of all wire layers at each mm; ``"field"``, ln
        of its scale, which tracks without a known mass or momentum do not tell.
    plates : tuple of int
        Numbers of wire layers that share a pair of end plates, from the inside; ``"drift_chamber.plates.*"`` then
        names the ends of their wires.
    priors : tuple of str
        Errors of surveys, ``"cgem.*.shift_z=100 um"``; later ones count. The survey says that the description is right.
    zero_modes : str
        What becomes of constants that the data determine only in combinations: ``"undetermined"``, they get no number;
        ``"constrained"``, combinations that the data do not see are set to 0.
    pairs : tuple of str
        Tracks that are joined: ``"cosmic"``, an upward and a downward track that are alone in their event are the
        halves of one muon; ``"vertex"``, tracks of an event leave one point, within some mm of the origin;
        ``"beam_line"``, that point, or the one track of an event, is on the beam line x = y = 0 within `beam_width`;
        ``"mass"``, two tracks that are alone in their event have the invariant mass `mass`.
    beam_width : (float, float)
        Standard deviations of vertices in x and y, mm.
    mass : float or None
        GeV/c2; with ``"mass"`` in `pairs`.
    mass_width : float
        Standard deviation of the true masses, GeV/c2.
    scattering : bool
        Whether matter scatters in the normal equations. Without, errors are too small (docs/methods/alignment.md).
    outlier_pull : tuple of float
        Cut on the pulls of hits and of joined tracks in each iteration; the last one counts for all later ones. 0: no
        cut; joined tracks then count unless they are ten times farther apart than half of them are.
    iterations : int
        Most iterations.
    tolerance : float
        Alignment ends where no constant moves by more than this, in units of its error.

    Raises
    ------
    SettingsError
        A ValueError that lists every wrong value.

    Examples
    --------
    >>> settings = cg.AlignmentSettings(free=("cgem.*",), fixed=("cgem.L1.tilt_*",))
    >>> forecast = cg.alignment_forecast("besiii-cgem", [(cg.Gun("mu-", p=1.0, cos_theta=(-0.8, 0.8)), 1000)], settings)
    >>> forecast.table.status.count("free"), forecast.table.status.count("fixed")
    (16, 2)
    """

    free: tuple[str, ...] = ("cgem.*",)
    fixed: tuple[str, ...] = ()
    calibrate: tuple[Literal["lorentz", "z_scale", "field", "t0", "relation"], ...] = ()
    plates: tuple[Count, ...] = ()
    priors: tuple[str, ...] = ()
    zero_modes: Literal["undetermined", "constrained"] = "undetermined"
    pairs: tuple[Literal["cosmic", "vertex", "beam_line", "mass"], ...] = ("cosmic",)
    beam_width: tuple[Positive, Positive] = (0.1, 0.1)
    mass: Positive | None = None
    mass_width: NotNegative = 0.0
    scattering: bool = True
    outlier_pull: tuple[Pull, ...] = (0.0, 8.0, 5.0)
    iterations: Turns = 8
    tolerance: Positive = 0.1

    def contradictions(self, problems: Problems) -> None:
        """Note settings without any constant or cut."""
        if isinstance(self.free, tuple) and not self.free and not self.calibrate:
            problems.note("free", "()", "a part or a constant, or something to calibrate")
        if isinstance(self.pairs, tuple) and ("mass" in self.pairs) != (self.mass is not None):
            problems.note("mass", str(self.mass), "a mass if, and only if, 'mass' is in pairs")
        if isinstance(self.outlier_pull, tuple) and not self.outlier_pull:
            problems.note("outlier_pull", "()", "a cut for each iteration, at least one")


def plan_of(
    detector: Detector, settings: AlignmentSettings
) -> tuple[tuple[Constant, ...], tuple[Constant, ...], Mapping[str, float]]:
    """Return the free constants, those that are fixed by name, and the errors of surveys by name.

    Raises
    ------
    ValueError
        Listing every pattern that names nothing, and every prior that is none.
    """
    single = any(".wires." in one for one in (*settings.free, *settings.fixed, *settings.priors))
    problems, every = Problems(), constants_of(detector, settings.plates, wires=single)
    wires = len(detector.drift_chamber.layers) if detector.drift_chamber is not None else 0
    if settings.plates and sum(settings.plates) != wires:
        problems.note("plates", f"{sum(settings.plates)} wire layers", f"the {wires} of the detector")
    free = chosen(every, settings.free, "free", problems)
    keys = {
        "lorentz": f"cgem.*.{LORENTZ}", "z_scale": f"cgem.*.{Z_SCALE}", "t0": "drift_chamber.layers.*.t0",
        "relation": "drift_chamber.drift_relation.*", "field": FIELD,
    }  # fmt: skip
    free |= chosen(every, [keys[name] for name in settings.calibrate], "calibrate", problems)
    fixed = chosen(every, settings.fixed, "fixed", problems)
    priors = priors_of(every, settings.priors, problems)
    if free and not free - fixed:
        problems.note("fixed", "all that is free", "a constant that is left free")
    problems.report("alignment")
    if single:
        _check_single(every, free - fixed, settings, problems)
    left = free - fixed
    return (
        tuple(one for one in every if one.name in left),
        tuple(one for one in every if one.name in fixed),
        {name: error for name, error in priors.items() if name in left},
    )


def _check_single(every: Sequence[Constant], left: set[str], settings: AlignmentSettings, problems: Problems) -> None:
    """Raise a ValueError for what has no sums with single wires: other constants, and tracks that are joined."""
    kinds = {of_single_wires([one]) for one in every if one.name in left}
    if True in kinds:
        if False in kinds:
            problems.note("free", "single wires and other constants", "one of these: align the parts first")
        if settings.pairs:
            problems.note("pairs", ", ".join(settings.pairs), "none (pairs=()) with single wires")
    problems.report("alignment")
