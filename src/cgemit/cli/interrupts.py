"""What comes from outside while a command runs: Ctrl-C or SIGTERM, which end it, and a closed pipe, which does not."""

from __future__ import annotations

import _thread
import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO, cast

_AGAIN = 0.02  # s


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Repeat an interrupt that Python has dropped, and take SIGTERM for one.

    By default SIGTERM ends the process on the spot, and unfinished folders stay behind.

    An exception that arises while an object is taken down (a finalizer, a weak reference's callback) is reported and
    forgotten; matplotlib has many of these, so that Ctrl-C during the drawing would sometimes do nothing.
    """
    report = sys.unraisablehook

    def repeat(dropped: sys.UnraisableHookArgs) -> None:
        if dropped.exc_type is KeyboardInterrupt:
            # Later and from outside: here it would be dropped again.
            threading.Timer(_AGAIN, _thread.interrupt_main).start()
        else:
            report(dropped)

    sys.unraisablehook = repeat
    # Python handles signals in its main thread only; a program that calls us may have a handler of its own.
    takes_over = (
        threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    )
    if takes_over:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        sys.unraisablehook = report
        if takes_over:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def pipes_kept() -> Iterator[None]:
    """Let a command go on without its reader when that has gone, as `head` does after some lines.

    Its files are written all the same, and the exit code is that of the command.
    """
    streams = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (cast(TextIO, _Kept(stream)) for stream in streams)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stdout, sys.stderr = streams


class _Kept:
    """A text stream that drops what cannot be written any more."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._drop()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._drop()

    def _drop(self) -> None:
        """Send what is still in the buffer, and everything to come, to nowhere."""
        with contextlib.suppress(io.UnsupportedOperation), open(os.devnull, "wb") as nowhere:  # noqa: PTH123
            os.dup2(nowhere.fileno(), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
