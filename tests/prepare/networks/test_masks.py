"""Masks: the cone at the nadir, what the camera carries, movers; and the user's own, which are never lost."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import helper

from panolog.prepare.networks.masks import GIVEN, MaskJob, find_static, make_masks, share_of_sphere
from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.networks.nadir import black_nadir, nadir_cone
from panolog.prepare.networks.static_regions import WIDTH as LOOKED_AT
from panolog.prepare.networks.static_regions import StaticRegion, static_region
from panolog.prepare.panorama_files import list_panoramas, load_grey, load_resized
from panolog.scene.errors import InputError
from panolog.scene.read import read_scene
from tests.data import shared
from tests.prepare.networks.networks import CHANNELS, channel, given, save
from tests.scenes import HEIGHT, WIDTH, write_scene

NAMES = [f"{index}.png" for index in range(3)]
NADIR = MaskJob(nadir=30.0)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene", names=NAMES)


def masked(scene: Path, job: MaskJob = NADIR) -> list[bool]:
    """Which of the masks were written."""
    return [step.fresh for step in make_masks(list_panoramas(scene), job)]


def pixels(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def put(path: Path, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.where(mask, 255, 0).astype(np.uint8))
    return mask


def put_striped(path: Path) -> NDArray[np.bool_]:
    """A user's mask without the first columns."""
    return put(path, np.arange(WIDTH)[None] + np.zeros((HEIGHT, 1)) > 9)


def test_the_cone_is_a_cap_of_the_sphere() -> None:
    cap = nadir_cone(512, 30)
    assert share_of_sphere(cap) == pytest.approx((1 - np.cos(np.radians(30))) / 2, rel=0.01)
    assert cap[-1].all() and not cap[:256].any()


def test_masks_need_no_model_and_reach_the_scene(scene: Path) -> None:
    model = scene / "sparse"
    model.rename(scene / "later")
    assert masked(scene) == [True] * 3
    (scene / "later").rename(model)
    for panorama in read_scene(scene).panoramas:
        assert panorama.mask is not None
        np.testing.assert_array_equal(pixels(panorama.mask) > 0, ~nadir_cone(HEIGHT, 30))
    assert not (scene / GIVEN).exists()


def test_masks_that_are_as_they_should_be_are_not_made_again(scene: Path) -> None:
    masked(scene)
    (scene / "masks" / NAMES[1]).unlink()
    damaged = scene / "masks" / NAMES[2]
    damaged.write_bytes(damaged.read_bytes()[:-30])
    assert masked(scene) == [False, True, True]
    assert masked(scene, MaskJob(nadir=31.0)) == [True] * 3


def test_the_users_mask_is_combined_and_kept(scene: Path) -> None:
    own = put_striped(scene / "masks" / NAMES[0])
    bytes_before = (scene / "masks" / NAMES[0]).read_bytes()
    for degrees in (60.0, 30.0):  # the second call starts from the user's mask, not from the first call's
        assert masked(scene, MaskJob(nadir=degrees))[0]
        np.testing.assert_array_equal(
            pixels(scene / "masks" / NAMES[0]) > 0, own & ~nadir_cone(HEIGHT, degrees)
        )
        assert (scene / GIVEN / NAMES[0]).read_bytes() == bytes_before
    assert masked(scene) == [False] * 3


@pytest.mark.parametrize("name", ["masks/0.png.png", "images/0_mask.png"])
def test_a_mask_by_another_name_is_combined_and_stays(name: str, scene: Path) -> None:
    own = put_striped(scene / name)
    masked(scene)
    np.testing.assert_array_equal(pixels(scene / "masks" / NAMES[0]) > 0, own & ~nadir_cone(HEIGHT, 30))
    np.testing.assert_array_equal(pixels(scene / name) > 0, own)


def test_a_changed_mask_is_the_users(scene: Path) -> None:
    masked(scene)
    path = scene / "masks" / NAMES[0]
    painted = pixels(path)
    painted[3, 3] = 0
    cv2.imwrite(str(path), painted)
    masked(scene, MaskJob(nadir=10.0))
    assert pixels(path)[3, 3] == 0
    cv2.imwrite(str(path), np.full((HEIGHT, WIDTH), 255, np.uint8))
    with pytest.raises(InputError, match=r"masks/0\.png: is not as it was made, and .*masks\.given/0\.png"):
        masked(scene)


