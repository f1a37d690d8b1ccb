"""The JSON of a run, and of a comparison, for the pages."""

import base64
import gzip
import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest

from panolog.orchestrator.engine.stages.outline import write_outline
from panolog.orchestrator.engine.stages.partitioning import write_plan
from panolog.orchestrator.runs.config import RunConfig, change, load_config
from panolog.orchestrator.runs.folder import write_json
from panolog.orchestrator.runs.info import SceneRef, make_info, write_info
from panolog.orchestrator.runs.records import Noticed, Outcome, Record, RunBegan, RunEnded, ViewEvaluated
from panolog.orchestrator.watch.dashboard import server
from panolog.orchestrator.watch.views import queries
from panolog.orchestrator.watch.views.comparison.compare import compare
from panolog.orchestrator.watch.views.comparison.reading import read_runs
from panolog.orchestrator.watch.views.pages.shell import STATIC
from panolog.workers.tasks import COARSE, EVAL
from tests.orchestrator.history import append
from tests.orchestrator.watch.dashboard import api_types
from tests.orchestrator.watch.dashboard.served import (
    EVIL,
    SCORES,
    Served,
    plan,
    progressed,
    serving,
    write_run,
    write_whole_run,
)
from tests.orchestrator.watch.views.comparison.runs import metrics, write, write_picture
from tests.ray_head import wait_until
from tests.visual.compare import expand
from tests.workers.small import small_scene


def test_the_declaration_for_the_pages_is_up_to_date() -> None:
    assert api_types.FILE.read_text() == api_types.declaration(), "run `make types`"


def test_the_list_has_a_row_for_each_run(tmp_path: Path) -> None:
    write_whole_run(tmp_path / "a" / "b")
    write_run(tmp_path / "new")
    write_run(tmp_path / "done", [RunBegan("h", 1, resumed=False), RunEnded(Outcome.DONE)])
    (tmp_path / "empty").mkdir()
    with serving(tmp_path) as served:
        rows = {row["name"]: row for row in served.get("/api/runs")["runs"]}
    assert set(rows) == {"a/b", "new", "done"}
    assert rows["a/b"]["status"] == "stopped"
    assert rows["a/b"]["scene"] == "town"
    assert rows["a/b"]["gaussians"] == 500
    assert rows["a/b"]["progress"] < 1
    assert [rows["a/b"][name] for name in ("width", "iterations", "blocks")] == [64, 100, 2]
    assert rows["a/b"]["cover"] is not None and rows["new"]["cover"] is None
    assert rows["done"]["progress"] == 1
    assert all(row["error"] is None for row in rows.values())


def test_the_page_of_a_run_has_its_results_and_settings(served: Served) -> None:
    run = served.get(f"/api/runs/{served.id('run')}")
    assert run["result"].pop("findings") == "- - - -"
    made = {"model": True, "report": True, "view": False, "sog": False, "in_3d": True}
    assert run["result"] == made | {"map": True, "outline": None, "exposure": None}
    settings = {setting["key"]: setting for setting in run["config"]}
    assert settings["iterations"]["changed"]
    assert run["config"][0]["key"] == "iterations"  # what was changed is first
    assert not settings["width"]["changed"]  # it is the scene's
    assert not settings["sky.kappa"]["changed"]
    assert not settings["partition.cuts"]["changed"]  # a list in run.json
    relocates = settings["densify.method"]
    assert (relocates["value"], relocates["changed"]) == ("relocate", False)  # that is its recipe's
    assert "eq. 3" in settings["sky.kappa"]["unit_or_doc"]


def test_what_the_user_gave_is_changed_and_what_the_run_chose_is_not(tmp_path: Path) -> None:
    given = load_config(flags={"width": 64, "iterations": 30_000, "seed": 3})
    resolved = change(given, {"device": "cpu", "densify.max_gaussians": 9_000})
    info = make_info(SceneRef(path="/scenes/town", fingerprint="f"), resolved, given)
    assert sorted(info.given or ()) == ["iterations", "seed", "width"]
    folder = write_run(tmp_path / "run")
    write_info(folder, info)
    with serving(tmp_path) as served:
        settings = served.get(f"/api/runs/{served.id('run')}")["config"]
    assert [it["key"] for it in settings if it["changed"]] == ["width", "seed"]  # the others are defaults


