"""A job before it starts: where it is calibrated, whether it fits, and how it is divided."""

import re
import socket
from collections.abc import Iterator, Mapping, Set
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from panolog.orchestrator.engine.estimates import calibration, suggestions
from panolog.orchestrator.engine.estimates.calibration import Basis, assumed, await_machine, calibrate
from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.engine.estimates.preflight import Preflight, choose_blocks, examine, require_memory
from panolog.orchestrator.engine.estimates.suggestions import DETAIL, problem
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.pool import NONE, Failed
from panolog.orchestrator.engine.scheduling.scaling import Group, Growth
from panolog.orchestrator.runs.config import RunConfig, change
from panolog.orchestrator.runs.machines.nodes import Node
from panolog.orchestrator.runs.records import Failure, Leaving
from panolog.scene.errors import ClusterError, InputError
from panolog.scene.model import Scene
from panolog.workers.events import Calibration, IterationCost, Notice
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import CALIBRATE, Stage, TaskId
from tests.orchestrator.calibrated import MEBI, calibrated, says
from tests.orchestrator.fakes import FakePool, SetClock, fails
from tests.workers.small import WIDTH, small_scene

PLENTY = 2**50
TIMES = 50  # as many points as the scene has


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "scene").mkdir()
    return small_scene(tmp_path / "scene")


def node(memory: int, cpus: int = 2) -> Node:
    return Node("node", "host", cpus, memory)


def examined(scene: Scene, has: int = PLENTY, script: Any = says, **settings: Any) -> Preflight:
    config = RunConfig.model_validate(
        {"width": 64, "device": "cpu", "iterations": 300, "recipe": "paper"} | settings
    )
    return examine(FakePool(script, [node(has)]), scene, config, scene.root / "run")


def large(scene: Scene, memory: int, **settings: Any) -> Estimator:
    """A job of 4,096-pixel panoramas and many Gaussians."""
    grown = IterationCost(2_000_000, 1.0, 4000 * MEBI, 0)
    basis = Basis(calibrated(width=4096, grown=grown, share=0.1), 3.0)
    cloud = replace(scene, width=4096, height=2048, points=scene.points.repeat(200, axis=0))
    config = RunConfig.model_validate(
        {"width": 4096, "device": "cpu", "iterations": 30_000, "recipe": "paper"} | settings
    )
    return Estimator(cloud, config, basis, (node(memory),))


def test_a_job_that_fits_has_no_problem(scene: Scene) -> None:
    found = examined(scene)
    found.require()
    assert found.problem is None
    assert found.config.blocks == "2x1x1"
    assert "blocks 2x1x1" in found.summary()
    trained = {it.name: it.gaussians for it in found.estimate.stages}
    both = f"Stage I {trained[Stage.COARSE]:,}, largest block {trained[Stage.BLOCK]:,}"
    assert f"Gaussians, roughly: {both}" in found.summary() and trained[Stage.COARSE] != trained[Stage.BLOCK]


def test_memory_that_no_task_fits_into_is_refused_with_the_least_that_one_does(scene: Scene) -> None:
    """Before anything is measured: the least is that of the same job on assumptions."""

    def config(memory: float | None) -> RunConfig:
        given = {"width": 64, "device": "cpu", "blocks": "auto", "memory": memory}
        return RunConfig.model_validate(given)

    with pytest.raises(
        InputError, match=r"--memory 0\.1GiB is too little .* at --width 64 give at least"
    ) as no:
        require_memory(scene, config(0.1))
    least = float(str(no.value).rpartition(" ")[2].removesuffix("GiB"))
    for enough in (None, 0.5, least):
        require_memory(scene, config(enough))
    estimator = Estimator(
        scene, change(config(least), {"blocks": "1x1x1"}), assumed(scene, config(least)), ()
    )
    assert 0.4 < least < 1.2 * max(stage.host for stage in estimator.estimate().stages) / 2**30


def test_a_job_that_does_not_fit_is_refused_in_one_line_before_it_starts(scene: Scene) -> None:
    with pytest.raises(
        InputError, match=r"needs about 0\.\d GiB of memory, and 0\.2 GiB are free"
    ) as refused:
        examined(scene, has=200 * MEBI).require()
    assert "\n" not in str(refused.value)
    assert str(scene.root) in str(refused.value)


