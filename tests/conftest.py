"""What holds for every test."""

from hypothesis import settings

# The same examples each time, so a failure can be repeated; no deadline, because machines differ.
settings.register_profile("panolog", derandomize=True, deadline=None)
settings.load_profile("panolog")
