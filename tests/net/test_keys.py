"""Keys as files, and which are admitted over CURVE."""

from __future__ import annotations

import errno
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import zmq
from zmq.utils import z85

from share.errors import ShareError, UsageError
from share.net import keys, zeromq_socket
from share.net.keys import AgentKeys, AllowList, EdgeKeys, KeyPair
from share.net.transport import AgentLink, EdgeLink, bind, connect
from share.wire.messages import peer_id
from share.wire.room_messages import Permission


def text(*paths: Path) -> str:
    return "".join(path.read_text() for path in paths)


# ---------------------------------------------------------------- files


def test_a_pair_is_read_as_it_was_made(tmp_path: Path) -> None:
    pair = keys.generate_pair(tmp_path / "new" / "keys", "edge")
    assert keys.load_pair(tmp_path / "new" / "keys") == pair
    assert zmq.curve_public(pair.secret.encode()).decode() == pair.public
    assert text(tmp_path / "new/keys/edge.public") == f"share-public-key edge {pair.public}\n"
    assert pair.secret not in repr(pair)
    assert pair.secret not in text(tmp_path / "new/keys/edge.public")


def test_only_the_owner_can_read_the_secret(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        keys.generate_pair(tmp_path / "keys", "edge")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "keys" / "edge.secret").stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "keys").stat().st_mode) == 0o700


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660])
def test_a_readable_secret_is_refused(mode: int, tmp_path: Path) -> None:
    keys.generate_pair(tmp_path, "edge")
    (tmp_path / "edge.secret").chmod(mode)
    with pytest.raises(UsageError, match=r"edge\.secret: others can read this secret; `chmod 600 "):
        keys.load_pair(tmp_path)


def test_a_pair_is_never_replaced(tmp_path: Path) -> None:
    pair = keys.generate_pair(tmp_path, "edge")
    with pytest.raises(UsageError, match="there is a key pair already"):
        keys.generate_pair(tmp_path, "other")
    assert keys.load_pair(tmp_path) == pair
    assert sorted(os.listdir(tmp_path)) == ["edge.public", "edge.secret"]


def test_no_public_key_looks_like_an_option(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = [(b"-" + b"0" * 39, b"1" * 40), (b"<" + b"0" * 39, b"2" * 40), zmq.curve_keypair()]
    drawn[2] = next(pair for pair in iter(zmq.curve_keypair, None) if pair[0][:1].isalnum())
    expected = drawn[2][0].decode()
    monkeypatch.setattr(zmq, "curve_keypair", lambda: drawn.pop(0))
    assert keys.generate_pair(tmp_path, "edge").public == expected


def test_named_after_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "-lab pc.local")
    assert keys.generate_pair(tmp_path).name == "lab-pc-local"


@pytest.mark.parametrize("name", ["", "a b", "../x", ".x", "-x", "x" * 65, "zoë", "a\n"])
def test_names(name: str, tmp_path: Path) -> None:
    for use in (
        lambda: keys.authorize(tmp_path, name, "0" * 40),
        lambda: keys.generate_pair(tmp_path, name or " "),
    ):
        with pytest.raises(UsageError, match="a name has 1 to 64 letters"):
            use()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda d: (d / "edge.secret").unlink(), "has no key pair; make one with `share keys generate --"),
        (lambda d: (d / "edge.secret").write_text("gone"), "edge.secret: is not a SHARE secret key"),
        (lambda d: (d / "edge.secret").write_text(text(d / "edge.public")), "is not a SHARE secret key"),
        (
            lambda d: (d / "edge.secret").write_bytes(b"\xff\0"),
            "edge.secret: cannot be read: not a text file",
        ),
        (lambda d: (d / "ann.secret").write_text(text(d / "edge.secret")), "has 2 key pairs"),
    ],
)
def test_a_folder_that_cannot_be_used(damage, said: str, tmp_path: Path) -> None:
    keys.generate_pair(tmp_path, "edge")
    damage(tmp_path)
    with pytest.raises(UsageError, match=said):
        keys.load_pair(tmp_path)


def test_an_unreadable_folder_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(where: object) -> list[str]:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(where))

    keys.generate_pair(tmp_path, "edge")
    assert not keys.has_pair(tmp_path / "none")
    monkeypatch.setattr(os, "listdir", denied)  # root, who may run this, may read all
    monkeypatch.setattr(os, "scandir", denied)
    for look in (keys.load_pair, keys.has_pair, keys.edge_keys):
        with pytest.raises(UsageError, match=rf"^{tmp_path}: cannot be read: Permission denied$"):
            look(tmp_path)


