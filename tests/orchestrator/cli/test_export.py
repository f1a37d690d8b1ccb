"""`panolog export`, and exported files in `eval` and `render`."""

import json
import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from typer.testing import Result

from panolog.export.georeference import Georeference
from panolog.export.reading import read_model
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.storage import fetch
from panolog.orchestrator.watch.views.site.viewpoints import read_viewpoints
from panolog.scene.gaussians import Gaussians, concatenate
from panolog.scene.ply import read_ply, write_ply
from panolog.scene.read import read_scene
from panolog.scene.write import Offset, Origin, write_offset
from panolog.workers.tasks import COARSE
from panolog.workers.training.initialise import scene_gaussians
from tests.orchestrator.cli.program import call as panolog
from tests.orchestrator.cli.program import one_line, shown
from tests.orchestrator.history import BEGAN, begun
from tests.scenes import write_scene

MODELS = ("sog", "spz", "compressed-ply", "ply")
PLACE = Origin(latitude=48.137, longitude=11.575, altitude=520.0)


def export(*arguments: object) -> Result:
    done = panolog("export", *arguments)
    assert done.exit_code == 0, done.output
    return done


def model(scene: Path) -> Gaussians:
    """The points of a scene in many colours, and a sky of four."""
    found = scene_gaussians(read_scene(scene))
    rng = torch.Generator().manual_seed(1)
    shN = torch.randn(len(found), 15, 3, generator=rng) * 0.1
    quats = torch.nn.functional.normalize(torch.randn(len(found), 4, generator=rng), dim=1)
    opaque = torch.full((len(found),), 2.0)
    found = found.with_tensors(found.tensors() | {"shN": shN, "quats": quats, "opacities": opaque})
    sky = found.select(torch.arange(len(found)) < 4)
    far = sky.tensors() | {"means": sky.means * 20, "scales": sky.scales + 3}
    return concatenate(found, sky.with_tensors(far, sky=4))


def picture(folder: Path) -> NDArray[np.float64]:
    """The first of a folder."""
    found = cv2.imread(str(min(folder.iterdir())))
    assert found is not None
    return found.astype(np.float64)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run of a scene with a place on the earth. No test changes it."""
    folder = tmp_path_factory.mktemp("place")
    root = write_scene(folder / "scene", points=300)
    write_offset(root, Offset(offset=(1, 2, 3), frame="ENU", origin=PLACE))
    found = begun(folder / "place", scene=root, fingerprint=read_scene(root).fingerprint)
    write_ply(found.point_cloud, model(root))
    return found


@pytest.fixture(scope="module")
def seen(run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> NDArray[np.float64]:
    """The first picture of its model along the path of its cameras."""
    folder = tmp_path_factory.mktemp("seen")
    assert panolog("render", run.root, "-o", folder, "--path", 2).exit_code == 0
    return picture(folder)


def test_all_formats_at_once(run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "out"
    kinds = ("sog", "web", "spz", "compressed-ply", "ply", "glb", "3dtiles", "sky-image")
    content = shown("export", run.root, "-o", out, *(f"--{kind}" for kind in kinds))
    files = {Path(file["path"]).name: file["bytes"] for file in content["files"]}
    models = {f"place.{ending}" for ending in ("sog", "spz", "compressed.ply", "ply", "glb")}
    folders = {"web", "3dtiles"}
    assert set(files) == models | folders | {"place-sky.spz", "sky.jpg", "sky.exr", "georef.json"}
    assert {path.name for path in out.iterdir()} == set(files)
    assert all(size > 0 for size in files.values())
    place = json.loads((out / "georef.json").read_bytes())
    assert place["exports"]["wgs84"]["latitude"] == pytest.approx(48.137, abs=1e-3)
    turned = place["exports"]["half_turn_around_z"]
    assert {".sog", ".ply", ".compressed.ply"} < set(turned) and ".spz" not in turned
    assert place["provenance"]["scene"] == read_scene(run.root.parent / "scene").fingerprint
    root = json.loads((out / "3dtiles" / "tileset.json").read_bytes())["root"]
    assert np.linalg.norm(root["transform"][12:15]) == pytest.approx(6.37e6, rel=0.01)


def test_the_same_folder_again(run: RunFolder, tmp_path: Path) -> None:
    for _ in range(2):
        export(run.root, "-o", tmp_path / "page", "--web")
        assert not (tmp_path / "page" / "web").exists()
    export(run.root, "-o", tmp_path / "tiles", "--3dtiles")
    again = panolog("export", run.root, "-o", tmp_path / "tiles", "--3dtiles")
    assert "exists already" in one_line(again)


@pytest.mark.parametrize("kind", [*MODELS, "SPZ"])
def test_what_is_exported_comes_back(
    run: RunFolder, seen: NDArray[np.float64], tmp_path: Path, kind: str
) -> None:
    """In the place of the run's scene; read as it stands, it is elsewhere."""
    file = tmp_path / f"model.{kind.lower().replace('-', '.')}"
    export(run.root, "-o", file)
    file = file.rename(tmp_path / f"model.{kind}")  # the content decides
    for name, options in (("back", []), ("off", ["--frame", "model"])):
        words = ("--model", file, "-o", tmp_path / name, "--path", 2, *options)
        assert panolog("render", run.root, *words).exit_code == 0
    back, off = (picture(tmp_path / name) for name in ("back", "off"))
    assert seen.std() > 10
    assert np.abs(seen - back).mean() < 4 < np.abs(seen - off).mean()


