"""A progress bar for `run`, `scan`, `sweep` and the other functions with an argument `progress`."""

from __future__ import annotations

from typing import Any


class ProgressBar:
    """A bar of tqdm: a widget in notebooks, a line on a terminal.

    ``cgemit.run(..., progress=cgemit.ProgressBar())`` shows how much of the work is done. A bar serves one call.

    Parameters
    ----------
    label : str
        What is running; studies replace it.

    Raises
    ------
    ImportError
        If tqdm is not installed.
    """

    def __init__(self, label: str = "cgemit") -> None:
        try:
            from tqdm.auto import tqdm
        except ImportError as error:
            raise ImportError("ProgressBar: needs tqdm; pip install 'cgemit[notebook]' installs it") from error
        shape = "{l_bar}{bar}| {elapsed}<{remaining}"
        self._bar: Any = tqdm(total=1.0, desc=label, bar_format=shape)

    def __call__(self, fraction: float, label: str = "") -> None:
        """Show that `fraction` (0 to 1) of the work is done, and what is running now."""
        if label:
            self._bar.set_description(label, refresh=False)
        self._bar.update(min(fraction, 1.0) - self._bar.n)
        if fraction >= 1:
            self._bar.close()
