"""Trains a block of a finished run again, in this process, without Ray or checkpoints: for `overhead`.

    python -m benchmarks.plain_training RUN block/000 THREADS

Prints as JSON the seconds of the training and the digest of the result, as a PLY.
"""

import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from panolog.orchestrator.driver import job as stages
from panolog.orchestrator.run.config import change
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import read_info
from panolog.renderer.process import prepare
from panolog.scene.files import Locate, here
from panolog.scene.ply import write_ply
from panolog.workers.events import Trained

_NEVER = 10**9  # iterations


def train(root: Path, task: str) -> Trained:
    """The result of a training task of a run. Raises as `workers.train.train`."""
    folder = RunFolder(root)
    info = read_info(folder)
    job = stages.Job(folder, stages.scene_of(info), change(info.config, {"checkpoint.every": _NEVER}))
    work, fields, _ = stages.prepare(job, stages.Shared(job, _put, _share), task)
    *_, result = work(**fields)
    if not isinstance(result, Trained):
        raise TypeError(f"{task} is no training task: it ended with {type(result).__name__}")
    return result


def _put(value: object) -> Any:
    return value


def _share(_scene: Iterable[Path], _run: Iterable[Path]) -> Locate:
    return here


def digest(result: Trained) -> str:
    """SHA-256 of the PLY that the driver would save."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.ply"
        write_ply(path, [result.gaussians], count=len(result.gaussians), sky=result.gaussians.sky)
        return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> None:
    """The program."""
    root, task, threads = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    os.environ["OMP_NUM_THREADS"] = str(threads)
    prepare(threads)
    result = train(root, task)
    print(json.dumps({"seconds": result.seconds, "digest": digest(result)}))


if __name__ == "__main__":
    main()
