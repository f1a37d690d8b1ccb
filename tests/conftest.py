"""What holds for every test."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch is imported: the processes share the cores
    os.environ["OMP_NUM_THREADS"] = "1"

import pytest
from hypothesis import settings

# Files that take longest, first: with several processes none of them is left alone at the end.
LONGEST = (
    "orchestrator/whole_runs/test_whole_runs",
    "prepare/sfm/test_shared_places",
    "visual/test_pages",
    "orchestrator/cluster/test_machines",
    "benchmarks/test_overhead",
    "orchestrator/dashboard/test_browser_live",
    "prepare/sfm",
    "benchmarks/chaos",
    "orchestrator/whole_runs",
    "orchestrator/cluster",
    "workers/training",
    "prepare/video",
    "renderer",
)

# The same examples each time, so a failure can be repeated; no deadline, because machines differ.
settings.register_profile("panolog", derandomize=True, deadline=None)
settings.load_profile("panolog")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Orders the tests by file, those of `LONGEST` first."""

    def rank(item: pytest.Item) -> int:
        return next((n for n, name in enumerate(LONGEST) if f"tests/{name}" in item.nodeid), len(LONGEST))

    items.sort(key=rank)
