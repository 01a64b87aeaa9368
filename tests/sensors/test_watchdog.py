"""The watchdog: one reset, then without the silent stream; a lost device is reconnected."""

from __future__ import annotations

import pytest

from share.sensors.watchdog import Action, Health, Watchdog

MS = 10**6
IMU = ("accel", "gyro")
ALL = ("cam0", "cam1", *IMU)


def run(dog: Watchdog, begin_ms: int, end_ms: int, *streams: str) -> list[Action]:
    """Return its actions, every 100 ms, while these streams deliver."""
    asked = []
    for now in range(begin_ms, end_ms, 100):
        for stream in streams:
            dog.record_sample(stream, now * MS)
        asked.append(dog.tick(now * MS))
    return [action for action in asked if action is not Action.NOTHING]


def test_a_delivering_camera_needs_no_action() -> None:
    assert run(Watchdog(0, ALL), 0, 60_000, *ALL) == []


def test_no_action_during_warm_up() -> None:
    assert run(Watchdog(0, ALL), 0, 4000) == []


def test_a_silent_imu_causes_one_reset_and_is_then_excluded() -> None:
    dog = Watchdog(0, ALL)
    assert run(dog, 0, 5000, *ALL) == []
    assert run(dog, 5000, 7100, "cam0", "cam1") == [Action.RESET]
    assert (dog.health, dog.silent) == (Health.AWAY, IMU)
    dog.record_connect(8000 * MS)
    assert run(dog, 8000, 20_000, "cam0", "cam1") == [Action.GO_WITHOUT]
    assert (dog.health, dog.silent) == (Health.VISION_ONLY, IMU)
    assert run(dog, 20_000, 22_000, *ALL) == [Action.RECOVERED]
    assert (dog.health, dog.silent) == (Health.OK, IMU)
    assert run(dog, 22_000, 25_000, "cam0", "cam1") == [Action.GO_WITHOUT]
    assert dog.resets == 1


def test_a_reset_camera_gets_time() -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    assert run(dog, 5000, 7100, "cam0", "cam1")[-1] is Action.RESET
    assert run(dog, 7100, 9900) == []
    assert run(dog, 9900, 11_000) == [Action.RECONNECT]


def test_a_lost_camera_is_reconnected_every_second() -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    assert run(dog, 5000, 10_000) == [Action.RECONNECT] * 4
    dog.record_connect(10_000 * MS)
    assert run(dog, 10_000, 20_000, *ALL) == []
    assert dog.resets == 0


@pytest.mark.parametrize("later_ms", [300, 900, 1400])
def test_an_unplugged_camera_is_not_reset(
    later_ms: int,
) -> None:
    dog, end_ms = Watchdog(0, ALL), 5000 + later_ms
    run(dog, 0, 5000, *ALL)
    assert run(dog, 5000, end_ms, "cam0", "cam1") == []  # what was still under way
    assert run(dog, end_ms, end_ms + 1100) == [Action.RECONNECT]
    assert (dog.health, dog.resets) == (Health.AWAY, 0)


def test_one_late_tick_is_ignored_but_not_every_one() -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    assert dog.tick(30_000 * MS) is Action.NOTHING  # the computer was asleep
    assert run(dog, 30_100, 31_000, *ALL) == []
    late = [dog.tick(now * MS) for now in range(33_000, 37_000, 2000)]
    assert late == [Action.NOTHING, Action.RECONNECT]


def test_a_silent_imu_alone_is_a_lost_camera() -> None:
    dog = Watchdog(0, IMU)
    run(dog, 0, 5000, *IMU)
    assert run(dog, 5000, 6200) == [Action.RECONNECT]


