"""A progress bar for `run`, `scan`, `sweep` and the other functions with an argument `progress`."""

from __future__ import annotations

from typing import Any

from tqdm.auto import tqdm


class ProgressBar:
    """A bar of tqdm: a widget in notebooks, a line on a terminal.

    ``cgemit.run(..., progress=cgemit.ProgressBar())`` shows how much of the work is done. A bar serves one call.

    Parameters
    ----------
    label : str
        What is running; studies replace it.
    **options : Any
        Of tqdm, such as ``leave=False``.

    Examples
    --------
    >>> gun = cg.Gun("mu-", p=1.0, cos_theta=0.0)
    >>> result = cg.run("besiii-cgem", gun, n=20, progress=cg.ProgressBar("muons"))  # muons: 100%|████| 00:00<00:00
    >>> result.n_events
    20
    """

    def __init__(self, label: str = "cgemit", **options: Any) -> None:
        self._bar: Any = tqdm(total=1.0, desc=label, bar_format="{l_bar}{bar}| {elapsed}<{remaining}", **options)

    def __call__(self, fraction: float, label: str = "") -> None:
        """Show that `fraction` (0 to 1) of the work is done, and what is running now."""
        if label:
            self._bar.set_description(label, refresh=False)
        self._bar.update(min(fraction, 1.0) - self._bar.n)
        if fraction >= 1:
            self._bar.close()

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()
