"""What holds for every test; the order of their files, and which of them take long."""

import json
import os
from collections import defaultdict
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch is imported: the processes share the cores
    os.environ["OMP_NUM_THREADS"] = "1"

import pytest
from hypothesis import settings

from tests import leaks

_DURATIONS = Path(__file__).with_name(
    "durations.json"
)  # seconds of each file that takes long, in `make test`
_LONG_S = 3.0  # seconds from which on a file takes long
_SHOWN = 10  # files in the summary

# The same examples each time, so a failure can be repeated; no deadline, because machines differ.
settings.register_profile("panolog", derandomize=True, deadline=None)
settings.load_profile("panolog")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds an option of ours."""
    parser.addoption(
        "--write-durations",
        action="store_true",
        help=f"record the slow files of this run in {_DURATIONS.name}",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Checks after each test that nothing of it is left."""
    leaks.configure(config)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take longest come first: with several processes none of them is left alone at the end."""
    recorded: dict[str, float] = json.loads(_DURATIONS.read_text())
    items.sort(key=lambda item: -recorded.get(_file(item.nodeid), 0.0))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Shows the slowest files of a run of many."""
    seconds: dict[str, float] = defaultdict(float)
    for reports in terminalreporter.stats.values():
        for report in reports:
            if isinstance(report, pytest.TestReport):
                seconds[_file(report.nodeid)] += report.duration
    if len(seconds) > _SHOWN:
        terminalreporter.section("slowest files")
        for file, duration in sorted(seconds.items(), key=lambda item: -item[1])[:_SHOWN]:
            terminalreporter.write_line(f"{duration:7.1f} s  {file}")
    if config.getoption("--write-durations"):
        recorded = json.loads(_DURATIONS.read_text()) | {file: round(s, 1) for file, s in seconds.items()}
        kept = {
            file: s for file, s in recorded.items() if s >= _LONG_S and Path(config.rootpath, file).exists()
        }
        ordered = dict(sorted(kept.items(), key=lambda item: -item[1]))
        _DURATIONS.write_text(json.dumps(ordered, indent=2) + "\n")


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0]
