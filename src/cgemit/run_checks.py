"""What a run cannot do, said before anything is simulated."""

from __future__ import annotations

import pickle
from concurrent.futures import Executor, ProcessPoolExecutor
from typing import Any

from cgemit.detector import Detector
from cgemit.finders import finder_name
from cgemit.problems import did_you_mean
from cgemit.stages import BY_STAGE, FINDERS, STAGES, TABLES, Settings
from cgemit.wire_times import check_wire_times


def tables_made(until: str, settings: Settings) -> tuple[str, ...]:
    """Return the tables that a run makes.

    Parameters
    ----------
    until : str
        Its last stage.
    settings : Settings
    """
    made = {name for names in BY_STAGE[: STAGES.index(until) + 1] for name in names}
    if until == "fit":
        made |= {name for name in ("residuals", "states") if getattr(settings.fit, name)}
        made |= {"start_times"} if settings.fit.start_time == "fitted" else set()
    return tuple(name for name in TABLES if name in made)


def check_calibration(detector: Detector | None, settings: Settings | None, until: object) -> None:
    """Raise an error if the read-out needs a calibration that there is not, before anything is simulated."""
    if detector is None or settings is None or until not in STAGES[2:]:
        return
    readout = settings.digitize.readout
    if hasattr(readout, "calibration"):
        readout.expected_errors(detector)


def check_raw_times(detector: Detector | None, settings: Settings | None, until: object) -> None:
    """Raise an error if raw drift times are asked for and the detector does not say how signals run along its wires."""
    if detector is not None and settings is not None and settings.digitize.wire_times == "raw" and until in STAGES[1:]:
        check_wire_times(detector)


def check_stages(
    finder: object, until: object, executor: Executor | None, keep: Any, settings: Settings | None
) -> tuple[str, ...] | None:
    """Raise an error if a run cannot be as asked for; return the tables to be kept, None for all."""
    problems = []
    names = [keep] if isinstance(keep, str) else [] if keep is None else list(keep)
    problems += [
        f"keep: got {name!r:.50}, expected some of {', '.join(TABLES)}{did_you_mean(str(name), TABLES, '; ')}"
        for name in names
        if name not in TABLES
    ]
    if keep is not None and not names:
        problems.append("keep: got no table, expected at least one")
    if not callable(finder) and finder not in FINDERS:
        problems.append(
            f"finder: got {finder!r}, expected 'truth', 'ckf' or a function of (detector, clusters, wire_hits)"
        )
    if until not in STAGES:
        problems.append(f"until: got {until!r}, expected one of {', '.join(map(repr, STAGES))}")
    elif settings is not None:
        made = tables_made(str(until), settings)
        missing = [name for name in names if name in TABLES and name not in made]
        if missing:
            problems.append(f"keep: got {', '.join(missing)}, which this run does not make, only {', '.join(made)}")
    if problems:
        raise ValueError("run:\n  " + "\n  ".join(problems))
    if callable(finder) and isinstance(executor, ProcessPoolExecutor):
        try:
            pickle.dumps(finder)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise TypeError(
                f"finder: got {finder_name(finder)}, which cannot be sent to other processes ({error}); "
                "expected a function of a module, or an executor of threads"
            ) from error
    return None if keep is None else (*names, *(["matches"] if "tracks" in names else []))
