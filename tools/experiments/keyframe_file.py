"""A set of keyframes as one file: msgpack of messages as agents send them, and of poses."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import msgspec
import numpy as np
from keyframe_types import AgentKeyframes, KeyframeSet, Spacing

from share.errors import DataError, WireError
from share.files.writing import atomic_write
from share.lab.emulate.recipe import SessionRecipe
from share.types import F64, Keyframe
from share.wire.codec import decode, encode
from share.wire.messages import Hello, Message


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
        cast(Hello, decode(agent.hello)),
        tuple(cast(Keyframe, decode(frames)) for frames in agent.keyframes),
        _poses(agent.T_world_body),
        _poses(agent.T_odom_body),
    )


def _frames(message: Message) -> list[bytes]:
    return [bytes(frame) for frame in encode(message)]


def _poses(data: bytes) -> F64:
    return np.frombuffer(data, "<f8").reshape(-1, 4, 4)
