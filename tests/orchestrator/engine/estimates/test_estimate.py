import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.engine.estimates.calibration import (
    CHECKPOINT,
    SPLAT,
    TRAINED,
    Basis,
    assumed,
    basis_of,
)
from panolog.orchestrator.engine.estimates.costs import Estimate, StageEstimate
from panolog.orchestrator.engine.estimates.estimate import Estimator
from panolog.orchestrator.runs import thinning
from panolog.orchestrator.runs.config import RunConfig
from panolog.orchestrator.runs.folder import RunFolder, write_json
from panolog.orchestrator.runs.machines.nodes import Gpu, Node
from panolog.workers.device_memory import CONTEXT
from panolog.workers.events import IterationCost
from panolog.workers.tasks import Stage
from panolog.workers.training.exterior import BAKED, PASSING, READING
from tests.orchestrator.calibrated import MEBI, calibrated
from tests.workers.small import WIDTH, small_scene

BASIS = Basis(calibrated(), startup=3.0)
HERE = (Node("node", "host", cpus=2, memory=8 * 2**30),)


def estimator(
    tmp_path: Path, basis: Basis = BASIS, nodes: tuple[Node, ...] = HERE, **settings: Any
) -> Estimator:
    config = RunConfig.model_validate(
        {"width": 64, "device": "cpu", "iterations": 300, "recipe": "paper"} | settings
    )
    folder = tmp_path / "scene"
    folder.mkdir(exist_ok=True)
    return Estimator(small_scene(folder), config, basis, nodes)


def stage(estimate: Estimate, name: Stage) -> StageEstimate:
    return next(stage for stage in estimate.stages if stage.name == name)


def test_memory_is_the_calibrations_and_what_more_gaussians_and_panoramas_take(tmp_path: Path) -> None:
    job = estimator(tmp_path)
    alone = job.host(12_000, 0)
    assert alone == 419 * MEBI + 1000 * TRAINED
    assert job.host(13_000, 0) - alone == 1000 * TRAINED
    assert job.host(12_000, 4) - alone == 4 * 9 * 64 * 32  # colour, mask, sky mask and depth
    assert job.host(12_000, 0, initial=1000) - alone == 1000 * 2 * 59 * 4
    tight = estimator(tmp_path, cache={"memory": 1e-5})
    assert tight.host(12_000, 4) - alone == int(1e-5 * 2**30)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_checkpoints_take_memory_of_the_host_and_none_of_a_gpu(tmp_path: Path, device: str) -> None:
    saving, not_saving = (estimator(tmp_path, device=device, checkpoint={"every": n}) for n in (100, 1000))
    assert saving.host(100_000, 0) - not_saving.host(100_000, 0) == 100_000 * 2 * CHECKPOINT
    assert saving.device(10_000_000) == not_saving.device(10_000_000)


def test_what_is_kept_of_movers_is_in_the_memory_of_stage_one(tmp_path: Path) -> None:
    """Where it computes once, and twice in the host's memory for checkpoints."""
    settings: dict[str, Any] = {"width": 512, "checkpoint": {"every": 100}}
    kept = 128 * 64 * (6 * 1000 + 5 * 16)
    for device, copies in (("cpu", 3), ("cuda", 2)):
        settings["device"] = device
        plain, weighing = (estimator(tmp_path, **settings, movers={"weigh": w}) for w in (False, True))
        assert weighing.host(1000, 1000) - plain.host(1000, 1000) == copies * kept
        assert weighing.memory(1000, 1000) - plain.memory(1000, 1000) == (
            kept if device == "cuda" else 3 * kept
        )
        assert weighing.host(1000, 1000, initial=9) == plain.host(1000, 1000, initial=9)
    coarse = [stage(job.estimate(), Stage.COARSE) for job in (plain, weighing)]
    assert coarse[1].device - coarse[0].device == 128 * 64 * (6 * 4 + 5 * 16)


def test_time_is_linear_in_the_gaussians_of_every_period(tmp_path: Path) -> None:
    still = estimator(tmp_path, densify={"until": 0}, sky={"count": 1000 - 200}, refine=False)
    coarse = stage(still.estimate(), Stage.COARSE)
    assert coarse.gaussians == 1000
    assert coarse.seconds == pytest.approx(0.5 + 300 * 0.011 + 4 * 0.01 / 2)
    more = estimator(tmp_path, densify={"until": 0}, sky={"count": 11_000 - 200}, refine=False)
    assert stage(more.estimate(), Stage.COARSE).seconds == pytest.approx(0.5 + 300 * 0.021 + 4 * 0.01 / 2)


