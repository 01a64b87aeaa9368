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
from share.vision.keyframe_images import compress

_KINDS = ("ar", "ar", "robot")
# of pictures: a keyframe then has 14 to 24 kB, and .6 of it with a small picture; of 110 emulated recordings
# 90 % have 13 to 26 kB (mean 19.8), and .57 of it with a small picture
_CONTRASTS = tuple(np.linspace(0.4, 1.0, 8).tolist())
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
    jpegs = [_jpeg(camera.width, camera.height, contrast) for contrast in _CONTRASTS]
    drawn = rng.integers(len(jpegs), size=len(agent.keyframes)).tolist()
    keyframes = tuple(
        replace(keyframe, image=replace(keyframe.image, jpeg=jpegs[k]))
        for keyframe, k in zip(agent.keyframes, drawn, strict=True)
    )
    return replace(agent, keyframes=keyframes)


@lru_cache
def _jpeg(width: int, height: int, contrast: float) -> U8:
    noise = np.random.default_rng(_STREAM).integers(0, 256, (height, width), dtype=np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 4.5).astype(np.float32)
    picture = 128 + contrast * (cv2.normalize(blurred, None, 0, 255, cv2.NORM_MINMAX) - 128)
    return compress(picture.astype(np.uint8))