def test_the_map_and_the_cameras_are_there_before_there_is_a_plan(tmp_path: Path) -> None:
    scene = small_scene(tmp_path / "scene")
    folder = write_run(tmp_path / "run")
    with serving(tmp_path) as served:
        path = f"/api/runs/{served.id('run')}"
        assert not served.get(path)["result"]["map"]
        write_outline(folder, scene, RunConfig(width=64))
        assert served.get(path)["result"]["map"]
        figure = served.get(f"{path}/map")
        names = [scene.panoramas[row].name for row in scene.train]
        assert (figure["blocks"]["planned"], figure["blocks"]["names"]) == (False, names)
        (cameras,) = (trace for trace in figure["data"] if trace["name"] == "cameras")
        assert (cameras["customdata"], cameras["text"]) == (list(scene.train), [""] * len(names))
        row = scene.train[1]
        camera = served.get(f"{path}/camera/{row}")
        assert (camera["name"], camera["scores"], camera["assigned"]) == (names[1], [], {})
        (points,) = (trace for trace in figure["data"] if trace["name"] == "points")
        assert np.frombuffer(base64.b64decode(points["z"]["bdata"]), np.uint8).any()
        write_plan(folder, plan(), SCORES)
        assert served.get(f"{path}/map")["blocks"]["planned"]


def test_the_map_is_being_made_when_the_page_is_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[object] = []
    monkeypatch.setattr(server, "import_module", begun.append)
    monkeypatch.setattr(server, "encoded_map", begun.append)
    folder = write_run(tmp_path / "run")
    with serving(tmp_path) as served:
        wait_until(lambda: begun == ["scipy.sparse"], "what maps need to be loaded")
        served.client.get(f"/runs/{served.id('run')}")
        wait_until(lambda: begun[1:] == [folder], "the map to be begun")


def test_every_record_has_words_in_the_log() -> None:
    def names(kind: Any) -> set[str]:
        parts = get_args(kind)
        return set().union(*map(names, parts)) if parts else {kind.__name__}

    words = (STATIC / "run" / "log.js").read_text()
    assert names(Record) == set(re.findall(r"^  (\w+): \[", words, re.MULTILINE))


def test_a_run_whose_scene_is_gone_allows_no_action(served: Served) -> None:
    id = served.id("run")
    assert served.get(f"/api/runs/{id}")["actions"]["available"] == ["resume"]
    answer = served.act(id, "resume")
    assert answer.status_code == 409
    assert "/scenes/town does not exist" in answer.json()["error"]
    assert served.act(id, "stop").json() == {"error": "stop: no driver is at work on the run"}
    assert served.act(id, "pause", -1).status_code == 409


def test_cameras_and_blocks(served: Served) -> None:
    id = served.id("run")
    assert served.get(f"/api/runs/{id}/camera/1") == {
        "row": 1,
        "name": "1.jpg",
        "block": 0,
        "scores": [1.0, 0.9],
        "assigned": {"0": "both", "1": "gradient"},
        "no_picture": "the scene /scenes/town is not on this machine",
    }
    cameras = served.get(f"/api/runs/{id}/block/1")["cameras"]
    assert [camera["reason"] for camera in cameras] == ["gradient", "both", "both"]
    for path in ("camera/9", "camera/9/panorama", "block/2", "views/999999"):
        assert served.errors(f"/api/runs/{id}/{path}", 404)


def test_curves_are_thinned(served: Served) -> None:
    id = served.id("run")
    whole = served.get(f"/api/runs/{id}/series", task="block/000")
    assert whole["loss"]["iteration"] == list(range(1, 41))
    thin = served.get(f"/api/runs/{id}/series", task="block/000", points=4)
    assert thin["rate/means"]["iteration"] == [10, 20, 30, 40]
    assert served.get(f"/api/runs/{id}/series", task="block/001") == {}


def pages(served: Served, path: str, **wanted: object) -> Iterator[dict[str, Any]]:
    """All pages of events, as the log requests them."""
    page = served.get(path, **wanted)
    while page["more"]:
        yield page
        page = served.get(path, before=page["next"], **wanted)
    yield page


def test_events_come_page_by_page(served: Served) -> None:
    path = f"/api/runs/{served.id('run')}/events"
    found = [event["id"] for page in pages(served, path, limit=7) for event in page["events"]]
    assert found == list(range(len(found), 0, -1))
    assert [event["id"] for event in served.get(path, after=len(found) - 2)["events"]] == found[:2]


def test_events_are_filtered(served: Served) -> None:
    path = f"/api/runs/{served.id('run')}/events"

    def types(**wanted: object) -> set[str]:
        return {event["type"] for event in served.get(path, **wanted)["events"]}

    assert types(type="Noticed") == {"Noticed"}
    assert types(type=["Noticed", "TaskStarted"]) == {"Noticed", "TaskStarted"}
    assert "Progressed" not in types(type="-Progressed")
    assert {event["task"] for event in served.get(path, task="coarse")["events"]} == {"coarse"}
    assert types(task="coarse", type="Progressed") == {"Progressed"}
    assert served.get(path, task="block/000", type="CheckpointSaved")["events"][0]["iteration"] == 40
    assert served.get(path, text="IS STRANGE")["events"][0]["message"] == "an image is strange"
    assert served.get(path, text="' OR 1=1 --")["events"] == []


