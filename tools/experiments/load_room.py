"""The room of the load measurements: a warehouse with two headsets and a robot for a minute."""

from __future__ import annotations

from keyframe_set import KeyframeSet, keyframe_set

from share.lab.emulate.recipe import SessionRecipe

RECIPE = SessionRecipe("warehouse", ("ar1=walk:", "ar2=walk:", "robot=robot:"), 60.0, seed=301)


def room() -> KeyframeSet:
    """Return the set; making it takes a minute."""
    return keyframe_set(RECIPE)
