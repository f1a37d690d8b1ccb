"""The workers' entry points as functions of a task's fields, the form in which Ray ships them.

What lies in files is named, not carried: the worker reads it itself, where its `locate` says.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from panolog.scene.files import Locate
from panolog.scene.ply import read_ply
from panolog.workers import stopping
from panolog.workers.calibration import CalibrateTask, calibrate
from panolog.workers.evaluation import EvaluateTask, evaluate
from panolog.workers.events import Event
from panolog.workers.scoring import ScoreTask, score
from panolog.workers.training.checkpoint import load
from panolog.workers.training.trainer import TrainTask, train


def train_work(
    checkpoint: Path | None, initial: Path | None, locate: Locate, **fields: Any
) -> Iterator[Event]:
    """`workers.train.train` on the task with these fields, from a checkpoint and a PLY."""
    model = read_ply(locate(initial)) if initial else None
    saved = load(locate(checkpoint)) if checkpoint else None
    return train(TrainTask(initial=model, locate=locate, **fields), saved, stopping.requested)


def score_work(gaussians: Path, locate: Locate, **fields: Any) -> Iterator[Event]:
    """`workers.score.score` on the task with these fields, of the model in a PLY."""
    return score(ScoreTask(gaussians=read_ply(locate(gaussians)), locate=locate, **fields))


def evaluate_work(**fields: Any) -> Iterator[Event]:
    """`workers.evaluate.evaluate` on the task with these fields."""
    return evaluate(EvaluateTask(**fields))


def calibrate_work(**fields: Any) -> Iterator[Event]:
    """`workers.calibrate.calibrate` on the task with these fields."""
    return calibrate(CalibrateTask(**fields))
