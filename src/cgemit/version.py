"""The version of the installed package."""

from importlib import metadata

#: Raised with every change of results ("Results change" in CHANGELOG.md): stored results of a sweep with another number
#: are computed anew. A test ties it to the golden numbers.
PHYSICS = 2

try:
    VERSION = metadata.version("cgemit")
except metadata.PackageNotFoundError:  # run from a source tree
    VERSION = "unknown"
