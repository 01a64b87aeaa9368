"""One agent's walk through a room, as a recording and its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from share.core.measurement import CAM0, CAM1, DEPTH, Measurement
from share.emulate.plain.agents import AGENTS, BASELINE, RATE_HZ, Agent
from share.emulate.plain.motion import move
from share.emulate.plain.render import Renderer
from share.emulate.plain.room import Room, make_room
from share.emulate.plain.sensor import Sensor
from share.geometry.se3 import inverse
from share.io.files import atomic_write
from share.io.images import EncodedImage
from share.io.mcap.recorder import Recorder
from share.io.trajectory import Trajectory, format_tum
from share.types import F64, U8

START_NS = 1_750_000_000 * 10**9  # any moment will do, so long as it is always the same
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]


def record(index: int, folder: Path, frames: int, seed: int, done: Callable[[], None]) -> None:
    """Write `NAME.mcap` and `truth/NAME.tum` of AGENTS[index] into `folder`; call `done` per frame.

    The same index, frames and seed give the same images and poses, whoever else is recorded.
    """
    agent, room = AGENTS[index], make_room(seed)
    T_world_body = move(agent.style, room.size, np.arange(frames) / RATE_HZ, (seed, 2, index))
    camera = _Camera(agent, room, (seed, 3, index))
    with Recorder(folder / f"{agent.name}.mcap", agent.rig) as recorder:
        for k, T in enumerate(T_world_body):
            for measurement in camera.shoot(k, T):
                recorder.write(measurement)
            done()
    truth = Trajectory(_stamps(frames), T_world_body)
    atomic_write(folder / "truth" / f"{agent.name}.tum", format_tum(truth))


def _stamps(frames: int) -> np.ndarray:
    return START_NS + np.arange(frames, dtype=np.int64) * (10**9 // RATE_HZ)


class _Camera:
    """All that an agent's rig sees of a room, encoded."""

    def __init__(self, agent: Agent, room: Room, seed: tuple[int, ...]) -> None:
        self._agent, self._rig = agent, agent.rig
        self._renderer, self._sensor = Renderer(room, agent.rig.cam0), Sensor(seed)

    def shoot(self, frame: int, T_world_body: F64) -> Iterator[Measurement]:
        rig, stamp = self._rig, int(_stamps(frame + 1)[-1])
        T_world_cam0 = T_world_body @ rig.T_body_cam0
        image, depth = self._renderer.render(T_world_cam0)
        yield Measurement(CAM0, stamp, self._gray(image, frame, 0))
        if rig.T_cam1_cam0 is not None:
            right, _ = self._renderer.render(T_world_cam0 @ inverse(rig.T_cam1_cam0))
            yield Measurement(CAM1, stamp, self._gray(right, frame, 1))
        if rig.depth is not None:
            mm = self._sensor.depth_mm(depth, rig.depth.fx * BASELINE, frame)
            yield Measurement(DEPTH, stamp, self._encoded(".png", mm, _PNG, 1000.0))

    def _gray(self, image: U8, frame: int, camera: int) -> EncodedImage:
        return self._encoded(".jpg", self._sensor.gray(image, frame, camera), _JPEG, 0.0)

    def _encoded(self, suffix: str, pixels: np.ndarray, options: list[int], scale: float) -> EncodedImage:
        data = cv2.imencode(suffix, pixels, options)[1].tobytes()
        height, width = pixels.shape
        return EncodedImage(data, f"emulated {self._agent.name}", width, height, scale)
