"""`panolog demo`: the whole job on a synthetic place, a small one in minutes on two CPU cores."""

from pathlib import Path
from typing import Any

from panolog.orchestrator.commands import session
from panolog.orchestrator.run.config import load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import check_output, read_info
from panolog.orchestrator.run.state import OnChange, RunState
from panolog.scene.errors import InputError, RunFolderError
from panolog.scene.write import Progress
from panolog.synthetic.make import make_flight, make_town

# 30,000 iterations at full size take hours on two cores; these settings run every stage in minutes.
SETTINGS: dict[str, Any] = {
    "recipe": "paper",  # all that it describes, opacity resets too
    "iterations": 500,
    "optimizer.short_runs": 0.5,
    "partition.tau_grad": 0.1,
    "reset.every_floor": 200,  # one reset in each stage
    "reset.recovery": 100,
    "densify.until": 20_000,  # some growth after it
    "blocks": "2x1x1",
    "sky.count": 5_000,
    "checkpoint.every": 100,
    "preview.every": 200,
}
FLIGHT: dict[str, Any] = {"blocks": (3, 3), "panoramas": 32, "points": 12_000}  # arguments of `make_flight`
_COMPLETE = "sparse/0/points3D.bin"  # the last file of a scene
_TOWN, _DISTRICT = "-town", "-district"  # with which names of scenes end


def make_place(root: Path, progress: Progress, *, flight: bool = False) -> Path:
    """Makes the town (or the flight's district) next to the run folder `root`, unless it is there already.

    Returns its folder. Raises InputError if there is no place next to `root`, or `root` holds something other
    than a run of it.
    """
    place = root.resolve()  # "." has no name
    if not place.name:
        raise InputError(f"{root}: the town cannot be written next to it; choose another output folder")
    mine, other = (_DISTRICT, _TOWN) if flight else (_TOWN, _DISTRICT)
    scene = place.with_name(place.name + mine)
    folder = RunFolder(root)
    if folder.info.exists():
        if read_info(folder).scene.path.endswith(other):
            raise RunFolderError(f"{root}: is a run of the demo's other scene; choose another output folder")
        return scene
    check_output(root, fingerprint="")  # before the scene is made: the folder holds no run of any scene
    if not (scene / _COMPLETE).exists():
        if flight:
            make_flight(scene, **FLIGHT, progress=progress)
        else:
            make_town(scene, progress=progress)
    return scene


def run_demo(scene: Path, root: Path, address: str | None, on_change: OnChange) -> RunState:
    """Reconstructs the scene into the run folder `root`, or resumes the run that is there.

    Raises as `session.start` and `session.resume`.
    """
    if RunFolder(root).info.exists():
        return session.resume(root, address, on_change)
    return session.start(scene, root, load_config(flags=SETTINGS), address, on_change)