def test_evaluation_of_an_exported_file(run: RunFolder, tmp_path: Path) -> None:
    file = tmp_path / "model.sog"
    export(run.root, "-o", file)
    true, found = (shown("eval", run.root, "--model", path) for path in (run.point_cloud, file))
    assert found["mean"]["psnr"] == pytest.approx(true["mean"]["psnr"], abs=0.3)
    assert found["gaussians"] == true["gaussians"]
    assert found["bytes"] == file.stat().st_size


@pytest.mark.parametrize("kind", ["spz", "ply"])
def test_choices(run: RunFolder, tmp_path: Path, kind: str) -> None:
    whole, file = read_ply(run.point_cloud), tmp_path / f"model.{kind}"
    scene = len(whole) - whole.sky
    x = float(whole.means[:scene, 0].median())
    crop = ("--crop", f"{x},-1e9,-1e9,1e9,1e9,1e9")
    sizes = whole.scales[:scene].max(dim=1).values
    size = float(sizes.median().exp())
    cases = (
        ((), scene),
        (crop, int((whole.means[:scene, 0] >= x).sum())),
        (("--max-size", size * 1.001), int((sizes <= math.log(size * 1.001)).sum())),
    )
    for options, count in cases:
        export(run.point_cloud, "-o", file, "--without-sky", *options)
        assert not (tmp_path / "model-sky.spz").exists()
        assert len(read_model(file) if kind == "spz" else read_ply(file)) == count
    export(run.point_cloud, "-o", file, "--without-sky", "--sh", 0)
    assert kind == "ply" or read_model(file).degree == 0
    nothing = ("--without-sky", "--min-opacity", 0.95)
    assert panolog("export", run.point_cloud, "-o", file, *nothing).exit_code == 2


