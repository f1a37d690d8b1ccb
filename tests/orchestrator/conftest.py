from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.orchestrator.fakes import Harness

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture
def harness(tmp_path: Path) -> Harness:
    return Harness(tmp_path)


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    """One browser for all tests of a file; the test skips where there is none."""
    from tests.orchestrator.watch.dashboard.browser import chromium  # noqa: PLC0415  # loading Playwright takes a while

    with chromium() as running:
        yield running
