"""Keyframes that agents would send to the edge from one emulated room, with exact ground truth."""

from __future__ import annotations

from dataclasses import dataclass

from share.errors import UsageError
from share.lab.emulate.recipe import SessionRecipe
from share.types import F64, Keyframe
from share.wire.messages import Hello


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
    `share.lab.emulate.world.scenes.corridor.twin_corridors` needs."""

    recipe: SessionRecipe
    every: Spacing
    size: tuple[float, float, float]
    agents: dict[str, AgentKeyframes]