@pytest.mark.system
@pytest.mark.parametrize(
    ("memory", "cache", "key", "more"),
    [
        (6, 0.1, "densify.max_gaussians", 100_000),
        (6, 0.1, "width", 64),
        (9, 8.0, "cache.memory", 0.1),
    ],
)
def test_a_value_that_is_proposed_fits_and_a_larger_one_would_not(
    scene: Scene, memory: int, cache: float, key: str, more: float
) -> None:
    job = large(scene, memory * 2**30, cache={"memory": cache})
    job = replace(job, scene=replace(job.scene, train=(0, 1, 2, 3) * 200))  # the cache will be full
    message = problem(job, PLENTY)
    assert message is not None
    found = re.search(rf"{key}[ =]([\d.]+)", message)
    assert found is not None, message

    def fits(value: float) -> bool:
        settings = {key: value if key == "cache.memory" else int(value)}
        return problem(replace(job, config=change(job.config, settings)), PLENTY) is None

    assert fits(float(found[1]))
    assert not fits(float(found[1]) + more)


def light(_: TaskSpec) -> Iterator[Calibration]:
    """Workers that need 40 MiB besides Gaussians: of few, which are soon counted, tasks are large then."""
    initial, grown = IterationCost(1_000, 0.011, 41 * MEBI, 0), IterationCost(11_000, 0.021, 60 * MEBI, 0)
    yield calibrated(initial=initial, grown=grown)


def growing(scene: Scene, times: int = TIMES, **settings: Any) -> Preflight:
    """A job whose Stage I is expected to come to many Gaussians, on a machine with plenty of memory."""
    cloud = replace(scene, points=scene.points.repeat(times, axis=0))
    return examined(cloud, script=light, **settings)


@pytest.mark.parametrize(("recipe", "blocks"), [("paper", "2x1x1"), ("paper", "auto"), ("panolog", "2x1x1")])
def test_a_task_grows_to_what_its_memory_takes(scene: Scene, recipe: str, blocks: str) -> None:
    """Where the place cannot be divided further."""
    whole: dict[str, Any] = {
        "times": 10,
        "recipe": recipe,
        "blocks": blocks,
        "stage2": {"detail": 1.0},
        "partition": {"min_cameras": 4},
    }
    free = growing(scene, **whole)
    need = max(stage.host for stage in free.estimate.stages) / 2**30
    assert free.config.densify.max_gaussians == 0 and "max_gaussians" not in free.summary()
    least = growing(scene, **whole, densify={"max_gaussians": 1})
    bare = max(stage.host for stage in least.estimate.stages) / 2**30
    points, caps = 10 * len(scene.points), list[int]()
    for share in (0.1, 0.4, 0.8):
        memory = bare + share * (need - bare)
        found = growing(scene, **whole, memory=memory)
        found.require()
        assert max(stage.host for stage in found.estimate.stages) <= memory * 2**30
        caps.append(found.config.densify.max_gaussians)
        assert f"at most {caps[-1]:,} scene Gaussians" in found.summary()
    assert caps[0] < caps[1] < caps[2] and caps[0] < points < caps[2]
    assert growing(scene, **whole, memory=2 * need).config == free.config.model_copy(
        update={"memory": 2 * need}
    )


def seen_apart(scene: Scene) -> Scene:
    """The scene of `growing`, each of whose panoramas has seen points of its own."""
    parts = np.array_split(np.arange(TIMES * len(scene.points)), len(scene.panoramas))
    seen = [replace(each, observed=rows) for each, rows in zip(scene.panoramas, parts, strict=True)]
    return replace(scene, panoramas=tuple(seen))


@pytest.mark.parametrize(("apart", "chosen"), [(False, "stage2.detail=8.0"), (True, "districts=2")])
def test_a_place_is_divided_until_its_tasks_fit(scene: Scene, apart: bool, chosen: str) -> None:
    """Where each panorama has seen points of its own, districts have parts of them."""
    settings: dict[str, Any] = {"recipe": "panolog", "partition": {"min_cameras": 1}}
    if apart:
        scene, settings["densify"] = seen_apart(scene), {"growth": 0.0}
    free = growing(scene, **settings)
    memory = 0.95 * max(stage.host for stage in free.estimate.stages) / 2**30
    found = growing(scene, **settings, memory=memory)
    found.require()
    assert max(stage.host for stage in found.estimate.stages) <= memory * 2**30
    assert found.config.stage2.detail == 8 and found.config.densify.max_gaussians == 0
    assert f"so that tasks fit into memory: {chosen}" in found.summary()


def test_a_cache_that_is_too_large_becomes_smaller(scene: Scene) -> None:
    """Before anything of the place is divided."""
    wide = replace(scene, width=8192, height=4096)
    settings: dict[str, Any] = {"recipe": "panolog", "width": 8192, "sky": {"count": 0}}
    free = examined(wide, **settings)
    memory = 0.9 * max(stage.host for stage in free.estimate.stages) / 2**30
    found = examined(wide, **settings, memory=memory)
    found.require()
    assert found.chosen == {"cache.memory": round(memory / 8, 3)}
    assert "so that tasks fit into memory: cache.memory=" in found.summary()


