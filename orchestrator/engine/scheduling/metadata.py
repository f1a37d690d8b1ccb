"""What metadata services say of a machine's end: those of Amazon EC2, Google Compute Engine and Azure.

All three answer at the same link-local address, which only the machine itself reaches. Sources:
docs.aws.amazon.com/AWSEC2/latest/UserGuide/spot-instance-termination-notices.html and
/rebalance-recommendations.html,
cloud.google.com/compute/docs/instances/preemptible and /compute/docs/metadata/getting-live-migration-notice,
learn.microsoft.com/azure/virtual-machines/linux/scheduled-events.
"""

import json
import os
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from http.client import HTTPConnection, HTTPException
from pathlib import Path
from threading import Event, Timer
from typing import Any, ClassVar, Protocol
from urllib.parse import urlsplit

from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.runs.records import Leaving

ADDRESS = "http://169.254.169.254"
VARIABLE = "PANOLOG_METADATA_URL"  # another address for all of them, for tests
DMI = Path("/sys/class/dmi/id")  # what the machine's firmware says of it
TIMEOUT_S = 1.0  # of one request, to its last byte
_LIMIT = 2**16  # bytes of an answer
_DAY_S = 86_400.0  # no provider announces earlier; a clock that is off may say so
_GOOGLE_S = 30.0  # between a pre-emption's announcement and the end, on Compute Engine
_AZURE_ASSET = "7783-7084-3265-9085-8269-3286-77"  # chassis tag of all machines of Azure


class NoAnswerError(Exception):
    """The service did not answer as it should: nothing is known."""


@dataclass(frozen=True)
class Answer:
    status: int
    body: str
    headers: Mapping[str, str]


class Service:
    def __init__(self, url: str) -> None:
        """Args: url, http://HOST[:PORT]. Raises ValueError if it is none."""
        parts = urlsplit(url)
        if parts.scheme != "http" or not parts.hostname:
            raise ValueError(f"{VARIABLE}={url}: write http://HOST:PORT")
        self._host, self._port = parts.hostname, parts.port or 80

    def request(self, path: str, headers: Mapping[str, str], method: str = "GET") -> Answer:
        """What it answers. Raises NoAnswerError if that takes too long or is too large."""
        try:
            with closing(HTTPConnection(self._host, self._port, timeout=TIMEOUT_S)) as connection:
                connection.connect()
                with _cut_when_late(connection.sock) as late:
                    connection.request(method, path, headers=dict(headers))
                    response = connection.getresponse()
                    body = response.read(_LIMIT + 1)
                if len(body) > _LIMIT:
                    raise NoAnswerError(f"{path}: more than {_LIMIT} bytes")
                if response.length or late.is_set():
                    raise NoAnswerError(f"{path}: it ends after {len(body)} bytes")
                return Answer(response.status, body.decode(), dict(response.getheaders()))
        except (OSError, HTTPException, UnicodeDecodeError) as error:
            raise NoAnswerError(f"{path}: {error}") from error

    def text(self, path: str, headers: Mapping[str, str]) -> str | None:
        """The body of an answer; None if there is no such value. Raises NoAnswerError for all others."""
        answer = self.request(path, headers)
        if answer.status not in (200, 404):
            raise NoAnswerError(f"{path}: HTTP {answer.status}")
        return answer.body.strip() if answer.status == 200 else None


@contextmanager
def _cut_when_late(connected: socket.socket) -> Iterator[Event]:
    """Shuts a socket down after TIMEOUT_S, which is said by the event: its own timeout is of each read.

    A connection forgets its socket once an answer of HTTP/1.0 has begun, so it cannot be cut through that.
    """
    late = Event()

    def cut() -> None:
        late.set()
        with suppress(OSError):  # it has just been closed
            connected.shutdown(socket.SHUT_RDWR)

    timer = Timer(TIMEOUT_S, cut)
    timer.start()
    try:
        yield late
    finally:
        timer.cancel()


class Provider(Protocol):
    """The service of one provider."""

    withdraws: ClassVar[tuple[Leaving, ...]]  # notices that may be withdrawn

    def notice(self) -> LeaveNotice | None:
        """Whether this machine leaves. Raises NoAnswerError if the service does not say."""


@dataclass
class Amazon:
    """EC2, by version 2 of its protocol: each request has a token."""

    withdraws: ClassVar[tuple[Leaving, ...]] = (Leaving.REBALANCE,)
    service: Service
    _token: str = ""

    def there(self) -> bool:
        self._renew()
        return bool(self._token)

    def notice(self) -> LeaveNotice | None:
        """Amazon's leave notice: a spot interruption, with its time, or a rebalance recommendation."""
        if (action := self._get("spot/instance-action")) is not None:
            return LeaveNotice(Leaving.PREEMPTION, _until(_fields(action).get("time")))
        recommended = self._get("events/recommendations/rebalance") is not None
        return LeaveNotice(Leaving.REBALANCE) if recommended else None

    def _get(self, name: str) -> str | None:
        path = f"/latest/meta-data/{name}"
        if self._token:
            answer = self.service.request(path, {"X-aws-ec2-metadata-token": self._token})
            if answer.status == 200:
                return answer.body
            if answer.status == 404:
                return None
        self._renew()  # none yet, or it has expired
        return self.service.text(path, {"X-aws-ec2-metadata-token": self._token})

    def _renew(self) -> None:
        seconds = {"X-aws-ec2-metadata-token-ttl-seconds": "21600"}
        answer = self.service.request("/latest/api/token", seconds, "PUT")
        token = answer.body.strip()
        if answer.status != 200 or not token.isascii() or not token.isprintable():
            raise NoAnswerError(f"no token: HTTP {answer.status}")
        self._token = token


