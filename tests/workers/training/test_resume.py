"""A training that continues from a checkpoint ends with the bytes of an undisturbed one, for any threads."""

import pickle
from dataclasses import replace
from typing import Any

import pytest

from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.workers.specs import Value
from panolog.workers.training.trainer import TrainSpec, train
from tests.workers.trainings import (
    RELOCATED,
    block_of,
    checkpoints,
    coarse_of,
    content,
    end,
    same,
    settings,
    threads,
    trained,
    until_saved,
)

pytestmark = pytest.mark.system

Groups = dict[str, Any]
CAPTURED: Groups = {
    "densify": {"until": 0},
    "poses": {"refine": True, "begin": 0.1, "visits": 0},
    "exposure": {"learn": True, "begin": 0},
    "movers": {"weigh": True, "factor": 1.2},
}
COARSE: dict[str, Groups] = {
    "usual": {},
    "absolute": {"densify": {"split_gradient": 3e-3}},
    "averaged": {"optimizer": {"average": 0.25}},
    "relocated": {"densify": RELOCATED, "depth": {"points": 0.8}},
    "relocated, exact": {"densify": RELOCATED, "projection": "exact", "optimizer": {"unit": "distance"}},
    "captured": CAPTURED,
}
BLOCKS: dict[str, Groups] = {
    "full": {},
    "frozen": {"stage2": {"exterior": "frozen"}},
    "frozen, relocated": {"stage2": {"exterior": "frozen"}, "densify": RELOCATED},
    "baked": {"stage2": {"exterior": "baked"}},
    "baked, relocated, exact": {
        "stage2": {"exterior": "baked"},
        "densify": RELOCATED,
        "projection": "exact",
        "optimizer": {"unit": "distance"},
    },
}


@pytest.fixture(scope="module")
def initial(scene: Scene) -> Gaussians:
    return trained(coarse_of(scene))


def resumed(spec: TrainSpec) -> Gaussians:
    """The end of a task, which resumes from each checkpoint to the next, and from the last one to it."""
    events = list(train(spec))
    saved = checkpoints(events)
    assert [event.iteration for event in saved] == [5, 10, 15, 20]
    for checkpoint, following in zip(saved, [*saved[1:], events[-1]], strict=True):
        again: TrainSpec = pickle.loads(pickle.dumps(replace(spec, checkpoint=Value(checkpoint))))
        assert content(until_saved(again)) == content(following), checkpoint.iteration
    return trained(events)


@pytest.mark.parametrize("name", COARSE)
def test_stage_one(name: str, scene: Scene, initial: Gaussians) -> None:
    found = resumed(coarse_of(scene, settings(**COARSE[name])))
    assert same(found, initial) == (name == "usual")


@pytest.mark.parametrize("name", BLOCKS)
def test_a_block(name: str, scene: Scene, initial: Gaussians) -> None:
    assert len(resumed(block_of(coarse_of(scene), initial, **BLOCKS[name])))


@pytest.mark.parametrize("name", ["usual", "captured"])
def test_the_number_of_threads_does_not_matter(name: str, scene: Scene) -> None:
    spec, found = coarse_of(scene, settings(**COARSE[name])), []
    for count in (1, 3):
        with threads(count):
            found.append(content(end(spec)))
    assert found[0] == found[1]
