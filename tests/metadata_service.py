"""A metadata service of each provider, which answers as the real ones document it."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread

TOKEN, NAME = "a-token", "worker-3"


@dataclass
class Metadata:
    """What the service says: values by path."""

    provider: str  # "amazon", "google", "azure", or "" for one that knows nothing
    url: str = ""
    values: dict[str, str] = field(default_factory=dict)
    status: int = 0  # in place of all other answers, if it is not 0
    slow: bool = False  # sends a byte now and then
    requests: list[str] = field(default_factory=list)
    tokens: int = 0  # that were made
    expired: bool = False  # the next request with a token fails
    looked: Event = field(default_factory=Event)  # something was requested

    def spot(self, seconds: float) -> None:
        """Amazon takes the machine away."""
        when = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() + seconds))
        action = json.dumps({"action": "terminate", "time": when})
        self.values["/latest/meta-data/spot/instance-action"] = action

    def event(self, kind: str, *, resources: tuple[str, ...] = (NAME,), before: str = "") -> None:
        """Azure has scheduled an event."""
        fields = {"EventId": "1", "EventType": kind, "Resources": resources, "EventStatus": "Scheduled"}
        events = {"DocumentIncarnation": 1, "Events": [fields | {"NotBefore": before}]}
        self.values["/metadata/scheduledevents?api-version=2020-07-01"] = json.dumps(events)


@contextmanager
def metadata(provider: str, host: str = "127.0.0.1") -> Iterator[Metadata]:
    """A service for as long as the context lasts. Args: host, this machine's address."""
    known = Metadata(provider)
    if provider == "google":
        known.values |= {
            "/computeMetadata/v1/": "instance/",
            "/computeMetadata/v1/instance/preempted": "FALSE",
            "/computeMetadata/v1/instance/maintenance-event": "NONE",
        }
    if provider == "azure":
        known.values["/metadata/instance/compute/name?api-version=2021-02-01&format=text"] = NAME
        known.values["/metadata/scheduledevents?api-version=2020-07-01"] = '{"Events": []}'
    server = ThreadingHTTPServer((host, 0), _handler(known))
    known.url = f"http://{host}:{server.server_port}"
    thread = Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield known
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def _handler(known: Metadata) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_PUT(self) -> None:
            amazon = known.provider == "amazon" and self.path == "/latest/api/token"
            amazon = amazon and "X-aws-ec2-metadata-token-ttl-seconds" in self.headers
            known.tokens += amazon
            self._answer(*((200, TOKEN) if amazon else (404, "")))

        def do_GET(self) -> None:
            required = {
                "amazon": ("X-aws-ec2-metadata-token", TOKEN),
                "google": ("Metadata-Flavor", "Google"),
                "azure": ("Metadata", "true"),
            }.get(known.provider, ("Host", self.headers["Host"]))
            if self.headers.get(required[0]) != required[1] or (known.expired and known.tokens):
                known.expired = False
                self._answer(401, "")
                return
            value = known.values.get(self.path)
            self._answer(*((200, value) if value is not None else (404, "")))

        def _answer(self, status: int, text: str) -> None:
            known.requests.append(self.path)
            body = text.encode()
            self.send_response(known.status or status)
            if known.provider == "google":
                self.send_header("Metadata-Flavor", "Google")
            self.send_header("Content-Length", str(len(body) + known.slow * 1000))
            self.end_headers()
            known.looked.set()
            self.wfile.write(body)
            stop = Event()
            while known.slow and not self.wfile.closed:
                try:
                    self.wfile.write(b" ")
                except OSError:
                    return
                stop.wait(0.05)

        def log_message(self, format: str, *args: object) -> None:
            """Quiet."""

    return Handler
