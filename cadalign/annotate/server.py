"""Web server of the annotator: the page, photos, model and actions."""

from __future__ import annotations

import io
import json
import secrets
import socket
from functools import partial
from typing import Any
from urllib.parse import quote

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
from cadalign.annotate.exporting import coco_of, glb_of, zipped_photo_set
from cadalign.annotate.guard import Access, BoundedProtocol, Guard
from cadalign.annotate.library import thumbnail_of
from cadalign.annotate.locks import Claims
from cadalign.annotate.model import detail_bytes, display_bytes
from cadalign.annotate.options import LOOPBACK
from cadalign.annotate.page_state import mask_pixels, page_state, worklist_state
from cadalign.annotate.ranking import advice_state, ranking_state
from cadalign.annotate.session import Session
from cadalign.errors import CadalignError, InputError
from cadalign.errors import quote as quoted
from cadalign.web import asset

_LONGEST_NUMBER = 9  # digits
_BYTES = "application/octet-stream"
_BROWSER = "cadalign-browser"  # cookie that identifies the browser, for all of its tabs


def make_app(session: Session, access: Access) -> ASGIApp:
    """Make the guarded application."""
    routes = _Routes(session, access)
    app = Starlette(
        routes=[
            Route("/", routes.page),
            Route("/annotate.js", partial(_send, "annotate.js", "text/javascript")),
            Route("/annotate.css", partial(_send, "annotate.css", "text/css")),
            Route("/model", routes.model),
            Route("/details", routes.details),
            Route("/photo/{number:int}", routes.photo),
            Route("/worklist", routes.worklist),
            Route("/thumbnail/{number:int}", routes.thumbnail),
            Route("/export/coco.json", routes.coco),
            Route("/export/{number:int}.glb", routes.glb),
            Route("/export/{form:str}.zip", routes.photo_set),
            Route("/mask/{number:int}", routes.mask),
            Route("/state/{number:int}", routes.state),
            Route("/claim/{number:int}", routes.claim),
            Route("/advice/{number:int}", routes.advice),
            Route("/act/{number:int}", routes.act, methods=["POST"]),
            Route("/models/{number:int}", routes.models),
            Route("/library/{number:int}.jpg", routes.library),
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
        response.set_cookie(
            self._access.cookie, self._access.token, httponly=True, samesite="strict"
        )
        if _BROWSER not in request.cookies:
            browser = secrets.token_urlsafe(12)
            response.set_cookie(_BROWSER, browser, httponly=True, samesite="strict")
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

    def coco(self, request: Request) -> Response:
        return JSONResponse(coco_of(self._session), headers=_as_file("keypoints.coco.json"))

    def glb(self, request: Request) -> Response:
        number, slot = _place(request)
        data = glb_of(self._session, number, slot=slot)
        name = self._session.photo_state(number, slot).files.observation.with_suffix(".glb").name
        return Response(data, media_type="model/gltf-binary", headers=_as_file(name))

    def photo_set(self, request: Request) -> Response:
        form = request.path_params["form"]
        data = zipped_photo_set(self._session, form)
        return Response(data, media_type="application/zip", headers=_as_file(f"{form}.zip"))

    def mask(self, request: Request) -> Response:
        number, slot = _place(request)
        mask = np.where(mask_pixels(self._session, number, slot=slot), 255, 0).astype(np.uint8)
        # Its opacity is what the page draws, in a colour of its own.
        data = io.BytesIO()
        Image.fromarray(np.stack([np.zeros_like(mask), mask], axis=2), "LA").save(data, "PNG")
        return Response(data.getvalue(), media_type="image/png")

    def claim(self, request: Request) -> Response:
        """The revision of an object, and whether its photo was changed in another browser."""
        number, slot = _place(request)
        state = self._session.photo_state(number, slot)
        elsewhere = self._claims.is_elsewhere(number, request.cookies.get(_BROWSER, ""))
        return JSONResponse({"revision": state.history.revision, "elsewhere": elsewhere})

    def advice(self, request: Request) -> Response:
        number, slot = _place(request)
        return JSONResponse(advice_state(self._session, number, slot=slot))

    def models(self, request: Request) -> Response:
        number, slot = _place(request)
        return JSONResponse(ranking_state(self._session, number, slot=slot))

    def state(self, request: Request) -> Response:
        number, slot = _place(request)
        return _as_json(page_state(self._session, number, slot=slot))

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
        return await run_in_threadpool(self._acted, request, action)

    def _acted(self, request: Request, action: dict[str, Any]) -> Response:
        session = self._session
        number, slot = _place(request)
        person = "" if request.client is None else request.client.host
        with session.lock:
            views = session.photo_state(number, slot).all_views
            photos = {number, *(session.place_of(view)[0] for view in views)}
            self._claims.take(photos, request.cookies.get(_BROWSER, ""), person)
            outcome = perform(session, number, action, slot=slot)
            return _as_json(page_state(session, number, outcome, slot=slot))


def _as_json(state: dict[str, Any]) -> Response:
    data = json.dumps(state, separators=(",", ":"), allow_nan=False).encode()
    return Response(data, media_type="application/json")


def _kept(thumbnail: bytes) -> Response:
    """A picture that the browser keeps for an hour."""
    return Response(thumbnail, media_type="image/jpeg", headers={"Cache-Control": "max-age=3600"})


def _place(request: Request) -> tuple[int, int | None]:
    """The numbers of a photo, and of one of its objects if the address has it."""
    return request.path_params["number"], _number(request, "object")


def _number(request: Request, name: str) -> int | None:
    given = request.query_params.get(name)
    if given is None:
        return None
    if not given.isdecimal() or len(given) > _LONGEST_NUMBER:
        raise InputError(f"{quoted(given)} is no number", where=name, fix="reload the page")
    return int(given)


def _as_file(name: str) -> dict[str, str]:
    """Headers that let a browser save a response under a name."""
    return {"Content-Disposition": f"attachment; filename*=UTF-8''{quote(name)}"}


def _send(name: str, media_type: str, request: Request) -> Response:
    return Response(asset(name), media_type=media_type)


async def _refused(request: Request, error: Exception) -> Response:
    return JSONResponse({"error": str(error)}, status_code=422)
