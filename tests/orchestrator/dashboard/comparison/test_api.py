"""The comparison as JSON: what the server sends of runs, whatever they hold, and what it refuses."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.run.folder import write_json
from panolog.orchestrator.run.records import ViewEvaluated
from panolog.orchestrator.views.comparison.compare import compare
from panolog.orchestrator.views.comparison.reading import read_runs
from panolog.workers.tasks import EVAL
from tests.orchestrator.dashboard.served import EVIL, Served, append, serving
from tests.orchestrator.views.comparison.runs import metrics, write, write_picture

NONE = "0123456789abcdef"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Two runs, one of which has a picture, one that cannot be read, and one with damaged metrics."""
    root = tmp_path_factory.mktemp("folder")
    first = write(root / "a", measured=metrics())
    write(root / "b", measured=metrics({"a.jpg": 21.0, "b.jpg": 23.0, "c.jpg": 31.0}), seed=5)
    write_picture(first, "b.jpg", 10, 200)
    append(first, ViewEvaluated(EVAL, "b.jpg", {"ws_psnr": 24.0}))
    write(root / "broken").info.write_text("{")
    write(root / "odd", measured=metrics()).metrics.write_text("{")
    with serving(root) as server:
        yield server


def compared(served: Served, *names: str, path: str = "/api/compare") -> Any:
    return served.get(path, run=[served.id(name) for name in names])


def test_it_is_what_the_command_line_has(served: Served) -> None:
    sent = compared(served, "a", "b")
    root = Path(served.get("/api/runs")["folder"])
    own = compare(read_runs([root / "a", root / "b"])).model_dump(mode="json")
    assert [run["name"] for run in sent["runs"]] == ["a", "b"]
    for key in ("metrics", "stages", "measured", "seconds", "gaussians", "memory", "color"):
        assert [run[key] for run in sent["runs"]] == [run[key] for run in own["runs"]]
    assert (sent["settings"], sent["warnings"]) == (own["settings"], own["warnings"])
    assert sent["runs"][1]["metrics"]["ws_psnr"]["better"] == 2


def test_pictures_are_those_of_the_runs(served: Served) -> None:
    views = {view["name"]: view for view in compared(served, "a", "b")["views"]}
    url, none = views["b.jpg"]["pictures"]
    assert none is None
    assert views["b.jpg"]["truth"] == url
    assert url.startswith(f"/api/runs/{served.id('a')}/views/")
    assert served.client.get(url).content.startswith(b"\xff\xd8\xff")
    assert views["a.jpg"]["pictures"] == [None, None]


def test_curves_are_in_the_order_of_the_runs(served: Served) -> None:
    runs = compared(served, "b", "a", path="/api/compare/curves")["runs"]
    assert [run["id"] for run in runs] == [served.id("b"), served.id("a")]
    assert [stage["label"] for stage in runs[0]["stages"]] == ["Stage I", "Stage II"]


def test_a_run_that_cannot_be_read_is_shown_as_such(served: Served) -> None:
    sent = served.get("/api/compare", run=[served.id("broken"), NONE, served.id("a"), served.id("b")])
    broken, none, first, _ = sent["runs"]
    assert (broken["name"], broken["status"]) == ("broken", "unreadable")
    assert "is not JSON" in broken["error"]
    assert "no such run" in none["error"]
    assert (sent["first"], first["error"]) == (2, None)
    assert sent["runs"][3]["metrics"]["ws_psnr"]["better"] == 2
    curves = served.get("/api/compare/curves", run=[NONE, served.id("a")])["runs"]
    assert "no such run" in curves[0]["error"]
    assert curves[1]["stages"]


def test_damaged_metrics_are_a_warning(served: Served) -> None:
    sent = compared(served, "a", "odd")
    assert sent["runs"][1]["measured"] is None
    (line,) = sent["warnings"]
    assert line.startswith("odd: eval/metrics.json: is not JSON")


@pytest.mark.parametrize("path", ["/api/compare", "/api/compare/curves"])
def test_what_is_refused(served: Served, path: str) -> None:
    id = served.id("a")
    assert served.errors(path, 422)
    assert served.errors(path, 422, run=[id])
    assert served.errors(path, 422, run=[id] * 9)
    for wrong in ("../a", "A" * 16, f"{id}0", "", EVIL, f"{id}\n"):
        assert served.errors(path, 422, run=[id, wrong])
    assert served.errors(path, 404, run=[NONE, "f" * 16]) == "there are no such runs"
    assert len(served.get(path, run=[id, id])["runs"]) == 1


@pytest.mark.parametrize("kind", ["link", "folder", "large"])
def test_metrics_that_are_not_the_runs_own(tmp_path: Path, kind: str) -> None:
    write(tmp_path / "folder" / "a", measured=metrics())
    outside, odd = write(tmp_path / "outside", measured=metrics()), write(tmp_path / "folder" / "b")
    odd.metrics.parent.mkdir()
    if kind == "link":
        odd.metrics.symlink_to(outside.metrics)
    elif kind == "folder":
        odd.metrics.mkdir()
    else:
        odd.metrics.write_bytes(b" " * 17_000_000)
    with serving(tmp_path / "folder") as served:
        sent = compared(served, "a", "b")
    assert sent["runs"][1]["metrics"] == {}
    assert [line for line in sent["warnings"] if line.startswith("b: metrics.json")]


def test_it_needs_the_token_where_there_is_one(tmp_path: Path) -> None:
    write(tmp_path / "a")
    write(tmp_path / "b")
    with serving(tmp_path, token="t" * 40) as served:
        for path in ("/compare", "/api/compare", "/api/compare/curves"):
            assert "token" in served.errors(path, 403)
        served.client.headers["Authorization"] = f"Bearer {'t' * 40}"
        assert len(compared(served, "a", "b")["runs"]) == 2
        page = served.client.get("/compare")
        assert (page.status_code, page.headers["x-frame-options"]) == (200, "DENY")
        assert "<!-- content -->" not in page.text


def test_names_are_data(tmp_path: Path) -> None:
    name = EVIL.replace("/", "∕")
    evil = write(tmp_path / name, measured=metrics({EVIL: 20.0}), fingerprint=EVIL)
    write_json(evil.info, json.loads(evil.info.read_bytes()) | {"versions": {"panolog": EVIL}})
    write(tmp_path / "b", measured=metrics())
    with serving(tmp_path) as served:
        answer = served.client.get("/api/compare", params={"run": [served.id(name), served.id("b")]})
    assert answer.headers["content-type"] == "application/json"
    assert answer.content.isascii()
    assert (answer.json()["runs"][0]["name"], answer.json()["runs"][0]["version"]) == (name, EVIL)
