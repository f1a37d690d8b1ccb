"""What the terminal shows of a run, at the usual widths."""

import re
import time
from collections.abc import Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from panolog.orchestrator.runs.machines.history import why_leaving
from panolog.orchestrator.runs.records import (
    Leaving,
    NodeLeaving,
    NodeLeft,
    NodeStaying,
    Outcome,
    PauseRequested,
    Progressed,
    Record,
    RunContinued,
    RunEnded,
    RunWaiting,
    StopRequested,
    Stored,
    TaskFailed,
    TaskYielded,
)
from panolog.orchestrator.runs.state import RunState
from panolog.orchestrator.watch.views.summary import summarize, task_label
from panolog.orchestrator.watch.views.terminal import WIDE, page, progress
from panolog.workers.tasks import EVAL, Stage
from tests.orchestrator.history import started
from tests.orchestrator.watch.views.test_timing import (
    MEASURED,
    MERGED,
    ONE,
    SHARDED,
    STAGE_ONE,
    STAGE_TWO,
    TRAINED,
    ZERO,
    Timed,
    state,
)

FORMAT = Path(__file__).parents[4] / "orchestrator/watch/dashboard/static/shared/format.js"
LARGE: list[Timed] = [
    *STAGE_TWO,
    (20_000, Progressed(ZERO, 12_345, 30_000, 12.3, 0.0812, 27.31, 1_739_000, 6 * 2**30)),
    (20_000, Progressed(ONE, 2_345, 30_000, 2.1, 0.0812, 27.31, 2_000_000, 6 * 2**30)),
]


def shown(records: list[Timed], width: int, *, running: bool) -> str:
    """What a terminal shows a second after the last record."""
    began = time.time() - records[-1][0] - 1
    records = [(began + at, record) for at, record in records]
    output, root = StringIO(), Path("runs/my street")
    summary = summarize(state(records), running=running, root=root)
    content = page(summary, root=root, wide=width >= WIDE)
    Console(file=output, width=width).print(content, crop=False)
    return output.getvalue()


@pytest.mark.parametrize("width", [80, 160])
def test_a_run_fits_the_terminal_and_says_how_far_it_is(width: int) -> None:
    text = shown(LARGE, width, running=True)
    first, gaussians, *rows = text.splitlines()
    assert first.startswith("running · Stage II · ")
    assert "% · " in first
    assert " elapsed · about " in first
    assert gaussians.strip() == "3,739,000 Gaussians in training, 10 kept"
    assert [row.split("  ")[0] for row in rows] == [
        "task",
        "Stage I",
        "scoring",
        "partition",
        "block 0",
        "block 1",
    ]
    assert all(len(line.rstrip()) <= width for line in text.splitlines())
    assert "1,739,000" in rows[4]


def test_a_narrow_terminal_has_fewer_columns_and_no_broken_ones() -> None:
    text = shown(LARGE, 55, running=True)
    (task,) = [line for line in text.splitlines() if line.startswith("block 0")]
    assert task.split() == ["block", "0", "12,345/30,000", "12.3", "it/s", "7:53:45", "left"]
    assert all(len(line.rstrip()) <= 55 for line in text.splitlines())
    assert "…" not in text and "━" not in text and "loss" not in text


def test_the_dashboard_has_the_same_names_of_tasks() -> None:
    match = re.search(r"const TASKS = \{(.*?)\};", FORMAT.read_text(), re.DOTALL)
    assert match is not None
    names = dict(re.findall(r'(\w+): "([^"]+)"', match[1]))
    assert names == {stage.value: task_label(stage.value) for stage in Stage}


def test_shards_of_the_evaluation_are_one_row() -> None:
    text = shown([*TRAINED, *SHARDED, (206, MERGED), *MEASURED], 160, running=True)
    (row,) = [row for row in text.splitlines() if row.startswith("measurement")]
    assert row.rstrip().endswith("1/3 shards")


def test_a_preflight_says_what_it_does() -> None:
    assert shown(STAGE_ONE[:2], 80, running=True).startswith("running · preflight: starting Ray · 0% · ")


def test_a_run_that_waits_for_its_disk_says_so_and_what_to_do() -> None:
    reason = "disk full, waiting: free 2.0 GiB on the disk of /runs/a or stop the run"
    waiting: list[Timed] = [*LARGE, (20_001, RunWaiting(reason))]
    first, second, *_ = shown(waiting, 120, running=True).splitlines()
    assert first.startswith("waiting · Stage II · ")
    assert second.strip() == reason
    paused = "waiting: block 1 is paused"
    (first,) = (
        line
        for line in shown([*LARGE, (20_001, RunWaiting(paused))], 160, running=True).splitlines()
        if paused in line
    )
    assert first.startswith(f"{paused} · Stage II · ") and "left" not in first
    continued = shown([*waiting, (20_900, RunContinued(899.0))], 120, running=True)
    assert continued.startswith("running · Stage II · ")
    assert reason not in continued + shown(waiting, 120, running=False)