def test_a_mask_of_another_size_loses_nothing(scene: Path) -> None:
    large = np.ones((4 * HEIGHT, 4 * WIDTH), bool)
    large[8, 8] = False  # a single pixel of sixteen
    put(scene / "masks" / NAMES[0], large)
    small = np.ones((HEIGHT // 2, WIDTH // 2), bool)
    small[1, 1] = False
    put(scene / "masks" / NAMES[1], small)
    masked(scene, MaskJob(nadir=1e-3))
    assert pixels(scene / "masks" / NAMES[0])[2, 2] == 0
    assert (pixels(scene / "masks" / NAMES[1])[2:4, 2:4] == 0).all()


def movers(scene: Path, nodes: list[onnx.NodeProto], layout: str = "NCHW", **head: Any) -> MaskJob:
    """A job by a network whose output is `found`, with the manifest's head, "classes" or "ignore"."""
    manifest = {"task": "mask", "input": given(HEIGHT, layout=layout), **head}
    shape: list[int | str] = ["N", 3, HEIGHT, WIDTH] if layout == "NCHW" else ["N", HEIGHT, WIDTH, 3]
    model = save(scene.parent, nodes, ["found"], manifest, shape=shape, constants=CHANNELS)
    return MaskJob(movers=MoverNetwork(model))


SCORES = [helper.make_node("Identity", ["image"], ["found"])]  # red, green and blue are classes


@pytest.mark.parametrize("layout", ["NCHW", "NHWC"])
@pytest.mark.parametrize("ignore", [[0], [1, 2]])
def test_movers_by_class(scene: Path, ignore: list[int], layout: str) -> None:
    """The class with the highest score counts."""
    masked(scene, movers(scene, SCORES, layout, classes={"output": "found", "ignore": ignore}))
    image = load_resized(scene / "images" / NAMES[0], WIDTH)
    np.testing.assert_array_equal(
        pixels(scene / "masks" / NAMES[0]) == 0, np.isin(image.argmax(axis=2), ignore)
    )


def test_movers_by_the_index_of_the_class(scene: Path) -> None:
    """Some networks choose the greatest score themselves, and give the index of its class."""
    winner = helper.make_node("ArgMax", ["image"], ["index"], axis=1, keepdims=0)
    nodes = [winner, helper.make_node("Cast", ["index"], ["found"], to=onnx.TensorProto.FLOAT)]
    masked(scene, movers(scene, nodes, classes={"output": "found", "ignore": [1]}))
    image = load_resized(scene / "images" / NAMES[0], WIDTH)
    np.testing.assert_array_equal(pixels(scene / "masks" / NAMES[0]) == 0, image.argmax(axis=2) == 1)


@pytest.mark.parametrize("above", ["ignore", "keep"])
def test_movers_by_threshold_and_everything_else(scene: Path, above: str) -> None:
    own = put_striped(scene / "masks" / NAMES[0])
    head = {"output": "found", "threshold": 0.501, "above": above}
    masked(scene, replace(movers(scene, [channel(1, "found")], ignore=head), nadir=30.0))
    green = load_resized(scene / "images" / NAMES[0], WIDTH)[..., 1] / 255
    people = (green > 0.501) == (above == "ignore")
    wanted = own & ~people & ~nadir_cone(HEIGHT, 30)
    np.testing.assert_array_equal(pixels(scene / "masks" / NAMES[0]) > 0, wanted)


def test_a_network_without_a_class_is_refused(scene: Path) -> None:
    with pytest.raises(InputError, match="no class 3 among 3"):
        masked(scene, movers(scene, SCORES, classes={"output": "found", "ignore": [3]}))


def walk(count: int, *, carried: bool) -> list[NDArray[np.uint8]]:
    """Panoramas of an ever different world, with a striped thing at the nadir that is carried along."""
    height = LOOKED_AT // 2
    v, u = np.mgrid[0:height, 0:LOOKED_AT] + 0.5
    angle, azimuth = 180 - v / height * 180, u / LOOKED_AT * 360
    thing = (angle < 30) | ((angle < 50) & (abs(azimuth - 90) < 20))  # with an arm
    stripes = np.where((angle // 4 + azimuth // 10) % 2 == 0, 40, 90)
    images = []
    for index in range(count):
        random = np.random.default_rng(index)
        world = cv2.resize(random.integers(0, 256, (64, 128), np.uint8), (LOOKED_AT, height))
        grey = np.where(thing, stripes, world) if carried else world
        noisy = np.clip(grey + random.normal(0, 4, grey.shape), 0, 255).astype(np.uint8)
        images.append(np.repeat(noisy[..., None], 3, axis=2))
    return images


def test_what_the_camera_carries_is_found() -> None:
    found = static_region(walk(12, carried=True)).panorama(256)
    v, u = np.mgrid[0:256, 0:512] + 0.5
    angle, azimuth = 180 - v / 256 * 180, u / 512 * 360
    core = (angle < 29) | ((angle < 48) & (abs(azimuth - 90) < 18))
    near = (angle < 34) | ((angle < 54) & (abs(azimuth - 90) < 27))
    assert found[core].mean() > 0.98
    assert not found[~near].any()


def test_where_nothing_is_carried_nothing_is_found() -> None:
    assert not static_region(walk(12, carried=False)).disc.any()


def test_the_tripod_of_the_flat_is_found_and_the_street_has_none() -> None:
    flat = find_static(list_panoramas(shared("flat"))).panorama(512)
    assert flat[-40:].mean() > 0.99  # tripod and handle
    assert share_of_sphere(flat) < 0.06
    assert not find_static(list_panoramas(shared("street"))[::4]).disc.any()


def test_a_static_region_is_part_of_the_mask(scene: Path) -> None:
    region = static_region(walk(6, carried=True))
    masked(scene, MaskJob(static=region))
    np.testing.assert_array_equal(pixels(scene / "masks" / NAMES[2]) == 0, region.panorama(HEIGHT))
    assert masked(scene, MaskJob(static=region)) == [False] * 3
    assert masked(scene, MaskJob(static=StaticRegion(~region.disc))) == [True] * 3


def test_a_folder_without_panoramas_says_so(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    with pytest.raises(InputError, match="there are no panoramas in it"):
        list_panoramas(tmp_path)


def test_a_black_cap_is_found_with_its_rim(tmp_path: Path) -> None:
    random = np.random.default_rng(4)
    pictures = []
    for index in range(4):
        picture = random.integers(20, 256, (512, 1024, 3), np.uint8)
        picture[-64 - index :] = 0
        path = str(tmp_path / f"{index}.jpg")
        cv2.imwrite(path, picture, [cv2.IMWRITE_JPEG_QUALITY, 70])
        pictures.append(np.asarray(cv2.imread(path), np.uint8))
    found = black_nadir(pictures)
    assert found is not None and 64 * 180 / 512 <= found <= 67 * 180 / 512 + 0.5
    assert black_nadir([*pictures, np.full((512, 1024, 3), 90, np.uint8)]) is None
    assert black_nadir([np.zeros((512, 1024, 3), np.uint8)]) is None  # all of it is black
    assert black_nadir([]) is None


def test_what_is_transparent_is_in_the_mask_and_no_edge_for_networks(scene: Path) -> None:
    whole = np.asarray(cv2.imread(str(scene / "images" / NAMES[0])))
    alpha = np.full(whole.shape[:2], 255, np.uint8)
    alpha[-6:] = 0
    cv2.imwrite(str(scene / "images" / NAMES[0]), np.dstack([whole * (alpha > 0)[..., None], alpha]))
    assert masked(scene, MaskJob(nadir=5.0)) == [True] * 3
    used = pixels(scene / "masks" / NAMES[0]) > 0
    assert not used[-6:].any() and used[:-6].all()
    assert (pixels(scene / "masks" / NAMES[1]) > 0)[-6:-2].all()
    assert masked(scene, MaskJob(nadir=5.0)) == [False] * 3
    shown = load_resized(scene / "images" / NAMES[0], WIDTH)
    np.testing.assert_array_equal(shown[:-6], whole[:-6, :, ::-1])
    np.testing.assert_array_equal(shown[-6:], np.broadcast_to(shown[-7], (6, WIDTH, 3)))
    grey, counted = load_grey(scene / "images" / NAMES[0])
    assert counted is not None
    np.testing.assert_array_equal(counted, alpha > 0)
    np.testing.assert_array_equal(grey[-6:], np.broadcast_to(grey[-7], (6, WIDTH)))
    assert load_grey(scene / "images" / NAMES[1])[1] is None
