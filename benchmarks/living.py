"""What a run shows while Stage I trains: how soon, and what that costs the training.

    python -m benchmarks.living SCENE [--iterations N] [--width N] [--shots FOLDER]
    python -m benchmarks.living SCENE --cost [--iterations N] [--width N]

The first command runs a scene with its dashboard open in Chromium, and prints the seconds until a point is on
the map, a picture is there, and the 3D view that the page offers has been drawn; then how often it changed.

The second trains Stage I twice in one process, in turns of some iterations: with all that is shown, which it
sends and stores as a driver does, and with nothing. Both do the same to the model, which must end with the
same bytes, so that the time of a turn less that of its twin is what showing has cost, whatever else the
machine does meanwhile.
"""

import argparse
import os
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Condition, Thread
from unittest.mock import Mock, patch

import torch
from playwright.sync_api import Page, ViewportSize

from panolog.orchestrator.engine.driver.job import Job, Specs
from panolog.orchestrator.engine.driver.saving import save
from panolog.orchestrator.engine.scheduling.pool import InProcess
from panolog.orchestrator.runs.config import RunConfig, load_config
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.machines.machine import cores
from panolog.renderer.process import prepare
from panolog.scene.gaussians import Gaussians
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.workers.events import Preview, Trained
from panolog.workers.showing.previews import PreviewClock
from panolog.workers.tasks import COARSE
from panolog.workers.training import trainer
from panolog.workers.training.task_config import PreviewConfig
from panolog.workers.training.trainer import TrainSpec, train
from tests.export.browser import SOFTWARE
from tests.orchestrator.watch.dashboard.browser import chromium

_TURN = 20  # iterations
_NOTHING = PreviewConfig(every=10**9)
_WAIT_S = 600.0
_WINDOW: ViewportSize = {"width": 1440, "height": 1000}


def load() -> str:
    """The load of the machine, as `uptime` has it."""
    return "load " + ", ".join(f"{value:.1f}" for value in os.getloadavg())


@contextmanager
def dashboard_of(command: list[str]) -> Iterator[str]:
    """The address of the dashboard of a run that is started; the run is ended afterwards."""
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as run:
        assert run.stderr is not None
        try:
            for line in run.stderr:
                if found := re.search(r"http://[0-9.:]+\S*", line):
                    Thread(target=run.stderr.read, daemon=True).start()
                    yield found[0]
                    return
            raise SystemExit("the run has shown no dashboard")
        finally:
            run.terminate()
            run.wait()


def watch(scene: Path, root: Path, options: argparse.Namespace) -> None:
    """Prints how soon a run of a scene shows something."""
    given = ["--iterations", str(options.iterations), "--width", str(options.width)]
    command = [sys.executable, "-m", "panolog.orchestrator.cli", "run", str(scene), "-o", str(root), *given]
    with ExitStack() as stack:
        context = stack.enter_context(chromium(SOFTWARE)).new_context(viewport=_WINDOW)  # as people have one
        context.set_default_timeout(1000 * _WAIT_S)
        page, began = context.new_page(), time.monotonic()

        def say(what: str) -> None:
            print(f"{time.monotonic() - began:6.1f} s  {what} ({load()})", flush=True)

        say("start")
        url = stack.enter_context(dashboard_of([*command, "--dashboard"]))
        say("the dashboard's address")
        page.goto(url)
        if page.locator("#runs a").count():
            page.locator("#runs a").first.click()
        page.locator("#map-plot .points").wait_for(state="attached")
        say("points and cameras on the map")
        shot(page, options.shots, "map")
        page.locator("#stage .compare:visible, #stage canvas:visible, #stage img:visible").first.wait_for()
        say("the first picture: " + page.locator("#stage .frames p").inner_text())
        shot(page, options.shots, "picture")
        with context.expect_page() as opened:
            page.locator("#actions").get_by_role("button", name="3D view").click()
        view = opened.value
        view.locator("html[data-state=ready]").wait_for(state="attached")
        say("the first 3D view: " + view.locator("#count").inner_text())
        shot(view, options.shots, "view")
        for number in range(options.changes):
            before = view.locator("#count").inner_text()
            changed = "text => document.querySelector('#count').textContent !== text"
            view.wait_for_function(changed, arg=before)
            say("the next: " + view.locator("#count").inner_text())
            shot(view, options.shots, f"view-{number}")


