"""One mask for each panorama: the user's, combined with the nadir, static regions and movers.

The whole system reads SCENE/masks/STEM.png. A mask that the user put there is copied to
SCENE/masks.given/STEM.png before it is combined, and each later call starts from that copy: no file of the
user is lost.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.networks.nadir import black_nadir, nadir_cone
from panolog.prepare.networks.static_regions import FEWEST, MOST, WIDTH, StaticRegion, static_region
from panolog.prepare.panorama_files import PanoramaFile, list_panoramas, load_resized, prefetch
from panolog.prepare.provenance import (
    Provenance,
    check_panorama_size,
    is_user_file,
    png_with_provenance,
    read_mask,
    read_provenance,
)
from panolog.scene.errors import SceneError
from panolog.scene.files import stem_of, write_bytes
from panolog.scene.image_files import decode_used, read_info, resize
from panolog.scene.pictures.headers import ImageInfo
from panolog.scene.read import MASKS
from panolog.scene.write import Progress, StageProgress, no_progress

GIVEN = "masks.given"  # folder of the user's masks that were combined

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class MaskResult:
    """The mask of one panorama."""

    name: str
    ignored: float  # share of the sphere
    fresh: bool  # written now; otherwise it was up to date


@dataclass(frozen=True)
class MaskJob:
    """What to ignore in addition to the masks of the user."""

    nadir: float | None = None  # degrees from straight down
    static: StaticRegion | None = None
    movers: MoverNetwork | None = None


def find_static(pictures: Sequence[PanoramaFile], progress: Progress = no_progress) -> StaticRegion:
    """The region that stays the same in the panoramas, or in MOST of them, evenly chosen.

    Raises SceneError: a panorama is damaged, or there are too few.
    """
    if len(pictures) < FEWEST:
        raise SceneError(
            f"--static: {len(pictures)} panoramas are too few to find what stays the same, {FEWEST} are "
            "needed; use --nadir"
        )
    return static_region(_some(pictures, lambda picture: load_resized(picture.path, WIDTH), progress))


def find_nadir(pictures: Sequence[PanoramaFile], progress: Progress) -> float:
    """The angle of `black_nadir` of the panoramas, or of MOST of them, evenly chosen.

    Raises SceneError: a panorama is damaged, or nothing is black in all of them.
    """
    found = black_nadir(_some(pictures, _not_enlarged, progress))
    if found is None:
        raise SceneError(
            "--nadir auto: the panoramas are not black around straight down; give --nadir DEGREES, or find "
            "what is there with --static"
        )
    return found


def _not_enlarged(picture: PanoramaFile) -> NDArray[np.uint8]:
    """(H, 2 H, 3) at most WIDTH wide: an enlarged rim would be wider than a row."""
    return load_resized(picture.path, min(WIDTH, read_info(picture.path).width))


def _some(
    pictures: Sequence[PanoramaFile],
    load: Callable[[PanoramaFile], NDArray[np.uint8]],
    progress: Progress,
) -> Iterator[NDArray[np.uint8]]:
    """MOST panoramas or fewer, evenly chosen and decoded by `load`."""
    chosen = [pictures[i] for i in np.linspace(0, len(pictures) - 1, min(MOST, len(pictures))).astype(int)]
    with closing(prefetch(load, chosen)) as loaded:
        for done, (_, image) in enumerate(loaded, 1):
            yield image
            progress(done, len(chosen))


def make_masks(
    pictures: Sequence[PanoramaFile], job: MaskJob, progress: Progress = no_progress
) -> list[MaskResult]:
    """Writes a mask for each panorama; can be interrupted at any moment and called again.

    Raises SceneError: a panorama or a mask is damaged, or there are two masks of the user for one panorama;
    RunError: the network failed.
    """
    results = []
    for done, picture in enumerate(pictures, 1):
        info = read_info(picture.path)
        check_panorama_size(picture.path, info)
        given = _given(picture)
        key = _key(job, given, (info.height, info.width), info.alpha)
        path = picture.layer(MASKS)
        fresh = read_provenance(path) != Provenance(key, "intact")
        if fresh:
            used = _used(picture, job, given, info)
            _keep(picture)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, png_with_provenance(np.where(used, 255, 0).astype(np.uint8), key))
        else:
            used = read_mask(path)
        results.append(MaskResult(picture.name, 1 - share_of_sphere(used), fresh))
        progress(done, len(pictures))
    return results


def masks_as_json(
    results: Sequence[MaskResult], static: StaticRegion | None, nadir: float | None
) -> dict[str, Any]:
    """The output of `panolog scene mask --json`. Shares are of the sphere, `nadir` is in degrees."""
    return {
        "nadir": nadir,
        "made": sum(mask.fresh for mask in results),
        "kept": sum(not mask.fresh for mask in results),
        "static": None if static is None else share_of_sphere(static.panorama(512)),
        "images": [{"name": mask.name, "ignored": mask.ignored} for mask in results],
    }


def mask_lines(content: dict[str, Any]) -> Iterator[str]:
    """The content of `masks_as_json` as text."""
    for image in content["images"]:
        yield f"{image['name']}: {image['ignored']:.1%} of the sphere is ignored"
    if content["nadir"] is not None:
        yield f"what is within {content['nadir']:g} degrees of straight down is ignored"
    if content["static"] is not None:
        yield f"{content['static']:.1%} of the sphere stays the same while the camera moves"
    yield f"{content['made']} masks made, {content['kept']} were there"


def share_of_sphere(mask: Mask) -> float:
    """The share of all directions that a mask (h, 2h) covers."""
    height = len(mask)
    weights = np.cos((np.arange(height) + 0.5) / height * np.pi - np.pi / 2)
    return float((mask.mean(axis=1) * weights).sum() / weights.sum())


def _used(picture: PanoramaFile, job: MaskJob, given: Path | None, info: ImageInfo) -> Mask:
    """(height, 2 height) True = use."""
    height = info.height
    used = np.ones((height, 2 * height), bool)
    if info.alpha and (opaque := decode_used(picture.path)) is not None:
        used &= opaque
    if given is not None:
        used &= ~_resized(~read_mask(given), height)
    if job.nadir is not None:
        used &= ~nadir_cone(height, job.nadir)
    if job.static is not None:
        used &= ~job.static.panorama(height)
    if job.movers is not None:
        used &= ~_resized(job.movers.find(load_resized(picture.path, job.movers.width)), height)
    return used


def _resized(ignored: Mask, height: int) -> Mask:
    """(height, 2 height) True = ignore: any pixel that an ignored one has a part in."""
    return np.asarray(resize(ignored.astype(np.float32), (2 * height, height)) > 1e-3)


def _given(picture: PanoramaFile) -> Path | None:
    """The user's own mask of a panorama.

    Raises SceneError: there are two, one that was kept and one that was put or changed since.
    """
    path, kept, colmap = picture.layer(MASKS), picture.layer(GIVEN), picture.colmap_layer(MASKS)
    if is_user_file(path):
        if kept.is_file() and kept.read_bytes() != path.read_bytes():
            raise SceneError(
                f"{path}: is not as it was made, and {kept} is another mask of the same panorama; "
                "remove the one that should not count"
            )
        return path
    next_to = picture.path.with_name(f"{stem_of(picture.path.name)}_mask.png")
    return next((it for it in (kept, colmap, next_to) if it.is_file()), None)


def _keep(picture: PanoramaFile) -> None:
    """Copies a mask of the user to SCENE/masks.given."""
    path, kept = picture.layer(MASKS), picture.layer(GIVEN)
    if is_user_file(path) and not kept.is_file():
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(kept, path.read_bytes())


def _key(job: MaskJob, given: Path | None, size: tuple[int, int], alpha: bool) -> str:
    """A digest of all that a mask is made from, for its provenance."""
    parts = {
        "size": size,
        "given": given and hashlib.sha256(given.read_bytes()).hexdigest(),
        "nadir": job.nadir,
        "static": job.static and hashlib.sha256(job.static.disc.tobytes()).hexdigest(),
        "movers": job.movers and job.movers.key,
    }
    if alpha:
        parts["alpha"] = True
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def mask_scene(
    scene: Path,
    *,
    nadir: float | Literal["auto"] | None,
    static: bool,
    model: Path | None,
    batch: int,
    device: str,
    progress: StageProgress,
) -> dict[str, Any]:
    """Writes the masks of a scene that are missing, and returns what `panolog scene mask --json` prints.

    Args: nadir, degrees around straight down, or "auto", what is black there; static, find the operator;
    model, an ONNX network for movers.
    Raises InputError if a panorama, the network or the device cannot be used.
    """
    pictures = list_panoramas(scene)
    movers = MoverNetwork(model, device, batch) if model is not None else None
    if nadir == "auto":
        nadir = find_nadir(pictures, partial(progress, "black nadir"))
    region = find_static(pictures, partial(progress, "static regions")) if static else None
    masks = make_masks(pictures, MaskJob(nadir, region, movers), partial(progress, "masks"))
    return masks_as_json(masks, region, nadir)
