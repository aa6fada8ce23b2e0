"""Pictures show themselves by pyplot, which does not know them before."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import matplotlib as mpl
import pytest
from matplotlib import pyplot as plt
from matplotlib.backends.backend_agg import FigureCanvasAgg

from cgemit.draw.style import new_picture


@pytest.mark.parametrize("name", ["x.jpgg", "x.jpg", "x.PNG", "x.pgn", "x.pdff", "x.tiff"])
def test_unknown_formats_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf'got "{name}", expected a name that ends in .png, .pdf or .svg'):
        new_picture()[0].save(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["p-1.0", "dr", "v.final", "sigma.mean", "p.pT", "L1.p2"])
def test_other_endings_are_parts_of_the_name(name: str, tmp_path: Path) -> None:
    written = new_picture()[0].save(tmp_path / name)
    assert [path.name for path in written] == [f"{name}.png", f"{name}.pdf"]


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[list[object]]]:
    """A backend with windows, which are closed as soon as they are shown; what each call has shown."""
    backend, shown, before = ModuleType("windows"), [], mpl.get_backend()

    def show() -> None:
        shown.append([plt.figure(number) for number in plt.get_fignums()])
        plt.close("all")

    backend.FigureCanvas, backend.show = FigureCanvasAgg, show  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "windows", backend)
    plt.switch_backend("module://windows")
    yield shown
    plt.switch_backend(before)


def test_a_picture_is_shown_in_a_window_each_time(windows: list[list[object]]) -> None:
    picture, (axes,) = new_picture()
    axes.plot([0, 1])
    picture.show()
    picture.show()
    assert windows == [[picture], [picture]]
    assert picture.axes == [axes]


def test_without_windows_it_says_so() -> None:
    picture, _ = new_picture()
    assert mpl.get_backend().lower() == "agg"
    with pytest.warns(UserWarning, match=r"save\(\)"):
        picture.show()
    picture.show(warn=False)
    assert not plt.get_fignums()
