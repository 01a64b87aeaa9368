"""Bounded queues of samples, from a device's threads to the thread that writes or tracks them."""

from __future__ import annotations

import threading
from collections import deque

from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample


class SampleQueue:
    """Policy `drop_new_image`: while the queue is full, new images are dropped, with all images of the same
    stamp. IMU samples are dropped only while `max_imu_samples` of them wait.

    dropped: count by stream. image_count: images that wait. is_closed: no more samples are accepted.
    """

    def __init__(self, max_images: int = 60, max_imu_samples: int = 20_000) -> None:
        self.dropped: dict[str, int] = {}
        self._max_images, self._max_imu_samples = max_images, max_imu_samples
        self._samples: deque[DeviceSample] = deque()
        self.image_count = 0
        self._accepted_ns = self._refused_ns = -1  # stamps of the last accepted and refused image
        self._changed = threading.Condition()
        self.is_closed = False

    def __len__(self) -> int:
        return len(self._samples)

    def put(self, sample: DeviceSample) -> None:
        """Add a sample or drop it; never waits."""
        with self._changed:
            if self.is_closed or not self._has_room(sample):
                self._drop(sample)
                return
            self._samples.append(sample)
            self.image_count += _is_image(sample)
            self._changed.notify()

    def get(self, timeout_s: float) -> DeviceSample | None:
        """Return the oldest sample; None after timeout_s, or if closed and empty."""
        with self._changed:
            if not self._samples and not self.is_closed:
                self._changed.wait(timeout_s)
            if not self._samples:
                return None
            sample = self._samples.popleft()
            self.image_count -= _is_image(sample)
            return sample

    def close(self) -> None:
        """Accept no more samples; waiting ones can still be taken."""
        with self._changed:
            self.is_closed = True
            self._changed.notify_all()

    @property
    def is_drained(self) -> bool:
        """Whether the queue is closed and empty."""
        return self.is_closed and not self._samples

    def _has_room(self, sample: DeviceSample) -> bool:
        if not _is_image(sample):
            return len(self._samples) - self.image_count < self._max_imu_samples
        return self._has_room_for_image(sample.stamp_ns)

    def _has_room_for_image(self, stamp_ns: int) -> bool:
        """Return whether an image is accepted; may drop others to make room."""
        is_full = self.image_count >= self._max_images and stamp_ns != self._accepted_ns
        if stamp_ns == self._refused_ns or is_full:
            self._refused_ns = stamp_ns
            return False
        self._accepted_ns = stamp_ns
        return True

    def _drop(self, sample: DeviceSample) -> None:
        self.dropped[sample.stream] = self.dropped.get(sample.stream, 0) + 1


class NewestImageQueue(SampleQueue):
    """Policy `drop_old_image`: while the queue is full, a new image replaces the oldest, with all images of
    that stamp. So a tracker that is slower than its camera tracks the newest images."""

    def _has_room_for_image(self, stamp_ns: int) -> bool:
        while self.image_count >= self._max_images:
            oldest_ns = next(s.stamp_ns for s in self._samples if _is_image(s))
            if oldest_ns == stamp_ns:  # of the same frame
                break
            self._drop_images(oldest_ns)
        return True

    def _drop_images(self, stamp_ns: int) -> None:
        samples, self._samples = self._samples, deque()
        for sample in samples:
            if _is_image(sample) and sample.stamp_ns == stamp_ns:
                self._drop(sample)
                self.image_count -= 1
            else:
                self._samples.append(sample)


def _is_image(sample: DeviceSample) -> bool:
    return sample.stream not in (ACCEL, GYRO)
