"""What holds for every test."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch is imported: the workers share the cores
    os.environ["OMP_NUM_THREADS"] = "1"

from hypothesis import settings

# The same examples each time, so a failure can be repeated; no deadline, because machines differ.
settings.register_profile("panolog", derandomize=True, deadline=None)
settings.load_profile("panolog")
