"""Rooms for experiments with scarce air: keyframes without a view, as large on the wire as real ones."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from keyframe_making import make_unseen
from keyframe_set import AgentKeyframes, KeyframeSet, Spacing, load, place, save

from share.files.writing import writable_dir
from share.lab.emulate.recipe import SessionRecipe
from share.types import U8

_KINDS = ("ar", "ar", "robot")
_QUALITIES = range(20, 56, 5)  # of JPEG: a keyframe then has 21 to 31 kB, 27 in the mean
_STREAM = 39  # of random numbers


def scarce_room(agents: int, seed: int, seconds: float = 60.0) -> KeyframeSet:
    """Return a warehouse in which two headsets per robot walk; its area grows with their number. Made once,
    then read from the cache of keyframe sets."""
    kinds = [_KINDS[k % len(_KINDS)] for k in range(agents)]
    motions = tuple(f"{kind}{k}={'walk' if kind == 'ar' else 'robot'}:" for k, kind in enumerate(kinds))
    side = max(8.0, 3.0 * agents**0.5 + 3)
    width = min(side, 20.0)
    recipe = SessionRecipe("warehouse", motions, seconds, seed=seed, size=(side**2 / width, width, 4.0))
    every = Spacing()
    path = place(recipe, every).with_suffix(".unseen.msgpack")
    if not path.exists():
        writable_dir(path.parent)
        save(make_unseen(recipe, every), path)
    made = load(path, recipe, every)
    rng = np.random.default_rng((seed, _STREAM))
    return replace(made, agents={name: _sized(agent, rng) for name, agent in made.agents.items()})


def _sized(agent: AgentKeyframes, rng: np.random.Generator) -> AgentKeyframes:
    """Return the agent with a JPEG in each keyframe, of a size drawn from those of real ones."""
    camera = agent.hello.rig.cam0
    jpegs = [_jpeg(camera.width, camera.height, quality) for quality in _QUALITIES]
    drawn = rng.integers(len(jpegs), size=len(agent.keyframes)).tolist()
    keyframes = tuple(
        replace(keyframe, image=replace(keyframe.image, jpeg=jpegs[k]))
        for keyframe, k in zip(agent.keyframes, drawn, strict=True)
    )
    return replace(agent, keyframes=keyframes)


@lru_cache
def _jpeg(width: int, height: int, quality: int) -> U8:
    noise = np.random.default_rng(_STREAM).integers(0, 256, (height, width), dtype=np.uint8)
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3.0), None, 0, 255, cv2.NORM_MINMAX)
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].reshape(-1)
