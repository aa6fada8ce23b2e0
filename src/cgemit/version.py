"""The version of the installed package, and the address of its documentation."""

from importlib import metadata

#: Raised with every change of results ("Results change" in CHANGELOG.md): stored results of a sweep with another number
#: are computed anew. A test ties it to the golden numbers.
PHYSICS = 4

#: Address of the pages of docs/; `[project.urls]` of pyproject.toml has the address of the site.
DOCS = "https://cgemit.readthedocs.io/en/latest/docs"

try:
    VERSION = metadata.version("cgemit")
except metadata.PackageNotFoundError:  # run from a source tree
    VERSION = "unknown"
