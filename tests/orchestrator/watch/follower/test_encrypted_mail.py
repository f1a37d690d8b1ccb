"""Mail over TLS and STARTTLS, against a real server: no password goes to one that cannot prove who it is."""

from pathlib import Path

import pytest
import trustme

from panolog.orchestrator.watch.follower.sending import Refusal, send
from panolog.orchestrator.watch.follower.targets import Target
from tests.orchestrator.watch.follower.mail_server import ELSEWHERE, Encryption, Mailbox, mailbox
from tests.orchestrator.watch.follower.test_sending import DONE, SECRET


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
