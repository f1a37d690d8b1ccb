"""Run folders as drivers leave them: finished, live, preparing and others, with all that pages show."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from panolog.orchestrator.engine.stages.outline import write_sketch
from panolog.orchestrator.engine.stages.partitioning import plan_records, write_plan
from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.info import PENDING, RunInfo, SceneRef, read_info, write_info
from panolog.orchestrator.runs.machines.gpus import GpuUsage
from panolog.orchestrator.runs.machines.usage import Usage
from panolog.orchestrator.runs.preparation.notes import (
    Counts,
    StepProgress,
    StepResult,
    write_note,
)
from panolog.orchestrator.runs.preparation.settings import Settings, Step, write_settings
from panolog.orchestrator.runs.records import (
    CheckpointSaved,
    Delivered,
    EvaluationSaved,
    Failure,
    Merged,
    ModelSaved,
    Noticed,
    Outcome,
    Part,
    PauseRequested,
    PlanSaved,
    PreflightSaved,
    Preparing,
    PreviewSaved,
    Progressed,
    Record,
    RunBegan,
    RunEnded,
    RunWaiting,
    ScoresSaved,
    StopRequested,
    TaskFailed,
    TaskStarted,
    TaskYielded,
    ViewEvaluated,
)
from panolog.orchestrator.watch.views.pages.report import write_report
from panolog.workers.tasks import COARSE, EVAL, PREPARE, TaskId
from tests.visual import town
from tests.visual.fixed import HOST, Clock

NAMES = {
    "finished": "harbour",
    "live": "old-town",
    "failed": "market-square",
    "killed": "riverside",
    "stopped": "quarry-test",
    "preparing": "arcade",
    "waiting": "bridge",
}
LENGTH = 30_000  # iterations of a task
_CAMERAS = 64
_STEPS = 15  # progress records of a quarter of a training
_VERSIONS = {
    "python": "3.11.9",
    "panolog": "1.0.0",
    "torch": "2.8.0",
    "ray": "2.60.0",
    "numpy": "2.2.6",
    "pycolmap": "4.1.0",
}
_RATES = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}


@dataclass
class Written:
    """A run folder while its driver writes it."""

    folder: RunFolder
    clock: Clock
    database: Database
    until: float  # seconds since the epoch: the present

    def add(self, *records: Record, after: float = 1.0) -> None:
        """Appends records, that many seconds after the last ones."""
        self.clock.now += after
        self.database.append(records)


@contextmanager
def _written(root: Path, clock: Clock, began: float, blocks: str) -> Iterator[Written]:
    """A new run of the town that began that many seconds ago. The clock ends where it was."""
    now, folder = clock.now, RunFolder(root)
    clock.now = now - began
    root.mkdir(parents=True)
    config = RunConfig(width=2048, blocks=blocks, seed=7, device="cuda")
    place = root.parent.with_name("scenes") / root.name
    scene = SceneRef(path=str(place), fingerprint="9f2c41d07be35a68")
    created = np.datetime64(round(clock.now), "s")
    write_info(folder, RunInfo(scene=scene, config=config, seed=7, versions=_VERSIONS, created=f"{created}Z"))
    stages: dict[str, float | None] = {"coarse": 900, "score": 60, "block": 3000, "merge": 20, "eval": 90}
    write_json(
        folder.preflight, {"estimate": {"stages": [{"name": n, "seconds": s} for n, s in stages.items()]}}
    )
    with closing(Database(folder.database)) as database:
        run = Written(folder, clock, database, now)
        run.add(RunBegan(HOST, 4711, resumed=False))
        needs = "8.4 GiB of memory for the largest task, 3.1 GiB of disk"
        needs += "; Gaussians, roughly: Stage I 1,120,000, largest block 410,000"
        if blocks == "auto":  # it has no scene yet
            yield run
            clock.now = now
            return
        run.add(Noticed(Part.PREFLIGHT, f"1 h 7 min with blocks {config.grid}, {needs}"))
        run.add(PreflightSaved("preflight.json", stages), after=0.0)
        yield run
    clock.now = now


def _started(task: TaskId, *, attempt: int = 1, iteration: int = 0) -> TaskStarted:
    """A task on one of two machines."""
    node = "borea" if (task.index or 0) % 2 else HOST
    return TaskStarted(
        task, attempt, iteration, node, 900 + (task.index or 0), "cuda:0", 8, "NVIDIA RTX A5000", 6.0
    )


def _progressed(task: TaskId, share: float, gaussians: int) -> Progressed:
    """How far a task is, with curves as training has them."""
    phase = 0.7 * (task.index or 0) + 55 * share
    wiggle = math.sin(phase) + 0.6 * math.sin(2.7 * phase)
    grown = gaussians * (0.35 + 0.65 * min(1.0, 2 * share))
    return Progressed(
        task,
        iteration=round(share * LENGTH),
        iterations=LENGTH,
        rate=34 - 12 * min(1.0, 2 * share) + 0.8 * wiggle,
        loss=0.055 + 0.19 * math.exp(-5 * share) + 0.004 * wiggle,
        psnr=25.5 + 0.4 * ((task.index or 0) % 3) - 11 * math.exp(-5 * share) + 0.25 * wiggle,
        gaussians=round(grown),
        memory=round(1.6e9 + 4100 * grown),
        host_peak=round(3.1e9 + 400 * grown),
        rates={name: rate * (0.01**share if name == "means" else 1) for name, rate in _RATES.items()},
    )


def _train(
    run: Written, tasks: Mapping[TaskId, tuple[float, float]], *, seconds: float, gaussians: int
) -> None:
    """Tasks train side by side in so many seconds, each from one share of its iterations to another."""
    for quarter in range(1, 5):
        steps = [(quarter - 1 + step / _STEPS) / 4 for step in range(1, _STEPS + 1)]
        shares = {task: begin + (end - begin) * steps[-1] for task, (begin, end) in tasks.items()}
        run.add(
            *(
                _progressed(task, begin + (end - begin) * step, gaussians)
                for step in steps
                for task, (begin, end) in tasks.items()
            ),
            after=seconds / 4,
        )
        for task, share in shares.items():
            number, checkpoint = round(share * LENGTH), run.folder.relative(run.folder.checkpoint(task))
            path = run.folder.of(task) / "previews" / f"{number:06d}.jpg"
            town.write_picture(path, 2 * (task.index or 0) + quarter, share)
            name = f"street_{3 * (task.index or 0):03d}.jpg"
            run.add(
                PreviewSaved(task, number, name, run.folder.relative(path), held_out=task == COARSE),
                CheckpointSaved(task, number, checkpoint, 240 * gaussians),
                after=0,
            )


def _finish(run: Written, tasks: Sequence[TaskId], gaussians: int, seconds: float) -> None:
    for task in tasks:
        path = run.folder.relative(run.folder.model(task))
        run.add(ModelSaved(task, path, gaussians, 248 * gaussians, LENGTH, seconds), after=2)


def _stage_one(run: Written) -> None:
    run.add(_started(COARSE), after=12)
    run.add(Noticed(COARSE, "street_017.jpg: 38 % of its pixels are overexposed; they take part as they are"))
    _train(run, {COARSE: (0.0, 1.0)}, seconds=880, gaussians=1_120_000)
    town.write_model(run.folder.model(COARSE))
    _finish(run, [COARSE], 1_120_000, 884.0)


def _partition(run: Written) -> list[TaskId]:
    """Scores and plan. Returns the blocks that train."""
    for shard in map(TaskId.shard, range(2)):
        run.add(_started(shard))
        path = run.folder.relative(run.folder.shard(shard))
        run.add(Progressed(shard, 32, 32, 1.4), ScoresSaved(shard, path, 32), after=24)
    plan, scores = town.plan(json.loads(run.folder.info.read_bytes())["config"]["blocks"], _CAMERAS)
    write_plan(run.folder, plan, scores)
    *notices, saved = plan_records(run.folder, plan, scores)
    assert isinstance(saved, PlanSaved)
    run.add(*notices, saved, after=3)
    return [TaskId.block(block.block) for block in saved.blocks if block.train]


def _merge_and_evaluate(run: Written) -> None:
    run.folder.point_cloud.write_bytes(b"ply\n")
    run.add(Merged(run.folder.relative(run.folder.point_cloud), 1_384_211, 24_000, 343_284_000, 8.0), after=9)
    run.add(_started(EVAL), after=6)
    views = dict[str, dict[str, float | None]]()
    for number in range(8):
        name, worse = f"held_out_{number:03d}.jpg", 0.45 * number
        views[name] = {
            "psnr": 27.4 - worse,
            "ssim": 0.871 - 0.02 * worse,
            "lpips": None,
            "ws_psnr": 26.2 - worse,
            "ws_ssim": 0.858 - 0.02 * worse,
        }
        town.write_picture(run.folder.images / name, number + 3, 0.95 - 0.05 * number)
        run.add(ViewEvaluated(EVAL, name, views[name]), after=8)
    means = {
        key: None if key == "lpips" else sum(float(v[key] or 0) for v in views.values()) / len(views)
        for key in views["held_out_000.jpg"]
    }
    reason = "LPIPS is not measured: the package lpips is not installed"
    write_json(run.folder.metrics, {"mean": means, "lpips_reason": reason, "views": views})
    run.add(EvaluationSaved("eval/metrics.json", means))
    run.add(Delivered("web", 41_000_000, 9.0))


def finished(root: Path, clock: Clock) -> RunFolder:
    """Done an hour ago, with two blocks."""
    with _written(root, clock, 3 * 3600, "2x1x1") as run:
        _stage_one(run)
        blocks = _partition(run)
        run.add(*map(_started, blocks), after=4)
        _train(run, dict.fromkeys(blocks, (0.0, 1.0)), seconds=2400, gaussians=640_000)
        _finish(run, blocks, 690_000, 2380.0)
        _merge_and_evaluate(run)
        run.add(RunEnded(Outcome.DONE))
        write_report(run.folder)
        _write_scene(run.folder)
    return run.folder


def _write_scene(folder: RunFolder) -> None:
    """As much of the scene as it takes to show a camera."""
    town.write_scene(Path(json.loads(folder.info.read_bytes())["scene"]["path"]), "street_010.jpg")


def live(root: Path, clock: Clock) -> RunFolder:
    """In Stage II: blocks that are done, training, paused, tried again, failed, waiting and not trained."""
    with _written(root, clock, 3_320, "5x2x1") as run:
        _stage_one(run)
        blocks = _partition(run)
        early, late = blocks[:3], blocks[3:5]
        run.add(*map(_started, early), after=4)
        run.add(Noticed(early[0], "the depth map of street_009.jpg does not fit the points; it is left out"))
        _train(
            run,
            {early[0]: (0.0, 1.0), early[1]: (0.0, 0.72), early[2]: (0.0, 0.35)},
            seconds=1300,
            gaussians=380_000,
        )
        _finish(run, early[:1], 402_000, 1290.0)
        run.add(PauseRequested(early[2]), TaskYielded(early[2]), after=3)
        run.add(_started(late[0]), after=5)
        lost = "the worker on borea was lost: its process was killed by signal 9"
        run.add(TaskFailed(late[0], 1, lost, final=False, kind=Failure.LOST, memory=24 * 2**30), after=30)
        run.add(_started(late[0], attempt=2), _started(late[1]), after=6)
        damaged = "street_031.jpg cannot be decoded: the file ends after 1,203,200 of 3,145,728 bytes"
        run.add(_progressed(late[1], 0.3, 380_000), after=9)
        run.add(TaskFailed(late[1], 3, damaged, final=True, kind=Failure.ERROR, memory=24 * 2**30), after=9)
        shares = {early[1]: (0.72, 0.91), late[0]: (0.0, 0.31)}
        _train(run, shares, seconds=run.until - clock.now - 20, gaussians=380_000)
        run.folder.control.mkdir()
        for node, busy in ((HOST, 0.93), ("borea", 0.71)):
            gpu = GpuUsage("NVIDIA RTX A5000", busy, round(9.4 * busy * 2**30), 24 * 2**30)
            memory, disk = round(41 * busy) * 2**30, 1_900 * 10**9
            usage = Usage(node, busy / 2, memory, 128 * 2**30, round(busy * disk), disk, (gpu,))
            run.database.put_usage(node, asdict(usage))
    return run.folder


def waiting(root: Path, clock: Clock) -> RunFolder:
    """One of two blocks is done, and the other is paused."""
    with _written(root, clock, 2_700, "2x1x1") as run:
        _stage_one(run)
        done, paused = _partition(run)
        run.add(_started(done), _started(paused), after=4)
        _train(run, {done: (0.0, 1.0), paused: (0.0, 0.6)}, seconds=1_200, gaussians=380_000)
        run.add(PauseRequested(paused), TaskYielded(paused), after=3)
        _finish(run, [done], 402_000, 1_210.0)
        run.add(RunWaiting(f"waiting: block {paused.number} is paused"))
        run.folder.control.mkdir()
    return run.folder


def preparing(root: Path, clock: Clock) -> RunFolder:
    """A run of a video that has masks and poses, and estimates depth."""
    with _written(root, clock, 1_540, "auto") as run:
        folder = run.folder
        info = read_info(folder)
        scene = SceneRef(path=str(folder.scene), fingerprint=PENDING)
        write_info(folder, info.model_copy(update={"scene": scene}))
        settings = Settings(
            source="/data/footage/arcade.mp4",
            video=True,
            panoramas=4_310,
            width=5_760,
            nadir=10,
            static=True,
            depth_model="/data/models/dap.onnx",
        )
        write_settings(folder, settings)
        folder.control.mkdir()
        run.add(Preparing("finding poses and points", PREPARE), after=2)
        lines = (
            "139 of 142 panoramas have a pose, 61,204 points, seen by 5.2 panoramas, 0.61 pixels off",
            "contradiction: arcade_000412.jpg and arcade_003985.jpg share 61 features, but 3 became common"
            " points: one of them stands elsewhere than their matches say, as happens where windows repeat",
        )
        counts = Counts(panoramas=142, registered=139, points=61_204, weak_links=0, contradictions=1)
        found = StepResult(step=Step.SFM, settings={}, seconds=1_410, lines=lines, counts=counts)
        write_note(folder.step_result(Step.SFM), found)
        masked = ("2.3% of the sphere: 10° around straight down, what is the same in all panoramas",)
        masks = StepResult(step=Step.MASKS, settings={}, seconds=312, lines=masked)
        write_note(folder.step_result(Step.MASKS), masks)
        places, names = town.cameras(_CAMERAS), [f"arcade_{30 * row:06d}.jpg" for row in range(_CAMERAS)]
        drift = np.random.default_rng(4).normal(0, [1.5, 1.5, 3], places.shape)
        write_sketch(folder, names, places, town.points(), places + drift)
        town.write_path(folder.sfm_picture)
        town.write_picture(folder.masks_picture, 3, 0.9)
        run.add(Preparing("estimating depth", PREPARE), after=1_412)
        write_note(
            folder.preparation_progress,
            StepProgress(step=Step.DEPTH, what="depth", done=58, total=139, time=run.until - 1),
        )
    return folder


@contextmanager
def all_runs(root: Path, clock: Clock) -> Iterator[dict[str, RunFolder]]:
    """Four runs and smaller ones that have ended, while drivers hold the locks of the live ones."""
    makers = {"finished": finished, "live": live, "preparing": preparing, "waiting": waiting}
    folders = {state: maker(root / NAMES[state], clock) for state, maker in makers.items()}
    why = "Stage I failed: street_031.jpg cannot be decoded; `panolog resume` tries again"
    ended: dict[str, tuple[Record, ...]] = {
        "failed": (RunEnded(Outcome.FAILED, why),),
        "killed": (),  # no record says so, and nothing holds the lock
        "stopped": (StopRequested(1), RunEnded(Outcome.INTERRUPTED)),
    }
    for days, (state, last) in enumerate(ended.items(), 2):
        with _written(root / NAMES[state], clock, days * 86_400, "2x1x1") as run:
            run.folder.make(run.folder.outline.parent)
            write_json(run.folder.outline, town.plan("1x1x1", _CAMERAS)[0].to_json())
            town.write_model(run.folder.outline_points)
            run.add(_started(COARSE), after=12)
            _train(run, {COARSE: (0.0, 0.42)}, seconds=400, gaussians=900_000)
            run.add(*last, after=9)
        folders[state] = run.folder
    (root / "damaged").mkdir()
    (root / "damaged" / "run.json").write_text("{")
    with ExitStack() as drivers:
        for state in ("live", "preparing", "waiting"):
            drivers.enter_context(lock.hold(folders[state].lock))
        yield folders