_OF_GOOGLE = {"Metadata-Flavor": "Google"}


@dataclass
class Google:
    withdraws: ClassVar[tuple[Leaving, ...]] = (Leaving.MAINTENANCE,)  # it may be over
    service: Service

    def there(self) -> bool:
        answer = self.service.request("/computeMetadata/v1/", _OF_GOOGLE)
        return _OF_GOOGLE.items() <= answer.headers.items()

    def notice(self) -> LeaveNotice | None:
        """Google's leave notice: a pre-emption, or maintenance for which the machine is stopped."""
        if self._get("preempted") == "TRUE":
            return LeaveNotice(Leaving.PREEMPTION, _GOOGLE_S)
        stops = self._get("maintenance-event") == "TERMINATE_ON_HOST_MAINTENANCE"
        return LeaveNotice(Leaving.MAINTENANCE) if stops else None

    def _get(self, name: str) -> str | None:
        return self.service.text(f"/computeMetadata/v1/instance/{name}", _OF_GOOGLE)


_OF_AZURE = {"Metadata": "true"}
_EVENTS = {
    "Preempt": Leaving.PREEMPTION,
    "Terminate": Leaving.TERMINATION,
    "Reboot": Leaving.MAINTENANCE,
    "Redeploy": Leaving.MAINTENANCE,
}


@dataclass
class Azure:
    """Azure's Scheduled Events, those of this machine: the service lists those of its whole group."""

    withdraws: ClassVar[tuple[Leaving, ...]] = tuple(Leaving)  # any event may be cancelled
    service: Service
    _name: str = ""

    def there(self) -> bool:
        self._find_name()
        return bool(self._name)

    def notice(self) -> LeaveNotice | None:
        """Azure's leave notice: the event that comes first."""
        if not self._name:
            self._find_name()
        text = self.service.text("/metadata/scheduledevents?api-version=2020-07-01", _OF_AZURE)
        events = _fields(text or "{}").get("Events")
        notices = list(self._notices(events if isinstance(events, list) else []))
        return min(notices, key=lambda one: _DAY_S if one.seconds is None else one.seconds, default=None)

    def _notices(self, events: list[Any]) -> Iterator[LeaveNotice]:
        for event in events:
            resources = event.get("Resources") if isinstance(event, dict) else None
            if isinstance(resources, list) and self._name in resources:
                kind = _EVENTS.get(str(event.get("EventType")))
                begun = event.get("EventStatus") == "Started"
                if kind is not None:
                    yield LeaveNotice(kind, 0.0 if begun else _until(event.get("NotBefore")))

    def _find_name(self) -> None:
        path = "/metadata/instance/compute/name?api-version=2021-02-01&format=text"
        self._name = self.service.text(path, _OF_AZURE) or ""


_KINDS: tuple[Callable[[Service], Amazon | Google | Azure], ...] = (Amazon, Google, Azure)


def detect(dmi: Path = DMI) -> Provider | None:
    """The service of this machine's provider; None if there is none.

    It follows from the maker that the firmware names. Where the firmware names nothing, as in some
    containers, or `VARIABLE` has another address, each service is requested once. Raises ValueError if that
    address is none.
    """
    url = os.environ.get(VARIABLE, "")
    service = Service(url or ADDRESS)
    if not url and dmi.is_dir():
        made = _by_firmware(dmi)
        return made(service) if made else None
    for made in _KINDS:
        with suppress(NoAnswerError):
            if (provider := made(service)).there():
                return provider
    return None


def _by_firmware(dmi: Path) -> Callable[[Service], Amazon | Google | Azure] | None:
    names = ("sys_vendor", "bios_vendor", "bios_version", "product_name", "chassis_asset_tag")
    texts = {name: _read(dmi / name) for name in names}
    if texts["chassis_asset_tag"] == _AZURE_ASSET:
        return Azure
    if texts["product_name"] == "Google Compute Engine":
        return Google
    amazon = (texts["sys_vendor"], texts["bios_vendor"], texts["bios_version"])
    return Amazon if any("amazon" in text.lower() for text in amazon) else None


def _read(file: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        return file.read_text().strip()
    return ""


def _fields(text: str) -> dict[str, Any]:
    """A JSON object. Raises NoAnswerError if it is none."""
    try:
        fields = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise NoAnswerError(f"{text[:80]!a} is not JSON") from error
    if not isinstance(fields, dict):
        raise NoAnswerError(f"{text[:80]!a} is not an object")
    return fields


def _until(text: Any) -> float | None:
    """Seconds from now to a time as RFC 3339 or RFC 5322 write it, not below 0; None if it is neither."""
    if not isinstance(text, str):
        return None
    for parse in (_rfc3339, parsedate_to_datetime):
        with suppress(ValueError, TypeError, OverflowError):
            time_ = parse(text)
            aware = time_ if time_.tzinfo else time_.replace(tzinfo=timezone.utc)
            return min(max(0.0, aware.timestamp() - time.time()), _DAY_S)
    return None


def _rfc3339(text: str) -> datetime:
    return datetime.fromisoformat(text.replace("Z", "+00:00"))  # Python 3.10 does not know Z
