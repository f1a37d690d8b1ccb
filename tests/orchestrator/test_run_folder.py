import json
import os
from pathlib import Path

import pytest

from panolog.orchestrator import lock
from panolog.orchestrator.config import RunConfig
from panolog.orchestrator.machine import cores, memory
from panolog.orchestrator.preflight import Needs, check_disk, decoded_bytes, estimate, fitting
from panolog.orchestrator.run_folder import RunFolder
from panolog.orchestrator.run_info import SceneRef, check_output, make_info, read_info, write_info
from panolog.orchestrator.units import gib
from panolog.scene.errors import InputError
from tests.workers.small import small_scene

SCENE = SceneRef(path="/scene", fingerprint="f")


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    folder = RunFolder(tmp_path / "run")
    folder.root.mkdir()
    write_info(folder, make_info(SCENE, RunConfig(width=64, seed=3)))
    return folder


def test_run_json_holds_the_resolved_settings(folder: RunFolder) -> None:
    info = read_info(folder)
    assert (info.scene, info.config, info.seed) == (SCENE, RunConfig(width=64, seed=3), 3)
    assert {"panolog", "python", "torch", "ray"} <= set(info.versions)
    assert json.loads(folder.info.read_text())["config"]["sky"]["count"] == 100_000


def test_every_task_has_its_place(folder: RunFolder) -> None:
    assert folder.relative(folder.checkpoint("coarse")) == "coarse/checkpoint.safetensors"
    assert folder.relative(folder.model("block/007")) == "blocks/007/model.ply"
    assert folder.relative(folder.shard("score/003")) == "partition/scores/003.npz"


def test_a_new_or_empty_folder_will_do(tmp_path: Path) -> None:
    check_output(tmp_path / "a" / "b", "f")
    check_output(tmp_path, "f")
    assert not (tmp_path / "a").exists()
    (tmp_path / "lock").touch()  # a driver was killed before run.json
    check_output(tmp_path, "f")


def test_an_occupied_folder_is_refused_and_untouched(folder: RunFolder, tmp_path: Path) -> None:
    before = folder.info.read_bytes()
    with pytest.raises(InputError, match="use `panolog resume"):
        check_output(folder.root, "f")
    with pytest.raises(InputError, match="another scene"):
        check_output(folder.root, "g")
    assert folder.info.read_bytes() == before
    (tmp_path / "other").mkdir()
    for foreign in ("thesis.txt", "run.db"):
        (tmp_path / "other" / foreign).touch()
        with pytest.raises(InputError, match="not empty"):
            check_output(tmp_path / "other", "f")
        (tmp_path / "other" / foreign).unlink()
    with pytest.raises(InputError, match="is a file"):
        check_output(folder.info, "f")
    with pytest.raises(InputError, match="cannot be written"):
        check_output(folder.info / "below", "f")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_an_unwritable_folder_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    with pytest.raises(InputError, match="cannot be written"):
        check_output(tmp_path / "run", "f")


@pytest.mark.parametrize("content", ["{", '{"format": 2}', "[]"])
def test_a_damaged_run_json_is_one_clear_line(folder: RunFolder, content: str) -> None:
    folder.info.write_text(content)
    with pytest.raises(InputError) as caught:
        read_info(folder)
    assert "\n" not in str(caught.value)


def test_only_one_holds_the_lock_and_looking_does_not_take_it(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    assert not lock.held(path)
    with lock.hold(path):
        assert lock.held(path)
        with pytest.raises(InputError, match="another driver"), lock.hold(path):
            pass
        assert lock.held(path)
    assert not lock.held(path)
    with lock.hold(path):
        pass


def test_a_full_disk_is_refused_before_anything_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_disk(tmp_path / "run", Needs(1000, 1, 1))
    monkeypatch.setattr("shutil.disk_usage", lambda _: _Usage(free=10**6))
    with pytest.raises(InputError, match=r"need 0\.9 GiB, 1 MiB of its disk are free"):
        check_disk(tmp_path / "run", Needs(1000, 1, 10**9))
    assert list(tmp_path.iterdir()) == []


class _Usage:
    def __init__(self, free: int) -> None:
        self.free = free


def test_estimates_grow_with_the_job() -> None:
    small = estimate(1000, 10**6, 512, RunConfig(), 2)
    assert estimate(10**6, 10**6, 512, RunConfig(), 2).task > small.task
    assert estimate(1000, 10**6, 1024, RunConfig(), 2).gaussians > small.gaussians
    assert estimate(1000, 10**7, 512, RunConfig(), 2).task == small.task + 9 * 10**6
    assert estimate(1000, 10**6, 512, RunConfig(refine=False), 2).disk < small.disk
    many = RunConfig(blocks="4x4x1")
    assert estimate(1000, 10**6, 512, many, 2).disk == small.disk  # two of them run, and have checkpoints
    assert estimate(1000, 10**6, 512, many, 16).disk > small.disk
    assert fitting(small.task, 10 * small.task) == 9
    assert fitting(small.task, 0) == 1
    assert (gib(3 * 2**30), gib(2**20)) == ("3.0 GiB", "1 MiB")


@pytest.mark.parametrize(("points", "measured"), [(3_850, 22 * 3_850), (19_900, 2 * 19_900)])
def test_estimates_are_no_less_than_what_was_measured(points: int, measured: int) -> None:
    capped = RunConfig.model_validate({"sky": {"count": 0}, "densify": {"max_gaussians": 30_000}})
    free = RunConfig.model_validate({"sky": {"count": 0}})
    assert measured <= estimate(points, 0, 1024, free, 1).gaussians <= 3 * measured
    assert estimate(points, 0, 1024, capped, 1).gaussians == 30_000


def test_decoded_panoramas_count_with_their_layers(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    plain, layered = small_scene(tmp_path / "plain", layers=False), small_scene(tmp_path)
    assert decoded_bytes(plain, 64) == 4 * 3 * 64 * 32
    assert decoded_bytes(layered, 64) == 4 * 9 * 64 * 32


@pytest.mark.parametrize(("limit", "free"), [("max", None), ("1000", 1000 - 600 + 250), ("300", 0)])
def test_memory_respects_a_containers_limit(tmp_path: Path, limit: str, free: int | None) -> None:
    machines = memory(tmp_path)  # no limit at all
    (tmp_path / "memory.max").write_text(limit + "\n")
    (tmp_path / "memory.current").write_text("600\n")
    (tmp_path / "memory.stat").write_text("anon 350\ninactive_file 250\n")
    if free is None:
        assert memory(tmp_path) == pytest.approx(machines, rel=0.5)
    else:
        assert memory(tmp_path) == free


@pytest.mark.parametrize(
    ("quota", "limit"), [("max 100000", 10**6), ("100000 100000", 1), ("50000 100000", 1)]
)
def test_cores_respect_a_containers_quota(tmp_path: Path, quota: str, limit: int) -> None:
    file = tmp_path / "cpu.max"
    file.write_text(quota + "\n")
    assert cores(file) == min(limit, len(os.sched_getaffinity(0)))
