"""`share` on a device of the tutorial. What its camera sees is by the name of the recording that it makes;
for `share agent` it is called live. Arguments: the device; then those of `share`."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import field_trip
import pyrealsense2 as rs
from helpers.room_camera import BEGIN_US, RoomCamera
from helpers.software_camera import SoftwareCamera
from helpers.software_share import share

from share.cli import main as command_line
from share.recordings.images import ArrayImage
from share.runtime.source import Source
from share.sensors.measurement import Measurement
from share.sensors.sample_processor import GYRO
from share.types import I64

PATIENCE_S = 1.0  # of the person who ends what runs until Ctrl-C


class InMemory:
    """A recording whose images are decoded already: a camera takes none of its computer's time for that."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._all = [
            replace(m, payload=ArrayImage(m.payload.load())) if m.stream in ("cam0", "cam1") else m
            for m in source.measurements()
        ]

    def measurements(self) -> list[Measurement]:
        return self._all

    def stamps(self) -> dict[str, I64]:
        return self._source.stamps()


class Pace:
    """Waits until it is time, and leaves the thread that plays when all has ended."""

    def __init__(self, ended: threading.Event) -> None:
        self._ended, self._began = ended, time.monotonic()

    def until(self, after_s: float) -> None:
        if self._ended.wait(max(0.0, self._began + after_s - time.monotonic())):
            sys.exit()


def play_rest(camera: SoftwareCamera, ended: threading.Event) -> None:
    pace = Pace(ended)
    for stamp_us, sensor, felt in field_trip.rest():
        if stamp_us % 50_000 == 0:
            pace.until(stamp_us / 1e6)
        (camera.turn if sensor == GYRO else camera.force)(BEGIN_US + stamp_us, *felt)


def play_room(room: RoomCamera, ended: threading.Event) -> None:
    """Once; then the person presses Ctrl-C."""
    pace = Pace(ended)
    stamps = iter(room.source.stamps()["cam0"].tolist())
    room.play(lambda: pace.until((next(stamps) - room.first_ns) / 1e9))
    if not ended.wait(PATIENCE_S):
        print("^C", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGINT)


def recorded(words: list[str]) -> str:
    """The name of what is recorded, "" where no camera is asked for."""
    if words[:1] == ["capture"]:
        return Path(words[words.index("--out") + 1]).stem
    return "live" if words[:2] in (["agent", "realsense"], ["calibrate", "realsense"]) else ""


def main(machine: str, words: list[str]) -> None:
    name = recorded(words)
    if not name:
        command_line.main(words)
    elif name == field_trip.REST:
        lying = SoftwareCamera(rs, serial=f"{machine}-1")
        share(words, lying, lambda ended: play_rest(lying, ended))
    else:
        moving = RoomCamera(rs, InMemory(field_trip.world(machine, name)), f"{machine}-1")
        share(words, moving.camera, lambda ended: play_room(moving, ended))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
