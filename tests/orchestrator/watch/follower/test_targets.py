"""Targets and their secrets, which no message shows: where these may be, and what each kind gets."""

import json
from pathlib import Path

import pytest
import trustme

from panolog.orchestrator.watch.follower.notifications import Kind, Notification
from panolog.orchestrator.watch.follower.payloads import signature
from panolog.orchestrator.watch.follower.recipients import from_json, read_recipients, to_json
from panolog.orchestrator.watch.follower.sending import Refusal, send
from panolog.orchestrator.watch.follower.targets import Target
from panolog.scene.errors import ConfigError
from tests.orchestrator.watch.follower.mail_server import ELSEWHERE, Encryption, Mailbox, mailbox
from tests.orchestrator.watch.follower.receivers import receiver

SECRET = "T0PSECRET"
SLACK = f"https://hooks.slack.com/services/{SECRET}"


def targets(*given: str, **environment: str) -> tuple[Target, ...]:
    plan, _ = read_recipients(given, (), {"HOME": "/nowhere", "NETRC": "/nowhere/netrc", **environment})
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
        "panolog.orchestrator.watch.follower.recipients.find_spec", lambda name: missing.get(name, "there")
    )
    notify, log, variables = WRONG[line]
    with pytest.raises(ConfigError, match=line) as caught:
        read_recipients(notify, log, {"NETRC": str(netrc), **variables})
    assert SECRET not in str(caught.value)


def test_variables_with_secrets_are_named_so_that_no_other_process_gets_them() -> None:
    _, used = read_recipients(["slack:env:HOOK"], (), {"HOOK": SLACK})
    assert {"HOOK", "PANOLOG_NOTIFY"} <= used


def test_a_plan_reaches_the_follower_whole(tmp_path: Path) -> None:
    plan, _ = read_recipients(["slack:env:HOOK"], (), {"HOOK": SLACK, "PANOLOG_NOTIFY_STALLED": "0.5"})
    root, _, there = from_json(to_json(plan, tmp_path))
    assert (root, there) == (tmp_path, plan)
    assert plan.stalled == 30


DONE = Notification(
    "ab-done-7", Kind.DONE, 1e9, "place", "the model is ready", {"metrics": {"psnr": 30.0}}, 7
)


def target_of(kind: str, url: str, user: str = "", secret: str = SECRET) -> Target:
    return Target(kind, "label", url, user, secret)


def test_a_webhook_is_signed_over_id_time_and_body() -> None:
    with receiver() as server:
        assert send(target_of("webhook", f"{server.url}/hook"), DONE) is None
    (request,) = server.received
    assert request.path == "/hook"
    assert request.json["type"] == "run.done"
    assert request.json["data"] == {"metrics": {"psnr": 30.0}}
    assert request.json["id"] == request.headers["webhook-id"] == DONE.id
    signed = signature(SECRET, DONE.id, int(request.headers["webhook-timestamp"]), request.body)
    assert request.headers["webhook-signature"] == signed


def test_the_signature_is_that_of_standard_webhooks() -> None:
    secret, id = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw", "msg_p5jXN8AQM9LWM0D4loKWxJek"
    signed = signature(secret, id, 1614265330, b'{"test": 2432232314}')
    assert signed == "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def test_slack_and_ntfy_get_their_shapes() -> None:
    with receiver() as server:
        assert send(target_of("slack", f"{server.url}/services/x"), DONE) is None
        assert send(target_of("ntfy", f"{server.url}/base/topic"), DONE) is None
    slack, ntfy = server.received
    assert slack.json == {"text": "*PanoLOG place: done*: the model is ready"}
    assert ntfy.path == "/base/"
    assert ntfy.json["topic"] == "topic"
    assert ntfy.json["message"] == "the model is ready"
    assert ntfy.headers["authorization"] == f"Bearer {SECRET}"


def test_mail_has_the_id_and_all_facts() -> None:
    with mailbox() as box:
        assert send(target_of("mail", f"smtp://127.0.0.1:{box.port}/a@b.c,d@e.f", "me@b.c"), DONE) is None
    (message,) = box.messages
    assert [message[name] for name in ("From", "To")] == ["me@b.c", "a@b.c,d@e.f"]
    assert message["Subject"] == "PanoLOG place: done"
    assert message["Message-ID"] == "<ab-done-7@panolog>"
    text, _, facts = str(message.get_payload()).replace("\r\n", "\n").partition("\n\n")
    assert text.strip() == "the model is ready"
    assert json.loads(facts)["data"] == DONE.facts
    assert box.logins == [("me@b.c", SECRET)]


