"""From matches to poses and points, by COLMAP's incremental or global mapper."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.sfm.workspace import Workspace
from panolog.scene.write import StageProgress

Mapper = Literal["incremental", "global"]
Pose = tuple[NDArray[np.float64], NDArray[np.float64]]

DIRECT = 1000  # panoramas up to which COLMAP's mapper has a direct solver: the other is slow on a chain
_VERSION = 2  # of what the functions here find: what another version found is not used
_FIRST_ANGLE = 4.0  # degrees between the rays of the first pair: neighbours of a walk have 5 to 20
_GROWTH = 1.2  # of what is adjusted as a whole: COLMAP's 1.1 takes a third longer and ends in the same poses
_NEVER = 10**9
_WIDER = 4.0, 1.0, 1.0  # times the bound of errors, one adjustment after the other
_LOOSE = 0.25  # of the bound of errors: Cauchy's scale
_MANY = 100  # panoramas that see a point: fewer are no work for the solver, however far it is
_FAR = 0.15  # of its distance: how far apart those are that see a point, which says little of where they are
_LEAST = 12  # points of a pose: the pairs are known to agree, and COLMAP's 30 break a thin chain


def map_pairs(
    work: Workspace,
    mapper: Mapper,
    max_error: float,
    progress: StageProgress,
    known: pycolmap.Reconstruction | None,
) -> list[pycolmap.Reconstruction]:
    """The reconstructions from the verified pairs of a database, that of most panoramas first.

    Args: max_error, pixels that an observation may be away from its point; known, a reconstruction of some of
    them, that of others is added to: its poses stay.
    """
    work.clear_models()
    if known is not None:
        known.write(work.models)

    def find() -> list[pycolmap.Reconstruction]:
        progress("poses", 0, len(work.numbers))
        found = _global(work) if mapper == "global" else _incremental(work, progress, max_error, known)
        return sorted(found, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))

    models = work.once([_VERSION, mapper, max_error], sorted(work.models.iterdir()), find)
    progress("poses", len(work.numbers), len(work.numbers))
    if work.sketcher is not None and models:
        work.sketcher.add(models[0], work.numbers)
    return models


def adjust_poses(
    work: Workspace,
    model: pycolmap.Reconstruction,
    poses: Mapping[int, Pose],
    max_error: float,
    *,
    last: bool = False,
) -> pycolmap.Reconstruction | None:
    """A model adjusted to the verified pairs of a database; None if these give no points with its poses.

    Its poses may be off by what drifts between neighbours: points are found with a wider bound first, but
    not the last time.
    Args: model, of panoramas of the database; poses, of its rows, in place of those of the model: world to
    camera (3, 3) and (3,), others are left out; max_error, pixels that an observation may be away from its
    point; last, loops are closed and poses right: what fits badly counts for less.
    """
    placed = [(row, *(part.tobytes() for part in poses[row])) for row in sorted(poses)]

    def adjust() -> list[pycolmap.Reconstruction]:
        adjusted = _adjusted(work, model, poses, max_error, last)
        return [] if adjusted is None else [adjusted]

    return next(iter(work.once([_VERSION, placed, max_error, last], [], adjust)), None)


def _adjusted(
    work: Workspace,
    model: pycolmap.Reconstruction,
    poses: Mapping[int, Pose],
    max_error: float,
    last: bool,
) -> pycolmap.Reconstruction | None:
    """The model that `adjust_poses` returns."""
    model, ids = pycolmap.Reconstruction(model), work.ids()
    for number in set(model.reg_image_ids()) - {ids[row] for row in poses}:
        model.deregister_frame(model.image(number).frame_id)
    for row, pose in poses.items():
        image = model.image(ids[row])
        moved = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[0]), pose[1])
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, moved)
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = adjustment.refine_focal_length = adjustment.refine_extra_params = False
    adjustment.ceres.solver_options.num_threads = 1
    adjustment.ceres.max_num_images_direct_sparse_cpu_solver = _NEVER
    if last:
        adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        adjustment.ceres.loss_function_scale = _LOOSE * max_error
    for wider in _WIDER[last:]:
        options = _options(wider * max_error, large=len(poses) > DIRECT)
        options.triangulation.create_max_angle_error *= wider
        options.triangulation.continue_max_angle_error *= wider
        work.clear_models()
        try:
            model = pycolmap.triangulate_points(
                model, work.database, work.images, work.models, options=options
            )
        except (RuntimeError, ValueError):
            return None
        _drop_far(model)
        if not model.num_points3D():
            return None
        config = pycolmap.BundleAdjustmentConfig()
        for number in model.reg_image_ids():
            config.add_image(number)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # `pycolmap.bundle_adjustment` does the same, but turns COLMAP's log on.
        pycolmap.create_default_bundle_adjuster(adjustment, config, model).solve()
    return model


def _drop_far(model: pycolmap.Reconstruction) -> None:
    """Deletes points that many panoramas see in almost one direction, such as of clouds.

    Each makes all panoramas that see it neighbours of each other in the solver: of 3,000, a solution that
    takes less than a second then takes minutes.
    """
    centers = {it.image_id: it.projection_center() for it in model.images.values() if it.has_pose}
    far = []
    for number, point in model.points3D.items():
        if point.track.length() > _MANY:
            seen = np.array([centers[it.image_id] for it in point.track.elements])
            distance = float(np.linalg.norm(point.xyz - seen.mean(axis=0)))
            far += [number] if np.linalg.norm(np.ptp(seen, axis=0)) < _FAR * distance else []
    for number in far:
        model.delete_point3D(number)


def _options(max_error: float, *, large: bool) -> pycolmap.IncrementalPipelineOptions:
    """Options of the mapper.

    Args: max_error, pixels that an observation may be away from its point; large, `_adjusted` adjusts the
    whole: COLMAP takes half of the time for what that does again.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.random_seed = 0
    # Ceres sums in the order in which its threads end: with several, equal matches give other poses.
    options.num_threads = options.mapper.num_threads = 1
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    options.mapper.filter_max_reproj_error = max_error
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = max_error
    if large:
        options.ba_global_max_refinements = options.ba_global_max_num_iterations = 1  # the least
    return options


def _incremental(
    work: Workspace, progress: StageProgress, max_error: float, known: pycolmap.Reconstruction | None
) -> list[pycolmap.Reconstruction]:
    large = len(work.numbers) > DIRECT
    options = _options(max_error, large=large)
    options.min_model_size = 2
    # By default COLMAP starts from no pair that moves along the optical axis, nor from one below 16 degrees.
    # A panorama has no such axis: of a walk along its z, only pairs misled by repetition would be left.
    options.mapper.init_max_forward_motion = 1.0
    options.mapper.init_min_tri_angle = _FIRST_ANGLE
    options.mapper.abs_pose_min_num_inliers = _LEAST
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _NEVER if large else _GROWTH
    if large:
        options.ba_global_frames_freq = options.ba_global_points_freq = _NEVER
    models, done = pycolmap.ReconstructionManager(), 2
    if known is not None:
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

    options.image_path = work.images
    with pycolmap.Database.open(work.database) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, models)
    pipeline.add_callback(pycolmap.IncrementalPipelineCallback.NEXT_IMAGE_REG_CALLBACK, another)
    pipeline.run()
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


def _global(work: Workspace) -> list[pycolmap.Reconstruction]:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = 0
    options.num_threads = options.mapper.num_threads = 1  # see above
    options.mapper.global_positioning.use_gpu = options.mapper.bundle_adjustment.ceres.use_gpu = False
    return list(pycolmap.global_mapping(work.database, work.images, work.models, options).values())