def test_default_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert keys.default_folder() == tmp_path / "share" / "keys"
    monkeypatch.setenv("XDG_CONFIG_HOME", "relative")  # the specification: ignore it then
    assert keys.default_folder() == Path.home() / ".config" / "share" / "keys"


def test_a_public_key_is_given_as_text_line_or_file(tmp_path: Path) -> None:
    pair = keys.generate_pair(tmp_path, "ann")
    line = text(tmp_path / "ann.public")
    given = (pair.public, line.strip(), str(tmp_path / "ann.public"))
    assert [keys.public_key(one) for one in given] == [pair.public] * 3


def test_a_path_of_40_characters_is_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All its characters are a key's too, and most such words decode to 32 bytes."""
    pair = keys.generate_pair(tmp_path / "home/ann/.config/share/keys", "edge")
    monkeypatch.chdir(tmp_path)
    path = "home/ann/.config/share/keys//edge.public"
    assert len(path) == 40 and keys._is_key(path)
    assert keys.public_key(path) == pair.public
    for typo in (path.replace("edge", "ebge"), path.replace("public", "pubkey")):
        assert keys._is_key(typo)
        with pytest.raises(UsageError, match="no such file"):
            keys.public_key(typo)


def test_a_key_with_slashes_is_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for key_text in ("/" + "a0" * 19 + "b", "ab/cd/" + "e" * 34):
        assert keys._is_key(key_text) and keys.public_key(key_text) == key_text


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("nowhere", "neither a file nor a public key"),
        ("#" * 40, "neither a file nor a public key"),  # five of them are more than 32 bits
        ("0" * 39, "neither a file nor a public key"),
        ("share-public-key ann short", "is not `share-public-key NAME KEY`"),
        ("{}/ann.secret", "is a secret key, which must stay on its machine; give the public key"),
    ],
)
def test_malformed_public_keys_are_refused(given: str, said: str, tmp_path: Path) -> None:
    keys.generate_pair(tmp_path, "ann")
    with pytest.raises(UsageError, match=said):
        keys.public_key(given.format(tmp_path))


# ---------------------------------------------------------------- the list


def key(number: int) -> str:
    return z85.encode(bytes([number]) * 32).decode()


def test_authorize_and_revoke(tmp_path: Path) -> None:
    allowed = keys.allow_list(tmp_path)
    assert allowed.names_by_key() == {}
    keys.authorize(tmp_path, "bob", key(2))
    keys.authorize(tmp_path, "ann", key(1))
    keys.authorize(tmp_path, "ann", key(1))  # again: nothing new
    assert allowed.names_by_key() == {key(1): "ann", key(2): "bob"}
    assert text(allowed.path) == f"share-public-key bob {key(2)}\nshare-public-key ann {key(1)}\n"
    keys.revoke(tmp_path, "ann")
    assert [allowed.is_allowed(key(n)) for n in (1, 2)] == [False, True]
    with pytest.raises(UsageError, match="'ann' is not authorized; authorized are: bob"):
        keys.revoke(tmp_path, "ann")


def test_what_a_key_may_do_as_a_client_is_given_kept_and_taken_back(tmp_path: Path) -> None:
    public, allowed = zmq.curve_keypair()[0].decode(), keys.allow_list(tmp_path)
    keys.authorize(tmp_path, "headset1", public, ["ann", "carol"])
    assert allowed.permissions_of(public) == frozenset()
    keys.authorize(tmp_path, "headset1", public, permissions={Permission.COMMANDS: True})
    keys.authorize(tmp_path, "headset1", public, permissions={Permission.OBJECTS: True})
    assert (
        text(tmp_path / "authorized") == f"share-public-key headset1 {public} ann carol +commands +objects\n"
    )
    assert allowed.permissions_of(public) == frozenset(Permission)
    keys.authorize(tmp_path, "headset1", public, ["bob"], {Permission.COMMANDS: False})
    assert allowed.permissions_of(public) == {Permission.OBJECTS}
    assert allowed.agents_for(public) == {"bob"}
    assert allowed.permissions_of("x" * 40) == frozenset()


