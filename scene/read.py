"""Reads a scene folder: the one way into the system, so all input is checked here.

The files are named as the paper's authors publish Pano360; all but the model and the images are optional:

SCENE/images/ or imgs/          panoramas, sub-folders allowed; what is fully transparent in them is ignored
SCENE/sparse/0/                 the COLMAP model, here or in SCENE/sparse
SCENE/sparse/0/points3D.ply     the cloud, where the model itself has no points
SCENE/sparse/0/depth_params.json    {stem: {"scale": s, "offset": o}} of eq. 4
SCENE/depths/STEM.png           16-bit inverse radial depth, 0 = sky
SCENE/skymasks/STEM.png         8 bit, 255 foreground, 0 sky
SCENE/masks/STEM.png            8 bit, 0 = ignore
SCENE/train.txt, test.txt       stems

A model far from its origin, such as in UTM or geocentric coordinates, is moved there: see `find_offset`.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.scene.colmap import ColmapImage, ColmapModel, read_panoramas
from panolog.scene.errors import SceneError
from panolog.scene.files import StrPath, file_of, stem_of
from panolog.scene.image_files import check_layer, layer_record, read_infos, shows_ends
from panolog.scene.model import NO_OFFSET, Panorama, Scene, Vector
from panolog.scene.ply_table import read_table, read_vertices
from panolog.scene.stores.stored_scenes import outline
from panolog.scene.stores.url import is_url

DEPTHS, SKY_MASKS, MASKS = "depths", "skymasks", "masks"
DEPTH_PARAMS = "depth_params.json"  # next to the model
# Where the model is in a scene: as COLMAP has it, and those that others make of equirectangular pictures.
MODELS = ("sparse/0", "sparse", "sparse_equirectangular/0", "colmap/sparse/0")
MIN_TRAINED = 2  # one panorama has no parallax
MIN_CAMERAS = MIN_TRAINED + 1  # one is held out
MIN_POINTS = 4  # a point's initial scale comes from its three nearest neighbours
FAR = 10  # times the cameras' reach; float32 is then coarser than 1e-6 of it, 1 mm in a kilometre
HOLD_OUT = 8  # every 8th in natural order is test: the 7:1 of the paper


def read_scene(path: StrPath) -> Scene:
    """Reads and checks a scene: a COLMAP model, its panoramas and the optional files around it.

    Every image file is opened and found complete, but none is decoded.

    Args: path, the scene's folder, or its URL in an object store: `Scene.root` is then its outline here.
    Raises SceneError: what is wrong with it, in one line; PlyError: its points3D.ply is damaged; StoreError,
    StoreLostError: the store has no such scene, refuses access or fails.

    >>> import panolog
    >>> scene = panolog.read_scene(SCENE)
    >>> scene.width, len(scene.panoramas), len(scene.train), scene.points.shape
    (64, 9, 7, (50, 3))
    """
    if isinstance(path, str) and is_url(path):
        return _read_stored(path)
    root = Path(path).resolve()
    try:
        return _read_checked(root)
    except OSError as error:  # a file or folder that may not be read, or is gone meanwhile
        raise SceneError(f"{error.filename or root}: cannot be read ({error.strerror})") from error


def _read_stored(url: str) -> Scene:
    root = outline(url, shows_ends).resolve()
    try:
        return _read_checked(root)
    except SceneError as error:
        raise SceneError(str(error).replace(str(root), url.rstrip("/"))) from error


def model_folder(root: Path) -> Path:
    """Where the COLMAP model of a scene is.

    Raises SceneError: there is no scene or no model.
    """
    if not root.is_dir():
        what = "is a file" if root.exists() else "there is no such folder"
        raise SceneError(f"{root}: {what}; give the folder of a scene: images and a COLMAP model in sparse/0")
    for folder in (root / name for name in MODELS):
        if any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return folder
    refuse_run(root)
    raise SceneError(f"{root}: there is no COLMAP model in sparse/0; `panolog run` makes one of panoramas")


def refuse_run(folder: Path) -> None:
    """Raises SceneError for the folder of a run, in which a scene or panoramas are looked for."""
    if (folder / "run.json").is_file():  # which makes a folder a run
        raise SceneError(
            f"{folder}: is the folder of a run; give the scene that it was made of, named in its run.json, "
            "or continue it by `panolog resume`"
        )


def image_folder(root: Path) -> Path:
    """Where the panoramas of a scene are. Raises SceneError if there is no such folder."""
    for name in ("images", "imgs"):
        if (root / name).is_dir():
            return root / name
    refuse_run(root)
    raise SceneError(f"{root}: there is no folder images or imgs; put the panoramas there")


def find_offset(centers: NDArray[np.float64]) -> Vector | None:
    """The whole numbers to subtract from a world that is far from its origin; None where it may stay.

    Training computes in float32. A world is far away if the mean of the cameras is more than `FAR` times as
    far from the origin as any camera is from the mean.

    Args: centers (K, 3), the cameras' positions in float64.
    """
    middle = centers.mean(axis=0)
    reach = np.linalg.norm(centers - middle, axis=1).max()
    if np.linalg.norm(middle) <= FAR * reach:
        return None
    x, y, z = np.rint(middle).tolist()
    return x, y, z


def check_names(where: Path, names: Sequence[str]) -> None:
    """Checks that names of panoramas stay in the image folder and that their stems are unique.

    Raises SceneError: a name is absolute, has `..` or is not UTF-8, or two differ only in their extension.
    """
    for name in names:
        if not (plain := name.encode("utf-8", "replace").decode()) == name:
            raise SceneError(f"{where}: the image name {plain} is not UTF-8; rename the file")
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise SceneError(f"{where}: the image name {name} leaves the image folder; make it relative")
    stem, count = Counter(map(stem_of, names)).most_common(1)[0]
    if count > 1:
        raise SceneError(f"{where}: {count} panoramas are called {stem}; their stems must differ")


def read_split(root: Path, stems: Sequence[str]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """(train, test): rows of `stems`, ascending.

    `root/train.txt` and `root/test.txt` hold one stem a line. With one of the two, the other set is the rest;
    with both, what neither names is left out; with none, every 8th is test.

    Args: stems, names of the panoramas without extension, in natural order.
    Raises SceneError: a file is not UTF-8 or names what the scene does not have, a panorama is in both, or a
    set is empty.
    """
    rows = {stem: row for row, stem in enumerate(stems)}
    train, test = (_read_split_file(root / name, rows) for name in ("train.txt", "test.txt"))
    if train is None and test is None:
        test = set(range(0, len(stems), HOLD_OUT))
    if test is None:
        test = set(rows.values()) - (train or set())
    if train is None:
        train = set(rows.values()) - test
    if both := sorted(train & test):
        raise SceneError(f"{root}: {stems[both[0]]} is in train.txt and in test.txt; remove it from one")
    for name, members in (("test", test), ("train", train)):
        if not members:
            all_ = "; to train on all, remove train.txt and test.txt, and give --holdout none"
            raise SceneError(
                f"{root}: the {name} split is empty; name at least one panorama in {name}.txt"
                f"{all_ if name == 'test' else ''}"
            )
    return tuple(sorted(train)), tuple(sorted(test))


def _read_checked(root: Path) -> Scene:
    folder = model_folder(root)
    model = _with_cloud(folder, read_panoramas(folder))
    _check_geometry(folder, model)
    check_names(folder, [image.name for image in model.images])
    panoramas = _panoramas(root, folder, model.images)
    infos = read_infos([panorama.image for panorama in panoramas])
    panoramas = tuple(
        replace(panorama, transparent=info.alpha) for panorama, info in zip(panoramas, infos, strict=True)
    )
    check_layer([panorama.mask for panorama in panoramas], bits=8)
    check_layer([panorama.sky_mask for panorama in panoramas], bits=8)
    check_layer([panorama.depth for panorama in panoramas], bits=16)
    train, test = read_split(root, [panorama.stem for panorama in panoramas])
    centers = np.stack([panorama.center for panorama in panoramas])
    _check_training(root, centers[list(train)])
    points, offset = model.points, find_offset(centers)
    if offset is not None:
        points = points - offset
        panoramas = tuple(replace(it, translation=it.translation + it.rotation @ offset) for it in panoramas)
    fingerprint = _fingerprint(panoramas, points, model.colors, (train, test))
    return Scene(
        root,
        infos[0].width,
        infos[0].height,
        panoramas,
        points,
        model.colors,
        train,
        test,
        fingerprint,
        offset or NO_OFFSET,
    )


def _with_cloud(folder: Path, model: ColmapModel) -> ColmapModel:
    """The model with the points of points3D.ply, if it has none of its own."""
    cloud = folder / "points3D.ply"
    if len(model.points) or not cloud.is_file():
        return model
    points, colors = read_vertices(read_table(cloud))
    if colors is None:
        raise SceneError(f"{cloud}: the point cloud has no column red")
    return replace(model, points=points, colors=colors)


def _panoramas(root: Path, folder: Path, images: Sequence[ColmapImage]) -> tuple[Panorama, ...]:
    names = [image.name for image in images]
    layers = (find_layer(root, layer, names) for layer in (MASKS, SKY_MASKS, DEPTHS))
    affines = _read_depth_params(folder)
    files = image_folder(root)
    return tuple(
        Panorama(
            name=image.name,
            image=file_of(files, image.name),
            rotation=image.rotation,
            translation=image.translation,
            observed=image.observed,
            mask=mask,
            sky_mask=sky_mask,
            depth=depth,
            depth_affine=_affine_of(depth, affines.get(stem_of(image.name))),
        )
        for image, mask, sky_mask, depth in zip(images, *layers, strict=True)
    )


def _affine_of(depth: Path | None, affine: tuple[float, float] | None) -> tuple[float, float] | None:
    """An affine of depth_params.json; none if `panolog scene depth` made the map: it is that of another."""
    return None if affine is not None and depth is not None and layer_record(depth) else affine


def find_layer(root: Path, layer: str, names: Sequence[str]) -> list[Path | None]:
    """The file of each panorama in the folder `layer`: STEM.png, or NAME.png as COLMAP names masks.

    Raises SceneError: the folder is there, but no panorama has a file in it.
    """
    folder = root / layer
    if not folder.is_dir():
        return [None] * len(names)
    older = Counter(str(Path(name).with_suffix("")) for name in names)  # the name in versions before this
    found = []
    for name in names:
        ways = [f"{stem_of(name)}.png", f"{name}.png"]
        if older[old := str(Path(name).with_suffix(""))] == 1:
            ways.append(f"{old}.png")
        paths = (file_of(folder, way) for way in ways)
        found.append(next((path for path in paths if path.is_file()), None))
    if not any(found):
        raise SceneError(
            f"{folder}: no file here belongs to a panorama; {stem_of(names[0])}.png would: rename them, or "
            "save other formats as PNG"
        )
    return found


def _read_depth_params(folder: Path) -> dict[str, tuple[float, float]]:
    """(scale, offset) of eq. 4 by stem, from depth_params.json next to the model; empty without the file.

    They are as the file has them: where a fit failed, tools write a scale of 0 or NaN.

    Raises SceneError: the file is not JSON of that form.
    """
    path = folder / DEPTH_PARAMS
    if not path.is_file():
        return {}
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {stem: (float(entry["scale"]), float(entry["offset"])) for stem, entry in entries.items()}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise SceneError(f'{path}: not {{"stem": {{"scale": s, "offset": o}}, ...}} ({error!r})') from error


def _read_split_file(path: Path, rows: dict[str, int]) -> set[int] | None:
    """The rows that a split file names, as stems or with their extension; None without the file."""
    if not path.is_file():
        return None
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: is not UTF-8; save it as UTF-8") from error
    found = set()
    for line in text.splitlines():
        if name := line.strip():
            row = rows.get(name, rows.get(stem_of(name)))
            if row is None:
                raise SceneError(f"{path}: {name} is not a panorama of this scene; remove that line")
            found.add(row)
    return found


def _check_geometry(where: Path, model: ColmapModel) -> None:
    """Refuses too few cameras, too few points, or points that are not finite."""
    if len(model.images) < MIN_CAMERAS:
        raise SceneError(f"{where}: {len(model.images)} posed panoramas; at least {MIN_CAMERAS} are needed")
    if len(model.points) < MIN_POINTS:
        raise SceneError(
            f"{where}: the sparse cloud has {len(model.points)} points; at least {MIN_POINTS} are needed, "
            "triangulate them first"
        )
    if not np.isfinite(model.points).all():
        raise SceneError(f"{where}: a point of the sparse cloud is not finite; remove it")


def _check_training(where: Path, centers: NDArray[np.float64]) -> None:
    """Refuses a training split of fewer than two cameras, or all at one place; `centers` (K, 3)."""
    if len(centers) < MIN_TRAINED:
        raise SceneError(
            f"{where}: the train split has {len(centers)} panoramas; at least {MIN_TRAINED} are needed, "
            "add some or change train.txt or test.txt"
        )
    if np.ptp(centers, axis=0).max() <= 1e-9 * np.abs(centers).max():
        raise SceneError(
            f"{where}: all panoramas of the train split have the same position; "
            "without parallax there is no depth"
        )


def _fingerprint(
    panoramas: tuple[Panorama, ...],
    points: NDArray[np.float64],
    colors: NDArray[np.uint8],
    split: tuple[tuple[int, ...], tuple[int, ...]],
) -> str:
    """sha256 of everything that affects training; of files only their names and sizes, so it is fast."""
    described = []
    for panorama in panoramas:
        files = (panorama.image, panorama.mask, panorama.sky_mask, panorama.depth)
        sizes = (file.stat().st_size if file else None for file in files)
        described.append([panorama.name, panorama.depth_affine, *sizes])
    digest = hashlib.sha256(json.dumps([described, *split]).encode())
    arrays: list[NDArray[Any]] = [panorama.rotation for panorama in panoramas]
    arrays += [panorama.translation for panorama in panoramas]
    arrays += [points, colors, *(panorama.observed for panorama in panoramas)]
    for array in arrays:
        digest.update(array.tobytes())
    return digest.hexdigest()
