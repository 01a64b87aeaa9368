"""What a wearer that has paired may do, by and by."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from share.headset.pairing import PairingError
from share.headset.session_ledger import SessionLedger, moment_now
from share.headset.wearer_session import SessionOverError, WearerSession
from share.headset.wearers import EdgeAccess, ListDamagedError, WearerRegistry
from share.net.keys import authorize, generate_pair, revoke
from share.wire.room_messages import Permission


def wearer(name: str, left_s: float) -> Any:
    session = WearerSession(name, None, "a:1", 1, moment_now().after(left_s), "n")
    return SimpleNamespace(name=name, session=session)


def registry(access: EdgeAccess) -> WearerRegistry:
    return WearerRegistry(access, bytes(32), SessionLedger("a:1"), lambda line: None, lambda *_: None)


def test_twelve_hours_end_also_for_a_page_that_stays() -> None:
    access = EdgeAccess("tcp://127.0.0.1:1", frozenset({Permission.OBJECTS}))
    assert registry(access).rights_now(wearer("ann", 1.0)) == {Permission.OBJECTS}
    with pytest.raises(SessionOverError, match="this session is over; pair again"):
        registry(access).rights_now(wearer("ann", -1.0))


def test_a_session_that_another_edge_of_the_address_ends_is_over_here_too(tmp_path: Path) -> None:
    desks = [
        WearerRegistry(
            EdgeAccess("tcp://127.0.0.1:1"), bytes(32), SessionLedger("a:1", tmp_path), *[lambda *_: None] * 2
        )
        for _ in "ab"
    ]
    here = SimpleNamespace(name="ann", session=SessionLedger("a:1").new_session("ann", None, moment_now()))
    assert desks[0].rights_now(here) == frozenset()  # type: ignore[arg-type]
    there = SessionLedger("a:1", tmp_path)
    there.note(here.session)
    assert desks[0].rights_now(here) == frozenset()  # type: ignore[arg-type]
    there.note(there.new_session("ann", None, moment_now()))
    for desk in desks:
        with pytest.raises(SessionOverError, match="another headset has paired as 'ann' since"):
            desk.rights_now(here)  # type: ignore[arg-type]


def test_rights_are_as_the_list_says_now(tmp_path: Path) -> None:
    public = generate_pair(tmp_path / "ann", "ann").public
    one = registry(EdgeAccess("tcp://127.0.0.1:1", frozenset(Permission), tmp_path))
    authorize(tmp_path, "ann", public, permissions={Permission.COMMANDS: True})
    assert one.rights_now(wearer("ann", 9.0)) == {Permission.COMMANDS}
    revoke(tmp_path, "ann")
    with pytest.raises(PairingError, match=r"no agent 'ann'.*share keys authorize ann ann\.public"):
        one.rights_now(wearer("ann", 9.0))
    (tmp_path / "authorized").write_bytes(b"\0garbage")
    with pytest.raises(ListDamagedError, match=r"the edge's list of keys cannot be used: .*authorized"):
        one.rights_now(wearer("ann", 9.0))
