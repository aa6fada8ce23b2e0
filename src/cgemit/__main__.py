"""``python -m cgemit`` is the command line."""

import sys

from cgemit.cli.main import main

sys.exit(main())
