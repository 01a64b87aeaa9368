"""Sets of keyframes from emulated rooms: made in a minute, opened in much less than a second.

    from keyframe_set import Spacing, keyframe_set

    made = keyframe_set(SessionRecipe("corridor-twins", ("walk:", "walk:"), 40.0, seed=3), Spacing(0.3, 0.35))
    for name, agent in made.agents.items():  # agent.hello, .keyframes, .T_world_body, .T_odom_body

Room, motions, sensors, exposure and noise are those of `share emulate` with the same recipe, and each image
is that of the frame that it would record. Only keyframes are drawn: the first along the true path after each
`Spacing`. Odometry is simulated, see `keyframe_odometry`. Unlike with an inertial tracker, surfaces are
corners with the depth of this one frame, taken to face the camera, and there are keyframes from the first
frame on.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import msgspec
import numpy as np

from share.errors import DataError, UsageError, WireError
from share.files.writing import atomic_write, writable_dir
from share.lab.emulate.recipe import Progress, SessionRecipe, no_progress
from share.lab.emulate.session import default_cache
from share.types import F64, Keyframe
from share.wire.codec import WIRE_VERSION, decode, encode
from share.wire.messages import Hello, Message

__all__ = ["AgentKeyframes", "KeyframeSet", "Spacing", "keyframe_set", "place"]

# increase it when any keyframe changes (image, depth, odometry); the recipe has the emulator's version
VERSION = 4
_READABLE = (6, 7, WIRE_VERSION)  # wire versions with these keyframes


def place(recipe: SessionRecipe, every: Spacing, cache: Path | None = None) -> Path:
    """Return the file of this set in `cache` (default: the user's), whether or not it exists."""
    folder = (default_cache() if cache is None else cache) / "keyframes"
    return folder / f"{recipe.digest}-{every}-v{VERSION}.msgpack"


def keyframe_set(
    recipe: SessionRecipe,
    every: Spacing | None = None,
    cache: Path | None = None,
    workers: int = 1,
    progress: Progress = no_progress,
) -> KeyframeSet:
    """Return the set of this recipe; make it with `workers` processes if it does not exist. Opening needs no
    OpenGL. Raises UsageError, ConfigError or DataError for an invalid recipe, DataError for a damaged file,
    RenderError where this machine cannot draw."""
    every = every or Spacing()
    path = place(recipe, every, cache)
    if not path.exists():
        from keyframe_making import make

        writable_dir(path.parent)
        save(make(recipe, every, workers, progress), path)
    return load(path, recipe, every)


@dataclass(frozen=True)
class Spacing:
    """A keyframe follows after `metres` or `radians` since the last one, but not within `seconds`. Raises
    UsageError where one of them is not positive."""

    metres: float = 0.15
    radians: float = 0.2
    seconds: float = 0.1

    def __post_init__(self) -> None:
        if not min(self.metres, self.radians, self.seconds) > 0:
            raise UsageError(f"spacing {self}: must be positive")

    def __str__(self) -> str:
        return f"{self.metres:g}m-{self.radians:g}rad-{self.seconds:g}s"


@dataclass(frozen=True, eq=False)
class AgentKeyframes:
    """keyframes: N of them, in the order of sending. T_world_body (N, 4, 4): true poses. T_odom_body (N, 4,
    4): poses of odometry, which the keyframes' steps add up to."""

    hello: Hello
    keyframes: tuple[Keyframe, ...]
    T_world_body: F64
    T_odom_body: F64


@dataclass(frozen=True, eq=False)
class KeyframeSet:
    """agents: by name. size: of the room (x, y, z) m, which
    `share.lab.emulate.world.scenes.hard_rooms.twin_corridors` needs."""

    recipe: SessionRecipe
    every: Spacing
    size: tuple[float, float, float]
    agents: dict[str, AgentKeyframes]


class _Agent(msgspec.Struct, array_like=True):
    """One agent: frames of messages; poses are (N, 4, 4) little-endian doubles."""

    hello: list[bytes]
    keyframes: list[list[bytes]]
    T_world_body: bytes
    T_odom_body: bytes


class _Set(msgspec.Struct):
    size: tuple[float, float, float]
    agents: dict[str, _Agent]


def save(made: KeyframeSet, path: Path) -> None:
    """Write the set atomically. Raises as `atomic_write`."""
    agents = {name: _packed(agent) for name, agent in made.agents.items()}
    atomic_write(path, msgspec.msgpack.encode(_Set(made.size, agents)))


def load(path: Path, recipe: SessionRecipe, every: Spacing) -> KeyframeSet:
    """Return the set made of this recipe. Raises DataError where the file is damaged."""
    try:
        found = msgspec.msgpack.decode(path.read_bytes(), type=_Set)
        agents = {name: _unpacked(agent) for name, agent in found.agents.items()}
    except (msgspec.MsgspecError, WireError, ValueError) as error:
        raise DataError(f"{path}: is damaged ({error}); delete it and run the command again") from None
    return KeyframeSet(recipe, every, found.size, agents)


def _packed(agent: AgentKeyframes) -> _Agent:
    return _Agent(
        _frames(agent.hello),
        [_frames(keyframe) for keyframe in agent.keyframes],
        agent.T_world_body.astype("<f8").tobytes(),
        agent.T_odom_body.astype("<f8").tobytes(),
    )


def _unpacked(agent: _Agent) -> AgentKeyframes:
    return AgentKeyframes(
        cast(Hello, decode(agent.hello, _READABLE)),
        tuple(cast(Keyframe, decode(frames, _READABLE)) for frames in agent.keyframes),
        _poses(agent.T_world_body),
        _poses(agent.T_odom_body),
    )


def _frames(message: Message) -> list[bytes]:
    return [bytes(frame) for frame in encode(message)]


def _poses(data: bytes) -> F64:
    return np.frombuffer(data, "<f8").reshape(-1, 4, 4)
