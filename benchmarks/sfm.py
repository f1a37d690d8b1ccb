"""Poses from panoramas: `panolog scene sfm` compared with COLMAP's defaults, against known poses.

    python -m benchmarks.sfm SCENE [--json]

SCENE has panoramas and a model whose poses are taken as true. Both ways get only the panoramas and run on all
cores. COLMAP's way: features in the equirectangular picture, each matched with each, its incremental mapper,
no option changed but the camera model.
"""

import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import report
from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.reconstruct import reconstruct
from panolog.prepare.sfm.sparse_model import SparseModel, from_colmap
from panolog.prepare.sfm.workspace import Workspace, silence_colmap
from panolog.scene.model import Scene
from panolog.scene.read import read_scene
from panolog.scene.write import no_progress
from tests.prepare.sfm.accuracy import drift, length

Array = NDArray[np.float64]
HEAD = (
    "way",
    "registered",
    "rms, % of the way",
    "worst step",
    "pixels off",
    "contradictions",
    "seconds",
    "CPU seconds",
)


@dataclass(frozen=True)
class Accuracy:
    """One way of finding the poses."""

    name: str
    registered: int
    drift: float | None  # percent of the trajectory's length, rms after the best similarity
    step: float | None  # between neighbours, over the true one and the median of that, at worst
    error: float | None  # pixels, mean over the observations
    contradictions: int | None  # pairs that share many features but few points; None where not checked
    seconds: float
    cpu: float  # of this process and of those that it started: other load does not count


def measure(scene: Scene) -> list[Accuracy]:
    """Both ways. Raises InputError if the panoramas do not come together."""
    panoramas = tuple(PanoramaFile(scene.root, it.name, it.image) for it in scene.panoramas)
    return [_plain(scene, panoramas), _ours(scene, panoramas)]


def _ours(scene: Scene, panoramas: Sequence[PanoramaFile]) -> Accuracy:
    with tempfile.TemporaryDirectory(prefix="sfm-") as folder:
        begin = clocks()
        found = reconstruct(
            panoramas,
            {},
            Path(folder),
            pairing="auto",
            mapper="incremental",
            partial=True,
            progress=no_progress,
        )[0]
        spent = clocks() - begin
    return _accuracy("panolog scene sfm", scene, found.model, len(found.contradictions), spent)


def _plain(scene: Scene, panoramas: tuple[PanoramaFile, ...]) -> Accuracy:
    begin = clocks()
    found = by_colmap(panoramas, (scene.width, scene.height))["incremental"]
    spent = clocks() - begin
    if found is None:
        return Accuracy("COLMAP", 0, None, None, None, None, *spent.tolist())
    return _accuracy("COLMAP", scene, found, None, spent)


def by_colmap(
    panoramas: tuple[PanoramaFile, ...], size: tuple[int, int], mappers: Sequence[str] = ("incremental",)
) -> dict[str, SparseModel | None]:
    """The largest reconstruction of panoramas by COLMAP's defaults, of each mapper; size, (width, height)."""
    import pycolmap  # noqa: PLC0415

    made: dict[str, SparseModel | None] = dict.fromkeys(mappers)
    with tempfile.TemporaryDirectory(prefix="sfm-") as folder, silence_colmap():
        work = Workspace(Path(folder), panoramas)
        work.open(None)
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "EQUIRECTANGULAR"
        pycolmap.extract_features(
            work.database, work.images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
        )
        pycolmap.match_exhaustive(work.database)
        for mapper in mappers:
            run = pycolmap.global_mapping if mapper == "global" else pycolmap.incremental_mapping
            models = run(work.database, work.images, work.models)
            if models:
                best = max(models.values(), key=lambda model: model.num_reg_images())
                made[mapper] = from_colmap(best, work.numbers, size)
    return made


def clocks() -> Array:
    """(2,) seconds: of the clock, and of all cores on this process and the ended ones that it started."""
    own, ended = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return np.array([time.perf_counter(), own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime])


def _accuracy(
    name: str, scene: Scene, found: SparseModel, contradictions: int | None, spent: Array
) -> Accuracy:
    truth = scene.centers[list(found.rows)]
    steps = np.linalg.norm(np.diff(found.centers, axis=0), axis=1)
    ratios = steps / np.linalg.norm(np.diff(truth, axis=0), axis=1)
    ratios /= np.median(ratios)
    worst = float(np.exp(np.abs(np.log(ratios)).max()))
    error = float(np.concatenate(found.errors(scene.width)).mean())
    percent = 100 * drift(found.centers, truth) / length(truth)
    return Accuracy(name, len(found.rows), percent, worst, error, contradictions, *spent.tolist())


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("sfm", __doc__, quick=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="panoramas with known poses")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        results = measure(read_scene(options.scene))
        table = report.markdown(HEAD, [astuple(turn) for turn in results])
        return report.Report({"results": [asdict(turn) for turn in results]}, table)

    return report.run("sfm", options, work)


if __name__ == "__main__":
    sys.exit(main())
