"""What is told of a live camera when all is over."""

from __future__ import annotations

from share.cameras.feed import feed_report
from share.cli.live import met, summary
from share.sensors.intake import Intake
from share.sensors.watchdog import Watchdog

RATES = {"cam0": 30.0, "cam1": 30.0, "accel": 250.0, "gyro": 400.0}


def test_a_camera_to_which_nothing_happened_is_not_spoken_of() -> None:
    report = feed_report(Intake(RATES, 10.0), {}, Watchdog(0, RATES))
    assert met(report) == ""
    assert summary({"camera": report}) == ["camera: missing 0, dropped 0, backward 0 (docs/capture.md)"]


def test_what_was_done_without_at_the_end_is_told() -> None:
    dog = Watchdog(0, RATES)
    for now_ms in range(0, 20_000, 100):
        for stream in ("cam0", "accel", "gyro"):
            dog.heard(stream, now_ms * 10**6)
        dog.tick(now_ms * 10**6)
        if now_ms == 10_000:
            dog.connected(now_ms * 10**6)
    assert met(feed_report(Intake(RATES, 10.0), {}, dog)) == "resets 1, DEGRADED at the end"
