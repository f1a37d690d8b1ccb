"""A run of several sources: what it notes of them, what it masks in each, and what it refuses."""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx import helper

from panolog.orchestrator.cli.session.preparing import settings_of
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.preparation import notes
from panolog.orchestrator.runs.preparation.settings import Options, Step, read_settings
from panolog.prepare.sfm import pipeline
from panolog.prepare.sfm.pipeline import SfmSettings, WithMasks, workspace_folder
from panolog.prepare.sfm.sketch import Sketch
from panolog.prepare.sources.find import find_sources
from panolog.prepare.sources.gather import gather
from panolog.scene.errors import InputError
from panolog.scene.write import StageProgress
from tests.orchestrator.cli.program import call, one_line, shown
from tests.orchestrator.runs.preparation.fake_sfm import image, start
from tests.prepare.networks.networks import CHANNELS, channel, save
from tests.prepare.networks.networks import given as network_input
from tests.prepare.video.videos import render, walk, write_video
from tests.prepare.world.stills import crop, write_still
from tests.scenes import write_scene

WIDTH = 256


class MaskedError(Exception):
    """Ends a driver once the panoramas have masks."""


@pytest.fixture
def gathering(monkeypatch: pytest.MonkeyPatch) -> list[Sequence[Path]]:
    """What poses are to be found of; the panoramas are gathered and masked, and nothing else is done."""
    calls = list[Sequence[Path]]()

    def make_scene(
        source: Sequence[Path],
        output: Path,
        settings: SfmSettings,
        progress: StageProgress,
        with_masks: WithMasks,
        memory: int,
        _show: Callable[[Sketch], None],
    ) -> None:
        calls.append(source)
        found = gather(find_sources(source), workspace_folder(output.resolve()), settings, progress)
        with_masks(found.panoramas)
        raise MaskedError

    monkeypatch.setattr(pipeline, "make_scene", make_scene)
    return calls


def walked(folder: Path, *, bearer: bool, count: int = 6, width: int = WIDTH) -> Path:
    """Panoramas of a walk, with or without the one who bears the camera."""
    folder.mkdir()
    for number, shot in enumerate(walk([0.9] * count)):
        cv2.imwrite(str(folder / f"{number}.png"), render(shot, width, bearer=bearer))
    return folder


@pytest.mark.system
def test_each_source_is_masked_by_what_is_the_same_in_it(
    gathering: list[Sequence[Path]], tmp_path: Path
) -> None:
    given = [
        walked(tmp_path / "borne", bearer=True),
        walked(tmp_path / "free", bearer=False),
        walked(tmp_path / "few", bearer=True, count=2, width=128),
    ]
    with pytest.raises(MaskedError):
        start(given, tmp_path / "run", nadir=0)
    folder = RunFolder(tmp_path / "run")
    assert gathering == [given]
    settings = read_settings(folder)
    assert settings is not None
    assert (settings.source, settings.others) == (str(given[0]), (str(given[1]), str(given[2])))
    assert (settings.video, settings.panoramas, settings.width) == (False, 14, WIDTH)
    result = notes.read_result(folder, Step.MASKS)
    assert result is not None
    assert result.lines[0] == "few: 2 panoramas are too few to find what is the same in all"
    assert result.lines[1].endswith("% of the sphere: what is the same in all panoramas of a source")
    shares = {
        label: [
            (cv2.imread(str(it), cv2.IMREAD_GRAYSCALE) == 0).mean()  # type: ignore[union-attr]
            for it in (folder.preparation / "masks" / label).iterdir()
        ]
        for label in ("borne", "free", "few")
    }
    assert len(shares["borne"]) == len(shares["free"]) == 6 and len(shares["few"]) == 2
    assert min(shares["borne"]) > 0.1 and max(shares["free"]) < 0.02 and max(shares["few"]) == 0


def red_ones(folder: Path) -> Path:
    """A network of views that finds what is red."""
    size = 64
    put = network_input(size, width=size, seam="tiles", fov=90)
    others = [channel(1, "green"), helper.make_node("Neg", ["green"], ["without"])]
    nodes = [channel(0, "red"), *others, helper.make_node("Add", ["red", "without"], ["found"])]
    head = {"output": "found", "threshold": 0.5, "above": "ignore"}
    manifest = {"task": "mask", "input": put, "ignore": head}
    return save(folder, nodes, ["found"], manifest, shape=["N", 3, size, size], constants=CHANNELS)


