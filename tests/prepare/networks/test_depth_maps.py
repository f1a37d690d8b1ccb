"""Depth maps by ONNX networks: bytes in, the right inverse depth out; what is on disk is not done again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import helper

from panolog.prepare.networks.depth_maps import DepthJob, make_depth, plan_depth
from panolog.prepare.networks.inverse_depth import FULL, NEAREST, match_scale
from panolog.prepare.networks.manifest import Input
from panolog.prepare.networks.seam import blend
from panolog.prepare.panorama_files import list_posed_panoramas
from panolog.prepare.provenance import Provenance, is_user_file, read_provenance
from panolog.scene.errors import InputError, PanologError
from panolog.scene.read import read_scene
from tests.prepare.networks.networks import CHANNELS, channel, given, red_depth, save
from tests.scenes import HEIGHT, WIDTH, write_scene

NAMES = [f"{index}.png" for index in range(3)]
RELATIVE = {"output": "depth", "kind": "depth", "distance": "radial"}
INVERSE = RELATIVE | {"kind": "inverse"}
SKY = {"output": "sky", "threshold": 0.7, "above": "sky"}
Floats = NDArray[np.float64]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Three panoramas; no pixel is 0 in red, so each has a depth."""
    root = write_scene(tmp_path / "scene", names=NAMES)
    for index, name in enumerate(NAMES):
        random = np.random.default_rng(index)
        cv2.imwrite(str(root / "images" / name), random.integers(20, 256, (HEIGHT, WIDTH, 3), np.uint8))
    return root


def manifest(**changes: Any) -> dict[str, Any]:
    return {"task": "depth", "input": given(HEIGHT), "depth": RELATIVE} | changes


def network(
    scene: Path, *nodes: onnx.NodeProto, put: dict[str, Any] | None = None, **more: NDArray[Any]
) -> Path:
    """A network of inverse depth with these nodes, which get `more` constants by name."""
    put = put or given(HEIGHT)
    constants, shape = CHANNELS | more, ["N", 3, put["height"], put["width"]]
    head = manifest(input=put, depth=INVERSE)
    return save(scene.parent, nodes, ["depth"], head, shape=shape, constants=constants)


def made(scene: Path, model: Path, **options: Any) -> DepthJob:
    job = plan_depth(list_posed_panoramas(scene), model)
    steps: list[tuple[int, int]] = []
    make_depth(job, progress=lambda done, total: steps.append((done, total)), **options)
    assert steps == [(done, len(job.todo)) for done in range(1, len(job.todo) + 1)]
    return job


def pixels(path: Path, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    image = cv2.imread(str(path), flags)
    assert image is not None
    return image


def rgb(scene: Path, name: str = NAMES[0]) -> Floats:
    """(3, H, W) red, green and blue of a panorama, from 0 to 1."""
    image = pixels(scene / "images" / name, cv2.IMREAD_COLOR)[..., ::-1]
    return image.transpose(2, 0, 1).astype(np.float64) / 255


def expected(inverse: Floats, top: float | None = None) -> Floats:
    return np.clip(np.rint(inverse * FULL / (top or inverse.max())), 1, FULL)


def assert_map(scene: Path, wanted: Floats, name: str = NAMES[0]) -> None:
    found = pixels(scene / "depths" / name)
    assert found.dtype == np.uint16
    np.testing.assert_allclose(found, wanted, atol=1)


@pytest.mark.parametrize("seam", ["turn", "none", "wrap"])
@pytest.mark.parametrize(
    ("layout", "batch", "fixed"),
    [("NCHW", 2, "N"), ("NHWC", 2, "N"), ("NCHW", 1, "N"), ("NCHW", 5, "N"), ("NHWC", 2, 1), ("NHWC", 2, 4)],
)
def test_depth_becomes_inverse_depth(
    scene: Path, layout: str, batch: int, fixed: int | str, seam: str
) -> None:
    put = given(HEIGHT, layout=layout, seam=seam, wrap=8 if seam == "wrap" else 0)
    axis = 1 if layout == "NCHW" else 3
    made(scene, red_depth(scene.parent, manifest(input=put), batch=fixed, axis=axis), batch=batch)
    for name in NAMES:
        assert_map(scene, expected(1 / rgb(scene, name)[0]), name)
    assert not (scene / "skymasks").exists()
    read_scene(scene)


def from_zero(values: Floats) -> Floats:
    """Negative inverse depth is shifted, and not lost."""
    return expected(values - min(0, values.min()))


def share(distance: str) -> Floats:
    """(H, W) of z in the radial distance, z as of a cube's faces or a cylinder."""
    azimuth = (np.arange(WIDTH) + 0.5) / WIDTH * 2 * np.pi - np.pi
    elevation = (np.arange(HEIGHT)[:, None] + 0.5) / HEIGHT * np.pi - np.pi / 2
    x, y, z = np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)
    on_cube: Floats = np.maximum(np.maximum(abs(x), abs(z)), abs(y))  # z on its face is the greatest
    return on_cube if distance == "cube" else np.hypot(x, z)


