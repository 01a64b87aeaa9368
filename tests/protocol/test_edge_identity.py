"""Identity of a run: its run id is secret, and with keys a credential is authorised for names."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.hellos import hello_of

from share.agent_names import checked_name
from share.checks import MAX_ID
from share.config import Config
from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SaveCredential
from share.protocol import edge_events as ed
from share.protocol.common_events import Tick
from share.protocol.edge import EdgeProtocol
from share.protocol.keyframe_intake import OdometryBase
from share.protocol.peer import RestoredRun
from share.types import Keyframe, View
from share.wire import messages as m
from share.wire.codec import decode, encode
from share.wire.room_messages import ClientHello

SECRET = 0x0123_4567_89AB_CDEF
EMPTY = View(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 32), np.uint8))
ANN = frozenset({"ann"})
EVE = frozenset({"eve", "mallory"})


def keyframe(id: int) -> Keyframe:
    cov = 1e-6 * np.eye(6)
    return Keyframe(id, id - 1, 200 * id, np.eye(4), cov, np.eye(4), np.zeros(3), 0.0, EMPTY)


def tell(
    edge: EdgeProtocol,
    message: m.Message,
    names: frozenset[str] | None,
    peer: int = SECRET,
    now_ns: int = 0,
    key: str = "",
) -> list[ed.EdgeEffect]:
    frames = [bytes(frame) for frame in encode(message)]
    return edge.handle(ed.PeerMessageReceived(m.peer_id(peer), frames, names, key), now_ns)


def sent(effects: list[ed.EdgeEffect]) -> list[m.Message]:
    return [decode([bytes(f) for f in e.frames]) for e in effects if isinstance(e, ed.SendToPeer)]


def of(effects: list[ed.EdgeEffect], kind: type) -> list:
    return [effect for effect in effects if isinstance(effect, kind)]


def test_a_run_is_not_to_blame_for_who_uses_it_with_another_s_key() -> None:
    """The page said of ann that her messages are refused."""
    edge = EdgeProtocol(Config(), 7)
    tell(edge, hello_of("ann", SECRET), ANN)
    before = edge.report({})["agents"]["ann"]
    for message in (m.Welcome(1, 0), m.Bye(), keyframe(0)):
        tell(edge, message, EVE)
    edge.handle(ed.PeerMessageReceived(m.peer_id(SECRET), [b"nonsense"], EVE), 0)
    report = edge.report({})
    assert report["agents"]["ann"] == before
    assert report["unjoined"]["unexpected"] == 1
    assert report["unjoined"]["bad_messages"] == 3


def test_a_key_is_authorised_for_its_names_only() -> None:
    edge = EdgeProtocol(Config(), 7)
    (refused,) = sent(tell(edge, hello_of("ann", SECRET), EVE, key="of eve"))
    assert isinstance(refused, m.Refused)
    assert "authorized for 'eve', 'mallory', not for 'ann'" in refused.reason
    assert "share keys authorize" in refused.reason
    welcome, _ = sent(tell(edge, hello_of("eve", SECRET), EVE))
    assert isinstance(welcome, m.Welcome)


def test_without_keys_nobody_is_told_of_keys() -> None:
    """In a room of a site, whose rooms file names who may be there."""
    edge = EdgeProtocol(Config(), 7)
    why = "this room is for 'eve', 'mallory', not for 'ann': see `agents` of the room in the rooms file"
    assert sent(tell(edge, hello_of("ann", SECRET), EVE)) == [m.Refused(why)]
    tell(edge, hello_of("eve", SECRET), EVE)
    for message in (hello_of("eve", SECRET), ClientHello("ann", 5)):
        (refused,) = sent(tell(edge, message, ANN if message.name == "eve" else EVE, peer=message.run_id))
        assert isinstance(refused, m.Refused) and refused.reason.endswith("in the rooms file")
    assert "key" not in str(edge.report({})["unjoined"]) + str(edge.report({})["refused"])


def test_a_run_is_not_taken_over_by_another_key() -> None:
    """The attacker knows the run id and has taken over the transport id."""
    edge = EdgeProtocol(Config(), 7)
    tell(edge, hello_of("ann", SECRET), ANN)
    tell(edge, keyframe(0), ANN)
    for message in (keyframe(1), m.Bye(), hello_of("ann", SECRET), m.Evaluation(0, 1.0, 1.0), m.Ping(1, 0)):
        effects = tell(edge, message, EVE)
        assert not of(effects, ed.AddKeyframe), message
        assert not [answer for answer in sent(effects) if not isinstance(answer, m.Refused)], message
    assert not edge.report({})["agents"]["ann"]["gone"]
    assert of(tell(edge, keyframe(1), ANN), ed.AddKeyframe)


def test_without_keys_the_run_id_identifies_a_run() -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, hello_of("ann", SECRET), None)
    assert of(tell(edge, keyframe(0), None), ed.AddKeyframe)
    welcome, _ = sent(tell(edge, hello_of("ann", SECRET), None, now_ns=10**9))  # connected again
    assert welcome == m.Welcome(7, 1)
    (refused,) = sent(tell(edge, hello_of("ann", 5), None, peer=5, now_ns=10**9))
    assert isinstance(refused, m.Refused)


def test_no_output_reveals_the_run_id() -> None:
    edge = EdgeProtocol(Config(), 7, has_store=True)
    effects = tell(edge, hello_of("ann", SECRET), None) + tell(edge, keyframe(0), None)
    shown = [edge.report({}), edge.series(), *(e.fields for e in of(effects, ed.WriteEvent))]
    keys = [e.key for e in of(effects, ed.AddRun)]
    text = json.dumps([shown, keys])
    for digits in (str(SECRET), f"{SECRET:x}", f"{SECRET:016x}"[-4:], f"{SECRET:016x}"[:4]):
        assert digits not in text


@pytest.mark.parametrize("number", [5 * 10**7, 10**9, MAX_ID])
def test_a_jump_of_ids_costs_one_message(number: int) -> None:
    edge = EdgeProtocol(Config(), 7)
    tell(edge, hello_of("ann", SECRET), None)
    tell(edge, keyframe(0), None)
    effects = tell(edge, replace(keyframe(1), id=number, reference=-1, predecessor=-1), None)
    assert not of(effects, ed.AddKeyframe)
    assert sent(effects) == [m.Ack(1)]
    assert of(tell(edge, keyframe(1), None), ed.AddKeyframe)
    assert edge.report({})["agents"]["ann"]["refused_messages"] == 1


@pytest.mark.parametrize("name", ["n" * 57, "n" * 58, "n" * 64, "é" * 64, "日" * 64])
def test_the_map_of_an_agent_with_a_long_name_can_be_sent(name: str) -> None:
    (join,) = of(tell(EdgeProtocol(Config(), 7), hello_of(name, SECRET), None), ed.AddRun)
    map_id = f"{join.key}/999999"  # of its segment of that number
    sent_back = decode(encode(m.Correction(np.eye(4), np.eye(6), map_id, 1, 0, 0)))
    assert isinstance(sent_back, m.Correction) and sent_back.map_id == map_id


def test_the_credential_of_a_run_follows_the_authorised_key() -> None:
    edge = EdgeProtocol(Config(), 7, has_store=True)
    (join,) = of(tell(edge, hello_of("eve", SECRET), EVE, key="E"), ed.AddRun)
    (other,) = of(tell(edge, hello_of("mallory", 5), frozenset({"bob", "mallory"}), 5, key="E"), ed.AddRun)
    assert join.credential == other.credential == "E"
    (same,) = of(tell(edge, hello_of("mallory", 6), EVE, 6, 10**10, key="F"), ed.AddRun)
    assert same.credential == "F"
    (keep,) = of(tell(edge, keyframe(0), EVE, key="E"), ed.SaveChanges)
    assert keep.changes[0].credential == "E"
    assert "'E'" not in str(edge.report({}))


@pytest.mark.parametrize("message", [hello_of("eve", SECRET), keyframe(3), m.Ping(1, 0)])
@pytest.mark.parametrize("kept", [None, "", "E", "F"])
def test_a_restored_run_takes_the_credential_of_its_sender(kept: str | None, message: m.Message) -> None:
    known = RestoredRun(
        "eve-1234", hello_of("eve", SECRET), OdometryBase.from_keyframe(keyframe(2)), credential=kept
    )
    edge = EdgeProtocol(Config(), 7, has_store=True, restored=[known])
    effects = tell(edge, message, EVE, now_ns=1, key="E")
    changes = [change for keep in of(effects, ed.SaveChanges) for change in keep.changes]
    if kept == "E":
        assert not of(effects, ed.SetCredential)
    else:
        assert of(effects, ed.SetCredential) == [ed.SetCredential("eve-1234", "E")]
        assert SaveCredential("eve-1234", "E") in changes
    again = tell(edge, m.Ping(2, 0), EVE, now_ns=2, key="E")
    assert not of(again, ed.SetCredential)
    assert not of(again, ed.SaveChanges)


def test_no_name_equals_the_label_of_an_earlier_run() -> None:
    """The key of eve's first run is the honest agent's name, by choice of the run id."""
    edge, number = (
        EdgeProtocol(Config(), 7),
        next(n for n in range(10**6) if m.public_tag(n).startswith("0001")),
    )
    tell(edge, hello_of("eve-0001", SECRET), None)
    for run, now_ns in ((number, 1), (5, 2)):
        tell(edge, hello_of("eve", run), None, run, now_ns)
        tell(edge, m.Bye(), None, run, now_ns)
    assert of(tell(edge, keyframe(0), None, now_ns=3), ed.AddKeyframe)
    own = edge.report({})["agents"]["eve-0001"]["run"]
    agents = edge.report({"agents": {"eve-0001": {"map_id": "hers"}, own: {"map_id": "own"}}})["agents"]
    assert agents.keys() == {"eve-0001", "eve", "eve/0001"}
    assert (agents["eve-0001"]["gone"], agents["eve-0001"]["keyframes"]) == (False, 1)
    assert (agents["eve-0001"]["map_id"], agents["eve/0001"]["map_id"]) == ("own", "hers")
    assert agents["eve/0001"]["run"] == "eve-0001"
    with pytest.raises(ValueError, match="name"):
        checked_name("eve/0001")


def test_labels_of_earlier_runs_are_unique() -> None:
    """For any order of joining."""
    edge, run = EdgeProtocol(Config(), 7), 0
    for name in ("a", "a-b", "a-b.c", "a"):
        for _ in range(3):
            run += 1
            tell(edge, hello_of(name, run), None, run, run * 10**10)
            tell(edge, m.Bye(), None, run, run * 10**10)
    agents = edge.report({})["agents"]
    assert len(agents) == 12
    assert len({agent["run"] for agent in agents.values()}) == 12


def restored(*runs: tuple[str, int]) -> list[RestoredRun]:
    """Runs of a map file, each with a keyframe."""
    base = OdometryBase.from_keyframe(keyframe(2))
    return [RestoredRun(f"{name}-0001", hello_of(name, run_id), base) for name, run_id in runs]


def test_a_hello_with_another_run_id_than_its_connection_is_refused() -> None:
    """A restarted edge knows a run by the id in its hello, so two of them would have been one."""
    edge = EdgeProtocol(Config(), 7)
    (refused,) = sent(tell(edge, hello_of("eve", 5), None, peer=SECRET))
    assert isinstance(refused, m.Refused) and "another run id than its connection" in refused.reason
    assert edge.report({})["agents"] == {}
    welcome, _ = sent(tell(edge, hello_of("eve", SECRET), None))
    assert isinstance(welcome, m.Welcome)
    (refused,) = sent(tell(edge, hello_of("eve", 5), None, peer=SECRET))  # of a run that is known too
    assert isinstance(refused, m.Refused)


def test_two_runs_of_a_map_file_with_one_id_are_two_runs_and_can_both_be_forgotten() -> None:
    """Every report failed for good, and nothing was acknowledged any more."""
    edge = EdgeProtocol(Config(), 7, restored=restored(("eve", 5), ("mallory", 5)))
    assert edge.report({})["agents"].keys() == {"eve", "mallory"}
    empty = tuple(KeyframeKey(f"{name}-0001", 2) for name in ("eve", "mallory"))
    edge.handle(ed.MapperResult((), (), empty), 0)
    effects = edge.handle(Tick(), 0)
    assert {one.key for one in of(effects, ed.DropRun)} == {"eve-0001", "mallory-0001"}
    report = edge.report({})
    assert (report["internal_errors"], report["agents"], report["unlisted_runs"]) == (0, {}, 0)
    (welcome, *_) = sent(tell(edge, hello_of("bob", 9), None, peer=9))
    assert isinstance(welcome, m.Welcome)


def test_of_two_runs_with_one_id_the_first_goes_on() -> None:
    edge = EdgeProtocol(Config(), 7, restored=restored(("eve", 5), ("mallory", 5)))
    assert sent(tell(edge, hello_of("eve", 5), None, peer=5))[0] == m.Welcome(7, 3)
    (refused,) = sent(tell(edge, hello_of("mallory", 5), None, peer=5))
    assert isinstance(refused, m.Refused) and "in use by 'eve'" in refused.reason
