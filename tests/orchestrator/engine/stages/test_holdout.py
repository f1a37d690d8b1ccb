"""A run that trains on all panoramas, and says that it has measured nothing."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.engine.stages.scenes import divided
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.state import ignore
from panolog.scene.read import read_scene
from panolog.workers.calibration import CalibrateSpec
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import NOTHING_HELD_OUT
from panolog.workers.training.trainer import TrainSpec
from tests.orchestrator.calibrated import says
from tests.orchestrator.cli.program import call, shown
from tests.orchestrator.cli.session.test_session import calibrating
from tests.orchestrator.fakes import MACHINE, FakePool, well
from tests.orchestrator.watch.dashboard.browser import opened
from tests.orchestrator.watch.dashboard.served import serving
from tests.scenes import write_scene

FLAGS = {"width": 64, "iterations": 2, "blocks": "2x1x1", "sky.count": 2, "holdout": "none"}
CONFIG = load_config(flags=FLAGS)
SENTENCE = f"{NOTHING_HELD_OUT[0].upper()}{NOTHING_HELD_OUT[1:]}."


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene") / "scene")


@pytest.fixture(scope="module")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    root = tmp_path_factory.mktemp("runs") / "all"
    pool = calibrating()
    session.start(scene, root, CONFIG, None, ignore, pool)
    assert trained_on(pool) == {tuple(range(len(read_scene(scene).panoramas)))}
    return RunFolder(root)


def trained_on(pool: FakePool) -> set[tuple[int, ...]]:
    """The panoramas of each Stage I."""
    specs = [spec for _, spec in pool.started]
    return {spec.views for spec in specs if isinstance(spec, TrainSpec) and spec.cell is None}


def test_what_the_scene_holds_out_trains_too_but_not_what_it_leaves_out(scene: Path) -> None:
    read = read_scene(scene)
    assert read.test and divided(read, load_config()) is read
    count = len(read.panoramas)
    found = divided(read, CONFIG)
    assert (found.train, found.test) == (tuple(range(count)), ())
    assert found.fingerprint == read.fingerprint  # it is that of the scene, for any run
    stems = [panorama.stem for panorama in read.panoramas]
    try:
        (scene / "train.txt").write_text("\n".join(stems[1:3]))
        (scene / "test.txt").write_text(stems[0])
        assert divided(read_scene(scene), CONFIG).train == (0, 1, 2)
    finally:
        (scene / "train.txt").unlink()
        (scene / "test.txt").unlink()


@pytest.mark.system
def test_all_say_that_nothing_is_measured(run: RunFolder) -> None:
    measured = json.loads(run.metrics.read_bytes())
    assert (measured["mean"], measured["views"], measured["unmeasured"]) == ({}, {}, NOTHING_HELD_OUT)
    status = shown("status", run.root)
    assert (status["status"], status["metrics"]) == ("done", {})
    assert NOTHING_HELD_OUT in [notice["message"] for notice in status["notices"]]
    assert NOTHING_HELD_OUT in call("eval", run.root).stdout.splitlines()
    assert shown("eval", run.root) == measured
    run.metrics.unlink()
    resumed = call("resume", run.root)
    assert f"metrics   are missing; `panolog eval {run.root}` measures them again" in resumed.stderr
    for damaged in (
        None,
        '{"mean": ',
        "[]",
        json.dumps({"gaussians": measured["gaussians"], "crop_bottom": 0}),
    ):
        if damaged is not None:
            run.metrics.write_text(damaged)
        assert shown("eval", run.root)["unmeasured"] == NOTHING_HELD_OUT  # measured anew
        assert json.loads(run.metrics.read_bytes()) == measured
    assert not run.images.exists()
    assert call("status", run.root).exit_code == call("events", run.root).exit_code == 0


class KilledError(BaseException):
    """Ends a driver without a record."""


@pytest.mark.system
def test_a_run_that_is_resumed_holds_nothing_out_either(scene: Path, tmp_path: Path) -> None:
    def kill(spec: TaskSpec) -> Iterator[Any]:
        if isinstance(spec, TrainSpec):
            raise KilledError
        yield from says(spec) if isinstance(spec, CalibrateSpec) else well(spec)

    with pytest.raises(KilledError):
        session.start(scene, tmp_path / "run", CONFIG, None, ignore, FakePool(kill, [MACHINE]))
    pool = calibrating()
    session.resume(tmp_path / "run", None, ignore, pool)
    assert trained_on(pool) == {tuple(range(len(read_scene(scene).panoramas)))}


@pytest.mark.system
def test_report_and_page_say_it(browser: Browser, run: RunFolder) -> None:
    with opened(browser, run.report.as_uri()) as page:
        expect(page.locator("#verdict")).to_have_text(SENTENCE)
    with serving(run.root.parent) as server, opened(browser, f"{server.url}/runs/{server.id('all')}") as page:
        expect(page.locator("#quality")).to_contain_text(SENTENCE)
        expect(page.locator("#facts")).to_contain_text("PSNR, held outnot measured")
        expect(page.locator("#log")).to_contain_text("nothing is held out")