MAPS: dict[str, tuple[dict[str, Any], Callable[[Floats], Floats]]] = {
    "inverse": ({"depth": INVERSE}, lambda it: expected(it[0])),
    "negative": (
        {"depth": INVERSE, "input": given(HEIGHT, mean=[0.5] * 3)},
        lambda it: from_zero(it[0] - 0.5),
    ),
    "normalised": (
        {
            "depth": INVERSE,
            "input": given(HEIGHT, channels="BGR", divisor=1, mean=[10, 20, 30], std=[2, 4, 8]),
        },
        lambda it: from_zero((255 * it[2] - 10) / 2),  # its first channel is blue
    ),
    "metres": ({"depth": RELATIVE | {"factor": 100.0}}, lambda it: expected(1 / (100 * it[0]), 1 / NEAREST)),
    "metric inverse": ({"depth": INVERSE | {"factor": 2.0}}, lambda it: expected(it[0] / 2, 1 / NEAREST)),
    "cube": ({"depth": RELATIVE | {"distance": "cube"}}, lambda it: expected(share("cube") / it[0])),
    "cylinder": (
        {"depth": RELATIVE | {"distance": "cylinder"}},
        lambda it: expected(share("cylinder") / it[0]),
    ),
}


@pytest.mark.parametrize(("changes", "wanted"), MAPS.values(), ids=MAPS)
def test_maps_are_what_the_manifest_says(
    scene: Path, changes: dict[str, Any], wanted: Callable[[Floats], Floats]
) -> None:
    """Those of metric estimators share one scale."""
    made(scene, red_depth(scene.parent, manifest(**changes)))
    for name in NAMES:
        assert_map(scene, wanted(rgb(scene, name)), name)


@pytest.mark.parametrize("sure", [None, "sure", "unsure"])
@pytest.mark.parametrize("sky", [None, "sky", "foreground"])
def test_sky_and_what_the_network_is_not_sure_of(scene: Path, sky: str | None, sure: str | None) -> None:
    """Both are 0 in the map, and sky alone is in the sky mask."""
    heads = {"sky": SKY | {"above": sky}} if sky else {}
    if sure:
        heads["confidence"] = {"output": "sure", "threshold": 0.401, "above": sure}
    made(scene, red_depth(scene.parent, manifest(**heads)))
    red, green, blue = rgb(scene)
    is_sky = ((green > 0.7) == (sky == "sky")) & (sky is not None)
    none = is_sky | (((blue <= 0.401) == (sure == "sure")) & (sure is not None))
    assert_map(scene, np.where(none, 0, expected(np.where(none, 0, 1 / red))))
    mask = scene / "skymasks" / NAMES[0]
    assert mask.exists() == bool(heads)
    if heads:
        np.testing.assert_array_equal(pixels(mask), np.where(is_sky, 0, 255))


def test_nothing_that_is_no_depth_becomes_one(scene: Path) -> None:
    image = pixels(scene / "images" / NAMES[0])
    image[:4, :, 2] = 0  # depth 0 is none
    cv2.imwrite(str(scene / "images" / NAMES[0]), image)
    made(scene, red_depth(scene.parent, manifest()))
    depth = pixels(scene / "depths" / NAMES[0])
    assert (depth[:4] == 0).all() and (depth[4:] > 0).all()