@pytest.mark.parametrize("left", IMU)
def test_half_an_imu_counts_as_silent(left: str) -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 5000, *ALL)
    assert run(dog, 5000, 7100, "cam0", "cam1", left) == [Action.RESET]
    dog.record_connect(8000 * MS)
    assert run(dog, 8000, 20_000, "cam0", "cam1", left) == [Action.GO_WITHOUT]
    assert (dog.health, dog.silent) == (Health.VISION_ONLY, tuple(name for name in IMU if name != left))
    assert run(dog, 20_000, 22_000, *ALL) == [Action.RECOVERED]


def test_half_an_imu_without_images_is_reconnected_after_its_reset() -> None:
    dog = Watchdog(0, IMU)
    run(dog, 0, 5000, *IMU)
    assert run(dog, 5000, 7100, "gyro") == [Action.RESET]
    dog.record_connect(9000 * MS)
    assert run(dog, 9000, 14_200, "gyro") == [Action.RECONNECT]


@pytest.mark.parametrize(
    ("streams", "silent"),
    [(ALL, ("cam0",)), (ALL, ("cam0", "cam1")), (ALL, ("cam1", "gyro")), (("cam0", "cam1"), ("cam1",))],
)
def test_a_needed_stream_causes_one_reset_and_then_reconnections(
    streams: tuple[str, ...], silent: tuple[str, ...]
) -> None:
    others = [name for name in streams if name not in silent]
    dog = Watchdog(0, streams)
    run(dog, 0, 5000, *streams)
    assert run(dog, 5000, 7100, *others) == [Action.RESET]
    for began in range(10_000, 80_000, 10_000):
        dog.record_connect(began * MS)
        assert run(dog, began, began + 5200, *others) == [Action.RECONNECT]
    assert (dog.resets, dog.silent) == (1, silent)


@pytest.mark.parametrize("silent", ["cam1", "depth"])
def test_a_redundant_stream_causes_one_reset_and_is_then_excluded(silent: str) -> None:
    streams = (*ALL, "depth")
    others = [name for name in streams if name != silent]
    dog = Watchdog(0, streams)
    assert run(dog, 0, 5200, *others) == [Action.RESET]
    dog.record_connect(9000 * MS)
    assert run(dog, 9000, 30_000, *others) == [Action.GO_WITHOUT]
    assert (dog.health, dog.silent) == (Health.DEGRADED, (silent,))
    assert run(dog, 30_000, 33_000, "cam0", "cam1", "depth") == [Action.RECOVERED, Action.GO_WITHOUT]
    assert (dog.health, dog.silent) == (Health.VISION_ONLY, IMU)


@pytest.mark.parametrize(
    ("streams", "comes"),
    [(ALL, ()), (ALL, IMU), (ALL, ("cam0",)), (("cam0", "cam1"), ("cam0",)), (IMU, IMU[:1])],
)
def test_a_needed_stream_that_never_came_is_given_up_after_a_reset(
    streams: tuple[str, ...], comes: tuple[str, ...]
) -> None:
    dog, asked = Watchdog(0, streams), []
    for began in range(0, 40_000, 10_000):
        dog.record_connect(began * MS)
        asked += run(dog, began, began + (5200 if comes else 4200), *comes)
        if Action.GIVE_UP in asked:
            break
    assert asked == [Action.RESET, Action.RECONNECT, Action.GIVE_UP]
    assert dog.silent == tuple(name for name in streams if name not in comes)


def test_a_camera_that_is_away_is_not_given_up() -> None:
    dog = Watchdog(0, ALL)
    run(dog, 0, 4000, *IMU)  # then it was pulled out, before anybody missed its eyes
    for began in range(5_000, 60_000, 10_000):
        assert Action.GIVE_UP not in run(dog, began, began + 9000)
        dog.record_connect((began + 9000) * MS)


def test_an_unexpected_stream_does_not_count() -> None:
    dog = Watchdog(0, ("cam0",))
    assert run(dog, 0, 60_000, "cam0") == []
    assert run(dog, 60_000, 61_500, "gyro", "depth") == [Action.RECONNECT]
