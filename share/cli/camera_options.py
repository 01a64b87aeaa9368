"""Options of a live camera, opening it, and its part of live lines and summaries."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import click

from share.cli.completion import complete_profile
from share.cli.terminal import LiveLine
from share.errors import UsageError
from share.timing import PeriodicTimer

if TYPE_CHECKING:
    from share.cameras.feed import CameraFeed
    from share.cameras.realsense.streams import StreamRequest
    from share.odometry.track_result import TrackResult
    from share.runtime.source import Source

PROFILE = "d435i"

profile = click.option(
    "--profile",
    "profile_name",
    metavar="P",
    shell_complete=complete_profile,
    help=f"Camera profile: its name or YAML file.  [default: {PROFILE}]",
)
mode = click.option("--mode", metavar="WxH[@HZ]", help="Image size and rate.  [default: the profile's]")
sensors = click.option(
    "--sensors",
    type=click.Choice(["stereo", "rgbd"]),
    help="Streams of a live camera: stereo (infrared pair) or rgbd (left image and depth).  "
    "[default: stereo]",
)


@dataclass(frozen=True)
class CameraOptions:
    """The camera options given; None where one was not."""

    profile_name: str | None
    mode: str | None
    sensors: str | None

    def camera_request(self) -> StreamRequest:
        """Return the streams to ask of the camera. Raises ConfigError for an unknown profile or mode."""
        from share.cameras.realsense.streams import StreamRequest
        from share.sensors.profile import load_profile

        rgbd = self.sensors == "rgbd"
        return StreamRequest(
            load_profile(self.profile_name or PROFILE, self.mode), depth=rgbd, right=not rgbd
        )

    def check_unused(self, source: str) -> None:
        """Raise UsageError if any camera option was given with a recording."""
        named = {"--profile": self.profile_name, "--mode": self.mode, "--sensors": self.sensors}
        options_given = ", ".join(option for option, value in named.items() if value is not None)
        if options_given:
            raise UsageError(
                f"{source}: {options_given} works only with a live camera (SOURCE realsense); leave it out"
            )


def camera_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of a live camera to a command, which gets them as `camera: CameraOptions`."""

    @functools.wraps(command)
    def with_camera(*args: Any, profile_name: str, mode: str, sensors: str, **options: Any) -> None:
        command(*args, camera=CameraOptions(profile_name, mode, sensors), **options)

    return profile(mode(sensors(with_camera)))


def open_source(
    source: str,
    calib: str | None,
    frames: slice | None,
    camera: CameraOptions,
    print_line: Callable[[str], None],
) -> Source:
    """Open a recording or a live camera; a camera is closed when the command ends.

    print_line: called with a line when the camera is lost, found again and so on.
    Raises UsageError, ConfigError, DataError, ShareError.
    """
    from share.cameras.realsense.devices import is_camera
    from share.runtime.source import open_source

    if not is_camera(source):
        camera.check_unused(source)
        return open_source(source, calib, frames)
    if frames is not None:
        raise UsageError("--frames works only with a recording, not with a live camera; leave it out")
    from share.cameras.realsense.camera import open_live
    from share.runtime.source import read_given_calibration

    calibration = read_given_calibration(calib)
    live = open_live(source, camera.camera_request(), print_line, calibration)
    click.get_current_context().with_resource(closing(live))
    return live


class TrackLine:
    """The live line of `share track` on a camera, updated once a second."""

    def __init__(self, feed: CameraFeed, line: LiveLine) -> None:
        self._feed, self._line, self._frames = feed, line, 0
        self._once_a_second = PeriodicTimer(1.0)

    def __call__(self, result: TrackResult) -> None:
        self._frames += 1
        if self._once_a_second.fire_if_due(time.monotonic_ns()):
            waiting_text = "" if result.waiting_for is None else f", waiting for {result.waiting_for.text}"
            camera = f"camera {self._feed.status()}"
            self._line.write(f"{self._frames} frames  tracking {result.state}{waiting_text}  {camera}")


def camera_status_text(feed: CameraFeed | None) -> str:
    """Return the camera's part of the agent's live line; empty without a camera."""
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
    """Return the non-zero event counts of a camera's report, and its health at the end unless OK."""
    events = [f"{name.replace('_', ' ')} {report[name]}" for name in _CAMERA_EVENTS if report[name]]
    return ", ".join([*events, *([] if report["health"] == "OK" else [f"{report['health']} at the end"])])


def camera_summary(report: dict[str, Any]) -> list[str]:
    """Return the lines on the camera of a run's report; none if it had no camera."""
    if "camera" not in report:
        return []
    camera_report = report["camera"]
    streams = camera_report["streams"].values()
    counts = [f"{name} {sum(one[name] for one in streams)}" for name in ("missing", "dropped", "backward")]
    lines = [
        f"camera: {', '.join([*counts, *filter(None, [camera_events(camera_report)])])} (docs/do/record.md)"
    ]
    if (known := report.get("imu_bias", {}).get("learnt_at")) is not None:
        lines.append(f"imu bias: from the run of {known}")
    return lines
