"""Who may read what is served over HTTP."""

from __future__ import annotations

import base64
import os
from http import HTTPStatus
from pathlib import Path

import pytest

from share.errors import TransportError, UsageError
from share.net.http_guard import HttpGuard, http_address, listen, read_token
from share.net.transport import Address

TOKEN = "a-token-of-24-characters"
LOCAL, REMOTE = Address("127.0.0.1", 8080), Address("192.0.2.7", 8080)
BASIC = base64.b64encode(f"anybody:{TOKEN}".encode()).decode()


def status(guard: HttpGuard, target: str = "/", **headers: str) -> HTTPStatus | None:
    refusal = guard.check(target, {name.replace("_", "-"): value for name, value in headers.items()})
    return None if refusal is None else refusal.status


@pytest.mark.parametrize("host", ["localhost", "LocalHost:8080", "127.0.0.1:1", "[::1]:80"])
def test_this_machine_is_served_under_its_own_names(host: str) -> None:
    assert status(HttpGuard(LOCAL), host=host, origin=f"http://{host}") is None


def test_a_rebound_name_is_refused() -> None:
    assert status(HttpGuard(LOCAL), host="evil.example:8080") == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "http://localhost:9999", "https://localhost.evil.example:8080", ""],
)
@pytest.mark.parametrize("guard", [HttpGuard(LOCAL), HttpGuard(REMOTE, TOKEN)])
def test_a_page_of_another_origin_is_refused(guard: HttpGuard, origin: str) -> None:
    """Browsers open WebSockets across origins, with cookies."""
    headers = {"host": "localhost:8080", "origin": origin, "authorization": f"Bearer {TOKEN}"}
    assert status(guard, **headers) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize("authorization", [f"Bearer {TOKEN}", f"bearer {TOKEN}", f"Basic {BASIC}"])
def test_who_has_the_token_is_served(authorization: str) -> None:
    guard = HttpGuard(REMOTE, TOKEN)
    assert status(guard, host="edge:8080", authorization=authorization) is None


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"authorization": "Bearer wrong"},
        {"authorization": "Bearer "},
        {"authorization": f"Digest {TOKEN}"},
        {"authorization": "Basic !!!"},
        {"authorization": "Basic " + base64.b64encode(b"\xff\xfe:x").decode()},
        {"authorization": "Basic " + base64.b64encode(TOKEN.encode()).decode()},
        {"cookie": "share_8080=wrong"},
        {"cookie": f"share_8080={TOKEN}"},
        {"authorization": "Bearer tök"},
    ],
)
def test_who_has_it_not_is_asked_for_a_password(headers: dict[str, str]) -> None:
    refusal = HttpGuard(REMOTE, TOKEN).check("/?token=wrong", headers)
    assert refusal is not None and refusal.status == HTTPStatus.UNAUTHORIZED
    assert refusal.headers[0].startswith("WWW-Authenticate: Basic")


@pytest.mark.parametrize(
    ("target", "where"),
    [
        (f"/?token={TOKEN}", "/"),
        (f"/health?a=b&token={TOKEN}", "/health?a=b"),
        (f"//evil.example/?token={TOKEN}", "/evil.example/"),
        (f"//[x?token={TOKEN}&b=\udce9", "/[x?b=%3F"),
        (f"/%0d%0aX?token={TOKEN}", "/%0d%0aX"),
        (f"/\\evil?token={TOKEN}", "/evil"),
    ],
)
def test_a_token_in_the_address_becomes_a_cookie(target: str, where: str) -> None:
    guard = HttpGuard(REMOTE, TOKEN)
    refusal = guard.check(target, {"host": "edge:8080"})
    assert refusal is not None and refusal.status == HTTPStatus.SEE_OTHER
    assert refusal.headers[0] == f"Location: {where}"
    name, _, rest = refusal.headers[1].partition(": ")[2].partition("=")
    assert "HttpOnly" in rest and "SameSite" in rest and TOKEN not in rest
    assert status(guard, cookie=f"other=1; {name}={rest.partition(';')[0]}") is None
    assert guard.cookie_headers() == refusal.headers[1:]


def test_status_page_and_live_room_share_a_cookie_and_two_edges_do_not() -> None:
    (given,) = HttpGuard(REMOTE, TOKEN).cookie_headers()
    cookie = given.partition(": ")[2].partition(";")[0]
    other_port = HttpGuard(Address("192.0.2.7", 8081), TOKEN)
    assert status(other_port, cookie=cookie) is None
    (others,) = HttpGuard(REMOTE, "another" + TOKEN).cookie_headers()
    assert others.partition("=")[0] != given.partition("=")[0]


@pytest.mark.parametrize(
    "target", ["//[x", "/?token=\udcc3\udca9", "/?token=%ed%a0%80", "/?token=\xe9", "http://[/"]
)
@pytest.mark.parametrize("given", [chr(0xDCE9), chr(0xE9), chr(0xD800), ""])
def test_odd_bytes_are_just_no_token(target: str, given: str) -> None:
    headers = {"authorization": f"Bearer {given}", "cookie": f"share_8080={given}", "host": "localhost"}
    for guard in (HttpGuard(REMOTE, TOKEN), HttpGuard(LOCAL, TOKEN)):
        refusal = guard.check(target, headers)
        assert refusal is not None and refusal.status == HTTPStatus.UNAUTHORIZED


def test_without_a_token_nothing_is_set() -> None:
    assert HttpGuard(LOCAL).cookie_headers() == ()


@pytest.mark.parametrize("text", ["0.0.0.0:8080", "192.0.2.7:80", "edge.example:8080", "[::]:8080"])
def test_other_machines_are_served_with_a_token_only(text: str) -> None:
    with pytest.raises(UsageError, match=r"--view .*: others could read it; add --http-token FILE"):
        http_address("--view", text, None)
    assert not http_address("--view", text, TOKEN).local


@pytest.mark.parametrize("text", ["8080", "127.0.0.1:8080", "localhost:8080", "[::1]:8080"])
def test_this_machine_needs_none(text: str) -> None:
    assert http_address("--http", text, None).port == 8080


def test_a_port_in_use_is_reported() -> None:
    listener, bound = listen(Address("127.0.0.1", 0))
    with listener, pytest.raises(TransportError, match="the port is in use"):
        listen(bound)


# ---------------------------------------------------------------- the file


def test_a_token_is_made_once_for_its_owner(tmp_path: Path) -> None:
    path = tmp_path / "token"
    token = read_token(path)
    assert len(token) >= 24 and path.stat().st_mode & 0o777 == 0o600
    assert read_token(path) == token


@pytest.mark.parametrize(
    ("content", "mode", "said"),
    [
        (b"short\n", 0o600, "expected one word of 16 to 256"),
        (b"two words of the same\n", 0o600, "expected one word"),
        (b"x" * 300, 0o600, "expected one word"),
        (b"\xff" * 20, 0o600, "expected one word"),
        (b"x" * 20, 0o644, "others can read it; `chmod 600"),
    ],
)
def test_an_unfit_file_is_refused(tmp_path: Path, content: bytes, mode: int, said: str) -> None:
    path = tmp_path / "token"
    path.write_bytes(content)
    path.chmod(mode)
    with pytest.raises(UsageError, match=said):
        read_token(path)


def test_a_pipe_and_a_missing_folder_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path in (tmp_path / "pipe", tmp_path / "none" / "token", tmp_path):
        with pytest.raises(UsageError, match="--http-token"):
            read_token(path)
