"""Files of a model that are made on request: each format once, of the present model of this run alone."""

from pathlib import Path

import httpx
import numpy as np
import pytest

from panolog.export.reading import read_model
from panolog.orchestrator.engine.stages.partitioning import write_plan
from panolog.orchestrator.runs.folder import RunFolder
from panolog.orchestrator.watch.dashboard.models import downloads
from panolog.scene.ply import ply_exported, read_ply, write_ply
from tests.orchestrator.watch.dashboard.served import POST, SCORES, Served, plan, serving, write_run
from tests.orchestrator.watch.views.models import some

pytestmark = pytest.mark.system


@pytest.fixture
def folder(tmp_path: Path) -> RunFolder:
    """A run with a model of thirty Gaussians."""
    folder = write_run(tmp_path / "runs" / "run")
    write_plan(folder, plan(), SCORES)
    write_ply(folder.point_cloud, some(30))
    return folder


def request(served: Served, kind: str) -> httpx.Response:
    path = f"/api/runs/{served.id('run')}/downloads"
    return served.client.post(path, json={"kind": kind}, headers=POST)


def saved(served: Served, kind: str, folder: Path) -> Path:
    """The file that the answer to a request leads to, saved."""
    answer = request(served, kind)
    assert answer.status_code == 200, answer.text
    file = served.client.get(answer.json()["url"])
    path = folder / file.headers["content-disposition"].partition("filename=")[2].strip('"')
    path.write_bytes(file.content)
    return path


def test_each_format_opens(folder: RunFolder, tmp_path: Path) -> None:
    with serving(folder.root.parent) as served:
        assert served.errors(f"/api/runs/{served.id('run')}/downloads/sog", 404)  # nothing was requested
        sog, spz, ply, page = (saved(served, kind, tmp_path) for kind in ("sog", "spz", "ply", "html"))
    assert [path.name for path in (sog, spz, ply, page)] == [
        "run.sog",
        "run.spz",
        "run-upright.ply",
        "run.html",
    ]
    assert ply_exported(ply)
    down = np.sort(read_ply(ply).means[:, 1].numpy())
    assert len(down) == 30
    np.testing.assert_allclose(np.sort(read_model(sog).means[:, 1]), down, atol=0.01)
    np.testing.assert_allclose(np.sort(-read_model(spz).means[:, 1]), down, atol=0.01)
    assert b"engine.js" in page.read_bytes()


def test_a_file_is_made_once_for_each_model(
    folder: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = list[str]()

    async def counted(module: str, arguments: list[str], what: str) -> None:
        made.append(arguments[2])
        Path(arguments[3]).write_bytes(folder.point_cloud.read_bytes())

    monkeypatch.setattr(downloads, "run_program", counted)  # what it makes: the test above
    with serving(folder.root.parent) as served:
        first = saved(served, "ply", tmp_path).read_bytes()
        assert saved(served, "ply", tmp_path).read_bytes() == first
        assert made == ["ply"]
        write_ply(folder.point_cloud, some(20))
        assert served.errors(f"/api/runs/{served.id('run')}/downloads/ply", 404)  # that was the old model
        assert len(read_ply(saved(served, "ply", tmp_path))) == 20
        monkeypatch.setattr(downloads, "_CACHED", 1)
        saved(served, "spz", tmp_path)
        assert served.errors(f"/api/runs/{served.id('run')}/downloads/ply", 404)


def test_what_cannot_be_made_is_one_line(folder: RunFolder, tmp_path: Path) -> None:
    with serving(folder.root.parent) as served:
        assert request(served, "exe").status_code == 422
        model = tmp_path / "outside.ply"
        folder.point_cloud.rename(model)
        missing = request(served, "sog")
        assert (missing.status_code, missing.json()["error"]) == (409, "run: has no model yet")
        folder.point_cloud.symlink_to(model)
        outside = request(served, "sog")
        assert (outside.status_code, outside.json()["error"]) == (
            409,
            "point_cloud.ply: is not a plain file of the run",
        )
        folder.point_cloud.unlink()
        folder.point_cloud.write_bytes(b"ply\n")
        damaged = request(served, "sog")
        assert damaged.status_code == 409
        assert damaged.json()["error"].startswith("point_cloud.ply: the PLY header is not terminated")
