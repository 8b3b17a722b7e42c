"""Web server of the annotator: the page, photos, model and actions."""

from __future__ import annotations

import json
import socket
from functools import partial
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from cadalign.annotate.guard import Access, Guard
from cadalign.annotate.model import display_bytes
from cadalign.annotate.page_state import advice_state, page_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError, InputError
from cadalign.web import asset

LOOPBACK = "127.0.0.1"


def make_app(session: Session, access: Access) -> ASGIApp:
    """Make the guarded application."""
    routes = _Routes(session, access)
    app = Starlette(
        routes=[
            Route("/", routes.page),
            Route("/annotate.js", partial(_send, "annotate.js", "text/javascript")),
            Route("/annotate.css", partial(_send, "annotate.css", "text/css")),
            Route("/model", routes.model),
            Route("/photo/{number:int}", routes.photo),
            Route("/state/{number:int}", routes.state),
            Route("/advice/{number:int}", routes.advice),
            Route("/act/{number:int}", routes.act, methods=["POST"]),
        ],
        exception_handlers={CadalignError: _refused},
    )
    return Guard(app, access)


def listen(port: int) -> socket.socket:
    """Open a socket on the loopback interface; port 0 chooses a free one."""
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


def serve(app: ASGIApp, listener: socket.socket) -> None:
    """Serve until interrupted."""
    import uvicorn

    config = uvicorn.Config(
        app, log_level="warning", access_log=False, lifespan="off", timeout_graceful_shutdown=1
    )
    uvicorn.Server(config).run(sockets=[listener])


class _Routes:
    """Handlers of the addresses. Long work runs in threads."""

    def __init__(self, session: Session, access: Access) -> None:
        self._session = session
        self._access = access
        self._model: bytes | None = None

    async def page(self, request: Request) -> Response:
        response = Response(asset("annotate.html"), media_type="text/html")
        response.set_cookie(
            self._access.cookie, self._access.token, httponly=True, samesite="strict"
        )
        return response

    async def model(self, request: Request) -> Response:
        data = await run_in_threadpool(self._display)
        return Response(data, media_type="application/octet-stream")

    async def photo(self, request: Request) -> Response:
        photo = self._session.photo_state(request.path_params["number"]).photo
        kind, data = await run_in_threadpool(photo.encoded)
        return Response(data, media_type=kind)

    async def state(self, request: Request) -> Response:
        return await self._answer(request.path_params["number"], None)

    async def advice(self, request: Request) -> Response:
        number = request.path_params["number"]
        return JSONResponse(await run_in_threadpool(advice_state, self._session, number))

    async def act(self, request: Request) -> Response:
        if request.headers.get("content-type", "").partition(";")[0] != "application/json":
            raise InputError(
                "not application/json", where="content-type", fix="send an action as JSON"
            )
        try:
            action = json.loads(await request.body())
        except (ValueError, RecursionError):
            raise InputError("not JSON", where="body", fix="send an action as JSON") from None
        if not isinstance(action, dict):
            raise InputError("not a JSON object", where="body", fix="send an action as JSON")
        return await self._answer(request.path_params["number"], action)

    async def _answer(self, number: int, action: dict[str, Any] | None) -> Response:
        def work() -> bytes:
            with self._session.lock:
                outcome = None if action is None else self._session.act(number, action)
                state = page_state(self._session, number, outcome)
            return json.dumps(state, separators=(",", ":"), allow_nan=False).encode()

        return Response(await run_in_threadpool(work), media_type="application/json")

    def _display(self) -> bytes:
        with self._session.lock:
            if self._model is None:
                self._model = display_bytes(self._session.model)
            return self._model


async def _send(name: str, media_type: str, request: Request) -> Response:
    return Response(asset(name), media_type=media_type)


async def _refused(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, status_code=422)
