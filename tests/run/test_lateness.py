"""Poses that come late are counted and said."""

from __future__ import annotations

from share.runtime.arrivals import LatenessMonitor


def test_poses_in_time_are_not_spoken_of() -> None:
    said: list[str] = []
    lateness = LatenessMonitor(said.append, "this machine")
    for _ in range(100):
        lateness.record(45.0)
    assert (said, lateness.report()) == ([], {"late_frames": 0, "max_late_s": 0.045})


def test_late_ones_are_counted_and_said_once_and_where_it_doubles() -> None:
    said: list[str] = []
    lateness = LatenessMonitor(said.append, "this machine")
    for k in range(100):
        lateness.record(100.0 * k)  # to 9.9 s
    assert [line.split(":")[0] for line in said] == [f"poses are {s:.1f} s late" for s in (1, 2, 4, 8)]
    assert "this machine is too slow for this source; set agent.late_ms" in said[0]
    assert lateness.report() == {"late_frames": 94, "max_late_s": 9.9}
