"""Colours, sizes and the figure class that all pictures share."""

from __future__ import annotations

import io
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cgemit.analysis.quantities import KINEMATICS
from cgemit.base.errors import did_you_mean
from cgemit.base.files import new_file
from cgemit.base.validate import InTurn
from cgemit.particles.gun import Gun, Guns, Source

#: Okabe-Ito colours (distinguishable with colour-blind eyes and in grey), by what they stand for.
COLORS = {
    "cgem": "#0072B2",
    "idc": "#D55E00",
    "truth": "#009E73",
    "fit": "#CC3311",
    "data": "#222222",
    "single": "#E69F00",
    "multi": "#56B4E9",
    "x": "#0072B2",
    "v": "#D55E00",
    "wire": "#8A8A8A",
    "matter": "#C8CED6",
    "text": "#333333",
    "grid": "#E3E6EA",
}

#: Colours of curves, bars and areas, in turn; neighbours differ in lightness too.
SERIES = (
    COLORS["cgem"], COLORS["single"], COLORS["truth"], COLORS["idc"], COLORS["multi"], "#7A3E9D", "#F0E442", "#666666",
)  # fmt: skip
#: One marker fewer than colours, so that only the 57th curve looks like the first.
MARKERS = ("o", "s", "D", "^", "v", "P", "X")
_LINES = (COLORS["cgem"], COLORS["idc"], COLORS["truth"], "#7A3E9D", "#666666", COLORS["multi"])
_HATCHES = ("", "///", "...", "xxx")

#: Endings of files that hold pictures.
_FORMATS = ("png", "pdf", "svg", "jpg", "jpeg", "gif", "eps", "ps", "tif", "tiff", "webp", "bmp")

_STYLE = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.labelsize": 10,
    "axes.edgecolor": "#555555",
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "xtick.labelcolor": COLORS["text"],
    "ytick.labelcolor": COLORS["text"],
    "xtick.direction": "in",
    "ytick.direction": "in",
    "xtick.top": True,
    "ytick.right": True,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}

#: Backends of matplotlib that only write files.
_WITHOUT_WINDOWS = ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template")
_DPI = 130  # of the PNG files and of the pictures in notebooks


class Picture(Figure):
    """A matplotlib figure that shows itself in a notebook, by `show` in a script, and needs no window system.

    Examples
    --------
    >>> picture = cg.draw.draw_budget(cg.analytic("besiii-cgem-design", p=[0.3, 0.5, 1.0]).budget("dr"))
    >>> [file.name for file in picture.save("budget")]
    ['budget.png', 'budget.pdf']
    >>> picture.show(warn=False)  # a window, where matplotlib has one
    """

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=_DPI)
        return stream.getvalue()

    def show(self, warn: bool = True) -> None:
        """Show the picture, in a script in a window until that is closed, in a notebook below the cell.

        Parameters
        ----------
        warn : bool
            Whether to warn where matplotlib's backend has no windows.
        """
        from matplotlib import pyplot as plt

        backend = mpl.get_backend()
        if backend.lower() in _WITHOUT_WINDOWS:
            if warn:
                warnings.warn(f"matplotlib's backend {backend} has no windows; save() writes files", stacklevel=2)
            return
        manager = self.canvas.manager
        if manager is None or not plt.fignum_exists(manager.num):
            plt.figure(FigureClass=lambda **_: self)  # type: ignore[arg-type]  # pyplot takes this picture for its own
        plt.show()

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Write the picture as PNG and PDF, or in one format if `path` names one.

        Raises
        ------
        FileExistsError
            If a file exists and `overwrite` is false.
        ValueError
            If `path` ends like a format of pictures that is none of png, pdf and svg.
        """
        path = Path(path)
        # Only these count as formats: a name such as "p-1.0" must not lose its end.
        known = path.suffix in (".png", ".pdf", ".svg")
        if not known and path.suffix[1:].isalpha() and did_you_mean(path.suffix[1:], _FORMATS):
            raise ValueError(
                f'save: got "{path.name}", expected a name that ends in .png, .pdf or .svg, or a bare name'
            )
        targets = [path] if known else [path.with_name(path.name + end) for end in (".png", ".pdf")]
        for target in targets:
            with new_file(target, overwrite=overwrite) as temporary:
                # No creation date, so that the same run writes the same bytes.
                metadata = {"CreationDate": None} if target.suffix == ".pdf" else None
                # First into memory: on a full disk matplotlib's PDF writer hides the error behind one of its own.
                stream = io.BytesIO()
                self.savefig(stream, format=target.suffix[1:], dpi=_DPI, metadata=metadata)
                temporary.write_bytes(stream.getvalue())
        return targets


@contextmanager
def style() -> Iterator[None]:
    """Apply the project's style to what is drawn inside the block, and only there."""
    with mpl.rc_context(_STYLE):  # type: ignore[arg-type]
        yield


