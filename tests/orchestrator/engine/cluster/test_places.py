import pytest

from panolog.orchestrator.engine.cluster import places
from panolog.orchestrator.engine.cluster.places import Others
from panolog.orchestrator.runs.machines.nodes import Gpu, Node

CORES, GPUS = Node("c", "cores", 8, 2**40), Node("g", "gpus", 8, 2**40, (Gpu(),) * 4)


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, float]]:
    values = {"c": {"CPU": 8.0}, "g": {"CPU": 8.0, "GPU": 4.0}}
    monkeypatch.setattr(places, "available_resources_per_node", lambda: values)
    return values


def test_what_others_have_is_not_ours(free: dict[str, dict[str, float]]) -> None:
    seen = Others()
    free["g"] = {"GPU": 1.0}  # two are ours, one is another program's; cores do not count
    free["c"] = {}  # all cores are others'
    for _ in range(3):
        seen.look([CORES, GPUS], {"g": 2.0})
    assert (seen.share("g"), seen.share("c"), seen.share("unknown")) == (0.75, 0.0, 1.0)


def test_what_ray_has_not_freed_yet_is_still_ours(free: dict[str, dict[str, float]]) -> None:
    seen = Others()
    for left, held in ((2.0, 2.0), (2.0, 0.0), (4.0, 0.0), (3.0, 2.0)):  # it ends, and another has begun
        free["g"] = {"GPU": left}
        seen.look([GPUS], {"g": held})
        assert seen.share("g") == 1.0
