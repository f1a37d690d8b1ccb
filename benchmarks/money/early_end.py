"""What a run should make of blocks that a limit ends: their last checkpoints, or what Stage I has of them?

    python -m benchmarks.money.early_end [--iterations 400] [--recipe panolog]

Trains a small town in two blocks and keeps their checkpoints. Of those after some parts of Stage II it merges
a model each, and measures it on the held-out panoramas as it measures that of Stage I.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from panolog.orchestrator.commands import session
from panolog.orchestrator.commands.demo import demo_of, make_place
from panolog.orchestrator.commands.evaluate import evaluate_run
from panolog.orchestrator.driver.local_pool import local_pool
from panolog.orchestrator.run.config import RunConfig, load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.orchestrator.run.records import CheckpointSaved, Stored
from panolog.orchestrator.run.state import RunState, ignore
from panolog.orchestrator.stages.merging import write_saved
from panolog.orchestrator.stages.scenes import scene_of
from panolog.partition.plan import read_plan
from panolog.workers.merge import merge
from panolog.workers.tasks import COARSE, Stage, TaskId

_PARTS = (0.05, 0.1, 0.25, 0.5, 0.75, 0.95)


def main() -> None:
    """Prints a row for each part."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--iterations", type=int, default=400, help="of Stage I and of each block")
    parser.add_argument("--recipe", default="panolog", help="panolog or paper")
    parser.add_argument("--width", type=int, default=256, help="of the panoramas, pixels")
    given = parser.parse_args()
    flags = {"iterations": given.iterations, "width": given.width, "recipe": given.recipe, "device": "cpu"}
    flags |= {"deliver": False, "passes.repair": 0.0, "checkpoint.every": max(1, given.iterations // 20)}
    with TemporaryDirectory(prefix="panolog-early-") as place:
        folder, kept = RunFolder(Path(place) / "run"), Path(place) / "kept"
        scene = make_place(folder.root, demo_of(), ignore)
        _train(scene, folder, kept, load_config(flags=flags))
        print(f"{given.recipe}, {given.iterations} iterations, width {given.width}: held-out WS-PSNR")
        print(f"{'Stage I':>10} {_quality(folder, folder.model(COARSE)):6.2f} dB")
        for part in _PARTS:
            model = _merged(folder, kept, round(part * given.iterations))
            print(f"{part:>10.0%} {_quality(folder, model):6.2f} dB", flush=True)
        print(f"{'Stage II':>10} {_quality(folder, folder.point_cloud):6.2f} dB")


def _train(scene: Path, folder: RunFolder, kept: Path, config: RunConfig) -> None:
    """Makes a run of which all checkpoints of blocks are kept."""

    def keep(_: RunState, news: Sequence[Stored]) -> None:
        for stored in news:
            record = stored.record
            if isinstance(record, CheckpointSaved) and record.task.stage is Stage.BLOCK:
                target = kept / str(record.iteration) / f"{record.task.number}"
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(folder.root / record.path, target)

    with local_pool() as pool:
        session.start(scene, folder.root, config, None, keep, pool)


def _merged(folder: RunFolder, kept: Path, iteration: int) -> Path:
    """The model of the checkpoints at an iteration, or at the one before for which there are some."""
    info, plan, parts = read_info(folder), read_plan(folder.plan), list[Path]()
    scene, least = scene_of(info, folder), info.config.densify.prune_opacity
    for block in range(info.config.grid.count):
        found = [int(place.name) for place in kept.iterdir() if (place / str(block)).exists()]
        at = max(number for number in found if number <= iteration)
        task = TaskId.block(block)
        shutil.copy(kept / str(at) / str(block), folder.checkpoint(task))
        parts.append(write_saved(folder, task, scene, plan.cell(block), least))
    output = kept / f"{iteration}.ply"
    merge(parts, folder.model(COARSE), output)
    return output


def _quality(folder: RunFolder, model: Path) -> float:
    report = evaluate_run(
        folder.root, model=model, axes="model", crop_bottom=None, device="cpu", progress=ignore
    )
    return float(report["mean"]["ws_psnr"])


if __name__ == "__main__":
    main()
