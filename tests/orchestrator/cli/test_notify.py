"""`panolog notify test`; what `run` refuses before it begins, and that no process inherits its secrets."""

import os
from pathlib import Path

import pytest

from tests.orchestrator.cli.program import call, one_line
from tests.orchestrator.watch.follower import histories
from tests.orchestrator.watch.follower.mail_server import mailbox
from tests.orchestrator.watch.follower.receivers import receiver
from tests.ray_head import living, wait_until
from tests.scenes import write_scene


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


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("notify", "test"), "give --notify KIND:URL or set PANOLOG_NOTIFY"),
        (("run", "town", "-o", "run", "--notify", "slack:https://hooks.slack.com/T0PSECRET"), "is a secret"),
        (("run", "town", "-o", "run", "--notify", "slack:env:NOTHING"), "is not set"),
        (("run", "town", "-o", "run", "--log", "excel"), "there is no such sink"),
    ],
)
def test_wrong_options_begin_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], expected: str
) -> None:
    monkeypatch.delenv("PANOLOG_NOTIFY", raising=False)
    monkeypatch.chdir(tmp_path)
    write_scene(tmp_path / "town")
    line = one_line(call(*words))
    assert expected in line and "T0PSECRET" not in line
    assert not (tmp_path / "run").exists()


def test_a_run_gives_its_secrets_to_no_process_and_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A follower of its own gets them, on a pipe; Ray and the workers would inherit the environment."""
    seen: list[str] = []

    def start(_: object, root: Path, *__: object) -> None:
        seen.append(repr(os.environ))
        wait_until(lambda: living("panolog.orchestrator.watch.follower"), "the follower")
        (follower,) = living("panolog.orchestrator.watch.follower")
        seen.append(repr((follower.cmdline(), follower.environ())))
        histories.write(root)

    monkeypatch.setattr("panolog.orchestrator.cli.session.session.start", start)
    monkeypatch.setattr("panolog.orchestrator.cli.run.say_results", lambda *_: None)
    secrets = ["HOOK", "PANOLOG_NOTIFY", "PANOLOG_NOTIFY_SECRET", "PANOLOG_NTFY_TOKEN"]
    secrets += ["PANOLOG_SMTP_USER", "PANOLOG_SMTP_PASSWORD"]
    with receiver() as server, mailbox() as box:
        for name in secrets:
            monkeypatch.setenv(name, "T0PSECRET")
        monkeypatch.setenv("HOOK", f"{server.url}/T0PSECRET")
        monkeypatch.setenv("PANOLOG_NOTIFY", f"ntfy:{server.url}/T0PSECRET")
        options = ("--notify", "webhook:env:HOOK", "--notify", f"mail:smtp://127.0.0.1:{box.port}/you@there")
        result = call("run", write_scene(tmp_path / "town"), "-o", tmp_path / "run", *options)
    assert result.exit_code == 0, result.output
    assert sorted(it.path for it in server.received) == ["/", "/T0PSECRET"]
    assert len(box.messages) == 1
    written = [path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert len(written) > 3
    assert not [said for said in (*seen, result.output, *map(repr, written)) if "T0PSECRET" in said]
