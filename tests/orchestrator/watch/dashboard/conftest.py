from collections.abc import Iterator

import pytest

from tests.orchestrator.watch.dashboard.served import Served, serving, write_whole_run


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A run without a driver, for tests that change nothing."""
    folder = tmp_path_factory.mktemp("folder")
    write_whole_run(folder / "run")
    with serving(folder) as server:
        yield server