@pytest.mark.parametrize("words", ["+drive", "+commands ann", "commands+", "+ objects"])
def test_an_unknown_permission_damages_the_list(words: str, tmp_path: Path) -> None:
    public = zmq.curve_keypair()[0].decode()
    (tmp_path / "authorized").write_text(f"share-public-key ann {public} {words}\n")
    assert keys.allow_list(tmp_path).permissions_of(public) == frozenset()
    assert "line 1" in str(keys.allow_list(tmp_path).trouble())


def test_with_keys_the_list_says_who_may_and_no_option() -> None:
    assert keys.allowed_without_keys(["objects"], False) == {Permission.OBJECTS}
    with pytest.raises(UsageError, match="--allow: with keys the list says who may"):
        keys.allowed_without_keys(["objects"], True)
    with pytest.raises(UsageError, match="--allow 'all': known are commands, objects"):
        keys.allowed_without_keys(["all"], False)


def test_one_name_one_key(tmp_path: Path) -> None:
    keys.authorize(tmp_path, "ann", key(1))
    with pytest.raises(
        UsageError, match="'ann' has another key; remove it first with `share keys revoke ann`"
    ):
        keys.authorize(tmp_path, "ann", key(2))
    with pytest.raises(UsageError, match="'bob': this key is authorized already, as 'ann'"):
        keys.authorize(tmp_path, "bob", key(1))
    assert keys.allow_list(tmp_path).names_by_key() == {key(1): "ann"}


def test_a_list_made_of_public_key_files(tmp_path: Path) -> None:
    pairs = [keys.generate_pair(tmp_path / name, name) for name in ("ann", "bob")]
    path = tmp_path / "authorized"
    path.write_text("# ours\n\n" + text(*(tmp_path / p.name / f"{p.name}.public" for p in pairs)))
    assert AllowList(path).names_by_key() == {pair.public: pair.name for pair in pairs}


def test_comments_in_the_list_stay(tmp_path: Path) -> None:
    path = tmp_path / "authorized"
    path.write_text(f"# room 1\n\nshare-public-key ann {key(1)}\n# spare")  # without an end
    keys.authorize(tmp_path, "bob", key(2))
    keys.revoke(tmp_path, "ann")
    assert text(path) == f"# room 1\n\n# spare\nshare-public-key bob {key(2)}\n"


def test_a_key_listed_twice_is_revoked_by_either_name(tmp_path: Path) -> None:
    path = tmp_path / "authorized"
    for name in ("ann", "old-ann"):
        path.write_text("".join(f"share-public-key {n} {key(1)}\n" for n in ("ann", "old-ann")))
        keys.revoke(tmp_path, name)
        assert not AllowList(path).is_allowed(key(1))


def test_a_world_writable_list_admits_no_key(tmp_path: Path) -> None:
    keys.generate_pair(tmp_path, "edge")
    keys.authorize(tmp_path, "ann", key(1))
    allowed = keys.allow_list(tmp_path)
    assert (allowed.is_allowed(key(1)), allowed.trouble()) == (True, None)
    allowed.path.chmod(0o666)
    assert not allowed.is_allowed(key(1))
    assert allowed.trouble() == f"{allowed.path}: all users can write to it; `chmod o-w {allowed.path}`"
    allowed.path.chmod(0o664)
    assert allowed.is_allowed(key(1))
    tmp_path.chmod(0o777)
    with pytest.raises(UsageError, match=f"^{tmp_path}: all users can write to it; `chmod o-w"):
        keys.load_pair(tmp_path)
    tmp_path.chmod(0o700)


def test_a_damaged_list_admits_no_key_and_is_reported(tmp_path: Path) -> None:
    keys.generate_pair(tmp_path, "edge")
    keys.authorize(tmp_path, "ann", key(1))
    allowed = keys.allow_list(tmp_path)
    assert allowed.is_allowed(key(1))
    allowed.path.write_text(text(allowed.path) + "bob\n")
    assert not allowed.is_allowed(key(1))
    with pytest.raises(UsageError, match="authorized, line 2: is not `share-public-key NAME KEY`"):
        keys.edge_keys(tmp_path)


# ---------------------------------------------------------------- the door


