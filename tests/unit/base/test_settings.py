"""Settings check themselves by their annotations, and files give back what was written."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pytest

import cgemit as cg
from cgemit.base.settings import SettingsData, SettingsError
from cgemit.base.validate import NO, Positive, expected, kinds_of, matcher
from cgemit.chain.settings import Settings
from cgemit.reconstruction.clusterers.clusterer import ClusterSettings
from cgemit.reconstruction.find.ckf import FindSettings
from cgemit.reconstruction.fit import FitSettings
from cgemit.reconstruction.refine import RefineSettings
from cgemit.reconstruction.states import SurfaceName
from cgemit.simulation.digitize import DigitizeSettings
from cgemit.simulation.transport import SimulateSettings

STAGES = (SimulateSettings, DigitizeSettings, ClusterSettings, FitSettings)

ENERGY = '"1 GeV" (an energy), expected a momentum with its unit (GeV/c, MeV/c); did you mean "1 GeV/c"?'
SURFACES = ", ".join(map(repr, get_args(SurfaceName)))

#: Settings none of which is a default.
CHANGED = Settings(
    simulate=SimulateSettings(sublayers=True, foil="lattice", screening="moliere", deltas=False, steps=True),
    digitize=DigitizeSettings(reveal_sides=True),
    cluster=ClusterSettings(position="charge", reference_p=0.1 + 0.2, reference_cos_theta=1 / 3),
    find=FindSettings(momentum=0.25, hypothesis="K"),
    fit=FitSettings(
        momentum=0.7, cluster_errors="cluster", screening="moliere", loss="most_probable", momentum_error=0.002,
        residuals=True, states=(90.5, "origin", "hits"), hypothesis=("mu", "K"), max_iterations=7, tolerance=1e-07,
        least_width=2, delta_strips=0.0, kinks=False, components=True, outlier_pull=0, prior_sigma=(1, 2, 3, 4, 1 / 7),
    ),
    refine=RefineSettings(start_time="fitted", start_time_error=2.5, find_again=False),
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Strips(SettingsData):
    """Settings inside others."""

    gain: Positive = 10.0


@dataclass(frozen=True, kw_only=True)
class Toy(SettingsData):
    """Settings with everything that an annotation may say."""

    strips: Strips = field(default_factory=Strips)
    limit: float | None = 5.0
    counts: tuple[int, ...] = ()
    title: str = ""


@pytest.mark.parametrize("settings", [Settings(), CHANGED, Toy(), Toy(strips=Strips(gain=3.0), limit=None)])
def test_files_give_back_what_was_written(settings: SettingsData, tmp_path: Path) -> None:
    kind = type(settings)
    assert kind.from_dict(tomllib.loads(settings.to_toml())) == settings
    assert kind.from_dict(tomllib.loads(settings.to_toml(comments=True))) == settings
    assert kind.from_dict(settings.to_dict()) == settings
    settings.save(tmp_path / "s.toml")
    assert kind.load(tmp_path / "s.toml") == settings
    assert repr(kind.load(tmp_path / "s.toml")) == repr(settings)
    with pytest.raises(FileExistsError):
        settings.save(tmp_path / "s.toml")


def test_every_field_of_every_stage_is_in_the_files() -> None:
    tables = tomllib.loads(CHANGED.to_toml())
    assert tables.keys() == {f.name for f in dataclasses.fields(Settings)}
    for stage in tables:
        given = getattr(CHANGED, stage)
        left_out = {"beam"} if stage == "fit" else set()  # which does not go with states
        assert set(tables[stage]) == {f.name for f in dataclasses.fields(given)} - left_out
        for name, value in tables[stage].items():
            kept = getattr(given, name)
            assert value == (list(kept) if isinstance(kept, tuple) else kept), name


def test_a_beam_spot_is_in_the_files() -> None:
    settings = FitSettings(beam=(0.1, 5.0))
    assert tomllib.loads(settings.to_toml())["beam"] == [0.1, 5.0]
    assert FitSettings.from_dict(tomllib.loads(settings.to_toml())) == settings


def test_none_is_left_out_where_it_is_the_default_and_is_a_word_elsewhere() -> None:
    assert "screening" not in tomllib.loads(FitSettings().to_toml())
    assert FitSettings.from_dict(tomllib.loads('screening = "none"')) == FitSettings()
    assert tomllib.loads(Toy(limit=None).to_toml())["limit"] == "none"


def test_all_problems_of_a_file_are_listed_at_once(tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(
        "fits = 1\n[fit]\nloss = 'meen'\ntolerance = -1\nprior_sigma = [1, 2]\nstates = ['hits', 'nowhere']\nlos = 1\n"
        "[simulate]\nfoil = 'lattice'\nfluctuations = 'off'\ndeltas = 'no'\n[cluster]\nreference_p = '1 GeV'\n",
        encoding="utf-8",
    )
    with pytest.raises(SettingsError) as error:
        Settings.load(file)
    assert error.value.source == str(file)
    assert sorted(map(str, error.value.problems)) == sorted(
        [
            f"fits: got an unknown key, expected one of {', '.join(kinds_of(Settings))}; did you mean \"fit\"?",
            f"fit.los: got an unknown key, expected one of {', '.join(kinds_of(FitSettings))}; did you mean \"loss\"?",
            "fit.loss: got 'meen', expected one of 'truncated', 'mean', 'most_probable'; did you mean \"mean\"?",
            "fit.tolerance: got -1, expected a positive number",
            "fit.prior_sigma: got [1, 2], expected a list of 5, each a number of at least 1e-12",
            f"fit.states[1]: got 'nowhere', expected a length in mm above 0, or one of {SURFACES}",
            "simulate.deltas: got 'no', expected true or false",
            "simulate.foil: got 'lattice', expected 'effective' unless fluctuations are 'full'",
            f"cluster.reference_p: got {ENERGY}",
        ]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [("loss = ", r"1 problem\n  not a TOML file: Invalid value"), ("3", "not a TOML file: "), (None, "no such file")],
)
def test_files_that_cannot_be_read(text: str | None, message: str, tmp_path: Path) -> None:
    file = tmp_path / "s.toml"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=message):
        Settings.load(file)


def test_later_layers_lie_over_earlier_ones_and_problems_name_theirs() -> None:
    first = {"fit": {"loss": "mean", "tolerance": 0.5}}
    both = Settings.from_layers([("a.toml", first), ("--set", {"fit": {"tolerance": 0.2}})])
    assert both == Settings(fit=FitSettings(loss="mean", tolerance=0.2))
    with pytest.raises(SettingsError) as error:
        Settings.from_layers([("a.toml", {"fit": {"loss": "m"}}), ("--set", {"fit": {"tolerance": 0}, "find": 1})])
    assert [problem.path for problem in error.value.problems] == [
        "a.toml: fit.loss", "--set: fit.tolerance", "--set: find",
    ]  # fmt: skip


def test_overrides_are_those_of_the_fields() -> None:
    changed = Settings().with_overrides({"fit.loss": "mean", "simulate.deltas": False, "fit.states": ["hits", 90]})
    assert changed == Settings(
        simulate=SimulateSettings(deltas=False), fit=FitSettings(loss="mean", states=("hits", 90.0))
    )
    assert changed.with_overrides({"fit.loss": "truncated"}).fit == FitSettings(states=("hits", 90.0))
    with pytest.raises(SettingsError, match=r"1 problem\n  fit\.loss: got 1,"):
        changed.with_overrides({"fit.loss": 1})


@pytest.mark.parametrize(
    ("kind", "given", "kept"),
    [
        (bool, np.True_, True), (bool, 1, NO), (int, np.int64(3), 3), (int, True, NO), (int, 2.0, NO),
        (float, 3, 3.0), (float, np.float32(0.5), 0.5), (float, "3", NO), (float, float("nan"), NO), (float, True, NO),
        (Positive, 0, NO), (Positive, float("inf"), NO), (str, "a", "a"), (str, 1, NO), (float | None, None, None),
        (Literal["a", "b"], np.str_("b"), "b"), (Literal["a", "b"], "c", NO), (Literal["a"], ["a"], NO),
        (tuple[int, ...], [1, 2], (1, 2)), (tuple[int, ...], np.arange(2), (0, 1)), (tuple[int, ...], [1, "2"], NO),
        (tuple[float, float], (1, 2), (1.0, 2.0)), (tuple[float, float], (1,), NO), (tuple[int, ...], "12", NO),
    ],
)  # fmt: skip
def test_values_are_kept_as_those_of_python(kind: Any, given: object, kept: object) -> None:
    value = matcher(kind)(given)
    assert value == kept
    assert type(value) is type(kept)


@pytest.mark.parametrize("cls", [*STAGES, Settings], ids=lambda cls: cls.__name__)
def test_every_field_has_a_default_and_words_for_what_it_may_be(cls: type[SettingsData]) -> None:
    settings = cls()
    for name, kind in kinds_of(cls).items():
        assert matcher(kind)(getattr(settings, name)) == getattr(settings, name)
        assert expected(kind)
        with pytest.raises(SettingsError, match=f"^{cls.__name__}: 1 problem\n  {name}: got "):
            dataclasses.replace(settings, **{name: object()})


@pytest.mark.parametrize("given", [5, {"residuals": True}, Settings()], ids=["number", "mapping", "all stages"])
def test_functions_refuse_settings_of_another_kind(given: Any) -> None:
    """With the name of the argument and the kind that it takes, before anything is computed."""
    made = cg.run("besiii-cgem", cg.Gun("mu-", p=1.0, cos_theta=0.3), n=1)
    detector, hits = made.detector, (made.clusters, made.wire_hits)
    calls: dict[str, Callable[[], Any]] = {
        "settings: got {}, expected SimulateSettings": lambda: cg.simulate(detector, made.particles, given),
        "settings: got {}, expected DigitizeSettings": lambda: cg.digitize(
            detector, made.truths, made.wire_truths, given
        ),
        "settings: got {}, expected BackgroundSettings": lambda: cg.add_background(
            detector, made.digis, made.wire_hits, given, seed=1
        ),
        "settings: got {}, expected ClusterSettings": lambda: cg.cluster(detector, made.digis, given),
        "settings: got {}, expected FindSettings": lambda: cg.find_tracks(detector, *hits, given),
        "settings: got {}, expected FitSettings": lambda: cg.fit(
            detector, *hits, made.candidates, made.candidate_hits, given
        ),
        "refine: got {}, expected RefineSettings": lambda: cg.fit_hits(detector, *hits, refine=given),
        "fit: got {}, expected FitSettings": lambda: cg.analytic(detector, "mu-", p=1.0, fit=given),
    }
    for message, call in calls.items():
        with pytest.raises(TypeError) as error:
            call()
        assert str(error.value) == message.format(type(given).__name__)