def test_a_search_continues_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert queries.SEARCHED > 10
    monkeypatch.setattr(queries, "SEARCHED", 10)
    write_run(tmp_path, [Noticed(None, "needle"), *(progressed(COARSE, i) for i in range(1, 21))])
    with serving(tmp_path) as served:
        found = [page["events"] for page in pages(served, f"/api/runs/{served.id()}/events", text="needle")]
    assert len(found) > 1
    assert [[event["message"] for event in events] for events in found if events] == [["needle"]]


def test_pictures(served: Served) -> None:
    path = f"/api/runs/{served.id('run')}"
    (preview,) = served.get(f"{path}/previews")["previews"]
    assert served.get(f"{path}/previews", task="block/000") == {"previews": []}
    (view,) = served.get(f"{path}/views")["views"]
    assert (preview["task"], view["metrics"]) == ("coarse", {"psnr": 20.0})
    covers = [f"cover/{preview['event']}", f"cover/{view['number']}"]
    assert served.errors(f"{path}/cover/1", 404)
    for picture in (f"previews/{preview['event']}", f"views/{view['number']}", *covers):
        answer = served.client.get(f"{path}/{picture}")
        assert answer.headers["content-type"] == "image/jpeg"
        assert answer.content.startswith(b"\xff\xd8")
    assert served.errors(f"{path}/previews/{view['number']}", 404)
    names = f"views/{view['number']}", covers[1]
    whole, render = (expand(served.client.get(f"{path}/{name}").content) for name in names)
    assert render.shape[:2] == (whole.shape[0] // 2, whole.shape[1])


def test_downloads(served: Served) -> None:
    path = f"/api/runs/{served.id('run')}"
    model = served.client.get(f"{path}/point_cloud.ply")
    assert model.content == b"ply\n"
    assert model.headers["content-disposition"] == 'attachment; filename="run.ply"'
    part = served.client.get(f"{path}/point_cloud.ply", headers={"Range": "bytes=1-2"})
    assert (part.status_code, part.content) == (206, b"ly")
    report = served.client.get(f"{path}/report.html")
    assert report.headers["content-security-policy"].startswith("sandbox allow-scripts ")
    assert "allow-same-origin" not in report.headers["content-security-policy"]
    assert served.client.get(f"{path}/report.html?save=1").headers["content-disposition"].startswith("attach")


def test_pages_and_scripts(served: Served) -> None:
    for path in ("/", f"/runs/{served.id('run')}", "/runs/nonsense"):
        answer = served.client.get(path)
        assert answer.headers["content-type"] == "text/html; charset=utf-8"
        inline = re.findall(r"<script(?![^>]* src=)[^>]*>(.*?)</script>", answer.text, re.DOTALL)
        (digest,) = (base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in inline)
        assert f"script-src 'self' 'sha256-{digest}';" in answer.headers["content-security-policy"]
    charts = served.client.get("/vendor/plotly.min.js")
    assert b"plotly.js" in charts.content[:1000]
    again = served.client.get("/vendor/plotly.min.js", headers={"If-None-Match": charts.headers["etag"]})
    assert again.status_code == 304


def test_large_answers_are_packed(served: Served) -> None:
    url = f"/api/runs/{served.id('run')}"
    with served.client.stream("GET", url, headers={"Accept-Encoding": "gzip"}) as answer:
        assert gzip.decompress(b"".join(answer.iter_raw())) == served.client.get(url).content


def test_what_was_measured_and_its_pictures_are_of_the_run_alone(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run")
    with serving(tmp_path) as server:
        path = f"/api/runs/{server.id('run')}/findings"
        assert not any(server.get(path).values())
        values = {"psnr": 20.0, "lpips": None}
        folder.make(folder.metrics.parent)
        write_json(folder.metrics, {"mean": {"psnr": 20.0}, "views": {"a.jpg": values}})
        write_json(folder.mover_shares, {"panoramas": [{"name": f"{i}.jpg", "share": 0.1} for i in range(2)]})
        folder.mover_picture("0.jpg").parent.mkdir(parents=True)
        cv2.imwrite(str(folder.mover_picture("0.jpg")), np.zeros((8, 16, 3), np.uint8))
        (tmp_path / "secret.jpg").write_bytes(folder.mover_picture("0.jpg").read_bytes())
        folder.mover_picture("1.jpg").symlink_to(tmp_path / "secret.jpg")
        found = server.get(path)
        assert found["metrics"]["views"] == {"a.jpg": values}
        assert found["pictures"] == ["mover-0.jpg"]
        assert server.client.get(f"{path}/mover-0.jpg").headers["content-type"] == "image/jpeg"
        for name in ("mover-1.jpg", "mover-7.jpg", "..%2Frun.json"):
            assert server.client.get(f"{path}/{name}").status_code == 404
        folder.metrics.write_bytes(b'{"mean": 3}')
        assert "metrics.json: is damaged" in server.errors(path, 404)


NONE = "0123456789abcdef"


@pytest.fixture(scope="module")
def compared_runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Two runs, one of which has a picture, and one that cannot be read."""
    root = tmp_path_factory.mktemp("folder")
    first = write(root / "a", measured=metrics())
    write(root / "b", measured=metrics({"a.jpg": 21.0, "b.jpg": 23.0, "c.jpg": 31.0}), seed=5)
    write_picture(first, "b.jpg", 10, 200)
    append(first, ViewEvaluated(EVAL, "b.jpg", {"ws_psnr": 24.0}))
    write(root / "broken").info.write_text("{")
    with serving(root) as server:
        yield server


def compared(served: Served, *names: str) -> Any:
    return served.get("/api/compare", run=[served.id(name) for name in names])


def test_it_is_what_the_command_line_has(compared_runs: Served) -> None:
    served = compared_runs
    sent = compared(served, "a", "b")
    root = Path(served.get("/api/runs")["folder"])
    own = compare(read_runs([root / "a", root / "b"])).model_dump(mode="json")
    assert [run["name"] for run in sent["runs"]] == ["a", "b"]
    for key in ("metrics", "stages", "measured", "seconds", "gaussians", "memory", "color"):
        assert [run[key] for run in sent["runs"]] == [run[key] for run in own["runs"]]
    assert (sent["settings"], sent["warnings"]) == (own["settings"], own["warnings"])
    assert sent["runs"][1]["metrics"]["ws_psnr"]["better"] == 2
    views = {view["name"]: view for view in sent["views"]}
    url, none = views["b.jpg"]["pictures"]
    assert (views["b.jpg"]["truth"], none) == (url, None)
    assert url.startswith(f"/api/runs/{served.id('a')}/views/")
    assert served.client.get(url).content.startswith(b"\xff\xd8\xff")
    assert views["a.jpg"]["pictures"] == [None, None]


def test_a_run_that_cannot_be_read_is_shown_as_such(compared_runs: Served) -> None:
    served = compared_runs
    sent = served.get("/api/compare", run=[served.id("broken"), NONE, served.id("a"), served.id("b")])
    broken, none, first, _ = sent["runs"]
    assert (broken["name"], broken["status"]) == ("broken", "unreadable")
    assert "is not JSON" in broken["error"]
    assert "no such run" in none["error"]
    assert (sent["first"], first["error"]) == (2, None)
    assert sent["runs"][3]["metrics"]["ws_psnr"]["better"] == 2
    curves = served.get("/api/compare/curves", run=[NONE, served.id("b"), served.id("a")])["runs"]
    assert "no such run" in curves[0]["error"]
    assert [run["id"] for run in curves[1:]] == [served.id("b"), served.id("a")]
    assert [stage["label"] for stage in curves[1]["stages"]] == ["Stage I", "Stage II"]


@pytest.mark.parametrize("path", ["/api/compare", "/api/compare/curves"])
def test_what_is_refused(compared_runs: Served, path: str) -> None:
    served = compared_runs
    id = served.id("a")
    assert served.errors(path, 422)
    assert served.errors(path, 422, run=[id])
    assert served.errors(path, 422, run=[id] * 9)
    for wrong in ("../a", "A" * 16, f"{id}0", "", EVIL, f"{id}\n"):
        assert served.errors(path, 422, run=[id, wrong])
    assert served.errors(path, 404, run=[NONE, "f" * 16]) == "there are no such runs"
    assert len(served.get(path, run=[id, id])["runs"]) == 1


def test_metrics_that_are_none_or_not_the_runs_own_are_a_warning(tmp_path: Path) -> None:
    outside = write(tmp_path / "outside", measured=metrics())
    good, damaged, link = (
        write(tmp_path / "folder" / name, measured=metrics()) for name in ("good", "damaged", "link")
    )
    damaged.metrics.write_text("{")
    link.metrics.unlink()
    link.metrics.symlink_to(outside.metrics)
    with serving(tmp_path / "folder") as served:
        for odd in (damaged, link):
            sent = compared(served, good.root.name, odd.root.name)
            assert (sent["runs"][1]["measured"], sent["runs"][1]["metrics"]) == (None, {})
            (line,) = sent["warnings"]
            assert re.match(rf"{odd.root.name}: (eval/)?metrics\.json", line)