class House:
    """An edge with keys that lets `ann` in, and links to it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder, self._stack = folder / "edge", stack
        self.pair = keys.generate_pair(self.folder, "edge")
        self.ann = self.pair_of("ann")
        keys.authorize(self.folder, "ann", self.ann.public)
        self.edge: EdgeLink = stack.enter_context(
            closing(bind("tcp://127.0.0.1:0", EdgeKeys(self.pair, keys.allow_list(self.folder))))
        )

    def pair_of(self, name: str) -> KeyPair:
        return keys.generate_pair(self.folder.parent / name, name)

    def agent(self, run_id: int, own: KeyPair | None, server: str | None = None) -> AgentLink:
        with_keys = None if own is None else AgentKeys(own, server or self.pair.public)
        return self._stack.enter_context(closing(connect(self.edge.endpoint, run_id, with_keys)))

    def refusals(self, agent: AgentLink) -> list[str]:
        """What the edge says of an agent that gets nothing, and the agent nothing either."""
        lines: list[str] = []
        end = time.monotonic() + 15
        while not (lines and agent.trouble()):
            assert time.monotonic() < end, (lines, agent.trouble())
            assert not agent.send([b"in?"])
            assert agent.receive(5) is None
            assert self.edge.receive(5) is None
            lines += self.edge.refusals()
        return lines

    def loses(self, agent: AgentLink, within_s: float = 4) -> None:
        """The agent notices that its connection is gone; until then what it sends reaches nobody."""
        end = time.monotonic() + within_s
        while agent.send([b"in?"]):
            assert time.monotonic() < end, "still connected"
            assert agent.receive(5) is None
            assert self.edge.receive(5) is None

    def greets(self, agent: AgentLink, run_id: int, within_s: float = 4) -> None:
        """A message there and back."""
        end = time.monotonic() + within_s
        while True:
            assert time.monotonic() < end, "did not get in"
            agent.send([b"hello"])
            if (heard := self.edge.receive(10)) is not None and heard.peer == peer_id(run_id):
                self.edge.send(peer_id(run_id), [b"welcome"])
            if agent.receive(10) == [b"welcome"]:
                return


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    with ExitStack() as stack:
        yield House(tmp_path, stack)


def test_a_malformed_host_is_refused(house: House) -> None:
    with pytest.raises(UsageError, match="'-' is not a valid host name"):
        connect("tcp://-:5555", 1, AgentKeys(house.ann, house.pair.public))


def test_a_listed_key_is_admitted(house: House) -> None:
    agent = house.agent(1, house.ann)
    house.greets(agent, 1)
    assert agent.trouble() is None
    assert house.edge.refusals() == []


@pytest.mark.long
def test_an_unlisted_key_is_refused_until_it_is_listed(house: House) -> None:
    bob = house.pair_of("bob")
    agent = house.agent(2, bob)
    said = house.refusals(agent)[0]
    assert said.endswith(f"is not authorized; to authorize it: share keys authorize NAME '{bob.public}'")
    assert "(127.0.0.1)" in said
    assert agent.trouble() == (
        "refused: the edge does not know this key; "
        f"on the edge's machine: share keys authorize bob '{bob.public}'"
    )
    keys.authorize(house.folder, "bob", bob.public)
    house.greets(agent, 2)
    assert agent.trouble() is None


def test_a_list_damaged_meanwhile_is_reported(house: House) -> None:
    path = house.folder / "authorized"
    path.write_text(text(path) + "bob\n")
    said = house.refusals(house.agent(1, house.ann))
    why = f"all agents are refused: {path}, line 2: is not `share-public-key NAME KEY`"
    assert set(said) == {why}
    assert house.edge.trouble() == why
    keys_before = text(path).removesuffix("bob\n")
    path.write_text(keys_before)
    time.sleep(0.12)
    assert house.edge.receive(0) is None
    assert house.edge.trouble() is None


def test_the_key_of_another_edge(house: House) -> None:
    agent = house.agent(3, house.ann, server=house.pair_of("other").public)
    assert "with another edge's key" in house.refusals(agent)[0]
    assert "has another key than --server-key" in str(agent.trouble())


def test_an_agent_without_keys(house: House) -> None:
    agent = house.agent(4, None)
    assert "an agent without keys" in house.refusals(agent)[0]
    assert "the edge requires keys; give its public key with --server-key" in str(agent.trouble())
    house.greets(house.agent(1, house.ann), 1)  # the edge goes on


def test_an_edge_without_keys(house: House) -> None:
    house.edge.close()
    with closing(bind(house.edge.endpoint)) as plain:
        house.edge = plain
        agent = house.agent(5, house.ann)
        assert "this edge does not: start it with --keys" in house.refusals(agent)[0]
        assert "or none" in str(agent.trouble())
        plain.close()
    with closing(bind(plain.endpoint, EdgeKeys(house.pair, keys.allow_list(house.folder)))) as house.edge:
        house.greets(agent, 5)  # as soon as the right edge is there


def test_an_edge_that_does_not_answer_is_not_said_to_require_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is paused, say: the system still accepts connections for it."""
    monkeypatch.setitem(zeromq_socket._COMMON_OPTIONS, zmq.HANDSHAKE_IVL, 200)
    with socket.create_server(("127.0.0.1", 0)) as paused:
        agent = connect(f"tcp://127.0.0.1:{paused.getsockname()[1]}", 1)
        with closing(agent):
            end = time.monotonic() + 1.5
            while time.monotonic() < end:
                assert agent.receive(20) is None and agent.trouble() is None


