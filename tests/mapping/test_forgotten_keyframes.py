"""Keyframes that came too long ago leave the map, its file and the mapper's memory; the rest goes on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_restored_map import STEPS, Session, after_a_walk

from share.config import Config
from share.geometry import se3
from share.mapping.forgetting import DAY_S, Retention
from share.mapping.map_changes import RemoveKeyframes, StoredMap, Wipe
from share.store import map_store
from share.store.map_store import MapStore

NOW_S = 1_800_000_000.0
KEPT_A_DAY = replace(Config(), edge=replace(Config().edge, keep_days=1.0))


def test_a_keyframe_expires_after_the_days_that_are_set() -> None:
    retention = Retention(2.0)
    retention.add(1, NOW_S)
    retention.add(2)  # comes with the next look
    assert retention.expired(NOW_S + DAY_S) == []
    assert retention.expired(NOW_S + 2 * DAY_S) == [1]
    retention.remove(1)
    assert retention.expired(NOW_S + 3 * DAY_S - 1) == []
    assert retention.expired(NOW_S + 3 * DAY_S) == [2]


def test_by_default_nothing_expires() -> None:
    assert Config().edge.keep_days is None
    retention = Retention(None)
    retention.add(1, 0.0)
    assert retention.expired(NOW_S) == []


@pytest.mark.parametrize("days", [0.0, -1.0, float("nan")])
def test_days_must_be_positive(days: float) -> None:
    with pytest.raises(ValueError, match="keep_days"):
        replace(Config().edge, keep_days=days)


def stored(session: Session, path: Path) -> StoredMap:
    """The file that the session's changes make."""
    with MapStore.open(path) as store:
        store.write([*session.changes, session.mapper.current_poses()])
    kept = MapStore.read(path).load()
    assert kept.problems == ()
    return kept


@pytest.mark.long
def test_old_keyframes_leave_a_running_mapper_and_its_file(tmp_path: Path) -> None:
    session, people = after_a_walk(KEPT_A_DAY)
    mapper = session.mapper
    assert mapper.expire(NOW_S) == []
    held = {key: mapper.atlas.T_map_odom(key) for key in ("ann", "bob")}
    for _ in range(12):
        for person in people:
            session.step(person)
    assert mapper.expire(NOW_S + DAY_S / 2) == []
    (event,) = mapper.expire(NOW_S + DAY_S)
    assert (event.agent, event.event) == (None, "expired")
    assert event.reason == f"{2 * STEPS} keyframes forgotten, 24 stay: older than 1 days"
    assert mapper.expire(NOW_S + DAY_S + 1) == []
    session.work()
    assert {key.id for key in mapper.current_poses().keys} == set(range(STEPS, STEPS + 12))
    assert any(isinstance(c, Wipe) for c in session.changes)
    kept = stored(session, tmp_path / "room.sqlite")
    assert {k.keyframe_key for k in kept.keyframes} == set(mapper.current_poses().keys)
    assert mapper.report()["maps"] == {"ann/0": 24}  # loops of old keyframes moved to those that stay
    for key, T in held.items():  # nobody is moved by it
        now = mapper.atlas.T_map_odom(key)
        assert T is not None and now is not None
        assert np.linalg.norm((se3.inverse(T) @ now)[:3, 3]) < 0.1
    accepted = mapper.report()["loops"]["accepted"]
    for _ in range(12):
        for person in people:
            session.step(person)
    assert mapper.report()["loops"]["accepted"] > accepted
    assert len(stored(session, tmp_path / "later.sqlite").keyframes) == 48


@pytest.mark.long
def test_a_restarted_mapper_forgets_what_expired_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, _ = after_a_walk(KEPT_A_DAY)
    monkeypatch.setattr(map_store.time, "time", lambda: NOW_S)
    kept = stored(session, tmp_path / "room.sqlite")
    for later_s, left in ((DAY_S / 2, 2 * STEPS), (DAY_S + 1, 0)):
        second = Session(KEPT_A_DAY)
        second.mapper.restore(kept)
        assert len(second.mapper.expire(NOW_S + later_s)) == (left == 0)
        assert len(second.mapper.current_poses().keys) == left
        second.work()
    emptied = second.mapper.take_empty_runs()
    assert {key.agent for key in emptied} == {"ann", "bob"}  # so the edge forgets their names
    assert sum(len(c.keys) for c in second.changes if isinstance(c, RemoveKeyframes)) == 2 * STEPS


@pytest.mark.slow
@pytest.mark.long
def test_a_connected_agent_whose_keyframes_expired_goes_on(tmp_path: Path) -> None:
    """Its run stays until it leaves."""
    session, people = after_a_walk(KEPT_A_DAY)
    session.mapper.expire(NOW_S)
    session.mapper.expire(NOW_S + 2 * DAY_S)
    assert len(session.mapper.atlas) == 0
    session.work()
    for _ in range(STEPS):
        for person in people:
            session.step(person)
    assert len(session.mapper.atlas) == 2 * STEPS
    assert len(session.mapper.report()["maps"]) == 1
    session.mapper.expire(NOW_S + 3 * DAY_S)
    session.mapper.expire(NOW_S + 5 * DAY_S)
    assert session.mapper.take_empty_runs() == ()
    session.mapper.set_present("ann", False)
    assert [key.agent for key in session.mapper.take_empty_runs()] == ["ann"]
