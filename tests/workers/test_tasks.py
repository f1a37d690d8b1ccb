"""Ids of tasks: their texts, their order, and what is none."""

import pickle

import pytest

from panolog.scene.errors import InputError
from panolog.workers.tasks import CALIBRATE, COARSE, EVAL, MERGE, PLAN, Stage, TaskId

IN_ORDER = {
    "calibrate": CALIBRATE,
    "coarse": COARSE,
    "score/000": TaskId.shard(0),
    "score/012": TaskId.shard(12),
    "plan": PLAN,
    "block/003": TaskId.block(3),
    "block/999": TaskId.block(999),
    "block/1000": TaskId.block(1000),
    "merge": MERGE,
    "measure/001": TaskId.measure(1),
    "eval": EVAL,
}


@pytest.mark.parametrize("text", IN_ORDER)
def test_a_text_is_one_task_and_back(text: str) -> None:
    assert TaskId.parse(text) == IN_ORDER[text]
    assert str(IN_ORDER[text]) == text
    assert pickle.loads(pickle.dumps(IN_ORDER[text])) == IN_ORDER[text]


def test_tasks_are_in_the_order_of_stages_and_numbers() -> None:
    assert sorted(set(IN_ORDER.values())) == list(IN_ORDER.values())


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Coarse",
        "coarse/000",
        "block",
        "block/3",
        "block/0003",
        "block/-01",
        "block/٣٣٣",
        "a/000",
        " plan",
    ],
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="is not a task"):
        TaskId.parse(text)


@pytest.mark.parametrize(("stage", "index"), [(Stage.COARSE, 0), (Stage.BLOCK, None), (Stage.SCORE, -1)])
def test_a_number_belongs_to_shards_and_blocks(stage: Stage, index: int | None) -> None:
    with pytest.raises(ValueError, match="has no task with the number"):
        TaskId(stage, index)
