"""`panolog demo`: the whole job on a synthetic place, a small one in minutes on two CPU cores."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from panolog.orchestrator.cli.session import session
from panolog.orchestrator.runs.config import load_config
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.info import check_output, read_info
from panolog.orchestrator.runs.state import OnChange, RunState
from panolog.scene.errors import InputError, RunFolderError
from panolog.scene.write import Progress
from panolog.synthetic.make import make_city, make_flight, make_town

# 30,000 iterations at full size take hours on two cores; these settings run every stage in minutes.
SETTINGS: dict[str, Any] = {
    "recipe": "paper",  # all that it describes, opacity resets too
    "iterations": 500,
    "optimizer.short_runs": 0.5,
    "optimizer.position": 2e-5,  # of the extent: by `short_runs` 60 times that
    "optimizer.position_final": 2e-7,
    "partition.tau_grad": 0.1,
    "reset.every_floor": 200,  # one reset in each stage
    "reset.recovery": 100,
    "densify.until": 20_000,  # some growth after it
    "blocks": "2x1x1",
    "sky.count": 5_000,
    "checkpoint.every": 100,
    "preview.every": 200,
}
_CITY = {  # of `SETTINGS`; all others are those of the recipe
    key: SETTINGS[key] for key in ("iterations", "checkpoint.every", "preview.every")
}
_PANORAMAS = 40  # of a city for each of its blocks
_COMPLETE = "sparse/0/points3D.bin"  # the last file of a scene


@dataclass(frozen=True)
class Demo:
    """A place that is made and reconstructed."""

    title: str  # for people
    ending: str  # of the name of its scene's folder
    make: Callable[..., Path]  # as `make_town`
    arguments: Mapping[str, Any]  # of `make`
    settings: Mapping[str, Any]  # of its run, by dotted key


def demo_of(*, flight: bool = False, city: int | None = None) -> Demo:
    """The town; with `flight` a district from above; with `city` a city of so many panoramas."""
    if city is not None:
        settings = {**_CITY, "blocks": str(max(2, city // _PANORAMAS))}
        ending = f"-city-{city}" + "-flight" * flight
        return Demo("the city", ending, make_city, {"panoramas": city, "flight": flight}, settings)
    if flight:
        arguments = {"blocks": (3, 3), "panoramas": 32, "points": 12_000}
        return Demo("the district", "-district", make_flight, arguments, SETTINGS)
    return Demo("the town", "-town", make_town, {}, SETTINGS)


def make_place(root: Path, demo: Demo, progress: Progress) -> Path:
    """Makes the place next to the run folder `root`, unless it is there already; returns its folder.

    Raises InputError if there is no place next to `root`, or `root` holds something other than a run of it.
    """
    place = root.resolve()  # "." has no name
    if not place.name:
        raise InputError(f"{root}: {demo.title} cannot be written next to it; choose another output folder")
    scene = place.with_name(place.name + demo.ending)
    folder = RunFolder(root)
    if folder.info.exists():
        if not read_info(folder).scene.path.endswith(demo.ending):
            raise RunFolderError(f"{root}: is a run of another scene; choose another output folder")
        return scene
    check_output(root, fingerprint="")  # before the scene is made: the folder holds no run of any scene
    if not (scene / _COMPLETE).exists():
        demo.make(scene, **demo.arguments, progress=progress)
    return scene


def run_demo(scene: Path, root: Path, demo: Demo, address: str | None, on_change: OnChange) -> RunState:
    """Reconstructs the scene into the run folder `root`, or resumes the run that is there.

    Raises as `session.start` and `session.resume`.
    """
    if RunFolder(root).info.exists():
        return session.resume(root, address, on_change)
    return session.start(scene, root, load_config(flags=demo.settings), address, on_change)