def shot(page: Page, folder: Path | None, name: str) -> None:
    """A picture of a page, if those are wanted."""
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        page.screenshot(path=folder / f"{name}.png")


def spec_of(scene: Scene, folder: RunFolder, config: RunConfig, *, shows: bool) -> TrainSpec:
    """Stage I of a run, that shows itself or nothing."""
    spec = Specs(Job(folder, scene, config), InProcess()).of(COARSE)
    assert isinstance(spec, TrainSpec)
    return spec if shows else replace(spec, config=config.model_copy(update={"preview": _NOTHING}))


def clock_of(every: int, seconds: float) -> PreviewClock:
    """The clock of a training, which is never due for one that shows no picture but the last."""
    clock = PreviewClock(every, seconds)
    return Mock(wraps=clock, due=lambda _: False) if every == _NOTHING.every else clock


class Turns:
    """Two trainings of the same model that take turns: while one is at work the other waits."""

    def __init__(self) -> None:
        self._baton, self._next = Condition(), 0
        self.seconds, self.cpu = [0.0, 0.0], [0.0, 0.0]
        self.iterations, self.pictures = [0, 0], [0, 0]
        self.models: list[Gaussians | None] = [None, None]
        self._over = [False, False]

    def run(self, number: int, spec: TrainSpec, scene: Scene, folder: RunFolder) -> None:
        """One of them, in a thread: number 0 or 1; folder, where what it sends is stored."""
        try:
            self._train(number, spec, scene, folder)
        finally:
            with self._baton:
                self._over[number] = True
                self._baton.notify_all()

    def _train(self, number: int, spec: TrainSpec, scene: Scene, folder: RunFolder) -> None:
        began = self._take(number)

        def stop() -> bool:
            nonlocal began
            self.iterations[number] += 1
            if self.iterations[number] % _TURN == 0:
                self._give(number, began)
                began = self._take(number)
            return False

        for event in train(spec, stop):
            sent = pickle.loads(pickle.dumps(event))  # our own
            if isinstance(sent, Preview):
                self.pictures[number] += 1
                save(folder, sent, scene)
            if isinstance(sent, Trained):
                self.models[number] = sent.gaussians
        self._give(number, began)

    def _take(self, number: int) -> tuple[float, float]:
        with self._baton:
            self._baton.wait_for(lambda: self._next == number or self._over[1 - number])
        return time.perf_counter(), time.process_time()

    def _give(self, number: int, began: tuple[float, float]) -> None:
        self.seconds[number] += time.perf_counter() - began[0]
        self.cpu[number] += time.process_time() - began[1]
        with self._baton:
            self._next = 1 - number
            self._baton.notify_all()


def cost(path: Path, root: Path, options: argparse.Namespace) -> None:
    """Prints what showing has cost a training."""
    flags = {"iterations": options.iterations, "width": options.width, "device": "cpu"}
    scene, config, turns = read_scene(path), load_config(flags=flags), Turns()
    prepare(cores())
    threads = list[Thread]()
    for number, shows in enumerate((True, False)):
        folder = RunFolder(root / str(number))
        folder.root.mkdir(parents=True)
        spec = spec_of(scene, folder, config, shows=shows)
        threads.append(Thread(target=turns.run, args=(number, spec, scene, folder)))
    with patch.object(trainer, "PreviewClock", clock_of):
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    first, second = turns.models
    assert first is not None and second is not None, "a training has failed"
    same = all(torch.equal(first.tensors()[name], tensor) for name, tensor in second.tensors().items())
    (shown, plain), (busy, idle) = turns.seconds, turns.cpu
    print(f"{options.iterations} iterations at width {options.width}, {len(first):,} Gaussians, {load()}")
    print(f"{turns.pictures[0]} pictures with snapshots: {shown:.1f} s, {turns.pictures[1]}: {plain:.1f} s")
    print(f"slower by {shown / plain - 1:.2%} of time, {busy / idle - 1:.2%} of CPU")
    print("the models are equal to the byte" if same else "THE MODELS DIFFER")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--width", type=int, default=512)
    parser.add_argument("--cost", action="store_true", help="measure what showing costs")
    parser.add_argument("--changes", type=int, default=3, help="of the 3D view that are awaited")
    parser.add_argument("--shots", type=Path, help="folder for pictures of the pages")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="panolog-living-") as folder:
        (cost if options.cost else watch)(options.scene, Path(folder) / "run", options)


if __name__ == "__main__":
    main()
