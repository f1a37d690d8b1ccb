"""URLs on the command line: where they are not supported, or not as they must be, one line says so."""

from pathlib import Path

import pytest

from panolog.orchestrator.runs.storage.mirror_settings import MIRROR_SETTINGS, local_folder, settings_of
from panolog.scene.errors import ConfigError
from panolog.scene.stores.cache import FOLDER
from tests.orchestrator.cli.program import call

LOCAL = "takes files and folders of this machine only"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["render", "s3://bucket/run", "-o", "x"], LOCAL),
        (["view", "run", "--output=gs://bucket/x"], LOCAL),
        (["pause", "s3://bucket/run", "1"], LOCAL),
        (["run", "town", "-o", "s3://me:T0PSECRET@bucket/run"], "user and password do not belong into a URL"),
        (["status", "s3://bucket/run?key=T0PSECRET"], "may hold a secret"),
        (["run", "https://T0PSECRET/town", "-o", "x"], "is no store that PanoLOG knows"),
        (["run", "town", "-o", "run", "--local", "x"], "only with the URL of a run"),
        (["resume", "run", "--force"], "only with the URL of a run"),
        (["report", "file:///nowhere/run"], "give -o FILE.html"),
        (["status", "file:///nowhere/run"], "there is no run"),
        (["run", "file:///nowhere/town", "-o", "new"], "there is no COLMAP model"),
        (["doctor", "s3://bucket/town?key=T0PSECRET"], "may hold a secret"),
    ],
)
def test_a_url_that_cannot_be_used_is_one_line(
    words: list[str], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(FOLDER, str(tmp_path / "cache"))
    end = call(*words)
    assert (end.exit_code, end.stdout) == (2, "")
    said = [it for it in end.stderr.splitlines() if it.startswith("panolog: ")]
    assert len(said) == 1
    assert line in end.stderr.replace("\n", " ")
    assert "T0PSECRET" not in end.stderr
    assert [it.name for it in tmp_path.iterdir()] in ([], ["cache"])


def test_the_local_folder_of_a_url_is_always_the_same(tmp_path: Path) -> None:
    environment = {FOLDER: str(tmp_path / "store")}
    first = local_folder("file:///place/run", environment)
    assert first == local_folder("file:///place/run", environment)
    assert first.parent == tmp_path / "runs"
    assert first != local_folder("file:///other/run", environment)
    plan = settings_of("file:///place/run/", None, environment, resumes=False)
    assert plan is not None
    assert (plan.root, plan.url) == (first, "file:///place/run")
    assert MIRROR_SETTINGS.validate_json(MIRROR_SETTINGS.dump_json(plan)) == plan


def test_wrong_variables_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="write a number above 0"):
        settings_of("file:///place/run", tmp_path, {"PANOLOG_STORE_SECONDS": "often"}, resumes=False)
