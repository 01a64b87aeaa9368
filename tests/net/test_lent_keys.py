"""Keys that an edge lends: clients of several names from one process, each with its own rights."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers.room_server import MAP, RoomServer

from share.errors import UsageError
from share.headset.pairing import PairingError
from share.headset.wearers import EdgeAccess
from share.net.keys import AgentKeys, allow_list, authorize, edge_keys, generate_pair, revoke
from share.net.lent_keys import LentKeys
from share.protocol.room_events import MessageWanted, RequestAnswered
from share.runtime.room_link import RoomLink
from share.wire.room_messages import ObjectKind, Permission, PutObject

SECRET = b"s" * 32


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Keys of an edge: ann's and bob's devices, of which ann's may place objects."""
    generate_pair(tmp_path / "edge", "edge")
    for name, may in (("ann", True), ("bob", False)):
        pair = generate_pair(tmp_path / name, f"{name}-pc")
        rights = {Permission.OBJECTS: may}
        authorize(tmp_path / "edge", f"{name}-pc", pair.public, [name], rights)
    return tmp_path / "edge"


def wait_for(link: RoomLink, is_it: Callable[[], bool], within_s: float = 30.0) -> bool:
    deadline = time.monotonic() + within_s
    while not is_it() and time.monotonic() < deadline:
        link.step(20)
    return is_it()


def put(link: RoomLink) -> str:
    """Place an object; return the answer."""
    request = PutObject(next(link.numbers), 5, ObjectKind.CUBE, MAP, np.eye(4))
    link.handle(MessageWanted(request))
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        for effect in link.step(20):
            if isinstance(effect, RequestAnswered):
                return effect.reason
    raise AssertionError("no answer")


@pytest.mark.long
def test_each_name_has_the_rights_that_the_list_gives_it(folder: Path) -> None:
    keys, lent = edge_keys(folder), LentKeys(SECRET)
    keys.allowed.public_key_of = lambda name: lent.pair(name).public
    with RoomServer(keys=keys) as edge:

        def link(name: str, key: str) -> RoomLink:
            pair = lent.pair(key)
            return RoomLink(edge.address, name, AgentKeys(pair, keys.own.public, is_lent=True))

        with closing(link("ann", "ann")) as ann, closing(link("bob", "bob")) as bob:
            assert put(ann) == ""
            assert "the key of 'bob' may not place objects" in put(bob)
            (one,) = edge.edge.room.kept_objects()
            assert one.object.owner == "ann"
            with closing(link("zoe", "zoe")) as zoe:  # a name that the list does not have
                assert not wait_for(zoe, lambda: zoe.client.is_connected, 2.0)
            with closing(link("ann", "bob")) as other, pytest.raises(UsageError, match="ann"):
                wait_for(other, lambda: False, 20.0)
            revoke(folder, "ann-pc")
            assert wait_for(ann, lambda: not ann.client.is_connected)
            assert wait_for(ann, lambda: "has no agent 'ann' any more" in (ann.trouble or ""))
            assert wait_for(bob, lambda: bob.client.is_connected)


def test_a_list_without_a_loan_has_none(folder: Path) -> None:
    public = LentKeys(SECRET).pair("ann").public
    assert not allow_list(folder).is_allowed(public)
    lending = allow_list(folder)
    lending.public_key_of = lambda name: LentKeys(SECRET).pair(name).public
    assert lending.agents_for(public) == {"ann"}
    assert lending.permissions_of(public) == {Permission.OBJECTS}
    assert not lending.is_allowed(LentKeys(b"t" * 32).pair("ann").public)
    other = "x" * 40
    assert f"share keys authorize NAME '{other}'" in lending.refusal(other, "127.0.0.1")
    for name in ("ann-pc", "bob-pc"):
        revoke(folder, name)
    said = lending.refusal(public, "127.0.0.1")  # a key that nobody has in a file: not to be authorized
    assert said == "a client of 'ann' (127.0.0.1): the list has no agent of that name any more"
    assert public not in lending.names_by_key()  # it is in no list that a person sees


def test_a_name_has_what_any_of_its_keys_may(folder: Path, tmp_path: Path) -> None:
    pair = generate_pair(tmp_path / "more", "more")
    authorize(folder, "more", pair.public, ["ann", "cy"], {Permission.COMMANDS: True})
    both, none = frozenset(Permission), frozenset[Permission]()
    assert allow_list(folder).rights() == {"ann": both, "bob": none, "cy": frozenset({Permission.COMMANDS})}
    access = EdgeAccess("tcp://127.0.0.1:1", both, folder, "", SECRET)
    assert access.rights_of("bob") == none
    with pytest.raises(PairingError, match=r"has no agent 'zoe'; .*: share keys authorize zoe zoe\.public"):
        access.rights_of("zoe")
    (folder / "authorized").write_text("nonsense\n")
    with pytest.raises(PairingError, match=r"the edge's list of keys cannot be used: .*line 1"):
        access.rights_of("ann")
    assert EdgeAccess("tcp://127.0.0.1:1", both).rights_of("zoe") == both
