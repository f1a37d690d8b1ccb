"""What a comparison of runs says: differences, settings, whether it is fair; and its page as one file."""

import base64
import json
import os
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.runs.preparation.notes import StepResult, write_note
from panolog.orchestrator.runs.preparation.settings import Settings, Step, write_settings
from panolog.orchestrator.runs.records import Outcome, Preparing, Record, RunEnded
from panolog.orchestrator.watch.views.comparison.compare import compare
from panolog.orchestrator.watch.views.comparison.curves import curves_of
from panolog.orchestrator.watch.views.comparison.page import write_comparison
from panolog.orchestrator.watch.views.comparison.reading import names_of, picture_of, read_runs
from panolog.orchestrator.watch.views.comparison.schema import Comparison
from panolog.orchestrator.watch.views.comparison.terminal import table
from panolog.scene.errors import InputError
from panolog.workers.tasks import COARSE, PREPARE, TaskId
from tests.orchestrator.history import BEGAN, started
from tests.orchestrator.watch.views.comparison.runs import finished, metrics, progressed, write, write_picture
from tests.orchestrator.watch.views.pages.snapshots import self_contained, snapshot_of

HIGHER = {"a.jpg": 21.0, "b.jpg": 23.0, "c.jpg": 31.0}


def compared(*folders: RunFolder) -> Comparison:
    return compare(read_runs([folder.root for folder in folders]), picture_of)


def test_means_are_compared_with_the_first_run(tmp_path: Path) -> None:
    first = write(tmp_path / "first", measured=metrics())
    second = write(tmp_path / "second", measured=metrics(HIGHER))
    comparison = compared(first, second)
    one, other = (run.metrics["ws_psnr"] for run in comparison.runs)
    assert (one.mean, one.difference, one.better) == (24.0, None, None)
    assert [other.mean, other.difference] == pytest.approx([25.0, 1.0])
    assert (other.better, other.worse, other.panoramas) == (2, 1, 3)
    lpips = comparison.runs[1].metrics["lpips"]
    assert lpips.difference == pytest.approx(-0.02)
    assert (lpips.better, lpips.worse) == (2, 1)  # less is better
    assert comparison.runs[1].metrics["psnr"].mean is None
    assert comparison.warnings == ()


def test_what_a_run_has_come_to(tmp_path: Path) -> None:
    run, _ = compared(write(tmp_path / "a", measured=metrics()), write(tmp_path / "b")).runs
    assert (run.name, run.status, run.progress) == ("a", "done", 1.0)
    assert run.stage_one is not None
    assert run.stage_two is not None
    assert (run.stage_one.iteration, run.stage_one.iterations) == (100, 100)
    assert (run.blocks, run.blocks_done, run.stage_two.iterations) == (2, 2, 200)
    assert (run.gaussians, run.bytes, run.memory, run.gpu_memory) == (700, 12_345, 5_000, None)
    assert (run.seconds, run.machines, run.recipe) == (190.0, ("host (cpu)",), "panolog")
    assert {stage.name: stage.seconds for stage in run.stages}["coarse"] == 60.0


def test_a_run_that_makes_its_scene_has_the_name_of_what_it_makes_it_of(tmp_path: Path) -> None:
    records: list[tuple[float, Record]] = [(0.0, BEGAN), (0.0, Preparing("masks", PREPARE))]
    folder = write(tmp_path / "a", records=records)
    source, more = "/films/walk.mp4", ("/films/b",)
    made = Settings(source=source, others=more, video=True, panoramas=9, width=64, nadir=0, static=False)
    write_settings(folder, made)
    done = StepResult(step=Step.SFM, settings={}, seconds=1, lines=())
    write_note(folder.step_result(Step.SFM), done)
    with lock.hold(folder.lock):
        run, _ = compared(folder, write(tmp_path / "b")).runs
    assert run.scene == "walk.mp4 and 1 more" and run.progress > 0


