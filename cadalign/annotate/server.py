"""Web server of the annotator: the page, photos, model and actions."""

from __future__ import annotations

import io
import json
import socket
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import uvicorn
from PIL import Image
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from cadalign.annotate.actions import perform
from cadalign.annotate.annotation import Annotation
from cadalign.annotate.guard import Access, Guard
from cadalign.annotate.model import detail_bytes, display_bytes
from cadalign.annotate.options import LOOPBACK
from cadalign.annotate.page_state import page_state, worklist_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError, InputError
from cadalign.web import asset

_BYTES = "application/octet-stream"
_MOST_CONNECTIONS = 256


def make_app(session: Session, access: Access) -> ASGIApp:
    """Make the guarded application."""
    routes = _Routes(session, access)
    answers: dict[str, Callable[[Request], Response]] = {
        "/": routes.page,
        "/annotate.js": partial(_asset, "annotate.js", "text/javascript"),
        "/annotate.css": partial(_asset, "annotate.css", "text/css"),
        "/model": routes.model,
        "/details": routes.details,
        "/photo/{number:int}": routes.photo,
        "/worklist": routes.worklist,
        "/thumbnail/{number:int}": routes.thumbnail,
        "/mask/{number:int}": routes.mask,
        "/state/{number:int}": routes.state,
    }
    app = Starlette(
        routes=[
            *(Route(path, answer) for path, answer in answers.items()),
            Route("/act/{number:int}", routes.act, methods=["POST"]),
        ],
        exception_handlers={CadalignError: _refused},
    )
    return Guard(app, access)


def listen(port: int) -> socket.socket:
    """Open a socket that only this machine reaches; port 0 chooses a free one."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
        listener.listen()  # connections wait until the server runs
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(
            f"port {port} cannot be opened ({reason})",
            where="--port",
            fix="omit --port to use a free one",
        ) from None
    return listener


def make_server(app: ASGIApp) -> uvicorn.Server:
    """Make the server of an application, which `serve` runs."""
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


def serve(app: ASGIApp, listener: socket.socket) -> None:
    """Serve until interrupted."""
    make_server(app).run(sockets=[listener])


class _Routes:
    """Handlers of the addresses; Starlette runs synchronous ones in threads."""

    def __init__(self, session: Session, access: Access) -> None:
        self._session = session
        self._access = access
        self._model = b""

    def page(self, request: Request) -> Response:
        response = Response(asset("annotate.html"), media_type="text/html")
        cookie, token = self._access.cookie, self._access.token
        response.set_cookie(cookie, token, httponly=True, samesite="strict")
        return response

    def model(self, request: Request) -> Response:
        with self._session.lock:
            self._model = self._model or display_bytes(self._session.model.cad)
        return Response(self._model, media_type=_BYTES)

    def details(self, request: Request) -> Response:
        opened = self._session.model
        return Response(detail_bytes(opened.cad, opened.wireframe.creases), media_type=_BYTES)

    def photo(self, request: Request) -> Response:
        kind, data = self._annotation(request).photo.encoded()
        return Response(data, media_type=kind)

    def worklist(self, request: Request) -> Response:
        return JSONResponse(worklist_state(self._session))

    def thumbnail(self, request: Request) -> Response:
        thumbnail = self._annotation(request).photo.thumbnail()
        kept = {"Cache-Control": "max-age=3600"}
        return Response(thumbnail, media_type="image/jpeg", headers=kept)

    def mask(self, request: Request) -> Response:
        mask = self._annotation(request).mask
        # Its opacity is what the page draws, in a colour of its own.
        opacity = np.where(mask, 255, 0).astype(np.uint8)
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
        return await run_in_threadpool(self._acted, request, action)

    def _acted(self, request: Request, action: dict[str, Any]) -> Response:
        number = request.path_params["number"]
        with self._session.lock:
            outcome = perform(self._session, number, action)
            return JSONResponse(page_state(self._session, number, outcome))

    def _annotation(self, request: Request) -> Annotation:
        return self._session.annotation(request.path_params["number"])


def _asset(name: str, media_type: str, request: Request) -> Response:
    return Response(asset(name), media_type=media_type)


async def _refused(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, status_code=422)
