"""The world of the tutorial: what the cameras of its two devices see and feel, recording by recording, and
what the motion capture of the room exports. Emulated, and kept from one walk to the next."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from helpers.field_sim import Watched, export, paths, seen

from share.geometry import se3
from share.lab.emulate.recipe import Progress, SessionRecipe, no_progress
from share.lab.emulate.sensor.effects import Effects
from share.lab.emulate.sensor.imu import measured_samples
from share.lab.emulate.session import make_cached_session
from share.runtime.source import Source, open_source
from share.sensors.profile import load_profile
from share.sensors.sample_processor import ACCEL, GYRO

MODE = "d435i:640x480@15"
LATE = Effects(time_offset_ms=3.0)  # the pictures of these devices
SPARE_S = 2.0  # a world lasts longer than the recording of it
REST_S = 600.0
REST = "rest"


def _recipe(scene: str, motions: tuple[str, ...], seconds: float, seed: int) -> SessionRecipe:
    return SessionRecipe(
        scene, motions, seconds + SPARE_S, seed, sensors={"": "stereo"}, profiles={"": MODE}, effects=LATE
    )


_BOARD = ("headset=board:",)
_ROOM = ("headset=walk:", "robot=robot:")
RECIPES = {
    "board": _recipe("board", _BOARD, 40, 71),
    "dance": _recipe("board", _BOARD, 40, 72),
    "carried": _recipe("warehouse", ("robot=walk:",), 40, 73),
    "live": _recipe("warehouse", _ROOM, 40, 74),
    "field": _recipe("warehouse", _ROOM, 60, 75),
}
WATCHED = {  # bodies of the motion capture; the robot's markers do not move from the carrying to the field
    "headset": ("Headset1", Watched(se3.exp(np.array([0.4, -1.9, 0.6, 0.05, -0.08, 0.07])))),
    "robot": ("Turtle", Watched(se3.exp(np.array([1.1, 0.3, -0.5, -0.07, 0.03, 0.12])))),
}
MOCAP_NOISE = (0.0005, np.radians(0.1))


def session(name: str, progress: Progress) -> Path:
    """That world's, made once."""
    return make_cached_session(RECIPES[name], progress=progress)


def world(machine: str, name: str) -> Source:
    """What the camera of `machine` is in while it records `name`."""
    return open_source(str(session(name, no_progress) / machine))


def exports(folder: Path) -> None:
    """The motion capture's files: carried.csv and field.csv."""
    for k, name in enumerate(("carried", "field")):
        recipe = RECIPES[name]
        moved = paths(recipe, folder / f"{name}-room")
        bodies = {
            body: seen(moved[machine], watched, MOCAP_NOISE, 10 * k + i)
            for i, (machine, (body, watched)) in enumerate(WATCHED.items())
            if machine in moved
        }
        export(folder / f"{name}.csv", bodies)


def rest(seed: int = 1) -> Iterator[tuple[int, str, list[float]]]:
    """A D435i that lies on a table: stamp (us), sensor, and what it feels, in order."""
    imu = load_profile(MODE.partition(":")[0]).device.imu
    rows = []
    for k, (name, sensor, felt) in enumerate(
        ((GYRO, imu.gyro, (0.0, 0.0, 0.0)), (ACCEL, imu.accel, (0.0, -9.81, 0.0)))
    ):
        n = int((REST_S + SPARE_S) * sensor.rate_hz)
        stamps = np.round(np.arange(n) * 1e6 / sensor.rate_hz).astype(int).tolist()
        values = measured_samples(np.tile(felt, (n, 1)), sensor, (seed, k)).tolist()
        rows.append(zip(stamps, [name] * n, values, strict=True))
    return heapq.merge(*rows)