def test_a_run_that_does_not_proceed_is_in_the_stage_that_has_begun_last() -> None:
    def headline(*records: Record) -> str:
        later: list[Timed] = [*STAGE_TWO, *((151, record) for record in records)]
        return shown(later, 160, running=isinstance(records[-1], RunWaiting)).splitlines()[0]

    waiting = RunWaiting("waiting: 2 blocks are paused (0, 1)")
    yielded = TaskYielded(ZERO), TaskYielded(ONE)
    assert headline(*yielded, waiting).startswith(f"{waiting.reason} · Stage II · ")
    assert headline(*yielded, RunEnded(Outcome.INTERRUPTED)).startswith("stopped · Stage II · ")
    lost = TaskFailed(ZERO, 1, "lost", final=False)
    assert headline(lost, waiting).endswith(" · 1 retry")


def test_progress_is_never_rounded_up() -> None:
    summary = summarize(state(STAGE_TWO), running=True).model_copy(update={"progress": 0.996})
    output = StringIO()
    Console(file=output, width=160).print(page(summary, root="a", wide=True))
    assert " · 99% · " in output.getvalue()


LEAVES = NodeLeaving("3f2a81c4d5e6", "gpu-07", Leaving.PREEMPTION, 120.0)


@pytest.mark.parametrize("width", [80, 160])
def test_machines_that_leave_are_shown_with_the_time_left_until_they_have_left(
    width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now)
    recent: list[Timed] = [*LARGE, (now, LEAVES), (now + 1, TaskYielded(ONE, "gpu-07"))]
    text = " ".join(shown(recent, width, running=True).split())
    assert "gpu-07 (3f2a81c4): leaves in 1:58: its provider takes it away; tasks there" in text
    assert "1 moved from machines that left" in text
    later = shown([*recent, (now + 2, NodeLeft("3f2a81c4d5e6", "gpu-07"))], width, running=True)
    assert "gpu-07" not in later
    assert "gpu-07" not in shown(recent, width, running=False).splitlines()[1]


def lines(*changes: tuple[RunState, Sequence[Record]]) -> list[str]:
    """What is printed of changes of a run where there is no terminal."""
    with progress(Console(file=(output := StringIO()), width=80), Path("run")) as show:
        for state, records in changes:
            show(state, [Stored(number, 0.0, record) for number, record in enumerate(records, 1)])
    return output.getvalue().splitlines()


def test_plain_lines_say_what_leaves_and_what_moves() -> None:
    gone = NodeLeft("3f2a81c4d5e6", "gpu-07"), NodeStaying("7f2a81c4d5e6", "gpu-08")
    assert lines((RunState(), [LEAVES, TaskYielded(ONE, "gpu-07"), *gone])) == [
        f"gpu-07 (3f2a81c4) leaves in 2:00: {why_leaving(Leaving.PREEMPTION)}",
        "block 1: has stopped with a checkpoint, and moves: gpu-07 leaves",
        "gpu-07 (3f2a81c4): has left",
        "gpu-08 (7f2a81c4): stays after all, and is used again",
    ]


def test_lines_say_views_where_nothing_is_trained_and_no_stop_of_nothing() -> None:
    stops = [StopRequested(tasks) for tasks in (0, 1, 3)]
    assert lines((RunState(), [*stops, Progressed(EVAL, 7, 216, 9.0)])) == [
        "stopping: a task saves a checkpoint first; repeat to stop at once",
        "stopping: 3 tasks save a checkpoint first; repeat to stop at once",
        "evaluation: 7/216 views, 9.0 it/s, 0:23 left",
    ]
    measured: list[Timed] = [*LARGE, (20_001, started(EVAL)), (20_002, Progressed(EVAL, 216, 216, 9.0))]
    assert "216/216 views" in shown(measured, 120, running=True)


def test_plain_lines_say_it_also_where_no_record_can_be_stored() -> None:
    states = (replace(RunState(), waiting=text) for text in ("", "disk full", "disk full", ""))
    assert lines(*((state, ()) for state in states)) == ["disk full", "the run continues"]


def test_commands_have_the_path_of_the_run() -> None:
    killed = shown(LARGE, 80, running=False)
    assert killed.startswith("driver lost · Stage II · ")
    assert "`panolog resume 'runs/my street'` resumes it" in killed
    paused = shown([*LARGE, (20_001, PauseRequested(ONE)), (20_002, TaskYielded(ONE))], 160, running=True)
    assert "1 paused: `panolog unpause 'runs/my street' 1` resumes block 1" in paused
