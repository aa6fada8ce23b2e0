"""The program: ``cgemit``, or ``python -m cgemit``."""

import os
import signal
import sys


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C ends it quietly while it is still being imported.

    SIGTERM counts as Ctrl-C: by default it ends the process at once and leaves unfinished folders behind. Streams that
    the shell has closed (``>&-``) take what is written to them, and no file of the run gets their numbers.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: PTH123, SIM115
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from cgemit.cli.main import main as command

        return command()
    except KeyboardInterrupt:
        return 130
    except RuntimeError as error:  # which Python 3.11 makes of an interruption in the body of a class
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        return 130


if __name__ == "__main__":
    sys.exit(main())
