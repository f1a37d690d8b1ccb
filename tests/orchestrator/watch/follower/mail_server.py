"""A mail server for tests: plain, or encrypting with a certificate of a test's authority."""

import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from email import message_from_bytes
from email.message import Message
from typing import Any, Literal

import trustme
from aiosmtpd.controller import Controller
from aiosmtpd.smtp import SMTP, AuthResult, Envelope, LoginPassword, Session

HERE, ELSEWHERE = "127.0.0.1", "127.0.0.2"  # both of this machine; the other is no name of it to `sending`
Encryption = Literal["tls", "starttls", "none"]


@dataclass
class Mailbox:
    """A mail server and what it has got."""

    refuse: str = ""  # its answer to recipients
    port: int = 0
    messages: list[Message] = field(default_factory=list)
    logins: list[tuple[str, str]] = field(default_factory=list)  # user and password
    encrypted: list[bool] = field(default_factory=list)  # of each message

    # aiosmtpd gives the hooks their names.
    async def handle_RCPT(  # noqa: N802
        self, _: SMTP, session: Session, envelope: Envelope, address: str, options: list[str]
    ) -> str:
        """Takes a recipient, or none."""
        if not self.refuse:
            envelope.rcpt_tos.append(address)
        return self.refuse or "250 fine"

    async def handle_DATA(self, server: SMTP, session: Session, envelope: Envelope) -> str:  # noqa: N802
        """Takes a message."""
        assert isinstance(envelope.content, bytes) and server.transport is not None
        self.messages.append(message_from_bytes(envelope.content))
        self.encrypted.append(server.transport.get_extra_info("sslcontext") is not None)
        return "250 taken"

    def login(self, _: SMTP, session: Session, envelope: Envelope, how: str, given: Any) -> AuthResult:
        """Lets everybody in."""
        assert isinstance(given, LoginPassword)
        self.logins.append((given.login.decode(), given.password.decode()))
        return AuthResult(success=True)


@contextmanager
def mailbox(
    refuse: str = "",
    *,
    host: str = HERE,
    how: Encryption = "none",
    authority: trustme.CA | None = None,
    name: str = ELSEWHERE,
) -> Iterator[Mailbox]:
    """A mail server while the context lasts.

    Args: refuse, its answer to recipients; authority, of its certificate; name, for which that is.
    """
    box, context = Mailbox(refuse), None
    if authority is not None:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        authority.issue_cert(name).configure_cert(context)
    server = _Server(
        box,
        hostname=host,
        port=0,
        ready_timeout=120.0,
        authenticator=box.login,
        auth_require_tls=how == "starttls",  # TLS from the start is none to aiosmtpd
        require_starttls=how == "starttls",
        tls_context=context if how == "starttls" else None,
        ssl_context=context if how == "tls" else None,
    )
    server.start()
    box.port = server.port
    try:
        yield box
    finally:
        server.stop()


class _Server(Controller):
    """A server at a free port."""

    def _trigger_server(self) -> None:
        self.port = self.server.sockets[0].getsockname()[1]  # type: ignore[union-attr]
        super()._trigger_server()  # type: ignore[no-untyped-call]
