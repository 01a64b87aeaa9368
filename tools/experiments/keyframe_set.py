"""Sets of keyframes from emulated rooms: a set is made in a minute, and opened in much less than a second.

    from keyframe_set import Spacing, keyframe_set

    made = keyframe_set(Recipe("corridor-twins", ("walk:", "walk:"), 40.0, seed=3), Spacing(0.3, 0.35))
    for name, agent in made.agents.items():  # agent.hello, .keyframes, .T_world_body, .T_odom_body

Room, motions, sensors, exposure and noise are those of `share emulate` with the same recipe, and each view is
what `make_view` finds in the frame that this would record. Of all frames only keyframes are drawn: the first
along the true path after each `Spacing`. Odometry is drawn, see `keyframe_odometry`. Unlike an inertial
tracker's, a view's stereo depths start from no guess, and there are keyframes from the first frame on.
"""

from __future__ import annotations

from pathlib import Path

from keyframe_file import load, save
from keyframe_types import AgentKeyframes, KeyframeSet, Spacing

from share.files.writing import writable_dir
from share.lab.emulate.progress import Progress, no_progress
from share.lab.emulate.recipe import SessionRecipe
from share.lab.emulate.session import default_cache

__all__ = ["AgentKeyframes", "KeyframeSet", "Spacing", "keyframe_set", "place"]

VERSION = 3  # raise it when any keyframe changes (ORB, depth, odometry); emulation has its own in the recipe


def place(recipe: SessionRecipe, every: Spacing, cache: Path | None = None) -> Path:
    """The file of this set in `cache` (default: the user's), whether or not it is there."""
    folder = (default_cache() if cache is None else cache) / "keyframes"
    return folder / f"{recipe.digest}-{every}-v{VERSION}.msgpack"


def keyframe_set(
    recipe: SessionRecipe,
    every: Spacing | None = None,
    cache: Path | None = None,
    workers: int = 1,
    progress: Progress = no_progress,
) -> KeyframeSet:
    """The set of this recipe, made with `workers` processes if it is not there yet; to open one takes no
    OpenGL. Raises UsageError, ConfigError or DataError for what cannot be made, DataError for a damaged file,
    RenderError where nothing can be drawn."""
    every = every or Spacing()
    path = place(recipe, every, cache)
    if not path.exists():
        from keyframe_making import make

        writable_dir(path.parent)
        save(make(recipe, every, workers, progress), path)
    return load(path, recipe, every)
