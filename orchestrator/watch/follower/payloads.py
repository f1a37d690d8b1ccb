"""A notification in the shape that each kind of target takes.

Webhooks are signed as https://www.standardwebhooks.com (1.0) defines it: `webhook-signature` is "v1," and the
base64 of HMAC-SHA256 over "ID.TIMESTAMP.BODY"; a secret that begins with "whsec_" is base64 after that.
Slack: https://api.slack.com/messaging/webhooks. ntfy: https://docs.ntfy.sh/publish/#publish-as-json.
"""

import base64
import binascii
import hashlib
import hmac
import html
import json
from contextlib import suppress
from email.message import EmailMessage
from typing import Any
from urllib.parse import urlsplit, urlunsplit
from urllib.request import Request

from panolog.orchestrator.watch.follower.notifications import Kind, Notification
from panolog.orchestrator.watch.follower.targets import Target

_PREFIX = "whsec_"
_NTFY = {  # tag, which ntfy shows as an emoji, and priority
    Kind.DONE: ("white_check_mark", 3),
    Kind.FAILED: ("x", 4),
    Kind.STALLED: ("hourglass", 4),
    Kind.PREEMPTED: ("wave", 3),
    Kind.OVER_BUDGET: ("moneybag", 4),
    Kind.TEST: ("test_tube", 3),
}


def post_of(target: Target, notification: Notification, now: float) -> Request:
    """The request for a webhook, Slack or ntfy. Args: now, seconds since the epoch."""
    url, headers, content = target.url, dict[str, str](), payload(notification)
    if target.kind == "slack":
        text = html.escape(f"*{notification.title}*: {notification.text}", quote=False)
        content = {"text": text}
    elif target.kind == "ntfy":
        url, topic = _topic(target.url)
        tag, priority = _NTFY[notification.kind]
        content = {"topic": topic, "title": notification.title, "message": notification.text}
        content |= {"tags": [tag], "priority": priority}
        headers = {"Authorization": f"Bearer {target.secret}"} if target.secret else {}
    body = json.dumps(content, allow_nan=False).encode()
    if target.kind == "webhook":
        headers = {"webhook-id": notification.id, "webhook-timestamp": str(int(now))}
        if target.secret:
            headers["webhook-signature"] = signature(target.secret, notification.id, int(now), body)
    headers = {"Content-Type": "application/json", "User-Agent": "panolog", **headers}
    return Request(url, body, headers, method="POST")


def payload(notification: Notification) -> dict[str, Any]:
    """The JSON of a webhook."""
    return {
        "type": f"run.{notification.kind}",
        "id": notification.id,
        "time": notification.time,
        "run": notification.run,
        "text": notification.text,
        "data": notification.facts,
    }


def signature(secret: str, id: str, timestamp: int, body: bytes) -> str:
    """The header `webhook-signature`."""
    key = secret.encode()
    if secret.startswith(_PREFIX):
        with suppress(binascii.Error):  # else it is used as it is
            key = base64.b64decode(secret.removeprefix(_PREFIX), validate=True)
    digest = hmac.new(key, f"{id}.{timestamp}.".encode() + body, hashlib.sha256).digest()
    return f"v1,{base64.b64encode(digest).decode()}"


def mail_of(target: Target, notification: Notification) -> EmailMessage:
    """The message for a mail server. Its Message-ID is that of the notification."""
    parts = urlsplit(target.url)
    message = EmailMessage()
    message["Subject"] = notification.title
    message["From"] = target.user if "@" in target.user else f"panolog@{parts.hostname}"
    message["To"] = parts.path.strip("/")
    message["Message-ID"] = f"<{notification.id}@panolog>"
    facts = json.dumps(payload(notification), indent=2, allow_nan=False)
    message.set_content(f"{notification.text}\n\n{facts}\n")
    return message


def _topic(url: str) -> tuple[str, str]:
    """Where ntfy takes JSON, and the topic, of the URL of a topic."""
    parts = urlsplit(url)
    folder, _, topic = parts.path.rpartition("/")
    return urlunsplit(parts._replace(path=f"{folder}/")), topic
