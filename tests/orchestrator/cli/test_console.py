"""Progress on stderr, and the usage of every command."""

import logging
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from io import StringIO
from pathlib import Path
from threading import Event
from typing import TextIO, cast

import pytest
from rich.console import Console
from typer.core import TyperGroup
from typer.main import get_command

from panolog.orchestrator.cli import app, console
from panolog.orchestrator.cli.console import Lasting
from panolog.orchestrator.runs import log
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.records import Outcome, Record, RunBegan, RunEnded, TaskFailed, TaskStarted
from panolog.orchestrator.runs.state import replay
from panolog.orchestrator.watch.views.summary import summarize
from panolog.orchestrator.watch.views.terminal import page, progress
from panolog.workers.tasks import COARSE
from tests.orchestrator.cli.program import call

COMMANDS = Path(__file__).parents[3] / "docs" / "commands.md"


@pytest.fixture
def lines(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[list[str], Event]]:
    """What is printed, with an event that is set once there is a line."""
    said, spoken = list[str](), Event()

    def say(line: str) -> None:
        said.append(line)
        spoken.set()

    monkeypatch.setattr(console, "say", say)
    yield said, spoken


def test_long_work_without_a_terminal_prints_lines(
    lines: tuple[list[str], Event], monkeypatch: pytest.MonkeyPatch
) -> None:
    said, spoken = lines
    monkeypatch.setattr(console, "_FIRST", 0.01)
    with console.progress_bar("reading the scene") as show:
        assert spoken.wait(120)  # no call of `show` is needed
        show("masks", 1, 1_200)
        monkeypatch.setattr(console, "_FIRST", -1.0)  # a step that ends later than that says so
        show("masks", 1_200, 1_200)
    assert said[-1] == "masks: 1,200 of 1,200"
    assert re.fullmatch(r"reading the scene: \d+ s", said[0])


def test_quick_work_prints_nothing(lines: tuple[list[str], Event]) -> None:
    with console.progress_bar("reading the scene") as show:
        for done in range(4):
            show("masks", done, 3)
    assert lines[0] == []


def test_a_terminal_shows_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Console(file=(output := StringIO()), force_terminal=True, width=80)
    monkeypatch.setattr(console, "err", lambda: terminal)
    with console.progress_bar("reading the scene") as show:
        show("masks", 3, 1_200)
    assert "reading the scene" in output.getvalue() and "3 of 1,200" in output.getvalue()


def commands() -> Iterator[list[str]]:
    """The words of every command and group."""
    program = get_command(app.app)
    assert isinstance(program, TyperGroup)
    yield []
    for name, command in program.commands.items():
        inner = command.commands if isinstance(command, TyperGroup) else {}
        yield from ([name], *([name, sub] for sub in inner))


def test_usage_shows_no_type_of_a_flag_and_no_braces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for words in commands():
        usage = call(*words, "--help")
        assert usage.exit_code == 0
        assert not re.search(r"<bool>|<int>|\{|\[\[", usage.stdout), words
    for command, arguments in (("dashboard", "[FOLDER]"), ("pause", "RUN BLOCK")):
        usage = call(command, "--help")
        assert f"Usage: root {command} [OPTIONS] {arguments}\n" in re.sub(r" +\n", "\n", usage.stdout)


def test_the_table_of_commands_names_each_command_and_no_option_that_is_none() -> None:
    program, table = get_command(app.app), COMMANDS.read_text().split("\nSCENE and RUN")[0]
    assert isinstance(program, TyperGroup)
    groups = {name: it.commands for name, it in program.commands.items() if isinstance(it, TyperGroup)}
    named: set[tuple[str, ...]] = set()
    for text in re.findall(r"^\| `panolog ([^`]+)`", table, re.MULTILINE):
        words = str(text).split()
        group = words[:1] if words[0] in groups else []
        named |= {(*group, name) for name in words[len(group)].split(r"\|")}
    assert named == {tuple(words) for words in commands() if words[1:] or not {*words} <= {*groups}}
    every = [*program.commands.values(), *(sub for inner in groups.values() for sub in inner.values())]
    assert set(re.findall(r"--[a-z][\w-]*", table)) <= {
        name for it in every for param in it.params for name in param.opts
    }


@pytest.mark.parametrize("terminal", [True, False])
def test_the_reason_of_a_failed_run_is_printed_once(terminal: bool, tmp_path: Path) -> None:
    """The command prints it as its last line, so the display does not; `status` has it once."""
    records: list[Record] = [
        RunBegan("host", 1, resumed=False),
        TaskStarted(COARSE, 1, 0, "node", 2, "cpu", 2),
        TaskFailed(COARSE, 1, "no memory", final=True),
        RunEnded(Outcome.FAILED, "coarse failed: no memory"),
    ]
    with closing(Database(tmp_path / "run.db")) as database:
        stored = database.append(records)
    (tmp_path / "run.json").write_text("{}")
    shown, status = StringIO(), StringIO()
    with progress(Console(file=shown, force_terminal=terminal, width=120), tmp_path) as show:
        show(replay(stored), stored)
    found = page(summarize(replay(stored), running=False), root=tmp_path, wide=True)
    Console(file=status, width=120).print(found)
    assert [output.getvalue().count("no memory") for output in (shown, status)] == [0, 1]


def full() -> TextIO:
    """A stream on a full disk."""
    return Path("/dev/full").open("w", buffering=1)


def broken() -> TextIO:
    """A pipe whose reader has ended."""
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w", buffering=1)


def closed() -> TextIO:
    """A terminal whose program has ended."""
    master, terminal = pty.openpty()
    os.close(master)
    return os.fdopen(terminal, "w", buffering=1)


@pytest.mark.parametrize("dead", [full, broken, closed])
def test_a_run_outlasts_the_reader_of_its_messages(
    dead: Callable[[], TextIO], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = dead()
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(OSError):
        stream.write("a line\n")
    shown = Console(file=cast(TextIO, Lasting(stream)), force_terminal=dead is closed)
    with progress(shown, tmp_path) as show, closing(Database(tmp_path / "run.db")) as database:
        for record in (
            RunBegan("here", 1, False),
            TaskStarted(COARSE, 1, 0, "here", 1, "cpu", 1),
            RunEnded(Outcome.DONE),
        ):
            stored = database.append([record])
            show(replay(stored), stored)
    monkeypatch.setattr(sys, "stderr", stream)
    log._Stderr().emit(logging.makeLogRecord({"msg": "a line"}))
    with suppress(OSError):
        stream.close()


@pytest.mark.parametrize("dead", [full, broken, closed])
def test_the_exit_code_is_right_without_a_reader_of_messages(
    dead: Callable[[], TextIO], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "panolog.orchestrator.cli", "status", str(tmp_path / "none")]
    stream = dead()
    assert subprocess.run(command, stderr=stream, timeout=300, check=False).returncode == 2
    with suppress(OSError):
        stream.close()