def test_settings_that_differ_also_from_an_older_version(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a"), write(tmp_path / "b", seed=5)
    content = json.loads(second.info.read_bytes())
    del content["config"]["sky"]["count"]
    content["config"]["former"] = "x" * 1_000
    second.info.write_text(json.dumps(content))
    settings = {one.key: one for one in compared(first, second).settings}
    assert settings.keys() == {"seed", "sky.count", "former"}
    assert settings["seed"].values == (0, 5)
    assert settings["sky.count"].known == (True, False)
    assert len(settings["former"].values[1]) < 250


BEGUN: list[tuple[float, Record]] = [
    (0.0, BEGAN),
    (0.0, started(COARSE)),
    (9.0, progressed(COARSE, 50, 9)),
]
UNFAIR: dict[str, dict[str, Any]] = {  # line -> how the second run differs from the first
    "not finished: b (driver lost, ": {"records": BEGUN},
    "not measured yet, without metrics: b": {"measured": None},
    "not of the same scene: a ffffffffffff, b eeeeeeeeeeee": {"fingerprint": "e" * 64},
    "not measured at the same width: a 64 pixels, b 128 pixels": {"measured": metrics(width=128)},
    "not measured with the same crop at the bottom: a 0, b 0.1": {"measured": metrics(crop_bottom=0.1)},
    "not measured with the same levels of detail: a none, b of 2 pixels": {"measured": metrics(detail=2.0)},
    "not measured on the same panoramas: a on 3, b on 2; differences are of the 1 that both have": {
        "measured": metrics({"a.jpg": 1.0, "z.jpg": 2.0})
    },
    "not measured on the same panoramas: a on 3, b on 1; they have none in common": {
        "measured": metrics({"z.jpg": 2.0})
    },
    "b: its metrics are of a model with 650 Gaussians, and the run's has 700": {
        "measured": metrics(gaussians=650)
    },
    "not on the same machines, so their minutes say little: a host (cpu), b other (cpu)": {
        "records": finished("other")
    },
    "not finished: b (failed, ": {"records": [*finished()[:-1], (190, RunEnded(Outcome.FAILED, "x"))]},
}


@pytest.mark.parametrize("line", UNFAIR)
def test_what_is_not_fair_is_said(tmp_path: Path, line: str) -> None:
    first = write(tmp_path / "a", measured=metrics())
    second = write(tmp_path / "b", **{"measured": metrics(), **UNFAIR[line]})
    warnings = compared(first, second).warnings
    assert [one for one in warnings if one.startswith(line)], warnings


def test_panoramas_are_not_counted_where_values_cannot_be_compared(tmp_path: Path) -> None:
    first = write(tmp_path / "a", measured=metrics())
    other = write(tmp_path / "b", measured=metrics(HIGHER, width=128))
    metric = compared(first, other).runs[1].metrics["ws_psnr"]
    assert metric.difference == pytest.approx(1.0)
    assert (metric.better, metric.panoramas) == (None, None)


def test_differences_are_of_the_panoramas_that_both_have(tmp_path: Path) -> None:
    first = write(tmp_path / "a", measured=metrics())
    some = write(tmp_path / "b", measured=metrics({"b.jpg": 25.0, "z.jpg": 90.0}))
    none = write(tmp_path / "c", measured=metrics({"y.jpg": 25.0}))
    _, one, other = (run.metrics["ws_psnr"] for run in compared(first, some, none).runs)
    assert one.difference == pytest.approx(1.0)
    assert (one.mean, one.panoramas) == (57.5, 1)
    assert (other.mean, other.difference, other.panoramas) == (25.0, None, None)


def test_names_are_as_long_as_it_takes() -> None:
    places = [Path("/x/one/run"), Path("/x/two/run"), Path("/x/two/other")]
    assert names_of(places) == ["one/run", "two/run", "two/other"]
    assert names_of([Path("/x/a"), Path("/x/b")]) == ["a", "b"]
    assert names_of([Path("/"), Path("/run")]) == ["/", "run"]


def test_curves_are_of_stages_one_after_the_other(tmp_path: Path) -> None:
    folders = [write(tmp_path / "a"), write(tmp_path / "b")]
    coarse, blocks = curves_of(read_runs([folder.root for folder in folders])).runs[0].stages
    assert (coarse.label, coarse.tasks, blocks.label, blocks.tasks) == ("Stage I", 1, "Stage II", 2)
    loss = coarse.curves["loss"]
    assert (loss.iterations.x, loss.iterations.y, loss.minutes.x) == ((50, 100), (0.3, 0.2), (0.5, 1.0))
    by_iteration = blocks.curves["loss"].iterations
    assert (by_iteration.x[0], by_iteration.x[-1]) == (150, 200)
    assert [by_iteration.y[0], by_iteration.y[-1]] == pytest.approx([0.3, 0.2])  # means
    by_minutes = blocks.curves["loss"].minutes
    assert (by_minutes.x[0], by_minutes.x[-1]) == (1.5, 3.0)
    assert by_minutes.y[-1] == pytest.approx(0.3)
    assert None in by_minutes.y  # between the two, nothing trains
    counts = blocks.curves["gaussians"]
    assert (counts.iterations.y[0], counts.iterations.y[-1]) == (620, 700)  # sums
    assert (counts.minutes.y[0], counts.minutes.y[-1]) == (300, 700)


def test_of_many_tasks_some_are_read_and_sums_are_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("panolog.orchestrator.watch.views.comparison.curves._TASKS", 2)
    many: list[tuple[float, Record]] = [(0.0, BEGAN)]
    for number in range(5):
        task = TaskId.block(number)
        many += [(0.0, started(task)), (30.0, progressed(task, 50, 100)), (60.0, progressed(task, 100, 200))]
    folders = [write(tmp_path / "a", records=many), write(tmp_path / "b", records=many)]
    (blocks,) = curves_of(read_runs([folder.root for folder in folders])).runs[0].stages
    assert (blocks.tasks, blocks.read) == (5, 2)
    assert blocks.curves["gaussians"].iterations.y[-1] == 1_000


def replace_by_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def break_info(folder: RunFolder, **changes: Any) -> None:
    folder.info.write_text(json.dumps(json.loads(folder.info.read_bytes()) | changes))


@pytest.mark.parametrize(
    "damage",
    [
        lambda folder: folder.info.write_text("[" * 100_000),
        lambda folder: folder.info.write_text('{"x": "' + "x" * 2_000_000 + '"}'),
        lambda folder: break_info(folder, scene=None),
        lambda folder: break_info(folder, config={"width": 64, "recipe": ["x"]}),
        lambda folder: folder.database.write_bytes(b"no database" * 1_000),
        lambda folder: folder.metrics.write_text("{"),
        lambda folder: folder.metrics.write_text("[]"),
        lambda folder: replace_by_pipe(folder.info),
        lambda folder: (folder.database.unlink(), folder.database.mkdir()),
        lambda folder: replace_by_pipe(folder.lock),
        lambda folder: os.truncate(folder.metrics, 100_000_000),
    ],
)
def test_a_damaged_run_is_one_line(tmp_path: Path, damage: Callable[[RunFolder], object]) -> None:
    good, bad = write(tmp_path / "good"), write(tmp_path / "bad", measured=metrics())
    damage(bad)
    with pytest.raises(InputError) as error:
        compared(good, bad)
    assert str(bad.root) in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_values_that_are_none_count_as_not_measured(tmp_path: Path) -> None:
    first = write(tmp_path / "a", measured=metrics())
    second = write(tmp_path / "b")
    second.metrics.parent.mkdir()
    values = (
        '{"a.jpg": {"ws_psnr": NaN, "lpips": "x"}, "b.jpg": {"ws_psnr": 1e999}, "c.jpg": [1], "d.jpg": null}'
    )
    head = f'"width": true, "crop_bottom": "x", "detail": -Infinity, "gaussians": {"9" * 400}, "left_out": 3'
    second.metrics.write_text(f'{{{head}, "views": {values}}}')
    run = compared(first, second).runs[1]
    assert {metric.mean for metric in run.metrics.values()} == {None}
    assert run.measured is not None
    assert (run.measured.width, run.measured.gaussians, run.measured.panoramas) == (None, None, 4)


@pytest.mark.parametrize("name", ["../../../secret.jpg", "/etc/passwd", "\0", "x" * 5_000, "", "."])
def test_a_name_of_a_panorama_leads_nowhere(tmp_path: Path, name: str) -> None:
    first = write(tmp_path / "a", measured=metrics({name: 20.0}))
    first.images.mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"\xff\xd8\xff")
    (view,) = compared(first, write(tmp_path / "b")).views
    assert (view.name, view.pictures) == (name, (None, None))


