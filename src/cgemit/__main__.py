"""The program: ``cgemit``, or ``python -m cgemit``."""

import contextlib
import os
import signal
import sys
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_INTERRUPTED = 130


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C ends it quietly while it is still being imported.

    SIGTERM counts as Ctrl-C: by default it ends the process at once and leaves unfinished folders behind. The first
    one of both ends the stages at work and unwinds the command, a second one ends the process at once. Streams that
    the shell has closed (``>&-``) take what is written to them, and no file of the run gets their numbers.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
    try:
        _handle(_interrupt)
        from cgemit.cli.main import main as command

        code = command()
        _handle(signal.SIG_IGN)  # all is written; while Python ends, its handlers would not be called
    except BaseException as error:  # others if imports, such as classes in Python 3.11, make them of an interruption
        if not isinstance(error, KeyboardInterrupt) and signal.getsignal(signal.SIGINT) is not _leave:
            raise
        code = _INTERRUPTED
    if code == _INTERRUPTED:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):  # closed
                stream.flush()
        _leave()
    return code


def _handle(how: object) -> None:
    for number in _SIGNALS:
        signal.signal(number, how)  # type: ignore[arg-type]


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End the command: raise KeyboardInterrupt here and in the stages at work on all threads."""
    _handle(_leave)
    core = sys.modules.get("cgemit._core.common")
    if hasattr(core, "stop_stages"):  # else it is being imported
        core.stop_stages(True)  # type: ignore[union-attr]
    raise KeyboardInterrupt


def _leave(*_: object) -> None:
    """End the process at once, without its temporary folders and the processes that it started.

    Threads may still run: where Python ends in the usual way, it would end them by force, in the middle of the core.
    """
    _handle(signal.SIG_IGN)
    with contextlib.suppress(Exception):
        if "multiprocessing" in sys.modules:
            from multiprocessing import active_children

            for child in active_children():
                child.kill()
    with contextlib.suppress(Exception):
        if "cgemit.base.files" in sys.modules:
            sys.modules["cgemit.base.files"].remove_temporaries()
    os._exit(_INTERRUPTED)


if __name__ == "__main__":
    sys.exit(main())
