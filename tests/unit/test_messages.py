"""What people read when something is wrong, and what they see in a notebook."""

import subprocess
import sys
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

import cgemit as cg
from cgemit.analysis.curves import Line
from cgemit.base.settings import SettingsError
from cgemit.chain import executor
from cgemit.cli.main import main
from cgemit.cli.options import whole
from cgemit.draw.curves import draw_curves
from cgemit.draw.style import new_picture
from cgemit.particles.table import ParticleError
from cgemit.study import chi2_flatness, gaussian_fit, pulls, scan
from cgemit.tables.show import html_table, text_table
from cgemit.units import QuantityError, parse_quantity
from fitted import make_tracks

DESIGN = "besiii-cgem-design"


@pytest.mark.parametrize(
    ("text", "dimension", "hint"),
    [("500MeV", "momentum", "500 MeV/c"), ("1.5 GeV", "momentum", "1.5 GeV/c"), ("79 MeV/c", "energy", "79 MeV")],
)
def test_energies_for_momenta(text, dimension, hint):
    with pytest.raises(QuantityError, match=f'did you mean "{hint}"'):
        parse_quantity(text, dimension)


def test_degrees_without_unit():
    with pytest.raises(ParticleError, match=r'theta: got 60, expected .*; did you mean "60 deg"\?'):
        cg.Gun("mu-", p=1, theta=60)
    assert cg.Gun("mu-", p=1, theta="60 deg").theta == pytest.approx(np.pi / 3)
    with pytest.raises(ParticleError) as caught:
        cg.Gun("mu-", p=1, theta=600)  # no angle in degrees either
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(("text", "number"), [("1e4", 10_000), ("2.5e3", 2500), ("17", 17), ("1E2", 100)])
def test_numbers_of_events_in_scientific_form(text, number):
    assert whole(text, 1, 2**31 - 1) == number
    assert whole(str(2**64 - 1), 0, 2**64 - 1) == 2**64 - 1


@pytest.mark.parametrize("text", ["1.5", "1e400", "nan", "inf", "1e-1", "", "0x10", "1e20"])
def test_what_is_no_whole_number(text, capsys):
    arguments = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "-n", text, "-o", "never"]
    assert main(arguments) == 2
    assert "expected a whole number" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sturdy"], "cgemit: unknown command 'sturdy'; did you mean \"study\"?"),
        (["xyz"], "cgemit: unknown command 'xyz'; expected one of study, "),
        (["study", "--evnts", "3"], 'cgemit study: got --evnts 3, which it does not know; did you mean "--events"?'),
        (["resolution", "-d", "x"], "cgemit resolution: the following arguments are required: -o/--output"),
        ([], "cgemit: the following arguments are required: COMMAND"),
    ],
)
def test_an_error_of_the_command_line_is_one_line(arguments, message, capsys):
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message)
    assert captured.err.count("\n") == 1
    assert not captured.out


@dataclass(frozen=True)
class Toy:
    """A read-out that nobody has registered."""

    name: ClassVar[str] = "toy"


def test_read_outs_that_are_not_registered():
    with pytest.raises(
        SettingsError,
        match=r"'binary', 'gaussian', .*; cgemit.register_readout\(Toy, ...\) registers it",
    ):
        cg.DigitizeSettings(readout=Toy())


def test_settings_of_another_read_out(tmp_path, capsys):
    (tmp_path / "mine.toml").write_text("[digitize.readout]\nsigma_x = 0.1\n")
    assert main(["settings", "--settings", str(tmp_path / "mine.toml")]) == 2
    assert "sigma_x: got an unknown key" in (text := capsys.readouterr().err)
    assert "it is a key of name = 'gaussian', and name is 'binary' here" in text
    (tmp_path / "mine.toml").write_text("[digitize.readout]\nname = 'gaussian'\nsigma_x = 0.1\n")
    assert main(["settings", "--settings", str(tmp_path / "mine.toml")]) == 0


