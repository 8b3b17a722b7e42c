"""Web server of the annotator: page, photos, model and actions; requests need a token."""

from __future__ import annotations

import hmac
import io
import json
import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import uvicorn
from PIL import Image
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cadalign.annotate.actions import perform
from cadalign.annotate.page_state import page_state, photos_state
from cadalign.annotate.session import Annotation, Session
from cadalign.errors import CadalignError, InputError
from cadalign.web import asset

LOOPBACK = "127.0.0.1"
"""Address that only this machine reaches."""
_NAMES = [LOOPBACK, "localhost"]
_MOST_CONNECTIONS = 256
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
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
    """Requirements on requests: origin and the session's secret token."""

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def url(self) -> str:
        """Address of the page with the token."""
        return f"http://{LOOPBACK}:{self.port}/?token={self.token}"

    @property
    def cookie(self) -> str:
        """Name of the cookie, by port: browsers send cookies to all ports of a machine."""
        return f"cadalign-{self.port}"

    def refusal(self, request: Request) -> str | None:
        """Check a request before its body is read; returns the reason of a refusal."""
        origin = request.headers.get("origin")
        if origin is not None and origin not in {f"http://{name}:{self.port}" for name in _NAMES}:
            return "requests from another origin are refused"
        if request.headers.get("sec-fetch-site") in ("cross-site", "same-site"):
            return "requests from another site are refused"
        given = [request.cookies.get(self.cookie)]
        if request.url.path == "/":
            given.append(request.query_params.get("token"))
        wanted = self.token.encode()
        tokens = (text.encode("utf-8", "replace") for text in given if text)
        if not any(hmac.compare_digest(token, wanted) for token in tokens):
            return "the token is missing or wrong: open the address that cadalign has printed"
        return None


class Guard:
    """ASGI middleware that enforces `Access` and sends the headers of every answer."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":  # web sockets and lifespan events are not used
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        app, reason = self._app, self._access.refusal(Request(scope))
        if reason is not None:
            # A body stays unread, so the connection cannot be used again.
            app = PlainTextResponse(reason, status_code=403, headers={"Connection": "close"})
        await app(scope, receive, send_with_headers)


def make_app(session: Session, access: Access) -> ASGIApp:
    """Make the guarded application."""
    routes = _Routes(session, access)
    answers: dict[str, Callable[[Request], Response]] = {
        "/": routes.page,
        "/annotate.js": partial(_asset, "annotate.js", "text/javascript"),
        "/annotate.css": partial(_asset, "annotate.css", "text/css"),
        "/model/{number:int}": routes.model,
        "/photos": routes.photos,
        "/photo/{number:int}": routes.photo,
        "/mask/{number:int}": routes.mask,
        "/state/{number:int}": routes.state,
    }
    return Starlette(
        routes=[
            *(Route(path, answer) for path, answer in answers.items()),
            Route("/act/{number:int}", routes.act, methods=["POST"]),
        ],
        middleware=[
            Middleware(Guard, access=access),
            # Another site's name may resolve to this machine (DNS rebinding).
            Middleware(TrustedHostMiddleware, allowed_hosts=_NAMES),
        ],
        exception_handlers={CadalignError: _refusal},
    )


def listen(port: int) -> socket.socket:
    """Listen on a port of the loopback interface, 0 for a free one; raises InputError."""
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
        listener.listen()  # connections wait until the server runs
    except (OSError, OverflowError) as error:
        listener.close()
        what = f"port {port} cannot be opened ({getattr(error, 'strerror', None) or error})"
        raise InputError(what, where="--port", fix="omit --port to use a free one") from None
    return listener


def make_server(app: ASGIApp) -> uvicorn.Server:
    """Make the server of an application, whose ``run`` serves until interrupted."""
    config = uvicorn.Config(
        app,
        http="h11",
        limit_concurrency=_MOST_CONNECTIONS,
        log_level="warning",
        access_log=False,
        lifespan="off",
        timeout_graceful_shutdown=1,
    )
    return uvicorn.Server(config)


class _Routes:
    """Handlers of the addresses; Starlette runs synchronous ones in threads."""

    def __init__(self, session: Session, access: Access) -> None:
        self._session = session
        self._access = access

    def page(self, request: Request) -> Response:
        response = Response(asset("annotate.html"), media_type="text/html")
        cookie, token = self._access.cookie, self._access.token
        response.set_cookie(cookie, token, httponly=True, samesite="strict")
        return response

    def model(self, request: Request) -> Response:
        with self._session.lock:
            data = self._annotation(request).model.cad.display_bytes
        return Response(data, media_type="application/octet-stream")

    def photos(self, request: Request) -> Response:
        return JSONResponse(photos_state(self._session))

    def photo(self, request: Request) -> Response:
        kind, data = self._annotation(request).photo.encode()
        return Response(data, media_type=kind)

    def mask(self, request: Request) -> Response:
        # The page draws the opacity in its own colour.
        opacity = np.where(self._annotation(request).mask, 255, 0).astype(np.uint8)
        data = io.BytesIO()
        Image.fromarray(np.stack([np.zeros_like(opacity), opacity], axis=2), "LA").save(data, "PNG")
        return Response(data.getvalue(), media_type="image/png")

    def state(self, request: Request) -> Response:
        return JSONResponse(page_state(self._session, request.path_params["number"]))

    async def act(self, request: Request) -> Response:
        """Do an action of the page; answers with the state after it."""
        fix = "send an action as JSON"
        if request.headers.get("content-type", "").partition(";")[0] != "application/json":
            raise InputError("not application/json", where="content-type", fix=fix)
        try:
            action = json.loads(await request.body())
        except (ValueError, RecursionError):
            raise InputError("not JSON", where="body", fix=fix) from None
        if not isinstance(action, dict):
            raise InputError("not a JSON object", where="body", fix=fix)
        return await run_in_threadpool(self._perform, request.path_params["number"], action)

    def _perform(self, number: int, action: dict[str, Any]) -> Response:
        with self._session.lock:
            outcome = perform(self._session, number, action)
            return JSONResponse(page_state(self._session, number, outcome))

    def _annotation(self, request: Request) -> Annotation:
        return self._session.annotation(request.path_params["number"])


def _asset(name: str, media_type: str, request: Request) -> Response:
    return Response(asset(name), media_type=media_type)


async def _refusal(request: Request, error: Exception) -> Response:
    return PlainTextResponse(str(error), status_code=422)
