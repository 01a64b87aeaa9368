"""What `share demo` plays: two headset wearers and a robot in one room."""

from __future__ import annotations

from share.lab.emulate.recipe import SessionRecipe

MOTIONS = ("ar1=walk:speed=0.65", "ar2=walk:speed=0.55", "robot=robot:speed=0.3")
AGENTS = tuple(motion.partition("=")[0] for motion in MOTIONS)
PROFILE = "d435i:640x480@15"  # four processes share two cores: half of what the device can do
DEFAULT_SCENE, FALLBACK_SCENE = "warehouse", "plain"


def meeting_seed(scene: str) -> int:
    """Of a room in which all three soon look at the same things; in others 20 s may be too short for that."""
    return 3 if scene == FALLBACK_SCENE else 11


def recipe(scene: str, seconds: float, seed: int) -> SessionRecipe:
    """The same three for every scene."""
    return SessionRecipe(scene, MOTIONS, seconds, seed, profiles={"": PROFILE})
