"""Records a drive of a robot, its agent's odometry and its wheels', for `share robot calibrate`."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from share.errors import DataError, WireError
from share.net.udp import StampedSocket
from share.robot import robot_events as ev
from share.robot.mounting import MountingDrive
from share.runtime.robot_bridge import RobotConnection, received_pose
from share.timing import PeriodicTimer, seconds_to_ns

_WAIT_S, _SHOW_S = 0.01, 0.5


class DriveRecorder:
    """Poses and wheel odometry, with times of the host. agent: source of the poses; None: the first."""

    def __init__(self, agent: str | None) -> None:
        self._agent = agent
        self._poses: list[tuple[int, np.ndarray]] = []
        self._wheels: list[tuple[int, int, float, float, float]] = []  # stamp, arrival, x, y, yaw

    def add(self, event: ev.RobotEvent, now_ns: int) -> None:
        """Add a pose or a sample of odometry that rises in time; others are ignored."""
        match event:
            case ev.AgentPoseReceived() if event.T_odom_body is not None and event.state.has_pose:
                self._agent = self._agent or event.agent
                time_ns = now_ns - (event.age_ns or 0)
                if event.agent == self._agent and (not self._poses or time_ns > self._poses[-1][0]):
                    self._poses.append((time_ns, event.T_odom_body))
            case ev.OdometryReceived() if event.problem is None:
                if not self._wheels or event.stamp_ns > self._wheels[-1][0]:
                    T = event.T_odom_base
                    self._wheels.append((event.stamp_ns, now_ns, T.x, T.y, T.yaw))

    @property
    def text(self) -> str:
        """The samples so far, for a person."""
        way_m = sum(
            np.hypot(b[2] - a[2], b[3] - a[3]) for a, b in zip(self._wheels, self._wheels[1:], strict=False)
        )
        return f"{len(self._poses)} poses, {len(self._wheels)} of odometry, {way_m:.1f} m; drive in eights"

    def drive(self) -> MountingDrive:
        """Return the drive. Raises DataError where poses or odometry are missing."""
        if len(self._poses) < 2:
            raise DataError("no poses came; is the agent running, with --poses to this address?")
        if len(self._wheels) < 2:
            raise DataError("no odometry came; is the robot on, in this domain and namespace?")
        # no sample arrives before it was made: the quickest one tells the robot's clock
        ahead_ns = max(stamp_ns - arrived_ns for stamp_ns, arrived_ns, *_ in self._wheels)
        return MountingDrive(
            np.array([time_ns for time_ns, _ in self._poses]),
            np.stack([T for _, T in self._poses]),
            np.array([one[0] - ahead_ns for one in self._wheels]),
            np.array([one[2:] for one in self._wheels]),
        )


def record_drive(
    poses: StampedSocket,
    robot: RobotConnection,
    agent: str | None,
    seconds: float,
    is_ended: Callable[[], bool],
    show: Callable[[str], None],
) -> MountingDrive:
    """Record until `is_ended`, at most for a time."""
    recorder, timer = DriveRecorder(agent), PeriodicTimer(_SHOW_S)
    end_ns = time.monotonic_ns() + seconds_to_ns(seconds)
    while not is_ended() and (now_ns := time.monotonic_ns()) < end_ns:
        datagram = poses.receive(_WAIT_S)
        now_ns = time.monotonic_ns()
        if datagram is not None:
            try:
                recorder.add(received_pose(datagram), now_ns)
            except WireError as error:
                show(f"what comes as a pose is none: {error}")
        for event in robot.poll(now_ns):
            recorder.add(event, now_ns)
        if timer.fire_if_due(now_ns):
            show(recorder.text)
    return recorder.drive()