def test_what_is_far_from_all_cameras_is_left_out(run: RunFolder, tmp_path: Path) -> None:
    viewpoints = read_viewpoints(run, None)
    assert viewpoints is not None
    cameras = viewpoints.positions
    whole, file = read_ply(run.point_cloud), tmp_path / "model.ply"
    scene = whole.means[: len(whole) - whole.sky].numpy()
    nearest = np.linalg.norm(scene[:, None] - cameras, axis=2).min(axis=1)
    export(run.root, "-o", file, "--max-distance", np.median(nearest) * 1.0001)
    found = read_ply(file)
    assert (len(found) - found.sky, found.sky) == ((len(scene) + 1) // 2, whole.sky)
    alone = panolog("export", run.point_cloud, "-o", file, "--max-distance", 1)
    assert alone.exit_code == 2
    assert "has no cameras; give the run" in one_line(alone)


def test_choices_of_a_plain_ply(run: RunFolder, tmp_path: Path) -> None:
    """Its sky is its last rows, and what has a lower degree has fewer columns."""
    whole, file = read_ply(run.point_cloud), tmp_path / "model.ply"
    export(run.root, "-o", file, "--sh", 1)
    assert file.stat().st_size < run.point_cloud.stat().st_size / 2
    found = read_ply(file)
    assert (len(found), found.sky) == (len(whole), whole.sky)
    assert not found.shN[:, 3:].any()
    torch.testing.assert_close(found.scales, whole.scales)
    before = file.read_bytes()
    assert "is the model itself" in one_line(panolog("export", file, "-o", file))
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("output", "kind"),
    [("", "ply"), ("point_cloud.ply", "ply"), ("sky.ply", "ply"), ("web", "web"), ("place.sog", None)],
)
def test_what_a_run_has_made_stays(run: RunFolder, tmp_path: Path, output: str, kind: str | None) -> None:
    copy = RunFolder(shutil.copytree(run.root, tmp_path / "copy"))
    copy.georeference.write_text(json.dumps(Georeference().as_json({})))
    before = {path: path.read_bytes() for path in copy.root.iterdir() if path.is_file()}
    done = panolog("export", copy.root, "-o", copy.root / output, *([f"--{kind}"] if kind else []))
    assert done.exit_code == (2 if kind else 0)
    assert not kind or "the run" in one_line(done) or "is the folder of a run" in one_line(done)
    made = [copy.root / output] * (kind is None)
    assert {path for path in copy.root.iterdir() if path.is_file()} == {*before, *made}
    assert all(path.read_bytes() == content for path, content in before.items())


