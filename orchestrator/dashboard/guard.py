"""Who may ask: a layer around the whole server, so that no route can be forgotten.

On this machine's own address there is no token, but a page of another site must neither read nor act through
the browser of somebody who has the dashboard open: the Host header must name this machine (DNS rebinding),
and nothing but a GET is taken from another origin or without the header that only our pages send. On any
other address all need the token, as a cookie that the URL with the token has set, or as a bearer.
"""

import ipaddress
import secrets
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from panolog.orchestrator.dashboard.encoding import encode

_LOCAL = {"localhost", "127.0.0.1", "[::1]"}
_SAFE = {"GET", "HEAD"}
MARK = "x-panolog"  # a header that no other site can send without being allowed to
# plotly writes its own style elements and attributes; scripts are files of ours only.
CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:;"
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
_ENTER = '<!doctype html><meta http-equiv="refresh" content="0;url=./"><a href="./">PanoLOG</a>'


@dataclass(frozen=True)
class Access:
    """What a client must bring."""

    token: str | None  # None: it must be on this machine
    port: int

    @property
    def cookie(self) -> str:
        """The name of the cookie: browsers keep those of all ports of a host together."""
        return f"panolog-{self.port}"


def is_local(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


class Guard:
    """Passes on what may pass, and sets the headers of all that goes back."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                names = {name.lower() for name, _ in message["headers"]}
                message["headers"] = [
                    *message["headers"],
                    *(
                        (n.lower().encode(), v.encode())
                        for n, v in _HEADERS.items()
                        if n.lower().encode() not in names
                    ),
                ]
            await send(message)

        answer = self._answer(scope)
        await (answer or self._app)(scope, receive, send_guarded)

    def _answer(self, scope: Scope) -> Response | None:
        """What is said instead of what was asked for; None if it may pass."""
        headers, token = Headers(scope=scope), self._access.token
        if token is None:
            host = headers.get("host", "").lower()
            name = host if host.endswith("]") else host.rpartition(":")[0] or host
            if name not in _LOCAL:
                return _refuse("this dashboard answers to localhost only")
        elif (given := _given(scope)) is not None and _same(given, token):
            return self._enter(token)
        elif not self._known(headers, token):
            return _refuse("open the address with the token that `panolog dashboard` has printed")
        if scope["method"] not in _SAFE and not _is_ours(headers):
            return _refuse("this was asked from another site")
        return None

    def _enter(self, token: str) -> Response:
        answer = HTMLResponse(_ENTER, headers={"Cache-Control": "no-store"})
        answer.set_cookie(
            self._access.cookie, token, max_age=400 * 86_400, path="/", httponly=True, samesite="strict"
        )
        return answer

    def _known(self, headers: Headers, token: str) -> bool:
        kind, _, bearer = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and _same(bearer.strip(), token):
            return True
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self._access.cookie)
        except CookieError:
            return False
        return morsel is not None and _same(morsel.value, token)


def _given(scope: Scope) -> str | None:
    """The token in the address, where it is looked for: at the first page alone."""
    if scope["path"] != "/" or scope["method"] not in _SAFE:
        return None
    values: list[str] = parse_qs(scope["query_string"].decode("latin-1")).get("token", [])
    return values[0] if values else None


def _same(given: str, token: str) -> bool:
    """Compares in a time that says nothing about where they differ."""
    return secrets.compare_digest(given.encode(), token.encode())


def _is_ours(headers: Headers) -> bool:
    """Whether it was asked by one of our pages, or by no page at all."""
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc.lower() != headers.get("host", "").lower():
        return False
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    return headers.get(MARK) == "1" and kind == "application/json"


def _refuse(line: str) -> Response:
    return Response(encode({"error": line}), 403, {"Cache-Control": "no-store"}, "application/json")
