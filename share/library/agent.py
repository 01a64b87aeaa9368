"""An agent in threads of this process, as `share agent` runs it in a process of its own; with a recording, or
with the program's own camera, whose samples are pushed and whose newest images are tracked."""

from __future__ import annotations

import contextlib
import logging
import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike, NDArray

from share.cameras.feed import CameraFeed
from share.cameras.live import MAX_WAITING_FRAMES, LiveSource
from share.cameras.sample_queue import NewestImageQueue
from share.config import Config
from share.errors import UsageError
from share.geometry.camera import Rig
from share.library.background import BackgroundRun
from share.library.checked_input import (
    checked_call,
    checked_config,
    checked_kind,
    checked_path,
    checked_rate_hz,
    image_samples,
    imu_sample,
)
from share.library.recording import RecordedFrames, open_recording
from share.net.keys import agent_keys
from share.net.transport import check_keys, connect, parse_address
from share.recordings.session import AGENT_NAME_RULE, is_agent_name
from share.runtime.agent import AgentRun
from share.runtime.error_estimators import model_estimator
from share.runtime.pipeline import check_trackable
from share.runtime.pose import Pose
from share.runtime.pose_feed import open_pose_sinks
from share.sensors.measurement import CAM0
from share.sensors.sample_processor import ACCEL, GYRO, DeviceSample
from share.types import AgentKind, TrackState
from share.wire.messages import Hello

logger = logging.getLogger("share")

MAX_WAITING_POSES = 1000  # for a program that reads them; beyond, the oldest are left out


