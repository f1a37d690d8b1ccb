"""`panolog notify test`, and what `run` refuses before it begins."""

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from panolog.orchestrator.cli import app
from tests.orchestrator.follower.receivers import receiver
from tests.scenes import write_scene


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app.app, [str(argument) for argument in arguments])


def refused(result: Result) -> str:
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert "T0PSECRET" not in line
    return line


def test_a_test_message_arrives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with receiver() as server:
        monkeypatch.setenv("HOOK", f"{server.url}/T0PSECRET")
        result = call("notify", "test", tmp_path / "place", "--notify", "webhook:env:HOOK")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "sent to webhook:env:HOOK\n")
    (request,) = server.received
    assert (request.json["type"], request.json["run"]) == ("run.test", "place")


def test_a_test_message_that_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with receiver([404]) as server:
        monkeypatch.setenv("PANOLOG_NOTIFY", f"slack:{server.url}/T0PSECRET slack:{server.url}/other")
        result = call("notify", "test")
    assert result.exit_code == 2
    assert "T0PSECRET" not in result.stderr
    sent, failed = result.stderr.splitlines()
    assert sent == "sent to PANOLOG_NOTIFY#2"
    assert failed.startswith("panolog: notify PANOLOG_NOTIFY#1: the server answers HTTP 404; check the URL")


def test_no_target(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PANOLOG_NOTIFY", raising=False)
    assert "give --notify KIND:URL or set PANOLOG_NOTIFY" in refused(call("notify", "test"))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--notify", "slack:https://hooks.slack.com/T0PSECRET"), "its URL is a secret"),
        (("--notify", "slack:env:NOTHING"), "is not set"),
        (("--log", "excel"), "there is no such sink"),
    ],
)
def test_wrong_options_begin_no_run(tmp_path: Path, options: tuple[str, ...], expected: str) -> None:
    scene = write_scene(tmp_path / "scene")
    assert expected in refused(call("run", scene, "-o", tmp_path / "run", *options))
    assert not (tmp_path / "run").exists()