def test_an_error_of_a_run_in_a_store_names_its_url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder in which the run is for a while is of no use to who reads it."""
    begun(tmp_path / "run", BEGAN)

    @contextmanager
    def viewed(*_: object) -> Iterator[tuple[Path, bool]]:
        yield tmp_path / "run", False

    monkeypatch.setattr(fetch, "viewed", viewed)
    url = f"file://{tmp_path}/store/run"
    line = one_line(panolog("export", url, "--sog", "-o", tmp_path / "made"))
    assert line == f"panolog: {url}: the run has no model yet; its first checkpoint makes one"


def test_up(run: RunFolder, tmp_path: Path) -> None:
    """+y of an SPZ is up, of SOG and PLY down: of a PLY -y, of a run's scene with a place +z."""
    whole = read_ply(run.point_cloud)
    means = whole.means[whole.scene].numpy()
    files = ("up.spz", 1, read_model), ("up.sog", -1, read_model), ("up.ply", -1, read_ply)
    for source, options, axis, sign in (
        (run.root, [], 2, 1),
        (run.point_cloud, [], 1, -1),
        (run.point_cloud, ["--up", "-x"], 0, -1),
        (run.point_cloud, ["--up", "0,0,-2"], 2, -1),
    ):
        for name, turned, read in files:
            file = tmp_path / name
            export(source, "-o", file, "--without-sky", *options)
            heights = np.sort(turned * np.asarray(read(file).means)[:, 1])
            expected = np.sort(sign * means[:, axis])
            offset = np.median(heights) - np.median(expected)  # the origin is among the cameras
            np.testing.assert_allclose(heights - offset, expected, atol=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "out"], "out: which format? Give one of --sog,"),
        (["-o", "out.sog", "--crop", "1,2,3"], "--crop 1,2,3: write 6 numbers"),
        (["-o", "out.sog", "--crop", "0,0,0,1,1,0"], "--crop 0,0,0,1,1,0: the first three numbers"),
        (["-o", "out.sog", "--up", "w"], "--up w: write 3 numbers"),
        (["-o", "out.sog", "--up", "0,0,0"], "--up (0.0, 0.0, 0.0) is no direction"),
        (["-o", "out", "--3dtiles", "--epsg", "999999"], "EPSG:999999: cannot be converted"),
        (["-o", "out.sog", "--crop", "900,900,900,901,901,901"], "nothing is left of it"),
    ],
)
def test_wrong_input(
    run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in one_line(panolog("export", run.root, *options, "--without-sky"))
    assert not list(tmp_path.glob("out*"))


def test_a_run_whose_scene_is_gone(run: RunFolder, tmp_path: Path) -> None:
    export(run.root, "-o", tmp_path / "all", "--sog")
    copy, file = RunFolder(tmp_path / "place"), tmp_path / "model.sog"
    shutil.copytree(run.root, copy.root)
    info = json.loads(copy.info.read_bytes())
    info["scene"]["path"] = str(tmp_path / "gone")
    copy.info.write_text(json.dumps(info))
    refused = one_line(panolog("export", copy.root, "-o", file))
    assert "without it nothing says where the model is" in refused
    assert not file.exists()
    (tmp_path / "all" / "georef.json").rename(copy.georeference)
    export(copy.root, "-o", file)
    assert file.read_bytes() == (tmp_path / "all" / "place.sog").read_bytes()


def test_a_run_that_is_not_merged(run: RunFolder, tmp_path: Path) -> None:
    shutil.copytree(run.root, tmp_path / "place")
    copy = RunFolder(tmp_path / "place")
    copy.of(COARSE).mkdir()
    copy.point_cloud.rename(copy.model(COARSE))
    assert "this is its model of Stage I" in export(copy.root, "-o", tmp_path / "a.sog").stderr
    export(copy.of(COARSE) / "..", "-o", tmp_path / "out", "--sog")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"place.sog", "georef.json"}


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04"])
def test_files_that_are_no_models(run: RunFolder, tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "a.sog"
    file.write_bytes(content)
    for command in ("eval", "render"):
        options = ["-o", tmp_path / "x", "--path", 2] if command == "render" else []
        assert str(file) in one_line(panolog(command, run.root, "--model", file, *options))


def box_of(folder: Path) -> NDArray[np.float64]:
    """(3,) half the size of a tileset."""
    root = json.loads((folder / "tileset.json").read_bytes())["root"]
    return np.array(root["boundingVolume"]["box"][3:]).reshape(3, 3).diagonal()


def test_gltf_and_3d_tiles_are_in_metres(run: RunFolder, tmp_path: Path) -> None:
    """`--metres` was ignored."""
    for name, options in (("units", []), ("metres", ["--metres", 0.25])):
        export(run.point_cloud, "-o", tmp_path / name, "--3dtiles", *options)
    np.testing.assert_allclose(box_of(tmp_path / "metres"), box_of(tmp_path / "units") / 4, rtol=1e-3)
    wrong = panolog("export", run.root, "-o", tmp_path / "no", "--3dtiles", "--metres", 0.25)
    assert "in metres east, north and up of its place" in one_line(wrong)
    assert not (tmp_path / "no").exists()


def test_heights_of_a_globe(run: RunFolder, tmp_path: Path) -> None:
    """What GPS gave is above the sea with most receivers: that it is not known is said, and can be given."""
    heights = []
    for name, options, said in (("a", [], True), ("b", ["--geoid", 46], False)):
        done = export(run.root, "-o", tmp_path / name, "--3dtiles", "--glb", *options)
        assert ("heights are taken to be above the ellipsoid" in done.stderr) == said
        place = json.loads((tmp_path / name / "georef.json").read_bytes())
        heights.append(place["exports"]["wgs84"]["height"])
    assert heights[1] - heights[0] == pytest.approx(46, abs=1e-3)


def test_a_sky_that_spz_cannot_hold_is_pulled_in(run: RunFolder, tmp_path: Path) -> None:
    """A scene with a point beyond 205 m was refused at the radius of its sky."""
    whole = read_ply(run.point_cloud)
    tensors = whole.tensors()
    means, scales = tensors["means"].clone(), tensors["scales"].clone()
    means[-whole.sky :] *= 300
    scales[-whole.sky :] += np.log(300)
    write_ply(tmp_path / "far.ply", whole.with_tensors(tensors | {"means": means, "scales": scales}))
    assert means.abs().max() > 2048
    export(tmp_path / "far.ply", "-o", tmp_path / "far.spz")
    found, true = (
        read_model(tmp_path / "far-sky.spz"),
        whole.select(torch.arange(len(whole)) >= len(whole) - 4),
    )
    assert 1000 < np.abs(found.means).max() < 2048  # less, as its Gaussians have to fit, too
    size = np.exp(found.scales).max() / np.linalg.norm(found.means, axis=1).max()
    was = float(true.scales.exp().max() / true.means.norm(dim=1).max())
    assert size == pytest.approx(was, rel=0.1)  # as large as it was, seen from the origin
    assert len(read_model(tmp_path / "far.spz")) == len(whole) - whole.sky


@pytest.mark.parametrize("kind", ["spz", "glb", "3dtiles"])
def test_few_gaussians_that_are_too_far_are_left_out(run: RunFolder, tmp_path: Path, kind: str) -> None:
    whole = read_ply(run.point_cloud)
    scene, means = len(whole) - whole.sky, whole.means.clone()
    for count in (2, scene // 20):
        means[:count, 1] = 5000
        write_ply(tmp_path / "far.ply", whole.with_tensors(whole.tensors() | {"means": means}))
        done = panolog("export", tmp_path / "far.ply", f"--{kind}", "-o", tmp_path / f"{count}")
        if count == 2:
            assert done.exit_code == 0
            left = f"2 of {scene} Gaussians are more than 2048 units from the origin of exports"
            assert left in done.stderr
    assert done.exit_code == 2
    assert "SPZ holds ±2048; crop the model, or leave out what is far with --max-distance" in one_line(done)


def test_a_sky_of_an_earlier_spz_goes_with_it(run: RunFolder, tmp_path: Path) -> None:
    """Read with the scene that was exported without one, it came back."""
    for options, files in ((), {"a.spz", "a-sky.spz"}), (("--without-sky",), {"a.spz"}):
        export(run.root, "-o", tmp_path / "a.spz", *options)
        assert {path.name for path in tmp_path.iterdir()} == files


@pytest.mark.parametrize("count", [0, 1])
def test_a_sky_of_one_gaussian(run: RunFolder, tmp_path: Path, count: int) -> None:
    """A sky of one Gaussian has a reach of 0, also where there is no scene."""
    whole = read_ply(run.point_cloud)
    last = whole.select(torch.arange(len(whole)) >= len(whole) - 1 - count)
    write_ply(tmp_path / "a.ply", last.with_tensors(last.tensors(), sky=1))
    export(tmp_path / "a.ply", "-o", tmp_path / "out", "--sog", "--ply", "--compressed-ply")
    assert len(read_model(tmp_path / "out" / "a.sog")) == 1 + count


def test_rows_that_are_no_gaussians_are_counted(run: RunFolder, tmp_path: Path) -> None:
    whole = read_ply(run.point_cloud)
    tensors = {name: tensor.clone() for name, tensor in whole.tensors().items()}
    tensors["means"][:3] = torch.nan
    tensors["quats"][3, 2], tensors["quats"][4, 0] = torch.nan, torch.inf
    tensors["opacities"][20:22] = torch.inf
    tensors["scales"][22, 0] = -torch.inf
    for tensor in tensors.values():
        tensor[10:17] = 0
    write_ply(tmp_path / "bad.ply", whole.with_tensors(tensors))
    done = export(tmp_path / "bad.ply", "-o", tmp_path / "bad.sog")
    left_out = f"5 of {len(whole)} Gaussians have numbers that are not finite; exports leave them out"
    assert left_out in done.stderr
    assert len(read_model(tmp_path / "bad.sog")) == len(whole) - 5
    assert f"3 of {len(whole)} Gaussians have an infinite opacity or size" in done.stderr
    assert f"7 of {len(whole)} Gaussians have a rotation of zeros" in done.stderr
    assert "not finite" not in export(run.point_cloud, "-o", tmp_path / "good.sog").stderr
