"""Access to the annotator: only with the session's token, by bodies of bounded length and time."""

from __future__ import annotations

import asyncio
import hmac
import secrets
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cadalign.annotate.options import LOOPBACK

TOKEN_HEADER = "x-cadalign-token"
MAX_BODY = 512 * 1024
PATIENCE = 10.0
"""Seconds within which a request's body has to be there."""
_NAMES = (LOOPBACK, "localhost")
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
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
    """Requirements on requests: host, origin and the session's secret token."""

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def address(self) -> str:
        """Address of the page, for browsers that have the cookie."""
        return f"http://{LOOPBACK}:{self.port}/"

    @property
    def url(self) -> str:
        """Address of the page with the token."""
        return f"{self.address}?token={self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie, by port: browsers send cookies to all ports of a machine."""
        return f"cadalign-{self.port}"

    def refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Check a request before its body is read; returns status and reason of a refusal."""
        headers = Headers(scope=scope)
        hosts = {f"{name}:{self.port}" for name in _NAMES}
        if headers.get("host") not in hosts:
            # Another site's name may resolve to this machine (DNS rebinding).
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
    """ASGI middleware that enforces `Access` and limits the length of bodies, and their time."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":  # web sockets and lifespan events are not used
            return
        refused, body = self._access.refusal(scope), b""
        try:
            async with asyncio.timeout(PATIENCE):
                while refused is None:
                    message = await receive()
                    body += message.get("body", b"")
                    if len(body) > MAX_BODY:
                        refused = 413, f"more than {MAX_BODY} bytes"
                    elif not message.get("more_body", False):
                        break
        except TimeoutError:
            refused = 408, f"the request takes more than {PATIENCE:.0f} s"
        if refused is not None:
            status, reason = refused
            # The rest of the body is unread, so the connection cannot be reused.
            headers = HEADERS | {"Connection": "close"}
            response = PlainTextResponse(reason, status_code=status, headers=headers)
            await response(scope, receive, send)
            return
        messages: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def replay() -> Message:
            return messages.pop() if messages else {"type": "http.disconnect"}

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        await self._app(scope, replay, send_with_headers)
