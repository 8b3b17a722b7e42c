"""Web server of the annotator: the page, photos, model and actions."""

from __future__ import annotations

import io
import json
import secrets
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
from cadalign.annotate.guard import Access, BoundedProtocol, Guard
from cadalign.annotate.library import thumbnail_of
from cadalign.annotate.locks import Claims
from cadalign.annotate.model import detail_bytes, display_bytes
from cadalign.annotate.options import LOOPBACK
from cadalign.annotate.page_state import page_state, worklist_state
from cadalign.annotate.ranking import ranking_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError, InputError, quote
from cadalign.web import asset

_LONGEST_NUMBER = 9  # digits
_BYTES = "application/octet-stream"
_BROWSER = "cadalign-browser"  # cookie that identifies the browser, for all of its tabs


_OF_OBJECT = {"state": page_state, "models": ranking_state}
"""Plain data of one object of a photo, by the address."""


def make_app(session: Session, access: Access) -> ASGIApp:
    """Make the guarded application."""
    routes = _Routes(session, access)
    data = {
        f"/{name}/{{number:int}}": partial(routes.data, answer)
        for name, answer in _OF_OBJECT.items()
    }
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
        "/claim/{number:int}": routes.claim,
        "/library/{number:int}.jpg": routes.library,
        **data,
    }
    app = Starlette(
        routes=[
            *(Route(path, answer) for path, answer in answers.items()),
            Route("/act/{number:int}", routes.act, methods=["POST"]),
        ],
        exception_handlers={CadalignError: _refused},
    )
    return Guard(app, access)


def listen(port: int, host: str = LOOPBACK) -> socket.socket:
    """Open a socket on an interface of this machine; port 0 chooses a free one."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()  # connections wait until the server runs
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        if host != LOOPBACK:
            raise InputError(
                f"{host}, port {port} cannot be opened ({reason})",
                where="--host",
                fix="give an address of this machine, or 0.0.0.0 for all",
            ) from None
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
        http=BoundedProtocol,
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
        self._models: dict[int, bytes] = {}
        self._claims = Claims()

    def page(self, request: Request) -> Response:
        response = Response(asset("annotate.html"), media_type="text/html")
        cookies = {self._access.cookie: self._access.token}
        if _BROWSER not in request.cookies:
            cookies[_BROWSER] = secrets.token_urlsafe(12)
        for name, value in cookies.items():
            response.set_cookie(name, value, httponly=True, samesite="strict")
        return response

    def model(self, request: Request) -> Response:
        number = _number(request, "number") or 0
        with self._session.lock:
            if number not in self._models:
                self._models[number] = display_bytes(self._session.models[number].cad)
        return Response(self._models[number], media_type=_BYTES)

    def details(self, request: Request) -> Response:
        opened = self._session.models[_number(request, "number") or 0]
        return Response(detail_bytes(opened.cad, opened.wireframe.creases), media_type=_BYTES)

    def photo(self, request: Request) -> Response:
        kind, data = self._session.photo_state(request.path_params["number"]).photo.encoded()
        return Response(data, media_type=kind)

    def worklist(self, request: Request) -> Response:
        return JSONResponse(worklist_state(self._session))

    def thumbnail(self, request: Request) -> Response:
        return _kept(self._session.photo_state(request.path_params["number"]).photo.thumbnail())

    def library(self, request: Request) -> Response:
        choice = self._session.choice
        if choice is None:
            raise InputError("the session has no library", where="library")
        return _kept(thumbnail_of(choice, request.path_params["number"]))

    def mask(self, request: Request) -> Response:
        mask = self._session.photo_state(*_place(request)).mask
        # Its opacity is what the page draws, in a colour of its own.
        opacity = np.where(mask, 255, 0).astype(np.uint8)
        data = io.BytesIO()
        Image.fromarray(np.stack([np.zeros_like(opacity), opacity], axis=2), "LA").save(data, "PNG")
        return Response(data.getvalue(), media_type="image/png")

    def claim(self, request: Request) -> Response:
        """The revision of an object, and whether its photo was changed in another browser."""
        number, slot = _place(request)
        state = self._session.photo_state(number, slot)
        elsewhere = self._claims.is_elsewhere(number, request.cookies.get(_BROWSER, ""))
        return JSONResponse({"revision": state.owner.history.revision, "elsewhere": elsewhere})

    def data(self, answer: Callable[..., dict[str, Any]], request: Request) -> Response:
        """Answer with what a function of `_OF_OBJECT` returns for an object."""
        number, slot = _place(request)
        return JSONResponse(answer(self._session, number, slot=slot))

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
        session = self._session
        number, slot = _place(request)
        person = "" if request.client is None else request.client.host
        with session.lock:
            views = session.photo_state(number, slot).owner.shown
            photos = {number, *(view.place[0] for view in views)}
            self._claims.take(photos, request.cookies.get(_BROWSER, ""), person)
            outcome = perform(session, number, action, slot=slot)
            return JSONResponse(page_state(session, number, outcome, slot=slot))


def _asset(name: str, media_type: str, request: Request) -> Response:
    return Response(asset(name), media_type=media_type)


def _kept(thumbnail: bytes) -> Response:
    return Response(thumbnail, media_type="image/jpeg", headers={"Cache-Control": "max-age=3600"})


def _place(request: Request) -> tuple[int, int | None]:
    """The numbers of a photo, and of one of its objects if the address has it."""
    return request.path_params["number"], _number(request, "object")


def _number(request: Request, name: str) -> int | None:
    given = request.query_params.get(name)
    if given is None:
        return None
    if not given.isdecimal() or len(given) > _LONGEST_NUMBER:
        raise InputError(f"{quote(given)} is no number", where=name, fix="reload the page")
    return int(given)


async def _refused(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, status_code=422)