def test_an_evaluation_that_does_not_fit_caps_no_gaussians(scene: Scene) -> None:
    """It is divided as all else is, where it alone would have all of them."""
    settings: dict[str, Any] = {"recipe": "panolog", "districts": 4, "blocks": "3x3x1"}
    settings |= {"partition": {"min_cameras": 1, "rho_tri": 0.1}, "densify": {"growth": 0.0}}
    scene = seen_apart(scene)
    whole = {stage.name: stage for stage in growing(scene, **settings).estimate.stages}
    detailed = growing(scene, **settings, stage2={"detail": DETAIL}).estimate.stages
    largest = max(stage.host for stage in detailed)
    assert whole[Stage.EVAL].host > largest and Stage.MEASURE not in whole
    found = growing(scene, **settings, memory=1.01 * largest / 2**30)
    found.require()
    assert (found.config.stage2.detail, found.config.densify.max_gaussians) == (DETAIL, 0)
    assert [stage.host for stage in found.estimate.stages] == [stage.host for stage in detailed]
    shards = next(stage for stage in detailed if stage.name is Stage.MEASURE)
    assert shards.tasks > 1 and shards.gaussians < whole[Stage.EVAL].gaussians / 2
    assert next(stage for stage in detailed if stage.name is Stage.EVAL).host == 0


def test_memory_that_takes_not_even_the_sparse_points_is_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"needs about .* of memory, and 10 MiB are free"):
        growing(scene, memory=0.01).require()


def test_a_cap_that_is_given_stays(scene: Scene) -> None:
    found = growing(scene, memory=0.03, densify={"max_gaussians": 10**9})
    assert found.config.densify.max_gaussians == 10**9 and found.problem is not None


def test_a_full_disk_is_refused(scene: Scene) -> None:
    job = large(scene, PLENTY)
    message = problem(job, 10**9)
    assert message is not None
    assert "of its disk are free" in message
    assert "densify.max_gaussians" in message


