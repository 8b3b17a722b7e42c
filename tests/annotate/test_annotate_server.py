"""The annotator's server only answers its own page."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator

import pytest
from support.annotating import Case, served

from cadalign.annotate.server import Access, listen
from cadalign.errors import InputError

UNDO = json.dumps({"do": "undo"})


@pytest.fixture(scope="module")
def access(original: Case) -> Iterator[Access]:
    with served(original.open()) as opened:
        yield opened


def ask(
    access: Access,
    path: str,
    *,
    method: str = "GET",
    body: str | None = None,
    token: str | None = "right",
    **headers: str,
) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Send a request as it is written, with the session's token unless another is given."""
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    if token is not None:
        sent["Cookie"] = f"{access.cookie}={access.token if token == 'right' else token}"
    connection = http.client.HTTPConnection("127.0.0.1", access.port, timeout=20)
    try:
        connection.request(method, path, body=body, headers=sent)
        response = connection.getresponse()
        return response.status, response.headers, response.read()
    finally:
        connection.close()


def act(access: Access, body: str = UNDO, **options: str) -> int:
    defaults = {"Content_Type": "application/json"}
    return ask(access, "/act/0", method="POST", body=body, **(defaults | options))[0]


PATHS = ["/", "/annotate.js", "/annotate.css", "/model/0", "/photo/0", "/state/0"]


@pytest.mark.long
@pytest.mark.parametrize("path", PATHS)
def test_with_the_token_everything_is_served(access: Access, path: str) -> None:
    status, headers, body = ask(access, path)
    assert status == 200
    assert body
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Cache-Control"] == "no-store"
    assert "Access-Control-Allow-Origin" not in headers


def test_the_model_is_served(original: Case) -> None:
    session = original.open(prepared=False)
    with served(session) as opened:
        assert ask(opened, "/model/0")[::2] == (200, session.model.cad.display_bytes)


@pytest.mark.parametrize("path", [*PATHS, "/nowhere", "/?token=", "/?token=wrong"])
@pytest.mark.parametrize("token", [None, "", "wrong", "täuschung"])
def test_without_the_token_nothing_is(access: Access, path: str, token: str | None) -> None:
    if token == "täuschung":
        token = token.encode().decode("latin-1")
    status, headers, body = ask(access, path, token=token)
    assert status == 403
    assert body == b"the token is missing or wrong: open the address that cadalign has printed"
    assert "Set-Cookie" not in headers


def test_actions_need_the_token(access: Access) -> None:
    assert act(access) == 200
    assert ask(access, "/act/0", method="POST", body=UNDO, token=None)[0] == 403


def test_token_in_the_address_opens_the_page_only_and_gives_a_cookie(access: Access) -> None:
    status, headers, _ = ask(access, f"/?token={access.token}", token=None)
    assert status == 200
    cookie = headers["Set-Cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    pair = cookie.split(";")[0]
    assert ask(access, "/state/0", token=None, Cookie=pair)[0] == 200
    assert ask(access, "/state/0", token=None, Cookie=pair[:-1])[0] == 403
    assert ask(access, "/state/0", token=None, Cookie='a="b; ;;=')[0] == 403
    assert ask(access, f"/state/0?token={access.token}", token=None)[0] == 403


def test_tokens_differ_and_are_long() -> None:
    tokens = {Access(1).token for _ in range(100)}
    assert len(tokens) == 100
    assert min(map(len, tokens)) >= 43
    assert Access(1).token not in repr(Access(1))


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/photo/../../../etc/passwd",
        "/photo/..%2f..%2fetc%2fpasswd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/photo/%2e%2e/camera.json",
        "/..\\camera.json",
        "//etc/passwd",
        "/photo/photo.png",
        "/photo/-1",
        "/camera.json",
        "/annotate.js/../LICENSES.txt",
    ],
)
def test_no_path_leads_to_other_files(access: Access, path: str) -> None:
    status, _, body = ask(access, path)
    assert status in (404, 422)
    assert b"root:" not in body
    assert b"params" not in body


def test_unknown_photo_is_an_error_in_words(access: Access) -> None:
    status, _, body = ask(access, "/photo/99")
    assert status == 422
    assert body == b"image: there is no photo 100"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        *(({"Origin": o}, 403) for o in ("https://evil.example", "null", "http://127.0.0.1:1", "")),
        *(({"Sec_Fetch_Site": site}, 403) for site in ("cross-site", "same-site")),
        # Foreign names that resolve to this machine.
        *(({"Host": host}, 400) for host in ("evil.example", "", "127.0.0.1.evil.example:80")),
    ],
)
def test_other_places_are_refused(access: Access, headers: dict[str, str], status: int) -> None:
    assert act(access, **headers) == status
    assert ask(access, "/state/0", **headers)[0] == status


def test_own_origin_is_served(access: Access) -> None:
    for name in ("127.0.0.1", "localhost"):
        origin = f"http://{name}:{access.port}"
        assert act(access, Origin=origin, Sec_Fetch_Site="same-origin") == 200
    assert ask(access, "/state/0", Sec_Fetch_Site="none")[0] == 200


def test_only_json_objects_are_actions(access: Access) -> None:
    assert act(access, Content_Type="text/plain") == 422
    assert act(access, "{") == 422
    assert act(access, "[1]") == 422
    assert act(access, "[" * 60_000) == 422
    assert act(access, '{"do": "place_uv", "uv": [NaN, 1]}') == 422
    assert ask(access, "/act/0")[0] == 405


def test_a_body_without_the_token_is_not_read(access: Access) -> None:
    head = f"POST /act/0 HTTP/1.1\r\nHost: 127.0.0.1:{access.port}\r\nContent-Length: 100\r\n\r\n"
    with socket.create_connection(("127.0.0.1", access.port), timeout=20) as client:
        client.sendall(head.encode() + b"{")
        answer = b""
        while part := client.recv(4096):  # until the server closes the connection
            answer += part
    assert answer.startswith(b"HTTP/1.1 403")


# --- the socket ------------------------------------------------------------------------------


def test_it_listens_on_the_loopback_interface_only() -> None:
    with listen(0) as listener:
        assert listener.getsockname()[0] == "127.0.0.1"


def test_port_in_use_is_an_error_in_words() -> None:
    with listen(0) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(InputError) as error:
            listen(port)
    assert str(error.value) == (
        f"--port: port {port} cannot be opened (Address already in use); "
        "omit --port to use a free one"
    )
    with pytest.raises(InputError, match=r"^--port: port 99999 cannot be opened"):
        listen(99999)
