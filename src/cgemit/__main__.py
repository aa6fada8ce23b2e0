"""The program: ``cgemit``, or ``python -m cgemit``."""

import sys


def main() -> int:
    """Run the command line and return its exit code; Ctrl-C ends it quietly while it is still being imported."""
    try:
        from cgemit.cli.main import main as command

        return command()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
