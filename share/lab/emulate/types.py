"""Types that the parts of the emulator share: meshes, rooms, instants, paths.

    layout (world) -> where paths fit (motion) -> room with pictures and light (world)
                   -> images of instants (render) -> sensor readings (sensor) -> a session

World frame: z up, origin in a lower corner of the room, metres. Gray levels are linear in light: the
non-linear parts (exposure, noise, saturation) belong to the sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from share.geometry.camera import Camera
from share.types import F32, F64, I64, U8, ImuBatch

I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles. vertices (V, 3) m and unit normals (V, 3); uv (V, 2): position in a picture of width
    1 that repeats; layer (V,): index of the picture, the same for all corners of a triangle; faces (F,
    3): corners, counter-clockwise from outside (both sides are drawn)."""

    vertices: F32
    normals: F32
    uv: F32
    layer: I32
    faces: I32

    @property
    def triangles(self) -> F32:
        """Return corners (F, 3, 3) m."""
        return self.vertices[self.faces]


@dataclass(frozen=True, eq=False)
class DrawableRoom:
    """A room ready to be drawn.

    size (3,) m. mesh: the static part. pictures (L, P, P) uint8: albedo, one a layer. light_map (H, W) uint8:
    baked light, 100 makes the gray level the albedo; light_uv (V, 2): position of each vertex of `mesh` in
    it, 0..1. agent_parts: by name, the rigid parts of each agent, each in the frame that
    `SceneInstant.part_poses` places; their light is `mover_light` everywhere.
    """

    name: str
    seed: int
    size: F64
    mesh: Mesh
    pictures: U8
    light_uv: F32
    light_map: U8
    agent_parts: dict[str, tuple[Mesh, ...]] = field(default_factory=dict)
    mover_light: float = 1.0


@dataclass(frozen=True, eq=False)
class SceneInstant:
    """Poses at one instant. T_world_cam (4, 4); part_poses: by name, T_world_part (P, 4, 4) of all other
    agents, as an agent does not see itself."""

    T_world_cam: F64
    part_poses: dict[str, F64] = field(default_factory=dict)


class RoomRenderer(Protocol):
    """Draws one room. Created once a process; not thread-safe."""

    def radiance(self, camera: Camera, instants: Sequence[SceneInstant]) -> F32:
        """Return an image (H, W) in linear gray levels 0..255, the mean over `instants`: one for a sharp
        image, several for motion blur. Includes the camera's distortion; pixel centres at integers."""
        ...

    def depth(self, camera: Camera, instant: SceneInstant) -> F32:
        """Return the exact depth (H, W) m along the optical axis through pixel centres, 0 where there is
        nothing."""
        ...


class MotionPath(Protocol):
    """The true motion of one agent's body (its IMU frame), continuous over its span.

    start_ns, end_ns: in the agent's clock, both included. gaps (G, 2) ns: without ground truth (lost by
    motion capture): no images there, and gaps in truth files. recorded: samples of a real IMU, used as they
    are; None: the IMU is simulated.
    """

    @property
    def start_ns(self) -> int: ...

    @property
    def end_ns(self) -> int: ...

    @property
    def gaps(self) -> I64: ...

    @property
    def recorded(self) -> ImuBatch | None: ...

    def poses(self, stamps_ns: I64) -> F64:
        """Return T_world_body (N, 4, 4). Raises ValueError outside the span."""
        ...

    def inertial(self, stamps_ns: I64) -> tuple[F64, F64]:
        """Return what a perfect IMU would measure: angular rate (N, 3) rad/s and specific force (N, 3) m/s^2
        in the body frame; gravity is `GRAVITY` along -z of the world."""
        ...

    def transformed(self, T_world_old: F64) -> MotionPath:
        """Return the same motion turned about the vertical and shifted by T_world_old (4, 4)."""
        ...


GRAVITY = 9.81  # m/s^2
START_NS = 1_750_000_000 * 10**9  # of simulated paths, at session time 0; an arbitrary constant


def stamps_within(stamps_ns: I64, start_ns: int, end_ns: int) -> I64:
    """Return stamps (N,) as they are. Raises ValueError where the path does not span one."""
    stamps = np.asarray(stamps_ns, np.int64)
    if len(stamps) and not start_ns <= stamps.min() <= stamps.max() <= end_ns:
        raise ValueError(
            f"stamps {stamps.min()} .. {stamps.max()} ns: the path spans {start_ns} .. {end_ns} ns"
        )
    return stamps