@pytest.mark.parametrize(
    ("code", "final"),
    [(500, False), (503, False), (429, False), (408, False), (404, True), (403, True), (302, True)],
)
def test_which_answers_are_final(code: int, final: bool) -> None:
    with receiver([code]) as server:
        refusal = send(target_of("webhook", f"{server.url}/{SECRET}"), DONE)
    assert refusal is not None
    assert refusal.final is final
    assert f"HTTP {code}" in refusal.reason
    assert SECRET not in refusal.reason
    assert len(server.received) == 1  # a redirect is not followed


@pytest.mark.parametrize("url", ["http://127.0.0.1:1/{}", "http://a..b/{}", "smtp://127.0.0.1:1/{}@b.c"])
def test_a_server_that_is_not_there(url: str) -> None:
    kind = "mail" if url.startswith("smtp") else "webhook"
    refusal = send(target_of(kind, url.format(SECRET)), DONE)
    assert refusal is not None
    assert SECRET not in refusal.reason


@pytest.mark.parametrize(("answer", "final"), [("550 no such box", True), ("451 later", False)])
def test_a_mail_server_that_refuses(answer: str, final: bool) -> None:
    with mailbox(answer) as box:
        refusal = send(target_of("mail", f"smtp://127.0.0.1:{box.port}/a@b.c"), DONE)
    assert refusal is not None
    assert refusal.final is final


@pytest.fixture
def trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> trustme.CA:
    """An authority that this machine trusts."""
    authority = trustme.CA()
    authority.cert_pem.write_to_path(tmp_path / "authority.pem")
    monkeypatch.setenv("SSL_CERT_FILE", str(tmp_path / "authority.pem"))
    return authority


def sent(box: Mailbox, how: Encryption, user: str = "me@b.c") -> Refusal | None:
    url = f"smtp{'s' if how == 'tls' else ''}://{ELSEWHERE}:{box.port}/a@b.c"
    return send(Target("mail", "label", url, user, SECRET if user else ""), DONE)


@pytest.mark.parametrize("how", ["tls", "starttls"])
def test_mail_and_password_are_encrypted(trusted: trustme.CA, how: Encryption) -> None:
    with mailbox(host=ELSEWHERE, how=how, authority=trusted) as box:
        assert sent(box, how) is None
    assert (box.logins, box.encrypted) == ([("me@b.c", SECRET)], [True])
    assert "the model is ready" in box.messages[0].as_string()
    assert SECRET not in box.messages[0].as_string()


@pytest.mark.parametrize("how", ["tls", "starttls"])
@pytest.mark.parametrize("name", [ELSEWHERE, "mail.example"])
def test_a_certificate_of_an_unknown_authority_or_for_another_host_is_refused(
    trusted: trustme.CA, how: Encryption, name: str
) -> None:
    authority = trustme.CA() if name == ELSEWHERE else trusted
    with mailbox(host=ELSEWHERE, how=how, authority=authority, name=name) as box:
        refusal = sent(box, how)
    assert refusal is not None
    assert refusal.reason.startswith("its certificate is not valid: ")
    assert not refusal.final  # it may be renewed
    assert (box.logins, box.messages) == ([], [])


def test_a_server_that_does_not_encrypt_gets_no_password() -> None:
    with mailbox(host=ELSEWHERE) as box:
        refusal = sent(box, "none")
        assert refusal == Refusal(
            "its server does not encrypt, so it gets no password; use smtps", final=True
        )
        assert (box.logins, box.messages) == ([], [])
        assert sent(box, "none", user="") is None  # without a password there is nothing to keep
    assert (box.logins, box.encrypted) == ([], [False])


def test_a_server_of_the_other_kind_is_no_answer(trusted: trustme.CA) -> None:
    with mailbox(host=ELSEWHERE, how="starttls", authority=trusted) as box:
        refusal = sent(box, "tls")
    assert refusal is not None
    assert SECRET not in refusal.reason
    assert (box.logins, box.messages) == ([], [])
