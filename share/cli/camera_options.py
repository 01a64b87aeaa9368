"""A live camera in place of a recording: its options, and how it is opened."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from share.cli.terminal import LiveLine
from share.errors import UsageError
from share.timing import PeriodicTimer

if TYPE_CHECKING:
    from share.cameras.feed import CameraFeed
    from share.cameras.realsense.streams import StreamRequest
    from share.config import Config
    from share.odometry.track_result import TrackResult
    from share.runtime.source import Source

PROFILE = "d435i"

profile = click.option(
    "--profile",
    "profile_name",
    metavar="P",
    help=f"Kind of camera: a profile's name or file.  [default: {PROFILE}]",
)
mode = click.option("--mode", metavar="WxH[@HZ]", help="Image size and rate; default: the profile's.")
sensors = click.option(
    "--sensors",
    type=click.Choice(["stereo", "rgbd"]),
    help="Of a camera: infrared pair, or left image and depth.  [default: stereo]",
)


@dataclass(frozen=True)
class CameraOptions:
    """What was asked of a live camera; None: nothing."""

    profile_name: str | None
    mode: str | None
    sensors: str | None

    def camera_request(self) -> StreamRequest:
        """Raises ConfigError for an unknown profile or mode."""
        from share.cameras.realsense.streams import StreamRequest
        from share.sensors.profile import load_profile

        rgbd = self.sensors == "rgbd"
        return StreamRequest(
            load_profile(self.profile_name or PROFILE, self.mode), depth=rgbd, right=not rgbd
        )

    def check_unused(self, source: str) -> None:
        """Raises UsageError where a recording was asked for what only a camera has."""
        named = {"--profile": self.profile_name, "--mode": self.mode, "--sensors": self.sensors}
        options_given = ", ".join(option for option, value in named.items() if value is not None)
        if options_given:
            raise UsageError(
                f"{source}: {options_given} goes with a live camera (realsense) only; leave it out"
            )


def camera_options(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command the options of a live camera, as `camera: Asked`."""

    @functools.wraps(command)
    def with_camera(*args: Any, profile_name: str, mode: str, sensors: str, **options: Any) -> None:
        command(*args, camera=CameraOptions(profile_name, mode, sensors), **options)

    return profile(mode(sensors(with_camera)))


def open_source(
    source: str,
    calib: str | None,
    frames: slice | None,
    camera: CameraOptions,
    settings: Config,
    say: Callable[[str], None],
) -> Source:
    """A recording or a live camera, which is let go when the command ends. `say` is told what happens to it.

    Raises UsageError, ConfigError, DataError, ShareError.
    """
    from share.cameras.realsense.devices import is_camera
    from share.runtime.source import open_source

    if not is_camera(source):
        camera.check_unused(source)
        return open_source(source, calib, frames)
    if frames is not None:
        raise UsageError("--frames: goes with a recording, not with a live camera")
    from share.cameras.realsense.source import open_live
    from share.runtime.source import read_given_calibration

    live = open_live(source, camera.camera_request(), settings.sequencer, say, read_given_calibration(calib))
    click.get_current_context().with_resource(closing(live))
    return live


class TrackLine:
    """The live line of `share track`, once a second."""

    def __init__(self, feed: CameraFeed, line: LiveLine) -> None:
        self._feed, self._line, self._frames = feed, line, 0
        self._once_a_second = PeriodicTimer(1.0)

    def __call__(self, result: TrackResult) -> None:
        self._frames += 1
        if self._once_a_second.fire_if_due(time.monotonic_ns()):
            waiting_text = "" if result.waiting_for is None else f", waits for {result.waiting_for.text}"
            camera = f"camera {self._feed.status()}"
            self._line.write(f"{self._frames} frames  tracking {result.state}{waiting_text}  {camera}")


def camera_status_text(feed: CameraFeed | None) -> str:
    """A live camera's part of the agent's line; nothing without one."""
    if feed is None:
        return ""
    status = feed.status()
    return f"camera {status.health.value} cam0 {status.rates_hz['cam0']:.0f} Hz dropped {status.dropped}  "


_CAMERA_EVENTS = (
    "imu_alone",
    "foreign",
    "wraps",
    "jumps",
    "strays",
    "past",
    "restarts",
    "reconnections",
    "resets",
)


def camera_events(report: dict[str, Any]) -> str:
    """What happened to the camera, without what never did; of its report."""
    events = [f"{name.replace('_', ' ')} {report[name]}" for name in _CAMERA_EVENTS if report[name]]
    return ", ".join([*events, *([] if report["health"] == "OK" else [f"{report['health']} at the end"])])


def camera_summary(report: dict[str, Any]) -> list[str]:
    """Of a run's report: lines on its camera, none if it had none."""
    if "camera" not in report:
        return []
    camera_report = report["camera"]
    streams = camera_report["streams"].values()
    counts = [f"{name} {sum(one[name] for one in streams)}" for name in ("missing", "dropped", "backward")]
    lines = [
        f"camera: {', '.join([*counts, *filter(None, [camera_events(camera_report)])])} (docs/do/record.md)"
    ]
    if (known := report.get("imu_bias", {}).get("from")) is not None:
        lines.append(f"imu bias: from the run of {known}")
    return lines
