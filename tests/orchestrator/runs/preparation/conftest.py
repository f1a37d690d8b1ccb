"""A town, its panoramas without poses, and a run of them."""

from pathlib import Path
from shutil import copytree

import pytest

from panolog.orchestrator.runs.folder import RunFolder
from panolog.prepare.sfm import pipeline
from panolog.synthetic.make import make_town
from tests.orchestrator.runs.preparation.fake_sfm import FakeSfm, start


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_town(tmp_path_factory.mktemp("town") / "town", panoramas=9, width=64, points=300)


@pytest.fixture
def raw(town: Path, tmp_path: Path) -> Path:
    """The panoramas of the town without their poses."""
    copytree(town / "images", tmp_path / "raw")
    return tmp_path / "raw"


@pytest.fixture
def sfm(town: Path, monkeypatch: pytest.MonkeyPatch) -> FakeSfm:
    fake = FakeSfm(town)
    monkeypatch.setattr(pipeline, "make_scene", fake.make_scene)
    return fake


@pytest.fixture(scope="module")
def calm(town: Path, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("calm")
    copytree(town / "images", folder / "raw")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "make_scene", FakeSfm(town).make_scene)
        start(folder / "raw", folder / "run")
    return RunFolder(folder / "run")
