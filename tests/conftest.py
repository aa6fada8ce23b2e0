"""Settings and fixtures of all tests. The folder `helpers` is on the path, so that tests import them by name."""

import os
import sys
from collections.abc import Iterator

# Tests run in a process for each core: threads of OpenBLAS would only wait for each other. Read when numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

# The same examples in every run: a test passes always or never.
settings.register_profile("fixed", derandomize=True, deadline=None, database=None)
settings.load_profile("fixed")

# jsonschema would compile a grammar of addresses, which no schema here has, for longer than all other imports take.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that rewrites the numbers on file."""
    parser.addoption("--update-golden", action="store_true", help="write tests/golden/*.json anew")


@pytest.fixture
def undrawn(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write files without the picture, which take most of the time of a command; with the slow tests all are drawn."""
    if request.config.getoption("markexpr") == "not slow":
        monkeypatch.setattr("cgemit.draw.style.Picture.savefig", lambda _, stream, **how: stream.write(b"not drawn"))


@pytest.fixture
def equal_weights(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Tune detectors in which all matter of a track acts with every slab; none of them is kept."""
    from caches import forget
    from cgemit import fit_matter

    monkeypatch.setattr(fit_matter, "_muon_terms", lambda *_: None)
    monkeypatch.setattr(fit_matter, "_assumed", lambda core: core)
    monkeypatch.setattr(fit_matter, "_kept", fit_matter._tuned)
    forget()  # and the momentum errors that presets have kept
    yield
    forget()
