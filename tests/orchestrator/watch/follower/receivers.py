"""A server that receives notifications by HTTP in a test."""

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


@dataclass
class Received:
    """One request that has come."""

    path: str
    headers: dict[str, str]  # names in lower case
    body: bytes

    @property
    def json(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads(self.body)
        return content


@dataclass
class Receiver:
    """A server and what it has got. Of the answers each is used once; then it answers 200."""

    url: str
    answers: list[int]
    received: list[Received] = field(default_factory=list)
    hang: threading.Event = field(default_factory=threading.Event)  # set: it answers; cleared: it waits

    @property
    def texts(self) -> list[str]:
        return [it.json["type"] for it in self.received]


@contextmanager
def receiver(answers: Sequence[int] = (), *, hangs: bool = False) -> Iterator[Receiver]:
    """An HTTP server on this machine while the context lasts."""
    made = Receiver("", list(answers))
    if not hangs:
        made.hang.set()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            made.received.append(
                Received(self.path, {name.lower(): value for name, value in self.headers.items()}, body)
            )
            made.hang.wait(60)
            code = made.answers.pop(0) if made.answers else 200
            self.send_response(code)
            if 300 <= code < 400:
                self.send_header("Location", f"{made.url}/elsewhere")
            self.send_header("Content-Length", "0")
            self.end_headers()

        do_GET = do_POST  # noqa: N815

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    made.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield made
    finally:
        made.hang.set()
        server.shutdown()
        server.server_close()
