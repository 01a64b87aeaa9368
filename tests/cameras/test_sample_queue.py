"""Full queues keep complete pairs of images, and count what they drop."""

from __future__ import annotations

from share.cameras.sample_queue import NewestImageQueue, SampleQueue
from share.sensors.sample_processor import DeviceSample


def filled(queue: SampleQueue, pairs: int) -> list[tuple[str, int]]:
    """Return what is left of so many pairs of images, each after a sample of the gyroscope."""
    for stamp in range(pairs):
        for stream in ("gyro", "cam0", "cam1"):
            queue.put(DeviceSample(stream, stamp, None, 0))
    queue.close()
    taken = []
    while (sample := queue.get(0)) is not None:
        taken.append((sample.stream, sample.stamp_ns))
    return taken


def images(taken: list[tuple[str, int]]) -> list[tuple[str, int]]:
    return [one for one in taken if one[0] != "gyro"]


def test_a_full_queue_keeps_the_oldest_pairs_complete() -> None:
    queue = SampleQueue(max_images=3)
    assert images(filled(queue, 5)) == [("cam0", 0), ("cam1", 0), ("cam0", 1), ("cam1", 1)]
    assert queue.dropped == {"cam0": 3, "cam1": 3}


def test_a_full_newest_image_queue_keeps_the_newest_pairs_complete() -> None:
    queue = NewestImageQueue(max_images=4)
    assert images(filled(queue, 5)) == [("cam0", 3), ("cam1", 3), ("cam0", 4), ("cam1", 4)]
    assert queue.dropped == {"cam0": 3, "cam1": 3}


def test_imu_samples_stay_in_order_while_images_are_dropped() -> None:
    for queue in (SampleQueue(max_images=2), NewestImageQueue(max_images=2)):
        taken = filled(queue, 50)
        assert [stamp for stream, stamp in taken if stream == "gyro"] == list(range(50))
        assert "gyro" not in queue.dropped
        assert (queue.image_count, len(queue)) == (0, 0)


def test_imu_samples_are_bounded_too() -> None:
    queue = SampleQueue(max_imu_samples=3)
    for stamp in range(5):
        queue.put(DeviceSample("accel", stamp, None, 0))
    assert (len(queue), queue.dropped) == (3, {"accel": 2})