def test_runs_larger_than_the_memory_are_refused(monkeypatch, capsys):
    gun = cg.Gun("mu-", p=1, theta=1)
    with pytest.raises(ValueError, match=r"n: 100000000 events need about [\d,]+ GB of memory") as caught:
        cg.run(DESIGN, gun, 100_000_000, workers=1)
    least = cg.run(DESIGN, gun, 1000)
    size = sum(column.nbytes for table in least.tables.values() for column in table.columns.values())
    stated = float(str(caught.value).partition("about ")[2].partition(" GB")[0].replace(",", ""))
    assert stated == pytest.approx(2e5 * size / 1e9, rel=0.03)
    arguments = ["simulate", "-d", DESIGN, "--p", "1", "--theta", "1", "-n", "1e8", "-o", "never", "--quiet"]
    assert main(arguments) == 2
    assert "GB are free; expected at most" in capsys.readouterr().err
    monkeypatch.setattr(executor, "available", lambda: 10**18)
    executor.check_memory({"tracks": 10**9}, {"tracks"}, 1000, 100_000_000)


def test_import_takes_no_numpy():
    """Ctrl-C during a long import would end the command line with a traceback."""
    code = "import sys, cgemit.__main__; sys.exit(any(name in sys.modules for name in ('numpy', 'cgemit._core')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    assert all(getattr(cg, name) is not None for name in cg.__all__)
    assert set(cg.__all__) <= set(dir(cg))
    assert cg.helix.momentum([0, 0, 1, 0, 0]) == 1  # modules, too
    with pytest.raises(AttributeError, match="no attribute 'rum'"):
        cg.rum  # noqa: B018


def line(name, y):
    return Line("sigma_p", name, np.array([0.02]), "GeV/c", np.array([y]), np.array([0.1]), "MeV/c")


def test_curves_without_points_are_not_in_the_legend():
    _, (axes,) = new_picture(1, 1)
    draw_curves(axes, [line("empty", np.nan), line("there", 5.0)], "σ(p)", "p")
    assert axes.get_legend_handles_labels()[1] == ["there"]
    assert axes.get_xticks().tolist() == [0.02]


def test_tables_have_text_to_the_left():
    rows = [["a", "1.5 ± 0.1", "none"], ["longer", "-", "3 lost"]]
    assert text_table("title", ("name", "core", "removed"), rows).splitlines() == [
        "title", "name         core  removed", "a       1.5 ± 0.1  none", "longer          -  3 lost",
    ]  # fmt: skip
    html = html_table("title", ("name", "core", "removed"), rows)
    assert '<td style="text-align:left">longer</td><td style="text-align:right">-</td>' in html


@pytest.mark.parametrize(
    "thing",
    [
        cg.Gun("mu-", p=[0.1] * 500, theta=1) + cg.Gun("pi+", pt=(0.1, 1), cos_theta=0), cg.Settings(),
        scan(DESIGN, [1.0], events=30).samples[0], cg.load(DESIGN).cgem[0], cg.load(DESIGN).drift_chamber,
        chi2_flatness(make_tracks(), 5), gaussian_fit(np.arange(50.0)), cg.load(DESIGN), pulls(make_tracks()),
    ],
    ids=lambda thing: type(thing).__name__,
)  # fmt: skip
def test_things_show_themselves(thing):
    html = thing._repr_html_()
    assert html.startswith("<")
    assert html.count("<tr") == html.count("</tr>")
    assert len(html) < 10_000
    if not isinstance(thing, type(cg.Gun("mu-", p=1, theta=1) + cg.Gun("mu-", p=1, theta=1))):
        assert len(repr(thing)) < 1500


def test_displays_hold_the_values():
    gun = cg.Gun("pi+", pt=(0.1, 1), cos_theta=0, vertex=(1, 2, 3))._repr_html_()
    assert all(text in gun for text in ("pi+", "pt [GeV/c]", "0.1 to 1", "1, 2, 3", "vertex [mm]"))
    settings = cg.Settings(fit=cg.FitSettings(loss="mean"))._repr_html_()
    assert '<th style="text-align:left">fit.loss</th><td style="text-align:left">mean</td>' in settings
    chamber = cg.load(DESIGN).drift_chamber
    assert "35 layers, 6312 cells" in repr(chamber)
    assert "matter of the wires not counted" in repr(chamber)
    smeared = cg.load(DESIGN).with_overrides({"drift_chamber.wires": "smeared"})
    assert "matter of the wires Al, spread over the gas" in repr(smeared)
    layer = cg.load(DESIGN).cgem[1]
    assert f"{layer.strips_x} X + {layer.strips_v} V" in repr(layer)


def test_keys_complete_themselves():
    tracks = make_tracks()
    assert tracks._ipython_key_completions_() == list(tracks.keys())
    found = pulls(tracks)
    assert [found[name].parameter for name in found._ipython_key_completions_()] == found._ipython_key_completions_()
