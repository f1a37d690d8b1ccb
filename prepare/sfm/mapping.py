"""From matches to poses and points, by COLMAP's incremental or global mapper."""

import shutil
from typing import Literal

import pycolmap

from panolog.prepare.sfm.contradictions import Contradiction, find_contradictions
from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

Mapper = Literal["incremental", "global"]
Mapped = tuple[pycolmap.Reconstruction, list[Contradiction]]

_FIRST_ANGLE = 4.0  # degrees between the rays of the first pair: neighbours of a walk have 5 to 20
_TRIES = 3  # of other first pairs, while the result contradicts its matches


def map_panoramas(
    work: Workspace, mapper: Mapper, max_error: float, progress: StageProgress
) -> Mapped | None:
    """The reconstruction of most panoramas that contradicts its matches least; None if there is none.

    The result depends on the first pair. If the reconstruction contradicts the pairs that share most, the
    mapper starts again from the strongest of these.

    Args: max_error, pixels that an observation may be away from its point.
    """
    shutil.rmtree(work.models, ignore_errors=True)
    work.models.mkdir(parents=True)
    if mapper == "global":
        return _best(work, _global(work, progress))
    best = _best(work, _incremental(work, max_error, progress, None))
    tried: set[tuple[int, int]] = set()
    while best is not None and best[1] and len(tried) < _TRIES:
        first = next((pair.between for pair in best[1] if pair.between not in tried), None)
        if first is None:
            break
        tried.add(first)
        again = _best(work, _incremental(work, max_error, progress, first))
        if again is not None and _rank(again) > _rank(best):
            best = again
    return best


def _best(work: Workspace, models: list[pycolmap.Reconstruction]) -> Mapped | None:
    """The largest model, with its contradictions."""
    if not models:
        return None
    model = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    return model, find_contradictions(work, model)


def _rank(mapped: Mapped) -> tuple[int, int, int]:
    model, contradictions = mapped
    return int(model.num_reg_images()), -len(contradictions), int(model.num_points3D())


def _incremental(
    work: Workspace, max_error: float, progress: StageProgress, first: tuple[int, int] | None
) -> list[pycolmap.Reconstruction]:
    """Args: first, rows of the panoramas to begin with; COLMAP chooses if None."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.extract_colors = False
    options.random_seed = 0
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.filter_max_reproj_error = max_error
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = max_error
    # By default COLMAP starts from no pair that moves along the optical axis, nor from one below 16 degrees.
    # A panorama has no such axis: of a walk along its z, only pairs misled by repetition would be left.
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_tri_angle = _FIRST_ANGLE
    if first is not None:
        ids = work.ids()
        options.init_image_id1, options.init_image_id2 = ids[first[0]], ids[first[1]]
    done = 2

    def another() -> None:
        nonlocal done
        done = min(done + 1, len(work.numbers))
        progress("poses", done, len(work.numbers))

    progress("poses", 0, len(work.numbers))
    found = pycolmap.incremental_mapping(
        work.database, work.images, work.models, options, next_image_callback=another
    )
    progress("poses", len(work.numbers), len(work.numbers))
    return list(found.values())


def _global(work: Workspace, progress: StageProgress) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    progress("poses", 0, len(work.numbers))
    found = list(pycolmap.global_mapping(work.database, work.images, work.models, options).values())
    progress("poses", len(work.numbers), len(work.numbers))
    return found
