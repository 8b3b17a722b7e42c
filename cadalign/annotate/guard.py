"""Who may talk to the annotator: this machine's browser with the session's token, nobody else."""

from __future__ import annotations

import hmac
import secrets
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

TOKEN_HEADER = "x-cadalign-token"
MAX_BODY = 64 * 1024
_NAMES = ("127.0.0.1", "localhost")
_POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)
HEADERS = {
    "Content-Security-Policy": _POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class Access:
    """What a request must show.

    Parameters
    ----------
    port : int
        The port that is listened on.
    token : str
        The session's secret.
    """

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def url(self) -> str:
        """The page's address with the token."""
        return f"http://127.0.0.1:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """The name of the cookie; browsers send cookies to all ports of a machine."""
        return f"cadalign-{self.port}"

    def refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Status and reason if a request is refused, before any of its body is read."""
        headers = Headers(scope=scope)
        hosts = {f"{name}:{self.port}" for name in _NAMES}
        if headers.get("host") not in hosts:
            # A name that another site has made resolve to this machine.
            return 400, "unknown host"
        origin = headers.get("origin")
        if origin is not None and origin not in {f"http://{host}" for host in hosts}:
            return 403, "requests from another origin are refused"
        if headers.get("sec-fetch-site") in ("cross-site", "same-site"):
            return 403, "requests from another site are refused"
        if not self._has_token(scope, headers):
            return 403, "the token is missing or wrong: open the address that cadalign has printed"
        length = headers.get("content-length")
        if length is not None and (not length.isdecimal() or int(length) > MAX_BODY):
            return 413, f"more than {MAX_BODY} bytes"
        return None

    def _has_token(self, scope: Scope, headers: Headers) -> bool:
        given = [headers.get(TOKEN_HEADER)]
        if scope["path"] == "/":
            given += parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [])
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self.cookie)
        except CookieError:
            morsel = None
        given.append(morsel.value if morsel else None)
        wanted = self.token.encode()
        return any(
            hmac.compare_digest(text.encode("utf-8", "replace"), wanted) for text in given if text
        )


class Guard:
    """Middleware that refuses what `Access` refuses, and bodies that are too long.

    Parameters
    ----------
    app : ASGI application
    access : Access
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # there are no web sockets here
            return
        refused = self._access.refusal(scope)
        if refused is None:
            body = await _read_body(receive)
            if body is not None:
                await self._app(scope, _replay(body), _with_headers(send))
                return
            refused = 413, f"more than {MAX_BODY} bytes"
        status, reason = refused
        # The body has not been read to its end, so the connection cannot be used again.
        headers = HEADERS | {"Connection": "close"}
        await PlainTextResponse(reason, status_code=status, headers=headers)(scope, receive, send)


async def _read_body(receive: Receive) -> bytes | None:
    """A request's body; None as soon as it is longer than it may be."""
    body = b""
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            return body
        part: bytes = message.get("body", b"")
        body += part
        if len(body) > MAX_BODY:
            return None
        if not message.get("more_body", False):
            return body


def _replay(body: bytes) -> Receive:
    """A receiver that hands over a body that has been read."""
    messages: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def receive() -> Message:
        return messages.pop() if messages else {"type": "http.disconnect"}

    return receive


def _with_headers(send: Send) -> Send:
    """A sender that adds the security headers to a response."""

    async def add(message: Message) -> None:
        if message["type"] == "http.response.start":
            own = [(name.lower().encode(), value.encode()) for name, value in HEADERS.items()]
            message["headers"] = [*message.get("headers", []), *own]
        await send(message)

    return add
