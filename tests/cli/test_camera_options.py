"""The lines that summarise a live camera after a run."""

from __future__ import annotations

from share.cameras.feed import feed_report
from share.cli.camera_options import camera_events, camera_summary
from share.sensors.sample_processor import SampleProcessor
from share.sensors.watchdog import Watchdog

RATES = {"cam0": 30.0, "cam1": 30.0, "accel": 250.0, "gyro": 400.0}


def test_uneventful_camera_has_no_events() -> None:
    report = feed_report(SampleProcessor(RATES), {}, Watchdog(0, RATES))
    assert camera_events(report) == ""
    assert camera_summary({"camera": report}) == [
        "camera: missing 0, dropped 0, backward 0 (docs/do/record.md)"
    ]


def test_health_at_the_end_is_reported() -> None:
    dog = Watchdog(0, RATES)
    for now_ms in range(0, 20_000, 100):
        for stream in ("cam0", "accel", "gyro"):
            dog.record_sample(stream, now_ms * 10**6)
        dog.tick(now_ms * 10**6)
        if now_ms == 10_000:
            dog.record_connect(now_ms * 10**6)
    assert camera_events(feed_report(SampleProcessor(RATES), {}, dog)) == "resets 1, DEGRADED at the end"