def test_who_leaves_before_the_handshake_is_not_said_to_use_keys() -> None:
    """An agent that gave up while the edge was paused, or a port scanner."""
    with closing(bind("tcp://127.0.0.1:0")) as edge:
        host, _, port = edge.endpoint.removeprefix("tcp://").rpartition(":")
        for greeting in (b"", b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x7f\x03"):
            with socket.create_connection((host, int(port))) as leaving:
                leaving.sendall(greeting)
        end = time.monotonic() + 0.5
        while time.monotonic() < end:
            assert edge.receive(20) is None and edge.refusals() == []


def test_a_revoked_key_is_disconnected_and_others_reconnect(house: House) -> None:
    bob = house.pair_of("bob")
    keys.authorize(house.folder, "bob", bob.public)
    ann, bad = house.agent(1, house.ann), house.agent(2, bob)
    house.greets(ann, 1)
    house.greets(bad, 2)
    keys.revoke(house.folder, "bob")
    time.sleep(0.12)  # the edge looks ten times a second
    assert bad.send([b"too late"])
    assert house.edge.receive(50) is None
    assert not house.edge.send(peer_id(2), [b"for bob"])
    house.loses(bad)
    assert "does not know this key" in str(house.refusals(bad) and bad.trouble())
    house.greets(ann, 1)


def test_a_change_that_revokes_no_admitted_key_breaks_no_connection(house: House) -> None:
    agent = house.agent(1, house.ann)
    house.greets(agent, 1)
    keys.authorize(house.folder, "bob", key(9))
    keys.revoke(house.folder, "bob")
    time.sleep(0.12)
    assert house.edge.receive(0) is None
    assert house.edge.send(peer_id(1), [b"still here"])
    assert agent.receive(2000) == [b"still here"]


def test_a_peer_without_a_key_cannot_connect(house: House) -> None:
    """Anonymous CURVE, as anyone could who knows only the edge's public key; many at a time."""
    context = zmq.Context()
    sockets = []
    for _ in range(20):
        rogue = context.socket(zmq.DEALER)
        public, secret = zmq.curve_keypair()
        rogue.curve_publickey, rogue.curve_secretkey = public, secret
        rogue.curve_serverkey = house.pair.public.encode()
        rogue.linger = 0
        rogue.connect(house.edge.endpoint)
        rogue.send(b"let me in")
        sockets.append(rogue)
    house.greets(house.agent(1, house.ann), 1)
    end = time.monotonic() + 10
    count, strangers = 0, []
    while count < 20 and time.monotonic() < end:
        message = house.edge.receive(10)
        if message is not None and message.frames != [b"hello"]:  # ann may have had to say it twice
            strangers.append(message)
        count += len(house.edge.refusals())
    for rogue in sockets:
        rogue.close()
    context.term()
    assert not strangers
    assert count == 20


def test_close_frees_the_address_and_the_thread(house: House) -> None:
    import threading

    agent = house.agent(1, house.ann)
    house.greets(agent, 1)
    start = time.monotonic()
    house.edge.close()
    house.edge.close()
    assert time.monotonic() - start < 1
    assert [t for t in threading.enumerate() if t.name == "doorkeeper"] == []
    with pytest.raises(ShareError, match="in use"), closing(bind(house.edge.endpoint)) as other:
        bind(other.endpoint, EdgeKeys(house.pair, keys.allow_list(house.folder)))
    assert [t for t in threading.enumerate() if t.name == "doorkeeper"] == []
