"""docs/settings.md is what its script makes, and its examples work."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

from cgemit.base.settings import kinds_of
from cgemit.chain.settings import Settings
from cgemit.detector.readouts import READOUTS

SCRIPT = Path(__file__).parents[2] / "docs" / "settings_page.py"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("settings_page", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(script: ModuleType) -> None:
    assert script.page() == script.PAGE.read_text(encoding="utf-8"), f"run python {SCRIPT}"


def test_every_setting_has_a_meaning(script: ModuleType) -> None:
    for cls in [*kinds_of(Settings).values(), *READOUTS.values()]:
        assert script.meanings(cls).keys() == kinds_of(cls).keys(), cls.__name__
        assert all(script.meanings(cls).values()), cls.__name__


def test_the_examples_are_right(script: ModuleType) -> None:
    blocks = re.findall(r"```(python|toml)\n(.*?)```", script.TEXT, re.DOTALL)
    names: dict[str, object] = {}
    exec(next(code for kind, code in blocks if kind == "python"), names)
    settings = names["settings"]
    assert isinstance(settings, Settings)
    read = Settings.from_dict(tomllib.loads(next(code for kind, code in blocks if kind == "toml")))
    assert read == settings.with_overrides({"fit.states": ["hits", 90.0]})