def test_temporary_files_of_blocks_need_a_disk(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """236 MB for each panorama of 3,840 pixels: it was missing in Stage II, after hours."""
    assert suggestions.free_temporary([node(PLENTY)]) == float("inf")  # of another machine
    here = replace(node(PLENTY), host=socket.gethostname())
    assert 0 < suggestions.free_temporary([here]) < float("inf")
    monkeypatch.setattr(suggestions, "free_temporary", lambda _: float(10**6))
    job = large(scene, PLENTY, recipe="panolog", blocks="2x1x1", cache={"memory": 0.1})
    job = replace(job, scene=replace(job.scene, points=scene.points))  # a search of many takes two seconds
    message = problem(job, PLENTY)
    assert message is not None
    assert re.match(
        r"what is baked for the panoramas of a block needs about 1\.. GiB in .*\(TMPDIR\)", message
    )
    assert problem(replace(job, config=change(job.config, {"cache.memory": 2.0})), PLENTY) is None


def test_nothing_is_proposed_where_nothing_helps(scene: Scene) -> None:
    message = problem(large(scene, MEBI), PLENTY)
    assert message is not None
    assert "it fits with" not in message


def test_a_calibration_that_fails_leaves_assumptions_or_finds_the_input_wrong(scene: Scene) -> None:
    dies = fails(
        CALIBRATE, Failed("out of memory", Failure.MEMORY), 1, before=[Notice(CALIBRATE, "passed over")]
    )
    assert examined(scene, script=dies).estimate.seconds is None
    finds = fails(CALIBRATE, Failed("a.jpg: cannot be decoded", Failure.INPUT), 1)
    with pytest.raises(InputError, match=r"a\.jpg: cannot be decoded"):
        examined(scene, script=finds)


class SilentPool(FakePool):
    """Its worker hangs, at once or after so many messages."""

    def __init__(self, messages: int, clock: SetClock) -> None:
        super().__init__(says, [node(PLENTY)])
        self.left, self.clock = messages, clock

    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        self.left -= 1
        if self.left >= 0:
            return super().ready(seconds)
        self.clock.sleep(seconds)
        return []


@pytest.mark.parametrize(("messages", "timed"), [(0, False), (1, False), (2, True)])
def test_a_calibration_that_hangs_is_ended(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, messages: int, timed: bool
) -> None:
    """What it has measured before counts."""
    pool = SilentPool(messages, clock := SetClock())
    monkeypatch.setattr(calibration, "time", clock)
    assert calibrate(pool, scene, RunConfig(width=scene.width, device="cpu")).timed == timed
    assert clock.now - 1e9 > RunConfig().deadlines.message and not pool.running


def test_auto_takes_as_few_blocks_as_memory_allows_and_as_keep_the_machines_busy(scene: Scene) -> None:
    assert examined(scene, blocks="auto").config.blocks == "1x1x1"
    for memory, one in ((PLENTY, True), (7 * 2**30, False)):
        job = large(scene, memory, cache={"memory": 64.0})
        job = replace(job, scene=replace(job.scene, train=(0, 1, 2, 3) * 100), nodes=(node(memory, cpus=1),))
        assert (choose_blocks(job) == 1) == one
    job = large(scene, PLENTY)
    many = replace(job.scene, train=(0, 1, 2, 3) * 16)  # cameras enough
    assert choose_blocks(replace(job, scene=many, nodes=(node(PLENTY), node(PLENTY)))) > 1


def test_a_number_of_blocks_is_balanced(scene: Scene) -> None:
    found = examined(scene, blocks="2", partition={"min_cameras": 2})
    assert (found.config.blocks, len(found.config.partition.cuts), found.estimate.blocks) == ("2", 1, "2")
    assert RunConfig.model_validate(found.config.model_dump(mode="json"), context="resolved") == found.config
    again = examined(scene, **found.config.model_dump(exclude={"device", "width"}))
    assert again.config.partition.cuts == found.config.partition.cuts


def test_more_blocks_than_there_are_cameras_for_are_refused(scene: Scene) -> None:
    with pytest.raises(InputError, match=r"4 training panoramas are enough for --blocks 1 .* not for 7"):
        examined(scene, blocks="7")


# Where a job is calibrated


NODES = [Node(name, name, 2, 2**40) for name in ("a", "b")]


@pytest.mark.parametrize(("leaving", "where"), [([], "a"), (["a"], "b"), (["a", "b"], "a")])
def test_a_node_that_leaves_is_not_calibrated_on_if_another_stays(
    leaving: list[str], where: str, tmp_path: Path
) -> None:
    pool = FakePool(says, NODES)
    pool.leaving = {name: LeaveNotice(Leaving.PREEMPTION, 60) for name in leaving}
    calibrate(pool, small_scene(tmp_path), RunConfig(width=WIDTH, device="cpu"))
    assert [placement.node for placement, _ in pool.started] == [where]


class ComingPool(FakePool):
    """A machine joins when the driver has waited twice."""

    def __init__(self, groups: tuple[Group, ...]) -> None:
        super().__init__(says, [])
        self.groups, self.left = groups, 2
        self.requests: list[dict[str, int]] = []
        self.when_waiting(self._wait)

    def _wait(self) -> None:
        self.left -= 1
        if not self.left:
            self.join(NODES[0])

    def growth(self) -> Growth:
        return Growth(self.groups, trouble="no spot machines" if self.left == 1 else "")

    def request(self, wanted: Mapping[str, int]) -> None:
        self.requests.append(dict(wanted))


def test_without_a_machine_one_is_requested_and_waited_for() -> None:
    small, large = Group("small", 4, 2, memory=2**33), Group("large", 4, 8, memory=2**36)
    pool, said = ComingPool((large, small)), list[str]()
    assert await_machine(pool, lambda: 2**30, said.append, cuda=False) is not None
    assert pool.requests == [{"small": 1}, {"small": 1}, {}]
    requested = "waiting for a machine: small (2 cores, 8.0 GiB) is requested from Ray's autoscaler"
    assert said == [requested, f"{requested}; it reports: no spot machines", ""]
    pool = ComingPool((large, small))
    await_machine(pool, lambda: 2**34, said.append, cuda=False)
    assert pool.requests[0] == {"large": 1}


def test_where_none_can_be_started_one_may_join() -> None:
    pool, said = ComingPool(()), list[str]()
    assert await_machine(pool, lambda: 0, said.append, cuda=False) is None
    assert said == ["waiting for a machine with a core: the cluster has none", ""]


def test_a_cluster_that_stays_empty_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "_JOIN_S", 0.0)
    with pytest.raises(ClusterError, match="no node of the cluster has a core for tasks"):
        await_machine(FakePool(says, []), lambda: 0, lambda _: None, cuda=False)


def test_where_there_is_a_machine_nothing_is_requested() -> None:
    pool = ComingPool((Group("small", 4, 2),))
    pool.join(NODES[1])
    assert await_machine(pool, lambda: 0, lambda _: None, cuda=False) is None
    assert pool.requests in ([], [{}])
