"""Samples from a device's threads to the one that writes or tracks them: bounded, and nobody waits."""

from __future__ import annotations

import threading
from collections import deque

from share.sensors.intake import ACCEL, GYRO, Sample


class Handover:
    """Policy `drop_new_image`: an image that finds the queue full is left out, with its partner of the same
    stamp. Samples of the IMU are small, and left out only where `most_motion` of them wait. `dropped`
    counts by stream."""

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
                self._drop(sample)
                return
            self._samples.append(sample)
            self._images += _is_image(sample)
            self._changed.notify()

    def get(self, timeout_s: float) -> Sample | None:
        """The oldest sample; None after timeout_s, or when it is closed and empty."""
        with self._changed:
            if not self._samples and not self._closed:
                self._changed.wait(timeout_s)
            if not self._samples:
                return None
            sample = self._samples.popleft()
            self._images -= _is_image(sample)
            return sample

    def close(self) -> None:
        """Let nothing more in; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Nothing more is let in."""
        return self._closed

    @property
    def done(self) -> bool:
        """Closed, and all taken."""
        return self._closed and not self._samples

    def _room(self, sample: Sample) -> bool:
        """Whether it is let in."""
        if not _is_image(sample):
            return len(self._samples) - self._images < self._most_motion
        return self._room_for_image(sample.stamp_ns)

    def _room_for_image(self, stamp_ns: int) -> bool:
        if stamp_ns == self._refused_ns or (self._images >= self._most_images and stamp_ns != self._taken_ns):
            self._refused_ns = stamp_ns
            return False
        self._taken_ns = stamp_ns
        return True

    def _drop(self, sample: Sample) -> None:
        self.dropped[sample.stream] = self.dropped.get(sample.stream, 0) + 1


class KeepNewest(Handover):
    """Policy `drop_old_image`: an image that finds the queue full takes the place of the oldest, which goes
    with its partners of the same stamp. So a tracker that is slower than its camera tracks the newest."""

    def _room_for_image(self, stamp_ns: int) -> bool:
        while self._images >= self._most_images:
            oldest_ns = next(s.stamp_ns for s in self._samples if _is_image(s))
            if oldest_ns == stamp_ns:  # its own partner
                break
            self._drop_images(oldest_ns)
        return True

    def _drop_images(self, stamp_ns: int) -> None:
        kept: deque[Sample] = deque()
        for sample in self._samples:
            if _is_image(sample) and sample.stamp_ns == stamp_ns:
                self._drop(sample)
                self._images -= 1
            else:
                kept.append(sample)
        self._samples = kept


def _is_image(sample: Sample) -> bool:
    return sample.stream not in (ACCEL, GYRO)
