"""The session of `share demo`: two headsets and a robot in one room."""

from __future__ import annotations

from share.lab.emulate.recipe import SessionRecipe

MOTIONS = ("ar1=walk:speed=0.65", "ar2=walk:speed=0.55", "robot=robot:speed=0.3")
AGENTS = tuple(motion.partition("=")[0] for motion in MOTIONS)
PROFILE = "d435i:640x480@15"  # half of the device's frame rate: four processes share two cores
DEFAULT_SCENE, FALLBACK_SCENE = "warehouse", "plain"


def meeting_seed(scene: str) -> int:
    """Return a seed of the scene with which all three soon see the same things; with others 20 s may be too
    short."""
    return 3 if scene == FALLBACK_SCENE else 11


def recipe(scene: str, seconds: float, seed: int) -> SessionRecipe:
    """Return the recipe with the same three agents for any scene."""
    return SessionRecipe(scene, MOTIONS, seconds, seed, profiles={"": PROFILE})