@pytest.mark.parametrize("seam, wrap, smooth", [("none", 0, False), ("turn", 0, True), ("wrap", 16, True)])
def test_the_seam_shows_no_step(scene: Path, seam: str, wrap: int, smooth: bool) -> None:
    """Of a network for which what is farther right in its picture is nearer: a step at the seam."""
    for name in NAMES:
        cv2.imwrite(str(scene / "images" / name), np.full((HEIGHT, WIDTH, 3), 100, np.uint8))
    put = given(HEIGHT, seam=seam, wrap=wrap)
    ramp = np.linspace(0.2, 0.9, put["width"], dtype=np.float32).reshape(1, 1, 1, -1)
    add = helper.make_node("Add", ["red", "ramp"], ["depth"])
    model = network(scene, channel(0, "red"), add, put=put, ramp=ramp)
    made(scene, model)
    depth = pixels(scene / "depths" / NAMES[0]).astype(np.float64)
    within, across = np.abs(np.diff(depth, axis=1)).max(), np.abs(depth[:, 0] - depth[:, -1]).max()
    assert (across <= 1.1 * within) == smooth
    if smooth:  # the blend itself is no step either
        assert within <= 0.2 * np.ptp(depth)


def test_a_coarser_output_keeps_its_size(scene: Path) -> None:
    pool = helper.make_node("AveragePool", ["red"], ["depth"], kernel_shape=[2, 2], strides=[2, 2])
    put = given(HEIGHT, seam="wrap", wrap=8)
    made(scene, network(scene, channel(0, "red"), pool, put=put))
    mean = rgb(scene)[0].reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))
    assert_map(scene, expected(mean))


def files(scene: Path) -> dict[str, int]:
    """When each depth map was written."""
    return {path.name: path.stat().st_mtime_ns for path in (scene / "depths").iterdir()}


def test_what_is_on_disk_is_not_done_again(scene: Path) -> None:
    model = red_depth(scene.parent, manifest(sky=SKY))
    assert len(made(scene, model).todo) == 3
    before, job = files(scene), made(scene, model)
    assert (job.todo, job.done, files(scene)) == ((), 3, before)
    (scene / "depths" / NAMES[1]).unlink()
    (scene / "skymasks" / NAMES[2]).unlink()
    assert [picture.name for picture in made(scene, model).todo] == [NAMES[1], NAMES[2]]
    assert files(scene)[NAMES[0]] == before[NAMES[0]]


def test_damaged_maps_and_those_of_another_network_are_made_again(scene: Path) -> None:
    made(scene, red_depth(scene.parent, manifest(), batch=2))
    damaged = scene / "depths" / NAMES[0]
    damaged.write_bytes(damaged.read_bytes()[:-200])
    model = scene.parent / "net.onnx"
    assert [picture.name for picture in made(scene, model).todo] == [NAMES[0]]
    other = red_depth(scene.parent, manifest(depth=INVERSE), batch=2)
    assert len(made(scene, other).todo) == 3
    assert_map(scene, expected(rgb(scene)[0]))


