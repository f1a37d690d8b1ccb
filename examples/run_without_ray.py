"""Reconstructs a scene without Ray: all stages, each task in a process of its own on this machine.

    python examples/run_without_ray.py SCENE RUN --set iterations=2000 --set width=512

`panolog status RUN`, `panolog stop RUN` and `panolog resume RUN` work on it as on every run.
"""

import argparse
import os
import socket
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import panolog
from panolog.orchestrator.driver.driver import Driver, Hooks
from panolog.orchestrator.driver.job import Job
from panolog.orchestrator.driver.local_pool import local_pool
from panolog.orchestrator.run import control, lock
from panolog.orchestrator.run.config import change, load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import SceneRef, check_output, make_info, write_info
from panolog.orchestrator.run.records import RunBegan, Stored
from panolog.orchestrator.run.state import RunState
from panolog.orchestrator.run.store import Database
from panolog.renderer.process import choose_device


def show(_: RunState, news: Sequence[Stored]) -> None:
    """Prints what happens, except for progress."""
    for stored in news:
        name = type(stored.record).__name__
        if name not in ("Progressed", "PreviewSaved", "CheckpointSaved"):
            print(f"{stored.record.task or 'run'}: {name}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs to the end and prints the metrics."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("run", metavar="RUN", type=Path)
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="a setting of a run")
    options = parser.parse_args(arguments)

    scene, folder = panolog.read_scene(options.scene), RunFolder(options.run)
    config = load_config(sets=options.set)
    config = change(config, {"device": choose_device(config.device), "width": config.width or scene.width})
    check_output(folder.root, scene.fingerprint)
    folder.root.mkdir(parents=True, exist_ok=True)
    with lock.hold(folder.lock), closing(Database(folder.database)) as database, local_pool() as pool:
        write_info(folder, make_info(SceneRef(path=str(scene.root), fingerprint=scene.fingerprint), config))
        database.append(control.begin(folder))
        driver = Driver(Job(folder, scene, config), database, pool, Hooks(on_change=show))
        state = driver.run(RunBegan(socket.gethostname(), os.getpid(), resumed=False))
    print(state.metrics)


if __name__ == "__main__":
    main()
