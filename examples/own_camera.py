"""Track your own camera: give its images and IMU samples to SHARE as they come.

Replace `samples` by what your driver delivers; here it is drawn from a recording, so that this runs anywhere.

python examples/own_camera.py room1/ann calib/mine
"""

import sys
from collections.abc import Iterator

from share import ShareError, Tracker, load_calibration, open_recording


def samples() -> Iterator[tuple]:
    """Yield samples as a driver does: "imu", stamp in ns, gyro, accel; "images", stamp, left, right."""
    for frame in open_recording(sys.argv[1]):
        for stamp_ns, gyro, accel in zip(frame.imu.stamps_ns, frame.imu.gyro, frame.imu.accel, strict=True):
            yield "imu", stamp_ns, gyro, accel
        yield "images", frame.stamp_ns, frame.image0, frame.image1


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    rig = load_calibration(sys.argv[2]) if len(sys.argv) > 2 else open_recording(sys.argv[1]).rig
    tracker = Tracker(rig)
    for kind, *sample in samples():
        feed = tracker.feed_imu if kind == "imu" else tracker.feed_images
        for pose in feed(*sample):  # a frame's pose is known once the IMU has reached it
            x, y, z, w = pose.quaternion
            print(f"{pose.stamp_ns}  {pose.position.round(3)} m  {x:.3f} {y:.3f} {z:.3f} {w:.3f}")
        tracker.make_keyframe()  # after the pose is used: the next one does not wait for this


if __name__ == "__main__":
    try:
        main()
    except ShareError as error:
        sys.exit(f"own_camera: {error}")
