"""People whose agents say what is not so: a wrong calibration, a wrong clock, odometry that leaps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from helpers.edge_sim import MS, Person

from share.geometry import se3
from share.types import F64, View
from share.wire.messages import Hello


@dataclass
class Miscalibrated(Person):
    """Sees everything larger by `scale` along the camera's axes, and moves so; `tilt` (rotation vector): its
    camera is not turned on its body as it says."""

    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    tilt: tuple[float, float, float] = (0.0, 0.0, 0.0)
    _told: list[F64] = field(default_factory=list)

    @property
    def hello(self) -> Hello:
        T_body_cam0 = se3.from_rt(se3.so3_exp(np.array(self.tilt)), np.zeros(3))
        hello = super().hello
        return replace(hello, rig=replace(hello.rig, T_body_cam0=T_body_cam0))

    def step(self) -> tuple[F64, View]:
        T, view = super().step()
        if not self._told:
            self._told.append(T)
        else:
            moved = se3.inverse(self.T_odom_body[-2]) @ T
            moved[:3, 3] *= self.scale
            self._told.append(self._told[-1] @ moved)
        scale = np.array(self.scale)
        points = view.points * scale.astype(np.float32)
        return self._told[-1], View(
            view.uv * (scale[:2] / scale[2]).astype(np.float32), points, view.descriptors
        )


@dataclass
class WrongClock(Person):
    """An hour ahead, and after 20 frames an hour behind."""

    def stamp_ns(self, now_ns: int) -> int:
        hour = 3600 * 1000 * MS
        return now_ns + (hour if len(self.T_world_body) <= 20 else -hour)


@dataclass
class Leaper(Person):
    """Its odometry leaps 100 m at some frames, and nobody says so."""

    at: tuple[int, ...] = (15, 30)

    def step(self) -> tuple[F64, View]:
        T, view = super().step()
        if len(self.T_odom_body) - 1 in self.at:
            T = self.T_odom_body[-1] = se3.from_rt(np.eye(3), np.array([100.0, 0.0, 0.0])) @ T
        return T, view


@dataclass
class Blind(Person):
    """Views of `see` points."""

    see: int = 0

    def step(self) -> tuple[F64, View]:
        T, view = super().step()
        return T, View(view.uv[: self.see], view.points[: self.see], view.descriptors[: self.see])
