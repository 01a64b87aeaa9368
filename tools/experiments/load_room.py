"""The room of the load measurements: a warehouse that two headsets and a robot walk for a minute."""

from __future__ import annotations

from keyframe_set import KeyframeSet, keyframe_set

from share.lab.emulate.recipe import SessionRecipe

RECIPE = SessionRecipe("warehouse", ("ar1=walk:", "ar2=walk:", "robot=robot:"), 60.0, seed=301)


def room() -> KeyframeSet:
    """Made if it is not there yet, which takes a minute."""
    return keyframe_set(RECIPE)