def test_numbers_that_json_does_not_have(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a", measured=metrics()), write(tmp_path / "b", measured=metrics())
    info = json.loads(second.info.read_bytes())
    info["config"] |= {"former": [float("nan")], "overlap": float("inf"), "passes": {"round": float("nan")}}
    second.info.write_text(json.dumps(info))
    with closing(sqlite3.connect(second.database)) as connection, connection:
        connection.execute("UPDATE events SET time = 9e999 WHERE type IN ('ModelSaved', 'RunEnded')")
        connection.execute("DELETE FROM events WHERE type = 'RunEnded'")
        connection.execute("UPDATE metrics SET value = 9e999 WHERE iteration = 50")
        connection.execute("UPDATE metrics SET value = 'text' WHERE name = 'psnr'")
        connection.execute("UPDATE metrics SET time = 9e999 WHERE name = 'gaussians'")
    runs = read_runs([first.root, second.root])
    comparison = compare(runs)
    assert "nan" in str({one.key: one.values for one in comparison.settings}["former"])
    for content in (comparison, curves_of(runs)):
        json.dumps(content.model_dump(mode="json"), allow_nan=False)
    console = Console(width=200, file=StringIO())
    console.print(table(comparison))
    output = tmp_path / "page.html"
    write_comparison([first.root, second.root], output)
    snapshot_of(output.read_text())  # is JSON


JPEG = "data:image/jpeg;base64,"


def page_of(tmp_path: Path, *folders: RunFolder) -> str:
    output = tmp_path / "page.html"
    write_comparison([folder.root for folder in folders], output)
    return output.read_text()


def grey(url: str) -> tuple[int, int, int]:
    """The size of a picture in a data URL, and its mean grey."""
    raw = np.frombuffer(base64.b64decode(url.removeprefix(JPEG)), np.uint8)
    picture = cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    return picture.shape[1], picture.shape[0], round(float(picture.mean()))


def test_it_is_one_page_with_all_of_it(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a", measured=metrics()), write(tmp_path / "b", measured=metrics())
    write_picture(first, "b.jpg", 20, 200)
    write_picture(second, "b.jpg", 100, 200, width=2048)
    page = page_of(tmp_path, first, second)
    assert self_contained(page)
    assert "default-src 'none'" in page
    found = snapshot_of(page)["answers"]
    assert [run["name"] for run in found["compare?"]["runs"]] == ["a", "b"]
    assert [len(run["stages"]) for run in found["compare/curves?"]["runs"]] == [2, 2]
    (view,) = (view for view in found["compare?"]["views"] if view["truth"])
    assert view["name"] == "b.jpg"
    assert grey(view["pictures"][0]) == (64, 32, 20)
    assert grey(view["pictures"][1]) == (1024, 512, 100)
    assert grey(view["truth"]) == (64, 32, 200)


@pytest.mark.parametrize(("count", "most"), [(2, 12), (8, 6)])
def test_pictures_are_few_and_small(tmp_path: Path, count: int, most: int) -> None:
    values = {f"{number:02d}.jpg": float(number) for number in range(20)}
    folders = [write(tmp_path / str(number), measured=metrics(values)) for number in range(count)]
    for folder in folders:
        for name in values:
            write_picture(folder, name, 20, 200, width=1024)
    page = page_of(tmp_path, *folders)
    shown = [view["name"] for view in snapshot_of(page)["answers"]["compare?"]["views"] if view["truth"]]
    assert (len(shown), shown[0], shown[-1]) == (most, "00.jpg", "19.jpg")
    assert len(page) < 8_000_000


def huge_jpeg(width: int, height: int) -> bytes:
    """A small JPEG whose header states another size."""
    raw = bytes(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1])
    at = raw.index(b"\xff\xc0") + 5
    return raw[:at] + struct.pack(">HH", height, width) + raw[at + 4 :]


def test_pictures_that_are_none_are_left_out(tmp_path: Path) -> None:
    views = dict.fromkeys(("cut", "bomb", "png", "wide", "empty", "link", "good"), 20.0)
    first = write(tmp_path / "a", measured=metrics({f"{name}.jpg": value for name, value in views.items()}))
    write_picture(first, "good.jpg", 20, 200)
    good = first.picture("good.jpg").read_bytes()
    (tmp_path / "outside.jpg").write_bytes(good)
    first.picture("cut.jpg").write_bytes(good[: len(good) // 3])
    first.picture("bomb.jpg").write_bytes(huge_jpeg(65_000, 65_000))
    first.picture("png.jpg").write_bytes(bytes(cv2.imencode(".png", np.zeros((64, 64, 3), np.uint8))[1]))
    first.picture("wide.jpg").write_bytes(bytes(cv2.imencode(".jpg", np.zeros((8, 64, 3), np.uint8))[1]))
    first.picture("empty.jpg").touch()
    first.picture("link.jpg").symlink_to(tmp_path / "outside.jpg")
    found = snapshot_of(page_of(tmp_path, first, write(tmp_path / "b")))["answers"]["compare?"]["views"]
    assert {view["name"] for view in found if any(view["pictures"]) or view["truth"]} == {"good.jpg"}
    assert len(found) == len(views)
