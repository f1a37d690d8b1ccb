"""Poses and points that agree with the observations: COLMAP's bundle adjustment of a scene as it is."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.check.evidence import Array, Tracks
from panolog.prepare.check.residuals import measure_residuals
from panolog.renderer.motion import Common
from panolog.scene.colmap import Observations
from panolog.scene.colmap_files import EQUIRECTANGULAR
from panolog.scene.model import Scene

if TYPE_CHECKING:
    import pycolmap

POSES_OFF = 2.0  # from this gain on poses were off, and not only the observations that they were found by
_SEAM = 0.02  # of the width: observations nearer to the edge may be projected to the other one
_POLE = 0.08  # of the height: about straight up and down, pixels are too narrow to be counted
_ROUNDS, _TOLERANCE = 50, 1e-6  # of Ceres: most steps, and the relative gain of the last one
_LOOSE = 2.0  # of Cauchy's scale by the median residual, so that large errors are pulled in


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A scene after its adjustment, in the frame of the one before."""

    poses: Array  # (K, 3, 4) rotation and translation, as `Panorama`
    points: Array  # (P, 3) world units
    before: Array  # (K,) residuals as `measure_residuals`
    after: Array  # (K,)

    @property
    def gain(self) -> float:
        """By which factor the median panorama's residual has shrunk; 1 where none is known."""
        known = np.isfinite(self.before)
        if not known.any():
            return 1.0
        return float(np.median(self.before[known]) / max(np.median(self.after[known]), 1e-6))

    def applied(self, scene: Scene) -> Scene:
        """The scene with these poses and points."""
        panoramas = tuple(
            replace(panorama, rotation=pose[:, :3].copy(), translation=pose[:, 3].copy())
            for panorama, pose in zip(scene.panoramas, self.poses, strict=True)
        )
        return replace(scene, panoramas=panoramas, points=self.points)


def adjust(scene: Scene, tracks: Tracks) -> Adjusted:
    """Moves all cameras and points to where the observations are met best, robustly.

    The similarity that all cameras have moved by is taken out again. On one thread, so that equal scenes give
    equal poses.
    """
    import pycolmap  # noqa: PLC0415 (slow and large: loaded where it is needed)

    from panolog.prepare.sfm.workspace import silence_colmap  # noqa: PLC0415 (as pycolmap)

    before = measure_residuals(scene, tracks)
    used, observations = _in_several([_used(scene, tracks, each.name) for each in scene.panoramas])
    if not len(used) or not np.isfinite(before).any():
        return Adjusted(scene.poses, scene.points, before, before)
    model = _reconstruction_of(scene, used, observations)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.refine_sensor_from_rig = options.print_summary = options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = max(1.0, _LOOSE * float(np.nanmedian(before)))
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = 1, _ROUNDS, _TOLERANCE
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.set_constant_cam_intrinsics(1)
    with silence_colmap():
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    moved = [model.images[number].cam_from_world() for number in range(1, len(scene.panoramas) + 1)]
    poses = np.stack([np.column_stack([pose.rotation.matrix(), pose.translation]) for pose in moved])
    points = scene.points.copy()
    points[used] = [model.points3D[number].xyz for number in range(1, len(used) + 1)]
    common = Common.of(
        scene.poses, poses, float(np.median(np.linalg.norm(points - scene.centers.mean(0), axis=1)))
    )
    poses, points = common.undone_poses(poses), common.undone(points)
    found = Adjusted(poses, points, before, before)
    return replace(found, after=measure_residuals(found.applied(scene), tracks))


def _used(scene: Scene, tracks: Tracks, name: str) -> Observations:
    """Observations of a panorama, pixels of the scene's width, without those at the edges of the picture."""
    if (image := tracks.get(name)) is None:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    seen = image.pixels / (image.camera.width, image.camera.height)
    inside = (np.abs(seen - 0.5) < (0.5 - _SEAM, 0.5 - _POLE)).all(axis=1)
    return image.points[inside], seen[inside] * (scene.width, scene.height)


def _in_several(observations: list[Observations]) -> tuple[NDArray[np.int64], list[Observations]]:
    """The rows (U,) of points that several panoramas have seen, and their observations, as rows of these."""
    seen, count = np.unique(np.concatenate([np.unique(rows) for rows, _ in observations]), return_counts=True)
    used = seen[count > 1]
    kept = [np.isin(rows, used) for rows, _ in observations]
    return used, [
        (np.searchsorted(used, rows[keep]), pixels[keep])
        for keep, (rows, pixels) in zip(kept, observations, strict=True)
    ]


def _reconstruction_of(
    scene: Scene, used: NDArray[np.int64], observations: Sequence[Observations]
) -> "pycolmap.Reconstruction":
    """A model with one camera and the points `used` (U,); images and points have ids from 1 on."""
    import pycolmap  # noqa: PLC0415 (slow and large: loaded where a model is made)

    size = {"width": scene.width, "height": scene.height}
    camera = pycolmap.Camera(
        camera_id=1, model=EQUIRECTANGULAR, **size, params=[float(side) for side in size.values()]
    )
    reconstruction = pycolmap.Reconstruction()
    reconstruction.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in used]
    for index, (panorama, (rows, pixels)) in enumerate(
        zip(scene.panoramas, observations, strict=True), start=1
    ):
        image = pycolmap.Image(panorama.name, pixels.reshape(-1, 2), camera_id=1, image_id=index)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(panorama.rotation), panorama.translation)
        reconstruction.add_image_with_trivial_frame(image, pose)
        for feature, row in enumerate(rows):
            tracks[row].add_element(index, feature)
    for point, color, track in zip(scene.points[used], scene.colors[used], tracks, strict=True):
        reconstruction.add_point3D(point, track, color)
    return reconstruction
