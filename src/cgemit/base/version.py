"""The version of the installed package, and that of its physics."""

from __future__ import annotations

from importlib import metadata

#: Raised with every change of results ("Results change" in CHANGELOG.md): stored results of a sweep with another number
#: are computed anew. A test ties it to the golden numbers.
PHYSICS = 33

try:
    __version__ = metadata.version("cgemit")
except metadata.PackageNotFoundError:  # run from a source tree
    __version__ = "unknown"
