"""Targets and their secrets: where these may be, and that no message shows them."""

from pathlib import Path

import pytest

from panolog.orchestrator.watch.follower.plan import from_json, read_plan, to_json
from panolog.orchestrator.watch.follower.targets import Target
from panolog.scene.errors import ConfigError

SECRET = "T0PSECRET"
SLACK = f"https://hooks.slack.com/services/{SECRET}"


def targets(*given: str, **environment: str) -> tuple[Target, ...]:
    plan, _ = read_plan(given, (), {"HOME": "/nowhere", "NETRC": "/nowhere/netrc", **environment})
    return plan.targets


def private(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


def test_a_url_comes_from_a_file_or_a_variable(tmp_path: Path) -> None:
    file = private(tmp_path / "slack", SLACK + "\n")
    for given in (f"slack:@{file}", "slack:env:HOOK"):
        (target,) = targets(given, HOOK=SLACK)
        assert (target.kind, target.label, target.url) == ("slack", given, SLACK)
        assert SECRET not in repr(target)


def test_several_targets_come_from_one_file_or_variable(tmp_path: Path) -> None:
    file = private(tmp_path / "all", f"# mine\nslack:{SLACK}\nntfy:https://ntfy.sh/{SECRET}\n")
    found = targets(
        f"@{file}", PANOLOG_NOTIFY=f"slack:@{private(tmp_path / 'one', SLACK)}", PANOLOG_NTFY_TOKEN="tk"
    )
    assert [it.kind for it in found] == ["slack", "ntfy", "slack"]
    assert [it.label for it in found] == [f"@{file}#1", f"@{file}#2", "PANOLOG_NOTIFY#1"]
    assert [it.secret for it in found] == ["", "tk", ""]


def test_secrets_of_a_target_come_from_variables_and_files(tmp_path: Path) -> None:
    file = private(tmp_path / "secret", f"{SECRET}\n")
    (hook,) = targets("webhook:https://h.example/a", PANOLOG_NOTIFY_SECRET=f"@{file}")
    assert (hook.secret, hook.label) == (SECRET, "webhook:https://h.example/…")
    netrc = private(tmp_path / "netrc", f"machine mail.example login me password {SECRET}\n")
    (mail,) = targets("mail:smtp://mail.example:25/a@b.c", NETRC=str(netrc))
    assert (mail.user, mail.secret) == ("me", SECRET)
    (mail,) = targets("mail:smtp://mail.example/a@b.c", PANOLOG_SMTP_USER="you", PANOLOG_SMTP_PASSWORD=SECRET)
    assert (mail.user, mail.secret) == ("you", SECRET)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (f"slack:{SLACK}", "slack:https://hooks.slack.com/…: its URL is a secret"),
        (f"ntfy:https://ntfy.sh/{SECRET}", "--notify ntfy:@FILE"),
        (f"webhook:https://h.example/?key={SECRET}", "use webhook:@FILE or webhook:env:NAME"),
        (f"webhook:https://me:{SECRET}@h.example/", "user, password and # are no part of the URL"),
        (f"webhook:ftp://h.example/{SECRET}", "not a URL of the form https://HOST/PATH"),
        (f"webhook:https://[{SECRET}/", "not a URL of the form"),
        (f"webhook:https://h.example/{SECRET}\r\nX: y", "not a URL of the form"),
        (f"webhook:https://h.example/{SECRET * 300}", "not a URL of the form"),
        (f"mail:smtp://h.example/{SECRET}", "smtp://HOST:PORT/TO"),
        (SLACK, "with one of the kinds webhook, slack, ntfy, mail"),
        ("slack:env:NOTHING", "the environment variable NOTHING is not set"),
        ("slack:@/nowhere/x", "/nowhere/x cannot be read: No such file or directory"),
        ("slack:@/dev/zero", "/dev/zero is not a plain file"),
    ],
)
def test_what_is_no_target_is_refused_without_its_secret(given: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        targets(given)
    assert expected in str(caught.value)
    assert SECRET not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "mode", "expected"),
    [
        (SLACK, 0o640, "chmod 600"),
        (SLACK, 0o604, "chmod 600"),
        ("", 0o600, "is empty"),
        ("x" * 70_000, 0o600, "more than 65536 bytes"),
        (f"slack:{SLACK} nonsense:{SECRET}", 0o600, "with one of the kinds"),
        (" ".join(f"webhook:https://h{number}.example/" for number in range(21)), 0o600, "give at most 20"),
    ],
)
def test_wrong_files_of_targets(tmp_path: Path, text: str, mode: int, expected: str) -> None:
    file = private(tmp_path / "file", text, mode)
    with pytest.raises(ConfigError, match=expected) as caught:
        targets(f"@{file}")
    assert SECRET not in str(caught.value)


WRONG: dict[str, tuple[list[str], list[str], dict[str, str]]] = {  # targets, sinks and variables
    "line 1 is not of netrc's format": (["mail:smtp://mail.example/a@b.c"], [], {}),
    "is given twice; give it once": (["webhook:https://h.example/a", "webhook:https://h.example/b"], [], {}),
    "choose one of mlflow, tensorboard, wandb": ([], ["excel"], {}),
    "a sink is given twice": ([], ["tensorboard", "tensorboard:x"], {}),
    "MLFLOW_TRACKING_URI": ([], ["mlflow"], {}),
    "MLFLOW_TRACKING_USERNAME": ([], [f"mlflow:http://me:{SECRET}@h/"], {}),
    "pip install wandb": ([], ["wandb"], {}),
    **{
        f"{minutes}.*write minutes": ([], [], {"PANOLOG_NOTIFY_STALLED": minutes})
        for minutes in ("soon", "0", "-1", "nan", "inf")
    },
}


@pytest.mark.parametrize("line", WRONG)
def test_what_a_plan_cannot_have_is_one_line_without_a_secret(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    netrc = private(tmp_path / "netrc", f"machine mail.example login me passwort {SECRET}\n")
    missing = {"wandb": None}
    monkeypatch.setattr(
        "panolog.orchestrator.watch.follower.plan.find_spec", lambda name: missing.get(name, "there")
    )
    notify, log, variables = WRONG[line]
    with pytest.raises(ConfigError, match=line) as caught:
        read_plan(notify, log, {"NETRC": str(netrc), **variables})
    assert SECRET not in str(caught.value)


def test_variables_with_secrets_are_named_so_that_no_other_process_gets_them() -> None:
    _, used = read_plan(["slack:env:HOOK"], (), {"HOOK": SLACK})
    assert {"HOOK", "PANOLOG_NOTIFY"} <= used


def test_a_plan_reaches_the_follower_whole(tmp_path: Path) -> None:
    plan, _ = read_plan(["slack:env:HOOK"], (), {"HOOK": SLACK, "PANOLOG_NOTIFY_STALLED": "0.5"})
    root, _, there = from_json(to_json(plan, tmp_path))
    assert (root, there) == (tmp_path, plan)
    assert plan.stalled == 30
