"""What `panolog clean` removes of runs as drivers leave them, and what it never touches."""

import json
import os
import shutil
import time
from contextlib import closing
from pathlib import Path

import pytest

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.database import Database, read_milestones, read_records
from panolog.orchestrator.runs.folder import RunFolder, model_of, removed_models
from panolog.orchestrator.runs.info import SceneRef, make_info, write_info
from panolog.orchestrator.runs.records import (
    BlockPlan,
    CheckpointSaved,
    Merged,
    Outcome,
    PlanSaved,
    Record,
    RunEnded,
    ScoresSaved,
)
from panolog.orchestrator.runs.state import replay
from panolog.scene.errors import RunFolderError
from panolog.workers.tasks import COARSE, TaskId
from tests.orchestrator.cli.program import call
from tests.orchestrator.history import BEGAN, model, started

BLOCKS = [TaskId.block(0), TaskId.block(1)]


def put(path: Path, size: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"x" * size)
    return path


def written(root: Path, *more: Record, keep: int = 1) -> RunFolder:
    """A run in the middle of block 1, with all that a run may have on its disk, and then those records."""
    folder = RunFolder(root)
    root.mkdir(parents=True)
    config = RunConfig.model_validate({"width": 64, "retention": {"checkpoints": keep}})
    write_info(folder, make_info(SceneRef(path="/scenes/town", fingerprint="f"), config))
    records: list[Record] = [BEGAN, model(COARSE), ScoresSaved(TaskId.shard(0), "", 4)]
    plan = tuple(BlockPlan(block, 4, 9, train=block < 2) for block in range(3))
    records += [PlanSaved("partition/plan.json", plan), model(BLOCKS[0])]
    records += [started(BLOCKS[1]), CheckpointSaved(BLOCKS[1], 300, "", 10)]
    with closing(Database(folder.database)) as database:
        database.append([*records, *more])
    put(folder.model(COARSE), 1_000)
    for block in BLOCKS:
        put(folder.model(block), 200)
        put(folder.initial(block), 40)
        put(folder.checkpoint(block), 30)
        for iteration in (100, 200):
            put(folder.earlier_checkpoint(block, iteration), 30)
    put(folder.kept(2), 70)
    put(folder.shard(TaskId.shard(0)), 5)
    killed = put(root / "blocks" / "001" / ".model.ply.ab12.part", 11)
    within = put(root / ".web.cd34.part" / "a" / "b", 12)
    for path in (killed, within, within.parent, within.parent.parent):
        os.utime(path, (0, 0))
    put(folder.point_cloud, 500)
    return folder


DONE = (model(BLOCKS[1]), Merged("point_cloud.ply", 9, 1, 500, 1.0), RunEnded(Outcome.DONE))


def files(root: Path) -> dict[str, int]:
    return {str(it.relative_to(root)): it.stat().st_size for it in root.rglob("*") if it.is_file()}


def clean(*words: object) -> tuple[int, str, str]:
    result = call("clean", *words)
    return result.exit_code, result.stdout, result.stderr.strip()


def test_a_dry_run_says_bytes_by_run_and_kind_and_changes_nothing(tmp_path: Path) -> None:
    done = written(tmp_path / "runs" / "done", *DONE)
    killed = written(tmp_path / "runs" / "killed")
    before = files(tmp_path)
    code, stdout, _ = clean(tmp_path / "runs", "--blocks", "--dry-run", "--json")
    assert code == 0
    found = json.loads(stdout)
    assert (found["dry_run"], found["bytes"]) == (True, 758 + 213)
    kinds = {"leftovers": 23, "checkpoints": 260, "shards": 5, "models": 470}
    of_done = {"run": str(done.root), "bytes": 758, "files": 14, "kinds": kinds, "skipped": None}
    kinds = {"leftovers": 23, "checkpoints": 190}
    of_killed = {"run": str(killed.root), "bytes": 213, "files": 8, "kinds": kinds, "skipped": None}
    assert found["runs"] == [of_done, of_killed]
    assert files(tmp_path) == before


