"""The rooms that come with SHARE: seeded layouts by name."""

from __future__ import annotations

from share.lab.emulate.world.scenes.registry import SCENES, SceneEntry, make_scene_layout

__all__ = ["SCENES", "SceneEntry", "make_scene_layout"]
