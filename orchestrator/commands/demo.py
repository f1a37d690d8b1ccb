"""`panolog demo`: the whole job on a small synthetic town, in minutes on two CPU cores."""

from pathlib import Path
from typing import Any

from panolog.orchestrator.commands import session
from panolog.orchestrator.run.config import load_config
from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.info import check_output
from panolog.orchestrator.run.state import OnChange, RunState
from panolog.scene.errors import InputError
from panolog.scene.write import Progress
from panolog.synthetic.make import make_town

# 30,000 iterations at full size take hours on two cores; these settings run every stage in minutes.
SETTINGS: dict[str, Any] = {
    "iterations": 600,
    "blocks": "2x1x1",
    "sky.count": 5_000,
    "checkpoint.every": 100,
    "preview.every": 200,
}
_COMPLETE = "sparse/0/points3D.bin"  # the last file of the town


def make_place(root: Path, progress: Progress) -> Path:
    """Makes the town next to the run folder `root`, unless it is there already; returns its folder.

    Raises InputError if there is no place next to `root`, or `root` holds something other than a run.
    """
    place = root.resolve()  # "." has no name
    if not place.name:
        raise InputError(f"{root}: the town cannot be written next to it; choose another output folder")
    town = place.with_name(f"{place.name}-town")
    if RunFolder(root).info.exists():
        return town
    check_output(root, fingerprint="")  # before the town is made: the folder holds no run of any scene
    if not (town / _COMPLETE).exists():
        make_town(town, progress=progress)
    return town


def run_demo(town: Path, root: Path, address: str | None, on_change: OnChange) -> RunState:
    """Reconstructs the town into the run folder `root`, or resumes the run that is there.

    Raises as `session.start` and `session.resume`.
    """
    if RunFolder(root).info.exists():
        return session.resume(root, address, on_change)
    return session.start(town, root, load_config(flags=SETTINGS), address, on_change)
