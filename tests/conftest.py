"""Settings of all tests. This folder is on the path, so that tests import their helpers by name."""

from hypothesis import settings

# The same examples in every run: a test passes always or never.
settings.register_profile("fixed", derandomize=True, deadline=None, database=None)
settings.load_profile("fixed")
