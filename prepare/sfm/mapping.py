"""From matches to poses and points, by COLMAP's incremental or global mapper."""

import shutil
from typing import Literal

import numpy as np
import pycolmap

from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

Mapper = Literal["incremental", "global"]

_FIRST_ANGLE = 4.0  # degrees between the rays of the first pair: neighbours of a walk have 5 to 20
_GROWTH = 1.2  # of what is adjusted as a whole: COLMAP's 1.1 takes a third longer and ends in the same poses
_LEAST = (
    12  # points that a pose is found by: the pairs are known to agree, and COLMAP's 30 break a thin chain
)


def map_pairs(
    work: Workspace,
    mapper: Mapper,
    max_error: float,
    progress: StageProgress,
    known: pycolmap.Reconstruction | None,
) -> pycolmap.Reconstruction | None:
    """The reconstruction of most panoramas from the verified pairs of a database; None if there is none.

    Args: max_error, pixels that an observation may be away from its point; known, a reconstruction of some of
    them, that of others is added to: its poses stay.
    """
    shutil.rmtree(work.models, ignore_errors=True)
    work.models.mkdir(parents=True)
    models = _global(work, progress) if mapper == "global" else _incremental(work, progress, max_error, known)
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _incremental(
    work: Workspace, progress: StageProgress, max_error: float, known: pycolmap.Reconstruction | None
) -> list[pycolmap.Reconstruction]:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.extract_colors = False
    options.random_seed = 0
    # Ceres sums in the order in which its threads end: with several, equal matches give other poses.
    options.num_threads = options.mapper.num_threads = 1
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.filter_max_reproj_error = max_error
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = max_error
    # By default COLMAP starts from no pair that moves along the optical axis, nor from one below 16 degrees.
    # A panorama has no such axis: of a walk along its z, only pairs misled by repetition would be left.
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_tri_angle = _FIRST_ANGLE
    options.mapper.abs_pose_min_num_inliers = _LEAST
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    models, done = pycolmap.ReconstructionManager(), 2
    if known is not None:
        known.write(work.models)
        models.read(work.models)
        options.fix_existing_frames = options.load_all_images = True
        options.structure_less_registration_fallback = False  # it needs no points, and so finds no scale
        options.multiple_models, done = False, known.num_reg_images()

    def another() -> None:
        nonlocal done
        done = min(done + 1, len(work.numbers))
        progress("poses", done, len(work.numbers))
        if work.sketcher is not None:
            work.sketcher.add(models.get(models.size() - 1), work.numbers)

    progress("poses", 0, len(work.numbers))
    options.image_path = work.images
    with pycolmap.Database.open(work.database) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, models)
    pipeline.add_callback(pycolmap.IncrementalPipelineCallback.NEXT_IMAGE_REG_CALLBACK, another)
    pipeline.run()
    progress("poses", len(work.numbers), len(work.numbers))
    if known is not None:
        _put_back(models.get(0), known)
    return [models.get(number) for number in range(models.size())]


def _put_back(model: pycolmap.Reconstruction, known: pycolmap.Reconstruction) -> None:
    """Undoes COLMAP's normalisation of a model that has those of `known`: a shift and a scale."""
    posed = [image.image_id for image in known.images.values() if image.has_pose]
    before, after = (
        np.array([it.image(number).projection_center() for number in posed]) for it in (known, model)
    )
    sizes = [float(np.linalg.norm(centers - centers.mean(axis=0))) for centers in (before, after)]
    scale = sizes[0] / sizes[1]
    shift = before.mean(axis=0) - scale * after.mean(axis=0)
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), shift))


def _global(work: Workspace, progress: StageProgress) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1  # see above
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    progress("poses", 0, len(work.numbers))
    found = list(pycolmap.global_mapping(work.database, work.images, work.models, options).values())
    progress("poses", len(work.numbers), len(work.numbers))
    return found
