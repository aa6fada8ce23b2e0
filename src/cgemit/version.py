"""The version of the installed package."""

from importlib import metadata

try:
    VERSION = metadata.version("cgemit")
except metadata.PackageNotFoundError:  # run from a source tree
    VERSION = "unknown"
