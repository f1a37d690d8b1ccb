"""Each kind of target gets its shape; what goes wrong is described without a secret, which mail encrypts."""

import json
from pathlib import Path

import pytest
import trustme

from panolog.orchestrator.watch.follower.notifications import Kind, Notification
from panolog.orchestrator.watch.follower.sending import Refusal, send
from panolog.orchestrator.watch.follower.shapes import signature
from panolog.orchestrator.watch.follower.targets import Target
from tests.orchestrator.watch.follower.mail_server import ELSEWHERE, Encryption, Mailbox, mailbox
from tests.orchestrator.watch.follower.receivers import receiver

SECRET = "T0PSECRET"
DONE = Notification(
    "ab-done-7", Kind.DONE, 1e9, "place", "the model is ready", {"metrics": {"psnr": 30.0}}, 7
)


def target(kind: str, url: str, user: str = "", secret: str = SECRET) -> Target:
    return Target(kind, "label", url, user, secret)


def test_a_webhook_is_signed_over_id_time_and_body() -> None:
    with receiver() as server:
        assert send(target("webhook", f"{server.url}/hook"), DONE) is None
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
        assert send(target("slack", f"{server.url}/services/x"), DONE) is None
        assert send(target("ntfy", f"{server.url}/base/topic"), DONE) is None
    slack, ntfy = server.received
    assert slack.json == {"text": "*PanoLOG place: done*: the model is ready"}
    assert ntfy.path == "/base/"
    assert ntfy.json["topic"] == "topic"
    assert ntfy.json["message"] == "the model is ready"
    assert ntfy.headers["authorization"] == f"Bearer {SECRET}"


def test_mail_has_the_id_and_all_facts() -> None:
    with mailbox() as box:
        assert send(target("mail", f"smtp://127.0.0.1:{box.port}/a@b.c,d@e.f", "me@b.c"), DONE) is None
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
        refusal = send(target("webhook", f"{server.url}/{SECRET}"), DONE)
    assert refusal is not None
    assert refusal.final is final
    assert f"HTTP {code}" in refusal.reason
    assert SECRET not in refusal.reason
    assert len(server.received) == 1  # a redirect is not followed


@pytest.mark.parametrize("url", ["http://127.0.0.1:1/{}", "http://a..b/{}", "smtp://127.0.0.1:1/{}@b.c"])
def test_a_server_that_is_not_there(url: str) -> None:
    kind = "mail" if url.startswith("smtp") else "webhook"
    refusal = send(target(kind, url.format(SECRET)), DONE)
    assert refusal is not None
    assert SECRET not in refusal.reason


@pytest.mark.parametrize(("answer", "final"), [("550 no such box", True), ("451 later", False)])
def test_a_mail_server_that_refuses(answer: str, final: bool) -> None:
    with mailbox(answer) as box:
        refusal = send(target("mail", f"smtp://127.0.0.1:{box.port}/a@b.c"), DONE)
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
