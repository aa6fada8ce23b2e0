"""The progress bar on the error stream."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TextIO

_WIDTH = 28  # characters of the bar
_REDRAW = 0.1  # s between two drawings on a terminal
_STEP = 0.1  # share of the work between two lines in a log file


class Progress:
    """Show how much of a job is done: a moving bar on a terminal, a line every tenth in a log file.

    Parameters
    ----------
    label : str
        What is running.
    quiet : bool
        Show nothing.
    stream : text stream, optional
        Default: the error stream.
    """

    def __init__(self, label: str, *, quiet: bool = False, stream: TextIO | None = None) -> None:
        self.label, self.quiet = label, quiet
        self._stream = stream or sys.stderr
        self._terminal = self._stream.isatty()
        self._start = self._drawn = time.monotonic()
        self._shown = 0.0
        self._length = 0

    def __call__(self, fraction: float, label: str = "") -> None:
        """Show that `fraction` (0 to 1) of the work is done, and what is running now."""
        if self.quiet:
            return
        self.label = label or self.label
        now = time.monotonic()
        if self._terminal and (now - self._drawn >= _REDRAW or fraction >= 1):
            self._drawn = now
            self._draw(fraction, now - self._start)
        elif not self._terminal and (fraction - self._shown >= _STEP - 1e-9 or fraction >= 1 > self._shown):
            self._shown = fraction
            self._stream.write(f"{self.label}: {fraction:4.0%}, {now - self._start:.1f} s\n")
            self._stream.flush()

    def _draw(self, fraction: float, seconds: float) -> None:
        full = round(_WIDTH * min(1.0, fraction))
        line = f"[{'#' * full}{'.' * (_WIDTH - full)}] {fraction:4.0%} {seconds:5.1f} s  {self.label}"
        self._stream.write("\r" + line.ljust(self._length))
        self._length = len(line)
        self._stream.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # Leave the terminal's line free for what is written next.
        if self._terminal and not self.quiet and self._length:
            self._stream.write("\r" + " " * self._length + "\r")
            self._stream.flush()
