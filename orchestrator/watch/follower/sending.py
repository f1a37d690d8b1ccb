"""Sends one notification to one target, once. What goes wrong is described without the URL or a secret.

The package apprise would be less code, but says only whether a message was taken: neither why not nor when to
try again, and it sends neither ids nor signatures.
"""

import http.client
import smtplib
import ssl
import time
from dataclasses import dataclass
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from panolog.orchestrator.watch.follower.notifications import Notification
from panolog.orchestrator.watch.follower.payloads import mail_of, post_of
from panolog.orchestrator.watch.follower.targets import Target

_TIMEOUT_S = 10.0  # to connect, and for each answer
_LATER = (408, 425, 429)  # of 4xx, those after which the same request may succeed
_LONGEST_S = 300.0  # that a server can make us wait
_OWN = ("localhost", "127.0.0.1", "::1")  # hosts to which nothing need be encrypted


@dataclass(frozen=True)
class Refusal:
    """Why a notification was not taken."""

    reason: str  # one line
    final: bool  # whether the same request will be refused again
    after: float = 0.0  # seconds that the server wants us to wait


class _NoRedirect(HTTPRedirectHandler):
    """Follows no redirect: it would take a secret to another host."""

    def redirect_request(self, *_: Any) -> None:
        return None


def send(target: Target, notification: Notification) -> Refusal | None:
    """Delivers a notification. Returns None if it was taken."""
    if target.kind == "mail":
        return _mail(target, notification)
    return _post(post_of(target, notification, time.time()))


def _post(request: Request) -> Refusal | None:
    try:
        with build_opener(_NoRedirect).open(request, timeout=_TIMEOUT_S):
            return None
    except HTTPError as error:
        error.close()
        hint = ", a redirect, which is not followed" if 300 <= error.code < 400 else ""
        final = 300 <= error.code < 500 and error.code not in _LATER
        return Refusal(f"the server answers HTTP {error.code}{hint}", final, _after(error.headers))
    except UnicodeError:
        return Refusal("its host is no valid name", final=True)
    except URLError as error:
        return _no_answer(error.reason)
    except (OSError, http.client.HTTPException) as error:
        return _no_answer(error)


def _after(headers: Any) -> float:
    """Seconds of `Retry-After`, if it has a number."""
    text = str(headers.get("Retry-After", "")).strip()
    return min(float(text), _LONGEST_S) if text.isascii() and text.isdecimal() and len(text) < 10 else 0.0


def _no_answer(error: object) -> Refusal:
    if isinstance(error, ssl.SSLCertVerificationError):
        return Refusal(f"its certificate is not valid: {error.verify_message}", final=False)
    text = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
    return Refusal(f"no answer of its server ({text})", final=False)


def _mail(target: Target, notification: Notification) -> Refusal | None:
    parts = urlsplit(target.url)
    host, implicit = parts.hostname or "", parts.scheme == "smtps"
    port, context = parts.port or (465 if implicit else 587), ssl.create_default_context()
    try:
        message = mail_of(target, notification)
    except ValueError:
        return Refusal("its recipients are no valid addresses", final=True)
    try:
        if implicit:
            server: smtplib.SMTP = smtplib.SMTP_SSL(host, port, timeout=_TIMEOUT_S, context=context)
        else:
            server = smtplib.SMTP(host, port, timeout=_TIMEOUT_S)
        with server:
            if not implicit and host not in _OWN:
                server.ehlo()
                if server.has_extn("starttls"):
                    server.starttls(context=context)
                elif target.secret:
                    return Refusal(
                        "its server does not encrypt, so it gets no password; use smtps", final=True
                    )
            if target.user:
                server.login(target.user, target.secret)
            server.send_message(message)
    except smtplib.SMTPResponseException as error:
        return Refusal(f"the server answers SMTP {error.smtp_code}", final=error.smtp_code >= 500)
    except smtplib.SMTPRecipientsRefused as error:
        final = all(code >= 500 for code, _ in error.recipients.values())
        return Refusal("the server refuses its recipients", final)
    except (smtplib.SMTPNotSupportedError, UnicodeError):
        return Refusal("the server does not support what is needed: login or these addresses", final=True)
    except (smtplib.SMTPException, OSError) as error:
        return _no_answer(error)
    return None
