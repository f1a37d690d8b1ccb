import shutil
import struct
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from panolog.scene.colmap import _quaternion, read_panoramas, write_colmap
from panolog.scene.colmap_files import read_cameras, read_image_records, read_point_records
from panolog.scene.errors import InputError
from panolog.scene.files import atomic
from tests.data import shared
from tests.scenes import WIDTH, write_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene") / "sparse" / "0"


def as_text(folder: Path) -> None:
    """Replaces the binary model by a text model without rigs and frames, as older COLMAP writes."""
    reconstruction = pycolmap.Reconstruction(str(folder))
    for path in folder.iterdir():
        path.unlink()
    reconstruction.write_text(str(folder))
    (folder / "rigs.txt").unlink()
    (folder / "frames.txt").unlink()


def without_rigs(folder: Path) -> None:
    (folder / "rigs.bin").unlink()
    (folder / "frames.bin").unlink()


def as_sphere(folder: Path) -> None:
    """The binary model as SphereSfM writes it: id 11, parameters f, W/2, H/2."""
    without_rigs(folder)
    camera = struct.pack("<QIiQQ3d", 1, 1, 11, WIDTH, WIDTH // 2, 1, WIDTH / 2, WIDTH / 4)
    (folder / "cameras.bin").write_bytes(camera)


def set_lines(name: str, text: str) -> Callable[[Path], None]:
    """The model as text, with other lines in one of its files."""

    def change(folder: Path) -> None:
        as_text(folder)
        (folder / name).write_text(text + "\n")

    return change


def set_camera(line: str) -> Callable[[Path], None]:
    return set_lines("cameras.txt", line)


def set_image(text: str) -> Callable[[Path], None]:
    return set_lines("images.txt", text)


def unused_cameras(folder: Path) -> None:
    """Adds a camera of each model that COLMAP has to the binary file."""
    cameras = [
        pycolmap.Camera.create_from_model_id(10 + number, model, 100.0, 64, 32)
        for number, model in enumerate(pycolmap.CameraModelId.__members__.values())
        if int(model) not in (-1, 11)  # SphereSfM uses 11 for its own
    ]
    records = [
        struct.pack(f"<IiQQ{len(it.params)}d", it.camera_id, int(it.model), it.width, it.height, *it.params)
        for it in cameras
    ]
    count, kept = struct.unpack_from("<Q", (folder / "cameras.bin").read_bytes())[0], folder / "cameras.bin"
    kept.write_bytes(struct.pack("<Q", count + len(cameras)) + kept.read_bytes()[8:] + b"".join(records))


@pytest.mark.parametrize(
    "change",
    [
        lambda _: None,
        as_text,
        without_rigs,
        as_sphere,
        set_camera("# SphereSfM\n1 SPHERE 64 32 1 32 16"),
        set_camera("1 PINHOLE 64 32 64 32 32 16"),
        *[  # cameras of no image
            set_camera(f"1 EQUIRECTANGULAR 64 32 64 32\n2 {camera}")
            for camera in (
                "PINHOLE 64 48 50 50 32 24",
                "OPENCV 64 48 50 50 32 24 0 0 0 0",
                "EQUIRECTANGULAR 64 48 64 48",
                "NEW_MODEL 64 48 1 2 3",
            )
        ],
        unused_cameras,
        *map(set_camera, ["1 SPHERICAL 64 32 64 32", "1 SPHERICAL 64 32", "1 EQUIRECTANGULAR 64 32"]),
    ],
)
def test_every_form_of_a_model_is_what_colmap_reads(folder: Path, change: Callable[[Path], None]) -> None:
    reconstruction = pycolmap.Reconstruction(str(folder))
    ids = sorted(reconstruction.points3D)
    change(folder)
    model = read_panoramas(folder)
    assert len(model.images) == len(reconstruction.images)
    for image in model.images:
        truth = reconstruction.find_image_with_name(image.name)
        pose = truth.cam_from_world()
        np.testing.assert_allclose(image.rotation, pose.rotation.matrix(), rtol=0, atol=1e-15)
        np.testing.assert_array_equal(image.translation, pose.translation)
        seen = {point.point3D_id for point in truth.get_observation_points2D()}
        assert {ids[row] for row in image.observed} == seen
    points = [reconstruction.points3D[number] for number in ids]
    np.testing.assert_allclose(model.points, [point.xyz for point in points], atol=1e-12)
    np.testing.assert_array_equal(model.colors, [point.color for point in points])


def test_a_written_model_reads_back_and_projects_onto_its_observations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(1)
    points, colors = random.normal(size=(6, 3)), random.integers(0, 256, (6, 3), np.uint8)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    images = [("b/2.jpg", np.eye(3), np.zeros(3)), ("a 1.jpg", turn, np.array([1.0, 2, 3]))]
    seen = [(np.array([5, 1]), np.ones((2, 2))), (np.array([], np.int64), np.zeros((0, 2)))]
    appeared: list[str] = []

    def noted(path: Path) -> AbstractContextManager[Path]:
        appeared.append(path.name)
        return atomic(path)

    monkeypatch.setattr("panolog.scene.colmap.atomic", noted)
    write_colmap(tmp_path, images, width=64, height=32, points=points, colors=colors, observations=seen)
    assert appeared[-1] == "points3D.bin"  # a model that has it is whole
    model = read_panoramas(tmp_path)
    assert [image.name for image in model.images] == ["a 1.jpg", "b/2.jpg"]
    np.testing.assert_allclose([image.rotation for image in model.images], [turn, np.eye(3)], atol=1e-12)
    np.testing.assert_allclose(
        [image.translation for image in model.images], [[1, 2, 3], [0, 0, 0]], atol=1e-12
    )
    np.testing.assert_allclose(model.points, points)
    np.testing.assert_array_equal(model.colors, colors)
    assert [list(image.observed) for image in model.images] == [[], [1, 5]]
    of_colmap = tmp_path / "of_colmap"
    of_colmap.mkdir()
    pycolmap.Reconstruction(str(tmp_path)).write_binary(str(of_colmap))
    for file in of_colmap.iterdir():
        assert file.read_bytes() == (tmp_path / file.name).read_bytes(), file.name


def test_rotations_have_the_quaternions_of_colmap() -> None:
    for rotation in Rotation.random(200, random_state=1).as_matrix():
        written = _quaternion(rotation)[[1, 2, 3, 0]]
        assert written.tolist() == pycolmap.Rotation3d(rotation).quat.tolist()


@pytest.mark.parametrize("name", ["flat", "street"])
def test_real_models_agree_with_colmap_on_every_observation(name: str) -> None:
    """Also proves the camera convention: u from atan2(x, z), v down, against COLMAP's own keypoints."""
    folder = shared(name) / "sparse" / "0"
    model = read_panoramas(folder)
    reconstruction = pycolmap.Reconstruction(str(folder))
    ids = sorted(reconstruction.points3D)
    for ours in (model.images[0], model.images[-1]):
        image = reconstruction.find_image_with_name(ours.name)
        features = {p.point3D_id: p.xy for p in image.get_observation_points2D()}
        camera = reconstruction.cameras[image.camera_id]
        local = model.points[ours.observed] @ ours.rotation.T + ours.translation
        u = camera.width * (np.arctan2(local[:, 0], local[:, 2]) / (2 * np.pi) + 0.5)
        v = camera.height * (np.arcsin(local[:, 1] / np.linalg.norm(local, axis=1)) / np.pi + 0.5)
        pixels = np.array([features[ids[i]] for i in ours.observed])
        across = (u - pixels[:, 0] + camera.width / 2) % camera.width - camera.width / 2
        assert np.median(np.hypot(across, v - pixels[:, 1])) < 1.5


def patch(folder: Path, name: str, at: int, data: bytes) -> None:
    content = bytearray((folder / name).read_bytes())
    content[at : at + len(data)] = data
    (folder / name).write_bytes(content)


def lines_of(path: Path) -> list[str]:
    """Without comments."""
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def without_lines_of_points(folder: Path) -> None:
    """images.txt with one line for each image, whose names have spaces, as some programs write it."""
    as_text(folder)
    poses = lines_of(folder / "images.txt")[::2]
    (folder / "images.txt").write_text("\n".join(line.replace("pano_", "A B ") for line in poses) + "\n")


def test_no_image_is_lost_without_lines_of_points(folder: Path) -> None:
    """The second of two was read as the points of the first where its words are triples."""
    expected = [
        image.name.replace("pano_", "A B ") for image in read_image_records(folder, observations=False)
    ]
    without_lines_of_points(folder)
    for observations in (False, True):
        found = list(read_image_records(folder, observations=observations))
        assert sorted(image.name for image in found) == sorted(expected)
        assert not any(len(image.points) for image in found)


def test_colours_from_0_to_1_are_as_bright_as_bytes(folder: Path) -> None:
    expected = read_point_records(folder)
    as_text(folder)
    rows = [line.split() for line in lines_of(folder / "points3D.txt")]
    scaled = [[*row[:4], *(f"{int(it) / 255:.4f}" for it in row[4:7]), *row[7:]] for row in rows]
    (folder / "points3D.txt").write_text("\n".join(map(" ".join, scaled)) + "\n")
    found = read_point_records(folder)
    colors = {number: found.colors[3 * i : 3 * i + 3] for i, number in enumerate(found.ids)}
    assert colors == {n: expected.colors[3 * i : 3 * i + 3] for i, n in enumerate(expected.ids)}


def test_a_byte_order_mark_is_no_part_of_a_model(folder: Path) -> None:
    expected = [image.name for image in read_image_records(folder, observations=False)]
    as_text(folder)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        path = folder / name
        path.write_bytes(b"\xef\xbb\xbf" + "\n".join(lines_of(path)).encode())
    assert sorted(image.name for image in read_image_records(folder, observations=True)) == sorted(expected)
    assert len(read_cameras(folder)) == 1 and len(read_point_records(folder).ids) > 0


def append(folder: Path, name: str, text: str) -> None:
    as_text(folder)
    with (folder / name).open("a") as file:
        file.write(text)


def repeat_record(folder: Path, name: str, lines: int) -> None:
    """Writes the first record of a text file again, at its end."""
    as_text(folder)
    text = [line for line in (folder / name).read_text().splitlines() if not line.startswith("#")]
    (folder / name).write_text("\n".join([*text, *text[:lines]]) + "\n")


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "no images": (lambda f: (f / "images.bin").unlink(), "no images.bin"),
    "NaN": (lambda f: patch(f, "images.bin", 12, struct.pack("<d", np.nan)), "not finite"),
    "NaN in a frame": (
        lambda f: patch(f, "frames.bin", 16, struct.pack("<d", np.nan)),
        "frame .* not finite",
    ),
    "not unit": (lambda f: patch(f, "images.bin", 12, struct.pack("<d", 3.0)), "norm .* not 1"),
    "unknown camera": (lambda f: patch(f, "cameras.bin", 12, struct.pack("<i", 99)), "camera model id 99"),
    "real id 11": (
        lambda f: (f / "cameras.bin").write_bytes(struct.pack("<QIiQQ16d", 1, 1, 11, 64, 32, *range(16))),
        "RAD_TAN_THIN_PRISM_FISHEYE",
    ),
    "huge count": (lambda f: patch(f, "points3D.bin", 51, b"\xff" * 8), "truncated"),
    "empty": (lambda f: (f / "points3D.bin").write_bytes(b""), "empty"),
    "trailing bytes": (lambda f: (f / "points3D.bin").open("ab").write(b"1234"), "4 bytes more"),
    "text OpenCV": (set_camera("1 OPENCV 64 32 50 50 32 16 0 0 0 0"), "camera model OPENCV is not supported"),
    "text SPHERICAL": (set_camera("1 SPHERICAL 64 32 7"), "camera model SPHERICAL"),
    "text nonsense": (set_camera("1 PINHOLE wide 32 1"), "number was expected"),
    "text NaN": (set_camera("1 EQUIRECTANGULAR nan 32 64 32"), "not finite"),
    "text short": (set_camera("1 PINHOLE 64 32 64 32"), "4 parameters, not 2"),
    "pinhole": (set_camera("1 PINHOLE 64 32 50 50 32 16"), "real pinhole"),
    "pinhole not 2:1": (set_camera("1 PINHOLE 64 48 64 48 32 24"), "not 2:1"),
    "panorama not 2:1": (set_camera("1 EQUIRECTANGULAR 64 48 64 48"), "not 2:1"),
    "cropped panorama": (set_camera("1 EQUIRECTANGULAR 64 32 128 64"), "other than its width"),
    "sphere off centre": (set_camera("1 SPHERE 64 32 1 30 16"), "middle"),
    "an image twice": (lambda f: repeat_record(f, "images.txt", 2), "two images have one id"),
    "a point twice": (lambda f: repeat_record(f, "points3D.txt", 1), "point 1 occurs twice"),
    "half a track": (lambda f: append(f, "points3D.txt", "99 1 2 3 4 5 6 0.5 1 0 2\n"), "track of point 99"),
    "other camera id": (set_camera("7 EQUIRECTANGULAR 64 32 64 32"), "COLMAP cannot read"),
    "text image short": (set_image("1 1 0 0"), "image line"),
    "text decimal commas": (set_image("1 0,9 0 0 0 0 0 0 1 a.jpg\n"), "again, with points in numbers"),
    "text UTF-16": (set_image("1\0 1\0 0\0 0 0 0 0 0 1 a.jpg\n"), "again, as UTF-8"),
    "text half a point": (set_image("1 1 0 0 0 0 0 0 1 a.jpg\n3.5 4.5"), "triples"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_broken_model_is_one_clear_line(folder: Path, case: str) -> None:
    change, complaint = BAD[case]
    change(folder)
    with pytest.raises(InputError, match=complaint) as error:
        read_panoramas(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


@pytest.mark.parametrize("name", ["cameras", "images", "frames", "points3D"])
def test_every_truncation_is_noticed(folder: Path, tmp_path: Path, name: str) -> None:
    size = (folder / f"{name}.bin").stat().st_size
    for cut in {1, 8, 24, size // 2, size - 9, size - 1}:
        broken = tmp_path / str(cut)
        shutil.copytree(folder, broken)
        with (broken / f"{name}.bin").open("r+b") as file:
            file.truncate(cut)
        with pytest.raises(InputError, match=name):
            read_panoramas(broken)
