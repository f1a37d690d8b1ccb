"""pytest as a step: what its tests did, also when one of them ends or stops the process."""

import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from benchmarks.first_hour.outcome import NO_CARD, Context, Ending, Outcome, call, python

if TYPE_CHECKING:
    import pytest

# The log names each test before it runs, junit's first family its file; nothing is written into the tree.
# A test that hangs ends the process, because a call of the driver takes no signal.
PYTEST = python("-m", "pytest", "-m", "cuda", "-vv", "-p", "no:cacheprovider", "-o", "junit_family=xunit1")
PYTEST += ["-o", "timeout=90", "-o", "timeout_method=thread", "--ignore=tests/structure"]  # which needs git
BY_HAND = "python -m pytest -m cuda"
_DONE = "FIRST_HOUR_DONE"  # variable with the ids of tests that have run, as JSON
_STICKY = "CUDA"  # in the message of an error after which a process cannot use the card any more
_SHARE = 0.9  # of the step's time, until which tests run
_SHOWN = 20  # failures on the page
_LINE = 160  # characters of a failure
_IN_LOG = re.compile(r"(\S+\.py::[^\s\[]+(?:\[.*?\])?)(?: (PASSED|FAILED|SKIPPED|ERROR|XFAIL|XPASS)\b| |$)")
_ENDED = "the process ended or was stopped in it"


@dataclass
class Suite:
    """The tests that ran: their ids by how they ended."""

    passed: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)  # with the first line of the reason
    not_collected: dict[str, str] = field(default_factory=dict)  # files that need a package that is missing
    alone: dict[str, bool] = field(default_factory=dict)  # failures that ran again: whether they passed

    @property
    def count(self) -> str:
        """In words."""
        numbers = {"passed": self.passed, "failed": self.failed, "skipped": self.skipped}
        return ", ".join(f"{len(ids)} {name}" for name, ids in numbers.items() if ids) or "no test ran"

    @property
    def done(self) -> int:
        """How many have run."""
        return len(self.passed) + len(self.skipped) + len(self.failed)

    def add(self, other: "Suite") -> None:
        """Adds the tests of another run."""
        self.passed += other.passed
        self.skipped += other.skipped
        self.failed |= other.failed
        self.not_collected |= other.not_collected


def pytest_collection_modifyitems(config: "pytest.Config", items: list["pytest.Item"]) -> None:
    """As a plugin of pytest: leaves out the tests that have run. Its own --deselect takes prefixes."""
    done = set(json.loads(os.environ[_DONE]))
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid in done])
    items[:] = [item for item in items if item.nodeid not in done]


def tests(context: Context) -> Outcome:
    """`pytest -m cuda`, again without the test that ended it, if one did. Without a card all are skipped."""
    ends = time.monotonic() + _SHARE * context.seconds
    suite, whole, done = Suite(), False, -1
    while not whole and suite.done > done and (left := ends - time.monotonic()) > 0:
        done = suite.done
        names = json.dumps([*suite.passed, *suite.skipped, *suite.failed])
        plugin = ["-p", __name__, "--continue-on-collection-errors"]
        found, whole = run(context, [*PYTEST, *plugin], left, {_DONE: names})
        suite.add(found)
    if len(suite.failed) > 1 and any(_STICKY in reason for reason in suite.failed.values()):
        suite.alone = dict(alone(context, suite.failed, ends))
    return judged(context, suite, (BY_HAND,), whole=whole)


def run(
    context: Context, command: Sequence[str], seconds: float, environment: Mapping[str, str] | None = None
) -> tuple[Suite, bool]:
    """Runs pytest for so many seconds at most. Returns what it did and whether it came to its end."""
    report, log = context.work / "tests.xml", context.work / "log.txt"
    report.unlink(missing_ok=True)
    begin = log.stat().st_size
    call([*command, f"--junitxml={report}"], os.environ | (environment or {}), seconds)
    if report.exists():
        return read_report(report), True
    return read_log(log.read_bytes()[begin:].decode(errors="replace")), False


def read_report(report: Path) -> Suite:
    """What a report of pytest says."""
    suite = Suite()
    for case in ElementTree.parse(report).iter("testcase"):
        name = f"{case.get('file') or case.get('classname')}::{case.get('name')}"
        wrong = [part for part in case if part.tag in ("failure", "error")]
        if wrong:
            why = f"{wrong[0].get('message', '')}\n{wrong[0].text or ''}".strip()
            needs = re.search(r"ModuleNotFoundError: No module named '(\w+)", why)
            if "collection failure" in why and needs:
                suite.not_collected[name.partition("::")[0]] = needs[1]
            else:
                suite.failed[name] = why.partition("\n")[0][:_LINE]
        elif case.find("skipped") is not None:
            suite.skipped.append(name)
        else:
            suite.passed.append(name)
    return suite


def read_log(text: str) -> Suite:
    """What the output of a pytest that did not come to its end says: the last test is what ended it."""
    suite = Suite()
    for found in filter(None, map(_IN_LOG.match, text.splitlines())):
        name, ending = found.groups()
        if ending == "PASSED":
            suite.passed.append(name)
        elif ending == "SKIPPED":
            suite.skipped.append(name)
        elif ending in ("FAILED", "ERROR", None):
            suite.failed[name] = "see the log" if ending else _ENDED
    return suite


def alone(context: Context, failed: Mapping[str, str], ends: float) -> Iterator[tuple[str, bool]]:
    """Each failed test in a process of its own, as long as there is time; whether it passes there."""
    for name in failed:
        if (left := ends - time.monotonic()) <= 0:
            return
        found, _ = run(context, [*PYTEST, name], left)
        yield name, bool(found.passed) and not found.failed


def judged(context: Context, suite: Suite, commands: tuple[str, ...], *, whole: bool) -> Outcome:
    """The outcome of tests. Args: whole, whether all of them ran."""
    again = {name for name, passed in suite.alone.items() if passed}
    reasons = []
    if suite.failed:
        reasons.append(f"{len(suite.failed) - len(again)} fail")
    if again:
        reasons.append(f"{len(again)} fail only after an error of another test")
    if not whole:
        reasons.append("not all of them ran")
    ending: Ending = "failed" if reasons else "passed"
    if not suite.passed and not reasons:
        ending = "failed" if context.cuda else "skipped"
        reasons.append("no test passed" if context.cuda else NO_CARD)
    if suite.not_collected:
        needs = ", ".join(sorted(set(suite.not_collected.values())))
        reasons.append(f"{len(suite.not_collected)} files were not collected, without {needs}")
    lines = [
        f"- `{name}`{' (passes alone)' if name in again else ''}: {why}" for name, why in suite.failed.items()
    ]
    if len(lines) > _SHOWN:
        lines = [*lines[:_SHOWN], f"- and {len(lines) - _SHOWN} more"]
    return Outcome(ending, suite.count, "; ".join(reasons), commands, asdict(suite), "\n".join(lines))
