"""What all tests of the command line share."""

import pytest


@pytest.fixture(autouse=True)
def _no_lines_of_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands print no progress, however slow this machine is: most tests expect exact lines."""
    monkeypatch.setattr("panolog.orchestrator.cli.console._FIRST", 600.0)