@pytest.mark.system
def test_a_network_masks_folders_and_videos_and_what_it_has_done_is_kept(
    gathering: list[Sequence[Path]], tmp_path: Path
) -> None:
    """A red thing across the seam, at another height in each panorama."""
    pictures = []
    for number, shot in enumerate(walk([0.9] * 6)):
        grey = render(shot, WIDTH, bearer=False).mean(axis=2, keepdims=True)
        picture = np.repeat(grey, 3, axis=2).astype(np.uint8)
        for columns in (slice(0, 12), slice(-12, None)):
            picture[40 + 4 * number : 70 + 4 * number, columns] = (0, 0, 255)
        pictures.append(picture)
    sources = [tmp_path / "photos", write_video(tmp_path / "walk.mp4", pictures, fourcc="mp4v")]
    sources[0].mkdir()
    for number, picture in enumerate(pictures):
        cv2.imwrite(str(sources[0] / f"{number}.png"), picture)
    model = red_ones(tmp_path)
    written = list[dict[str, int]]()
    for _ in range(2):
        with pytest.raises(MaskedError):
            start(sources, tmp_path / "run", nadir=0, static=False, mask_model=str(model))
        masks = sorted((tmp_path / "run" / "prepare" / "masks").rglob("*.png"))
        written.append({str(it): it.stat().st_mtime_ns for it in masks})
    assert written[0] == written[1]
    assert {it.parent.name for it in masks} == {"photos", "walk"}
    for mask in masks:
        ignored = np.asarray(cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)) == 0
        assert 0.5 < ignored.sum() / (30 * 24) < 2
        assert ignored[:, :20].any() and ignored[:, -20:].any() and not ignored[:, 24:-24].any()
    result = notes.read_result(RunFolder(tmp_path / "run"), Step.MASKS)
    assert result is not None
    assert result.settings == {"nadir": 0, "static": False, "model": str(model)}
    assert result.lines[-1].endswith("% of the sphere: what net.onnx finds")


@pytest.mark.system
def test_the_same_sources_in_any_order_take_up_a_run_and_others_do_not(
    gathering: list[Sequence[Path]], tmp_path: Path
) -> None:
    one, other, third = (walked(tmp_path / name, bearer=False, count=3) for name in "abc")
    for given in ([one, other], [other, one]):
        with pytest.raises(MaskedError):
            start(given, tmp_path / "run")
    for given in ([one], [one, third], [one, other, third]):
        with pytest.raises(InputError, match=rf"belongs to a run of {other}, {one}; choose another"):
            start(given, tmp_path / "run")


def test_masks_are_kept_as_they_are_if_all_panoramas_of_all_sources_have_some(tmp_path: Path) -> None:
    given = [tmp_path / "a", tmp_path / "b"]
    for folder in given:
        for number in range(2):
            image(folder / "images" / f"{number}.png", 64, 32)
            image(folder / "masks" / f"{number}.png", 64, 32)
    settings = settings_of(given, Options())
    assert settings is not None and (settings.nadir, settings.static) == (0, False)
    (tmp_path / "b" / "masks" / "0.png").unlink()
    settings = settings_of(given, Options())
    assert settings is not None and (settings.nadir, settings.static) == (10, True)


@pytest.mark.system
def test_doctor_looks_at_all_sources(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", [np.full((128, 256, 3), 90, np.uint8)] * 5, fourcc="mp4v")
    photographs = walked(tmp_path / "photos", bearer=False, count=1, width=512)  # one is enough
    findings = {it["what"]: it["value"] for it in shown("doctor", video, photographs)["findings"]}
    words = "2 sources: 6 panoramas and frames of videos, of which a part is used, 512x256"
    assert findings["source"] == words
    assert "the panoramas have 512 pixels" in one_line(call("doctor", video, photographs, "--width", 1024))


def test_panoramas_that_become_whole_first_are_looked_at_as_they_will_be(tmp_path: Path) -> None:
    """Cropped ones were refused by `run`, though `scene sfm` completes them."""
    for number in range(3):
        part = np.full((40, 96, 3), 90 + number, np.uint8)
        write_still(tmp_path / "cropped" / f"{number}.png", part, panorama=crop((128, 64), 16, 8, (96, 40)))
        image(tmp_path / "odd" / f"{number}.png", 256, 127)
    for given, width in (("cropped", 128), ("odd", 256)):
        settings = settings_of(tmp_path / given, Options())
        assert settings is not None and (settings.width, settings.panoramas) == (width, 3)
    settings = settings_of([tmp_path / "cropped", tmp_path / "odd"], Options())
    assert settings is not None and settings.width == 256


def test_a_scene_and_a_url_are_run_by_themselves(tmp_path: Path) -> None:
    scene, photographs = write_scene(tmp_path / "scene"), walked(tmp_path / "photos", bearer=False, count=2)
    for given in ((photographs, scene), (scene, photographs)):
        line = one_line(call("run", *given, "-o", tmp_path / "run"))
        assert f"{scene}: is a scene already, which is run by itself; give it alone" in line
    line = one_line(call("run", photographs, "s3://bucket/scene", "-o", tmp_path / "run"))
    assert "s3://bucket/scene: a URL is that of a scene, which is run by itself" in line
    line = one_line(call("run", photographs, tmp_path / "none.mp4", "-o", tmp_path / "run"))
    assert "none.mp4: there is no such file or folder" in line
    assert not (tmp_path / "run").exists()
