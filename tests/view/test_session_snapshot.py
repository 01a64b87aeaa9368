"""What a live room that starts again is told leads to the same room."""

from __future__ import annotations

import numpy as np

from share.mapping.loops import KeyframeKey
from share.mapping.map_changes import SavePoses
from share.types import AgentKind
from share.view import drawing as dr
from share.view import events as ev
from share.view.events import MAX_KEYFRAMES, SessionSnapshot
from share.view.room import DrawnRoom


def at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def shown(run: str, k: int) -> ev.KeyframeArrived:
    return ev.KeyframeArrived(KeyframeKey(run, k), k == 0, at(k), np.ones((5, 3), np.float32), b"x" * 10**5)


def drawn(events: list[ev.RoomEvent]) -> dict[str, object]:
    room, out = DrawnRoom(), dict[str, object]()
    for event in events:
        room.apply(event, 0.0)
    while room.waiting:
        for one in room.take_drawings(10.0):
            if isinstance(one, dr.RemoveDrawing):
                out.pop(one.name, None)
            elif isinstance(one, dr.Points | dr.Lines):
                out[one.name] = one.origin.round(6).tolist()
    return out


def test_it_leads_to_the_same_room() -> None:
    events: list[ev.RoomEvent] = [ev.SessionBegun()]
    for run in ("ann", "bob", "eve"):
        events.append(ev.RunArrived(run, run, AgentKind.AR, np.eye(4), (1.0, 1.0)))
        events += [shown(run, k) for k in range(40)]
        events.append(ev.CorrectionArrived(run, f"{run}/0", at(1), 0))
    keys = tuple(KeyframeKey(run, k) for run in ("ann", "bob") for k in range(20))
    events.append(ev.MapsSolved(SavePoses(keys, np.array([at(2 * k.id) for k in keys]), ("A",) * len(keys))))
    events += [ev.LoopAccepted(KeyframeKey("ann", k), KeyframeKey("bob", k)) for k in range(5)]
    events += [ev.LoopsRemoved(KeyframeKey("bob", 1), KeyframeKey("ann", 1)), ev.RunRemoved("eve")]
    snapshot = SessionSnapshot()
    for event in events:
        snapshot.apply(event)
    assert drawn(list(snapshot.events())) == drawn(events)
    assert len(list(snapshot.events())) == 1 + 2 + 80 + 2 + 1 + 4


def test_what_is_gone_and_pictures_are_not_kept() -> None:
    snapshot = SessionSnapshot()
    for k in range(MAX_KEYFRAMES + 10):
        snapshot.apply(shown("ann", k))
    snapshot.apply(ev.LoopAccepted(KeyframeKey("ann", 20), KeyframeKey("ann", 21)))
    snapshot.apply(ev.KeyframesRemoved((KeyframeKey("ann", 20),)))
    kept = [one for one in snapshot.events() if isinstance(one, ev.KeyframeArrived)]
    assert len(kept) == MAX_KEYFRAMES - 1 and not any(one.jpeg for one in kept)
    assert not any(isinstance(one, ev.LoopAccepted) for one in snapshot.events())
