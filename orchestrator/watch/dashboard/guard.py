"""Which requests pass: a layer around the whole server, so that no route can be forgotten.

On a loopback address there is no token, but a page of another site must neither read nor act through the
browser of a user who has the dashboard open: the Host header must name this machine (DNS rebinding), and
nothing but a GET is accepted from another origin or without the header that only our pages send. On any other
address every request needs the token, as a cookie that the URL with the token has set, or as a bearer. The
page of a model has an origin of its own, from which browsers send no cookie: the address of its files, which
only clients with the token learn, is as secret as the token and grants these files alone.
"""

import base64
import hashlib
import ipaddress
import os
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from panolog.orchestrator.watch.views.pages.encoding import encode
from panolog.orchestrator.watch.views.pages.shell import LIVE_IMPORTS
from panolog.scene.errors import InputError
from panolog.scene.files import user_folder

_SEND_TIMEOUT_MS = 60_000  # after which a client that reads nothing is disconnected
_LOCAL = {"localhost", "127.0.0.1", "[::1]"}
_SAFE = {"GET", "HEAD"}
_OWN_HEADER = "x-panolog"  # a header that no other site can send without being allowed to
_IMPORTS = base64.b64encode(hashlib.sha256(LIVE_IMPORTS.encode()).digest()).decode()
# plotly writes its own style elements and attributes; scripts are files of ours only, and where they are.
CSP = (
    f"default-src 'none'; script-src 'self' 'sha256-{_IMPORTS}';"
    " style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:;"
    " font-src 'self'; connect-src 'self'; manifest-src 'self'; base-uri 'none'; form-action 'none';"
    " frame-ancestors 'none'"
)
_HEADERS = {
    "Content-Security-Policy": CSP,
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
# A redirect would not send the strict cookie when the link came from another site, such as a web mail.
_ENTRY_PAGE = '<!doctype html><meta http-equiv="refresh" content="0;url=./"><a href="./">PanoLOG</a>'


@dataclass(frozen=True)
class Access:
    """What a request needs."""

    token: str | None  # None: requests come from this machine alone
    port: int

    @property
    def cookie(self) -> str:
        """The name of the cookie, with the port: browsers share cookies between the ports of a host."""
        return f"panolog-{self.port}"


def is_local(host: str) -> bool:
    """Whether an address to listen on can be reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def token_for(host: str) -> str | None:
    """The token that clients must send: None on a loopback address, else the user's, made if needed.

    It is kept in `token_file`, so that open pages work again after a restart; remove the file for a new one.
    Raises InputError if the file holds no token, OSError if it can be neither read nor written.
    """
    if is_local(host):
        return None
    file = token_file()
    file.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    try:
        handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        token = file.read_text().strip()
        if len(token) < 32:
            raise InputError(f"{file}: holds no token; remove it") from None
        return token
    with os.fdopen(handle, "w") as new:
        token = secrets.token_urlsafe(32)
        new.write(token)
    return token


def token_file() -> Path:
    """Where a user's token is stored. Raises InputError if this user has no home."""
    folder = user_folder("XDG_STATE_HOME", ".local/state")
    if folder is None:
        raise InputError("there is no home folder for the dashboard's token: set HOME or XDG_STATE_HOME")
    return folder / "dashboard-token"


class Guard:
    """Refuses what must not pass, and adds the security headers to every response."""

    def __init__(self, app: ASGIApp, access: Access, granted: Callable[[str], bool]) -> None:
        """Args: granted says whether the path of an address is itself a grant of what is there."""
        self._app = app
        self._access = access
        self._granted = granted

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._intercept(scope)
        await (refusal or self._app)(scope, receive, send_guarded)

    def _intercept(self, scope: Scope) -> Response | None:
        """The response in place of the requested one; None if the request may pass."""
        request, token = HTTPConnection(scope), self._access.token
        headers = request.headers
        if token is None:
            host = headers.get("host", "").lower()
            name = host if host.endswith("]") else host.rpartition(":")[0] or host
            if name not in _LOCAL:
                return _refuse("this dashboard can be reached as localhost only")
        elif (
            scope["path"] == "/"
            and scope["method"] in _SAFE
            and _same(request.query_params.get("token"), token)
        ):
            return self._set_cookie(token)
        elif not (self._has_token(request, token) or self._granted(scope["path"])):
            return _refuse("open the address with the token that `panolog dashboard` has printed")
        if scope["method"] not in _SAFE and not _is_ours(headers):
            return _refuse("this request came from another site")
        return None

    def _set_cookie(self, token: str) -> Response:
        answer = HTMLResponse(_ENTRY_PAGE, headers={"Cache-Control": "no-store"})
        answer.set_cookie(
            self._access.cookie, token, max_age=400 * 86_400, path="/", httponly=True, samesite="strict"
        )
        return answer

    def _has_token(self, request: HTTPConnection, token: str) -> bool:
        kind, _, bearer = request.headers.get("authorization", "").partition(" ")
        bearer = bearer.strip() if kind.lower() == "bearer" else ""
        return _same(bearer, token) or _same(request.cookies.get(self._access.cookie), token)


def _same(given: str | None, token: str) -> bool:
    """Compares in constant time."""
    return secrets.compare_digest((given or "").encode(errors="replace"), token.encode())


def _is_ours(headers: Headers) -> bool:
    """Whether a request comes from one of our pages, or from no page at all."""
    origin = headers.get("origin")
    if origin is not None and origin.lower().partition("://")[2] != headers.get("host", "").lower():
        return False
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    return headers.get(_OWN_HEADER) == "1" and kind == "application/json"


def _refuse(line: str) -> Response:
    return Response(encode({"error": line}), 403, {"Cache-Control": "no-store"}, "application/json")


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 for a free one. Raises InputError if the address cannot be used."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol: only then does asyncio know that it is TCP and turn Nagle's algorithm off.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    # Connections inherit it.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _SEND_TIMEOUT_MS)
    try:
        listener.bind((host, port))
    except (OSError, OverflowError) as error:
        listener.close()
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"{host}:{port}: cannot listen there: {why}; choose another --host or --port"
        ) from error
    listener.listen(socket.SOMAXCONN)
    return listener


def address(listener: socket.socket, host: str, token: str | None) -> str:
    """The URL to open."""
    name = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname()}.get(host, host)
    name = f"[{name}]" if ":" in name else name
    return f"http://{name}:{listener.getsockname()[1]}/" + (f"?token={token}" if token else "")