def test_what_a_user_made_or_changed_stays(scene: Path) -> None:
    model = red_depth(scene.parent, manifest(sky=SKY))
    (scene / "depths").mkdir()
    (scene / "skymasks").mkdir()
    own = np.full((HEIGHT // 2, WIDTH // 2), 777, np.uint16)
    cv2.imwrite(str(scene / "depths" / NAMES[0]), own)
    cv2.imwrite(str(scene / "depths" / "1.png.png"), own)  # as COLMAP names layers
    cv2.imwrite(str(scene / "skymasks" / NAMES[2]), np.full((HEIGHT, WIDTH), 255, np.uint8))
    job = made(scene, model)
    assert (len(job.todo), job.given) == (1, 2)
    np.testing.assert_array_equal(pixels(scene / "depths" / NAMES[0]), own)
    assert not (scene / "depths" / NAMES[1]).exists()
    assert (pixels(scene / "skymasks" / NAMES[2]) == 255).all()
    path = scene / "depths" / NAMES[2]
    data, changed = path.read_bytes(), pixels(path)
    changed[0, 0] += 1
    cv2.imwrite(str(path), changed)
    retouched = path.read_bytes()
    path.write_bytes(retouched[:33] + data[33:182] + retouched[33:])  # an editor keeps the text
    assert read_provenance(path) == Provenance(job.key, "changed") and is_user_file(path)
    assert made(scene, model).given == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"depth": RELATIVE | {"output": "disp"}}, "no output disp; its outputs are depth, sky"),
        ({"input": given(HEIGHT, name="x")}, "input.name is x; the model has image"),
        ({"input": given(HEIGHT // 2)}, "has the shape .* 32 x 64, but the manifest says"),
        ({"input": given(HEIGHT, layout="NHWC")}, "has the shape"),
    ],
)
def test_a_manifest_that_does_not_fit_its_model_is_refused(
    scene: Path, change: dict[str, Any], message: str
) -> None:
    model = red_depth(scene.parent, manifest())
    model.with_suffix(".yaml").write_text(str(manifest(**change)))  # JSON-like, and so YAML
    with pytest.raises(InputError, match=message):
        plan_depth(list_posed_panoramas(scene), model)
    assert not (scene / "depths").exists()


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ([helper.make_node("Identity", ["image"], ["depth"])], "output depth: .* is not one channel"),
        (
            [channel(0, "red"), helper.make_node("Gather", ["red", "index0"], ["depth"], axis=3)],
            "output depth: 32 x 1 is not a scaled 32 x 64",
        ),
        ([helper.make_node("ReduceMean", ["image"], ["depth"], keepdims=0)], "output depth has the shape"),
        ([helper.make_node("Reshape", ["image", "seven"], ["depth"])], "the network failed"),
    ],
)
def test_outputs_that_are_no_map_are_one_clear_line(
    scene: Path, nodes: list[onnx.NodeProto], message: str
) -> None:
    with pytest.raises(PanologError, match=rf"net\.onnx: .*{message}") as error:
        made(scene, network(scene, *nodes, seven=np.array([7, 7], np.int64)))
    assert "\n" not in str(error.value)


def test_pictures_that_cannot_be_are_named(scene: Path) -> None:
    model = red_depth(scene.parent, manifest())
    path = scene / "images" / NAMES[1]
    whole = path.read_bytes()
    bomb = whole[:16] + (60_000).to_bytes(4, "big") + (30_000).to_bytes(4, "big") + whole[24:]
    for data, message in ((whole[:300], "truncated"), (bomb, "more than any panorama has")):
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"1\.png: .*{message}"):
            made(scene, model)
    path.unlink()
    with pytest.raises(InputError, match=r"1\.png: the model names this image"):
        list_posed_panoramas(scene)


def test_half_precision(scene: Path) -> None:
    nodes, head, half = [channel(0, "depth")], manifest(depth=INVERSE), onnx.TensorProto.FLOAT16
    shape: list[int | str] = ["N", 3, HEIGHT, WIDTH]
    made(scene, save(scene.parent, nodes, ["depth"], head, shape=shape, constants=CHANNELS, dtype=half))
    red = rgb(scene)[0]
    found = pixels(scene / "depths" / NAMES[0]) / FULL * red.max()
    np.testing.assert_allclose(found, red, rtol=2e-3)


def test_a_turned_answer_in_another_scale_is_brought_to_the_first() -> None:
    put = Input.model_validate(given(HEIGHT))
    first = np.random.default_rng(0).uniform(0.1, 1, (HEIGHT, WIDTH)).astype(np.float32)
    turned = np.roll(3 * first + 2, HEIGHT, axis=1)
    first[:3], turned[-3:] = np.nan, np.nan  # each is silent somewhere
    found = blend(np.stack([first, turned]), put, match_scale)
    wanted = np.where(np.isnan(first), (np.roll(turned, -HEIGHT, axis=1) - 2) / 3, first)
    np.testing.assert_allclose(found, wanted, rtol=1e-4)
