"""An object store for tests: moto's server, which speaks S3's protocol, behind a proxy with faults."""

import http.client
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Literal

from s3fs import S3FileSystem

BUCKET = "places"
KEY, SECRET = "AKIAT0PSECRETKEY0000", "T0PSECRETaws/accesskey"
Fault = Literal["throttled", "error", "reset", "lost answer", "truncated", "slow"]
_CODES: dict[str, tuple[int, bytes]] = {
    "throttled": (503, b"<Error><Code>SlowDown</Code><Message>Reduce your request rate.</Message></Error>"),
    "error": (500, b"<Error><Code>InternalError</Code><Message>We had an error.</Message></Error>"),
}
_SLOW_S = 0.3
_START_S = 300.0  # for a server


@dataclass
class ObjectStore:
    """A server. `faults` are used up in order, each by the next request; `down` makes all fail."""

    port: int
    server: int  # the port of moto's server
    faults: list[Fault] = field(default_factory=list)
    injected: Counter[str] = field(default_factory=Counter)
    requests: Counter[str] = field(default_factory=Counter)  # by method
    keys: list[tuple[str, str]] = field(default_factory=list)  # (method, path) in order
    down: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)
    writing: threading.Lock = field(default_factory=threading.Lock)  # moto looks first, and then writes

    @property
    def environment(self) -> dict[str, str]:
        """Variables of the provider's own chain that lead here, with a secret that may appear nowhere."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}",
            "AWS_ACCESS_KEY_ID": KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
        }

    def url(self, name: str) -> str:
        """The URL of a place in its bucket."""
        return f"s3://{BUCKET}/{name}"

    def next_fault(self) -> Fault | None:
        with self.lock:
            fault = "error" if self.down else self.faults.pop(0) if self.faults else None
            if fault:
                self.injected[fault] += 1
            return fault


@contextmanager
def object_store() -> Iterator[ObjectStore]:
    """A store with an empty bucket while the context lasts."""
    S3FileSystem.clear_instance_cache()  # a server of before had another address
    with _moto() as server:
        store = ObjectStore(0, server)
        _call(server, "PUT", f"/{BUCKET}", b"", {})
        proxy = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"store": store}))
        proxy.daemon_threads = True
        store.port = proxy.server_port
        thread = threading.Thread(target=proxy.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield store
        finally:
            proxy.shutdown()
            thread.join()
            proxy.server_close()


@contextmanager
def _moto() -> Iterator[int]:
    arguments = ("-m", "moto.server", "-H", "127.0.0.1", "-p")
    with served(lambda port: [sys.executable, *arguments, str(port)], {"AWS_ACCESS_KEY_ID": "x"}) as port:
        yield port


@contextmanager
def served(command: Callable[[int], list[str]], environment: dict[str, str]) -> Iterator[int]:
    """Runs a server while the context lasts, which begins when it listens. Args: command, for a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
    process = subprocess.Popen(
        command(port),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=os.environ | environment,
        start_new_session=True,
    )
    try:
        end = time.monotonic() + _START_S
        while not _listens(port):
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"{process.args!r} does not listen on port {port}")
            time.sleep(0.05)
        yield port
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # also what a program starts that is a script
        process.wait()


def _listens(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), 1).close()
    except OSError:
        return False
    return True


def _call(
    port: int, method: str, path: str, body: bytes, headers: dict[str, str]
) -> tuple[int, list[tuple[str, str]], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
    for name, value in ({"Host": f"127.0.0.1:{port}"} | headers | {"Content-Length": str(len(body))}).items():
        connection.putheader(name, value)
    connection.endheaders(body)
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer.status, answer.getheaders(), data


class _Handler(BaseHTTPRequestHandler):
    """Passes requests on to moto's server, with the faults of the self.store."""

    store: ObjectStore
    protocol_version = "HTTP/1.1"

    def handle_any(self) -> None:
        body = self._body()
        fault = self.store.next_fault()
        with self.store.lock:
            self.store.requests[self.command] += 1
            self.store.keys.append((self.command, self.path))
        if fault in _CODES:
            code, content = _CODES[str(fault)]
            self._answer(code, [("Content-Type", "application/xml")], content)
            return
        if fault == "reset":
            self._reset()
            return
        headers = {name: self.headers[name] for name in self.headers if name.lower() not in _HOP}
        conditional = any(name in self.headers for name in ("If-None-Match", "If-Match"))
        try:
            with self.store.writing if conditional else nullcontext():
                status, given, data = _call(self.store.server, self.command, self.path, body, headers)
        except OSError:  # the test has ended
            return
        if fault == "lost answer":
            self._reset()
            return
        if fault == "slow":
            time.sleep(_SLOW_S)
        if fault == "truncated" and len(data) > 1:
            self._answer(status, given, data[: len(data) // 2], size=len(data))
            self._reset()
            return
        self._answer(status, given, data)

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = handle_any  # noqa: N815

    def _body(self) -> bytes:
        if "chunked" in self.headers.get("Transfer-Encoding", ""):
            pieces = []
            while size := int(self.rfile.readline().split(b";")[0], 16):
                pieces.append(self.rfile.read(size))
                self.rfile.readline()
            while self.rfile.readline().strip():
                pass
            return b"".join(pieces)
        return self.rfile.read(int(self.headers.get("Content-Length", 0)))

    def _answer(
        self, status: int, headers: list[tuple[str, str]], data: bytes, size: int | None = None
    ) -> None:
        self.send_response(status)
        given = dict(headers)
        length = given.get("Content-Length") if self.command == "HEAD" else None
        for name, value in headers:
            if name.lower() not in _HOP:
                self.send_header(name, value)
        self.send_header("Content-Length", length or str(len(data) if size is None else size))
        self.send_header("Connection", "close")  # so that its thread ends with the test, not 12 seconds later
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _reset(self) -> None:
        self.close_connection = True
        with suppress(OSError):
            self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
            self.connection.close()

    def log_message(self, *_: Any) -> None:
        pass


_HOP = ("host", "content-length", "connection", "transfer-encoding", "server", "date", "expect")