def test_a_run_that_is_not_done_keeps_its_last_checkpoints_and_all_models(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    assert clean(folder.root, "--blocks")[0] == 0
    left = files(folder.root)
    assert folder.checkpoint(BLOCKS[1]).exists()
    assert folder.initial(BLOCKS[1]).exists()
    assert not folder.earlier_checkpoints(BLOCKS[1])
    assert not folder.checkpoint(BLOCKS[0]).exists()
    assert not folder.initial(BLOCKS[0]).exists()
    assert folder.shard(TaskId.shard(0)).exists()
    assert all(folder.model(task).exists() for task in (COARSE, *BLOCKS))
    assert folder.kept(2).exists()
    assert not [name for name in left if ".part" in name]
    assert clean(folder.root, "--blocks")[1].splitlines()[0] == f"{folder.root}: nothing to remove"


@pytest.mark.parametrize(
    ("keep", "words", "last", "left"),
    [
        (2, [], True, [200]),
        (1, ["--keep-checkpoints", 3], True, [100, 200]),
        (1, [], False, [200]),  # the only one stays whatever its name
    ],
)
def test_as_many_checkpoints_stay_as_are_wanted(
    tmp_path: Path, keep: int, words: list[object], last: bool, left: list[int]
) -> None:
    folder = written(tmp_path / "run", keep=keep)
    if not last:
        folder.checkpoint(BLOCKS[1]).unlink()
    assert clean(folder.root, *words)[0] == 0
    assert folder.earlier_checkpoints(BLOCKS[1]) == [folder.earlier_checkpoint(BLOCKS[1], it) for it in left]
    assert folder.checkpoint(BLOCKS[1]).exists() == last


def test_models_of_parts_go_when_the_run_is_done_and_readers_say_why(tmp_path: Path) -> None:
    folder = written(tmp_path / "run", *DONE)
    assert clean(folder.root)[0] == 0
    assert folder.model(BLOCKS[0]).exists()
    assert clean(folder.root, "--blocks")[0] == 0
    assert not any(path.exists() for path in (*map(folder.model, BLOCKS), folder.kept(2)))
    assert folder.model(COARSE).exists()
    assert model_of(folder) == folder.point_cloud
    assert removed_models(folder) == {"block/000", "block/001", "block/002"}
    with pytest.raises(
        RunFolderError, match="the model of block/001 was removed after the merge; the merged"
    ):
        model_of(folder, BLOCKS[1])
    state = replay(read_milestones(folder.database))
    assert state.outcome == Outcome.DONE
    said = "the models of the parts were removed, 0.5 KiB: the merged model has their Gaussians"
    assert [record.message for record in state.notices] == [said]
    before = len(read_records(folder.database))
    assert clean(folder.root, "--blocks")[0] == 0
    assert len(read_records(folder.database)) == before  # nothing was left to say


@pytest.mark.parametrize("outcome", [Outcome.FAILED, Outcome.INTERRUPTED])
def test_a_run_with_a_failed_block_keeps_the_models_that_a_resume_merges(
    tmp_path: Path, outcome: Outcome
) -> None:
    folder = written(tmp_path / "run", *DONE[:-1], RunEnded(outcome, "block 2 failed"))
    assert clean(folder.root, "--blocks")[0] == 0
    assert folder.model(BLOCKS[0]).exists() and folder.kept(2).exists()


def test_a_live_run_is_left_as_it_is(tmp_path: Path) -> None:
    folder = written(tmp_path / "run", *DONE)
    with lock.hold(folder.lock):
        before = files(folder.root)
        code, stdout, _ = clean(folder.root, "--blocks")
        assert files(folder.root) == before
    assert (code, stdout.splitlines()[0]) == (0, f"{folder.root}: left as it is: a driver is at work on it")


def test_only_what_is_old_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = written(tmp_path / "run")
    before = files(folder.root)
    first, *_ = clean(folder.root, "--older-than", "1h")[1].splitlines()
    assert first.endswith("its last record is 0.0 days old")
    assert files(folder.root) == before
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + 3_700)
    assert clean(folder.root, "--older-than", "1h")[0] == 0
    assert files(folder.root) != before
    refused = "panolog: --older-than 30: write a duration such as 90m, 12h"
    assert clean(folder.root, "--older-than", "30")[2].startswith(refused)


def test_nothing_outside_of_the_run_is_removed_through_links(tmp_path: Path) -> None:
    folder = written(tmp_path / "run", *DONE)
    outside = put(tmp_path / "precious" / "model.ply", 9)
    folder.checkpoint(BLOCKS[1]).unlink()
    folder.checkpoint(BLOCKS[1]).symlink_to(outside)
    shutil.rmtree(folder.of(BLOCKS[0]))
    folder.of(BLOCKS[0]).symlink_to(outside.parent)
    (folder.root / ".link.ab.part").symlink_to(outside.parent)
    assert clean(folder.root, "--blocks")[0] == 0
    assert outside.exists()
    assert folder.checkpoint(BLOCKS[1]).is_symlink()


def test_what_is_being_written_is_no_leftover(tmp_path: Path) -> None:
    folder = written(tmp_path / "run", *DONE)
    exported = put(folder.root / ".model.spz.ef56.part", 9)  # by a command that needs no driver
    within = put(folder.root / ".site.ef57.part" / "index.html", 9)
    os.utime(within.parent, (0, 0))
    assert clean(folder.root)[0] == 0
    assert exported.exists() and within.exists()


def test_what_is_no_run_or_is_damaged_is_one_clear_line(tmp_path: Path) -> None:
    assert clean(tmp_path)[::2] == (2, f"panolog: {tmp_path}: is no run, and there is none below it")
    good = written(tmp_path / "good")
    put(tmp_path / "bad" / "run.json", 3)
    code, stdout, _ = clean(tmp_path)
    assert code == 2
    assert "is not JSON" in stdout.splitlines()[0]
    assert not good.earlier_checkpoints(BLOCKS[1])  # the others are cleaned nonetheless


def test_a_hostile_note_of_removed_models_is_none(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    for content in ("[", "[]", '{"removed_models": 3}', '{"removed_models": [{}, 7]}', "[" * 100_000):
        folder.retention.write_text(content)
        assert removed_models(folder) == frozenset()
    folder.retention.unlink()
    os.mkfifo(folder.retention)
    assert removed_models(folder) == frozenset()
