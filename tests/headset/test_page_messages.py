"""Messages of pages, malformed ones too, and requests over HTTP."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from share.headset import page_messages as page
from share.headset.page_requests import PageGuard, own_names, read_page
from share.wire.room_messages import Cancel, CommandState, Goto, PutObject, RemoveObject

PUT = {"type": "put", "request": 7, "id": 3, "kind": "cube", "map_id": "ann-1/0"}
PUT |= {"position": [1, 2.5, 0], "quaternion": [0, 0, math.sqrt(0.5), math.sqrt(0.5)]}
GOTO = {"type": "goto", "command": 9, "robot": None, "map_id": None, "x": 1, "y": 2, "yaw": None}
VALID: list[dict[str, Any]] = [
    {"type": "hello", "schema": 1, "code": "48392175", "name": "ann", "agent": None},
    {"type": "hello", "schema": 1, "session": "x"},
    {"type": "ping", "n": 1, "sent_ms": 12.5},
    PUT,
    {"type": "remove", "request": 8, "id": 3},
    GOTO,
    {"type": "cancel", "command": 10, "robot": "tb"},
    {"type": "points", "map_id": "ann-1/0"},
    {"type": "seen", "n": 4},
    {"type": "measured", "mode": "align", "frames": 90, "over_20ms": 1, "p50_ms": 12.0, "alignment_mm": None},
]


def test_what_a_page_wants_is_what_goes_to_the_edge() -> None:
    put = page.as_request(page.decode_page(json.dumps(PUT)), 5)  # type: ignore[arg-type]
    assert isinstance(put, PutObject) and (put.request, put.object_id, put.map_id) == (5, 3, "ann-1/0")
    T = [[0, -1, 0, 1], [1, 0, 0, 2.5], [0, 0, 1, 0], [0, 0, 0, 1]]
    assert put.T_map_object == pytest.approx(np.array(T))
    wanted = [page.decode_page(json.dumps(one)) for one in VALID]
    assert page.as_request(wanted[4], 6) == RemoveObject(6, 3)  # type: ignore[arg-type]
    assert page.as_command(wanted[5], 7) == Goto(7, None, "", None, 1.0, 2.0)  # type: ignore[arg-type]
    assert page.as_command(wanted[6], 8) == Cancel(8, "tb")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"position": [1e4, 0, 0]}, "more than 1000 m away"),
        ({"quaternion": [0, 0, 0, 0]}, "its length is not 1"),
        ({"map_id": "a\nb"}, "map_id"),
    ],
)
def test_what_no_room_has_is_refused_with_the_reason(change: dict[str, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        page.as_request(page.decode_page(json.dumps(PUT | change)), 5)  # type: ignore[arg-type]


BAD: list[str | bytes] = [
    *("", "null", "{}", "[]", "1", '"x"', "[" * 9000, '{"type":"hello"', b"\xff\xfe", b"\0" * 100),
    '{"type":"hello","schema":1,"code":1}',
    '{"type":"hello","schema":"2","code":"1"}',
    '{"type":"welcome"}',
    '{"type":"p\\ning \\u001b[31m"}',
    json.dumps(PUT).replace("2.5", "NaN"),
    json.dumps(PUT).replace("2.5", "1e999"),
    json.dumps(PUT | {"position": [None, 0, 0]}),
    json.dumps(PUT | {"position": [1, 2]}),
    json.dumps(PUT | {"position": [1e7, 0, 0]}),
    json.dumps(PUT | {"kind": "<img onerror=x>"}),
    json.dumps(PUT | {"id": -1}),
    json.dumps(PUT | {"id": 2**40}),
    json.dumps(PUT | {"request": 2**70}),
    json.dumps(PUT | {"map_id": "m" * 300}),
    json.dumps(GOTO | {"x": "1"}),
]


@pytest.mark.parametrize("data", BAD)
def test_what_is_malformed_is_one_line(data: str | bytes) -> None:
    with pytest.raises(page.MessageError) as refused:
        page.decode_page(data)
    assert str(refused.value).startswith("not a message of this page")
    assert str(refused.value).isprintable() and len(str(refused.value)) <= 300


@pytest.mark.parametrize(
    "data", ['{"type":"hello","schema":2,"code":"1"}', '{"schema":0,"type":"hello","name":[]}']
)
def test_a_hello_of_another_schema_says_what_to_do(data: str) -> None:
    with pytest.raises(page.OtherSchemaError, match=r"^this page is of another release .*: load it again"):
        page.decode_page(data)


def mutated(draw: random.Random) -> bytes:
    """A valid message with some of its bytes changed, doubled or left out, or one value replaced."""
    message = dict(draw.choice(VALID))
    if draw.random() < 0.5:
        odd = [
            None,
            True,
            -1,
            2**63,
            1e308,
            "",
            "x" * 300,
            [],
            {},
            [1] * 50,
            {"type": "put"},
            "\u202e</script>",
        ]
        message[draw.choice(list(message))] = draw.choice(odd)
    data = bytearray(json.dumps(message).encode())
    for _ in range(draw.choice([0, 0, 1, 2, 8])):
        at = draw.randrange(len(data))
        match draw.randrange(3):
            case 0:
                data[at] = draw.randrange(256)
            case 1:
                del data[at]
            case _:
                data[at:at] = data[at : at + draw.randrange(9)]
    return bytes(data)


def fuzz(count: int, seed: int) -> tuple[int, list[str]]:
    """Return how many of mutated messages were taken, and the refusals; any other error is raised."""
    draw, taken, refusals = random.Random(seed), 0, list[str]()
    for number in range(count):
        try:
            wish = page.decode_page(mutated(draw))
            taken += 1
            if isinstance(wish, page.PageRequest):
                page.as_request(wish, number)
            elif isinstance(wish, page.PageCommand):
                page.as_command(wish, number)
        except (page.MessageError, ValueError) as error:
            refusals.append(str(error))
    return taken, refusals


@pytest.mark.parametrize(("count", "seed"), [(10_000, 42), pytest.param(100_000, 43, marks=pytest.mark.slow)])
def test_mutated_messages_are_taken_or_refused_in_a_line(count: int, seed: int) -> None:
    taken, refusals = fuzz(count, seed)
    assert 0.05 * count < taken < 0.95 * count and all(one.isprintable() for one in refusals)


def test_a_state_of_somebody_elses_command_has_no_number() -> None:
    state = CommandState(5, "tb", "bob", "drives", is_final=True)
    assert page.command_fields(state, None) == {
        "type": "command",
        "command": None,
        "robot": "tb",
        "commander": "bob",
        "text": "drives",
        "is_final": True,
        "is_reached": False,
    }


# ---------------------------------------------------------------- HTTP


@pytest.fixture
def guard(tmp_path: Path) -> PageGuard:
    for name in ("index.html", "main.js", "page.css", ".hidden.js", "Notes.txt", "setup.py", "a b.js"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder.js").mkdir()
    (tmp_path / "link.js").symlink_to("/etc/passwd")
    return PageGuard("https", own_names("192.168.1.5"), read_page(tmp_path))


HOST = "192.168.1.5:8443"


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/", "text/html; charset=utf-8"),
        ("/index.html?x=1", "text/html; charset=utf-8"),
        ("/main.js", "text/javascript; charset=utf-8"),
        ("/page.css", "text/css; charset=utf-8"),
    ],
)
def test_files_of_the_page_are_served_by_name(guard: PageGuard, path: str, kind: str) -> None:
    answer = guard.answer(path, {"host": HOST}, False)
    assert answer is not None and (answer.status, answer.media_type) == (200, kind)


@pytest.mark.parametrize(
    "path",
    [
        *("/../certificate.py", "/..%2fserver.py", "//etc/passwd", "/main.js/", "/MAIN.JS", "/%6dain.js"),
        *("/.hidden.js", "/Notes.txt", "/setup.py", "/folder.js", "/link.js", "/room", "main.js", ""),
    ],
)
def test_nothing_else_is(guard: PageGuard, path: str) -> None:
    answer = guard.answer(path, {"host": HOST}, False)
    assert answer is not None and answer.status == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:8443", "192.168.1.5.evil.example", "", None, "[x]"]
)
def test_a_name_that_is_not_this_machines_is_refused(guard: PageGuard, host: str | None) -> None:
    headers = {} if host is None else {"host": host, "origin": f"https://{host}"}
    for is_upgrade in (False, True):
        answer = guard.answer("/room" if is_upgrade else "/", headers, is_upgrade)
        assert answer is not None and answer.status == 403


@pytest.mark.parametrize(
    "origin",
    [
        *(
            None,
            "null",
            "https://evil.example",
            f"http://{HOST}",
            "https://192.168.1.5",
            "https://192.168.1.5:84430",
        )
    ],
)
def test_only_its_own_page_opens_a_socket(guard: PageGuard, origin: str | None) -> None:
    assert guard.answer("/room", {"host": HOST, "origin": f"https://{HOST}"}, True) is None
    headers = {"host": HOST} | ({} if origin is None else {"origin": origin})
    answer = guard.answer("/room", headers, True)
    assert answer is not None and answer.status == 403


def test_the_policy_allows_its_own_files_and_socket_alone(guard: PageGuard) -> None:
    policy = guard.headers(HOST)["Content-Security-Policy"]
    assert "default-src 'none'" in policy and f"connect-src 'self' wss://{HOST};" in policy
    assert "unsafe" not in policy and "frame-ancestors 'none'" in policy
    hostile = guard.headers("x; script-src *")["Content-Security-Policy"]
    assert "*" not in hostile