def test_a_plan_is_estimated_from_the_stage_one_and_the_cameras_that_it_has(tmp_path: Path) -> None:
    job = estimator(tmp_path, blocks="2x1x1")
    estimated = stage(job.estimate(), Stage.BLOCK)
    coarse = stage(job.estimate(), Stage.COARSE).gaussians
    assert job.refinement(coarse, 2, job.parts.block_cameras) == estimated
    assert job.block(coarse, coarse, job.parts.block_cameras).host == estimated.host
    larger = job.refinement(coarse + 5_000, 4, job.parts.block_cameras)
    assert larger.host > estimated.host
    assert larger.seconds is not None
    assert estimated.seconds is not None
    assert larger.seconds > 2 * estimated.seconds


def test_blocks_share_the_cores(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"densify": {"until": 0}, "sky": {"count": 11_000 - 200}}
    pair = stage(estimator(tmp_path, **settings, blocks="2x1x1").estimate(), Stage.BLOCK)
    assert (pair.tasks, pair.together) == (2, 2)
    assert pair.seconds == pytest.approx(0.5 + 300 * 0.036 + 4 * 0.01 / 2, rel=0.01)
    four = stage(estimator(tmp_path, **settings, blocks="4x1x1").estimate(), Stage.BLOCK)
    assert four.seconds == pytest.approx(2 * (pair.seconds or 0), rel=0.01)
    small = (replace(HERE[0], memory=700 * MEBI),)  # room for one of them
    alone = stage(estimator(tmp_path, nodes=small, **settings, blocks="2x1x1").estimate(), Stage.BLOCK)
    assert alone.together == 1
    assert alone.seconds == pytest.approx(2 * (0.5 + 300 * 0.021), rel=0.02)


def test_on_gpus_memory_is_the_devices_and_each_takes_a_block(tmp_path: Path) -> None:
    gpu = calibrated(grown=IterationCost(11_000, 0.021, 900 * MEBI, 100 * MEBI))
    node = Node("node", "host", 8, 8 * 2**30, (Gpu("card", 2**34), Gpu("card", 2**34)))
    job = estimator(tmp_path, Basis(gpu, 3.0), (node,), device="cuda", blocks="2x2x1")
    assert job.memory(11_000, 0) == 100 * MEBI + CONTEXT
    assert job.capacity(job.memory(1_000_000, 0)) == pytest.approx(1_000_000, abs=1)
    block = stage(job.estimate(), Stage.BLOCK)
    assert (block.tasks, block.together) == (4, 2)
    assert block.device > 100 * MEBI > 0
    assert block.host > 0


@pytest.mark.parametrize("decode", [0.01, 0.5])
def test_cores_decode_while_a_gpu_trains(tmp_path: Path, decode: float) -> None:
    """The slower of the two decides, where no panorama stays decoded."""
    settings: dict[str, Any] = {"densify": {"until": 0}, "sky": {"count": 11_000 - 200}}
    basis = Basis(calibrated(decode=decode, threads=2, grown=IterationCost(11_000, 0.021, 2**30, 2**27)), 3.0)
    job = estimator(tmp_path, basis, **settings, device="cuda", cache={"memory": 1e-5})
    seconds = stage(job.estimate(), Stage.COARSE).seconds
    assert seconds == pytest.approx(0.5 + 300 * max(0.021, decode / 2), rel=0.02)


def test_a_block_with_a_baked_exterior_trains_what_its_cell_has(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"blocks": "2x1x1", "sky": {"count": 5_000}}
    whole, own = (estimator(tmp_path, **settings, stage2={"exterior": kind}) for kind in ("frozen", "baked"))
    before, after = (stage(job.estimate(), Stage.BLOCK) for job in (whole, own))
    assert stage(own.estimate(), Stage.COARSE) == stage(whole.estimate(), Stage.COARSE)
    assert after.gaussians < before.gaussians - 5_000  # no sky
    assert after.seconds is not None and before.seconds is not None and after.seconds < before.seconds
    layer = BAKED * 64 * 32
    more = own.host(1_000, 4, 10_000) - whole.host(1_000, 4, 10_000)
    assert more == (4 + READING) * layer + 10_000 * SPLAT
    small = {**settings, "stage2": {"exterior": "baked"}, "cache": {"memory": 3 * layer / 2**30}}
    hosts = {estimator(tmp_path, **small).host(1_000, cameras, 10_000) for cameras in (10, 10_000)}
    assert len(hosts) == 1, "what has no room is in a file"
    assert own.memory(1_000, 4) == whole.memory(1_000, 4), "Stage I has no exterior"
    on_gpu = estimator(tmp_path, **settings, stage2={"exterior": "baked"}, device="cuda")
    assert on_gpu.device(1_000, PASSING) - on_gpu.memory(1_000, 4) == PASSING * layer
    few, many = (own.block(50_000, gaussians, 4) for gaussians in (1_000, 20_000))
    assert few.gaussians < many.gaussians and few.host < many.host
    assert whole.block(50_000, 1_000, 4) == whole.block(50_000, 20_000, 4), "it trains with all of Stage I"


