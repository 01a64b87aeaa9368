"""What `share demo` plays: two headset wearers and a robot in one room."""

from __future__ import annotations

from share.emulate.recipe import Recipe

MOTIONS = ("ar1=walk:speed=0.65", "ar2=walk:speed=0.55", "robot=robot:speed=0.3")
AGENTS = tuple(motion.partition("=")[0] for motion in MOTIONS)
PROFILE = "d435i:640x480@15"  # four processes share two cores: half of what the device can do
SCENE, FALLBACK = "warehouse", "plain"
_MEETING = {
    "plain": 3
}  # rooms of a kind in which they soon look at the same things; in others 20 s may be too short
_ELSE = 11


def recipe(scene: str, seconds: float, seed: int | None = None) -> Recipe:
    """The same three for every scene. seed: which room; None: one in which they meet."""
    room = _MEETING.get(scene, _ELSE) if seed is None else seed
    return Recipe(scene, MOTIONS, seconds, room, profiles={"": PROFILE})
