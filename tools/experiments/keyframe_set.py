"""Sets of keyframes from emulated rooms: made in a minute, opened in much less than a second.

    from keyframe_set import Spacing, keyframe_set

    made = keyframe_set(SessionRecipe("corridor-twins", ("walk:", "walk:"), 40.0, seed=3), Spacing(0.3, 0.35))
    for name, agent in made.agents.items():  # agent.hello, .keyframes, .T_world_body, .T_odom_body

Room, motions, sensors, exposure and noise are those of `share emulate` with the same recipe, and each view is
what `make_view` finds in the frame that it would record. Only keyframes are drawn: the first along the true
path after each `Spacing`. Odometry is simulated, see `keyframe_odometry`. Unlike with an inertial tracker,
stereo depths of a view start without a guess, and there are keyframes from the first frame on.
"""

from __future__ import annotations

from pathlib import Path

from keyframe_file import load, save
from keyframe_types import AgentKeyframes, KeyframeSet, Spacing

from share.files.writing import writable_dir
from share.lab.emulate.recipe import Progress, SessionRecipe, no_progress
from share.lab.emulate.session import default_cache

__all__ = ["AgentKeyframes", "KeyframeSet", "Spacing", "keyframe_set", "place"]

# increase it when any keyframe changes (ORB, depth, odometry); the recipe has the emulator's version
VERSION = 3


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