class AgentThread(BackgroundRun):
    """One run of one agent. Use it as a context manager, or call `start` and `stop`.

    With a recording it plays at the recorded pace; with a rig it tracks the images and samples that
    `feed_images` and `feed_imu` give it. pose, state: of the newest frame.
    """

    def __init__(
        self,
        source: str | Path | RecordedFrames | Rig,
        name: str,
        edge: str,
        kind: str = "ar",
        *,
        rate_hz: float = 30.0,
        config: Config | None = None,
        keys: str | Path | None = None,
        server_key: str | None = None,
        poses: str | None = None,
        out: str | Path | None = None,
        notify: Callable[[str], None] = logger.info,
    ) -> None:
        """source: a recording, by its path or open; or the rig of your own camera, with the rate of its
        images, Hz. edge: its address, tcp://HOST:PORT. kind: ar or robot. keys, server_key, poses, out: as
        of `share agent`. notify: called from the agent's threads with lines for a person. Raises ShareError.
        """
        if not is_agent_name(checked_kind("name", name, str, "text")):
            raise UsageError(f"name {name[:80]!r}: use {AGENT_NAME_RULE}")
        if kind not in list(AgentKind):
            raise UsageError(f"kind {kind!r:.40}: use ar (headset) or robot")
        if keys is not None and server_key is None:
            raise UsageError("keys needs server_key, the public key of the edge")
        checked_call("notify", notify)
        if poses is not None:
            checked_kind("poses", poses, str, "text")
        settings, run_id = checked_config(config), secrets.randbits(63)
        folder = None if keys is None else checked_path("keys", keys)
        edge_keys = (
            None
            if server_key is None
            else agent_keys(folder, checked_kind("server_key", server_key, str, "text"))
        )
        check_keys(parse_address(checked_kind("edge", edge, str, "text")), edge_keys)
        self._camera = OwnCamera(source, checked_rate_hz(rate_hz)) if isinstance(source, Rig) else None
        self.pose: Pose | None = None
        self.state = TrackState.INITIALISING
        self._waiting: queue.Queue[Pose | None] = queue.Queue(MAX_WAITING_POSES)
        self._error: BaseException | None = None
        self._source = self._open(source, notify)
        check_trackable(self._source.name, self._source.rig)
        self._hello = Hello(name, AgentKind(kind), run_id, self._source.rig)
        self._settings, self._notify, self._poses = settings, notify, [] if poses is None else [poses]
        self._out = None if out is None else checked_path("out", out)
        self._connect = partial(connect, edge, run_id, edge_keys)
        self._run: AgentRun | None = None  # once started
        self._thread = threading.Thread(target=self._run_to_end, name=f"agent {name}", daemon=True)

    def _open(self, source: str | Path | RecordedFrames | Rig, notify: Callable[[str], None]) -> Any:
        if self._camera is not None:
            return OwnCameraSource(self._camera, notify)
        assert not isinstance(source, Rig)
        return (source if isinstance(source, RecordedFrames) else open_recording(source)).source

    def feed_imu(self, stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> None:
        """Add an IMU sample of your own camera, as `Tracker.feed_imu`; never waits. Raises ShareError."""
        self._own_camera().feed_imu(stamp_ns, gyro, accel)

    def feed_images(
        self,
        stamp_ns: int,
        image0: NDArray[Any],
        image1: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
    ) -> None:
        """Add images of your own camera, as `Tracker.feed_images`; never waits: where tracking is slower than
        the camera, the newest are tracked. Raises ShareError."""
        self._own_camera().feed_images(stamp_ns, image0, image1, depth)

    def _own_camera(self) -> OwnCamera:
        if self._camera is None:
            raise UsageError("this agent plays a recording; give the rig of a camera in place of it")
        return self._camera

    def start(self) -> None:
        """Begin, once. Returns at once. Raises ShareError if `out` or `poses` cannot be used."""
        if self._run is not None:
            raise UsageError("this agent was started before; make another for another run")
        settings, notify = self._settings, self._notify
        with contextlib.ExitStack() as stack:
            sinks = open_pose_sinks(self._poses, self._hello.name)
            for sink in sinks:
                stack.callback(sink.close)
            estimator = model_estimator(settings.agent.error_model, notify)
            if estimator is not None:
                stack.callback(estimator.close)
            self._run = AgentRun(
                self._source,
                self._hello,
                settings,
                self._connect,
                self._out,
                notify,
                error_estimator=estimator,
                pose_sinks=[_AgentPoses(self), *sinks],
            )
            stack.pop_all()
        self._thread.start()

    def stop(self) -> dict[str, Any]:
        """End: wait a moment for the edge's acknowledgements, and return the report (report.json). Raises
        the ShareError that ended the run early, if one did."""
        if self._run is not None:
            self._run.stop()
        return self.wait()

    def wait(self) -> dict[str, Any]:
        """Wait for the end of the recording, and return the report; it is empty if nothing was started.
        Raises as `stop`."""
        if self._run is None:
            return {}
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._run.report

    def poses(self) -> Iterator[Pose]:
        """Yield each pose as it comes, until the run ends. Of a reader that is slow, the oldest poses that
        wait beyond MAX_WAITING_POSES are left out. Raises the ShareError that ended the run early, if one
        did."""
        while (pose := self._waiting.get()) is not None:
            yield pose
        self._waiting.put(None)  # for the next that asks
        if self._error is not None:
            raise self._error

    def _run_to_end(self) -> None:
        assert self._run is not None
        try:
            self._run.run()
        except BaseException as error:
            self._error = error
        finally:
            self._offer(None)

    def _offer(self, pose: Pose | None) -> None:
        """Add to what waits for a reader; never waits."""
        while True:
            try:
                self._waiting.put_nowait(pose)
                return
            except queue.Full:
                with contextlib.suppress(queue.Empty):
                    self._waiting.get_nowait()


class _AgentPoses:
    """Hands an agent's poses to its owner."""

    def __init__(self, owner: AgentThread) -> None:
        self._owner = owner

    def publish(self, pose: Pose) -> None:
        self._owner.pose, self._owner.state = pose, pose.state
        self._owner._offer(pose)

    def publish_state(self, stamp_ns: int, state: TrackState, age_ms: float | None = None) -> None:
        self._owner.state = state

    def close(self) -> None:
        """Nothing to close: the run closes its own files and links."""


class OwnCamera:
    """A `share.cameras.feed.CameraDevice` whose samples a program pushes, from any one thread."""

    def __init__(self, rig: Rig, rate_hz: float) -> None:
        """rate_hz: of cam0's images."""
        self.rig, self.serial = rig, "own camera"
        rates = dict.fromkeys(rig.cameras, rate_hz)
        self.rates_hz: Mapping[str, float] = (
            rates if rig.imu is None else rates | dict.fromkeys((ACCEL, GYRO), rig.imu.rate_hz)
        )
        self._sink: Callable[[DeviceSample], None] | None = None

    def start(self, sink: Callable[[DeviceSample], None]) -> None:
        self._sink = sink

    def stop(self) -> None:
        self._sink = None

    def reset(self) -> None:
        """The program that pushes samples has nothing to reset."""

    def feed_imu(self, stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> None:
        """As `Tracker.feed_imu`. Raises UsageError."""
        sample = imu_sample(self.rig, stamp_ns, gyro, accel)
        for stream, values in ((ACCEL, sample.payload[3:]), (GYRO, sample.payload[:3])):
            self._push(stream, sample.stamp_ns, values)

    def feed_images(
        self,
        stamp_ns: int,
        image0: NDArray[Any],
        image1: NDArray[Any] | None = None,
        depth: NDArray[Any] | None = None,
    ) -> None:
        """As `Tracker.feed_images`. Raises UsageError."""
        for sample in image_samples(self.rig, stamp_ns, image0, image1, depth):
            self._push(sample.stream, sample.stamp_ns, sample.payload)

    def _push(self, stream: str, stamp_ns: int, payload: Any) -> None:
        if (sink := self._sink) is not None:  # None before the start and after the end
            sink(DeviceSample(stream, stamp_ns, payload, time.monotonic_ns()))


class OwnCameraSource(LiveSource):
    """An `OwnCamera` as a SOURCE."""

    def __init__(self, camera: OwnCamera, notify: Callable[[str], None]) -> None:
        queue = NewestImageQueue(MAX_WAITING_FRAMES * len(camera.rig.cameras))
        feed = CameraFeed(lambda serial, attempts: camera, None, camera.rates_hz, notify, queue)
        super().__init__(feed, camera.rates_hz[CAM0])
        self.name, self.serial = camera.serial, None