def new_picture(
    rows: int = 1, columns: int = 1, size: tuple[float, float] | None = None, **options: Any
) -> tuple[Picture, Sequence[Axes]]:
    """Return a picture and its axes, row by row.

    Parameters
    ----------
    size : (float, float), optional
        Width and height in inches.
    **options
        Passed to `Figure.subplots`.
    """
    picture = Picture(figsize=size or (5.4 * columns, 4.0 * rows))
    axes = picture.subplots(rows, columns, squeeze=False, **options)
    return picture, list(axes.flat)


def legend_entries(axes: Sequence[Axes]) -> dict[str, Any]:
    """Return the handles of all axes by label, each label once."""
    pairs = (zip(*plot.get_legend_handles_labels(), strict=True) for plot in axes)
    return {label: handle for pair in pairs for handle, label in pair}


def plain(text: str) -> str:
    """Return text of users, such as a name, so that matplotlib does not take ``$`` for the limits of a formula."""
    return text.replace("$", r"\$")


_SYMBOLS = {
    "d_ρ": r"$d_\rho$", "d_z": "$d_z$", "p_T": "$p_T$", "φ₀": r"$\phi_0$", "tan λ": r"$\tan\lambda$", "κ": r"$\kappa$",
}  # fmt: skip


def mathematical(label: str) -> str:
    """Return a label with d_ρ, d_z, p_T, φ₀, κ and tan λ set as formulas."""
    for text, formula in _SYMBOLS.items():
        label = label.replace(text, formula)
    return label


def statistics_box(axes: Axes, lines: Sequence[str], *, right: bool = True, top: float = 0.97) -> None:
    """Write a few lines of numbers into a corner of the axes."""
    lines = [re.sub(r"(?<![\w.])-(?=\d)", "−", line) for line in lines]
    axes.text(
        0.97 if right else 0.03, top, "\n".join(lines), transform=axes.transAxes, ha="right" if right else "left",
        va="top", fontsize=8.4, linespacing=1.4, color=COLORS["text"],
        bbox={"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": COLORS["grid"], "alpha": 0.92},
    )  # fmt: skip


def grid(axes: Axes) -> None:
    """Draw a faint grid behind the data."""
    axes.grid(True, color=COLORS["grid"], linewidth=0.7)


def legend_below(picture: Picture, labels: Sequence[str]) -> None:
    """Draw the legend of all curves of a picture below its panels."""
    from matplotlib.lines import Line2D

    options: dict[str, Any] = {"ls": "", "ms": 6}
    handles = [
        Line2D([], [], marker=marker, color=colour, label=plain(label), **options)
        for label, (marker, colour) in zip(labels, looks(), strict=False)
    ]
    picture.legend(handles=handles, loc="lower center", ncols=len(labels), fontsize=9.5)


def looks() -> Iterator[tuple[str, str]]:
    """Yield marker and colour of each curve."""
    return zip(cycle(MARKERS), cycle(_LINES), strict=False)


def fills(number: int) -> list[tuple[str, str]]:
    """Return colour and hatch of each of several areas or bars; a colour comes again with another hatch."""
    return [(SERIES[i % len(SERIES)], _HATCHES[i // len(SERIES) % len(_HATCHES)]) for i in range(number)]


def shot_text(source: Source | Guns | None) -> str:
    """Return particle, momentum and angle of a gun, or of several, as text.

    Parameters
    ----------
    source : Gun, EventSample, Guns or None
        None: particles were given.
    """
    guns: Sequence[Source] = () if source is None else source.guns if isinstance(source, Guns) else (source,)
    texts = []
    for gun in guns:
        if not isinstance(gun, Gun):
            texts.append(repr(gun))
            continue
        given = {name: getattr(gun, name) for name in ("p", "pt", "theta", "cos_theta", "eta")}
        shot = [KINEMATICS[name].text(_value(value)) for name, value in given.items() if value is not None]
        texts.append(", ".join([str(gun.particle), *shot]))
    return "; ".join(texts) or "given particles"


def _value(value: Any) -> Any:
    if not isinstance(value, InTurn):
        return value
    return ", ".join(f"{one:g}" for one in value.values[:5]) + (", ..." if len(value.values) > 5 else "")
