"""A wrong word in settings fails in mypy, which reads this file, and at run time."""

from __future__ import annotations

from collections.abc import Callable

from cgemit.base.settings import SettingsError
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.reconstruction.fit import FitSettings
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings

WRONG: dict[str, Callable[[], object]] = {
    "fluctuations": lambda: SimulateSettings(fluctuations="some"),  # type: ignore[arg-type]
    "foil": lambda: SimulateSettings(foil="holes"),  # type: ignore[arg-type]
    "deltas": lambda: SimulateSettings(deltas="no"),  # type: ignore[arg-type]
    "wire_times": lambda: DigitizeSettings(wire_times="late"),  # type: ignore[arg-type]
    "position": lambda: ClusterSettings(position="center"),  # type: ignore[arg-type]
    "loss": lambda: FitSettings(loss="median"),  # type: ignore[arg-type]
    "screening": lambda: FitSettings(screening="goudsmit"),  # type: ignore[arg-type]
    "hypothesis": lambda: FitSettings(hypothesis=("pi", "d")),  # type: ignore[arg-type]
    "states": lambda: FitSettings(states=("hits", "begin")),  # type: ignore[arg-type]
}


def wrong_fields(make: Callable[[], object]) -> list[str]:
    """Return the names of the fields that settings are refused for."""
    try:
        make()
    except SettingsError as error:
        return [problem.path.partition("[")[0] for problem in error.problems]
    return []


def test_wrong_words_fail_at_run_time() -> None:
    assert {name: wrong_fields(make) for name, make in WRONG.items()} == {name: [name] for name in WRONG}


def test_right_words_are_right_for_mypy() -> None:
    settings = FitSettings(loss="mean", states=(90.0, "hits"), hypothesis=("pi", "K"), screening=None)
    assert settings.hypotheses() == ("pi", "K")
    assert FitSettings(hypothesis="all").hypotheses() == ("e", "mu", "pi", "K", "p")