def test_disk_is_taken_by_models_and_checkpoints_that_stay(tmp_path: Path) -> None:
    sizes = [estimator(tmp_path, retention={"checkpoints": kept}).estimate().disk for kept in (1, 2, 4)]
    assert sizes[2] - sizes[1] == 2 * (sizes[1] - sizes[0]) > 0
    assert estimator(tmp_path, refine=False).estimate().disk < sizes[0]
    free, capped = (
        estimator(tmp_path, sky={"count": 0}, densify={"max_gaussians": most}).estimate() for most in (0, 250)
    )
    assert stage(free, Stage.BLOCK).gaussians > stage(capped, Stage.BLOCK).gaussians == 250
    assert capped.disk < free.disk
    few = estimator(tmp_path, sky={"count": 0}, densify={"max_gaussians": 20}).estimate()
    assert stage(few, Stage.COARSE).gaussians == 20, "of more points it starts with a part"


def test_progress_and_previews_of_every_task_take_disk(tmp_path: Path) -> None:
    """Of a thousand small models they are the most."""
    settings: dict[str, Any] = {"densify": {"until": 0}, "sky": {"count": 0}, "blocks": "10x10x10"}
    estimated = estimator(tmp_path, **settings).estimate()
    previews = thinning.PREVIEWS * WIDTH * WIDTH * 0.3
    kept = 1_000 * (thinning.DENSE * thinning.ROW + previews)
    assert kept < estimated.disk < 5 * kept


def test_districts_have_a_part_of_the_cameras_and_of_the_points(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"partition": {"min_cameras": 1, "rho_tri": 0.1}}
    whole, apart = (estimator(tmp_path, districts=n, **settings).estimate() for n in (1, 3))
    coarse, district = stage(apart, Stage.COARSE), stage(apart, Stage.DISTRICT)
    assert [stage.name for stage in apart.stages[:2]] == [Stage.DISTRICT, Stage.COARSE]
    assert (district.tasks, coarse.host) == (3, 0)
    assert district.gaussians <= coarse.gaussians
    assert 0 < district.host <= stage(whole, Stage.COARSE).host
    assert apart.disk > whole.disk


def test_a_district_grows_as_a_place_with_its_points(tmp_path: Path) -> None:
    cut: dict[str, Any] = {"partition": {"min_cameras": 1, "rho_tri": 0.1}, "sky": {"count": 0}}
    relocated = cut | {"densify": {"method": "relocate", "growth": 1.0}}
    job = estimator(tmp_path, districts=3, **relocated)
    share = job.parts.district[1]
    points = job.scene.points[: math.ceil(len(job.scene.points) * share)]
    alone = estimator(tmp_path, **relocated)
    alone = replace(alone, scene=replace(alone.scene, points=points))
    district = stage(job.estimate(), Stage.DISTRICT).gaussians
    assert district == stage(alone.estimate(), Stage.COARSE).gaussians
    assert stage(job.estimate(), Stage.COARSE).gaussians == pytest.approx(district / share, rel=0.02)


def test_a_run_remembers_what_it_was_estimated_on(tmp_path: Path) -> None:
    job, folder = estimator(tmp_path), RunFolder(tmp_path)
    assert not basis_of(folder, job.scene, job.config).timed
    write_json(folder.preflight, {"basis": BASIS.as_json()})
    assert basis_of(folder, job.scene, job.config) == BASIS
    folder.preflight.write_text("{}")
    assert basis_of(folder, job.scene, job.config) == assumed(job.scene, job.config)


def test_fitting_poses_takes_time_and_gradients(tmp_path: Path) -> None:
    off, on = {"refine": False}, {"refine": True}
    seconds = [stage(estimator(tmp_path, poses=poses).estimate(), Stage.EVAL).seconds for poses in (off, on)]
    assert seconds[0] is not None and seconds[1] is not None
    assert seconds[1] - seconds[0] > 20 * 0.01  # renderings of the one held-out panorama
    gpu = (replace(HERE[0], gpus=(Gpu("card", 2**34),)),)
    device = [
        stage(estimator(tmp_path, nodes=gpu, device="cuda", poses=poses).estimate(), Stage.EVAL).device
        for poses in (off, on)
    ]
    assert device[0] < device[1]
