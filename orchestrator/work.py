"""The workers' entry points as functions of a task's fields, the form in which Ray ships them."""

from collections.abc import Iterator
from typing import Any

from panolog.workers.evaluate import EvaluateTask, evaluate
from panolog.workers.events import Checkpoint, Event
from panolog.workers.score import ScoreTask, score
from panolog.workers.train import TrainTask, train


def train_work(checkpoint: Checkpoint | None, **fields: Any) -> Iterator[Event]:
    """`workers.train.train` on the task with these fields."""
    return train(TrainTask(**fields), checkpoint)


def score_work(**fields: Any) -> Iterator[Event]:
    """`workers.score.score` on the task with these fields."""
    return score(ScoreTask(**fields))


def evaluate_work(**fields: Any) -> Iterator[Event]:
    """`workers.evaluate.evaluate` on the task with these fields."""
    return evaluate(EvaluateTask(**fields))
