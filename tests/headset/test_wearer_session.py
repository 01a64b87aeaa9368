"""By what a page comes back."""

from __future__ import annotations

import base64
import json

import pytest

from share.agent_names import MAX_NAME_LENGTH, checked_name
from share.headset.page_messages import PageHello, decode_page
from share.headset.pairing import PairingError
from share.headset.wearer_session import (
    SESSION_S,
    SessionMoment,
    SessionOverError,
    WearerSession,
    seal,
    unseal,
)

KEY = b"k" * 32
EDGE = "192.168.1.10:8443"
NOW = SessionMoment("boot", 500.0, 1.8e9)


def session(left_s: float = SESSION_S, name: str = "Ann Ö") -> WearerSession:
    return WearerSession(name, "ann", EDGE, 7, NOW.after(left_s), "n")


def test_a_session_is_known_again_by_its_secret_alone() -> None:
    assert unseal(KEY, seal(KEY, session()), EDGE, NOW) == session()
    assert unseal(KEY, seal(KEY, session(1.0)), EDGE, NOW) == session(1.0)
    for over in (session(0.0), session(-1.0), session(SESSION_S + 1)):
        with pytest.raises(SessionOverError, match="is over; pair again"):
            unseal(KEY, seal(KEY, over), EDGE, NOW)


def test_a_session_of_one_edge_is_none_at_another() -> None:
    with pytest.raises(SessionOverError, match="not known here"):
        unseal(KEY, seal(KEY, session()), "192.168.1.10:9443", NOW)


@pytest.mark.parametrize("step_s", [-400 * 86400.0, -12 * 3600.0, 12 * 3600.0, 400 * 86400.0])
def test_a_clock_that_is_set_changes_nothing_while_the_machine_runs(step_s: float) -> None:
    secret = seal(KEY, session())
    wrong = SessionMoment("boot", NOW.up_s, NOW.wall_s + step_s)
    assert unseal(KEY, secret, EDGE, SessionMoment("boot", NOW.up_s + SESSION_S - 1, wrong.wall_s))
    with pytest.raises(SessionOverError):
        unseal(KEY, secret, EDGE, SessionMoment("boot", NOW.up_s + SESSION_S, wrong.wall_s))


def test_after_a_start_of_the_machine_the_wall_clock_tells() -> None:
    secret = seal(KEY, session())
    unknown = WearerSession("ann", None, EDGE, 7, SessionMoment("", 9.0, NOW.wall_s + 10), "n")
    assert unknown.is_over(SessionMoment("", 5.0, NOW.wall_s + 20)), (
        "a sandbox does not say which start it is"
    )
    for later_s in (60, SESSION_S - 1):
        assert unseal(KEY, secret, EDGE, SessionMoment("another", 5.0, NOW.wall_s + later_s))
    for later_s in (SESSION_S, 1e9, -1, -1e9):
        with pytest.raises(SessionOverError):
            unseal(KEY, secret, EDGE, SessionMoment("another", 5.0, NOW.wall_s + later_s))


def test_the_longest_names_have_a_secret_that_a_page_may_send() -> None:
    longest = checked_name("\U00020000" * MAX_NAME_LENGTH)
    end = SessionMoment("0" * 36, 123456789.123456, 1.8e9 + 0.1234567)
    edge = "[2001:0db8:1111:2222:3333:4444:5555:6666%enp0s31f6]:65535"
    one = WearerSession(longest, longest, edge, 10**14, end, "n" * 16)
    secret = seal(KEY, one)
    hello = decode_page(json.dumps({"type": "hello", "schema": 1, "session": secret}))
    assert isinstance(hello, PageHello) and hello.session == secret
    assert unseal(KEY, secret, edge, SessionMoment("0" * 36, 123456780.0, 0.0)) == one


def test_no_changed_secret_is_a_session() -> None:
    secret = seal(KEY, session(name="ann"))
    data = base64.urlsafe_b64decode(secret)
    changed = [bytes([*data[:k], data[k] ^ 1, *data[k + 1 :]]) for k in range(len(data))]
    texts = [base64.urlsafe_b64encode(one).decode() for one in changed]
    others = ("", "=", "é", "\ud800", "A" * 5000, secret[:-4], seal(b"j" * 32, session()))
    for text in (*texts, *others):
        with pytest.raises(PairingError, match="not known here"):
            unseal(KEY, text, EDGE, NOW)
