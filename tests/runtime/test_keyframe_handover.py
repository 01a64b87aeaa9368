"""Keyframes go to the mapper a few at a time, and names take turns."""

from __future__ import annotations

import numpy as np

from share.protocol.edge_events import AddKeyframe
from share.runtime.keyframe_handover import KeyframeHandover, KeyframesAdded
from share.types import Keyframe, View


def effect(key: str, id_: int) -> AddKeyframe:
    eye = np.eye(4)
    return AddKeyframe(key, Keyframe(id_, id_ - 1, id_, eye, eye_cov(), eye, np.zeros(3), 0.0, View.empty()))


def eye_cov() -> np.ndarray:
    return 1e-6 * np.eye(6)


def test_a_flood_of_one_name_delays_another_by_what_is_under_way_only() -> None:
    sent: list[AddKeyframe] = []
    handover = KeyframeHandover(sent.append)
    for k in range(700):
        handover.add(effect(f"eve-{k % 2:04x}", k))  # two runs of one name
    assert (under_way := len(sent)) < 50
    handover.add(effect("ann-0001", 0))
    handover.record_added(KeyframesAdded(2))
    assert [one.key for one in sent[under_way:]].count("ann-0001") == 1
    assert len(sent) == under_way + 2


def test_all_arrive_each_once_and_those_of_a_name_in_order() -> None:
    sent: list[AddKeyframe] = []
    handover = KeyframeHandover(sent.append)
    for k in range(200):
        handover.add(effect("eve-0001", k))
        handover.add(effect("ann-0001", k))
    seen = 0
    while len(sent) < 300:
        seen, added = len(sent), len(sent) - seen
        handover.record_added(KeyframesAdded(added))
    handover.flush()
    for key in ("eve-0001", "ann-0001"):
        assert [one.keyframe.id for one in sent if one.key == key] == list(range(200))


def test_one_at_a_time_waits_for_nothing() -> None:
    sent: list[AddKeyframe] = []
    handover = KeyframeHandover(sent.append)
    for k in range(100):
        handover.add(effect("ann-0001", k))
        assert len(sent) == k + 1
        handover.record_added(KeyframesAdded(1))
