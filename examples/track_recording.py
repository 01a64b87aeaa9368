"""Track a recording: prints the time, position and speed of the body for each frame.

python examples/track_recording.py room1/ann
"""

import sys

import numpy as np

from share import Tracker, open_recording

if len(sys.argv) != 2:
    sys.exit(__doc__)
recording = open_recording(sys.argv[1])
tracker = Tracker(recording.rig, rate_hz=recording.rate_hz)
for frame in recording:
    pose = tracker.track(frame)
    if pose is None:
        print(f"{frame.stamp_ns}  {tracker.state}")
    else:
        x, y, z = pose.position
        speed = np.nan if pose.velocity is None else np.linalg.norm(pose.velocity)
        print(f"{frame.stamp_ns}  {x:7.3f} {y:7.3f} {z:7.3f} m  {speed:.2f} m/s")
