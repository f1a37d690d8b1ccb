"""What all tests of the command line share."""

from pathlib import Path

import pytest

from tests.scenes import write_scene


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands print no progress, however slow this machine is: most tests expect exact lines."""
    monkeypatch.setattr("panolog.orchestrator.cli.console._FIRST", 600.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scene. No test changes it."""
    return write_scene(tmp_path_factory.mktemp("scene") / "town")
