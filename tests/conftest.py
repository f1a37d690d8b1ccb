"""What holds for every test; the order of their files, and which of them take long."""

import gc
import json
import os
import random
import signal
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # before torch is imported: the processes share the cores
    os.environ["OMP_NUM_THREADS"] = "1"

import pytest
from hypothesis import settings

from tests import leaks

_DURATIONS = Path(__file__).with_name("durations.json")  # seconds of each long file, in `make test`
_LONG_S = 3.0  # seconds from which on a file takes long
_SHOWN = 10  # files in the summary

# The same examples each time, so a failure can be repeated; no deadline, because machines differ.
settings.register_profile("panolog", derandomize=True, deadline=None)
settings.load_profile("panolog")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds options of ours."""
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run files and their tests in another order")
    parser.addoption(
        "--write-durations",
        action="store_true",
        help=f"record the slow files of this run in {_DURATIONS.name}",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Checks after each test that nothing of it is left; Ctrl-C works, also in a shell's background job."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    leaks.configure(config)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files all of whose tests `-m "not system and not nightly"` leaves out: they would be imported."""
    terms = str(config.getoption("markexpr")).split(" and ")
    if all(term.startswith("not ") for term in terms) and collection_path.match("test_*.py"):
        marks = [f"\npytestmark = pytest.mark.{term.removeprefix('not ')}\n" for term in terms]
        if any(mark in collection_path.read_text() for mark in marks):
            return True
    return None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keeps what is imported out of all searches for garbage, which took a quarter of the collection."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Files that take longest come first: with several processes none of them is left alone at the end."""
    order: dict[str, float] = {file: -seconds for file, seconds in json.loads(_DURATIONS.read_text()).items()}
    if (seed := config.getoption("--shuffle")) is not None:
        chance = random.Random(seed)
        chance.shuffle(items)
        order = {file: chance.random() for file in sorted({_file(item.nodeid) for item in items})}
    items.sort(key=lambda item: order.get(_file(item.nodeid), 0.0))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Shows what was skipped and why, and the slowest files of a run of many."""
    reasons = Counter(
        report.longrepr[2] for report in terminalreporter.stats.get("skipped", ()) if report.longrepr
    )
    if reasons:
        terminalreporter.section("skipped")
    for reason, count in reasons.most_common():
        terminalreporter.write_line(f"{count:7d}    {reason.removeprefix('Skipped: ')}")
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
        _record(terminalreporter, seconds)


def _record(terminalreporter: pytest.TerminalReporter, seconds: dict[str, float]) -> None:
    """Writes how long files took that take long or have tests of a system; files that did not run stay."""
    reports = [report for reports in terminalreporter.stats.values() for report in reports]
    system = {
        _file(report.nodeid)
        for report in reports
        if isinstance(report, pytest.TestReport) and "system" in report.keywords
    }
    recorded = {
        file: took for file, took in json.loads(_DURATIONS.read_text()).items() if file not in seconds
    }
    for file, took in seconds.items():
        if took >= _LONG_S or file in system:
            tenths = round(10 * took)
            recorded[file] = (tenths + (tenths % 10 == 0)) / 10  # a whole number would be an estimate
    longest_first = dict(sorted(recorded.items(), key=lambda item: -item[1]))
    _DURATIONS.write_text(json.dumps(longest_first, indent=2) + "\n")


def _file(nodeid: str) -> str:
    return nodeid.partition("::")[0]
