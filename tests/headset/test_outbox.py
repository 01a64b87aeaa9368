"""What waits for a page."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from share.headset.outbox import MAX_REPLIES, MAX_UNSEEN, Outbox


def pose(agent: str, t: float, **more: Any) -> dict[str, Any]:
    return {"agent": agent, "t_ms": t, **more}


def test_a_page_that_is_slow_gets_the_newest_of_each_thing() -> None:
    box = Outbox()
    for t in range(100):
        box.put_poses([pose("ann", t, **({"path": [[0, 0, t]]} if t == 50 else {})), pose("bob", -t)])
        box.put_object({"id": 1, "position": [t, 0, 0]})
        box.put_robot({"robot": "tb", "x": t})
    assert box.take(0.0) == [
        {"type": "objects", "all": False, "objects": [{"id": 1, "position": [99, 0, 0]}], "removed": []},
        {"type": "robots", "robots": [{"robot": "tb", "x": 99}]},
        {"type": "poses", "n": 1, "poses": [pose("ann", 99, path=[[0, 0, 50]]), pose("bob", -99)]},
    ]
    assert box.take(1.0) == [] and box.wait_s(1.0) is None


def test_poses_come_sixty_times_a_second_at_most() -> None:
    box, sent = Outbox(), []
    for ms in range(1000):
        box.put_poses([pose("ann", ms)])
        if box.take(ms / 1000):
            sent.append(ms)
            box.mark_seen(len(sent))
    assert 57 <= len(sent) <= 61 and min(b - a for a, b in pairwise(sent)) >= 16
    box.put_poses([pose("ann", 0)])
    wait = box.wait_s(1.0)
    assert wait is not None and 0 < wait <= 1 / 60


def test_a_page_that_does_not_keep_up_has_few_poses_on_their_way() -> None:
    """They would wait in sockets and in the browser: it drew poses that were 15 s old."""
    box = Outbox()

    def play(first_s: int) -> list[dict[str, Any]]:
        sent = []
        for tick in range(60 * first_s, 60 * (first_s + 1)):
            box.put_poses([pose("ann", tick)])
            sent += box.take(tick / 59)
        return sent

    sent = play(0)
    assert [one["n"] for one in sent] == list(range(1, MAX_UNSEEN + 1))
    assert play(1) == [] and box.wait_s(2.0) is None
    box.mark_seen(4)
    assert box.wait_s(2.0) is not None
    more = play(2)
    assert [one["n"] for one in more] == [*range(MAX_UNSEEN + 1, MAX_UNSEEN + 5)]
    assert more[0]["poses"] == [pose("ann", 120)]  # the newest
    box.mark_seen(10**9)  # of a page that claims too much
    assert len(play(3)) == MAX_UNSEEN


def test_of_an_object_the_last_word_counts() -> None:
    box = Outbox()
    box.put_object({"id": 1})
    box.remove_object(1, "removed by 'ann'")
    box.remove_object(2, "gone")
    box.put_object({"id": 2})
    (message,) = box.take(0.0)
    assert message["objects"] == [{"id": 2}]
    assert message["removed"] == [{"id": 1, "reason": "removed by 'ann'"}]
    box.put_object({"id": 3})
    box.put_all_objects([])
    (message,) = box.take(0.0)
    assert message == {"type": "objects", "all": True, "objects": [], "removed": []}


def test_answers_are_kept_in_order_and_too_many_are_told() -> None:
    box = Outbox()
    for k in range(MAX_REPLIES):
        box.reply({"type": "receipt", "request": k})
    assert not box.is_overfull
    box.reply({"type": "receipt", "request": -1})
    assert box.is_overfull
    assert [one["request"] for one in box.take(0.0)] == list(range(MAX_REPLIES))
