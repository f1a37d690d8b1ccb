"""What was measured of a run: metrics of held-out panoramas, seams between blocks, poses and movers."""

from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import Field

from panolog.orchestrator.runs.folder import RunFolder, is_below
from panolog.orchestrator.watch.views.block_colors import SEAM_GRADES, seam_grade
from panolog.orchestrator.watch.views.comparison.measured import MEASURED_ANEW, read_seams
from panolog.orchestrator.watch.views.preparation import version_of
from panolog.orchestrator.watch.views.summary import Text, ViewModel
from panolog.workers.seams.schema import Seam

_MOST = 200_000_000  # bytes of a file at most
_WITHOUT = "put back a copy of it, or remove it to see the run without it"
_FACES = 3  # between blocks with pictures: the worst
_MOVERS = 6  # panoramas with pictures: those with the largest movers
_SEAM_PICTURES = ("truth.jpg", "merged.jpg", "below.jpg", "above.jpg", "face.png")

Metrics = dict[str, float | None]
_Share = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_File = TypeVar("_File", bound=ViewModel)


class PoseFit(ViewModel):
    """Metrics of held-out panoramas at the poses that fit the model best, `pixels` away on average."""

    mean: Metrics


class HeldOutMetrics(ViewModel):
    """The metrics of held-out panoramas, and their means; `lpips_reason`, why there is no LPIPS.

    Or `unmeasured`, why there are none.
    """

    mean: Metrics = Field(default_factory=dict)
    views: dict[str, Metrics] = Field(default_factory=dict)
    pose_fit: PoseFit | None = None
    lpips_reason: Text | None = None
    unmeasured: Text | None = None


class MovedCamera(ViewModel):
    """A refined camera: how far it moved in world units, turned in degrees, and moved what it sees."""

    name: Text
    moved: _Share
    turned: _Share
    pixels: _Share
    at_bound: bool


class MoverShare(ViewModel):
    """A training panorama, and what part of it is left out of the loss because it moves, 0 to 1."""

    name: Text
    share: _Share


class Findings(ViewModel):
    """GET …/findings: the worst first, `colors` of the seams; `pictures` are names for …/findings/{name}."""

    metrics: HeldOutMetrics | None
    seams: tuple[Seam, ...]
    colors: tuple[str | None, ...]
    moves: tuple[MovedCamera, ...]
    movers: tuple[MoverShare, ...]
    pictures: tuple[str, ...]


class _PosesFile(ViewModel):
    panoramas: tuple[MovedCamera, ...] = ()


class _MoversFile(ViewModel):
    panoramas: tuple[MoverShare, ...] = ()


def findings_version(folder: RunFolder) -> str:
    """A text that changes with the findings."""
    files = (folder.metrics, folder.seams, folder.poses, folder.mover_shares)
    return " ".join(version_of(path) or "-" for path in files)


def read_findings(folder: RunFolder) -> Findings:
    """The findings of a run; empty where there are none yet.

    Raises InputError if a file is damaged, or not below the run.
    """

    def parsed(kind: type[_File], path: Path, way: str) -> _File | None:
        return folder.parsed(path, _MOST, kind.model_validate_json, way) if path.exists() else None

    poses = parsed(_PosesFile, folder.poses, _WITHOUT) or _PosesFile()
    shares = parsed(_MoversFile, folder.mover_shares, _WITHOUT) or _MoversFile()
    seams = read_seams(folder)
    found = Findings(
        metrics=parsed(HeldOutMetrics, folder.metrics, MEASURED_ANEW),
        seams=seams,
        colors=tuple(None if face.seam is None else SEAM_GRADES[seam_grade(face.seam)][1] for face in seams),
        moves=tuple(sorted(poses.panoramas, key=lambda camera: -camera.pixels)),
        movers=tuple(sorted(shares.panoramas, key=lambda mover: (-mover.share, mover.name))),
        pictures=(),
    )
    return found.model_copy(update={"pictures": tuple(finding_pictures(folder, found))})


def finding_pictures(folder: RunFolder, found: Findings) -> dict[str, Path]:
    """The pictures of the worst faces and of the largest movers, by their names, of those that there are."""
    paths = {}
    for face in found.seams[:_FACES]:
        below, above = face.blocks
        for name in _SEAM_PICTURES:
            paths[f"seam-{below}-{above}-{name}"] = folder.seam(below, above) / name
    for number, mover in enumerate(found.movers[:_MOVERS]):
        paths[f"mover-{number}.jpg"] = folder.mover_picture(mover.name)
    own = folder.movers, folder.seams.parent
    return {name: path for name, path in paths.items() if is_below(path, *own)}
