"""Silence, told step by step: one reset, then vision only; a lost device is looked for."""

from __future__ import annotations

import pytest

from share.core.watchdog import Action, Health, Watchdog

MS = 10**6
IMU = ("accel", "gyro")
ALL = ("cam0", "cam1", *IMU)


def run(dog: Watchdog, begin_ms: int, end_ms: int, *streams: str) -> list[Action]:
    """What it asks for, every 100 ms, while these streams are heard."""
    asked = []
    for now in range(begin_ms, end_ms, 100):
        for stream in streams:
            dog.heard(stream, now * MS)
        asked.append(dog.tick(now * MS))
    return [action for action in asked if action is not Action.NOTHING]


def test_a_camera_that_delivers_is_left_alone() -> None:
    assert run(Watchdog(0, ALL), 0, 60_000, *ALL) == []


def test_nothing_is_asked_while_it_warms_up() -> None:
    assert run(Watchdog(0, ALL), 0, 4000) == []


def test_a_silent_imu_is_reset_once_and_then_done_without() -> None:
    dog = Watchdog(0, ALL)
    assert run(dog, 0, 5000, *ALL) == []
    assert run(dog, 5000, 6100, "cam0", "cam1") == [Action.RESET]
    assert dog.health is Health.AWAY
    dog.connected(8000 * MS)
    assert run(dog, 8000, 20_000, "cam0", "cam1") == [Action.VISION_ONLY]
    assert dog.health is Health.VISION_ONLY
    assert run(dog, 20_000, 22_000, *ALL) == [Action.HEARD_AGAIN]
    assert dog.health is Health.OK
    assert run(dog, 22_000, 24_000, "cam0", "cam1") == [Action.VISION_ONLY]
    assert dog.resets == 1


def test_a_lost_camera_is_looked_for_once_a_second_until_it_is_there() -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    assert run(dog, 5000, 10_000) == [Action.RECONNECT] * 4
    dog.connected(10_000 * MS)
    assert run(dog, 10_000, 20_000, *ALL) == []
    assert dog.resets == 0


def test_an_unplugged_camera_is_lost_and_not_reset_though_its_last_image_came_after_the_imu() -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    run(dog, 5000, 5300, "cam0", "cam1")  # what was still under way
    assert run(dog, 5300, 6400) == [Action.RECONNECT]
    assert (dog.health, dog.resets) == (Health.AWAY, 0)


def test_without_images_a_silent_imu_is_a_lost_camera_after_its_reset() -> None:
    dog = Watchdog(0, IMU)
    assert run(dog, 0, 5000) == [Action.RESET]
    dog.connected(5000 * MS)
    assert run(dog, 5000, 9500) == [Action.RECONNECT]


@pytest.mark.parametrize("left", IMU)
def test_half_an_imu_is_a_silent_one(left: str) -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    assert run(dog, 5000, 6100, "cam0", "cam1", left) == [Action.RESET]
    dog.connected(8000 * MS)
    assert run(dog, 8000, 20_000, "cam0", "cam1", left) == [Action.VISION_ONLY]
    assert run(dog, 20_000, 22_000, *ALL) == [Action.HEARD_AGAIN]


def test_half_an_imu_without_images_is_looked_for_after_its_reset() -> None:
    dog = Watchdog(0, IMU)
    assert run(dog, 0, 5000, "gyro") == [Action.RESET]
    dog.connected(5000 * MS)
    assert run(dog, 5000, 9500, "gyro") == [Action.RECONNECT]


@pytest.mark.parametrize("silent", ["cam0", "cam1", "depth"])
def test_a_stream_of_images_that_is_silent_is_looked_for(silent: str) -> None:
    streams = (*ALL, "depth")
    dog = Watchdog(0, streams)
    run(dog, 0, 5000, *streams)
    others = [name for name in streams if name != silent]
    assert run(dog, 5000, 6100, *others) == [Action.RECONNECT]
    assert dog.resets == 0


def test_a_stream_that_nobody_expects_does_not_count() -> None:
    dog = Watchdog(0, ("cam0",))
    assert run(dog, 0, 60_000, "cam0") == []
    assert run(dog, 60_000, 61_500, "gyro", "depth") == [Action.RECONNECT]
