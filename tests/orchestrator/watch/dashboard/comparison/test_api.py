"""The comparison as JSON: what the server sends of runs, whatever they hold, and what it refuses."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from panolog.orchestrator.runs.records import ViewEvaluated
from panolog.orchestrator.watch.views.comparison.compare import compare
from panolog.orchestrator.watch.views.comparison.reading import read_runs
from panolog.workers.tasks import EVAL
from tests.orchestrator.watch.dashboard.served import EVIL, Served, append, serving
from tests.orchestrator.watch.views.comparison.runs import metrics, write, write_picture

NONE = "0123456789abcdef"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
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


def test_it_is_what_the_command_line_has(served: Served) -> None:
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


def test_a_run_that_cannot_be_read_is_shown_as_such(served: Served) -> None:
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
def test_what_is_refused(served: Served, path: str) -> None:
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
    good, damaged, link, folder, large = (
        write(tmp_path / "folder" / name, measured=metrics())
        for name in ("good", "damaged", "link", "folder", "large")
    )
    damaged.metrics.write_text("{")
    link.metrics.unlink()
    link.metrics.symlink_to(outside.metrics)
    folder.metrics.unlink()
    folder.metrics.mkdir()
    large.metrics.write_bytes(b" " * 17_000_000)
    with serving(tmp_path / "folder") as served:
        for odd in (damaged, link, folder, large):
            sent = compared(served, good.root.name, odd.root.name)
            assert (sent["runs"][1]["measured"], sent["runs"][1]["metrics"]) == (None, {})
            (line,) = sent["warnings"]
            assert re.match(rf"{odd.root.name}: (eval/)?metrics\.json", line)
