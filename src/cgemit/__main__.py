"""The program: ``cgemit``, or ``python -m cgemit``."""

import signal
import sys


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C ends it quietly while it is still being imported.

    SIGTERM counts as Ctrl-C: by default it ends the process at once and leaves unfinished folders behind.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        from cgemit.cli.main import main as command

        return command()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
