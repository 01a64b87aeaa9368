"""Samples from a device's threads to the one that writes or tracks: bounded, policy `drop_new_image`."""

from __future__ import annotations

import threading
from collections import deque

from share.core.intake import ACCEL, GYRO, Sample


class Handover:
    """An image that finds the queue full is left out, with its partner of the same stamp; samples of
    the IMU are small, and left out only where `most_motion` of them wait. `dropped` counts by stream."""

    def __init__(self, most_images: int = 60, most_motion: int = 20_000) -> None:
        self.dropped: dict[str, int] = {}
        self._most_images, self._most_motion = most_images, most_motion
        self._samples: deque[Sample] = deque()
        self._images = 0
        self._taken_ns = self._refused_ns = -1  # stamp of the last image that was let in, and was not
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def images(self) -> int:
        """How many images wait."""
        return self._images

    def put(self, sample: Sample) -> None:
        """Never waits."""
        with self._changed:
            if self._closed or not self._room(sample):
                self.dropped[sample.stream] = self.dropped.get(sample.stream, 0) + 1
                return
            self._samples.append(sample)
            self._changed.notify()

    def get(self, timeout_s: float) -> Sample | None:
        """The oldest sample; None after timeout_s, or when it is closed and empty."""
        with self._changed:
            if not self._samples and not self._closed:
                self._changed.wait(timeout_s)
            if not self._samples:
                return None
            sample = self._samples.popleft()
            self._images -= sample.stream not in (ACCEL, GYRO)
            return sample

    def close(self) -> None:
        """Let nothing more in; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def done(self) -> bool:
        """Closed, and all taken."""
        return self._closed and not self._samples

    def _room(self, sample: Sample) -> bool:
        if sample.stream in (ACCEL, GYRO):
            return len(self._samples) - self._images < self._most_motion
        stamp = sample.stamp_ns
        if stamp == self._refused_ns or (self._images >= self._most_images and stamp != self._taken_ns):
            self._refused_ns = stamp
            return False
        self._taken_ns = stamp
        self._images += 1
        return True
